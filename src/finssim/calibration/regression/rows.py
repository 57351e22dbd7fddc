"""From one trial's motion to the rows of the regression of paper, eq. 6.

The derivative of a noisy velocity is not taken. Both sides of the equation are weighted with a smooth bump phi that
vanishes at its ends, and integration by parts moves the derivative onto it (the weak form; the same low-pass filter on
both sides):

    ∫ phi tau = -m ∫ phi_dot nu + d1 ∫ phi nu + d2 ∫ phi |nu| nu + b ∫ phi (+ k ∫ phi sin eta)
                + c1 ∫ phi tau_dot - c2 ∫ phi tau_dot_dot (- Σ θ_j ∫ phi tau_j)

The last two allow for a motion that was recorded late by c1 [s] and smoothed by a filter of variance 2 c2 [s²]: to
second order, that filter may act on tau instead. tau_j are the wrenches of the vehicle's further terms for units of the
parameters θ_j that are fitted. Equations hold about the reference point of the hydrodynamic
coefficients; what the vehicle file knows (Coriolis terms, couplings off the diagonal, gravity and buoyancy but for the
parts that are fitted) is moved to the left side.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.motion.signals import Motion
from finssim.calibration.motion.smoothing import without_spikes
from finssim.calibration.regression.plant_terms import Matrices, known_wrench, unit_wrenches

__all__ = ["Kernel", "Rows", "Signals", "axis_rows", "kernel", "signals", "simulated_columns"]

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
    unit: Array
    """Wrench of the vehicle's terms for a unit of each parameter that is fitted, (n, 6, k)."""


@dataclass(frozen=True, kw_only=True)
class Rows:
    """Rows of one axis of one trial."""

    name: str
    X: Array
    """Columns nu_dot, nu, |nu| nu, 1, tau_dot, -tau_dot_dot, sin eta (zero but on roll and pitch), and -tau_j of the
    parameters of terms, (n, 7 + k)."""
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
    from finssim.geometry.rotations import quat_inverse_rotate

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
        unit=unit_wrenches(*state, matrices),
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
    for begin, end in _spans(good) if found.rate > SLOW else ():
        outlying[begin:end] = ~without_spikes(found.t[begin:end], nu[begin:end, None])
    nu, good = _bridge(nu, good, outlying)
    spans = [(b, e) for b, e in _spans(good) if e - b >= len(kernels.phi) + 2]
    if not spans:
        return None
    X, y, at = [], [], []
    offset = np.where(np.isfinite(found.up[:, 2]), found.up[:, 2], 1.0) if axis == 2 else np.ones(len(nu))
    for begin, end in spans:
        cut = slice(begin, end)
        centre, rhs = _filtered(left[cut, None], kernels)
        _, constant = _filtered(offset[cut, None], kernels)
        _, first = _filtered(left[cut, None], kernels, kernels.phi_dot)
        _, second = _filtered(left[cut, None], kernels, kernels.phi_dot_dot)
        _, terms = _filtered(found.unit[cut, axis], kernels)
        moving = _columns(nu[cut], None if sine is None else sine[cut], kernels)
        X.append(np.concatenate([moving[:, :3], constant, first, -second, moving[:, 3:], -terms], axis=1))
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
    return np.concatenate([moving[:, :3], rows.X[:, 3:6], moving[:, 3:], rows.X[:, 7:]], axis=1)


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


def _spans(good: NDArray[np.bool_]) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], good, [False]]).astype(np.int8)))
    return [(int(b), int(e)) for b, e in edges.reshape(-1, 2)]


def _bridge(
    x: Array, good: NDArray[np.bool_], outlying: NDArray[np.bool_]
) -> tuple[Array, NDArray[np.bool_]]:
    """Short runs of outliers replaced by straight lines; longer ones are no longer good."""
    if not outlying.any():
        return x, good
    good = good.copy()
    keep = np.flatnonzero(good & ~outlying)
    for begin, end in _spans(outlying):
        inside = begin > 0 and end < len(x) and good[begin - 1] and good[end]
        if end - begin > LONGEST_REPAIR or not inside:
            good[begin:end] = False
    if len(keep):
        x = np.where(outlying, np.interp(np.arange(len(x)), keep, x[keep]), x)
    return x, good
