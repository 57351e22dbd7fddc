"""Cost of projection through the water: `python benchmarks/optics.py`.

Microseconds per call and per point on one core, the best of many, and the ratio to cv2.projectPoints (which has no
water) in the same run.
"""

import argparse
import json
import time

import cv2
import numpy as np

from finssim.core.optics import Camera, Interface, Lens, back_project, project, projection_jacobians

LENS = Lens(
    1280,
    720,
    540.9305,
    540.9305,
    682.2341,
    348.6136,
    distortion=(0.02944176, -0.05975546, 0.00088098, 0.00179148, 0.01256862),
)
CAMERA = Camera(LENS, (0.033, -0.167, 2.172), (1.0, 0.0, 0.0, 0.0))
WATER = Interface.water(0.96)


def best(call, seconds: float = 0.5) -> float:
    """Return the least time of a call [µs], over batches of calls for a number of seconds."""
    call()
    start = time.perf_counter()
    call()
    count = max(1, int(0.005 / (time.perf_counter() - start)))
    end, least = start + seconds, np.inf
    while time.perf_counter() < end:
        begin = time.perf_counter()
        for _ in range(count):
            call()
        least = min(least, (time.perf_counter() - begin) / count)
    return 1e6 * least


def measure(count: int) -> dict[str, float]:
    """Measure the time of each function for a number of points [µs per call]."""
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-1.0, 1.0, (count, 2)), rng.uniform(0.0, 0.9, (count, 1))], axis=-1)
    pixels, zero = project(CAMERA, WATER, points).pixels, np.zeros(3)
    shifted, distortion = points - [0.0, 0.0, 3.0], np.array(LENS.distortion)
    return {
        "cv2.projectPoints": best(lambda: cv2.projectPoints(shifted, zero, zero, LENS.K, distortion)),
        "project": best(lambda: project(CAMERA, WATER, points)),
        "back_project": best(lambda: back_project(CAMERA, WATER, pixels)),
        "derivative by point": best(lambda: projection_jacobians(CAMERA, WATER, points).point),
        "all derivatives": best(lambda: every_derivative(points)),
    }


def every_derivative(points: np.ndarray) -> list[np.ndarray]:
    """Return the derivatives of pixels by point, pose, plane, index and lens."""
    found = projection_jacobians(CAMERA, WATER, points)
    return [found.point, found.pose, found.interface, found.index, found.lens]


def main() -> None:
    """Print one JSON object per number of points."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    for count in (8, 1000):
        times = measure(count)
        print(
            json.dumps(
                {
                    "points": count,
                    "us_per_call": {name: round(t, 1) for name, t in times.items()},
                    "us_per_point": {name: round(t / count, 3) for name, t in times.items()},
                    "times_cv2": {
                        name: round(t / times["cv2.projectPoints"], 1) for name, t in times.items()
                    },
                }
            )
        )


if __name__ == "__main__":
    main()
