"""One world as a PettingZoo `ParallelEnv`: observations, rewards and actions in dictionaries by agent."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from finssim.learning.adapter import adapter_environment
from finssim.learning.gymnasium_env import action_space, observation_space
from finssim.tasks import Environment, EnvironmentSetupError, Task

Observation = NDArray[np.float32]


class PettingZooEnv(ParallelEnv[str, Observation, Observation]):
    """The task's agents by their names; a task of one agent is a world with one. All agents end together.

    At the end there are the last observations and, in every agent's info, `episode`: the task's metrics.
    """

    metadata = {"render_modes": [], "is_parallelizable": True}

    def __init__(self, task: str | Task | Environment = "t1", **options: Any) -> None:
        """Set up one world.

        Args:
            task: A task or its name; or an environment of one world created with auto_reset=False.
            options: Other arguments of `finssim.make`: vehicle, hydrodynamics, action, randomize, seed, ...
        """
        self.render_mode = options.pop("render_mode", None)
        self.environment = environment = adapter_environment(task, options, auto_reset=False)
        if environment.worlds != 1:
            raise EnvironmentSetupError(
                f"worlds is {environment.worlds}, expected 1: PettingZoo steps one world"
            )
        self.metadata = {**self.metadata, "name": f"finssim/{environment.task.name}"}
        self.possible_agents = list(environment.task.agents)
        self.agents: list[str] = []
        # PettingZoo requires the same object every time, because it contains the random stream of sampled actions.
        self.observation_spaces = {name: observation_space(environment) for name in self.possible_agents}
        self.action_spaces = {name: action_space(environment) for name in self.possible_agents}
        space = observation_space(environment)
        self.state_space = spaces.Box(
            np.tile(space.low, environment.agents), np.tile(space.high, environment.agents), dtype=np.float32
        )

    def observation_space(self, agent: str) -> spaces.Box:
        """Return the bounds of an agent's observation."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Box:
        """Return the space of an agent's action: each component in [-1, 1]."""
        return self.action_spaces[agent]

    def state(self) -> Observation:
        """Return the concatenated observations of all agents, for centralised critics."""
        return self.environment.arrays.observation.numpy()[0].copy()

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Observation], dict[str, dict[str, Any]]]:
        """Start an episode; a seed restarts the random streams. There are no options."""
        self.environment.reset(seed=seed)
        self.agents = list(self.possible_agents)
        return self._observations(self.environment.arrays.observation), {name: {} for name in self.agents}

    def step(
        self, actions: dict[str, Observation]
    ) -> tuple[
        dict[str, Observation],
        dict[str, float],
        dict[str, bool],
        dict[str, bool],
        dict[str, dict[str, Any]],
    ]:
        """Simulate one control step with an action for every agent, each component in [-1, 1].

        Raises:
            EnvironmentSetupError: An agent has no action, or the episode is over.
        """
        if not self.agents:
            raise EnvironmentSetupError("step without a running episode: call reset first")
        missing = [name for name in self.agents if name not in actions]
        if missing:
            raise EnvironmentSetupError(f"no action for {', '.join(missing)}: every agent acts in every step")
        rows = np.stack([np.asarray(actions[name], dtype=np.float32) for name in self.agents])
        step = self.environment.step(rows if self.environment.agents == 1 else rows[None])
        names, ended = self.agents, bool(step.terminated[0] or step.truncated[0])
        arrays = self.environment.arrays
        rewards = arrays.agent_reward.numpy()[0]
        info: dict[str, Any] = {}
        if ended:
            totals = self.environment.task.metrics(arrays)
            info, self.agents = {"episode": {key: float(value[0]) for key, value in totals.items()}}, []
        return (
            self._observations(arrays.final_observation if ended else arrays.observation),
            {name: float(reward) for name, reward in zip(names, rewards, strict=True)},
            dict.fromkeys(names, bool(step.terminated[0])),
            dict.fromkeys(names, bool(step.truncated[0])),
            {name: dict(info) for name in names},
        )

    def _observations(self, array: Any) -> dict[str, Observation]:
        rows = array.numpy()[0].reshape(self.environment.agents, -1).copy()
        return dict(zip(self.possible_agents, rows, strict=True))

    def close(self) -> None:
        """Do nothing: the arrays are released with the environment."""
