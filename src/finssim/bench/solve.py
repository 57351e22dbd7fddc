"""Least squares with 95 % intervals from the scatter of groups of rows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finssim.identification.uncertainty import Evidence, correlated_samples, intervals, trial_covariance

Array = NDArray[np.float64]


class Solution(NamedTuple):
    """Estimates of a least-squares problem."""

    x: Array
    """Estimates in the units of the parameters, (P,)."""
    half: Array
    """Half-widths of their 95 % intervals, in the units of the parameters, (P,); infinite for parameters that
    the rows do not determine."""


def solve(
    residual: Callable[[Array], Array],
    start: Sequence[float] | Array,
    groupings: Sequence[NDArray[np.integer[Any]]],
    *,
    breaks: Sequence[int] = (),
    rows_too: bool = False,
    refit: bool = False,
    **options: Any,
) -> Solution:
    """Minimise a sum of squares, and estimate intervals that are valid for correlated rows.

    The interval of a parameter is the widest of those from the scatter of each grouping's groups
    (`finssim.identification.uncertainty`).

    Args:
        residual: Residuals of all rows as a function of the parameters, (P,) -> (N,).
        start: Initial guess in the units of the parameters, (P,).
        groupings: Group of every row, (N,) each, such as blocks of neighbours, tables or trials.
        breaks: Rows at which a new series begins.
        rows_too: True if an interval is at least that from the scatter of the rows, with their effective number.
        refit: True to estimate the scatter of the groups from fits without each of them (jackknife) instead of its
            linearisation, as for a law with bounds.
        options: Further options of `scipy.optimize.least_squares`: bounds, x_scale, diff_step.
    """
    from scipy.optimize import least_squares
    from scipy.stats import t

    found = least_squares(residual, start, **options)
    r, J, x = found.fun, found.jac, found.x
    if refit:
        left = [
            least_squares(lambda p, rows=labels != label: residual(p)[rows], x, **options).x
            for labels in groupings
            for label in np.unique(labels)
        ]
        G, deviation = len(left), np.array(left) - np.mean(left, axis=0)
        spread = np.sqrt((G - 1) / G * np.sum(deviation**2, axis=0))
        return Solution(x, float(t.ppf(0.975, G - 1)) * spread)
    dof = len(r) - len(x)
    if dof < 1:
        return Solution(x, np.full(len(x), np.inf))
    alike = correlated_samples(r, breaks)
    rounding = 1e-26 * float(np.mean((J @ x) ** 2))  # an exact fit has no residual
    variance = float(r @ r) / dof * alike + rounding + 1e-300
    halves = []
    for labels in groupings:
        rows = [labels == label for label in np.unique(labels)]
        covariance = trial_covariance(
            Evidence(
                names=tuple(map(str, range(len(x)))),
                normal=np.array([J[row].T @ J[row] for row in rows]) / variance,
                score=np.array([J[row].T @ r[row] for row in rows]) / variance,
            )
        )
        halves.append(intervals(np.zeros(len(x)), covariance)[:, 1])
        if rows_too:
            quantile = float(t.ppf(0.975, max(int(len(r) / alike) - len(x), 1)))
            halves.append(quantile * np.sqrt(np.diagonal(covariance.local)))
    return Solution(x, np.max(halves, axis=0))


def blocks(order: Array, count: int, weight: Array | None = None) -> NDArray[np.int64]:
    """Return the block of each row when rows are sorted by a quantity and divided into parts of equal weight.

    Args:
        order: Quantity of any unit by which rows are sorted, (N,).
        count: Number of blocks; with fewer than twice as many rows, each row is a block.
        weight: Weight of each row, (N,); equal weights if None.

    Returns:
        Block numbers, (N,).
    """
    n = len(order)
    if n < 2 * count:
        return np.arange(n)
    sorted_rows = np.argsort(order, kind="stable")
    w = np.ones(n) if weight is None else weight[sorted_rows]
    label = np.empty(n, dtype=np.int64)
    label[sorted_rows] = np.minimum((np.cumsum(w) - 0.5 * w) / np.sum(w) * count, count - 1).astype(np.int64)
    return label
