"""Results of a calibration: estimates with intervals, their basis, and parameters that are not identifiable."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from finssim.core.page import notebook_html
from finssim.trials.findings import CalibrationError, Finding, plain
from finssim.trials.motion import longest_step
from finssim.vehicles import AXES, Vehicle

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from finssim.identification.programme import Leg

__all__ = ["Correlation", "Curve", "Estimate", "Fit"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Estimate:
    """Estimate of one parameter."""

    name: str
    """`surge.m_eff`, `surge.added_mass`, `surge.d1`, `surge.d2`, `surge.bias`, `roll.k`, `buoyancy_excess`,
    `thrust_scale`, `thrust_lag`, `thrust_delay`, `gain.T1`, `CC.c_plus`, ...; coupled terms `added_mass.surge.pitch`,
    `d1.sway.yaw`."""
    estimate: float
    """Value in `unit`."""
    ci95: tuple[float, float]
    """95 % interval in `unit`; infinite or NaN ends if the data are not informative."""
    unit: str
    identifiable: bool
    """True if the data determine the parameter; False also if a bound is active."""
    note: str = ""
    """Reason why it is not identifiable, or basis of the number."""
    path: str | None = None
    """Dotted path of the number in the vehicle file, if it is in the file."""

    @classmethod
    def within(cls, name: str, value: float, half: float, unit: str, sure: bool, note: str = "") -> Estimate:
        """Return an estimate with an interval of ± `half`, and a note if it is not `sure`.

        Numbers are in `unit`.
        """
        ci95 = (float(value - half), float(value + half))
        note = "" if sure else note
        return cls(name, float(value), ci95, unit, bool(sure), note)

    def as_json(self) -> dict[str, Any]:
        """Return plain values; non-finite numbers become None."""
        values = {key: getattr(self, key) for key in ("estimate", "ci95", "unit", "identifiable", "note")}
        return dict(plain(values))


@dataclass(frozen=True, kw_only=True)
class Dive:
    """Recommended next dive."""

    legs: tuple[Leg, ...]
    widest: str
    """Name of the estimate with the widest interval, relative to its value."""
    factor: float
    """Width of that interval after the dive, relative to its present width [-]."""

    @property
    def duration(self) -> float:
        """Duration [s]."""
        return sum(leg.times * leg.duration for leg in self.legs)

    def as_json(self) -> dict[str, Any]:
        """Return plain values."""
        return {"legs": [asdict(leg) for leg in self.legs], "widest": self.widest, "factor": self.factor}

    def __str__(self) -> str:
        legs = [
            f"{leg.axis} at ±{leg.level:g} {'N' if leg.axis in AXES[:3] else 'N m'}, first steps of {leg.hold:g} s"
            + (f", {leg.times} times" if leg.times > 1 else "")
            for leg in self.legs
        ]
        return (
            f"record next: {'; '.join(legs)} ({self.duration:.0f} s). The widest interval, that of {self.widest}, "
            f"would be {self.factor:.2f} times as wide; `finssim excite --from` plays it"
        )


@dataclass(frozen=True, kw_only=True)
class Correlation:
    """Correlation of the errors of the estimates."""

    names: tuple[str, ...]
    matrix: Array
    """Correlations, (n, n)."""

    def as_json(self) -> dict[str, Any]:
        """Return plain values."""
        return {"names": list(self.names), "matrix": plain(self.matrix)}


@dataclass(frozen=True, kw_only=True)
class Curve:
    """Measured and fitted values over one abscissa, for the report's figures."""

    title: str
    x_label: str
    y_label: str
    x: Array
    """Abscissa in the unit of its label, (n,)."""
    measured: Array
    """Measured values in the unit of the label, (n,)."""
    fitted: Array
    """Fitted values in the unit of the label, (n,)."""
    kind: str = "line"
    """`line` (against time) or `scatter`."""
    band: Array | None = None
    """Half width of the 95 % band around the fitted values in the unit of the label, (n,)."""

    @classmethod
    def joined(cls, title: str, y_label: str, parts: Sequence[tuple[Array, ...]]) -> Curve:
        """Return a curve that concatenates segments of time [s], measured and fitted values, and optional
        bands, (k,) each, one second apart; lines break between segments and at gaps."""
        x, columns, start = list[Array](), list[list[Array]](), 0.0
        for t, *values in parts:
            gaps = [*(1 + np.flatnonzero(np.diff(t) > longest_step(t))), len(t)]
            x.append(np.insert(t - t[0] + start, gaps, np.nan))
            columns.append([np.insert(y, gaps, np.nan) for y in values])
            start += float(t[-1] - t[0]) + 1.0
        measured, fitted, *band = (np.concatenate(some) for some in zip(*columns, strict=True))
        label = "time, one after the other [s]"
        return cls(
            title=title, x_label=label, y_label=y_label, x=np.concatenate(x), measured=measured, fitted=fitted,
            band=band[0] if band else None,
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Fit:
    """A finished calibration."""

    kind: str
    """Kind of calibration: thruster, motor or hydrodynamics."""
    method: str
    before: Vehicle
    """Vehicle from which the fit started."""
    estimates: dict[str, Estimate]
    """Estimates by name, in the order of a report."""
    changes: dict[str, Any]
    """Changes for `Vehicle.replace`: dotted path -> value, only for parameters that the data determine."""
    quality: dict[str, dict[str, float]] = field(default_factory=dict)
    """Axis or thruster -> quality of the fit: r2 and nrmse [-], rmse in the unit of the axis, samples,
    rejected, ..."""
    correlation: Correlation | None = None
    findings: tuple[Finding, ...] = ()
    """Findings about bounds, degeneracies, speeds of less than a decade, omitted trials."""
    curves: tuple[Curve, ...] = ()
    trials: dict[str, str] = field(default_factory=dict)
    """Name of a trial or table -> SHA-256 of its numbers."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Options of the method, and seed."""
    next_dive: Dive | None = None
    """Recommended next dive; None if it was not requested."""
    interrupted: bool = False
    """True if Ctrl-C stopped the fit before it converged; the estimates are the best so far."""

    @cached_property
    def vehicle(self) -> Vehicle:
        """Calibrated vehicle: all numbers that the fit did not determine keep their values and origins.

        Raises:
            CalibrationError: The estimates do not form a vehicle that can be simulated.
        """
        from finssim.identification.vehicle_file import calibrated

        return calibrated(self)

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """95 % interval of each estimate by its name, in the estimate's unit; infinite ends if it is unknown."""
        return {name: estimate.ci95 for name, estimate in self.estimates.items()}

    def plot(self) -> Figure:
        """Return a Matplotlib figure of measured and fitted values and their differences, of up to six curves.

        Raises:
            CalibrationError: The fit contains no curves.
        """
        from finssim.identification.report import draw_curves

        figure = next(draw_curves(self.curves), None)
        if figure is None:
            raise CalibrationError("the fit contains no curves to draw")
        return figure

    def __repr__(self) -> str:
        counts = (
            f"{len(self.estimates)} estimates, {len(self.changes)} changes, {len(self.findings)} findings"
        )
        return f"<Fit {self.kind} ({self.method}) of {self.before.name}: {counts}>"

    def _repr_html_(self) -> str:
        rows = [
            (e.name, f"{e.estimate:.4g}", f"{e.ci95[0]:.4g} to {e.ci95[1]:.4g}", e.unit, e.note)
            for e in self.estimates.values()
        ]
        title = f"{self.kind} of {self.before.name} ({self.method})"
        return notebook_html(title, ("", "estimate", "95 % interval", "unit", "note"), rows)
