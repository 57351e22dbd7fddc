"""What the learners of Stable-Baselines3 share: the worlds under a tally, and a logger that only collects."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger

from finssim.learning.learners.acting import ActingLearner
from finssim.learning.sb3 import Sb3VecEnv
from finssim.learning.tally import EpisodeTally

__all__ = ["Sb3Learner", "TalliedWorlds"]


class TalliedWorlds(Sb3VecEnv):
    """Worlds of which some episodes end in every step, and each step is tallied."""

    def __init__(self, tally: EpisodeTally) -> None:
        """Adapt the tally's environment."""
        super().__init__(tally.environment, stagger=True)
        self.tally = tally

    def step_wait(
        self,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """As every SB3 environment; and the tally looks."""
        result = super().step_wait()
        self.tally.look()
        return result


class Sb3Learner(ActingLearner):
    """One of SB3's algorithms, an update at a time: what its `learn` does, without its loop."""

    def start(self, model: Any) -> None:
        """Take the algorithm and start its first episodes."""
        self.model = model
        model.set_logger(Logger(None, []))
        _, callback = BaseAlgorithm._setup_learn(model, self.settings.steps * self.environment.agents)
        self.callback: BaseCallback = callback

    def counted(self) -> None:
        """Bring steps and the share of the training up to date."""
        self.steps = self.model.num_timesteps // self.environment.agents
        self.model._update_current_progress_remaining(self.steps, self.settings.steps)

    def losses(self, *names: str) -> dict[str, float]:
        """What the algorithm logged of its last update; 0 before the first."""
        logged = {name: float(self.model.logger.name_to_value.get(f"train/{name}", 0.0)) for name in names}
        self.model.logger.name_to_value.clear()
        return logged

    def learned(self) -> dict[str, Any]:
        """Parameters and counters; what else an algorithm has it adds."""
        m = self.model
        return {
            "policy": m.policy.state_dict(),
            "timesteps": m.num_timesteps,
            "updates": m._n_updates,
            "observation": m._last_obs,
            "starts": m._last_episode_starts,
        }

    def load_learned(self, state: dict[str, Any]) -> None:
        """Take what `learned` gave."""
        m = self.model
        m.policy.load_state_dict(state["policy"])
        m.num_timesteps, m._n_updates = int(state["timesteps"]), int(state["updates"])
        m._last_obs, m._last_episode_starts = state["observation"], state["starts"]
        self.counted()
