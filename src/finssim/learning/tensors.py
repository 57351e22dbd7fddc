"""An environment's arrays as torch tensors in the same memory, on the environment's device."""

from __future__ import annotations

import torch
import warp as wp

from finssim.tasks import Environment, EnvironmentSetupError


class Tensors:
    """Views that the environment overwrites in every step; copy them to keep their values.

    Attributes:
        observation: (worlds, agents, size); the first of the new episode where one ended.
        final_observation: The same shape; the last of the old episode, where one ended in this step.
        reward: (worlds, agents).
    """

    def __init__(self, environment: Environment) -> None:
        """Create views of an environment's arrays."""
        self.environment = environment
        self.device = torch.device(wp.device_to_torch(environment.device))
        a, rows = environment.arrays, (environment.worlds, environment.agents, -1)
        self._action = wp.to_torch(a.action)
        self.observation = wp.to_torch(a.observation).view(rows)
        self.final_observation = wp.to_torch(a.final_observation).view(rows)
        self.reward = wp.to_torch(a.agent_reward)
        self._terminated, self._truncated = wp.to_torch(a.terminated), wp.to_torch(a.truncated)

    def step(self, action: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Simulate one control step.

        Args:
            action: (worlds, agents, size), or any shape with as many numbers in that order, each clipped to [-1, 1].

        Returns:
            Flags terminated and truncated [bool], (worlds,); new tensors.

        Raises:
            EnvironmentSetupError: The shape is wrong or a number is not finite.
        """
        flat = action.reshape(-1)
        if flat.numel() != self._action.numel():
            e = self.environment
            raise EnvironmentSetupError(
                f"action has shape {tuple(action.shape)}, expected {e.worlds * e.agents} rows of {e.action_size}"
            )
        # A sum is finite if every summand is, and takes a tenth of the time of checking each one.
        if not torch.isfinite(flat.sum()):
            raise EnvironmentSetupError("action has a number that is not finite: the network has diverged")
        self._action.view(-1).copy_(flat)
        self.environment.advance()
        return self._terminated != 0, self._truncated != 0
