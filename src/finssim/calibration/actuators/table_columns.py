"""Which column of a bench table holds what, and in which unit."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import NamedTuple

from finssim.calibration.errors import CalibrationError

__all__ = ["QUANTITIES", "Source", "find_columns"]

G0 = 9.80665
"""Standard gravity, of kilogram-force and pound-force [m/s²]."""

_UNITS: dict[str, dict[str, float]] = {
    "speed": {
        **dict.fromkeys(("rpm", "1/min", "min-1", "r/min", "rev/min"), math.pi / 30.0),
        **dict.fromkeys(("rad/s", "rads", "radps", "rads-1", "radpers"), 1.0),
        **dict.fromkeys(("rps", "rev/s", "hz", "1/s"), 2.0 * math.pi),
    },
    "force": {
        **dict.fromkeys(("n", "newton", "newtons"), 1.0),
        "mn": 1e-3,
        "kn": 1e3,
        **dict.fromkeys(("kgf", "kg", "kp", "kilogram", "kilograms"), G0),
        **dict.fromkeys(("gf", "g", "gram", "grams", "gr"), 1e-3 * G0),
        **dict.fromkeys(("lbf", "lb", "lbs", "pound", "pounds"), 0.45359237 * G0),
        **dict.fromkeys(("ozf", "oz"), 0.028349523125 * G0),
    },
    "pulse": {
        **dict.fromkeys(("us", "usec", "microsecond", "microseconds"), 1.0),
        **dict.fromkeys(("ms", "msec"), 1e3),
    },
    "voltage": {**dict.fromkeys(("v", "volt", "volts"), 1.0), "mv": 1e-3},
    "time": {**dict.fromkeys(("s", "sec", "second", "seconds"), 1.0), "ms": 1e-3, "us": 1e-6, "min": 60.0},
}
_SHOWN = {
    "speed": "rpm, rad/s, rev/s",
    "force": "N, kgf, gf, lbf",
    "pulse": "us, ms",
    "voltage": "V, mV",
    "time": "s, ms, us",
}
_WORDS = {
    "speed": {"speed", "rpm", "omega", "rotation", "rotational", "shaft", "rev", "revs", "velocity"},
    "force": {"force", "thrust", "load", "loadcell"},
    "pulse": {"pwm", "pulse", "pulsewidth", "esc", "throttle", "signal"},
    "voltage": {"voltage", "battery", "volt", "volts", "supply", "vbat", "v"},
    "time": {"time", "t", "timestamp"},
}
_IMPLIED = {"rpm": ("speed", math.pi / 30.0), "pwm": ("pulse", 1.0)}
"""Words that say the unit too."""

QUANTITIES = tuple(_UNITS)
"""speed force pulse voltage time"""


class Source(NamedTuple):
    """Where a quantity is found."""

    column: int
    header: str
    factor: float
    """To rad/s, N, µs, V or s; NaN where the header names no unit."""


def find_columns(
    headers: list[str], used: list[bool], given: Mapping[str, str] | None, shown: str
) -> dict[str, Source]:
    """The column of every quantity that the table has.

    Args:
        headers: The header line's cells.
        used: Whether a column holds any number but zero; others are passed over.
        given: Quantity -> `COLUMN`, `COLUMN=UNIT`, or either after a minus sign that turns the values' sign; what it
            does not name is found from the headers.
        shown: How messages call the table.

    Raises:
        CalibrationError: Two columns could be meant, a unit is missing, or `given` names what is not there.
    """
    names = [header.strip() for header in headers]
    found = {quantity: _given(quantity, text, names, shown) for quantity, text in dict(given or {}).items()}
    candidates: dict[str, list[Source]] = {}
    for column, header in enumerate(names):
        guess = _recognised(header)
        if guess is not None and used[column] and guess[0] not in found:
            candidates.setdefault(guess[0], []).append(Source(column, header, guess[1]))
    for quantity, sources in candidates.items():
        if len(sources) > 1:
            with_unit = [source for source in sources if not math.isnan(source.factor)]
            sources = with_unit if len(with_unit) == 1 else sources
        if len(sources) > 1:
            listed = " or ".join(f"'{source.header}'" for source in sources)
            raise CalibrationError(
                f"{shown}: {quantity} could be {listed}: say which, {quantity}={sources[0].header}"
            )
        found[quantity] = sources[0]
    for quantity, source in found.items():
        if math.isnan(source.factor):
            raise CalibrationError(
                f"{shown}: column '{source.header}' has no unit: write it into the header or say it, "
                f"{quantity}={source.header}=UNIT with one of {_SHOWN[quantity]}"
            )
    return found


def _given(quantity: str, text: str, names: list[str], shown: str) -> Source:
    if quantity not in _UNITS:
        raise CalibrationError(f"unknown quantity '{quantity}', expected one of {', '.join(QUANTITIES)}")
    sign = 1.0
    for name in (text, text[1:] if text.startswith("-") else None):
        if name is None:
            continue
        sign = 1.0 if name == text else -1.0
        if name.strip() in names:
            column = names.index(name.strip())
            guess = _recognised(names[column])
            factor = guess[1] if guess and guess[0] == quantity else _unit_of(quantity, names[column])
            return Source(column, names[column], sign * factor)
        header, _, unit = name.rpartition("=")
        if header.strip() in names:
            factor = _UNITS[quantity].get(_plain(unit), math.nan)
            if math.isnan(factor):
                raise CalibrationError(
                    f"{shown}: unknown unit '{unit}' of {quantity}, expected one of {_SHOWN[quantity]}"
                )
            return Source(names.index(header.strip()), header.strip(), sign * factor)
    raise CalibrationError(f"{shown}: no column '{text}' for {quantity}; there are {', '.join(names)}")


def _recognised(header: str) -> tuple[str, float] | None:
    """Quantity and factor that a header names; the factor is NaN where it gives no unit."""
    label, unit = _split(header)
    words = set(re.findall(r"[a-z]+", label.lower()))
    for word, (quantity, factor) in _IMPLIED.items():
        if word in words and _plain(unit) in ("", word):
            return quantity, factor
    matches = [quantity for quantity, known in _WORDS.items() if words & known]
    if unit:
        matches = [quantity for quantity in matches if _plain(unit) in _UNITS[quantity]]
        if not label and not matches:
            matches = [quantity for quantity in ("speed", "voltage") if _plain(unit) in _UNITS[quantity]]
        return (matches[0], _UNITS[matches[0]][_plain(unit)]) if len(matches) == 1 else None
    if len(matches) != 1:
        return None
    return matches[0], 1.0 if matches[0] in ("voltage", "time") else math.nan


def _unit_of(quantity: str, header: str) -> float:
    return _UNITS[quantity].get(_plain(_split(header)[1]), math.nan)


def _split(header: str) -> tuple[str, str]:
    """Label and unit: `Force (Kg f)`, `Thrust [N]`, `speed_rpm`, `omega rad/s`, `RPM`."""
    text = header.strip()
    brackets = re.fullmatch(r"(.*?)[\s_]*[(\[{](.*)[)\]}]", text)
    if brackets:
        return brackets[1], brackets[2]
    known = {unit for units in _UNITS.values() for unit in units}
    parts = re.split(r"[\s_]+", text)
    for start in range(1, len(parts)):
        tail = "/".join(parts[start:]) if len(parts) - start == 2 else "".join(parts[start:])
        if _plain(tail) in known:
            return " ".join(parts[:start]), tail
    return text, ""


def _plain(unit: str) -> str:
    """Lower case, without spaces, with u for micro and / for per."""
    text = unit.strip().lower().replace("µ", "u").replace("μ", "u").replace("·", "").replace("^", "")
    return re.sub(r"\s+|\.", "", text.replace(" per ", "/")).replace("rad_s", "rad/s")
