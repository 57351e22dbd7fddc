"""The hull mesh of a vehicle: read from its file or built from its envelope, and checked."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from finssim.vehicles.errors import VehicleError

if TYPE_CHECKING:
    from finssim.vehicles.vehicle import Vehicle

Mesh = tuple[NDArray[np.float64], NDArray[np.int32]]


def hull_mesh(vehicle: Vehicle) -> Mesh:
    """See `Vehicle.hull_mesh`."""
    from finssim.geometry import mesh

    hull, body = vehicle.hull, vehicle.body
    if hull is None:
        raise VehicleError(
            f"{vehicle.name} has no hull: give 'hull: {{parametric: true}}' or 'hull: {{file: NAME.stl}}'"
        )
    if hull.file is None:
        vertices, faces = mesh.parametric_hull(body.size, body.displaced_volume, body.center_of_buoyancy)
    else:
        if not hull.file.is_file():
            raise VehicleError(f"file {hull.file} does not exist: give a path relative to the vehicle file")
        try:
            vertices, faces = mesh.load_stl(hull.file)
        except ValueError as error:
            raise VehicleError(f"file {hull.file.name} cannot be used: {error}") from None
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int32)
    refuse_unusable(vertices, faces, str(hull.file.name) if hull.file else "parametric hull")
    return vertices, faces


def signed_volume(vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> float:
    """Volume enclosed by a closed mesh, positive where normals point outward [m³]: Σ a·(b × c) / 6."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def open_edges(faces: NDArray[np.int32]) -> int:
    """Directed edges that no neighbouring face runs along the other way; 0 for a closed, consistently turned mesh."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    size = int(faces.max()) + 1
    forward, backward = edges[:, 0] * size + edges[:, 1], edges[:, 1] * size + edges[:, 0]
    return int(np.count_nonzero(~np.isin(forward, backward)))


def refuse_unusable(vertices: NDArray[np.float64], faces: NDArray[np.int32], shown: str) -> None:
    """Refuse a mesh on which buoyancy and drag would be wrong.

    Raises:
        VehicleError: The mesh is open, turned inside out, or holds a number that is not finite.
    """
    if not np.all(np.isfinite(vertices)):
        raise VehicleError(f"{shown} holds a vertex that is not finite")
    count = open_edges(faces)
    if count:
        raise VehicleError(
            f"{shown} has {count} open or inconsistently turned edges, expected none: close the mesh"
        )
    volume = signed_volume(vertices, faces)
    if volume <= 0.0:
        raise VehicleError(
            f"{shown} encloses {volume:.4g} m³, expected > 0: its normals point inward, flip the faces"
        )
