"""Settings of the fusion."""

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
    """Errors of Doppler log and compass; constant errors since power-on are part of the error state."""

    velocity_std: float = 0.01
    """Standard deviation of one sample, per axis [m/s]."""
    velocity_bias: float = 0.001
    """Standard deviation of the offset, per axis [m/s]."""
    velocity_scale: float = 0.001
    """Standard deviation of the scale error [-]."""
    velocity_walk: float = 0.0
    """Random walk of the offset [m/s²/√Hz]."""
    heading_std: float = 0.01
    """Standard deviation of one sample [rad]."""
    heading_bias: float = 0.005
    """Standard deviation of the compass's offset [rad]."""


@dataclass(frozen=True)
class AgeLimits:
    """Limits of ages and delays of samples [s]."""

    fresh: float = 0.25
    """Age of vision up to which the vision mode is `fresh` [s]."""
    coast: float = 0.75
    """Age of vision up to which velocity is extrapolated [s]."""
    hold: float = 3.0
    """Age of vision [s] up to which velocity decays; beyond it the position is constant and its covariance grows."""
    imu_fresh: float = 0.10
    """Age up to which an IMU sample is fresh [s]."""
    depth_fresh: float = 0.30
    """Age up to which a depth sample is fresh [s]."""
    horizon: float = 1.0
    """Greatest delay with which a sample is still inserted at its own time [s]."""
    jump: float = 1.0
    """Greatest jump of a time stamp relative to its arrival that is not treated as a clock jump [s]."""


@dataclass(frozen=True)
class ImuErrors:
    """Errors of gyro and accelerometer."""

    gyro: YawNoise = YawNoise()
    gyro_bias_std: float = 0.01
    """Standard deviation of the gyro's bias at power-on [rad/s]."""
    blind_rate: float = 0.3
    """Noise density of the yaw rate while the gyro delivers no samples [rad/s/√Hz]."""
    accel_noise: float = 0.02
    """Noise density of the accelerometer [m/s²/√Hz], vibration included."""
    accel_bias_walk: float = 1e-3
    """Random walk of the accelerometer's bias [m/s³/√Hz]."""
    accel_bias_std: float = 0.05
    """Standard deviation of the accelerometer's bias at power-on [m/s²]."""
    tilt_std: float = 0.03
    """Standard deviation of roll and pitch at the start of the error-state filter [rad]."""


@dataclass(frozen=True)
class Settings:
    """Settings of the estimator. Times in seconds."""

    ages: AgeLimits = AgeLimits()
    gate: OutlierGate = OutlierGate()
    motion: MotionModel = MotionModel()
    half_life: float = 1.0
    """Half-life of the velocity in the vision mode `hold` [s]."""
    speed_std: float = 0.3
    """Standard deviation of the velocity per axis without any measurement [m/s]."""
    largest_variance: float = 100.0
    """Greatest variance of a position, at which its growth ends [m²]."""
    vision_std: tuple[float, float] = (0.02, 0.03)
    """Standard deviation of x and y [m] and of yaw [rad], if a measurement has no covariance."""
    vision_floor: tuple[float, float] = (0.002, 0.003)
    """Standard deviation of x and y [m] and of yaw [rad] that is added in quadrature, for errors that the
    measurement's own covariance omits."""
    depth_std: float = 0.01
    """Standard deviation of a depth [m]."""
    imu: ImuErrors = ImuErrors()
    ready_position: float = 0.04
    """Largest variance of a position with which the estimator is ready [m²]."""
    ready_yaw: float = 0.03
    """Largest variance of yaw with which the estimator is ready [rad²]."""
    aids: Aids | None = None
    """Errors of Doppler log and compass; None without them. With them the position drifts between fixes, as its
    covariance states, and is ready up to `largest_variance`."""

    @property
    def decay(self) -> float:
        """Rate at which a held velocity decays [1/s]."""
        return math.log(2.0) / self.half_life


LOST = 100.0
"""Standard deviation per axis beyond which a vehicle that navigates by log and compass is lost [m]."""


@dataclass(frozen=True)
class Site:
    """Parameters of pool and vehicle that the fusion needs."""

    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Unit normal of the still surface, upwards, pool frame."""
    offset: float = 0.0
    """Offset of the height: a point p is up . p + offset above the surface [m]."""
    depth_port: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Pressure port, body frame [m]."""
    imu: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Accelerometer, body frame [m]."""
    dvl: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Doppler log, body frame [m]."""
    gravity: float = 9.81
    """Acceleration of gravity [m/s²]."""
    R_wp: tuple[tuple[float, float, float], ...] = field(default=((1, 0, 0), (0, 1, 0), (0, 0, 1)))
    """Rotation matrix from pool axes to world axes, for velocities in the report."""


def site_of(pool: Pool | None, vehicle: Vehicle) -> Site:
    """Return the site of a pool file and a vehicle file; without a pool file the pool frame is the world frame.

    Heights are measured from the water plane, tilt included, if that plane is a surface; if it is a wall, from
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
    """Return settings with the vehicle file's sensor noise, bounded below by default values that cover
    mounting and sampling."""
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
