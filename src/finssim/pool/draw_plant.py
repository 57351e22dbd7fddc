"""Drawing a plant around a vehicle file: by seed, at one of three severities."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.pool.plant_spec import PlantSpec, PlantSpecError, Severity, basin_of
from finssim.pool.share import hull_share, less_share, panel_drag, steady_share
from finssim.pool.spread import SPREADS, Spread
from finssim.vehicles import Vehicle
from finssim.vehicles.defaults import room
from finssim.vehicles.hydrodynamics import HydrodynamicSet

__all__ = ["draw_plant"]

Array = NDArray[np.float64]


STREAM = 20261122
"""Sets the draws of plants apart from everything else that a seed starts."""


def draw_plant(vehicle: Vehicle, seed: int, severity: Severity = "realistic") -> PlantSpec:
    """A plant around the vehicle that stands in the pool; equal seeds give equal plants.

    Args:
        vehicle: Its file, with a `calibrated` set, an IMU and a depth sensor.
        seed: 0 or more. A seed keeps its character over severities: what is strong in `realistic` is so in `hard`.
        severity: nominal, realistic or hard.

    Raises:
        PlantSpecError: There is no such severity, or the vehicle has not what the pool needs.
    """
    if severity not in SPREADS:
        raise PlantSpecError(f"unknown severity '{severity}'; available: {', '.join(SPREADS)}")
    hydro = vehicle.hydrodynamics.get("calibrated")
    needed = {
        "sensors.imu": vehicle.sensors.imu,
        "sensors.depth": vehicle.sensors.depth,
        "hydrodynamics.calibrated": hydro,
    }
    missing = ", ".join(name for name, section in needed.items() if section is None)
    if missing or not isinstance(hydro, HydrodynamicSet):
        raise PlantSpecError(
            f"vehicle '{vehicle.name}' has no {missing or 'coefficients in hydrodynamics.calibrated'}: "
            "add it to the file to put the vehicle into a pool"
        )
    spread = SPREADS[severity]
    draw = _Draw(np.random.default_rng([seed, STREAM]))
    sections: dict[str, Any] = {
        "title": f"{vehicle.name}, {severity} plant {seed}",
        "severity": severity,
        "seed": seed,
        "vehicle": vehicle.name,
        "basin": basin_of(vehicle),
        "body": _body(vehicle, spread, draw),
        "thrusters": _thrusters(vehicle, spread, draw),
        "propellers": {"own_share": spread.own_share, "induced_share": spread.induced_share},
        "battery": {"fade": spread.fade * draw.within(0.6, 1.0), "resistance": spread.resistance},
        "buoyancy": _buoyancy(spread, draw),
        "circulation": _circulation(spread, draw),
        "tether": _tether(vehicle, spread, draw),
        "instruments": {"noise": spread.noise, "pressure_drift": spread.pressure_drift},
        "firmware": {
            "crystal_ppm": spread.crystal * draw.around(1.0),
            "clock_start": int(draw.within(2.0e4, 4.0e5)),
        },
    }
    return PlantSpec.model_validate({**sections, **_water(vehicle, hydro, spread, draw, sections)})


class _Draw:
    """Draws rounded to six digits, so that a plant's file reads well and is the plant."""

    def __init__(self, random: np.random.Generator) -> None:
        self._random = random

    def within(self, low: float, high: float) -> float:
        return float(f"{self._random.uniform(low, high):.6g}")

    def around(self, half: float, size: int | None = None) -> Any:
        """Between -half and half: a number, or an array of `size`."""
        part = self._random.uniform(-1.0, 1.0, size)
        return float(f"{half * part:.6g}") if size is None else half * np.round(part, 6)

    def direction(self) -> Array:
        x = self._random.standard_normal(3)
        return np.asarray(np.round(x / np.linalg.norm(x), 6))

    def sign(self) -> int:
        return 1 if self._random.random() < 0.5 else -1


def _water(
    vehicle: Vehicle, hydro: HydrodynamicSet, spread: Spread, draw: _Draw, sections: dict[str, Any]
) -> dict[str, Any]:
    """Added mass, damping and hull drag, so that the sum of all losses of speed is about the file's damping."""
    half = spread.hydrodynamics
    M_A = _congruent(hydro.added_mass, draw.around(half, 6))
    factor = draw.around(half, 6)
    D1, D2 = _congruent(hydro.linear_damping, factor), _congruent(hydro.quadratic_damping, factor)
    if hydro.terms:
        raise PlantSpecError(
            f"vehicle '{vehicle.name}' has {', '.join(hydro.terms)}, which the pool's plants do not model"
        )
    drag = panel_drag(vehicle)
    hull = hull_share(vehicle, spread.hull_share, drag)
    panels = hull["form_drag"] * drag
    taken = steady_share(vehicle, panels, sections["propellers"], sum(spread.deduction) / 2.0)
    D1, D2 = less_share(vehicle, D1, D2, taken)
    axes = [
        {
            "center": tuple((np.asarray(hydro.reference_point) + draw.around(spread.center, 3)).tolist()),
            "tilt_deg": tuple(np.asarray(draw.around(spread.tilt_deg, 3)).tolist()),
        }
        for _ in range(2)
    ]
    return {
        "added_mass": {**axes[0], "matrix": M_A.tolist()},
        "damping": {**axes[1], "linear": D1.tolist(), "quadratic": D2.tolist()},
        "hull": hull,
    }


def _congruent(matrix: Any, change: Array) -> Array:
    """S A S with S = diag sqrt(1 + change): scaled on every axis, and no less definite than A."""
    S = np.sqrt(1.0 + change)
    return np.asarray(np.asarray(matrix) * np.outer(S, S))


def _body(vehicle: Vehicle, spread: Spread, draw: _Draw) -> dict[str, Any]:
    body = vehicle.body
    offset = draw.direction() * draw.within(*spread.gravity_offset)
    return {
        "mass": body.mass + draw.around(spread.mass),
        "inertia": np.asarray(body.inertia).tolist(),
        "center_of_gravity": (np.asarray(body.center_of_gravity) + offset).tolist(),
        "displaced_volume": body.displaced_volume,
        "center_of_buoyancy": np.asarray(body.center_of_buoyancy).tolist(),
    }


def _thrusters(vehicle: Vehicle, spread: Spread, draw: _Draw) -> dict[str, Any]:
    built = {}
    for name, t in vehicle.thrusters.items():
        built[name] = {
            "gain_plus": 1.0 + draw.around(spread.thrust),
            "gain_minus": 1.0 + draw.around(spread.thrust),
            "deduction": draw.within(*spread.deduction),
            "time_constant": t.time_constant * (1.0 + draw.around(spread.motor)),
            "delay": t.delay * (1.0 + draw.around(spread.motor)),
            "dead_rpm_plus": t.dead_rpm_plus * (1.0 + 0.5 * draw.around(spread.motor)),
            "dead_rpm_minus": -t.dead_rpm_minus * (1.0 + 0.5 * draw.around(spread.motor)),
            # A motor reaches somewhat more than the bench drove it to.
            "full_rpm": 1.05 * max(t.rpm_max, -t.rpm_min) * (1.0 + draw.around(0.1 * spread.motor)),
        }
    return built


def _buoyancy(spread: Spread, draw: _Draw) -> dict[str, Any]:
    periods = [draw.within(180.0, 420.0), draw.within(600.0, 1200.0)]
    phases = [draw.within(0.0, 2.0 * math.pi) for _ in periods]
    if not spread.buoyancy:
        return {}
    return {"grams": [0.4 * spread.buoyancy, 0.6 * spread.buoyancy], "periods": periods, "phases": phases}


def _circulation(spread: Spread, draw: _Draw) -> dict[str, Any]:
    speed, part = draw.within(*spread.current), draw.within(0.3, 0.7)
    eddies = [
        {
            "cells": cells,
            "speed": share * speed,
            "unsteadiness": draw.within(0.1, 0.4),
            "period": draw.within(40.0, 120.0),
            "phase": draw.within(0.0, 2.0 * math.pi),
            "sense": draw.sign(),
        }
        for cells, share in ((1, part), (2, 1.0 - part))
    ]
    return {"eddies": eddies if speed else [], "floor_share": draw.within(0.3, 0.8)}


def _tether(vehicle: Vehicle, spread: Spread, draw: _Draw) -> dict[str, Any] | None:
    size = vehicle.body.size
    scale = room(size)
    anchor = (scale * draw.sign() * 2.0, scale * draw.sign() * draw.within(0.6, 1.0), 0.3)
    length = scale * draw.within(*spread.tether)
    weight = draw.around(spread.tether_weight)
    if not length:
        return None
    return {
        "anchor": anchor,
        "attachment": (round(-0.4 * float(size[0]), 6), 0.0, round(0.4 * float(size[2]), 6)),
        "length": length,
        "wet_weight": weight,
    }
