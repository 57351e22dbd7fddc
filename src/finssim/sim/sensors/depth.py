"""Pressure sensor: depth of its mounting point below the still surface."""
# mypy: disable-error-code="valid-type,misc,index,no-any-return,no-untyped-def,untyped-decorator"

from typing import Any

import warp as wp

from finssim.sim.sensors.batch import SensorBatch, Surroundings
from finssim.sim.sensors.sampling import (
    TURN_ON,
    WALK,
    WHITE,
    SampledState,
    digitised,
    normal,
    parameters_of,
    sampling_kernel,
)
from finssim.vehicles.equipment import DepthSensor

ATMOSPHERE = 101325.0
"""Pressure at the surface [Pa], ISO 2533."""

# Specific weight: rho g of the water [N/m³].
DepthParameters = parameters_of(DepthSensor, specific_weight=float)


@wp.struct
class DepthArrays:
    """Readings and internal state of all pressure sensors, by (world, vehicle); the ring buffer has one more index."""

    depth: wp.array2d(dtype=float)  # below the still surface [m]
    pressure: wp.array2d(dtype=float)  # absolute [Pa]
    bias: wp.array2d(dtype=float)  # true bias [m]
    ring: wp.array3d(dtype=float)  # depths in transit [m]


@wp.func
def depth_of_point(position: wp.vec3, q_wb: wp.quat, r: wp.vec3) -> float:
    """Return the reading of an ideal sensor: depth of its point in still water, max(0, -(p + R_wb r)_z) [m].

    Args:
        position: Body origin, world frame [m].
        q_wb: Attitude, body to world, xyzw.
        r: Sensor from the body origin, body frame [m].

    Note:
        In air the depth is zero, at atmospheric pressure. The pressure of passing waves is neglected.
    """
    point = position + wp.quat_rotate(q_wb, r)
    return wp.max(-point[2], 0.0)


@wp.func
def measure_depth(
    truth: SampledState, p: DepthParameters, gauge: DepthArrays, w: int, v: int, slot: int
) -> bool:
    """Take one sample of a pressure sensor; for the arguments see `sampling_kernel`."""
    if truth.restarting:
        gauge.bias[w, v] = p.bias_initial * normal(truth.key, TURN_ON)
    bias = gauge.bias[w, v] + p.bias_walk * truth.root * normal(truth.key, WALK)
    exact = depth_of_point(truth.position, truth.quaternion, p.position)
    gauge.ring[w, v, slot] = digitised(
        exact + bias + p.noise_std * normal(truth.key, WHITE), p.quantisation, wp.inf
    )
    gauge.bias[w, v] = bias
    return True


@wp.func
def display_depth(p: DepthParameters, gauge: DepthArrays, w: int, v: int, slot: int):
    """Copy depth and absolute pressure in still water, p = p_atm + rho g depth [Pa], of an arrived sample to the
    readings."""
    gauge.depth[w, v] = gauge.ring[w, v, slot]
    gauge.pressure[w, v] = ATMOSPHERE + p.specific_weight * gauge.ring[w, v, slot]


class DepthBatch(SensorBatch):
    """The pressure sensors of all vehicles of all worlds."""

    kind = "depth"
    kernel = sampling_kernel(DepthParameters, DepthArrays, measure_depth, display_depth)
    readings = ("depth", "pressure")

    depth: "wp.array[Any]"
    """Depth of the sensor below the still surface [m]; float (W, V)."""
    pressure: "wp.array[Any]"
    """Absolute pressure [Pa]; float (W, V)."""
    bias: "wp.array[Any]"
    """Truth: bias of the depth [m]; float (W, V)."""

    def derived(self, entry: Any, site: Surroundings) -> dict[str, float]:
        """Return the specific weight of the water [N/m³]."""
        return {"specific_weight": site.density * site.gravity}
