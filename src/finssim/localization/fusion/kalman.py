"""Measurement update of a Kalman filter, and bounds of its covariance, over a leading `...` batch."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Self, TypeAlias

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Number: TypeAlias = Any
"""A float, or an array with one value per run: formulas accept both; plain floats take a tenth of the time."""


@dataclass(frozen=True)
class Innovation:
    """Difference between a measurement and its prediction."""

    residual: Array
    """Measured minus predicted, in the unit of the measurement, (..., m)."""
    H: Array
    """Jacobian of the prediction with respect to the errors, in their units, (..., m, n)."""
    R: Array
    """Covariance of the measurement in its unit, (..., m, m)."""
    mahalanobis: Number
    """Squared Mahalanobis distance, (...)."""
    gain: Any
    """Kalman gain, (..., n, m); two numbers for yaw."""


class MatrixState:
    """State of a filter with n errors and their covariance."""

    P: Array
    """Covariance of the errors in their units, (..., n, n)."""

    def moved(self, error: Array, P: Array) -> Self:
        """Return the state corrected by an error (..., n), with a new covariance (..., n, n).

        Errors have the units of the state.
        """
        raise NotImplementedError

    def innovation(self, residual: Array, H: Array, R: Array) -> Innovation:
        """Return the innovation of a measurement.

        Args:
            residual: Measured minus predicted, in the unit of the measurement, (..., m).
            H: Jacobian of the prediction with respect to the errors, in their units, (..., m, n).
            R: Covariance of the measurement in its unit, (..., m, m).
        """
        PHt = self.P @ H.swapaxes(-1, -2)
        inverse = _inverse(H @ PHt + R)
        if residual.ndim == 1:  # half the time of a batch of one
            distance = float(residual @ inverse @ residual)
        else:
            distance = np.einsum("...i,...ij,...j", residual, inverse, residual)
        return Innovation(residual, H, R, distance, PHt @ inverse)

    def corrected(self, found: Innovation) -> Self:
        """Return the state after a measurement, in Joseph's form: P stays symmetric and positive despite rounding.

        x <- x + K ρ,  P <- (I - K H) P (I - K H)' + K R K'
        """
        K, residual = found.gain, found.residual
        retained = _identity(K.shape[-2]) - K @ found.H
        P = retained @ self.P @ retained.swapaxes(-1, -2) + K @ found.R @ K.swapaxes(-1, -2)
        error = K @ residual if residual.ndim == 1 else (K @ residual[..., None])[..., 0]
        return self.moved(error, 0.5 * (P + P.swapaxes(-1, -2)))


def _inverse(S: Array) -> Array:
    """Return the inverse of symmetric matrices, (..., m, m); for 2x2, np.linalg takes four times as long."""
    if S.shape[-1] == 1:
        return np.asarray(1.0 / S)
    if S.shape != (2, 2):
        return np.asarray(np.linalg.inv(S), np.float64)
    (a, b), (_, c) = S.tolist()
    determinant = a * c - b * b
    return np.asarray(np.array([[c, -b], [-b, a]]) / determinant)


@lru_cache(maxsize=8)
def _identity(n: int) -> Array:
    return np.eye(n)


def bounded(P: Array, limits: Array) -> Array:
    """Return a covariance (..., n, n) with variances of at most `limits` (n,): larger rows and columns are
    scaled down.

    The units are those of the errors.
    """
    d = P.diagonal(axis1=-2, axis2=-1)
    if (d <= limits).all():
        return P
    scale = np.sqrt(np.minimum(1.0, limits / np.maximum(d, 1e-300)))
    return np.asarray(P * scale[..., :, None] * scale[..., None, :])


def isolated(P: Array, rows: list[int], block: Array) -> Array:
    """Return a covariance (..., n, n) in which some errors are uncorrelated with the others, with covariance
    `block`.

    The units are those of the errors.
    """
    P = P.copy()
    P[..., rows, :] = 0.0
    P[..., :, rows] = 0.0
    P[..., np.array(rows)[:, None], np.array(rows)] = block
    return P
