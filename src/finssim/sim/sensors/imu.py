"""Inertial measurement unit: specific force and angular rate at its mounting point."""
# mypy: disable-error-code="valid-type,misc,index,return-value,no-any-return,no-untyped-def,untyped-decorator,operator"

import math
from typing import Any

import warp as wp

from finssim.physics.types import angular, linear, vec6
from finssim.sim.sensors.batch import SensorBatch, Surroundings
from finssim.sim.sensors.sampling import (
    TURN_ON,
    TURN_ON_2,
    WALK,
    WALK_2,
    WHITE,
    WHITE_2,
    SampledState,
    digitised3,
    normal3,
    parameters_of,
    sampling_kernel,
)
from finssim.vehicles.equipment import Imu

# Per sample: standard deviations [rad/s] and [m/s²].
ImuParameters = parameters_of(Imu, gravity=float, gyro_noise=float, accel_noise=float)


@wp.struct
class ImuArrays:
    """Readings and internal state of all IMUs, by (world, vehicle); the ring buffers have one more index."""

    gyro: wp.array2d(dtype=wp.vec3)  # angular rate, sensor frame [rad/s]
    accel: wp.array2d(dtype=wp.vec3)  # specific force, sensor frame [m/s²]
    gyro_bias: wp.array2d(dtype=wp.vec3)  # true bias, sensor frame [rad/s]
    accel_bias: wp.array2d(dtype=wp.vec3)  # true bias, sensor frame [m/s²]
    gyro_ring: wp.array3d(dtype=wp.vec3)  # angular rates in transit, sensor frame [rad/s]
    accel_ring: wp.array3d(dtype=wp.vec3)


@wp.func
def specific_force(
    nu: vec6, nu_dot: vec6, q_wb: wp.quat, r: wp.vec3, q_bs: wp.quat, gravity: float
) -> wp.vec3:
    """Return the reading of an ideal accelerometer: acceleration of its point without gravity.

    f = R_bsᵀ [ v_dot + ω × v + ω_dot × r + ω × (ω × r) - R_wbᵀ g ],  g = (0, 0, -gravity)

    ω × v is there because v_dot is the rate of the *components* of v in the turning body frame.

    Args:
        nu: Velocity of the body origin, body frame [m/s, rad/s].
        nu_dot: Rate of the components of nu [m/s², rad/s²].
        q_wb: Attitude, body to world, xyzw.
        r: Sensor from the body origin, body frame [m].
        q_bs: Orientation, sensor to body, xyzw.
        gravity: [m/s²].

    Returns:
        Specific force, sensor frame [m/s²]: (0, 0, +gravity) when level and at rest.
    """
    omega = angular(nu)
    a = linear(nu_dot) + wp.cross(omega, linear(nu))
    a += wp.cross(angular(nu_dot), r) + wp.cross(omega, wp.cross(omega, r))
    g = wp.quat_rotate_inv(q_wb, wp.vec3(0.0, 0.0, -gravity))
    return wp.quat_rotate_inv(q_bs, a - g)


@wp.func
def angular_rate(nu: vec6, q_bs: wp.quat) -> wp.vec3:
    """Return the reading of an ideal gyroscope: R_bsᵀ ω, sensor frame [rad/s]."""
    return wp.quat_rotate_inv(q_bs, angular(nu))


@wp.func
def measure_motion(truth: SampledState, p: ImuParameters, imu: ImuArrays, w: int, v: int, slot: int) -> bool:
    """Take one sample of an IMU; for the arguments see `sampling_kernel`."""
    if truth.restarting:
        imu.gyro_bias[w, v] = p.gyro_bias_initial * normal3(truth.key, TURN_ON)
        imu.accel_bias[w, v] = p.accel_bias_initial * normal3(truth.key, TURN_ON_2)
    gyro_bias = imu.gyro_bias[w, v] + p.gyro_bias_walk * truth.root * normal3(truth.key, WALK)
    accel_bias = imu.accel_bias[w, v] + p.accel_bias_walk * truth.root * normal3(truth.key, WALK_2)
    gyro = angular_rate(truth.velocity, p.orientation) + gyro_bias + p.gyro_noise * normal3(truth.key, WHITE)
    accel = specific_force(
        truth.velocity, truth.acceleration, truth.quaternion, p.position, p.orientation, p.gravity
    )
    accel += accel_bias + p.accel_noise * normal3(truth.key, WHITE_2)
    imu.gyro_ring[w, v, slot] = digitised3(gyro, p.gyro_quantisation, p.gyro_range)
    imu.accel_ring[w, v, slot] = digitised3(accel, p.accel_quantisation, p.accel_range)
    imu.gyro_bias[w, v] = gyro_bias
    imu.accel_bias[w, v] = accel_bias
    return True


@wp.func
def display_motion(p: ImuParameters, imu: ImuArrays, w: int, v: int, slot: int):
    """Copy both readings of an arrived sample."""
    imu.gyro[w, v] = imu.gyro_ring[w, v, slot]
    imu.accel[w, v] = imu.accel_ring[w, v, slot]


class ImuBatch(SensorBatch):
    """The IMUs of all vehicles of all worlds."""

    kind = "imu"
    kernel = sampling_kernel(ImuParameters, ImuArrays, measure_motion, display_motion)
    readings = ("gyro", "accel")

    gyro: "wp.array[Any]"
    """Angular rate, sensor frame [rad/s]; vec3 (W, V)."""
    accel: "wp.array[Any]"
    """Specific force, sensor frame [m/s²]; vec3 (W, V)."""
    gyro_bias: "wp.array[Any]"
    """Truth: bias of the angular rate, sensor frame [rad/s]; vec3 (W, V)."""
    accel_bias: "wp.array[Any]"
    """Truth: bias of the specific force, sensor frame [m/s²]; vec3 (W, V)."""

    def derived(self, entry: Any, site: Surroundings) -> dict[str, float]:
        """Return gravity [m/s²] and the standard deviations of white noise per sample: density times √rate."""
        noise = {name: getattr(entry, f"{name}_density") for name in ("gyro_noise", "accel_noise")}
        return {"gravity": site.gravity, **{name: std * math.sqrt(entry.rate) for name, std in noise.items()}}
