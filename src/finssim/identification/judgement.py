"""Quality of a fit: figures by axis, prediction of left-out data, curves, findings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from finssim.core.least_squares import boxed
from finssim.identification.confidence import Confidence, Stage, evidence_of, shared_slopes, time_blocks
from finssim.identification.excitation import speeds
from finssim.identification.fit import Curve
from finssim.identification.rollout import Streams
from finssim.identification.shooting import CUT, FitSolution, Point, Shooting
from finssim.identification.uncertainty import intervals
from finssim.trials.conversion import EULER
from finssim.trials.findings import Finding, finding
from finssim.trials.free_motion import DETERMINED_BY
from finssim.trials.motion import without_spikes
from finssim.trials.trial import COLUMNS

Array = NDArray[np.float64]


LATE = 0.03
"""Lag of a stream above which a warning is given [s]."""

SHOWN = 4
"""Number of trials in the curve of an axis."""


def valid_samples(problem: Shooting, solution: FitSolution) -> NDArray[np.bool_]:
    """Return a mask of the samples that count in figures of quality, (N,).

    Excluded are samples that the fit rejects and that are isolated among the residuals of their channel and
    trial, at most a twentieth of these: the errors of a wrong model are persistent or numerous, and count.
    """
    m, clock = problem.measured, problem.measured.clock
    residual = solution.linear.residual
    series = len(m.names) * problem.groups[m.segment] + m.channel
    out = np.abs(residual) <= 2.0 * CUT * solution.std
    for one in np.unique(series[~out]):
        rows = np.flatnonzero(series == one)
        rows = rows[np.argsort(clock[rows], kind="stable")]
        out[rows] |= without_spikes(clock[rows], residual[rows, None])
    return out


def channels(problem: Shooting, solution: FitSolution) -> dict[str, str]:
    """Return the measured channel that determines each axis: the most direct one; empty if there is none.

    If no velocity is measured, surge and sway are assigned one of x and y each: the one that their own
    numbers affect more.
    """
    m, p = problem.measured, problem.parameters
    out = {axis: next((c for c in DETERMINED_BY[axis] if c in m.names), "") for axis in p.axes}
    planar = [axis for axis in ("surge", "sway") if out.get(axis) == "x"]
    if not planar or "y" not in m.names:
        return out

    def moved(axis: str, column: str) -> float:
        """Return the effect of the numbers of an axis on a column."""
        own = [c for c, name in enumerate(p.names) if name.startswith(f"{axis}.")]
        rows = m.channel == m.names.index(column)
        slopes = solution.linear.shared[np.ix_(rows, own)] * p.scale[own] / solution.std[rows, None]
        return float(np.sum(slopes**2))

    orders = ({"surge": "x", "sway": "y"}, {"surge": "y", "sway": "x"})
    best = max(orders, key=lambda order: sum(moved(axis, order[axis]) for axis in planar))
    return out | {axis: best[axis] for axis in planar}


def _shown_by(
    problem: Shooting, name: str, good: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], NDArray[np.int64], dict[int, float]]:
    """Return the good samples (n,), of (N,), of a channel, their trials (n,), and the range of the channel in
    each trial, from the 5th to the 95th percentile."""
    m = problem.measured
    rows = np.flatnonzero(good & (m.channel == m.names.index(name))) if name else np.empty(0, int)
    trial = problem.groups[m.segment][rows]
    spans = {
        int(g): float(np.ptp(np.percentile(m.value[rows][trial == g], [5.0, 95.0]))) for g in np.unique(trial)
    }
    return rows, trial, spans


def quality(
    problem: Shooting, solution: FitSolution, axes: Sequence[str], used: Sequence[Streams]
) -> dict[str, dict[str, float]]:
    """Return figures of each axis over the trials that excite it: the simulated compared with the measured channel.

    Units are those of the channel; R² and NRMSE are dimensionless.
    """
    out, good, names = {}, valid_samples(problem, solution), channels(problem, solution)
    for axis in axes:
        name = names[axis]
        rows, trial, spans = _shown_by(problem, name, good)
        if not name:
            continue
        moving = [g for g, span in spans.items() if span > 0.2 * max(spans.values())]
        every, of, _ = _shown_by(problem, name, np.ones_like(good))
        every = every[np.isin(of, moving)]
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
            "rejected": float(
                np.sum(np.abs(solution.linear.residual[every]) > 2.0 * CUT * solution.std[every])
            ),
            "trials": float(len(moving)),
            "speed_low": low,
            "speed_high": high,
            "noise": float(np.median(solution.std[rows])),
        }
    return out


AXES_BIAS = ("surge.bias", "sway.bias", "yaw.bias")
"""Biases that a vehicle file cannot represent."""


def held_out(
    stage: Stage, file: Shooting, axes: Sequence[str], by_trial: bool
) -> tuple[dict[str, tuple[float, float]], Array]:
    """Return the NRMSE of each axis over segments on which the estimates are not based, that of the vehicle
    file [-], and the errors of the former, (N,), in the units of the samples.

    Each trial, or segment, is predicted with the estimates after one Gauss-Newton step without it from the
    solution of the fit, from the initial state and the sensor offsets that fit it best.

    Args:
        stage: Finished fit.
        file: The same problem with every number of the vehicle file free.
        axes: Fitted axes.
        by_trial: True to leave out complete trials.
    """
    problem, point = stage.problem, stage.solution.point
    good, names = valid_samples(problem, stage.solution), channels(problem, stage.solution)
    trial = problem.groups[problem.measured.segment]
    group = np.unique(trial if by_trial else time_blocks(problem, trial), return_inverse=True)[1]
    evidence = evidence_of(problem, stage.solution, group)
    total = evidence.information
    scale = np.sqrt(np.maximum(np.diagonal(total), 1e-300))
    fitted = problem.parameters.names
    unwritten = [fitted.index(name) for name in AXES_BIAS if name in fitted]
    low, high = (problem.low - point.theta) * scale - 1e-12, (problem.high - point.theta) * scale + 1e-12

    def without(k: int) -> Array:
        rest = (total - evidence.normal[k]) / np.outer(scale, scale) + 1e-9 * np.eye(len(scale))
        step = boxed(rest, -evidence.score[k] / scale, low, high) / scale
        theta = np.clip(point.theta + step, problem.low, problem.high)
        theta[unwritten] = 0.0
        return theta

    known = dict(zip(problem.names, point.theta, strict=True))
    known |= dict(zip(file.parameters.names, file.parameters.expected, strict=True))
    known |= dict.fromkeys(AXES_BIAS, 0.0) | ({"thrust_scale": 1.0} if problem.parameters.likely else {})
    plain = np.array([known[name] for name in file.names])
    each = np.array([without(k) for k in range(len(evidence.normal))])
    after = _predicted_error(problem, each, stage.solution, good)[np.arange(len(group)), group]
    before = _predicted_error(file, plain[None], stage.solution, good)[:, 0]
    out = {}
    for axis in axes:
        rows, trial, spans = _shown_by(problem, names[axis], good)
        moving = [g for g, span in spans.items() if 0.2 * max(spans.values()) < span]
        rms = [
            [float(np.sqrt(np.mean(error[rows[trial == g]] ** 2))) / max(spans[g], 1e-12) for g in moving]
            for error in (after, before)
        ]
        if moving:
            after_mean, before_mean = np.nan_to_num(np.mean(rms, axis=1), nan=np.inf).tolist()
            out[axis] = after_mean, before_mean
    return out, after


def _predicted_error(
    problem: Shooting, theta: Array, solution: FitSolution, good: NDArray[np.bool_]
) -> Array:
    """Return the errors of vectors (C, P) after the initial state and offsets of each segment are fitted to
    the good samples (N,), (N, C).

    The unit is that of the channel.
    """
    z, linear = solution.point.z, solution.linear
    error = problem.residuals(Point(theta, np.repeat(z[None], len(theta), axis=0)))
    weight = good * solution.std**-2.0
    for s, (a, b) in enumerate(zip(problem.edges, problem.edges[1:], strict=False)):
        own, stiff = linear.own[a:b], problem.prior_std[s] ** -2.0
        normal = (own.T * weight[a:b]) @ own + np.diag(stiff)
        right = (own.T * weight[a:b]) @ error[a:b] - (stiff * z[s])[:, None]
        error[a:b] -= own @ np.linalg.solve(normal, np.nan_to_num(right))
    return error


def unexplained(
    problem: Shooting, solution: FitSolution, axis: str, used: Sequence[Streams]
) -> tuple[str, float]:
    """Return the trial of a free motion that the fit explains least, and its R²; infinite if there is none.

    R² is dimensionless.
    """
    rows, trial, _ = _shown_by(problem, channels(problem, solution)[axis], valid_samples(problem, solution))
    worst, least = "", np.inf
    for g, one in enumerate(used):
        those = rows[trial == g]
        if axis in one.released and len(those):
            residual, value = solution.linear.residual[those], problem.measured.value[those]
            r2 = 1.0 - float(np.mean(residual**2)) / max(float(np.var(value)), 1e-300)
            worst, least = min((worst, least), (one.trial.name, r2), key=lambda pair: pair[1])
    return worst, least


def pictures(stage: Stage, axes: Sequence[str], error: Array | None = None) -> tuple[Curve, ...]:
    """Return the measured and simulated channel of each axis with a 95 % band, over the trials that excite it most.

    Args:
        stage: Finished fit.
        axes: Fitted axes.
        error: Errors of predictions of left-out segments, (N,), in the units of the samples; the fit's
            residuals if None.
    """
    problem, solution, C = stage.problem, stage.solution, stage.found.covariance
    known = np.isfinite(np.diagonal(C.local)) & np.isfinite(np.diagonal(C.trials))
    variance = np.where(np.outer(known, known), np.where(C.alone[:, None] | C.alone, C.local, C.trials), 0.0)
    slopes = shared_slopes(problem, solution)
    band = 1.96 * np.sqrt(solution.std**2 + np.einsum("ni,ij,nj->n", slopes, variance, slopes))
    how = "simulated from the inputs alone" if error is None else "each segment predicted without it"
    error = solution.linear.residual if error is None else error
    m, out, good = problem.measured, [], valid_samples(problem, solution)
    names, clock = channels(problem, solution), m.clock
    for axis in axes:
        name, parts = names[axis], []
        rows, trial, spans = _shown_by(problem, name, good)
        for g in sorted(sorted(spans, key=lambda g: -spans[g])[:SHOWN]):
            those = rows[trial == g]
            those = those[np.argsort(clock[those], kind="stable")]
            value = np.unwrap(m.value[those]) if name in EULER else m.value[those]
            parts.append((clock[those], value, value - error[those], band[those]))
        if name:
            title = f"{axis}: {name}, {how}"
            out.append(Curve.joined(title, f"{name} [{COLUMNS[name].unit}]", parts))
    return tuple(out)


def fit_findings(
    problem: Shooting,
    solution: FitSolution,
    found: Confidence,
    used: Sequence[Streams],
    trials: Mapping[str, int],
) -> list[Finding]:
    """Return findings that are relevant for the use of the numbers.

    Args:
        problem: Problem that was fitted.
        solution: Solution of the fit.
        found: Uncertainty at the solution.
        used: The trials.
        trials: Axis -> number of trials that excite it.
    """
    out = []
    if solution.interrupted:
        out.append(finding("interrupted"))
    elif not (solution.converged or _close(solution, found, problem.judged)):
        out.append(finding("not_converged", iterations=solution.iterations))
    P = len(problem.parameters.names)
    for stream, late, (low, high) in zip(
        problem.streams, solution.point.theta[P:], found.interval[P:], strict=True
    ):
        if abs(late) > LATE and (low > 0.0 or high < 0.0):
            sense = "lags" if late > 0.0 else "leads"
            given = {"sense": sense, "lag": abs(late), "low": low, "high": high}
            if all(one.released for one in used):
                out.append(finding("streams_apart", stream, other=problem.streams[0], **given))
            else:
                out.append(finding("motion_late", stream, **given))
    if found.evidence.unit == "blocks":
        fewest = min(trials.values())
        scarce = tuple(axis for axis, count in trials.items() if count == fewest)
        out.append(finding("block_intervals", axes=scarce, trials=fewest))
    return out


def _close(solution: FitSolution, found: Confidence, judged: int) -> bool:
    """Return whether one more step would keep every parameter within its 95 % interval.

    Trials differ by more than independent noise, so that a step far above the error due to such noise may
    still be far below the actual uncertainty.
    """
    low, high = intervals(solution.point.theta, found.covariance).T
    return bool(np.all(np.abs(solution.step[:judged]) <= 0.5 * (high - low)[:judged]))
