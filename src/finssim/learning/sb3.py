"""The batched environment as a Stable-Baselines3 `VecEnv`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from finssim.learning.spaces import action_space, observation_space
from finssim.tasks import Environment

__all__ = ["Sb3VecEnv"]


class Sb3VecEnv(VecEnv):
    """One SB3 environment per world, stepped together.

    Where an episode ends, `info` has `terminal_observation`, `TimeLimit.truncated` (SB3 then adds the value of the
    terminal observation to the reward) and `episode` (return, length, and `held`: time within the success tolerance,
    without a break, when it ended [s]).
    """

    def __init__(self, environment: Environment, stagger: bool = False) -> None:
        """Adapt an environment that resets itself.

        Args:
            environment: The worlds.
            stagger: Let the first episodes start at random ages, so that from then on some end in every step: learning
                from all stages of an episode at once is steadier. A shortened episode has no `episode` in its info.
        """
        if not environment.auto_reset:
            raise ValueError("SB3 never resets an environment that ended: make it with auto_reset=True")
        self.environment = environment
        super().__init__(environment.worlds, observation_space(environment), action_space(environment))
        self._actions: NDArray[np.float32] | None = None
        self._stagger = stagger
        self._whole = np.ones(self.num_envs, dtype=np.bool_)

    def reset(self) -> NDArray[np.float32]:
        """Start new episodes everywhere; with the seed given to `seed`, if any.

        Returns:
            Observations, (worlds, size).
        """
        first = self._seeds[0]
        observation = self.environment.reset(seed=first).copy()
        if self._stagger:
            self._age_episodes()
        self._reset_seeds()
        self._reset_options()
        self.reset_infos = [{} for _ in range(self.num_envs)]
        return observation

    def _age_episodes(self) -> None:
        task, rng = self.environment.task, np.random.default_rng(self.environment.seed)
        limit = max(1, round(task.time_limit / task.control_step))
        self.environment.simulator.state.steps.assign(rng.integers(0, limit, self.num_envs).astype(np.int32))
        self._whole[:] = False

    def step_async(self, actions: NDArray[np.float32]) -> None:
        """Keep the actions for `step_wait`, (worlds, size)."""
        self._actions = actions

    def step_wait(
        self,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Observations, rewards, ends and infos; new arrays, which SB3 keeps and changes."""
        assert self._actions is not None, "step_wait without step_async"
        step = self.environment.step(self._actions)
        done = step.terminated | step.truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        ended = np.flatnonzero(done)
        if len(ended):
            a = self.environment.arrays
            totals = a.final_return.numpy(), a.final_length.numpy(), a.final_held.numpy()
            for w in ended:
                infos[w] = {
                    "terminal_observation": step.final_observation[w].copy(),
                    "TimeLimit.truncated": bool(step.truncated[w] and not step.terminated[w]),
                }
                if self._whole[w]:
                    names = ("r", float), ("l", int), ("held", float)
                    infos[w]["episode"] = {
                        n: kind(total[w]) for (n, kind), total in zip(names, totals, strict=True)
                    }
            self._whole[ended] = True
        return step.observation.copy(), step.reward.copy(), done, infos

    def close(self) -> None:
        """Nothing to release: the arrays go with the environment."""

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute of the environment, once per asked world."""
        return [getattr(self.environment, attr_name, None)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Refused: worlds share their settings."""
        raise ValueError(f"cannot set '{attr_name}' of single worlds: make a new Environment")

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Refused: worlds are no objects with methods."""
        raise ValueError(f"worlds have no method '{method_name}': call the environment's own")

    def env_is_wrapped(self, wrapper_class: Any, indices: VecEnvIndices = None) -> list[bool]:
        """Never."""
        return [False] * len(list(self._get_indices(indices)))

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """None: there is nothing to see."""
        return [None] * self.num_envs
