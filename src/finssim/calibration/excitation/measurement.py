"""What sensors make of a true motion: noise profiles for synthetic trials."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.excitation.recording import Recording
from finssim.geometry.rotations import (
    quat_from_euler,
    quat_inverse_rotate,
    quat_multiply,
    quat_rotate,
    quat_to_euler,
)
from finssim.physics.types import vec6
from finssim.sensors import SensorSuite
from finssim.vehicles import Vehicle

__all__ = ["NOISE_PROFILES", "NoiseProfile", "measure"]

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class NoiseProfile:
    """Errors of the measurements of a trial; standard deviations are per logged sample."""

    own_sensors: bool = False
    """IMU and depth as the vehicle file's sensors give them: rate, noise, bias, quantisation, latency, dropout."""
    velocity_std: float = 0.0
    """Of u, v, w from outside [m/s]."""
    attitude_std: float = 0.0
    """Of roll and pitch [rad]."""
    yaw_std: float = 0.0
    """[rad]"""
    position_std: float = 0.0
    """Of x, y, z [m]."""
    depth_std: float = 0.0
    """Where the vehicle's own sensor is not used [m]."""
    gyro_std: float = 0.0
    """Where the vehicle's own IMU is not used [rad/s]."""
    accel_std: float = 0.0
    """Where the vehicle's own IMU is not used [m/s²]."""
    velocity_window: float | None = None
    """u, v, w come from measured position, depth and attitude by local parabolas over this time [s], as an offline
    smoother makes them; `velocity_std` is then not used."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, float) and not (math.isfinite(value) and value >= 0.0):
                raise CalibrationError(f"noise: {field.name} is {value}, expected a finite number from 0 on")


NOISE_PROFILES: dict[str, NoiseProfile] = {
    "none": NoiseProfile(),
    "sensors": NoiseProfile(
        own_sensors=True, velocity_std=0.01, attitude_std=0.005, yaw_std=0.005, position_std=0.01
    ),
    "published": NoiseProfile(
        attitude_std=0.02,
        yaw_std=0.2,
        position_std=0.05,
        depth_std=0.05,
        gyro_std=0.1,
        accel_std=0.32,
        velocity_window=1.0,
    ),
}
"""`sensors`: the vehicle's own IMU and pressure sensor, and a velocity from outside of 1 cm/s; `published`: the fusion
settings that FinsROV's software was published with, which are larger than any noise; `none`: the truth."""


class _Recorded:
    """Arrays that a `SensorSuite` reads, filled from a recording."""

    def __init__(self, worlds: int) -> None:
        shape = (worlds, 1)
        self.position = wp.zeros(shape, dtype=wp.vec3, device="cpu")
        self.quaternion = wp.zeros(shape, dtype=wp.quat, device="cpu")
        self.velocity = wp.zeros(shape, dtype=vec6, device="cpu")
        self.acceleration = wp.zeros(shape, dtype=vec6, device="cpu")
        self.steps = wp.zeros(worlds, dtype=wp.int32, device="cpu")
        self.episode = wp.ones(worlds, dtype=wp.int32, device="cpu")

    def show(self, step: int, recording: Recording) -> None:
        """Put the state of one step there."""
        for name in ("position", "quaternion", "velocity", "acceleration"):
            getattr(self, name).numpy()[:, 0] = getattr(recording, name)[step]
        self.steps.fill_(step)


def measure(
    recording: Recording, vehicle: Vehicle, noise: NoiseProfile, *, every: int, seed: int
) -> dict[str, Array]:
    """Measured columns of all worlds of a recording at every `every`-th step.

    Args:
        recording: The true motion.
        vehicle: Whose sensors measure.
        noise: Errors.
        every: Steps between rows.
        seed: Of all errors.

    Returns:
        Canonical column -> values (rows, worlds); NaN where a sensor had no new sample.
    """
    rng = np.random.default_rng(seed)
    nu = recording.velocity[::every].astype(float)
    q = recording.quaternion[::every].astype(float)
    x = recording.position[::every].astype(float)
    shape = nu.shape[:2]

    def error(std: float, *tail: int) -> Array:
        return std * rng.standard_normal((*shape, *tail))

    # Roll and pitch errors are about body axes, the yaw error about the world's vertical.
    tilt = quat_from_euler(error(noise.attitude_std), error(noise.attitude_std), 0.0)
    heading = quat_from_euler(0.0, 0.0, error(noise.yaw_std))
    q_measured = quat_multiply(heading, quat_multiply(q, tilt))
    x_measured = x + error(noise.position_std, 3)
    out: dict[str, Array] = {}
    for i, name in enumerate(("qx", "qy", "qz", "qw")):
        out[name] = q_measured[..., i]
    out |= dict(zip(("roll", "pitch", "yaw"), quat_to_euler(q_measured), strict=True))
    for i, name in enumerate("xyz"):
        out[name] = x_measured[..., i]
    out |= _own_sensors(recording, vehicle, noise, every, seed)
    if "depth" not in out:
        at = vehicle.sensors.depth.position if vehicle.sensors.depth else np.zeros(3)
        out["depth"] = -(x + quat_rotate(q, np.broadcast_to(at, x.shape)))[..., 2] + error(noise.depth_std)
    if "p" not in out:
        rates = nu[..., 3:] + error(noise.gyro_std, 3)
        force = _specific_force(recording, vehicle, every) + error(noise.accel_std, 3)
        out |= {name: rates[..., i] for i, name in enumerate("pqr")}
        out |= {f"a{name}": force[..., i] for i, name in enumerate("xyz")}
    if noise.velocity_window is None:
        velocity = nu[..., :3] + error(noise.velocity_std, 3)
    else:
        velocity = _from_position(x_measured, q_measured, noise.velocity_window, recording.step * every)
    return out | {name: velocity[..., i] for i, name in enumerate("uvw")}


def _own_sensors(
    recording: Recording, vehicle: Vehicle, noise: NoiseProfile, every: int, seed: int
) -> dict[str, Array]:
    """IMU and depth through the vehicle's own sensors: at each row the newest sample since the last."""
    if not noise.own_sensors:
        return {}
    steps, worlds = recording.velocity.shape[:2]
    state = _Recorded(worlds)
    suite = SensorSuite(vehicle, worlds=worlds, control_step=recording.step, seed=seed)
    rows = len(range(0, steps, every))
    gyro, accel = np.full((rows, worlds, 3), np.nan), np.full((rows, worlds, 3), np.nan)
    depth = np.full((rows, worlds), np.nan)
    for step in range((rows - 1) * every + 1):
        state.show(step, recording)
        (suite.reset if step == 0 else suite.update)(state)
        row = -(-step // every)
        if suite.imu is not None:
            fresh = suite.imu.fresh.numpy()[:, 0]
            gyro[row, fresh] = suite.imu.gyro.numpy()[fresh, 0]
            accel[row, fresh] = suite.imu.accel.numpy()[fresh, 0]
        if suite.depth is not None:
            fresh = suite.depth.fresh.numpy()[:, 0]
            depth[row, fresh] = suite.depth.depth.numpy()[fresh, 0]
    out: dict[str, Array] = {}
    if vehicle.sensors.imu is not None:
        q_bs = np.broadcast_to(vehicle.sensors.imu.orientation, (rows, worlds, 4))
        gyro, accel = quat_rotate(q_bs, gyro), quat_rotate(q_bs, accel)
        out |= {name: gyro[..., i] for i, name in enumerate("pqr")}
        out |= {f"a{name}": accel[..., i] for i, name in enumerate("xyz")}
    if vehicle.sensors.depth is not None:
        out["depth"] = depth
    return out


def _specific_force(recording: Recording, vehicle: Vehicle, every: int) -> Array:
    """What an ideal accelerometer at the IMU's place reads, body axes [m/s²]: see `finssim.sensors.imu`."""
    nu, nu_dot = recording.velocity[::every].astype(float), recording.acceleration[::every].astype(float)
    q = recording.quaternion[::every].astype(float)
    imu = vehicle.sensors.imu
    r = np.broadcast_to(imu.position if imu else np.zeros(3), nu[..., :3].shape)
    omega = nu[..., 3:]
    a = nu_dot[..., :3] + np.cross(omega, nu[..., :3])
    a = a + np.cross(nu_dot[..., 3:], r) + np.cross(omega, np.cross(omega, r))
    up = quat_inverse_rotate(q, np.broadcast_to([0.0, 0.0, 1.0], r.shape))
    return np.asarray(a + vehicle.water.gravity * up)


def _from_position(x: Array, q: Array, window: float, interval: float) -> Array:
    """Body velocity from measured positions and attitudes by local parabolas over a window [m/s]."""
    from scipy.signal import savgol_filter

    n = max(3, 2 * round(0.5 * window / interval) + 1)
    n = min(n, len(x) - 1 + len(x) % 2)
    v = savgol_filter(x, n, 2, deriv=1, delta=interval, axis=0, mode="interp")
    # q and -q are one attitude: choose signs so that the numbers do not jump, also after a whole turn.
    jump = np.where(np.sum(q[1:] * q[:-1], axis=-1, keepdims=True) < 0.0, -1.0, 1.0)
    q = np.concatenate([q[:1], q[1:] * np.cumprod(jump, axis=0)])
    smooth = savgol_filter(q, n, 2, axis=0, mode="interp")
    smooth = smooth / np.linalg.norm(smooth, axis=-1, keepdims=True)
    return np.asarray(quat_inverse_rotate(smooth, v))
