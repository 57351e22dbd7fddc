"""Zero-phase smoothing of unevenly sampled signals, its strength chosen from the data.

A penalised cubic B-spline (Eilers and Marx 1996), with up to a knot per sample, fitted to every stretch without a gap:

    min Σ (y_i - f(t_i))² + λ Σ (Δᵐ c)²

λ is the one under which the data are most likely (restricted maximum likelihood; Wahba 1985), with the spectrum of the
smoother on a uniform grid, where sines diagonalise it. It is found for windows of some seconds and goes from one to the
next, so that a push is followed closely and the calm after it is not. Of the noise only whiteness is assumed.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dst
from scipy.linalg import solveh_banded

Array = NDArray[np.float64]

FEWEST = 5
"""Samples that a stretch needs; shorter ones are left out."""

CANDIDATES = 48
"""Values of λ that are tried."""

WINDOW = 200
"""Samples of a window, half shared with the next, at least; shorter stretches have one λ."""

WINDOW_TIME = 4.0
"""Length of a window, at least [s]."""

SHARE = 0.3
"""Weight, for a sample of a window, of the mean likelihood over all windows: what a window leaves open they decide."""

STIFFEST = 1e9
"""Largest λ where it varies: beside closely followed parts the equations would lose digits far above it."""

KNOT_PHASE = 0.2
"""Most that the frequency of half loss turns from one knot to the next [rad]."""

MIN_INTERVALS = 4

SPIKE = 8.0
"""Robust standard deviations beyond which a sample is a spike."""


class Smooth(NamedTuple):
    """Signals on a grid; NaN where no stretch of samples reaches."""

    value: Array
    """(m, c)"""
    slope: Array
    """Its time derivative, (m, c)."""
    noise: Array
    """Standard deviation of one sample, (c,)."""
    slope_std: Array
    """Standard deviation of `slope`, of what noise remains and what signal was lost (Wahba 1983), (c,)."""


def longest_step(t: Array) -> float:
    """Longest time between samples that is still bridged [s]: 0.2 s, or four usual steps."""
    return max(0.2, 4.0 * float(np.median(np.diff(t)))) if len(t) > 1 else 0.2


def stretches(t: Array, max_gap: float) -> list[slice]:
    """Runs of samples with no step longer than `max_gap`."""
    edges = [0, *(np.flatnonzero(np.diff(t) > max_gap) + 1), len(t)]
    return [slice(a, b) for a, b in zip(edges, edges[1:], strict=False) if b > a]


def spans_of(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Runs of samples that are true, [begin, end) each."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [(int(b), int(e)) for b, e in edges.reshape(-1, 2)]


def white_noise(values: Array) -> float:
    """Standard deviation of white noise on a signal that is smooth from sample to sample, from its second differences.

    Args:
        values: Evenly sampled, finite, (n,).

    Returns:
        NaN for fewer than ten samples.
    """
    if len(values) < 10:
        return math.nan
    return float(np.median(np.abs(np.diff(values, 2)))) / (0.6745 * math.sqrt(6.0))


def without_spikes(t: Array, y: Array) -> NDArray[np.bool_]:
    """Which samples are not spikes: far from the median of their five nearest, by the spread of all such distances.

    Args:
        t: Times [s], (n,).
        y: Values, (n, c).

    Returns:
        (n,); at most a twentieth is refused, for what happens more often is no spike.
    """
    n = len(t)
    if n < 9:
        return np.ones(n, bool)
    padded = np.concatenate([y[2:0:-1], y, y[-2:-4:-1]])
    median = np.median(np.lib.stride_tricks.sliding_window_view(padded, 5, axis=0), axis=-1)
    distance = np.abs(y - median)
    usual_step = np.median(np.abs(np.diff(y, axis=0)), axis=0)
    spread = np.maximum(1.4826 * np.median(distance, axis=0), 0.5 * usual_step)
    floor = 0.02 * (np.percentile(y, 95.0, axis=0) - np.percentile(y, 5.0, axis=0)) + 1e-12
    bad = np.any(distance > SPIKE * np.maximum(spread, floor), axis=1)
    return ~bad if bad.sum() <= 0.05 * n else np.ones(n, bool)


def smooth(t: Array, y: Array, at: Array, *, order: int = 2, together: bool = False) -> Smooth:
    """Smooth signals that share their sample times.

    Args:
        t: Times of the samples, increasing [s], (n,).
        y: Finite values, (n, c).
        at: Times asked for [s], (m,).
        order: m, the difference that is penalised: 2 for signals whose slope may jump, as velocities under a step of
            force; 3 for their integrals.
        together: One λ for all columns, for parts of one quantity such as a quaternion.

    Returns:
        On `at`.
    """
    good = without_spikes(t, y)
    gap = longest_step(t)
    t, y = t[good], y[good]
    m, c = len(at), y.shape[1]
    value, slope = np.full((m, c), np.nan), np.full((m, c), np.nan)
    runs = [run for run in stretches(t, gap) if run.stop - run.start >= FEWEST]
    if not runs:
        return Smooth(value, slope, *(np.full(c, np.nan) for _ in range(2)))
    shared = [slice(0, c)] if together else [slice(i, i + 1) for i in range(c)]
    figures = np.empty((2, c))
    for columns in shared:
        windows = [window for run in runs for window in _windows(t, run)]
        strength, figures[:, columns] = _choose([_spectrum(t[w], y[w, columns], order) for w in windows])
        middle = np.array([0.5 * (t[w][0] + t[w][-1]) for w in windows])
        for run in runs:
            inside = (at >= t[run][0] - 1e-6) & (at <= t[run][-1] + 1e-6)
            if inside.any():
                own = (middle >= t[run][0]) & (middle <= t[run][-1])
                f = _fit(t[run], y[run, columns], middle[own], strength[own], order, at[inside])
                value[inside, columns], slope[inside, columns] = f
    return Smooth(value, slope, *figures)


def _windows(t: Array, run: slice) -> list[slice]:
    """Windows of equal length that overlap by half."""
    n = run.stop - run.start
    whole = int(min(n / WINDOW, (t[run][-1] - t[run][0]) / WINDOW_TIME))
    count = max(1, 2 * whole - 1)
    width = 2 * n // (count + 1)
    starts = np.linspace(run.start, run.stop - width, count)
    return [slice(int(a), int(a) + width) for a in starts]


def _spectrum(t: Array, y: Array, order: int) -> tuple[Array, Array, Array]:
    """Penalty eigenvalue (k,), angular frequency (k,) [rad/s] and power by column (k, c) of the sines of a window."""
    n = len(t)
    grid = np.linspace(t[0], t[-1], n)
    even = np.stack([np.interp(grid, t, column) for column in y.T], axis=-1)
    part = (np.arange(n) / (n - 1))[:, None]
    even = even - (1.0 - part) * _first(even) - part * _first(even[::-1])
    theta = np.pi * np.arange(1, n - 1) / (n - 1)
    symbol = (2.0 + np.cos(theta)) / 3.0  # a cubic B-spline sampled at its knots
    penalty = (2.0 * np.sin(theta / 2.0)) ** (2 * order) / symbol**2
    omega = theta * (n - 1) / (t[-1] - t[0])
    return penalty, omega, dst(even[1:-1], type=1, norm="ortho", axis=0) ** 2


def _first(y: Array) -> Array:
    """The first value without its noise, (n, c) -> (c,): of the longest line that the first samples follow.

    A line through two noisy ends would be a signal of its own.
    """
    noise = np.median(np.abs(np.diff(y, 2, axis=0)), axis=0) / (0.6745 * np.sqrt(6.0))
    value, following = y[0].copy(), np.ones(y.shape[1], bool)
    k = 4
    while k <= len(y) // 8 and following.any():
        x = np.arange(k) - 0.5 * (k - 1)
        mean, slope = y[:k].sum(axis=0) / k, 12.0 * (x @ y[:k]) / (k * (k * k - 1.0))
        rest = y[:k] - mean - x[:, None] * slope
        fits = following & (np.sqrt(np.sum(rest**2, axis=0) / (k - 2)) <= (1.1 + np.sqrt(2.0 / k)) * noise)
        value = np.where(fits, mean + x[0] * slope, value)
        following = fits if k >= 16 else following  # four samples may misfit by chance
        k *= 4
    return value


def _choose(spectra: list[tuple[Array, Array, Array]]) -> tuple[Array, Array]:
    """λ of every window (w,), and noise and slope_std by column (2, c)."""
    smallest, largest = min(p.min() for p, _, _ in spectra), max(p.max() for p, _, _ in spectra)
    candidates = np.geomspace(1e-4 / largest, 1e1 / smallest, CANDIDATES)
    unlikely, sizes = np.empty((len(spectra), CANDIDATES)), np.array([len(p) for p, _, _ in spectra])
    for w, (penalty, _, power) in enumerate(spectra):
        lost = candidates[:, None] * penalty / (1.0 + candidates[:, None] * penalty)  # eigenvalues of 1 - H
        unlikely[w] = sizes[w] * np.log(lost @ power.sum(axis=1) + 1e-300) - np.log(lost).sum(axis=1)
    mean = unlikely.sum(axis=0) / sizes.sum()
    best = candidates[np.argmin(unlikely + SHARE * sizes[:, None] * mean, axis=1)]
    figures = []
    for strength, (penalty, omega, power) in zip(best, spectra, strict=True):
        lost = strength * penalty / (1.0 + strength * penalty)
        noise = np.sqrt((lost**2 @ power) / lost.sum())
        figures.append([noise, noise * np.sqrt(np.mean((1.0 - lost) * omega**2))])
    squares = np.square(figures)  # (w, 2, c)
    errors = np.sqrt(np.average(squares, axis=0, weights=sizes))
    errors[0] = np.sqrt(np.median(squares[:, 0], axis=0))
    return best, errors


def _fit(t: Array, y: Array, middle: Array, strength: Array, order: int, at: Array) -> tuple[Array, Array]:
    """Value and slope at given times inside [t[0], t[-1]] of the penalised spline, (m, c) each; λ at `middle` (w,)."""
    # What is smoothed strongly needs few knots; many would only make the equations ill-conditioned.
    usual = len(t) - 1
    intervals = max(MIN_INTERVALS, math.ceil(usual * min(1.0, strength.min() ** (-0.5 / order) / KNOT_PHASE)))
    h = (t[-1] - t[0]) / intervals
    trend = (y[-1] - y[0]) / (t[-1] - t[0])  # taken off, for what is small has small rounding
    line, y = y[0] + (at - t[0])[:, None] * trend, y - y[0] - (t - t[0])[:, None] * trend
    count = intervals + 3
    if len(strength) > 1:
        place = t[0] + h * (np.arange(count - order) + 0.5 * order - 1.0)
        strength = np.exp(np.interp(place, middle, np.log(np.minimum(strength, STIFFEST))))
    strength = strength * (intervals / usual) ** (2 * order - 1)
    cell, weights, _ = _basis((t - t[0]) / h, intervals)
    band = np.zeros((4, count))
    for a in range(4):
        for b in range(a, 4):
            band[b - a] += np.bincount(cell + a, weights[a] * weights[b], count)
    difference = np.array([1.0])
    for _ in range(order):
        difference = np.convolve(difference, [1.0, -1.0])
    for a in range(order + 1):
        for b in range(a, order + 1):
            band[b - a, a : a + count - order] += strength * difference[a] * difference[b]
    right = np.stack(
        [sum(np.bincount(cell + a, weights[a] * column, count) for a in range(4)) for column in y.T], axis=-1
    )
    coefficients = solveh_banded(band, right, lower=True, check_finite=False)
    cell, weights, slopes = _basis((at - t[0]) / h, intervals)
    parts = coefficients[cell[:, None] + np.arange(4)]
    return line + np.einsum("am,mac->mc", weights, parts), trend + np.einsum("am,mac->mc", slopes, parts) / h


def _basis(x: Array, intervals: int) -> tuple[NDArray[np.intp], Array, Array]:
    """Cell, and values and slopes of the four uniform cubic B-splines that are not zero there, (4, m) each."""
    cell = np.clip(np.floor(x).astype(np.intp), 0, intervals - 1)
    s = x - cell
    r = 1.0 - s
    values = [r**3, 3.0 * s**3 - 6.0 * s**2 + 4.0, 3.0 * r**3 - 6.0 * r**2 + 4.0, s**3]
    slopes = [-(r**2), 3.0 * s**2 - 4.0 * s, -3.0 * r**2 + 4.0 * r, s**2]
    return cell, np.stack(values) / 6.0, np.stack(slopes) / 2.0
