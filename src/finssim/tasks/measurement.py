"""What the controller is told of the state: the truth, or the truth with localization noise."""

import math
from dataclasses import dataclass

import warp as wp

from finssim.engine.state import State
from finssim.tasks.arrays import TaskArrays


@dataclass(frozen=True, kw_only=True)
class MeasurementNoise:
    """White noise on the pose a controller sees, drawn anew every control step."""

    position_std: float = 0.0
    """Per axis [m]."""
    yaw_std: float = 0.0
    """[rad]"""
    velocity_std: float = 0.0
    """Per axis of the linear velocity [m/s]."""
    rate_std: float = 0.0
    """Per axis of the angular velocity [rad/s]."""

    def __post_init__(self) -> None:
        values = (self.position_std, self.yaw_std, self.velocity_std, self.rate_std)
        if not all(math.isfinite(x) and x >= 0.0 for x in values):
            raise ValueError(f"measurement noise {values}: expected finite standard deviations of 0 or more")

    @property
    def present(self) -> bool:
        """Whether anything is added at all."""
        return any((self.position_std, self.yaw_std, self.velocity_std, self.rate_std))


@wp.kernel(enable_backward=False)
def measure(
    state: State,
    arrays: TaskArrays,
    position_std: float,
    yaw_std: float,
    velocity_std: float,
    rate_std: float,
    seed: int,
    world_offset: int,
):
    """Copy the state of vehicle 0 with noise; the draw depends on seed, world, episode and step alone."""
    w = world_offset + wp.tid()
    stream = wp.rand_init(seed + 104729 * state.episode[w] + 1, w)
    rng = wp.rand_init(wp.randi(stream), state.steps[w])
    n = wp.vec3(wp.randn(rng), wp.randn(rng), wp.randn(rng))
    arrays.position[w, 0] = state.position[w, 0] + position_std * n
    turn = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), yaw_std * wp.randn(rng))
    arrays.quaternion[w, 0] = turn * state.quaternion[w, 0]
    nu = state.velocity[w, 0]
    for i in range(3):
        nu[i] = nu[i] + velocity_std * wp.randn(rng)
    for i in range(3):
        nu[i + 3] = nu[i + 3] + rate_std * wp.randn(rng)
    arrays.velocity[w, 0] = nu
