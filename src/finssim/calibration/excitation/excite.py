"""`finssim excite`: excitation programmes written for a robot to run, or run in the simulator to make trials."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from finssim.calibration.excitation.programmes import Programme, programmes
from finssim.calibration.excitation.synthetic import simulate_programme
from finssim.calibration.trials.trial import TAU
from finssim.calibration.trials.trial_files import write_trial
from finssim.control.allocation import Allocator
from finssim.files import atomic_directory, atomic_write
from finssim.quiet import start_warp
from finssim.vehicles import Vehicle, load_vehicle

Array = NDArray[np.float64]


def excite(
    axes: str | Sequence[str],
    *,
    vehicle: Vehicle | str,
    out: str | Path,
    simulate: bool = False,
    kind: str = "published",
    levels: Mapping[str, Sequence[float]] | Sequence[float] | None = None,
    repeats: int = 1,
    rate: float = 50.0,
    noise: str = "sensors",
    seed: int = 0,
    coast: float = 30.0,
    duration: float = 60.0,
    band: tuple[float, float] = (0.05, 1.0),
    room: float | None = None,
    hydrodynamics: str = "calibrated",
    columns: Sequence[str] | None = None,
    inputs: Sequence[Any] = ("rpm", "wrench"),
) -> list[Path]:
    """Write programmes, each into a folder of its own under `out`; or the trials that they make in the simulator.

    Args:
        axes: `all`, or names separated by commas.
        vehicle: A `Vehicle`, a catalogue name or a file.
        out: Folder to make.
        simulate: Run them in the simulator and write trials, rather than what to run on a robot.
        kind: `published`, `validation` or `multisine`; this and the next as for `programmes`.
        levels: Magnitudes [N, N m].
        repeats: How often every programme comes.
        rate: Of a simulated trial's rows [Hz].
        noise: Name of a noise profile, for simulated trials.
        seed: Of a multi-sine's phases, and of a simulation's initial conditions and noise.
        coast: Longest coast after a dive [s].
        duration: Of a multi-sine [s].
        band: Of a multi-sine [Hz].
        room: Longest way along a linear axis [m].
        hydrodynamics: Set of the vehicle that is simulated.
        columns: Measured columns of simulated trials.
        inputs: Inputs that simulated trials log.

    Returns:
        The folders written.

    Raises:
        CalibrationError, VehicleError, OutputError: As they say.
    """
    start_warp()
    chosen = vehicle if isinstance(vehicle, Vehicle) else load_vehicle(vehicle)
    plan = programmes(
        axes,
        chosen,
        levels=levels,
        kind=kind,
        repeats=repeats,
        seed=seed,
        coast=coast,
        duration=duration,
        band=band,
        room=room,
    )
    out = Path(out)
    names = [out / programme.name for programme in plan]
    with atomic_directory(out, replaces="programmes.yaml") as folder:
        if simulate:
            for trial in simulate_programme(
                plan,
                chosen,
                noise=noise,
                seed=seed,
                rate=rate,
                columns=columns,
                inputs=inputs,
                hydrodynamics=hydrodynamics,
            ):
                write_trial(trial, folder / trial.name)
        else:
            for programme in plan:
                write_programme(programme, chosen, folder / programme.name)
        about = {
            "vehicle": {"name": chosen.name, "sha256": chosen.sha256},
            "kind": kind,
            "simulated": simulate,
            "seed": seed,
            "programmes": [programme.name for programme in plan],
        }
        if simulate:
            about["noise"] = noise
        (folder / "programmes.yaml").write_text(yaml.safe_dump(about, sort_keys=False), encoding="utf-8")
    return names


def write_programme(programme: Programme, vehicle: Vehicle, folder: Path) -> None:
    """Write what a robot needs to run one programme: `programme.csv` and `programme.yaml`.

    The table has `t` [s], the wrench wanted about `wrench_reference` [N, N m], the thrust of every thruster that the
    exact allocator gives for it, `force_NAME` [N], and the phase. A row holds until the next.

    Args:
        programme: What to run.
        vehicle: Whose thrusters.
        folder: To write into; made if missing.

    Raises:
        OutputError: The system refused to write.
    """
    thrust = Allocator.from_vehicle(vehicle).allocate(programme.tau_desired)
    with atomic_write(folder / "programme.csv") as path, path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["t", *TAU, *(f"force_{name}" for name in vehicle.thruster_names), "phase"])
        numbers = np.column_stack([programme.t, programme.tau_desired, thrust])
        for row, phase in zip(numbers.round(6) + 0.0, programme.phase, strict=True):
            writer.writerow([*(f"{x:g}" for x in row), phase])
    about: dict[str, Any] = {
        "name": programme.name,
        "vehicle": vehicle.name,
        "axis": list(programme.axes),
        "rate": programme.rate,
        "duration": programme.duration,
        "wrench_at": [float(x) for x in vehicle.wrench_reference],
        "peak": {axis: _peak(programme, i) for i, axis in enumerate(TAU) if _peak(programme, i) > 0.0},
    }
    if programme.ascent_speed is not None:
        about["end_coast_early"] = {"ascent_speed": programme.ascent_speed, "after": programme.ascent_time}
    with atomic_write(folder / "programme.yaml") as path:
        path.write_text(yaml.safe_dump(about, sort_keys=False), encoding="utf-8")


def _peak(programme: Programme, i: int) -> float:
    return float(np.abs(programme.tau_desired[:, i]).max())
