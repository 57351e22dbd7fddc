"""Inertial measurement unit: specific force and angular rate at its mount."""
# mypy: disable-error-code="valid-type,misc,index,return-value,no-any-return,no-untyped-def,untyped-decorator,operator"

import math
from typing import Any

import warp as wp

from finssim.physics.types import angular, linear, vec6
from finssim.sensors.batch import SensorBatch
from finssim.sensors.sampling import (
    TURN_ON,
    TURN_ON_2,
    WALK,
    WALK_2,
    WHITE,
    WHITE_2,
    Sampling,
    SensedState,
    arrival,
    begin_update,
    digitised3,
    lost,
    normal3,
    restart,
    root_of_wait,
    sample_due,
    sample_key,
    slot_of,
)

IMU = 1
"""Number of this kind of sensor in the random key."""


@wp.struct
class ImuParameters:
    """Mount and errors of one IMU. Standard deviations are per sample, walks per square root of a second."""

    dropout: float  # probability that a sample never arrives
    r: wp.vec3  # sensor from the body origin, body frame [m]
    q_bs: wp.quat  # sensor to body, xyzw
    gravity: float  # [m/s²]
    gyro_noise: float  # [rad/s]
    gyro_walk: float  # [rad/s/√s]
    gyro_turn_on: float  # [rad/s]
    gyro_quantum: float  # [rad/s]
    gyro_range: float  # [rad/s]
    accel_noise: float  # [m/s²]
    accel_walk: float  # [m/s²/√s]
    accel_turn_on: float  # [m/s²]
    accel_quantum: float  # [m/s²]
    accel_range: float  # [m/s²]


@wp.struct
class ImuArrays:
    """Readings and memory of all IMUs, by (world, vehicle); the ring has one more index."""

    gyro: wp.array2d(dtype=wp.vec3)  # angular rate, sensor frame [rad/s]
    accel: wp.array2d(dtype=wp.vec3)  # specific force, sensor frame [m/s²]
    gyro_bias: wp.array2d(dtype=wp.vec3)  # true bias, sensor frame [rad/s]
    accel_bias: wp.array2d(dtype=wp.vec3)  # true bias, sensor frame [m/s²]
    gyro_ring: wp.array3d(dtype=wp.vec3)  # samples on their way
    accel_ring: wp.array3d(dtype=wp.vec3)


@wp.func
def specific_force(
    nu: vec6, nu_dot: vec6, q_wb: wp.quat, r: wp.vec3, q_bs: wp.quat, gravity: float
) -> wp.vec3:
    """What an ideal accelerometer reads: acceleration of its point without gravity.

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
    """What an ideal gyroscope reads: R_bsᵀ ω, sensor frame [rad/s]."""
    return wp.quat_rotate_inv(q_bs, angular(nu))


@wp.kernel(enable_backward=False)
def sample_imu(
    quaternion: wp.array2d(dtype=wp.quat),
    velocity: wp.array2d(dtype=vec6),
    acceleration: wp.array2d(dtype=vec6),
    steps: wp.array(dtype=int),
    episode: wp.array(dtype=int),
    parameters: wp.array2d(dtype=ImuParameters),
    imu: ImuArrays,
    sampling: Sampling,
    mask: wp.array(dtype=int),
    restarting: bool,
    seed: int,
    world_offset: int,
):
    """One update of every IMU.

    Args:
        quaternion: Attitude, body to world, xyzw, (W, V).
        velocity: nu at the body origin, body frame [m/s, rad/s], (W, V).
        acceleration: nu_dot, rate of the components of nu, body frame [m/s², rad/s²], (W, V).
        steps: Control steps since the world's reset, (W,).
        episode: Resets of the world so far, (W,).
        parameters: Mount and errors of each IMU, (W, V).
        imu: Readings and memory.
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
    key = sample_key(seed, IMU, w, v, episode[w], step)
    if restarting:
        restart(sampling, w, v, step)
        imu.gyro_bias[w, v] = p.gyro_turn_on * normal3(key, TURN_ON)
        imu.accel_bias[w, v] = p.accel_turn_on * normal3(key, TURN_ON_2)
    if not begin_update(sampling, w, v, step):
        return
    if restarting or sample_due(sampling, w, v, step):
        root = root_of_wait(sampling, w, v, step)
        gyro_bias = imu.gyro_bias[w, v] + p.gyro_walk * root * normal3(key, WALK)
        accel_bias = imu.accel_bias[w, v] + p.accel_walk * root * normal3(key, WALK_2)
        nu = velocity[w, v]
        gyro = angular_rate(nu, p.q_bs) + gyro_bias + p.gyro_noise * normal3(key, WHITE)
        accel = specific_force(nu, acceleration[w, v], quaternion[w, v], p.r, p.q_bs, p.gravity)
        accel += accel_bias + p.accel_noise * normal3(key, WHITE_2)
        slot = slot_of(sampling, step)
        imu.gyro_ring[w, v, slot] = digitised3(gyro, p.gyro_quantum, p.gyro_range)
        imu.accel_ring[w, v, slot] = digitised3(accel, p.accel_quantum, p.accel_range)
        imu.gyro_bias[w, v] = gyro_bias
        imu.accel_bias[w, v] = accel_bias
        sampling.sent[w, v, slot] = restarting or not lost(key, p.dropout)
        sampling.last[w, v] = step
    slot = arrival(sampling, w, v, step, restarting)
    if slot >= 0:
        imu.gyro[w, v] = imu.gyro_ring[w, v, slot]
        imu.accel[w, v] = imu.accel_ring[w, v, slot]


class ImuBatch(SensorBatch):
    """The IMUs of all vehicles of all worlds."""

    kind = "imu"
    kernel = sample_imu
    parameter_struct = ImuParameters
    array_struct = ImuArrays
    readings = ("gyro", "accel")

    gyro: "wp.array[Any]"
    """Angular rate, sensor frame [rad/s]; vec3 (W, V)."""
    accel: "wp.array[Any]"
    """Specific force, sensor frame [m/s²]; vec3 (W, V)."""
    gyro_bias: "wp.array[Any]"
    """Truth: the bias in it, sensor frame [rad/s]; vec3 (W, V)."""
    accel_bias: "wp.array[Any]"
    """Truth: the bias in it, sensor frame [m/s²]; vec3 (W, V)."""

    def state_arrays(self, state: SensedState, water_velocity: Any) -> list[Any]:
        """Attitude, velocity and acceleration."""
        return [state.quaternion, state.velocity, state.acceleration]

    def use(self, vehicle: int, entry: Any, *, gravity: float, density: float) -> None:
        """Take one vehicle's parameters from its file.

        Args:
            vehicle: Index.
            entry: `vehicle.sensors.imu`.
            gravity: [m/s²]
            density: Not used [kg/m³].
        """
        # White noise of density σ has the standard deviation σ √rate in each of `rate` samples a second.
        root_rate = math.sqrt(entry.rate)
        self.set(
            vehicle,
            dropout=entry.dropout,
            r=entry.position,
            q_bs=entry.orientation,
            gravity=gravity,
            gyro_noise=entry.gyro_noise_density * root_rate,
            gyro_walk=entry.gyro_bias_walk,
            gyro_turn_on=entry.gyro_bias_initial,
            gyro_quantum=entry.gyro_quantisation,
            gyro_range=entry.gyro_range,
            accel_noise=entry.accel_noise_density * root_rate,
            accel_walk=entry.accel_bias_walk,
            accel_turn_on=entry.accel_bias_initial,
            accel_quantum=entry.accel_quantisation,
            accel_range=entry.accel_range,
        )
