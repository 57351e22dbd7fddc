"""Tables of thrust, shaft speed and pulse width, as written by test benches and manufacturers."""

from __future__ import annotations

import hashlib
import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from finssim.bench.levels import settled_rows
from finssim.core.text_table import read_text_table
from finssim.core.yaml_file import read_mapping
from finssim.trials.conversion import UNITS
from finssim.trials.findings import CalibrationError, Finding, finding

__all__ = ["ThrustTable", "read_table"]

Array = NDArray[np.float64]

_KNOWN = read_mapping(Path(__file__).with_name("quantities.yaml"), CalibrationError, such_as="force: {}")
"""Quantity of a column -> words and units of its header, and its plausible range."""
_UNITS = {
    quantity: {
        word: UNITS[known["dimension"]][unit] if "dimension" in known else float(unit)
        for unit, words in known["units"].items()
        for word in words
    }
    for quantity, known in _KNOWN.items()
}
"""Quantity -> unit, as normalized by `_plain` -> factor to rad/s, N, µs, V or s."""
_IMPLIED = {"rpm": ("speed", UNITS["rate"]["rpm"]), "pwm": ("pulse", 1.0)}
"""Word that implies its unit -> quantity and factor."""


def _recognised(header: str) -> tuple[str, float] | None:
    """Return the quantity named by a header such as `Force (Kg f)`, `speed_rpm` or `omega rad/s`, and its factor.

    The factor is NaN if the header has no unit.
    """
    text, unit = header.strip(), ""
    if brackets := re.fullmatch(r"(.*?)[\s_]*[(\[{](.*)[)\]}]", text):
        text, unit = brackets[1], _plain(brackets[2])
    elif tail := re.fullmatch(r"(.+)[\s_]+([^\s_]+)", re.sub(r"rad_s$", "rad/s", text)):
        if any(_plain(tail[2]) in units for units in _UNITS.values()):
            text, unit = tail[1], _plain(tail[2])
    words = set(re.findall(r"[a-z]+", text.lower()))
    for word, implied in _IMPLIED.items():
        if word in words and unit in ("", word):
            return implied
    matches = [name for name, known in _KNOWN.items() if words & set(known["words"])]
    if not unit:
        fixed = 1.0 if matches in (["voltage"], ["time"]) else math.nan
        return (matches[0], fixed) if len(matches) == 1 else None
    matches = [name for name in matches if unit in _UNITS[name]]
    return (matches[0], _UNITS[matches[0]][unit]) if len(matches) == 1 else None


def _plain(unit: str) -> str:
    """Return a unit in lower case without spaces, with u for micro and / for per."""
    text = unit.strip().lower().replace("µ", "u").replace("μ", "u").replace(" per ", "/")
    return re.sub(r"[\s.·^]+", "", text)


def _columns(headers: Sequence[str], rows: Array, label: str) -> dict[str, tuple[str, Array]]:
    """Return header and values in SI of every quantity that a table has; columns of zeros are ignored."""
    columns: dict[str, list[tuple[str, float, Array]]] = {}
    for header, values in zip(headers, rows.T, strict=True):
        guess = _recognised(header)
        if guess is not None and np.any(np.nan_to_num(values) != 0.0):
            columns.setdefault(guess[0], []).append((header.strip(), guess[1], values))
    out = {}
    for quantity, candidates in columns.items():
        clear = [one for one in candidates if not math.isnan(one[1])]
        candidates = clear if len(clear) == 1 else candidates
        header, factor, values = candidates[0]
        if len(candidates) > 1:
            listed = " or ".join(f"'{one[0]}'" for one in candidates)
            raise CalibrationError(
                f"{label}: {quantity} could be {listed}: rename the column that is not meant, or remove it"
            )
        if math.isnan(factor):
            choices = _KNOWN[quantity]["choices"]
            raise CalibrationError(
                f"{label}: column '{header}' has no unit: write it into the header, one of {choices}, such as "
                f"'{header} ({choices.split(',')[0]})'"
            )
        out[quantity] = header, values * factor
    for need, example in ((("force",), "force (N)"), (("speed", "pulse"), "speed (rpm)")):
        if not set(need) & set(out):
            raise CalibrationError(
                f"{label}: no column of {' or '.join(need)} among {', '.join(h.strip() for h in headers)}: rename one, "
                f"such as '{example}' (columns of nothing but zeros are passed over)"
            )
    return out


STANDING = 0.01
"""Fraction of the greatest speed below which a shaft counts as at standstill [-]."""
QUANTITIES = ("pulse", "speed", "force", "voltage")
"""Columns of a `ThrustTable`."""


@dataclass(frozen=True, kw_only=True)
class ThrustTable:
    """Steady values of one thruster (or one type of thruster); NaN where a column or cell is missing."""

    name: str
    """Name of the file."""
    speed: Array
    """Shaft speed ω, positive for positive thrust [rad/s], (n,)."""
    force: Array
    """Thrust T [N], (n,)."""
    pulse: Array
    """Pulse width [µs], (n,)."""
    voltage: Array
    """Voltage of the battery [V], (n,)."""
    sha256: str = ""
    """SHA-256 of the numbers."""
    findings: tuple[Finding, ...] = ()
    """Findings on offsets, signs and rows that were changed or left out."""

    def at(self, rows: NDArray[np.bool_]) -> ThrustTable:
        """Return the table with some of its rows."""
        return replace(self, **{key: getattr(self, key)[rows] for key in QUANTITIES})


def read_table(path: str | os.PathLike[str], *, neutral: float = 1500.0) -> ThrustTable:
    """Read a table of thrusts from a CSV file.

    Separators are `,`, `;` or tabs, comment lines begin with `#`, and headers contain the units (rpm, rad/s,
    N, kgf, lbf, g, ...), as in the files that Blue Robotics publishes. Unsigned speeds and forces get their
    sign from each other or from the pulse. In a log over time, the last part of each level is used (see
    `settled_rows`).

    Args:
        path: The file.
        neutral: Pulse at which the motor is off [µs], for signs.

    Raises:
        CalibrationError: The file is not a table of thrusts, or it is ambiguous.
    """
    label, findings = os.fspath(path), list[Finding]()
    columns = _columns(*_cells(Path(path), label), label)
    values = {quantity: column for quantity, (_, column) in columns.items()}
    if "time" in values:
        values, remark = settled_rows(values)
        findings.append(remark)
    full = {key: values.get(key, np.full(len(values["force"]), np.nan)) for key in QUANTITIES}
    good = np.isfinite(full["force"]) & np.isfinite(full["speed" if "speed" in values else "pulse"])
    if np.count_nonzero(good) < 3:
        raise CalibrationError(f"{label}: {np.count_nonzero(good)} rows hold numbers, expected at least 3")
    full = {key: value[good] for key, value in full.items()}
    for key in QUANTITIES:
        least, greatest, unit = _KNOWN[key]["range"]
        nonzero = full[key][np.isfinite(full[key]) & (full[key] != 0.0)]
        if nonzero.size and (nonzero.min() < least or nonzero.max() > greatest):
            raise CalibrationError(
                f"{label}: {key}s run from {nonzero.min():g} to {nonzero.max():g} {unit}, expected {least:g} to "
                f"{greatest:g} {unit}: check the column's name and unit"
            )
    full["force"] = _without_offset(full, neutral, findings)
    full = _signed(full, neutral, columns["force"][0], label, findings)
    digest = hashlib.sha256(b"".join(np.ascontiguousarray(full[key] + 0.0).tobytes() for key in sorted(full)))
    return ThrustTable(name=Path(path).stem, **full, sha256=digest.hexdigest(), findings=tuple(findings))


def _cells(path: Path, label: str) -> tuple[list[str], Array]:
    """Return the headers and numbers of a file; a second line of units is joined to the headers."""
    table = read_text_table(path, CalibrationError)
    headers, rows = table.names, table.rows

    def number(cell: str) -> float:
        value = table.number(cell)
        return math.nan if value is None else value

    if not rows:
        raise CalibrationError(f"{label}: no rows below a header line: give a CSV table of speeds and forces")
    if not any(math.isnan(number(cell)) for cell in headers):
        raise CalibrationError(
            f"{label}: the first line holds numbers, expected a header line that names the columns"
        )
    if all(math.isnan(number(cell)) for cell in rows[0]):
        units = [unit.strip(" ()[]") for unit in rows.pop(0)][: len(headers)]
        headers = [f"{h} ({u})" if u else h for h, u in zip_longest(headers, units, fillvalue="")]
    width = len(headers)
    numbers = [[number(cell) for cell in (row + [""] * width)[:width]] for row in rows]
    return headers, np.array(numbers, dtype=np.float64).reshape(-1, width)


def _without_offset(full: Mapping[str, Array], neutral: float, findings: list[Finding]) -> Array:
    """Return the forces minus the median reading at standstill."""
    force, speed = full["force"], np.abs(full["speed"])
    if np.isfinite(speed).any():
        standing = speed <= STANDING * np.nanmax(speed)
    else:
        standing = np.abs(full["pulse"] - neutral) <= 0.02 * neutral / 3.0
    offset = float(np.median(force[standing])) if standing.any() else 0.0
    if abs(offset) < 1e-3 * np.max(np.abs(force)):
        return force
    findings.append(finding("load_cell_offset", offset=offset))
    return force - offset


def _signed(
    full: Mapping[str, Array], neutral: float, header: str, label: str, findings: list[Finding]
) -> dict[str, Array]:
    """Return the rows whose direction of rotation is known, with signed speeds and forces.

    The direction comes from the first of speed, pulse and force that has both signs, otherwise from pulse or force.
    """
    speed, force = full["speed"], full["force"]
    small = STANDING * np.max(np.abs(force))
    turning = np.abs(speed) > STANDING * np.max(np.abs(speed))
    signs = {
        "speed": np.sign(speed) * turning,
        "pulse": np.nan_to_num(np.sign(full["pulse"] - neutral)),
        "force": np.sign(force) * (np.abs(force) > small),
    }
    both = [name for name, sign in signs.items() if sign.min() < 0.0 < sign.max()]
    source = (both or [name for name in ("pulse", "force") if signs[name].any()] or ["force"])[0]
    direction, keep = signs[source], np.ones(len(force), bool)
    if source in both and "force" not in both:
        findings.append(finding("force_sign", source=source))
        force = np.abs(force) * direction
    elif source == "pulse":  # a cell may be empty
        direction = np.where(direction != 0.0, direction, signs["force"])
    clear = (np.abs(force) > 5.0 * small) & (direction != 0.0)
    if np.count_nonzero(np.sign(force[clear]) != direction[clear]) > 0.5 * np.count_nonzero(clear):
        raise CalibrationError(
            f"{label}: force is negative where {source} is positive: turn the sign of the column '{header}'"
        )
    if source != "speed" and np.isfinite(speed).all():
        if np.any(direction < 0.0):
            findings.append(finding("speed_sign"))
        keep = ~turning | (direction != 0.0)
        if not keep.all():
            findings.append(finding("rows_unsigned", rows=np.count_nonzero(~keep)))
        speed = np.abs(speed) * np.where(turning, direction, 1.0)
    return {key: value[keep] for key, value in {**full, "speed": speed, "force": force}.items()}
