"""The batched environment as an RSL-RL `VecEnv`: torch tensors on the environment's device, one row per agent."""

from __future__ import annotations

from typing import Any

import torch
import warp as wp
from rsl_rl.env import VecEnv
from tensordict import TensorDict

from finssim.learning.adapter import adapter_environment
from finssim.learning.tensors import Tensors
from finssim.tasks import Environment, Task


class RslRlVecEnv(VecEnv):
    """RSL-RL environment with the observation groups "policy", the agent's observation, and "critic", which with
    privileged=True also contains the randomised parameters.

    Several agents of a world are consecutive rows, which end together: RSL-RL trains one network for all of them.

    Where an episode ends, the observation is the first of the next one, `extras["time_outs"]` marks ends by the time
    limit (RSL-RL then adds the discounted value of the previous state to the reward), `extras["final_observations"]`
    has the last observations, and `extras["log"]` the mean of the task's metrics over the finished episodes.
    """

    def __init__(self, task: str | Task | Environment = "t1", **options: Any) -> None:
        """Set up the worlds.

        Args:
            task: A task or its name; or an environment.
            options: Other arguments of `finssim.make`: worlds, vehicle, hydrodynamics, randomize, seed, device, ...
        """
        self.environment = environment = adapter_environment(task, options)
        self._tensors = Tensors(environment)
        self._steps = wp.to_torch(environment.simulator.state.steps)
        a, privileged = environment.arrays, bool(environment.privileged_names)
        self._drawn = (wp.to_torch(a.privileged), wp.to_torch(a.final_privileged)) if privileged else None
        self.device = str(self._tensors.device)
        self.num_envs = environment.worlds * environment.agents
        self.num_actions = environment.action_size
        self.max_episode_length = round(environment.task.time_limit / environment.task.control_step)
        self.cfg = {
            "task": environment.task.name,
            "action": environment.action_mode,
            "worlds": environment.worlds,
            "seed": environment.seed,
        }

    @property
    def episode_length_buf(self) -> torch.Tensor:
        """Number of control steps since the episode began, (num_envs,); assigning to it changes the age of episodes.

        All agents of a world have the same age.
        """
        return self._by_row(self._steps.long())

    @episode_length_buf.setter
    def episode_length_buf(self, steps: torch.Tensor) -> None:
        self._steps.copy_(steps.view(-1, self.environment.agents)[:, 0])

    def get_observations(self) -> TensorDict:
        """Return the current observations."""
        return self._groups(self._tensors.observation)

    def reset(self, seed: int | None = None) -> TensorDict:
        """Start new episodes in all worlds; a seed restarts the random streams."""
        self.environment.reset(seed=seed)
        return self.get_observations()

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Simulate one control step; actions (num_envs, num_actions), each in [-1, 1].

        Returns:
            Observations, rewards, dones and extras; new tensors, (num_envs, ...).
        """
        terminated, truncated = self._tensors.step(actions)
        done = terminated | truncated
        extras: dict[str, Any] = {"time_outs": self._by_row(truncated & ~terminated)}
        if done.any():
            extras["final_observations"] = self._groups(self._tensors.final_observation, final=True)
            extras["log"] = self._metrics(done)
        reward = self._tensors.reward.flatten().clone()
        return self.get_observations(), reward, self._by_row(done), extras

    def _by_row(self, of_world: torch.Tensor) -> torch.Tensor:
        return (
            of_world if self.environment.agents == 1 else of_world.repeat_interleave(self.environment.agents)
        )

    def _groups(self, observation: torch.Tensor, final: bool = False) -> TensorDict:
        policy = observation.reshape(self.num_envs, -1).clone()
        critic = policy
        if self._drawn is not None:
            critic = torch.cat([policy, self._drawn[final].reshape(self.num_envs, -1)], dim=1)
        return TensorDict(
            {"policy": policy, "critic": critic}, batch_size=[self.num_envs], device=self.device
        )

    def _metrics(self, done: torch.Tensor) -> dict[str, float]:
        ended = done.cpu().numpy()
        measured = self.environment.task.metrics(self.environment.arrays)
        return {f"Episode/{name}": float(values[ended].mean()) for name, values in measured.items()}
