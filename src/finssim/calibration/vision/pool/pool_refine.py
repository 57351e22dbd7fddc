"""The fit proper: full weights, the size of the errors, wrong rows left out, until nothing changes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from finssim.calibration.errors import CalibrationError
from finssim.calibration.vision.pool.observations import Observations
from finssim.calibration.vision.pool.pool_model import NAMES, PoolModel
from finssim.calibration.vision.pool.pool_noise import Noise, Whitener, estimate_noise
from finssim.calibration.vision.pool.pool_solver import (
    Prior,
    Solution,
    clearances,
    normal_equations,
    residuals,
    solve,
)
from finssim.calibration.vision.pool.pool_start import RobustPixels

__all__ = ["Refined", "refine", "refit", "touched", "touching_advice"]

Array = NDArray[np.float64]

CHANCE = 0.02
"""Chance that a right row is taken for a wrong one anywhere in a survey."""

MOST_WRONG = 0.4
"""Share of wrong rows beyond which nothing is believed."""

ROUNDS = 6

TOUCHING = 0.0001
"""Distance of the plane from a point or the camera, below which the one keeps the other from moving on [m]."""

PRESSED = 9.0
"""Fall of chi² that a plane held by a point or the camera would gain beyond it, from which that is no chance."""

CAMERA = "the camera"


@dataclass(frozen=True)
class Refined:
    """A fit and what it rests on."""

    model: PoolModel
    noise: Noise
    used: NDArray[np.bool_]
    """Rows that are not outliers, (N,)."""
    whiten: Whitener
    """Of the rows used."""
    active: NDArray[np.bool_]
    """Parameters fitted, (18,)."""
    prior: Prior
    covariance: Array
    """Of all parameters, zero where held, (18, 18)."""
    solution: Solution
    dof: float
    """Rows of residuals less parameters."""


def refine(
    model: PoolModel,
    seen: Observations,
    active: NDArray[np.bool_],
    prior: Prior,
    noise: Noise,
    *,
    pixel_known: bool = False,
) -> Refined:
    """Fit with the errors of pixels and survey estimated on the way, and wrong rows named.

    Args:
        model: From the search.
        seen: All rows.
        active: Parameters to fit, (18,).
        prior: What is known beforehand.
        noise: What is believed of the errors.
        pixel_known: The pixel's error is given.

    Raises:
        CalibrationError: Too many rows do not fit.
    """
    robust = RobustPixels(model, seen)
    model = solve(model, seen, robust, active, prior, iterations=40).model
    robust = RobustPixels(model, seen, least=0.05)
    model = solve(model, seen, robust, active, prior, iterations=40).model
    if not pixel_known:
        size = np.linalg.norm(residuals(model, seen)[0], axis=1)
        noise = replace(noise, pixel=max(0.05, float(np.median(size)) / 1.1774))
    used = _plausible(model, seen, noise)
    free = np.flatnonzero(active)
    for _ in range(ROUNDS):
        _refuse_few(used, seen, int(active.sum()))
        rows = seen.subset(used)
        J, J_point = model.jacobians(rows.points, rows.dry)
        information = _information(model, prior, free)
        noise = estimate_noise(
            residuals(model, rows)[0],
            J[..., free],
            J_point,
            rows,
            noise,
            information,
            pixel_known=pixel_known,
        )
        whiten = Whitener(J_point, rows, noise)
        solution = solve(model, rows, whiten, active, prior)
        model, before = solution.model, used
        used = _plausible(model, seen, noise)
        if np.array_equal(used, before):
            break
    covariance = _covariance(model, rows, whiten, free, prior)
    dof = max(3.0, 2.0 * len(rows) - len(free))
    return Refined(model, noise, before, whiten, active, prior, covariance, solution, dof)


def refit(start: Refined, seen: Observations, rows: NDArray[np.bool_]) -> PoolModel:
    """The same fit to some of the rows, errors as they were."""
    part = seen.subset(rows)
    whiten = Whitener(start.model.jacobians(part.points, part.dry)[1], part, start.noise)
    return solve(start.model, part, whiten, start.active, start.prior).model


def touched(fit: Refined, seen: Observations) -> tuple[str, ...]:
    """Points used, and the camera, that the plane and its window have come to rest against although the pixels want it
    further on; the nearest first.

    Args:
        fit: Of these rows.
        seen: All rows.
    """
    wet = fit.used & ~seen.dry
    distance = np.where(wet, clearances(fit.model, seen.points), np.inf)
    near = [i for i in np.argsort(distance) if distance[i] < TOUCHING]
    if not near and fit.model.clearance >= TOUCHING:
        return ()
    N, g = normal_equations(
        fit.model, seen.subset(fit.used), fit.whiten, np.flatnonzero(fit.active), fit.prior
    )
    scale = np.sqrt(np.maximum(np.diagonal(N), 1e-300))
    if float((g / scale) @ np.linalg.lstsq(N / np.outer(scale, scale), g / scale, rcond=1e-9)[0]) < PRESSED:
        return ()
    names = dict.fromkeys(seen.locations[seen.location[i]] for i in near)
    return (*((CAMERA,) if fit.model.clearance < TOUCHING else ()), *names)


def touching_advice(names: tuple[str, ...]) -> list[str]:
    """A sentence where the plane came to rest against the points or the camera, by the names of `touched`."""
    if not names:
        return []
    listed = ", ".join(names[:4]) + (", ..." if len(names) > 4 else "")
    return [
        f"the plane ends against {listed}, which it cannot pass: where nothing touches it in truth, the pixels want it "
        "further on than it can be; check the coordinates of what it touches, the thickness of the window, the index "
        "and the camera file"
    ]


def _plausible(model: PoolModel, seen: Observations, noise: Noise) -> NDArray[np.bool_]:
    """Rows whose residual is of the size that the errors of pixel and survey make, whatever it shares with others."""
    r, ok = residuals(model, seen)
    J_point = np.where(ok[:, None, None], model.jacobians(seen.points, seen.dry)[1], 0.0)
    sigma = noise.scale * np.where(np.isfinite(seen.sigma), seen.sigma, noise.survey)
    turn = noise.scale * noise.survey_yaw * np.einsum("nij,nj->ni", J_point, seen.arm)
    V = J_point @ J_point.transpose(0, 2, 1) * sigma[:, None, None] ** 2 + turn[:, :, None] * turn[:, None, :]
    V = V + noise.pixel**2 * np.eye(2)
    d2 = np.einsum("ni,nij,nj->n", r, np.linalg.inv(V), r)
    inner = max(1.0, float(np.median(d2)) / float(chi2.ppf(0.5, 2)))
    return np.asarray(ok & (d2 < inner * chi2.ppf(1.0 - CHANCE / len(seen), 2)))


def _refuse_few(used: NDArray[np.bool_], seen: Observations, parameters: int) -> None:
    wrong = len(seen) - int(used.sum())
    if wrong > MOST_WRONG * len(seen):
        raise CalibrationError(
            f"{wrong} of {len(seen)} points do not fit any one camera and plane: check that ids, units and the camera "
            "file belong together, and that the camera did not move"
        )
    if 2 * int(used.sum()) < 6:
        raise CalibrationError(
            f"{int(used.sum())} usable points for {parameters} parameters: survey at least 4, better 20"
        )


def _information(model: PoolModel, prior: Prior, free: NDArray[np.intp]) -> Array:
    J = prior.rows(model)[1][:, free]
    return np.asarray(J.T @ J)


def _covariance(
    model: PoolModel, rows: Observations, whiten: Whitener, free: NDArray[np.intp], prior: Prior
) -> Array:
    """Inverse information, in the order of `NAMES`; directions that nothing tells get a very large variance."""
    N, _ = normal_equations(model, rows, whiten, free, prior)
    scale = np.sqrt(np.maximum(np.diagonal(N), 1e-300))
    values, vectors = np.linalg.eigh(N / np.outer(scale, scale))
    half = vectors / np.sqrt(np.maximum(values, 1e-14)) / scale[:, None]
    covariance = np.zeros((len(NAMES), len(NAMES)))
    covariance[np.ix_(free, free)] = half @ half.T
    return covariance
