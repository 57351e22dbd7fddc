"""What perfect instruments of a simulated vehicle would show."""

from __future__ import annotations

import numpy as np

from finssim.geometry.rotations import quat_conjugate, quat_multiply, quat_rotate, quat_to_matrix
from finssim.robot.messages import Telemetry
from finssim.robot.reading import Reading
from finssim.sensors.depth import ATMOSPHERE
from finssim.vehicles import Vehicle

__all__ = ["IdealSensors"]

IDENTITY = (0.0, 0.0, 0.0, 1.0)


class IdealSensors:
    """Inertial unit and pressure port at their mounts, without noise; velocities at the IMU are those of the origin."""

    def __init__(self, vehicle: Vehicle) -> None:
        imu, depth = vehicle.sensors.imu, vehicle.sensors.depth
        self._q_bs = np.array(imu.orientation if imu is not None else IDENTITY)
        self._port = np.array(depth.position if depth is not None else (0.0, 0.0, 0.0))
        self._water = vehicle.water
        self.reset()

    def reset(self) -> None:
        """The vehicle was put elsewhere."""
        self._velocity: np.ndarray | None = None
        self._count = 0

    def sample(self, reading: Reading, step: float) -> Telemetry:
        """The instruments after a step [s]; the specific force is the mean over the step."""
        q, gravity = reading.quaternion, self._water.gravity
        velocity = np.asarray(quat_rotate(q, reading.nu[:3]))
        before, self._velocity = self._velocity, velocity
        force = np.array([0.0, 0.0, gravity])
        if before is not None:
            force = force + (velocity - before) / step
        R_sw = quat_to_matrix(quat_multiply(q, self._q_bs)).T
        R_sb = quat_to_matrix(quat_conjugate(self._q_bs))
        depth = -float(reading.position[2] + np.asarray(quat_rotate(q, self._port))[2])
        self._count += 1
        return Telemetry(
            sequence=self._count & 0xFFFF,
            mcu_ms=round(1e3 * reading.time) & 0xFFFFFFFF,
            quaternion=tuple(np.asarray(quat_multiply(q, self._q_bs), float).tolist()),
            gyro=tuple((R_sb @ reading.nu[3:]).tolist()),
            accel=tuple((R_sw @ force).tolist()),
            depth=depth,
            pressure=ATMOSPHERE + self._water.density * gravity * depth,
            flags=0,
            motor_rpm=None,
        )
