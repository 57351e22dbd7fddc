"""Telemetry as samples for the estimator: body axes, times of measurement, no sample twice, nothing that has frozen."""

from __future__ import annotations

import math
from collections.abc import Hashable

import numpy as np

from finssim.geometry.rotations import quat_to_matrix
from finssim.localization.fusion.streams import (
    DepthSample,
    HeadingSample,
    ImuSample,
    Sample,
    VelocitySample,
    VisionSample,
)
from finssim.robot.messages import HEADING, POSE, POSITION, VELOCITY, NavigationAid, Telemetry
from finssim.vehicles import Vehicle

__all__ = ["Aboard", "Stuck"]

Three = tuple[float, float, float]

FASTEST, STRONGEST, DEEPEST = 100.0, 1000.0, 1.0e4
"""Rates [rad/s], specific forces [m/s²] and depths [m] beyond these are no measurements."""
POSITION_STD, YAW_STD = 0.5, 0.1
"""Of a fix that does not tell its own [m, rad]."""
IMU_STUCK, DEPTH_STUCK = 0.2, 1.0
"""A sensor that has noise and repeats one value for this long has frozen [s]."""


class Stuck:
    """Notices that a source says the same thing for too long."""

    def __init__(self, longest: float) -> None:
        """
        Args:
            longest: Time for which a live source may repeat itself [s]; inf: for ever.
        """
        self.longest = longest
        self._value: Hashable = None
        self._since = math.nan

    def look(self, value: Hashable, time: float) -> bool:
        """Whether the source has frozen, now that it says this.

        Args:
            value: What it says.
            time: When it said so [s].
        """
        if value != self._value or time < self._since:
            self._value, self._since = value, time
        return time - self._since > self.longest


class Aboard:
    """The sensors aboard one vehicle. The methods return a sample, or in a word why there is none ("" for no news)."""

    def __init__(self, vehicle: Vehicle) -> None:
        """
        Args:
            vehicle: Its sensors' mounting, rates, latencies and noise.
        """
        imu, depth = vehicle.sensors.imu, vehicle.sensors.depth
        R = quat_to_matrix(imu.orientation if imu else (0.0, 0.0, 0.0, 1.0))
        log = vehicle.sensors.dvl
        self._R_bl = quat_to_matrix(log.orientation if log else (0.0, 0.0, 0.0, 1.0))
        self._R_bs = tuple(tuple(row) for row in R.tolist())
        self._imu_latency = imu.latency if imu else 0.0
        self._depth_latency = depth.latency if depth else 0.0
        self._depth_period = 1.0 / depth.rate if depth else 0.05
        noisy = imu is not None and imu.gyro_noise_density * math.sqrt(imu.rate) > 0.5 * imu.gyro_quantisation
        self._imu_stuck = Stuck(IMU_STUCK if noisy else math.inf)
        noisy = depth is not None and depth.noise_std > 0.5 * depth.quantisation
        self._depth_stuck = Stuck(DEPTH_STUCK if noisy else math.inf)
        self._depth, self._depth_time = math.nan, -math.inf

    def imu(self, telemetry: Telemetry, time: float, arrival: float) -> ImuSample | str:
        """The angular rate, specific force and tilt of a telemetry.

        Args:
            telemetry: As it came.
            time: When it was sent, robot's clock [s].
            arrival: When it came [s].
        """
        gyro, accel = telemetry.gyro, telemetry.accel
        if not (_within(gyro, FASTEST) and _within(accel, STRONGEST)):
            return "implausible"
        if self._imu_stuck.look((gyro, accel), time):
            return "frozen"
        omega, force = self.to_body(gyro), self.to_body(accel)
        return ImuSample(time - self._imu_latency, omega, force, self.tilt(telemetry), arrival)

    def depth(self, telemetry: Telemetry, time: float, arrival: float) -> DepthSample | str:
        """The depth, once each time that it was measured: telemetry repeats it until there is a new one.

        Args:
            telemetry: As it came.
            time: When it was sent, robot's clock [s].
            arrival: When it came [s].
        """
        depth = telemetry.depth
        if not abs(depth) <= DEEPEST:
            return "implausible"
        if self._depth_stuck.look(depth, time):
            return "frozen"
        waited = time - self._depth_time
        # The same value may have been measured again; half a period lets a jittery sensor be early.
        if 0.0 <= waited < (0.5 if depth != self._depth else 1.0) * self._depth_period - 1e-6:
            return ""
        self._depth, self._depth_time = depth, time
        return DepthSample(time - self._depth_latency, depth, arrival)

    def aid(self, aid: NavigationAid, arrival: float) -> Sample | str:
        """The sample of a navigation aid, or in a word why there is none.

        Args:
            aid: As it came.
            arrival: When it came [s].
        """
        time = arrival - max(aid.age, 0.0)
        x, y, z = aid.values
        if aid.kind == VELOCITY:
            velocity = self._R_bl @ np.array(aid.values)
            if not _within(aid.values, FASTEST):
                return "implausible"
            return VelocitySample(time, (velocity[0], velocity[1], velocity[2]), arrival)
        if aid.kind == HEADING:
            return HeadingSample(time, math.remainder(x, math.tau), arrival)
        if aid.kind not in (POSITION, POSE):
            return "unknown aid"
        std, turn = aid.std[0] or POSITION_STD, aid.std[1] or YAW_STD
        rows = ((std**2, 0.0, 0.0), (0.0, std**2, 0.0), (0.0, 0.0, turn**2))
        return VisionSample(time, (x, y), z if aid.kind == POSE else None, rows, arrival)

    def to_body(self, vector_s: Three) -> Three:
        """A vector of the IMU's frame in body axes."""
        x, y, z = vector_s
        a, b, c = self._R_bs
        return (
            a[0] * x + a[1] * y + a[2] * z,
            b[0] * x + b[1] * y + b[2] * z,
            c[0] * x + c[1] * y + c[2] * z,
        )

    def tilt(self, telemetry: Telemetry) -> tuple[float, float] | None:
        """Roll and pitch of the body [rad], from what the attitude filter takes for upwards; None: it has none."""
        up = self._up(telemetry)
        return up and (math.atan2(up[1], up[2]), math.atan2(-up[0], math.hypot(up[1], up[2])))

    def yaw(self, telemetry: Telemetry) -> float:
        """Heading of the body's x axis by the attitude filter alone [rad], which drifts; NaN where it has none."""
        if self._up(telemetry) is None:
            return math.nan
        x, y, z, w = telemetry.quaternion
        # Columns of R_ls weighted with the body's x axis in the sensor's frame, which is the first row of R_bs.
        a, b, c = self._R_bs[0]
        east = a * (1.0 - 2.0 * (y * y + z * z)) + b * 2.0 * (x * y - z * w) + c * 2.0 * (x * z + y * w)
        north = a * 2.0 * (x * y + z * w) + b * (1.0 - 2.0 * (x * x + z * z)) + c * 2.0 * (y * z - x * w)
        return math.atan2(north, east)

    def _up(self, telemetry: Telemetry) -> Three | None:
        x, y, z, w = telemetry.quaternion
        if not abs(x * x + y * y + z * z + w * w - 1.0) < 0.1:
            return None
        return self.to_body((2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)))


def _within(values: Three, bound: float) -> bool:
    """Whether all are numbers of at most that size."""
    return all(abs(v) <= bound for v in values)
