"""Measurements that the controller observes: the true state, optionally with errors like those of localization."""

import math
from dataclasses import dataclass, fields

import numpy as np
import warp as wp

from finssim.physics.types import vec6
from finssim.sim.measured import MeasurementErrors
from finssim.sim.packed import Packed
from finssim.sim.state import HISTORY, State
from finssim.tasks.arrays import TaskArrays

LONGEST_DELAY = 2.0
"""Greatest age of an observation [s]; states are stored for 50 control steps."""


@dataclass(frozen=True, kw_only=True)
class MeasurementNoise:
    """Errors of the controller's observations: white noise, an offset per episode, dropouts and a delay."""

    position_std: float = 0.0
    """Standard deviation of the noise, drawn every control step, per axis [m]."""
    yaw_std: float = 0.0
    """[rad]"""
    velocity_std: float = 0.0
    """Per axis of the linear velocity [m/s]."""
    rate_std: float = 0.0
    """Per axis of the angular velocity [rad/s]."""
    position_bias: float = 0.0
    """Standard deviation of an offset that lasts an episode, per axis [m]."""
    yaw_bias: float = 0.0
    """Standard deviation of the heading's offset [rad]."""
    velocity_bias: float = 0.0
    """Standard deviation of the linear velocity's offset, per axis [m/s]."""
    rate_bias: float = 0.0
    """Standard deviation of the angular velocity's offset, per axis [rad/s]."""
    dropout: float = 0.0
    """Probability that a control step has no new sample, below 1."""
    delay: float = 0.0
    """Age of the measurement [s], rounded to the nearest control step; never older than the episode."""
    graded: bool = False
    """True if the errors increase from zero in the first world to their full size in the last."""

    def __post_init__(self) -> None:
        values = tuple(getattr(self, field.name) for field in fields(self))
        if not all(math.isfinite(x) and x >= 0.0 for x in values):
            raise ValueError(f"measurement noise {values}: expected finite numbers of 0 or more")
        if self.dropout >= 1.0:
            raise ValueError(f"dropout of the measurement is {self.dropout}, expected a probability below 1")
        if self.delay > LONGEST_DELAY:
            raise ValueError(
                f"delay of the measurement is {self.delay} s, expected at most {LONGEST_DELAY:g} s"
            )

    @property
    def present(self) -> bool:
        """Return whether there is any error."""
        return any(getattr(self, field.name) for field in fields(self))


TRAINING = MeasurementNoise(position_std=0.01, yaw_std=math.radians(1.0), velocity_std=0.02, rate_std=0.02)
"""Approximate errors of an estimate: with exact states, policies learn gains that chatter on measured ones."""
ESTIMATOR = MeasurementNoise(
    position_std=0.003,
    yaw_std=math.radians(0.15),
    velocity_std=0.015,
    rate_std=0.01,
    position_bias=0.01,
    yaw_bias=math.radians(0.2),
    delay=0.1,
)
"""Approximate errors of the robot's own localization and fusion in a virtual pool of severity realistic."""


def connect_measured(present: bool, state: State, arrays: TaskArrays) -> None:
    """Set the task's arrays of measurements; without noise they are those of the state, without a copy."""
    if not present:
        arrays.position, arrays.quaternion, arrays.velocity = state.position, state.quaternion, state.velocity
        return
    shape, device = state.position.shape, state.position.device
    arrays.position = wp.zeros(shape, dtype=wp.vec3, device=device)
    arrays.quaternion = wp.zeros(shape, dtype=wp.quat, device=device)
    arrays.velocity = wp.zeros(shape, dtype=vec6, device=device)


def measurements(noise: MeasurementNoise, shape: tuple[int, int], device: wp.Device) -> Packed:
    """Return the errors of every vehicle of every world, (worlds, vehicles); randomisation overwrites them."""
    packed = Packed(MeasurementErrors, shape, device)
    part = np.linspace(0.0, 1.0, shape[0])[:, None] if noise.graded and shape[0] > 1 else 1.0
    for name, array in packed.fields.items():
        array.assign(np.full(shape, getattr(noise, name) * part, dtype=np.float32))
    return packed


@wp.kernel(enable_backward=False)
def measure(
    state: State,
    arrays: TaskArrays,
    measurement: wp.array2d(dtype=MeasurementErrors),
    control_step: float,
    seed: int,
    world_offset: int,
):
    """Write the measurements of every vehicle; the draw depends only on seed, world, vehicle, episode and step."""
    i, v = wp.tid()
    w = world_offset + i
    m = measurement[w, v]
    x = state.position[w, v]
    q = state.quaternion[w, v]
    nu = state.velocity[w, v]
    step = state.steps[w]
    late = wp.min(int(wp.rint(m.delay / control_step)), wp.static(HISTORY - 1))
    if late > 0 and step > 0:
        # Slot k of the history contains the state after step k + 1; the start of an episode is not in it.
        past = state.history[wp.max(step - 1 - late, 0) % wp.static(HISTORY), w, v]
        x = wp.vec3(past[0], past[1], past[2])
        q = wp.quat(past[3], past[4], past[5], past[6])
        for k in range(6):
            nu[k] = past[7 + k]
    # Overflow at 32 bits makes the streams of neighbouring seeds differ.
    vehicle_seed = wp.rand_init(seed + 104729 * state.episode[w] + 1 + 15485867 * v, w)
    bias = wp.rand_init(wp.randi(vehicle_seed), -1)
    rng = wp.rand_init(wp.randi(vehicle_seed), step)
    n = wp.vec3(wp.randn(rng), wp.randn(rng), wp.randn(rng))
    angle = m.yaw_std * wp.randn(rng)
    for k in range(3):
        nu[k] = nu[k] + m.velocity_std * wp.randn(rng)
    for k in range(3):
        nu[k + 3] = nu[k + 3] + m.rate_std * wp.randn(rng)
    lasting = wp.vec3(0.0)
    if m.position_bias + m.yaw_bias + m.velocity_bias + m.rate_bias > 0.0:
        lasting = wp.vec3(wp.randn(bias), wp.randn(bias), wp.randn(bias))
        angle += m.yaw_bias * wp.randn(bias)
        for k in range(3):
            nu[k] = nu[k] + m.velocity_bias * wp.randn(bias)
        for k in range(3):
            nu[k + 3] = nu[k + 3] + m.rate_bias * wp.randn(bias)
    if step > 0 and wp.randf(rng) < m.dropout:
        return  # the previous measurement is kept
    arrays.position[w, v] = x + m.position_std * n + m.position_bias * lasting
    arrays.quaternion[w, v] = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), angle) * q
    arrays.velocity[w, v] = nu
