"""The regression of one axis: m nu_dot + d1 nu + d2 |nu| nu + b (+ k sin eta) = tau over all its trials.

Two further terms, `delay` and `smoothing`, take up what the recording did to the motion: see
`finssim.identification.regression.axis_fit`.

The derivative of a noisy velocity is not taken. Both sides of the equation are weighted with a smooth bump phi that
vanishes at its ends, and integration by parts moves the derivative onto it (the weak form; the same low-pass filter on
both sides):

    ∫ phi tau = -m ∫ phi_dot nu + d1 ∫ phi nu + d2 ∫ phi |nu| nu + b ∫ phi (+ k ∫ phi sin eta)
                + c1 ∫ phi tau_dot - c2 ∫ phi tau_dot_dot

The last two allow for a motion that was recorded late by c1 [s] and smoothed by a filter of variance 2 c2 [s²]: to
second order, that filter may act on tau instead. Equations hold about the reference point of the hydrodynamic
coefficients; what the vehicle file knows (Coriolis terms, couplings off the diagonal, gravity and buoyancy but for the
parts that are fitted) is moved to the left side.

Measured velocities on the right side of a regression carry noise, which biases least squares towards zero. Velocities
simulated from the recorded input alone are close to the true ones and know nothing of that noise: as instruments they
remove the bias (Young 1981; Janot, Vandanjon and Gautier 2014, IDIM-IV).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from finssim.identification.regression.plant_terms import Matrices, known_wrench
from finssim.identification.uncertainty import (
    Covariance,
    Evidence,
    correlated_samples,
    intervals,
    trial_covariance,
)
from finssim.survey.least_squares import boxed, huber_weight
from finssim.trials.findings import CalibrationError
from finssim.trials.motion import Motion, spans_of, without_spikes

Array = NDArray[np.float64]

SLOW = 25.0
"""Rate up to which what looks like a spike may be a turn [Hz]."""

LONGEST_REPAIR = 3
"""Outliers in a row that are bridged by a straight line; longer runs break the record."""


@dataclass(frozen=True)
class Kernel:
    """Bump phi, its derivative, and a shorter bump that smooths nu before |nu| nu is formed."""

    phi: Array
    """Sums to 1, (L,)."""
    phi_dot: Array
    """Reads a derivative: Σ phi_dot_k x_k is the mean of x_dot under phi, (L,) [1/s]."""
    phi_dot_dot: Array
    """Reads a second derivative in the same way, (L,) [1/s²]."""
    short: Array
    """Sums to 1, (S,)."""
    stride: int
    """Rows are taken at every so many samples; neighbours share most of their noise."""


def _bump(half_width: float, rate: float) -> tuple[Array, Array, Array]:
    """(1 - s²)³ on (-1, 1) and what reads the first and second derivative, exact for parabolas."""
    n = max(1, round(half_width * rate))
    s = np.arange(-n, n + 1) / (n + 1)
    t = np.arange(-n, n + 1) / rate
    phi = (1.0 - s**2) ** 3
    phi /= phi.sum()
    slope = s * (1.0 - s**2) ** 2
    curve = (1.0 - s**2) * (5.0 * s**2 - 1.0)
    curve = curve - curve.sum() * phi
    return phi, slope / (slope @ t), 2.0 * curve / (curve @ t**2)


def kernel(rate: float, *, half_width: float = 0.25, short: float = 0.06) -> Kernel:
    """The kernels for a sampling rate; at low rates at least two samples to each side.

    Args:
        rate: [Hz]
        half_width: Of phi [s].
        short: Half width of the smoothing before |nu| nu [s].
    """
    phi, phi_dot, phi_dot_dot = _bump(max(half_width, 2.0 / rate), rate)
    brief = _bump(short, rate)[0] if short * rate >= 0.75 else np.ones(1)
    return Kernel(phi, phi_dot, phi_dot_dot, brief, max(1, len(phi) // 6))


@dataclass(frozen=True, kw_only=True)
class Signals:
    """One trial about the reference point of the coefficients, body frame, on a uniform grid."""

    name: str
    rate: float
    t: Array
    nu: Array
    """(n, 6), NaN where unknown; relative to the water where the current is known."""
    tau: Array
    """Applied, (n, 6)."""
    left: Array
    """`tau` without what the vehicle file explains: what the diagonal model of each axis has to balance, (n, 6)."""
    up: Array
    """World z in the body frame, (n, 3); NaN where the attitude is unknown."""
    usable: NDArray[np.bool_]
    """Synchronised, without gap, under water, (n,)."""
    wanted: NDArray[np.bool_]
    """Within the phases that are fitted, (n,)."""
    unknown: tuple[int, ...]
    """Axes whose velocity is unknown; their couplings are taken as zero."""


@dataclass(frozen=True, kw_only=True)
class Rows:
    """Rows of one axis of one trial."""

    name: str
    X: Array
    """Columns nu_dot, nu, |nu| nu, 1, tau_dot, -tau_dot_dot, sin eta (zero but on roll and pitch), (n, 7)."""
    y: Array
    """(n,)"""
    at: NDArray[np.int64]
    """Sample of the trial at the middle of each row, (n,)."""
    spans: tuple[tuple[int, int], ...]
    """Stretches of consecutive good samples, [begin, end)."""
    samples: int
    """Samples that entered."""
    rejected: int
    """Samples left out as outliers."""


def signals(
    name: str, motion: Motion, up: Array, matrices: Matrices, *, current: Array | None = None
) -> Signals:
    """What the axes' equations need of a trial.

    Args:
        name: Of the trial.
        motion: The trial on a uniform grid, about the body origin.
        up: World z in the body frame, not smoothed, (n, 3).
        matrices: The vehicle, about the reference point of its coefficients.
        current: Velocity of the water that `motion.nu` does not know of, world frame [m/s], (3,).
    """
    from finssim.core.rotations import quat_inverse_rotate

    n = len(motion.t)
    given = np.array([source == "measured" for source in motion.nu_source])
    nu = np.where(
        given, motion.raw, motion.nu
    )  # the weak form smooths both sides alike; a smoother would only one
    known = np.asarray(np.isfinite(nu).any(axis=0))
    q_known = np.asarray(np.isfinite(motion.quaternion).all(axis=1))
    q = np.where(q_known[:, None], motion.quaternion, [0.0, 0.0, 0.0, 1.0])
    if current is not None and q_known.any():
        nu[:, :3] -= np.where(
            q_known[:, None], quat_inverse_rotate(q, np.broadcast_to(current, (n, 3))), np.nan
        )
    # A shift to another point mixes axes; what is unknown takes no part.
    filled = np.where(known, nu, 0.0)
    shifted = filled @ matrices.H.T
    nu = np.where(known, shifted, np.nan)
    tau = motion.tau @ np.linalg.inv(matrices.H)  # wrench moves with the inverse transpose
    state = (
        np.where(np.isfinite(nu), nu, 0.0),
        np.where(np.isfinite(up), up, [0, 0, 1.0]),
        np.nan_to_num(-motion.position[:, 2]),
    )
    left = tau - known_wrench(*state, motion.rate, matrices)
    phase = motion.phase
    named = bool(np.isin(phase, ["excitation", "coast"]).any())
    return Signals(
        name=name,
        rate=motion.rate,
        t=motion.t,
        nu=nu,
        tau=tau,
        left=left,
        up=up,
        usable=motion.valid & matrices.submerged(motion.position, up),
        wanted=np.isin(phase, ["excitation", "coast"]) if named else np.ones(n, bool),
        unknown=tuple(int(i) for i in np.flatnonzero(~known)),
    )


def axis_rows(found: Signals, axis: int, kernels: Kernel) -> Rows | None:
    """Rows of one axis; None where there are no usable samples.

    Args:
        found: The trial.
        axis: 0 surge to 5 yaw.
        kernels: For its rate.
    """
    nu, left = found.nu[:, axis].copy(), found.left[:, axis]
    good = found.usable & np.isfinite(nu) & np.isfinite(left)
    sine = _sine(found.up, axis)
    if sine is not None:
        good &= np.isfinite(sine)
    outlying = np.zeros(len(nu), bool)
    for begin, end in spans_of(good) if found.rate > SLOW else ():
        outlying[begin:end] = ~without_spikes(found.t[begin:end], nu[begin:end, None])
    nu, good = _bridge(nu, good, outlying)
    spans = [(b, e) for b, e in spans_of(good) if e - b >= len(kernels.phi) + 2]
    if not spans:
        return None
    X, y, at = [], [], []
    offset = _offset(found, axis)
    for begin, end in spans:
        cut = slice(begin, end)
        centre, rhs = _filtered(left[cut, None], kernels)
        _, constant = _filtered(offset[cut, None], kernels)
        _, first = _filtered(left[cut, None], kernels, kernels.phi_dot)
        _, second = _filtered(left[cut, None], kernels, kernels.phi_dot_dot)
        moving = _columns(nu[cut], None if sine is None else sine[cut], kernels)
        X.append(np.concatenate([moving[:, :3], constant, first, -second, moving[:, 3:]], axis=1))
        y.append(rhs[:, 0])
        at.append(begin + centre)
    return Rows(
        name=found.name,
        X=np.concatenate(X),
        y=np.concatenate(y),
        at=np.concatenate(at),
        spans=tuple(spans),
        samples=sum(e - b for b, e in spans),
        rejected=int(outlying.sum()),
    )


def simulated_columns(nu: Array, sine: Array | None, rows: Rows, kernels: Kernel) -> Array:
    """The columns of `axis_rows` from simulated signals of the whole trial, filtered in the same way.

    Args:
        nu: Simulated velocity of the axis, body frame [m/s or rad/s], (n,).
        sine: Of the simulated angle, (n,); None without stiffness.
        rows: Of the same trial and axis, as measured.
        kernels: For the trial's rate.
    """
    moving = np.concatenate(
        [_columns(nu[b:e], None if sine is None else sine[b:e], kernels) for b, e in rows.spans]
    )
    return np.concatenate([moving[:, :3], rows.X[:, 3:6], moving[:, 3:]], axis=1)


def _columns(nu: Array, sine: Array | None, kernels: Kernel) -> Array:
    """[nu_dot, nu, |nu| nu, sine] under phi, (rows, 4)."""
    if len(kernels.short) > 1:
        weight = np.convolve(np.ones(len(nu)), kernels.short, "same")
        smooth = np.convolve(nu, kernels.short, "same") / weight
    else:
        smooth = nu
    signals = [nu, np.abs(smooth) * smooth, np.zeros(len(nu)) if sine is None else sine]
    _, out = _filtered(np.stack(signals, axis=1), kernels)
    _, first = _filtered(nu[:, None], kernels, kernels.phi_dot)
    return np.concatenate([first, out], axis=1)


def _filtered(x: Array, kernels: Kernel, weights: Array | None = None) -> tuple[NDArray[np.int64], Array]:
    """Sums under phi or other weights at every `stride`-th place where they fit: middle samples (r,), values (r, c)."""
    phi = kernels.phi if weights is None else weights
    windows = np.lib.stride_tricks.sliding_window_view(x, len(phi), axis=0)[:: kernels.stride]
    return np.arange(len(windows)) * kernels.stride + len(phi) // 2, windows @ phi


def _sine(up: Array, axis: int) -> Array | None:
    """The component of `up` that restores: sin(roll) cos(pitch), sin(pitch); None on the other axes."""
    return {3: up[:, 1], 4: -up[:, 0]}.get(axis)


def _bridge(
    x: Array, good: NDArray[np.bool_], outlying: NDArray[np.bool_]
) -> tuple[Array, NDArray[np.bool_]]:
    """Short runs of outliers replaced by straight lines; longer ones are no longer good."""
    if not outlying.any():
        return x, good
    good = good.copy()
    keep = np.flatnonzero(good & ~outlying)
    for begin, end in spans_of(outlying):
        inside = begin > 0 and end < len(x) and good[begin - 1] and good[end]
        if end - begin > LONGEST_REPAIR or not inside:
            good[begin:end] = False
    if len(keep):
        x = np.where(outlying, np.interp(np.arange(len(x)), keep, x[keep]), x)
    return x, good


RATE = 25.0
"""Steps per second that are enough for time constants of 0.3 s and swings of 1 s [Hz]; slower logs keep their own."""

BLOCK = 20.0
"""Longest run from one measured state [s]."""

LEAD = 2.0
"""Before each further block, for the noise of the state that it starts from to fade [s]."""


@dataclass(frozen=True)
class Run:
    """From one measured state."""

    push: Array
    """Mean of tau over every step, (n,)."""
    step: float
    """[s]"""
    nu: float
    s: float
    """At the begin."""


@dataclass(frozen=True)
class Piece:
    """Where a run goes in its trial, and the measured state that it starts from."""

    start: int
    first: int
    last: int
    """The run begins at `start`; samples from `first` to before `last` are taken from it."""
    every: int
    """Samples in a step."""
    rate: float
    """Of the samples [Hz]"""
    nu: float
    s: float

    def run(self, wrench: Array) -> Run:
        """The run under the trial's force or moment on the axis.

        Args:
            wrench: Without bias and known terms, body axes [N or N m], (n,).
        """
        q = self.every
        steps = -(-(self.last - 1 - self.start) // q)
        inside = wrench[self.start : self.start + steps * q + 1]
        inside = np.pad(inside, (0, steps * q + 1 - len(inside)), mode="edge")
        push = inside[:-1].reshape(steps, q).mean(axis=1) + np.diff(inside[::q]) / (2 * q)  # trapezoids
        return Run(push, q / self.rate, self.nu, self.s)


def cut(rate: float, spans: Sequence[tuple[int, int]], nu: Array, sine: Array | None) -> list[Piece]:
    """Pieces of one trial: each starts from the measured state and is no longer than `BLOCK`, after a `LEAD`.

    Args:
        rate: [Hz]
        spans: Stretches of consecutive good samples, [begin, end).
        nu: Measured velocity of the axis, body frame [m/s or rad/s], (n,); the state is the median of a tenth of a
            second.
        sine: Of the angle, (n,); None without stiffness.
    """
    q = max(1, int(rate / RATE + 1e-9))
    few, lead = max(1, round(0.1 * rate)), round(LEAD * rate)
    pieces = []
    for begin, end in spans:
        count = max(1, int(np.ceil((end - begin) / (BLOCK * rate))))
        edges = (begin + (end - begin) * np.arange(count + 1) // count).tolist()
        for first, last in zip(edges[:-1], edges[1:], strict=True):
            start = max(begin, first - lead)
            v = float(np.median(nu[start : start + few]))
            s = 0.0 if sine is None else float(np.median(sine[start : start + few]))
            pieces.append(Piece(start, first, last, q, rate, v, s))
    return pieces


def joined(lines: Sequence[Array], pieces: Sequence[Piece], n: int) -> Array:
    """A signal of the runs of a trial on its n samples, zero where there is none, (n,)."""
    out = np.zeros(n)
    for line, piece in zip(lines, pieces, strict=True):
        at = np.arange(piece.first, piece.last)
        knots = piece.start + piece.every * np.arange(len(line))
        out[piece.first : piece.last] = np.interp(at, knots, line)
    return out


def simulate_axis(theta: Array, runs: Sequence[Run]) -> tuple[list[Array], list[Array]]:
    """Velocities and angles of several runs at once.

    m nu_dot = tau - d1 nu - d2 |nu| nu - k s,  s_dot = nu          (paper, eq. 6 and its form for roll and pitch)

    The step is implicit in the damping and central in s: of second order, stable for any stiffness.

    Args:
        theta: m, d1, d2, k of all runs (4,), or of each (4, G); m > 0.
        runs: Inputs and initial states.

    Returns:
        nu and s of every run, the sine of the angle, (n_g + 1,) each; not finite from where a run leaves all bounds.
    """
    m, d1, d2, k = (np.broadcast_to(x, len(runs)) for x in np.asarray(theta, float))
    n = max((len(run.push) for run in runs), default=0)
    step = np.array([run.step for run in runs])
    push = np.zeros((n, len(runs)))
    for g, run in enumerate(runs):
        push[: len(run.push), g] = run.push * (run.step / m[g])
    nu, s = np.empty((n + 1, len(runs))), np.zeros((n + 1, len(runs)))
    nu[0], s[0] = [run.nu for run in runs], [run.s for run in runs]
    linear, quadratic, spring, half = d1 * step / (2.0 * m), d2 * step / (2.0 * m), k * step / m, 0.5 * step
    v, x = nu[0], s[0]
    previous, drag, swings = v, bool(d2.any()), bool(k.any())
    with np.errstate(over="ignore", invalid="ignore"):
        for i in range(n):
            force = push[i]
            a = linear
            if drag:
                a = a + quadratic * np.abs(1.5 * v - 0.5 * previous)  # speed at mid-step, extrapolated
            if swings:
                force = force - spring * (x + half * v)
            previous, v = v, (v * (1.0 - a) + force) / (1.0 + a)
            nu[i + 1] = v
            x = x + half * (previous + v)
            s[i + 1] = x
    ends = [len(run.push) + 1 for run in runs]
    return [nu[:end, g] for g, end in enumerate(ends)], [s[:end, g] for g, end in enumerate(ends)]


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


TERMS = ("m_eff", "d1", "d2", "bias", "delay", "smoothing", "k")
"""Names of the first columns; see the module for `delay` [s] and `smoothing` [s²]."""

HUBER, REJECT = 1.345, 8.0
"""Standard deviations from which a row loses weight (95 % efficient on Gaussian noise), and has none."""

GAUSSIAN_MAD = 1.4826
"""Standard deviation of a Gaussian in units of its median absolute deviation."""

ROUNDS, FREE_ROUNDS = 25, 6
"""Of instruments and weights, at most; after the latter the variance of trial offsets stays, so that they settle."""

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

    @property
    def terms(self) -> NDArray[np.bool_]:
        """Which of `TERMS` the rows can tell: a stiffness where there is one, (7,)."""
        return np.array([name != "k" or self.restoring for name in TERMS])

    @property
    def restoring(self) -> bool:
        """Roll and pitch have a stiffness."""
        return self.axis in (3, 4)

    def prior_moments(self) -> tuple[Array, Array]:
        """Means and inverse variances of all terms, (7,) each; zero where nothing was known."""
        mean, inverse = np.zeros((2, len(TERMS)))
        for name, (value, std) in self.prior.items():
            mean[TERMS.index(name)], inverse[TERMS.index(name)] = value, std**-2
        mean[TERMS.index("delay")] -= self.shift
        return mean, inverse


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


def fit_axis(data: AxisData, terms: NDArray[np.bool_]) -> AxisFit:
    """Instrumental-variable regression with Huber weights and bounds.

    Ordinary least squares starts; then velocities simulated with the latest estimate serve as instruments.

    Args:
        data: The axis.
        terms: Which of `TERMS` to fit, (7,); of `data.terms`.
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
    pieces = [
        cut(s.rate, rows.spans, s.nu[:, data.axis], _sine(s.up, data.axis))
        for s, rows in zip(data.signals, data.rows, strict=True)
    ]
    for round_ in range(ROUNDS + 1):
        sums = moments(X[inside], Z[inside], y[inside], weight, group).of(kept)
        previous = theta
        theta = np.zeros(p)
        theta[kept] = solve(sums, ratio, before)[0]
        residual = y[inside] - X[inside] @ theta
        centred = residual - _group_means(residual, weight, group)
        weight = robust_weights(centred)
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
    lower = np.array([0.0, 0.0, 0.0, -np.inf, -np.inf, -np.inf, 0.0])[kept]
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
        sums = moments(X[inside], Z[inside], y[inside], weight, blocks).of(kept)
        _, N_g, scores, _ = solve(sums, 0.0, before)
        unit = "blocks"
    names = tuple(name for name, on in zip(TERMS, kept, strict=True) if on)
    found = Evidence(
        names=names, normal=N_g / variance, score=scores / variance, unit=unit, prior=np.diag(inverse)
    )
    ends = np.cumsum([len(rows.y) for rows in data.rows])[:-1]
    return AxisFit(
        terms=kept,
        theta=theta + known,
        free=free + known,
        active=active,
        evidence=found,
        covariance=trial_covariance(found),
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


def robust_weights(residual: Array) -> Array:
    """Huber's weights, (n,), by the median absolute deviation; 0 for outliers, beyond `REJECT` standard deviations.

    Args:
        residual: Residuals [N, N m], body frame, (n,).
    """
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


def _offset(found: Signals, axis: int) -> Array:
    """What the bias multiplies: 1, and in heave the vertical component of `up`."""
    if axis != 2:
        return np.ones(len(found.t))
    return np.where(np.isfinite(found.up[:, 2]), found.up[:, 2], 1.0)


Damping = Literal["auto", "linear", "quadratic", "both"]
DAMPING: tuple[Damping, ...] = ("auto", "linear", "quadratic", "both")

SIGNIFICANT = 0.03
"""A second damping term that is a small share of the drag stays where it is significant at this level: one that is
superfluous should be rare, for it is carried to speeds that no trial had."""
SMALL = 0.1
"""Share of the drag at the greatest speed below which a term is small. Precise data leave a superfluous term 1 % or
less; a larger one of scattered data may well be there."""
AKAIKE = 0.157
"""The level of larger terms, and of a smoothing of the inputs (Akaike's criterion: χ² of one degree above 2)."""

TELLING = 6.0
"""Twice a logarithm of likelihoods below which linear drag is not preferred to quadratic: odds of 20 to 1."""


@dataclass(frozen=True, kw_only=True)
class Selection:
    """The model of one axis and the fuller one it was chosen from."""

    fit: AxisFit
    full: AxisFit
    """With both dampings."""
    dropped: tuple[str, ...]
    """Dampings that were left out because the data do not show them."""
    p_value: dict[str, float]
    """For each damping: probability of an estimate as large as that of the fuller model if it were zero."""
    interval: Array
    """95 % intervals of all terms, (7, 2): of a dropped term from the fuller model; of a kept one the hull of both
    models' when another was dropped, for nobody can be sure that it is zero. NaN for terms that were not asked for."""


def select(data: AxisData, damping: str = "auto") -> Selection:
    """Fit an axis with the dampings that the data support.

    `auto` starts from both and leaves out a term that is negative or not significant, by the standard error from the
    disagreement of the trials, at the level `SIGNIFICANT` if it is `SMALL`, else at `AKAIKE`; of two such terms the one
    with less evidence. One always stays,
    and where the data hardly tell linear from quadratic it is the quadratic one: a bluff body's drag is, and a linear
    one would be far off at higher speeds. The intervals hold both answers.

    Raises:
        CalibrationError: An unknown `damping`.
    """
    if damping not in DAMPING:
        raise CalibrationError(f"unknown damping '{damping}'; available: {', '.join(DAMPING)}")
    left_out = {"linear": "d2", "quadratic": "d1"}.get(damping)
    smoothed = fit_axis(data, _without(data.terms, left_out) if left_out else data.terms)
    full = _without_needless_smoothing(data, smoothed)
    p_value = {} if left_out else {name: _p_value(full, TERMS.index(name)) for name in ("d1", "d2")}
    share = _shares(data, full)
    weak = [name for name, p in p_value.items() if p > (SIGNIFICANT if share[name] < SMALL else AKAIKE)]
    if damping == "both" or not weak:
        interval = _with_lag(data, _interval(full), smoothed)
        return Selection(fit=full, full=full, dropped=(), p_value=p_value, interval=interval)
    dropped = max(weak, key=lambda name: p_value[name])
    fit = fit_axis(data, _without(full.terms, dropped))
    tried = [full, fit]
    if dropped == "d2":
        other = fit_axis(data, _without(full.terms, "d1"))
        if _evidence(data, fit, other) < TELLING:
            dropped, fit = "d1", other
            tried.append(other)
    ends = np.stack([_interval(one) for one in tried])
    with np.errstate(all="ignore"):
        hull = np.stack([np.fmin.reduce(ends[..., 0]), np.fmax.reduce(ends[..., 1])], axis=-1)
    interval = _with_lag(data, hull, smoothed)
    return Selection(fit=fit, full=full, dropped=(dropped,), p_value=p_value, interval=interval)


def _shares(data: AxisData, fit: AxisFit) -> dict[str, float]:
    """What each damping is of the drag at the greatest speed [-], by name."""
    X = np.concatenate([rows.X for rows in data.rows])
    top = {
        n: float(np.max(np.abs(X[:, TERMS.index(n)]))) * max(fit.free[TERMS.index(n)], 0.0)
        for n in ("d1", "d2")
    }
    return {name: force / max(sum(top.values()), 1e-300) for name, force in top.items()}


def _without(terms: NDArray[np.bool_], name: str) -> NDArray[np.bool_]:
    out = terms.copy()
    out[TERMS.index(name)] = False
    return out


def _evidence(data: AxisData, one: AxisFit, other: AxisFit) -> float:
    """Twice the logarithm of the likelihood of one fit over another's with as many terms."""
    if not (one.theta[0] > 0.0 and other.theta[0] > 0.0) or other.active[TERMS.index("d2")]:
        return np.inf
    rss = [
        sum(
            float(np.sum((rows.y - line)[used] ** 2))
            for rows, line, used in zip(data.rows, fit.fitted, fit.used, strict=True)
        )
        for fit in (one, other)
    ]
    return one.independent * float(np.log(max(rss[1], 1e-300) / max(rss[0], 1e-300)))


def _without_needless_smoothing(data: AxisData, fit: AxisFit) -> AxisFit:
    """Once more without `smoothing` where the recording shows none: it costs certainty of the inertia."""
    shown = _p_value(fit, TERMS.index("smoothing")) <= AKAIKE
    return fit if shown else fit_axis(data, _without(fit.terms, "smoothing"))


def _with_lag(data: AxisData, interval: Array, smoothed: AxisFit) -> Array:
    """Where the motion is late, nobody knows whether by a delay or by a lag of first order, which `smoothing` takes up.

    The inertia's interval then holds both answers.
    """
    inertia = TERMS.index("m_eff")
    if not data.shift or smoothed.active[inertia]:
        return interval
    out, other = interval.copy(), _interval(smoothed)[inertia]
    out[inertia] = np.fmin(out[inertia, 0], other[0]), np.fmax(out[inertia, 1], other[1])
    return out


def _p_value(fit: AxisFit, term: int) -> float:
    """Two-sided for a positive estimate, 1 for one that cannot be."""
    from scipy.stats import norm, t

    place = int(fit.terms[:term].sum())
    std, dof = float(fit.covariance.std[place]), float(fit.covariance.dof[place])
    if fit.free[term] <= 0.0 or not np.isfinite(std):
        return 1.0
    size = fit.free[term] / max(std, 1e-300)
    return float(2.0 * (t.sf(size, dof) if np.isfinite(dof) else norm.sf(size)))


def _interval(fit: AxisFit) -> Array:
    """About the free estimates, and where a bound moved them about the held ones too."""
    out = np.full((len(fit.terms), 2), np.nan)
    free, held = (intervals(x[fit.terms], fit.covariance) for x in (fit.free, fit.theta))
    out[fit.terms, 0] = np.minimum(free[:, 0], held[:, 0])
    out[fit.terms, 1] = np.maximum(free[:, 1], held[:, 1])
    return out
