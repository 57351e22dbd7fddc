"""`finssim experiment replay`: the paper's Table III with a hidden plant outside the class of every model."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Any

import numpy as np
import yaml
from numpy.typing import NDArray

from finssim.core.files import atomic_directory, refuse_unwritable
from finssim.core.provenance import provenance
from finssim.core.quiet import start_warp
from finssim.evaluation.campaign import Progress, write_json
from finssim.evaluation.figures import save_figure
from finssim.evaluation.metrics import PAPER
from finssim.evaluation.statistics import RESAMPLES, SEED, bootstrap
from finssim.evaluation.tables import Table, figure_text
from finssim.identification.fit import Fit
from finssim.identification.prediction import Replay, replay
from finssim.identification.programme import Programme, programmes
from finssim.identification.replay_report import DEFINITION, MODEL_LABELS, draw_response_envelopes
from finssim.identification.simulation_error import fit_by_simulation
from finssim.identification.synthetic import Recording, record, trials_of
from finssim.identification.vehicle_file import calibrated, write_vehicle
from finssim.pool.plant_spec import CoupledMatrix
from finssim.sim import Simulator, TetherLine
from finssim.trials.trial import Trial
from finssim.vehicles import Vehicle, load_vehicle
from finssim.vehicles.vehicle import Axis

Array = NDArray[np.float64]

PLANT_FILE = Path(__file__).with_name("replay_plant.yaml")

SLOWEST = 3.0
"""Propeller speed below which the loss of thrust is constant [1/s]: there is hardly any thrust to lose."""


class ReplayPlant:
    """Hidden plant of `replay_plant.yaml`; inertia, buoyancy, thrusters and allocation are those of the
    vehicle file."""

    def __init__(self) -> None:
        self.spec: Mapping[str, Any] = yaml.safe_load(PLANT_FILE.read_text(encoding="utf-8"))
        self.added_mass = CoupledMatrix(**self.spec["added_mass"])
        self.linear_damping = CoupledMatrix(**self.spec["linear_damping"])

    def record(self, programmes: Sequence[Programme], vehicle: Vehicle, seed: int) -> Recording:
        """Return the true motion in some programmes, commanded with the vehicle file's parameters; see `record`."""
        fields: dict[str, Any] = {
            "mass": self.spec["mass"],
            "M_A": self.added_mass.matrix(),
            **self.spec["hull"],
            **self.spec["motors"],
        }
        return record(
            programmes,
            vehicle,
            seed=seed,
            hydrodynamics="mesh",
            plant=fields,
            tether=TetherLine(**self.spec["tether"]),
            depth=self.spec["depth"],
            each_step=self.forces(vehicle),
        )

    def trials(self, programmes: Sequence[Programme], vehicle: Vehicle, seed: int) -> list[Trial]:
        """Return trials logged by sensors and telemetry: propeller speeds, velocity, IMU, attitude, position,
        depth."""
        recording = self.record(programmes, vehicle, seed)
        logged = trials_of(recording, programmes, vehicle, noise="sensors", seed=seed, inputs=("rpm",))
        random = np.random.default_rng([seed, 2])
        trials = []
        for trial in logged:
            speeds = {k: v for k, v in trial.channels.items() if k.startswith("rpm_")}
            noisy = {
                k: v + self.spec["rpm_noise"] * (v != 0.0) * random.standard_normal(len(v))
                for k, v in speeds.items()
            }
            trials.append(replace(trial, channels={**trial.channels, **noisy}))
        return trials

    def forces(self, vehicle: Vehicle) -> Callable[[Simulator], None]:
        """Return the function that writes forces outside the engine's models: coupled damping and the loss of
        thrust."""
        D = self.linear_damping.matrix()
        p = SimpleNamespace(**self.spec["propellers"])
        thrusters = list(vehicle.thrusters.values())
        axis = np.array([t.axis for t in thrusters])
        position = np.array([t.position for t in thrusters])
        distance = np.linalg.norm(position[:, None] - position, axis=-1)
        share = p.induced_share * np.exp(-distance / p.induced_reach) * (1.0 - np.eye(len(thrusters)))
        disc = 0.25 * math.pi * p.diameter**2
        c_plus = np.array([t.c_plus for t in thrusters])
        c_minus = np.array([t.c_minus for t in thrusters])
        n = len(thrusters)

        def act(simulator: Simulator) -> None:
            nu = simulator.numpy("velocity")[:, 0].astype(float)
            simulator.command.disturbance.numpy()[:, 0] = -nu @ D.T
            thrust = simulator.numpy("actuator")[:, 0, :n].astype(float)
            turns = np.sqrt(np.abs(thrust) / np.where(thrust >= 0.0, c_plus, c_minus)) / (2.0 * math.pi)
            induced = np.sqrt(np.abs(thrust) / (2.0 * vehicle.water.density * disc)) @ share.T
            flow = nu[:, :3] @ axis.T + np.einsum("wi,ki->wk", nu[:, 3:], np.cross(position, axis))
            inflow = np.sign(thrust) * flow + induced
            loss = inflow / (p.advance_at_zero_thrust * np.maximum(turns, SLOWEST) * p.diameter)
            simulator.plant.gain.numpy()[:, 0, :n] = 1.0 - loss

        return act


RESULT_FILE = "replay_experiment.json"

NOTE = (
    "ours: held-out trials of a virtual plant outside all three model classes. paper: Unity replaying trials of the "
    "real FinsROV in its pool. These are different experiments, listed together for orientation."
)
LEVELS = {
    "same_levels": "held-out repeats of the fitted levels",
    "other_levels": "the validation sweeps, at levels that were not fitted",
}


def tables_of(result: Mapping[str, Any]) -> list[Table]:
    """Return tables of our results by set of levels, then the paper's."""
    axes = list(next(iter(result["same_levels"]["models"].values()))["by_axis"])
    tables = [Table(title="Replay error of three hydrodynamic models", headline=_headline(result))]
    for key, title in LEVELS.items():
        rows = []
        for model, m in result[key]["models"].items():
            values = [figure_text(m["by_axis"].get(a), ".3f") for a in axes]
            rows.append([f"ours, {MODEL_LABELS[model]}", _nrmse(m), *values])
        tables.append(Table(title=title, heads=["", "NRMSE", *axes], rows=rows, intervals=True))
    theirs = [[f"paper, {MODEL_LABELS[model]}", _nrmse(p)] for model, p in result["paper"].items()]
    hashes = ", ".join(fit["vehicle_sha256"][:12] for fit in result["fits"])
    origin = result["provenance"]
    about = (
        f"Vehicle file {result['vehicle']['name']} {result['vehicle']['sha256'][:12]}; calibrated vehicles {hashes}; "
        f"seeds {', '.join(map(str, result['seeds']))}; FinsSim {origin['finssim']}, revision {origin['revision']}."
    )
    paper = Table(
        title="the paper: its vehicle in its pool",
        heads=["", "NRMSE"],
        rows=theirs,
        intervals=True,
        note=NOTE,
        sentences=[DEFINITION, about],
        pictures={"envelope.png": "Response envelopes"},
    )
    return [*tables, paper]


def _headline(result: Mapping[str, Any]) -> str:
    counts = result["trials_per_seed"]
    seeds = len(result["seeds"])
    subject = f"{result['vehicle']['name']}, {seeds} seed{'s' if seeds != 1 else ''}"
    return (
        f"{subject}: fitted on {counts['fitted']} trials each, replayed on {counts['same_levels']} others of the same "
        f"levels and {counts['other_levels']} of other levels"
    )


def _nrmse(figures: Mapping[str, Any]) -> str:
    return figure_text({"value": figures["aggregate"], "ci95": figures["ci95"]}, ".3f")


AXES: tuple[Axis, ...] = ("surge", "sway", "heave", "yaw")
MODELS = ("calibrated", "mesh", "simplified")

PAPER_TABLE_3: Mapping[str, Any] = PAPER["replay"]
"""Model -> NRMSE and 95 % interval in the paper: Unity compared with its real vehicle in its pool."""

REPEATS = 8
"""Number of repeats of every published level and direction; odd ones are fitted, even ones replayed."""


@dataclass(frozen=True)
class ReplaySeed:
    """One seed: the fit and its replays of held-out trials."""

    seed: int
    fit: Fit
    vehicle: Vehicle
    same_levels: Replay
    """Replay of the held-out repeats of the fitted levels."""
    other_levels: Replay
    """Replay of the published validation sweeps, at levels that were not fitted."""


def replay_experiment(
    *,
    out: Path,
    seeds: Annotated[int, (1, 1000)] = 3,
    seed: int = 1,
    vehicle: Annotated[str, "python"] = "finsrov",
    repeats: Annotated[int, "python"] = REPEATS,
    axes: Annotated[Sequence[str], "python"] = AXES,
    progress: Progress = lambda part, text: None,
) -> dict[str, Any]:
    """Identify on half of the trials of a plant outside the model class, replay three models on the other half.

    The calibrated model is the fit; mesh and simplified use the vehicle file's published numbers.

    Example: finssim experiment replay --seeds 3 --out experiment

    Args:
        out (DIR): Directory for JSON, Markdown and figures.
        seeds: Number of repetitions with different noise and initial states.
        seed: Seed of every random number; equal seeds give equal results.
        vehicle: Name or file of the initial vehicle.
        repeats: Number of repeats of every level and direction, even.
        axes: Axes that are excited, fitted and replayed.
        progress: Function that receives the completed fraction and the next step.

    Returns:
        Content of `replay_experiment.json`.

    Raises:
        ValueError: The number of seeds or repeats is invalid.
    """
    if seeds < 1 or repeats < 2 or repeats % 2:
        raise ValueError(
            f"seeds is {seeds}, repeats {repeats}: expected at least one, and an even number from 2 on"
        )
    refuse_unwritable(atomic_directory(out, replaces=RESULT_FILE))
    start_warp()
    body, water, done = load_vehicle(vehicle), ReplayPlant(), []
    for k in range(seeds):
        progress(k / seeds, f"seed {k + 1} of {seeds}")
        done.append(experiment_seed(body, water, seed + k, repeats, axes))
    result = {
        "experiment": "replay",
        "vehicle": {"name": body.name, "sha256": body.sha256},
        "plant": dict(water.spec),
        "seeds": [seed_result.seed for seed_result in done],
        "trials_per_seed": {
            "fitted": len(done[0].fit.trials),
            "same_levels": len(done[0].same_levels.pairs),
            "other_levels": len(done[0].other_levels.pairs),
        },
        "same_levels": pooled([seed_result.same_levels for seed_result in done]),
        "other_levels": pooled([seed_result.other_levels for seed_result in done]),
        "fits": [
            {
                "seed": seed_result.seed,
                "method": seed_result.fit.method,
                "vehicle_sha256": seed_result.vehicle.sha256,
                "parameters": {name: e.as_json() for name, e in seed_result.fit.estimates.items()},
                "findings": [finding.as_json() for finding in seed_result.fit.findings],
                "trials": dict(seed_result.fit.trials),
                "held_out": {p.name: p.sha256 for p in seed_result.same_levels.pairs},
            }
            for seed_result in done
        ],
        "paper": {m: {"aggregate": v, "ci95": list(ci)} for m, (v, ci) in PAPER_TABLE_3.items()},
        "bootstrap": {"resamples": RESAMPLES, "seed": SEED, "unit": "seed, then trial"},
        "provenance": provenance(),
    }
    with atomic_directory(out, replaces=RESULT_FILE) as folder:
        pairs = [pair for seed_result in done for pair in seed_result.same_levels.pairs]
        save_figure(draw_response_envelopes(pairs), folder / "envelope.png")
        (folder / "vehicles").mkdir()
        for seed_result in done:
            write_vehicle(seed_result.vehicle, folder / "vehicles" / f"seed_{seed_result.seed}.yaml")
        write_json(folder / RESULT_FILE, result, tables_of(result))
    return result


def experiment_seed(
    vehicle: Vehicle, plant: ReplayPlant, seed: int, repeats: int = REPEATS, axes: Sequence[str] = AXES
) -> ReplaySeed:
    """Run one seed of the experiment; arguments as in `replay_experiment`."""
    trials = plant.trials(programmes(axes, vehicle, kind="published", repeats=repeats), vehicle, seed)
    fit = fit_by_simulation(trials[0::2], vehicle, axes=axes)
    fitted = calibrated(fit)
    same = replay(trials[1::2], fitted, hydrodynamics=MODELS)
    sweeps = plant.trials(programmes(axes, vehicle, kind="validation"), vehicle, seed + 1_000_000)
    return ReplaySeed(seed, fit, fitted, same, replay(sweeps, fitted, hydrodynamics=MODELS))


def pooled(replays: Sequence[Replay]) -> dict[str, Any]:
    """Return the NRMSE of each model over all seeds: median over trials, mean of the axes, with its interval.

    The bootstrap draws seeds with replacement, then trials within each and axis by axis.

    Args:
        replays: One replay per seed, of the same models.
    """
    models: dict[str, Any] = {}
    for model in replays[0].models:
        by_seed = [_values(seed_replay, model) for seed_replay in replays]
        axes = [axis for axis in AXES if any(axis in values for values in by_seed)]
        by_axis = {a: float(np.median(np.concatenate([v[a] for v in by_seed]))) for a in axes}

        def redraw(random: np.random.Generator, by_seed: Any = by_seed, axes: Any = axes) -> float:
            drawn = [by_seed[s] for s in random.integers(len(by_seed), size=len(by_seed))]
            each = (np.concatenate([random.choice(v[a], len(v[a])) for v in drawn]) for a in axes)
            return float(np.mean([np.median(values) for values in each]))

        models[model] = {
            "aggregate": float(np.mean(list(by_axis.values()))),
            "ci95": bootstrap(redraw).tolist(),
            "by_axis": by_axis,
            "aggregate_mean": float(np.mean([np.concatenate([v[a] for v in by_seed]).mean() for a in axes])),
            "per_seed": [seed_replay.aggregate(model).value for seed_replay in replays],
            "diverged": sum(model in pair.diverged for seed_replay in replays for pair in seed_replay.pairs),
        }
    best = min(models, key=lambda model: float(models[model]["aggregate"]))
    return {"models": models, "best": best}


def _values(seed_replay: Replay, model: str) -> dict[str, NDArray[np.float64]]:
    """Return the NRMSE of every trial by axis."""
    values: dict[str, list[float]] = {}
    for scores in seed_replay.scores[model]:
        for axis, s in scores.items():
            if s.value is not None:
                values.setdefault(axis, []).append(s.value)
    return {axis: np.array(each) for axis, each in values.items()}
