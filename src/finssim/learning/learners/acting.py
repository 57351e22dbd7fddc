"""What all learners share that act in an environment: its tally, their steps, and a state that holds everything."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

from finssim.learning.layers import Arrays
from finssim.learning.resume import random_state, set_random_state
from finssim.learning.tally import EpisodeTally
from finssim.tasks import Environment

__all__ = ["ActingLearner"]


class ActingLearner:
    """Base of the learners; `learned` and `load_learned` are its own part of the state."""

    def __init__(self, environment: Environment, settings: Any, arrays: Arrays | None = None) -> None:
        """Take the environment, whose first episodes are going to be aged, and the library of the learner's arrays."""
        self.environment, self.settings = environment, settings
        self.tally = EpisodeTally(environment, arrays=arrays)
        self.steps = 0

    @property
    def left(self) -> float:
        """Part of the training that is still to come, in [0, 1]."""
        return max(0.0, 1.0 - self.steps / self.settings.steps)

    def learned(self) -> dict[str, Any]:
        """Parameters, optimisers and what else is the learner's own."""
        raise NotImplementedError

    def load_learned(self, state: dict[str, Any]) -> None:
        """Take what `learned` gave."""
        raise NotImplementedError

    def state(self) -> dict[str, Any]:
        """Everything that decides what comes next, as copies."""
        return {
            "steps": self.steps,
            "environment": self.environment.state(),
            "tally": self.tally.state(),
            "random": random_state(),
            "learner": deepcopy(self.learned()),
        }

    def load(self, state: dict[str, Any]) -> None:
        """Go on from a state of a learner that was made alike."""
        self.steps = int(state["steps"])
        self.environment.load_state(state["environment"])
        self.tally.load(state["tally"])
        self.load_learned(state["learner"])
        set_random_state(state["random"])
