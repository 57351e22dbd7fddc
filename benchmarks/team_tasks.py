"""Agent-steps per second of tasks with several vehicles: `python benchmarks/team_tasks.py [TASK ...] [--worlds N]`.

Each agent's action counts as one step. Actions are drawn beforehand and are in the environment's own array, as after a
learner on the same device; physics, allocation, script, rewards, observations and resets are included.

    best, median   of several rounds, by wall time: run alone
    per_core       by processor time, which other load disturbs least
    vehicles       steps of all simulated vehicles, including scripted ones, in the best round
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from pathlib import Path

import numpy as np

from finssim import make
from finssim.core.files import atomic_write
from finssim.tasks import TASKS

ROUNDS, SECONDS = 5, 2.0


def measure(task: str, worlds: int, device: str, threads: int | None) -> dict[str, float]:
    """Return the steps of all agents per second, under the names in the module's docstring."""
    environment = make(task, worlds=worlds, device=device, threads=threads)
    rng = np.random.default_rng(0)
    size = environment.agents * environment.action_size
    environment.arrays.action.assign(rng.uniform(-1.0, 1.0, (worlds, size)).astype(np.float32))
    for _ in range(20):
        environment.advance()
    rates, processor = [], []
    for _ in range(ROUNDS):
        steps, began, cpu = 0, time.perf_counter(), time.process_time()
        while (now := time.perf_counter()) - began < SECONDS:
            for _ in range(5):
                environment.advance()
            environment.arrays.done.numpy()  # on a GPU, waits for the steps
            steps += 5
        done = steps * worlds * environment.agents
        rates.append(done / (now - began))
        processor.append(done / (time.process_time() - cpu))
    vehicles = len(environment.simulator.vehicles)
    return {
        "best": max(rates),
        "median": statistics.median(rates),
        "per_core": max(processor),
        "vehicles": max(rates) * vehicles / environment.agents,
    }


def main() -> None:
    """Measure, print, and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("tasks", nargs="*", default=["pursuit", "team-pursuit", "formation"], metavar="TASK")
    parser.add_argument("--worlds", type=int, default=4096)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int)
    parser.add_argument("--json", type=Path, help="file for the figures")
    given = parser.parse_args()
    unknown = [task for task in given.tasks if task not in TASKS]
    if unknown:
        parser.error(f"unknown task '{unknown[0]}'; available: {', '.join(TASKS)}")
    figures = {}
    print(f"{given.worlds} worlds on {given.device}; agent-steps/s, millions")
    for task in given.tasks:
        figures[task] = measure(task, given.worlds, given.device, given.threads)
        words = "  ".join(f"{name} {1e-6 * value:6.3f}" for name, value in figures[task].items())
        print(f"  {task:<14}{words}", flush=True)
    if given.json:
        record = {"worlds": given.worlds, "device": given.device, **figures}
        with atomic_write(given.json) as path:
            path.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
