"""A rough start where no regression gives one: an evolution strategy whose population are parallel worlds."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

__all__ = ["coarse_search", "evolve"]

Array = NDArray[np.float64]

FINE = 0.02
"""Part of a coordinate's size around its bound where steps are linear; beyond, they are logarithmic."""


def evolve(
    cost: Callable[[Array], Array],
    start: Array,
    *,
    sigma: float,
    population: int,
    generations: int,
    seed: int,
    tolerance: float = 1e-3,
) -> tuple[Array, float]:
    """Minimise by covariance matrix adaptation                                         (Hansen 2016, CMA-ES tutorial).

    Args:
        cost: Of many points at once, (n, P) -> (n,); infinite where a point has none.
        start: First mean, (P,).
        sigma: First standard deviation.
        population: Points in a generation.
        generations: At most.
        seed: Of the draws.
        tolerance: Standard deviation below which it stops.

    Returns:
        The best point seen, and its cost.
    """
    rng, n = np.random.default_rng(seed), len(start)
    mu = population // 2
    weights = np.log(mu + 0.5) - np.log(np.arange(1, mu + 1))
    weights /= weights.sum()
    mass = 1.0 / float(np.square(weights).sum())
    c_path = (mass + 2.0) / (n + mass + 5.0)
    damping = 1.0 + 2.0 * max(0.0, np.sqrt((mass - 1.0) / (n + 1.0)) - 1.0) + c_path
    c_cum = (4.0 + mass / n) / (n + 4.0 + 2.0 * mass / n)
    c_one = 2.0 / ((n + 1.3) ** 2 + mass)
    c_mu = min(1.0 - c_one, 2.0 * (mass - 2.0 + 1.0 / mass) / ((n + 2.0) ** 2 + mass))
    expected = np.sqrt(n) * (1.0 - 1.0 / (4.0 * n) + 1.0 / (21.0 * n * n))

    mean, C, path_s, path_c = np.array(start, float), np.eye(n), np.zeros(n), np.zeros(n)
    best, lowest = mean.copy(), float(cost(mean[None])[0])
    for generation in range(generations):
        values, vectors = np.linalg.eigh(C)
        root = np.sqrt(np.maximum(values, 1e-20))
        steps = (rng.standard_normal((population, n)) * root) @ vectors.T
        costs = cost(mean + sigma * steps)
        order = np.argsort(costs)
        if costs[order[0]] < lowest:
            best, lowest = mean + sigma * steps[order[0]], float(costs[order[0]])
        chosen = steps[order[:mu]]
        shift = weights @ chosen
        mean = mean + sigma * shift
        path_s = (1.0 - c_path) * path_s
        path_s += np.sqrt(c_path * (2.0 - c_path) * mass) * (vectors @ ((vectors.T @ shift) / root))
        length = float(np.linalg.norm(path_s))
        steady = (
            length / np.sqrt(1.0 - (1.0 - c_path) ** (2 * generation + 2))
            < (1.4 + 2.0 / (n + 1.0)) * expected
        )
        path_c = (1.0 - c_cum) * path_c
        if steady:
            path_c += np.sqrt(c_cum * (2.0 - c_cum) * mass) * shift
        C = (1.0 - c_one - c_mu) * C + c_one * np.outer(path_c, path_c) + c_mu * (chosen.T * weights) @ chosen
        C = 0.5 * (C + C.T)
        sigma *= float(np.exp(c_path / damping * (length / expected - 1.0)))
        if sigma * root.max() < tolerance:
            break
    return best, lowest


def coarse_search(
    cost: Callable[[Array], Array],
    start: Array,
    low: Array,
    high: Array,
    scale: Array,
    *,
    population: int = 48,
    generations: int = 25,
    seed: int = 0,
) -> tuple[Array, float]:
    """Search a box over orders of magnitude.

    A coordinate with a lower bound is searched in y = log(1 + (x - low) / (FINE scale)), the others in x / scale.

    Args:
        cost: Of many points at once, (n, P) -> (n,).
        start: Where to begin, (P,).
        low: Lower bounds, -inf where none, (P,).
        high: Upper bounds, (P,).
        scale: Sizes of the coordinates, (P,).
        population: Points in a generation.
        generations: At most.
        seed: Of the draws.

    Returns:
        The best point seen, and its cost.
    """
    bounded = np.isfinite(low)
    unit = FINE * scale
    base = np.where(bounded, low, 0.0)

    def inside(y: Array) -> Array:
        grown = base + unit * np.expm1(np.clip(y, -50.0, 50.0))
        return np.clip(np.where(bounded, grown, y * scale), low, high)

    y = np.where(bounded, np.log1p(np.maximum(start - base, 0.0) / unit), start / scale)
    best, lowest = evolve(
        lambda points: cost(inside(points)),
        y,
        sigma=0.7,
        population=population,
        generations=generations,
        seed=seed,
        tolerance=0.03,
    )
    return inside(best), lowest
