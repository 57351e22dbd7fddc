"""Importer of Stonefish scenarios (`.scn`): the robot with its parts, materials and thrusters.

Equations as of version 1.6 (commit b21eb8e), in axes forward, right, down:

    body = all parts: mass, centre and inertia of box, cylinder, sphere or mesh, solid or as a shell
    added mass = for each submerged external part, of the sphere, cylinder or ellipsoid around it: the mean of its three
                 numbers in all directions, and three moments in the axes of the part's inertia
    buoyancy = density g volume at the centre of each buoyant part, internal ones too
    drag = density Cd / 2 of the sum over faces that meet the flow of A cos v², along the flow; moments with the same Cd
    friction = density Cf of the sum over all faces of A v along the face

The drag of version 1.6 contains an additional factor of speed (v³), that of earlier versions the speed along the
face's normal. The documentation describes a quadratic drag; the imported drag equals that of version 1.6 at 1 m/s.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from finssim.core.budget import DEPTH, NODES
from finssim.core.importer import Importer
from finssim.core.mesh import (
    Faces,
    MeshError,
    Vertices,
    face_geometry,
    load_obj,
    load_stl,
    mesh_centroid,
    mesh_volume,
)
from finssim.core.rotations import quat_from_euler, quat_to_matrix
from finssim.core.xml_file import read_xml
from finssim.vehicles.importers.draft import LAG, Draft, put_controlled_axes, put_envelope
from finssim.vehicles.importers.elements import Element, numbers, refuse_unknown
from finssim.vehicles.importers.rigid import IDENTITY, LinkPose, combined, flu_of_frd, plain
from finssim.vehicles.importers.thrust_curve import (
    dead_zone,
    interpolated,
    mirrored,
    put_curve,
    quadratic,
    steady_speed,
)
from finssim.vehicles.importers.xacro_file import CALLS, CONSTANTS, evaluate, packages_near
from finssim.vehicles.part import VehicleError
from finssim.vehicles.vehicle import moved_to_origin

__all__ = ["STONEFISH", "added_mass", "drag", "enclosing_ellipsoid", "read_stonefish"]

Array = NDArray[np.float64]

GRAVITY, DENSITY = 9.81, 1000.0
"""Gravity [m/s²] and density of water [kg/m³] of Stonefish if a scenario defines none."""
SOLID = {
    "dimensions", "origin", "physical", "visual", "material", "look", "mass", "inertia", "cg", "hydrodynamics",
    "compound_transform", "contact", "external_part", "internal_part",
}  # fmt: skip
"""Child elements of a part."""
ACTUATOR = {"link", "origin", "specs", "propeller", "rotor_dynamics", "thrust_model", "watchdog"}
"""Child elements of a thruster."""


# The scenario: its files, arguments and expressions.


def word(element: Element | None, name: str, where: str, default: str | None = None) -> str:
    """Return an attribute; if it is missing, the default, or an error if there is none."""
    value = default if element is None else element.get(name, default)
    if value is None:
        raise VehicleError(f"{where}: {name} is missing: add it")
    return value


def values(element: Element | None, name: str, count: int, where: str, default: str | None = None) -> Array:
    """Return the numbers of an attribute, in its unit, (count,)."""
    return numbers(word(element, name, where, default), count, f"{where}: {name}")


def refuse_strange(element: Element, known: set[str], where: str, draft: Draft) -> None:
    """Refuse children with unknown names, except those of Stonefish's ROS package, which are noted.

    Args:
        element: Parent element.
        known: Known names.
        where: Name of the parent in messages.
        draft: Draft to which the notes are added.
    """
    ros = [child.tag for child in element if child.tag.startswith("ros_")]
    draft.not_read.update(f"{element.tag}: {tag}" for tag in ros)
    refuse_unknown(element, {*known, *ros}, where)


def scalar(element: Element | None, name: str, where: str, default: str | None = None) -> float:
    """Return the number in an attribute, in its unit."""
    return float(values(element, name, 1, where, default)[0])


def pose_of(element: Element | None, where: str) -> LinkPose:
    """Return the pose `xyz`, `rpy` of an element, in axes forward, right, down."""
    if element is None:
        raise VehicleError(f"{where} is missing: add it")
    angles = values(element, "rpy", 3, where)
    return LinkPose(quat_to_matrix(quat_from_euler(*angles)), values(element, "xyz", 3, where))


class ScenarioFiles:
    """Files of a scenario: in its folder, in a folder `data` near it, in given folders, or in ROS packages."""

    def __init__(self, path: Path, folders: Sequence[Path]) -> None:
        """
        Args:
            path: Scenario file.
            folders: Folders that are searched first.
        """
        own = path.resolve().parent
        self.packages = packages_near(path, folders)
        self.notes: list[str] = []
        near = [own, *(folder / "data" for folder in (own, *own.parents[:2]))]
        self.places = [x for folder in folders for x in (folder.resolve(), folder.resolve() / "data")] + near

    def find(self, name: str, where: str) -> Path:
        """Return a file that the scenario refers to.

        Raises:
            VehicleError: The file does not exist, or its path leads outside these folders.
        """
        package = re.match(r"\$\(find ([\w.-]+)\)/+", name)
        rest = name[package.end() :] if package else name
        places = [self.packages.get(package[1])] if package else self.places
        for place in places if re.fullmatch(r"(?!.*\.\.)[\w. +()-][\w. +()/-]*", rest) else ():
            file = None if place is None else place / rest
            if file is not None and file.is_file() and file.resolve().is_relative_to(place):
                return file
        raise VehicleError(
            f"{where}: no file '{name[:200]}' near the scenario: give its folder with --folder"
        )


def prepared(root: Element, arguments: Mapping[str, str], where: str) -> None:
    """Replace arguments and expressions in all attributes of a file."""
    calls = CALLS | {"ln": math.log, "log": math.log10}

    def argument(match: re.Match[str]) -> str:
        return arguments.get(match[1].strip(), match[0])

    def result(match: re.Match[str]) -> str:
        try:
            return repr(float(evaluate(match[1].replace("^", "**"), CONSTANTS, calls)))
        except (TypeError, VehicleError) as error:
            raise VehicleError(f"{where}: {error}") from None

    for element in root.iter():
        for key, text in element.attrib.items():
            text = re.sub(r"\$\(arg ([^)]*)\)", argument, text)
            element.set(key, re.sub(r"\$\{([^}]*)\}", result, text))


def scenario(path: Path, files: ScenarioFiles, draft: Draft) -> list[Element]:
    """Return the elements of a scenario and of the files that it includes."""
    root = read_xml(path, VehicleError)
    if root.tag != "scenario":
        raise VehicleError(f"{path}: its root is '{root.tag}', expected scenario")
    prepared(root, {}, str(path))
    waiting, out, included, count = list(root), [], 0, 0
    while waiting:
        element = waiting.pop(0)
        if element.tag != "include":
            count += sum(1 for _ in element.iter())
            out.append(element)
            continue
        included += 1
        if included > DEPTH or count > NODES:
            raise VehicleError(
                f"{path}: includes more than {DEPTH} files or {NODES} elements: make it smaller"
            )
        name = word(element, "file", f"{path}: include")
        try:
            inner = read_xml(files.find(name, f"{path}: include"), VehicleError)
        except VehicleError as error:
            draft.not_read[f"include ({str(error).removeprefix(f'{path}: ')})"] += 1
            continue
        given = {arg.get("name", ""): arg.get("value", "") for arg in element.findall("arg")}
        prepared(inner, given, str(path))
        waiting += list(inner)
    return out


# Parts: shapes, their mass, and their interaction with the water.


@dataclass
class Solid:
    """Part of a robot, in the frame of the base link, or in a levelled frame if that is tilted."""

    mass: float
    """Mass [kg]."""
    volume: float
    """Displaced volume, or 0 [m³]."""
    lift: Array
    """Centre of the displaced volume [m], (3,)."""
    frame: LinkPose
    """Frame at its centre of gravity, along the principal axes of inertia."""
    moments: Array
    """Moments of inertia [kg m²], (3,)."""
    added: tuple[float, Array]
    """Added mass [kg], and added moments of inertia [kg m²], (3,)."""
    turn: Array
    """Axes of the drag coefficients [-], (3, 3)."""
    coefficients: Array
    """Coefficients of drag and of friction [-], (2, 3)."""
    surface: tuple[Vertices, Faces] | None
    """Surface exposed to the water [m]; None if there is none."""


def split(vertices: Vertices, faces: Faces, chosen: NDArray[np.bool_]) -> tuple[Vertices, Faces]:
    """Return a mesh whose selected faces are divided into four, as in Stonefish."""
    a, b, c = faces[chosen].T
    edges = np.stack([a, b, b, c, c, a], axis=1).reshape(-1, 2)
    unique, first, index = np.unique(np.sort(edges, axis=1), axis=0, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    middle = vertices[unique[np.argsort(first)]].mean(axis=1)
    ab, bc, ca = (len(vertices) + rank[index.reshape(-1, 3)]).T
    new = np.stack([np.stack(x, axis=1) for x in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))])
    return np.vstack([vertices, middle]), np.vstack([faces[~chosen], new.transpose(1, 0, 2).reshape(-1, 3)])


def refined(vertices: Vertices, faces: Faces) -> tuple[Vertices, Faces]:
    """Return a mesh without faces larger than three times the mean area."""
    for _ in range(20):
        area = face_geometry(vertices, faces)[1]
        large = area > 3.0 * max(float(area.mean()), 1e-4)
        if not large.any() or len(faces) > 2_000_000:
            break
        vertices, faces = split(vertices, faces, large)
    return vertices, faces


def box_mesh(half: Array) -> tuple[Vertices, Faces]:
    """Return the mesh of a box with these half sides [m]; adjacent sides share no vertices."""
    sides = "--- -+- ++- +-- | +-- ++- +++ +-+ | --+ -++ -+- --- | +-+ +++ -++ --+ | +++ ++- -+- -++ | +-- +-+ --+ ---"
    corners = [corner for side in sides.split(" | ") for corner in side.split()]
    vertices = half * np.array([[1.0 if sign == "+" else -1.0 for sign in corner] for corner in corners])
    faces = np.array([[4 * k + i for i in triple] for k in range(6) for triple in ((0, 1, 2), (0, 2, 3))])
    for _ in range(3):
        vertices, faces = split(vertices, faces, np.ones(len(faces), bool))
    return vertices, faces


def cylinder_mesh(radius: float, half: float) -> tuple[Vertices, Faces]:
    """Return the mesh of a cylinder along z of this radius and half height [m], scaled to the volume of the
    cylinder."""
    n = int(max(math.ceil(20.0 * math.pi * radius), 32))
    step = 2.0 * math.pi / n
    radius *= math.sqrt(step / math.sin(step))
    angle = step * np.arange(n)
    ring = radius * np.stack([np.sin(angle), -np.cos(angle)], axis=1)
    vertices = np.vstack(
        [np.c_[ring, np.full(n, half)], np.c_[ring, np.full(n, -half)], [[0, 0, half], [0, 0, -half]]]
    )
    i, j = np.arange(n), np.roll(np.arange(n), -1)
    top, bottom = np.full(n, 2 * n), np.full(n, 2 * n + 1)
    faces = np.vstack(
        [np.c_[i, i + n, j + n], np.c_[i, j + n, j], np.c_[top, i, j], np.c_[bottom, j + n, i + n]]
    )
    for _ in range(2):
        vertices, faces = split(vertices, faces, np.ones(len(faces), bool))
    return vertices, faces


def sphere_mesh(radius: float) -> tuple[Vertices, Faces]:
    """Return the mesh of a sphere of this radius [m], scaled to the volume of the sphere."""
    vertices, faces = box_mesh(np.ones(3))
    vertices /= np.linalg.norm(vertices, axis=1)[:, None]
    return radius * (4.0 / 3.0 * math.pi / mesh_volume(vertices, faces)) ** (1.0 / 3.0) * vertices, faces


def mesh_moments(points: Array, density: float) -> Array:
    """Return the inertia (3, 3) [kg m²] about the origin of the solid enclosed by triangles (n, 3, 3) [m]."""
    volumes, total = np.linalg.det(points), points.sum(axis=1)
    P = np.einsum("n,nij,nik->jk", volumes, points, points) + np.einsum("n,nj,nk->jk", volumes, total, total)
    P *= density / 120.0
    return np.trace(P) * np.eye(3) - P


def enclosing_ellipsoid(points: Array) -> Array:
    """Return the half axes [m], (3,), of the ellipsoid that Stonefish fits around points (n, 3) [m].

    The algorithm is that of Kumar and Yildirim (2008), terminated when its volume is accurate to 20 % or
    after 10 steps.
    """
    weights = np.zeros(len(points))
    ends = []
    for axis in points.T:
        ends += [int(np.argmin(axis)), len(axis) - 1 - int(np.argmax(axis[::-1]))]
    for end in ends:
        weights[np.all(points == points[end], axis=1)] = 1.0 / 6.0
    steps = 0
    while True:
        mean = weights @ points
        # Flat parts have no extent along the third axis.
        spread = np.maximum(weights @ points**2 - mean**2, 1e-18)
        reach = ((points - mean) ** 2 / (3.0 * spread)).sum(axis=1)
        farthest = int(np.argmax(reach))
        excess = float(reach[farthest]) - 1.0
        if excess <= 1.2 ** (2.0 / 3.0) - 1.0 or steps == 10:
            break
        share = excess / (4.0 * (1.0 + excess))
        weights *= 1.0 - share
        weights[farthest] += share
        steps += 1
    return np.sqrt(3.0 * spread) if steps else np.ptp(points[ends], axis=0) / 2.0


def added_mass(kind: str, size: Array, density: float) -> tuple[Array, Array]:
    """Return the added masses [kg] and moments [kg m²] that Stonefish assigns to a shape, (3,) each.

    Args:
        kind: `sphere`, `cylinder` (along z) or `ellipsoid`.
        size: Radius; radius and length; or three half axes [m].
        density: Density of the water [kg/m³].
    """
    if kind == "sphere":
        return np.full(3, 2.0 / 3.0 * math.pi * density * size[0] ** 3), np.zeros(3)
    if kind == "cylinder":
        disc = density * math.pi * size[0] ** 2
        turning = disc * size[0] * size[1] ** 2 / 12.0
        return np.array([disc * size[1], disc * size[1], disc]), np.array([turning, turning, 0.0])
    a, b, c = size
    mean = (b + c) / 2.0
    e, lamb = 1.0 - mean**2 / a, 1.0
    if -1.0 < e < 1.0:
        alpha = 2.0 * (1.0 - e * e) / (e * e) * (0.5 * math.log((1.0 + e) / (1.0 - e)) - e) if e else 0.0
        lamb = alpha / (2.0 - alpha)
    ball, turn = 4.0 / 3.0 * math.pi * density * a, math.pi * density * a**3 / 12.0
    return ball * np.array([lamb * mean**2, c**2, b**2]), turn * np.array([0.0, b**2, c**2])


def drag(surface: tuple[Vertices, Faces], centre: Array, twist: Array) -> tuple[Array, Array]:
    """Return the sums over faces of drag and friction, without density and coefficients, (2, 3) forces and moments.

    Args:
        surface: Vertices (n, 3) [m] and faces (m, 3).
        centre: Reference point of the moments [m], (3,).
        twist: Velocity of this point and angular velocity of the body [m/s, rad/s], (6,).
    """
    normal, area, place = face_geometry(*surface)
    flow = -(twist[:3] + np.cross(twist[3:], place - centre))
    along = np.einsum("ni,ni->n", flow, normal)
    form = flow * (np.maximum(-along, 0.0) * area)[:, None]
    skin = (flow - along[:, None] * normal) * area[:, None]
    arms = place - centre
    return (
        np.array([form.sum(axis=0), np.cross(arms, form).sum(axis=0)]),
        np.array([skin.sum(axis=0), np.cross(arms, skin).sum(axis=0)]),
    )


def _measure(kind: str, size: Array) -> tuple[float, Array]:
    """Return volume [m³] and moments of inertia per mass [m²], (3,), of a box (half sides), cylinder or sphere."""
    if kind == "box":
        a, b, c = size**2
        return 8.0 * float(np.prod(size)), np.array([b + c, a + c, a + b]) / 3.0
    if kind == "cylinder":
        r, h = size
        across = (3.0 * r**2 + 4.0 * h**2) / 12.0
        return 2.0 * math.pi * r**2 * h, np.array([across, across, r**2 / 2.0])
    return 4.0 / 3.0 * math.pi * float(size[0]) ** 3, np.full(3, 0.4 * size[0] ** 2)


def _primitive(
    part: Element, kind: str, where: str
) -> tuple[float, Array, Array, LinkPose, tuple[Vertices, Faces]]:
    """Return volume, centre, moments per density, axes and mesh of a box, cylinder or sphere, in its frame."""
    dimensions = part.find("dimensions")
    if kind == "box":
        size = values(dimensions, "xyz", 3, where) / 2.0
        mesh = box_mesh(size)
    elif kind == "cylinder":
        size = np.array([scalar(dimensions, "radius", where), scalar(dimensions, "height", where) / 2.0])
        mesh = cylinder_mesh(*size)
    else:
        size = values(dimensions, "radius", 1, where)
        mesh = sphere_mesh(float(size[0]))
    if size.min() <= 0.0:
        raise VehicleError(f"{where}: its dimensions are {size.tolist()}, expected more than 0")
    half = scalar(dimensions, "thickness", where, "-1") / 2.0
    shell = 0.0 < half < size.min()
    volume, moments = _measure(kind, size + half if shell else size)
    moments = volume * moments
    if shell:
        hollow, inner = _measure(kind, size - half)
        volume, moments = volume - hollow, moments - hollow * inner
    return volume, np.zeros(3), moments, IDENTITY, mesh


def _model(
    part: Element, files: ScenarioFiles, where: str
) -> tuple[float, Array, Array, LinkPose, tuple[Vertices, Faces]]:
    """Return volume, centre, moments per density, principal axes, and mesh, of a part with a mesh, in the
    mesh's frame."""
    mesh = part.find("physical/mesh")
    file = files.find(word(mesh, "filename", f"{where}: mesh"), where)
    try:
        vertices, faces = (load_obj if file.suffix.lower() == ".obj" else load_stl)(file)
    except MeshError as error:
        raise VehicleError(f"{where}: {error}") from None
    vertices = vertices * scalar(mesh, "scale", where, "1")
    if mesh_volume(vertices, faces) < 0.0:
        faces = faces[:, ::-1]
    vertices, faces = refined(vertices, faces)
    shell = scalar(part.find("physical/thickness"), "value", where, "-1")
    normal, area, place = face_geometry(vertices, faces)
    volume = mesh_volume(vertices, faces)
    if shell <= 0.0 and volume <= 1e-9 * float(area.sum()) and part.find("mass") is not None:
        files.notes.append(f"{file.name} encloses no volume: its mass is spread over its surface")
        shell = 1e-3
    if shell > 0.0:
        volume, centre = float(area.sum()) * shell, np.average(place, axis=0, weights=area)
        step = normal[:, None] * shell / 2.0
        corners = vertices[faces] - centre
        inertia = mesh_moments(corners + step, 1.0) - mesh_moments(corners - step, 1.0)
    elif volume > 0.0:
        centre = mesh_centroid(vertices, faces)
        inertia = mesh_moments(vertices[faces] - centre, 1.0)
    else:
        raise VehicleError(f"{where}: {file.name} encloses no volume: close it, or give a thickness")
    turn = np.eye(3)
    if np.abs(inertia - np.diag(np.diag(inertia))).max() > 1e-6 * np.trace(inertia):
        turn = np.linalg.eigh(inertia)[1]
        turn[:, 2] = np.cross(turn[:, 0], turn[:, 1])
    moments = np.diag(turn.T @ inertia @ turn)
    return volume, centre, moments, LinkPose(turn, centre), (vertices, faces)


def solid_of(
    part: Element,
    place: LinkPose,
    external: bool,
    files: ScenarioFiles,
    densities: Mapping[str, float],
    water: float,
    where: str,
) -> Solid:
    """Return a part in the frame of its given pose.

    Args:
        part: Element of the part.
        place: Pose of the part.
        external: True if it is exposed to the water.
        files: Files of the scenario.
        densities: Material -> density [kg/m³].
        water: Density of the water [kg/m³].
        where: Name of the part in messages.
    """
    refuse_unknown(part, SOLID, where)
    kind, mode = word(part, "type", where), word(part, "physics", where, "submerged")
    if kind not in ("box", "cylinder", "sphere", "model"):
        raise VehicleError(
            f"{where}: type is '{kind}', expected one of box, cylinder, sphere, model: change it"
        )
    if mode not in ("submerged", "floating", "surface", "aerodynamic", "disabled"):
        raise VehicleError(f"{where}: physics is '{mode}', expected submerged or floating: change it")
    outer = pose_of(part.find("physical/origin" if kind == "model" else "origin"), f"{where}: origin")
    form = _model(part, files, where) if kind == "model" else _primitive(part, kind, where)
    volume, centre, moments, axes, mesh = form
    frame, at = outer.after(axes), place.after(outer)

    # Its shape in the water, in its principal axes.
    points = (mesh[0] - axes.place) @ axes.turn
    fit = {"model": "ellipsoid", "box": "ellipsoid"}.get(kind, kind)
    if fit == "sphere":
        size, Cd = np.array([np.linalg.norm(points, axis=1).max()]), np.ones(3)
    elif fit == "cylinder":
        size = np.array([np.linalg.norm(points[:, :2], axis=1).max(), 2.0 * np.abs(points[:, 2]).max()])
        Cd = np.array([0.5, 0.5, 1.0])
    else:
        size = enclosing_ellipsoid(points)
        Cd = size.min() / size
    added, turning = added_mass(fit, size, water)
    Cd = np.abs(frame.turn @ Cd)
    coefficients = np.array([Cd, 0.1 * Cd])
    for row, name in enumerate(("quadratic_drag", "viscous_drag")):
        own = values(part.find("hydrodynamics"), name, 3, where, "-1 -1 -1")
        coefficients[row] = own if own.min() >= 0.0 else coefficients[row]

    # Its mass, from its material or as given.
    mass, cg = scalar(part.find("mass"), "value", where, "-1"), part.find("cg")
    own = values(part.find("inertia"), "xyz", 3, where, "0 0 0")
    material = word(part.find("material"), "name", f"{where}: material")
    if material not in densities and (mass <= 0.0 or (cg is not None and not own.any())):
        raise VehicleError(
            f"{where}: material '{material}' is in no file that was read: give the scenario that includes it or a mass"
        )
    density = densities.get(material, 1.0)
    own_mass, moments = density * volume, density * moments
    if mass > 0.0 and not own.any() and cg is None:
        moments = moments * mass / own_mass
    elif own.any():
        moments = own
    if cg is not None:
        frame = pose_of(cg, f"{where}: cg")
    wet = mode in ("submerged", "floating")
    return Solid(
        mass if mass > 0.0 else own_mass,
        volume if wet and word(part, "buoyant", where, "true").lower() in ("true", "1") else 0.0,
        at.turn @ centre + at.place,
        place.after(frame),
        moments,
        (float(added.mean()), turning) if external and mode == "submerged" else (0.0, np.zeros(3)),
        place.turn,
        coefficients,
        (mesh[0] @ at.turn.T + at.place, mesh[1]) if external and wet else None,
    )


def solids_of(link: Element, pose: LinkPose, *context: object, where: str) -> list[Solid]:
    """Return the parts of a link in the frame of its given pose; `context` is that of `solid_of`."""
    if word(link, "physics", where, "submerged") not in ("submerged", "floating"):
        raise VehicleError(
            f"{where}: physics is '{link.get('physics')}', expected submerged or floating: change it"
        )
    if word(link, "type", where) != "compound":
        return [solid_of(link, pose, True, *context, where)]
    refuse_unknown(link, SOLID, where)
    parts = []
    for tag in ("external_part", "internal_part"):
        for part in link.findall(tag):
            at = f"{where}: part '{part.get('name', '')}'"
            place = pose.after(pose_of(part.find("compound_transform"), f"{at}: compound_transform"))
            parts.append(solid_of(part, place, tag == "external_part", *context, at))
    if not parts:
        raise VehicleError(f"{where}: has no part, expected one or more external ones: add them")
    return parts


def rigid(parts: Sequence[Solid], augmented: bool) -> tuple[float, Array, Array]:
    """Return mass [kg], centre of gravity (3,) [m], and inertia (3, 3) [kg m²] about it, optionally with
    added mass."""
    mass, centre, inertia = combined(
        [part.mass for part in parts],
        [part.frame.place for part in parts],
        [part.frame.turn @ np.diag(part.moments) @ part.frame.turn.T for part in parts],
    )
    if augmented:
        for part in parts:
            r, (more, turning) = part.frame.place - centre, part.added
            inertia = inertia + part.frame.turn @ np.diag(turning) @ part.frame.turn.T
            inertia = inertia + more * (r @ r * np.eye(3) - np.outer(r, r))
            mass += more
    return mass, centre, inertia


def water_wrench(
    links: Sequence[Sequence[Solid]], centre: Array, twist: Array, density: float
) -> tuple[Array, Array]:
    """Return the wrenches of drag and of friction about a point, (6,) each [N, N m].

    Args:
        links: Parts of each link.
        centre: Reference point [m], (3,).
        twist: Velocity of the point and angular velocity, in axes forward, right, down [m/s, rad/s], (6,).
        density: Density of the water [kg/m³].
    """
    out = np.zeros((2, 6))
    for parts in links:
        arm = rigid(parts, False)[1] - centre
        own = np.concatenate([twist[:3] + np.cross(twist[3:], arm), twist[3:]])
        for part in parts:
            if part.surface is None:
                continue
            for row, sums in enumerate(drag(part.surface, centre + arm, own)):
                factor = density * (0.5 if row == 0 else 1.0)
                force, moment = (
                    factor
                    * (np.abs(part.turn.T @ x) @ part.coefficients[row])
                    / max(np.linalg.norm(x), 1e-30)
                    * x
                    for x in sums
                )
                out[row] += np.concatenate([force, moment + np.cross(arm, force)])
    return out[0], out[1]


# The robot.


def _links(
    robot: Element, context: tuple[object, ...], draft: Draft, where: str
) -> dict[str, tuple[LinkPose, list[Solid]]]:
    """Return, for every link, name -> pose in the base link, and its parts in that frame."""
    base = robot.find("base_link")
    if base is None:
        raise VehicleError(f"{where}: base_link is missing: add it")
    elements = {link.get("name", ""): link for link in [base, *robot.findall("link")]}
    poses = {base.get("name", ""): IDENTITY}
    start = robot.find("world_transform")
    known = start is not None and "$" not in start.get("rpy", "")
    angles = values(start, "rpy", 3, f"{where}: world_transform") if known else np.zeros(3)
    upright = quat_to_matrix(quat_from_euler(angles[0], angles[1], 0.0))
    if upright[2, 2] < 0.0:
        poses = {base.get("name", ""): LinkPose(upright, np.zeros(3))}
        draft.different.append("base_link is upside down in the scenario: the body's axes are level there")
    joints = list(robot.findall("joint"))
    held = []
    while joints:
        ready = [joint for joint in joints if word(joint.find("parent"), "name", f"{where}: joint") in poses]
        if not ready:
            raise VehicleError(
                f"{where}: joint '{joints[0].get('name', '')}' holds to no link of the robot: correct it"
            )
        joints = [joint for joint in joints if joint not in ready]
        for joint in ready:
            refuse_unknown(
                joint,
                {"parent", "child", "origin", "axis", "limits", "damping", "initial"},
                f"{where}: joint",
            )
            inner = pose_of(joint.find("origin"), f"{where}: origin of joint '{joint.get('name', '')}'")
            child = word(joint.find("child"), "name", f"{where}: joint")
            poses[child] = poses[word(joint.find("parent"), "name", where)].after(inner)
            if joint.get("type") != "fixed":
                held.append(f"'{joint.get('name', '')}' ({joint.get('type')})")
    if held:
        draft.different.append(f"joints held where the file puts them: {', '.join(held)}")
    for name in elements.keys() ^ poses.keys():
        raise VehicleError(
            f"{where}: link '{name}' is not joined to the base link, or is not there: correct it"
        )
    return {
        name: (poses[name], solids_of(link, poses[name], *context, where=f"{where}: link '{name}'"))
        for name, link in elements.items()
    }


def _put_propeller(actuator: Element, name: str, draft: Draft, where: str) -> None:
    """Set thrust, torque, limits and time constant of a thruster, in the old or the new syntax."""

    def of(place: str, default: str | None = None) -> float:
        tag, _, attribute = place.partition("@")
        return scalar(actuator.find(tag), attribute or "value", f"{where}: {tag}", default)

    def kind_of(tag: str) -> str:
        return word(actuator.find(tag), "type", f"{where}: {tag}")

    right = word(actuator.find("propeller"), "right", f"{where}: propeller").lower() in ("true", "1")
    diameter, old = of("propeller@diameter"), actuator.find("specs[@max_rpm]") is not None
    factor = draft.values["water"]["density"] * diameter**4 / (4.0 * math.pi**2)
    model = "fluid_dynamics" if old else kind_of("thrust_model")
    if model == "fluid_dynamics":  # coefficients of the force ahead and astern, for both rotations
        if old:
            ahead, turning = of("specs@thrust_coeff"), of("specs@torque_coeff", "0")
            astern = of("specs@thrust_coeff_backward", repr(ahead))
        else:
            ahead, astern = (of(f"thrust_model/thrust_coeff@{side}") for side in ("forward", "reverse"))
            turning = of("thrust_model/torque_coeff")
        curve = quadratic(factor * ahead, factor * astern, where)
        torque = factor * diameter * turning * (1.0 if right else -1.0)
        draft.put(f"thrusters.{name}.torque_constant", torque, "derived", "torque_coeff")
        falls = "the thrust of Stonefish falls with the inflow; here it does not"
        draft.different += [falls] if falls not in draft.different else []
    elif model == "quadratic":
        curve = quadratic(*2 * [abs(of("thrust_model/thrust_coeff"))], where)
    elif model == "deadband":
        sides = ("thrust_coeff@reverse", "thrust_coeff@forward", "deadband@lower", "deadband@upper")
        curve = dead_zone(*(of(f"thrust_model/{side}") for side in sides), where)
    elif model == "linear_interpolation":
        texts = [
            word(actuator.find(f"thrust_model/{x}"), "value", f"{where}: {x}") for x in ("input", "output")
        ]
        columns = [numbers(text, len(texts[0].split()), f"{where}: thrust_model") for text in texts]
        curve = interpolated(columns[0], columns[1], where)
    else:
        known = "quadratic, deadband, linear_interpolation or fluid_dynamics"
        raise VehicleError(f"{where}: thrust_model is '{model}', expected {known}: correct it")
    if not right and model != "fluid_dynamics":
        curve = mirrored(curve)

    dynamics = "" if old else kind_of("rotor_dynamics")
    greatest = of("specs@max_rpm") * math.pi / 30.0 if old else abs(of("specs@max_setpoint"))
    lag: float | None = None
    how = f"the dynamics {dynamics} have none"
    if old:
        lag, how = 1.0 / 8.0, "proportional gain 8 of its controller"
    elif dynamics == "first_order":
        lag, how = of("rotor_dynamics/time_constant"), "time_constant"
    elif dynamics == "mechanical_pi":
        how = "the inertia of the rotor is computed from its mesh"
        if actuator.find("rotor_dynamics/rotor_inertia") is not None:
            lag, how = of("rotor_dynamics/rotor_inertia") / of("rotor_dynamics/kp"), "rotor_inertia / kp"
    elif dynamics == "yoerger":
        greatest = steady_speed(of("rotor_dynamics/beta"), 0.0, of("rotor_dynamics/alpha"), where)(greatest)
    elif dynamics == "bessa":
        kt, rm, kv1, kv2 = (of(f"rotor_dynamics/{x}") for x in ("kt", "rm", "kv1", "kv2"))
        greatest = steady_speed(kt / rm, kv1, kv2, where)(greatest)
    elif dynamics != "zero_order":
        known = "zero_order, first_order, yoerger, bessa or mechanical_pi"
        raise VehicleError(f"{where}: rotor_dynamics is '{dynamics}', expected {known}: correct it")
    put_curve(
        draft, name, curve, curve.thrust(-greatest), curve.thrust(greatest), "greatest speed of the thruster"
    )
    if lag is None:
        draft.guess(f"thrusters.{name}.time_constant", LAG, how)
    else:
        draft.put(f"thrusters.{name}.time_constant", lag, "derived", how)


def _placed(
    actuator: Element, links: Mapping[str, tuple[LinkPose, list[Solid]]], draft: Draft, where: str
) -> tuple[str, LinkPose]:
    """Return name and pose of an actuator in the base link."""
    kind = "rudder" if actuator.get("type") == "rudder" else "thruster"
    name = re.sub(r"[^A-Za-z0-9_-]", "_", actuator.get("name", "") or kind)[:64]
    link = word(actuator.find("link"), "name", f"{where}: link")
    if (
        name in {**draft.values.get("thrusters", {}), **draft.values.get("actuators", {})}
        or link not in links
    ):
        raise VehicleError(
            f"{where}: its name is there twice, or its link '{link}' is not of the robot: correct it"
        )
    return name, links[link][0].after(pose_of(actuator.find("origin"), f"{where}: origin"))


RUDDER = {"specs", "visual", "origin", "link", "watchdog"}
"""Child elements of a rudder."""
ENDLESS = 1.5
"""Stall angle of a rudder without one in the file [rad]."""


def _put_rudder(
    actuator: Element, links: Mapping[str, tuple[LinkPose, list[Solid]]], draft: Draft, where: str
) -> None:
    """Set a rudder that rotates about the z axis of its origin: lift is lift_coeff times the angle, drag
    quadratic in the angle."""
    refuse_strange(actuator, RUDDER, where, draft)
    (name, pose), specs = _placed(actuator, links, draft, where), actuator.find("specs")
    lift, drag, area, most = (
        scalar(specs, key, f"{where}: specs", default)
        for key, default in (("lift_coeff", None), ("drag_coeff", "0"), ("area", None), ("max_angle", None))
    )
    if min(lift, area, most) <= 0.0 or drag < 0.0:
        raise VehicleError(
            f"{where}: expected lift_coeff, area and max_angle above 0 and drag_coeff of 0 or more"
        )
    path = f"actuators.{name}"
    draft.put(f"{path}.kind", "fin")
    draft.put(f"{path}.position", plain(flu_of_frd(pose.place)))
    for key, column in (("span", 2), ("chord", 0)):
        draft.put(f"{path}.{key}", plain(flu_of_frd(pose.turn[:, column])), "derived", "axes of its origin")
    draft.put(f"{path}.area", area)
    draft.put(f"{path}.lift_slope", lift)
    draft.put(f"{path}.drag", [0.0, 0.0, drag], "derived", "drag_coeff")
    stall = scalar(specs, "stall_angle", f"{where}: specs", repr(ENDLESS))
    draft.put(f"{path}.stall", min(stall, ENDLESS), "derived", "stall_angle")
    draft.put(f"{path}.minimum", -most)
    draft.put(f"{path}.maximum", most)
    if specs is not None and specs.get("max_angular_rate"):
        draft.put(f"{path}.rate_limit", scalar(specs, "max_angular_rate", f"{where}: specs"))
    if word(specs, "inverted", where, "false").lower() in ("true", "1"):
        draft.different.append(f"inverted: positive commands of '{name}' turn it about its own z axis here")


def _put_thruster(
    actuator: Element, links: Mapping[str, tuple[LinkPose, list[Solid]]], draft: Draft, where: str
) -> None:
    """Set a thruster, or a force actuator of limited magnitude as a thruster."""
    refuse_strange(actuator, ACTUATOR, where, draft)
    name, pose = _placed(actuator, links, draft, where)
    path = f"thrusters.{name}"
    draft.put(f"{path}.position", plain(flu_of_frd(pose.place)))
    draft.put(f"{path}.axis", plain(flu_of_frd(pose.turn[:, 0])), "derived", "x axis of its origin")
    if actuator.get("type") == "thruster":
        _put_propeller(actuator, name, draft, where)
        return
    specs, kind = actuator.find("specs"), "" if actuator.get("type") == "push" else "thrust_"
    ends = [-math.inf, math.inf]
    if specs is not None and specs.get(f"lower_{kind}limit") and specs.get(f"upper_{kind}limit"):
        own = [scalar(specs, f"{end}_{kind}limit", where) for end in ("lower", "upper")]
        ends = own if own[0] < own[1] else ends
    factor = abs(ends[1] if math.isfinite(ends[1]) else draft.values["body"]["mass"]) / (100.0 * math.pi) ** 2
    put_curve(draft, name, quadratic(factor, factor, where), *ends, "limits of the thruster")
    own = draft.values["thrusters"][name]
    for key in ("c_plus", "c_minus", "rpm_min", "rpm_max"):
        draft.guess(f"{path}.{key}", own[key], "a force has no shaft: 3000 rpm at its limit")
    own["domain"] = "force"
    draft.guess(f"{path}.time_constant", LAG, "the force follows at once")


def read_stonefish(path: Path, folders: Sequence[Path] = ()) -> Draft:
    """Read the robot of a scenario.

    Args:
        path: The scenario, or a file of the robot that it includes.
        folders: Folders that are searched for referenced files, besides its folder and `data` near it.

    Raises:
        VehicleError: The scenario cannot be read; the message states location, expected content and remedy.
    """
    files, draft = ScenarioFiles(path, folders), Draft(str(path), "")
    elements = scenario(path, files, draft)
    robots = [element for element in elements if element.tag == "robot"]
    if not robots:
        raise VehicleError(f"{path}: has no robot, expected one: give the file that has it")
    robot = robots[0]
    name = re.sub(r"\$\(arg ([^)]*)\)", r"\1", word(robot, "name", f"{path}: robot"))
    draft.source = f"{path.name}, robot {name} (Stonefish)"
    draft.values |= {
        "title": f"{name} (Stonefish)",
        "description": f"Read by FinsSim from {path.name}, a scenario of Stonefish.",
    }
    for other in robots[1:]:
        draft.not_read[f"robot {other.get('name', '')}: give a file with it alone"] += 1
    for element in elements:
        if element.tag not in ("robot", "materials", "environment"):
            draft.not_read[f"scenario: {element.tag}"] += 1
    refuse_strange(
        robot,
        {"base_link", "link", "joint", "sensor", "actuator", "light", "comm", "world_transform"},
        f"{path}: robot",
        draft,
    )
    for tag in ("sensor", "light", "comm"):
        if robot.find(tag) is not None:
            draft.not_read[f"{tag} of the robot"] += len(robot.findall(tag))

    oceans = [x for e in elements if e.tag == "environment" for x in e.iter("water") if x.get("density")]
    draft.guess("water.gravity", GRAVITY, "a scenario gives none: that of Stonefish")
    if oceans:
        draft.put("water.density", scalar(oceans[0], "density", f"{path}: water"))
    else:
        draft.guess("water.density", DENSITY, "the file gives none: that of Stonefish")
    water = draft.values["water"]["density"]
    densities = {
        x.get("name", ""): scalar(x, "density", f"{path}: material '{x.get('name', '')}'")
        for e in elements
        if e.tag == "materials"
        for x in e.findall("material")
    }
    links = _links(robot, (files, densities, water), draft, str(path))
    _put_body(links, water, files, draft)
    for actuator in robot.findall("actuator"):
        kind = actuator.get("type", "")
        where = f"{path}: actuator '{actuator.get('name', '')}'"
        if kind in ("thruster", "simple_thruster", "push"):
            _put_thruster(actuator, links, draft, where)
        elif kind == "rudder":
            _put_rudder(actuator, links, draft, where)
        elif kind in ("motor", "servo", "propeller", "vbs", "suction_cup"):
            draft.not_read[f"actuator {kind}"] += 1
        else:
            raise VehicleError(f"{where}: unknown type '{kind}': correct it")
    if not draft.values.get("thrusters"):
        raise VehicleError(f"{path}: the robot has no thruster, expected one or more: add them")
    solids = [solid for _, parts in links.values() for solid in parts]
    put_envelope(draft, [x.surface[0] * [1.0, -1.0, -1.0] for x in solids if x.surface is not None])
    put_controlled_axes(draft)
    return draft


def _put_body(
    links: Mapping[str, tuple[LinkPose, list[Solid]]], water: float, files: ScenarioFiles, draft: Draft
) -> None:
    """Set mass, buoyancy and hydrodynamics."""
    groups = [parts for _, parts in links.values()]
    solids = [solid for parts in groups for solid in parts]
    mass, centre, inertia = rigid(solids, False)
    note = f"sum of {len(solids)} parts"
    draft.put("body.mass", mass, "derived", note)
    draft.put("body.center_of_gravity", plain(flu_of_frd(centre)), "derived", note)
    draft.put("body.inertia", plain(flu_of_frd(inertia)), "derived", note)
    volume = sum(solid.volume for solid in solids)
    if volume > 0.0:
        lift = np.average([x.lift for x in solids], axis=0, weights=[x.volume for x in solids])
        draft.put("body.displaced_volume", volume, "derived", f"buoyant ones of {len(solids)} parts")
        note = f"buoyant ones of {len(solids)} parts"
        draft.put("body.center_of_buoyancy", plain(flu_of_frd(lift)), "derived", note)
    else:
        draft.guess("body.displaced_volume", mass / water, "no part is buoyant: neutral buoyancy")
        how = "no part is buoyant: at the centre of gravity"
        draft.guess("body.center_of_buoyancy", plain(flu_of_frd(centre)), how)
    added = np.zeros((6, 6))
    for parts in groups:
        m, c, bare = rigid(parts, False)
        more, _, full = rigid(parts, True)
        matrix = np.zeros((6, 6))
        matrix[:3, :3], matrix[3:, 3:] = (more - m) * np.eye(3), full - bare
        added += moved_to_origin(matrix, c - centre)
    D1, D2 = np.zeros((6, 6)), np.zeros((6, 6))
    for k, twist in enumerate(np.eye(6)):
        ahead, astern = (water_wrench(groups, centre, sign * twist, water) for sign in (1.0, -1.0))
        D2[:, k], D1[:, k] = (astern[0] - ahead[0]) / 2.0, (astern[1] - ahead[1]) / 2.0
    for key, matrix in (("added_mass", added), ("linear_damping", D1), ("quadratic_damping", D2)):
        full = plain(flu_of_frd(matrix))
        draft.put(f"hydrodynamics.calibrated.{key}", full, "derived", "from the shapes, as Stonefish")
    point = plain(flu_of_frd(centre))
    draft.put("hydrodynamics.calibrated.reference_point", point, "derived", "centre of gravity")
    draft.different += files.notes + [
        "the added mass is that of Stonefish: one number for all directions, and no couplings",
        "drag is quadratic and equal to that of Stonefish 1.6 at 1 m/s; there it grows with the cube of the speed",
        "drag is summed for motion along and about each axis alone; between them FinsSim adds the axes up",
    ]


def _recognises(path: Path, head: bytes) -> bool:
    return b"<scenario" in head or path.suffix.lower() == ".scn"


STONEFISH = Importer("vehicle", "Stonefish (.scn)", _recognises, read_stonefish, folders=True)
