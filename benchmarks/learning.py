"""Cost and result of trainings: `python benchmarks/learning.py [ROW ...] [--json FILE]`.

Every training is `finssim train` in its own process, on one processor, from its start to the written policy, measured
in processor-seconds of that process and its children. T1 with PPO of Stable-Baselines3 runs beside them: on another
machine the ratio is comparable, the seconds are not. The policy is then evaluated with `finssim evaluate`.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

COMMAND = [sys.executable, "-m", "finssim"]
PLANT = {"title": "another vehicle in every trial (ranges pool)", "ranges": "pool"}


@dataclass(frozen=True)
class Row:
    """Training and its evaluation."""

    task: str
    seeds: tuple[int, ...]
    train: tuple[str, ...] = ()
    """Further options of `finssim train`."""
    evaluate: tuple[str, ...] = ()
    """Further options of `finssim evaluate`."""


ROWS = {
    "t1": Row("t1", (1, 2, 3, 4, 5)),
    "t1 for longer": Row("t1", (1, 2, 3), ("--steps", "1500000", "--set", "hidden=64,64")),
    "t1 randomised": Row("t1", (1, 2, 3), ("--randomize", "pool"), ("--plant", "PLANT", "--trials", "200")),
    "t2": Row("t2", (1, 2, 3)),
    "t3": Row("t3", (1, 2, 3), (), ("--trials", "128")),
    "docking": Row("docking", (1, 2, 3), (), ("--trials", "128")),
    "t1 of sb3-ppo": Row("t1", (1,), ("--learner", "sb3-ppo")),
}
RATIO_TO = "t1 of sb3-ppo"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("rows", nargs="*", metavar="ROW", help=", ".join(ROWS))
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    rows = {name: ROWS[name] for name in dict.fromkeys([RATIO_TO, *(given.rows or ROWS)])}
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    results: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        plant = Path(folder) / "pool-ranges.yaml"
        plant.write_text(yaml.safe_dump(PLANT))
        warm = ["train", "t1", "--steps", "4096", "--out", f"{folder}/warm"]
        measured([*COMMAND, *warm], environment)  # compile the kernels before the measurement
        for name, row in rows.items():
            results[name] = [
                run(row, seed, Path(folder) / f"{name}-{seed}", plant, environment) for seed in row.seeds
            ]
            base = results[RATIO_TO][0]["processor_s"]
            for seed, result in zip(row.seeds, results[name], strict=True):
                result["ratio"] = result["processor_s"] / base
                numbers = ", ".join(f"{k} {v:.4g}" for k, v in result.items())
                print(f"{name}, seed {seed}: {numbers}", flush=True)
    if given.json:
        given.json.write_text(json.dumps(results, indent=1))


def run(row: Row, seed: int, folder: Path, plant: Path, environment: dict[str, str]) -> dict[str, float]:
    """Train and evaluate; return the cost, and the metrics of `evaluate` over all trials."""
    train = ["train", row.task, "--seed", str(seed), "--out", str(folder), *row.train]
    processor, wall = measured([*COMMAND, *train], environment)
    words = [str(plant) if word == "PLANT" else word for word in row.evaluate]
    done = subprocess.run(
        [*COMMAND, "evaluate", str(folder), "--task", row.task, "--json", *words],
        check=True, capture_output=True, text=True, env=environment,
    )  # fmt: skip
    told = json.loads(done.stdout)
    result = told[0] if isinstance(told, list) else told
    result |= {name: measure["value"] for name, measure in result.get("metrics", {}).items()}
    names = (
        "success",
        "trials",
        "e_p_m",
        "e_psi_deg",
        "horizontal_rmse_m",
        "vertical_rmse_m",
        "success_time",
        "error",
    )
    return {
        "processor_s": processor,
        "wall_s": wall,
        **{name: float(result[name]) for name in names if isinstance(result.get(name), int | float)},
    }


def measured(command: list[str], environment: dict[str, str]) -> tuple[float, float]:
    """Measure processor and wall time of a command [s]."""
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run(command, check=True, capture_output=True, env=environment)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return used, time.perf_counter() - began


if __name__ == "__main__":
    main()
