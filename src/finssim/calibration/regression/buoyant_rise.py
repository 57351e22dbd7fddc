"""A vehicle let go under water: the terminal speed of its rise, and what the rise says of buoyancy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.regression.instruments import Run, simulate_axis
from finssim.calibration.trials.trial import Trial
from finssim.calibration.uncertainty import Evidence, correlated_samples, intervals, trial_covariance

__all__ = ["Rise", "buoyant_rise"]

Array = NDArray[np.float64]

RISING = 0.01
"""Vertical speed that counts as a rise [m/s] (published procedure)."""

SHORTEST = 3.0
"""[s]"""

STEP = 0.02
"""Of the simulation [s]."""


@dataclass(frozen=True, kw_only=True)
class Rise:
    """z_dot_dot = e - c1 z_dot, or e - c2 |z_dot| z_dot; z up."""

    trial: str
    begin: float
    """On the trial's clock [s]."""
    end: float
    quadratic: bool
    """Whether the drag is c2 (the better of the two; one rise cannot show both)."""
    terminal_speed: float
    """[m/s]"""
    terminal_ci95: tuple[float, float]
    excess_ratio: float
    """e = (B - W) / m_eff [m/s²]."""
    excess_ci95: tuple[float, float]
    """Wide where the rise was steady from the start, for then only the terminal speed is known."""
    t: Array
    z: Array
    """Fitted [m]."""
    measured: Array
    """[m]"""


def buoyant_rise(trial: Trial) -> Rise:
    """Fit the longest rise of a trial without thrust.

    Args:
        trial: With `z` or `depth`.

    Raises:
        CalibrationError: Neither was measured, or nothing rises for 3 s.
    """
    t, z = trial.series("z") if trial.has("z") else trial.series("depth")
    z = z if trial.has("z") else -z
    if len(t) < 20:
        raise CalibrationError(f"{trial.name}: neither z nor depth: nothing to see a rise in")
    begin, end = _longest_rise(t, z, trial.name)
    inside = (t >= begin) & (t <= end)
    t, z = t[inside], z[inside]
    fits = [_fit(t, z, quadratic) for quadratic in (False, True)]
    best = int(np.argmin([float(np.sum(r**2)) for _, r, _ in fits]))
    x, r, J = fits[best]
    correlated = correlated_samples(r)
    blocks = max(6, int(len(r) / (4.0 * correlated)))
    cut = np.array_split(np.arange(len(r)), min(blocks, 24))
    k = 2
    project = np.linalg.lstsq(J[:, k:], J[:, :k], rcond=1e-12)[0]
    own = J[:, :k] - J[:, k:] @ project
    variance = float(np.mean(r**2)) * correlated
    covariance = trial_covariance(
        Evidence(
            names=("ln_speed", "ln_excess"),
            normal=np.array([own[i].T @ own[i] for i in cut]) / variance,
            score=np.array([-own[i].T @ r[i] for i in cut]) / variance,
            unit="blocks",
        )
    )
    ends = np.exp(np.clip(intervals(x[:k], covariance), -50.0, 50.0))
    return Rise(
        trial=trial.name,
        begin=begin,
        end=end,
        quadratic=bool(best),
        terminal_speed=float(np.exp(x[0])),
        terminal_ci95=(float(ends[0, 0]), float(ends[0, 1])),
        excess_ratio=float(np.exp(x[1])),
        excess_ci95=(float(ends[1, 0]), float(ends[1, 1])),
        t=t,
        z=z + r,
        measured=z,
    )


def _longest_rise(t: Array, z: Array, name: str) -> tuple[float, float]:
    """The longest stretch in which the height over half a second grows faster than `RISING`."""
    grid = np.arange(t[0], t[-1], 0.1)
    height = np.interp(grid, t, z)
    if len(height) > 5:
        height = np.convolve(np.pad(height, 2, mode="edge"), np.full(5, 0.2), "valid")
    up = np.gradient(height, 0.1) > RISING
    edges = np.flatnonzero(np.diff(np.concatenate([[False], up, [False]]).astype(np.int8))).reshape(-1, 2)
    longest = max(edges, key=lambda e: e[1] - e[0], default=(0, 0))
    if (longest[1] - longest[0]) * 0.1 < SHORTEST:
        raise CalibrationError(
            f"{name}: nothing rises faster than {RISING} m/s for {SHORTEST:g} s: expected a vehicle let go under water"
        )
    return float(grid[longest[0]]), float(grid[longest[1] - 1])


def _fit(t: Array, z: Array, quadratic: bool) -> tuple[Array, Array, Array]:
    """x = ln terminal speed, ln e, w(0), z(0); residuals fitted - measured [m]; their Jacobian."""
    from scipy.optimize import least_squares

    grid = np.arange(t[0], t[-1] + STEP, STEP)

    def run(x: Array) -> Array:
        speed, e = np.exp(x[0]), np.exp(x[1])
        one, none = np.ones_like(e), np.zeros_like(e)
        theta = np.stack([one, none if quadratic else e / speed, e / speed**2 if quadratic else none, none])
        runs = [
            Run(np.full(len(grid) - 1, value), STEP, float(w), float(h))
            for value, w, h in zip(e, x[2], x[3], strict=True)
        ]
        _, heights = simulate_axis(theta, runs)
        return np.stack([np.interp(t, grid, h) for h in heights], axis=1)

    def residual(x: Array) -> Array:
        return np.asarray(run(x[:, None])[:, 0] - z)

    def jacobian(x: Array) -> Array:
        h = 1e-5
        both = run(x[:, None] + h * np.concatenate([np.eye(4), -np.eye(4)], axis=1))
        return np.asarray((both[:, :4] - both[:, 4:]) / (2.0 * h))

    late = t > t[-1] - 0.3 * (t[-1] - t[0])
    speed = max(float(np.polyfit(t[late], z[late], 1)[0]), RISING)
    early = t < t[0] + 0.2 * (t[-1] - t[0])
    first = float(np.polyfit(t[early], z[early], 1)[0])
    start = np.array([np.log(speed), np.log(speed), first, z[0]])
    low = np.array([np.log(speed) - 3.0, np.log(speed) - 6.0, -np.inf, -np.inf])
    high = np.array([np.log(speed) + 3.0, np.log(speed) + 6.0, np.inf, np.inf])
    solved = least_squares(residual, start, jacobian, bounds=(low, high), x_scale="jac")
    return solved.x, residual(solved.x), jacobian(solved.x)
