"""Meshes and lines of what is drawn: the hull, thrusters, tags, the pool, and forces as arrows."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from finssim.core.rotations import quat_to_matrix
from finssim.core.sonar_fan import fan_picture
from finssim.extensions.perception.layout import Shape, WorldLayout
from finssim.extensions.viewer.frame import BodyPose, FixedBody
from finssim.physics.actuators.fin import Fin
from finssim.robot.messages import Picture
from finssim.robot.record_messages import FAN_ROWS
from finssim.vehicles import Vehicle, VehicleError
from finssim.vehicles.device_files import SonarDevice, device_of

Array = npt.NDArray[np.float64]

ARROW = 1.2
"""Length of the arrow of the largest thrust, part of the vehicle's length."""
FAINT = 0.002
"""Part of the largest thrust below which no arrow is drawn."""
FAR, GAMMA = 15.0, 2.2
"""Half the edge of a plane that is drawn [m]; reflectances are shown to this power."""


class Mesh(NamedTuple):
    """Triangles."""

    vertices: Array
    """[m], (v, 3)"""
    faces: npt.NDArray[np.int64]
    """Counter-clockwise seen from outside, (f, 3)."""


def wxyz(quaternion: npt.ArrayLike) -> tuple[float, float, float, float]:
    """A quaternion xyzw, body to world, (4,), in the order that the browser takes."""
    x, y, z, w = np.asarray(quaternion, float).tolist()
    return w, x, y, z


def hull_of(vehicle: Vehicle) -> Mesh:
    """The hull in the body frame; a box of the vehicle's size where its file gives none."""
    try:
        return Mesh(*vehicle.hull_mesh())
    except VehicleError:
        half = 0.5 * np.asarray(vehicle.body.size, float)
        return _box(vehicle.body.center_of_buoyancy - half, vehicle.body.center_of_buoyancy + half)


def tag_plates(vehicle: Vehicle) -> tuple[Mesh, Mesh] | None:
    """White plates and the dark squares on them where tags sit, body frame; None without tags."""
    tags = vehicle.tags
    if tags is None:
        return None
    return tuple(  # type: ignore[return-value]
        _squares(
            [
                (m.position, quat_to_matrix(m.orientation), size * tags.edge_of(i))
                for i, m in tags.mounts.items()
            ],
            lift,
        )
        for size, lift in ((1.3, 0.0), (0.9, 0.002))
    )


def fin_plates(vehicle: Vehicle) -> dict[int, Mesh]:
    """Return the plate of each fin about its position at deflection 0, in body axes, by its index among the actuators
    besides thrusters."""
    plates = {}
    for k, fin in enumerate(vehicle.actuators.values()):
        if isinstance(fin, Fin):
            half = 0.5 * np.array([*fin.sides, 0.1 * fin.sides[0]])
            box = _box(-half, half)
            axes = np.column_stack([fin.chord, fin.span, np.cross(fin.chord, fin.span)])
            plates[k] = Mesh(box.vertices @ axes.T, box.faces)
    return plates


def fin_attitude(fin: Fin, deflection: float) -> Array:
    """Return the rotation of a fin's plate at a deflection [rad], xyzw, (4,)."""
    return np.array([*(np.sin(0.5 * deflection) * fin.span), np.cos(0.5 * deflection)])


def wall_mesh(lower: Array, upper: Array) -> Mesh:
    """Floor and four walls of a box, seen from inside alone: those between the eye and the water vanish.

    Corners are in [m].
    """
    vertices, faces = _box(lower, upper)
    lid = (vertices[faces][..., 2] > 0.5 * (lower[2] + upper[2])).all(axis=1)
    return Mesh(vertices, faces[~lid][:, ::-1])


def force_arrows(vehicle: Vehicle, force: Array, pose: BodyPose) -> Array:
    """Start and end of an arrow for each thruster that pushes, world frame [m], (k, 2, 3).

    An arrow points where its thruster pushes the vehicle. Its length grows with the root of the force, as the shaft
    speed does: linear ones would be too small to see while a station is kept.
    """
    if not len(force):
        return np.zeros((0, 2, 3))
    largest = float(np.max(np.abs(vehicle.force_limits)))
    part = np.asarray(force, float) / largest
    length = ARROW * float(np.max(vehicle.body.size))
    at = np.array([t.position for t in vehicle.thrusters.values()], float)
    reach = length * np.sign(part) * np.sqrt(np.abs(part))
    along = np.array([t.axis for t in vehicle.thrusters.values()], float)
    visible = np.isfinite(part) & (np.abs(part) > FAINT)
    ends = np.stack([at, at + reach[:, None] * along], axis=1)[visible]
    return np.asarray(ends @ quat_to_matrix(pose.quaternion).T + pose.position)


def line_of(points: Array) -> Array:
    """Segments of a line through points, (k - 1, 2, 3) [m]."""
    points = points[np.isfinite(points).all(axis=1)] if len(points) else points
    return np.stack([points[:-1], points[1:]], axis=1) if len(points) > 1 else np.zeros((0, 2, 3))


def box_edges(lower: Array, upper: Array) -> Array:
    """The twelve edges of a box, (12, 2, 3) [m]."""
    corners = _box(lower, upper).vertices
    pairs = [(i, i ^ bit) for i in range(8) for bit in (1, 2, 4) if i < i ^ bit]
    return np.array([[corners[a], corners[b]] for a, b in pairs])


def shown_of(vehicle: Vehicle, picture: Picture) -> npt.NDArray[np.uint8] | str:
    """Return a displayable reading of the vehicle's own sensors: a picture, a sonar's fan, or ranges as text."""
    if picture.image is None:
        ranges = [] if picture.ranges is None else picture.ranges.tolist()
        return ", ".join(f"{x:.2f} m" if np.isfinite(x) else "nothing in reach" for x in ranges)
    device = device_of(vehicle, picture.source)
    if not isinstance(device, SonarDevice):
        return picture.image
    return np.nan_to_num(fan_picture(picture.image, device.sector, FAN_ROWS)).astype(np.uint8)


def world_bodies(layout: WorldLayout) -> list[FixedBody]:
    """Return the bodies of the first world of a layout; the copies in a row are one body.

    Planes end 15 m from their middle, and basins have no walls: the stage has.
    """
    parts: dict[str, list[Mesh]] = {}
    colours = {}
    places = zip(layout.transforms.numpy()[0].astype(float), layout.scales.numpy()[0], strict=True)
    for shape, (pose, scale) in zip(layout.shapes, places, strict=True):
        if shape.owner != "basin":
            mesh = _mesh_of(shape)
            turned = Mesh(scale * mesh.vertices @ quat_to_matrix(pose[3:]).T + pose[:3], mesh.faces)
            parts.setdefault(shape.owner, []).append(turned)
            colours[shape.owner] = tuple((255.0 * shape.finish.colour ** (1.0 / GAMMA)).astype(int).tolist())
    bodies = []
    for name, meshes in parts.items():
        first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
        faces = np.concatenate([mesh.faces + i for mesh, i in zip(meshes, first, strict=False)])
        bodies.append(
            FixedBody(name, np.concatenate([mesh.vertices for mesh in meshes]), faces, colours[name])
        )
    return bodies


def _mesh_of(shape: Shape) -> Mesh:
    """Triangles of a shape, in its axes."""
    size = shape.size
    if shape.kind == "mesh":
        return Mesh(np.asarray(shape.vertices, float), np.asarray(shape.faces))
    if shape.kind in ("heightfield", "plane"):
        heights = np.zeros((2, 2)) if shape.heights is None else shape.heights
        x, y = (size[i] or FAR for i in (0, 1))
        rows, columns = heights.shape
        grid = np.meshgrid(np.linspace(-x, x, columns), np.linspace(-y, y, rows))
        corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
        lower = np.stack([corner, corner + 1, corner + columns + 1], axis=1)
        upper = np.stack([corner, corner + columns + 1, corner + columns], axis=1)
        return Mesh(np.stack([*grid, heights], axis=-1).reshape(-1, 3), np.concatenate([lower, upper]))
    import trimesh.creation as made

    if shape.kind == "box":
        solid = made.box(extents=2.0 * np.asarray(size))
    elif shape.kind == "sphere":
        solid = made.icosphere(subdivisions=2, radius=size[0])
    elif shape.kind == "cylinder":
        solid = made.cylinder(radius=size[0], height=2.0 * size[1], sections=24)
    else:
        solid = made.capsule(height=2.0 * size[1], radius=size[0], count=[16, 16])
        middle = 0.5 * (solid.vertices.min(axis=0) + solid.vertices.max(axis=0))
        return Mesh(solid.vertices - middle, np.asarray(solid.faces))
    return Mesh(np.asarray(solid.vertices), np.asarray(solid.faces))


def _box(lower: Array, upper: Array) -> Mesh:
    """A box, its corners in the order of x, y, z."""
    import trimesh.creation as made

    solid = made.box(bounds=[lower, upper])
    return Mesh(np.asarray(solid.vertices), np.asarray(solid.faces))


def _squares(places: list[tuple[Array, Array, float]], lift: float) -> Mesh:
    """Squares about the z axes of mounts, each with its edge, seen from both sides."""
    flat = 0.5 * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    vertices = [(edge * flat + [0.0, 0.0, lift]) @ R.T + np.asarray(position) for position, R, edge in places]
    faces = [np.array([[0, 1, 2], [0, 2, 3]]) + 4 * i for i in range(len(places))]
    return Mesh(np.concatenate(vertices), np.concatenate(faces))
