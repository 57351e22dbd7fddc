"""Run the robot's complete software against a virtual pool, and compare its estimate with the truth.

    python examples/virtual_pool.py

Robot and pool step alternately, as fast as they compute. The pool's vehicle, water and camera are drawn around the
vehicle file, and no controller was tuned on them. Needs the extra "vision".
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from finssim.control import Station
from finssim.core import start_warp
from finssim.pool import PoolCamera, VirtualPool, camera_of, draw_plant, read_truth
from finssim.robot import Perception, Runtime, make_pilot, run_lockstep
from finssim.vehicles import load_vehicle

SEED, DURATION = 7, 20.0


def main() -> None:
    """Hold a station for a while."""
    start_warp()
    vehicle = load_vehicle("finsrov")
    true_camera, calibrated_camera, settings = camera_of(vehicle, SEED, "realistic")
    station = Station((0.8, -0.3, -0.5), yaw=1.0)
    perception = Perception(vehicle, calibrated_camera)
    robot = Runtime(vehicle, perception, make_pilot("pid", vehicle), station, arm=True)
    with tempfile.TemporaryDirectory() as folder:
        pool = VirtualPool(
            vehicle,
            draw_plant(vehicle, SEED, "realistic"),
            camera=PoolCamera(vehicle, true_camera, mode="corners", settings=settings, seed=SEED),
            seed=SEED,
            truth=Path(folder) / "dive.truth",
        )
        run_lockstep(robot, pool, DURATION)
        pool.close()
        truth = read_truth(Path(folder) / "dive.truth")
    assert robot.reading is not None
    away = np.linalg.norm(truth.position[-1] - np.array(station.position))
    off = np.linalg.norm(truth.position[-1] - robot.reading.position)
    print(
        f"{100.0 * away:.1f} cm from the station after {DURATION:.0f} s; the estimate is {100.0 * off:.1f} cm off"
    )
    print(
        f"bridge: {robot.bridge.state}; battery {truth.voltage[-1]:.2f} V; decisions {robot.counters.decisions}"
    )


if __name__ == "__main__":
    main()
