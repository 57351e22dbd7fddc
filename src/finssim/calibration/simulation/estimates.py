"""From the vector of a simulation-error fit to named estimates with intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.findings import Finding, finding
from finssim.calibration.fit import Estimate
from finssim.calibration.regression.axis_estimates import BIAS_NOTE, CERTAIN
from finssim.calibration.simulation.parameters import Parameters
from finssim.calibration.simulation.shooting import Shooting
from finssim.calibration.simulation.solver import Solution, weights_of
from finssim.calibration.uncertainty import Covariance, Evidence, intervals, trial_covariance
from finssim.vehicles.terms import unit_of

__all__ = ["Quantity", "estimates", "quantities"]

Array = NDArray[np.float64]

# What each trial, or each block of a few trials, says about the parameters of a simulation-error fit.

FEWEST_TRIALS = 4
"""With fewer, trials are cut into blocks to estimate the spread."""

BLOCKS = 24
"""That many, all trials together."""


class Confidence(NamedTuple):
    """Uncertainty of theta at a solution."""

    evidence: Evidence
    covariance: Covariance
    free: Array
    """Where the last step would go without bounds, (P,)."""
    interval: Array
    """95 %, around `free` and containing theta, (P, 2)."""


def confidence(problem: Shooting, solution: Solution) -> Confidence:
    """Evidence of theta, after initial states, offsets and trial biases are eliminated, and what follows from it."""
    evidence, P = evidence_of(problem, solution), problem.shared
    covariance = trial_covariance(evidence)
    theta, low, high = (part[:P] for part in (solution.point.theta, problem.low, problem.high))
    free = theta
    if ((theta <= low) | (theta >= high)).any():
        normal, score = evidence.normal.sum(axis=0), evidence.score.sum(axis=0)
        scale = np.sqrt(np.maximum(np.diagonal(normal), 1e-300))
        free = theta + np.linalg.lstsq(normal / np.outer(scale, scale), score / scale, rcond=1e-10)[0] / scale
    ends = intervals(free, covariance)
    ends[:, 0], ends[:, 1] = np.minimum(ends[:, 0], theta), np.maximum(ends[:, 1], theta)
    ends = np.clip(ends, low[:, None], high[:, None])
    unknown = ~np.isfinite(np.diagonal(covariance.local))
    ends[unknown] = [-np.inf, np.inf]
    return Confidence(evidence, covariance, free, ends)


def evidence_of(problem: Shooting, solution: Solution) -> Evidence:
    """Normal matrices and scores by trial, or by blocks of rows where fewer than `FEWEST_TRIALS` excite an axis."""
    linear, P = solution.linear, problem.shared
    weight = weights_of(linear.residual, solution.std)
    # Derivatives without what each segment's own unknowns, and then the biases of trials, take up of every sample.
    slopes = linear.shared.copy()
    for s, (a, b) in enumerate(zip(problem.edges, problem.edges[1:], strict=False)):
        prior = np.diag(problem.prior_std[s] ** -2.0)
        slopes[a:b] = _without(slopes[a:b], linear.own[a:b], weight[a:b], prior)
    biases = slopes[:, P:]
    slopes = _without(slopes[:, :P], biases, weight, 1e-12 * np.eye(biases.shape[1]))
    trial = problem.groups[problem.measured.segment]
    unit, group = "trials", trial
    if problem.few or len(np.unique(trial)) < FEWEST_TRIALS:
        unit, group = "blocks", _blocks(problem, trial)
    parts = [np.flatnonzero(group == label) for label in np.unique(group)]
    # What is known beforehand is one more witness.
    known = problem.prior_precision[:P]
    pull = known * (problem.prior_mean - solution.point.theta)[:P]
    normal = [(slopes[rows].T * weight[rows]) @ slopes[rows] for rows in parts]
    score = [(slopes[rows].T * weight[rows]) @ linear.residual[rows] for rows in parts]
    return Evidence(
        names=problem.names[:P],
        normal=np.array([*normal, np.diag(known)]),
        score=np.array([*score, pull]),
        unit=unit,
    )


def _without(slopes: Array, own: Array, weight: Array, prior: Array) -> Array:
    """Derivatives less the best combination of others of the same rows, (n, P)."""
    weighted = own.T * weight
    return np.asarray(slopes - own @ np.linalg.solve(weighted @ own + prior, weighted @ slopes))


def _blocks(problem: Shooting, trial: NDArray[np.int64]) -> NDArray[np.int64]:
    """Block of every sample: each trial in equal spans of time, the longer the trial the more of them."""
    start = np.array([s.t0 for s in problem.segments])[problem.measured.segment]
    t = start + problem.measured.time
    present = np.unique(trial)
    span = {g: (float(t[trial == g].min()), float(np.ptp(t[trial == g]))) for g in present}
    total = sum(length for _, length in span.values())
    out = np.zeros(len(t), int)
    for g in present:
        begin, length = span[g]
        pieces = max(2, round(BLOCKS * length / max(total, 1e-9)))
        rows = trial == g
        part = (t[rows] - begin) / max(length, 1e-9)
        out[rows] = 1000 * g + np.minimum((part * pieces).astype(int), pieces - 1)
    return out


LAG_CERTAIN = 0.05
"""The same for a delay [s]."""

UNITS = {
    "m_eff": ("kg", "kg m²"),
    "added_mass": ("kg", "kg m²"),
    "d1": ("N s/m", "N m s"),
    "d2": ("N s²/m²", "N m s²"),
    "bias": ("N", "N m"),
}

FAMILY = {"added_mass": "added_mass", "d1": "linear_damping", "d2": "quadratic_damping"}


@dataclass(frozen=True)
class Quantity:
    """One number of the report, a function of the vector."""

    name: str
    unit: str
    path: str | None
    kind: str
    """m_eff, added_mass, d1, d2, bias, k, coupling, or the name of an extra."""
    axis: int = -1


def quantities(p: Parameters, axes: Sequence[str]) -> list[Quantity]:
    """What a fit reports of some axes, in the report's order."""
    out = []
    base = f"hydrodynamics.{p.hydrodynamics}"
    for axis, i in zip(p.axes, p.index, strict=True):
        if axis not in axes:
            continue
        for kind in ("m_eff", "added_mass", "d1", "d2"):
            path = f"{base}.{FAMILY[kind]}.{i}.{i}" if kind in FAMILY else None
            out.append(Quantity(f"{axis}.{kind}", UNITS[kind][int(i > 2)], path, kind, int(i)))
        if "k" in p.names and axis in ("roll", "pitch"):
            out.append(Quantity(f"{axis}.k", "N m/rad", "body.center_of_buoyancy.2", "k", int(i)))
        if f"{axis}.bias" in p.names:
            out.append(Quantity(f"{axis}.bias", UNITS["bias"][int(i > 2)], None, "bias", int(i)))
    paths = {
        "buoyancy_excess": "body.displaced_volume",
        "thrust_lag": "thrusters.*.time_constant",
        "thrust_delay": "thrusters.*.delay",
    }
    for c in p.coordinates:
        if c.name in (
            "buoyancy_excess",
            "thrust_scale",
            "thrust_lag",
            "thrust_delay",
            "current.x",
            "current.y",
        ):
            out.append(Quantity(c.name, c.unit, paths.get(c.name), c.name))
    out += [Quantity(path, unit_of(path), f"{base}.{path}", path) for path in p.terms]
    if p.coupled:
        for name, matrix, i, j in p.coupled.entries():
            out.append(Quantity(name, _unit(matrix, i, j), f"{base}.{matrix}.{i}.{j}", "coupling"))
    return out


def _unit(matrix: str, i: int, j: int) -> str:
    if matrix == "added_mass":
        return "kg m" if (i < 3) != (j < 3) else "kg" if i < 3 else "kg m²"
    per = ("N", "N m")[int(i > 2)]
    square = matrix == "quadratic_damping"
    return f"{per} s{'²' if square else ''}" + (f"/m{'²' if square else ''}" if j < 3 else "")


def values(p: Parameters, listed: Sequence[Quantity], x: Array) -> Array:
    """Values of quantities for vectors (W, P), (W, Q)."""
    M_A, D1, D2 = p.matrices(x)
    matrix = {"added_mass": M_A, "d1": D1, "d2": D2, "linear_damping": D1, "quadratic_damping": D2}
    out = np.empty((len(x), len(listed)))
    for q, quantity in enumerate(listed):
        i = quantity.axis
        if quantity.kind == "m_eff":
            out[:, q] = M_A[:, i, i] + p.M_RB[i, i]
        elif quantity.kind in ("added_mass", "d1", "d2"):
            out[:, q] = matrix[quantity.kind][:, i, i]
        elif quantity.kind == "coupling":
            family, row, column = str(quantity.path).split(".")[-3:]
            out[:, q] = matrix[family][:, int(row), int(column)]
        else:
            out[:, q] = p.value(x, "k" if quantity.kind == "k" else quantity.name)
    return out


def jacobian(p: Parameters, listed: Sequence[Quantity], x: Array) -> Array:
    """Derivatives of quantities by the vector, (Q, P)."""
    size = 1e-5 * np.maximum(np.abs(x), p.scale)
    up, down = np.minimum(x + size, p.high), np.maximum(x - size, p.low)
    points = np.repeat(x[None], 2 * len(x), axis=0)
    i = np.arange(len(x))
    points[i, i], points[len(x) + i, i] = up, down
    found = values(p, listed, points)
    return np.asarray(((found[: len(x)] - found[len(x) :]) / (up - down)[:, None]).T)


def spread(
    p: Parameters, listed: Sequence[Quantity], x: Array, found: Confidence, own_error: float
) -> tuple[Array, Array, Array]:
    """Values (Q,), intervals (Q, 2) and p-values of being zero (Q,)."""
    from scipy.stats import norm, t

    P = len(p.names)
    J = jacobian(p, listed, x)
    one = np.count_nonzero(J, axis=1) == 1
    which = np.argmax(np.abs(J), axis=1)
    value = values(p, listed, x[None])[0]
    covariance = found.covariance
    finite = np.isfinite(np.diagonal(covariance.local))[:P]
    known = np.array([bool(finite[np.flatnonzero(row)].all()) for row in J])
    Jk = np.where(finite, J, 0.0)
    V = np.where(np.isfinite(covariance.trials), covariance.trials, 0.0)[:P, :P]
    local = np.where(np.isfinite(covariance.local), covariance.local, 0.0)[:P, :P]
    variance = np.einsum("qi,ij,qj->q", Jk, V, Jk)
    alone = np.array([bool(covariance.alone[:P][np.flatnonzero(row)].any()) for row in J])
    variance = np.where(alone, np.maximum(variance, np.einsum("qi,ij,qj->q", Jk, local, Jk)), variance)
    dof = np.array([float(covariance.dof[:P][np.flatnonzero(row)].min(initial=np.inf)) for row in J])
    quantile = np.where(np.isfinite(dof), t.ppf(0.975, np.where(np.isfinite(dof), dof, 1.0)), norm.ppf(0.975))
    std = np.sqrt(np.maximum(variance, 0.0))
    shift = J @ np.clip(found.free[:P] - x, -1e6, 1e6)
    free = np.where(one, value + shift, value)
    whole = np.array([p.M_RB[q.axis, q.axis] if q.kind == "added_mass" else 0.0 for q in listed])
    half = np.hypot(quantile * std, own_error * np.abs(value + whole))
    ends = np.stack([np.minimum(free - half, value), np.maximum(free + half, value)], axis=-1)
    # A bound of the vector is one of the quantity where they are the same up to a constant.
    offset = value - J[np.arange(len(J)), which] * x[which]
    low = np.where(one, J[np.arange(len(J)), which] * p.low[which] + offset, -np.inf)
    ends[:, 0] = np.maximum(ends[:, 0], np.where(np.isnan(low), -np.inf, low))
    ends[~known] = [-np.inf, np.inf]
    # Akaike's criterion compares likelihoods, hence independent errors: a term that is kept for nothing costs little.
    alone_std = np.sqrt(np.einsum("qi,ij,qj->q", Jk, local, Jk))
    tail = norm.sf(np.maximum(free, 0.0) / np.maximum(alone_std, 1e-300))
    return value, ends, np.where(known, 2.0 * tail, 1.0)


def estimates(
    p: Parameters,
    x: Array,
    found: Confidence,
    *,
    axes: Sequence[str],
    own_error: float = 0.0,
    wider: dict[str, tuple[float, float]] | None = None,
    dropped: dict[str, str] | None = None,
) -> tuple[dict[str, Estimate], dict[str, float], list[Finding]]:
    """Named estimates.

    Args:
        p: What was free.
        x: Where it ended, (P,).
        found: Evidence there.
        axes: Which to report.
        own_error: Of the simulation itself, as a part of an estimate; intervals hold it too.
        wider: Intervals of the fuller model that this one was chosen from; both are covered.
        dropped: Quantity -> why it was left out.

    Returns:
        Estimates by name, the p-value of each being zero, and which rest on a bound.
    """
    listed = quantities(p, axes)
    value, ends, p_value = spread(p, listed, x, found, own_error)
    at_low = {name for name, xi, low in zip(p.names, x, p.low, strict=True) if xi <= low}
    free = dict(zip(p.names, found.free, strict=False))
    out, bounds = dict[str, Estimate](), list[Finding]()
    for q, quantity in enumerate(listed):
        low, high = float(ends[q, 0]), float(ends[q, 1])
        if wider and quantity.name in wider:
            low, high = min(low, wider[quantity.name][0]), max(high, wider[quantity.name][1])
        sure, note = _verdict(quantity, float(value[q]), low, high)
        coordinate = "k" if quantity.kind == "k" else quantity.name.replace("m_eff", "added_mass")
        if dropped and quantity.name in dropped:
            sure, note = False, dropped[quantity.name]
        elif coordinate in at_low:
            sure, note = False, "held at its bound"
            if np.isfinite(low + high):
                note += f"; free, it would be {free[coordinate]:.3g} {quantity.unit}"
            bounds.append(finding("at_bound", quantity.name, free=free[coordinate], unit=quantity.unit))
        elif quantity.kind == "added_mass" and sure and value[q] <= 0.0:
            rigid = p.M_RB[quantity.axis, quantity.axis]
            sure, note = False, f"m_eff is below the file's rigid {rigid:.4g} {quantity.unit}"
        out[quantity.name] = Estimate(
            name=quantity.name,
            estimate=float(value[q]),
            ci95=(low, high),
            unit=quantity.unit,
            identifiable=sure,
            note=note,
            path=quantity.path,
        )
    return out, {quantity.name: float(p_value[q]) for q, quantity in enumerate(listed)}, bounds


def _verdict(quantity: Quantity, value: float, low: float, high: float) -> tuple[bool, str]:
    """Whether a quantity is determined, and what to say of it."""
    half = 0.5 * (high - low)
    if not np.isfinite(half):
        return False, "the trials say nothing of it"
    if quantity.kind in ("bias", "buoyancy_excess", "coupling", "current.x", "current.y"):
        return True, BIAS_NOTE if quantity.kind == "bias" else ""
    if quantity.kind == "thrust_delay":
        return half <= LAG_CERTAIN, "" if half <= LAG_CERTAIN else f"known to no better than ±{half:.2g} s"
    if half > CERTAIN * abs(value):
        percent = 100.0 * half / max(abs(value), 1e-300)
        return False, f"known to no better than ±{min(percent, 9999.0):.0f} %"
    if quantity.kind == "added_mass" and low <= 0.0:
        return False, "not distinguishable from zero"
    return True, ""
