"""The regression of one axis: m nu_dot + d1 nu + d2 |nu| nu + b (+ k sin eta) = tau over all its trials.

Two further terms, `delay` and `smoothing`, take up what the recording did to the motion: see
`finssim.calibration.regression.rows`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.regression.instruments import Piece, Run, cut, joined, simulate_axis
from finssim.calibration.regression.moments import evidence, moments, offset_ratio, solve
from finssim.calibration.regression.robust import bounded, huber_weights
from finssim.calibration.regression.rows import Kernel, Rows, Signals, simulated_columns
from finssim.calibration.uncertainty import Covariance, Evidence, correlated_samples, trial_covariance

__all__ = ["TERMS", "AxisData", "AxisFit", "fit_axis", "informative"]

Array = NDArray[np.float64]

TERMS = ("m_eff", "d1", "d2", "bias", "delay", "smoothing", "k")
"""Names of the columns; see the module for `delay` [s] and `smoothing` [s²]."""

FREE_ROUNDS = 6
"""After so many the variance of trial offsets stays, so that the rounds settle."""

FEWEST_TRIALS = 4
"""With fewer, trials are cut into blocks to estimate the spread."""

SMALL_WRENCH, SMALL_MOTION = 0.05, 0.005
"""Rows below both tell nothing [N, N m], [m/s, rad/s and their rates] (published procedure)."""


@dataclass(frozen=True, kw_only=True)
class AxisData:
    """Everything the regression of one axis reads."""

    axis: int
    signals: tuple[Signals, ...]
    rows: tuple[Rows, ...]
    kernels: tuple[Kernel, ...]
    tilted: float = 0.0
    """Share of the samples that were left out for their tilt."""
    shift: float = 0.0
    """Time by which the wrench was put later, beyond which `delay` is counted [s]."""
    inertia: float | None = None
    """Effective inertia where it is known [kg, kg m²]; fitted if None."""

    @property
    def restoring(self) -> bool:
        """Roll and pitch have a stiffness."""
        return self.axis in (3, 4)


@dataclass(frozen=True, kw_only=True)
class AxisFit:
    """Result for one choice of terms."""

    terms: NDArray[np.bool_]
    """Which of `TERMS` are fitted, (7,)."""
    theta: Array
    """Zero where not fitted, but for a known inertia, (7,)."""
    free: Array
    """The same without bounds, (7,)."""
    active: NDArray[np.bool_]
    """Terms that a bound holds, (7,)."""
    evidence: Evidence
    """Of the fitted terms."""
    covariance: Covariance
    offset_ratio: float
    """Variance of trial offsets over that of a row; 0 where trials share one bias."""
    independent: float
    """Rows' worth of independent samples."""
    fitted: tuple[Array, ...]
    """Left side as the model gives it, by trial, (n_g,)."""
    used: tuple[NDArray[np.bool_], ...]
    """Rows that entered, by trial."""
    simulated: tuple[Array, ...]
    """Velocity of the model under the recorded input, by trial; empty where it could not be simulated."""
    instrumental: bool
    """Whether instruments were used; without, noise of the velocity biases the estimates."""


def fit_axis(data: AxisData, terms: NDArray[np.bool_], *, iterations: int = 25) -> AxisFit:
    """Instrumental-variable regression with Huber weights and bounds.

    Ordinary least squares starts; then velocities simulated with the latest estimate serve as instruments.

    Args:
        data: The axis.
        terms: Which of `TERMS` to fit, (7,); `k` only on roll and pitch.
        iterations: Rounds of instruments and weights.
    """
    p = 7 if data.restoring else 6
    kept = terms[:p]
    X = np.concatenate([rows.X for rows in data.rows])
    known = np.zeros(p)
    if data.inertia is not None:
        kept = kept & (np.arange(p) != 0)
        known[0] = data.inertia
    y = np.concatenate([rows.y for rows in data.rows]) - X @ known
    used = [informative(rows, signals) for rows, signals in zip(data.rows, data.signals, strict=True)]
    trial = np.repeat(np.arange(len(data.rows)), [len(rows.y) for rows in data.rows])
    inside = np.concatenate(used)
    group = trial[inside]
    weight, Z, instrumental = np.ones(inside.sum()), X, False
    simulated: list[Array] = []
    ratio, theta = 0.0, np.zeros(p)
    pieces = [_cut(data, found, rows) for found, rows in zip(data.signals, data.rows, strict=True)]
    for round_ in range(iterations + 1):
        sums = moments(X[inside], Z[inside], y[inside], weight, group).of(kept)
        previous = theta
        theta = np.zeros(p)
        theta[kept] = solve(sums, ratio)[0]
        residual = y[inside] - X[inside] @ theta
        centred = residual - _group_means(residual, weight, group)
        weight = huber_weights(centred)
        correlated = correlated_samples(
            centred * np.sqrt(weight), (np.flatnonzero(np.diff(group)) + 1).tolist()
        )
        if round_ < FREE_ROUNDS:
            ratio = offset_ratio(sums, correlated) / correlated
        runs = _simulate(data, theta + known, pieces)
        if runs is None:
            break
        Z, simulated, instrumental = runs[0], runs[1], True
        if np.all(np.abs(theta - previous) <= 1e-3 * np.abs(theta) + 1e-9):
            break
    if instrumental:
        sums = moments(X[inside], Z[inside], y[inside], weight, group).of(kept)
    free = np.zeros(p)
    free[kept], N_g, scores, rss = solve(sums, ratio)
    lower = np.where(np.isin(np.arange(p), (3, 4, 5)), -np.inf, 0.0)[kept]
    held, active_kept = bounded(N_g.sum(axis=0) + 1e-12 * np.eye(kept.sum()), free[kept], lower)
    theta, active = np.zeros(p), np.zeros(p, bool)
    theta[kept], active[kept] = held, active_kept
    variance = float(rss.sum()) / max(float(sums.weight.sum()) - kept.sum(), 1.0) * correlated
    unit = "trials"
    if len(data.rows) < FEWEST_TRIALS:
        blocks = _blocks(group, correlated)
        cut = moments(X[inside], Z[inside], y[inside], weight, blocks).of(kept)
        _, N_g, scores, _ = solve(cut)
        unit = "blocks"
    names = tuple(name for name, on in zip(TERMS[:p], kept, strict=True) if on)
    found = evidence(names, N_g, scores, variance, unit)
    ends = np.cumsum([len(rows.y) for rows in data.rows])[:-1]
    return AxisFit(
        terms=np.pad(kept, (0, 7 - p)),
        theta=np.pad(theta + known, (0, 7 - p)),
        free=np.pad(free + known, (0, 7 - p)),
        active=np.pad(active, (0, 7 - p)),
        evidence=found,
        covariance=trial_covariance(found),
        offset_ratio=ratio,
        independent=float(inside.sum()) / correlated,
        fitted=tuple(np.split(X @ (theta + known), ends)),
        used=tuple(used),
        simulated=tuple(simulated),
        instrumental=instrumental,
    )


def informative(rows: Rows, signals: Signals) -> NDArray[np.bool_]:
    """Rows in the wanted phases that show a wrench or a motion."""
    still = (np.abs(rows.X[:, :2]) < SMALL_MOTION).all(axis=1)
    return signals.wanted[rows.at] & ~(still & (np.abs(rows.y) < SMALL_WRENCH))


def _group_means(x: Array, weight: Array, group: NDArray[np.int64]) -> Array:
    """Weighted mean of each row's group, (n,)."""
    size = int(group.max(initial=0)) + 1
    total = np.bincount(group, weight, size)
    return np.asarray((np.bincount(group, weight * x, size) / np.maximum(total, 1e-300))[group])


def _blocks(group: NDArray[np.int64], correlated: float) -> NDArray[np.int64]:
    """Consecutive rows of one trial in blocks of some four correlation lengths, at least 6 and at most 24 a trial."""
    out, count = np.empty_like(group), 0
    for g in np.unique(group):
        n = int((group == g).sum())
        pieces = int(np.clip(n / (4.0 * correlated), 6, 24))
        out[group == g] = count + np.minimum(np.arange(n) * pieces // max(n, 1), pieces - 1)
        count += pieces
    return out


def _simulate(data: AxisData, theta: Array, pieces: list[list[Piece]]) -> tuple[Array, list[Array]] | None:
    """Instruments for all rows and simulated velocities by trial; None where the estimate cannot be simulated."""
    m, d1, d2, b, delay = (float(x) for x in theta[:5])
    k = max(float(theta[6]), 0.0) if data.restoring else 0.0
    if not m > 0.0 or not np.isfinite(theta).all():
        return None
    runs, places = list[Run](), []
    for found, own in zip(data.signals, pieces, strict=True):
        left = np.where(np.isfinite(found.left[:, data.axis]), found.left[:, data.axis], 0.0)
        wrench = np.interp(found.t - delay, found.t, left) - b * _offset(found, data.axis)
        places.append((slice(len(runs), len(runs) + len(own)), own, len(found.t)))
        runs += [piece.run(wrench) for piece in own]
    lines = simulate_axis(np.array([m, max(d1, 0.0), max(d2, 0.0), k]), runs)
    nu, s = ([joined(line[those], own, n) for those, own, n in places] for line in lines)
    if not all(np.isfinite(v).all() for v in (*nu, *s)):
        return None
    Z = [
        simulated_columns(v, x if data.restoring else None, rows, kernels)
        for v, x, rows, kernels in zip(nu, s, data.rows, data.kernels, strict=True)
    ]
    return np.concatenate(Z), nu


def _cut(data: AxisData, found: Signals, rows: Rows) -> list[Piece]:
    sine = (found.up[:, 1] if data.axis == 3 else -found.up[:, 0]) if data.restoring else None
    return cut(found.rate, rows.spans, found.nu[:, data.axis], sine)


def _offset(found: Signals, axis: int) -> Array:
    """What the bias multiplies: 1, and in heave the vertical component of `up`."""
    if axis != 2:
        return np.ones(len(found.t))
    return np.where(np.isfinite(found.up[:, 2]), found.up[:, 2], 1.0)
