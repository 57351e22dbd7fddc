"""Least squares for camera and plane: Levenberg-Marquardt with analytic derivatives, robust where asked.

A plane cannot pass a point in the water nor the camera. A step that would lead there slides along this bound.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from finssim.calibration.vision.pool.observations import Observations
from finssim.calibration.vision.pool.pool_model import NAMES, PoolModel

__all__ = ["LOST", "Prior", "Solution", "clearances", "residuals", "solve"]

Array = NDArray[np.float64]

LOST = 500.0
"""Residual that stands for a point the model cannot see at all [px]."""

NEARER = 0.1
"""Part of its distance from a point or the camera that one step must leave the plane."""

MOST_BOUNDS = 60
"""Points looked at in one step, those that the plane comes nearest to."""

Whitening = Callable[[Array], Array]


@dataclass(frozen=True, kw_only=True)
class Prior:
    """What is known beforehand: Gaussian, each standard deviation infinite where nothing is."""

    normal: Array | None = None
    """Into the camera's side, (3,)."""
    tilt_std: float = np.inf
    """[rad]"""
    depth: float = np.nan
    """Distance of the plane from the reference point [m]."""
    depth_std: float = np.inf
    start: PoolModel
    """Holds index and lens that `index_std` and `lens_std` are about."""
    index_std: float = np.inf
    lens_std: tuple[float, ...] = (np.inf,) * 8
    """Of log focal, centre [px], distortion."""

    def rows(self, model: PoolModel) -> tuple[Array, Array]:
        """Residuals (M,) of the priors, each over its standard deviation, and their derivatives (M, 18)."""
        r: list[float] = []
        J: list[Array] = []

        def add(residual: float, std: float, columns: dict[int, float]) -> None:
            if np.isfinite(std) and std > 0.0:
                row = np.zeros(len(NAMES))
                for k, value in columns.items():
                    row[k] = value / std
                r.append(residual / std)
                J.append(row)

        if self.normal is not None:
            for e in self._tangents():
                along = model.tangents @ e
                add(float(model.interface.normal @ e), self.tilt_std, {6: along[0], 7: along[1]})
        if np.isfinite(self.depth):
            add(model.depth - self.depth, self.depth_std, {8: 1.0})
        add(model.interface.index_far - self.start.interface.index_far, self.index_std, {9: 1.0})
        for k, (now, before) in enumerate(zip(lens_values(model), lens_values(self.start), strict=True)):
            add(now - before, self.lens_std[k], {10 + k: 1.0})
        return np.array(r), np.array(J).reshape(-1, len(NAMES))

    def _tangents(self) -> Array:
        assert self.normal is not None
        axis = np.eye(3)[int(np.argmin(np.abs(self.normal)))]
        e1 = np.cross(self.normal, axis)
        e1 /= np.linalg.norm(e1)
        return np.stack([e1, np.cross(self.normal, e1)])


@dataclass(frozen=True)
class Solution:
    """Where the search ended."""

    model: PoolModel
    cost: float
    """Half the sum of squares of whitened residuals and priors."""
    iterations: int
    converged: bool


def lens_values(model: PoolModel) -> list[float]:
    """Log focal length, centre and five coefficients of distortion of the model's lens."""
    lens = model.camera.lens
    terms = (*lens.distortion, *([0.0] * 5))[:5]
    return [float(np.log(lens.fx)), lens.cx, lens.cy, *terms]


def residuals(model: PoolModel, seen: Observations) -> tuple[Array, NDArray[np.bool_]]:
    """Measured minus predicted pixel (N, 2), and where there is one (N,); `LOST` elsewhere."""
    r = seen.pixels - model.predict(seen.points, seen.dry)
    ok = np.isfinite(r).all(axis=1)
    return np.where(ok[:, None], r, LOST), ok


def solve(
    start: PoolModel,
    seen: Observations,
    whiten: Whitening,
    active: NDArray[np.bool_],
    prior: Prior,
    *,
    iterations: int = 60,
    tolerance: float = 1e-9,
) -> Solution:
    """Minimise |whiten(measured - predicted)|² plus the priors.

    Args:
        start: Where to begin.
        seen: The rows.
        whiten: Turns residuals (N, 2) and derivatives (N, 2, P) into independent rows of unit variance.
        active: Which of `NAMES` move, (18,).
        prior: Of those and of the others.
        iterations: At most.
        tolerance: Relative change of the cost at which the search ends.
    """
    model = start
    cost = _cost(model, seen, whiten, prior)
    damping, free = 1e-3, np.flatnonzero(active)
    for iteration in range(iterations):
        N, g = normal_equations(model, seen, whiten, free, prior)
        bounds = _bounds(model, seen, free)
        scale = np.sqrt(np.maximum(np.diagonal(N), 1e-300))
        H, b = N / np.outer(scale, scale), g / scale
        while True:
            step = np.zeros(len(NAMES))
            step[free] = _sliding(H + damping * np.eye(len(free)), b, scale, bounds) / scale
            trial = _tried(model, step, seen, 8 in free)
            new = np.inf if trial is None else _cost(trial, seen, whiten, prior)
            if new <= cost:
                break
            damping *= 4.0
            if damping > 1e10:
                return Solution(model, cost, iteration, True)
        assert trial is not None
        gain, model, cost = cost - new, trial, new
        damping = max(damping / 6.0, 1e-12)
        if gain <= tolerance * max(cost, 1e-12) and damping < 1.0:
            return Solution(model, cost, iteration + 1, True)
    return Solution(model, cost, iterations, False)


def normal_equations(
    model: PoolModel, seen: Observations, whiten: Whitening, free: NDArray[np.intp], prior: Prior
) -> tuple[Array, Array]:
    """Information (P, P) and gradient (P,) at a model, by the parameters `free`, priors included."""
    r, ok = residuals(model, seen)
    J = model.jacobians(seen.points, seen.dry)[0][..., free]
    J = np.where((ok & np.isfinite(J).all(axis=(1, 2)))[:, None, None], J, 0.0)
    A, e = whiten(J), whiten(r)
    r_prior, J_prior = prior.rows(model)
    J_prior = J_prior[:, free]
    return A.T @ A + J_prior.T @ J_prior, A.T @ e - J_prior.T @ r_prior


def _cost(model: PoolModel, seen: Observations, whiten: Whitening, prior: Prior) -> float:
    if model.refractive and (model.clearance <= 0.0 or not 1.0 < model.interface.index_far < 3.0):
        return np.inf
    e = whiten(residuals(model, seen)[0])
    r = prior.rows(model)[0]
    return 0.5 * float(e @ e + r @ r)


def clearances(model: PoolModel, points: Array) -> Array:
    """Distances of points from the far side of the plane and its window, on their own side positive, (N,) [m]."""
    return model.depth - (points - model.reference) @ model.interface.normal - model.interface.thickness


def _bounds(model: PoolModel, seen: Observations, free: NDArray[np.intp]) -> tuple[Array, Array]:
    """Clearances of the points in the water and of the camera (M,), and their derivatives by the parameters (M, P)."""
    if not model.refractive:
        return np.zeros(0), np.zeros((0, len(free)))
    wet, n = seen.points[~seen.dry], model.interface.normal
    distance = clearances(model, wet)
    wet, distance = wet[distance > 0.0], distance[distance > 0.0]
    rows = np.zeros((len(wet) + 1, len(NAMES)))
    rows[:-1, 6:8] = -(wet - model.reference) @ model.tangents.T
    rows[:-1, 8] = 1.0
    rows[-1, :3] = n
    rows[-1, 6:8] = model.tangents @ (model.camera.position - model.reference)
    rows[-1, 8] = -1.0
    return np.append(distance, model.clearance), rows[:, free]


def _sliding(H: Array, b: Array, scale: Array, bounds: tuple[Array, Array]) -> Array:
    """The least of x H x / 2 - b x among steps that leave every clearance a tenth of what it is.

    A problem of least distance, solved by non-negative least squares (Lawson and Hanson, Solving Least Squares
    Problems, ch. 23).
    """
    x = np.linalg.solve(H, b)
    distance, rows = bounds
    left = distance + (rows / scale) @ x
    if np.all(left >= NEARER * distance):
        return x
    near = np.argsort(left / np.maximum(distance, 1e-300))[:MOST_BOUNDS]
    values, vectors = np.linalg.eigh(H)
    root = vectors / np.sqrt(np.maximum(values, 1e-14))
    G = (rows[near] / scale) @ root
    length = np.maximum(np.linalg.norm(G, axis=1), 1e-300)
    h = (NEARER * distance[near] - left[near]) / length
    size = float(np.abs(h).max())
    E = np.concatenate([(G / length[:, None]).T, h[None] / size])
    try:
        weight, off = nnls(E, np.append(np.zeros(len(x)), 1.0))
    except RuntimeError:
        return x
    r = E @ weight - np.append(np.zeros(len(x)), 1.0)
    return x if off < 1e-9 else np.asarray(x - root @ r[:-1] / r[-1] * size)


def _tried(model: PoolModel, step: Array, seen: Observations, movable: bool) -> PoolModel | None:
    """The model a step away, or None where the step leads out of all sense.

    What a turn of the plane takes from a clearance beyond first order is given back by its depth where that may move.
    """
    if not np.isfinite(step).all() or np.abs(step[3:8]).max() > 1.0 or abs(step[10]) > 0.5:
        return None
    try:
        trial = model.moved(step)
        if model.refractive and movable:
            before = clearances(model, seen.points)
            held = (before > 0.0) & ~seen.dry
            short = 0.5 * NEARER * before - clearances(trial, seen.points)
            if held.any() and (back := float(short[held].max())) > 0.0:
                trial = model.moved(step + back * (np.arange(len(NAMES)) == 8))
        return trial
    except ValueError:
        return None
