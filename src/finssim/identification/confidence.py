"""Evidence of trials for the numbers of a fit, and the resulting intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from finssim.identification.shooting import FitSolution, Shooting, curvatures_of, weights_of
from finssim.identification.uncertainty import (
    Covariance,
    Evidence,
    intervals,
    pooled_covariance,
    trial_covariance,
)

Array = NDArray[np.float64]


FEWEST_TRIALS = 4
"""Number of trials below which they are cut into blocks to estimate the spread."""

BLOCKS = 24
"""Total number of blocks of all trials."""


class Confidence(NamedTuple):
    """Uncertainty of theta at a solution."""

    evidence: Evidence
    covariance: Covariance
    free: Array
    """Result of one unbounded step from the solution, in the units of theta, (P,)."""
    interval: Array
    """95 % interval in the units of theta, around `free` and containing theta, (P, 2)."""

    def variance(self, slope: Array, at: Sequence[int]) -> float:
        """Return the variance of a linear combination of some parameters.

        The unit is the square of that of the combination.

        Args:
            slope: Factor of each parameter, (n,).
            at: Indices of the parameters in theta, (n,).
        """
        C = self.covariance
        matrix = (C.local if C.alone[at].any() else C.trials)[np.ix_(at, at)]
        with np.errstate(invalid="ignore"):
            return float(slope @ matrix @ slope) if len(slope) else 0.0


def confidence(problem: Shooting, solution: FitSolution) -> Confidence:
    """Return the evidence on theta, after elimination of initial states and offsets, and its covariance and
    intervals."""
    evidence = evidence_of(problem, solution)
    pooled = problem.coasts and evidence.unit == "trials"
    covariance = pooled_covariance(evidence) if pooled else trial_covariance(evidence)
    theta, low, high = solution.point.theta, problem.low, problem.high
    free = theta
    if ((theta <= low) | (theta >= high)).any():
        off, slope = problem.prior(theta)
        normal, score = evidence.information, evidence.score.sum(axis=0) - slope.T @ off / problem.repeats
        scale = np.sqrt(np.maximum(np.diagonal(normal), 1e-300))
        free = theta + np.linalg.lstsq(normal / np.outer(scale, scale), score / scale, rcond=1e-10)[0] / scale
    ends = intervals(free, covariance)
    ends[:, 0], ends[:, 1] = np.minimum(ends[:, 0], theta), np.maximum(ends[:, 1], theta)
    ends = np.clip(ends, low[:, None], high[:, None])
    if np.isfinite(solution.step).all():  # without convergence, the true value may be as far as one more step
        goes = np.clip(theta + solution.step, low, high)
        ends[:, 0], ends[:, 1] = np.minimum(ends[:, 0], goes), np.maximum(ends[:, 1], goes)
    unknown = ~np.isfinite(np.diagonal(covariance.local))
    ends[unknown] = [-np.inf, np.inf]
    return Confidence(evidence, covariance, free, ends)


def shared_slopes(problem: Shooting, solution: FitSolution) -> Array:
    """Return the derivatives of every sample, without the part explained by the unknowns of its own segment, (N, P).

    The units are those of the sample over those of theta.
    """
    linear, weight = solution.linear, curvatures_of(solution.linear.residual, solution.std)
    slopes = linear.shared.copy()
    for s, (a, b) in enumerate(zip(problem.edges, problem.edges[1:], strict=False)):
        own, weighted = linear.own[a:b], linear.own[a:b].T * weight[a:b]
        normal = weighted @ own + np.diag(problem.prior_std[s] ** -2.0)
        slopes[a:b] -= own @ np.linalg.solve(normal, weighted @ slopes[a:b])
    return slopes


def evidence_of(problem: Shooting, solution: FitSolution, group: NDArray[np.int64] | None = None) -> Evidence:
    """Return normal matrices and scores by groups of rows.

    Args:
        problem: Problem that was fitted.
        solution: Solution of the fit.
        group: Group of every row, (N,); trials if None, or blocks if fewer than `FEWEST_TRIALS` excite an axis.
    """
    linear = solution.linear
    curved = curvatures_of(linear.residual, solution.std)
    loss_slope = weights_of(linear.residual, solution.std) * linear.residual
    slopes = shared_slopes(problem, solution)
    trial = problem.groups[problem.measured.segment]
    unit = "blocks" if problem.few or len(np.unique(trial)) < FEWEST_TRIALS else "trials"
    if group is None:
        group = trial if unit == "trials" else time_blocks(problem, trial)
    parts = [np.flatnonzero(group == label) for label in np.unique(group)]
    known = problem.prior(solution.point.theta)[1]
    normal = [(slopes[rows].T * curved[rows]) @ slopes[rows] for rows in parts]
    score = [slopes[rows].T @ loss_slope[rows] for rows in parts]
    return Evidence(
        names=problem.names,
        normal=np.array(normal) / problem.repeats,
        score=np.array(score) / problem.repeats,
        unit=unit,
        prior=known.T @ known / problem.repeats,
    )


def time_blocks(problem: Shooting, trial: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the block of every sample: each trial is cut into equal time spans, whose number depends on its
    length."""
    t = problem.measured.clock
    present = np.unique(trial)
    span = {g: (float(t[trial == g].min()), float(np.ptp(t[trial == g]))) for g in present}
    total = sum(length for _, length in span.values())
    out = np.zeros(len(t), int)
    for g in present:
        begin, length = span[g]
        pieces = max(2, round(BLOCKS * length / max(total, 1e-9)))
        rows = trial == g
        part = (t[rows] - begin) / max(length, 1e-9)
        out[rows] = 1000 * g + np.minimum((part * pieces).astype(int), pieces - 1)
    return out


@dataclass
class Stage:
    """Fit of one set of parameters."""

    problem: Shooting
    solution: FitSolution
    found: Confidence

    @property
    def x(self) -> Array:
        """Return the final parameters, (P,), in the units of the coordinates."""
        return self.solution.point.theta[: len(self.problem.parameters.names)]
