"""Tables of thrust against shaft speed and pulse width: from the manufacturer or from one's own bench."""

from __future__ import annotations

import hashlib
import math
import os
import re
import statistics
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.findings import CalibrationError, Finding, finding
from finssim.calibration.trials.conversion import TIME_UNITS, UNITS
from finssim.calibration.trials.trial import Trial
from finssim.text_table import TextTable, read_text_table

Array = NDArray[np.float64]

LAST = 0.4
"""Part of a level that counts as settled: the last 2 s of 5 s."""
SHORTEST = 0.5
"""Shortest level that can settle [s]."""
LEAST_COVERED = 0.5
"""Share of the time that levels must cover for a log to be one of levels; a slower sweep is used as it is."""
SHORTEST_HELD = 0.2
"""Levels of a command shorter than this are no steps [s]."""
SETTLING = 50
"""Samples of a run after which its median no longer moves, so that a slow ramp is not one run."""
TOLERANCE = 0.02
"""Band around a level within which a measured signal still counts as held, of its range."""


class Step(NamedTuple):
    """A change of a held signal and what follows until the next one."""

    start: float
    """Time of the last sample before the change, from which the signal could have changed [s]."""
    time: float
    """Time of the first sample after the change [s]."""
    end: float
    """Time of the last sample before the next change, or of the log [s]."""
    before: float
    after: float


def levels(x: Array, tolerance: float) -> list[tuple[int, int]]:
    """Runs of samples that stay within `tolerance` of their running median, [first, last) each, covering all.

    One stray sample does not end a run, two do.
    """
    runs, first = [], 0
    values = x.tolist()
    centre = values[0] if values else 0.0
    for i in range(1, len(values)):
        if values[i] == centre:
            continue
        outside = abs(values[i] - centre) > tolerance
        if outside and (i + 1 >= len(values) or abs(values[i + 1] - centre) > tolerance):
            runs.append((first, i))
            first, centre = i, values[i]
        elif not outside and i - first < SETTLING:
            centre = statistics.median(values[first : i + 1])
    if values:
        runs.append((first, len(values)))
    return runs


def last_parts(values: dict[str, Array]) -> tuple[dict[str, Array], Finding]:
    """Steady rows of a log over time: the mean over the last 40 % of each level of the pulse or of the speed.

    Args:
        values: `time` [s] and any of speed, force, pulse, voltage, (n,) each.

    Returns:
        The same without `time`, one row per level, and a finding; the rows as they are if the log holds no levels (a
        slow sweep).
    """
    times = values["time"]
    others = {key: value for key, value in values.items() if key != "time"}
    drive = values.get("pulse", values.get("speed"))
    assert drive is not None
    good = np.flatnonzero(np.isfinite(drive) & np.isfinite(times))
    span = float(np.ptp(drive[good])) if good.size else 0.0
    band = TOLERANCE * span if "pulse" not in values else 0.002 * span
    rows, covered = [], 0.0
    for first, last in levels(drive[good], band):
        index = good[first:last]
        length = float(times[index[-1]] - times[index[0]])
        half = len(index) // 2
        if length < SHORTEST or half < 2:
            continue
        settled = index[times[index] >= times[index[-1]] - LAST * length]
        drift = abs(np.mean(drive[index[half:]]) - np.mean(drive[index[half // 2 : half]]))
        if drift <= 0.25 * band:
            rows.append(settled)
            covered += length
    if len(rows) < 3 or covered < LEAST_COVERED * float(times[good[-1]] - times[good[0]]):
        return others, finding("read_as_sweep", rows=len(times))
    steady = {key: np.array([_mean(value[row]) for row in rows]) for key, value in others.items()}
    return steady, finding("read_as_levels", levels=len(rows), share=LAST)


def _mean(values: Array) -> float:
    good = values[np.isfinite(values)]
    return float(np.mean(good)) if good.size else float("nan")


def find_steps(t: Array, command: Array) -> list[Step]:
    """Every change of a held command that lasts.

    Args:
        t: Times [s], (n,).
        command: Its values, finite, (n,).

    Returns:
        Steps in order of time; none where the command never holds still.
    """
    span = float(np.ptp(command)) if command.size else 0.0
    if span == 0.0:
        return []
    runs = levels(command, 0.01 * span)
    held = [(a, b) for a, b in runs if t[b - 1] - t[a] >= SHORTEST_HELD]
    if len(runs) > 4 * len(held):  # a command that moves all the time
        return []
    return [
        Step(float(t[a2 - 1]), float(t[a2]), float(t[b2 - 1]), _mean(command[a1:b1]), _mean(command[a2:b2]))
        for (a1, b1), (a2, b2) in zip(held, held[1:], strict=False)
    ]


# Which column of a bench table holds what, and in which unit.

_ALIASES = {
    "rate": {
        **dict.fromkeys(("1/min", "min-1", "r/min", "rev/min"), "rpm"),
        **dict.fromkeys(("rads", "radps", "rads-1", "radpers"), "rad/s"),
        **dict.fromkeys(("rev/s", "1/s"), "rps"),
    },
    "force": {
        **dict.fromkeys(("newton", "newtons"), "N"),
        **dict.fromkeys(("kg", "kp", "kilogram", "kilograms"), "kgf"),
        **dict.fromkeys(("g", "gram", "grams", "gr"), "gf"),
        **dict.fromkeys(("lb", "lbs", "pound", "pounds"), "lbf"),
        "oz": "ozf",
    },
    "pulse": {**dict.fromkeys(("usec", "microsecond", "microseconds"), "us"), "msec": "ms"},
    "voltage": dict.fromkeys(("volt", "volts"), "V"),
}
"""Dimension -> what headers of benches call a unit -> the unit."""


def _units(dimension: str, but: tuple[str, ...] = ()) -> dict[str, float]:
    """Factors of a dimension's units as `_plain` writes them, by their aliases too."""
    sizes = {unit: size for unit, size in UNITS[dimension].items() if unit not in but}
    return {u.lower(): size for u, size in sizes.items()} | {
        alias: sizes[unit] for alias, unit in _ALIASES[dimension].items()
    }


_UNITS: dict[str, dict[str, float]] = {
    "speed": _units("rate", but=("deg/s", "mrad/s")),
    "force": _units("force"),
    "pulse": _units("pulse", but=("µs", "s", "ns")),
    "voltage": _units("voltage"),
    "time": {u: TIME_UNITS[u] for u in ("s", "ms", "us", "min")}
    | dict.fromkeys(("sec", "second", "seconds"), 1.0),
}
_UNIT_CHOICES = {
    "speed": "rpm, rad/s, rev/s",
    "force": "N, kgf, gf, lbf",
    "pulse": "us, ms",
    "voltage": "V, mV",
    "time": "s, ms, us",
}
_KEYWORDS = {
    "speed": {"speed", "rpm", "omega", "rotation", "rotational", "shaft", "rev", "revs", "velocity"},
    "force": {"force", "thrust", "load", "loadcell"},
    "pulse": {"pwm", "pulse", "pulsewidth", "esc", "throttle", "signal"},
    "voltage": {"voltage", "battery", "volt", "volts", "supply", "vbat", "v"},
    "time": {"time", "t", "timestamp"},
}
_IMPLIED = {"rpm": ("speed", math.pi / 30.0), "pwm": ("pulse", 1.0)}
"""Words that say the unit too."""

EXAMPLES = {"force": "force (N)", "speed": "speed (rpm)"}
"""Headers that are recognised."""


class Source(NamedTuple):
    """Where a quantity is found."""

    column: int
    header: str
    factor: float
    """To rad/s, N, µs, V or s; NaN where the header names no unit."""


def find_columns(headers: list[str], used: list[bool], label: str) -> dict[str, Source]:
    """The column of every quantity that the table has.

    Args:
        headers: The header line's cells.
        used: Whether a column holds any number but zero; others are passed over.
        label: How messages call the table.

    Raises:
        CalibrationError: Two columns could be meant, or a unit is missing.
    """
    names = [header.strip() for header in headers]
    columns: dict[str, Source] = {}
    candidates: dict[str, list[Source]] = {}
    for column, header in enumerate(names):
        guess = _recognised(header)
        if guess is not None and used[column]:
            candidates.setdefault(guess[0], []).append(Source(column, header, guess[1]))
    for quantity, sources in candidates.items():
        if len(sources) > 1:
            with_unit = [source for source in sources if not math.isnan(source.factor)]
            sources = with_unit if len(with_unit) == 1 else sources
        if len(sources) > 1:
            listed = " or ".join(f"'{source.header}'" for source in sources)
            raise CalibrationError(
                f"{label}: {quantity} could be {listed}: rename the column that is not meant, or remove it"
            )
        columns[quantity] = sources[0]
    for quantity, source in columns.items():
        if math.isnan(source.factor):
            raise CalibrationError(
                f"{label}: column '{source.header}' has no unit: write it into the header, one of "
                f"{_UNIT_CHOICES[quantity]}, such as '{source.header} ({_UNIT_CHOICES[quantity].split(',')[0]})'"
            )
    return columns


def _recognised(header: str) -> tuple[str, float] | None:
    """Quantity and factor that a header names; the factor is NaN where it gives no unit."""
    label, unit = _split(header)
    tokens = set(re.findall(r"[a-z]+", label.lower()))
    for word, (quantity, factor) in _IMPLIED.items():
        if word in tokens and _plain(unit) in ("", word):
            return quantity, factor
    matches = [quantity for quantity, keywords in _KEYWORDS.items() if tokens & keywords]
    if unit:
        matches = [quantity for quantity in matches if _plain(unit) in _UNITS[quantity]]
        if not label and not matches:
            matches = [quantity for quantity in ("speed", "voltage") if _plain(unit) in _UNITS[quantity]]
        return (matches[0], _UNITS[matches[0]][_plain(unit)]) if len(matches) == 1 else None
    if len(matches) != 1:
        return None
    return matches[0], 1.0 if matches[0] in ("voltage", "time") else math.nan


def _split(header: str) -> tuple[str, str]:
    """Label and unit: `Force (Kg f)`, `Thrust [N]`, `speed_rpm`, `omega rad/s`, `RPM`."""
    text = header.strip()
    brackets = re.fullmatch(r"(.*?)[\s_]*[(\[{](.*)[)\]}]", text)
    if brackets:
        return brackets[1], brackets[2]
    all_units = {unit for units in _UNITS.values() for unit in units}
    parts = re.split(r"[\s_]+", text)
    for start in range(1, len(parts)):
        tail = "/".join(parts[start:]) if len(parts) - start == 2 else "".join(parts[start:])
        if _plain(tail) in all_units:
            return " ".join(parts[:start]), tail
    return text, ""


def _plain(unit: str) -> str:
    """Lower case, without spaces, with u for micro and / for per."""
    text = unit.strip().lower().replace("µ", "u").replace("μ", "u").replace("·", "").replace("^", "")
    return re.sub(r"\s+|\.", "", text.replace(" per ", "/")).replace("rad_s", "rad/s")


# The signs of speeds and forces in a table, and the zero of its load cell.

STANDING = 0.01
"""Share of the fastest speed below which a shaft counts as standing."""


def without_offset(full: dict[str, Array], has_speed: bool, neutral: float, findings: list[Finding]) -> Array:
    """Forces less the median reading at standstill."""
    force = full["force"]
    if has_speed:
        standing = np.abs(full["speed"]) <= STANDING * np.nanmax(np.abs(full["speed"]))
    else:
        standing = np.abs(full["pulse"] - neutral) <= 0.02 * neutral / 3.0
    if not np.any(standing):
        return force
    offset = float(np.median(force[standing]))
    if abs(offset) < 1e-3 * np.max(np.abs(force)):
        return force
    findings.append(finding("load_cell_offset", offset=offset))
    return force - offset


PLAUSIBLE = {
    "pulse": (500.0, 2500.0, "µs"),
    "speed": (-1e5, 1e5, "rad/s"),
    "force": (-1e6, 1e6, "N"),
    "voltage": (0.0, 1e4, "V"),
}
"""What a column of a table may hold: least, most, unit."""


def check_values(full: Mapping[str, Array], label: str) -> None:
    """Refuse numbers that cannot be what their column says.

    Args:
        full: Columns of `PLAUSIBLE`, (n,) each; NaN and 0 are passed over.
        label: Name of the table, for messages.

    Raises:
        CalibrationError: A number is beyond its limits.
    """
    for key, (least, greatest, unit) in PLAUSIBLE.items():
        values = full[key][np.isfinite(full[key]) & (full[key] != 0.0)]
        if values.size and (values.min() < least or values.max() > greatest):
            raise CalibrationError(
                f"{label}: {key}s run from {values.min():g} to {values.max():g} {unit}, expected {least:g} to "
                f"{greatest:g} {unit}: check the column's name and unit"
            )


def signed(
    full: dict[str, Array],
    has_speed: bool,
    neutral: float,
    sources: Mapping[str, Source],
    label: str,
    findings: list[Finding],
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Speed and force with the sign of rotation, and the rows whose sign is known."""
    speed, force, pulse = full["speed"], full["force"], full["pulse"]
    small = STANDING * np.max(np.abs(force))
    sign_pulse = np.sign(pulse - neutral) if np.any(np.isfinite(pulse)) else np.zeros_like(force)
    force_signed = bool(np.any(force > small) and np.any(force < -small))
    if sign_pulse.any() and np.nanmin(sign_pulse) < 0 < np.nanmax(sign_pulse) and not force_signed:
        findings.append(finding("force_sign", source="pulse"))
        force, force_signed = np.abs(force) * np.nan_to_num(sign_pulse), True
    if not has_speed:
        _same_way(sign_pulse, force, small, ("pulse", "force"), sources, label)
        return speed, force, np.ones(force.shape, bool)
    fastest = np.max(np.abs(speed))
    turning = np.abs(speed) > STANDING * fastest
    if np.any(speed < -STANDING * fastest) and np.any(speed > STANDING * fastest):
        if not force_signed and not sign_pulse.any():
            findings.append(finding("force_sign", source="speed"))
            force = np.abs(force) * np.sign(speed)
        _same_way(np.sign(speed) * turning, force, small, ("speed", "force"), sources, label)
        return speed, force, np.ones(force.shape, bool)
    sign = np.where(
        np.isfinite(sign_pulse) & (sign_pulse != 0.0), sign_pulse, np.sign(force) * (np.abs(force) > small)
    )
    if np.any(sign < 0.0):
        findings.append(finding("speed_sign"))
    if sign_pulse.any():
        _same_way(sign_pulse, force, small, ("pulse", "force"), sources, label)
    keep = ~turning | (sign != 0.0)
    if not keep.all():
        findings.append(finding("rows_unsigned", rows=np.count_nonzero(~keep)))
    return np.abs(speed) * np.where(turning, sign, 1.0), force, keep


def _same_way(
    sign: Array, force: Array, small: float, names: tuple[str, str], sources: Mapping[str, Source], label: str
) -> None:
    """Refuse a table in which most forces point against the speed or pulse."""
    clear = (np.abs(force) > 5.0 * small) & (np.nan_to_num(sign) != 0.0)
    against = np.count_nonzero(np.sign(force[clear]) != sign[clear])
    if against > 0.5 * np.count_nonzero(clear):
        header = sources[names[1]].header if names[1] in sources else names[1]
        raise CalibrationError(
            f"{label}: {names[1]} is negative where {names[0]} is positive: turn the sign of the "
            f"column '{header}'"
        )


QUANTITIES = ("speed", "force", "pulse", "voltage")
"""Columns of a `ThrustTable`."""


@dataclass(frozen=True, kw_only=True)
class ThrustTable:
    """Steady values of one thruster (or one type of thruster); NaN where a column or cell is missing."""

    name: str
    """Of the file or trial."""
    speed: Array
    """ω [rad/s], positive for positive thrust, (n,)."""
    force: Array
    """T [N], (n,)."""
    pulse: Array
    """[µs], (n,)."""
    voltage: Array
    """Of the battery [V], (n,)."""
    thruster: str | None = None
    """Name of the thruster, where the data say it."""
    sha256: str = ""
    """Digest of the numbers."""
    findings: tuple[Finding, ...] = ()
    """What was taken off, turned or left out."""

    def at(self, rows: NDArray[np.bool_]) -> ThrustTable:
        """The same table with some of its rows."""
        return replace(self, **{key: getattr(self, key)[rows] for key in QUANTITIES})


def read_table(path: str | os.PathLike[str], *, neutral: float = 1500.0) -> ThrustTable:
    """Read a table from a CSV file.

    Separators `, ; tab`, comment lines after `#`, and units in the headers (rpm, rad/s, N, kgf, lbf, g, ...) are
    understood, among them the headers that Blue Robotics publishes. Speeds and forces without sign get it from each
    other or from the pulse; of a log over time the last part of each level is used (see `last_parts`).

    Args:
        path: The file.
        neutral: Pulse at which the motor is off [µs], for signs.

    Raises:
        CalibrationError: Not a table of thrusts, or it can be read in two ways; the sentence says how to decide.
    """
    label = os.fspath(path)
    headers, rows = _cells(Path(path), label)
    used = [bool(np.any(np.nan_to_num(rows[:, i]) != 0.0)) for i in range(len(headers))]
    sources = find_columns(headers, used, label)
    missing = [
        quantities
        for quantities, need in (("force", {"force"}), ("speed or pulse", {"speed", "pulse"}))
        if not need & set(sources)
    ]
    if missing:
        raise CalibrationError(
            f"{label}: no column of {' and none of '.join(missing)} among {', '.join(h.strip() for h in headers)}: "
            f"rename one, such as '{EXAMPLES[missing[0].split()[0]]}' (columns of nothing but zeros are passed over)"
        )
    values = {quantity: rows[:, source.column] * source.factor for quantity, source in sources.items()}
    return _table(Path(path).stem, values, sources, label, neutral)


def tables_of_trial(
    trial: Trial, *, neutral: float = 1500.0, reversed_wiring: Collection[str] = ()
) -> list[ThrustTable]:
    """One table per thruster of a bench trial: columns `force_NAME` (measured) with `rpm_NAME` or `pwm_NAME`.

    Args:
        trial: Levels held for some seconds, or a slow sweep.
        neutral: Pulse at which the motor is off [µs].
        reversed_wiring: Names of the thrusters that push forward at small pulses; their pulses are mirrored.

    Raises:
        CalibrationError: No thruster has both.
    """
    tables = []
    for column in trial.channels:
        name = column.removeprefix("force_")
        inputs = {"speed": f"rpm_{name}", "pulse": f"pwm_{name}"}
        present = {key: col for key, col in inputs.items() if trial.has(col)}
        if name == column or not trial.has(column) or not present:
            continue
        times, force = trial.series(column)
        values = {"time": times, "force": force}
        for key, col in present.items():
            factor = math.pi / 30.0 if key == "speed" else 1.0
            values[key] = factor * np.interp(times, *trial.series(col))
        if name in reversed_wiring and "pulse" in values:
            values["pulse"] = 2.0 * neutral - values["pulse"]
        if trial.has("voltage"):
            values["voltage"] = np.interp(times, *trial.series("voltage"))
        elif trial.header.voltage is not None:
            values["voltage"] = np.full(times.shape, trial.header.voltage)
        sources = {
            key: Source(0, {"speed": f"rpm_{name}", "force": column}.get(key, key), 1.0) for key in values
        }
        table = _table(trial.name, values, sources, trial.name, neutral)
        tables.append(replace(table, thruster=name, sha256=trial.sha256))
    if not tables:
        raise CalibrationError(
            f"{trial.name}: no thruster has a column force_NAME beside rpm_NAME or pwm_NAME: a bench trial needs the "
            "measured thrust and what drove it"
        )
    return tables


def _table(
    name: str,
    values: dict[str, Array],
    sources: Mapping[str, Source],
    label: str,
    neutral: float,
) -> ThrustTable:
    """Steady rows, with signs and without the load cell's offset."""
    findings: list[Finding] = []
    if "time" in values:
        values, remark = last_parts(values)
        findings.append(remark)
    count = len(values["force"])
    full = {key: values.get(key, np.full(count, np.nan)) for key in QUANTITIES}
    has_speed = "speed" in values
    good = np.isfinite(full["force"]) & np.isfinite(full["speed"] if has_speed else full["pulse"])
    if np.count_nonzero(good) < 3:
        raise CalibrationError(f"{label}: {np.count_nonzero(good)} rows hold numbers, expected at least 3")
    full = {key: value[good] for key, value in full.items()}
    check_values(full, label)
    full["force"] = without_offset(full, has_speed, neutral, findings)
    full["speed"], full["force"], keep = signed(full, has_speed, neutral, sources, label, findings)
    columns: dict[str, Any] = {key: value[keep] for key, value in full.items()}
    numbers = (np.ascontiguousarray(columns[key] + 0.0).tobytes() for key in sorted(columns))
    digest = hashlib.sha256(b"".join(numbers))
    return ThrustTable(name=name, **columns, sha256=digest.hexdigest(), findings=tuple(findings))


def _cells(path: Path, label: str) -> tuple[list[str], Array]:
    """Headers and numbers of a file; a second header line of units is joined to the first."""
    table = read_text_table(path, CalibrationError)
    headers, rows = table.names, table.rows
    if not rows:
        raise CalibrationError(f"{label}: no rows below a header line: give a CSV table of speeds and forces")
    if not any(math.isnan(_number(table, cell)) for cell in headers):
        raise CalibrationError(
            f"{label}: the first line holds numbers, expected a header line that names the columns"
        )
    if all(math.isnan(_number(table, cell)) for cell in rows[0]):
        units = [unit.strip(" ()[]") for unit in rows.pop(0)][: len(headers)]
        headers = [f"{h} ({u})" if u else h for h, u in zip_longest(headers, units, fillvalue="")]
    width = len(headers)
    numbers = [[_number(table, cell) for cell in (row + [""] * width)[:width]] for row in rows]
    return headers, np.array(numbers, dtype=np.float64).reshape(-1, width)


def _number(table: TextTable, cell: str) -> float:
    value = table.number(cell)
    return math.nan if value is None else value
