"""Time of one pose from eight corners, each method: `python benchmarks/planar_fit.py [--json FILE]`.

One core, the best of many repetitions, beside cv2.solvePnP and one 100 x 100 matrix product in the same run: on a busy
machine the ratios hold where the microseconds do not.
"""

from __future__ import annotations

import argparse
import json
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import timeit
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from finssim.core.optics import Camera, Interface, Lens, project
from finssim.core.rotations import quat_from_euler, quat_to_matrix
from finssim.localization.detection.detections import Detection
from finssim.localization.detection.families import tag_corners_b
from finssim.localization.overhead_camera import Pool
from finssim.localization.poses import Constraints
from finssim.localization.poses.methods import METHODS
from finssim.vehicles import load_vehicle

LIMIT = 500.0
"""Largest time of the constrained fit [µs]."""


def best(call: Callable[[], object], number: int) -> float:
    """Return the least time of a call [µs]."""
    call()
    return 1e6 * min(timeit.repeat(call, number=number, repeat=60)) / number


def main() -> None:
    """Measure, print, and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--json", type=Path, help="file for the figures")
    given = parser.parse_args()
    distortion = (0.02944176, -0.05975546, 0.00088098, 0.00179148, 0.01256862)
    lens = Lens(1280, 720, 540.9305, 540.9305, 682.2341, 348.6136, "plumb_bob", distortion)
    orientation = np.array([0.99876852, -0.00261252, 0.00069494, -0.04953919])
    camera = Camera(
        lens, np.array([0.032897, -0.167178, 2.171935]), orientation / np.linalg.norm(orientation)
    )
    pool = Pool(camera, Interface.water(0.96))
    tags_b = tag_corners_b(load_vehicle("finsrov").tags)
    position, angles = np.array([0.5, -0.3, 0.4]), (0.05, -0.08, 2.5)
    R, rng = quat_to_matrix(quat_from_euler(*angles)), np.random.default_rng(0)
    detections = [
        Detection(
            tag, project(camera, pool.interface, corners @ R.T + position).pixels + rng.normal(0, 0.3, (4, 2))
        )
        for tag, corners in tags_b.items()
    ]
    known = Constraints(position[2], roll=angles[0], pitch=angles[1])
    figures = {
        name: best(
            lambda method=method: method(detections, pool, tags_b, known, 0.3), 20 if "6" not in name else 1
        )
        for name, method in METHODS.items()
    }
    points, pixels = np.concatenate(list(tags_b.values())), np.concatenate([d.corners for d in detections])
    square = rng.normal(size=(100, 100))
    figures["cv2.solvePnP"] = best(lambda: cv2.solvePnP(points, pixels, lens.K, np.array(distortion)), 20)
    figures["100 x 100 product"] = best(lambda: square @ square, 20)
    for name, time in figures.items():
        print(f"{name:20s} {time:9.0f} µs   {time / figures['cv2.solvePnP']:7.1f} of solvePnP")
    print(f"limit for `refractive`: {LIMIT:.0f} µs")
    if given.json:
        given.json.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
