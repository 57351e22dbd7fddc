"""Coordinate frames as topics: map, odom and base_link of REP-105, what is mounted where, and the vehicle's URDF."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from finssim.geometry.rotations import (
    matrix_to_quat,
    quat_conjugate,
    quat_from_euler,
    quat_multiply,
    quat_rotate,
    quat_to_euler,
)
from finssim.localization.pool import Pool
from finssim.robot.reading import Reading
from finssim.ros2.nodes.robot_node import RobotNode
from finssim.ros2.nodes.ros_messages import ros_type
from finssim.ros2.urdf import BASE, mounts, urdf_of

__all__ = ["Frames", "Odometer", "Pose"]

Array = npt.NDArray[np.float64]

GAP = 0.5
"""After a longer silence the way between two readings is not known, and odom stands still over it [s]."""
OPTICAL = np.array([-0.5, 0.5, -0.5, 0.5])
"""camera_optical in camera_link, xyzw: z along the view, x right, y down (REP-103)."""


class Pose(NamedTuple):
    """Of one frame in another."""

    position: Array
    """[m], (3,)"""
    orientation: Array
    """xyzw, (4,)"""

    def times(self, other: Pose) -> Pose:
        """Of a frame of the second pose in that of the first."""
        place = self.position + np.asarray(quat_rotate(self.orientation, other.position))
        return Pose(place, np.asarray(quat_multiply(self.orientation, other.orientation)))

    def inverse(self) -> Pose:
        """The other way round."""
        q = np.asarray(quat_conjugate(self.orientation))
        return Pose(-np.asarray(quat_rotate(q, self.position)), q)


class Odometer:
    """base_link in odom: velocities added up from the first reading on, so that it drifts and never jumps (REP-105).

    Roll and pitch are the reading's; odom begins as the map and stays level.
    """

    def __init__(self) -> None:
        self._before: Reading | None = None
        self._place, self._yaw = np.zeros(3), 0.0

    def take(self, reading: Reading) -> Pose:
        """The pose at a reading whose position is known; later ones follow in time."""
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
        return Pose(self._place, np.asarray(quat_from_euler(roll, pitch, self._yaw)))


class Frames:
    """Says where everything is; of the one node that knows the vehicle's state."""

    def __init__(self, node: RobotNode, pool: Pool | None = None) -> None:
        """
        Args:
            node: That says it.
            pool: Where the camera is; None without one.
        """
        self._node, self._odometer = node, Odometer()
        node.sends("transform", "fixed_transform", "robot")
        parts = [(BASE, name, Pose(position, q)) for name, position, q in mounts(node.vehicle)]
        if pool is not None:
            T = pool.T_wp
            pool_in_map = Pose(T[:3, 3], np.asarray(matrix_to_quat(T[:3, :3])))
            optical = pool_in_map.times(Pose(pool.camera.position, pool.camera.orientation))
            link = optical.times(Pose(np.zeros(3), OPTICAL).inverse())
            parts += [
                ("map", "camera_link", link),
                ("camera_link", "camera_optical", Pose(np.zeros(3), OPTICAL)),
            ]
        stamp = node.ns(node.now())
        node.send("fixed_transform", node.make.transforms(stamp, parts))
        node.send("robot", ros_type("std_msgs/msg/String")(data=urdf_of(node.vehicle)))

    def tell(self, stamp: int, reading: Reading) -> None:
        """Publish map to odom and odom to base_link of a reading whose position is known."""
        odom = self._odometer.take(reading)
        drift = Pose(np.asarray(reading.position), np.asarray(reading.quaternion)).times(odom.inverse())
        parts = [("map", "odom", drift), ("odom", BASE, odom)]
        self._node.send("transform", self._node.make.transforms(stamp, parts))
