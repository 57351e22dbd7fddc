"""Pose estimator: accepts samples in any order and at any rate, and returns the state at any time."""

from __future__ import annotations

import bisect
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import numpy as np

from finssim.localization import LocalizationError
from finssim.localization.detection.detections import Frame
from finssim.localization.fusion.attitude import height_above_origin
from finssim.localization.fusion.constant_velocity import ConstantVelocity
from finssim.localization.fusion.error_state import ErrorState
from finssim.localization.fusion.fuse_log import counted, rows_of
from finssim.localization.fusion.fuse_settings import Settings, Site
from finssim.localization.fusion.sensors import SENSORS, Filter
from finssim.localization.fusion.streams import (
    DepthSample,
    Outcome,
    PoseEstimate,
    Sample,
    VisionSample,
    refusal,
)
from finssim.localization.poses import Constraints
from finssim.localization.poses.methods import TagLocator

__all__ = ["MODELS", "MODES", "Estimator", "Fixes", "Health", "health_of"]

S = TypeVar("S")

# Samples ordered by their times, so that a late sample is inserted at its own time.

SAME = 1e-7
"""Difference below which two time stamps count as equal [s]."""


@dataclass(frozen=True)
class OtherReadings:
    """Readings of the other sensors at the time of a picture."""

    roll: float
    """Roll [rad]; NaN if no IMU sample is near."""
    pitch: float
    depth: float
    """Depth of the pressure port [m]; NaN if no sample is near."""


class Timeline(Generic[S]):
    """Samples of the last `horizon` seconds with the state after each; `S` is any immutable state.

    An inserted sample and those after it are applied when `settle` is called, so that many samples that
    arrive together are processed in one pass, however late a robot's loop runs.
    """

    def __init__(self, start: S, horizon: float) -> None:
        """
        Args:
            start: State before any sample.
            horizon: Age up to which a late sample is accepted [s].
        """
        self.horizon = horizon
        self._ranks = {name: rank for rank, name in enumerate(("imu", *SENSORS))}
        """Order of samples of equal time, so that the result does not depend on the order of arrival."""
        self._before = start
        """State before the oldest retained sample."""
        self._closed = -math.inf
        """Time up to which samples have been discarded [s]."""
        self._keys: list[tuple[float, int]] = []
        self._samples: list[Sample] = []
        self._states: list[S] = []
        """States after the first samples, up to the earliest that has not been applied."""
        self._outcomes: list[tuple[Outcome, ...] | None] = []
        """Outcomes of each sample when it was last applied; None before."""

    @property
    def head(self) -> float:
        """Time of the newest sample [s]; -inf before the first."""
        return self._keys[-1][0] if self._keys else -math.inf

    @property
    def state(self) -> S:
        """State after the newest sample."""
        return self._states[-1] if self._states else self._before

    def state_at(self, time: float) -> S:
        """Return the state after the last retained sample that is not later than `time` [s]."""
        k = bisect.bisect_right(self._keys, (time + SAME, len(self._ranks)))
        return self._states[k - 1] if k else self._before

    def refusal(self, sample: Sample) -> str | None:
        """Return `too late` or `duplicate`, or None if the sample can be inserted."""
        if sample.time < max(self.head - self.horizon, self._closed):
            return "too late"
        k = bisect.bisect_left(self._keys, (sample.time - SAME, 0))
        while k < len(self._keys) and self._keys[k][0] <= sample.time + SAME:
            if self._samples[k].stream == sample.stream:
                return "duplicate"
            k += 1
        return None

    def insert(self, sample: Sample) -> None:
        """Insert a sample that `refusal` accepts; the states after it are recomputed by `settle`."""
        key = (sample.time, self._ranks[sample.stream])
        k = bisect.bisect_right(self._keys, key)
        self._keys.insert(k, key)
        self._samples.insert(k, sample)
        self._outcomes.insert(k, None)
        del self._states[k:]

    def settle(
        self, apply: Callable[[S, Sample], tuple[S, tuple[Outcome, ...]]]
    ) -> list[tuple[Sample, tuple[Outcome, ...] | None, tuple[Outcome, ...]]]:
        """Apply the samples that were inserted since the last call, and reapply those after them.

        Args:
            apply: Function of state and sample that returns the state after it and the outcomes.

        Returns:
            Samples in the order of their times, each with its former outcomes and its new ones.
        """
        state, settled = self.state, []
        for k in range(len(self._states), len(self._samples)):
            state, outcome = apply(state, self._samples[k])
            self._states.append(state)
            settled.append((self._samples[k], self._outcomes[k], outcome))
            self._outcomes[k] = outcome
        self._forget()
        return settled

    def _forget(self) -> None:
        """Discard samples older than the horizon; the state after them is kept."""
        k = bisect.bisect_left(self._keys, (self.head - self.horizon, 0))
        if k < 32:  # in batches: deleting from the front of a list costs time proportional to its length
            return
        self._before, self._closed = self._states[k - 1], self._keys[k - 1][0]
        del self._keys[:k], self._samples[:k], self._states[:k], self._outcomes[:k]

    def depth_at(self, time: float, longest: float) -> float:
        """Return the depth at a time [m], interpolated linearly, or that of the nearest sample within
        `longest` [s]; else NaN."""
        near = [self._samples[i] for i in self._around(time, "depth")]
        return _between([(s.time, s.depth) for s in near if isinstance(s, DepthSample)], time, longest)

    def tilt_at(
        self, time: float, longest: float, tilt: Callable[[S], tuple[float, float]]
    ) -> tuple[float, float]:
        """Return roll and pitch at a time [rad], interpolated between the states after the IMU samples, as
        `depth_at`."""
        near = [(self._keys[i][0], *tilt(self._states[i])) for i in self._around(time, "imu")]
        return (
            _between([(t, roll) for t, roll, _ in near], time, longest),
            _between([(t, pitch) for t, _, pitch in near], time, longest),
        )

    def _around(self, time: float, stream: str) -> list[int]:
        """Return the indices of the last sample of a stream before a time and of the first not before it, if they
        exist."""
        k = bisect.bisect_left(self._keys, (time, -1))
        before = next((i for i in range(k - 1, -1, -1) if self._samples[i].stream == stream), None)
        after = next((i for i in range(k, len(self._keys)) if self._samples[i].stream == stream), None)
        return [i for i in (before, after) if i is not None]


def _between(points: list[tuple[float, float]], time: float, longest: float) -> float:
    """Return the value at a time from time-ordered points, by interpolation or the nearest one; NaN if none
    is within `longest`."""
    k = bisect.bisect_left(points, (time, -math.inf))
    earlier = points[k - 1] if k and time - points[k - 1][0] <= longest else None
    later = points[k] if k < len(points) and points[k][0] - time <= longest else None
    if earlier and later:
        share = (time - earlier[0]) / max(later[0] - earlier[0], 1e-12)
        return earlier[1] + share * (later[1] - earlier[1])
    nearest = earlier or later
    return nearest[1] if nearest else math.nan


# Status of the estimator: vision mode, ages, readiness, and refused samples with reasons.

MODES = ("uninitialized", "fresh", "coast", "hold", "lost")


@dataclass(frozen=True)
class Health:
    """Status of the estimator at one time."""

    ready: bool
    """True if initialized, every sensor is fresh, vision is fresh or coasting, and the variances are within
    the limits."""
    initialized: bool
    vision_mode: str
    """One of `MODES`."""
    vision_fresh: bool
    imu_fresh: bool
    depth_fresh: bool
    age_vision: float
    """Age of the latest vision fix [s]; NaN before the first."""
    age_imu: float
    """Age of the latest IMU sample [s]."""
    age_depth: float
    """Age of the latest depth [s]."""
    reject_reason: str
    """Stream and reason of the latest refusal; empty before the first."""
    mahalanobis: dict[str, float]
    """Squared Mahalanobis distance of each stream's latest measurement [-]."""
    position_covariance: tuple[float, ...]
    """Diagonal, position [m²] then velocity [m²/s²], (6,)."""
    yaw_covariance: float
    """Variance of yaw [rad²]."""
    velocity_world: tuple[float, ...]
    """Velocity, world axes [m/s]."""
    counts: dict[str, dict[str, int]] = field(default_factory=dict)
    """Stream -> verdict -> number of samples."""

    def as_json(self) -> dict[str, Any]:
        """Return the status as plain values; unknown numbers are None."""
        return {
            "vision_source": "overhead_tags",
            **{name: _plain(value) for name, value in self.__dict__.items()},
        }


def mode_of(age: float, settings: Settings) -> str:
    """Return the vision mode for an age of vision [s]; NaN if there was no fix."""
    if math.isnan(age):
        return "uninitialized"
    limits = {mode: getattr(settings.ages, mode) for mode in MODES[1:4]}
    return next((mode for mode, limit in limits.items() if age <= limit + 1e-9), MODES[-1])


def health_of(
    estimate: PoseEstimate,
    settings: Settings,
    site: Site,
    latest: dict[str, float],
    reason: str,
    counts: dict[str, dict[str, int]],
) -> Health:
    """Return the status that belongs to an estimate.

    Args:
        estimate: The estimate.
        settings: Limits of ages and variances.
        site: Site whose rotation converts velocities to world axes.
        latest: Squared Mahalanobis distance [-] of each stream's latest measurement.
        reason: Stream and reason of the latest refusal.
        counts: Stream -> verdict -> number of samples.
    """
    vision, imu, depth = (
        math.nan if then is None else estimate.time - then
        for then in (estimate.vision_time, estimate.imu_time, estimate.depth_time)
    )
    times = [t for t in (estimate.vision_time, estimate.velocity_time) if t is not None]
    mode = mode_of(
        estimate.time - max(times) if times and estimate.vision_time is not None else vision, settings
    )
    variances = estimate.P.diagonal().tolist()
    vx, vy, vz = estimate.x[3:].tolist()
    imu_fresh, depth_fresh = imu <= settings.ages.imu_fresh + 1e-9, depth <= settings.ages.depth_fresh + 1e-9
    finite = all(map(math.isfinite, (*variances[:3], estimate.yaw_variance)))
    sure = finite and max(variances[:3]) <= settings.ready_position
    return Health(
        ready=sure
        and estimate.yaw_variance <= settings.ready_yaw
        and imu_fresh
        and depth_fresh
        and mode in ("fresh", "coast"),
        initialized=finite,
        vision_mode=mode,
        vision_fresh=mode == "fresh",
        imu_fresh=imu_fresh,
        depth_fresh=depth_fresh,
        age_vision=vision,
        age_imu=imu,
        age_depth=depth,
        reject_reason=reason,
        mahalanobis=dict(latest),
        position_covariance=tuple(variances),
        yaw_covariance=estimate.yaw_variance,
        velocity_world=tuple(a * vx + b * vy + c * vz for a, b, c in site.R_wp),
        counts={stream: dict(verdicts) for stream, verdicts in counts.items()},
    )


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


AGREED = 10
"""Number of consecutive samples on another clock after which that clock is accepted."""
UNHEARD = 10.0
"""Gap between samples without arrival times that still counts as a silence rather than a clock jump [s]."""


MODELS: dict[str, Callable[[Settings, Site], Filter[Any]]] = {
    "constant-velocity": ConstantVelocity,
    "error-state": ErrorState,
}
"""Name -> factory of the filter from settings and site."""


class Estimator:
    """Estimator of position, velocity and attitude of one vehicle from the available sensors: IMU and depth;
    position fixes of a camera, motion capture or acoustics; Doppler velocity and compass.

    Samples are processed in the order of their times, not of their arrival: the state is the same for any
    delivery within the horizon. Unusable samples are counted with the reason and never raise an exception.
    """

    def __init__(
        self, settings: Settings | None = None, site: Site | None = None, *, mode: str = "constant-velocity"
    ) -> None:
        """
        Args:
            settings: Tunable settings; None: the defaults.
            site: Parameters of pool and vehicle, made by `site_of`.
            mode: A name in `MODELS`.

        Raises:
            LocalizationError: The mode is unknown.
        """
        if mode not in MODELS:
            raise LocalizationError(f"unknown estimator '{mode}'; available: {', '.join(MODELS)}")
        self.settings, self.site = settings or Settings(), site or Site()
        self._model = MODELS[mode](self.settings, self.site)
        self._counts: dict[str, dict[str, int]] = {name: {} for name in ("imu", *SENSORS)}
        self._latest: dict[str, float] = {}
        self._reason = ""
        self.nis: dict[str, tuple[float, int]] = dict.fromkeys(SENSORS, (0.0, 0))
        """Sensor -> sum of squared Mahalanobis distances of accepted measurements, and sum of their dimensions."""
        self._arrived = -math.inf
        self._other: list[float] = []
        self._timeline: Timeline[Any] = Timeline(self._model.start(), self.settings.ages.horizon)

    def add(self, sample: Sample) -> str:
        """Add a sample and apply it.

        Returns:
            `accepted`, or the reason of the refusal; for a fix, the verdict on its position.
        """
        reason = self.put(sample)
        return reason or next(new for item, _, new in self._settle() if item is sample)[0].verdict

    def put(self, sample: Sample) -> str | None:
        """Add a sample, which is applied when the state is needed.

        Returns:
            Reason if the sample is refused before it is applied, else None.
        """
        reason = refusal(sample) or self._clock(sample) or self._timeline.refusal(sample)
        if reason is not None:
            return self.refuse(sample.stream, reason)
        self._timeline.insert(sample)
        self._arrived = max(self._arrived, sample.time if sample.arrival is None else sample.arrival)
        return None

    def _settle(self) -> list[tuple[Sample, tuple[Outcome, ...] | None, tuple[Outcome, ...]]]:
        """Apply the added samples, and count their outcomes."""
        settled = self._timeline.settle(self._model.apply)
        for _, old, new in settled:
            # Skip an outcome that is the same object as before: most are, those of IMU samples.
            if old is new:
                continue
            if old is not None:
                self._tally(old, -1)
            self._tally(new, +1)
            for outcome in new if old is None else ():
                if math.isfinite(outcome.mahalanobis):
                    self._latest[outcome.stream] = outcome.mahalanobis
                if not outcome.used:
                    self._reason = f"{outcome.stream}: {outcome.verdict}"
        return settled

    def refuse(self, stream: str, reason: str) -> str:
        """Count data that did not become a sample, such as a picture without tags, and return the reason."""
        self._count(stream, reason, 1)
        self._reason = f"{stream}: {reason}"
        return reason

    def estimate(self, time: float | None = None) -> PoseEstimate:
        """Return the estimate at a time [s], by default that of the newest sample; later times are predicted.

        For a time within the horizon, the estimate follows from the samples up to that time that have arrived.
        """
        self._settle()
        if time is None:
            time = self._timeline.head if math.isfinite(self._timeline.head) else 0.0
        track = self._timeline.state_at(time) if time < self._timeline.head else self._timeline.state
        return self._model.estimate(track, time)

    def health(self, estimate: PoseEstimate) -> Health:
        """Return the status that belongs to an estimate."""
        self._settle()
        return health_of(estimate, self.settings, self.site, self._latest, self._reason, self._counts)

    def at(self, time: float) -> OtherReadings:
        """Return roll, pitch and depth at the time of an exposure [s], for the fit of its pose.

        Values are interpolated linearly between samples, else taken from one within the freshness limit of
        its stream.
        """
        self._settle()
        s = self.settings
        roll, pitch = self._timeline.tilt_at(time, s.ages.imu_fresh, self._model.tilt)
        return OtherReadings(roll, pitch, self._timeline.depth_at(time, s.ages.depth_fresh))

    @property
    def counts(self) -> dict[str, dict[str, int]]:
        """Stream -> verdict -> number of samples."""
        self._settle()
        return {stream: dict(verdicts) for stream, verdicts in self._counts.items()}

    def _restart(self) -> None:
        self._settle()
        self._timeline = Timeline(self._model.start(), self.settings.ages.horizon)
        self._arrived = -math.inf

    def _clock(self, sample: Sample) -> str | None:
        """Refuse a time stamp that jumps relative to its arrival, until enough samples agree on the other clock.

        A silence of all sensors is not a jump if arrival times are given, since they advance by the same
        time. After a forward jump the state is predicted over it; after a backward jump the estimator
        restarts.
        """
        head = self._timeline.head
        if math.isinf(head):
            return None
        # Without arrival times, silence and jump cannot be distinguished, and silences are more frequent.
        waited = UNHEARD if sample.arrival is None else max(0.0, sample.arrival - self._arrived)
        forward = sample.time - head > waited + self.settings.ages.jump
        if not forward and sample.time >= head - max(self.settings.ages.horizon, self.settings.ages.jump):
            self._other = []
            return None
        if self._other and abs(sample.time - self._other[-1]) > self.settings.ages.jump:
            self._other = []
        self._other.append(sample.time)
        if len(self._other) < AGREED:
            return "clock jump" if forward else "too late"
        if not forward:
            self._restart()
            self._count("clock", "restart", 1)
        self._other = []
        return None

    def _tally(self, outcomes: tuple[Outcome, ...], sign: int) -> None:
        for outcome in outcomes:
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


# Position fixes from pictures with tags, with the estimator's depth and tilt at the exposure.


class Fixes:
    """Converter from pictures with tags to position fixes."""

    def __init__(self, locator: TagLocator) -> None:
        """
        Args:
            locator: Locator that measures the poses.
        """
        self._locate = locator

    def fix(self, frame: Frame, estimator: Estimator) -> VisionSample | str:
        """Return the fix of one picture, or the reason for having none.

        Args:
            frame: The picture's tags; its stamp is that of its arrival.
            estimator: Estimator that provides depth and tilt at the exposure, from the samples that have arrived.
        """
        if not math.isfinite(frame.time):
            return "time not finite"
        if not frame.detections:
            return "no tag"
        time = frame.time - self._locate.pool.latency
        constraints = self._constraints(time, estimator)
        if constraints is None and self._locate.needs_height:
            return "no depth or tilt"
        measurement = self._locate(frame.detections, constraints)
        if not measurement.ok:
            return counted(measurement.reason)
        R = np.asarray(measurement.covariance, float)
        return VisionSample(
            time, (measurement.x, measurement.y), measurement.yaw, rows_of(0.5 * (R + R.T)), frame.time
        )

    def _constraints(self, time: float, estimator: Estimator) -> Constraints | None:
        near, site = estimator.at(time), estimator.site
        if math.isnan(near.depth) or math.isnan(near.roll) or math.isnan(near.pitch):
            return None
        lever = height_above_origin(site.depth_port, near.roll, near.pitch)
        return Constraints(
            z_b=-near.depth - site.offset - lever,
            z_std=estimator.settings.depth_std,
            roll=near.roll,
            pitch=near.pitch,
            up=site.up,
            port=site.depth_port,
        )
