"""Drafts of maps: columns of a table whose names and unit suffixes are common, for the user to check."""

from __future__ import annotations

import json

from finssim.trials.conversion import TIME_NAMES, TIME_UNITS, factor, unit_of
from finssim.trials.findings import CalibrationError
from finssim.trials.trial import COLUMNS, column_of
from finssim.trials.trial_files import ColumnTable

_UNITS = {
    **{unit.lower(): unit for unit in ("s", "ms", "us", "ns", "deg", "rad", "m", "cm", "mm", "g", "V", "mV")},
    **{unit.lower(): unit for unit in ("Pa", "hPa", "kPa", "mbar", "bar", "m/s", "rad/s", "deg/s", "m/s2")},
    "sec": "s", "secs": "s", "degrees": "deg", "dps": "deg/s", "mps": "m/s", "mps2": "m/s2",
    "m_s": "m/s", "rad_s": "rad/s", "deg_s": "deg/s", "m_s2": "m/s2", "m/s^2": "m/s2", "m/s²": "m/s2",
}  # fmt: skip
"""Suffix of a name, in lower case -> unit."""

_QUANTITIES = {
    **dict(zip(COLUMNS, COLUMNS, strict=True)),
    **{f"{word}{axis}": f"a{axis}" for word in ("acc_", "accel_", "acc", "accel") for axis in "xyz"},
    **{
        f"{word}{axis}": rate
        for word in ("g", "w", "gyro", "gyro_", "gyr_", "omega_")
        for axis, rate in zip("xyz", "pqr", strict=True)
    },
    **{f"pos_{axis}": axis for axis in "xyz"},
    "rollrate": "p", "pitchrate": "q", "yawrate": "r", "rollspeed": "p", "pitchspeed": "q", "yawspeed": "r",
    "heading": "yaw", "pressure": "pressure", "battery_voltage": "voltage",
}  # fmt: skip
"""Common name of a quantity, in lower case -> canonical column."""


def draft_map(table: ColumnTable, label: str) -> str:
    """Return a map of the columns with common names as one line of YAML; unknown names are in capitals.

    Signs and axes cannot be taken from names: the draft is to be checked.

    Args:
        table: Table as read.
        label: Name of its file.
    """
    time, columns = "COLUMN", dict[str, str]()
    for name in table.columns:
        base, unit = _parted(name)
        column = _QUANTITIES.get(base)
        written = name in table.words
        if base in TIME_NAMES and time == "COLUMN" and (written or unit is None or unit in TIME_UNITS):
            time = _entry(name, "date" if written else unit if unit != "s" else None)
        elif column_of(name) is not None:
            columns[name] = _entry(name, None)
        elif column is not None and column not in columns and not written and _fits(unit, column):
            columns[column] = _entry(name, unit if unit != unit_of(column) else None)
    pairs = ", ".join(f"{column}: {entry}" for column, entry in columns.items()) or "u: COLUMN"
    return f"files: {{{json.dumps(label)}: {{time: {time}, columns: {{{pairs}}}, frame: FLU}}}}"


def _parted(name: str) -> tuple[str, str | None]:
    """Return a name without its unit suffix in lower case, such as `yaw` of `Yaw [deg]`, and the unit."""
    word = name.strip().lower()
    if word in _QUANTITIES or word in TIME_NAMES:
        return word, None
    for suffix in sorted(_UNITS, key=len, reverse=True):
        for end in (f"_{suffix}", f" {suffix}", f"[{suffix}]", f"({suffix})"):
            if word.endswith(end) and len(word) > len(end):
                return word.removesuffix(end).strip(" _").replace(" ", "_"), _UNITS[suffix]
    return word.replace(" ", "_"), None


def _entry(name: str, unit: str | None) -> str:
    """Return the source of a column in YAML, quoted unless its name is a word."""
    name = name if name.isidentifier() and name.isascii() else json.dumps(name)
    return name if unit is None else f"{{column: {name}, unit: {unit}}}"


def _fits(unit: str | None, column: str) -> bool:
    try:
        factor(unit, column)
    except CalibrationError:
        return False
    return True
