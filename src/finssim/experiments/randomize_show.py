"""`finssim randomize show`: what ranges mean for a vehicle, as a table in SI and as the spread of step responses."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from finssim.control.allocator import Allocator
from finssim.engine import Simulator, Water
from finssim.engine.randomize import Randomization
from finssim.experiments.randomize_figure import draw_spread
from finssim.experiments.randomize_rows import Row, rows_of
from finssim.files import atomic_directory
from finssim.provenance import provenance
from finssim.vehicles import AXES, Vehicle, load_vehicle

__all__ = ["ShowError", "randomize_show", "step_responses"]

CONTROL_STEP = 0.1
DURATION = 8.0
"""Of a step response [s]."""
PART = 0.5
"""Of the wrench limit that is commanded."""
STEPS = {"surge": 1.0, "sway": 1.0, "heave": -1.0, "yaw": 1.0}
"""Axis -> direction of the step; heave goes down, away from the surface."""
DEEP, SHALLOW = 10.0, 1.5
"""Depth at the start [m]: far from the surface, or near it where there are waves to feel."""
BAND = (5.0, 25.0, 50.0, 75.0, 95.0)
"""Percentiles over the vehicles."""
RECORD = "show.json"


class ShowError(ValueError):
    """Something that cannot be shown."""


def randomize_show(
    ranges: str | Path,
    *,
    vehicle: str,
    out: Path,
    hydrodynamics: str = "calibrated",
    samples: int = 200,
    seed: int = 0,
    as_json: bool = False,
) -> dict[str, Any]:
    """Draw vehicles, let each answer to a step of half its wrench limit on four axes, and write what came out.

    The directory takes `spread.png`, `entries.csv` and `show.json`.

    Args:
        ranges: Name or file.
        vehicle: Name or file.
        out: Directory to write.
        hydrodynamics: calibrated, mesh or simplified.
        samples: Vehicles to draw.
        seed: Of the draws.
        as_json: Print the record in place of the tables.

    Returns:
        The record.

    Raises:
        ShowError: Too few samples.
        RangesError, VehicleError, OutputError: As they say.
    """
    if samples < 2:
        raise ShowError(f"samples is {samples}, expected 2 or more")
    randomization, chosen = Randomization(ranges), load_vehicle(vehicle)
    with atomic_directory(out, replaces=RECORD) as place:
        rows = rows_of(randomization.ranges, chosen, hydrodynamics)
        t, drawn = step_responses(chosen, randomization, hydrodynamics, samples, seed)
        _, nominal = step_responses(chosen, None, hydrodynamics, 1, seed)
        record = {
            "ranges": randomization.ranges.model_dump(mode="json"),
            "vehicle": {"name": chosen.name, "sha256": chosen.sha256},
            "hydrodynamics": hydrodynamics,
            "seed": seed,
            "samples": samples,
            "entries": [asdict(row) for row in rows],
            "speed_after_s": DURATION,
            "speeds": {axis: _speeds(drawn[axis], nominal[axis][0]) for axis in STEPS},
            "provenance": provenance(),
        }
        (place / RECORD).write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
        _write_rows(place / "entries.csv", rows)
        title = f"{randomization.ranges.name} on {chosen.name}: half the wrench limit on one axis, {samples} draws"
        bands = {axis: np.percentile(drawn[axis], BAND, axis=0) for axis in STEPS}
        lines = {axis: drawn[axis][:12] for axis in STEPS}
        figure = draw_spread(t, bands, lines, {axis: nominal[axis][0] for axis in STEPS}, title)
        figure.savefig(place / "spread.png", dpi=150)
    if as_json:
        print(json.dumps(record))
    else:
        _print(record, rows, out)
    return record


def step_responses(
    vehicle: Vehicle, randomization: Randomization | None, hydrodynamics: str, samples: int, seed: int
) -> tuple[NDArray[np.float64], dict[str, NDArray[np.float64]]]:
    """Speed along the axis that is pushed, from rest, in deep open water.

    Args:
        vehicle: As its file has it.
        randomization: None for that vehicle itself.
        hydrodynamics: Key of `HYDRODYNAMICS`.
        samples: Vehicles to draw.
        seed: Of the draws.

    Returns:
        Times [s], (T,), and axis -> speed [m/s, rad/s], (samples, T); heave counts downwards.
    """
    longest = max((thruster.delay for thruster in vehicle.thrusters.values()), default=0.0)
    extra = randomization.simulator_arguments(longest) if randomization else {}
    simulator = Simulator(
        vehicle,
        worlds=samples,
        hydrodynamics=hydrodynamics,
        control_step=CONTROL_STEP,
        water=Water(depth=2.0 * DEEP),
        seed=seed,
        **extra,
    )
    step = simulator.pipeline()
    if randomization is not None:
        draws = randomization.draws(simulator)
        start = simulator.pipeline()
        everywhere = wp.ones(samples, dtype=wp.int32, device=simulator.device)
        draws.add(start, everywhere, seed)
        simulator.add_refresh(start, everywhere)
        start.run()
        draws.add_step(step, seed)
    simulator.add_step(step)
    wavy = randomization is not None and randomization.ranges.waves is not None
    depth, count = SHALLOW if wavy else DEEP, round(DURATION / CONTROL_STEP)
    allocator, speeds = Allocator.from_vehicle(vehicle), {}
    for axis, direction in STEPS.items():
        i = AXES.index(axis)
        tau = np.zeros(6)
        tau[i] = direction * PART * vehicle.wrench_limits[i]
        simulator.place(position=(0.0, 0.0, -depth))
        simulator.set_thrust(allocator.allocate(tau)[0])
        speed = np.zeros((samples, count + 1))
        for k in range(1, count + 1):
            step.run()
            speed[:, k] = direction * simulator.numpy("velocity")[:, 0, i]
        speeds[axis] = speed
    return CONTROL_STEP * np.arange(count + 1), speeds


def _speeds(drawn: NDArray[np.float64], nominal: NDArray[np.float64]) -> dict[str, float]:
    """Speed at the end: of the vehicle itself, and percentiles over those that were drawn."""
    found = {f"p{p:g}": float(x) for p, x in zip(BAND, np.percentile(drawn[:, -1], BAND), strict=True)}
    return {"nominal": float(nominal[-1]), **found}


def _write_rows(path: Path, rows: Sequence[Row]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(asdict(rows[0])) if rows else ["entry"])
        writer.writeheader()
        writer.writerows(asdict(row) for row in rows)


def _print(record: Mapping[str, Any], rows: Sequence[Row], out: Path) -> None:
    console = Console()
    table = Table(
        box=None, pad_edge=False, title=f"{record['ranges']['name']} on {record['vehicle']['name']}"
    )
    for heading in ("entry", "file", "low", "high", "unit", "drawn as"):
        right = heading in ("file", "low", "high")
        table.add_column(heading, justify="right" if right else "left", no_wrap=heading == "entry")
    for row in rows:
        numbers = ("–" if x is None else f"{x:.4g}" for x in (row.nominal, row.low, row.high))
        table.add_row(row.entry, *numbers, escape(row.unit), escape(row.drawn))
    console.print(table)
    console.print()
    speeds = Table(box=None, pad_edge=False, title=f"speed after {DURATION:g} s at half the wrench limit")
    for heading in ("axis", "file", "5 %", "median", "95 %", "unit"):
        speeds.add_column(heading, justify="left" if heading in ("axis", "unit") else "right")
    for axis, found in record["speeds"].items():
        numbers = (f"{found[key]:.3f}" for key in ("nominal", "p5", "p50", "p95"))
        speeds.add_row(
            "heave, down" if axis == "heave" else axis, *numbers, "rad/s" if axis == "yaw" else "m/s"
        )
    console.print(speeds)
    console.print(f"written: {out}", highlight=False, markup=False, soft_wrap=True)
