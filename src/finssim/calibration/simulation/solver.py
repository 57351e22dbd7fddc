"""Levenberg and Marquardt's descent over segments: several steps are tried at once, as worlds of one simulator."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.vision.least_squares import (
    Block,
    arrow_reduced,
    block_of,
    boxed,
    huber_cost,
    huber_weight,
)

__all__ = ["CUT", "Linear", "Point", "Problem", "Solution", "solve", "weights_of"]

Array = NDArray[np.float64]

CUT = 2.5
"""Whitened residual above which Huber's loss grows linearly."""

CLOSE = 0.25
"""Part of a standard error (of independent noise) that a converged estimate may still be off."""

DAMPINGS = np.array([1e-2, 1e-1, 1.0, 1e1, 1e2, 1e4])
"""Factors on the damping that are tried at once."""

SMALL = 0.05
"""Fall of half the sum of losses that is not worth another iteration: an error of a third of a standard error."""


class Point(NamedTuple):
    """Values of all unknowns; with a leading axis of candidates where several are evaluated together."""

    theta: Array
    """Shared by all segments, (P,)."""
    z: Array
    """Of each segment alone, deviations from the prior's mean, (S, q)."""


class Linear(NamedTuple):
    """Residuals at a point, sorted by segment, and derivatives of the predictions."""

    residual: Array
    """Measured minus predicted, (N,)."""
    shared: Array
    """d predicted / d theta, (N, P)."""
    own: Array
    """d predicted / d z of the sample's own segment, (N, q)."""


class Problem(Protocol):
    """What is fitted."""

    edges: NDArray[np.int64]
    """First sample of each segment, and N, (S + 1,)."""
    low: Array
    high: Array
    """Box of theta, (P,)."""
    prior_std: Array
    """Of z around zero, (S, q)."""
    prior_mean: Array
    """What is known of theta beforehand, (P,)."""
    prior_precision: Array
    """One over its variance; 0 where nothing is known, (P,)."""
    judged: int
    """How many of theta, from the first, have to be accurate; the rest are there for their sake."""

    def residuals(self, points: Point) -> Array:
        """Measured minus predicted for several points (leading axis C), (N, C); NaN where a point has no answer."""

    def linearise(self, point: Point) -> Linear:
        """Residuals and derivatives at one point."""

    def noise(self, residual: Array) -> Array:
        """Standard deviation of every sample, from residuals at a fit, (N,)."""

    def grain(self, theta: Array) -> Array:
        """Differences of theta that nobody minds, (P,)."""


@dataclass(frozen=True)
class Solution:
    """Where a fit ended."""

    point: Point
    std: Array
    """Of every sample, (N,)."""
    cost: float
    """Half the sum of the losses."""
    linear: Linear
    iterations: int
    converged: bool
    interrupted: bool = False


def weights_of(residual: Array, std: Array, cut: float = CUT) -> Array:
    """Huber's weights over the variance of the samples, (N,)."""
    return huber_weight(np.abs(residual / std), cut) / std**2


def blocks_of(problem: Problem, linear: Linear, std: Array, point: Point, cut: float = CUT) -> list[Block]:
    """Weighted normal equations of every segment with the prior of z; that of theta is in the first."""
    root = np.sqrt(weights_of(linear.residual, std, cut))
    shared, own, residual = linear.shared * root[:, None], linear.own * root[:, None], linear.residual * root
    blocks = []
    for s, (a, b) in enumerate(zip(problem.edges, problem.edges[1:], strict=False)):
        block, stiff = block_of(shared[a:b], own[a:b], residual[a:b]), problem.prior_std[s] ** -2.0
        blocks.append(block._replace(bb=block.bb + np.diag(stiff), b=block.b - stiff * point.z[s]))
    known, first = problem.prior_precision, blocks[0]
    blocks[0] = first._replace(
        aa=first.aa + np.diag(known), a=first.a - known * (point.theta - problem.prior_mean)
    )
    return blocks


def step_of(
    problem: Problem, reduced: tuple[Array, Array, list[Array]], point: Point, damping: float
) -> tuple[Array, Array, Array]:
    """Steps of theta (P,) inside the box and of z (S, q), and standard errors of theta, (P,).

    Args:
        problem: For its box.
        reduced: Normal equations of theta alone at the point, and how z follows; of `arrow_reduced`.
        point: Where the step begins.
        damping: What the diagonal of theta's grows by, as a part of itself [-].
    """
    total, right, inners = reduced
    scale = np.sqrt(np.maximum(np.diagonal(total), 1e-30 + 1e-12 * np.diagonal(total).max()))
    A = total / np.outer(scale, scale) + (damping + 1e-9) * np.eye(len(scale))
    low, high = problem.low - point.theta, problem.high - point.theta
    step = boxed(A, right / scale, np.minimum(low * scale, -1e-12), np.maximum(high * scale, 1e-12)) / scale
    z = np.array([inner[:, -1] - inner[:, :-1] @ step for inner in inners])
    return step, z, np.sqrt(np.diagonal(np.linalg.inv(A))) / scale


def costs_of(problem: Problem, residual: Array, std: Array, points: Point, cut: float = CUT) -> Array:
    """Half the losses of several points with residuals (N, C), (C,); infinite where one has no answer."""
    prior = np.square(points.z / problem.prior_std).sum(axis=(1, 2))
    prior = prior + (points.theta - problem.prior_mean) ** 2 @ problem.prior_precision
    loss = np.array([huber_cost(np.abs(column / std), cut) for column in residual.T])
    return np.asarray(np.where(np.isfinite(loss), 0.5 * (loss + prior), np.inf))


def solve(
    problem: Problem,
    start: Point,
    *,
    iterations: int = 30,
    std: Array | None = None,
    rough: bool = False,
    report: Callable[[int, float], None] | None = None,
) -> Solution:
    """Fit; noise and robust weights are estimated along the way.

    Converged where the undamped step moves no judged parameter by more than `CLOSE` of its standard error and grain
    together, and the noise no longer changes.

    Args:
        problem: What to fit.
        start: Where to begin.
        iterations: At most.
        std: Of every sample at the start, (N,); from the residuals there if None.
        rough: Far from a solution: keep `std`, and let no residual count as an outlier, for that is what a wrong
            parameter looks like too. Ends as soon as an iteration gains less than a hundredth.
        report: Called with each iteration and the root mean square of the whitened residuals.

    Returns:
        The best point; after Ctrl-C the best until then, with `interrupted`.
    """
    point, damping, done = start, 1e-2, 0
    linear = problem.linearise(point)
    if not np.isfinite(linear.residual).all():
        return Solution(point, np.ones(len(linear.residual)), np.inf, linear, 0, False)
    std = problem.noise(linear.residual) if std is None else std
    converged, interrupted, settled, cut = False, False, rough, np.inf if rough else CUT

    def cost_at(std: Array) -> float:
        one = Point(point.theta[None], point.z[None])
        return float(costs_of(problem, linear.residual[:, None], std, one, cut)[0])

    cost = cost_at(std)
    try:
        for done in range(1, iterations + 1):
            if report:
                report(done, float(np.sqrt(2.0 * cost / max(len(std), 1))))
            reduced = arrow_reduced(blocks_of(problem, linear, std, point, cut), 0.0)
            step, _, error = step_of(problem, reduced, point, 0.0)
            near = error + problem.grain(point.theta)
            remaining = float(np.max(np.abs(step / near)[: problem.judged], initial=0.0))
            if settled and remaining < CLOSE:
                converged = True
                break
            steps = [step_of(problem, reduced, point, damping * factor) for factor in DAMPINGS]
            points = Point(
                np.clip(point.theta + np.array([theta for theta, _, _ in steps]), problem.low, problem.high),
                point.z + np.array([z for _, z, _ in steps]),
            )
            costs = costs_of(problem, problem.residuals(points), std, points, cut)
            best = int(np.argmin(costs))
            if costs[best] < cost:
                damping = float(np.clip(damping * DAMPINGS[best], 1e-9, 1e9))
                stuck = cost - costs[best] < (1e-2 * cost if rough else SMALL)
                point = Point(points.theta[best], points.z[best])
                linear = problem.linearise(point)
            else:
                damping = min(damping * 1e5, 1e12)
                stuck = damping >= 1e12
            new = std if rough else problem.noise(linear.residual)
            settled = rough or bool(np.all(np.abs(np.log(new / std)) < 0.01)) or done > 12
            if stuck and settled:
                converged = remaining < 1.0
                break
            if not settled:
                std, damping = new, min(damping, 1e-2)
            cost = cost_at(std)
    except KeyboardInterrupt:
        interrupted = True
    return Solution(point, std, cost, linear, done, converged, interrupted)
