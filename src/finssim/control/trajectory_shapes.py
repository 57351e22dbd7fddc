"""Shapes that a trajectory can follow: position and its exact derivative as functions of time.

A shape lies in the horizontal plane z = `depth` (negative under water) unless it says otherwise. In the paper's
controller frame that is the x-z plane: its x is ours, its z is our y, both at y = depth.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from finssim.control.errors import ControlError

__all__ = ["SHAPES", "Motion", "circle", "ellipse", "gerono", "helix", "hermite", "polyline"]

Array = npt.NDArray[np.float64]

Motion = Callable[[Array], tuple[Array, Array]]
"""Times since the start [s], (...) -> position [m] and velocity [m/s], world frame, (..., 3) each."""

DEPTH = -0.5
"""Height of the published trajectories [m]."""

TABLE_SIZE = 2048
"""Knots of the ellipse's table: its spline is then exact to 1e-10 rad."""


def polyline(points: Sequence[Sequence[float]], durations: Sequence[float]) -> Motion:
    """Straight segments from point to point, each begun and ended at rest: s = 3u² - 2u³.

    Args:
        points: Corners, world frame [m], (n + 1, 3).
        durations: Time for each segment [s], (n,).

    Raises:
        ControlError: Lengths do not fit, or a time is not positive.
    """
    corners, times = np.asarray(points, float), np.asarray(durations, float)
    if corners.ndim != 2 or corners.shape[1:] != (3,) or times.shape != (len(corners) - 1,):
        raise ControlError(
            f"polyline of points {corners.shape} with durations {times.shape}: expected (n + 1, 3) and (n,)"
        )
    _positive(polyline=float(times.min()))
    starts = np.concatenate([[0.0], np.cumsum(times)])

    def motion(t: Array) -> tuple[Array, Array]:
        i = np.clip(np.searchsorted(starts, t, side="right") - 1, 0, len(times) - 1)
        s, s_dot = _smooth_step((t - starts[i]) / times[i])
        way = corners[i + 1] - corners[i]
        return corners[i] + s[..., None] * way, (s_dot / times[i])[..., None] * way

    return motion


def circle(radius: float, turns: float, duration: float, depth: float = DEPTH) -> Motion:
    """Circles about the pool's middle at constant speed, counter-clockwise from (radius, 0).

    Args:
        radius: [m]
        turns: Number of circles.
        duration: Time for all of them [s].
        depth: Height of their plane, world frame [m]: negative under water.
    """
    _positive(radius=radius, turns=turns, duration=duration)
    return helix(radius, turns, duration, depth, depth)


def helix(radius: float, turns: float, duration: float, bottom: float, top: float) -> Motion:
    """A circle that rises steadily from `bottom` to `top` (heights in the world frame [m])."""
    _positive(radius=radius, turns=turns, duration=duration)
    rate, climb = 2.0 * math.pi * turns / duration, (top - bottom) / duration

    def motion(t: Array) -> tuple[Array, Array]:
        c, s = radius * np.cos(rate * t), radius * np.sin(rate * t)
        position = np.stack([c, s, bottom + climb * t], axis=-1)
        return position, np.stack([-rate * s, rate * c, np.full_like(c, climb)], axis=-1)

    return motion


def gerono(a: float, b: float, duration: float, depth: float = DEPTH) -> Motion:
    """A figure of eight at constant phase rate: x = a sin θ, y = b sin θ cos θ (Gerono's lemniscate).

    Args:
        a: Half its length along world x [m].
        b: Its width along world y [m].
        duration: Time for one figure [s].
        depth: Height of its plane, world frame [m]: negative under water.
    """
    _positive(a=a, b=b, duration=duration)
    rate = 2.0 * math.pi / duration

    def motion(t: Array) -> tuple[Array, Array]:
        phase = rate * t
        x, y = a * np.sin(phase), 0.5 * b * np.sin(2.0 * phase)
        x_dot, y_dot = a * rate * np.cos(phase), b * rate * np.cos(2.0 * phase)
        return np.stack([x, y, np.full_like(x, depth)], axis=-1), np.stack([x_dot, y_dot, 0.0 * x], axis=-1)

    return motion


def ellipse(a: float, b: float, duration: float, depth: float = DEPTH) -> Motion:
    """One turn of an ellipse, slower at its four vertices, begun and ended at rest.

    The speed along the arc follows 0.5 + 0.5 sin² 2θ, and time itself runs by s = 3u² - 2u³. That reading of what is
    published gives the published peak: 0.1031 m/s for half axes of 1.0 and 0.4 m in 92.70 s.

    Args:
        a: Half axis along world x [m].
        b: Half axis along world y [m].
        duration: Time for the turn [s].
        depth: Height of its plane, world frame [m]: negative under water.
    """
    _positive(a=a, b=b, duration=duration)
    theta = np.linspace(0.0, 2.0 * math.pi, TABLE_SIZE + 1)

    def slowness(angle: Array) -> Array:
        """Time per angle, up to a factor: |dr/dθ| / (0.5 + 0.5 sin² 2θ)."""
        stretch = np.hypot(a * np.sin(angle), b * np.cos(angle))
        return np.asarray(stretch / (0.5 + 0.5 * np.sin(2.0 * angle) ** 2))

    middle = slowness(0.5 * (theta[1:] + theta[:-1]))
    ends = slowness(theta)
    pieces = (ends[:-1] + 4.0 * middle + ends[1:]) * np.diff(theta) / 6.0  # Simpson's rule
    table = np.concatenate([[0.0], np.cumsum(pieces)])
    knots, slopes = table / table[-1], table[-1] / ends

    def motion(t: Array) -> tuple[Array, Array]:
        s, s_dot = _smooth_step(t / duration)
        angle, slope = hermite(s, knots, theta, slopes)
        rate = slope * s_dot / duration
        c, n = np.cos(angle), np.sin(angle)
        position = np.stack([a * c, b * n, np.full_like(c, depth)], axis=-1)
        return position, np.stack([-a * rate * n, b * rate * c, 0.0 * c], axis=-1)

    return motion


SHAPES: dict[str, Callable[..., Motion]] = {
    "polyline": polyline,
    "circle": circle,
    "helix": helix,
    "gerono": gerono,
    "ellipse": ellipse,
}
"""Shapes by the name that trajectory files use."""


def hermite(x: Array, knots: Array, values: Array, slopes: Array) -> tuple[Array, Array]:
    """Cubic Hermite interpolation and its exact derivative.

    Args:
        x: Where, within the knots, (...).
        knots: Increasing, (n,).
        values: At the knots, (n,) or (n, m).
        slopes: Derivatives there, like `values`.

    Returns:
        Value and derivative, (...) or (..., m).
    """
    i = np.clip(np.searchsorted(knots, x, side="right") - 1, 0, len(knots) - 2)
    h, shape = knots[i + 1] - knots[i], (*np.shape(x), *(1,) * (values.ndim - 1))
    u, h = np.reshape((x - knots[i]) / h, shape), np.reshape(h, shape)
    way, a, b = values[i + 1] - values[i], slopes[i] * h, slopes[i + 1] * h
    value = values[i] + u * (a + u * (3.0 * way - 2.0 * a - b + u * (a + b - 2.0 * way)))
    return value, (a + u * (6.0 * way - 4.0 * a - 2.0 * b + 3.0 * u * (a + b - 2.0 * way))) / h


def _smooth_step(u: Array) -> tuple[Array, Array]:
    """3u² - 2u³ and its derivative."""
    return u * u * (3.0 - 2.0 * u), 6.0 * u * (1.0 - u)


def _positive(**numbers: float) -> None:
    for name, number in numbers.items():
        if not (math.isfinite(number) and number > 0.0):
            raise ControlError(f"{name} is {number}, expected a positive number")
