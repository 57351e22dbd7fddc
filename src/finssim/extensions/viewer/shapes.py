"""Meshes and lines that are drawn: hull, thrusters, tags, the pool, and forces as arrows."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from finssim.core import mesh as hulls
from finssim.core.rotations import quat_from_rotvec, quat_multiply, quat_to_matrix
from finssim.extensions.viewer.frame import BodyPose, FixedBody
from finssim.vehicles import Vehicle, VehicleError

if TYPE_CHECKING:  # not imported before the first picture of a view
    from finssim.extensions.perception.layout import Shape, WorldLayout
    from finssim.physics.actuators.fin import Fin
    from finssim.robot.messages import Picture

Array = npt.NDArray[np.float64]

ARROW = 1.2
"""Length of the arrow of the largest thrust, as a share of the vehicle's length."""
FAINT = 0.002
"""Share of the largest thrust below which no arrow is drawn."""
FAR, GAMMA = 15.0, 2.2
"""Half the edge of a drawn plane [m]; gamma of the drawn colours, which are reflectances to the power of 1/gamma."""


class Mesh(NamedTuple):
    """Triangle mesh."""

    vertices: Array
    """Vertices [m], (v, 3)."""
    faces: npt.NDArray[np.int64]
    """Vertex indices of the triangles, counter-clockwise seen from outside, (f, 3)."""


def wxyz(quaternion: npt.ArrayLike) -> tuple[float, float, float, float]:
    """Return a quaternion xyzw, body to world, (4,), in the order of the browser, wxyz."""
    x, y, z, w = np.asarray(quaternion, float).tolist()
    return w, x, y, z


def hull_of(vehicle: Vehicle) -> Mesh:
    """Return the hull in the body frame; without one in the vehicle's file, a body of its size and volume, or
    its box."""
    body = vehicle.body
    try:
        if vehicle.hull is None:
            return Mesh(*hulls.parametric_hull(body.size, body.displaced_volume, body.center_of_buoyancy))
        return Mesh(*vehicle.hull_mesh())
    except (VehicleError, hulls.MeshError):
        half = 0.5 * np.asarray(body.size, float)
        return _box(body.center_of_buoyancy - half, body.center_of_buoyancy + half)


def tag_plates(vehicle: Vehicle) -> tuple[Mesh, Mesh] | None:
    """Return the white plates of the tags and the dark squares on them, body frame; None without tags."""
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
    """Return the plate of each fin at deflection 0, in body axes relative to its position, by its index among
    the actuators besides thrusters."""
    plates: dict[int, Mesh] = {}
    if not vehicle.actuators:
        return plates
    from finssim.physics.actuators.fin import Fin

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


def duct_mesh(vehicle: Vehicle) -> Mesh | None:
    """Return the ducts of the thrusters, body frame; None for a vehicle with a single, open propeller."""
    import trimesh

    if len(vehicle.thrusters) < 2:
        return None
    rings = []
    for radius, (position, attitude) in zip(_radii(vehicle), _shafts(vehicle), strict=True):
        ring = trimesh.creation.annulus(1.06 * radius, 1.2 * radius, 0.9 * radius, sections=24)
        rings.append(Mesh(ring.vertices @ quat_to_matrix(attitude).T + position, np.asarray(ring.faces)))
    return _joined(rings)


def propeller_mesh() -> Mesh:
    """Return a hub and three twisted blades of unit radius around z."""
    import trimesh

    hub = trimesh.creation.cylinder(0.24, 0.8, sections=12)
    parts = [Mesh(np.asarray(hub.vertices), np.asarray(hub.faces))]
    for turn in 2.0 * np.pi / 3.0 * np.arange(3):
        edges = []
        for r, half, pitch in ((0.2, 0.22, 0.9), (0.6, 0.36, 0.6), (1.0, 0.28, 0.4)):
            across = half * np.array([0.0, np.cos(pitch), np.sin(pitch)])
            edges += [[r, 0.0, 0.0] - across, [r, 0.0, 0.0] + across]
        blade = np.array(edges) @ quat_to_matrix(quat_from_rotvec([0.0, 0.0, turn])).T
        parts.append(Mesh(blade, np.array([[0, 2, 3], [0, 3, 1], [2, 4, 5], [2, 5, 3]])))
    return _joined(parts)


def propeller_poses(vehicle: Vehicle, angles: npt.ArrayLike) -> tuple[Array, Array, Array]:
    """Return attitudes wxyz (n, 4), positions (n, 3) and radii (n,) [m] of propellers turned by angles [rad], (n,)."""
    turned = [
        wxyz(quat_multiply(attitude, quat_from_rotvec([0.0, 0.0, angle])))
        for (_, attitude), angle in zip(_shafts(vehicle), np.asarray(angles, float), strict=True)
    ]
    return np.array(turned), np.array([position for position, _ in _shafts(vehicle)]), _radii(vehicle)


def _radii(vehicle: Vehicle) -> Array:
    """Return the radii of the propellers [m], of the file or in proportion to the hull, (n,)."""
    usual = 0.17 * float(np.min(vehicle.body.size))
    return np.array([usual if t.diameter is None else 0.5 * t.diameter for t in vehicle.thrusters.values()])


def _shafts(vehicle: Vehicle) -> list[tuple[Array, Array]]:
    """Return position [m] and attitude of each propeller, which rotates z to the thrust's axis; body frame, xyzw."""
    shafts = []
    for thruster in vehicle.thrusters.values():
        x, y, z = thruster.axis
        sine = float(np.hypot(x, y))
        turn = np.array([-y, x, 0.0]) / sine if sine > 1e-9 else np.array([1.0, 0.0, 0.0])
        shafts.append((np.array(thruster.position, float), quat_from_rotvec(turn * np.arctan2(sine, z))))
    return shafts


def force_arrows(vehicle: Vehicle, force: Array, pose: BodyPose) -> Array:
    """Return start and end of an arrow for each thruster with a visible force, world frame [m], (k, 2, 3).

    An arrow has the direction of the force on the vehicle. Its length is proportional to the root of the
    force, like the shaft speed, because a proportional length would be too small to see while a position is
    kept.
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
    """Return the segments of a line through points, (k - 1, 2, 3) [m]."""
    points = points[np.isfinite(points).all(axis=1)] if len(points) else points
    return np.stack([points[:-1], points[1:]], axis=1) if len(points) > 1 else np.zeros((0, 2, 3))


def box_edges(lower: Array, upper: Array) -> Array:
    """Return the twelve edges of a box, (12, 2, 3) [m]."""
    corners = _box(lower, upper).vertices
    pairs = [(i, i ^ bit) for i in range(8) for bit in (1, 2, 4) if i < i ^ bit]
    return np.array([[corners[a], corners[b]] for a, b in pairs])


def shown_of(vehicle: Vehicle, picture: Picture) -> npt.NDArray[np.uint8] | str:
    """Return a displayable reading of the vehicle's own sensors: a picture, a sonar's fan, or ranges as text."""
    from finssim.core.sonar_fan import fan_picture
    from finssim.robot.record_messages import FAN_ROWS
    from finssim.vehicles.device_files import SonarDevice, device_of

    if picture.image is None:
        ranges = [] if picture.ranges is None else picture.ranges.tolist()
        return ", ".join(f"{x:.2f} m" if np.isfinite(x) else "nothing in reach" for x in ranges)
    device = device_of(vehicle, picture.source)
    if not isinstance(device, SonarDevice):
        return picture.image
    return np.nan_to_num(fan_picture(picture.image, device.sector, FAN_ROWS)).astype(np.uint8)


def world_bodies(layout: WorldLayout) -> list[FixedBody]:
    """Return the bodies of the first world of a layout; copies in a row are one body.

    Planes end 15 m from their centre. Basins are omitted, because the stage draws walls.
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
    return [FixedBody(name, *_joined(meshes), colours[name]) for name, meshes in parts.items()]


def _joined(meshes: list[Mesh]) -> Mesh:
    """Return several meshes as one."""
    first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = np.concatenate([mesh.faces + i for mesh, i in zip(meshes, first, strict=False)])
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), faces)


def _mesh_of(shape: Shape) -> Mesh:
    """Return the triangles of a shape, in its axes."""
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
    """Return a box; its corners are ordered by x, y, z."""
    import trimesh.creation as made

    solid = made.box(bounds=[lower, upper])
    return Mesh(np.asarray(solid.vertices), np.asarray(solid.faces))


def _squares(places: list[tuple[Array, Array, float]], lift: float) -> Mesh:
    """Return squares perpendicular to the z axes of mounts, each with its edge, visible from both sides."""
    flat = 0.5 * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    vertices = [(edge * flat + [0.0, 0.0, lift]) @ R.T + np.asarray(position) for position, R, edge in places]
    faces = [np.array([[0, 1, 2], [0, 2, 3]]) + 4 * i for i in range(len(places))]
    return Mesh(np.concatenate(vertices), np.concatenate(faces))
