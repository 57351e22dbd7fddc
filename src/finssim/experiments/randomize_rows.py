"""Ranges in SI for one vehicle: what each entry does to the number that it multiplies or adds to."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from finssim.engine.distributions import Distribution
from finssim.engine.plant_arrays import NO_LIMIT, vehicle_parameters
from finssim.engine.ranges_file import AXES, Ranges
from finssim.engine.ranges_table import ENTRIES, INDEX, drawn_entries
from finssim.vehicles import Vehicle
from finssim.vehicles.terms import unit_of

__all__ = ["Row", "rows_of"]

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
    return [*_body(ranges, drawn, vehicle, hydrodynamics), *_motors(drawn, vehicle), *_others(drawn)]


def _scaled(entry: str, nominal: float, unit: str, factors: list[Distribution]) -> Row:
    low, high = nominal, nominal
    for factor in factors:
        ends = factor.bounds()
        if factor.probability < 1.0:
            ends = min(ends[0], 1.0), max(ends[1], 1.0)
        low, high = low * ends[0], high * ends[1]
    return Row(entry, nominal, min(low, high), max(low, high), unit, " × ".join(f.text() for f in factors))


def _body(
    ranges: Ranges, drawn: dict[str, Distribution], vehicle: Vehicle, hydrodynamics: str
) -> Iterator[Row]:
    p = vehicle_parameters(vehicle, hydrodynamics)
    if "mass" in drawn:
        yield _scaled("mass", p["mass"], "kg", [drawn["mass"]])
    volume = drawn.get("mass") if ranges.volume == "with_mass" else drawn.get("volume")
    if volume is not None:
        yield _scaled("volume", p["volume"], "m³", [volume])
    if "inertia" in drawn:
        for i, axis in enumerate(AXES[3:]):
            yield _scaled(f"inertia.{axis}", float(vehicle.body.inertia[i][i]), "kg m²", [drawn["inertia"]])
    for center, field in (("center_of_gravity", "r_g"), ("center_of_buoyancy", "r_b")):
        for i, axis in enumerate("xyz"):
            if f"{center}.{axis}" in drawn:
                yield _shifted(f"{center}.{axis}", float(p[field][i]), "m", drawn[f"{center}.{axis}"])
    for family, (field, force, moment) in FAMILIES.items():
        matrix = vehicle_matrix(vehicle, hydrodynamics, family) if family == "added_mass" else p[field]
        for i, axis in enumerate(AXES):
            factors = [drawn[f"{family}.{name}"] for name in ("all", axis) if f"{family}.{name}" in drawn]
            if factors and matrix[i][i] != 0.0:
                yield _scaled(f"{family}.{axis}", float(matrix[i][i]), force if i < 3 else moment, factors)
    if "mesh_drag" in drawn:
        yield _scaled("mesh_drag", 1.0, "factor", [drawn["mesh_drag"]])
    for name in ranges.terms:
        if name in drawn and ENTRIES[INDEX[name]].unit == "1":
            one = np.ndim(p.get(name, np.zeros(1))) == 0
            unit = unit_of(name) if one else "factor"
            yield _scaled(name, float(p[name]) if one else 1.0, unit, [drawn[name]])


def vehicle_matrix(vehicle: Vehicle, hydrodynamics: str, family: str) -> list[list[float]]:
    """A matrix as the file has it, about the point where its coefficients hold."""
    chosen = vehicle.hydrodynamics[hydrodynamics]
    return [list(row) for row in getattr(chosen, family)]


def _shifted(entry: str, nominal: float, unit: str, drawn: Distribution) -> Row:
    low, high = drawn.bounds()
    if drawn.probability < 1.0:
        low, high = min(low, 0.0), max(high, 0.0)
    return Row(entry, nominal, nominal + low, nominal + high, unit, drawn.text())


def _motors(drawn: dict[str, Distribution], vehicle: Vehicle) -> Iterator[Row]:
    p, name = vehicle_parameters(vehicle, next(iter(vehicle.hydrodynamics))), vehicle.thruster_names[0]
    both = [drawn[key] for key in ("thrust.all", "thrust.each.0") if key in drawn]
    if both:
        yield _scaled(f"thrust ({name})", float(p["force_max"][0]), "N", both)
    if "thrust.failure.0" in drawn:
        yield _scaled("thrust.failure, of each", 1.0, "factor", [drawn["thrust.failure.0"]])
    lag = [drawn[key] for key in ("time_constant.all", "time_constant.each.0") if key in drawn]
    if lag:
        yield _scaled(f"time_constant ({name})", float(p["time_constant"][0]), "s", lag)
    if "delay" in drawn:
        yield _scaled("delay", float(p["delay"]), "s", [drawn["delay"]])
    if "slew" in drawn and p["slew"][0] < NO_LIMIT:
        unit = "rad/s²" if p["speed_lag"] else "N/s"
        yield _scaled(f"slew ({name})", float(p["slew"][0]), unit, [drawn["slew"]])
    if "dead_zone" in drawn:
        yield _scaled(f"dead_zone ({name})", float(p["dead_plus"][0]), "N", [drawn["dead_zone"]])


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
