"""The motor controller's attitude filter: gyroscope integrated, tilt from the accelerometer, yaw left to drift."""

from __future__ import annotations

import math

__all__ = ["AttitudeFilter"]

Three = tuple[float, float, float]


class AttitudeFilter:
    """Complementary filter on the rotation group (Mahony, Hamel and Pflimlin 2008, explicit form), without a compass.

    With up the accelerometer's direction and R the estimate: e = up × Rᵀ z, b_dot = -ki e, q_dot = ½ q (ω - b + kp e).
    Plain floats: at this size NumPy would cost ten times as much.
    """

    def __init__(self, gain: float, integral: float, gravity: float) -> None:
        """Start without a sample.

        Args:
            gain: kp [1/s].
            integral: ki [1/s²].
            gravity: [m/s²]; specific forces far from it are not used.
        """
        self.gain, self.integral, self.gravity = gain, integral, gravity
        self.bias: Three = (0.0, 0.0, 0.0)
        """Of the gyroscope, as estimated [rad/s]; its vertical part cannot be seen and stays about 0."""
        self._q: tuple[float, float, float, float] | None = None

    @property
    def quaternion(self) -> tuple[float, float, float, float]:
        """IMU frame to level world, xyzw; identity before the first sample."""
        w, x, y, z = self._q or (1.0, 0.0, 0.0, 0.0)
        return x, y, z, w

    def update(self, gyro: Three, accel: Three, dt: float) -> None:
        """Take one sample.

        Args:
            gyro: IMU frame [rad/s].
            accel: Specific force, IMU frame [m/s²].
            dt: Since the last [s].
        """
        if self._q is None:
            self._q = _level(accel)
            return
        w, x, y, z = self._q
        p, q, r = (rate - bias for rate, bias in zip(gyro, self.bias, strict=True))
        length = math.sqrt(accel[0] ** 2 + accel[1] ** 2 + accel[2] ** 2)
        if 0.7 * self.gravity < length < 1.3 * self.gravity:
            ax, ay, az = accel[0] / length, accel[1] / length, accel[2] / length
            ux, uy, uz = 2.0 * (x * z - w * y), 2.0 * (w * x + y * z), w * w - x * x - y * y + z * z
            ex, ey, ez = ay * uz - az * uy, az * ux - ax * uz, ax * uy - ay * ux
            k = self.integral * dt
            self.bias = (self.bias[0] - k * ex, self.bias[1] - k * ey, self.bias[2] - k * ez)
            p, q, r = p + self.gain * ex, q + self.gain * ey, r + self.gain * ez
        h = 0.5 * dt
        w, x, y, z = (
            w + h * (-x * p - y * q - z * r),
            x + h * (w * p + y * r - z * q),
            y + h * (w * q - x * r + z * p),
            z + h * (w * r + x * q - y * p),
        )
        norm = math.sqrt(w * w + x * x + y * y + z * z)
        self._q = (w / norm, x / norm, y / norm, z / norm)


def _level(accel: Three) -> tuple[float, float, float, float]:
    """Attitude at yaw 0 in which a specific force points upwards, wxyz."""
    roll = math.atan2(accel[1], accel[2])
    pitch = math.atan2(-accel[0], math.hypot(accel[1], accel[2]))
    cr, sr, cp, sp = math.cos(roll / 2), math.sin(roll / 2), math.cos(pitch / 2), math.sin(pitch / 2)
    return cr * cp, sr * cp, cr * sp, -sr * sp
