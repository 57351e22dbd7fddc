"""A task of your own in plain torch: keep a depth that is drawn in every episode."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from finssim.tasks import Environment, ObservationPart, Start, TorchTask, Worlds, check_task


@dataclass(frozen=True, kw_only=True)
class KeepDepth(TorchTask):
    """Reach a depth and hold it within 5 cm."""

    name: str = "keep-depth"
    observation: tuple[ObservationPart, ...] = (
        ObservationPart("way to the depth, upwards", 1, "m"),
        ObservationPart("heave", 1, "m/s", clip=2.0),
    )
    hold: float = 5.0
    deepest: float = 0.8

    def reset(self, w: Worlds) -> Start:
        """Draw the depth to keep, and the depth at the start."""
        low, high = (0.0, 0.0, -self.deepest), (0.0, 0.0, -0.3)
        return Start(position=w.uniform(low, high), goal_position=w.uniform(low, high))

    def observe(self, w: Worlds) -> Sequence[Tensor]:
        """Return a tensor for each part, in its unit; `w.position` is the measured position here."""
        return self.way(w), w.velocity[:, 2]

    def reward(self, w: Worlds) -> Tensor:
        """Return a reward with a slope near the depth and one far from it, less the effort; `w.position` is
        the truth here."""
        error = self.way(w).abs()
        return torch.exp(-error / 0.1) - error - 0.05 * w.action.square().mean(dim=1)

    def inside(self, w: Worlds) -> Tensor:
        """Return True within the tolerance; success is to stay there for `hold` seconds."""
        return self.way(w).abs() < 0.05

    def terminated(self, w: Worlds) -> Tensor:
        """Return True if the vehicle is out of the water, which is a failure."""
        return w.position[:, 2] > 0.3

    def way(self, w: Worlds) -> Tensor:
        """Return the distance up to the depth [m], (worlds,)."""
        return w.goal_position[:, 2] - w.position[:, 2]


if __name__ == "__main__":
    check_task(KeepDepth())
    environment = Environment(KeepDepth(), "finsrov", worlds=64, seed=1)
    action, observation = torch.zeros(64, environment.action_size), torch.from_numpy(environment.reset())
    for _ in range(200):
        action[:, 2] = 5.0 * observation[:, 0] - 2.0 * observation[:, 1]  # heave
        observation = torch.from_numpy(environment.step(action).observation)
    measured = environment.task.metrics(environment.arrays)
    print(f"held the depth within 5 cm in {measured['success'].mean():.0%} of the episodes")
