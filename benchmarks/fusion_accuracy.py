"""Accuracy of the fusion: `python benchmarks/fusion_accuracy.py [--seeds N]`.

Simulated streams with an exactly known path and typical faults, in both modes; and recordings of a real BlueROV2, with
its gyro at 20 Hz and one heading per second, compared with motion capture at the full rate.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
from pathlib import Path

import numpy as np

from finssim.core.rotations import wrap_angle
from finssim.localization.fusion.estimator import MODELS, Estimator
from finssim.localization.fusion.fuse import FuseSettings, fuse
from finssim.localization.fusion.fuse_log import load_log
from finssim.localization.fusion.fuse_settings import Settings
from finssim.localization.overhead_camera import load_pool
from finssim.vehicles import load_vehicle

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from localization.fusion.hinsdale_log import CLEAN, clock_offset, hinsdale
from localization.fusion.known_streams import (
    SITE,
    position,
    run,
    shuffled,
    slope,
    streams,
    with_flips,
    with_outliers,
    without_vision,
    yaw,
)

TIMES = np.arange(2.0, 24.0, 1.0 / 60.0)
SCENARIOS = (
    "clean",
    "5 % outliers, 5 % flips",
    "200 ms late, 10 % twice",
    "camera at 5 Hz",
    "three dropouts of 3 s",
)
POOL = """
camera: {lens: {width: 1280, height: 720, fx: 541, cx: 640, cy: 360}, position: [0, 0, 2.2], orientation: [1, 0, 0, 0]}
interface: {height: 1.0}
"""


def scenario(name: str, seed: int) -> list:
    """Return the samples of a scenario."""
    samples, rng = streams(24.0, seed=seed), np.random.default_rng(100 + seed)
    if name == SCENARIOS[1]:
        return with_flips(with_outliers(samples, 0.05, rng), 0.05, rng)
    if name == SCENARIOS[2]:
        return shuffled(samples, 0.2, 0.1, rng)
    if name == SCENARIOS[3]:
        return [s for s in samples if s.stream != "vision" or round((s.time - 0.011) * 30.0) % 6 == 0]
    if name == SCENARIOS[4]:
        for start in (5.0, 11.0, 17.0):
            samples = without_vision(samples, start, start + 3.0)
    return samples


def figures(name: str, mode: str, seeds: int) -> str:
    """Return one row of the table."""
    place, speed, turn = [], [], []
    for seed in range(seeds):
        found = run(Estimator(Settings(), SITE, mode=mode), scenario(name, seed), TIMES)
        x = np.array([e.x for e in found])
        place.append(x[:, :3] - position(TIMES))
        speed.append(x[:, 3:] - slope(position, TIMES))
        turn.append(wrap_angle(np.array([e.yaw for e in found]) - yaw(TIMES)))
    p, v, psi = (np.concatenate(part) for part in (place, speed, turn))
    flat = np.hypot(p[:, 0], p[:, 1])
    rms = [100.0 * np.sqrt(np.mean(a**2)) for a in (flat, p[:, 2], np.linalg.norm(v, axis=1))]
    degrees = math.degrees(np.sqrt(np.mean(psi**2)))
    return f"{rms[0]:.2f} | {100 * flat.max():.1f} | {rms[1]:.2f} | {rms[2]:.1f} | {degrees:.2f}"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seeds", type=int, default=4, help="runs of each scenario")
    given = parser.parse_args()
    print(
        "scenario | filter | horizontal rms [cm] | largest [cm] | z rms [cm] | velocity rms [cm/s] | yaw rms [deg]"
    )
    for name in SCENARIOS:
        for mode in MODELS:
            print(f"{name} | {mode} | {figures(name, mode, given.seeds)}", flush=True)
    print("\ntrial | yaw rms [deg] | p95 [deg] | fixes | IMU late by, not used [s]")
    with tempfile.TemporaryDirectory() as scratch:
        for trial in CLEAN:
            print(f"{trial} | {recorded(Path(scratch), trial)} | {clock_offset(trial):+.2f}")


def recorded(scratch: Path, trial: str) -> str:
    """Return the figures of one recording."""
    (scratch / "pool.yaml").write_text(POOL)
    folder, t, heading = hinsdale(scratch / trial, trial)
    vehicle = load_vehicle("finsrov")
    settings = FuseSettings(rate=100.0, estimator="constant-velocity")
    found = fuse(load_log(folder, vehicle), load_pool(scratch / "pool.yaml"), vehicle, settings)
    rows = np.array([[row[0], row[9]] for row in found.rows], float)
    error = np.abs(wrap_angle(rows[:, 1] - np.interp(rows[:, 0], t, np.unwrap(heading))))
    error = np.degrees(error[np.isfinite(error)])
    fixes = found.summary["accepted"]["yaw"]
    return f"{np.sqrt(np.mean(error**2)):.2f} | {np.percentile(error, 95):.2f} | {fixes}"


if __name__ == "__main__":
    main()
