"""`finssim simulate`: simulate one vehicle from rest under a constant wrench, and write its motion as a table."""

from __future__ import annotations

import difflib
import json
import math
from dataclasses import asdict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from finssim.control.allocation import Allocator
from finssim.core.files import atomic_write
from finssim.core.provenance import provenance
from finssim.core.rotations import quat_to_euler
from finssim.core.text_table import number, write_csv
from finssim.evaluation.tables import Table, print_tables
from finssim.sim import Simulator
from finssim.sim.recorder import STATE_COLUMNS
from finssim.sim.water import load_water
from finssim.vehicles import AXES, load_vehicle

UNITS = ("N", "N", "N", "N m", "N m", "N m")


class CommandError(ValueError):
    """Command line that does not describe a wrench or a run; the message states which part and how to correct it."""


def parse_wrench(text: str) -> NDArray[np.float64]:
    """Return the wrench of a text such as "surge=10 yaw=-1".

    Args:
        text: `axis=number` separated by spaces or commas; omitted axes are 0.

    Returns:
        Wrench, body frame, order surge sway heave roll pitch yaw [N, N m], (6,).

    Raises:
        CommandError: An axis is unknown or repeated, or a number is missing or not finite.
    """
    wrench: dict[str, float] = {}
    for word in text.replace(",", " ").split():
        axis, _, digits = word.partition("=")
        if axis not in AXES:
            close = difflib.get_close_matches(axis, AXES, n=1)
            hint = f"; did you mean '{close[0]}'?" if close else ""
            raise CommandError(f"command: unknown axis '{axis}'; available: {', '.join(AXES)}{hint}")
        if axis in wrench:
            raise CommandError(f"command: '{axis}' is given twice")
        unit, value = UNITS[AXES.index(axis)], number(digits)
        if value is None or not digits:
            raise CommandError(f"command: {axis} is '{digits}', expected a number: {axis}=1.5 [{unit}]")
        if not math.isfinite(value):
            raise CommandError(f"command: {axis} is {value}, expected a finite number [{unit}]")
        wrench[axis] = value
    if not wrench:
        raise CommandError('command is empty: give axis=number, such as "surge=10 yaw=1" [N, N m]')
    return np.array([wrench.get(axis, 0.0) for axis in AXES])


CONTROL_STEP = 0.1
"""Time between two rows [s]."""

LONGEST = 86400.0
"""Longest simulated run [s]: a table of a day has a million rows."""


def simulate(
    *,
    vehicle: str,
    command: str,
    duration: float,
    out: Path,
    hydrodynamics: str = "calibrated",
    depth: float = 5.0,
    water: Path | None = None,
    device: str = "cpu",
    as_json: bool = False,
) -> None:
    """Simulate a vehicle from rest under a constant wrench and record its motion.

    Columns: t [s], the state with the names of `finssim.sim.recorder`, and the delivered thrust of every
    thruster [N]. `OUT.json` in the same folder contains the vehicle's hash, the command and the provenance.

    Example: finssim simulate --vehicle finsrov --command "surge=10 yaw=1" --duration 10 --out run.csv

    Args:
        vehicle (NAME|FILE): Vehicle in the catalogue, or path of a vehicle file.
        command (WRENCH): Constant wrench: "surge=10 yaw=1". surge sway heave in N, roll pitch yaw in N m; omitted
            axes are 0.
        duration: Simulated time [s].
        out: Table to write, one row per control step of 0.1 s: a .csv file. OUT.json records its origin.
        hydrodynamics (MODEL): Hydrodynamic model: calibrated, simplified or mesh.
        depth: Depth of the body origin at the start [m].
        water (FILE): Water file (.yaml): currents, a profile over depth and time, waves or a sea state;
            default still water.
        device (DEVICE): Compute device: cpu or cuda.
        as_json: Print one JSON object instead of a table.

    Raises:
        CommandError: The command, a time or the file's name cannot be used, or the motion became infinite.
        VehicleError: The vehicle cannot be used.
        SimulatorError: The simulator cannot be set up.
        OutputError: A file cannot be written.
    """
    if not CONTROL_STEP <= duration <= LONGEST:
        raise CommandError(f"duration is {duration} s, expected {CONTROL_STEP} to {LONGEST:g} s")
    if not math.isfinite(depth):
        raise CommandError(f"depth is {depth} m, expected a finite number")
    if out.suffix != ".csv":
        raise CommandError(f"{out} ends in '{out.suffix}', expected .csv")
    tau, chosen = parse_wrench(command), load_vehicle(vehicle)
    allocator, names = Allocator.from_vehicle(chosen), chosen.thruster_names
    thrust = allocator.allocate(tau)
    flow = None if water is None else load_water(water)
    simulator = Simulator(
        chosen, hydrodynamics=hydrodynamics, control_step=CONTROL_STEP, water=flow, device=device
    )
    with atomic_write(out) as table, atomic_write(f"{out}.json") as origin:
        rows = _run(simulator, thrust, depth, steps=round(duration / CONTROL_STEP))
        columns = ["t", *(name for state in STATE_COLUMNS.values() for name in state)]
        columns += [f"thrust_{name}" for name in names]
        write_csv(table, columns, [[f"{value:.9g}" for value in row] for row in rows])
        about = {
            "vehicle": {"name": chosen.name, "sha256": chosen.sha256},
            "hydrodynamics": hydrodynamics,
            "command": dict(zip(AXES, tau.tolist(), strict=True)),
            "thrust": dict(zip(names, thrust.tolist(), strict=True)),
            "depth": depth,
            "water": None if flow is None else asdict(flow),
            "control_step": CONTROL_STEP,
            "provenance": provenance(),
        }
        origin.write_text(json.dumps(about, indent=2) + "\n", encoding="utf-8")
    last, achieved = rows[-1], allocator.achieved(thrust)
    if as_json:
        state = dict(zip(columns, (float(x) for x in last), strict=True))
        print(
            json.dumps(
                {
                    "out": str(out),
                    **about,
                    "wrench": dict(zip(AXES, achieved.tolist(), strict=True)),
                    "end": state,
                }
            )
        )
        return
    angles_deg = np.degrees(quat_to_euler(last[4:8]))
    cells = [
        ["requested wrench [N, N m]", *(f"{x:.4g}" for x in tau)],
        ["delivered wrench [N, N m]", *(f"{x:.4g}" for x in achieved.round(4) + 0.0)],
        ["velocity [m/s, rad/s]", *(f"{x:.3f}" for x in last[8:14])],
        ["pose [m, deg]", *(f"{x:.2f}" for x in last[1:4]), *(f"{x:.1f}" for x in angles_deg)],
    ]
    title, note = f"{chosen.name} after {last[0]:g} s", f"written: {out} and {out}.json"
    print_tables([Table(title=title, heads=["", *AXES], rows=cells, left=(), note=note)], Console())


def _run(simulator: Simulator, thrust: NDArray[np.float64], depth: float, steps: int) -> NDArray[np.float64]:
    """Return time [s], state and delivered thrusts [N] at the start and after every control step, (steps + 1,
    columns)."""
    simulator.place(position=(0.0, 0.0, -depth))
    simulator.set_thrust(thrust)
    rows = []
    for step in range(steps + 1):
        if step:
            simulator.step()
        state = [simulator.numpy(name)[0, 0] for name in STATE_COLUMNS]
        delivered = simulator.numpy("thrust")[0, 0, : len(thrust)]
        rows.append(np.concatenate([[step * simulator.control_step], *state, delivered]))
    if len(simulator.frozen_worlds()):
        raise CommandError(f"the motion stopped being finite before {steps * CONTROL_STEP:g} s: command less")
    return np.array(rows)
