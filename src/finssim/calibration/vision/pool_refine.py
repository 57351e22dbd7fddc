"""The fit proper: full weights, the size of the errors, wrong rows left out, errors at points not seen."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.stats import chi2

from finssim.calibration.errors import CalibrationError
from finssim.calibration.vision.pool_model import (
    NAMES,
    PoolModel,
    Prior,
    clearances,
    normal_equations,
    residuals,
    solve,
)
from finssim.calibration.vision.pool_search import RobustPixels
from finssim.calibration.vision.survey import Observations
from finssim.geometry.optics import back_project

__all__ = [
    "HeldOut", "Noise", "Refined", "Whitener", "error_vectors", "held_out", "refine", "rms", "surprise",
    "touched",
]  # fmt: skip

Array = NDArray[np.float64]

LEAST_PIXEL = 0.02
"""Smallest standard error of a pixel that an estimate can take [px]: no corner is found better."""

ENOUGH = 2000
"""Rows from which the size of the errors is estimated."""

KNOWN_SURVEY = 0.35
"""Standard deviation of the logarithm of the survey's error: what is said of it is right within about a third."""

KNOWN_PIXEL, USUAL_PIXEL = 1.2, 0.4
"""The same of the pixel's error, and its usual size [px]."""


@dataclass(frozen=True, kw_only=True)
class Noise:
    """Standard errors."""

    pixel: float
    """Of each image coordinate [px]."""
    survey: float = 0.002
    """Of each coordinate of a location, where the survey does not give its own [m]."""
    survey_yaw: float = 0.0087
    """Of the direction in which a tag was laid [rad]."""
    scale: float = 1.0
    """Of all survey errors, as the residuals tell it."""

    def survey_modes(self, J_point: Array, seen: Observations) -> Array:
        """What one standard error of a location's x, y, z and of a tag's direction does to each pixel [px], (N, 2, 4).

        Args:
            J_point: Derivative of the pixel by the point, (N, 2, 3).
            seen: The rows.
        """
        sigma = np.where(np.isfinite(seen.sigma), seen.sigma, self.survey)[:, None, None]
        turn = self.survey_yaw * np.einsum("nij,nj->ni", J_point, seen.arm)[..., None]
        return np.asarray(self.scale * np.concatenate([J_point * sigma, turn], axis=-1))


class Whitener:
    """Makes residuals independent and of unit variance; rows of one location belong together.

    V_l = sigma² 1 + J_l B_l S B_lᵀ J_lᵀ: a location is displaced as a whole, and a tag turned, by the survey's error.
    """

    def __init__(self, J_point: Array, seen: Observations, noise: Noise) -> None:
        """
        Args:
            J_point: Derivative of the pixel by the point, (N, 2, 3).
            seen: The rows.
            noise: Standard errors.
        """
        modes = noise.survey_modes(J_point, seen)
        self.logdet = 0.0
        self._groups: list[tuple[NDArray[np.intp], Array]] = []
        order = np.argsort(seen.location, kind="stable")
        _, starts, counts = np.unique(seen.location[order], return_index=True, return_counts=True)
        for count in np.unique(counts):
            rows = np.stack([order[s : s + count] for s in starts[counts == count]])
            B = modes[rows].reshape(len(rows), 2 * count, 4)
            V = B @ B.transpose(0, 2, 1)
            index = np.arange(2 * count)
            V[:, index, index] += noise.pixel**2
            L = np.linalg.cholesky(V)
            self.logdet += 2.0 * float(np.log(L[:, index, index]).sum())
            self._groups.append((rows, np.linalg.inv(L)))

    def __call__(self, values: Array) -> Array:
        """Whitened rows of values (N, 2) or (N, 2, P), as (2N,) or (2N, P); locations one after another."""
        tail = values.shape[2:]
        parts = []
        for rows, L_inverse in self._groups:
            block = values[rows].reshape(len(rows), L_inverse.shape[-1], -1)
            parts.append((L_inverse @ block).reshape(-1, *tail))
        return np.concatenate(parts)


def estimate_noise(
    residual: Array,
    J: Array,
    J_point: Array,
    seen: Observations,
    noise: Noise,
    prior: Array,
    *,
    pixel_known: bool,
) -> Noise:
    """Most likely standard errors of pixels and survey (restricted likelihood: what the fit swallowed is given back).

    Args:
        residual: Measured minus predicted [px], (N, 2).
        J: Derivative of the prediction by the fitted parameters, (N, 2, P).
        J_point: By the point, (N, 2, 3).
        seen: The rows.
        noise: What is believed before.
        prior: Information of the priors on the parameters, (P, P).
        pixel_known: The pixel's error is given and stays.
    """
    if len(seen) > ENOUGH:  # two numbers need no more; whole locations, evenly
        every = int(np.ceil(len(seen) / ENOUGH))
        rows = np.flatnonzero(seen.location % every == 0)
        if len(rows) > ENOUGH // 4:
            residual, J, J_point, seen = residual[rows], J[rows], J_point[rows], seen.subset(rows)

    def at(x: Array) -> Noise:
        pixel = noise.pixel if pixel_known else max(LEAST_PIXEL, math.exp(x[1]))
        return replace(noise, pixel=pixel, scale=math.exp(x[0]))

    def cost(x: Array) -> float:
        if np.abs(x).max() > 12.0:
            return 1e12
        whiten = Whitener(J_point, seen, at(x))
        r, A = whiten(residual), whiten(J)
        N = A.T @ A + prior
        scale = np.sqrt(np.maximum(np.diagonal(N), 1e-300))
        logdet = float(np.linalg.slogdet(N / np.outer(scale, scale))[1]) + 2.0 * float(np.log(scale).sum())
        g = A.T @ r
        chi2 = float(r @ r) - float(g @ np.linalg.lstsq(N, g, rcond=None)[0])
        usual = (x[0] / KNOWN_SURVEY) ** 2
        if not pixel_known:
            usual += ((x[1] - math.log(USUAL_PIXEL)) / KNOWN_PIXEL) ** 2
        return chi2 + whiten.logdet + logdet + usual

    start = [0.0, math.log(max(noise.pixel, LEAST_PIXEL))][: 1 if pixel_known else 2]
    found = minimize(
        cost, np.array(start), method="Nelder-Mead", options={"xatol": 0.01, "fatol": 0.01, "maxiter": 120}
    )
    return at(found.x)


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
    cost: float
    """Half the sum of squares that was minimised."""
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
        J_prior = prior.rows(model)[1][:, free]
        off, information = residuals(model, rows)[0], J_prior.T @ J_prior
        noise = estimate_noise(off, J[..., free], J_point, rows, noise, information, pixel_known=pixel_known)
        whiten = Whitener(J_point, rows, noise)
        (model, cost), before = solve(model, rows, whiten, active, prior), used
        used = _plausible(model, seen, noise)
        if np.array_equal(used, before):
            break
    covariance = _covariance(model, rows, whiten, free, prior)
    dof = max(3.0, 2.0 * len(rows) - len(free))
    return Refined(model, noise, before, whiten, active, prior, covariance, cost, dof)


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


def _plausible(model: PoolModel, seen: Observations, noise: Noise) -> NDArray[np.bool_]:
    """Rows whose residual is of the size that the errors of pixel and survey make, whatever it shares with others."""
    d2 = surprise(model, seen, noise)
    inner = max(1.0, float(np.median(d2)) / float(chi2.ppf(0.5, 2)))
    return np.asarray(d2 < inner * chi2.ppf(1.0 - CHANCE / len(seen), 2))


def surprise(model: PoolModel, seen: Observations, noise: Noise, covariance: Array | None = None) -> Array:
    """Squared residuals over what the errors of pixel and survey make of them, (N,); infinite where there is none.

    Args:
        model: Predicts.
        seen: The rows.
        noise: Standard errors.
        covariance: Of the model's parameters, if their errors count too, (18, 18).
    """
    r, ok = residuals(model, seen)
    J, J_point = (np.where(ok[:, None, None], part, 0.0) for part in model.jacobians(seen.points, seen.dry))
    modes = noise.survey_modes(J_point, seen)
    V = modes @ modes.transpose(0, 2, 1) + noise.pixel**2 * np.eye(2)
    if covariance is not None:
        V = V + J @ covariance @ J.transpose(0, 2, 1)
    return np.where(ok, np.einsum("ni,nij,nj->n", r, np.linalg.inv(V), r), np.inf)


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


FEW = 4
"""Locations below which single rows are held out instead: a target or two have no parts to leave out."""


@dataclass(frozen=True)
class HeldOut:
    """Errors of K rows, each from a fit without its location."""

    pixels: Array
    """Measured minus predicted [px], (K, 2)."""
    points: Array
    """Back-projected minus surveyed, in the plane of the point [m], (K, 3)."""
    rows: NDArray[np.intp]
    """Of the observations, (K,)."""
    folds: int

    def as_json(self) -> dict[str, float | int | None]:
        """Root mean squares and 95th percentiles; the error of the survey is in them."""
        size = np.linalg.norm(self.points, axis=1)
        size = size[np.isfinite(size)]
        return {
            "folds": self.folds,
            "points": len(self.rows),
            "rms_px": rms(self.pixels),
            "rms_cm": 100.0 * rms(size[:, None]) if len(size) else None,
            "p95_cm": 100.0 * float(np.percentile(size, 95)) if len(size) else None,
        }


def rms(errors: Array) -> float:
    """Root mean square length of vectors (K, n)."""
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=-1)))) if len(errors) else float("nan")


def held_out(fit: Refined, seen: Observations, folds: int, seed: int, normal: Array) -> HeldOut | None:
    """Refit without each part of the locations in turn; None where too few would be left.

    Args:
        fit: To all rows; its outliers stay out.
        seen: All rows.
        folds: Parts, at most one for each location.
        seed: Of the parts.
        normal: Of the planes, one through each point, on which pixels are back-projected: unit, pool frame [-], (3,).
    """
    used = np.flatnonzero(fit.used)
    place = seen.location if len(np.unique(seen.location[used])) >= FEW else np.arange(len(seen))
    names = np.unique(place[used])
    folds = min(folds, len(names))
    if folds < 2:
        return None
    fold = np.empty(int(place.max()) + 1, int)
    fold[np.random.default_rng(seed).permutation(names)] = np.arange(len(names)) % folds
    pixels, points, rows = [], [], []
    for k in range(folds):
        inside = np.zeros(len(seen), bool)
        inside[used] = fold[place[used]] != k
        outside = used[fold[place[used]] == k]
        if 2 * inside.sum() < 8 or len(np.unique(seen.points[inside].round(6), axis=0)) < 4:
            return None
        part = seen.subset(inside)  # the errors stay as they were
        whiten = Whitener(fit.model.jacobians(part.points, part.dry)[1], part, fit.noise)
        model = solve(fit.model, part, whiten, fit.active, fit.prior).model
        here = seen.subset(outside)
        r, ok = residuals(model, here)
        rows.append(outside[ok])
        pixels.append(r[ok])
        points.append(error_vectors(model, here, normal)[ok])
    return HeldOut(np.concatenate(pixels), np.concatenate(points), np.concatenate(rows), folds)


def error_vectors(model: PoolModel, seen: Observations, normal: Array) -> Array:
    """Where each pixel's ray meets the plane through its point, minus the point [m], (N, 3); NaN where it does not.

    Args:
        model: Camera and water.
        seen: Pixels and points.
        normal: Unit normal of the planes, pool frame [-], (3,).
    """
    rays, ok = model.camera.lens.rays(seen.pixels)
    origin = np.broadcast_to(np.asarray(model.camera.position), seen.points.shape).copy()
    direction = np.where(ok[:, None], rays, np.nan) @ np.asarray(model.camera.R_pc).T
    if model.refractive and not seen.dry.all():  # what is dry is seen straight from the camera
        water = back_project(model.camera, model.interface, seen.pixels[~seen.dry])
        origin[~seen.dry], direction[~seen.dry] = water.origin, water.direction
    with np.errstate(all="ignore"):
        length = ((seen.points - origin) @ normal) / (direction @ normal)
    return np.asarray(origin + length[:, None] * direction - seen.points)
