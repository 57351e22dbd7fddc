"""How well a calibrated lens is known over the picture, and where the pictures taken say nothing about it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.uncertainty import Covariance
from finssim.geometry.optics import Lens
from finssim.geometry.rotations import skew

__all__ = ["COLUMNS", "ROWS", "LensReach", "lens_reach"]

Array = NDArray[np.float64]

COLUMNS, ROWS = 12, 9
"""Cells of the picture in which corners are counted."""

TWO_SIGMA_PLANE = 5.991
"""95 % point of chi-squared with two degrees of freedom."""


@dataclass(frozen=True, kw_only=True)
class LensReach:
    """Over a grid of cells of the picture."""

    counts: NDArray[np.int64]
    """Corners in each cell, (rows, columns)."""
    error95: Array
    """Radius of the 95 % circle of a pixel whose direction is known, at the cell's centre [px], (rows, columns); a turn
    of the whole camera, which any pose takes up, is not in it. NaN where the lens cannot see."""
    edges: dict[str, float]
    """Empty border of the picture at left, right, top, bottom, as a share of its width or height."""

    @property
    def inside(self) -> float:
        """Largest error in cells with corners [px]."""
        return float(np.nanmax(np.where(self.counts > 0, self.error95, np.nan)))

    @property
    def anywhere(self) -> float:
        """Largest error over the picture [px]."""
        return float(np.nanmax(self.error95))


def lens_reach(lens: Lens, pixels: Array, covariance: Covariance) -> LensReach:
    """Count corners over the picture and carry the covariance of the lens to pixels.

    Args:
        lens: The lens.
        pixels: All corners used, (n, 2).
        covariance: Of the lens's numbers, in the order of `Lens.parameter_jacobian`.
    """
    u_edges = np.linspace(-0.5, lens.width - 0.5, COLUMNS + 1)
    v_edges = np.linspace(-0.5, lens.height - 0.5, ROWS + 1)
    counts = np.histogram2d(pixels[:, 1], pixels[:, 0], (v_edges, u_edges))[0].astype(np.int64)
    u, v = np.meshgrid(0.5 * (u_edges[1:] + u_edges[:-1]), 0.5 * (v_edges[1:] + v_edges[:-1]))
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    return LensReach(
        counts=counts,
        error95=_error95(lens, np.stack([u, v], axis=-1), counts > 0, covariance),
        edges={
            "left": float((low[0] + 0.5) / lens.width),
            "right": float((lens.width - 0.5 - high[0]) / lens.width),
            "top": float((low[1] + 0.5) / lens.height),
            "bottom": float((lens.height - 0.5 - high[1]) / lens.height),
        },
    )


def _error95(lens: Lens, pixels: Array, covered: NDArray[np.bool_], covariance: Covariance) -> Array:
    """d pixel = A d lens + B turn, with the turn that takes most of it away over the covered cells, (rows, columns)."""
    rays, ok = lens.rays(pixels)
    safe = np.where(ok[..., None], rays, np.array([0.0, 0.0, 1.0]))
    A = lens.parameter_jacobian(safe)
    B = -lens.project_jacobian(safe) @ skew(safe)
    fitted = covered & ok
    turn = -np.linalg.pinv(B[fitted].reshape(-1, 3)) @ A[fitted].reshape(-1, A.shape[-1])
    J = A + B @ turn
    if not np.isfinite(covariance.local).all():
        return np.full(pixels.shape[:-1], np.nan)
    # The information gives the shape, the disagreement of the views the size: alone, theirs would lack directions.
    ratio = covariance.std**2 / np.maximum(np.diagonal(covariance.local), 1e-300)
    S = max(float(np.mean(ratio)), 1.0) * J @ covariance.local @ np.swapaxes(J, -1, -2)
    radius = np.sqrt(TWO_SIGMA_PLANE * np.maximum(np.linalg.eigvalsh(S)[..., -1], 0.0))
    return np.asarray(np.where(ok, radius, np.nan))
