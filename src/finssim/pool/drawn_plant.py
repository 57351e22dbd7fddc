"""Random plants around a vehicle file: by seed, at one of three severities."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.core.mesh import face_geometry
from finssim.pool.plant_spec import (
    HEADROOM,
    Basin,
    Circulation,
    PlantSpec,
    PlantSpecError,
    Propellers,
    Severity,
    Swell,
    basin_of,
    by_severity,
)
from finssim.pool.positioning import POSITIONING, Positioning
from finssim.vehicles import Vehicle
from finssim.vehicles.defaults import SITES, room
from finssim.vehicles.hydrodynamics import HydrodynamicSet

__all__ = [
    "SPREADS", "Spread", "cruise", "draw_plant", "hull_share", "panel_drag", "positioning_of", "remaining_damping",
    "site_of", "steady_share",
]  # fmt: skip


# Spreads of the plants of each severity around the vehicle file.


@dataclass(frozen=True)
class HydrodynamicSpread:
    """Spreads of added mass, damping and hull drag around the vehicle file: ±, uniform."""

    entries: float
    """Spread of every diagonal entry of added mass and damping, and of the forces of each term [-]."""
    center: float
    """Spread of the points about which they are diagonal, per axis [m]."""
    tilt_deg: float
    """Spread of the axes in which they are diagonal [deg]."""
    hull_share: float
    """Fraction of the drag that the hull's panels cause, on the axis where it is largest [-]."""


@dataclass(frozen=True)
class PropulsionSpread:
    """Spreads of thrusters, other actuators and battery around the vehicle file: ±, uniform, unless stated
    otherwise."""

    own_share: float
    """Fraction of the vehicle's speed in the inflow of its propellers [-]."""
    induced_share: float
    """Fraction of a neighbour's induced speed in the inflow [-]."""
    deduction: tuple[float, float]
    """Smallest and largest thrust deduction [-]."""
    thrust: float
    """Spread of each propeller's thrust, in each direction, and of the gain of other actuators [-]."""
    motor: float
    """Spread of each motor's lag, delay and slowest speed, and of the lag of other actuators [-]."""
    offset: float
    """Spread of the offset of other actuators, as a fraction of half their travel [-]."""
    fade: float
    """Largest relative voltage loss of the battery in a quarter of an hour [-]."""
    resistance: float
    """Resistance of the battery [ohm]."""


@dataclass(frozen=True)
class Spread:
    """Spread of a plant of one severity around the vehicle file: ±, uniform, unless a description says otherwise."""

    hydrodynamics: HydrodynamicSpread
    propulsion: PropulsionSpread
    mass: float
    """[kg]"""
    gravity_offset: tuple[float, float]
    """Smallest and largest distance of the centre of gravity from that of the file [m]."""
    buoyancy: float
    """Amplitude of the buoyancy drift [g]."""
    current: tuple[float, float]
    """Smallest and largest speed of the pool's circulation [m/s]; 0 for no circulation."""
    tether_weight: float
    """Spread of the tether's weight in water [N/m]."""
    tether: tuple[float, float]
    """Smallest and largest length of the tether [m]; 0 for no tether."""
    noise: float
    """Factor on the file's instrument noise [-]."""
    pressure_drift: float
    """[m/√s]"""
    crystal: float
    """[ppm]"""

    def slender(self, share: float) -> Spread:
        """Return the spread for a slender hull, trimmed for forward motion; the share is its ratio of beam to length
        [-].

        Added mass about axes tilted by 3° would turn a torpedo-shaped vehicle more than its rudder does (Munk).
        """
        least, most = self.gravity_offset
        hydro = self.hydrodynamics
        hydro = replace(hydro, center=share * hydro.center, tilt_deg=share * hydro.tilt_deg)
        return replace(self, hydrodynamics=hydro, gravity_offset=(share * least, share * most))


HYDRODYNAMICS = by_severity(
    HydrodynamicSpread,
    entries=(0.0, 0.1, 0.2),
    center=(0.0, 0.012, 0.025),
    tilt_deg=(0.0, 3.0, 6.0),
    hull_share=(0.0, 0.1, 0.2),
)
PROPULSION = by_severity(
    PropulsionSpread,
    own_share=(0.0, 0.4, 0.7),
    induced_share=(0.0, 0.05, 0.1),
    deduction=((0.0, 0.0), (0.02, 0.06), (0.04, 0.12)),
    thrust=(0.0, 0.15, 0.25),
    motor=(0.0, 0.2, 0.35),
    offset=(0.0, 0.02, 0.04),
    fade=(0.0, 0.04, 0.08),
    resistance=(0.0, 0.03, 0.06),
)
SPREADS: dict[Severity, Spread] = by_severity(
    Spread,
    hydrodynamics=tuple(HYDRODYNAMICS.values()),
    propulsion=tuple(PROPULSION.values()),
    mass=(0.0, 0.012, 0.025),
    gravity_offset=((0.0, 0.0), (0.003, 0.006), (0.006, 0.012)),
    buoyancy=(0.0, 4.0, 8.0),
    current=((0.0, 0.0), (0.02, 0.04), (0.04, 0.08)),
    tether=((0.0, 0.0), (4.4, 5.0), (3.9, 4.5)),
    tether_weight=(0.0, 0.015, 0.03),
    noise=(0.5, 1.0, 1.5),
    pressure_drift=(0.0, 2.0e-4, 4.0e-4),
    crystal=(0.0, 30.0, 60.0),
)
"""Severity -> spreads: those of a careful laboratory in `realistic`, and about twice as large in `hard`."""


# Part of a vehicle's steady drag that panels and propellers cause, by axis; it is subtracted from the damping.


Array = NDArray[np.float64]

CRUISE = 0.4
"""Fraction of the largest wrench at which these parts are computed: between hovering and full speed [-]."""

LARGEST = 2.0 / 3.0
"""Largest fraction of a damping coefficient that is subtracted [-]."""

SKIN = 0.02
"""Ratio of the skin to the form drag coefficient, as in the published mesh set [-]."""


def cruise(vehicle: Vehicle) -> tuple[Array, Array]:
    """Return steady wrench and velocity at `CRUISE`, one axis at a time, with the file's damping.

    Returns:
        Wrench [N, N m] and velocity [m/s, rad/s], (6,) each; zeros on axes that are not controlled or not damped.
    """
    hydro: Any = vehicle.hydrodynamics["calibrated"]
    d1, d2 = np.diag(hydro.linear_damping), hydro.axis_drag
    F = CRUISE * np.asarray(vehicle.wrench_limits)
    # d2 v² + d1 v = F, by the root that is also exact without d2.
    root = d1 + np.sqrt(d1 * d1 + 4.0 * d2 * F)
    v = np.divide(2.0 * F, root, out=np.zeros(6), where=root > 0.0)
    return F, v


def panel_drag(vehicle: Vehicle) -> Array:
    """Return the drag of the hull's panels at cruise along each axis, with C_form = 1 [N, N m], (6,); zeros without
    a hull."""
    if vehicle.hull is None:
        return np.zeros(6)
    _, v = cruise(vehicle)
    hydro: Any = vehicle.hydrodynamics["calibrated"]
    normal, area, middle = face_geometry(*vehicle.hull_mesh())
    half = 0.5 * vehicle.water.density
    drag = np.zeros(6)
    arm = middle - np.asarray(hydro.reference_point)
    for axis in range(6):
        if axis < 3:
            flow = np.zeros_like(middle)
            flow[:, axis] = -v[axis]
        else:
            flow = -np.cross(np.eye(3)[axis - 3] * v[axis], arm)
        across = np.sum(normal * flow, axis=1)
        v_t = flow - across[:, None] * normal
        skin = SKIN * np.linalg.norm(v_t, axis=1)[:, None] * v_t
        pull = half * area[:, None] * (np.maximum(-across, 0.0)[:, None] * flow + skin)
        total = pull.sum(axis=0) if axis < 3 else np.cross(arm, pull).sum(axis=0)
        drag[axis] = -total[axis % 3]
    return drag


def hull_share(vehicle: Vehicle, share: float, drag: Array) -> dict[str, float]:
    """Return coefficients with which the panels cause a fraction of the drag, on the driven axis where this is largest.

    Args:
        vehicle: Its file.
        share: Fraction of the drag at cruise [-].
        drag: Result of `panel_drag` [N, N m].
    """
    F, _ = cruise(vehicle)
    largest = np.max(np.divide(drag, F, out=np.zeros(6), where=F > 0.0), initial=0.0)
    form = float(f"{share / largest:.6g}") if largest > 0.0 else 0.0
    return {"form_drag": form, "skin_drag": float(f"{SKIN * form:.6g}")}


def steady_share(vehicle: Vehicle, panels: Array, propellers: Mapping[str, float], deduction: float) -> Array:
    """Return the drag of panels and propellers at cruise, by axis [N, N m], (6,).

    The part of the propellers is the thrust lost to the vehicle's motion, T V / (J0 n D), as in `delivered_thrust`, and
    to the thrust deduction: a file's damping was fitted with thrusts measured on a bench, so it contains both.

    Args:
        vehicle: Its file.
        panels: Drag of the panels, by axis [N, N m], (6,).
        propellers: Keys of `Propellers`, in the units of `Propellers`.
        deduction: Mean thrust deduction [-].
    """
    F, v = cruise(vehicle)
    p = Propellers.model_validate(propellers)
    thrusters = list(vehicle.thrusters.values())
    B = vehicle.thruster_matrix()
    axis = np.array([t.axis for t in thrusters])
    position = np.array([t.position for t in thrusters])
    drag = panels.copy()
    for i in np.flatnonzero(v > 0.0):
        T = np.linalg.pinv(B) @ (F[i] * np.eye(6)[i])
        speed = np.array([abs(t.speed(f)) for t, f in zip(thrusters, T, strict=True)])
        motion = np.eye(3)[i] if i < 3 else np.cross(np.eye(3)[i - 3], position)
        along = v[i] * np.sum(axis * motion, axis=1) * [t.inflow is None for t in thrusters]
        stall = p.advance_at_zero_thrust * p.diameter / (2.0 * math.pi) * np.maximum(speed, 20.0)
        drag[i] += B[i] @ (np.abs(T) * p.own_share * along / stall)
    return np.where(v > 0.0, drag + deduction * F, 0.0)


def remaining_damping(vehicle: Vehicle, D1: Array, D2: Array, drag: Array) -> tuple[Array, Array]:
    """Return the damping without the drag that other parts cause; a third of each coefficient always remains.

    Args:
        vehicle: Its file.
        D1: Linear damping [N s/m, N m s], (6, 6).
        D2: Quadratic damping [N s²/m², N m s²], (6, 6).
        drag: Drag at cruise, by axis [N, N m], (6,); subtracted from the linear part first.

    Returns:
        D1 [N s/m, N m s] and D2 [N s²/m², N m s²] with smaller diagonals.
    """
    _, v = cruise(vehicle)
    first = np.minimum(drag, LARGEST * np.diag(D1) * v)
    second = np.minimum(drag - first, LARGEST * np.diag(D2) * v * v)
    safe = np.where(v > 0.0, v, 1.0)
    return D1 - np.diag(first / safe), D2 - np.diag(second / safe**2)


DRAWN = 20261122
"""Number that separates the draws of plants from other uses of a seed."""


def draw_plant(vehicle: Vehicle, seed: int, severity: Severity = "realistic") -> PlantSpec:
    """Return a random plant for the vehicle in the pool; equal seeds give equal plants.

    Args:
        vehicle: Its file, with a `calibrated` set, an IMU and a depth sensor.
        seed: 0 or more. With one seed, deviations of all severities have the same signs and proportions.
        severity: nominal, realistic or hard.

    Raises:
        PlantSpecError: The severity does not exist, or the vehicle lacks something that the pool needs.
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
    if hydro.terms or vehicle.actuators:
        spread = spread.slender(float(vehicle.body.size[1] / vehicle.body.size[0]))
    propulsion = spread.propulsion
    draw = _Draw(np.random.default_rng([seed, DRAWN]))
    sections: dict[str, Any] = {
        "title": f"{vehicle.name}, {severity} plant {seed}",
        "severity": severity,
        "seed": seed,
        "vehicle": vehicle.name,
        "basin": basin_of(vehicle),
        "body": _body(vehicle, spread, draw),
        "thrusters": _thrusters(vehicle, propulsion, draw),
        "propellers": {"own_share": propulsion.own_share, "induced_share": propulsion.induced_share},
        "battery": {"fade": propulsion.fade * draw.within(0.6, 1.0), "resistance": propulsion.resistance},
        "buoyancy": _buoyancy(spread, draw),
        "circulation": _circulation(spread, draw),
        "tether": _tether(vehicle, spread, draw),
        "instruments": {"noise": spread.noise, "pressure_drift": spread.pressure_drift},
        "firmware": {
            "crystal_ppm": spread.crystal * draw.around(1.0),
            "clock_start": int(draw.within(2.0e4, 4.0e5)),
        },
    }
    further = _Draw(np.random.default_rng([seed, DRAWN, 1]))
    sections["actuators"] = _actuators(vehicle, propulsion, further)
    sections["terms"] = {name: 1.0 + further.around(spread.hydrodynamics.entries) for name in hydro.terms}
    return PlantSpec.model_validate({**sections, **_water(vehicle, hydro, spread, draw, sections)})


class _Draw:
    """Random numbers rounded to six digits, so that the plant's file is readable and exact."""

    def __init__(self, random: np.random.Generator) -> None:
        self._random = random

    def within(self, low: float, high: float) -> float:
        return float(f"{self._random.uniform(low, high):.6g}")

    def around(self, half: float, size: int | None = None) -> Any:
        """Return a number between -half and half, or an array of `size`."""
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
    """Return added mass, damping and hull drag such that the total resistance is about the file's damping."""
    half, about = spread.hydrodynamics.entries, spread.hydrodynamics
    M_A = _congruent(hydro.added_mass, draw.around(half, 6))
    factor = draw.around(half, 6)
    D1, D2 = _congruent(hydro.linear_damping, factor), _congruent(hydro.quadratic_damping, factor)
    # Terms already describe the flow around the hull.
    drag = np.zeros(6) if hydro.terms else panel_drag(vehicle)
    hull = hull_share(vehicle, about.hull_share, drag)
    panels = hull["form_drag"] * drag
    outer_drag = steady_share(vehicle, panels, sections["propellers"], sum(spread.propulsion.deduction) / 2.0)
    D1, D2 = _dissipative(*remaining_damping(vehicle, D1, D2, outer_drag))
    axes = [
        {
            "center": tuple((np.asarray(hydro.reference_point) + draw.around(about.center, 3)).tolist()),
            "tilt_deg": tuple(np.asarray(draw.around(about.tilt_deg, 3)).tolist()),
        }
        for _ in range(2)
    ]
    return {
        "added_mass": {**axes[0], "matrix": M_A.tolist()},
        "damping": {**axes[1], "linear": D1.tolist(), "quadratic": D2.tolist()},
        "hull": hull,
    }


def _dissipative(D1: Array, D2: Array) -> tuple[Array, Array]:
    """Return D1 and D2 with couplings reduced to what `Damping` allows; unchanged if they are small enough."""
    scale = np.sqrt(np.maximum(np.outer(np.diag(D1), np.diag(D1)), 1e-24))
    least = min(float(np.linalg.eigvalsh((D1 + D1.T) / 2.0 / scale)[0]), 0.0)
    off = np.abs(D2 - np.diag(np.diag(D2)))
    need = off.sum(axis=1) / 3.0 + 2.0 * off.sum(axis=0) / 3.0
    room = float((np.diag(D2)[need > 0.0] / need[need > 0.0]).min(initial=np.inf))
    if least >= -1e-9 and room >= 1.0 - 1e-9:
        return D1, D2
    kept = np.where(np.eye(6, dtype=bool), 1.0, 0.999 * min(room, 1.0 / (1.0 - least), 1.0))
    return kept * D1, kept * D2


def _congruent(matrix: Any, change: Array) -> Array:
    """Return S A S with S = diag sqrt(1 + change): scaled on every axis, with the definiteness of A."""
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


def _thrusters(vehicle: Vehicle, spread: PropulsionSpread, draw: _Draw) -> dict[str, Any]:
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
            "full_rpm": HEADROOM * max(t.rpm_max, -t.rpm_min) * (1.0 + draw.around(0.1 * spread.motor)),
        }
    return built


def _actuators(vehicle: Vehicle, spread: PropulsionSpread, draw: _Draw) -> dict[str, Any]:
    return {
        name: {
            "gain": 1.0 + draw.around(spread.thrust),
            "offset": draw.around(0.5 * spread.offset * (a.maximum - a.minimum)),
            "time_constant": a.time_constant * (1.0 + draw.around(spread.motor)),
        }
        for name, a in vehicle.actuators.items()
    }


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


# Sites: pool, tank or open water, and positioning systems.


TANK, OPEN = (
    Basin(length=size[0], width=size[1], depth=size[2]) for size in SITES.values() if size is not None
)
STREAM = {"nominal": 0.0, "realistic": 0.1, "hard": 0.25}
"""Current of open water by severity [m/s]."""
SWELL = {"nominal": 0.0, "realistic": 0.05, "hard": 0.15}
"""Amplitude of the longest of the three waves in open water, by severity [m]."""


def site_of(name: str, spec: PlantSpec) -> PlantSpec:
    """Return the plant at a site: the same vehicle in other water.

    Args:
        name: pool, tank (10 m x 6 m, 5 m deep, only with the pool's own eddies) or open-water (20 m deep, without walls
            within reach or a tether, with a uniform current and three waves by severity).
        spec: Plant drawn for the pool.

    Raises:
        PlantSpecError: The site does not exist, or the vehicle does not fit into it.
    """
    if name not in SITES:
        raise PlantSpecError(f"unknown site '{name}'; available: {', '.join(SITES)}")
    if name == "pool":
        return spec
    if name == "tank":
        if spec.basin.length > TANK.length:
            raise PlantSpecError(
                f"{spec.vehicle} needs {spec.basin.length:.1f} m, the tank has {TANK.length:g} m: choose open-water"
            )
        return spec.model_copy(update={"basin": TANK, "tether": None})
    random = np.random.default_rng([spec.seed, 0x5EA])
    towards, speed = float(random.uniform(-math.pi, math.pi)), STREAM[spec.severity]
    waves = tuple(
        Swell(
            amplitude=SWELL[spec.severity] * share,
            wavelength=length,
            heading=towards + float(random.uniform(-0.5, 0.5)),
            phase=float(random.uniform(-math.pi, math.pi)),
        )
        for share, length in ((1.0, 12.0), (0.5, 7.0), (0.3, 4.0))
        if SWELL[spec.severity]
    )
    stream = (speed * math.cos(towards), speed * math.sin(towards), 0.0)
    return spec.model_copy(
        update={"basin": OPEN, "tether": None, "circulation": Circulation(stream=stream, waves=waves)}
    )


def positioning_of(name: str, seed: int) -> Positioning | None:
    """Return the positioning system of that name; None for `none`.

    Raises:
        PlantSpecError: The system does not exist.
    """
    if name == "none":
        return None
    if name not in POSITIONING:
        raise PlantSpecError(f"unknown positioning '{name}'; available: none, {', '.join(POSITIONING)}")
    return Positioning(POSITIONING[name], seed)


def site_of_world(world: Any, spec: PlantSpec) -> PlantSpec:
    """Return the plant in the water of a world: its basin, or open water above its seabed.

    Args:
        world: Described world.
        spec: Plant drawn for the pool.
    """
    if world.basin is not None:
        length, width, depth = world.basin.size.tolist()
        basin = Basin(length=length, width=width, depth=depth)
        return spec if basin == spec.basin else spec.model_copy(update={"basin": basin, "tether": None})
    spec = site_of("open-water", spec)
    depth = spec.basin.depth if world.seabed is None else world.seabed.depth
    return spec.model_copy(update={"basin": spec.basin.model_copy(update={"depth": depth})})
