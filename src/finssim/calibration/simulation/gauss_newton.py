"""Levenberg-Marquardt over segments: many steps are tried at once, and every segment keeps the one that serves it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.simulation.bordered import (
    CUT,
    Blocks,
    Linear,
    bounded_step,
    collect,
    eliminate,
    huber,
    scatter,
)

__all__ = ["Point", "Problem", "Solution", "cost_of", "costs_of", "solve"]

Array = NDArray[np.float64]

CLOSE = 0.25
"""Part of a standard error (of independent noise) that a converged estimate may still be off."""

DAMPINGS = np.array([1e-1, 1.0, 1e1, 1e3])
"""Factors on the damping of theta and phi that are tried at once."""

SMALL = 0.05
"""Fall of half the sum of losses that is not worth another iteration: an error of a third of a standard error."""

OWN_DAMPINGS = np.array([0.0, 1.0, 30.0])
"""Dampings of z that are tried with each; every segment takes the one that serves it best."""


class Point(NamedTuple):
    """Values of all unknowns; with a leading axis of candidates where several are evaluated together."""

    theta: Array
    """(P,)"""
    phi: Array
    """(G, b)"""
    z: Array
    """Deviations from the prior's mean, (S, q)."""


class Problem(Protocol):
    """What is fitted."""

    edges: NDArray[np.int64]
    """First sample of each segment, and N, (S + 1,)."""
    groups: NDArray[np.int64]
    """Trial of each segment, (S,)."""
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


def costs_of(problem: Problem, residual: Array, std: Array, z: Array, cut: float) -> Array:
    """Half the losses of every segment (C, S) at several points with residuals (N, C); infinite where one has none."""
    loss = np.add.reduceat(huber(residual / std[:, None], cut)[0], problem.edges[:-1], axis=0).T
    loss = loss + 0.5 * np.square(z / problem.prior_std).sum(axis=2)
    return np.asarray(np.where(np.isfinite(loss), loss, np.inf))


def cost_of(problem: Problem, residual: Array, std: Array, point: Point, cut: float = CUT) -> float:
    """Half the loss of one point with residuals (N,)."""
    own = costs_of(problem, residual[:, None], std, point.z[None], cut)
    return float(own.sum() + 0.5 * problem.prior_precision @ (point.theta - problem.prior_mean) ** 2)


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
    point, damping, done, interrupted = start, 1e-2, 0, False
    linear = problem.linearise(point)
    if not np.isfinite(linear.residual).all():
        return Solution(point, np.ones(len(linear.residual)), np.inf, linear, 0, False)
    std = problem.noise(linear.residual) if std is None else std
    converged, settled, cut = False, rough, np.inf if rough else CUT
    cost = cost_of(problem, linear.residual, std, point, cut)
    try:
        for done in range(1, iterations + 1):
            if report:
                report(done, float(np.sqrt(2.0 * cost / max(len(std), 1))))
            blocks = collect(linear, std, problem.edges, point.z, problem.prior_std, cut)
            trials, remaining = _trial_steps(problem, blocks, point, damping)
            if settled and remaining < CLOSE:
                converged = True
                break
            best, found, least = _best(problem, trials, std, cut)
            if least < cost:
                damping = float(np.clip(damping * DAMPINGS[best], 1e-9, 1e9))
                fall = cost - least
                point = found
                linear = problem.linearise(point)
                stuck = fall < (1e-2 * cost if rough else SMALL)
            else:
                damping = min(damping * 1e4, 1e12)
                stuck = damping >= 1e12
            new = std if rough else problem.noise(linear.residual)
            settled = rough or bool(np.all(np.abs(np.log(new / std)) < 0.01)) or done > 12
            if stuck and settled:
                converged = remaining < 1.0
                break
            if not settled:
                std, damping = new, min(damping, 1e-2)
            cost = cost_of(problem, linear.residual, std, point, cut)
    except KeyboardInterrupt:
        interrupted = True
    return Solution(point, std, cost, linear, done, converged, interrupted)


def _trial_steps(problem: Problem, blocks: Blocks, point: Point, damping: float) -> tuple[Point, float]:
    """The points that several dampings lead to, all of z for each of theta, and the largest step in standard errors
    without any."""
    P = len(point.theta)
    theta, _, errors = _step(problem, blocks, point, 0.0)
    near = errors[:P] + problem.grain(point.theta)
    remaining = float(np.max(np.abs(theta / near)[: problem.judged], initial=0.0))
    points = []
    for factor in DAMPINGS:
        theta, phi, _ = _step(problem, blocks, point, damping * factor)
        shared = np.repeat(theta[None], len(problem.groups), axis=0)
        x = np.concatenate([shared, phi[problem.groups]], axis=1)
        rest = (blocks.z - np.einsum("skq,sk->sq", blocks.xz, x))[..., None]
        for own in OWN_DAMPINGS:
            z = np.linalg.solve(blocks.zz * (1.0 + own * np.eye(blocks.zz.shape[1])), rest)[..., 0]
            moved = np.clip(point.theta + theta, problem.low, problem.high)
            points.append(Point(moved, point.phi + phi, point.z + z))
    return Point(*(np.stack(parts) for parts in zip(*points, strict=True))), remaining


def _best(problem: Problem, trials: Point, std: Array, cut: float) -> tuple[int, Point, float]:
    """Which of `DAMPINGS` serves best where every segment chooses its own z, that point, and its cost."""
    own = costs_of(problem, problem.residuals(trials), std, trials.z, cut)
    own = own.reshape(len(DAMPINGS), len(OWN_DAMPINGS), -1)
    prior = 0.5 * (trials.theta[:: len(OWN_DAMPINGS)] - problem.prior_mean) ** 2 @ problem.prior_precision
    total = own.min(axis=1).sum(axis=1) + prior
    best = int(np.argmin(total))
    choice = own[best].argmin(axis=0)
    at = best * len(OWN_DAMPINGS)
    z = trials.z[at + choice, np.arange(len(choice))]
    return best, Point(trials.theta[at], trials.phi[at], z), float(total[best])


def _step(problem: Problem, blocks: Blocks, point: Point, damping: float) -> tuple[Array, Array, Array]:
    """Steps of theta (P,) and phi (G, b) inside the box, and standard errors of both, (P + G b,)."""
    (G, b), P = point.phi.shape, len(point.theta)
    normal, right, _ = eliminate(blocks)
    A, g = scatter(normal, right, problem.groups, (P, G, b))
    A[np.arange(P), np.arange(P)] += problem.prior_precision
    g[:P] -= problem.prior_precision * (point.theta - problem.prior_mean)
    scale = np.sqrt(np.maximum(np.diag(A), 1e-30 + 1e-12 * np.diag(A).max()))
    A, g = A / np.outer(scale, scale) + (damping + 1e-9) * np.eye(len(g)), g / scale
    far = np.full(G * b, np.inf)
    low = np.concatenate([np.minimum(problem.low - point.theta, 0.0), -far]) * scale
    high = np.concatenate([np.maximum(problem.high - point.theta, 0.0), far]) * scale
    d = bounded_step(A, g, low, high) / scale
    return d[:P], d[P:].reshape(G, b), np.sqrt(np.diag(np.linalg.inv(A))) / scale
