"""Drag as the average over its models (linear, quadratic, both), weighted by their evidence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from finssim.identification.confidence import Confidence, Stage
from finssim.identification.parameters import DETERMINED, PLACES, USUAL_SPEED, Parameters
from finssim.identification.shooting import Shooting, solve
from finssim.identification.uncertainty import Covariance
from finssim.trials.free_motion import DETERMINED_BY
from finssim.vehicles import AXES, Vehicle

Array = NDArray[np.float64]


SHAPES = {"linear": 0.1, "quadratic": 0.45, "both": 0.45}
"""Prior probability of the drag models: at the Reynolds numbers of vehicles, above 10⁴, drag is rarely linear."""

SIZE_STD = 1.5
"""Standard deviation of quadratic drag, relative to that of a box of the vehicle's size (drag coefficient 1)."""

NARROW = 2.0
"""Ratio of the speeds of segments below which they determine the drag at one speed, but not its model."""

WIDER = 2.5
"""Factor on the standard deviations of the intervals in that case."""

WHITE = np.linspace(-5.0, 5.0, 61)
"""Grid of the densities, in standard deviations."""


class DragShape(NamedTuple):
    """Drag of an axis, averaged over its models."""

    value: Array
    """d1 and d2 in their units, (2,)."""
    ends: list[tuple[float, float]]
    """95 % intervals of d1 and d2 in their units."""
    weights: dict[str, float]
    """Probability of each model [-]."""
    spread: float = np.inf
    """Standard deviation of the drag at the top speed, at the estimated thrust [N, N m]."""


def drag_of_size(vehicle: Vehicle, axis: str) -> float:
    """Return the quadratic drag of a bluff box of the vehicle's size, in the unit of d2."""
    i, size = AXES.index(axis), np.asarray(vehicle.body.size, float)
    others = np.delete(size, i % 3)
    area = np.prod(others) if i < 3 else size[i - 3] * np.sum(others**4) / 32.0
    return 0.5 * vehicle.water.density * float(area)


def levels_of(problem: Shooting, axis: str) -> list[float]:
    """Return the speeds that segments of the trials reach on an axis, for segments that excite it [m/s, rad/s]."""
    i, tops = AXES.index(axis), []
    for s in problem.segments:
        own = s.measured.get(DETERMINED_BY[axis][0])
        values = np.abs(s.held[:, i]) if s.held is not None and np.isfinite(s.held[:, i]).all() else None
        values = np.abs(own[1]) if own is not None and values is None else values
        if values is not None and len(values):
            tops.append(float(np.percentile(values, 95.0)))
    return [top for top in tops if top > 0.2 * max(tops)]


def drag_shape(stage: Stage, axis: str, size: float, levels: Sequence[float]) -> DragShape:
    """Return the average over linear and quadratic drag and both, weighted by evidence, at the estimated thrust.

    Args:
        stage: Fit with both terms.
        axis: Name of the axis.
        size: Quadratic drag expected from the size of the vehicle, in the unit of d2.
        levels: Speeds of the segments [m/s, rad/s]; if their range is below `NARROW`, the intervals are widened.
    """
    from scipy.stats import norm, t

    C, names = stage.found.covariance, stage.problem.parameters.names
    at, common = (
        [names.index(n) for n in some if n in names] for some in ((f"{axis}.d1", f"{axis}.d2"), COMMON)
    )
    S, whole = (matrix[np.ix_(at, at)] for matrix in (_given(C, at, common), _given(C, at, [])))
    if not np.isfinite(S).all() or np.linalg.det(S) <= 0.0:
        return DragShape(stage.x[at], [(-np.inf, np.inf)] * 2, dict(SHAPES))
    factor = float(t.ppf(0.975, min(float(np.min(C.dof[at])), 1e6)) / norm.ppf(0.975))
    x, mean = stage.x[at], stage.x[at].copy()
    for j in np.flatnonzero(x <= stage.problem.low[at]):
        # Without the bound the term would be lower, and the other one would change with it by their correlation.
        lower = np.clip(stage.found.free[at][j] - x[j], -4.0 * np.sqrt(S[j, j]), 0.0)
        mean += S[:, j] / S[j, j] * lower
    top = max(levels, default=1.0)
    value, _, weights, spread = _average(mean, S * factor**2, size, top)
    known = float(np.sqrt(S[1, 1])) < DETERMINED * SIZE_STD * size
    file = float(stage.problem.parameters.expected[at[1]])
    # If slow trials do not determine d2, it is kept from the file, with the corresponding d1.
    if not (known or stage.problem.parameters.likely) and file > 0.0:
        value = np.array([max(mean[0] + S[0, 1] / S[1, 1] * (file - mean[1]), 0.0), file])
    if known and x[0] <= stage.problem.low[at[0]]:
        value = x  # the trials indicate purely quadratic drag; the intervals include linear drag
    wide = factor * (WIDER if top < NARROW * min(levels, default=top) else 1.0)
    ends = _average(mean, S * wide**2, size, top)[1]
    # Contribution of the thrust and its lever arm to the joint spread of both terms.
    more = 1.96 * factor * np.sqrt(np.maximum(np.diagonal(whole - S), 0.0))
    pairs = [
        (max(v - np.hypot(v - a, m), 0.0), v + np.hypot(b - v, m))
        for v, (a, b), m in zip(value, ends, more, strict=True)
    ]
    return DragShape(value, [(float(a), float(b)) for a, b in pairs], weights, spread)


COMMON = ("thrust_scale", *PLACES)
"""Coordinates that scale all drag terms."""


def _given(C: Covariance, at: Sequence[int], known: Sequence[int]) -> Array:
    """Return the covariance (P, P) conditional on some coordinates, in the units of theta."""
    local, trials = (float(np.linalg.det(matrix[np.ix_(at, at)])) for matrix in (C.local, C.trials))
    matrix = C.trials if trials > local and not C.alone[at].any() else C.local
    if not known or not np.isfinite(matrix[np.ix_(known, known)]).all():
        return matrix
    scale = np.sqrt(np.diagonal(matrix)[known])
    inner = matrix[np.ix_(known, known)] / np.outer(scale, scale)
    side = matrix[:, known] / scale
    return np.asarray(matrix - side @ np.linalg.pinv(inner, rcond=1e-8) @ side.T)


def _average(
    mean: Array, S: Array, size: float, top: float
) -> tuple[Array, list[tuple[float, float]], dict[str, float], float]:
    """Return mean and 95 % intervals of d1 and d2 over the models, the probability of each model, and the
    standard deviation of the drag at the top speed.

    Args:
        mean: Mean of the likelihood of d1 and d2, in their units, (2,).
        S: Covariance of the likelihood, (2, 2).
        size: Quadratic drag expected from the size of the vehicle, in the unit of d2.
        top: Speed up to which linear drag is not expected to exceed quadratic drag [m/s, rad/s].
    """
    from scipy.stats import norm

    prior = norm(0.0, size * max(top, 2.0 * USUAL_SPEED)), norm(size, SIZE_STD * size)
    share = 2.0, 1.0 / norm.cdf(1.0 / SIZE_STD)  # of densities truncated to non-negative values
    root = np.linalg.cholesky(S)
    white = np.stack(np.meshgrid(WHITE, WHITE, indexing="ij"), axis=-1).reshape(-1, 2)
    parts = {"both": (mean + white @ root.T, np.abs(np.linalg.det(root)) * (WHITE[1] - WHITE[0]) ** 2)}
    for j, name in enumerate(("linear", "quadratic")):
        k = 1 - j
        centre, std = mean[j] - S[j, k] / S[k, k] * mean[k], float(np.sqrt(S[j, j] - S[j, k] ** 2 / S[k, k]))
        grid = np.zeros((len(WHITE), 2))
        grid[:, j] = centre + std * WHITE
        parts[name] = grid, std * (WHITE[1] - WHITE[0])
    inverse, logs = np.linalg.inv(S), {}
    for name, (grid, cell) in parts.items():
        off = grid - mean
        log = np.log(SHAPES[name] * cell) - 0.5 * np.einsum("ni,ij,nj->n", off, inverse, off)
        for j, absent in enumerate(("quadratic", "linear")):
            if name != absent:
                log = log + np.where(
                    grid[:, j] >= 0.0, prior[j].logpdf(grid[:, j]) + np.log(share[j]), -np.inf
                )
        logs[name] = log
    highest = max(float(log.max()) for log in logs.values())
    density = {name: np.exp(log - highest) for name, log in logs.items()}
    weights = {name: float(w.sum()) for name, w in density.items()}
    total = sum(weights.values())
    grid = np.concatenate([g for g, _ in parts.values()])
    density_of = np.concatenate([density[n] for n in parts]) / total
    ends = []
    for j in range(2):  # a term is never known to be absent: the intervals include those of both terms
        some = [_quantiles(grid[:, j], density_of)]
        if weights["both"] > 0.0:
            some.append(_quantiles(parts["both"][0][:, j], density["both"] / weights["both"]))
        ends.append((min(low for low, _ in some), max(high for _, high in some)))
    drag, value = grid @ [1.0, top] * top, density_of @ grid
    spread = float(np.sqrt(density_of @ (drag - density_of @ drag) ** 2))
    return value, ends, {name: w / total for name, w in weights.items()}, spread


def _quantiles(values: Array, weight: Array) -> tuple[float, float]:
    """Return the 2.5 % and 97.5 % quantiles of weighted values in their unit; weights sum to 1."""
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weight[order])
    low, high = np.searchsorted(total, (0.025, 0.975 - 1e-12))
    return float(values[order[low]]), float(values[order[min(high, len(order) - 1)]])


def averaged(stage: Stage, shapes: Mapping[str, DragShape]) -> Stage:
    """Return a fit with the drag averaged over models, and the other numbers re-optimised for it.

    Their intervals cover both solutions: the effect of the drag model is part of their uncertainty.
    """
    if not shapes:
        return stage
    problem, solution = stage.problem, stage.solution
    value = {
        f"{axis}.{n}": v
        for axis, shape in shapes.items()
        for n, v in zip(("d1", "d2"), shape.value, strict=True)
    }
    at, theta = [problem.names.index(name) for name in value], solution.point.theta.copy()
    theta[at] = list(value.values())
    kept = problem.low, problem.high
    problem.low, problem.high = kept[0].copy(), kept[1].copy()
    problem.low[at] = problem.high[at] = theta[at]
    polish = RELEASED_POLISH if problem.released else POLISH
    end = solve(problem, solution.point._replace(theta=theta), iterations=polish, std=solution.std)
    problem.low, problem.high = kept
    if not np.isfinite(end.cost):
        return stage
    shift = end.point.theta - solution.point.theta
    reach = np.stack([np.minimum(shift, 0.0), np.maximum(shift, 0.0)], axis=-1)
    found = stage.found._replace(free=stage.found.free + shift, interval=stage.found.interval + reach)
    return Stage(problem, replace(end, converged=solution.converged, step=solution.step), found)


POLISH, RELEASED_POLISH = 1, 3
"""Iterations in which the other numbers are re-optimised, with thrust and without: without, they are strongly
correlated."""


USEFUL_DRAG = 0.5
"""Relative half width of the interval of a damping force up to which it is written: still better than a guess."""


def is_drag_known(
    p: Parameters, x: Array, found: Confidence, axis: str, speed: float, shape: DragShape | None
) -> bool:
    """Return whether the drag at one speed [m/s, rad/s] is known to `USEFUL_DRAG`, or excludes the vehicle
    file's value.

    x is the solution of the fit, in the units of the coordinates, (P,).
    """
    i, names = AXES.index(axis), [f"{axis}.{name}" for name in ("d1", "d2")]
    at = [p.names.index(name) for name in names if name in p.names]
    powers = np.array([speed, speed**2])
    slope = powers[np.isin(names, p.names)]
    before = np.array([p.set.linear_damping[i][i], p.set.quadratic_damping[i][i]], float)
    force = float(slope @ x[at])
    if p.likely:  # relative to the thrust, whose scale is also written to the file
        scale = p.names.index("thrust_scale")
        at, slope = [*at, scale], np.append(slope, -force / x[scale])
    half = 2.0 * (np.sqrt(np.maximum(found.variance(slope, at), 0.0)) if shape is None else shape.spread)
    known = half < USEFUL_DRAG * force or abs(powers @ before - force) > half
    return bool(np.isfinite(half) and force > 0.0 and known)
