"""`finssim randomize show`: what ranges mean for a vehicle, as a table in SI and as the spread of step responses."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.control.allocation import Allocator
from finssim.engine import Simulator, Water
from finssim.engine.distributions import Distribution
from finssim.engine.plant_arrays import NO_LIMIT, vehicle_parameters
from finssim.engine.randomize import Randomization
from finssim.engine.ranges_file import Ranges
from finssim.engine.ranges_table import ENTRIES, INDEX, drawn_entries
from finssim.experiments.campaign import write_json
from finssim.experiments.figures import COLORS, clean, legend_below, new_figure, save_figure
from finssim.experiments.tables import Table
from finssim.files import atomic_directory
from finssim.provenance import provenance
from finssim.text_table import write_csv
from finssim.vehicles import AXES, Vehicle, load_vehicle
from finssim.vehicles.terms import unit_of

FAMILIES = {
    "added_mass": ("M_A", "kg", "kg m²"),
    "linear_damping": ("D1", "N s/m", "N m s"),
    "quadratic_damping": ("D2", "N s²/m²", "N m s²"),
}
"""Family -> field of the parameters, unit of the first three axes, unit of the last three."""


@dataclass(frozen=True)
class Row:
    """One number of the vehicle, the water or the sensors."""

    entry: str
    nominal: float | None
    """As the file has it, or where nothing is drawn; None where that has no such number."""
    low: float
    high: float
    unit: str
    drawn: str
    """How, in words."""


def rows_of(ranges: Ranges, vehicle: Vehicle, hydrodynamics: str = "calibrated") -> list[Row]:
    """Everything that a ranges file draws for a vehicle, in SI.

    Args:
        ranges: The ranges.
        vehicle: The vehicle.
        hydrodynamics: Whose coefficients.

    Raises:
        SimulatorError: The vehicle has no such hydrodynamics.
    """
    drawn = drawn_entries(ranges, thrusters=1)  # every thruster is drawn alike: one stands for all
    p, name = vehicle_parameters(vehicle, hydrodynamics), vehicle.thruster_names[0]
    # Added mass as the file has it, about the point where its coefficients hold.
    matrices = p | {"M_A": vehicle.hydrodynamics[hydrodynamics].added_mass}

    def scaled(entry: str, nominal: Any, unit: str, *keys: str) -> list[Row]:
        factors = [drawn[key] for key in keys if key in drawn]
        return [_scaled(entry, float(nominal), unit, factors)] if factors else []

    rows = [
        *scaled("mass", p["mass"], "kg", "mass"),
        *scaled(
            "volume", p["volume"], "m³", "mass" if ranges.volume == "with_mass" else "volume", "buoyancy"
        ),
    ]
    for i, axis in enumerate(AXES[3:]):
        rows += scaled(f"inertia.{axis}", vehicle.body.inertia[i][i], "kg m²", "inertia")
    for center, field in (("center_of_gravity", "r_g"), ("center_of_buoyancy", "r_b")):
        for i, letter in enumerate("xyz"):
            if (entry := f"{center}.{letter}") in drawn:
                (low, high), own = _bounds(drawn[entry], 0.0), float(p[field][i])
                rows.append(Row(entry, own, own + low, own + high, "m", drawn[entry].text()))
    for family, (field, *units) in FAMILIES.items():
        for i, axis in enumerate(AXES):
            nominal = matrices[field][i][i]
            if nominal != 0.0:
                keys = f"{family}.all", f"{family}.{axis}"
                rows += scaled(f"{family}.{axis}", nominal, units[i // 3], *keys)
    rows += scaled("mesh_drag", 1.0, "factor", "mesh_drag")
    for term in ranges.terms:
        if term in INDEX and ENTRIES[INDEX[term]].unit == "1":
            one = np.ndim(p.get(term, np.zeros(1))) == 0
            rows += scaled(term, float(p[term]) if one else 1.0, unit_of(term) if one else "factor", term)
    rows += scaled(f"thrust ({name})", p["force_max"][0], "N", "thrust.all", "thrust.each.0")
    rows += scaled("thrust.failure, of each", 1.0, "factor", "thrust.failure.0")
    lag = ("time_constant.all", "time_constant.each.0")
    rows += scaled(f"time_constant ({name})", p["time_constant"][0], "s", *lag)
    rows += scaled("delay", p["delay"], "s", "delay")
    if p["slew"][0] < NO_LIMIT:
        rows += scaled(f"slew ({name})", p["slew"][0], "rad/s²" if p["speed_lag"] else "N/s", "slew")
    rows += scaled(f"dead_zone ({name})", p["dead_plus"][0], "N", "dead_zone")
    return [*rows, *_others(drawn)]


def _scaled(entry: str, nominal: float, unit: str, factors: list[Distribution]) -> Row:
    low, high = nominal, nominal
    for factor in factors:
        least, most = _bounds(factor, 1.0)
        low, high = low * least, high * most
    return Row(entry, nominal, min(low, high), max(low, high), unit, " × ".join(f.text() for f in factors))


def _bounds(drawn: Distribution, otherwise: float) -> tuple[float, float]:
    """Least and greatest; what it is where it is drawn in some episodes only counts too."""
    low, high = drawn.bounds()
    return (low, high) if drawn.probability >= 1.0 else (min(low, otherwise), max(high, otherwise))


def _others(drawn: dict[str, Distribution]) -> Iterator[Row]:
    """Entries in a unit of their own."""
    for name, distribution in drawn.items():
        entry = ENTRIES[INDEX[name]]
        counted = entry.name == "waves.count"
        if entry.angle or (
            entry.unit == "1" and not name.startswith(("tether.", "sensors.")) and not counted
        ):
            continue
        if name.startswith(("center_of", "waves.")) and not name.startswith("waves.0.") and not counted:
            continue
        low, high = distribution.bounds()
        drawn_as = distribution.text()
        if counted:
            low, high, drawn_as = float(int(low)), float(int(high)), "whole numbers"
        unit = "" if entry.unit == "1" else entry.unit
        absent = name.startswith(("waves.", "tether.", "current_drift.time"))
        nominal = None if absent else entry.nominal
        yield Row(name.replace("waves.0.", "waves."), nominal, low, high, unit, drawn_as)


Array = NDArray[np.float64]

LABELS = {
    "surge": "surge speed [m/s]",
    "sway": "sway speed [m/s]",
    "heave": "heave speed, down [m/s]",
    "yaw": "yaw rate [rad/s]",
}


def draw_spread(t: Array, drawn: Mapping[str, Array], nominal: Mapping[str, Array], title: str) -> Any:
    """A panel for each axis: 5 to 95 % and the middle half of the drawn vehicles, some of them, and the file's own.

    Args:
        t: Times [s], (T,).
        drawn: Axis -> speeds of the drawn vehicles, (n, T).
        nominal: Axis -> speed of the vehicle of the file, (T,).
        title: Written above.
    """
    figure = new_figure(8.4, 6.0, title)
    for axes, (axis, speeds) in zip(figure.subplots(2, 2, sharex=True).flat, drawn.items(), strict=True):
        clean(axes)
        band = np.percentile(speeds, BAND, axis=0)
        axes.fill_between(t, band[0], band[4], color=COLORS[0], alpha=0.18, linewidth=0.0, label="5 to 95 %")
        axes.fill_between(t, band[1], band[3], color=COLORS[0], alpha=0.30, linewidth=0.0, label="25 to 75 %")
        for k, line in enumerate(speeds[:12]):
            axes.plot(t, line, color=COLORS[0], linewidth=0.5, alpha=0.6, label=None if k else "some of them")
        axes.plot(t, nominal[axis], color="0.1", linewidth=1.8, label="as the file has it")
        axes.set(ylabel=LABELS[axis], xlim=(0.0, float(t[-1])))
    for axes in figure.axes[2:]:
        axes.set_xlabel("time since the step [s]")
    figure.align_ylabels()
    legend_below(figure, figure.axes[0], 4)
    return figure


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
    samples: Annotated[int, (2, 100000)] = 200,
    seed: int = 0,
) -> dict[str, Any]:
    """Tell what ranges mean for a vehicle: its numbers in SI, and how far its step responses spread.

    The directory takes `spread.png`, `entries.csv` and `show.json`.

    Example: finssim randomize show pool --vehicle finsrov --out ranges/pool

    Args:
        ranges (FILE): Ranges: a file, or hold_for_position, fossen_learn_to_swim, equivalent_box, pool,
            no_thruster_dynamics.
        vehicle (NAME|FILE): Vehicle of the catalogue, or the path of a vehicle file.
        out: Directory for spread.png, entries.csv and show.json.
        hydrodynamics (MODEL): Hydrodynamic model: calibrated, simplified or mesh.
        samples: Vehicles to draw.
        seed: Seed of every random number; equal seeds give equal results.

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
        write_json(place / RECORD, record)
        write_csv(
            place / "entries.csv", list(record["entries"][0]), [one.values() for one in record["entries"]]
        )
        title = f"{randomization.ranges.name} on {chosen.name}: half the wrench limit on one axis, {samples} draws"
        own = {axis: nominal[axis][0] for axis in STEPS}
        save_figure(draw_spread(t, drawn, own, title), place / "spread.png")
    return record


def step_responses(
    vehicle: Vehicle, randomization: Randomization | None, hydrodynamics: str, samples: int, seed: int
) -> tuple[Array, dict[str, Array]]:
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
        simulator.set_thrust(allocator.allocate(tau))
        speed = np.zeros((samples, count + 1))
        for k in range(1, count + 1):
            step.run()
            speed[:, k] = direction * simulator.numpy("velocity")[:, 0, i]
        speeds[axis] = speed
    return CONTROL_STEP * np.arange(count + 1), speeds


def _speeds(drawn: Array, nominal: Array) -> dict[str, float]:
    """Speed at the end: of the vehicle itself, and percentiles over those that were drawn."""
    bounds = np.percentile(drawn[:, -1], BAND).tolist()
    return {"nominal": float(nominal[-1])} | {f"p{p:g}": x for p, x in zip(BAND, bounds, strict=True)}


def tables_of(result: Mapping[str, Any]) -> list[Table]:
    """The entries in SI, and the speeds after the steps."""
    entries = [
        [
            one["entry"],
            *("–" if x is None else f"{x:.4g}" for x in (one["nominal"], one["low"], one["high"])),
            one["unit"],
            one["drawn"],
        ]
        for one in result["entries"]
    ]
    speeds = [
        [
            "heave, down" if axis == "heave" else axis,
            *(f"{of_axis[key]:.3f}" for key in ("nominal", "p5", "p50", "p95")),
            "rad/s" if axis == "yaw" else "m/s",
        ]
        for axis, of_axis in result["speeds"].items()
    ]
    title = f"{result['ranges']['name']} on {result['vehicle']['name']}"
    heads = ("entry", "file", "low", "high", "unit", "drawn as")
    speed_heads = ("axis", "file", "5 %", "median", "95 %", "unit")
    after = f"speed after {DURATION:g} s at half the wrench limit"
    return [
        Table(title=title, heads=heads, rows=entries, left=(0, 4, 5)),
        Table(title=after, heads=speed_heads, rows=speeds, left=(0, 5)),
    ]
