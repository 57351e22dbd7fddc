"""Coefficients that hold about some point in tilted axes: how a matrix that couples all axes stays physical."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from finssim.engine.plant_arrays import twist_shift
from finssim.geometry.rotations import quat_from_euler, quat_to_matrix

__all__ = ["CoupledMatrix", "PrincipalAxes", "Section", "Six", "Three"]

Array = NDArray[np.float64]
Six = tuple[float, float, float, float, float, float]
Three = tuple[float, float, float]


class Section(BaseModel):
    """A frozen part of a plant file: unknown keys and numbers that are not finite are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class PrincipalAxes(Section):
    """A point of the body and axes there."""

    center: Three
    """Body frame [m]."""
    tilt_deg: Three
    """Roll, pitch, yaw of the axes in the body [deg]."""

    def to_axes(self) -> Array:
        """T with x = T nu: the twist at the point, in the tilted axes, from that of the body origin; (6, 6)."""
        tilt = quat_to_matrix(quat_from_euler(*np.radians(self.tilt_deg)))
        return np.asarray(np.kron(np.eye(2), tilt.T) @ twist_shift(self.center))


class CoupledMatrix(PrincipalAxes):
    """A 6x6 matrix that is diagonal about some point in some axes."""

    diagonal: Six
    """[kg, kg m²] or [N s/m, N m s]; above 0."""

    def matrix(self) -> Array:
        """About the body origin, body axes: Tᵀ diag T; positive definite for a positive diagonal, (6, 6)."""
        T = self.to_axes()
        return np.asarray(T.T @ np.diag(self.diagonal) @ T)
