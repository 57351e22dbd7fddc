"""Accuracy and speed of tag detection: `python benchmarks/detection.py [accuracy] [speed] [--json FILE] [--count 60]`.

Parts:
    accuracy  every refinement on rendered tags with known corners: detection rate, bias, error
    speed     processor time on pictures of 1280x720 with two tags: the full picture, and regions around the tags

The rendered tags have edges of 20 to 45 px, random positions, rotations and tilts, blur, noise of 2.5 gray levels and a
white margin of 0.78 cells. Run alone, with OMP_NUM_THREADS=1.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from finssim.localization.detection.detections import Detection
from finssim.localization.detection.detector import REFINEMENTS, Detector, Region, RegionTracker, detector
from finssim.localization.detection.families import FAMILIES
from reference.tag_picture import draw, pose_corners

CASES = [(20.0, 0.5), (20.0, 1.0), (30.0, 0.5), (30.0, 1.0), (45.0, 0.5), (45.0, 1.0)]
"""Edge of the border and standard deviation of the blur [px]."""
NOISE = 2.5
MARGIN = 0.78


def main() -> None:
    """Run the requested parts."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("parts", nargs="*", default=["accuracy", "speed"])
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    results: dict[str, Any] = {}
    if "accuracy" in arguments.parts:
        results["accuracy"] = accuracy(arguments.count)
    if "speed" in arguments.parts:
        results["speed"] = speed()
    if arguments.json:
        arguments.json.write_text(json.dumps(results, indent=1), encoding="utf-8")


def accuracy(count: int) -> list[dict[str, Any]]:
    """Return rows of detection rate and errors."""
    rows = []
    print(f"{'family':17} {'edge':>4} {'blur':>4}  {'refine':9} found   rms  |bias|  outward [px]")
    for family in ("tag25h9", "tag36h11", "tagStandard41h12"):
        for edge, blur in CASES:
            pictures = list(drawn(family, edge, blur, count))
            for way in (detector(family, refine=refine) for refine in REFINEMENTS):
                row = {
                    "family": family,
                    "edge": edge,
                    "blur": blur,
                    "refine": way.refine,
                }
                row |= measured(way, pictures)
                rows.append(row)
                print(
                    f"{family:17} {edge:4.0f} {blur:4.1f}  {way.refine:9} {row['found']:4.0%} "
                    f"{row['rms']:6.3f} {row['bias']:6.3f} {row['outward']:+7.3f}"
                )
    return rows


def drawn(
    family: str, edge: float, blur: float, count: int
) -> Iterator[tuple[int, NDArray[np.float64], NDArray[np.uint8]]]:
    """Yield tag, true corners and picture."""
    rng = np.random.default_rng(7)
    side = round(2 * edge + 60)
    for k in range(count):
        ring = pose_corners(
            edge,
            centre=side / 2 + rng.uniform(-1.0, 1.0, 2),
            turn=rng.uniform(-np.pi, np.pi),
            tilt=rng.uniform(0.0, 0.5),
            towards=rng.uniform(-np.pi, np.pi),
        )
        tag = (5 * k) % FAMILIES[family].count
        light = {"blur": blur, "noise": NOISE, "margin": MARGIN, "seed": k}
        yield tag, ring, draw((side, side), {tag: ring}, family=family, **light)


def measured(way: Detector, pictures: list[tuple[int, Any, Any]]) -> dict[str, float]:
    """Return detection rate, root mean square error per axis, largest mean error of an axis, and mean outward
    error [px]."""
    missed, outward = [], []
    for tag, ring, picture in pictures:
        for found in way.detect(picture):
            if found.tag == tag:
                missed.append(found.corners - ring)
                unit = (ring - ring.mean(axis=0)) / np.linalg.norm(ring - ring.mean(axis=0), axis=1)[:, None]
                outward.append(float(np.mean(np.sum(missed[-1] * unit, axis=1))))
    if not missed:
        return {"found": 0.0, "rms": np.nan, "bias": np.nan, "outward": np.nan}
    apart = np.array(missed)
    return {
        "found": len(missed) / len(pictures),
        "rms": float(np.sqrt(np.mean(apart**2))),
        "bias": float(np.abs(apart.mean(axis=(0, 1))).max()),
        "outward": float(np.mean(outward)),
    }


@dataclass
class Counting:
    """Detector that counts the pixels that it searches."""

    detector: Detector
    pixels: int = 0
    pictures: int = 0

    def detect(self, image: NDArray[np.uint8], region: Region | None = None) -> list[Detection]:
        """Search a picture, or a region of it."""
        left, top, right, bottom = region or (0, 0, image.shape[1], image.shape[0])
        self.pixels += image[max(top, 0) : bottom, max(left, 0) : right].size
        return self.detector.detect(image, region)


def speed() -> list[dict[str, Any]]:
    """Measure the processor time per picture, the best of several rounds [ms]."""
    rows = []
    pictures = [moving(k) for k in range(8)]
    print(f"{'refine':9} whole [ms]  regions [ms]  ratio  pixels searched")
    for refine in ("fit", "edges"):
        find = detector("tag25h9", refine=refine)
        whole = best(lambda find=find: [find.detect(picture) for picture in pictures]) / len(pictures)
        counting = Counting(find)
        tracker = RegionTracker(cast(Detector, counting), [15, 16])
        tracker.detect(pictures[0], 0.0)
        counting.pixels = counting.pictures = 0

        def follow(tracker: RegionTracker = tracker, counting: Counting = counting) -> None:
            for k in (*range(1, 8), *range(6, -1, -1)):
                counting.pictures += 1
                tracker.detect(pictures[k], counting.pictures / 30.0)

        regions = best(follow) / 14
        share = counting.pixels / (counting.pictures * pictures[0].size)
        rows.append({"refine": refine, "whole_ms": whole, "regions_ms": regions, "share": share})
        print(f"{refine:9} {whole:9.1f} {regions:12.2f} {whole / regions:8.1f} {share:10.1%}")
    return rows


def moving(k: int) -> NDArray[np.uint8]:
    """Return a picture of 1280x720 with noise, tiles and the two tags of a moving vehicle."""
    rings = {
        tag: pose_corners(36.0, centre=(500 + 5 * k + shift, 330 + 3 * k), turn=0.4 + 0.02 * k)
        for tag, shift in ((15, 0.0), (16, 60.0))
    }
    picture = draw(
        (720, 1280), rings, family="tag25h9", blur=0.7, noise=NOISE, seed=k, oversampling=3
    ).astype(float)
    tiles = 12.0 * (((np.arange(720)[:, None] // 60) + (np.arange(1280)[None, :] // 60)) % 2)
    return np.clip(picture + tiles, 0, 255).astype(np.uint8)


def best(work: Callable[[], Any], rounds: int = 7) -> float:
    """Return the least processor time of a call [ms]."""
    times = []
    for _ in range(rounds):
        start = time.process_time()
        work()
        times.append(1e3 * (time.process_time() - start))
    return min(times)


if __name__ == "__main__":
    main()
