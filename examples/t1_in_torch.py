"""Station keeping (T1) in plain torch, with the same results as `finssim.tasks.StationKeeping`, which is in
Warp."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

import finssim
from finssim.agents import baseline
from finssim.tasks import ObservationPart, Start, TorchTask, Worlds, station_keeping
from finssim.tasks import torch_rotations as rot


@dataclass(frozen=True, kw_only=True)
class TorchStationKeeping(TorchTask):
    """Reach a pose in the pool and hold it: 0.10 m per axis and 10° in yaw, for 10 s."""

    name: str = "t1-torch"
    observation: tuple[ObservationPart, ...] = field(default=station_keeping.OBSERVATION, repr=False)
    hold: float = 10.0
    goal_low: tuple[float, float, float] = (-1.2, -0.5, -0.82)
    goal_high: tuple[float, float, float] = (1.2, 0.5, -0.28)
    spawn_low: tuple[float, float, float] = (-1.4, -0.6, -0.80)
    spawn_high: tuple[float, float, float] = (1.4, 0.6, -0.20)
    tilt: float = math.radians(20.0)
    speed: float = 0.30
    rate: float = 0.35
    bounds: tuple[float, float] = (2.5, 1.5)
    ceiling: float = 0.3
    depth: float = 1.5
    tolerance: float = 0.10
    yaw_tolerance: float = math.radians(10.0)
    weights: station_keeping.Reward = field(default_factory=station_keeping.Reward)

    def reset(self, w: Worlds) -> Start:
        """Draw goal and start from boxes; the goal is level."""
        a = w.uniform((-self.tilt, -self.tilt, -math.pi), (self.tilt, self.tilt, math.pi))
        most = (*[self.speed] * 3, *[self.rate] * 3)
        return Start(
            position=w.uniform(self.spawn_low, self.spawn_high),
            quaternion=rot.multiply(
                rot.about_axis(2, a[:, 2]),
                rot.multiply(rot.about_axis(1, a[:, 1]), rot.about_axis(0, a[:, 0])),
            ),
            velocity=w.uniform([-x for x in most], most),
            goal_position=w.uniform(self.goal_low, self.goal_high),
            goal_quaternion=rot.about_axis(2, w.uniform(-math.pi, math.pi)),
        )

    def observe(self, w: Worlds) -> Sequence[Tensor]:
        """Return the 16 numbers of T1's observation."""
        offset = rot.rotate_inverse(w.quaternion, w.goal_position - w.position)
        R = rot.matrix(self.turn(w))
        return (
            offset,
            torch.cat((R[:, :, 0], R[:, :, 1]), dim=1),
            w.velocity[:, :3],
            w.velocity[:, 3:],
            torch.linalg.vector_norm(offset, dim=1),
        )

    def reward(self, w: Worlds) -> Tensor:
        """Return the reward; see `station_keeping.Reward`."""
        r = self.weights
        e = torch.linalg.vector_norm(w.goal_position - w.position, dim=1)
        theta = rot.angle(self.turn(w))
        omega = w.velocity[:, 3:].square().sum(dim=1)
        return (
            r.position * torch.exp(-e / r.position_scale)
            - r.distance * e
            + r.heading * torch.exp(-theta / r.heading_scale)
            - r.turn * theta
            - r.action * w.action.square().mean(dim=1)
            - r.change * (w.action - w.previous_action).square().mean(dim=1)
            - r.rate * omega.clamp(max=4.0)
            - r.loss * self.terminated(w)
        )

    def terminated(self, w: Worlds) -> Tensor:
        """Return True outside the pool."""
        x, y, z = w.position.unbind(1)
        return (
            (x.abs() > self.bounds[0]) | (y.abs() > self.bounds[1]) | (z > self.ceiling) | (z < -self.depth)
        )

    def inside(self, w: Worlds) -> Tensor:
        """Return True if every axis and the heading are within the tolerance."""
        off = (w.goal_position - w.position).abs().amax(dim=1)
        turn = rot.wrapped(rot.heading(w.goal_quaternion) - rot.heading(w.quaternion)).abs()
        return (off <= self.tolerance) & (turn <= self.yaw_tolerance)

    def turn(self, w: Worlds) -> Tensor:
        """Return the rotation of the goal relative to the body, (worlds, 4)."""
        return rot.multiply(rot.conjugate(w.quaternion), w.goal_quaternion)


if __name__ == "__main__":
    environment = finssim.make(TorchStationKeeping(), worlds=64, seed=1)
    pid = baseline("t1", "pid", "finsrov")  # it has the same observation
    memory, observation = pid.reset(64), environment.reset()
    for _ in range(round(environment.task.time_limit / environment.task.control_step)):
        action, memory = pid.act(memory, observation)
        observation = environment.step(action).observation
    measured = environment.task.metrics(environment.arrays)
    print(f"the PID held the pose in {measured['success'].mean():.0%} of the episodes")
