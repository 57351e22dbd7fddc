"""Policies of a task for vehicles that must move to steer, beside its classical baseline, in plants of a given seed.

    python benchmarks/steering.py TASK --plants SEED [--vehicle remus100] [--plant beyond_cruise] [--trials 200]
        [--seeds 1,2,3,4,5] [--steps N] [--init NAME] [--set NAME=VALUE] [--out DIR] [--json FILE]

Every policy is `finssim train TASK --randomize cruise --seed S`; a policy in --out with the same options is reused. All
controllers have the same plants and starts, those of `finssim evaluate --seed SEED`. Intervals contain 95 % of 2000
resampled figures: each resamples learner seeds and plants with replacement, with the same plants for policy and
baseline. `less error` is the baseline's error minus the policy's, in the plants where both have one. `fast` is the
baseline with action 1 for its speed, the highest speed of the autopilot.
"""

from __future__ import annotations

import argparse
import json
import time
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from finssim.agents.agent import BaselineAgent
from finssim.core.provenance import provenance
from finssim.evaluation.evaluate import evaluate_controller
from finssim.evaluation.plants import load_plant
from finssim.evaluation.statistics import bootstrap
from finssim.evaluation.trials import TrialSettings
from finssim.learning.train import TrainingSettings, train
from finssim.tasks import Task, task_named
from finssim.vehicles import Vehicle

Array = NDArray[np.float64]


class Fast(BaselineAgent):
    """Baseline of a task at the highest speed of the autopilot."""

    def __init__(self, vehicle: Vehicle, task: Task) -> None:
        super().__init__(next(iter(task.baselines)), vehicle, task)

    def act(self, memory: Any, reading: Any, goal: Any) -> Any:
        """Return the actions of the baseline, with 1 for the speed."""
        action, memory = super().act(memory, reading, goal)
        return np.column_stack([np.ones_like(action[:, :1]), action[:, 1:]]), memory


def tried(controller: str, given: argparse.Namespace) -> dict[str, Array]:
    """Return success [-] and error [m] of a controller in every plant, (plants,); a missing error is NaN."""
    settings = TrialSettings(trials=given.trials, seed=given.plants)
    found = evaluate_controller(
        controller,
        load_plant(given.plant),
        settings,
        task=given.task,
        vehicle=given.vehicle,
    )
    rows = found.result["per_trial"]
    return {name: np.array([row[name] for row in rows], float) for name in ("success", "error")}


def figure(values: Array) -> dict[str, Any]:
    """Return the mean of values (seeds, plants), and its interval over both."""

    def redraw(random: np.random.Generator) -> Any:
        seeds, plants = (random.integers(n, size=n) for n in values.shape)
        return np.nanmean(values[np.ix_(seeds, plants)])

    return {"value": float(np.nanmean(values)), "ci95": bootstrap(redraw).tolist()}


def trained(given: argparse.Namespace, seed: int) -> tuple[str, float]:
    """Return the folder of the policy of a seed, and the cost of its training [processor-s], 0 if it existed."""
    asked = json.dumps([given.vehicle, given.steps, given.init, given.set])
    folder = given.out / f"{given.task}-{seed}-{zlib.crc32(asked.encode()):08x}"
    before = time.process_time()
    if not folder.is_dir():
        settings = TrainingSettings(
            vehicle=given.vehicle,
            randomize="cruise",
            seed=seed,
            steps=given.steps,
            init=given.init,
            settings=given.set,
        )
        train(given.task, out=folder, settings=settings, console=Console(quiet=True))
    return str(folder), time.process_time() - before


def main() -> None:
    """Train missing policies, evaluate all controllers, print, and write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("task")
    parser.add_argument("--plants", type=int, required=True, metavar="SEED")
    parser.add_argument("--vehicle", default="remus100")
    parser.add_argument("--plant", default="beyond_cruise")
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--seeds", default="1,2,3,4,5")
    parser.add_argument("--steps", type=int)
    parser.add_argument("--init")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE")
    parser.add_argument("--out", type=Path, default=Path("steering"))
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    (baseline,) = task_named(given.task).baselines
    classical = {baseline: tried(baseline, given), "fast": tried(f"{__file__}:Fast", given)}
    learned, costs = [], []
    for name, one in classical.items():
        print(f"{name}: success {np.mean(one['success']):.3f}, error {np.nanmean(one['error']):.3f} m")
    for seed in map(int, given.seeds.split(",")):
        folder, cost = trained(given, seed)
        learned.append(tried(folder, given))
        costs.append(cost)
        means = {name: float(np.nanmean(values)) for name, values in learned[-1].items()}
        print(
            f"seed {seed}: success {means['success']:.3f}, error {means['error']:.3f} m, {cost:.0f} s",
            flush=True,
        )
    every = {name: np.array([one[name] for one in learned]) for name in learned[0]}
    figures = {f"learned {name}": figure(values) for name, values in every.items()}
    for who, one in classical.items():
        figures |= {f"{who} {name}": figure(values[None]) for name, values in one.items()}
        figures[f"more success than {who}"] = figure(every["success"] - one["success"])
        figures[f"less error than {who}"] = figure(one["error"] - every["error"])
    for name, one in figures.items():
        print(f"{name:32s} {one['value']:.3f} [{one['ci95'][0]:.3f}, {one['ci95'][1]:.3f}]")
    if given.json:
        about = {key: str(value) for key, value in vars(given).items()} | {"processor_s": costs}
        per_plant = {key: np.round(values, 4).tolist() for key, values in (*every.items(),)}
        record = {"settings": about, "provenance": provenance(), "figures": figures, "learned": per_plant}
        record["baselines"] = {
            who: {key: np.round(values, 4).tolist() for key, values in one.items()}
            for who, one in classical.items()
        }
        given.json.write_text(json.dumps(record) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
