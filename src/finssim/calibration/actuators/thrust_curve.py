"""The steady thrust curve T = c± ω|ω| of a thruster, with intervals that allow for systematic residuals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.actuators.thrust_table import STANDING

__all__ = ["DeadZone", "Side", "dead_zone", "fit_side", "jackknife", "t_quantile"]

Array = NDArray[np.float64]

BLOCKS = 10
"""Parts of equal weight that a table is cut into for intervals."""
OUTLIER = 6.0
"""Scaled median deviations beyond which a row is left out, if it is also off by `COARSE` of the largest force."""
COARSE = 0.05


@dataclass(frozen=True, kw_only=True)
class Side:
    """c of one direction of rotation."""

    c: float
    """T = c ω², [N s²/rad²]."""
    half_width: float
    """Of the 95 % interval; infinite from a single row."""
    r2: float
    """Share of the variance of the forces of this direction that the curve explains."""
    rmse: float
    """[N]"""
    samples: int
    rejected: int
    per_table: tuple[float, ...]
    """c of every table alone."""


def fit_side(tables: Sequence[tuple[Array, Array]]) -> Side | None:
    """Least squares of |T| = c ω² (paper, eq. 16) over one direction of rotation.

    The residuals of real tables are not noise but the curve's own misfit, alike in neighbouring rows. The interval is
    the widest of three: a jackknife over blocks of neighbouring speeds (heteroscedastic residuals), first-order
    autocorrelated residuals (long-lived ones), and, of several tables, what the tables' own c's vary by.

    Args:
        tables: Speed |ω| [rad/s] and thrust along this direction [N] of the turning rows, (n,) each, per table.

    Returns:
        None where there is no row.
    """
    tables = [(w, f) for w, f in tables if len(w)]
    if not tables:
        return None
    square, force = np.concatenate([w**2 for w, _ in tables]), np.concatenate([f for _, f in tables])
    keep = np.ones(len(square), bool)
    for _ in range(5):
        c = _slope(square[keep], force[keep])
        error = np.abs(force - c * square)
        limit = max(OUTLIER * 1.4826 * float(np.median(error)), COARSE * float(np.max(np.abs(force))))
        if np.array_equal(keep, error <= limit):
            break
        keep = error <= limit
    owner = np.concatenate([np.full(len(w), i) for i, (w, _) in enumerate(tables)])
    rows = [keep & (owner == i) for i in range(len(tables))]
    blocks = [_blocks(square[row], force[row]) for row in rows]
    per_table = tuple(_slope(*_joined(parts)) for parts in blocks if parts)
    parts = [part for of_table in blocks for part in of_table]
    leave_out = (
        [_slope(*_joined(parts[:i] + parts[i + 1 :])) for i in range(len(parts))] if len(parts) > 1 else []
    )
    half_width = jackknife(np.array(leave_out)[:, None])[0] if leave_out else np.inf
    half_width = max(half_width, _autocorrelated([(square[row], force[row]) for row in rows], c))
    if len(per_table) > 1:
        spread = float(np.std(per_table, ddof=1)) / np.sqrt(len(per_table))
        half_width = max(half_width, t_quantile(len(per_table) - 1) * spread)
    error = force[keep] - c * square[keep]
    total = float(np.sum((force[keep] - np.mean(force[keep])) ** 2))
    return Side(
        c=c,
        half_width=float(half_width),
        r2=1.0 - float(error @ error) / total if total > 0.0 else float("nan"),
        rmse=float(np.sqrt(np.mean(error**2))),
        samples=int(np.count_nonzero(keep)),
        rejected=int(np.count_nonzero(~keep)),
        per_table=per_table,
    )


def jackknife(leave_one_out: Array) -> Array:
    """Half-widths of 95 % intervals from estimates that each leave one of G blocks out, (G, P) -> (P,)."""
    G = len(leave_one_out)
    deviation = leave_one_out - np.mean(leave_one_out, axis=0)
    return t_quantile(G - 1) * np.sqrt((G - 1) / G * np.sum(deviation**2, axis=0))


def t_quantile(dof: int) -> float:
    """97.5 % point of Student's t."""
    from scipy.stats import t  # SciPy is slow to import

    return float(t.ppf(0.975, dof))


def _slope(square: Array, force: Array) -> float:
    return float(square @ force / (square @ square))


def _blocks(square: Array, force: Array) -> list[tuple[Array, Array]]:
    """Neighbouring speeds in at most `BLOCKS` parts of about equal Σ ω⁴; of a short table every row."""
    if square.size == 0:
        return []
    order = np.argsort(square)
    square, force = square[order], force[order]
    if len(square) < 2 * BLOCKS:
        return [(square[i : i + 1], force[i : i + 1]) for i in range(len(square))]
    share = (np.cumsum(square**2) - 0.5 * square**2) / np.sum(square**2)
    label = np.minimum(share * BLOCKS, BLOCKS - 1).astype(int)
    return [(square[label == i], force[label == i]) for i in np.unique(label)]


def _autocorrelated(tables: Sequence[tuple[Array, Array]], c: float) -> float:
    """Half-width of the interval of c if residuals in order of speed are a first-order autoregression."""
    from scipy.signal import lfilter  # SciPy is slow to import

    variance, information, independent = 0.0, 0.0, 0.0
    for square, force in tables:
        order = np.argsort(square)
        x, error = square[order], force[order] - c * square[order]
        n, power = len(x), float(error @ error)
        if n < 3 or power == 0.0:
            continue
        phi = float(error[1:] @ error[:-1]) / power
        phi = float(
            np.clip(phi + (1.0 + 3.0 * phi) / n, 0.0, 0.95)
        )  # least squares finds it too small (Kendall 1954)
        spread = 2.0 * float(x @ lfilter([1.0], [1.0, -phi], x)) - float(x @ x)  # Σ_ij x_i x_j φ^|i-j|
        spent = spread / float(x @ x)  # degrees of freedom that fitting c takes out of the residuals
        variance += power / max(n - spent, 0.5 * n) * spread
        information += float(x @ x)
        independent += n * (1.0 - phi**2) / (1.0 + phi**2)
    if information == 0.0:
        return 0.0
    return t_quantile(max(int(independent) - 1, 1)) * float(np.sqrt(variance)) / information


def _joined(parts: Sequence[tuple[Array, Array]]) -> tuple[Array, Array]:
    return np.concatenate([s for s, _ in parts]), np.concatenate([f for _, f in parts])


@dataclass(frozen=True, kw_only=True)
class DeadZone:
    """The slowest speed of one direction that turns the shaft [rad/s, >= 0]."""

    speed: float
    interval: tuple[float, float]
    known: bool
    """Whether the table shows a gap; otherwise `speed` is 0 and the interval ends at the slowest speed seen."""
    note: str = ""


def dead_zone(speed: Array) -> DeadZone | None:
    """The gap between standstill and the slowest turning shaft.

    It shows only where the table goes down to standstill and the gap is more than three times the distance between the
    speeds above it; otherwise the speeds in between were not tried.

    Args:
        speed: Along one direction [rad/s]; standing rows near 0, (n,).

    Returns:
        None where nothing turns.
    """
    fastest = float(np.max(speed, initial=0.0))
    turning = np.sort(speed[speed > STANDING * fastest])
    if fastest <= 0.0 or turning.size < 2:
        return None
    slowest = float(turning[0])
    standing = speed[np.abs(speed) <= STANDING * fastest]
    if standing.size == 0:
        note = "the table holds no standstill: its slowest speed is an upper limit"
        return DeadZone(speed=0.0, interval=(0.0, slowest), known=False, note=note)
    gap, spacing = slowest - float(np.max(standing)), float(np.median(np.diff(turning[:8])))
    if gap <= 3.0 * spacing:
        note = "speeds between standstill and the slowest were not tried"
        return DeadZone(speed=0.0, interval=(0.0, slowest), known=False, note=note)
    return DeadZone(speed=slowest, interval=(max(slowest - 2.0 * spacing, 0.0), slowest), known=True)
