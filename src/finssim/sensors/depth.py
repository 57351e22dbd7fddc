"""Pressure gauge: depth of its mount below the still surface."""
# mypy: disable-error-code="valid-type,misc,index,no-any-return,no-untyped-def,untyped-decorator"

from typing import Any

import warp as wp

from finssim.sensors.batch import SensorBatch
from finssim.sensors.sampling import (
    TURN_ON,
    WALK,
    WHITE,
    Sampling,
    SensedState,
    arrival,
    begin_update,
    digitised,
    lost,
    normal,
    restart,
    root_of_wait,
    sample_due,
    sample_key,
    slot_of,
)

DEPTH = 2
"""Number of this kind of sensor in the random key."""

ATMOSPHERE = 101325.0
"""Pressure at the surface [Pa], ISO 2533."""


@wp.struct
class DepthParameters:
    """Mount and errors of one gauge. Standard deviations are per sample, the walk per square root of a second."""

    dropout: float  # probability that a sample never arrives
    r: wp.vec3  # sensor from the body origin, body frame [m]
    specific_weight: float  # rho g of the water [N/m³]
    noise: float  # [m]
    walk: float  # [m/√s]
    turn_on: float  # [m]
    quantum: float  # [m]


@wp.struct
class DepthArrays:
    """Readings and memory of all gauges, by (world, vehicle); the ring has one more index."""

    depth: wp.array2d(dtype=float)  # below the still surface [m]
    pressure: wp.array2d(dtype=float)  # absolute [Pa]
    bias: wp.array2d(dtype=float)  # true bias [m]
    ring: wp.array3d(dtype=float)  # samples on their way


@wp.func
def depth_of_point(position: wp.vec3, q_wb: wp.quat, r: wp.vec3) -> float:
    """What an ideal gauge reads: depth of its point in still water, max(0, -(p + R_wb r)_z) [m].

    Args:
        position: Body origin, world frame [m].
        q_wb: Attitude, body to world, xyzw.
        r: Sensor from the body origin, body frame [m].

    Note:
        In air it reads zero, the pressure of the atmosphere. The pressure of passing waves is left out.
    """
    point = position + wp.quat_rotate(q_wb, r)
    return wp.max(-point[2], 0.0)


@wp.func
def pressure_at(depth: float, specific_weight: float) -> float:
    """Absolute pressure in still water, p = p_atm + rho g depth [Pa].

    Args:
        depth: [m].
        specific_weight: rho g of the water [N/m³].
    """
    return ATMOSPHERE + specific_weight * depth


@wp.kernel(enable_backward=False)
def sample_depth(
    position: wp.array2d(dtype=wp.vec3),
    quaternion: wp.array2d(dtype=wp.quat),
    steps: wp.array(dtype=int),
    episode: wp.array(dtype=int),
    parameters: wp.array2d(dtype=DepthParameters),
    gauge: DepthArrays,
    sampling: Sampling,
    mask: wp.array(dtype=int),
    restarting: bool,
    seed: int,
    world_offset: int,
):
    """One update of every gauge.

    Args:
        position: Body origin, world frame [m], (W, V).
        quaternion: Attitude, body to world, xyzw, (W, V).
        steps: Control steps since the world's reset, (W,).
        episode: Resets of the world so far, (W,).
        parameters: Mount and errors of each gauge, (W, V).
        gauge: Readings and memory.
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
    key = sample_key(seed, DEPTH, w, v, episode[w], step)
    if restarting:
        restart(sampling, w, v, step)
        gauge.bias[w, v] = p.turn_on * normal(key, TURN_ON)
    if not begin_update(sampling, w, v, step):
        return
    if restarting or sample_due(sampling, w, v, step):
        root = root_of_wait(sampling, w, v, step)
        bias = gauge.bias[w, v] + p.walk * root * normal(key, WALK)
        depth = depth_of_point(position[w, v], quaternion[w, v], p.r) + bias + p.noise * normal(key, WHITE)
        slot = slot_of(sampling, step)
        gauge.ring[w, v, slot] = digitised(depth, p.quantum, wp.inf)
        gauge.bias[w, v] = bias
        sampling.sent[w, v, slot] = restarting or not lost(key, p.dropout)
        sampling.last[w, v] = step
    slot = arrival(sampling, w, v, step, restarting)
    if slot >= 0:
        gauge.depth[w, v] = gauge.ring[w, v, slot]
        gauge.pressure[w, v] = pressure_at(gauge.ring[w, v, slot], p.specific_weight)


class DepthBatch(SensorBatch):
    """The pressure gauges of all vehicles of all worlds."""

    kind = "depth"
    kernel = sample_depth
    parameter_struct = DepthParameters
    array_struct = DepthArrays
    readings = ("depth", "pressure")

    depth: "wp.array[Any]"
    """Of the gauge below the still surface [m]; float (W, V)."""
    pressure: "wp.array[Any]"
    """Absolute [Pa]; float (W, V)."""
    bias: "wp.array[Any]"
    """Truth: the bias in the depth [m]; float (W, V)."""

    def state_arrays(self, state: SensedState, water_velocity: Any) -> list[Any]:
        """Position and attitude."""
        return [state.position, state.quaternion]

    def use(self, vehicle: int, entry: Any, *, gravity: float, density: float) -> None:
        """Take one vehicle's parameters from its file.

        Args:
            vehicle: Index.
            entry: `vehicle.sensors.depth`.
            gravity: [m/s²]
            density: Of the water [kg/m³].
        """
        self.set(
            vehicle,
            dropout=entry.dropout,
            r=entry.position,
            specific_weight=density * gravity,
            noise=entry.noise_std,
            walk=entry.bias_walk,
            turn_on=entry.bias_initial,
            quantum=entry.quantisation,
        )
