"""The environment for Gymnasium: one world as an `Env`, a batch as a `VectorEnv`.

Importing this module registers every task of one agent under the name of its class:
`gymnasium.make("finssim/StationKeeping-v0")`, and likewise for `make_vec`. Gymnasium imports the module itself if the
name contains it: `gymnasium.make("finssim.learning.gymnasium_env:finssim/StationKeeping-v0")`.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from finssim.learning.adapter import adapter_environment, copied, single_agent
from finssim.sim.site import described_world
from finssim.tasks import TASKS, Environment, EnvironmentSetupError, Task

# Gymnasium's spaces of an environment's observations and actions.


def observation_space(environment: Environment) -> spaces.Box | spaces.Dict:
    """Return the bounds of one world's observation: each part's clip, or none; with pictures, `state` and the
    pictures."""
    parts = environment.task.observation
    high = np.concatenate([np.full(part.size, np.inf if part.clip is None else part.clip) for part in parts])
    state = spaces.Box(-high.astype(np.float32), high.astype(np.float32), dtype=np.float32)
    if environment.sight is None:
        return state
    shapes = {name: picture["shape"] for name, picture in environment.sight.describe().items()}
    pictures = {name: spaces.Box(0, 255, tuple(shape), np.uint8) for name, shape in shapes.items()}
    return spaces.Dict({"state": state, **pictures})


def action_space(environment: Environment) -> spaces.Box:
    """Return the space of one world's action: each component in [-1, 1]."""
    return spaces.Box(-1.0, 1.0, shape=(environment.action_size,), dtype=np.float32)


Observation = Any
"""float32 (size,); for a task with pictures, a dictionary of these numbers and uint8 pictures."""


class Env(gymnasium.Env[Any, Any]):
    """One world. After its end, an episode can be stepped further until `reset`.

    A world in which a number stopped being finite reports its episode as terminated, with the last finite observation
    and reward 0. On a CPU a new episode has begun there when `step` returns, and the remaining `info` refers to it; on
    a GPU this may take up to 100 steps, each reported as terminated.

    `info` contains, in SI units, `position_error` (distance to the task's goal [m]), `held` (uninterrupted time within
    the success tolerance [s]) and, at the end, `episode` with return `r`, length `l` and the task's other metrics.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(self, task: str | Task | Environment = "t1", **options: Any) -> None:
        """Set up one world.

        Args:
            task: A task or its name; or an environment of one world created with auto_reset=False.
            options: Other arguments of `finssim.make`: vehicle, hydrodynamics, action, randomize, seed, ...

        Raises:
            EnvironmentSetupError: As for `finssim.make`; or there are several agents or several worlds.
        """
        self.render_mode = options.pop("render_mode", None)
        self.environment = single_agent(
            adapter_environment(task, options, auto_reset=False, pictures=True), "Gymnasium"
        )
        if self.environment.worlds != 1:
            raise EnvironmentSetupError(
                f"worlds is {self.environment.worlds}, expected 1: several are a VectorEnv"
            )
        self.observation_space = observation_space(self.environment)
        self.action_space = action_space(self.environment)
        self.metadata = {**self.metadata, "render_fps": round(1.0 / self.environment.task.control_step)}
        self._chase_camera: Any = None

    def render(self) -> NDArray[np.uint8] | None:
        """Return a rendered view from behind the vehicle, uint8 (360, 640, 3), with `render_mode="rgb_array"`;
        otherwise None."""
        if self.render_mode != "rgb_array":
            return None
        self._chase_camera = self._chase_camera or described_world("pool").chase_camera(self.environment)
        return self._chase_camera.picture()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; a seed restarts the random streams."""
        super().reset(seed=seed)
        return copied(self.environment.reset(seed=seed), 0), self._info()

    def step(self, action: Observation) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Simulate one control step; action (size,), each in [-1, 1]."""
        step = self.environment.step(np.asarray(action, dtype=np.float32)[None])
        terminated, truncated = bool(step.terminated[0]), bool(step.truncated[0])
        info = self._info()
        if terminated or truncated:
            a = self.environment.arrays
            metrics = {key: float(value[0]) for key, value in self.environment.task.metrics(a).items()}
            info["episode"] = {"r": metrics.pop("return"), "l": int(metrics.pop("length")), **metrics}
            return copied(step.final_observation, 0), float(step.reward[0]), terminated, truncated, info
        return copied(step.observation, 0), float(step.reward[0]), terminated, truncated, info

    def _info(self) -> dict[str, Any]:
        a, state = self.environment.arrays, self.environment.simulator.state
        error = a.goal_position.numpy()[0] - state.position.numpy()[0, 0]
        return {"position_error": float(np.linalg.norm(error)), "held": float(a.held.numpy()[0])}


class VectorEnv(gymnasium.vector.VectorEnv[Observation, Observation, NDArray[Any]]):
    """A batch of worlds, with Gymnasium's two modes of automatic reset.

    `AutoresetMode.SAME_STEP`, the default: the step that ends an episode begins the next one. `info` then has
    `final_obs` (an array of observations, None elsewhere) and `final_info` (`episode_return`, `episode_length` and the
    task's other metrics, such as `held`: time within the success tolerance at the end [s]), with their masks.

    `AutoresetMode.NEXT_STEP`, which Gymnasium's own wrappers expect: the step that ends an episode returns its last
    observation, and these metrics in `info` itself; the next step begins an episode there, with any action and reward
    0.
    """

    def __init__(
        self,
        num_envs: int | None = None,
        task: str | Task | Environment = "t1",
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        **options: Any,
    ) -> None:
        """Set up the worlds.

        Args:
            num_envs: Number of worlds, Gymnasium's name for `worlds`; 1 if neither is given.
            task: A task or its name; or an environment, created with auto_reset=False for NEXT_STEP.
            autoreset_mode: Mode of automatic reset: SAME_STEP or NEXT_STEP, or Gymnasium's text for it.
            options: Other arguments of `finssim.make`: vehicle, hydrodynamics, action, randomize, seed, ...

        Raises:
            EnvironmentSetupError: As for `finssim.make`; or there are several agents, or the mode is unknown.
        """
        self.render_mode = options.pop("render_mode", None)
        modes = (AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP)
        if autoreset_mode not in (*modes, *(mode.value for mode in modes)):
            raise EnvironmentSetupError(
                f"autoreset_mode is {autoreset_mode}, expected {' or '.join(mode.value for mode in modes)}"
            )
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {"render_modes": [], "autoreset_mode": self.autoreset_mode}
        self._same_step = self.autoreset_mode is AutoresetMode.SAME_STEP
        if num_envs is not None:
            options["worlds"] = num_envs
        environment = adapter_environment(task, options, auto_reset=self._same_step, pictures=True)
        self.environment = single_agent(environment, "Gymnasium")
        self.num_envs = self.environment.worlds
        self._ended = np.zeros(self.num_envs, bool)
        self.single_observation_space = observation_space(self.environment)
        self.single_action_space = action_space(self.environment)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode in every world, or in those of `options["reset_mask"]`; one seed applies to the batch."""
        super().reset(seed=seed)
        mask = (options or {}).get("reset_mask")
        self._ended &= False if mask is None else ~np.asarray(mask, bool)
        return copied(self.environment.reset(mask=mask, seed=seed)), {}

    def step(
        self, actions: Observation
    ) -> tuple[Observation, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Simulate one control step; actions (worlds, size), each in [-1, 1]."""
        before, step = self._ended, self.environment.step(actions)
        observation, reward = copied(step.observation), step.reward.copy()
        terminated, truncated = step.terminated & ~before, step.truncated & ~before
        ended = terminated | truncated
        if self._same_step:
            info = self._final(step.final_observation, ended) if ended.any() else {}
            return observation, reward, terminated, truncated, info
        _replace(observation, step.final_observation, ended)
        info = self._metrics(ended) if ended.any() else {}
        if before.any():
            _replace(observation, self.environment.reset(mask=before), before)
            reward[before] = 0.0
        self._ended = ended
        return observation, reward, terminated, truncated, info

    def _metrics(self, ended: NDArray[np.bool_]) -> dict[str, Any]:
        """Return the metrics of the finished episodes, with masks."""
        totals: dict[str, Any] = {}
        for key, value in self.environment.task.metrics(self.environment.arrays).items():
            name = f"episode_{key}" if key in ("return", "length") else key
            totals |= {name: np.where(ended, value, 0), f"_{name}": ended.copy()}
        return totals

    def _final(self, observation: Observation, ended: NDArray[np.bool_]) -> dict[str, Any]:
        final = np.full(self.num_envs, None, dtype=object)
        for w in np.flatnonzero(ended):
            final[w] = copied(observation, w)
        return {
            "final_obs": final,
            "_final_obs": ended.copy(),
            "final_info": self._metrics(ended),
            "_final_info": ended.copy(),
        }


def _replace(observation: Observation, other: Observation, rows: NDArray[np.bool_]) -> None:
    """Replace rows of observations by those of others."""
    if not isinstance(observation, dict):
        observation, other = {"": observation}, {"": other}
    for name, array in observation.items():
        array[rows] = other[name][rows]


for _name, _kind in TASKS.usable().items():
    if isinstance(_kind, type) and len(_kind.agents) == 1:
        gymnasium.register(
            id=f"finssim/{_kind.__name__}-v0",
            entry_point="finssim.learning.gymnasium_env:Env",
            vector_entry_point="finssim.learning.gymnasium_env:VectorEnv",
            kwargs={"task": _name},
        )
