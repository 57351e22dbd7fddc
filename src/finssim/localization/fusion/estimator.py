"""The estimator: samples in, in any order and at any rate; the state at any time out."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from finssim.geometry.rotations import (
    cross,
    matrix_to_quat,
    quat_from_euler,
    quat_multiply,
    quat_to_matrix,
    wrap_angle,
)
from finssim.localization.errors import LocalizationError
from finssim.localization.fusion import error_state, fuse_restart
from finssim.localization.fusion.attitude import roll_pitch
from finssim.localization.fusion.changed import changed
from finssim.localization.fusion.error_state import ErrorStateNoise, InertialState
from finssim.localization.fusion.fuse_constant_velocity import (
    GYRO_HOLD,
    ConstantVelocity,
    Track,
    motion_of,
    vision_covariance,
)
from finssim.localization.fusion.fuse_settings import Settings, Site
from finssim.localization.fusion.gate import GateMemory, judge, judge_carried
from finssim.localization.fusion.health import Estimate, Health, Outcome, health_of
from finssim.localization.fusion.streams import (
    DepthSample,
    HeadingSample,
    ImuSample,
    Sample,
    VelocitySample,
    VisionSample,
    refusal,
)
from finssim.localization.fusion.timeline import Surroundings, Timeline
from finssim.localization.poses.measurement import axes_of_up

__all__ = ["MODELS", "Estimator", "Model"]

# Fusion with the IMU's acceleration: the error-state filter behind the same gates, states and timings.

Array = npt.NDArray[np.float64]

TILT_CAP = 0.5
"""Doubt of roll and pitch does not grow beyond this [rad]."""


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
    """Memories of the gates of position, yaw, depth, Doppler velocity and compass."""
    roll: float = 0.0
    pitch: float = 0.0


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
                roll=before.roll,
                pitch=before.pitch,
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
        s, track = self.settings, self._until(track, sample.time)
        assert track.inertial is not None
        height, H = error_state.depth_model(track.inertial, self._port, self._up, self.site.offset)
        residual, R = -sample.depth - height, np.array([[s.depth_std**2]])
        distance, gain = error_state.error_innovation(track.inertial, residual, H, R)
        verdict, memory = judge(
            s.gate, track.gates[2], sample.time, residual, R, float(distance), s.speed_std
        )
        state = track.inertial
        if verdict == "accepted":
            state = error_state.correct(state, residual, H, R, gain)
        elif verdict == "reacquired":
            state = fuse_restart.restarted(state, [2], state.p[2:] + residual / self._up[2], R, s.speed_std)
        then = track.depth_time if verdict == "gate" else sample.time
        gates = (*track.gates[:2], memory, *track.gates[3:])
        track = self._kept(changed(track, inertial=state, depth_time=then, gates=gates))
        return track, (Outcome("depth", verdict, float(distance), 1),)

    def vision(self, track: InertialTrack, sample: VisionSample) -> tuple[InertialTrack, tuple[Outcome, ...]]:
        """Take in a fix of the camera."""
        if track.inertial is None:
            before, outcomes = self._before.vision(track.before, sample)
            return self._begun(changed(track, before=before), sample.time), outcomes
        R = vision_covariance(sample, self.settings)
        track, seen = self._fixed(self._until(track, sample.time), sample, R[:2, :2])
        if sample.yaw is None:
            return self._kept(track), (seen,)
        track, turned = self._turned(track, sample, R[2:, 2:])
        return self._kept(track), (seen, turned)

    def velocity(
        self, track: InertialTrack, sample: VelocitySample
    ) -> tuple[InertialTrack, tuple[Outcome, ...]]:
        """Take in a velocity over the floor."""
        s = self.settings
        if track.inertial is None or s.aids is None:
            before, outcomes = self._before.velocity(track.before, sample)
            return changed(track, before=before), outcomes
        track = self._until(track, sample.time)
        state = track.inertial
        assert state is not None
        expected, H = error_state.velocity_model(state, np.array(track.omega), self._log)
        seen, R = np.array(sample.velocity), s.aids.velocity_std**2 * np.eye(3)
        distance, gain = error_state.error_innovation(state, seen - expected, H, R)
        verdict, memory = judge(s.gate, track.gates[3], sample.time, seen, R, float(distance), 1.0)
        if (
            verdict != "gate"
        ):  # what the log says of velocity is believed in the end, whatever was thought before
            state = error_state.correct(state, seen - expected, H, R, gain)
        then = track.velocity_time if verdict == "gate" else sample.time
        gates = (*track.gates[:3], memory, track.gates[4])
        track = self._kept(changed(track, inertial=state, velocity_time=then, gates=gates))
        return track, (Outcome("velocity", verdict, float(distance), 3),)

    def heading(
        self, track: InertialTrack, sample: HeadingSample
    ) -> tuple[InertialTrack, tuple[Outcome, ...]]:
        """Take in a heading."""
        s = self.settings
        if track.inertial is None or s.aids is None:
            before, outcomes = self._before.heading(track.before, sample)
            return self._begun(changed(track, before=before), sample.time), outcomes
        track = self._until(track, sample.time)
        state = track.inertial
        assert state is not None
        expected, H = error_state.heading_model(state)
        residual, R = wrap_angle(np.array([sample.yaw]) - expected), np.array([[s.aids.heading_std**2]])
        distance, gain = error_state.error_innovation(state, residual, H, R)
        verdict, memory = judge(s.gate, track.gates[4], sample.time, residual, R, float(distance), 0.05)
        if verdict != "gate":
            state = error_state.correct(state, residual, H, R, gain)
        track = changed(track, inertial=state, gates=(*track.gates[:4], memory))
        return self._kept(track), (Outcome("heading", verdict, float(distance), 1),)

    def estimate(self, track: InertialTrack, time: float) -> Estimate:
        """The state at a time [s], not before its own."""
        if track.inertial is None:
            return self._before.estimate(track.before, time)
        track = self._until(track, time)
        state = track.inertial
        assert state is not None
        T, x = self._to_body(state, np.array(track.omega))
        aided = _aided(track)
        old = aided is None or time - aided > self.settings.hold
        if old:
            x[3:5] = 0.0
        yaw, H = error_state.yaw_model(state)
        rates = quat_to_matrix(state.q) @ (np.array(track.omega) - state.gyro_bias)
        return Estimate(
            time=time,
            x=x,
            P=T @ state.covariance @ T.T,
            yaw=float(yaw[0]),
            yaw_variance=float((H @ state.covariance @ H.T)[0, 0]) + track.gates[1].doubt,
            yaw_rate=float(H[0, 6:9] @ rates),
            roll=track.roll,
            pitch=track.pitch,
            vision_time=track.vision_time,
            depth_time=track.depth_time,
            imu_time=track.imu_time,
            velocity_time=track.velocity_time,
        )

    def _to_body(self, state: InertialState, omega: Array) -> tuple[Array, Array]:
        """Jacobian (6, n) of the body origin's position and velocity, and their values (6,)."""
        position, H = error_state.position_model(state, self._body)
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
        known = self._before.estimate(before, time)
        level = quat_from_euler(known.roll, known.pitch, known.yaw)
        from_level = axes_of_up(self.site.up)
        R = from_level @ quat_to_matrix(level)
        q = quat_multiply(matrix_to_quat(from_level), level)
        extra = 0 if s.aids is None else error_state.AIDED
        covariance = np.zeros((15 + extra, 15 + extra))
        covariance[:6, :6] = known.P
        covariance[6:9, 6:9] = np.diag([s.tilt_std**2, s.tilt_std**2, known.yaw_variance])
        covariance[9:15, 9:15] = np.diag([s.bias_std**2] * 3 + [s.accel_bias_std**2] * 3)
        if s.aids is not None:
            a = s.aids
            covariance[15:, 15:] = np.diag(
                np.square([a.heading_bias, a.velocity_scale, *[a.velocity_bias] * 3])
            )
            if before.compass:  # yaw is then what the compass said, less its offset
                covariance[8, 8] += a.heading_bias**2
                covariance[8, 15] = covariance[15, 8] = -(a.heading_bias**2)
        state = InertialState(
            known.x[:3] - R @ self._body,
            known.x[3:],
            q,
            np.zeros(3),
            np.zeros(3),
            covariance,
            np.zeros(extra),
        )
        gates = (*before.gates, GateMemory(1), GateMemory(1))
        track = changed(track, inertial=state, time=time, vision_time=before.vision_time, gates=gates)
        return self._kept(changed(track, depth_time=before.depth_time))

    def _fixed(self, track: InertialTrack, sample: VisionSample, R: Array) -> tuple[InertialTrack, Outcome]:
        s, state = self.settings, track.inertial
        assert state is not None
        position, H = error_state.position_model(state, self._body)
        seen = np.array(sample.position)
        residual, H = seen - position[:2], H[:2]
        distance, gain = error_state.error_innovation(state, residual, H, R)
        verdict, memory = judge(s.gate, track.gates[0], sample.time, seen, R, float(distance), s.speed_std)
        if verdict == "accepted":
            state = error_state.correct(state, residual, H, R, gain)
        elif verdict == "reacquired":
            state = fuse_restart.restarted(state, [0, 1], state.p[:2] + residual, R, s.speed_std)
        then = track.vision_time if verdict == "gate" else sample.time
        track = changed(track, inertial=state, vision_time=then, gates=(memory, *track.gates[1:]))
        return track, Outcome("vision", verdict, float(distance), 2)

    def _turned(self, track: InertialTrack, sample: VisionSample, R: Array) -> tuple[InertialTrack, Outcome]:
        s, state = self.settings, track.inertial
        assert state is not None
        yaw, H = error_state.yaw_model(state)
        residual = wrap_angle(np.array([sample.yaw]) - yaw)
        distance, gain = error_state.error_innovation(state, residual, H, R)
        carried = track.imu_time is not None and sample.time - track.imu_time <= GYRO_HOLD
        apart, variance = float(residual[0]), float(R[0, 0])
        verdict, memory = judge_carried(
            s.gate, track.gates[1], sample.time, apart, variance, float(distance), 0.05, carried
        )
        if verdict == "accepted":
            state = error_state.correct(state, residual, H, R, gain)
        elif verdict == "reacquired":
            state = fuse_restart.turned(state, float(residual[0]), float(R[0, 0]))
        track = changed(track, inertial=state, gates=(track.gates[0], memory, *track.gates[2:]))
        return track, Outcome("yaw", verdict, float(distance), 1)

    def _until(self, track: InertialTrack, time: float) -> InertialTrack:
        """The track at a time; velocity without news is drawn to rest, and then the position stands still."""
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
        return self._kept(
            changed(track, inertial=fuse_restart.capped(state, s.largest_variance, TILT_CAP), time=time)
        )

    def _step(
        self, state: InertialState, track: InertialTrack, dt: float, *, blind: bool, age: float
    ) -> InertialState:
        s, lost = self.settings, age > self.settings.hold
        if lost:
            state = fuse_restart.stopped(state, [0, 1])
        if blind or track.force is None:
            return error_state.drift(state, dt, self._drifts[age > s.coast], s.blind_rate)
        omega, force = np.array(track.omega), np.array(track.force)
        after = error_state.predict(state, omega, force, dt, self._noise, self._gravity)
        if age <= s.coast:
            return after
        if (
            lost
        ):  # the place is no longer told by the accelerometer, only that the vehicle may be anywhere near
            walk = 2.0 * s.speed_std**2 / s.decay * dt
            after = fuse_restart.parted(changed(after, p=np.append(state.p[:2], after.p[2])), [0, 1], walk)
        H = np.eye(len(after.covariance))[3:5]
        R = np.eye(2) * s.speed_std**2 / (s.decay * dt)
        residual = -after.v[:2]
        gain = error_state.error_innovation(after, residual, H, R)[1]
        return error_state.correct(after, residual, H, R, gain)

    def _kept(self, track: InertialTrack) -> InertialTrack:
        """The track with roll and pitch read from its attitude."""
        assert track.inertial is not None
        roll, pitch = roll_pitch(self._up @ quat_to_matrix(track.inertial.q))
        return changed(track, roll=float(roll), pitch=float(pitch))


def _aided(track: InertialTrack) -> float | None:
    """Time of the latest fix or Doppler velocity [s]; None before the first."""
    told = [t for t in (track.vision_time, track.velocity_time) if t is not None]
    return max(told) if told else None


def _mean(a: tuple[float, float, float], b: tuple[float, float, float]) -> tuple[float, float, float]:
    return 0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1]), 0.5 * (a[2] + b[2])


S = TypeVar("S")

STREAMS = ("imu", "depth", "vision", "yaw", "velocity", "heading")
AGREED = 10
"""Samples on one other clock after which that clock is believed."""
UNHEARD = 10.0
"""Silence that is taken for one where samples tell no arrival [s]."""


class Model(Protocol[S]):
    """What moves a state from sample to sample: pure functions of it."""

    settings: Settings
    site: Site

    def start(self) -> S: ...
    def imu(self, track: S, sample: ImuSample) -> tuple[S, tuple[Outcome, ...]]: ...
    def depth(self, track: S, sample: DepthSample) -> tuple[S, tuple[Outcome, ...]]: ...
    def vision(self, track: S, sample: VisionSample) -> tuple[S, tuple[Outcome, ...]]: ...
    def velocity(self, track: S, sample: VelocitySample) -> tuple[S, tuple[Outcome, ...]]: ...
    def heading(self, track: S, sample: HeadingSample) -> tuple[S, tuple[Outcome, ...]]: ...
    def estimate(self, track: S, time: float) -> Estimate:
        """The state at a time [s]."""


MODELS: dict[str, Any] = {"constant-velocity": ConstantVelocity, "error-state": ErrorState}
"""Name -> model, made from settings and site."""


class Estimator:
    """Position, velocity and attitude of one vehicle from what it has: IMU and depth; fixes of a camera, of motion
    capture or of acoustics; Doppler velocity and compass.

    Samples are put in the order of their times, whatever the order in which they come: the state is the same for any
    delivery within the horizon. What cannot be used is counted with its reason, and never raises.
    """

    def __init__(
        self, settings: Settings | None = None, site: Site | None = None, *, mode: str = "constant-velocity"
    ) -> None:
        """
        Args:
            settings: What can be tuned; the defaults if None.
            site: What of pool and vehicle is needed; `site_of` makes it.
            mode: A name of `MODELS`.

        Raises:
            LocalizationError: Unknown mode.
        """
        if mode not in MODELS:
            raise LocalizationError(f"unknown mode '{mode}'; available: {', '.join(MODELS)}")
        self.settings, self.site = settings or Settings(), site or Site()
        self._model = MODELS[mode](self.settings, self.site)
        self._counts: dict[str, dict[str, int]] = {stream: {} for stream in STREAMS}
        self._latest: dict[str, float] = {}
        self._reason = ""
        self.nis: dict[str, tuple[float, int]] = dict.fromkeys(
            ("vision", "yaw", "depth", "velocity", "heading"), (0.0, 0)
        )
        """Stream -> sum of squared Mahalanobis distances of accepted measurements, and of their dimensions."""
        self._arrived = -math.inf
        self._other: list[float] = []
        self._timeline: Timeline[Any] = Timeline(self._model.start(), self.settings.horizon)

    def add(self, sample: Sample) -> str:
        """Take in a sample.

        Returns:
            `accepted`, or why it was refused; a fix's is that of its position.
        """
        reason = refusal(sample) or self._clock(sample) or self._timeline.refusal(sample)
        if reason is not None:
            return self.refuse(sample.stream, reason)
        gone, now = self._timeline.insert(sample, self._apply)
        # An outcome that is the same object as before stands: those of the IMU's samples, which are most.
        other = [pair for pair in zip(gone, now[1:], strict=True) if pair[0] is not pair[1]]
        self._tally([old for old, _ in other], -1)
        self._tally([now[0], *(new for _, new in other)], +1)
        self._arrived = max(self._arrived, sample.time if sample.arrival is None else sample.arrival)
        for outcome in now[0]:
            if math.isfinite(outcome.mahalanobis):
                self._latest[outcome.stream] = outcome.mahalanobis
            if not outcome.used:
                self._reason = f"{outcome.stream}: {outcome.verdict}"
        return now[0][0].verdict

    def refuse(self, stream: str, reason: str) -> str:
        """Count what never became a sample, such as a picture without tags; returns the reason."""
        self._count(stream, reason, 1)
        self._reason = f"{stream}: {reason}"
        return reason

    def estimate(self, time: float | None = None) -> Estimate:
        """The state at a time [s]: predicted beyond the newest sample, which is the default.

        For a time within the horizon it is the state after the samples up to then, as far as they have come.
        """
        if time is None:
            time = self._timeline.head if math.isfinite(self._timeline.head) else 0.0
        track = self._timeline.state_at(time) if time < self._timeline.head else self._timeline.state
        found: Estimate = self._model.estimate(track, time)
        return found

    def health(self, estimate: Estimate) -> Health:
        """The condition that goes with an estimate."""
        return health_of(estimate, self.settings, self.site, self._latest, self._reason, self._counts)

    def at(self, time: float) -> Surroundings:
        """Roll, pitch and depth at the time of an exposure [s], for the fit of its pose: between samples in a straight
        line, else from one within the freshness of its stream.
        """
        s = self.settings
        roll, pitch = self._timeline.tilt_at(time, s.imu_fresh, lambda track: (track.roll, track.pitch))
        return Surroundings(roll, pitch, self._timeline.depth_at(time, s.depth_fresh))

    @property
    def counts(self) -> dict[str, dict[str, int]]:
        """Stream -> verdict -> samples."""
        return {stream: dict(verdicts) for stream, verdicts in self._counts.items()}

    def _restart(self) -> None:
        self._timeline = Timeline(self._model.start(), self.settings.horizon)
        self._arrived = -math.inf

    def _apply(self, track: Any, sample: Sample) -> tuple[Any, tuple[Outcome, ...]]:
        result: tuple[Any, tuple[Outcome, ...]] = getattr(self._model, sample.stream)(track, sample)
        return result

    def _clock(self, sample: Sample) -> str | None:
        """Refuse a stamp that runs away from its arrival, until enough samples agree on the other clock.

        A silence of all sensors is no such jump where arrivals are given, for those go on meanwhile. Forwards the state
        is then predicted over the jump; backwards nothing is known of the time between, and all starts anew.
        """
        head = self._timeline.head
        if math.isinf(head):
            return None
        # Without arrivals a silence and a jump look alike, and silences are commoner.
        waited = UNHEARD if sample.arrival is None else max(0.0, sample.arrival - self._arrived)
        forward = sample.time - head > waited + self.settings.jump
        if not forward and sample.time >= head - max(self.settings.horizon, self.settings.jump):
            self._other = []
            return None
        if self._other and abs(sample.time - self._other[-1]) > self.settings.jump:
            self._other = []
        self._other.append(sample.time)
        if len(self._other) < AGREED:
            return "clock jump" if forward else "too late"
        if not forward:
            self._restart()
            self._count("clock", "restart", 1)
        self._other = []
        return None

    def _tally(self, outcomes: list[tuple[Outcome, ...]], sign: int) -> None:
        for group in outcomes:
            for outcome in group:
                self._count(outcome.stream, outcome.verdict, sign)
                if outcome.verdict == "accepted" and outcome.stream in self.nis:
                    total, numbers = self.nis[outcome.stream]
                    self.nis[outcome.stream] = (
                        total + sign * outcome.mahalanobis,
                        numbers + sign * outcome.dimension,
                    )

    def _count(self, stream: str, verdict: str, step: int) -> None:
        verdicts = self._counts.setdefault(stream, {})
        verdicts[verdict] = verdicts.get(verdict, 0) + step
        if not verdicts[verdict]:
            del verdicts[verdict]
