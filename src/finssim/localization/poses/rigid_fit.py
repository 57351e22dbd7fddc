"""A rigid motion in the plane that lays one set of points on another, measured in pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

__all__ = ["RigidFit", "rigid_fit"]

Array = npt.NDArray[np.float64]

_MOST_STEPS = 30
_MOST_TURNS = 8
_STILL = 1e-13
"""A step that changes the misses by less than the root of this [px²] is the last."""


@dataclass(frozen=True, eq=False)
class RigidFit:
    """The motion found, and what its uncertainty follows from."""

    xi: tuple[float, float, float]
    """x, y [m], psi [rad]."""
    inverse: Array
    """Inverse of the weighted J'J [m², rad² per px²], (3, 3)."""
    weighted_J: Array
    """The curvature of rho times J, (n, 2, 3)."""
    A: Array
    """[px/m], (n, 2, 2)."""
    missed: Array
    """Distance of each point from its place [px], (n,)."""
    iterations: int
    converged: bool

    @property
    def rms(self) -> float:
        """Root mean square of `missed` [px]."""
        return math.sqrt(float(self.missed @ self.missed) / len(self.missed))

    def response(self, shared: Array) -> Array:
        """How the motion changes with errors that move many points at once.

        Args:
            shared: Change of each point Q - P per unit of each error, (k, n, 2).

        Returns:
            (3, k)
        """
        in_pixels = (self.A @ shared[..., None])[..., 0].reshape(len(shared), -1)
        return np.asarray(-self.inverse @ (in_pixels @ self.weighted_J.reshape(-1, 3)).T)

    def inflation(self, std: float) -> float:
        """Factor on the variance where the misses are larger than noise of `std` [px] explains.

        It is 1 up to the 99 % quantile of chi² (Wilson and Hilferty's approximation), and the ratio to it beyond.
        """
        dof = 2 * len(self.missed) - 3
        k = 2.0 / (9.0 * dof)
        quantile = dof * (1.0 - k + 2.326 * math.sqrt(k)) ** 3
        return max(1.0, float(self.missed @ self.missed) / std**2 / quantile)


def rigid_fit(Q: Array, points: Array, A: Array, huber: float) -> RigidFit | None:
    """Find xi = (x, y, psi) that minimises sum_i rho(|A_i (Q_i - R(psi) points_i - [x, y])|).

    Levenberg and Marquardt's method with the analytic Jacobian -A [I, R'(psi) points], from the minimum of the plain
    sum of squares: where no point misses by `huber` or more, its first step is its last.

    Args:
        Q: Where the points are seen [m], (n, 2).
        points: Where they are on the body [m], (n, 2).
        A: Metres to pixels [px/m], (n, 2, 2).
        huber: Distance [px] from which on Huber's rho grows linearly.

    Returns:
        The fit, or None where the points are too close together to tell the angle.
    """
    xi = _least_squares(Q, points, A)
    now = _evaluate(xi, Q, points, A, huber)
    damping, converged = 1e-6, False
    step_number = 0
    while step_number < _MOST_STEPS and not converged:
        step_number += 1
        inverse = _inverse(now.H, damping)
        if inverse is None:
            return None
        step = -inverse @ now.g
        converged = bool(-(step @ now.g) < _STILL)
        trial = (xi[0] + step[0], xi[1] + step[1], xi[2] + step[2])
        then = _evaluate(trial, Q, points, A, huber)
        if converged or then.cost <= now.cost:  # the last step changes the cost by no more than rounding does
            xi, now, damping = trial, then, max(0.1 * damping, 1e-12)
        else:
            damping = max(10.0 * damping, 1e-6)
    inverse = _inverse(now.H, 0.0)
    if inverse is None:
        return None
    where = (float(xi[0]), float(xi[1]), math.remainder(float(xi[2]), math.tau))
    return RigidFit(where, inverse, now.weighted_J, A, now.missed, step_number, converged)


@dataclass(frozen=True, eq=False)
class _State:
    cost: float
    H: Array
    g: Array
    weighted_J: Array
    missed: Array


def _inverse(H: Array, damping: float) -> Array | None:
    """Inverse of H + damping diag(H) by its adjugate, None where it is singular: np.linalg costs four times as much."""
    (a, d, e), (_, b, f), (_, _, c) = H.tolist()
    scale = a * b * c
    a, b, c = a * (1.0 + damping), b * (1.0 + damping), c * (1.0 + damping)
    A, D, E = b * c - f * f, e * f - c * d, d * f - b * e
    determinant = a * A + d * D + e * E
    if not determinant > 1e-12 * scale:
        return None
    B, F, C = a * c - e * e, d * e - a * f, a * b - d * d
    return np.asarray(np.array([[A, D, E], [D, B, F], [E, F, C]]) / determinant)


def _procrustes(centre: Array, middle: Array, q: Array, p: Array) -> tuple[float, float, float]:
    """The closed form for equal weights, of the middles of both sets of points and where they are from them."""
    along = float(np.vdot(p, q))
    across = float(p[:, 0] @ q[:, 1] - p[:, 1] @ q[:, 0])
    psi = math.atan2(across, along)
    c, s = math.cos(psi), math.sin(psi)
    return (
        float(centre[0] - c * middle[0] + s * middle[1]),
        float(centre[1] - s * middle[0] - c * middle[1]),
        psi,
    )


def _least_squares(Q: Array, points: Array, A: Array) -> tuple[float, float, float]:
    """The minimum of sum_i |A_i (Q_i - R(psi) points_i - [x, y])|², beside the closed form for equal weights.

    The misses are linear in (x, y, cos psi, sin psi), so the sum is a quadratic form. Without x and y, which it decides
    for each psi, it is K over (cos psi, sin psi, 1): Newton's method finds its minimum in plain numbers.
    """
    n = len(Q)
    centre, middle = Q.sum(axis=0) / n, points.sum(axis=0) / n
    q, p = Q - centre, points - middle
    columns = np.zeros((n, 2, 5))  # of x, y, cos psi and sin psi in R points + [x, y], and -Q
    columns[:, 0, 0] = columns[:, 1, 1] = 1.0
    columns[:, :, 2] = p
    columns[:, 0, 3], columns[:, 1, 3] = -p[:, 1], p[:, 0]
    columns[:, :, 4] = -q
    in_pixels = (A @ columns).reshape(-1, 5)
    G = (in_pixels.T @ in_pixels).tolist()
    (a, b), d = G[0][:2], G[1][1]
    determinant = a * d - b * b
    if not determinant > 0.0:
        return _procrustes(centre, middle, q, p)
    # Where x and y are for each of cos psi, sin psi, 1; and what is left of the form.
    x = [-(d * G[0][k] - b * G[1][k]) / determinant for k in (2, 3, 4)]
    y = [-(a * G[1][k] - b * G[0][k]) / determinant for k in (2, 3, 4)]
    cc, ss, cs, c1, s1 = (
        G[i + 2][j + 2] + G[i + 2][0] * x[j] + G[i + 2][1] * y[j]
        for i, j in ((0, 0), (1, 1), (0, 1), (0, 2), (1, 2))
    )
    _, _, psi = begin = _procrustes(centre, middle, q, p)
    for _ in range(_MOST_TURNS):
        c, s = math.cos(psi), math.sin(psi)
        slope = (ss - cc) * c * s + cs * (c * c - s * s) - c1 * s + s1 * c
        curvature = (ss - cc) * (c * c - s * s) - 4.0 * cs * c * s - c1 * c - s1 * s
        if not curvature > 0.0:
            return begin
        psi -= slope / curvature
        if abs(slope) < 1e-8 * curvature:  # the error is the square of this, once the step is taken
            break
    c, s = math.cos(psi), math.sin(psi)
    (qx, qy), (px, py) = centre.tolist(), middle.tolist()
    return (
        x[0] * c + x[1] * s + x[2] + qx - (c * px - s * py),
        y[0] * c + y[1] * s + y[2] + qy - (s * px + c * py),
        psi,
    )


def _evaluate(xi: tuple[float, float, float], Q: Array, points: Array, A: Array, huber: float) -> _State:
    c, s = math.cos(xi[2]), math.sin(xi[2])
    turned = points @ np.array([[c, s], [-s, c]])
    change = np.empty((len(Q), 2, 4))  # columns: Q - P, and P's derivatives by x, y, psi
    change[:, :, 0] = Q - turned - xi[:2]
    change[:, :, 1:3] = -_UNIT
    change[:, 0, 3], change[:, 1, 3] = turned[:, 1], -turned[:, 0]
    in_pixels = A @ change
    miss, J = in_pixels[:, :, 0], in_pixels[:, :, 1:]
    squares = (miss * miss) @ _ONES
    missed = np.sqrt(squares)
    flat = J.reshape(-1, 3)
    if missed.max() <= huber:
        return _State(float(squares.sum()), flat.T @ flat, flat.T @ miss.ravel(), J, missed)
    far = missed > huber
    weight = np.where(far, huber / np.maximum(missed, huber), 1.0)
    cost = float(np.where(far, huber * (2.0 * missed - huber), squares).sum())
    # Where rho grows linearly it curves across the miss only; with weights alone the steps would shrink but slowly.
    towards = np.where(far, 1.0 / np.maximum(missed, huber), 0.0)[:, None] * miss
    across = J - towards[:, :, None] * np.einsum("ij,ijk->ik", towards, J)[:, None, :]
    weighted = weight[:, None, None] * across
    g = flat.T @ (weight[:, None] * miss).ravel()
    return _State(cost, weighted.reshape(-1, 3).T @ flat, g, weighted, missed)


_UNIT, _ONES = np.eye(2), np.ones(2)
