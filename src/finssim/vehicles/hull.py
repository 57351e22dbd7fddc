"""The hull mesh of a vehicle: read from its file or built from its envelope, and checked."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from finssim.vehicles.errors import VehicleError

if TYPE_CHECKING:
    from finssim.vehicles.vehicle import Vehicle


def hull_mesh(vehicle: Vehicle) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """See `Vehicle.hull_mesh`."""
    from finssim.geometry import mesh  # SciPy, which it uses, is slow to import

    hull, body = vehicle.hull, vehicle.body
    if hull is None:
        raise VehicleError(
            f"{vehicle.name} has no hull: give 'hull: {{parametric: true}}' or 'hull: {{file: NAME.stl}}'"
        )
    if hull.file is None:
        try:
            return mesh.parametric_hull(body.size, body.displaced_volume, body.center_of_buoyancy)
        except mesh.MeshError as error:
            raise VehicleError(f"parametric hull of {vehicle.name}: {error}") from None
    if not hull.file.is_file():
        raise VehicleError(f"file {hull.file} does not exist: give a path relative to the vehicle file")
    try:
        vertices, faces = mesh.load_stl(hull.file)
        mesh.check_closed(vertices, faces)
    except mesh.MeshError as error:
        raise VehicleError(f"file {hull.file.name}: {error}") from None
    return hull.scale * vertices, faces
