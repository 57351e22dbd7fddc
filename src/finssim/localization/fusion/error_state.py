"""Fusion with the IMU: the published filter of constant velocity, and the error-state filter behind the same gates.

Predictions, models and corrections are pure functions over a leading `...` batch.

Nominal state: position and velocity of the IMU in the pool frame, attitude, gyro bias, accelerometer bias. Error state
(15): [δp, δv, δθ, δb_g, δb_a], with the attitude error in pool axes, R = exp([δθ]x) R̂.

With a Doppler log or a compass it has five more (20): [δb_c, δs, δb_v], their offsets and the log's scale.

    p_dot = v,  v_dot = R (f - b_a) + g,  R_dot = R [ω - b_g]x
    δp_dot = δv,  δv_dot = -[R (f - b_a)]x δθ - R δb_a + n_a,  δθ_dot = -R δb_g + n_g
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from finssim.core.rotations import (
    cross,
    matrix_to_quat,
    quat_from_euler,
    quat_from_rotvec,
    quat_multiply,
    quat_to_matrix,
    skew,
    wrap_angle,
)
from finssim.localization.fusion import attitude, position_filter
from finssim.localization.fusion.attitude import (
    Tilt,
    TiltGains,
    YawNoise,
    YawState,
    follow,
    height_above_origin,
    roll_pitch,
    tilt_from,
    yaw_rate,
)
from finssim.localization.fusion.fuse_settings import Gate, Settings, Site
from finssim.localization.fusion.position_filter import Motion, PositionState, process_noise, transition
from finssim.localization.fusion.streams import (
    DepthSample,
    Estimate,
    HeadingSample,
    ImuSample,
    Outcome,
    VelocitySample,
    VisionSample,
    changed,
)
from finssim.localization.poses import axes_of_up

Array = npt.NDArray[np.float64]

# Gates: which measurements are believed, and when a run of disbelieved ones has been right all along.

LONGEST_SUPPORT = 200
"""Believed measurements that are counted."""

OUTVOTED = 6
"""Divisor of the support of a state carried by a gyro, which a run of refused measurements needs to replace it."""


@dataclass(frozen=True)
class Suspects:
    """Memory of a gate: refused measurements that agree with one another."""

    since: float
    """Time of the first [s]."""
    time: float
    """Time of the latest [s]."""
    value: tuple[float, ...]
    """The latest."""
    covariance: tuple[tuple[float, ...], ...]
    """Its covariance."""
    hits: int = 1
    """Number of measurements that agree."""
    misses: int = 0
    """Refused measurements in between that agree with none of them."""


def remember(
    suspects: Suspects | None, time: float, value: Array, covariance: Array, drift: float, gate: Gate
) -> Suspects:
    """The memory with one more refused measurement.

    It belongs to the run if its distance to the run's latest is within their covariances and what the quantity may
    have moved meanwhile. A run that more measurements contradict than support is given up for the newest.

    Args:
        suspects: The memory so far; None after a measurement that was believed.
        time: Of the measurement [s].
        value: The measurement, (n,).
        covariance: Its covariance, (n, n).
        drift: How fast the quantity may change [units/s].
        gate: The gate.
    """
    rows = tuple(tuple(float(c) for c in row) for row in covariance)
    fresh = Suspects(time, time, tuple(float(v) for v in value), rows)
    if suspects is None:
        return fresh
    difference = value - np.array(suspects.value)
    moved = (drift * (time - suspects.time)) ** 2
    S = covariance + np.array(suspects.covariance) + moved * np.eye(len(value))
    if float(difference @ np.linalg.solve(S, difference)) <= gate.limit(len(value)):
        return Suspects(suspects.since, time, fresh.value, rows, suspects.hits + 1, suspects.misses)
    if suspects.misses + 1 > suspects.hits:
        return fresh
    return replace(suspects, misses=suspects.misses + 1)


def due(suspects: Suspects, gate: Gate) -> bool:
    """Return whether the run has lasted long enough, and is numerous enough, to replace the state."""
    if math.isinf(gate.reacquire_after):
        return False
    # A microsecond of slack: stamps are sums of periods.
    long = suspects.time - suspects.since >= gate.reacquire_after - 1e-6
    return long and suspects.hits >= gate.reacquire_samples


@dataclass(frozen=True)
class Rival:
    """A replaced state, kept in case it was right."""

    offset: float
    """Difference from the current state [units of the measurement]."""
    held: int
    """Measurements that supported it."""
    won: int
    """Measurements that support what is believed now."""


@dataclass(frozen=True)
class GateMemory:
    """All that a gate remembers."""

    support: int = 0
    """Measurements believed since the state was last started from one; counted up to `reacquire_samples`."""
    suspects: Suspects | None = None
    believed: int = 0
    """Number of accepted measurements, counted up to `LONGEST_SUPPORT`."""
    rival: Rival | None = None

    @property
    def doubt(self) -> float:
        """Variance that a rival, or a run of refused measurements, adds to that of the state [units²]."""
        if self.rival is not None:
            return self.rival.offset**2 * self.rival.held / (self.rival.held + self.rival.won)
        if self.suspects is not None and self.suspects.hits > 1:
            return self.suspects.value[0] ** 2 * self.suspects.hits / (self.suspects.hits + self.believed)
        return 0.0


def judge(
    gate: Gate,
    memory: GateMemory,
    time: float,
    value: Array,
    covariance: Array,
    distance: float,
    drift: float,
) -> tuple[str, GateMemory]:
    """Return whether a measurement is accepted or refused as an outlier, and the gate's memory after it.

    A state that was started from one measurement is no surer than that one: until `reacquire_samples` others have
    supported it, a run takes over as soon as it outnumbers its support.

    Args:
        gate: The gate.
        memory: What it remembers; support 0 where there is no state yet.
        time: Of the measurement [s].
        value: What is compared among refused measurements, (n,).
        covariance: Of `value`, (n, n).
        distance: Squared Mahalanobis distance of the measurement from its prediction [-].
        drift: How fast `value` may change [units/s].

    Returns:
        `initialized` for the first, `accepted`, `gate` where it is refused, or `reacquired` where it ends a run that
        takes over; and the memory.
    """
    if memory.support == 0:
        return "initialized", GateMemory(1)
    if distance <= gate.limit(len(value)):
        return "accepted", GateMemory(min(memory.support + 1, gate.reacquire_samples))
    suspects = remember(memory.suspects, time, value, covariance, drift, gate)
    outvoted = memory.support < gate.reacquire_samples and suspects.hits > memory.support
    if due(suspects, gate) or (outvoted and math.isfinite(gate.reacquire_after)):
        return "reacquired", GateMemory(min(suspects.hits, gate.reacquire_samples))
    return "gate", GateMemory(memory.support, suspects)


def judge_carried(
    gate: Gate,
    memory: GateMemory,
    time: float,
    residual: float,
    variance: float,
    distance: float,
    drift: float,
    carried: bool,
) -> tuple[str, GateMemory]:
    """Return the result of `judge` for a measurement of a state that another sensor carries, as a gyro carries yaw.

    Between two measurements the state is right to a fraction of a degree, so that a jump is the measurement's error, or
    the state was wrong all along. What has been believed for long gives way only to a run of a sixth of its support,
    and is kept as a rival: a measurement that agrees with a rival of more support brings it back at once.

    Args:
        gate: The gate.
        memory: What it remembers.
        time: Of the measurement [s].
        residual: Measurement less prediction [units].
        variance: Of the measurement [units²].
        distance: Squared Mahalanobis distance of the measurement from its prediction [-].
        drift: How fast residuals that agree may change [units/s].
        carried: Whether that other sensor speaks; `judge` has to do where it does not.
    """
    value, R = np.array([residual]), np.array([[variance]])
    if not carried:
        return judge(gate, memory, time, value, R, distance, drift)
    rival = memory.rival
    refused = memory.support > 0 and distance > gate.limit(1)
    if refused and rival is not None and rival.held >= rival.won and math.isfinite(gate.reacquire_after):
        S = max(residual**2 / distance, variance)
        if (residual - rival.offset) ** 2 / S <= gate.limit(1):
            back = Rival(-residual, rival.won, rival.held)
            return "reacquired", GateMemory(gate.reacquire_samples, None, rival.held, back)
    verdict, after = judge(gate, memory, time, value, R, distance, drift)
    if verdict == "reacquired":
        hits = memory.suspects.hits + 1 if memory.suspects is not None else 1
        if hits * OUTVOTED < memory.believed:
            suspects = remember(memory.suspects, time, value, R, drift, gate)
            return "gate", GateMemory(memory.support, suspects, memory.believed, rival)
        return verdict, GateMemory(after.support, None, hits, Rival(-residual, memory.believed, hits))
    if verdict == "gate":
        return verdict, GateMemory(after.support, after.suspects, memory.believed, rival)
    believed = min(memory.believed + 1, LONGEST_SUPPORT)
    if rival is not None:
        rival = Rival(rival.offset, rival.held, rival.won + 1) if rival.won < 2 * rival.held else None
    return verdict, GateMemory(after.support, None, believed, rival)


# The filters behind these gates.

GYRO_HOLD = 0.3
"""The last rate of the gyro is held this long where samples are missing [s]."""
YAW_CAP = 10.0
"""Doubt of yaw does not grow beyond this variance [rad²]: far past a full circle."""
STEEPEST = math.radians(80.0)
"""Pitch beyond which the gyro gives no yaw rate."""
KINEMATIC_GATES = ("vision", "yaw", "depth")
"""Streams in the order of their gates."""
ACCEPTED, STEEP = (Outcome("imu", "accepted"),), (Outcome("imu", "steep"),)


@dataclass(frozen=True)
class Track:
    """All that the filters know; nothing else remembers."""

    position: PositionState
    yaw: YawState
    position_time: float = math.nan
    """Time of `position` [s]. Both advance only when they are asked for: the gyro does not move the position."""
    yaw_time: float = math.nan
    rate: float | None = None
    """Latest yaw rate [rad/s]."""
    roll: float = 0.0
    pitch: float = 0.0
    tilt: Tilt | None = None
    """Tilt of the filter for logs without an orientation."""
    vision_time: float | None = None
    yaw_seen: float | None = None
    """Time of the latest vision yaw that was believed [s]."""
    depth_time: float | None = None
    imu_time: float | None = None
    velocity_time: float | None = None
    compass: bool = False
    """True if yaw comes from a compass, including its offset."""
    gates: tuple[GateMemory, ...] = (GateMemory(),) * 3
    """Memories of the gates, in the order of `KINEMATIC_GATES`."""


class ConstantVelocity:
    """Filters of one vehicle: pure functions of `Track`, with settings and site fixed."""

    def __init__(self, settings: Settings, site: Site) -> None:
        """
        Args:
            settings: What can be tuned.
            site: What of pool and vehicle is needed.
        """
        self.settings, self.site = settings, site
        self._H_depth = np.array([[*site.up, 0.0, 0.0, 0.0]])
        self._motions = {(xy, z): motion_of(settings, xy, z) for xy in (False, True) for z in (False, True)}

    def start(self) -> Track:
        """The state before any sample: nothing is known."""
        s = self.settings
        P = np.diag([s.largest_variance] * 3 + [s.speed_std**2] * 3)
        yaw = YawState(0.0, 0.0, YAW_CAP, 0.0, s.bias_std**2)
        return Track(PositionState(np.zeros(6), P), yaw)

    def imu(self, track: Track, sample: ImuSample) -> tuple[Track, tuple[Outcome, ...]]:
        """Take in a rate: tilt, and yaw up to its time."""
        dt = math.inf if track.imu_time is None else sample.time - track.imu_time
        roll, pitch, tilt = self._tilted(track, sample, dt)
        steep = abs(pitch) > STEEPEST
        rate = None if steep else yaw_rate(sample.omega[1], sample.omega[2], roll, pitch)
        yaw = self._yaw_at(track, sample.time)
        if track.rate is not None and rate is not None and dt <= GYRO_HOLD:
            # Up to here the older rate was held; half the difference makes a trapezium of the step.
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

    def depth(self, track: Track, sample: DepthSample) -> tuple[Track, tuple[Outcome, ...]]:
        """Take in a depth: up . p + offset + lever = -depth."""
        s, site = self.settings, self.site
        track = self._positioned(track, sample.time)
        lever = height_above_origin(site.depth_port, track.roll, track.pitch)
        z = np.array([-sample.depth - site.offset - lever])
        R = np.array([[s.depth_std**2]])
        x = track.position.x

        def height() -> Array:
            return np.asarray((z - site.up[0] * x[0] - site.up[1] * x[1]) / site.up[2])

        track, outcome = self._placed(track, "depth", sample.time, z, self._H_depth, R, [2], height)
        return track, (outcome,)

    def vision(self, track: Track, sample: VisionSample) -> tuple[Track, tuple[Outcome, ...]]:
        """Take in a fix of the camera: x and y, and yaw if it has one."""
        R = vision_covariance(sample, self.settings)
        track, z = (
            self._turned_to(self._positioned(track, sample.time), sample.time),
            np.array(sample.position),
        )
        track, placed = self._placed(track, "vision", sample.time, z, _H_VISION, R[:2, :2], [0, 1], lambda: z)
        if sample.yaw is None:
            return track, (placed,)
        track, turned = self._turned(track, sample.time, sample.yaw, float(R[2, 2]))
        track = changed(track, compass=track.compass and not turned.used)
        return track, (placed, turned)

    def velocity(self, track: Track, sample: VelocitySample) -> tuple[Track, tuple[Outcome, ...]]:
        """Take in a velocity over the floor, turned into the pool frame by the heading so far."""
        if track.yaw_seen is None or self.settings.aids is None:
            return track, (Outcome("velocity", "no heading"),)
        track = self._turned_to(self._positioned(track, sample.time), sample.time)
        R_pb = quat_to_matrix(quat_from_euler(track.roll, track.pitch, track.yaw.yaw))
        z = R_pb @ np.array(sample.velocity)
        turned = track.yaw.variance * float(z @ z) + self.settings.aids.velocity_bias**2
        R = (self.settings.aids.velocity_std**2 + turned) * np.eye(3)
        innovation = position_filter.innovation(track.position, _H_VELOCITY, z, R)
        position = position_filter.correct(track.position, innovation, _H_VELOCITY, R)
        track = changed(track, position=position, velocity_time=sample.time)
        return track, (Outcome("velocity", "accepted", float(innovation.mahalanobis), 3),)

    def heading(self, track: Track, sample: HeadingSample) -> tuple[Track, tuple[Outcome, ...]]:
        """Take in a heading: as a yaw of the camera, with the compass's offset in its variance."""
        aids = self.settings.aids
        if aids is None:
            return track, (Outcome("heading", "no compass"),)
        track = self._turned_to(track, sample.time)
        variance = aids.heading_std**2 + aids.heading_bias**2
        track, turned = self._turned(track, sample.time, sample.yaw, variance)
        # Its offset is in every sample: many of them know no better than one.
        if track.yaw.variance < aids.heading_bias**2:
            track = changed(track, yaw=changed(track.yaw, variance=aids.heading_bias**2))
        return changed(track, compass=track.compass or turned.used), (replace(turned, stream="heading"),)

    def estimate(self, track: Track, time: float) -> Estimate:
        """The state at a time [s], not before its own; what is not known yet is NaN."""
        position, yaw = self._positioned(track, time).position, self._yaw_at(track, time)
        x, P = position.x.copy(), position.P.copy()
        unknown = ([0, 1, 3, 4] if track.vision_time is None else []) + (
            [2, 5] if track.depth_time is None else []
        )
        if unknown:
            x[unknown] = math.nan
            P[unknown, :] = math.nan
            P[:, unknown] = math.nan
        has_yaw = track.yaw_seen is not None
        silent = track.rate is None or track.imu_time is None or time - track.imu_time > GYRO_HOLD
        return Estimate(
            time=time,
            x=x,
            P=P,
            yaw=yaw.yaw if has_yaw else math.nan,
            yaw_variance=yaw.variance + track.gates[1].doubt if has_yaw else math.nan,
            yaw_rate=math.nan if silent else (track.rate or 0.0) - yaw.bias,
            roll=track.roll if track.imu_time is not None else math.nan,
            pitch=track.pitch if track.imu_time is not None else math.nan,
            vision_time=track.vision_time,
            depth_time=track.depth_time,
            imu_time=track.imu_time,
            velocity_time=track.velocity_time,
        )

    def _placed(
        self,
        track: Track,
        stream: str,
        time: float,
        z: Array,
        H: Array,
        R: Array,
        axes: list[int],
        restart: Callable[[], Array],
    ) -> tuple[Track, Outcome]:
        """Return the track after a fix or a depth that its gate has judged; `restart` gives restarted axes."""
        s, k = self.settings, KINEMATIC_GATES.index(stream)
        innovation = position_filter.innovation(track.position, H, z, R)
        distance = float(innovation.mahalanobis)
        verdict, memory = judge(s.gate, track.gates[k], time, z, R, distance, s.speed_std)
        position = track.position
        if verdict == "accepted":
            position = position_filter.correct(position, innovation, H, R)
        elif verdict != "gate":
            position = position_filter.restarted(position, axes, restart(), R, s.speed_std)
        gates = (*track.gates[:k], memory, *track.gates[k + 1 :])
        believed = {} if verdict == "gate" else {f"{stream}_time": time}
        track = changed(track, position=position, gates=gates, **believed)
        return track, Outcome(stream, verdict, distance, len(z))

    def _turned(self, track: Track, time: float, measured: float, variance: float) -> tuple[Track, Outcome]:
        s = self.settings
        innovation = attitude.innovation(track.yaw, measured, variance)
        # Flipped yaws agree with one another as distances from the prediction, which turns with the vehicle.
        carried = track.imu_time is not None and time - track.imu_time <= GYRO_HOLD
        distance = float(innovation.mahalanobis)
        verdict, memory = judge_carried(
            s.gate, track.gates[1], time, float(innovation.residual), variance, distance, 0.05, carried
        )
        if verdict == "accepted":
            yaw = attitude.correct(track.yaw, innovation, variance)
        elif verdict == "gate":
            yaw = track.yaw
        else:
            yaw = attitude.restarted(track.yaw, measured, variance, s.bias_std)
        then = track.yaw_seen if verdict == "gate" else time
        gates = (track.gates[0], memory, track.gates[2])
        track = changed(track, yaw=yaw, yaw_seen=then, gates=gates)
        return track, Outcome("yaw", verdict, innovation.mahalanobis, 1)

    def tilt(self, track: Track) -> tuple[float, float]:
        """Roll and pitch of a state [rad]."""
        return track.roll, track.pitch

    def _tilted(self, track: Track, sample: ImuSample, dt: float) -> tuple[float, float, Tilt | None]:
        """Roll and pitch after a sample, the unit's own, else those of gyro and accelerometer; and their filter."""
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

    def _positioned(self, track: Track, time: float) -> Track:
        """Return the track with its position at a time; axes without measurements slow down, then stop."""
        s, then = self.settings, track.position_time
        if math.isnan(then) or time <= then:
            return changed(track, position_time=_later(then, time))
        position = track.position
        aided = max(-math.inf if t is None else t for t in (track.vision_time, track.velocity_time))
        dived = -math.inf if track.depth_time is None else track.depth_time
        for until in _steps(then, time, (aided + s.coast, aided + s.hold, dived + s.coast, dived + s.hold)):
            middle = 0.5 * (then + until)
            blind, deaf = middle - aided, middle - dived
            still = ([0, 1] if blind > s.hold else []) + ([2] if deaf > s.hold else [])
            if still:
                position = position_filter.frozen(position, still)
            motion = self._motions[blind > s.coast, deaf > s.coast]
            position = position_filter.predict(position, until - then, motion)
            then = until
        position = position_filter.capped(position, s.largest_variance)
        return changed(track, position=position, position_time=time)

    def _turned_to(self, track: Track, time: float) -> Track:
        return changed(track, yaw=self._yaw_at(track, time), yaw_time=_later(track.yaw_time, time))

    def _yaw_at(self, track: Track, time: float) -> YawState:
        """Yaw at a time: the latest rate held, and none where the gyro has been silent for too long."""
        s, then = self.settings, track.yaw_time
        if math.isnan(then) or time <= then:
            return track.yaw
        yaw = track.yaw
        heard = -math.inf if track.imu_time is None or track.rate is None else track.imu_time + GYRO_HOLD
        for until in _steps(then, time, (heard,)):
            if until <= heard + 1e-12 and track.rate is not None:
                yaw = attitude.predict(yaw, track.rate, until - then, s.gyro)
            else:
                noise = YawNoise(rate=s.blind_rate, bias_walk=s.gyro.bias_walk)
                yaw = attitude.predict(yaw, yaw.bias, until - then, noise)
            then = until
        return attitude.capped(yaw, YAW_CAP) if yaw.variance > YAW_CAP else yaw


_H_VISION = np.eye(6)[:2]
_H_VELOCITY = np.eye(6)[3:]


def vision_covariance(sample: VisionSample, settings: Settings) -> Array:
    """Covariance of x, y and yaw that a fix is given, (3, 3)."""
    floor = _diagonal(settings.vision_floor)
    if sample.covariance is None:
        return _diagonal(settings.vision_std) + floor
    return np.array(sample.covariance) + floor


@lru_cache(maxsize=64)
def _diagonal(std: tuple[float, float]) -> Array:
    """Covariance of x, y and yaw that know nothing of each other, with a standard deviation of place and of yaw."""
    return np.diag([std[0] ** 2, std[0] ** 2, std[1] ** 2])


def motion_of(settings: Settings, xy_slows: bool, z_slows: bool) -> Motion:
    """The motion model where the axes without news slow down to rest, give or take `speed_std`."""
    slows = (xy_slows, xy_slows, z_slows)
    rate, motion = settings.decay, settings.motion
    density = [
        2.0 * rate * settings.speed_std**2 if slow else q
        for slow, q in zip(slows, motion.density, strict=True)
    ]
    decay = [rate if slow else nominal for slow, nominal in zip(slows, motion.decay, strict=True)]
    return replace(motion, density=(density[0], density[1], density[2]), decay=(decay[0], decay[1], decay[2]))


def _steps(start: float, end: float, cuts: Iterable[float]) -> list[float]:
    """Ends of the steps from `start` to `end` that are cut at `cuts`."""
    inside = {cut for cut in cuts if start < cut < end}
    return [*sorted(inside), end] if inside else [end]


def _later(then: float, time: float) -> float:
    return time if math.isnan(then) else max(then, time)


# The error-state filter, and the model that runs it behind its gates.


P, V, A, G, B = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12), slice(12, 15)
"""Indices of δp, δv, δθ, δb_g and δb_a in the error state."""
C, S, D = 15, 16, slice(17, 20)
"""Indices of the offset of the compass, the scale and the offset of the Doppler log in the aided error state."""
AIDED = 5
"""Numbers that log and compass add."""
_I = {n: np.eye(n) for n in (15, 15 + AIDED)}


@dataclass(frozen=True)
class InertialState:
    """State of the filter."""

    p: Array
    """Position of the IMU, pool frame [m], (..., 3)."""
    v: Array
    """Its velocity, pool frame [m/s], (..., 3)."""
    q: Array
    """Attitude q_pb, body to pool, xyzw, (..., 4)."""
    gyro_bias: Array
    """Body frame [rad/s], (..., 3)."""
    accel_bias: Array
    """Body frame [m/s²], (..., 3)."""
    covariance: Array
    """Covariance of the error state, (..., n, n): n = 15, or 20 with `extra`."""
    extra: Array = field(default_factory=lambda: np.zeros(0))
    """Offset of the compass [rad], scale error [-] and offset of the Doppler log [m/s], (..., 5); none: (0,)."""


@dataclass(frozen=True)
class ErrorStateNoise:
    """Noise densities of the IMU."""

    gyro: float
    """[rad/s/√Hz]"""
    accel: float
    """[m/s²/√Hz]"""
    gyro_walk: float
    """[rad/s²/√Hz]"""
    accel_walk: float
    """[m/s³/√Hz]"""
    log_walk: float = 0.0
    """Random walk of the Doppler log's offset [m/s²/√Hz]."""


def predict(
    state: InertialState, omega: Array, force: Array, dt: float, noise: ErrorStateNoise, gravity: Array
) -> InertialState:
    """The state a time later, with rate and force constant over the step and the attitude of its middle.

    Args:
        state: Before.
        omega: Angular rate, body frame [rad/s], (..., 3).
        force: Specific force at the IMU, body frame [m/s²], (..., 3).
        dt: Length of the step [s].
        noise: Of the IMU.
        gravity: Pool frame [m/s²], (3,): downwards.
    """
    turn = (omega - state.gyro_bias) * dt
    half = quat_from_rotvec(0.5 * turn)
    middle = quat_multiply(state.q, half)
    q = quat_multiply(middle, half)
    R = quat_to_matrix(middle)
    pushed = (R @ (force - state.accel_bias)[..., None])[..., 0]
    a = pushed + gravity
    n = state.covariance.shape[-1]
    F = _I[n].copy() if turn.ndim == 1 else np.tile(_I[n], (*turn.shape[:-1], 1, 1))
    F[..., P, V] = dt * _I[15][:3, :3]
    swing, turned = -dt * skew(pushed), -dt * R
    F[..., V, A], F[..., P, A] = swing, (0.5 * dt) * swing
    F[..., V, B], F[..., P, B] = turned, (0.5 * dt) * turned
    F[..., A, G] = turned
    covariance = F @ state.covariance @ F.swapaxes(-1, -2) + _noise(dt, noise, n)
    return changed(
        state,
        p=state.p + dt * state.v + 0.5 * dt**2 * a,
        v=state.v + dt * a,
        q=q / np.sqrt((q * q).sum(axis=-1, keepdims=True)),
        covariance=0.5 * (covariance + covariance.swapaxes(-1, -2)),
    )


def drift(state: InertialState, dt: float, motion: Motion, turning: float) -> InertialState:
    """The state a time later without the IMU: it moves as the position filter has it, and may turn any way.

    Args:
        state: Before.
        dt: Time that passes [s].
        motion: How the vehicle may move.
        turning: Noise density of its rates [rad/s/√Hz].
    """
    n = state.covariance.shape[-1]
    F = np.eye(n)
    F[:6, :6] = transition(dt, motion)
    Q = np.zeros((n, n))
    Q[:6, :6] = process_noise(dt, motion)
    Q[A, A] = turning**2 * dt * np.eye(3)
    moved = np.concatenate([state.p, state.v], axis=-1) @ F[:6, :6].T
    covariance = F @ state.covariance @ F.T + Q
    return changed(state, p=moved[..., :3], v=moved[..., 3:], covariance=covariance)


def _noise(dt: float, noise: ErrorStateNoise, n: int) -> Array:
    """Covariance that one step adds, (n, n): the same in every direction, so that no axes need to turn."""
    first, second, third = _noise_powers(noise, n)
    return dt * first + (0.5 * dt**2) * second + (dt**3 / 3.0) * third


@lru_cache(maxsize=8)
def _noise_powers(noise: ErrorStateNoise, n: int) -> tuple[Array, Array, Array]:
    """Return the coefficients of dt, dt²/2 and dt³/3 in the noise of a step, (n, n) each."""
    first, second, third = np.zeros((3, n, n))
    if n > 15:
        first[D, D] = noise.log_walk**2 * np.eye(3)
    i = np.arange(3)
    third[i, i] = second[i, i + 3] = second[i + 3, i] = first[i + 3, i + 3] = noise.accel**2
    first[i + 6, i + 6] = noise.gyro**2
    first[i + 9, i + 9] = noise.gyro_walk**2
    first[i + 12, i + 12] = noise.accel_walk**2
    return first, second, third


def position_model(state: InertialState, lever: Array) -> tuple[Array, Array]:
    """Return the position of a body point, and its derivative by the errors.

    Args:
        state: The state.
        lever: The point from the IMU, body frame [m], (3,).

    Returns:
        Position, pool frame [m], (..., 3), and its Jacobian, (..., 3, 15).
    """
    arm = (quat_to_matrix(state.q) @ lever[:, None])[..., 0]
    H = np.zeros((*arm.shape[:-1], 3, state.covariance.shape[-1]))
    H[..., range(3), range(3)] = 1.0
    H[..., A] = -skew(arm)
    return state.p + arm, H


def depth_model(state: InertialState, lever: Array, up: Array, offset: float) -> tuple[Array, Array]:
    """Height of a body point above the surface.

    Args:
        state: The state.
        lever: The point from the IMU, body frame [m], (3,).
        up: Normal of the surface, pool frame, (3,).
        offset: Height of p is up . p + offset [m].

    Returns:
        Height [m], (..., 1), and its Jacobian, (..., 1, 15).
    """
    point, H = position_model(state, lever)
    return np.asarray(point @ up[:, None] + offset), np.asarray(up[None, :] @ H)


def yaw_model(state: InertialState) -> tuple[Array, Array]:
    """Yaw of the body x axis, and how the errors turn it.

    With c = R e_x:  dψ = δθ_z - c_z (c_x δθ_x + c_y δθ_y) / (c_x² + c_y²)

    Returns:
        Yaw [rad], (..., 1), and its Jacobian, (..., 1, 15).
    """
    c = quat_to_matrix(state.q)[..., :, 0]
    level = c[..., 0] ** 2 + c[..., 1] ** 2
    H = np.zeros((*c.shape[:-1], 1, state.covariance.shape[-1]))
    H[..., 0, 6] = -c[..., 2] * c[..., 0] / level
    H[..., 0, 7] = -c[..., 2] * c[..., 1] / level
    H[..., 0, 8] = 1.0
    return np.arctan2(c[..., 1], c[..., 0])[..., None], H


def heading_model(state: InertialState) -> tuple[Array, Array]:
    """Return the reading of a compass: yaw and its own offset.

    Returns:
        Heading [rad], (..., 1), and its Jacobian, (..., 1, 20).
    """
    yaw, H = yaw_model(state)
    H[..., 0, C] = 1.0
    return yaw + state.extra[..., :1], H


def velocity_model(state: InertialState, omega: Array, lever: Array) -> tuple[Array, Array]:
    """Return the reading of a Doppler log: (1 + s) [R' v + (ω - b_g) x l] + b_v.

    Args:
        state: The state.
        omega: Angular rate as measured, body frame [rad/s], (..., 3).
        lever: The log from the IMU, body frame [m], (3,).

    Returns:
        Velocity, body frame [m/s], (..., 3), and its Jacobian, (..., 3, 20).
    """
    back = np.swapaxes(quat_to_matrix(state.q), -1, -2)
    predicted = (back @ state.v[..., None])[..., 0] + cross(omega - state.gyro_bias, lever)
    gain = 1.0 + state.extra[..., 1]
    H = np.zeros((*predicted.shape[:-1], 3, state.covariance.shape[-1]))
    H[..., V] = gain * back
    H[..., A] = gain * (back @ skew(state.v))
    H[..., G] = gain * skew(lever)
    H[..., S] = predicted
    H[..., D] = _I[15][:3, :3]
    return gain * predicted + state.extra[..., 2:], H


def error_innovation(state: InertialState, residual: Array, H: Array, R: Array) -> tuple[Array, Array]:
    """Squared Mahalanobis distance of a residual, and the gain.

    Args:
        state: The prediction.
        residual: Measured minus predicted, (..., m).
        H: Jacobian of the prediction, (..., m, 15).
        R: Covariance of the measurement, (..., m, m).

    Returns:
        Distance (...) and gain (..., 15, m).
    """
    PHt = state.covariance @ np.swapaxes(H, -1, -2)
    S = H @ PHt + R
    inverse = 1.0 / S if S.shape[-1] == 1 else np.linalg.inv(S)
    weighted = (inverse @ residual[..., None])[..., 0]
    return np.asarray(np.sum(residual * weighted, axis=-1)), PHt @ inverse


def correct(state: InertialState, residual: Array, H: Array, R: Array, gain: Array) -> InertialState:
    """The state after a measurement, in Joseph's form; the error is moved into the nominal state.

    Args:
        state: The prediction.
        residual: Measured minus predicted, (..., m).
        H: Jacobian of the prediction, (..., m, 15).
        R: Covariance of the measurement, (..., m, m).
        gain: As `error_innovation` gives it.
    """
    d = (gain @ residual[..., None])[..., 0]
    retained = _I[gain.shape[-2]] - gain @ H
    covariance = retained @ state.covariance @ np.swapaxes(retained, -1, -2)
    covariance = covariance + gain @ R @ np.swapaxes(gain, -1, -2)
    q = quat_multiply(quat_from_rotvec(d[..., A]), state.q)
    return InertialState(
        state.p + d[..., P],
        state.v + d[..., V],
        q / np.linalg.norm(q, axis=-1, keepdims=True),
        state.gyro_bias + d[..., G],
        state.accel_bias + d[..., B],
        0.5 * (covariance + np.swapaxes(covariance, -1, -2)),
        state.extra + d[..., 15:],
    )


# What happens to an error state besides prediction and correction: restarts, stops, bounds. One state each.


def restarted(
    state: InertialState, axes: list[int], value: Array, R: Array, speed_std: float
) -> InertialState:
    """Forget position and velocity of some axes, 0 to 2, and start them at a measurement.

    Args:
        state: Before.
        axes: Position axes to restart.
        value: Their positions [m], (n,).
        R: Covariance of `value` [m²], (n, n).
        speed_std: Standard deviation of the velocity per axis [m/s].
    """
    rows = axes + [axis + 3 for axis in axes]
    p, v, covariance = state.p.copy(), state.v.copy(), state.covariance.copy()
    covariance[rows, :] = 0.0
    covariance[:, rows] = 0.0
    p[axes], v[axes] = value, 0.0
    covariance[np.ix_(axes, axes)] = R
    covariance[rows[len(axes) :], rows[len(axes) :]] = speed_std**2
    return changed(state, p=p, v=v, covariance=covariance)


def stopped(state: InertialState, axes: list[int]) -> InertialState:
    """Stop some axes: their velocity becomes zero, and what it was becomes doubt about it."""
    rows = [axis + 3 for axis in axes]
    v, covariance = state.v.copy(), state.covariance.copy()
    covariance[rows, rows] += v[axes] ** 2
    v[axes] = 0.0
    return changed(state, v=v, covariance=covariance)


def parted(state: InertialState, axes: list[int], walk: float) -> InertialState:
    """Return the state with some positions uncorrelated with all other errors, and their variances increased by `walk`
    [m²]."""
    covariance = state.covariance.copy()
    of_axes = covariance[np.ix_(axes, axes)] + walk * np.eye(len(axes))
    covariance[axes, :] = 0.0
    covariance[:, axes] = 0.0
    covariance[np.ix_(axes, axes)] = of_axes
    return changed(state, covariance=covariance)


def turned(state: InertialState, angle: float, variance: float) -> InertialState:
    """Turn the attitude about the pool's z by `angle` [rad], and forget what was known of it."""
    covariance = state.covariance.copy()
    covariance[8, :] = 0.0
    covariance[:, 8] = 0.0
    covariance[8, 8] = variance
    return changed(
        state, q=quat_multiply(quat_from_rotvec(np.array([0.0, 0.0, angle])), state.q), covariance=covariance
    )


def capped(state: InertialState, variance: float, tilt: float) -> InertialState:
    """The state with bounded doubt: rows and columns beyond are scaled down together.

    Args:
        state: Before.
        variance: Largest of a position [m²].
        tilt: Largest standard deviation of roll and pitch [rad].
    """
    d = np.diagonal(state.covariance)
    limit = _caps(variance, tilt, len(d))
    if (d <= limit).all():
        return state
    scale = np.sqrt(np.minimum(1.0, limit / np.maximum(d, 1e-300)))
    return changed(state, covariance=state.covariance * scale[:, None] * scale[None, :])


@lru_cache(maxsize=8)
def _caps(variance: float, tilt: float, n: int) -> Array:
    """The largest variance of each error, (n,)."""
    return np.array([variance] * 3 + [np.inf] * 3 + [tilt**2] * 2 + [10.0] + [np.inf] * (n - 9))


# Fusion with the IMU's acceleration: the error-state filter behind the same gates, states and timings.

TILT_CAP = 0.5
"""Doubt of roll and pitch does not grow beyond this [rad]."""


GATES = ("vision", "yaw", "depth", "velocity", "heading")
"""Streams in the order of their gates."""
TIMED = ("vision", "depth", "velocity")
"""Streams whose latest accepted measurement's time counts."""


@dataclass(frozen=True)
class InertialTrack:
    """All that the filter knows; nothing else remembers."""

    before: Track
    """The constant-velocity filters, from which this one starts once every sensor has spoken."""
    inertial: InertialState | None = None
    time: float = math.nan
    omega: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Latest angular rate, body frame [rad/s]."""
    force: tuple[float, float, float] | None = None
    """Latest specific force, body frame [m/s²]."""
    vision_time: float | None = None
    depth_time: float | None = None
    imu_time: float | None = None
    velocity_time: float | None = None
    gates: tuple[GateMemory, ...] = (GateMemory(),) * 5
    """Their memories, in the order of `GATES`."""


class ErrorState:
    """The filter of one vehicle: pure functions of `InertialTrack`, with settings and site fixed."""

    def __init__(self, settings: Settings, site: Site) -> None:
        """
        Args:
            settings: What can be tuned.
            site: What of pool and vehicle is needed.
        """
        self.settings, self.site = settings, site
        self._before = ConstantVelocity(settings, site)
        self._up = np.array(site.up)
        self._gravity = -site.gravity * self._up
        self._body, self._port = -np.array(site.imu), np.array(site.depth_port) - np.array(site.imu)
        self._log = np.array(site.dvl) - np.array(site.imu)
        self._noise = ErrorStateNoise(
            settings.gyro.rate,
            settings.accel_noise,
            settings.gyro.bias_walk,
            settings.accel_bias_walk,
            settings.aids.velocity_walk if settings.aids else 0.0,
        )
        self._drifts = {slow: motion_of(settings, slow, False) for slow in (False, True)}

    def start(self) -> InertialTrack:
        """The state before any sample: nothing is known."""
        return InertialTrack(self._before.start())

    def imu(self, track: InertialTrack, sample: ImuSample) -> tuple[InertialTrack, tuple[Outcome, ...]]:
        """Take in a rate and a specific force."""
        if sample.force is None:
            return track, (Outcome("imu", "no acceleration"),)
        if track.inertial is None:
            before, outcomes = self._before.imu(track.before, sample)
            track = changed(
                track,
                before=before,
                omega=sample.omega,
                force=sample.force,
                imu_time=sample.time,
            )
            return self._begun(track, sample.time), outcomes
        heard = track.imu_time is not None and sample.time - track.imu_time <= GYRO_HOLD
        if heard and track.force is not None:  # the step's mean, rather than what it began with
            omega, force = _mean(track.omega, sample.omega), _mean(track.force, sample.force)
            track = self._until(changed(track, omega=omega, force=force), sample.time)
        else:
            track = self._until(track, sample.time)
        track = changed(track, omega=sample.omega, force=sample.force, imu_time=sample.time)
        return track, (Outcome("imu", "accepted"),)

    def depth(self, track: InertialTrack, sample: DepthSample) -> tuple[InertialTrack, tuple[Outcome, ...]]:
        """Take in a depth."""
        if track.inertial is None:
            before, outcomes = self._before.depth(track.before, sample)
            return self._begun(changed(track, before=before), sample.time), outcomes
        track, state = self._at(track, sample.time)
        height, H = depth_model(state, self._port, self._up, self.site.offset)
        residual, R = -sample.depth - height, np.array([[self.settings.depth_std**2]])
        speed = self.settings.speed_std

        def restart(state: InertialState) -> InertialState:
            return restarted(state, [2], state.p[2:] + residual / self._up[2], R, speed)

        track, outcome = self._measured(track, "depth", sample.time, residual, H, R, residual, speed, restart)
        return track, (outcome,)

    def vision(self, track: InertialTrack, sample: VisionSample) -> tuple[InertialTrack, tuple[Outcome, ...]]:
        """Take in a fix of the camera."""
        if track.inertial is None:
            before, outcomes = self._before.vision(track.before, sample)
            return self._begun(changed(track, before=before), sample.time), outcomes
        R, speed = vision_covariance(sample, self.settings), self.settings.speed_std
        track, state = self._at(track, sample.time)
        position, H = position_model(state, self._body)
        fix = np.array(sample.position)
        off, R_xy = fix - position[:2], R[:2, :2]

        def restart(state: InertialState) -> InertialState:
            return restarted(state, [0, 1], state.p[:2] + off, R_xy, speed)

        track, fix_outcome = self._measured(
            track, "vision", sample.time, off, H[:2], R_xy, fix, speed, restart
        )
        if sample.yaw is None or track.inertial is None:
            return track, (fix_outcome,)
        yaw, H = yaw_model(track.inertial)
        residual, R_yaw = wrap_angle(np.array([sample.yaw]) - yaw), R[2:, 2:]
        # Flipped yaws agree with one another as distances from the prediction, which turns with the vehicle.
        carried = track.imu_time is not None and sample.time - track.imu_time <= GYRO_HOLD

        def turn(state: InertialState) -> InertialState:
            return turned(state, float(residual[0]), float(R_yaw[0, 0]))

        track, turn_outcome = self._measured(
            track, "yaw", sample.time, residual, H, R_yaw, residual, 0.05, turn, carried=carried
        )
        return track, (fix_outcome, turn_outcome)

    def velocity(
        self, track: InertialTrack, sample: VelocitySample
    ) -> tuple[InertialTrack, tuple[Outcome, ...]]:
        """Take in a velocity over the floor."""
        aids = self.settings.aids
        if track.inertial is None or aids is None:
            before, outcomes = self._before.velocity(track.before, sample)
            return changed(track, before=before), outcomes
        track, state = self._at(track, sample.time)
        expected, H = velocity_model(state, np.array(track.omega), self._log)
        measured, R = np.array(sample.velocity), aids.velocity_std**2 * np.eye(3)
        track, outcome = self._measured(
            track, "velocity", sample.time, measured - expected, H, R, measured, 1.0
        )
        return track, (outcome,)

    def heading(
        self, track: InertialTrack, sample: HeadingSample
    ) -> tuple[InertialTrack, tuple[Outcome, ...]]:
        """Take in a heading."""
        aids = self.settings.aids
        if track.inertial is None or aids is None:
            before, outcomes = self._before.heading(track.before, sample)
            return self._begun(changed(track, before=before), sample.time), outcomes
        track, state = self._at(track, sample.time)
        expected, H = heading_model(state)
        residual, R = wrap_angle(np.array([sample.yaw]) - expected), np.array([[aids.heading_std**2]])
        track, outcome = self._measured(track, "heading", sample.time, residual, H, R, residual, 0.05)
        return track, (outcome,)

    def _measured(
        self,
        track: InertialTrack,
        stream: str,
        time: float,
        residual: Array,
        H: Array,
        R: Array,
        value: Array,
        drift: float,
        restart: Callable[[InertialState], InertialState] | None = None,
        *,
        carried: bool | None = None,
    ) -> tuple[InertialTrack, Outcome]:
        """The track after a measurement that its gate has judged; without a restart a run of refused ones corrects."""
        state, k = track.inertial, GATES.index(stream)
        assert state is not None
        squared, gain = error_innovation(state, residual, H, R)
        distance, gate, memory = float(squared), self.settings.gate, track.gates[k]
        if carried is None:
            verdict, memory = judge(gate, memory, time, value, R, distance, drift)
        else:
            difference, variance = float(residual[0]), float(R[0, 0])
            verdict, memory = judge_carried(
                gate, memory, time, difference, variance, distance, drift, carried
            )
        if verdict == "accepted" or (verdict == "reacquired" and restart is None):
            state = correct(state, residual, H, R, gain)
        elif verdict == "reacquired" and restart is not None:
            state = restart(state)
        gates = (*track.gates[:k], memory, *track.gates[k + 1 :])
        believed = {f"{stream}_time": time} if verdict != "gate" and stream in TIMED else {}
        track = changed(track, inertial=state, gates=gates, **believed)
        return track, Outcome(stream, verdict, distance, len(residual))

    def tilt(self, track: InertialTrack) -> tuple[float, float]:
        """Roll and pitch of a state [rad]."""
        if track.inertial is None:
            return track.before.roll, track.before.pitch
        roll, pitch = roll_pitch(self._up @ quat_to_matrix(track.inertial.q))
        return float(roll), float(pitch)

    def _at(self, track: InertialTrack, time: float) -> tuple[InertialTrack, InertialState]:
        """The track at a time, and what its filter knows then."""
        track = self._until(track, time)
        assert track.inertial is not None
        return track, track.inertial

    def estimate(self, track: InertialTrack, time: float) -> Estimate:
        """The state at a time [s], not before its own."""
        if track.inertial is None:
            return self._before.estimate(track.before, time)
        track, state = self._at(track, time)
        T, x = self._to_body(state, np.array(track.omega))
        aided = _aided(track)
        old = aided is None or time - aided > self.settings.hold
        if old:
            x[3:5] = 0.0
        yaw, H = yaw_model(state)
        rates = quat_to_matrix(state.q) @ (np.array(track.omega) - state.gyro_bias)
        roll, pitch = self.tilt(track)
        return Estimate(
            time=time,
            x=x,
            P=T @ state.covariance @ T.T,
            yaw=float(yaw[0]),
            yaw_variance=float((H @ state.covariance @ H.T)[0, 0]) + track.gates[1].doubt,
            yaw_rate=float(H[0, 6:9] @ rates),
            roll=roll,
            pitch=pitch,
            vision_time=track.vision_time,
            depth_time=track.depth_time,
            imu_time=track.imu_time,
            velocity_time=track.velocity_time,
        )

    def _to_body(self, state: InertialState, omega: Array) -> tuple[Array, Array]:
        """Jacobian (6, n) of the body origin's position and velocity, and their values (6,)."""
        position, H = position_model(state, self._body)
        R = quat_to_matrix(state.q)
        swing = R @ cross(omega - state.gyro_bias, self._body)
        T = np.zeros((6, H.shape[-1]))
        T[:3] = H
        T[3:, 3:6] = np.eye(3)
        return T, np.concatenate([position, state.v + swing])

    def _begun(self, track: InertialTrack, time: float) -> InertialTrack:
        """Start the filter once position, yaw, depth and tilt are known."""
        before, s = track.before, self.settings
        if track.force is None or None in (before.vision_time, before.yaw_seen, before.depth_time):
            return track
        prior = self._before.estimate(before, time)
        level = quat_from_euler(prior.roll, prior.pitch, prior.yaw)
        from_level = axes_of_up(self.site.up)
        R = from_level @ quat_to_matrix(level)
        q = quat_multiply(matrix_to_quat(from_level), level)
        extra = 0 if s.aids is None else AIDED
        covariance = np.zeros((15 + extra, 15 + extra))
        covariance[:6, :6] = prior.P
        covariance[6:9, 6:9] = np.diag([s.tilt_std**2, s.tilt_std**2, prior.yaw_variance])
        covariance[9:15, 9:15] = np.diag([s.bias_std**2] * 3 + [s.accel_bias_std**2] * 3)
        if s.aids is not None:
            a = s.aids
            covariance[15:, 15:] = np.diag(
                np.square([a.heading_bias, a.velocity_scale, *[a.velocity_bias] * 3])
            )
            if before.compass:  # yaw is then the compass's reading minus its offset
                covariance[8, 8] += a.heading_bias**2
                covariance[8, 15] = covariance[15, 8] = -(a.heading_bias**2)
        state = InertialState(
            prior.x[:3] - R @ self._body,
            prior.x[3:],
            q,
            np.zeros(3),
            np.zeros(3),
            covariance,
            np.zeros(extra),
        )
        gates = (*before.gates, GateMemory(1), GateMemory(1))
        track = changed(track, inertial=state, time=time, vision_time=before.vision_time, gates=gates)
        return changed(track, depth_time=before.depth_time)

    def _until(self, track: InertialTrack, time: float) -> InertialTrack:
        """Return the track at a time; velocity without measurements decays, and then the position stops."""
        s, then = self.settings, track.time
        if time <= then:
            return track
        aided = _aided(track)
        cuts = [] if aided is None else [aided + limit for limit in (s.coast, s.hold)]
        heard = -math.inf if track.imu_time is None else track.imu_time + GYRO_HOLD
        ends = [*sorted({cut for cut in (*cuts, heard) if then < cut < time}), time]
        state = track.inertial
        assert state is not None
        for until in ends:
            middle = 0.5 * (then + until)
            age = math.inf if aided is None else middle - aided
            state = self._step(state, track, until - then, blind=middle > heard, age=age)
            then = until
        return changed(track, inertial=capped(state, s.largest_variance, TILT_CAP), time=time)

    def _step(
        self, state: InertialState, track: InertialTrack, dt: float, *, blind: bool, age: float
    ) -> InertialState:
        s, lost = self.settings, age > self.settings.hold
        if lost:
            state = stopped(state, [0, 1])
        if blind or track.force is None:
            return drift(state, dt, self._drifts[age > s.coast], s.blind_rate)
        omega, force = np.array(track.omega), np.array(track.force)
        after = predict(state, omega, force, dt, self._noise, self._gravity)
        if age <= s.coast:
            return after
        if lost:  # the accelerometer no longer gives the position; the vehicle may be anywhere near
            walk = 2.0 * s.speed_std**2 / s.decay * dt
            after = parted(changed(after, p=np.append(state.p[:2], after.p[2])), [0, 1], walk)
        H = np.eye(len(after.covariance))[3:5]
        R = np.eye(2) * s.speed_std**2 / (s.decay * dt)
        residual = -after.v[:2]
        gain = error_innovation(after, residual, H, R)[1]
        return correct(after, residual, H, R, gain)


def _aided(track: InertialTrack) -> float | None:
    """Time of the latest fix or Doppler velocity [s]; None before the first."""
    times = [t for t in (track.vision_time, track.velocity_time) if t is not None]
    return max(times) if times else None


def _mean(a: tuple[float, float, float], b: tuple[float, float, float]) -> tuple[float, float, float]:
    return 0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1]), 0.5 * (a[2] + b[2])
