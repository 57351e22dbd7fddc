"""Processor time of the estimator per sample: `python benchmarks/fusion.py [--json FILE]`.

A minute of IMU at 100 Hz, depth at 20 Hz and a camera at 30 Hz whose fixes arrive 60 ms after exposure, so that each
fix repeats about eight later samples; then a prediction of the state 10 ms ahead. Reported are medians of processor
time, which other load disturbs less than wall time, and the fraction of one core that the live estimator needs.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from finssim.localization.fusion.estimator import MODELS, Estimator
from finssim.localization.fusion.streams import DepthSample, ImuSample, Sample, VisionSample

DURATION = 60.0
LATENCY = 0.06
RATES = {"imu": 100.0, "depth": 20.0, "vision": 30.0}


def samples(*, tilt: bool) -> list[Sample]:
    """Return the samples of a level vehicle on a circle, with or without roll and pitch from the IMU."""
    rng = np.random.default_rng(0)
    found: list[Sample] = []
    for t in np.arange(0.0, DURATION, 1.0 / RATES["imu"]):
        rates = tuple(np.array([0.0, 0.0, 0.3]) + 0.002 * rng.standard_normal(3))
        force = tuple(np.array([0.0, 0.15, 9.81]) + 0.02 * rng.standard_normal(3))
        found.append(ImuSample(t, rates, force, (0.0, 0.0) if tilt else None, t))
    found += [
        DepthSample(t, 0.5 + 0.01 * rng.standard_normal(), t + 0.01)
        for t in np.arange(0.003, DURATION, 1.0 / RATES["depth"])
    ]
    for t in np.arange(0.011, DURATION, 1.0 / RATES["vision"]):
        xy = 0.5 / 0.3 * np.array([np.sin(0.3 * t), -np.cos(0.3 * t)]) + 0.01 * rng.standard_normal(2)
        yaw = 0.3 * t + 0.02 * rng.standard_normal()
        R = ((1e-4, 0.0, 0.0), (0.0, 1e-4, 0.0), (0.0, 0.0, 4e-4))
        found.append(VisionSample(t, (xy[0], xy[1]), yaw, R, t + LATENCY))
    return sorted(found, key=lambda s: s.arrival or 0.0)


def measure(mode: str, *, tilt: bool) -> dict[str, float]:
    """Measure microseconds per sample of each stream and per prediction, and the fraction of a core [%]."""
    estimator, took = Estimator(mode=mode), {name: [] for name in (*RATES, "predict")}
    for sample in samples(tilt=tilt):
        took[sample.stream].append(_timed(lambda s=sample: estimator.add(s)))
        if sample.stream == "vision":
            newest = estimator.estimate().time
            took["predict"].append(_timed(lambda t=newest + 0.01: estimator.estimate(t)))
    figures = {name: float(np.median(values)) for name, values in took.items()}
    share = sum(RATES[name] * np.mean(took[name]) for name in RATES) * 1e-6
    return {**figures, "vision_p99": float(np.percentile(took["vision"], 99)), "core_percent": 100.0 * share}


def _timed(call: Callable[[], Any]) -> float:
    start = time.thread_time_ns()
    call()
    return (time.thread_time_ns() - start) * 1e-3


def main() -> None:
    """Measure, print, and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--json", type=Path, help="file for the figures")
    given = parser.parse_args()
    found = {}
    for mode in MODELS:
        for tilt in (True, False):
            name = f"{mode}, {'tilt from the IMU' if tilt else 'tilt from gyro and accelerometer'}"
            found[name] = figures = measure(mode, tilt=tilt)
            print(name + ": " + ", ".join(f"{key} {value:.0f}" for key, value in figures.items()))
    print("microseconds; core_percent is the share of one core")
    if given.json:
        given.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
