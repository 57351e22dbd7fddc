"""The first part of the demonstration: a vehicle nobody measured, a pool, trials, and what they tell."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from finssim.calibration.excitation.programmes import programmes
from finssim.calibration.excitation.synthetic import simulate_programme
from finssim.calibration.findings import Finding
from finssim.calibration.fit import Fit
from finssim.calibration.output.calibrate import all_findings, calibrated
from finssim.calibration.output.report import write_report
from finssim.calibration.output.vehicle_file import write_vehicle
from finssim.calibration.regression.regress import regress
from finssim.calibration.replay.replay import Replay, replay
from finssim.calibration.replay.report import draw_response_envelopes
from finssim.calibration.trials.trial import Trial
from finssim.calibration.trials.trial_files import write_trial
from finssim.experiments.figures import save_figure
from finssim.quiet import start_warp
from finssim.vehicles import Provenance, Vehicle, load_vehicle
from finssim.vehicles.defaults import room

TRIALS = "trials"
SET = "hydrodynamics.calibrated"

COAST = 10.0
"""Of a dive [s]; a third of the published, to be quick."""
HELD_OUT = {"surge": [9.0], "sway": [6.0], "heave": [7.0], "yaw": [1.0]}
"""Levels that no trial of the fit has [N, N m]."""

Record = Callable[[Path, Path, int], dict[str, list[Trial]]]
"""Makes trials: folder that takes ROLE/NAME, file of the rough vehicle, seed -> trials by role (fit, held-out)."""


@dataclass(frozen=True)
class Identification:
    """What the trials told."""

    vehicle: Vehicle
    """As read back from its file."""
    fit: Fit
    replay: Replay
    """On the held-out trials, of the identified vehicle."""
    truth: Vehicle
    """The vehicle of the catalogue that made the trials, or around which the pool's own was drawn."""
    findings: tuple[Finding, ...]
    seconds: float


def rough_vehicle(truth: Vehicle) -> Vehicle:
    """What one knows of a vehicle before any trial: weighed, measured out, thrusters from a bench.

    Its hydrodynamics are guesses: added mass of half the displaced water on every linear axis, damping of the order of
    other small vehicles, forces growing with the square of the length, moments with its fourth power and moments of
    inertia with its fifth. Moments are guessed low: a controller that counts on damping which is not there rings.
    """
    half = 0.5 * truth.water.density * truth.body.displaced_volume
    size = room(truth.body.size)
    force, moment, inertia = size**2, size**4, 0.1 * size**5
    guess = {
        f"{SET}.added_mass": [half, half, half, inertia, inertia, inertia],
        f"{SET}.linear_damping": [20.0 * force] * 3 + [0.5 * moment] * 3,
        f"{SET}.quadratic_damping": [50.0 * force] * 3 + [moment] * 3,
    }
    origin = Provenance("guessed", "", "the order of other small vehicles, before any trial")
    words = "Hydrodynamics are guesses; the rest is the catalogue's."
    return _named(truth.replace(guess, origin), f"{truth.name} before any trial", words)


def _named(vehicle: Vehicle, title: str, description: str) -> Vehicle:
    """The same vehicle under words of its own."""
    return vehicle.model_copy(update={"title": title, "description": description})


def identify(
    folder: Path, name: str, *, seed: int, shown: Path | None = None, record: Record | None = None
) -> Identification:
    """Make trials of a vehicle, identify it from some, replay the others; write all of it.

    Into the folder go `NAME_rough.yaml` (the vehicle before), `trials/fit` and `trials/held-out`,
    `NAME_identified.yaml`, `calibration` (the report), and `replay.json` with `replay.png`.

    Args:
        folder: Existing directory.
        name: Name or file of a vehicle.
        seed: Of initial conditions and noise of the trials.
        shown: Name of the folder in the report, where `folder` is a temporary one.
        record: Makes the trials; in the simulator if None.

    Returns:
        What was found.
    """
    began = time.perf_counter()
    start_warp()
    truth = load_vehicle(name)
    name = truth.name
    start_file, vehicle_file = vehicle_files(name)
    write_vehicle(rough_vehicle(truth), folder / start_file)
    recorded = (record or simulated_trials(truth))(folder / TRIALS, folder / start_file, seed)
    fit = regress(recorded["fit"], load_vehicle(folder / start_file), seed=seed)
    found = calibrated(fit)
    findings = tuple(all_findings(fit, found))
    found = _named(
        found, f"{name} as identified", "Hydrodynamics from trials where they tell it, else guesses."
    )
    write_vehicle(found, folder / vehicle_file)
    vehicle = load_vehicle(folder / vehicle_file)
    place = folder if shown is None else shown
    write_report(
        fit,
        folder / "calibration",
        vehicle,
        command=commands(place, name, seed)[1],
        findings=findings,
        out=place / vehicle_file,
    )
    scored = replay(recorded["held-out"], vehicle, seed=seed)
    text = json.dumps(scored.as_json(), indent=2, allow_nan=False) + "\n"
    (folder / "replay.json").write_text(text, encoding="utf-8")
    save_figure(draw_response_envelopes(scored.pairs), folder / "replay.png")
    return Identification(
        vehicle=vehicle,
        fit=fit,
        replay=scored,
        truth=truth,
        findings=findings,
        seconds=time.perf_counter() - began,
    )


def vehicle_files(name: str) -> tuple[str, str]:
    """Names of the vehicle's files before and after."""
    return f"{name}_rough.yaml", f"{name}_identified.yaml"


def commands(place: Path, name: str, seed: int) -> list[str]:
    """Command lines that identify and replay from the trials again."""
    start, vehicle = (place / file for file in vehicle_files(name))
    trials = place / TRIALS
    return [
        f"finssim trials check {trials / 'fit'} --vehicle {start}",
        f"finssim calibrate hydrodynamics {trials / 'fit'} --vehicle {start} --out {vehicle} --seed {seed}",
        f"finssim replay {trials / 'held-out'} --vehicle {vehicle}",
    ]


def simulated_trials(truth: Vehicle) -> Record:
    """Trials of a vehicle in the simulator, with the noise of its sensors; all programmes run at once."""

    def record(folder: Path, rough: Path, seed: int) -> dict[str, list[Trial]]:
        plans = {
            "fit": programmes("all", truth, coast=COAST),
            "held-out": programmes(tuple(HELD_OUT), truth, levels=HELD_OUT, coast=COAST),
        }
        trials = iter(simulate_programme(sum(plans.values(), []), truth, noise="sensors", seed=seed))
        recorded: dict[str, list[Trial]] = {role: [] for role in plans}
        for role, plan in plans.items():
            for _, trial in zip(plan, trials, strict=False):
                meant = replace(trial, header=trial.header.model_copy(update={"role": role}))
                write_trial(meant, folder / role / meant.name, format="parquet")
                recorded[role].append(meant)
        return recorded

    return record
