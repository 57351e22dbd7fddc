"""Common parts of the learners: settings, their task-specific defaults, and acting in an environment."""

from __future__ import annotations

import math
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any, ClassVar

from finssim.agents.agent import expert_for
from finssim.control.modes import MODES
from finssim.learning.episodes import EpisodeTally
from finssim.learning.layers import Arrays
from finssim.learning.resume import random_state, set_random_state
from finssim.tasks import Environment, Task

# Task-specific changes of the learners' default settings; they are defined here only.


ON_POLICY = ("sb3-ppo", "rsl-rl", "torchrl-ppo", "torchrl-ippo", "torchrl-mappo")
"""Learners that `on-policy` stands for below: those of external libraries with `OnPolicySettings`."""

Table = dict[str, dict[str, dict[str, Any]]]
"""Task -> `on-policy` or a learner's name, which takes precedence -> changes of the defaults. `*` is every task;
entries of a task take precedence."""

CHASE: dict[str, dict[str, Any]] = {
    # A capture or delivery is far ahead: ten seconds of foresight. Its reward exceeds that of a step by so much that
    # the value error must not use up the gradient norm that policy and value share; RSL-RL's do not share one.
    "on-policy": {"discount": 0.99, "value_weight": 0.05, "learning_rate": 2.0e-3, "steps": 1_000_000},
    "rsl-rl": {"value_weight": 1.0},
    "ppo": {"discount": 0.99, "steps": 600_000},
}

SIGHT: dict[str, dict[str, Any]] = {"bc": {"steps": 600_000, "hidden": (128, 64), "batch": 256}}
"""Settings of tasks with pictures, which need separate networks."""

SETTINGS: Table = {
    # Smaller networks than the default are as good here, and train in three quarters of the time.
    "t1": {"ppo": {"hidden": (48, 48)}},
    "t2": {
        # A reference is always close: one second of foresight is enough, and learns faster than five.
        "ppo": {"discount": 0.9, "steps": 500_000},
        "on-policy": {"discount": 0.9},
    },
    # The same holds for a moving target, once it has been reached.
    "t3": {"on-policy": {"discount": 0.95}, "ppo": {"steps": 600_000}},
    "velocity6": {"on-policy": {"discount": 0.95}},
    "docking": {"ppo": {"steps": 900_000}},
    # The teacher succeeds in all episodes after a quarter of these steps, and the student after half of them.
    "pipeline": {"distill": {"teacher_steps": 600_000, "steps": 60_000}, **SIGHT},
    "gate": {"distill": {"teacher_steps": 600_000}, **SIGHT},
    # The student succeeds in all episodes after a quarter of these steps.
    "net": {"distill": {"teacher_steps": 300_000, "steps": 12_800, "learning_rate": 2.0e-3}, **SIGHT},
    "camera-docking": SIGHT,
    "pursuit": {**CHASE, "ppo": {**CHASE["ppo"], "teacher": "lead"}},
    # After 1.5 million steps, half of the seeds have only begun to capture.
    "team-pursuit": {
        "on-policy": {**CHASE["on-policy"], "steps": 3_600_000},
        "rsl-rl": CHASE["rsl-rl"],
        # The first captures are a matter of luck, which half of the seeds lacked; the baseline demonstrates them.
        "ppo": {
            "discount": 0.99,
            "learning_rate": 2.0e-3,
            "entropy_weight": 0.003,
            "steps": 1_500_000,
            "teacher": "formation",
        },
    },
    "formation": {
        "on-policy": {**CHASE["on-policy"], "learning_rate": 2.5e-3, "steps": 1_800_000},
        "rsl-rl": CHASE["rsl-rl"],
        "ppo": {"discount": 0.99, "learning_rate": 2.0e-3, "steps": 1_500_000, "teacher": "consensus"},
    },
}
"""Settings of every training."""

RANDOMIZED: Table = {
    # There is more to learn.
    "*": {
        "ppo": {"steps": 1_000_000},
        "on-policy": {"steps": 3_000_000},
    },
    # The latest observations and actions reveal this vehicle's response: thrust, lag, and delay of the state.
    "t1": {"ppo": {"steps": 2_000_000, "history": 2, "last_action": True}},
    "t2": {
        "ppo": {"steps": 2_000_000, "history": 2, "last_action": True},
        "on-policy": {"steps": 2_000_000},
    },
    "t3": {"ppo": {"steps": 1_500_000}},
    "velocity6": {"ppo": {"steps": 2_000_000, "history": 2, "last_action": True}},
    "docking": {"ppo": {"steps": 2_000_000}},
    # In `open_water` the student succeeds in all episodes after half of these steps.
    "camera-docking": {"distill": {"teacher_steps": 1_500_000, "steps": 60_000}},
    # After a third of these steps the teacher is too slow along the net in some currents.
    "net": {"distill": {"teacher_steps": 900_000}},
    "pursuit": {"ppo": {"steps": 1_500_000}, "on-policy": {"steps": 2_500_000}},
    "team-pursuit": {"ppo": {"steps": 3_000_000}, "on-policy": {"steps": 6_000_000}},
    "formation": {"ppo": {"steps": 3_000_000}, "on-policy": {"steps": 4_000_000}},
}
"""Additional settings if every episode has another vehicle (`--randomize`)."""


def task_settings(task: str, learner: str, randomized: bool) -> dict[str, Any]:
    """Return the task-specific changes of a learner's defaults; none for a task that is not in the tables."""
    changes: dict[str, Any] = {}
    for name in ("*", task):
        for table in (SETTINGS, RANDOMIZED) if randomized else (SETTINGS,):
            rows = table.get(name, {})
            changes |= rows.get("on-policy", {}) if learner in ON_POLICY else {}
            changes |= rows.get(learner, {})
    return changes


# Settings that all PPO learners share, of any library.


ROLLOUT_SAMPLES = 8192
"""Fewest samples between two updates of the learners of external libraries."""


@dataclass(frozen=True, kw_only=True)
class OnPolicySettings:
    """Settings of PPO; the defaults, for T1, hold setpoints to a centimetre after some twenty seconds of training."""

    worlds: int = 256
    steps: int = 1_300_000
    """Control steps, summed over all worlds."""
    rollout: int = 32
    """Control steps of each world between two updates."""
    batch: int = 2048
    """Samples in a gradient step. For equal computation, many small steps learn faster here than few large ones."""
    epochs: int = 5
    """Passes over a rollout."""
    learning_rate: float = 1.5e-3
    """Initial learning rate; it decreases linearly to zero, which yields the last centimetres."""
    discount: float = 0.98
    """Discount factor per control step: 5 s of foresight at 10 Hz, a few time constants of the vehicle."""
    gae_lambda: float = 0.95
    """Factor λ of the generalised advantage."""
    clip: float = 0.2
    """Bound ε on the ratio of probabilities, less 1."""
    value_weight: float = 0.5
    """Weight of the value's squared error relative to the policy's objective, if both share a gradient norm."""
    largest_gradient: float = 0.5
    """Norm to which larger gradients are clipped, so that an outlier batch does not undo the progress of many."""
    entropy_weight: float = 0.0
    """Weight of the entropy; 0 by default, because rewarded noise would keep the vehicle from settling."""
    log_std: float = -1.0
    """Logarithm of the initial standard deviation of the action noise; more noise hides the goal's last
    centimetres."""
    hidden: tuple[int, ...] = (64, 64)
    """Units of the hidden layers, ELU, of policy and value each."""


def expert_in(environment: Environment, name: str) -> Any:
    """Return the expert of a learner in an environment: a baseline of the task by name, or a policy directory.

    Raises:
        AgentError: There is neither, or its action mode differs from the environment's.
        PolicyError: The policy was trained for another vehicle or task.
    """
    e = environment
    mode, vehicle = MODES[e.action_mode], e.nominal[0]
    scale = mode.mix(vehicle) @ e.wrench_scale if mode.wrench else 1.0
    return expert_for(name, vehicle, e.task, e.action_mode, scale)


# Common part of all learners that act in an environment: episode statistics, step count, and the complete state.


class ActingLearner:
    """Base class of the learners; `learned` and `load_learned` are the learner-specific part of the state."""

    Settings: ClassVar[Any]
    """Class of its settings."""
    rollout_samples: ClassVar[int] = 0
    """Fewest samples between two updates: with few worlds, rollouts are longer. 0: as in the settings."""

    gpu_factor: ClassVar[int] = 1
    """Factor on worlds, batch and steps on a GPU, which preserves the number of gradient steps."""

    @classmethod
    def settings_for(
        cls,
        task: Task,
        changes: Mapping[str, Any],
        worlds: int | None,
        steps: int | None,
        device: str = "cpu",
    ) -> Any:
        """Return the settings of a training: defaults with the task's changes, and with worlds and steps unless None.

        On a GPU the samples in a gradient step scale with the number of worlds. A teacher acts on the host, so a
        training with a teacher has the settings of a CPU.
        """
        stated = {name: value for name, value in (("worlds", worlds), ("steps", steps)) if value is not None}
        settings = replace(cls.Settings(), **changes)
        if device != "cpu" and cls.gpu_factor > 1 and not settings.teacher:
            factor = cls.gpu_factor if worlds is None else max(1, worlds // settings.worlds)
            scaled = {name: factor * getattr(settings, name) for name in ("worlds", "batch", "steps")}
            settings = replace(settings, **scaled)
        settings = replace(settings, **stated)
        if not cls.rollout_samples:
            return settings
        least = math.ceil(cls.rollout_samples / (settings.worlds * len(task.agents)))
        return replace(settings, rollout=max(settings.rollout, least))

    def __init__(self, environment: Environment, settings: Any, arrays: Arrays | None = None) -> None:
        """Store the environment, whose first episodes will be aged, and the library of the learner's arrays."""
        self.environment, self.settings = environment, settings
        self.tally = EpisodeTally(environment, arrays=arrays)
        self.steps = 0

    @property
    def remaining(self) -> float:
        """Remaining fraction of the training, in [0, 1]."""
        return max(0.0, 1.0 - self.steps / self.settings.steps)

    def learned(self) -> dict[str, Any]:
        """Return the learner-specific state, such as parameters and optimisers."""
        raise NotImplementedError

    def load_learned(self, state: dict[str, Any]) -> None:
        """Restore the state that `learned` returned."""
        raise NotImplementedError

    def state(self) -> dict[str, Any]:
        """Return the complete state of the training, as copies."""
        return {
            "steps": self.steps,
            "environment": self.environment.state(),
            "tally": self.tally.state(),
            "random": random_state(),
            "learner": deepcopy(self.learned()),
        }

    def load(self, state: dict[str, Any]) -> None:
        """Continue from the state of a learner that was created in the same way."""
        self.steps = int(state["steps"])
        self.environment.load_state(state["environment"])
        self.tally.load(state["tally"])
        self.load_learned(state["learner"])
        set_random_state(state["random"])
