"""Units that a log may use, and the factor to the unit of a canonical column."""

from __future__ import annotations

import math

from finssim.calibration.errors import CalibrationError
from finssim.calibration.trials.columns import column_of
from finssim.vehicles.part import did_you_mean

__all__ = ["EXTRA_COLUMNS", "TIME_UNITS", "factor"]

GRAVITY = 9.80665
"""Standard gravity, of the units g and kgf [m/s²]."""

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

_POUND_FORCE = 4.4482216152605

_UNITS: dict[str, tuple[str, float]] = {
    "rad": ("angle", 1.0),
    "deg": ("angle", math.pi / 180.0),
    "mrad": ("angle", 1e-3),
    "cdeg": ("angle", math.pi / 18000.0),
    "rad/s": ("rate", 1.0),
    "deg/s": ("rate", math.pi / 180.0),
    "mrad/s": ("rate", 1e-3),
    "rpm": ("rate", math.pi / 30.0),
    "rps": ("rate", 2.0 * math.pi),
    "Hz": ("rate", 2.0 * math.pi),
    "m": ("length", 1.0),
    "cm": ("length", 1e-2),
    "mm": ("length", 1e-3),
    "ft": ("length", 0.3048),
    "in": ("length", 0.0254),
    "m/s": ("speed", 1.0),
    "cm/s": ("speed", 1e-2),
    "mm/s": ("speed", 1e-3),
    "km/h": ("speed", 1.0 / 3.6),
    "kn": ("speed", 1852.0 / 3600.0),
    "m/s²": ("acceleration", 1.0),
    "m/s^2": ("acceleration", 1.0),
    "m/s2": ("acceleration", 1.0),
    "g": ("acceleration", GRAVITY),
    "mg": ("acceleration", 1e-3 * GRAVITY),
    "N": ("force", 1.0),
    "mN": ("force", 1e-3),
    "kN": ("force", 1e3),
    "kgf": ("force", GRAVITY),
    "gf": ("force", 1e-3 * GRAVITY),
    "lbf": ("force", _POUND_FORCE),
    "N m": ("moment", 1.0),
    "Nm": ("moment", 1.0),
    "N mm": ("moment", 1e-3),
    "kgf m": ("moment", GRAVITY),
    "kgf cm": ("moment", 1e-2 * GRAVITY),
    "lbf ft": ("moment", _POUND_FORCE * 0.3048),
    "V": ("voltage", 1.0),
    "mV": ("voltage", 1e-3),
    "cV": ("voltage", 1e-2),
    "µs": ("pulse", 1.0),
    "us": ("pulse", 1.0),
    "ms": ("pulse", 1e3),
    "s": ("pulse", 1e6),
    "ns": ("pulse", 1e-3),
    "Pa": ("pressure", 1.0),
    "hPa": ("pressure", 1e2),
    "mbar": ("pressure", 1e2),
    "kPa": ("pressure", 1e3),
    "bar": ("pressure", 1e5),
    "dbar": ("pressure", 1e4),
    "atm": ("pressure", 101325.0),
    "psi": ("pressure", 6894.757293168),
    "-": ("number", 1.0),
}


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
    if unit not in _UNITS:
        raise CalibrationError(
            f"unit of {canonical} is '{unit}'{did_you_mean(unit, list(_UNITS))} "
            f"expected {_like(target)}: or give a scale to {target}"
        )
    (dimension, size), (wanted, target_size) = _UNITS[unit], _UNITS[target]
    if dimension != wanted:
        raise CalibrationError(
            f"unit of {canonical} is '{unit}', {_article(dimension)}, expected {_like(target)}"
        )
    return size / target_size


def _like(target: str) -> str:
    dimension = _UNITS[target][0]
    return "one of " + ", ".join(unit for unit, (of, _) in _UNITS.items() if of == dimension)


def _article(dimension: str) -> str:
    return f"{'an' if dimension[0] in 'a' else 'a'} {dimension}"
