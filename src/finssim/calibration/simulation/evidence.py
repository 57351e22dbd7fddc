"""What each trial, or each block of a few trials, says about the parameters of a simulation-error fit."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.simulation.bordered import collect, huber
from finssim.calibration.simulation.gauss_newton import Solution
from finssim.calibration.simulation.shooting import Shooting
from finssim.calibration.uncertainty import Covariance, Evidence, intervals, trial_covariance

__all__ = ["FEWEST_TRIALS", "Confidence", "confidence", "evidence_of"]

Array = NDArray[np.float64]

FEWEST_TRIALS = 4
"""With fewer, trials are cut into blocks to estimate the spread."""

BLOCKS = 24
"""That many, all trials together."""


class Confidence(NamedTuple):
    """Uncertainty of theta at a solution."""

    evidence: Evidence
    covariance: Covariance
    free: Array
    """Where the last step would go without bounds, (P,)."""
    interval: Array
    """95 %, around `free` and containing theta, (P, 2)."""


def confidence(problem: Shooting, solution: Solution) -> Confidence:
    """Evidence of theta, after initial states, offsets and trial biases are eliminated, and what follows from it."""
    evidence = evidence_of(problem, solution)
    covariance = trial_covariance(evidence)
    theta = solution.point.theta
    scale = np.sqrt(np.maximum(np.diagonal(evidence.normal.sum(axis=0)), 1e-300))
    normal = evidence.normal.sum(axis=0) / np.outer(scale, scale)
    free = theta + np.linalg.lstsq(normal, evidence.score.sum(axis=0) / scale, rcond=1e-10)[0] / scale
    at_bound = (theta <= problem.low) | (theta >= problem.high)
    if not at_bound.any():
        free = theta
    ends = intervals(free, covariance)
    ends[:, 0], ends[:, 1] = np.minimum(ends[:, 0], theta), np.maximum(ends[:, 1], theta)
    ends = np.clip(ends, problem.low[:, None], problem.high[:, None])
    unknown = ~np.isfinite(np.diagonal(covariance.local))
    ends[unknown] = [-np.inf, np.inf]
    return Confidence(evidence, covariance, free, ends)


def evidence_of(problem: Shooting, solution: Solution) -> Evidence:
    """Normal matrices and scores by trial, or by blocks of rows where fewer than `FEWEST_TRIALS` excite an axis."""
    linear, std, point = solution.linear, solution.std, solution.point
    blocks = collect(linear, std, problem.edges, point.z, problem.prior_std)
    weight = huber(linear.residual / std)[1] / std**2
    # Derivatives with each segment's own unknowns projected out: what they leave of every sample.
    gain = np.linalg.solve(blocks.zz, np.swapaxes(blocks.xz, 1, 2))
    segment = problem.measured.segment
    slopes = linear.shared.copy()
    for s in range(len(problem.edges) - 1):
        rows = slice(problem.edges[s], problem.edges[s + 1])
        slopes[rows] -= linear.own[rows] @ gain[s]
    trial = problem.groups[segment]
    P, (G, b) = len(point.theta), point.phi.shape
    if b:
        slopes = _without_biases(slopes, weight, trial, P, (G, b))
    unit, group = "trials", trial
    if problem.few or len(np.unique(trial)) < FEWEST_TRIALS:
        unit, group = "blocks", _blocks(problem, trial)
    labels, group = np.unique(group, return_inverse=True)
    order = np.argsort(group, kind="stable")
    edges = np.searchsorted(group[order], np.arange(len(labels) + 1))
    normal, score = np.empty((len(labels), P, P)), np.empty((len(labels), P))
    for g in range(len(labels)):
        those = order[edges[g] : edges[g + 1]]
        weighted = slopes[those].T * weight[those]
        normal[g], score[g] = weighted @ slopes[those], weighted @ linear.residual[those]
    # What is known beforehand is one more witness.
    normal = np.concatenate([normal, np.diag(problem.prior_precision)[None]])
    pull = problem.prior_precision * (problem.prior_mean - point.theta)
    score = np.concatenate([score, pull[None]])
    return Evidence(names=problem.names, normal=normal, score=score, unit=unit)


def _without_biases(
    slopes: Array, weight: Array, trial: NDArray[np.int64], P: int, shape: tuple[int, int]
) -> Array:
    """Derivatives by theta with the trial biases projected out too, (N, P)."""
    out = slopes[:, :P].copy()
    for g in range(shape[0]):
        rows = trial == g
        own = slopes[rows, P:]
        if not rows.any():
            continue
        weighted = own.T * weight[rows]
        normal = weighted @ own + 1e-12 * np.eye(shape[1])
        out[rows] -= own @ np.linalg.solve(normal, weighted @ slopes[rows, :P])
    return out


def _blocks(problem: Shooting, trial: NDArray[np.int64]) -> NDArray[np.int64]:
    """Block of every sample: each trial in equal spans of time, the longer the trial the more of them."""
    start = np.array([s.t0 for s in problem.segments])[problem.measured.segment]
    t = start + problem.measured.time
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
