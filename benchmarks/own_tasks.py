"""Cost of a task in plain torch compared with the same task in Warp: station keeping, steps of all worlds per second.

python benchmarks/own_tasks.py --worlds 256 4096
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np
import torch

import finssim
from finssim.core.quiet import start_warp
from finssim.tasks import Task, task_named

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "t1_in_torch.py"


def rate(task: str | Task, worlds: int, device: str, seconds: float) -> float:
    """Return steps of all worlds per second, with episodes of all ages and random actions; the best of three."""
    env = finssim.make(task, worlds=worlds, device=device, seed=1)
    limit = round(env.task.time_limit / env.task.control_step)
    rng = np.random.default_rng(0)
    env.simulator.state.steps.assign(rng.integers(0, limit, worlds).astype(np.int32))
    env.arrays.action.assign(rng.uniform(-1.0, 1.0, env.arrays.action.shape).astype(np.float32))
    for _ in range(20):
        env.advance()
    best = 0.0
    for _ in range(3):
        began, steps = time.perf_counter(), 0
        while (took := time.perf_counter() - began) < seconds:
            env.advance()
            steps += 1
        env.arrays.reward.numpy()  # waits for a GPU
        best = max(best, steps * worlds / took)
    return best


def main() -> None:
    """Print a line for each number of worlds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, nargs="+", default=[256, 4096])
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--seconds", type=float, default=2.0)
    given = parser.parse_args()
    start_warp()
    torch.set_num_threads(1)
    print(f"{'worlds':>8} {'Warp [steps/s]':>16} {'torch [steps/s]':>16} {'times as long':>14}")
    for worlds in given.worlds:
        tasks = ("t1", task_named(f"{EXAMPLE}:TorchStationKeeping"))
        warp, plain = (rate(task, worlds, given.device, given.seconds) for task in tasks)
        print(f"{worlds:8d} {warp:16,.0f} {plain:16,.0f} {warp / plain:14.2f}")


if __name__ == "__main__":
    sys.exit(main())
