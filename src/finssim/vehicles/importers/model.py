"""Models with links, joints and collision shapes, as in SDF: frames, rigid body, and displaced volume."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from finssim.core.mesh import MeshError, check_closed, load_stl, mesh_volume
from finssim.core.rotations import quat_from_euler, quat_to_matrix
from finssim.vehicles.importers.draft import Draft, unread
from finssim.vehicles.importers.elements import Element, file_of_model, flag, number, numbers, refuse_unknown
from finssim.vehicles.importers.rigid import IDENTITY, LinkPose, combined, plain
from finssim.vehicles.part import VehicleError, did_you_mean

__all__ = [
    "CollisionShape", "Model", "note_rest", "pose_of", "put_body", "put_displacement", "put_hull",
    "put_physical_inertia", "shape_volume", "shapes_of",
]  # fmt: skip

Array = NDArray[np.float64]

INERTIA = {"ixx", "ixy", "ixz", "iyy", "iyz", "izz"}
"""Child elements of an inertia."""
SHAPES = {
    "box": ("size",), "ellipsoid": ("radii",), "sphere": ("radius",), "cylinder": ("radius", "length"),
    "capsule": ("radius", "length"), "cone": ("radius", "length"), "mesh": ("uri", "scale"),
    "plane": ("normal", "size"), "empty": (),
}  # fmt: skip
"""Shape -> its child elements."""


def pose_of(element: Element | None, where: str) -> LinkPose:
    """Return the pose of an element `pose`: x y z, then roll pitch yaw, or a quaternion.

    Args:
        element: The element; None for the identity.
        where: Name of the element in messages.
    """
    if element is None or not (element.text or "").strip():
        return IDENTITY
    if element.get("rotation_format", "euler_rpy") == "quat_xyzw":
        values = numbers(element.text, 7, f"{where}: pose")
        length = float(np.linalg.norm(values[3:]))
        if length < 1e-6:
            raise VehicleError(f"{where}: pose has a quaternion of length 0, expected 1")
        return LinkPose(quat_to_matrix(values[3:] / length), values[:3])
    values = numbers(element.text, 6, f"{where}: pose")
    angles = (
        np.radians(values[3:]) if element.get("degrees", "false").lower() in ("true", "1") else values[3:]
    )
    return LinkPose(quat_to_matrix(quat_from_euler(*angles)), values[:3])


def shape_volume(shape: Element, where: str) -> float:
    """Return the volume of a shape other than a mesh [m³]."""

    def of(tag: str) -> float:
        length = number(shape, tag, where)
        if length < 0.0:
            raise VehicleError(f"{where}: {tag} is {length:g}, expected 0 or more")
        return length

    if shape.tag in ("box", "ellipsoid"):
        tag, factor = ("size", 1.0) if shape.tag == "box" else ("radii", 4.0 / 3.0 * math.pi)
        sides = numbers(shape.findtext(tag), 3, f"{where}: {tag}")
        if sides.min() < 0.0:
            raise VehicleError(f"{where}: {tag} is {sides.tolist()}, expected 3 numbers of 0 or more")
        return factor * float(np.prod(sides))
    if shape.tag in ("plane", "empty"):
        return 0.0
    ball = 4.0 / 3.0 * math.pi * of("radius") ** 3
    if shape.tag == "sphere":
        return ball
    column = math.pi * of("radius") ** 2 * of("length")
    return column / 3.0 if shape.tag == "cone" else column + (ball if shape.tag == "capsule" else 0.0)


def _half_size(shape: Element) -> Array:
    """Return half the sides of the bounding box of a shape other than a mesh, in its frame [m], (3,)."""
    if shape.tag == "box":
        return numbers(shape.findtext("size"), 3, "size") / 2.0
    if shape.tag == "ellipsoid":
        return numbers(shape.findtext("radii"), 3, "radii")
    radius, length = number(shape, "radius", shape.tag, 0.0), number(shape, "length", shape.tag, 0.0)
    ends = radius if shape.tag in ("capsule", "sphere") else 0.0
    return np.array([radius, radius, length / 2.0 + ends])


class Model:
    """Model whose links and frames have poses in the body frame, which is the frame of the link with
    hydrodynamics."""

    def __init__(
        self, element: Element, label: str, draft: Draft, packages: Mapping[str, Path] | None = None
    ) -> None:
        """
        Args:
            element: The element `model`.
            label: Name of the model in messages.
            draft: Draft to which unread contents are added.
            packages: Name -> folder of packages that may contain its meshes.
        """
        self.element, self.label, self.draft = element, label, draft
        self.packages = packages or {}
        self.links = self._named("link")
        self.joints = self._named("joint")
        self.frames = self._named("frame")
        for tag in ("include", "model"):
            if element.find(tag) is not None:
                raise VehicleError(
                    f"{label}: has a {tag} inside: write it as one model with 'gz sdf -p FILE'"
                )
        if flag(element, "static", label):
            raise VehicleError(f"{label}: is static, expected a model that moves")
        self._poses: dict[str, LinkPose] = {}
        self.body = IDENTITY

    def _named(self, tag: str) -> dict[str, Element]:
        found: dict[str, Element] = {}
        for element in self.element.findall(tag):
            name = element.get("name", "")
            if not name or name in found:
                raise VehicleError(f"{self.label}: {tag} '{name}' is there twice or has no name: rename it")
            found[name] = element
        return found

    def pose(self, name: str, above: tuple[str, ...] = ()) -> LinkPose:
        """Return the pose of a link, joint or frame in the body frame."""
        return self.body.inverse().after(self._in_model(name, above))

    def _in_model(self, name: str, above: tuple[str, ...]) -> LinkPose:
        if name == "__model__":
            return IDENTITY
        if name in above:
            raise VehicleError(f"{self.label}: the pose of '{name}' depends on itself: {' -> '.join(above)}")
        if name in self._poses:
            return self._poses[name]
        element = self.links.get(name, self.joints.get(name, self.frames.get(name)))
        if element is None:
            known = [*self.links, *self.joints, *self.frames]
            raise VehicleError(f"{self.label}: no link, joint or frame '{name}'{did_you_mean(name, known)}")
        pose, default = element.find("pose"), "__model__"
        if name in self.joints:
            default = self.text(element, "child")
        elif name in self.frames:
            default = element.get("attached_to") or "__model__"
        reference = (None if pose is None else pose.get("relative_to")) or default
        if len(above) > 50:
            raise VehicleError(
                f"{self.label}: the pose of '{name}' depends on more than 50 frames: make it fewer"
            )
        outer = self._in_model(reference, (*above, name))
        self._poses[name] = outer.after(pose_of(pose, f"{self.label}: {element.tag} '{name}'"))
        return self._poses[name]

    def text(self, element: Element, tag: str) -> str:
        """Return the text of a required child element."""
        text = (element.findtext(tag) or "").strip()
        if not text:
            raise VehicleError(
                f"{self.label}: {element.tag} '{element.get('name', '')}': {tag} is missing: add it"
            )
        return text

    def link_of(self, name: str) -> str:
        """Return the link that a joint refers to, directly or through a frame that is attached to it."""
        for _ in range(50):
            if name in self.links or name not in self.frames:
                break
            name = self.frames[name].get("attached_to", "")
        if name not in self.links:
            raise VehicleError(f"{self.label}: a joint names '{name}', expected a link of the model")
        return name

    def set_body(self, base: str, where: str) -> None:
        """Use the frame of a link as the body frame, and refuse links that are not joined to it.

        Args:
            base: Name of the link.
            where: Name of the referring element in messages.
        """
        if base not in self.links:
            raise VehicleError(
                f"{self.label}: {where}: no link '{base}'{did_you_mean(base, list(self.links))} correct it"
            )
        self.body = self.pose(base)
        pairs = [
            (self.link_of(self.text(j, "parent")), self.link_of(self.text(j, "child")))
            for j in self.joints.values()
        ]
        held, before = {base}, 0
        while len(held) > before:
            before = len(held)
            held |= {name for pair in pairs for name in pair if held & set(pair)}
        for name in self.links.keys() - held:
            raise VehicleError(f"{self.label}: link '{name}' is not joined to '{base}': join it or remove it")

    def pose_in(self, link: str, element: Element, where: str) -> LinkPose:
        """Return the pose in the body frame of a child of a link, such as a collision."""
        pose = element.find("pose")
        reference = (None if pose is None else pose.get("relative_to")) or link
        return self.pose(reference).after(pose_of(pose, where))


def put_body(model: Model, draft: Draft) -> None:
    """Set mass, centre of gravity and inertia of all links combined, as one rigid body."""
    masses, centres, tensors = [], [], []
    massless, momentless = [], []
    for name, link in model.links.items():
        where = f"{model.label}: link '{name}'"
        inertial = link.find("inertial")
        if not flag(link, "gravity", where, True) or flag(link, "kinematic", where):
            raise VehicleError(
                f"{where}: has no weight (gravity or kinematic), expected a link that falls: change it"
            )
        unread(link, {"inertial", "collision", "pose", "gravity", "kinematic"}, "link", draft)
        if inertial is None:
            inertial = Element("inertial")
        if inertial.find("mass") is None:
            massless.append(name)
        if any(inertial.find(f"inertia/{tag}") is None for tag in ("ixx", "iyy", "izz")):
            momentless.append(name)
        if inertial.get("auto", "false").lower() in ("true", "1"):
            raise VehicleError(
                f"{where}: its mass is computed from its shapes (auto): write the numbers of it instead"
            )
        unread(inertial, {"mass", "pose", "inertia", "fluid_added_mass"}, "inertial", draft)
        pose = model.pose_in(name, inertial, where)
        tensor, inertia = np.zeros((3, 3)), inertial.find("inertia")
        for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
            tag = f"i{'xyz'[i]}{'xyz'[j]}"
            usual = 1.0 if i == j else 0.0
            tensor[i, j] = tensor[j, i] = usual if inertia is None else number(inertia, tag, where, usual)
        if inertia is not None:
            refuse_unknown(inertia, INERTIA, where)
        masses.append(number(inertial, "mass", where, 1.0))
        centres.append(pose.place)
        tensors.append(pose.turn @ tensor @ pose.turn.T)
    if min(masses) < 0.0 or sum(masses) <= 0.0:
        raise VehicleError(f"{model.label}: its links weigh {masses} kg, expected more than 0")
    mass, centre, total = combined(masses, centres, tensors)
    note = f"sum of {len(masses)} links" if len(masses) > 1 else ""
    for path, value, without in (
        ("mass", mass, massless),
        ("center_of_gravity", centre, massless),
        ("inertia", total, massless + momentless),
    ):
        if without:
            links = f"link '{without[0]}'{' and others' if without[1:] else ''}"
            draft.guess(
                f"body.{path}", plain(value), f"the file lacks numbers of {links}: 1 kg, 1 kg m² as in SDF"
            )
        else:
            draft.put(f"body.{path}", plain(value), "derived" if note else "published", note)


class CollisionShape(NamedTuple):
    """Collision shape."""

    link: str
    """Name of its link."""
    pose: LinkPose
    """Pose of the shape in the body frame."""
    volume: float
    """Volume [m³]."""
    corners: Array
    """Points that bound the shape, in the body frame [m], (n, 3)."""
    faces: NDArray[np.int64] | None
    """Faces of a mesh with the corners as vertices, (m, 3); None for other shapes."""


def shapes_of(model: Model) -> list[CollisionShape]:
    """Return the collision shapes of a model.

    Raises:
        VehicleError: A shape or a mesh is not supported.
    """
    shapes = []
    for name in model.links:
        for collision in model.links[name].findall("collision"):
            where = f"{model.label}: link '{name}': collision '{collision.get('name', '')}'"
            unread(collision, {"pose", "geometry"}, "collision", model.draft)
            inner = list(collision.find("geometry") or ())
            if len(inner) != 1 or inner[0].tag not in SHAPES:
                found = ", ".join(shape.tag for shape in inner) or "nothing"
                raise VehicleError(
                    f"{where}: its geometry is {found}, expected one of {', '.join(sorted(SHAPES))}"
                )
            refuse_unknown(inner[0], SHAPES[inner[0].tag], where)
            pose = model.pose_in(name, collision, where)
            if inner[0].tag == "mesh":
                vertices, faces = _mesh(model, inner[0], where)
                volume = abs(mesh_volume(vertices, faces))
                shapes.append(CollisionShape(name, pose, volume, vertices @ pose.turn.T + pose.place, faces))
            else:
                volume = shape_volume(inner[0], where)
                half = np.abs(pose.turn) @ _half_size(inner[0])
                corners = np.stack([pose.place - half, pose.place + half])
                shapes.append(CollisionShape(name, pose, volume, corners, None))
    return shapes


def put_hull(shapes: Sequence[CollisionShape], draft: Draft) -> None:
    """Set the hull, if there is exactly one shape and it is a closed mesh of the displaced volume."""
    if len(shapes) != 1 or shapes[0].faces is None:
        return
    shape, volume = shapes[0], draft.values["body"]["displaced_volume"]
    try:
        check_closed(shape.corners, shape.faces)
    except MeshError as error:
        draft.different.append(f"the collision mesh is no hull: {error}")
        return
    if abs(shape.volume - volume) <= 0.02 * volume:
        draft.hull = shape.corners, shape.faces
    else:
        draft.different.append(
            f"the collision mesh is no hull: it encloses {shape.volume:.4g} m³, the displaced volume is {volume:.4g} m³"
        )


def put_physical_inertia(draft: Draft) -> None:
    """Move the part of an inertia that is impossible for a body of positive mass to the added mass, which
    acts equally."""
    inertia = np.asarray(draft.values["body"]["inertia"])
    moments, axes = np.linalg.eigh(inertia)
    excess = (1.0 + 1e-6) * (moments[2] - moments[0] - moments[1])
    if excess <= 0.0:
        return
    share = excess * np.outer(axes[:, 2], axes[:, 2])
    added = np.asarray(draft.values["hydrodynamics"]["calibrated"]["added_mass"])
    added[3:, 3:] += share
    part = f"{excess:.4g} kg m² of it are in the added mass, so that it moves the same"
    note = f"no body has the inertia of the file: {part}"
    draft.put("body.inertia", inertia - share, "derived", note)
    draft.put("hydrodynamics.calibrated.added_mass", added, "derived", note)
    draft.different.append(note)


def put_displacement(lifts: Sequence[tuple[float, Array]], density: float, note: str, draft: Draft) -> None:
    """Set volume and centre of buoyancy.

    Args:
        lifts: Volume [m³] and centre in the body frame [m] of each part that displaces water.
        density: Density of the water [kg/m³].
        note: Derivation of the volume.
        draft: Draft to which the values are written.
    """
    volume = sum(lift[0] for lift in lifts)
    if volume <= 0.0:
        mass, centre = draft.values["body"]["mass"], draft.values["body"]["center_of_gravity"]
        draft.guess("body.displaced_volume", mass / density, "no shape displaces water: neutral buoyancy")
        draft.guess("body.center_of_buoyancy", centre, "no shape displaces water: at the centre of gravity")
        return
    centre = np.average([place for _, place in lifts], axis=0, weights=[share for share, _ in lifts])
    draft.put("body.displaced_volume", float(volume), "derived", note)
    draft.put("body.center_of_buoyancy", plain(centre), "derived", note)


def _mesh(model: Model, shape: Element, where: str) -> tuple[Array, NDArray[np.int64]]:
    """Return vertices (n, 3) [m] and faces (m, 3) of a collision mesh in its own frame."""
    uri = (shape.findtext("uri") or "").strip()
    file = file_of_model(Path(model.label).parent, uri, where, model.packages)
    if file.suffix.lower() != ".stl":
        raise VehicleError(
            f"{where}: its mesh is a {file.suffix or 'file'}, expected .stl: export it so, or use a box"
        )
    try:
        vertices, faces = load_stl(file)
    except MeshError as error:
        raise VehicleError(f"{where}: {error}") from None
    scale = shape.find("scale")
    factors = np.ones(3) if scale is None else numbers(scale.text, 3, f"{where}: scale")
    if not np.all(factors > 0.0):
        raise VehicleError(f"{where}: scale is {factors.tolist()}, expected 3 numbers > 0")
    return vertices * factors, faces


def note_rest(
    model: Model,
    plugins: Mapping[str, Sequence[Element]],
    read: Collection[str],
    remarks: Mapping[str, str],
    turned: Collection[str],
) -> None:
    """Note plugins, joints and elements of the model that are not read.

    Args:
        model: The model.
        plugins: Plugins of the model by kind.
        read: Kinds that are read.
        remarks: Kind -> remark that is appended to its note.
        turned: Joints of thrusters.
    """
    draft = model.draft
    unread(model.element, {"link", "joint", "frame", "plugin", "pose", "static"}, "model", draft)
    for kind, found in plugins.items():
        if kind not in read:
            draft.not_read[f"plugin {kind or 'without a name'}{remarks.get(kind, '')}"] += len(found)
    for frame in model.frames.values():
        unread(frame, {"pose"}, "frame", draft)
    held = []
    for name, joint in model.joints.items():
        unread(joint, {"pose", "parent", "child", "axis"}, "joint", draft)
        for axis in joint.findall("axis"):
            limited = name in draft.values.get("actuators", {})
            unread(axis, {"xyz", "limit"} if limited else {"xyz"}, "axis", draft)
        if joint.get("type") != "fixed" and not joint.get("still") and name not in turned:
            held.append(f"'{name}' ({joint.get('type')})")
    if held:
        draft.different.append(f"joints held where the file puts them: {', '.join(held)}")
