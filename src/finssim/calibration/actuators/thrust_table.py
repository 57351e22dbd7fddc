"""Tables of thrust against shaft speed and pulse width: from the manufacturer or from one's own bench."""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from itertools import zip_longest
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.actuators.steps import last_parts
from finssim.calibration.actuators.table_columns import Source, find_columns
from finssim.calibration.actuators.table_signs import check_pulses, signed, without_offset
from finssim.calibration.errors import CalibrationError
from finssim.calibration.findings import Finding
from finssim.calibration.trials.trial import Trial
from finssim.text_table import TextTable, read_text_table

__all__ = ["ThrustTable", "read_table", "tables_of_trial"]

Array = NDArray[np.float64]


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
        columns = {key: getattr(self, key)[rows] for key in ("speed", "force", "pulse", "voltage")}
        return replace(self, **columns)


def read_table(
    path: str | os.PathLike[str], *, columns: Mapping[str, str] | None = None, neutral: float = 1500.0
) -> ThrustTable:
    """Read a table from a CSV file.

    Separators `, ; tab`, comment lines after `#`, and units in the headers (rpm, rad/s, N, kgf, lbf, g, ...) are
    understood, among them the headers that Blue Robotics publishes. Speeds and forces without sign get it from each
    other or from the pulse; of a log over time the last part of each level is used (see `last_parts`).

    Args:
        path: The file.
        columns: Quantity (speed force pulse voltage time) -> `COLUMN`, `COLUMN=UNIT` or `-COLUMN` (sign turned), for
            what the headers do not tell.
        neutral: Pulse at which the motor is off [µs], for signs.

    Raises:
        CalibrationError: Not a table of thrusts, or it can be read in two ways; the sentence says how to decide.
    """
    shown = os.fspath(path)
    headers, rows = _cells(Path(path), shown)
    used = [bool(np.any(np.nan_to_num(rows[:, i]) != 0.0)) for i in range(len(headers))]
    sources = find_columns(headers, used, columns, shown)
    missing = [
        what
        for what, need in (("force", {"force"}), ("speed or pulse", {"speed", "pulse"}))
        if not need & set(sources)
    ]
    if missing:
        raise CalibrationError(
            f"{shown}: no column of {' and none of '.join(missing)} among {', '.join(h.strip() for h in headers)}: "
            f"name it, such as {missing[0].split()[0]}=COLUMN=UNIT (columns of nothing but zeros are passed over)"
        )
    values = {quantity: rows[:, source.column] * source.factor for quantity, source in sources.items()}
    return _table(Path(path).stem, values, sources, shown, neutral)


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
    shown: str,
    neutral: float,
) -> ThrustTable:
    """Steady rows, with signs and without the load cell's offset."""
    findings: list[Finding] = []
    if "time" in values:
        values, kept = last_parts(values)
        findings.append(kept)
    count = len(values["force"])
    full = {key: values.get(key, np.full(count, np.nan)) for key in ("speed", "force", "pulse", "voltage")}
    speed_known = "speed" in values
    good = np.isfinite(full["force"]) & np.isfinite(full["speed"] if speed_known else full["pulse"])
    if np.count_nonzero(good) < 3:
        raise CalibrationError(f"{shown}: {np.count_nonzero(good)} rows hold numbers, expected at least 3")
    full = {key: value[good] for key, value in full.items()}
    full["force"] = without_offset(full, speed_known, neutral, findings)
    check_pulses(full["pulse"], shown)
    full["speed"], full["force"], keep = signed(full, speed_known, neutral, sources, shown, findings)
    full = {key: value[keep] for key, value in full.items()}
    digest = hashlib.sha256(b"".join(np.ascontiguousarray(full[key] + 0.0).tobytes() for key in sorted(full)))
    return ThrustTable(
        name=name,
        speed=full["speed"],
        force=full["force"],
        pulse=full["pulse"],
        voltage=full["voltage"],
        sha256=digest.hexdigest(),
        findings=tuple(findings),
    )


def _cells(path: Path, shown: str) -> tuple[list[str], Array]:
    """Headers and numbers of a file; a second header line of units is joined to the first."""
    table = read_text_table(path, CalibrationError)
    headers, rows = table.names, table.rows
    if not rows:
        raise CalibrationError(f"{shown}: no rows below a header line: give a CSV table of speeds and forces")
    if not any(math.isnan(_number(table, cell)) for cell in headers):
        raise CalibrationError(
            f"{shown}: the first line holds numbers, expected a header line that names the columns"
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
