"""The paper's fusion: constant velocity for the position, the gyro for yaw (eq. 14 and 15), each behind its gates."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from finssim.geometry.rotations import quat_from_euler, quat_to_matrix
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
from finssim.localization.fusion.position_filter import Motion, PositionState
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

Array = npt.NDArray[np.float64]

# Gates: which measurements are believed, and when a run of disbelieved ones has been right all along.

LONGEST_SUPPORT = 200
"""Believed measurements that are counted."""

OUTVOTED = 6
"""A state that a gyro carries gives way to a run of refused measurements with this part of its own support."""


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
    """How many agree."""
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
    """Whether the run has lasted long enough, and is numerous enough, to take over."""
    if math.isinf(gate.reacquire_after):
        return False
    # A microsecond of slack: stamps are sums of periods.
    long = suspects.time - suspects.since >= gate.reacquire_after - 1e-6
    return long and suspects.hits >= gate.reacquire_samples


@dataclass(frozen=True)
class Rival:
    """What a state that was taken over said, kept alive in case that it was right."""

    offset: float
    """From what is believed now [units of the measurement]."""
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
    """The same, counted up to `LONGEST_SUPPORT`."""
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
    """Whether a measurement is believed, and the gate's memory after it.

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
    """As `judge`, for the distance of a measurement from a state that another sensor carries on, as a gyro does yaw.

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
"""Pitch beyond which the gyro tells no yaw rate."""
GATES = ("vision", "yaw", "depth")
"""Streams in the order of their gates."""
TAKEN, STEEP = (Outcome("imu", "accepted"),), (Outcome("imu", "steep"),)


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
    """Of the filter for logs without an orientation."""
    vision_time: float | None = None
    yaw_seen: float | None = None
    """Time of the latest vision yaw that was believed [s]."""
    depth_time: float | None = None
    imu_time: float | None = None
    velocity_time: float | None = None
    compass: bool = False
    """Whether yaw is what a compass says, offset included."""
    gates: tuple[GateMemory, ...] = (GateMemory(),) * 3
    """Memories of the gates, in the order of `GATES`."""


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
        return track, STEEP if steep else TAKEN

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
        track, seen = self._placed(track, "vision", sample.time, z, _H_VISION, R[:2, :2], [0, 1], lambda: z)
        if sample.yaw is None:
            return track, (seen,)
        track, turned = self._turned(track, sample.time, sample.yaw, float(R[2, 2]))
        track = changed(track, compass=track.compass and not turned.used)
        return track, (seen, turned)

    def velocity(self, track: Track, sample: VelocitySample) -> tuple[Track, tuple[Outcome, ...]]:
        """Take in a velocity over the floor, turned into the pool frame by the heading so far."""
        if track.yaw_seen is None or self.settings.aids is None:
            return track, (Outcome("velocity", "no heading"),)
        track = self._turned_to(self._positioned(track, sample.time), sample.time)
        R_pb = quat_to_matrix(quat_from_euler(track.roll, track.pitch, track.yaw.yaw))
        z = R_pb @ np.array(sample.velocity)
        turned = track.yaw.variance * float(z @ z) + self.settings.aids.velocity_bias**2
        R = (self.settings.aids.velocity_std**2 + turned) * np.eye(3)
        found = position_filter.innovation(track.position, _H_VELOCITY, z, R)
        position = position_filter.correct(track.position, found, _H_VELOCITY, R)
        track = changed(track, position=position, velocity_time=sample.time)
        return track, (Outcome("velocity", "accepted", float(found.mahalanobis), 3),)

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
        seen = track.yaw_seen is not None
        silent = track.rate is None or track.imu_time is None or time - track.imu_time > GYRO_HOLD
        return Estimate(
            time=time,
            x=x,
            P=P,
            yaw=yaw.yaw if seen else math.nan,
            yaw_variance=yaw.variance + track.gates[1].doubt if seen else math.nan,
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
        """The track after a fix or a depth that its gate has judged; `restart` is where the axes begin anew."""
        s, k = self.settings, GATES.index(stream)
        found = position_filter.innovation(track.position, H, z, R)
        distance = float(found.mahalanobis)
        verdict, memory = judge(s.gate, track.gates[k], time, z, R, distance, s.speed_std)
        position = track.position
        if verdict == "accepted":
            position = position_filter.correct(position, found, H, R)
        elif verdict != "gate":
            position = position_filter.restarted(position, axes, restart(), R, s.speed_std)
        gates = (*track.gates[:k], memory, *track.gates[k + 1 :])
        believed = {} if verdict == "gate" else {f"{stream}_time": time}
        track = changed(track, position=position, gates=gates, **believed)
        return track, Outcome(stream, verdict, distance, len(z))

    def _turned(self, track: Track, time: float, seen: float, variance: float) -> tuple[Track, Outcome]:
        s = self.settings
        found = attitude.innovation(track.yaw, seen, variance)
        # Flipped yaws agree with one another as distances from the prediction, which turns with the vehicle.
        carried = track.imu_time is not None and time - track.imu_time <= GYRO_HOLD
        distance = float(found.mahalanobis)
        verdict, memory = judge_carried(
            s.gate, track.gates[1], time, float(found.residual), variance, distance, 0.05, carried
        )
        if verdict == "accepted":
            yaw = attitude.correct(track.yaw, found, variance)
        elif verdict == "gate":
            yaw = track.yaw
        else:
            yaw = attitude.restarted(track.yaw, seen, variance, s.bias_std)
        then = track.yaw_seen if verdict == "gate" else time
        gates = (track.gates[0], memory, track.gates[2])
        track = changed(track, yaw=yaw, yaw_seen=then, gates=gates)
        return track, Outcome("yaw", verdict, found.mahalanobis, 1)

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
        """The track with its position at a time; axes without news slow down, then stand still."""
        s, then = self.settings, track.position_time
        if math.isnan(then) or time <= then:
            return changed(track, position_time=_later(then, time))
        position = track.position
        seen = max(-math.inf if t is None else t for t in (track.vision_time, track.velocity_time))
        dived = -math.inf if track.depth_time is None else track.depth_time
        for until in _steps(then, time, (seen + s.coast, seen + s.hold, dived + s.coast, dived + s.hold)):
            middle = 0.5 * (then + until)
            blind, deaf = middle - seen, middle - dived
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
    if sample.covariance is None or settings.vision_fixed:
        return _diagonal(settings.vision_std) + floor
    return np.array(sample.covariance) + floor


@lru_cache(maxsize=64)
def _diagonal(std: tuple[float, float]) -> Array:
    """Covariance of x, y and yaw that know nothing of each other, with a standard deviation of place and of yaw."""
    return np.diag([std[0] ** 2, std[0] ** 2, std[1] ** 2])


def motion_of(settings: Settings, xy_slows: bool, z_slows: bool) -> Motion:
    """The motion model where the axes without news slow down to rest, give or take `speed_std`."""
    slows = (xy_slows, xy_slows, z_slows)
    rate, own = settings.decay, settings.motion
    density = [
        2.0 * rate * settings.speed_std**2 if slow else q for slow, q in zip(slows, own.density, strict=True)
    ]
    decay = [rate if slow else given for slow, given in zip(slows, own.decay, strict=True)]
    return replace(own, density=(density[0], density[1], density[2]), decay=(decay[0], decay[1], decay[2]))


def _steps(start: float, end: float, cuts: Iterable[float]) -> list[float]:
    """Ends of the steps from `start` to `end` that are cut at `cuts`."""
    inside = {cut for cut in cuts if start < cut < end}
    return [*sorted(inside), end] if inside else [end]


def _later(then: float, time: float) -> float:
    return time if math.isnan(then) else max(then, time)
