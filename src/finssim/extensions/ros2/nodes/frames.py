"""Coordinate frames as topics: map, odom and base_link of REP-105, frames of mounted parts, and the vehicle's URDF."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt

from finssim.core.rotations import (
    matrix_to_quat,
    quat_conjugate,
    quat_from_euler,
    quat_multiply,
    quat_rotate,
    quat_to_euler,
)
from finssim.extensions.ros2.nodes.conversions import ros_type, xyz, xyzw
from finssim.extensions.ros2.nodes.robot_node import RobotNode
from finssim.localization.fusion.estimator import Estimator
from finssim.localization.fusion.streams import VisionSample
from finssim.localization.overhead_camera import Pool
from finssim.localization.poses import axes_of_up
from finssim.robot.reading import Reading
from finssim.robot.record_messages import own_kind
from finssim.vehicles import Vehicle
from finssim.vehicles.device_files import device_of
from finssim.vehicles.export import fin_joint, fin_plate, fins_of

Array = npt.NDArray[np.float64]

BASE = "base_link"
OPTICAL = np.array([-0.5, 0.5, -0.5, 0.5])
"""Rotation of NAME_optical in NAME_link, xyzw: z along the view, x right, y down (REP-103)."""
ACOUSTIC = np.array([math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0])
"""Rotation of NAME_acoustic in NAME_link, xyzw: z along the view, x up, y right."""


def mounts(vehicle: Vehicle) -> Iterator[tuple[str, Array, Array]]:
    """Yield frame, position [m] (3,) and orientation xyzw (4,) in base_link of sensors, tags and thrusters.

    Cameras also have an optical frame, sonars and Doppler logs the acoustic frame of marine_acoustic_msgs.

    A thruster's x axis is the direction of its positive thrust.
    """
    sensors = vehicle.sensors
    for name, mount in (("imu", sensors.imu), ("pressure", sensors.depth), ("dvl", sensors.dvl)):
        if mount is not None:
            yield f"{name}_link", np.asarray(mount.position), np.asarray(mount.orientation)
    for name, device in {name: device_of(vehicle, name) for name in vehicle.perception}.items():
        position, q = np.asarray(device.mount.position), np.asarray(device.mount.quaternion)
        yield f"{name}_link", position, q
        turned = {"camera": ("optical", OPTICAL), "range": None}.get(own_kind(device), ("acoustic", ACOUSTIC))
        if turned is not None:
            yield f"{name}_{turned[0]}", position, np.asarray(quat_multiply(q, turned[1]))
    for tag, mount in (vehicle.tags.mounts if vehicle.tags else {}).items():
        yield f"tag_{tag}_link", np.asarray(mount.position), np.asarray(mount.orientation)
    for name, thruster in vehicle.thrusters.items():
        yield f"{name}_link", np.asarray(thruster.position), _along(np.asarray(thruster.axis))


def urdf_of(vehicle: Vehicle) -> str:
    """Return the URDF of a vehicle: mass and inertia without water, hull or envelope, `mounts` as fixed
    joints, movable fins."""
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
    for name, fin in fins_of(vehicle).items():
        turned, plate = fin_plate(fin)
        shape = ElementTree.SubElement(ElementTree.SubElement(robot, "link", name=f"{name}_fin"), "visual")
        ElementTree.SubElement(shape, "origin", xyz="0 0 0", rpy=_numbers(turned))
        shape.append(plate)
        robot.append(fin_joint(name, fin, np.zeros(3)))
    ElementTree.indent(robot)
    return ElementTree.tostring(robot, encoding="unicode")


def _numbers(values: npt.ArrayLike) -> str:
    return " ".join(repr(float(v)) for v in np.asarray(values, float).ravel())


def _along(axis: Array) -> Array:
    """Return the quaternion of a frame whose x axis is `axis`; its y axis is level unless `axis` is nearly
    vertical."""
    side = np.cross([0.0, 0.0, 1.0], axis) if abs(axis[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    side = side - axis * (side @ axis)
    side /= np.linalg.norm(side)
    return np.asarray(matrix_to_quat(np.column_stack([axis, side, np.cross(axis, side)])))


# Conversion of fixes between the pool frame, used by the estimator, and the map frame, used in messages.


KNOWN = [0, 1, 2, 5]
"""Indices of x, y, z and yaw in a pose's covariance."""
UNKNOWN = 1.0e6
"""Variance of an unknown heading [rad²] or height [m²]."""
TILT_VARIANCE = 0.02
"""Variance of roll and pitch from the attitude filter [rad²]."""


class FixFrame:
    """Frames of one pool. Height and tilt, which a fix does not measure, are included as used for the fix."""

    def __init__(self, pool: Pool, estimator: Estimator) -> None:
        self._T_wp = pool.T_wp
        R = self._T_wp[:3, :3]
        self._q_wg = matrix_to_quat(R @ axes_of_up(estimator.site.up))
        self._turn = np.eye(4)
        self._turn[:3, :3] = R
        self._height_variance = estimator.settings.depth_std**2

    def to_map(self, fix: VisionSample, estimator: Estimator) -> tuple[Array, Array, Array]:
        """Return position [m], quaternion xyzw and covariance (6, 6) in the map frame.

        Args:
            fix: Fix in the pool frame.
            estimator: Estimator with height and tilt at its time.
        """
        near = estimator.at(fix.time)
        height = float(estimator.estimate(fix.time).x[2])
        known = math.isfinite(height)
        position = np.array([*fix.position, height if known else 0.0])
        roll, pitch = (a if math.isfinite(a) else 0.0 for a in (near.roll, near.pitch))
        level = quat_from_euler(roll, pitch, fix.yaw or 0.0)
        P = np.diag(
            [0.0, 0.0, self._height_variance if known else UNKNOWN, UNKNOWN if fix.yaw is None else 0.0]
        )
        if fix.covariance is not None:
            P[np.ix_([0, 1, 3], [0, 1, 3])] += np.array(fix.covariance)
        full = np.diag([0.0, 0.0, 0.0, TILT_VARIANCE, TILT_VARIANCE, 0.0])
        full[np.ix_(KNOWN, KNOWN)] = self._turn @ P @ self._turn.T
        q = np.asarray(quat_multiply(self._q_wg, level))
        return self._T_wp[:3, :3] @ position + self._T_wp[:3, 3], q, full

    def from_map(self, message: Any, time: float, now: float) -> VisionSample:
        """Return the fix of a PoseWithCovarianceStamped; the estimator checks its numbers.

        Args:
            message: Message in the map frame.
            time: Time of its stamp [s].
            now: Present time [s].
        """
        pose = message.pose.pose
        position = self._T_wp[:3, :3].T @ (np.array(xyz(pose.position)) - self._T_wp[:3, 3])
        level = quat_multiply(quat_conjugate(self._q_wg), np.array(xyzw(pose.orientation)))
        P = np.array(message.pose.covariance, float).reshape(6, 6)[np.ix_(KNOWN, KNOWN)]
        R = (self._turn.T @ P @ self._turn)[np.ix_([0, 1, 3], [0, 1, 3])]
        rows = tuple((float(row[0]), float(row[1]), float(row[2])) for row in 0.5 * (R + R.T))
        yaw = float(quat_to_euler(level)[2])
        return VisionSample(time, (float(position[0]), float(position[1])), yaw, rows, now)


# Frames as topics.


GAP = 0.5
"""Gap between readings above which odom stays constant, since the motion in between is unknown [s]."""


class FramePose(NamedTuple):
    """Pose of one frame in another."""

    position: Array
    """Position [m], (3,)."""
    orientation: Array
    """Orientation, xyzw, (4,)."""

    def times(self, other: FramePose) -> FramePose:
        """Return the pose of the second pose's frame in the reference frame of the first."""
        position = self.position + np.asarray(quat_rotate(self.orientation, other.position))
        return FramePose(position, np.asarray(quat_multiply(self.orientation, other.orientation)))

    def inverse(self) -> FramePose:
        """Return the inverse pose."""
        q = np.asarray(quat_conjugate(self.orientation))
        return FramePose(-np.asarray(quat_rotate(q, self.position)), q)


class Odometer:
    """Pose of base_link in odom: velocities integrated from the first reading on, so that it drifts without
    jumps (REP-105).

    Roll and pitch are those of the reading; odom coincides with the map at the start and stays level.
    """

    def __init__(self) -> None:
        self._before: Reading | None = None
        self._place, self._yaw = np.zeros(3), 0.0

    def take(self, reading: Reading) -> FramePose:
        """Return the pose at a reading with a known position; readings must be in order of time."""
        roll, pitch, yaw = (float(a) for a in quat_to_euler(reading.quaternion))
        before, self._before = self._before, reading
        if before is None:
            self._place, self._yaw = np.array(reading.position, float), yaw
        else:
            dt = reading.time - before.time
            nu = 0.5 * (before.nu + reading.nu)
            if 0.0 < dt <= GAP and np.isfinite(nu).all():
                turn = (math.sin(roll) * nu[4] + math.cos(roll) * nu[5]) / max(math.cos(pitch), 1e-3)
                middle = quat_from_euler(roll, pitch, self._yaw + 0.5 * dt * turn)
                self._place = self._place + dt * np.asarray(quat_rotate(middle, nu[:3]))
                self._yaw += dt * turn
        return FramePose(self._place, np.asarray(quat_from_euler(roll, pitch, self._yaw)))


class Frames:
    """Publisher of all frames, in the one node that knows the vehicle's state."""

    def __init__(self, node: RobotNode, pool: Pool | None = None) -> None:
        """
        Args:
            node: Node that publishes the frames.
            pool: Pool with the pose of the camera; None without a camera.
        """
        self._node, self._odometer = node, Odometer()
        node.sends("transform", "fixed_transform", "robot")
        parts = [(BASE, name, FramePose(position, q)) for name, position, q in mounts(node.vehicle)]
        if pool is not None:
            T = pool.T_wp
            pool_in_map = FramePose(T[:3, 3], np.asarray(matrix_to_quat(T[:3, :3])))
            optical = pool_in_map.times(FramePose(pool.camera.position, pool.camera.orientation))
            link = optical.times(FramePose(np.zeros(3), OPTICAL).inverse())
            parts += [
                ("map", "camera_link", link),
                ("camera_link", "camera_optical", FramePose(np.zeros(3), OPTICAL)),
            ]
        stamp = node.ns(node.now())
        node.send("fixed_transform", node.make.transforms(stamp, parts))
        node.send("robot", ros_type("std_msgs/msg/String")(data=urdf_of(node.vehicle)))

    def publish(self, stamp: int, reading: Reading) -> None:
        """Publish map to odom and odom to base_link for a reading with a known position."""
        odom = self._odometer.take(reading)
        drift = FramePose(np.asarray(reading.position), np.asarray(reading.quaternion)).times(odom.inverse())
        parts = [("map", "odom", drift), ("odom", BASE, odom)]
        self._node.send("transform", self._node.make.transforms(stamp, parts))
