"""Estimates, changes of the vehicle file and findings of one axis, from its fitted numbers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finssim.identification.confidence import Confidence, Stage
from finssim.identification.fit import Estimate
from finssim.identification.parameters import (
    DETERMINED,
    GAIN_STD,
    PLACES,
    Parameters,
    horizontal,
    places,
    scaled_actuators,
)
from finssim.identification.plant_terms import SET, UNITS, Matrices, matrices
from finssim.identification.uncertainty import intervals
from finssim.identification.vehicle_file import scaled_thrust
from finssim.trials.findings import Finding, finding
from finssim.vehicles import AXES, Vehicle

Array = NDArray[np.float64]

CERTAIN = 0.2
"""Relative half width of an interval up to which a parameter counts as identifiable."""

USEFUL = 0.5
"""Relative half width up to which an inertia is written to the vehicle file: still better than a guess."""

DECADE = 10.0

BIAS_NOTE = (
    "a constant force; above zero it opposes motion in the positive direction, as damping does: tether, trim or the "
    "offset of a sensor"
)


class Number(NamedTuple):
    """Fitted number of an axis."""

    value: float
    ends: tuple[float, float]
    """95 % interval in the unit of the number; not finite if the trials do not determine it."""
    free: float | None = None
    """Estimate without the active bound, in the unit of the number; None if no bound is active."""


@dataclass
class AxisResult:
    """Estimates, changes of the vehicle file and findings of one axis."""

    axis: str
    speeds: tuple[float, float]
    """Lowest and highest speed on which the damping is based [m/s, rad/s]."""
    estimates: dict[str, Estimate] = field(default_factory=dict)
    changes: dict[str, Any] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)

    def believe_nothing(self, reason: str) -> None:
        """Mark all estimates as not identifiable and discard all changes, for a reason."""
        self.estimates = {
            name: replace(e, identifiable=False, note=reason) for name, e in self.estimates.items()
        }
        self.changes = {}
        self.findings.append(finding("axis_refused", self.axis, reason=reason))


def axis_result(
    p: Parameters,
    x: Array,
    numbers: Mapping[str, Number],
    axis: str,
    *,
    speeds: tuple[float, float],
    drag_known: bool,
    given: float | None = None,
) -> AxisResult:
    """Return the result of one axis.

    Numbers that the data determine well are written, and so are uncertain ones if the vehicle file's number
    lies outside the interval: a wide interval is better than a number that it excludes.

    Args:
        p: Free parameters of the fit.
        x: Solution of the fit, in the units of the coordinates, (P,).
        numbers: Result of `numbers_of`.
        axis: Name of the axis.
        speeds: Lowest and highest speed on which the damping is based [m/s, rad/s].
        drag_known: Whether the damping is known well enough to be written; both terms are written, or neither.
        given: Known effective inertia [kg, kg m²].
    """
    out, i, file = AxisResult(axis, speeds), AXES.index(axis), matrices(p.moved(x))
    rigid, (low, high), unit = float(file.M_RB[i, i]), speeds, "m/s" if i < 3 else "rad/s"

    def take(
        name: str, value: float, ends: tuple[float, float], sure: bool, note: str, path: str | None = None
    ) -> Estimate:
        """Add an estimate."""
        own = UNITS["m_eff" if name == "added_mass" else name][i > 2]
        ends = (float(ends[0]), float(ends[1]))
        one = Estimate(f"{axis}.{name}", float(value), ends, own, sure, note, path)
        out.estimates[one.name] = one
        return one

    def add(name: str, number: Number, path: str | None = None) -> Estimate:
        """Add the estimate of a number, and a finding if a bound is active."""
        value, (least, most), free = number
        own, note = UNITS[name][i > 2], ""
        if free is not None:
            note = "held at its bound" + (
                f"; without the bound it would be {free:.3g} {own}" if np.isfinite(free) else ""
            )
            out.findings.append(finding("at_bound", f"{axis}.{name}", free=free, unit=own))
        elif not np.isfinite([least, most]).all():
            note = "the trials do not determine it"
        elif 0.5 * (most - least) > CERTAIN * abs(value):
            part = 0.5 * (most - least) / abs(value) if value else np.inf
            note = "uncertain by " + (f"±{100.0 * part:.0f} %" if part < 1.0 else "more than its own size")
        return take(name, value, (least, most), not note, note, path)

    mass = numbers.get(f"{axis}.added_mass")
    if given is not None:
        _added_mass(out, take("m_eff", given, (given, given), True, "given"), file, take)
    elif mass is not None:
        free = None if mass.free is None else mass.free + rigid
        ends = (mass.ends[0] + rigid, mass.ends[1] + rigid)
        _added_mass(out, add("m_eff", Number(mass.value + rigid, ends, free)), file, take)
    for name, matrix in (("d1", file.D1), ("d2", file.D2)):
        drag, path = numbers.get(f"{axis}.{name}"), _diagonal(axis, name)
        if drag is not None:
            e = add(name, drag, path)
            if e.ci95[0] <= 0.0 <= e.ci95[1] < np.inf:
                note = f"not distinguishable from zero at speeds of {low:.2g}-{high:.2g} {unit}"
                take(name, e.estimate, e.ci95, False, note, path)
        if drag_known:
            value = 0.0 if drag is None else max(drag.value, 0.0)
            if drag is None or value != matrix[i, i]:
                out.changes[path] = value
    if not drag_known:
        out.findings.append(finding("damping_unknown", axis, low=low, high=high, unit=unit))
    if "k" in numbers and axis in ("roll", "pitch"):
        add("k", numbers["k"], "body.center_of_buoyancy.2")
    if f"{axis}.bias" in numbers:  # identifiable if it has an interval, since it may well be zero
        bias = add("bias", numbers[f"{axis}.bias"])
        take("bias", bias.estimate, bias.ci95, bool(np.isfinite(bias.ci95).all()), BIAS_NOTE)
    if 0.0 < low and high < DECADE * low:
        out.findings.append(finding("few_speeds", axis, low=low, high=high, unit=unit))
    return out


def _added_mass(out: AxisResult, whole: Estimate, file: Matrices, take: Callable[..., Estimate]) -> None:
    """Add the added mass of an axis: its effective inertia minus the rigid-body inertia of the file."""
    i = AXES.index(out.axis)
    rigid, before = float(file.M_RB[i, i]), float(file.M_A[i, i])
    value, ends = whole.estimate - rigid, (whole.ci95[0] - rigid, whole.ci95[1] - rigid)
    sure, note = whole.identifiable, f"assuming the file's rigid-body {rigid:.4g} {whole.unit}"
    if value <= 0.0:
        sure, note = False, f"m_eff is below the file's rigid-body {rigid:.4g} {whole.unit}"
        fields = {"effective": whole.estimate, "rigid": rigid, "unit": whole.unit}
        out.findings.append(finding("inertia_too_small", out.axis, **fields))
    elif ends[0] <= 0.0:
        sure, note = False, "not distinguishable from zero"
    half, path = 0.5 * (whole.ci95[1] - whole.ci95[0]), _diagonal(out.axis, "added_mass")
    if value > 0.0 and (half < USEFUL * whole.estimate or outside(before, ends)):
        out.changes[path] = value
    take("added_mass", value, ends, sure, note, path)


def trim(found: Mapping[str, Estimate], buoyancy: float, centre: Sequence[float]) -> dict[str, float]:
    """Return the centre of buoyancy that explains the constant roll and pitch moments of a vehicle with a
    static tilt.

    B r_b - W r_g = (b_pitch, -b_roll, k), with the centre of gravity unchanged.

    Positions are in [m].

    Args:
        found: Estimates, including `roll.bias` and `pitch.bias`.
        buoyancy: B [N].
        centre: r_b of the vehicle file [m].
    """
    out = {}
    for name, i, sign in (("pitch.bias", 0, 1.0), ("roll.bias", 1, -1.0)):
        bias = found.get(name)
        if bias is not None and bias.identifiable and outside(0.0, bias.ci95):
            out[f"body.center_of_buoyancy.{i}"] = float(centre[i]) + sign * bias.estimate / buoyancy
    return out


def hydrostatics(found: Mapping[str, Estimate], vehicle: Vehicle) -> tuple[dict[str, float], list[Finding]]:
    """Return buoyancy excess, stiffness and constant moments as volume and centre of buoyancy; weight and
    centre of gravity are unchanged.

    Args:
        found: Estimates by name.
        vehicle: Vehicle as defined by its file.

    Returns:
        Changes of the vehicle file in its units, and a finding if roll and pitch disagree.
    """
    body, water, findings = vehicle.body, vehicle.water, list[Finding]()
    changes: dict[str, float] = {}
    volume = float(body.displaced_volume)
    excess = found.get("buoyancy_excess")
    if excess is not None and excess.identifiable:
        volume = (vehicle.weight + excess.estimate) / (water.density * water.gravity)
        changes["body.displaced_volume"] = volume
    buoyancy = water.density * water.gravity * volume
    changes |= trim(found, buoyancy, body.center_of_buoyancy)
    stiffness = float(matrices(vehicle).arm[2])
    some = [found[name] for name in ("roll.k", "pitch.k") if name in found]
    some = [e for e in some if e.estimate > 0.0 and (useful(e) or outside(stiffness, e.ci95))]
    if not some:
        return changes, findings
    half = np.array([0.5 * (e.ci95[1] - e.ci95[0]) for e in some])
    value = np.array([e.estimate for e in some])
    if len(some) == 2 and abs(value[0] - value[1]) > float(np.hypot(*half)):
        findings.append(finding("stiffness_disagrees", roll=value[0], pitch=value[1]))
    k = float(np.sum(value / half**2) / np.sum(1.0 / half**2))
    reference = float(vehicle.hydrodynamic_set("calibrated").reference_point[2])
    gravity_part = vehicle.weight * (float(body.center_of_gravity[2]) - reference)
    changes["body.center_of_buoyancy.2"] = reference + (k + gravity_part) / buoyancy
    return changes, findings


def useful(e: Estimate) -> bool:
    """Return whether an estimate is known to within `USEFUL`."""
    return 0.5 * (e.ci95[1] - e.ci95[0]) < USEFUL * e.estimate


def outside(value: float, ends: Array | tuple[float, float]) -> bool:
    """Return whether a number lies outside a finite interval of the same unit."""
    return bool(np.isfinite(ends).all() and not ends[0] <= value <= ends[1])


LAG_CERTAIN = 0.05
"""Half width of the interval of a delay up to which it counts as identifiable [s]."""

EXCESS_CERTAIN = 0.02
"""Half width of the interval of buoyancy minus weight, relative to the weight, up to which it is identifiable."""

PATHS = {
    "buoyancy_excess": "body.displaced_volume",
    "thrust_scale": None,
    "thrust_lag": "thrusters.*.time_constant",
    "thrust_delay": "thrusters.*.delay",
}
"""Reported coordinates besides those of the axes, and their paths in the vehicle file."""


LEVER = 1.0
"""Length to which the simulation's own error is related for positions [m]: a lever arm of some centimetres
results from a small difference of large accelerations."""


NO_BETTER = "the trials do not determine it better than the vehicle file"


def numbers_of(p: Parameters, x: Array, found: Confidence, own_error: float) -> dict[str, Number]:
    """Return every coordinate with its 95 % interval, by name.

    Args:
        p: Free parameters of the fit.
        x: Solution of the fit, in the units of the coordinates, (P,).
        found: Evidence at the solution.
        own_error: Relative error of the simulation itself [-], which the intervals include.
    """
    local, out, M_RB = np.diagonal(found.covariance.local), {}, matrices(p.moved(x)).M_RB
    half = intervals(np.zeros(len(local)), found.covariance)[:, 1]
    for c, name in enumerate(p.names):
        low, high, value = -np.inf, np.inf, float(x[c])
        if np.isfinite(local[c]):
            free = value + float(np.clip(found.free[c] - value, -1e6, 1e6))
            axis, _, kind = name.partition(".")
            rigid = M_RB[AXES.index(axis), AXES.index(axis)] if kind == "added_mass" else 0.0
            size = LEVER if name in PLACES else abs(value + rigid)
            width = float(np.hypot(half[c], own_error * size))
            low = max(min(free - width, value), p.low[c])
            high = free + width if free + width > value else value + width
            # If the fit was terminated early, the true value may be as far as one more step.
            low, high = min(low, float(found.interval[c, 0])), max(high, float(found.interval[c, 1]))
        out[name] = Number(value, (low, high), float(found.free[c]) if value <= p.low[c] else None)
    return out


def other_estimates(
    p: Parameters, numbers: Mapping[str, Number]
) -> tuple[dict[str, Estimate], list[Finding]]:
    """Return the estimates that belong to no axis, and findings about active bounds."""
    out, bounds = dict[str, Estimate](), list[Finding]()
    reported = {*PATHS, *PLACES, *p.terms, *p.actuators, *p.gains}
    paths = PATHS | places(p.vehicle)
    units = {c.name: c.unit for c in p.coordinates if c.name in reported}
    for name, unit in units.items():
        value, (low, high), free = numbers[name]
        half, note = 0.5 * (high - low), ""
        # Delay and excess may well be zero, so their uncertainty is not judged relative to their value.
        limits = {"thrust_delay": LAG_CERTAIN, "buoyancy_excess": EXCESS_CERTAIN * p.vehicle.weight}
        limit = limits.get(name, CERTAIN * abs(value))
        if free is not None:
            note = f"held at its bound; without the bound it would be {free:.3g} {unit}"
            bounds.append(finding("at_bound", name, free=free, unit=unit))
        elif not np.isfinite(half):
            note = "the trials do not determine it"
        elif name in p.gains:
            note = NO_BETTER if half / 1.96 > DETERMINED * GAIN_STD else ""
        elif name in PLACES:
            coordinate = p.coordinates[p.names.index(name)]
            known, std = half / 1.96, float(coordinate.std or np.inf)
            if known > DETERMINED * std:
                note = NO_BETTER
            else:  # estimate from the trials alone, without the file
                variance = 1.0 / (known**-2.0 - std**-2.0)
                alone = variance * (value / known**2.0 - coordinate.start / std**2.0)
                span = 1.96 * float(np.sqrt(variance))
                if abs(alone - coordinate.start) > span:
                    what = f"{name[-1]} of the centre of gravity"
                    if name == PLACES[0]:
                        what = f"height of {', '.join(horizontal(p.vehicle))}"
                    fields = {"value": alone, "half": span, "file": coordinate.start}
                    bounds.append(finding("place_contradicted", what, **fields))
        elif half > limit:
            note = f"uncertain by ±{half:.2g} {unit}"
        path = f"{SET}.{name}" if name in p.terms else paths.get(name)
        out[name] = Estimate(name, value, (low, high), unit, not note, note, path)
    return out, bounds


def changes(
    p: Parameters,
    x: Array,
    found: Mapping[str, Estimate],
    axes: dict[str, Any],
    *,
    unmeasured: Sequence[str],
    scaled: bool,
) -> dict[str, Any]:
    """Return the changes of the vehicle file.

    Args:
        p: Free parameters of the fit.
        x: Solution of the fit, in the units of the coordinates, (P,).
        found: All estimates.
        axes: Changes of the axes' own numbers.
        unmeasured: Axes that were simulated because no trial measured them: the other estimates are valid
            with their numbers.
        scaled: True if a thrust scale is applied to the thrusters' curves.
    """
    out, written = dict(axes), x.copy()
    for c, name in enumerate(p.names):
        axis, _, kind = name.partition(".")
        unsure = name in PLACES and not found[name].identifiable
        own = axis in AXES and kind in KINDS
        if unsure or own and axis not in unmeasured and _diagonal(axis, kind) not in axes:
            written[c] = p.expected[c]
    for path, matrix in matrix_changes(p, written).items():
        old = np.asarray(getattr(p.set, path.rpartition(".")[2]), float)
        new = [f"{path}.{i}.{i}" in axes or axis in unmeasured for i, axis in enumerate(AXES)]
        for i, j in np.ndindex(6, 6):
            # A coupling changes with both of its axes, or is zero if the selected damping model has none.
            if new[i] and i == j or (new[i] or new[j]) and matrix[i, j] != old[i, j]:
                out[f"{path}.{i}.{j}"] = float(matrix[i, j])
    moved = p.moved(written)
    at = [f"thrusters.{name}.position.2" for name in horizontal(p.vehicle)]
    if PLACES[0] in found:
        c = p.names.index(PLACES[0])
        lower = float(written[c] - p.expected[c])
        out |= {path: p.vehicle.thrusters[path.split(".")[1]].position[2] + lower for path in at if lower}
    if moved is not p.vehicle:
        for name in ("center_of_gravity", "center_of_buoyancy"):
            out |= {f"body.{name}.{j}": float(c) for j, c in enumerate(getattr(moved.body, name))}
    out |= hydrostatics(found, moved)[0]
    for name, path in (("thrust_lag", "time_constant"), ("thrust_delay", "delay")):
        if name in found and found[name].identifiable:
            out[f"thrusters.*.{path}"] = max(found[name].estimate, 1e-4 if path == "time_constant" else 0.0)
    for path in p.terms:
        if found[path].identifiable:
            out[str(found[path].path)] = found[path].estimate
    for name in p.actuators:
        if found[name].identifiable:
            out |= scaled_actuators(p.vehicle, name, found[name].estimate)
    scale, gains = found.get("thrust_scale"), [found[name].estimate for name in p.gains]
    if scaled and (bool(gains) if scale is None else scale.identifiable or p.likely):
        out |= scaled_thrust(p.vehicle, scale.estimate if scale else 1.0, gains)
    return out


def terminal_speed(d1: float, d2: float, excess: float) -> float:
    """Return the speed at which drag equals an excess of buoyancy [m/s].

    Args:
        d1: Linear damping of heave [N s/m].
        d2: Quadratic damping of heave [N s²/m²].
        excess: Buoyancy minus weight [N].
    """
    e = max(excess, 0.0)
    return 2.0 * e / max(d1 + float(np.sqrt(d1**2 + 4.0 * d2 * e)), 1e-12)


def derived(
    stage: Stage, of: Callable[[Array], float], own_error: float
) -> tuple[float, tuple[float, float]]:
    """Return a positive function of the parameters and its 95 % interval, to first order in its logarithm.

    The result has the unit of the function.

    Args:
        stage: Finished fit.
        of: Function from the vector of parameters (P,) to the number.
        own_error: Relative error of the simulation itself [-].
    """
    from scipy.stats import t

    p, x, C = stage.problem.parameters, stage.x, stage.found.covariance
    h = 1e-4 * np.maximum(np.abs(x), 1e-2 * p.scale)
    value, steps = of(x), np.diag(h)
    slope = np.array([(of(x + s) - of(np.maximum(x - s, p.low))) for s in steps])
    slope /= x + h - np.maximum(x - h, p.low)
    at = np.flatnonzero(slope).tolist()
    dof = float(np.min(C.dof[at], initial=np.inf))
    half = float(t.ppf(0.975, min(dof, 1e6))) * float(np.sqrt(stage.found.variance(slope[at], at)))
    half = float(np.hypot(half, own_error * value))
    factor = float(np.exp(min(half / max(value, 1e-12), 50.0)))
    return value, (value / factor, value * factor)


KINDS = {"added_mass": "added_mass", "d1": "linear_damping", "d2": "quadratic_damping"}
"""Coordinate of an axis -> matrix of the vehicle file."""


def matrix_changes(p: Parameters, x: Array) -> dict[str, Any]:
    """Return the changes of the vehicle file for the matrices of a vector in the units of the coordinates, (P,)."""
    return {f"{SET}.{name}": m[0] for name, m in zip(KINDS.values(), p.matrices(x), strict=True)}


def _diagonal(axis: str, kind: str) -> str:
    i = AXES.index(axis)
    return f"{SET}.{KINDS[kind]}.{i}.{i}"
