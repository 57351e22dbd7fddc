"""`finssim experiment replay`: the paper's Table III against a hidden plant that none of the models can be."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from finssim.calibration.excitation.programmes import programmes
from finssim.calibration.fit import Fit
from finssim.calibration.output.calibrate import calibrated
from finssim.calibration.regression.regress import regress
from finssim.calibration.replay.metrics import RESAMPLES, SEED
from finssim.calibration.replay.replay import Replay, replay
from finssim.experiments.replay_plant import ReplayPlant, load_replay_plant
from finssim.experiments.replay_table import RESULT_FILE, print_table, write_results
from finssim.experiments.running import Say, run_experiment
from finssim.files import atomic_directory, refuse_unwritable
from finssim.provenance import provenance
from finssim.quiet import start_warp
from finssim.vehicles import Vehicle, load_vehicle
from finssim.vehicles.vehicle import Axis

__all__ = ["AXES", "MODELS", "PAPER_TABLE_3", "experiment_seed", "pooled", "replay_experiment", "run"]

AXES: tuple[Axis, ...] = ("surge", "sway", "heave", "yaw")
MODELS = ("calibrated", "mesh", "simplified")

PAPER_TABLE_3 = MappingProxyType(
    {
        "calibrated": (0.315, (0.255, 0.338)),
        "mesh": (1.104, (0.923, 1.282)),
        "simplified": (1.374, (1.201, 1.447)),
    }
)
"""Model -> NRMSE and 95 % interval in the paper: Unity against its real vehicle in its pool."""

REPEATS = 8
"""Of every published level and direction; the odd ones are fitted, the even ones replayed."""


@dataclass(frozen=True)
class SeedResult:
    """One seed: the fit and its replays on trials it has not seen."""

    seed: int
    fit: Fit
    vehicle: Vehicle
    same_levels: Replay
    """The held-out repeats of the levels that were fitted."""
    other_levels: Replay
    """The published validation sweeps, of levels that no fit has seen."""


def run(
    *,
    seeds: int = 3,
    out: Path,
    seed: int = 1,
    as_json: bool = False,
    vehicle: str = "finsrov",
    console: Console | None = None,
) -> dict[str, Any]:
    """Run the experiment with a progress bar, print the table (or one JSON object) and write the directory.

    Arguments as for `replay_experiment`; console is where the table goes, standard output if None.
    """
    return run_experiment(
        "replay experiment",
        lambda say: replay_experiment(seeds=seeds, out=out, seed=seed, vehicle=vehicle, progress=say),
        print_table,
        out=out,
        as_json=as_json,
        console=console,
    )


def replay_experiment(
    *,
    seeds: int,
    out: Path,
    seed: int = 1,
    vehicle: str = "finsrov",
    plant: ReplayPlant | None = None,
    repeats: int = REPEATS,
    axes: Sequence[str] = AXES,
    progress: Say | None = None,
) -> dict[str, Any]:
    """Trials from the hidden plant, identification on half of them, three models replayed on the other half.

    The calibrated model is what the fit found; mesh and simplified have the vehicle file's published numbers. Ctrl-C
    keeps the seeds that are finished.

    Args:
        seeds: How many: each has its own trials, fit and replays.
        out: Directory for `replay_experiment.json`, `.md`, the envelope figure and the calibrated vehicles.
        seed: The first.
        vehicle: Name or file of the vehicle whose file the operator starts from.
        plant: The hidden plant; the shipped one if None.
        repeats: Of every level and direction, an even number.
        axes: Which are excited, fitted and replayed.
        progress: Told the share that is done and what comes next.

    Returns:
        What `replay_experiment.json` holds.

    Raises:
        ValueError: A number of seeds or repeats that cannot be.
    """
    if seeds < 1 or repeats < 2 or repeats % 2:
        raise ValueError(
            f"seeds is {seeds}, repeats {repeats}: expected at least one, and an even number from 2 on"
        )
    refuse_unwritable(atomic_directory(out, replaces=RESULT_FILE))
    start_warp()
    body, water = load_vehicle(vehicle), plant or load_replay_plant()
    done: list[SeedResult] = []
    interrupted = False
    try:
        for k in range(seeds):
            say = _part(progress, k, seeds)
            done.append(experiment_seed(body, water, seed + k, repeats, axes, say))
    except KeyboardInterrupt:
        if not done:
            raise
        interrupted = True
    result = {
        "experiment": "replay",
        "vehicle": {"name": body.name, "sha256": body.sha256},
        "plant": water.model_dump(mode="json"),
        "seeds": [one.seed for one in done],
        "seeds_asked_for": seeds,
        "interrupted": interrupted,
        "trials_per_seed": {
            "fitted": len(done[0].fit.trials),
            "same_levels": len(done[0].same_levels.pairs),
            "other_levels": len(done[0].other_levels.pairs),
        },
        "same_levels": pooled([one.same_levels for one in done]),
        "other_levels": pooled([one.other_levels for one in done]),
        "fits": [_fit(one) for one in done],
        "paper": {m: {"aggregate": v, "ci95": list(ci)} for m, (v, ci) in PAPER_TABLE_3.items()},
        "bootstrap": {"resamples": RESAMPLES, "seed": SEED, "unit": "seed, then trial"},
        "provenance": provenance(),
    }
    write_results(
        result, out, [p for one in done for p in one.same_levels.pairs], [one.vehicle for one in done]
    )
    return result


def experiment_seed(
    vehicle: Vehicle,
    plant: ReplayPlant,
    seed: int,
    repeats: int = REPEATS,
    axes: Sequence[str] = AXES,
    say: Say = lambda part, what: None,
) -> SeedResult:
    """One seed of the experiment; arguments as for `replay_experiment`, `say` is told the share that is done."""
    say(0.0, "trials")
    plan = programmes(axes, vehicle, kind="published", repeats=repeats)
    trials = plant.trials(plan, vehicle, seed)
    fitted, held_out = trials[0::2], trials[1::2]
    say(0.35, "identification")
    fit = regress(fitted, vehicle, axes=axes, seed=seed)
    found = calibrated(fit)
    say(0.6, "replay")
    same = replay(held_out, found, hydrodynamics=MODELS)
    say(0.85, "replay of other levels")
    sweeps = plant.trials(programmes(axes, vehicle, kind="validation"), vehicle, seed + 1_000_000)
    return SeedResult(seed, fit, found, same, replay(sweeps, found, hydrodynamics=MODELS))


def pooled(replays: Sequence[Replay]) -> dict[str, Any]:
    """NRMSE of each model over all seeds: median over trials, mean of the axes, with its interval.

    The bootstrap draws seeds with replacement, then trials within each and axis by axis.

    Args:
        replays: One for each seed, of the same models.
    """
    models: dict[str, Any] = {}
    for model in replays[0].models:
        by_seed = [_values(one, model) for one in replays]
        axes = [axis for axis in AXES if any(len(v.get(axis, ())) for v in by_seed)]
        by_axis = {a: float(np.median(np.concatenate([v[a] for v in by_seed]))) for a in axes}
        models[model] = {
            "aggregate": float(np.mean(list(by_axis.values()))),
            "ci95": _interval(by_seed, axes),
            "by_axis": by_axis,
            "aggregate_mean": float(np.mean([np.concatenate([v[a] for v in by_seed]).mean() for a in axes])),
            "per_seed": [one.aggregate(model).value for one in replays],
            "diverged": sum(model in pair.diverged for one in replays for pair in one.pairs),
        }
    best = min(models, key=lambda model: float(models[model]["aggregate"]))
    return {"models": models, "best": best}


def _values(one: Replay, model: str) -> dict[str, NDArray[np.float64]]:
    """NRMSE of every trial by axis."""
    out: dict[str, list[float]] = {}
    for scores in one.scores[model]:
        for axis, s in scores.items():
            if s.value is not None:
                out.setdefault(axis, []).append(s.value)
    return {axis: np.array(values) for axis, values in out.items()}


def _interval(by_seed: Sequence[Mapping[str, NDArray[np.float64]]], axes: Sequence[str]) -> list[float]:
    random = np.random.default_rng(SEED)
    replicates = np.empty(RESAMPLES)
    for k in range(RESAMPLES):
        drawn = random.integers(len(by_seed), size=len(by_seed))
        medians = [
            np.median(np.concatenate([random.choice(by_seed[s][a], len(by_seed[s][a])) for s in drawn]))
            for a in axes
        ]
        replicates[k] = np.mean(medians)
    return [float(x) for x in np.percentile(replicates, (2.5, 97.5))]


def _fit(one: SeedResult) -> dict[str, Any]:
    return {
        "seed": one.seed,
        "method": one.fit.method,
        "vehicle_sha256": one.vehicle.sha256,
        "parameters": {name: e.as_json() for name, e in one.fit.estimates.items()},
        "warnings": list(one.fit.warnings),
        "trials": dict(one.fit.trials),
        "held_out": {p.name: p.sha256 for p in one.same_levels.pairs},
    }


def _part(progress: Say | None, k: int, seeds: int) -> Say:
    """Progress of one of several seeds."""

    def say(part: float, what: str) -> None:
        if progress is not None:
            progress((k + part) / seeds, f"seed {k + 1} of {seeds}: {what}")

    return say
