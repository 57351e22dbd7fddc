"""Doppler velocity log: velocity of its mounting point over the floor or through the water."""
# mypy: disable-error-code="valid-type,misc,index,return-value,no-any-return,no-untyped-def,untyped-decorator"

import math
from typing import Any

import warp as wp

from finssim.physics.types import angular, linear, vec6
from finssim.sim.sensors.batch import SensorBatch, Surroundings
from finssim.sim.sensors.sampling import (
    TURN_ON,
    TURN_ON_2,
    WALK,
    WHITE,
    SampledState,
    digitised3,
    normal,
    normal3,
    parameters_of,
    sampling_kernel,
)
from finssim.vehicles.equipment import Dvl

# Cosine of the largest tilt with bottom lock [-], and depth of the flat floor [m].
DvlParameters = parameters_of(Dvl, tilt_cosine=float, floor_depth=float)


@wp.struct
class DvlArrays:
    """Readings and internal state of all DVLs, by (world, vehicle); the ring buffer has one more index."""

    velocity: wp.array2d(dtype=wp.vec3)  # sensor frame [m/s]
    bias: wp.array2d(dtype=wp.vec3)  # true bias, sensor frame [m/s]
    scale_error: wp.array2d(dtype=float)  # true scale error
    lock: wp.array2d(dtype=int)  # 1 if the beams reach the bottom of a described world
    ring: wp.array3d(dtype=wp.vec3)  # velocities in transit [m/s]


@wp.func
def sensed_velocity(nu: vec6, q_wb: wp.quat, water: wp.vec3, r: wp.vec3, q_bs: wp.quat) -> wp.vec3:
    """Return the reading of an ideal DVL: velocity of its point relative to the floor or to the water.

    v = R_bsᵀ [ v + ω × r - R_wbᵀ v_w ]

    Args:
        nu: Velocity of the body origin, body frame [m/s, rad/s].
        q_wb: Attitude, body to world, xyzw.
        water: Velocity v_w of the water for water track, zero for bottom track; world frame [m/s].
        r: Sensor from the body origin, body frame [m].
        q_bs: Orientation, sensor to body, xyzw.

    Returns:
        Velocity, sensor frame [m/s].
    """
    over_floor = linear(nu) + wp.cross(angular(nu), r)
    return wp.quat_rotate_inv(q_bs, over_floor - wp.quat_rotate_inv(q_wb, water))


@wp.func
def has_echo(position: wp.vec3, q_wb: wp.quat, p: DvlParameters) -> bool:
    """Return whether the beams reach the floor: tilt and altitude of the DVL are within its limits.

    Args:
        position: Body origin, world frame [m].
        q_wb: Attitude, body to world, xyzw.
        p: Mounting pose and limits.
    """
    up = wp.quat_rotate(q_wb, wp.vec3(0.0, 0.0, 1.0))
    point = position + wp.quat_rotate(q_wb, p.position)
    altitude = p.floor_depth + point[2]
    return up[2] >= p.tilt_cosine and altitude >= p.altitude_min and altitude <= p.altitude_max


@wp.func
def measure_velocity(
    truth: SampledState, p: DvlParameters, dvl: DvlArrays, w: int, v: int, slot: int
) -> bool:
    """Take one sample of a DVL; for the arguments see `sampling_kernel`."""
    if truth.restarting:
        dvl.bias[w, v] = p.bias_initial * normal3(truth.key, TURN_ON)
        dvl.scale_error[w, v] = p.scale_error * normal(truth.key, TURN_ON_2)
    bias = dvl.bias[w, v] + p.bias_walk * truth.root * normal3(truth.key, WALK)
    exact = sensed_velocity(truth.velocity, truth.quaternion, truth.water, p.position, p.orientation)
    reading = (1.0 + dvl.scale_error[w, v]) * exact + bias + p.noise_std * normal3(truth.key, WHITE)
    dvl.ring[w, v, slot] = digitised3(reading, p.quantisation, p.velocity_range)
    dvl.bias[w, v] = bias
    return truth.water_known or (dvl.lock[w, v] != 0 and has_echo(truth.position, truth.quaternion, p))


@wp.func
def display_velocity(p: DvlParameters, dvl: DvlArrays, w: int, v: int, slot: int):
    """Copy the velocity of an arrived sample to the readings."""
    dvl.velocity[w, v] = dvl.ring[w, v, slot]


class DvlBatch(SensorBatch):
    """The DVLs of all vehicles of all worlds."""

    kind = "dvl"
    kernel = sampling_kernel(DvlParameters, DvlArrays, measure_velocity, display_velocity)
    readings = ("velocity",)

    velocity: "wp.array[Any]"
    """Velocity over the floor, or through the water if its velocity was given; sensor frame [m/s]; vec3 (W, V)."""
    bias: "wp.array[Any]"
    """Truth: bias of the velocity, sensor frame [m/s]; vec3 (W, V)."""
    scale_error: "wp.array[Any]"
    """Truth: scale error of the velocity; float (W, V)."""
    lock: "wp.array[Any]"
    """Flag [-] of bottom lock, int (W, V): 1, unless the beams in a described world update it."""

    def _new_arrays(self) -> Any:
        arrays = super()._new_arrays()
        arrays.lock.fill_(1)
        return arrays

    def derived(self, entry: Any, site: Surroundings) -> dict[str, float]:
        """Return the limits of the beams; without a known floor the altitude is unlimited [m]."""
        tilt = {"tilt_cosine": math.cos(min(entry.max_tilt, math.pi)), "floor_depth": site.floor_depth}
        return tilt if math.isfinite(site.floor_depth) else {**tilt, "altitude_max": math.inf}
