"""Everything that can be tuned in the fusion."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from finssim.localization import LocalizationError
from finssim.localization.fusion.attitude import YawNoise
from finssim.localization.fusion.gates import OutlierGate
from finssim.localization.fusion.position_filter import MotionModel
from finssim.localization.overhead_camera import Pool
from finssim.vehicles import Vehicle

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Aids:
    """Errors of Doppler log and compass; those that last since power-on are a part of the error state."""

    velocity_std: float = 0.01
    """Standard deviation of one sample, per axis [m/s]."""
    velocity_bias: float = 0.001
    """Standard deviation of the offset, per axis [m/s]."""
    velocity_scale: float = 0.001
    """Standard deviation of the scale's error [-]."""
    velocity_walk: float = 0.0
    """Random walk of the offset [m/s²/√Hz]."""
    heading_std: float = 0.01
    """Standard deviation of one sample [rad]."""
    heading_bias: float = 0.005
    """Standard deviation of the compass's offset [rad]."""


@dataclass(frozen=True)
class AgeLimits:
    """Ages and delays of samples up to which they count [s]."""

    fresh: float = 0.25
    """Age of vision up to which the state is called fresh [s]."""
    coast: float = 0.75
    """Time up to which velocity is extrapolated [s]."""
    hold: float = 3.0
    """Time [s] up to which velocity decays; beyond it the position is constant and its covariance grows."""
    imu_fresh: float = 0.10
    """Age of an IMU's sample up to which it is called fresh [s]."""
    depth_fresh: float = 0.30
    """Age of a depth up to which it is called fresh [s]."""
    horizon: float = 1.0
    """Greatest delay of a sample that is still inserted at its time [s]."""
    jump: float = 1.0
    """Greatest lead of a stamp over its arrival before the clock is doubted [s]."""


@dataclass(frozen=True)
class ImuErrors:
    """Errors of gyro and accelerometer."""

    gyro: YawNoise = YawNoise()
    gyro_bias_std: float = 0.01
    """Bias of the gyro at power-on [rad/s]."""
    blind_rate: float = 0.3
    """Noise density of the yaw rate where the gyro is silent [rad/s/√Hz]."""
    accel_noise: float = 0.02
    """Noise density of the accelerometer [m/s²/√Hz], vibration included."""
    accel_bias_walk: float = 1e-3
    """Random walk of the accelerometer's bias [m/s³/√Hz]."""
    accel_bias_std: float = 0.05
    """Bias of the accelerometer at power-on [m/s²]."""
    tilt_std: float = 0.03
    """Standard deviation of roll and pitch at the start of the error-state filter [rad]."""


@dataclass(frozen=True)
class Settings:
    """Settings of the estimator. Times in seconds."""

    ages: AgeLimits = AgeLimits()
    gate: OutlierGate = OutlierGate()
    motion: MotionModel = MotionModel()
    half_life: float = 1.0
    """Half-life of velocity while the state is held [s]."""
    speed_std: float = 0.3
    """Speed per axis that the vehicle may have when nothing is known [m/s]."""
    largest_variance: float = 100.0
    """Greatest variance of a position [m²], at which its growth ends."""
    vision_std: tuple[float, float] = (0.02, 0.03)
    """Standard deviation of x and y [m] and of yaw [rad], if a measurement has no covariance."""
    vision_floor: tuple[float, float] = (0.002, 0.003)
    """Added to a measurement's own standard deviations, in squares [m, rad]: errors that its covariance leaves out."""
    depth_std: float = 0.01
    """[m]"""
    imu: ImuErrors = ImuErrors()
    ready_position: float = 0.04
    """Largest variance of a position with which the state is ready [m²]."""
    ready_yaw: float = 0.03
    """And of yaw [rad²]."""
    aids: Aids | None = None
    """Noise of Doppler log and compass; None without them. Between fixes the position then drifts as its covariance
    states, and is ready up to `largest_variance`."""

    @property
    def decay(self) -> float:
        """Rate at which a held velocity dies away [1/s]."""
        return math.log(2.0) / self.half_life


LOST = 100.0
"""Standard deviation per axis with which a vehicle that navigates by log and compass is lost [m]."""


@dataclass(frozen=True)
class Site:
    """Numbers of pool and vehicle that the fusion needs."""

    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Unit normal of the still surface, upwards, pool frame."""
    offset: float = 0.0
    """Height of a point p above the surface is up . p + offset [m]."""
    depth_port: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Pressure port, body frame [m]."""
    imu: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Accelerometer, body frame [m]."""
    dvl: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Doppler log, body frame [m]."""
    gravity: float = 9.81
    """[m/s²]"""
    R_wp: tuple[tuple[float, float, float], ...] = field(default=((1, 0, 0), (0, 1, 0), (0, 0, 1)))
    """Rotation matrix from pool axes to world axes, for velocities in the report."""


def site_of(pool: Pool | None, vehicle: Vehicle) -> Site:
    """The site of a pool file and a vehicle file; without a pool file the pool frame is the world's.

    Heights are measured from the water plane itself, tilt included, where that plane is a surface; behind a wall from
    the world frame's origin.

    Raises:
        LocalizationError: The pool frame's z does not point up.
    """
    R_wp = np.eye(3) if pool is None else pool.T_wp[:3, :3]
    if pool is None:
        up, offset = np.array([0.0, 0.0, 1.0]), 0.0
    elif pool.is_surface:
        up, offset = np.asarray(pool.interface.normal, float), float(pool.interface.offset)
    else:
        up, offset = R_wp[2], float(pool.T_wp[2, 3])
    if up[2] < math.cos(math.radians(10.0)):
        raise LocalizationError(
            f"pool frame: up is {np.round(up, 3).tolist()} in its axes, expected z within 10 degrees of it: depth and "
            "heading are fused about z; survey the pool with z up, or give frames: world: in the pool file"
        )
    sensors = vehicle.sensors
    return Site(
        up=_three(up),
        offset=offset,
        depth_port=_three(sensors.depth.position) if sensors.depth else (0.0, 0.0, 0.0),
        imu=_three(sensors.imu.position) if sensors.imu else (0.0, 0.0, 0.0),
        dvl=_three(sensors.dvl.position) if sensors.dvl else (0.0, 0.0, 0.0),
        gravity=float(vehicle.water.gravity),
        R_wp=tuple(_three(row) for row in R_wp),
    )


def settings_of(vehicle: Vehicle) -> Settings:
    """Settings with the vehicle file's sensor noises, never below what mounting and sampling leave besides them."""
    settings, imu, depth = Settings(), vehicle.sensors.imu, vehicle.sensors.depth
    if imu is not None:
        least = settings.imu
        errors = replace(
            least,
            gyro=YawNoise(max(imu.gyro_noise_density, least.gyro.rate), max(imu.gyro_bias_walk, 2e-5)),
            gyro_bias_std=max(imu.gyro_bias_initial, least.gyro_bias_std),
            accel_noise=max(imu.accel_noise_density, least.accel_noise),
            accel_bias_std=max(imu.accel_bias_initial, least.accel_bias_std),
        )
        settings = replace(settings, imu=errors)
    if depth is not None:
        settings = replace(settings, depth_std=max(depth.noise_std, settings.depth_std))
    dvl, compass = vehicle.sensors.dvl, vehicle.sensors.compass
    if dvl is None and compass is None:
        return settings
    aids = Aids()
    if dvl is not None:
        aids = replace(
            aids,
            velocity_std=math.hypot(dvl.noise_std, 0.3 * dvl.quantisation),
            velocity_bias=dvl.bias_initial,
            velocity_scale=dvl.scale_error,
            velocity_walk=dvl.bias_walk,
        )
    if compass is not None:
        aids = replace(
            aids,
            heading_std=math.hypot(compass.noise_std, 0.3 * compass.quantisation),
            heading_bias=compass.bias_initial,
        )
    return replace(settings, aids=aids, ready_position=LOST**2, largest_variance=LOST**2)


def _three(values: npt.ArrayLike) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in np.asarray(values, float))
    return x, y, z
