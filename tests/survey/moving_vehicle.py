"""A vehicle with tags that moves below a camera: simulated measurements of camera, IMU and depth sensor."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pandas as pd

from finssim.core.optics import Camera, Interface, Lens, project
from finssim.core.rotations import (
    quat_conjugate,
    quat_from_euler,
    quat_from_rotvec,
    quat_inverse_rotate,
    quat_multiply,
    quat_rotate,
    quat_to_matrix,
    quat_to_rotvec,
)
from finssim.localization.detection.detections import Detection, Frame, write_detections
from finssim.localization.detection.families import corners
from finssim.localization.overhead_camera import Pool
from finssim.survey.mounts_fit import Moment
from finssim.survey.pose import Pose

EDGE = 0.093
PORT = np.array([0.02, -0.03, -0.115])

POOL = Pool(
    Camera(
        Lens(1280, 720, 541.0, 541.0, 640.0, 360.0, "plumb_bob", (0.029, -0.06, 0.0009, 0.0018, 0.0126)),
        np.array([0.03, -0.17, 2.17]),
        np.array([0.99876852, -0.00261252, 0.00069494, -0.04953919])
        / np.linalg.norm([0.99876852, -0.00261252, 0.00069494, -0.04953919]),
    ),
    Interface.water(0.96),
)

MOUNTS = {
    15: Pose(quat_to_matrix(quat_from_euler(0.02, -0.01, np.pi / 2)), np.array([0.075, 0.004, 0.103])),
    16: Pose(
        quat_to_matrix(quat_from_euler(-0.01, 0.02, np.pi / 2 + 0.03)), np.array([-0.07, -0.003, 0.098])
    ),
}
"""Poses of the tags in the body."""


@dataclass
class Motion:
    """True motion over time."""

    t: np.ndarray
    position: np.ndarray
    quaternion: np.ndarray
    at: Callable
    """Function that returns the same motion at other times."""

    def depth(self, port=PORT):
        """Return the depth of the port below the surface [m]."""
        return 0.96 - (self.position + quat_rotate(self.quaternion, port))[:, 2]

    @property
    def up(self):
        """Return the up direction in the body."""
        return quat_inverse_rotate(self.quaternion, np.array([0.0, 0.0, 1.0]))


def motion(*, tilt=0.2, seconds=60.0, rate=5.0, travel=0.4, spin=0.3, heave=0.15):
    """Return the motion of a vehicle that wanders, turns and rocks."""

    def at(t):
        roll, pitch = tilt * np.sin(1.3 * t), tilt * np.sin(0.9 * t + 1.0)
        yaw = spin * t + 0.2 * np.sin(0.4 * t)
        height = 0.45 + heave * np.sin(0.5 * t)
        position = np.stack([travel * np.sin(0.31 * t), travel * np.cos(0.23 * t), height], axis=-1)
        return Motion(t, position, quat_from_euler(roll, pitch, yaw), at)

    return at(np.arange(0.0, seconds, 1.0 / rate))


def moments(moved, rng, *, pixel=0.15, up=0.005, depth=0.004, mounts=None, both=True):
    """Return the measurements at every time of a motion."""
    found = []
    depths, ups = moved.depth(), moved.up
    for i in range(len(moved.t)):
        R = quat_to_matrix(moved.quaternion[i])
        seen = {}
        for tag, mount in (mounts or MOUNTS).items():
            points = (mount.at(corners(EDGE))) @ R.T + moved.position[i]
            pixels = project(POOL.camera, POOL.interface, points).pixels
            if np.isfinite(pixels).all() and POOL.camera.lens.inside(pixels).all():
                seen[tag] = pixels + pixel * rng.standard_normal((4, 2))
        if not both and i % 2:
            seen.pop(16, None)
        felt = ups[i] + up * rng.standard_normal(3)
        found.append(
            Moment(
                time=float(moved.t[i]),
                corners=seen,
                up=felt / np.linalg.norm(felt),
                depth=float(depths[i] + depth * rng.standard_normal()),
            )
        )
    return found


def write_log(
    folder,
    moved,
    rng,
    *,
    mounts=None,
    imu_orientation=(0.0, 0.0, 1.0, 0.0),
    depth_offset=0.0,
    depth_scale=1.0,
    attitude=True,
    gyro_bias=(0.01, -0.006, 0.004),
    clock=0.0,
):
    """Write a log folder: detections, an IMU of 50 Hz in its own axes, depth of 10 Hz."""
    folder.mkdir(exist_ok=True)
    frames = [
        Frame(
            m.time,
            f"{i:05d}.png",
            tuple(Detection(tag, px, 50.0, 0, "tag25h9") for tag, px in m.corners.items()),
        )
        for i, m in enumerate(moments(moved, rng, mounts=mounts))
    ]
    write_detections(frames, folder / "detections.csv")
    t = np.arange(moved.t[0], moved.t[-1], 0.02)
    fine = moved.at(t)
    turned = quat_multiply(quat_conjugate(fine.quaternion[:-1]), fine.quaternion[1:])
    rate = np.vstack([quat_to_rotvec(turned), np.zeros((1, 3))])[[*range(len(t) - 1), len(t) - 2]] / 0.02
    # A rate over the next step belongs to its middle.
    sensor = quat_inverse_rotate(np.array(imu_orientation), rate) + np.array(gyro_bias)
    force = quat_inverse_rotate(np.array(imu_orientation), 9.81 * fine.up)
    columns = {"t": t + 0.01 - clock}
    for name, values, std in (("gyro", sensor, 0.003), ("accel", force, 0.02)):
        noisy = values + std * rng.standard_normal(values.shape)
        columns |= {f"{name}_{axis}": noisy[:, i] for i, axis in enumerate("xyz")}
    if attitude:  # attitude of the sensor, like the other readings in its axes
        wobble = quat_from_rotvec(0.004 * rng.standard_normal((len(t), 3)))
        q = quat_multiply(moved.at(t + 0.01).quaternion, quat_multiply(wobble, imu_orientation))
        columns |= {f"q{axis}": q[:, i] for i, axis in enumerate("xyzw")}
    pd.DataFrame(columns).to_csv(folder / "imu.csv", index=False, float_format="%.6f")
    slow = moved.at(np.arange(moved.t[0], moved.t[-1], 0.1))
    reading = depth_scale * slow.depth() + depth_offset + 0.004 * rng.standard_normal(len(slow.t))
    pd.DataFrame({"t": slow.t, "depth": reading}).to_csv(
        folder / "depth.csv", index=False, float_format="%.6f"
    )
    return folder
