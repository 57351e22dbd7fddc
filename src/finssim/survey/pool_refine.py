"""Fit of camera and plane with estimated errors of pixels and survey and without outliers; errors at held-out
points."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.stats import chi2

from finssim.core.least_squares import rms, unit_diagonal
from finssim.core.optics import back_project
from finssim.survey.points import Observations
from finssim.survey.pool_model import NAMES, PoolModel, Prior, normal_equations, residuals, solve
from finssim.survey.pool_search import RobustPixels
from finssim.trials.findings import CalibrationError

Array = NDArray[np.float64]

LEAST_PIXEL = 0.02
"""Smallest estimated standard error of a pixel [px]: no corner is detected more accurately."""

NOISE_ROWS = 2000
"""Greatest number of rows from which the standard errors are estimated."""

STATED_SURVEY = 0.35
"""Prior standard deviation of the logarithm of the survey's error: the stated error is right within about a third."""

STATED_PIXEL, USUAL_PIXEL = 1.2, 0.4
"""Prior standard deviation of the logarithm of a pixel's error, and its usual size [px]."""


@dataclass(frozen=True, kw_only=True)
class StandardErrors:
    """Standard errors of pixels and survey."""

    pixel: float
    """Standard error of each image coordinate [px]."""
    survey: float = 0.002
    """Standard error of each coordinate of a location, unless the survey states it [m]."""
    survey_yaw: float = 0.0087
    """Standard error of a tag's heading [rad]."""
    scale: float = 1.0
    """Factor on all survey errors, estimated from the residuals [-]."""

    def survey_modes(self, J_point: Array, observed: Observations) -> Array:
        """Return the change of pixels by one standard error of a location's x, y, z and of a tag's rotation
        [px], (N, 2, 4).

        Args:
            J_point: Derivative of the pixel by the point, (N, 2, 3).
            observed: The rows.
        """
        sigma = np.where(np.isfinite(observed.sigma), observed.sigma, self.survey)[:, None, None]
        turn = self.survey_yaw * np.einsum("nij,nj->ni", J_point, observed.arm)[..., None]
        return np.asarray(self.scale * np.concatenate([J_point * sigma, turn], axis=-1))


class Whitener:
    """Whitening of residuals: makes them independent and of unit variance; rows of one location are correlated.

    V_l = sigma² 1 + J_l B_l S B_lᵀ J_lᵀ: the survey's error displaces a complete location, and rotates a tag.
    """

    def __init__(self, J_point: Array, observed: Observations, noise: StandardErrors) -> None:
        """
        Args:
            J_point: Derivative of the pixel by the point, (N, 2, 3).
            observed: The rows.
            noise: Standard errors.
        """
        modes = noise.survey_modes(J_point, observed)
        self.logdet = 0.0
        self._groups: list[tuple[NDArray[np.intp], Array]] = []
        order = np.argsort(observed.location, kind="stable")
        _, starts, counts = np.unique(observed.location[order], return_index=True, return_counts=True)
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
        """Return whitened rows of values (N, 2) or (N, 2, P), as (2N,) or (2N, P), in sequence of the locations."""
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
    observed: Observations,
    noise: StandardErrors,
    prior: Array,
    *,
    fixed_pixel: bool,
) -> StandardErrors:
    """Return the most likely standard errors of pixels and survey (restricted likelihood, which accounts for
    fitted parameters).

    Args:
        residual: Measured minus predicted [px], (N, 2).
        J: Derivative of the prediction in pixels by the fitted parameters, per unit of these, (N, 2, P).
        J_point: Derivative of the prediction by the point [px/m], (N, 2, 3).
        observed: The rows.
        noise: Prior standard errors.
        prior: Information of the priors on the parameters, per unit of these squared, (P, P).
        fixed_pixel: True if the pixel's error is given and not estimated.
    """
    if len(observed) > NOISE_ROWS:  # enough for two parameters; complete locations, evenly
        every = int(np.ceil(len(observed) / NOISE_ROWS))
        rows = np.flatnonzero(observed.location % every == 0)
        if len(rows) > NOISE_ROWS // 4:
            residual, J, J_point, observed = residual[rows], J[rows], J_point[rows], observed.subset(rows)

    def at(x: Array) -> StandardErrors:
        pixel = noise.pixel if fixed_pixel else max(LEAST_PIXEL, math.exp(x[1]))
        return replace(noise, pixel=pixel, scale=math.exp(x[0]))

    def cost(x: Array) -> float:
        if np.abs(x).max() > 12.0:
            return 1e12
        whiten = Whitener(J_point, observed, at(x))
        r, A = whiten(residual), whiten(J)
        N = A.T @ A + prior
        scaled, scale = unit_diagonal(N)
        logdet = float(np.linalg.slogdet(scaled)[1]) + 2.0 * float(np.log(scale).sum())
        g = A.T @ r
        chi2 = float(r @ r) - float(g @ np.linalg.lstsq(N, g, rcond=None)[0])
        usual = (x[0] / STATED_SURVEY) ** 2
        if not fixed_pixel:
            usual += ((x[1] - math.log(USUAL_PIXEL)) / STATED_PIXEL) ** 2
        return chi2 + whiten.logdet + logdet + usual

    start = [0.0, math.log(max(noise.pixel, LEAST_PIXEL))][: 1 if fixed_pixel else 2]
    solution = minimize(
        cost, np.array(start), method="Nelder-Mead", options={"xatol": 0.01, "fatol": 0.01, "maxiter": 120}
    )
    return at(solution.x)


CHANCE = 0.02
"""Probability that any correct row of a survey is classified as an outlier."""

MAX_WRONG = 0.4
"""Fraction of outliers above which the fit is refused."""

ROUNDS = 6


@dataclass(frozen=True)
class Refined:
    """Fit with its noise, outliers and covariance."""

    model: PoolModel
    noise: StandardErrors
    used: NDArray[np.bool_]
    """Mask of rows that are not outliers, (N,)."""
    whiten: Whitener
    """Whitening of the rows used."""
    active: NDArray[np.bool_]
    """Mask of the fitted parameters, (18,)."""
    prior: Prior
    covariance: Array
    """Covariance of all parameters in their units, zero if fixed, (18, 18)."""
    cost: float
    """Minimized half sum of squares [-]."""
    dof: float
    """Degrees of freedom: number of residuals minus that of parameters."""


def refine(
    model: PoolModel,
    observed: Observations,
    active: NDArray[np.bool_],
    prior: Prior,
    noise: StandardErrors,
    *,
    fixed_pixel: bool = False,
) -> Refined:
    """Fit with estimated errors of pixels and survey, and detection of outliers.

    Args:
        model: Model from the search.
        observed: All rows.
        active: Mask of parameters to fit, (18,).
        prior: Prior of the parameters.
        noise: Prior standard errors.
        fixed_pixel: True if the pixel's error is given and not estimated.

    Raises:
        CalibrationError: Too many rows do not fit.
    """
    robust = RobustPixels(model, observed)
    model = solve(model, observed, robust, active, prior, iterations=40).model
    robust = RobustPixels(model, observed, least=0.05)
    model = solve(model, observed, robust, active, prior, iterations=40).model
    if not fixed_pixel:
        size = np.linalg.norm(residuals(model, observed)[0], axis=1)
        noise = replace(noise, pixel=max(0.05, float(np.median(size)) / 1.1774))
    used = _plausible(model, observed, noise)
    free = np.flatnonzero(active)
    for _ in range(ROUNDS):
        _refuse_few(used, observed, int(active.sum()))
        rows = observed.subset(used)
        J, J_point = model.jacobians(rows.points, rows.dry)
        J_prior = prior.rows(model)[1][:, free]
        off, information = residuals(model, rows)[0], J_prior.T @ J_prior
        noise = estimate_noise(off, J[..., free], J_point, rows, noise, information, fixed_pixel=fixed_pixel)
        whiten = Whitener(J_point, rows, noise)
        (model, cost), before = solve(model, rows, whiten, active, prior), used
        used = _plausible(model, observed, noise)
        if np.array_equal(used, before):
            break
    covariance = _covariance(model, rows, whiten, free, prior)
    dof = max(3.0, 2.0 * len(rows) - len(free))
    return Refined(model, noise, before, whiten, active, prior, covariance, cost, dof)


def _plausible(model: PoolModel, observed: Observations, noise: StandardErrors) -> NDArray[np.bool_]:
    """Return a mask of rows whose residual is consistent with the errors of pixel and survey, correlations ignored."""
    d2 = squared_distance(model, observed, noise)
    inner = max(1.0, float(np.median(d2)) / float(chi2.ppf(0.5, 2)))
    return np.asarray(d2 < inner * chi2.ppf(1.0 - CHANCE / len(observed), 2))


def squared_distance(
    model: PoolModel, observed: Observations, noise: StandardErrors, covariance: Array | None = None
) -> Array:
    """Return squared residuals over their variance by errors of pixel and survey [-], (N,); infinite without
    residual.

    Args:
        model: Model that predicts the pixels.
        observed: The rows.
        noise: Standard errors.
        covariance: Covariance of the model's parameters in their units, to include their errors, (18, 18).
    """
    r, ok = residuals(model, observed)
    J, J_point = (
        np.where(ok[:, None, None], part, 0.0) for part in model.jacobians(observed.points, observed.dry)
    )
    modes = noise.survey_modes(J_point, observed)
    V = modes @ modes.transpose(0, 2, 1) + noise.pixel**2 * np.eye(2)
    if covariance is not None:
        V = V + J @ covariance @ J.transpose(0, 2, 1)
    return np.where(ok, np.einsum("ni,nij,nj->n", r, np.linalg.inv(V), r), np.inf)


def _refuse_few(used: NDArray[np.bool_], observed: Observations, parameters: int) -> None:
    wrong = len(observed) - int(used.sum())
    if wrong > MAX_WRONG * len(observed):
        raise CalibrationError(
            f"{wrong} of {len(observed)} points do not fit any one camera and plane: check that ids, units and the "
            "camera file belong together, and that the camera did not move"
        )
    if 2 * int(used.sum()) < 6:
        raise CalibrationError(
            f"{int(used.sum())} usable points for {parameters} parameters: survey at least 4, better 20"
        )


def _covariance(
    model: PoolModel, rows: Observations, whiten: Whitener, free: NDArray[np.intp], prior: Prior
) -> Array:
    """Return the inverse information, in the order of `NAMES`; a very large variance for undetermined directions."""
    N, _ = normal_equations(model, rows, whiten, free, prior)
    scaled, scale = unit_diagonal(N)
    values, vectors = np.linalg.eigh(scaled)
    half = vectors / np.sqrt(np.maximum(values, 1e-14)) / scale[:, None]
    covariance = np.zeros((len(NAMES), len(NAMES)))
    covariance[np.ix_(free, free)] = half @ half.T
    return covariance


FEW = 4
"""Number of locations below which single rows are held out instead: one or two targets cannot be divided."""


@dataclass(frozen=True)
class HeldOut:
    """Errors of K rows, each from a fit without its location."""

    pixels: Array
    """Measured minus predicted pixels [px], (K, 2)."""
    points: Array
    """Back-projected minus surveyed points, in the plane of the point [m], (K, 3)."""
    rows: NDArray[np.intp]
    """Indices of the observations, (K,)."""
    folds: int

    def as_json(self) -> dict[str, float | int | None]:
        """Return root mean squares and 95th percentiles, including the error of the survey. Units are in the names."""
        size = np.linalg.norm(self.points, axis=1)
        size = size[np.isfinite(size)]
        return {
            "folds": self.folds,
            "points": len(self.rows),
            "rms_px": rms(self.pixels),
            "rms_cm": 100.0 * rms(size[:, None]) if len(size) else None,
            "p95_cm": 100.0 * float(np.percentile(size, 95)) if len(size) else None,
        }


def held_out(fit: Refined, observed: Observations, folds: int, seed: int, normal: Array) -> HeldOut | None:
    """Refit without each fold of the locations in turn; return None if too few would remain.

    Args:
        fit: Fit to all rows; its outliers stay excluded.
        observed: All rows.
        folds: Number of folds, at most one for each location.
        seed: Seed of the folds.
        normal: Normal of the planes, one through each point, onto which pixels are back-projected: unit, pool
            frame [-], (3,).
    """
    used = np.flatnonzero(fit.used)
    group = observed.location if len(np.unique(observed.location[used])) >= FEW else np.arange(len(observed))
    names = np.unique(group[used])
    folds = min(folds, len(names))
    if folds < 2:
        return None
    fold = np.empty(int(group.max()) + 1, int)
    fold[np.random.default_rng(seed).permutation(names)] = np.arange(len(names)) % folds
    pixels, points, rows = [], [], []
    for k in range(folds):
        inside = np.zeros(len(observed), bool)
        inside[used] = fold[group[used]] != k
        outside = used[fold[group[used]] == k]
        if 2 * inside.sum() < 8 or len(np.unique(observed.points[inside].round(6), axis=0)) < 4:
            return None
        part = observed.subset(inside)  # the standard errors stay unchanged
        whiten = Whitener(fit.model.jacobians(part.points, part.dry)[1], part, fit.noise)
        model = solve(fit.model, part, whiten, fit.active, fit.prior).model
        here = observed.subset(outside)
        r, ok = residuals(model, here)
        rows.append(outside[ok])
        pixels.append(r[ok])
        points.append(error_vectors(model, here, normal)[ok])
    return HeldOut(np.concatenate(pixels), np.concatenate(points), np.concatenate(rows), folds)


def error_vectors(model: PoolModel, observed: Observations, normal: Array) -> Array:
    """Return where each pixel's ray meets the plane through its point, minus the point [m], (N, 3); NaN
    without one.

    Args:
        model: Camera and water.
        observed: Pixels and points.
        normal: Unit normal of the planes, pool frame [-], (3,).
    """
    rays, ok = model.camera.lens.rays(observed.pixels)
    origin = np.broadcast_to(np.asarray(model.camera.position), observed.points.shape).copy()
    direction = np.where(ok[:, None], rays, np.nan) @ np.asarray(model.camera.R_pc).T
    if model.refractive and not observed.dry.all():  # dry points are seen directly
        water = back_project(model.camera, model.interface, observed.pixels[~observed.dry])
        origin[~observed.dry], direction[~observed.dry] = water.origin, water.direction
    with np.errstate(all="ignore"):
        length = ((observed.points - origin) @ normal) / (direction @ normal)
    return np.asarray(origin + length[:, None] * direction - observed.points)
