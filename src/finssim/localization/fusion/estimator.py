"""The estimator: samples in, in any order and at any rate; the state at any time out."""

from __future__ import annotations

import math
from typing import Any, Protocol, TypeVar

from finssim.localization.errors import LocalizationError
from finssim.localization.fusion.fuse_constant_velocity import ConstantVelocity
from finssim.localization.fusion.fuse_error_state import ErrorState
from finssim.localization.fusion.fuse_settings import Settings, Site
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

__all__ = ["MODELS", "Estimator", "Model"]

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
    def estimate(self, track: S, time: float) -> Estimate: ...


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
        """Roll, pitch and depth at the time of an exposure, for the fit of its pose: between samples in a straight
        line, else from one within the freshness of its stream."""
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
