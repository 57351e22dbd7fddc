"""Pools and tanks with known geometry, surveyed with stated errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from finssim.core.optics import Camera, Interface, Layer, Lens, Status, project
from finssim.core.rotations import matrix_to_quat, quat_from_rotvec, quat_to_matrix
from finssim.survey.points import Observations

PLUMB_BOB = Lens(
    1280, 720, 540.93, 540.93, 682.23, 348.61, "plumb_bob", (0.0294, -0.0598, 0.00088, 0.00179, 0.01257)
)
FISHEYE = Lens(1920, 1080, 600.0, 600.0, 960.0, 540.0, "fisheye", (0.02, -0.01, 0.002, 0.0))
RATIONAL = Lens(
    1280, 720, 620.0, 615.0, 640.0, 350.0, "rational", (0.1, -0.05, 1e-3, 1e-3, 0.01, 0.12, -0.03, 0.0)
)
TANK_LENS = Lens(1280, 720, 900.0, 900.0, 640.0, 360.0, "plumb_bob", (-0.1, 0.05, 0.0, 0.0))
GLASS = Layer(0.010, 1.52)
FLOOR = ((-1.9, -0.95, 0.0), (1.9, 0.95, 1e-12))
SOLID = ((-1.9, -0.95, 0.0), (1.9, 0.95, 0.6))
TANK = ((-0.3, 0.03, 0.0), (0.3, 0.35, 0.4))


def looking(position, target, lens=PLUMB_BOB, up=(0.0, 1.0, 0.0)) -> Camera:
    """Return a camera at a position that points at a target."""
    ahead = np.subtract(target, position) / np.linalg.norm(np.subtract(target, position))
    right = np.cross(ahead, up)
    right = right / np.linalg.norm(right)
    axes = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    return Camera(lens, np.array(position, float), matrix_to_quat(axes))


def overhead(lens=PLUMB_BOB) -> Camera:
    """Return a camera about 1.2 m above the water, slightly tilted."""
    return looking((0.03, -0.17, 2.2), (0.1, -0.1, 0.0), lens)


def before_tank(degrees: float) -> Camera:
    """Return a camera 0.6 m from the middle of a tank's window at y = 0, seen from the side."""
    a = np.radians(degrees)
    position = (0.6 * np.sin(a), -0.6 * np.cos(a), 0.2)
    return looking(position, (0.0, 0.15, 0.2), TANK_LENS, (0.0, 0.0, 1.0))


def window() -> Interface:
    """Return the window of a tank: 10 mm of glass at y = 0, the water beyond it."""
    return Interface(np.array([0.0, -1.0, 0.0]), 0.0, window=(GLASS,))


def survey(camera, plane, box, count, seed=0, *, pixel=0.25, error=0.002) -> Observations:
    """Return points in a box that the camera sees, with errors of pixels [px] and of the survey [m]."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(*np.array(box), (200 * count, 3))
    found = project(camera, plane, points + error * rng.standard_normal(points.shape))
    seen = np.flatnonzero(found.status == Status.OK)[:count]
    assert len(seen) == count
    pixels = found.pixels[seen] + pixel * rng.standard_normal((count, 2))
    return observations(points[seen], pixels)


def observations(points, pixels) -> Observations:
    """Return single points p0, p1, ..."""
    count = len(points)
    names = tuple(f"p{i}" for i in range(count))
    return Observations(
        pixels=np.asarray(pixels, float),
        points=np.asarray(points, float),
        location=np.arange(count),
        names=names,
        locations=names,
        sigma=np.full(count, np.nan),
        arm=np.zeros((count, 3)),
        dry=np.zeros(count, bool),
    )


def carried(camera, plane, seen, seed=3):
    """Return the same scene in another frame, rotated and far away."""
    rng = np.random.default_rng(seed)
    R, t = quat_to_matrix(quat_from_rotvec(2.0 * rng.standard_normal(3))), 5.0 * rng.standard_normal(3)
    normal = R @ plane.normal
    return (
        Camera(camera.lens, R @ camera.position + t, matrix_to_quat(R @ camera.R_pc)),
        replace(plane, normal=normal / np.linalg.norm(normal), offset=float(plane.offset - normal @ t)),
        replace(seen, points=seen.points @ R.T + t),
    )
