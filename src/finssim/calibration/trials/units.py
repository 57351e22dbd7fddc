"""Units that a log may use, and the factor to the unit of a canonical column."""

from __future__ import annotations

import math

from finssim.calibration.errors import CalibrationError
from finssim.calibration.trials.trial import column_of
from finssim.vehicles.part import did_you_mean

__all__ = ["EXTRA_COLUMNS", "GRAVITY", "TIME_UNITS", "factor"]

GRAVITY = 9.80665
"""Standard gravity, of the units g and kgf [m/s²]."""

POUND = 0.45359237
"""Of the units lbf and ozf, which is a sixteenth of it [kg]."""

TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}
"""Seconds in one of each."""

EXTRA_COLUMNS = {
    "vx": ("m/s", "velocity along world x"),
    "vy": ("m/s", "velocity along world y"),
    "vz": ("m/s", "velocity along world z"),
    "pressure": ("Pa", "absolute pressure, or above that of the surface with surface_pressure 0"),
    "stick_roll": ("-", "ArduSub's demand of roll in [-1, 1], right side down"),
    "stick_pitch": ("-", "of pitch, nose up"),
    "stick_yaw": ("-", "of yaw, clockwise from above"),
    "stick_throttle": ("-", "of throttle, up"),
    "stick_forward": ("-", "of forward, ahead"),
    "stick_lateral": ("-", "of lateral, right"),
}
"""Names that a map may give beside the canonical columns: they become u v w, depth and pulse widths in the trial."""

UNITS: dict[str, dict[str, float]] = {
    "angle": {"rad": 1.0, "deg": math.pi / 180.0, "mrad": 1e-3, "cdeg": math.pi / 18000.0},
    "rate": {
        "rad/s": 1.0,
        "deg/s": math.pi / 180.0,
        "mrad/s": 1e-3,
        "rpm": math.pi / 30.0,
        "rps": 2.0 * math.pi,
        "Hz": 2.0 * math.pi,
    },
    "length": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "ft": 0.3048, "in": 0.0254},
    "speed": {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3, "km/h": 1.0 / 3.6, "kn": 1852.0 / 3600.0},
    "acceleration": {"m/s²": 1.0, "m/s^2": 1.0, "m/s2": 1.0, "g": GRAVITY, "mg": 1e-3 * GRAVITY},
    "force": {
        "N": 1.0,
        "mN": 1e-3,
        "kN": 1e3,
        "kgf": GRAVITY,
        "gf": 1e-3 * GRAVITY,
        "lbf": POUND * GRAVITY,
        "ozf": POUND / 16.0 * GRAVITY,
    },
    "moment": {
        "N m": 1.0,
        "Nm": 1.0,
        "N mm": 1e-3,
        "kgf m": GRAVITY,
        "kgf cm": 1e-2 * GRAVITY,
        "lbf ft": POUND * GRAVITY * 0.3048,
    },
    "voltage": {"V": 1.0, "mV": 1e-3, "cV": 1e-2},
    "pulse": {"µs": 1.0, "us": 1.0, "ms": 1e3, "s": 1e6, "ns": 1e-3},
    "pressure": {
        "Pa": 1.0,
        "hPa": 1e2,
        "mbar": 1e2,
        "kPa": 1e3,
        "bar": 1e5,
        "dbar": 1e4,
        "atm": 101325.0,
        "psi": 6894.757293168,
    },
    "number": {"-": 1.0},
}
"""Dimension -> unit -> how many of our units it is."""

_DIMENSION = {unit: dimension for dimension, units in UNITS.items() for unit in units}


def unit_of(canonical: str) -> str:
    """The unit that a canonical or extra column is kept in."""
    if canonical in EXTRA_COLUMNS:
        return EXTRA_COLUMNS[canonical][0]
    column = column_of(canonical)
    if column is None:
        raise CalibrationError(f"'{canonical}' is no column of a trial")
    return column.unit


def factor(unit: str | None, canonical: str) -> float:
    """What a number in `unit` is multiplied by to be in the unit of the canonical column; 1 for no unit.

    Raises:
        CalibrationError: Unknown unit, or one of another dimension.
    """
    if unit is None:
        return 1.0
    target = unit_of(canonical)
    if unit not in _DIMENSION:
        raise CalibrationError(
            f"unit of {canonical} is '{unit}'{did_you_mean(unit, list(_DIMENSION))} "
            f"expected {_like(target)}: or give a scale to {target}"
        )
    dimension, wanted = _DIMENSION[unit], _DIMENSION[target]
    if dimension != wanted:
        article = "an" if dimension[0] == "a" else "a"
        raise CalibrationError(
            f"unit of {canonical} is '{unit}', {article} {dimension}, expected {_like(target)}"
        )
    return UNITS[wanted][unit] / UNITS[wanted][target]


def _like(target: str) -> str:
    return f"one of {', '.join(UNITS[_DIMENSION[target]])}"
