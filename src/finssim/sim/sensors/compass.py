"""Compass: heading of the body's x axis about the vertical, tilt compensated."""
# mypy: disable-error-code="valid-type,misc,index,no-any-return,no-untyped-def,untyped-decorator"

from typing import Any

import warp as wp

from finssim.sim.sensors.batch import SensorBatch
from finssim.sim.sensors.sampling import (
    TURN_ON,
    WHITE,
    SampledState,
    digitised,
    normal,
    parameters_of,
    sampling_kernel,
)
from finssim.vehicles.equipment import Compass

CompassParameters = parameters_of(Compass)


@wp.struct
class CompassArrays:
    """Readings and internal state of all compasses, by (world, vehicle); the ring buffer has one more index."""

    heading: wp.array2d(dtype=float)  # left positive from world x [rad]
    bias: wp.array2d(dtype=float)  # true bias [rad]
    ring: wp.array3d(dtype=float)  # headings in transit [rad]


@wp.func
def heading_of(q_wb: wp.quat) -> float:
    """Return the angle of the body's x axis from world x about the vertical, in [-π, π] [rad].

    Args:
        q_wb: Attitude, body to world, xyzw.
    """
    ahead = wp.quat_rotate(q_wb, wp.vec3(1.0, 0.0, 0.0))
    return wp.atan2(ahead[1], ahead[0])


@wp.func
def measure_heading(
    truth: SampledState, p: CompassParameters, compass: CompassArrays, w: int, v: int, slot: int
) -> bool:
    """Take one sample of a compass; for the arguments see `sampling_kernel`."""
    if truth.restarting:
        compass.bias[w, v] = p.bias_initial * normal(truth.key, TURN_ON)
    heading = heading_of(truth.quaternion) + compass.bias[w, v] + p.noise_std * normal(truth.key, WHITE)
    compass.ring[w, v, slot] = digitised(heading, p.quantisation, wp.inf)
    return True


@wp.func
def display_heading(p: CompassParameters, compass: CompassArrays, w: int, v: int, slot: int):
    """Copy the heading of an arrived sample to the readings."""
    compass.heading[w, v] = compass.ring[w, v, slot]


class CompassBatch(SensorBatch):
    """The compasses of all vehicles of all worlds."""

    kind = "compass"
    kernel = sampling_kernel(CompassParameters, CompassArrays, measure_heading, display_heading)
    readings = ("heading",)

    heading: "wp.array[Any]"
    """Heading of the body's x axis from world x, left positive [rad]; float (W, V)."""
    bias: "wp.array[Any]"
    """Truth: bias of the heading [rad]; float (W, V)."""
