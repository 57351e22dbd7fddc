"""The batched environment in skrl's two forms, on the environment's device, and the bootstrapping it leaves out."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from skrl.envs.wrappers.torch import MultiAgentEnvWrapper, Wrapper

from finssim.learning.gymnasium_env import action_space, observation_space
from finssim.learning.served import age_episodes, served
from finssim.learning.tensors import Tensors
from finssim.tasks import Environment, Task


class _Worlds:
    """Common part of both forms."""

    def __init__(self, task: str | Task | Environment, stagger: bool, options: dict[str, Any]) -> None:
        self.environment = served(task, options)
        self.tensors, self._stagger = Tensors(self.environment), stagger

    def reset(self) -> torch.Tensor:
        """Start new episodes everywhere; first observations, (worlds, agents, size)."""
        self.environment.reset()
        if self._stagger:
            age_episodes(self.environment)
        return self.tensors.observation.clone()

    def step(self, action: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Observations and last observations (worlds, agents, size), rewards (worlds, agents), ends (worlds,)."""
        t = self.tensors
        terminated, truncated = t.step(action)
        done = terminated | truncated
        last = torch.where(done[:, None, None], t.final_observation, t.observation)
        return t.observation.clone(), last, t.reward.clone(), terminated, truncated

    def episode(self, done: torch.Tensor) -> dict[str, Any]:
        """Mean of the task's metrics over the episodes that ended, as skrl's trainers log it; empty if none did."""
        if not done.any():
            return {}
        ended = done.cpu().numpy()
        measured = self.environment.task.metrics(self.environment.arrays)
        return {"episode": {key: torch.tensor(float(value[ended].mean())) for key, value in measured.items()}}


class SkrlEnv(Wrapper):
    """For skrl's single agents: one row per world, or per agent of a world, so that one network serves them all.

    Where an episode ends, the observation is the next one's first; `infos["final_observations"]` has, in every row, the
    observation that the step led to. `bootstrapping` makes skrl use it.
    """

    def __init__(
        self, task: str | Task | Environment = "t1", *, stagger: bool = False, **options: Any
    ) -> None:
        """Set up the worlds.

        Args:
            task: A task or its name; or an environment.
            stagger: Let episodes be of random age after each reset.
            options: The other arguments of `finssim.make`: worlds, vehicle, hydrodynamics, randomize, seed, device, ...
        """
        self._worlds = _Worlds(task, stagger, options)
        self.environment = self._worlds.environment
        super().__init__(self.environment)
        self._device = self._worlds.tensors.device
        self._spaces = observation_space(self.environment), action_space(self.environment)

    @property
    def num_envs(self) -> int:
        """Rows: worlds times agents."""
        return self.environment.worlds * self.environment.agents

    @property
    def num_agents(self) -> int:
        """One: rows are environments to skrl."""
        return 1

    @property
    def state_space(self) -> None:
        """There is no state beside the observation."""
        return None

    @property
    def observation_space(self) -> gymnasium.Space[Any]:
        """Bounds of a row."""
        return self._spaces[0]

    @property
    def action_space(self) -> gymnasium.Space[Any]:
        """Each component in [-1, 1]."""
        return self._spaces[1]

    def reset(self) -> tuple[torch.Tensor, dict[str, Any]]:
        """Start new episodes everywhere; observations (rows, size)."""
        return self._worlds.reset().flatten(0, 1), {}

    def step(
        self, actions: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Act for one control step; actions (rows, size). Rewards and ends are (rows, 1)."""
        observation, last, reward, terminated, truncated = self._worlds.step(actions)
        ends = [end.repeat_interleave(self.environment.agents)[:, None] for end in (terminated, truncated)]
        infos = {"final_observations": last.flatten(0, 1), **self._worlds.episode(terminated | truncated)}
        return observation.flatten(0, 1), reward.flatten()[:, None], *ends, infos

    def state(self) -> None:
        """None."""
        return None

    def render(self, *args: Any, **kwargs: Any) -> None:
        """Nothing to see."""

    def close(self) -> None:
        """Nothing to release."""


class SkrlTeamEnv(MultiAgentEnvWrapper):
    """For skrl's multi-agents (IPPO, MAPPO): dictionaries by agent of rows by world.

    The state, for critics that see everything, is the observations of all agents, one after the other.
    `infos["final_observations"]` and `infos["final_states"]` are what the step led to, for `bootstrapping`.
    """

    def __init__(self, task: str | Task | Environment, *, stagger: bool = False, **options: Any) -> None:
        """Set up the worlds; arguments as those of `SkrlEnv`."""
        self._worlds = _Worlds(task, stagger, options)
        self.environment = self._worlds.environment
        super().__init__(self.environment)
        self._device = self._worlds.tensors.device
        names, local_space = self.environment.task.agents, observation_space(self.environment)
        joint_space = spaces.Box(
            np.tile(local_space.low, len(names)), np.tile(local_space.high, len(names)), dtype=np.float32
        )
        self._observation_spaces = dict.fromkeys(names, local_space)
        self._action_spaces = dict.fromkeys(names, action_space(self.environment))
        self._state_spaces = dict.fromkeys(names, joint_space)

    @property
    def num_envs(self) -> int:
        """Worlds."""
        return self.environment.worlds

    @property
    def agents(self) -> list[str]:
        """Names of the agents, who all are always there."""
        return self.possible_agents

    @property
    def possible_agents(self) -> list[str]:
        """Names of the agents."""
        return list(self.environment.task.agents)

    @property
    def observation_spaces(self) -> dict[str, gymnasium.Space[Any]]:
        """Bounds of the observations."""
        return self._observation_spaces

    @property
    def action_spaces(self) -> dict[str, gymnasium.Space[Any]]:
        """Each component in [-1, 1]."""
        return self._action_spaces

    @property
    def state_spaces(self) -> dict[str, gymnasium.Space[Any]]:
        """Bounds of the state."""
        return self._state_spaces

    def reset(self) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
        """Start new episodes everywhere; observations (worlds, size)."""
        return self._by_agent(self._worlds.reset()), {}

    def step(
        self, actions: dict[str, torch.Tensor]
    ) -> tuple[
        dict[str, torch.Tensor], dict[str, torch.Tensor], dict[str, Any], dict[str, Any], dict[str, Any]
    ]:
        """Act for one control step; actions (worlds, size) by agent. Rewards and ends are (worlds, 1)."""
        joint = torch.stack([actions[name] for name in self.possible_agents], dim=1)
        observation, last, reward, terminated, truncated = self._worlds.step(joint)
        infos = {
            "final_observations": self._by_agent(last),
            "final_states": dict.fromkeys(self.possible_agents, last.flatten(1)),
            **self._worlds.episode(terminated | truncated),
        }
        ends = [dict.fromkeys(self.possible_agents, end[:, None]) for end in (terminated, truncated)]
        return self._by_agent(observation), self._by_agent(reward[:, :, None]), *ends, infos

    def state(self) -> dict[str, torch.Tensor]:
        """Return the observations of all agents, (worlds, agents * size), the same for each."""
        return dict.fromkeys(self.possible_agents, self._worlds.tensors.observation.flatten(1).clone())

    def _by_agent(self, rows: torch.Tensor) -> dict[str, torch.Tensor]:
        return {name: rows[:, k] for k, name in enumerate(self.possible_agents)}

    def render(self, *args: Any, **kwargs: Any) -> None:
        """Nothing to see."""

    def close(self) -> None:
        """Nothing to release."""


def bootstrapping(kind: type) -> Any:
    """A class of skrl's agents that ends transitions with the last observation of an episode.

    skrl takes the observation that comes next, which where an episode ended is the first of another one: a wrong value
    at every time limit. PPO needs `time_limit_bootstrap=True` besides.

    Args:
        kind: An agent class, such as `skrl.agents.torch.ppo.PPO`, of single or of several agents.
    """

    class Bootstrapping(kind):  # type: ignore[misc]
        def record_transition(
            self, *, next_observations: Any, next_states: Any, infos: dict[str, Any], **rest: Any
        ) -> None:
            super().record_transition(
                next_observations=infos.get("final_observations", next_observations),
                next_states=infos.get("final_states", next_states),
                infos=infos,
                **rest,
            )

    Bootstrapping.__name__ = Bootstrapping.__qualname__ = kind.__name__
    return Bootstrapping
