"""`finssim randomize show`: what ranges mean for a vehicle, in SI."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from finssim.engine.distributions import Distribution
from finssim.engine.plant_arrays import NO_LIMIT, vehicle_parameters
from finssim.engine.ranges_file import Ranges, load_ranges
from finssim.engine.ranges_table import ENTRIES, INDEX, drawn_entries
from finssim.experiments.tables import Table
from finssim.provenance import provenance
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


def randomize_show(ranges: str | Path, *, vehicle: str, hydrodynamics: str = "calibrated") -> dict[str, Any]:
    """Show what ranges mean for a vehicle: each of its numbers that is drawn, in SI.

    Example: finssim randomize show pool --vehicle finsrov

    Args:
        ranges (FILE): Ranges: a file, or hold_for_position, fossen_learn_to_swim, equivalent_box, pool,
            no_thruster_dynamics.
        vehicle (NAME|FILE): Vehicle of the catalogue, or the path of a vehicle file.
        hydrodynamics (MODEL): Hydrodynamic model: calibrated, simplified or mesh.

    Raises:
        RangesError, VehicleError: As they say.
    """
    drawn, chosen = load_ranges(ranges), load_vehicle(vehicle)
    return {
        "ranges": drawn.model_dump(mode="json"),
        "vehicle": {"name": chosen.name, "sha256": chosen.sha256},
        "hydrodynamics": hydrodynamics,
        "entries": [asdict(row) for row in rows_of(drawn, chosen, hydrodynamics)],
        "provenance": provenance(),
    }


def tables_of(result: Mapping[str, Any]) -> list[Table]:
    """The entries in SI."""
    entries = [
        [
            one["entry"],
            *("–" if x is None else f"{x:.4g}" for x in (one["nominal"], one["low"], one["high"])),
            one["unit"],
            one["drawn"],
        ]
        for one in result["entries"]
    ]
    title = f"{result['ranges']['name']} on {result['vehicle']['name']}"
    heads = ("entry", "file", "low", "high", "unit", "drawn as")
    return [Table(title=title, heads=heads, rows=entries, left=(0, 4, 5))]
