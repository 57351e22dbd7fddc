"""Wall time of calibrating four axes from 32 trials of 15 s: `python benchmarks/calibration_speed.py [--json FILE]`.

Measured are the call in this process, the same call when everything is compiled, and the command `finssim calibrate
hydrodynamics` in its own process.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from finssim.identification.programme import Programme, programmes
from finssim.identification.simulation_error import fit_by_simulation
from finssim.identification.synthetic import simulate_programme
from finssim.trials.trial import Trial
from finssim.trials.trial_files import write_trial
from finssim.vehicles import load_vehicle

AXES = "surge,sway,heave,yaw"
DURATION = 15.0
TRIALS = 32


def make_trials() -> list[Trial]:
    """Simulate 32 trials: four levels on four axes in both directions, each 15 s long."""
    vehicle = load_vehicle("finsrov")
    limits = dict(zip(AXES.split(","), vehicle.wrench_limits[[0, 1, 2, 5]], strict=True))
    levels = {axis: [share * limit for share in (0.2, 0.4, 0.6, 0.8)] for axis, limit in limits.items()}
    plan = [_of_length(p) for p in programmes(AXES, vehicle, levels=levels)]
    trials = simulate_programme(plan, vehicle, seed=1)
    assert len(trials) == TRIALS
    return trials


def _of_length(p: Programme) -> Programme:
    """Cut a programme to `DURATION`, or extend it without thrust."""
    n = round(DURATION * p.rate)
    missing = max(0, n - len(p.phase))
    return Programme(
        name=p.name,
        axes=p.axes,
        rate=p.rate,
        tau_desired=np.pad(p.tau_desired, ((0, missing), (0, 0)))[:n],
        phase=np.pad(p.phase, (0, missing), mode="edge")[:n],
    )


def main() -> None:
    """Measure, print, and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--json", type=Path, help="file for the figures")
    given = parser.parse_args()
    trials, vehicle = make_trials(), load_vehicle("finsrov")
    times = []
    for _ in range(2):
        start = time.perf_counter()
        fit_by_simulation(trials, vehicle, axes=AXES.split(","))
        times.append(time.perf_counter() - start)
    with tempfile.TemporaryDirectory() as folder:
        for trial in trials:
            write_trial(trial, Path(folder) / "trials" / trial.name)
        words = (
            f"calibrate hydrodynamics {folder}/trials --vehicle finsrov --axes {AXES} --out {folder}/v.yaml"
        )
        start = time.perf_counter()
        subprocess.run(
            [sys.executable, "-m", "finssim", *words.split()], check=True, stdout=subprocess.DEVNULL
        )
    figures = {
        "first_call": times[0],
        "second_call": times[1],
        "command": time.perf_counter() - start,
    }
    line = "  ".join(f"{name} {value:.2f}" for name, value in figures.items())
    print(f"{TRIALS} trials of {DURATION:g} s, {AXES} [s]: {line}")
    if given.json:
        given.json.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
