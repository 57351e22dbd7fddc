"""Compass: heading of the body's x axis about the vertical, tilt compensated."""
# mypy: disable-error-code="valid-type,misc,index,no-any-return,no-untyped-def,untyped-decorator"

from typing import Any

import warp as wp

from finssim.sensors.batch import SensorBatch
from finssim.sensors.sampling import (
    TURN_ON,
    WHITE,
    Sampling,
    SensedState,
    arrival,
    begin_update,
    digitised,
    lost,
    normal,
    restart,
    sample_due,
    sample_key,
    slot_of,
)

COMPASS = 4
"""Number of this kind of sensor in the random key."""


@wp.struct
class CompassParameters:
    """Errors of one compass. Standard deviations are per sample."""

    dropout: float  # probability that a sample never arrives
    noise: float  # [rad]
    turn_on: float  # [rad]
    quantum: float  # [rad]


@wp.struct
class CompassArrays:
    """Readings and memory of all compasses, by (world, vehicle); the ring has one more index."""

    heading: wp.array2d(dtype=float)  # left positive from world x [rad]
    bias: wp.array2d(dtype=float)  # true offset [rad]
    ring: wp.array3d(dtype=float)  # samples on their way


@wp.func
def heading_of(q_wb: wp.quat) -> float:
    """Angle of the body's x axis from world x about the vertical, in [-π, π] [rad].

    Args:
        q_wb: Attitude, body to world, xyzw.
    """
    ahead = wp.quat_rotate(q_wb, wp.vec3(1.0, 0.0, 0.0))
    return wp.atan2(ahead[1], ahead[0])


@wp.kernel(enable_backward=False)
def sample_compass(
    quaternion: wp.array2d(dtype=wp.quat),
    steps: wp.array(dtype=int),
    episode: wp.array(dtype=int),
    parameters: wp.array2d(dtype=CompassParameters),
    compass: CompassArrays,
    sampling: Sampling,
    mask: wp.array(dtype=int),
    restarting: bool,
    seed: int,
    world_offset: int,
):
    """One update of every compass.

    Args:
        quaternion: Attitude, body to world, xyzw, (W, V).
        steps: Control steps since the world's reset, (W,).
        episode: Resets of the world so far, (W,).
        parameters: Errors of each compass, (W, V).
        compass: Readings and memory.
        sampling: When each samples.
        mask: Worlds to look at, (W,).
        restarting: Whether these worlds have just been reset.
        seed: Of all random numbers.
        world_offset: World of the first thread.
    """
    i, v = wp.tid()
    w = world_offset + i
    if mask[w] == 0:
        return
    p = parameters[w, v]
    step = steps[w]
    key = sample_key(seed, COMPASS, w, v, episode[w], step)
    if restarting:
        restart(sampling, w, v, step)
        compass.bias[w, v] = p.turn_on * normal(key, TURN_ON)
    if not begin_update(sampling, w, v, step):
        return
    if restarting or sample_due(sampling, w, v, step):
        heading = heading_of(quaternion[w, v]) + compass.bias[w, v] + p.noise * normal(key, WHITE)
        slot = slot_of(sampling, step)
        compass.ring[w, v, slot] = digitised(heading, p.quantum, wp.inf)
        sampling.sent[w, v, slot] = restarting or not lost(key, p.dropout)
        sampling.last[w, v] = step
    slot = arrival(sampling, w, v, step, restarting)
    if slot >= 0:
        compass.heading[w, v] = compass.ring[w, v, slot]


class CompassBatch(SensorBatch):
    """The compasses of all vehicles of all worlds."""

    kind = "compass"
    kernel = sample_compass
    parameter_struct = CompassParameters
    array_struct = CompassArrays
    readings = ("heading",)

    heading: "wp.array[Any]"
    """Of the body's x axis from world x, left positive [rad]; float (W, V)."""
    bias: "wp.array[Any]"
    """Truth: the offset in it [rad]; float (W, V)."""

    def state_arrays(self, state: SensedState, water_velocity: Any) -> list[Any]:
        """Attitude."""
        return [state.quaternion]

    def use(self, vehicle: int, entry: Any, *, gravity: float, density: float) -> None:
        """Take one vehicle's parameters from its file.

        Args:
            vehicle: Index.
            entry: `vehicle.sensors.compass`.
            gravity: Not used [m/s²].
            density: Not used [kg/m³].
        """
        self.set(
            vehicle,
            dropout=entry.dropout,
            noise=entry.noise_std,
            turn_on=entry.bias_initial,
            quantum=entry.quantisation,
        )
