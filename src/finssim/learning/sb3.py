"""The batched environment as a Stable-Baselines3 `VecEnv`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from finssim.learning.adapter import adapter_environment, age_episodes, copied
from finssim.learning.gymnasium_env import action_space, observation_space
from finssim.tasks import Environment, Task


class Sb3VecEnv(VecEnv):
    """One SB3 environment per agent, stepped together: agents of a world are consecutive rows, which end together.

    Where an episode ends, `info` has `terminal_observation`, `TimeLimit.truncated` (SB3 then adds the value of the
    terminal observation to the reward) and `episode` (mean return of a world's agents, length, and the task's metrics,
    such as `held`: uninterrupted time within the success tolerance at the end [s]).
    """

    def __init__(self, task: str | Task | Environment = "t1", stagger: bool = False, **options: Any) -> None:
        """Set up the worlds.

        Args:
            task: A task or its name; or an environment.
            stagger: True to start the first episodes at random ages, so that some end in every step: training on all
                stages of an episode at once is more stable. A shortened episode has no `episode` in its info.
            options: Other arguments of `finssim.make`: worlds, vehicle, hydrodynamics, randomize, seed, ...
        """
        self.environment = environment = adapter_environment(task, options, pictures=True)
        rows = environment.worlds * environment.agents
        super().__init__(rows, observation_space(environment), action_space(environment))
        self._actions: NDArray[np.float32] | None = None
        self._stagger = stagger
        self._whole = np.ones(environment.worlds, dtype=np.bool_)

    def reset(self) -> Any:
        """Start new episodes in all worlds, with the seed given to `seed`, if any.

        Returns:
            Observations, (rows, size); for a task with pictures, a dictionary of `state` and uint8 pictures.
        """
        first = self._seeds[0]
        observation = copied(self._rows(self.environment.reset(seed=first)))
        self._whole[:] = not self._stagger
        if self._stagger:
            age_episodes(self.environment)
        self._reset_seeds()
        self._reset_options()
        self.reset_infos = [{} for _ in range(self.num_envs)]
        return observation

    def step_async(self, actions: NDArray[np.float32]) -> None:
        """Store the actions for `step_wait`, (rows, size)."""
        self._actions = actions

    def step_wait(
        self,
    ) -> tuple[Any, NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Return observations, rewards, ends and infos; new arrays, which SB3 may store and modify."""
        assert self._actions is not None, "step_wait without step_async"
        agents = self.environment.agents
        joint = (
            self._actions if agents == 1 else self._actions.reshape(-1, agents, self.environment.action_size)
        )
        step = self.environment.step(joint)
        done = step.terminated | step.truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        ended = np.flatnonzero(done)
        if len(ended):
            last, episodes = self._rows(step.final_observation), self._episodes(ended)
            for w in ended:
                for row in range(w * agents, (w + 1) * agents):
                    infos[row] = {
                        "terminal_observation": copied(last, row),
                        "TimeLimit.truncated": bool(step.truncated[w] and not step.terminated[w]),
                    }
                    if w in episodes:
                        infos[row]["episode"] = episodes[w]
            self._whole[ended] = True
        return (
            copied(self._rows(step.observation)),
            step.reward.reshape(-1).copy(),
            np.repeat(done, agents),
            infos,
        )

    def _rows(self, observation: Any) -> Any:
        """Return (worlds, size) or (worlds, agents, size) as rows, a view. Tasks with pictures have one agent."""
        return observation if isinstance(observation, dict) else observation.reshape(self.num_envs, -1)

    def _episodes(self, ended: NDArray[np.intp]) -> dict[int, dict[str, float]]:
        """Return world -> SB3's summary of a finished episode, for episodes that were not shortened."""
        short = {"return": "r", "length": "l"}
        metrics = self.environment.task.metrics(self.environment.arrays)
        columns = {short.get(key, key): value for key, value in metrics.items()}
        return {
            int(w): {
                key: int(column[w]) if key == "l" else float(column[w]) for key, column in columns.items()
            }
            for w in ended
            if self._whole[w]
        }

    def close(self) -> None:
        """Do nothing: the arrays are released with the environment."""

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of the environment, once per requested row."""
        return [getattr(self.environment, attr_name, None)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Refuse the call: worlds share their settings."""
        raise ValueError(f"cannot set '{attr_name}' of single worlds: make a new Environment")

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Refuse the call: worlds are not objects with methods."""
        raise ValueError(f"worlds have no method '{method_name}': call the environment's own")

    def env_is_wrapped(self, wrapper_class: Any, indices: VecEnvIndices = None) -> list[bool]:
        """Return False for every row."""
        return [False] * len(list(self._get_indices(indices)))

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """Return None for every row: there are no images."""
        return [None] * self.num_envs
