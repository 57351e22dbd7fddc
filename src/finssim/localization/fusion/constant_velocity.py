"""Published filters: position and velocity at constant velocity (paper, eq. 14), and yaw from the gyro (eq. 15)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from finssim.core.rotations import quat_from_euler, quat_to_matrix
from finssim.localization.fusion import attitude, position_filter
from finssim.localization.fusion.attitude import (
    Tilt,
    TiltGains,
    YawState,
    follow,
    height_above_origin,
    roll_pitch,
    tilt_from,
    yaw_rate,
)
from finssim.localization.fusion.fuse_settings import Settings, Site
from finssim.localization.fusion.position_filter import PositionState
from finssim.localization.fusion.sensors import GYRO_HOLD, Filter, FilterMemory, Prediction, motion_of, steps
from finssim.localization.fusion.streams import ImuSample, Outcome, PoseEstimate, Sample, changed

Array = npt.NDArray[np.float64]

YAW_CAP = 10.0
"""Largest variance of yaw [rad²]: far above that of an unknown heading."""
STEEPEST = math.radians(80.0)
"""Pitch beyond which no yaw rate is computed from the gyro [rad]."""
ACCEPTED, STEEP = (Outcome("imu", "accepted"),), (Outcome("imu", "steep"),)
_H_XY, _H_YAW = np.eye(6)[:2], np.eye(2)[:1]


@dataclass(frozen=True, kw_only=True)
class PlaneTrack(FilterMemory):
    """State of the position and yaw filters, whose errors are independent, with the filter memory."""

    position: PositionState
    yaw: YawState
    position_time: float = math.nan
    """Time of the position [s]; IMU samples advance only yaw."""
    yaw_time: float = math.nan
    """Time of the yaw [s]."""
    rate: float | None = None
    """Latest yaw rate [rad/s]."""
    roll: float = 0.0
    """Latest roll [rad]."""
    pitch: float = 0.0
    """Latest pitch [rad]."""
    tilt: Tilt | None = None
    """State of the tilt filter, for an IMU without an orientation."""
    compass: bool = False
    """True if yaw comes from a compass, including its offset."""


class ConstantVelocity(Filter[PlaneTrack]):
    """Constant-velocity position filter with a separate yaw filter."""

    gate_of: ClassVar[Mapping[str, str | None]] = {"heading": "yaw", "velocity": None}
    """Gate of each sensor: headings use that of yaw, since their offset is not estimated; Doppler velocities
    are always accepted."""

    def __init__(self, settings: Settings, site: Site) -> None:
        """
        Args:
            settings: Settings of the estimator.
            site: Parameters of pool and vehicle.
        """
        super().__init__(settings, site)
        self._H_height = np.array([[*site.up, 0.0, 0.0, 0.0]])
        self._motions = {(xy, z): motion_of(settings, xy, z) for xy in (False, True) for z in (False, True)}

    def start(self) -> PlaneTrack:
        """Return the track before the first sample."""
        s = self.settings
        P = np.diag([s.largest_variance] * 3 + [s.speed_std**2] * 3)
        yaw = YawState(0.0, 0.0, YAW_CAP, 0.0, s.imu.gyro_bias_std**2)
        return PlaneTrack(position=PositionState(np.zeros(6), P), yaw=yaw)

    def imu(self, track: PlaneTrack, sample: ImuSample) -> tuple[PlaneTrack, tuple[Outcome, ...]]:
        """Return the track with its tilt updated and yaw advanced to the time of the sample."""
        dt = math.inf if track.imu_time is None else sample.time - track.imu_time
        roll, pitch, tilt = self._tilted(track, sample, dt)
        steep = abs(pitch) > STEEPEST
        rate = None if steep else yaw_rate(sample.omega[1], sample.omega[2], roll, pitch)
        yaw = self._yaw_at(track, sample.time)
        if track.rate is not None and rate is not None and dt <= GYRO_HOLD:
            # So far the older rate was held; adding half the difference gives the trapezoidal rule.
            yaw = changed(yaw, yaw=yaw.yaw + 0.5 * (rate - track.rate) * dt)
        track = changed(
            track,
            roll=roll,
            pitch=pitch,
            tilt=tilt,
            yaw=yaw,
            yaw_time=sample.time,
            rate=rate,
            imu_time=sample.time,
        )
        return track, STEEP if steep else ACCEPTED

    def update(
        self, track: PlaneTrack, name: str, sample: Sample, reading: Array
    ) -> tuple[PlaneTrack, Outcome]:
        """Return the track after a sensor's reading (m,), and the gate's verdict.

        The reading has the unit of the sensor.
        """
        track, outcome = super().update(track, name, sample, reading)
        if name == "heading" and self.settings.aids is not None:
            # The compass's offset is common to all samples: averaging does not reduce it.
            least = self.settings.aids.heading_bias**2
            if track.yaw.variance < least:
                track = changed(track, yaw=changed(track.yaw, variance=least))
        if name in ("yaw", "heading") and outcome.used and track.compass != (name == "heading"):
            track = changed(track, compass=not track.compass)
        return track, outcome

    def position(self, track: PlaneTrack) -> Prediction:
        """Predict x and y of the body origin, pool frame [m]."""
        return Prediction(track.position.x[:2], _H_XY, part="position")

    def height(self, track: PlaneTrack) -> Prediction:
        """Predict the height of the pressure port above the surface [m]."""
        lever = height_above_origin(self.site.depth_port, track.roll, track.pitch)
        height = self._H_height @ track.position.x + (self.site.offset + lever)
        return Prediction(height, self._H_height, part="position")

    def yaw(self, track: PlaneTrack) -> Prediction:
        """Predict yaw, pool frame [rad]."""
        return Prediction(np.array([track.yaw.yaw]), _H_YAW, part="yaw")

    def heading(self, track: PlaneTrack) -> Prediction | str:
        """Predict the reading of a compass, pool frame [rad]."""
        if self.settings.aids is None:
            return "no compass"
        return self.yaw(track)._replace(extra_variance=self.settings.aids.heading_bias**2)

    def velocity(self, track: PlaneTrack) -> Prediction | str:
        """Predict the reading of a Doppler log, body frame [m/s], at the body origin and with the present heading."""
        if "yaw" not in track.seen or self.settings.aids is None:
            return "no heading"
        H = np.zeros((3, 6))
        H[:, 3:] = quat_to_matrix(quat_from_euler(track.roll, track.pitch, track.yaw.yaw)).T
        offset = self.settings.aids.velocity_bias**2 * np.eye(3)
        return Prediction(H @ track.position.x, H, offset, track.yaw.variance, part="position")

    def restarted(self, track: PlaneTrack, axes: list[int], step: Array, R: Array) -> PlaneTrack:
        """Restart position axes at a measurement, `step` [m] from the estimate, with covariance `R` [m²]."""
        state, speed = track.position, self.settings.speed_std
        return changed(track, position=position_filter.restarted(state, axes, state.x[axes] + step, R, speed))

    def turned(self, track: PlaneTrack, angle: float, variance: float) -> PlaneTrack:
        """Restart yaw at a measurement, `angle` [rad] from the estimate, with variance `variance` [rad²]."""
        yaw = attitude.restarted(track.yaw, track.yaw.yaw + angle, variance, self.settings.imu.gyro_bias_std)
        return changed(track, yaw=yaw)

    def estimate(self, track: PlaneTrack, time: float) -> PoseEstimate:
        """Return the estimate at a time [s], or at the track's own time if later; unknown values are NaN."""
        track, seen = self.advanced(track, time), track.seen
        x, P, yaw = track.position.x.copy(), track.position.P.copy(), track.yaw
        unknown = ([] if "vision" in seen else [0, 1, 3, 4]) + ([] if "depth" in seen else [2, 5])
        if unknown:
            x[unknown] = math.nan
            P[unknown, :] = math.nan
            P[:, unknown] = math.nan
        has_yaw, has_imu = "yaw" in seen, track.imu_time is not None
        return PoseEstimate(
            time=time,
            x=x,
            P=P,
            yaw=yaw.yaw if has_yaw else math.nan,
            yaw_variance=yaw.variance + track.extra_variance("yaw") if has_yaw else math.nan,
            yaw_rate=track.rate - yaw.bias if track.rate is not None and track.heard(time) else math.nan,
            roll=track.roll if has_imu else math.nan,
            pitch=track.pitch if has_imu else math.nan,
            **track.times(),
        )

    def tilt(self, track: PlaneTrack) -> tuple[float, float]:
        """Return roll and pitch of a track [rad]."""
        return track.roll, track.pitch

    def _tilted(self, track: PlaneTrack, sample: ImuSample, dt: float) -> tuple[float, float, Tilt | None]:
        """Return roll and pitch after a sample, from the IMU's orientation or from gyro and accelerometer,
        and the tilt filter's state."""
        if sample.tilt is not None:
            return sample.tilt[0], sample.tilt[1], None
        force = np.full(3, math.nan) if sample.force is None else np.array(sample.force)
        gains = TiltGains(gravity=self.site.gravity)
        if track.tilt is not None and dt <= gains.longest_gap:
            tilt = follow(track.tilt, np.array(sample.omega), force, dt, gains)
        elif sample.force is not None and float(np.linalg.norm(force)) > 1.0:
            tilt = tilt_from(force)
        else:
            return track.roll, track.pitch, track.tilt
        roll, pitch = roll_pitch(tilt.up)
        return float(roll), float(pitch), tilt

    def advanced(self, track: PlaneTrack, time: float) -> PlaneTrack:
        """Return the track advanced to a time [s]; never to an earlier one."""
        # max returns its first argument if the second is NaN: no sample yet.
        return changed(
            track,
            position=self._position_at(track, time),
            yaw=self._yaw_at(track, time),
            position_time=max(time, track.position_time),
            yaw_time=max(time, track.yaw_time),
        )

    def _position_at(self, track: PlaneTrack, time: float) -> PositionState:
        """Return the position at a time; the velocity of axes without measurements decays, then is zero."""
        s, then, position = self.settings, track.position_time, track.position
        if math.isnan(then) or time <= then:
            return position
        aided, dived = track.aided, track.seen.get("depth", -math.inf)
        for dt, middle in steps(
            then, time, (aided + s.ages.coast, aided + s.ages.hold, dived + s.ages.coast, dived + s.ages.hold)
        ):
            blind, deaf = middle - aided, middle - dived
            still = ([0, 1] if blind > s.ages.hold else []) + ([2] if deaf > s.ages.hold else [])
            if still:
                position = position_filter.frozen(position, still)
            position = position_filter.predict(
                position, dt, self._motions[blind > s.ages.coast, deaf > s.ages.coast]
            )
        return position_filter.capped(position, s.largest_variance)

    def _yaw_at(self, track: PlaneTrack, time: float) -> YawState:
        """Return yaw at a time: the latest rate is held for at most `GYRO_HOLD`, then yaw stays constant."""
        s, then, yaw = self.settings, track.yaw_time, track.yaw
        if math.isnan(then) or time <= then:
            return yaw
        until = -math.inf if track.imu_time is None or track.rate is None else track.imu_time + GYRO_HOLD
        for dt, middle in steps(then, time, (until,)):
            if track.rate is not None and middle < until:
                yaw = attitude.predict(yaw, track.rate, dt, s.imu.gyro)
            else:
                yaw = attitude.predict(yaw, yaw.bias, dt, replace(s.imu.gyro, rate=s.imu.blind_rate))
        return attitude.capped(yaw, YAW_CAP) if yaw.variance > YAW_CAP else yaw
