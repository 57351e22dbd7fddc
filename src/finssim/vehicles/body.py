"""Water, rigid body and hull of a vehicle file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import model_validator

from finssim.vehicles.part import Inertia, Part, Positive, Positive3, Vector3, refuse_section


class Water(Part):
    """The water the numbers of the file were given for."""

    density: Positive
    """[kg/m³]"""
    gravity: Positive
    """[m/s²]"""


class Body(Part):
    """Rigid body: positions are from the body origin, in body axes (x forward, y left, z up)."""

    mass: Positive
    """Dry mass including flooded-in solids, without entrained water [kg]."""
    inertia: Inertia
    """About the centre of gravity, body axes, (3, 3) [kg m²]; the file gives 3 diagonal entries or 3 rows of 3."""
    center_of_gravity: Vector3
    """[m], (3,)"""
    displaced_volume: Positive
    """Volume of water displaced when fully submerged [m³]."""
    center_of_buoyancy: Vector3
    """[m], (3,)"""
    size: Positive3
    """Envelope box along x, y, z [m], (3,)."""
    surface_half_height: Positive
    """Half height of the layer in which buoyancy fades out at the surface [m]."""


class Hull(Part):
    """The closed surface of the vehicle: a mesh file, or one built from `body` (envelope, volume, centre)."""

    parametric: bool = False
    """True: build the mesh from `body.size`, `body.displaced_volume` and `body.center_of_buoyancy`."""
    file: Path | None = None
    """STL in body axes [m]; a relative path starts at the vehicle file."""
    scale: Positive = 1.0
    """Factor on the coordinates of the file."""

    @model_validator(mode="after")
    def _one_of_two(self) -> Hull:
        if self.parametric == (self.file is not None):
            raise refuse_section("expected either 'parametric: true' or 'file: NAME.stl'")
        return self


def skew(r: NDArray[np.float64]) -> NDArray[np.float64]:
    """S(r) with S(r) x = r × x."""
    return np.array([[0.0, -r[2], r[1]], [r[2], 0.0, -r[0]], [-r[1], r[0], 0.0]])


def moved_to_origin(matrix: NDArray[np.float64], point: NDArray[np.float64]) -> NDArray[np.float64]:
    """A 6x6 mass or damping matrix that holds at `point` [m, body], for the twist at the body origin.

    H(r)ᵀ M H(r) with H(r) = [[I, -S(r)], [0, I]]                       (Fossen 2021, eq. 3.31)
    """
    H = np.eye(6)
    H[:3, 3:] = -skew(point)
    return H.T @ matrix @ H
