"""Errors of pixels and of the survey together: the covariance of residuals, whitening, and the size of both errors."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from finssim.calibration.vision.pool.observations import Observations

__all__ = ["Noise", "Whitener", "estimate_noise"]

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


class Whitener:
    """Makes residuals independent and of unit variance; rows of one location belong together.

    V_l = sigma² 1 + J_l B_l S B_lᵀ J_lᵀ: a location is displaced as a whole, and a tag turned, by the survey's error.
    """

    def __init__(
        self, J_point: Array, seen: Observations, noise: Noise, weights: Array | None = None
    ) -> None:
        """
        Args:
            J_point: Derivative of the pixel by the point, (N, 2, 3).
            seen: The rows.
            noise: Standard errors.
            weights: Factors of robust weighting on each row's pixel information, (N,), or None.
        """
        sigma = noise.scale * np.where(np.isfinite(seen.sigma), seen.sigma, noise.survey)
        turn = noise.scale * noise.survey_yaw * np.einsum("nij,nj->ni", J_point, seen.arm)
        modes = np.concatenate([J_point * sigma[:, None, None], turn[..., None]], axis=-1)
        variance = noise.pixel**2 / (np.ones(len(seen)) if weights is None else np.maximum(weights, 1e-6))
        self.logdet = 0.0
        self._groups: list[tuple[NDArray[np.intp], Array]] = []
        order = np.argsort(seen.location, kind="stable")
        _, starts, counts = np.unique(seen.location[order], return_index=True, return_counts=True)
        for count in np.unique(counts):
            rows = np.stack([order[s : s + count] for s in starts[counts == count]])
            B = modes[rows].reshape(len(rows), 2 * count, 4)
            V = B @ B.transpose(0, 2, 1)
            index = np.arange(2 * count)
            V[:, index, index] += np.repeat(variance[rows], 2, axis=-1)
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

    @property
    def locations(self) -> list[NDArray[np.intp]]:
        """Rows of whitened values that belong to one location each."""
        found, start = [], 0
        for rows, L_inverse in self._groups:
            size = L_inverse.shape[-1]
            found += [np.arange(start + i * size, start + (i + 1) * size) for i in range(len(rows))]
            start += len(rows) * size
        return found


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
