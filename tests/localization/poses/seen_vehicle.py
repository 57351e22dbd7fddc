"""A vehicle with two tags in a pool, and its exact corners in the camera, to which tests add errors."""

import numpy as np

from finssim.core.optics import Camera, Interface, Layer, Lens, Status, project
from finssim.core.rotations import matrix_to_quat, quat_from_euler, quat_to_matrix
from finssim.localization.detection.detections import Detection
from finssim.localization.detection.families import tag_corners_b
from finssim.localization.overhead_camera import Pool
from finssim.localization.poses import Constraints, axes_of_up
from finssim.vehicles import load_vehicle

TAGS = tag_corners_b(load_vehicle("finsrov").tags)
LENS = Lens(
    1280,
    720,
    540.9305,
    540.9305,
    682.2341,
    348.6136,
    "plumb_bob",
    (0.02944, -0.05976, 0.00088, 0.00179, 0.01257),
)
FISHEYE = Lens(1280, 960, 420.0, 420.0, 640.0, 480.0, "fisheye", (-0.02, 0.003, -0.001, 0.0002))
DOWN = matrix_to_quat(np.array([[1.0, 0.02, 0.0], [0.02, -1.0, 0.03], [0.0006, -0.03, -1.0]]))
DOWN = DOWN / np.linalg.norm(DOWN)
ABOVE = Camera(LENS, np.array([0.03, -0.17, 2.17]), DOWN)
# In front of a wall at y = 0, looking along +y into the water.
FRONT = Camera(
    LENS, np.array([0.0, -0.5, 0.9]), matrix_to_quat(np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]]))
)

POOLS = {
    "level water": Pool(ABOVE, Interface.water(0.96)),
    "tilted water": Pool(ABOVE, Interface.water(0.96, tilt_x=0.02, tilt_y=-0.03)),
    "fisheye": Pool(Camera(FISHEYE, np.array([0.03, -0.17, 2.17]), DOWN), Interface.water(0.96)),
    "window in the surface": Pool(
        ABOVE, Interface.through([0, 0, 0.98], [0, 0, 1.0], window=(Layer(0.02, 1.49),))
    ),
    "window wall": Pool(FRONT, Interface.through([0, 0, 0], [0, -1.0, 0], window=(Layer(0.01, 1.49),))),
}
"""Pools with z up."""


def pose(name, seed):
    """Return a position in the field of view at which all corners are seen, and roll, pitch, yaw."""
    rng = np.random.default_rng(seed)
    for _ in range(1000):
        low, high = (
            ([-0.9, 0.9, -0.1], [0.9, 2.0, 0.3])
            if name == "window wall"
            else ([-1.2, -0.7, 0.1], [1.2, 0.5, 0.75])
        )
        position = rng.uniform(low, high)
        angles = np.append(rng.normal(0.0, 0.1, 2), rng.uniform(-np.pi, np.pi))
        if seen(POOLS[name], position, angles) is not None:
            return position, angles
    raise AssertionError(f"{name}: no pose is seen")


def rotation(angles, up=(0.0, 0.0, 1.0)):
    """Return R_pb of roll, pitch, yaw [rad] about a vertical."""
    return axes_of_up(up) @ quat_to_matrix(quat_from_euler(*angles))


def seen(pool, position, angles, tags=TAGS, up=(0.0, 0.0, 1.0)):
    """Return exact detections of all tags; None where a corner is not within the picture."""
    R, found = rotation(angles, up), []
    for tag, corners_b in tags.items():
        points = corners_b @ R.T + position
        in_air = pool.interface.distance(points) > 0.0
        image = project(pool.camera, pool.interface, points)
        pixels, status = image.pixels.copy(), image.status.copy()
        direct, ok = pool.camera.lens.project((points - pool.camera.position) @ pool.camera.R_pc)
        pixels[in_air] = direct[in_air]
        status[in_air] = np.where(ok & pool.camera.lens.inside(direct), Status.OK, Status.NO_RAY)[in_air]
        if (status != Status.OK).any():
            return None
        found.append(Detection(tag, pixels))
    return found


def moved(detections, change):
    """Return detections with a change [px] added to the corners, (n, 4, 2)."""
    return [
        Detection(d.tag, d.corners + c, d.margin, d.hamming, d.family)
        for d, c in zip(detections, change, strict=True)
    ]


def known(position, angles, **more):
    """Return exact readings of depth sensor and IMU."""
    return Constraints(z_b=float(position[2]), roll=float(angles[0]), pitch=float(angles[1]), **more)
