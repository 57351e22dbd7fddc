"""The regression of one axis: m nu_dot + d1 nu + d2 |nu| nu + b (+ k sin eta) = tau over all its trials.

Two further terms, `delay` and `smoothing`, take up what the recording did to the motion: see
`finssim.calibration.regression.rows`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.regression.instruments import Piece, Run, cut, joined, simulate_axis
from finssim.calibration.regression.rows import Kernel, Rows, Signals, simulated_columns
from finssim.calibration.uncertainty import Covariance, Evidence, correlated_samples, trial_covariance
from finssim.calibration.vision.least_squares import boxed, huber_weight

__all__ = ["TERMS", "AxisData", "AxisFit", "fit_axis", "informative"]

# Sums over the rows of each trial, and the instrumental-variable estimate that follows from them.


@dataclass(frozen=True, kw_only=True)
class Moments:
    """Of the stacked columns [X Z y] by group."""

    product: Array
    """Σ w [X Z y]ᵀ [X Z y], (G, 2p + 1, 2p + 1)."""
    mean: Array
    """Σ w [X Z y] / Σ w, (G, 2p + 1)."""
    weight: Array
    """Σ w, (G,)."""

    @property
    def columns(self) -> int:
        """p"""
        return (self.product.shape[-1] - 1) // 2

    def without_offsets(self, ratio: float) -> Array:
        """`product` of rows from which trial offsets of variance `ratio` (to that of a row) are taken out in part.

        The generalised least squares of a random offset for each trial: S_g - c_g w_g m_g m_gᵀ with
        c_g = ratio w_g / (1 + ratio w_g).
        """
        share = ratio * self.weight / (1.0 + ratio * self.weight)
        return np.asarray(
            self.product
            - (share * self.weight)[:, None, None] * self.mean[:, :, None] * self.mean[:, None, :]
        )

    def of(self, kept: NDArray[np.bool_]) -> Moments:
        """With some of the p columns only."""
        index = np.flatnonzero(np.concatenate([kept, kept, [True]]))
        return Moments(
            product=self.product[:, index[:, None], index], mean=self.mean[:, index], weight=self.weight
        )


def moments(X: Array, Z: Array, y: Array, weight: Array, group: NDArray[np.int64]) -> Moments:
    """Sums by group.

    Args:
        X: Regressors, (n, p).
        Z: Instruments, (n, p).
        y: Left side, (n,).
        weight: Of the rows, (n,).
        group: Ascending group of each row, (n,).
    """
    Q = np.concatenate([X, Z, y[:, None]], axis=1)
    begins = np.flatnonzero(np.diff(group, prepend=-1))
    parts = list(zip(np.split(Q, begins[1:]), np.split(weight, begins[1:]), strict=True))
    total = np.array([w.sum() for _, w in parts])
    product = np.array([(q * w[:, None]).T @ q for q, w in parts])
    mean = np.array([w @ q for q, w in parts]) / np.maximum(total, 1e-300)[:, None]
    return Moments(product=product, mean=mean, weight=total)


def solve(
    found: Moments, ratio: float = 0.0, prior: tuple[Array, Array] | None = None
) -> tuple[Array, Array, Array, Array]:
    """Two-stage least squares, theta = (Zᵀ X)⁻¹ Zᵀ y, and what each group says about it.

    Args:
        found: Sums.
        ratio: Variance of the trial offsets over that of a row.
        prior: What was known before: means, and inverse variances times the variance of a row, (p,) each.

    Returns:
        theta (p,); N_g = Z_p,gᵀ Z_p,g of the regressors projected on the instruments (G, p, p); scores
        Z_p,gᵀ (y - X theta) (G, p); Σ w (y - X theta)² by group (G,). Unknown directions get the least-norm answer.
    """
    p = found.columns
    S = found.without_offsets(ratio)
    x, z, y = slice(0, p), slice(p, 2 * p), 2 * p
    total = S.sum(axis=0)
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(total[z, z]), 1e-300))
    zz = total[z, z] * np.outer(scale, scale)
    project = scale[:, None] * np.linalg.lstsq(zz, scale[:, None] * total[z, x], rcond=1e-11)[0]
    N_g = project.T @ S[:, z, z] @ project
    N, right = N_g.sum(axis=0), project.T @ total[z, y]
    if prior is not None:
        N, right = N + np.diag(prior[1]), right + prior[1] * prior[0]
    unit = 1.0 / np.sqrt(np.maximum(np.diagonal(N), 1e-300))
    theta = unit * np.linalg.lstsq(N * np.outer(unit, unit), unit * right, rcond=1e-11)[0]
    r = np.concatenate([-theta, np.zeros(p), [1.0]])
    scores = (S[:, z, :] @ r) @ project
    return theta, N_g, scores, np.einsum("i,gij,j->g", r, S, r)


def offset_ratio(found: Moments, correlated: float) -> float:
    """Variance of trial offsets over that of an independent row, by maximum likelihood; 0 where they do not show.

    Args:
        found: Sums over trials, with weights that count rows.
        correlated: Rows that one independent row stands for.
    """
    weights = found.weight / correlated
    n = weights.sum()
    if len(weights) < 3:
        return 0.0
    independent = Moments(product=found.product / correlated, mean=found.mean, weight=weights)
    best, ratio = np.inf, 0.0
    for candidate in np.concatenate([[0.0], np.logspace(-3, 2, 26)]):
        rss = float(solve(independent, candidate)[3].sum())
        cost = (
            n * np.log(max(rss, 1e-300) / n) + np.log1p(candidate * weights).sum() + 2.0 * (candidate > 0.0)
        )
        if cost < best:
            best, ratio = cost, float(candidate)
    return ratio


def evidence(
    names: tuple[str, ...], N_g: Array, scores: Array, variance: float, unit: str, prior: Array
) -> Evidence:
    """For `trial_covariance`, in units of the variance of an independent row."""
    return Evidence(names=names, normal=N_g / variance, score=scores / variance, unit=unit, prior=prior)


Array = NDArray[np.float64]

TERMS = ("m_eff", "d1", "d2", "bias", "delay", "smoothing", "k")
"""Names of the first columns; see the module for `delay` [s] and `smoothing` [s²]."""

HUBER, REJECT = 1.345, 8.0
"""Standard deviations from which a row loses weight (95 % efficient on Gaussian noise), and has none."""

GAUSSIAN_MAD = 1.4826
"""Standard deviation of a Gaussian in units of its median absolute deviation."""

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

    prior: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """What was known of some of `TERMS` before any trial: mean and standard deviation."""
    estimated: tuple[str, ...] = ()
    """Paths of the parameters of the vehicle's terms that are fitted too."""
    lowest: tuple[float, ...] = ()
    """Their bounds."""

    @property
    def terms(self) -> NDArray[np.bool_]:
        """Which of `TERMS` and of `estimated` the rows can tell: a stiffness where there is one, terms that act."""
        largest = np.max(
            [np.abs(rows.X[:, len(TERMS) :]).max(axis=0, initial=0.0) for rows in self.rows], axis=0
        )
        return np.append([name != "k" or self.restoring for name in TERMS], largest > 0.0)

    @property
    def restoring(self) -> bool:
        """Roll and pitch have a stiffness."""
        return self.axis in (3, 4)

    def prior_moments(self) -> tuple[Array, Array]:
        """Means and inverse variances of all terms, (7 + k,) each; zero where nothing was known."""
        mean, inverse = np.zeros((2, len(TERMS) + len(self.estimated)))
        for name, (value, std) in self.prior.items():
            mean[TERMS.index(name)], inverse[TERMS.index(name)] = value, std**-2
        mean[TERMS.index("delay")] -= self.shift
        return mean, inverse


@dataclass(frozen=True, kw_only=True)
class AxisFit:
    """Result for one choice of terms."""

    terms: NDArray[np.bool_]
    """Which of `TERMS`, and then of `AxisData.estimated`, are fitted, (7 + k,)."""
    theta: Array
    """Zero where not fitted, but for a known inertia, (7 + k,)."""
    free: Array
    """The same without bounds, (7 + k,)."""
    active: NDArray[np.bool_]
    """Terms that a bound holds, (7 + k,)."""
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
        terms: Which of `TERMS` and `data.estimated` to fit, (7 + k,); of `data.terms`.
        iterations: Rounds of instruments and weights.
    """
    p, kept = len(terms), terms
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
    mean, inverse = (column[kept] for column in data.prior_moments())
    before = (mean, np.zeros_like(inverse))
    pieces = [_cut(data, found, rows) for found, rows in zip(data.signals, data.rows, strict=True)]
    for round_ in range(iterations + 1):
        sums = moments(X[inside], Z[inside], y[inside], weight, group).of(kept)
        previous = theta
        theta = np.zeros(p)
        theta[kept] = solve(sums, ratio, before)[0]
        residual = y[inside] - X[inside] @ theta
        centred = residual - _group_means(residual, weight, group)
        weight = _weights(centred)
        correlated = correlated_samples(
            centred * np.sqrt(weight), (np.flatnonzero(np.diff(group)) + 1).tolist()
        )
        if round_ < FREE_ROUNDS:
            ratio = offset_ratio(sums, correlated) / correlated
            variance = float(weight @ centred**2) / max(float(weight.sum()) - kept.sum(), 1.0) * correlated
            before = (mean, variance * inverse)
        if not round_:
            theta[kept] = solve(sums, ratio, before)[0]
        runs = _simulate(data, theta + known, pieces)
        if runs is None:
            break
        Z, simulated, instrumental = runs[0], runs[1], True
        if np.all(np.abs(theta - previous) <= 1e-3 * np.abs(theta) + 1e-9):
            break
    if instrumental:
        sums = moments(X[inside], Z[inside], y[inside], weight, group).of(kept)
    free = np.zeros(p)
    free[kept], N_g, scores, rss = solve(sums, ratio, before)
    lower = np.array([0.0, 0.0, 0.0, -np.inf, -np.inf, -np.inf, 0.0, *data.lowest])[kept]
    normal = N_g.sum(axis=0) + np.diag(before[1]) + 1e-12 * np.eye(kept.sum())
    theta, active = np.zeros(p), np.zeros(p, bool)
    theta[kept] = free[kept]
    if (free[kept] < lower).any():
        theta[kept] = boxed(normal, normal @ free[kept], lower, np.full(len(lower), np.inf))
        active[kept] = theta[kept] <= lower
    variance = float(rss.sum()) / max(float(sums.weight.sum()) - kept.sum(), 1.0) * correlated
    unit = "trials"
    if len(data.rows) < FEWEST_TRIALS:
        blocks = _blocks(group, correlated)
        cut = moments(X[inside], Z[inside], y[inside], weight, blocks).of(kept)
        _, N_g, scores, _ = solve(cut, 0.0, before)
        unit = "blocks"
    names = tuple(name for name, on in zip((*TERMS, *data.estimated), kept, strict=True) if on)
    found = evidence(names, N_g, scores, variance, unit, np.diag(inverse))
    ends = np.cumsum([len(rows.y) for rows in data.rows])[:-1]
    return AxisFit(
        terms=kept,
        theta=theta + known,
        free=free + known,
        active=active,
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


def _weights(residual: Array) -> Array:
    """Huber's, by the median absolute deviation; 0 beyond `REJECT` standard deviations, (n,)."""
    size = np.abs(residual - np.median(residual))
    scale = GAUSSIAN_MAD * float(np.median(size))
    if scale <= 0.0 or len(residual) < 8:
        return np.ones_like(residual)
    return np.where(size > REJECT * scale, 0.0, huber_weight(size, HUBER * scale))


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
        wrench = wrench + found.unit[:, data.axis] @ theta[len(TERMS) :]
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
