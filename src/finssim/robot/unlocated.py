"""What a vehicle knows of itself without a camera: attitude and rates, no position. Enough for a person who drives."""

from __future__ import annotations

from typing import Any

import numpy as np

from finssim.geometry.rotations import quat_conjugate, quat_multiply, quat_to_matrix
from finssim.robot.messages import NavigationAid, Picture, Telemetry
from finssim.robot.robot import Reading
from finssim.vehicles import Vehicle

__all__ = ["Unlocated"]


class Unlocated:
    """In place of `Perception` where there is no pool file: never ready, so that no pilot that needs a state acts."""

    def __init__(self, vehicle: Vehicle) -> None:
        self.vehicle = vehicle
        imu = vehicle.sensors.imu
        self._q_body_imu = np.array(imu.orientation if imu is not None else (0.0, 0.0, 0.0, 1.0))
        self._R_body_imu = quat_to_matrix(self._q_body_imu)
        self._quaternion = np.array([0.0, 0.0, 0.0, 1.0])
        self._nu = np.full(6, np.nan)

    def telemetry(self, now: float, telemetry: Telemetry, time: float) -> None:
        """Take attitude and rates; what is not finite is passed over.

        Args:
            now: When it came [s].
            telemetry: As it was decoded.
            time: When it was measured, the vehicle's clock mapped to ours [s].
        """
        q, gyro = np.array(telemetry.quaternion), self._R_body_imu @ telemetry.gyro
        if np.isfinite(q).all() and np.isfinite(gyro).all():
            self._quaternion = quat_multiply(q, quat_conjugate(self._q_body_imu))
            self._nu[3:] = gyro

    def aid(self, arrival: float, aid: NavigationAid) -> None:
        """Nothing is located, so nothing is aided."""

    def picture(self, now: float, picture: Picture) -> Any:
        """Pictures say nothing without a pool file."""
        return None

    def reading(self, now: float) -> Reading:
        """Attitude and rates at a time [s]; position and velocity are NaN."""
        return Reading(
            time=now,
            position=np.full(3, np.nan),
            quaternion=self._quaternion.copy(),
            nu=self._nu.copy(),
            ready=False,
            mode="uninitialized",
            reason="driven without localization",
        )
