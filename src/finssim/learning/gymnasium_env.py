"""The environment in Gymnasium's two forms: one world as an `Env`, a batch as a `VectorEnv`.

Importing this module registers T1: `gymnasium.make("finssim/StationKeeping-v0")`, and `make_vec` likewise.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from finssim.learning.spaces import action_space, observation_space
from finssim.tasks import TASKS, Environment, Task

__all__ = ["Env", "VectorEnv"]

Observation = NDArray[np.float32]


def _task(task: str | Task) -> Task:
    if isinstance(task, Task):
        return task
    if task not in TASKS:
        raise ValueError(f"unknown task '{task}'; available: {', '.join(TASKS)}")
    return TASKS[task]()


class Env(gymnasium.Env[Any, Any]):
    """One world. An episode that ended is simulated further, if stepped, until `reset`.

    A world in which a number stopped being finite reports its episode as terminated, with the last finite observation
    and reward 0. On a CPU a new episode has begun there when `step` returns, and the rest of `info` is of that one; on
    a GPU it may take up to 100 steps, each reported as terminated.

    `info` holds, in SI units, `position_error` [m], `held` (time within the success tolerance without a break [s]) and,
    at the end, `episode` with its return `r` and length `l`.
    """

    metadata = {"render_modes": []}

    def __init__(self, task: str | Task = "t1", **options: Any) -> None:
        """Set up one world.

        Args:
            task: A task, or its name.
            options: Of `finssim.tasks.Environment`: vehicle, hydrodynamics, action, randomization, noise, ...
        """
        self.render_mode = options.pop("render_mode", None)
        self.environment = Environment(_task(task), worlds=1, auto_reset=False, **options)
        self.observation_space = observation_space(self.environment)
        self.action_space = action_space(self.environment)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; with a seed the random streams start over."""
        super().reset(seed=seed)
        return self.environment.reset(seed=seed)[0].copy(), self._info()

    def step(self, action: Observation) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Act for one control step; action (size,), each in [-1, 1]."""
        step = self.environment.step(np.asarray(action, dtype=np.float32)[None])
        terminated, truncated = bool(step.terminated[0]), bool(step.truncated[0])
        info = self._info()
        if terminated or truncated:
            a = self.environment.arrays
            info["episode"] = {"r": float(a.final_return.numpy()[0]), "l": int(a.final_length.numpy()[0])}
            return step.final_observation[0].copy(), float(step.reward[0]), terminated, truncated, info
        return step.observation[0].copy(), float(step.reward[0]), terminated, truncated, info

    def _info(self) -> dict[str, Any]:
        a, state = self.environment.arrays, self.environment.simulator.state
        error = a.goal_position.numpy()[0] - state.position.numpy()[0, 0]
        return {"position_error": float(np.linalg.norm(error)), "held": float(a.held.numpy()[0])}


class VectorEnv(gymnasium.vector.VectorEnv[Observation, Observation, NDArray[Any]]):
    """A batch of worlds. Where an episode ends, the next starts in the same step (`AutoresetMode.SAME_STEP`).

    `info` then has `final_obs` (an array of observations, None elsewhere) and `final_info` (`episode_return`,
    `episode_length`, and `held`: time within the success tolerance when it ended [s]), with their masks.
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(self, num_envs: int = 1, task: str | Task = "t1", **options: Any) -> None:
        """Set up the worlds.

        Args:
            num_envs: How many.
            task: A task, or its name.
            options: Of `finssim.tasks.Environment`: vehicle, hydrodynamics, action, randomization, noise, ...
        """
        self.render_mode = options.pop("render_mode", None)
        self.num_envs = num_envs
        self.environment = Environment(_task(task), worlds=num_envs, **options)
        self.single_observation_space = observation_space(self.environment)
        self.single_action_space = action_space(self.environment)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode in every world, or in those of `options["reset_mask"]`; one seed serves the batch."""
        super().reset(seed=seed)
        mask = (options or {}).get("reset_mask")
        return self.environment.reset(mask=mask, seed=seed).copy(), {}

    def step(
        self, actions: Observation
    ) -> tuple[Observation, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Act for one control step; actions (worlds, size), each in [-1, 1]."""
        step = self.environment.step(actions)
        ended = step.terminated | step.truncated
        info = self._final(step.final_observation, ended) if ended.any() else {}
        return step.observation.copy(), step.reward.copy(), step.terminated, step.truncated, info

    def _final(self, observation: Observation, ended: NDArray[np.bool_]) -> dict[str, Any]:
        final = np.full(self.num_envs, None, dtype=object)
        for w in np.flatnonzero(ended):
            final[w] = observation[w].copy()
        a = self.environment.arrays
        totals: dict[str, Any] = {}
        for name, array in (
            ("episode_return", a.final_return),
            ("episode_length", a.final_length),
            ("held", a.final_held),
        ):
            totals |= {name: np.where(ended, array.numpy(), 0), f"_{name}": ended.copy()}
        return {
            "final_obs": final,
            "_final_obs": ended.copy(),
            "final_info": totals,
            "_final_info": ended.copy(),
        }


gymnasium.register(
    id="finssim/StationKeeping-v0",
    entry_point="finssim.learning.gymnasium_env:Env",
    vector_entry_point="finssim.learning.gymnasium_env:VectorEnv",
    kwargs={"task": "t1"},
)
