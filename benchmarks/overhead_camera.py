"""Wall time of rendering 1280x720 pictures on one core: `python benchmarks/overhead_camera.py [--json FILE]`.

The published camera above 1 m of water, two tags of 9.3 cm: the full picture and the neighbourhood of the tags, with a
still and a rippling surface. Each figure is the best of many, since other load disturbs wall time.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from finssim.core.optics import Camera, Interface, Lens
from finssim.localization.detection.families import bitmap
from finssim.sim.overhead_camera import (
    ImageSensor,
    ObjectPose,
    OverheadCamera,
    Ripples,
    Scene,
    TagInScene,
    TiledBasin,
)

DISTORTION = (0.02944176, -0.05975546, 0.00088098, 0.00179148, 0.01256862)
LENS = Lens(1280, 720, 540.9305, 540.9305, 682.2341, 348.6136, "plumb_bob", DISTORTION)
ORIENTATION = np.array([0.99876852, -0.00261252, 0.00069494, -0.04953919])
SURFACES = {
    "still": None,
    "rippling": Ripples(rms_slope=0.03),
}


TAGS = tuple(
    TagInScene(
        bitmap=bitmap("tag25h9", number),
        edge=0.093,
        margin=0.0133,
        pose=ObjectPose(position=(x, 0.2, 0.7), orientation=(0.0, 0.0, 0.7071068, 0.7071068)),
    )
    for number, x in ((15, 0.37), (16, 0.23))
)


def published_scene() -> Scene:
    """Return the published camera and water."""
    camera = Camera(
        LENS, np.array([0.032897, -0.167178, 2.171935]), ORIENTATION / np.linalg.norm(ORIENTATION)
    )
    return Scene(
        camera=camera,
        interface=Interface.water(0.96),
        basin=TiledBasin(lower=(-2.0, -1.5, 0.0), upper=(2.0, 1.5, 1.2)),
        sensor=ImageSensor(shutter=0.005),
    )


def best(draw: Callable[[int], object], repetitions: int) -> float:
    """Return the least time of a call [s]; the first call compiles and does not count."""
    draw(0)
    times = []
    for i in range(repetitions):
        start = time.perf_counter()
        draw(i)
        times.append(time.perf_counter() - start)
    return min(times)


def measure(scene: Scene, device: str) -> dict[str, float]:
    """Measure the times of one kind of surface [s], and count the pixels of the neighbourhood."""
    camera = OverheadCamera(scene, device=device)
    return {
        "complete": best(lambda i: camera.render(tags=TAGS, time=i / 30), 5),
        "tags": best(lambda i: camera.render(tags=TAGS, time=i / 30, region="tags"), 40),
        "pixels": sum(r.area for r in camera.neighbourhood(TAGS)),
    }


def main() -> None:
    """Measure, print, and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--json", type=Path, help="file for the figures")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    given = parser.parse_args()
    scene = published_scene()
    figures = {
        name: measure(replace(scene, ripples=ripples), given.device) for name, ripples in SURFACES.items()
    }
    print(f"{'surface':<12}{'complete':>10}{'tags':>10}   [ms], and the pixels around the tags")
    for name, f in figures.items():
        print(f"{name:<12}{1e3 * f['complete']:>10.1f}{1e3 * f['tags']:>10.2f}   {f['pixels']:.0f}")
    if given.json:
        given.json.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
