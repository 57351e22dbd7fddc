"""Hydrodynamics by simulation error: numbers with which the simulator, driven as the vehicle was, moves as it did."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.findings import Finding, finding
from finssim.calibration.fit import Curve, Estimate, Fit
from finssim.calibration.motion import Motion
from finssim.calibration.regression.axis_estimates import (
    CERTAIN,
    AxisResult,
    Number,
    drag_known,
    hydrostatics,
)
from finssim.calibration.regression.axis_fit import AKAIKE, DAMPING
from finssim.calibration.regression.plant_terms import matrices
from finssim.calibration.simulation.rollout import Segment, Streams, segments, streams
from finssim.calibration.simulation.shooting import (
    CUT,
    EXTRAS,
    Parameters,
    Point,
    Shooting,
    Solution,
    solve,
    weights_of,
)
from finssim.calibration.trials.inputs import require_axes, require_fittable
from finssim.calibration.trials.trial import Trial
from finssim.calibration.uncertainty import Covariance, Evidence, degeneracy, intervals, trial_covariance
from finssim.calibration.vehicle_file import SCALED
from finssim.engine.plant_arrays import twist_shift
from finssim.vehicles import AXES, HydrodynamicSet, Vehicle, VehicleError
from finssim.vehicles.terms import unit_of

__all__ = ["ESTIMATE", "fit_by_simulation"]

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
"""Half width of the interval of a delay up to which it counts as identifiable [s]."""

PATHS = {
    "buoyancy_excess": "body.displaced_volume",
    "thrust_scale": None,
    "thrust_lag": "thrusters.*.time_constant",
    "thrust_delay": "thrusters.*.delay",
    "current.x": None,
    "current.y": None,
}
"""Coordinates besides those of the axes that are reported, and where they stand in the vehicle file."""

SIGNED = ("buoyancy_excess", "current.x", "current.y")
"""Of these, those that may well be zero: determined wherever they have an interval."""


def numbers_of(p: Parameters, x: Array, found: Confidence, own_error: float) -> dict[str, Number]:
    """Every coordinate with its 95 % interval, by name.

    Args:
        p: What was free.
        x: Where it ended, (P,).
        found: Evidence there.
        own_error: Of the simulation itself, as a part of an estimate; intervals hold it too.
    """
    local, out = np.diagonal(found.covariance.local), {}
    half = intervals(np.zeros(len(local)), found.covariance)[:, 1]
    for c, name in enumerate(p.names):
        low, high, value = -np.inf, np.inf, float(x[c])
        if np.isfinite(local[c]):
            free = value + float(np.clip(found.free[c] - value, -1e6, 1e6))
            width = float(np.hypot(half[c], own_error * abs(value + rigid_part(p, name))))
            low, high = max(min(free - width, value), p.low[c]), max(free + width, value)
        out[name] = Number(value, (low, high), float(found.free[c]) if value <= p.low[c] else None)
    return out


def rigid_part(p: Parameters, name: str) -> float:
    """Rigid inertia of the axis of an added mass [kg, kg m²]; 0 of any other coordinate."""
    axis, _, kind = name.partition(".")
    return float(p.M_RB[AXES.index(axis), AXES.index(axis)]) if kind == "added_mass" else 0.0


def axis_result(
    p: Parameters, numbers: Mapping[str, Number], first: Mapping[str, Number], axis: str, **known: Any
) -> AxisResult:
    """The result of one axis.

    Args:
        p: What was free.
        numbers: Of `numbers_of`.
        first: The same of the fuller model from which this one was chosen: damping that was left out has its interval.
        axis: Which.
        known: Further fields of `AxisResult`.
    """
    mass, rigid = numbers[f"{axis}.added_mass"], rigid_part(p, f"{axis}.added_mass")
    free = None if mass.free is None else mass.free + rigid
    own = {"m_eff": Number(mass.value + rigid, (mass.ends[0] + rigid, mass.ends[1] + rigid), free)}
    own |= {n: numbers[f"{axis}.{n}"] for n in ("d1", "d2", "bias") if f"{axis}.{n}" in numbers}
    if "k" in numbers and axis in ("roll", "pitch"):
        own["k"] = numbers["k"]
    dropped = {
        n: (0.0, first[f"{axis}.{n}"].ends[1])
        for n in ("d1", "d2")
        if n not in own and f"{axis}.{n}" in first
    }
    return AxisResult(axis=axis, numbers=own, file=matrices(p.vehicle), dropped=dropped, **known)


def other_estimates(
    p: Parameters, numbers: Mapping[str, Number]
) -> tuple[dict[str, Estimate], list[Finding]]:
    """Of what no axis has for itself, and which of them rest on a bound."""
    out, bounds = dict[str, Estimate](), list[Finding]()
    units = {c.name: c.unit for c in p.coordinates if c.name in PATHS} | {
        path: unit_of(path) for path in p.terms
    }
    for name, unit in units.items():
        value, (low, high), free = numbers[name]
        half, note = 0.5 * (high - low), ""
        limit = LAG_CERTAIN if name == "thrust_delay" else np.inf if name in SIGNED else CERTAIN * abs(value)
        if free is not None:
            note = f"held at its bound; free, it would be {free:.3g} {unit}"
            bounds.append(finding("at_bound", name, free=free, unit=unit))
        elif not np.isfinite(half):
            note = "the trials do not determine it"
        elif half > limit:
            note = f"known to no better than ±{half:.2g} {unit}"
        path = PATHS[name] if name in PATHS else f"hydrodynamics.{p.hydrodynamics}.{name}"
        out[name] = Estimate(
            name=name,
            estimate=value,
            ci95=(low, high),
            unit=unit,
            identifiable=not note,
            note=note,
            path=path,
        )
    return out, bounds


# What trials show: which axes they excite, which measurements tell of an axis, how fast the vehicle answers.

TELL = {
    "surge": ("u", "x", "y"),
    "sway": ("v", "x", "y"),
    "heave": ("w", "z", "depth"),
    "roll": ("p", "roll"),
    "pitch": ("q", "pitch"),
    "yaw": ("r", "yaw"),
}
"""Measured columns that tell of an axis, the most direct first."""

DRIFTING = {"x": "u", "y": "v", "yaw": "r"}
"""Integrals without a restoring force: where the rate is measured they add drift, not knowledge."""

SEEN = 0.9
"""Part of a segment for which a velocity has to be known to be imposed."""

PUSH = 0.03
"""Range of a wrench, as part of the vehicle's limit, below which an axis is not driven."""

SWING = 0.2
"""Range of the rate of roll or pitch that tells of it though no thruster is meant for it [rad/s]."""

ANSWER = (0.02, 0.02, 0.02, 0.04, 0.04, 0.04)
"""Range of a velocity below which an axis does not answer [m/s, rad/s]."""


def compared(segment: Segment, motion: Motion, axes: Sequence[str]) -> Segment:
    """The segment as a fit of some axes uses it.

    Axes that are not fitted move as they were seen to, where they were seen: their numbers in the vehicle file may be
    wrong, and couplings would carry that into the others. They are not compared, nor are integrals that add drift.
    """
    held = np.full((segment.steps + 1, 6), np.nan)
    t = segment.t0 + segment.step * np.arange(segment.steps + 1)
    drop = {column for column, rate in DRIFTING.items() if rate in segment.measured}
    inside = (motion.t >= t[0] - 0.1) & (motion.t <= t[-1] + 0.1)
    for i, axis in enumerate(AXES):
        good = inside & np.isfinite(motion.nu[:, i])
        if axis not in axes and good.sum() >= max(2.0, SEEN * inside.sum()):
            held[:, i] = np.interp(t, motion.t[good], motion.nu[good, i])
            drop |= {TELL[axis][0]}
    if not np.isnan(held[:, 3:5]).any():
        drop |= {"roll", "pitch"}
    measured = {c: pair for c, pair in segment.measured.items() if c not in drop}
    return replace(segment, measured=measured, held=held)


def observable(trials: Sequence[Streams]) -> tuple[str, ...]:
    """Axes that some trial measures anything of."""
    columns = {c for s in trials for c in s.measured}
    return tuple(a for a in AXES if columns & set(TELL[a]))


def excited(trials: Sequence[Streams], vehicle: Vehicle) -> tuple[str, ...]:
    """Axes that the trials excite: those their headers name, else those that were driven, or moved while passive, and
    answered."""
    found = {axis for s in trials for axis in excites(s, vehicle)}
    return tuple(a for a in AXES if a in found and a in observable(trials))


def telling(trials: Sequence[Streams], vehicle: Vehicle, axes: Sequence[str]) -> list[Streams]:
    """Trials that excite one of some axes; all of them where none does.

    In the others the vehicle moves on axes that are not fitted, maybe not even measured, and couplings carry that over.
    """
    return [s for s in trials if set(excites(s, vehicle)) & set(axes)] or list(trials)


def excites(s: Streams, vehicle: Vehicle) -> set[str]:
    """Axes that one trial excites: those its header names, else those that were driven, or moved while passive."""
    return set(s.trial.header.axis) or _moved(s, vehicle)


def _moved(s: Streams, vehicle: Vehicle) -> set[str]:
    try:
        limits = vehicle.wrench_limits
    except VehicleError:
        limits = np.zeros(6)
    tau = s.motion.tau @ np.linalg.inv(twist_shift(list(vehicle.wrench_reference)))
    out: set[str] = set()
    for i, axis in enumerate(AXES):
        nu = s.motion.nu[:, i]
        noise = s.motion.noise_std[i]
        answers = _range(nu) > max(ANSWER[i], 4.0 * noise if np.isfinite(noise) else 0.0)
        pushed = limits[i] > 0.0 and _range(tau[:, i]) > PUSH * limits[i]
        # Weight rights roll and pitch again: a swing tells of them whatever began it.
        swings = i in (3, 4) and _range(nu) > max(SWING, 10.0 * np.nan_to_num(noise))
        if answers and (pushed or swings or s.drive.source == "passive"):
            out.add(axis)
    return out


def _range(values: Array) -> float:
    finite = values[np.isfinite(values)]
    return float(np.ptp(np.percentile(finite, [2.0, 98.0]))) if len(finite) else 0.0


def speeds(motions: Sequence[Motion], axis: str) -> tuple[float, float]:
    """Range of speeds at which an axis was seen moving, from the 20th to the 99th percentile [m/s or rad/s]."""
    i = AXES.index(axis)
    values = np.concatenate([np.abs(m.nu[:, i]) for m in motions] or [np.empty(0)])
    values = values[np.isfinite(values)]
    moving = values[values > max(0.02 * values.max(initial=0.0), 1e-9)]
    return (
        (float(np.percentile(moving, 20.0)), float(np.percentile(moving, 99.0)))
        if len(moving)
        else (0.0, 0.0)
    )


def horizon(vehicle: Vehicle, trials: Sequence[Streams], axes: Sequence[str]) -> float:
    """Length of segments that shows steady motion and yet forgets what no model knows [s]: five of the slowest time
    constant, at least forty samples, between 5 and 12 s."""
    chosen = vehicle.hydrodynamic_set("calibrated")
    M = np.diag(vehicle.mass_matrix("calibrated"))
    slowest = 0.5
    if isinstance(chosen, HydrodynamicSet):
        for axis in axes:
            i = AXES.index(axis)
            top = speeds([s.motion for s in trials], axis)[1]
            drag = chosen.linear_damping[i, i] + chosen.quadratic_damping[i, i] * top
            slowest = max(slowest, float(M[i] / drag) if drag > 0.0 else 3.0)
    return float(np.clip(max(5.0 * slowest, 40.0 * sampling(trials)), 5.0, 12.0))


def sampling(trials: Sequence[Streams]) -> float:
    """Usual time between the samples of a channel [s]."""
    steps = [float(np.median(np.diff(t))) for s in trials for t, _ in s.measured.values() if len(t) > 2]
    return float(np.median(steps or [0.02]))


# What a simulation-error fit shows besides its estimates: figures by axis, curves, findings.

LATE = 0.03
"""Lag of a stream worth a warning [s]."""

SHOWN = 4
"""Trials in the curve of an axis."""


def _shown_by(
    problem: Shooting, axis: str
) -> tuple[str, NDArray[np.int64], NDArray[np.int64], dict[int, float]]:
    """The most direct channel in use that tells of an axis, its samples (n,), their trials (n,), and the range of the
    channel in each trial, from the 5th to the 95th percentile; no samples where there is no such channel."""
    m = problem.measured
    name = next((c for c in TELL[axis] if c in m.names), "")
    rows = np.flatnonzero(m.channel == m.names.index(name)) if name else np.empty(0, int)
    trial = problem.groups[m.segment][rows]
    spans = {
        int(g): float(np.ptp(np.percentile(m.value[rows][trial == g], [5.0, 95.0]))) for g in np.unique(trial)
    }
    return name, rows, trial, spans


def quality(
    problem: Shooting, solution: Solution, axes: Sequence[str], used: Sequence[Streams]
) -> dict[str, dict[str, float]]:
    """Figures of each axis over the trials that move it: the simulated against the measured channel."""
    out = {}
    for axis in axes:
        name, rows, trial, spans = _shown_by(problem, axis)
        if not name:
            continue
        moving = [g for g, span in spans.items() if span > 0.2 * max(spans.values())]
        inside = np.isin(trial, moving)
        rows, trial = rows[inside], trial[inside]
        residual, value = solution.linear.residual[rows], problem.measured.value[rows]
        rms = {g: float(np.sqrt(np.mean(residual[trial == g] ** 2))) for g in moving}
        low, high = speeds([s.motion for s in used], axis)
        out[axis] = {
            "r2": 1.0 - float(np.mean(residual**2)) / max(float(np.var(value)), 1e-300),
            "rmse": float(np.sqrt(np.mean(residual**2))),
            "nrmse": float(np.mean([rms[g] / max(spans[g], 1e-12) for g in moving])),
            "samples": float(len(rows)),
            "rejected": float(np.sum(np.abs(residual) > 2.0 * CUT * solution.std[rows])),
            "trials": float(len(moving)),
            "speed_low": low,
            "speed_high": high,
            "noise": float(np.median(solution.std[rows])),
        }
    return out


def pictures(problem: Shooting, solution: Solution, axes: Sequence[str]) -> tuple[Curve, ...]:
    """Measured and simulated channel of each axis, over the trials that move it most."""
    m, out = problem.measured, []
    clock = m.time + np.array([s.t0 for s in problem.segments])[m.segment]
    for axis in axes:
        name, rows, trial, spans = _shown_by(problem, axis)
        parts = []
        for g in sorted(sorted(spans, key=lambda g: -spans[g])[:SHOWN]):
            those = rows[trial == g]
            those = those[np.argsort(clock[those], kind="stable")]
            value = m.value[those]
            parts.append((clock[those], value, value - solution.linear.residual[those]))
        if name:
            title = f"{axis}: {name}, simulated from the inputs alone"
            out.append(Curve.joined(title, f"{name} [{_unit(name)}]", parts))
    return tuple(out)


def _unit(name: str) -> str:
    if name in ("u", "v", "w"):
        return "m/s"
    return "rad/s" if name in ("p", "q", "r") else "rad" if name in ("roll", "pitch", "yaw") else "m"


def fit_findings(
    problem: Shooting,
    solution: Solution,
    found: Confidence,
    used: Sequence[Streams],
) -> list[Finding]:
    """What a reader should know before using the numbers."""
    out = []
    if solution.interrupted:
        out.append(finding("interrupted"))
    elif not solution.converged:
        out.append(finding("not_converged", iterations=solution.iterations))
    P = len(problem.parameters.names)
    for stream, late, (low, high) in zip(
        problem.errors.streams, solution.point.theta[P : problem.shared], found.interval[P:], strict=True
    ):
        if abs(late) > LATE and (low > 0.0 or high < 0.0):
            sense = "lags" if late > 0.0 else "leads"
            out.append(finding("motion_late", stream, sense=sense, lag=abs(late), low=low, high=high))
    if found.evidence.unit == "blocks":
        out.append(finding("block_intervals", trials=len(used)))
    return out


class Clock:
    """Tells progress over several stages: iteration, cost, rate and what may remain."""

    def __init__(self, progress: Callable[[float, str], None] | None) -> None:
        self.progress, self.begin, self.part = progress, time.perf_counter(), 0.0

    def __call__(self, words: str, toward: float = 1.0) -> None:
        # How many iterations remain nobody knows; each takes a share of the rest.
        self.part += 0.2 * max(toward - self.part, 0.0)
        spent = time.perf_counter() - self.begin
        if self.progress:
            self.progress(self.part, f"{words}, {spent:.0f} s")


# From a simulation-error fit to changes of the vehicle file: only what the trials determine.


def changes(
    p: Parameters, x: Array, found: Mapping[str, Estimate], axes: dict[str, Any], scaled: bool
) -> dict[str, Any]:
    """Changes of the vehicle file.

    Args:
        p: What was free.
        x: Where it ended, (P,).
        found: All estimates.
        axes: Changes of the axes' own numbers.
        scaled: Whether a thrust scale belongs to the thrusters' curves.
    """
    out = dict(axes)
    for path, matrix in _matrices(p, x).items():
        old = np.asarray(getattr(p.set, path.rpartition(".")[2]), float)
        for i, axis in enumerate(AXES):
            # Axes that nobody measured were simulated: the others hold with their numbers.
            if f"{path}.{i}.{i}" in axes or axis in p.unseen:
                for j in range(6):
                    # Couplings are written where the fit did away with them.
                    if i == j or matrix[i, j] != old[i, j]:
                        out[f"{path}.{i}.{j}"] = float(matrix[i, j])
    out |= hydrostatics(found, p.vehicle)[0]
    for name, path in (("thrust_lag", "time_constant"), ("thrust_delay", "delay")):
        if name in found and found[name].identifiable:
            out[f"thrusters.*.{path}"] = max(found[name].estimate, 1e-4 if path == "time_constant" else 0.0)
    for path in p.terms:
        if found[path].identifiable:
            out[str(found[path].path)] = found[path].estimate
    if "thrust_scale" in found and found["thrust_scale"].identifiable and scaled:
        scale = found["thrust_scale"].estimate
        for name, thruster in p.vehicle.thrusters.items():
            out |= {f"thrusters.{name}.{key}": scale * float(getattr(thruster, key)) for key in SCALED}
    return out


def _drag_known(p: Parameters, x: Array, found: Confidence, axis: str, speed: float) -> bool:
    """`drag_known` at one speed."""
    i, names = AXES.index(axis), [f"{axis}.{name}" for name in ("d1", "d2")]
    at = [p.names.index(name) for name in names if name in p.names]
    free = np.isin(names, p.names)
    C = found.covariance
    C = (C.local if C.alone[at].any() else C.trials)[np.ix_(at, at)]
    d = np.zeros(2)
    d[free] = x[at]
    before = float(p.set.linear_damping[i][i]), float(p.set.quadratic_damping[i][i])
    return drag_known(d, free, [C], 2.0, [speed], before)


STEP = 0.02
"""Of the simulation [s]."""

SHORT = 2.5
"""Of the segments at first [s]: over so short a time every problem is nearly linear."""

OWN_ERROR, BETWEEN = 0.003, 0.05
"""Error of the simulation itself, as a part of an estimate; and how it grows with the time between samples of the
inputs [1/s], for nobody recorded what happened in between."""

GROWTH = 12.0
"""Growth of a disturbance of the initial velocity over a segment above which its trial is cut into shorter ones.

A fast vehicle without fins turns broadside by itself, and derivatives over a long run of that mean little."""

HALVINGS = 2


@dataclass
class Stage:
    """One fit of one set of parameters."""

    problem: Shooting
    solution: Solution
    found: Confidence

    @property
    def x(self) -> Array:
        """Where the parameters ended, (P,)."""
        return self.solution.point.theta[: len(self.problem.parameters.names)]


class Stages:
    """The stages of one fit: they share trials and segments."""

    def __init__(
        self,
        prepared: Sequence[Streams],
        vehicle: Vehicle,
        axes: tuple[str, ...],
        estimate: tuple[str, ...],
        length: float | None,
        starts: Sequence[dict[str, float]],
        say: Clock,
    ) -> None:
        self.prepared, self.vehicle, self.axes, self.say = prepared, vehicle, axes, say
        self.given, self.starts = length, starts
        self.excites = [excites(s, vehicle) for s in prepared]
        # The added mass of axes that are not fitted pushes and turns the others; roll's and pitch's hardly does.
        self.imposed = tuple(a for a in ("surge", "sway", "heave", "yaw") if a not in axes)
        measured = observable(prepared)
        self.unseen = tuple(a for a in self.imposed if a not in measured)
        apart = [float(np.median(np.diff(s.drive.t))) for s in prepared if not s.drive.held]
        self.own_error = OWN_ERROR + BETWEEN * max([0.0, *(dt - STEP for dt in apart)])
        self.shorter: dict[str, float] = {}
        self.used: list[Streams] = []
        self.segments: list[Segment] = []
        self.extras = {word for word in estimate if word not in ("bias", "trial_bias")}
        if "heave" in axes:
            self.extras.add("buoyancy_excess")
        if {"roll", "pitch"} & set(axes):
            self.extras.add("k")
        biased = [a for a in axes if a != "heave"]
        self.trial_biases = biased if "trial_bias" in estimate else []
        self.biases = [] if self.trial_biases else biased

    def first(self, kinds: dict[str, str]) -> Stage:
        """Short segments from the better of the starts, then segments of the length that the answer calls for."""
        short = max(SHORT, 15.0 * sampling(self.prepared))
        self.cut(min(short, self.given or short))
        problem = min(
            (self.problem(kinds, start) for start in self.starts), key=lambda one: one.cost(one.start())
        )
        point = problem.start()
        problem.hold_clocks(True)
        rough = solve(
            problem, point, iterations=12, std=problem.size(), rough=True, report=self.report("start", 0.3)
        )
        if not np.isfinite(rough.cost):
            raise CalibrationError(
                "the simulation diverges with the vehicle file's numbers: give better ones, or shorter segments "
                f"(now {self.length:.3g} s)"
            )
        p, x = problem.parameters, rough.point.theta[: len(problem.parameters.names)]
        if rough.interrupted:
            problem.hold_clocks(False)
            return Stage(problem, rough, confidence(problem, rough))
        self.cut(self.given or horizon(self.vehicle.replace(_matrices(p, x)), self.prepared, self.axes))
        problem = self.problem(kinds, dict(zip(p.names, x, strict=True)))
        for _ in range(0 if self.given else HALVINGS):
            growth = problem.growth(problem.start())
            wild = {self.used[g].trial.name for g in np.unique(problem.groups[growth > GROWTH])}
            if not wild:
                break
            for name in wild:
                self.shorter[name] = 0.5 * self.shorter.get(name, 1.0)
            self.cut(self.length)
            problem = self.problem(kinds, dict(zip(p.names, x, strict=True)))
        return self.finish(problem, problem.start(), 0.6)

    def next(self, kinds: dict[str, str], before: Stage) -> Stage:
        """Another set of parameters, from where a fit ended."""
        old, x = before.problem.parameters, before.x
        problem = self.problem(kinds, dict(zip(old.names, x, strict=True)))
        rest = before.solution.point.theta[len(old.names) :]
        point = Point(np.concatenate([problem.parameters.start, rest]), before.solution.point.z)
        return self.finish(problem, point, 0.95, before.solution.std)

    def finish(self, problem: Shooting, point: Point, toward: float, std: Array | None = None) -> Stage:
        """Fit with robust weights and clocks let go, after a first approach without."""
        if std is None:
            problem.hold_clocks(True)
            rough = solve(
                problem,
                point,
                iterations=6,
                std=problem.size(),
                rough=True,
                report=self.report("fit", toward),
            )
            problem.hold_clocks(False)
            point = rough.point
            if rough.interrupted:
                return Stage(problem, rough, confidence(problem, rough))
        solution = solve(problem, point, std=std, report=self.report("fit", toward))
        return Stage(problem, solution, confidence(problem, solution))

    def numbers(self, stage: Stage) -> dict[str, Number]:
        """Of a stage."""
        return numbers_of(stage.problem.parameters, stage.x, stage.found, self.own_error)

    def report(self, words: str, toward: float) -> Callable[[int, float], None]:
        return lambda i, rms: self.say(f"{words}: iteration {i}, residual {rms:.4g} σ", toward)

    def cut(self, length: float) -> None:
        """Cut the trials into segments of about a length [s]."""
        tells = {column for axis in self.axes for column in TELL[axis]}
        cut = [
            [
                compared(s, one.motion, self.axes)
                for s in segments(one, self.vehicle, length=length * self._part(one), step=STEP)
            ]
            for one in self.prepared
        ]
        kept = [[s for s in stretch if tells & set(s.measured)] for stretch in cut]
        self.length = length
        self.used = [one for one, stretch in zip(self.prepared, kept, strict=True) if stretch]
        self.segments = [replace(s, index=g) for g, stretch in enumerate(filter(None, kept)) for s in stretch]
        if not self.segments:
            raise CalibrationError(
                f"no stretch of these trials has both inputs and measurements that tell of {', '.join(self.axes)}"
            )
        commanded = np.array([s.commanded for s in self.segments])
        # Where every input is said to have acted, whoever asks for a lag doubts that.
        self.lagged = commanded if commanded.any() else np.ones_like(commanded)

    def _part(self, one: Streams) -> float:
        return self.shorter.get(one.trial.name, 1.0)

    def problem(self, kinds: dict[str, str], start: dict[str, float]) -> Shooting:
        """What is free, over the segments."""
        parameters = Parameters(
            self.vehicle,
            axes=self.axes,
            damping=kinds,
            extras=tuple(self.extras),
            biases=self.biases,
            start=start,
            imposed=self.imposed,
            unseen=self.unseen,
        )
        return Shooting(
            self.segments,
            parameters,
            sorted({c for s in self.segments for c in s.measured}),
            trial_biases=self.trial_biases,
            lagged=self.lagged,
            few=min(sum(axis in one for one in self.excites) for axis in self.axes) < FEWEST_TRIALS,
        )

    def result(
        self,
        stage: Stage,
        first: Mapping[str, Number],
        remarks: list[Finding],
        *,
        damping: str,
        seed: int,
    ) -> Fit:
        """The finished fit; intervals hold those of the fuller model `first` from which this one was chosen."""
        p, x = stage.problem.parameters, stage.x
        numbers = self.numbers(stage)
        for name in numbers.keys() & first.keys():
            (low, high), (a, b) = numbers[name].ends, first[name].ends
            numbers[name] = numbers[name]._replace(ends=(min(low, a), max(high, b)))
        found, axes, bounds = dict[str, Estimate](), dict[str, Any](), list[Finding]()
        for axis in self.axes:
            own = speeds([s.motion for s in self.used], axis)
            known = _drag_known(p, x, stage.found, axis, own[1])
            result = axis_result(p, numbers, first, axis, speeds=own, drag_known=known)
            found |= result.estimates
            axes |= result.changes
            bounds += result.findings
        others, held = other_estimates(p, numbers)
        found |= others
        sources = {s.drive.source for s in self.used}
        new = changes(p, x, found, axes, scaled=sources <= {"rpm", "pwm"})
        P, local = stage.problem.judged, stage.found.covariance.local
        correlation, traded = degeneracy(p.names[:P], local[:P, :P], stage.found.free[:P])
        left_out = [one.trial.name for one in self.prepared if one not in self.used]
        remarks = [
            *remarks,
            *(finding("trial_left_out", name) for name in left_out),
            *fit_findings(stage.problem, stage.solution, stage.found, self.used),
            *bounds,
            *held,
            *traded,
        ]
        settings: dict[str, Any] = {
            "axes": list(self.axes),
            "damping": damping,
            "estimate": sorted(self.extras) + (["trial_bias"] if self.trial_biases else []),
            "horizon": round(self.length, 3),
            "step": STEP,
            "segments": len(self.segments),
            "iterations": stage.solution.iterations,
            "seed": seed,
        }
        self.say("done")
        return Fit(
            kind="hydrodynamics",
            method="simulation",
            vehicle=self.vehicle,
            estimates=found,
            changes=new,
            quality=quality(stage.problem, stage.solution, self.axes, self.used),
            correlation=correlation,
            findings=tuple(dict.fromkeys(remarks)),
            curves=pictures(stage.problem, stage.solution, self.axes),
            trials={one.trial.name: one.trial.sha256 for one in self.used},
            settings=settings,
            interrupted=stage.solution.interrupted,
        )


def _matrices(p: Parameters, x: Array) -> dict[str, Any]:
    """Changes of the vehicle file to the matrices of a vector."""
    base = f"hydrodynamics.{p.hydrodynamics}"
    names = ("added_mass", "linear_damping", "quadratic_damping")
    return {f"{base}.{name}": m[0] for name, m in zip(names, p.matrices(x), strict=True)}


Progress = Callable[[float, str], None]

ESTIMATE = (*EXTRAS, "bias", "trial_bias")
"""Words for `estimate`; `trial_bias` gives every trial a bias of its own, as a tether does."""


def fit_by_simulation(
    trials: Sequence[Trial],
    vehicle: Vehicle,
    *,
    axes: Sequence[str] | None = None,
    estimate: Sequence[str] = (),
    damping: str = "auto",
    horizon: float | None = None,
    begin: Fit | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Fit:
    """Fit by simulation error over all trials at once.

    Trials are cut into segments with an initial state each; Levenberg-Marquardt moves the parameters, the initial
    states, offsets of the sensors and lags of their streams, with derivatives from parallel worlds. All numbers hold at
    the reference point of the vehicle's calibrated set.

    Args:
        trials: Of any inputs, rates and measured columns.
        vehicle: Gives the rigid body, the motors and everything that is not fitted.
        axes: Axes to fit; those that the trials excite if None.
        estimate: Words of `ESTIMATE`, and parameters of the vehicle's terms, such as `lift.coefficient`. Buoyancy comes
            with heave, stiffness with roll and pitch, a bias with the others.
        damping: `auto`, `linear`, `quadratic` or `both`.
        horizon: Length of the segments [s]; from the data if None.
        begin: Of another method: it begins with its numbers where these simulate the trials better than the file's.
        seed: Recorded; nothing here is random.
        progress: Called with the part done and a few words.

    Returns:
        After Ctrl-C the best until then, with `interrupted`.

    Raises:
        CalibrationError: No trial can be used, one is held out, or a word is unknown.
    """
    _check(trials, vehicle, axes, damping, estimate)
    prepared = [streams(trial, vehicle) for trial in trials]
    chosen, remarks = _axes(prepared, vehicle, axes)
    say = Clock(progress)
    starts = [{}] if begin is None else [{}, {name: e.estimate for name, e in begin.estimates.items()}]
    fit = Stages(telling(prepared, vehicle, chosen), vehicle, chosen, tuple(estimate), horizon, starts, say)
    kinds = dict.fromkeys(chosen, "both" if damping == "auto" else damping)
    stage = fit.first(kinds)
    first: dict[str, Number] = {}
    if damping == "auto" and not stage.solution.interrupted:
        chosen_kinds = _select(kinds, stage)
        if chosen_kinds != kinds:
            first = fit.numbers(stage)
            stage = fit.next(chosen_kinds, stage)
    return fit.result(stage, first, remarks, damping=damping, seed=seed)


def _check(
    trials: Sequence[Trial],
    vehicle: Vehicle,
    axes: Sequence[str] | None,
    damping: str,
    estimate: Sequence[str],
) -> None:
    require_fittable(trials, vehicle)
    require_axes(axes)
    if damping not in DAMPING:
        raise CalibrationError(f"unknown damping '{damping}'; available: {', '.join(DAMPING)}")
    chosen = vehicle.hydrodynamics.get("calibrated")
    known = [*ESTIMATE, *(chosen.term_scalars if isinstance(chosen, HydrodynamicSet) else ())]
    for word in estimate:
        if word not in known:
            raise CalibrationError(
                f"cannot estimate '{word}'; available: {', '.join(known)}"
                + ("; a term's parameter only where the vehicle file has the term" if "." in word else "")
            )


def _axes(
    prepared: Sequence[Streams], vehicle: Vehicle, axes: Sequence[str] | None
) -> tuple[tuple[str, ...], list[Finding]]:
    """Axes to fit, and why some that were asked for are not."""
    moved, seen = excited(prepared, vehicle), observable(prepared)
    if axes is None:
        if not moved:
            raise CalibrationError(
                f"no trial excites an axis of {vehicle.name}: name the axes, or give trials with larger inputs"
            )
        return moved, []
    remarks = [finding("axis_untold", axis) for axis in axes if axis not in seen]
    remarks += [finding("axis_doubtful", axis) for axis in axes if axis in seen and axis not in moved]
    chosen = tuple(a for a in AXES if a in axes and a in seen)
    if not chosen:
        raise CalibrationError(f"nothing that tells of {', '.join(axes)} was measured in these trials")
    return chosen, remarks


def _select(kinds: dict[str, str], stage: Stage) -> dict[str, str]:
    """Damping of each axis by Akaike's criterion.

    It compares likelihoods, hence errors that are independent: a term that stays for nothing costs little.
    """
    from scipy.stats import norm

    names, new = stage.problem.parameters.names, dict(kinds)
    std = np.sqrt(np.diagonal(stage.found.covariance.local))
    for axis in kinds:
        p_value = {}
        for name in ("d1", "d2"):
            c = names.index(f"{axis}.{name}")
            known = bool(np.isfinite(std[c]))
            p_value[name] = (
                2.0 * norm.sf(max(stage.found.free[c], 0.0) / max(std[c], 1e-300)) if known else 1.0
            )
        weakest = max(p_value, key=lambda name: p_value[name])
        if p_value[weakest] > AKAIKE:
            new[axis] = "quadratic" if weakest == "d1" else "linear"
    return new
