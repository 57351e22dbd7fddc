"""The state for a controller, from telemetry and pictures. Invalid data are counted and never raise an exception."""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from finssim.core.rotations import (
    matrix_to_quat,
    quat_conjugate,
    quat_from_euler,
    quat_inverse_rotate,
    quat_multiply,
    quat_rotate,
    quat_to_matrix,
    wrap_angle,
)
from finssim.localization.detection.detections import Detection, Frame
from finssim.localization.detection.detector import RegionTracker, detector
from finssim.localization.fusion.attitude import height_above_origin
from finssim.localization.fusion.estimator import Estimator, Fixes, Health, health_of
from finssim.localization.fusion.fuse_settings import Settings, settings_of, site_of
from finssim.localization.fusion.streams import (
    DepthSample,
    HeadingSample,
    ImuSample,
    PoseEstimate,
    Sample,
    VelocitySample,
    VisionSample,
)
from finssim.localization.overhead_camera import Pool
from finssim.localization.poses import axes_of_up
from finssim.localization.poses.methods import TagLocator
from finssim.robot.messages import (
    HEADING,
    POSE,
    POSITION,
    POSITION_STD,
    VELOCITY,
    YAW_STD,
    NavigationAid,
    Picture,
    Telemetry,
)
from finssim.robot.reading import Reading
from finssim.vehicles import Vehicle

# Telemetry as samples for the estimator: body axes, times of measurement, no duplicates, no frozen sensors.


Three = tuple[float, float, float]

FASTEST, STRONGEST, DEEPEST = 100.0, 1000.0, 1.0e4
"""Greatest plausible rates [rad/s], specific forces [m/s²] and depths [m]."""
IMU_STUCK, DEPTH_STUCK = 0.2, 1.0
"""Time after which a noisy sensor that repeats one value counts as frozen [s]."""


class Stuck:
    """Detector of a source that repeats the same value for too long."""

    def __init__(self, longest: float) -> None:
        """Start without a value.

        Args:
            longest: Time for which a working source may repeat itself [s]; inf: without limit.
        """
        self.longest = longest
        self._value: Hashable = None
        self._since = math.nan

    def look(self, value: Hashable, time: float) -> bool:
        """Note a value, and return whether the source has frozen.

        Args:
            value: Value of the source.
            time: Time of the value [s].
        """
        if value != self._value or time < self._since:
            self._value, self._since = value, time
        return time - self._since > self.longest


class VehicleSensors:
    """The sensors aboard one vehicle. The methods return a sample, or in a word why there is none ("" if there is
    no news)."""

    def __init__(self, vehicle: Vehicle) -> None:
        """Read the properties of the sensors.

        Args:
            vehicle: Vehicle with the mounting, rates, latencies and noise of its sensors.
        """
        imu, depth = vehicle.sensors.imu, vehicle.sensors.depth
        R = quat_to_matrix(imu.orientation if imu else (0.0, 0.0, 0.0, 1.0))
        log = vehicle.sensors.dvl
        self._R_bl = quat_to_matrix(log.orientation if log else (0.0, 0.0, 0.0, 1.0))
        self._R_bs = R
        self._imu_latency = imu.latency if imu else 0.0
        self._depth_latency = depth.latency if depth else 0.0
        self._depth_period = 1.0 / depth.rate if depth else 0.05
        noisy = imu is not None and imu.gyro_noise_density * math.sqrt(imu.rate) > 0.5 * imu.gyro_quantisation
        self._imu_stuck = Stuck(IMU_STUCK if noisy else math.inf)
        noisy = depth is not None and depth.noise_std > 0.5 * depth.quantisation
        self._depth_stuck = Stuck(DEPTH_STUCK if noisy else math.inf)
        self._depth, self._depth_time = math.nan, -math.inf

    def imu(self, telemetry: Telemetry, time: float, arrival: float) -> ImuSample | str:
        """Return angular rate, specific force and tilt of a telemetry message.

        Args:
            telemetry: The message.
            time: Time of sending, robot's clock [s].
            arrival: Time of arrival [s].
        """
        gyro, accel = telemetry.gyro, telemetry.accel
        if not (_within(gyro, FASTEST) and _within(accel, STRONGEST)):
            return "implausible"
        if self._imu_stuck.look((gyro, accel), time):
            return "frozen"
        omega, force = self.to_body(gyro), self.to_body(accel)
        return ImuSample(time - self._imu_latency, omega, force, self.tilt(telemetry), arrival)

    def depth(self, telemetry: Telemetry, time: float, arrival: float) -> DepthSample | str:
        """Return the depth, once per measurement: telemetry repeats it until there is a new one.

        Args:
            telemetry: The message.
            time: Time of sending, robot's clock [s].
            arrival: Time of arrival [s].
        """
        depth = telemetry.depth
        if not abs(depth) <= DEEPEST:
            return "implausible"
        if self._depth_stuck.look(depth, time):
            return "frozen"
        waited = time - self._depth_time
        # The same value may have been measured again; the factor of a half allows for jitter of the sensor.
        if 0.0 <= waited < (0.5 if depth != self._depth else 1.0) * self._depth_period - 1e-6:
            return ""
        self._depth, self._depth_time = depth, time
        return DepthSample(time - self._depth_latency, depth, arrival)

    def aid(self, aid: NavigationAid, arrival: float) -> Sample | str:
        """Return the sample of a navigation aid, or in a word why there is none.

        Args:
            aid: The received message.
            arrival: Time of arrival [s].
        """
        time = arrival - max(aid.age, 0.0)
        x, y, z = aid.values
        if aid.kind == VELOCITY:
            velocity = self._R_bl @ np.array(aid.values)
            if not _within(aid.values, FASTEST):
                return "implausible"
            return VelocitySample(time, (velocity[0], velocity[1], velocity[2]), arrival, aid.std[0])
        if aid.kind == HEADING:
            return HeadingSample(time, math.remainder(x, math.tau), arrival)
        if aid.kind not in (POSITION, POSE):
            return "unknown aid"
        std, turn = aid.std[0] or POSITION_STD, aid.std[1] or YAW_STD
        rows = ((std**2, 0.0, 0.0), (0.0, std**2, 0.0), (0.0, 0.0, turn**2))
        return VisionSample(time, (x, y), z if aid.kind == POSE else None, rows, arrival)

    def to_body(self, vector_s: Three) -> Three:
        """Return a vector of the IMU's frame in body axes; the unit is kept."""
        x, y, z = (self._R_bs @ vector_s).tolist()
        return x, y, z

    def tilt(self, telemetry: Telemetry) -> tuple[float, float] | None:
        """Return roll and pitch of the body [rad] from the attitude filter's vertical; None if it has no valid
        attitude."""
        if not _is_unit(telemetry.quaternion):
            return None
        x, y, z = self._R_bs @ quat_inverse_rotate(telemetry.quaternion, (0.0, 0.0, 1.0))
        return math.atan2(y, z), math.atan2(-x, math.hypot(y, z))

    def yaw(self, telemetry: Telemetry) -> float:
        """Return the heading of the body's x axis by the attitude filter alone [rad], which drifts; NaN if it is
        invalid."""
        if not _is_unit(telemetry.quaternion):
            return math.nan
        x, y, _ = quat_rotate(telemetry.quaternion, self._R_bs[0])
        return math.atan2(y, x)


def _is_unit(q: tuple[float, float, float, float]) -> bool:
    """Return whether a quaternion has about unit length."""
    return abs(math.hypot(*q) ** 2 - 1.0) < 0.1


def _within(values: Three, bound: float) -> bool:
    """Return whether all numbers have at most this magnitude."""
    return all(abs(v) <= bound for v in values)


# State without a filter, for the ablation "without EKF": the latest fix, the IMU's heading, differences as speeds.


Array = npt.NDArray[np.float64]

ALPHA = 0.35
"""Weight of a new difference in the speed (published velocity filter)."""
LONGEST = 0.5
"""Longest time over which a difference yields a speed [s]."""


@dataclass(frozen=True)
class _Axis:
    """The latest values of some coordinates, and their speeds."""

    value: Array
    speed: Array
    time: float = math.nan

    def after(self, value: Array, time: float) -> _Axis:
        """Return the axis after one more measurement, unless it is older."""
        if not math.isnan(self.time) and time <= self.time:
            return self
        step = time - self.time
        if not step <= LONGEST:
            return replace(self, value=value, speed=np.zeros(len(value)), time=time)
        speed = self.speed + ALPHA * ((value - self.value) / step - self.speed)
        return _Axis(value, speed, time)


class Unfused:
    """Position, velocity and heading in the pool frame directly from the sensors."""

    def __init__(self) -> None:
        self._xy = _Axis(np.full(2, math.nan), np.zeros(2))
        self._z = _Axis(np.full(1, math.nan), np.zeros(1))
        self._heading = math.nan
        self._offset = math.nan

    def heading(self, yaw: float) -> None:
        """Store the attitude filter's own heading [rad]."""
        if math.isfinite(yaw):
            self._heading = yaw

    def height(self, z: float, time: float) -> None:
        """Store the height of the body origin [m]."""
        if math.isfinite(z):
            self._z = self._z.after(np.array([z]), time)

    def fix(self, position: tuple[float, float], yaw: float | None, time: float) -> None:
        """Store a fix; the first one with a yaw determines the offset of the attitude filter's heading.

        Args:
            position: x, y of the body origin, pool frame [m].
            yaw: Left positive, pool frame [rad]; None if unknown.
            time: Middle of the exposure [s].
        """
        self._xy = self._xy.after(np.array(position), time)
        if math.isnan(self._offset) and yaw is not None:
            self._offset = yaw - self._heading

    @property
    def vision_time(self) -> float | None:
        """Time of the latest fix [s]; None before the first."""
        return None if math.isnan(self._xy.time) else self._xy.time

    @property
    def x(self) -> Array:
        """Position [m] and velocity [m/s], (6,); NaN if unknown."""
        return np.concatenate([self._xy.value, self._z.value, self._xy.speed, self._z.speed])

    @property
    def yaw(self) -> float:
        """Yaw [rad]; NaN before the first fix."""
        return float(wrap_angle(self._heading + self._offset))


# State of a vehicle without a camera: attitude and rates, no position. Sufficient for manual driving.


class Unlocated:
    """Replacement of `Perception` without a pool file: never ready, so that pilots that need a state do not act."""

    def __init__(self, vehicle: Vehicle) -> None:
        self.vehicle, self.let_in = vehicle, None
        imu = vehicle.sensors.imu
        self._q_body_imu = np.array(imu.orientation if imu is not None else (0.0, 0.0, 0.0, 1.0))
        self._R_body_imu = quat_to_matrix(self._q_body_imu)
        self._quaternion = np.array([0.0, 0.0, 0.0, 1.0])
        self._nu = np.full(6, np.nan)

    def telemetry(self, now: float, telemetry: Telemetry, time: float) -> None:
        """Store attitude and rates; messages that are not finite are ignored.

        Args:
            now: Time of arrival [s].
            telemetry: The decoded message.
            time: Time of measurement, on the robot's clock [s].
        """
        q, gyro = np.array(telemetry.quaternion), self._R_body_imu @ telemetry.gyro
        if np.isfinite(q).all() and np.isfinite(gyro).all():
            self._quaternion = quat_multiply(q, quat_conjugate(self._q_body_imu))
            self._nu[3:] = gyro

    def aid(self, arrival: float, aid: NavigationAid) -> None:
        """Ignore a navigation aid, since nothing is located. `arrival` is a time [s]."""

    def picture(self, now: float, picture: Picture) -> Any:
        """Ignore a picture, which cannot be evaluated without a pool file."""
        return None

    def reading(self, now: float) -> Reading:
        """Return attitude and rates at a time [s]; position and velocity are NaN."""
        return Reading(
            time=now,
            position=np.full(3, np.nan),
            quaternion=self._quaternion.copy(),
            nu=self._nu.copy(),
            ready=False,
            mode="uninitialized",
            reason="driven without localization",
        )


PICTURE_STUCK = 0.4
"""Time after which exactly constant corners count as one picture that is sent repeatedly [s]."""

LET_IN_STD = 0.05
"""Standard deviation of the initial position of a vehicle, per axis [m]."""
LET_IN_AFTER = 0.5
"""Time from the first request of the state until the initial position is used; by then there is inertial data [s]."""

JUMP = 1.0
"""Age relative to the newest data above which the sender's clock counts as set back [s]."""


class Perception:
    """State of one vehicle from its telemetry and other sources: an overhead camera, position fixes on the link, DVL
    and compass."""

    def __init__(
        self,
        vehicle: Vehicle,
        pool: Pool | None,
        *,
        method: str = "refractive",
        mode: str | None = None,
        fusion: bool = True,
        settings: Settings | None = None,
        let_in: Sequence[float] | None = None,
    ) -> None:
        """Set up the estimator.

        Args:
            vehicle: Vehicle with its tags and sensors.
            pool: Camera, water and frames; None without a camera: the pool frame is then the world frame.
            method: Method for position fixes from tags, a name of `localization.poses.methods.METHODS`.
            mode: Mode of the estimator: constant-velocity or error-state. None: error-state, which uses the
                accelerations of an IMU, for a vehicle with one, otherwise constant-velocity.
            fusion: False: no filter, for the ablation "without EKF" (`Unfused`).
            settings: Settings of the estimator; the vehicle file's noises if None.
            let_in: Initial x, y of the vehicle, world frame [m]: the single fix from which dead reckoning starts. None:
                another source provides the position.

        Raises:
            LocalizationError: Unknown method or mode; a vehicle without tags; a pool whose z is not up.
        """
        self.vehicle, self.pool = vehicle, pool
        self.fixes = (
            None
            if pool is None
            else Fixes(TagLocator(pool, vehicle.tags, method=method, pixel_std=pool.pixel_std))
        )
        mode = mode or ("constant-velocity" if vehicle.sensors.imu is None else "error-state")
        self.estimator = Estimator(settings or settings_of(vehicle), site_of(pool, vehicle), mode=mode)
        self.unfused = None if fusion else Unfused()
        self._aboard = VehicleSensors(vehicle)
        self._tracker: RegionTracker | None = None
        self._frame = _WorldFrame(pool, self.estimator.site.up)
        self._omega, self._omega_time = (math.nan,) * 3, -math.inf
        self._rate = math.nan
        self._pictures = Stuck(PICTURE_STUCK)
        self._last_picture = -math.inf
        self.let_in = None if let_in is None else (float(let_in[0]), float(let_in[1]))
        """Initial x, y of the vehicle, world frame [m]; None: not given."""
        self._let_in, self._asked_since = self.let_in, math.nan

    def telemetry(self, now: float, telemetry: Telemetry, time: float) -> None:
        """Process telemetry of the vehicle.

        Args:
            now: Time of arrival [s].
            telemetry: The decoded message.
            time: Time of measurement, on the robot's clock [s].
        """
        imu = self._aboard.imu(telemetry, time, now)
        if isinstance(imu, ImuSample):
            if self.estimator.put(imu) is None and not _older(imu.time, self._omega_time):
                self._omega, self._omega_time = imu.omega, imu.time
        else:
            self.estimator.refuse("imu", imu)
        if self.unfused is not None:
            self.unfused.heading(self._aboard.yaw(telemetry))
        depth = self._aboard.depth(telemetry, time, now)
        if isinstance(depth, DepthSample):
            self.estimator.put(depth)
            if self.unfused is not None:
                self.unfused.height(self._height(telemetry), depth.time)
        elif depth:
            self.estimator.refuse("depth", depth)

    def picture(self, now: float, picture: Picture) -> str:
        """Process a picture, or the tags detected in it.

        Returns:
            `accepted`, or the reason why there is no fix.
        """
        time = min(picture.time, now) if math.isfinite(picture.time) else math.nan
        if _older(time, self._last_picture):
            return self.estimator.refuse(
                "vision", "duplicate" if time == self._last_picture else "out of order"
            )
        detections = self._detections(picture, time)
        if detections is None:
            return self.estimator.refuse("vision", "not a picture of this camera")
        if math.isfinite(time):
            self._last_picture = time
        corners = tuple(tuple(d.corners.ravel().tolist()) for d in detections)
        if corners and self._pictures.look(corners, time):
            return self.estimator.refuse("vision", "frozen")
        assert self.fixes is not None  # detections is None without a pool
        fix = self.fixes.fix(Frame(time, "", tuple(detections)), self.estimator)
        if not isinstance(fix, VisionSample):
            return self.estimator.refuse("vision", fix)
        if self.unfused is not None:
            self.unfused.fix(fix.position, fix.yaw, fix.time)
        return self.estimator.add(fix)

    def aid(self, arrival: float, aid: NavigationAid) -> None:
        """Process a message of a navigation instrument.

        Args:
            arrival: Time of arrival [s].
            aid: The decoded message.
        """
        sample = self._aboard.aid(aid, arrival)
        if isinstance(sample, str):
            self.estimator.refuse("aid", sample)
        else:
            self.estimator.put(self._frame.in_pool(sample))

    def reading(self, now: float) -> Reading:
        """Return the state at a time [s], in world and body axes."""
        estimate = self._estimate(now)
        health = health_of(estimate, self.estimator.settings, self.estimator.site, {}, "", {})
        self._send_start_position(now)
        position, quaternion, velocity = self._frame.state(estimate)
        return Reading(
            time=now,
            position=position,
            quaternion=quaternion,
            nu=np.concatenate([velocity, self._turning(estimate)]),
            ready=health.ready,
            mode=health.vision_mode,
            reason="" if health.ready else _why(health, self.pool is not None),
            std=self._frame.std(estimate),
        )

    def health(self) -> Health:
        """Return the estimator's health at the time of its newest sample, with counts of refused samples by reason."""
        return self.estimator.health(self.estimator.estimate())

    def _send_start_position(self, now: float) -> None:
        """Provide the estimator once with the initial position of the vehicle, as soon as there is inertial data."""
        if self._let_in is None or (self.vehicle.sensors.imu is not None and self._omega_time == -math.inf):
            return
        self._asked_since = now if math.isnan(self._asked_since) else self._asked_since
        if now - self._asked_since >= LET_IN_AFTER - 1e-6:
            x, y = self._let_in
            self._let_in = None
            self.aid(now, NavigationAid(0, POSITION, 0.1, (x, y, 0.0), (LET_IN_STD, 0.0)))

    def _estimate(self, now: float) -> PoseEstimate:
        estimate = self.estimator.estimate(now)
        if self.unfused is None:
            return estimate
        raw = self.unfused
        return replace(estimate, x=raw.x, yaw=raw.yaw, vision_time=raw.vision_time)

    def _turning(self, estimate: PoseEstimate) -> Array:
        """Return the angular velocity, body frame [rad/s], minus the estimated gyroscope bias about the vertical."""
        if not math.isfinite(estimate.yaw_rate):
            return np.full(3, math.nan)
        omega, roll, cos = np.array(self._omega), estimate.roll, math.cos(estimate.pitch)
        up = np.array([-math.sin(estimate.pitch), math.sin(roll) * cos, math.cos(roll) * cos])
        bias = (omega[1] * up[1] + omega[2] * up[2]) / cos**2 - estimate.yaw_rate
        return omega - bias * up

    def _height(self, telemetry: Telemetry) -> float:
        """Return the height of the body origin in the pool frame from depth and tilt alone [m]."""
        tilt, site = self._aboard.tilt(telemetry), self.estimator.site
        if tilt is None:
            return math.nan
        return -telemetry.depth - site.offset - height_above_origin(site.depth_port, *tilt)

    def _detections(self, picture: Picture, time: float) -> list[Detection] | None:
        if self.pool is None:
            return None
        if picture.image is None or picture.tags:
            return [Detection(tag.tag_id, np.asarray(tag.corners, float)) for tag in picture.tags]
        lens = self.pool.camera.lens
        if picture.image.dtype != np.uint8 or picture.image.shape != (lens.height, lens.width):
            return None
        if self._tracker is None:
            tags = self.vehicle.tags
            assert tags is not None  # the locator refuses a vehicle without tags
            self._tracker = RegionTracker(detector(tags.family), set(tags.mounts))
        return self._tracker.detect(picture.image, time)


class _WorldFrame:
    """Conversion of the state from the pool frame to world and body axes."""

    def __init__(self, pool: Pool | None, up: tuple[float, float, float]) -> None:
        T = np.eye(4) if pool is None else pool.T_wp
        self._R_wp, self._t = T[:3, :3].copy(), T[:3, 3].copy()
        self._R_wg = self._R_wp @ axes_of_up(up)
        self._q_wg = matrix_to_quat(self._R_wg)
        self._plain = bool(np.allclose(self._R_wp, np.eye(3), atol=1e-12))
        # Heading of the pool frame's level axes, the reference of the estimator's yaw.
        self._yaw = math.atan2(self._R_wg[1, 0], self._R_wg[0, 0])

    def in_pool(self, sample: Sample) -> Sample:
        """Transform a fix or heading from the world to the pool frame; a velocity in body axes is unchanged."""
        if isinstance(sample, HeadingSample):
            return replace(sample, yaw=math.remainder(sample.yaw - self._yaw, math.tau))
        if not isinstance(sample, VisionSample):
            return sample
        x, y = np.array(sample.position) - self._t[:2]
        cos, sin = math.cos(self._yaw), math.sin(self._yaw)
        yaw = None if sample.yaw is None else math.remainder(sample.yaw - self._yaw, math.tau)
        return replace(sample, position=(cos * x + sin * y, cos * y - sin * x), yaw=yaw)

    def state(self, estimate: PoseEstimate) -> tuple[Array, Array, Array]:
        """Return position [m], attitude xyzw, and velocity in body axes [m/s]."""
        position = self._R_wp @ estimate.x[:3] + self._t
        q = quat_multiply(self._q_wg, quat_from_euler(estimate.roll, estimate.pitch, estimate.yaw))
        return position, q, quat_inverse_rotate(q, self._R_wp @ estimate.x[3:])

    def std(self, estimate: PoseEstimate) -> Array:
        """Return the standard deviations of position, velocity (world axes) and yaw, (7,)."""
        if self._plain:
            return estimate.std()
        P = np.zeros((6, 6))
        P[:3, :3] = self._R_wp @ estimate.P[:3, :3] @ self._R_wp.T
        P[3:, 3:] = self._R_wp @ estimate.P[3:, 3:] @ self._R_wp.T
        return replace(estimate, P=P).std()


def _older(time: float, last: float) -> bool:
    """Return whether a sample is repeated or late; a very late one indicates that the clock was set back."""
    return last - JUMP < time <= last


def _why(health: Health, camera: bool) -> str:
    """Return why a state is not ready, for a user with or without a camera."""
    if math.isnan(health.age_imu) or not health.imu_fresh:
        return "no inertial data"
    if math.isnan(health.age_depth) or not health.depth_fresh:
        return "no depth"
    if health.vision_mode == "uninitialized":
        return (
            "not seen by the camera yet"
            if camera
            else "no position fix yet, and where it was let in is not given"
        )
    if health.vision_mode in ("hold", "lost"):
        lack = "not seen by the camera" if camera else "no position fix or velocity"
        return f"{lack} for {health.age_vision:.1f} s"
    return "position or heading too uncertain"
