"""Pools whose every number is known, surveyed with stated errors."""

from __future__ import annotations

import numpy as np

from finssim.calibration.vision.survey import Observations
from finssim.geometry.optics import Camera, Lens, Status, project
from finssim.geometry.rotations import matrix_to_quat

PLUMB_BOB = Lens(
    1280, 720, 540.93, 540.93, 682.23, 348.61, "plumb_bob", (0.0294, -0.0598, 0.00088, 0.00179, 0.01257)
)
FISHEYE = Lens(1920, 1080, 600.0, 600.0, 960.0, 540.0, "fisheye", (0.02, -0.01, 0.002, 0.0))
RATIONAL = Lens(
    1280, 720, 620.0, 615.0, 640.0, 350.0, "rational", (0.1, -0.05, 1e-3, 1e-3, 0.01, 0.12, -0.03, 0.0)
)
FLOOR = ((-1.9, -0.95, 0.0), (1.9, 0.95, 1e-12))
SOLID = ((-1.9, -0.95, 0.0), (1.9, 0.95, 0.6))


def looking(position, target, lens=PLUMB_BOB, up=(0.0, 1.0, 0.0)) -> Camera:
    """A camera at a place that looks at another."""
    ahead = np.subtract(target, position) / np.linalg.norm(np.subtract(target, position))
    right = np.cross(ahead, up)
    right = right / np.linalg.norm(right)
    axes = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    return Camera(lens, np.array(position, float), matrix_to_quat(axes))


def overhead(lens=PLUMB_BOB) -> Camera:
    """A camera about 1.2 m above the water, a little askew."""
    return looking((0.03, -0.17, 2.2), (0.1, -0.1, 0.0), lens)


def survey(camera, plane, box, count, seed=0, *, pixel=0.25, error=0.002) -> Observations:
    """Points drawn in a box that the camera sees, with errors of pixels [px] and of the survey [m]."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(*np.array(box), (200 * count, 3))
    found = project(camera, plane, points + error * rng.standard_normal(points.shape))
    seen = np.flatnonzero(found.status == Status.OK)[:count]
    assert len(seen) == count
    pixels = found.pixels[seen] + pixel * rng.standard_normal((count, 2))
    return observations(points[seen], pixels)


def observations(points, pixels) -> Observations:
    """Single points p0, p1, ..."""
    count = len(points)
    names = tuple(f"p{i}" for i in range(count))
    return Observations(
        pixels=np.asarray(pixels, float),
        points=np.asarray(points, float),
        location=np.arange(count),
        names=names,
        locations=names,
        arm=np.zeros((count, 3)),
        dry=np.zeros(count, bool),
    )
