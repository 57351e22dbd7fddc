"""Cost of the stack in lock-step: `python benchmarks/lockstep.py [corners] [pictures] [--seconds 30] [--profile]`.

Plays setpoint P02 of T1 against a realistic pool: motor controller, instruments, camera and plant in the pool;
decoder, localization, fusion, PID (or `--controller DIR` of a policy), bridge and encoder on the robot. Reported is the
processor time of all threads per simulated second, for robot and pool separately, in the best quarter of the simulated
seconds, beside a fixed loop of Python and NumPy in the same run: on a busy machine the ratios are comparable, the
milliseconds are not.
"""

from __future__ import annotations

import argparse
import json
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cProfile
import math
import pstats
import time
from pathlib import Path
from typing import Any

import numpy as np

from finssim.control.guidance import Station
from finssim.core.quiet import start_warp
from finssim.core.rotations import quat_from_yaw
from finssim.evaluation.metrics import T1_SETPOINTS, T1_START
from finssim.pool import VirtualPool, draw_plant
from finssim.pool.camera import PoolCamera, camera_of
from finssim.robot.perception import Perception
from finssim.robot.pilots import make_pilot
from finssim.robot.runtime import Runtime
from finssim.vehicles import load_vehicle

GOALS = {"corners": 20.0, "pictures": 4.0}
"""Least simulated seconds per second of one core."""
RATE = 60


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("modes", nargs="*", default=list(GOALS))
    parser.add_argument("--seconds", type=int, default=30, help="vehicle seconds")
    parser.add_argument("--controller", default="pid", help="pid or a policy directory")
    parser.add_argument("--profile", action="store_true", help="say where the time goes instead")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    start_warp()
    result = {}
    for mode in given.modes:
        if given.profile:
            profile(mode, given.seconds, given.controller)
        else:
            result[mode] = measure(mode, given.seconds, given.controller)
    if given.json:
        given.json.write_text(json.dumps(result, indent=1))


class Stack:
    """A robot and its pool that are run second by second."""

    def __init__(self, mode: str, controller: str) -> None:
        vehicle = load_vehicle("finsrov")
        true_site, known_site, settings = camera_of(vehicle, 1, "realistic")
        x, y, z, yaw = T1_SETPOINTS["P02"]
        pilot = make_pilot(controller, vehicle, task="t1")
        self.runtime = Runtime(
            vehicle, Perception(vehicle, known_site), pilot, Station((x, y, z), yaw, name="P02"), arm=True
        )
        self.pool = VirtualPool(
            vehicle,
            draw_plant(vehicle, 1, "realistic"),
            camera=PoolCamera(vehicle, true_site, mode=mode, settings=settings, seed=1),
            start=(T1_START[:3], quat_from_yaw(T1_START[3])),
            seed=1,
        )
        self._steps, self._sent = 0, []

    def second(self) -> tuple[float, float]:
        """Run for one simulated second; return the processor time of robot and pool [s]."""
        robot = pool = 0.0
        for _ in range(RATE):
            self._steps += 1
            t0 = time.process_time()
            delivery = self.pool.exchange(self._steps / RATE, self._sent)
            t1 = time.process_time()
            self._sent = self.runtime.step(delivery.time, delivery.frames, delivery.pictures)
            self.runtime.sent(delivery.time)
            pool, robot = pool + t1 - t0, robot + time.process_time() - t1
        return robot, pool


def reference() -> float:
    """Measure the processor time of a fixed loop of small arrays, floats and calls, as in a robot's step [s]."""
    began = time.process_time()
    A, x, total = np.eye(6) * 0.99, np.ones(6), 0.0
    for k in range(4000):
        x = A @ x + 1.0
        total += math.sin(total + k) * math.hypot(0.1 * k, 1.0) + float(x[0])
        total = max(-1e9, min(total, 1e9))
    return time.process_time() - began


def measure(mode: str, seconds: int, controller: str) -> dict[str, Any]:
    """Run, and print the cost of a simulated second."""
    stack = Stack(mode, controller)
    for _ in range(4):  # until it is armed and the camera tracks it
        stack.second()
    rows = np.array([(*stack.second(), reference()) for _ in range(seconds)])
    best = np.sort(rows, axis=0)[: max(1, seconds // 4)].mean(axis=0)
    ratios = np.median(rows[:, :2] / rows[:, 2:], axis=0)
    counters = stack.runtime.counters
    result = {
        "robot_ms": 1e3 * best[0],
        "pool_ms": 1e3 * best[1],
        "reference_ms": 1e3 * best[2],
        "robot_over_reference": ratios[0],
        "pool_over_reference": ratios[1],
        "real_time": 1.0 / (best[0] + best[1]),
        "goal": GOALS[mode],
        "fixes_per_s": counters.fixes / (seconds + 4),
    }
    print(
        f"{mode:9s} robot {result['robot_ms']:6.1f} + pool {result['pool_ms']:6.1f} ms a vehicle second: "
        f"{result['real_time']:5.1f} x real time (goal {GOALS[mode]:g}); over the reference of "
        f"{result['reference_ms']:.1f} ms: {ratios[0]:.2f} + {ratios[1]:.2f}; {result['fixes_per_s']:.1f} fixes/s; "
        f"at {np.round(stack.pool.plant.position, 3).tolist()}"
    )
    return {name: float(value) for name, value in result.items()}


def profile(mode: str, seconds: int, controller: str) -> None:
    """Print the functions that take the most time."""
    stack = Stack(mode, controller)
    for _ in range(4):
        stack.second()
    profiler = cProfile.Profile(time.process_time)
    profiler.enable()
    for _ in range(seconds):
        stack.second()
    profiler.disable()
    stats = pstats.Stats(profiler)
    stats.sort_stats("tottime").print_stats(45)
    stats.sort_stats("cumtime").print_stats(70)


if __name__ == "__main__":
    main()
