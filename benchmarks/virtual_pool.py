"""Speed and memory of the virtual pool: `python benchmarks/virtual_pool.py [plants] [speed] [memory] [--seeds N]`.

Parts:
    plants  steady speed of drawn plants along one axis, over the file's, at 0.1, 0.3 and 0.7 of full power
    speed   processor time of a simulated second: 60 exchanges and 20 commands per second, truth file, no camera
    memory  resident memory after 10 s and after 20 min

In `plants` a guide rail leaves one axis free, without current and tether. Run alone, with OMP_NUM_THREADS=1. `--json
FILE` writes the figures.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from finssim.pool import VirtualPool, draw_plant
from finssim.pool.plant import Plant
from finssim.pool.plant_spec import Basin, Circulation, PlantSpec
from finssim.robot.links.frames import encode_command
from finssim.robot.messages import ThrusterCommand
from finssim.vehicles import load_vehicle

FINSROV = load_vehicle("finsrov")
AXES = {"surge": 0, "sway": 1, "heave": 2, "yaw": 5}
POWERS = (0.1, 0.3, 0.7)
OPEN_WATER = {
    "basin": Basin(length=400.0, width=400.0, depth=200.0),
    "circulation": Circulation(),
    "tether": None,
}
SURGE = encode_command(ThrusterCommand(True, (-0.3, -0.3, 0.0, 0.0, 0.0, -0.3, 0.3, 0.0)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("parts", nargs="*", default=["plants", "speed", "memory"])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    parts = {"plants": lambda: plants(given.seeds), "speed": speed, "memory": memory}
    result = {name: parts[name]() for name in given.parts}
    if given.json:
        given.json.write_text(json.dumps(result, indent=1))


def plants(seeds: int) -> dict[str, Any]:
    """Return mean, least and greatest ratio of steady speed to the file's, by severity, power and axis."""
    table: dict[str, Any] = {}
    for severity in ("realistic", "hard"):
        specs = [draw_plant(FINSROV, seed, severity) for seed in range(seeds)]
        for power in POWERS:
            for name, axis in AXES.items():
                ratios = [steady_ratio(spec, axis, power) for spec in specs]
                row = [round(float(f(ratios)), 3) for f in (np.mean, np.min, np.max)]
                table[f"{severity} {power} {name}"] = row
                spread = f"mean {row[0]:.3f}, from {row[1]:.3f} to {row[2]:.3f}"
                print(f"{severity:10} {power} {name:6} {spread}", flush=True)
    return table


def steady_ratio(spec: PlantSpec, axis: int, power: float) -> float:
    """Return the ratio of the steady speed along one axis to that at which the file's damping balances the
    wrench."""
    hydro = FINSROV.hydrodynamics["calibrated"]
    d1, d2 = hydro.linear_damping[axis, axis], hydro.quadratic_damping[axis, axis]
    wrench = power * FINSROV.wrench_limits[axis]
    plant = Plant(
        FINSROV, spec.model_copy(update=OPEN_WATER), start=((0.0, 0.0, -100.0), (0.0, 0.0, 0.0, 1.0))
    )
    force = np.linalg.pinv(FINSROV.control_matrix) @ (wrench * np.eye(6)[axis])
    pairs = zip(FINSROV.thrusters.values(), force, strict=True)
    plant.target[:] = [float(t.speed(f)) if abs(f) > 0.1 else 0.0 for t, f in pairs]
    M = np.linalg.inv(plant.simulator.plant.M_inv.numpy()[0, 0].astype(float))
    speeds = []
    for _ in range(1600):
        plant.advance()
        # The rail's forces do not change momentum along the axis.
        plant.nu[:] = (M @ plant.nu)[axis] / M[axis, axis] * np.eye(6)[axis]
        plant.quaternion[:] = (0.0, 0.0, 0.0, 1.0)
        speeds.append(float(plant.nu[axis]))
    return float(np.mean(speeds[-400:]) * (d1 + np.sqrt(d1 * d1 + 4.0 * d2 * wrench)) / (2.0 * wrench))


def live(pool: VirtualPool, duration: float) -> None:
    """Run a pool while a robot drives ahead."""
    first = round(60.0 * pool.time) + 1
    for i in range(first, first + round(60.0 * duration)):
        pool.exchange(i / 60.0, [SURGE] if i % 3 == 0 else [])


def speed() -> dict[str, float]:
    """Return milliseconds of processor time per simulated second, the best of 15 runs of 2 s, by severity."""
    best = {}
    with tempfile.TemporaryDirectory() as directory:
        for severity in ("nominal", "realistic", "hard"):
            pool = VirtualPool(FINSROV, draw_plant(FINSROV, 1, severity), truth=Path(directory) / "truth")
            times = []
            for _ in range(15):
                start = time.process_time()
                live(pool, 2.0)
                times.append(500.0 * (time.process_time() - start))
            best[severity] = round(min(times), 2)
            print(
                f"{severity:10} {min(times):.1f} ms for a vehicle second, {1000.0 / min(times):.0f} x real time"
            )
    return best


def memory() -> list[float]:
    """Return the resident memory after 10 s and 20 min of simulated time [MiB]."""
    pool = VirtualPool(FINSROV, draw_plant(FINSROV, 1, "realistic"))
    sizes = []
    for duration in (10.0, 1190.0):
        live(pool, duration)
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        sizes.append(round(pages * 4096 / 2**20, 2))
        print(f"{sizes[-1]:.1f} MiB after {pool.time:.0f} s")
    return sizes


if __name__ == "__main__":
    main()
