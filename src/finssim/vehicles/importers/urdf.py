"""Importer of URDF and xacro: links and joints with the plugins of gz-sim or of uuv_simulator.

A URDF is converted to SDF as Gazebo does it: `<gazebo>` elements are merged into the elements they refer to, and a
link without mass stays massless. Fixed links stay separate links: their combined rigid body is the same.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from xml.etree.ElementTree import SubElement

from finssim.core.importer import Importer
from finssim.core.xml_file import read_xml
from finssim.vehicles.importers.draft import Draft
from finssim.vehicles.importers.elements import Element
from finssim.vehicles.importers.sdf import kind_of, read_model
from finssim.vehicles.importers.uuv import PLUGINS, read_uuv
from finssim.vehicles.importers.xacro_file import expanded, packages_near
from finssim.vehicles.part import VehicleError

__all__ = ["URDF", "read_urdf", "sdf_of"]

INERTIA = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
READ = {
    "robot": {"link", "joint", "gazebo"},
    "link": {"inertial", "collision"},
    "inertial": {"origin", "mass", "inertia"},
    "collision": {"origin", "geometry"},
    "joint": {"origin", "parent", "child", "axis", "limit"},
}
"""Element -> children that are read."""


def sdf_of(robot: Element, label: str) -> tuple[Element, Counter[str]]:
    """Return the `model` of SDF that Gazebo generates from a `robot` of URDF, and the omitted contents.

    Args:
        robot: The element `robot`, expanded.
        label: Name of its file in messages.
    """
    model, left = Element("model", {"name": robot.get("name", "")}), Counter[str]()

    def note(element: Element) -> None:
        for child in element:
            if child.tag not in READ[element.tag]:
                left[f"{element.tag}: {child.tag}"] += 1

    def text(parent: Element, tag: str, value: str | None) -> Element:
        child = SubElement(parent, tag)
        child.text = value
        return child

    def pose(parent: Element, element: Element) -> Element:
        origin = element.find("origin")
        words = {} if origin is None else origin.attrib
        return text(parent, "pose", f"{words.get('xyz', '0 0 0')} {words.get('rpy', '0 0 0')}")

    note(robot)
    links: dict[str, Element] = {}
    for link in robot.findall("link"):
        name = link.get("name", "")
        links[name] = made = SubElement(model, "link", name=name)
        note(link)
        inertial = link.find("inertial")
        body = SubElement(made, "inertial")
        if inertial is not None:
            note(inertial)
            pose(body, inertial)
        mass = None if inertial is None else inertial.find("mass")
        text(body, "mass", "0" if mass is None else mass.get("value"))
        tensor, moments = SubElement(body, "inertia"), None if inertial is None else inertial.find("inertia")
        for tag in INERTIA:
            text(tensor, tag, "0" if moments is None else moments.get(tag, "0"))
        for collision in link.findall("collision"):
            note(collision)
            solid = SubElement(made, "collision", name=collision.get("name", ""))
            pose(solid, collision)
            geometry = SubElement(solid, "geometry")
            for shape in collision.find("geometry") or ():
                kept = SubElement(geometry, shape.tag)
                for word, value in shape.attrib.items():
                    text(kept, "uri" if (shape.tag, word) == ("mesh", "filename") else word, value)
    for joint in robot.findall("joint"):
        note(joint)
        made = SubElement(model, "joint", name=joint.get("name", ""), type=joint.get("type", ""))
        ends = {}
        for tag in ("parent", "child"):
            end = joint.find(tag)
            ends[tag] = "" if end is None else end.get("link", "")
            text(made, tag, ends[tag])
        if ends["child"] not in links:
            raise VehicleError(f"{label}: joint '{joint.get('name')}': no link '{ends['child']}': correct it")
        if links[ends["child"]].find("pose") is not None:
            raise VehicleError(f"{label}: link '{ends['child']}' is the child of two joints: remove one")
        pose(links[ends["child"]], joint).set("relative_to", ends["parent"])
        limit = joint.find("limit")
        if (
            limit is not None
            and limit.get("lower", "0") == limit.get("upper", "0")
            and joint.get("type") != "continuous"
        ):
            made.set("still", "true")
        elif limit is not None and joint.get("type") == "revolute":
            made.attrib.update({end: limit.get(end, "0") for end in ("lower", "upper")})
        axis = joint.find("axis")
        text(SubElement(made, "axis"), "xyz", "1 0 0" if axis is None else axis.get("xyz"))
    for extension in robot.findall("gazebo"):
        target = extension.get("reference")
        for child in extension:
            if target is None:
                model.append(child)
            elif child.tag == "turnGravityOff" and (child.text or "").strip().lower() in ("true", "1"):
                text(links.get(target, model), "gravity", "false")
            else:
                left[f"gazebo of a link or joint: {child.tag}"] += 1
    return model, left


def read_urdf(path: Path, folders: Sequence[Path] = ()) -> Draft:
    """Read the robot from a URDF or xacro file.

    Args:
        path: The file; packages near it are identified by their package.xml.
        folders: Additional folders that are searched for packages.

    Raises:
        VehicleError: The file cannot be read; the message states location, expected content and remedy.
    """
    root, packages = read_xml(path, VehicleError), packages_near(path, folders)
    texts = [text for e in root.iter() for text in (e.tag, e.text or "", *e.attrib.values())]
    if any(word in text for text in texts for word in ("xacro:", "${", "$(")):
        root = expanded(path, packages)
    if root.tag != "robot":
        raise VehicleError(f"{path}: its root is '{root.tag}', expected robot")
    model, left = sdf_of(root, str(path))
    inside = {"": path.resolve().parent, **packages}
    plugins = model.findall("plugin")
    if any(plugin.get("filename", "") in PLUGINS for plugin in plugins):
        draft = read_uuv(model, path, inside)
    elif any(kind_of(plugin) == "Hydrodynamics" for plugin in plugins):
        draft = read_model(model, None, path, "URDF with plugins of gz-sim", inside)
    else:
        raise VehicleError(
            f"{path}: has no hydrodynamics, expected a plugin Hydrodynamics of gz-sim or {PLUGINS[0]} of uuv_simulator"
        )
    draft.not_read += left
    return draft


def _recognises(path: Path, head: bytes) -> bool:
    return path.suffix.lower() in (".urdf", ".xacro") or (b"<robot" in head and path.suffix.lower() != ".scn")


URDF = Importer(
    "vehicle",
    "URDF and xacro (.urdf, .xacro) of uuv_simulator or gz-sim",
    _recognises,
    read_urdf,
    folders=True,
)
