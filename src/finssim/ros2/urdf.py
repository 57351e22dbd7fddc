"""The vehicle file as URDF: a rigid body, its hull, and a frame for everything that is mounted on it."""

from __future__ import annotations

from collections.abc import Iterator
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt

from finssim.geometry.rotations import matrix_to_quat, quat_to_euler
from finssim.vehicles import Vehicle

__all__ = ["BASE", "mounts", "urdf_of"]

Array = npt.NDArray[np.float64]

BASE = "base_link"


def mounts(vehicle: Vehicle) -> Iterator[tuple[str, Array, Array]]:
    """Frame, position [m] (3,) and orientation xyzw (4,) in base_link of sensors, tags and thrusters.

    A thruster's x axis is the direction of its positive thrust.
    """
    sensors = vehicle.sensors
    for name, mount in (("imu", sensors.imu), ("pressure", sensors.depth), ("dvl", sensors.dvl)):
        if mount is not None:
            yield f"{name}_link", np.asarray(mount.position), np.asarray(mount.orientation)
    for tag, mount in (vehicle.tags.mounts if vehicle.tags else {}).items():
        yield f"tag_{tag}_link", np.asarray(mount.position), np.asarray(mount.orientation)
    for name, thruster in vehicle.thrusters.items():
        yield f"{name}_link", np.asarray(thruster.position), _along(np.asarray(thruster.axis))


def urdf_of(vehicle: Vehicle) -> str:
    """URDF of a vehicle: mass and inertia without water, hull or envelope, and its `mounts` as fixed joints."""
    robot, body = ElementTree.Element("robot", name=vehicle.name), vehicle.body
    base = ElementTree.SubElement(robot, "link", name=BASE)
    inertial = ElementTree.SubElement(base, "inertial")
    ElementTree.SubElement(inertial, "origin", xyz=_numbers(body.center_of_gravity), rpy="0 0 0")
    ElementTree.SubElement(inertial, "mass", value=repr(float(body.mass)))
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = (map(repr, map(float, row)) for row in body.inertia)
    ElementTree.SubElement(inertial, "inertia", ixx=xx, ixy=xy, ixz=xz, iyy=yy, iyz=yz, izz=zz)
    for kind in ("visual", "collision"):
        shape = ElementTree.SubElement(base, kind)
        hull = vehicle.hull
        if hull is not None and hull.file is not None:
            geometry = ElementTree.SubElement(shape, "geometry")
            scale = _numbers([hull.scale] * 3)
            ElementTree.SubElement(geometry, "mesh", filename=f"file://{hull.file.resolve()}", scale=scale)
        else:
            ElementTree.SubElement(shape, "origin", xyz=_numbers(body.center_of_buoyancy), rpy="0 0 0")
            geometry = ElementTree.SubElement(shape, "geometry")
            ElementTree.SubElement(geometry, "box", size=_numbers(body.size))
    for name, position, orientation in mounts(vehicle):
        ElementTree.SubElement(robot, "link", name=name)
        joint = ElementTree.SubElement(
            robot, "joint", name=f"{name.removesuffix('_link')}_joint", type="fixed"
        )
        ElementTree.SubElement(joint, "parent", link=BASE)
        ElementTree.SubElement(joint, "child", link=name)
        rpy = _numbers(quat_to_euler(orientation))
        ElementTree.SubElement(joint, "origin", xyz=_numbers(position), rpy=rpy)
    ElementTree.indent(robot)
    return ElementTree.tostring(robot, encoding="unicode")


def _numbers(values: npt.ArrayLike) -> str:
    return " ".join(repr(float(v)) for v in np.asarray(values, float).ravel())


def _along(axis: Array) -> Array:
    """Quaternion of a frame whose x axis is that one; its y axis is level unless that is upright."""
    side = np.cross([0.0, 0.0, 1.0], axis) if abs(axis[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    side = side - axis * (side @ axis)
    side /= np.linalg.norm(side)
    return np.asarray(matrix_to_quat(np.column_stack([axis, side, np.cross(axis, side)])))
