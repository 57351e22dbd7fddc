"""`finssim simulate`: one vehicle from rest under a constant wrench, its motion in a table that opens in pandas."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from finssim.control.allocator import Allocator
from finssim.engine import Simulator
from finssim.engine.recorder import STATE_COLUMNS
from finssim.experiments.wrench_words import CommandError, parse_wrench
from finssim.files import atomic_write
from finssim.geometry.rotations import quat_to_euler
from finssim.provenance import provenance
from finssim.vehicles import AXES, Vehicle, load_vehicle

__all__ = ["simulate"]

CONTROL_STEP = 0.1
"""Time between two rows [s]."""

LONGEST = 86400.0
"""Longest run that is recorded [s]: a table of a day has a million rows."""


def simulate(
    *, vehicle: str, command: str, duration: float, hydrodynamics: str, depth: float, device: str, out: Path
) -> None:
    """Simulate a vehicle in still, open water and write one row per control step.

    Columns: t [s], the state as `finssim.engine.recorder` names it, and the delivered thrust of every thruster [N].
    Beside the table goes `OUT.json` with the vehicle's hash, the command and where the run came from.

    Args:
        vehicle: Name or file.
        command: Constant wrench in words, see `parse_wrench`; allocated to the thrusters once.
        duration: [s]
        hydrodynamics: Key of `HYDRODYNAMICS`.
        depth: Of the body origin at the start [m].
        device: Warp device.
        out: Table to write, ending in .csv.

    Raises:
        CommandError: The command, a time or the file's name cannot be used, or the motion did not stay finite.
        VehicleError, SimulatorError, OutputError: As they say.
    """
    _check(duration, depth, out)
    tau = parse_wrench(command)
    chosen = load_vehicle(vehicle)
    allocator = Allocator.from_vehicle(chosen)
    thrust, _ = allocator.allocate(tau)
    simulator = Simulator(chosen, hydrodynamics=hydrodynamics, control_step=CONTROL_STEP, device=device)
    with atomic_write(out) as table, atomic_write(f"{out}.json") as origin:
        rows = _run(simulator, thrust, depth, steps=round(duration / CONTROL_STEP))
        _write_table(table, chosen, rows)
        about = {
            "vehicle": {"name": chosen.name, "sha256": chosen.sha256},
            "hydrodynamics": hydrodynamics,
            "command": dict(zip(AXES, tau.tolist(), strict=True)),
            "thrust": dict(zip(chosen.thruster_names, thrust.tolist(), strict=True)),
            "depth": depth,
            "control_step": CONTROL_STEP,
            "provenance": provenance(),
        }
        origin.write_text(json.dumps(about, indent=2) + "\n", encoding="utf-8")
    _print(chosen, tau, allocator.achieved(thrust), rows[-1], out)


def _check(duration: float, depth: float, out: Path) -> None:
    if not CONTROL_STEP <= duration <= LONGEST:
        raise CommandError(f"duration is {duration} s, expected {CONTROL_STEP} to {LONGEST:g} s")
    if not math.isfinite(depth):
        raise CommandError(f"depth is {depth} m, expected a finite number")
    if out.suffix != ".csv":
        raise CommandError(f"{out} ends in '{out.suffix}', expected .csv")


def _run(simulator: Simulator, thrust: NDArray[np.float64], depth: float, steps: int) -> NDArray[np.float64]:
    """Time [s], state and delivered thrusts [N] at the start and after every control step, (steps + 1, columns)."""
    simulator.place(position=(0.0, 0.0, -depth))
    simulator.set_thrust(thrust)
    rows = [_row(simulator, 0, len(thrust))]
    for step in range(1, steps + 1):
        simulator.step()
        rows.append(_row(simulator, step, len(thrust)))
    if len(simulator.frozen_worlds()):
        raise CommandError(f"the motion stopped being finite before {steps * CONTROL_STEP:g} s: command less")
    return np.array(rows)


def _row(simulator: Simulator, step: int, thrusters: int) -> NDArray[np.float64]:
    state = [simulator.numpy(name)[0, 0] for name in STATE_COLUMNS]
    return np.concatenate(
        [[step * simulator.control_step], *state, simulator.numpy("thrust")[0, 0, :thrusters]]
    )


def _write_table(path: Path, vehicle: Vehicle, rows: NDArray[np.float64]) -> None:
    columns = ["t", *(name for names in STATE_COLUMNS.values() for name in names)]
    columns += [f"thrust_{name}" for name in vehicle.thruster_names]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows([f"{value:.9g}" for value in row] for row in rows)


def _print(
    vehicle: Vehicle, tau: NDArray[Any], achieved: NDArray[Any], last: NDArray[Any], out: Path
) -> None:
    console = Console()
    angles_deg = np.degrees(quat_to_euler(last[4:8]))
    table = Table(box=None, pad_edge=False, title=f"{vehicle.name} after {last[0]:g} s", title_justify="left")
    for heading in ("", *AXES):
        table.add_column(heading, justify="right")
    units = escape("[N, N m]")
    table.add_row(f"wrench asked {units}", *(f"{x:.4g}" for x in tau))
    table.add_row(f"wrench given {units}", *(f"{x:.4g}" for x in achieved.round(4) + 0.0))
    table.add_row("velocity " + escape("[m/s, rad/s]"), *(f"{x:.3f}" for x in last[8:14]))
    place = [*(f"{x:.2f}" for x in last[1:4]), *(f"{x:.1f}" for x in angles_deg)]
    table.add_row("place " + escape("[m, deg]"), *place)
    console.print(table)
    console.print(f"written: {out} and {out}.json", highlight=False, markup=False)
