"""What a check of trials says, as data."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Literal

from finssim.calibration.findings import Finding

__all__ = ["PARAMETERS", "THRUST", "AxisReport", "StreamReport", "Told", "TrialReport", "Verdict"]

Verdict = Literal["usable", "usable with care", "refused"]

PARAMETERS = ("m_eff", "d1", "d2", "bias", "k", "thrust_scale", "thrust_lag", "buoyancy")
"""What a trial may tell of an axis; k of roll and pitch, buoyancy of heave."""

THRUST = ("bias", "k", "thrust_scale", "thrust_lag", "buoyancy")
"""Of these, what a passive trial does not tell because no thrust is known."""


@dataclass(frozen=True, kw_only=True)
class StreamReport:
    """Columns that are sampled together."""

    columns: tuple[str, ...]
    group: str
    samples: int
    rate: float
    """Samples per second while there are any [Hz]."""
    jitter: float
    """Standard deviation of the time between samples, gaps aside, over its mean."""
    gaps: int
    longest_gap: float
    """[s]"""
    missing: float
    """Part of the trial's time without this stream."""


@dataclass(frozen=True, kw_only=True)
class Told:
    """Whether a trial tells a parameter."""

    can: bool
    why: str


@dataclass(frozen=True, kw_only=True)
class AxisReport:
    """Excitation of one axis and what follows from it."""

    axis: str
    source: str
    """Of the velocity: measured, derived from ..., or nothing."""
    fastest: float
    """95th percentile of the speed [m/s, rad/s]."""
    noise: float
    """Of one velocity sample [m/s, rad/s]."""
    decades: float
    """log10 of the fastest over the slowest speed that stands out of the noise."""
    strongest: float
    """95th percentile of the wrench [N, N m]."""
    levels: tuple[float, ...]
    """Wrenches that were held for half a second or more [N, N m]."""
    work: float
    """Done by the inputs along this axis [J]; of a passive trial 0."""
    both_directions: bool
    driven: float
    """Time of input [s]."""
    coasts: float
    """Time of motion without input [s]."""
    rests: float
    """Time without input and motion [s]."""
    excited: bool
    tells: dict[str, Told] = field(default_factory=dict)
    """By parameter."""


@dataclass(frozen=True, kw_only=True)
class TrialReport:
    """One trial."""

    name: str
    vehicle: str | None
    role: str | None
    duration: float
    """[s]"""
    rows: int
    inputs: str
    """What drove it: rpm, force, tau, pwm, command, passive, or nothing."""
    streams: tuple[StreamReport, ...]
    axes: tuple[AxisReport, ...]
    offsets: dict[str, dict[str, Any]]
    """Group of columns -> reference, seconds, std and correlation."""
    findings: tuple[Finding, ...]
    sha256: str = ""

    @property
    def verdict(self) -> Verdict:
        """By the worst finding."""
        levels = {finding.severity for finding in self.findings}
        return "refused" if "refused" in levels else "usable with care" if "care" in levels else "usable"

    def as_json(self) -> dict[str, Any]:
        """Plain values; numbers that are not finite become None."""
        return {
            "name": self.name,
            "verdict": self.verdict,
            "vehicle": self.vehicle,
            "role": self.role,
            "duration": _plain(self.duration),
            "rows": self.rows,
            "inputs": self.inputs,
            "findings": [finding.as_json() for finding in self.findings],
            "streams": [
                {**vars(stream), "columns": list(stream.columns), **_numbers(stream)}
                for stream in self.streams
            ],
            "axes": {
                axis.axis: {
                    **{key: value for key, value in vars(axis).items() if key not in ("axis", "tells")},
                    **_numbers(axis),
                    "levels": list(axis.levels),
                    "tells": {name: {"can": told.can, "why": told.why} for name, told in axis.tells.items()},
                }
                for axis in self.axes
            },
            "offsets": self.offsets,
            "sha256": self.sha256,
        }


def _plain(x: float) -> float | None:
    return float(x) if math.isfinite(x) else None


def _numbers(part: Any) -> dict[str, float | None]:
    return {key: _plain(value) for key, value in vars(part).items() if isinstance(value, float)}
