"""From tables of a bench to the thrust curve, dead zone, limits and speed controller of a vehicle's thrusters."""

from __future__ import annotations

import hashlib
import math
import os
import re
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.findings import CalibrationError, Finding, finding, sentences
from finssim.calibration.fit import Curve, Estimate, Fit
from finssim.calibration.report import finish, refuse_places
from finssim.calibration.trials.conversion import UNITS
from finssim.calibration.uncertainty import Evidence, correlated_samples, intervals, trial_covariance
from finssim.text_table import read_text_table
from finssim.vehicles import Esc, Vehicle, load_vehicle
from finssim.vehicles.thruster import Thruster

__all__ = ["dead_zone", "find_steps", "fit_esc", "fit_side", "fit_thruster", "jackknife", "read_table"]

Array = NDArray[np.float64]

# Levels of a log over time.

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


# Tables: which column holds what, in which unit, and with which sign.

_N, _RATE = UNITS["force"], UNITS["rate"]
_UNITS: dict[str, dict[str, float]] = {
    "speed": {
        **dict.fromkeys(("rpm", "1/min", "rev/min", "r/min"), _RATE["rpm"]),
        **dict.fromkeys(("rad/s", "rads", "radps"), 1.0),
        **dict.fromkeys(("rps", "rev/s", "1/s", "hz"), _RATE["rps"]),
    },
    "force": {
        **dict.fromkeys(("n", "newton", "newtons"), 1.0),
        **dict.fromkeys(("kgf", "kg", "kp"), _N["kgf"]),
        **dict.fromkeys(("gf", "g", "gram", "grams"), _N["gf"]),
        **dict.fromkeys(("lbf", "lb", "lbs"), _N["lbf"]),
    },
    "pulse": {"us": 1.0, "usec": 1.0, "ms": 1e3},
    "voltage": {"v": 1.0, "volt": 1.0, "volts": 1.0, "mv": 1e-3},
    "time": {"s": 1.0, "sec": 1.0, "second": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0},
}
"""Quantity -> unit, as `_plain` writes it -> rad/s, N, µs, V or s in one of it."""
_CHOICES = {"speed": "rpm, rad/s, rev/s", "force": "N, kgf, gf, lbf", "pulse": "us, ms"}
_KEYWORDS = {
    "speed": {"speed", "rpm", "omega", "rotation", "rotational", "shaft", "rev", "revs", "velocity"},
    "force": {"force", "thrust", "load", "loadcell"},
    "pulse": {"pwm", "pulse", "pulsewidth", "esc", "throttle", "signal"},
    "voltage": {"voltage", "battery", "volt", "volts", "supply", "vbat", "v"},
    "time": {"time", "t", "timestamp"},
}
_IMPLIED = {"rpm": ("speed", _RATE["rpm"]), "pwm": ("pulse", 1.0)}
"""Words that say the unit too."""


def _recognised(header: str) -> tuple[str, float] | None:
    """Quantity and factor that a header names, as `Force (Kg f)`, `Thrust [N]`, `speed_rpm`, `omega rad/s`, `RPM`.

    The factor is NaN where it gives no unit.
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
    matches = [name for name, keywords in _KEYWORDS.items() if words & keywords]
    if not unit:
        fixed = 1.0 if matches in (["voltage"], ["time"]) else math.nan
        return (matches[0], fixed) if len(matches) == 1 else None
    matches = [name for name in matches if unit in _UNITS[name]]
    return (matches[0], _UNITS[matches[0]][unit]) if len(matches) == 1 else None


def _plain(unit: str) -> str:
    """Lower case, without spaces, with u for micro and / for per."""
    text = unit.strip().lower().replace("µ", "u").replace("μ", "u").replace(" per ", "/")
    return re.sub(r"[\s.·^]+", "", text)


def _columns(headers: Sequence[str], rows: Array, label: str) -> dict[str, tuple[str, Array]]:
    """Header and values in our units of every quantity that a table has; columns of zeros are passed over."""
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
            choices = _CHOICES[quantity]
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
"""Share of the fastest speed below which a shaft counts as standing."""
PLAUSIBLE = {
    "pulse": (500.0, 2500.0, "µs"),
    "speed": (-1e5, 1e5, "rad/s"),
    "force": (-1e6, 1e6, "N"),
    "voltage": (0.0, 1e4, "V"),
}
"""What a column of a table may hold: least, most, unit; NaN and 0 are passed over."""
QUANTITIES = tuple(PLAUSIBLE)
"""Columns of a `ThrustTable`."""


@dataclass(frozen=True, kw_only=True)
class ThrustTable:
    """Steady values of one thruster (or one type of thruster); NaN where a column or cell is missing."""

    name: str
    """Of the file."""
    speed: Array
    """ω [rad/s], positive for positive thrust, (n,)."""
    force: Array
    """T [N], (n,)."""
    pulse: Array
    """[µs], (n,)."""
    voltage: Array
    """Of the battery [V], (n,)."""
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
    label, findings = os.fspath(path), list[Finding]()
    columns = _columns(*_cells(Path(path), label), label)
    values = {quantity: column for quantity, (_, column) in columns.items()}
    if "time" in values:
        values, remark = last_parts(values)
        findings.append(remark)
    full = {key: values.get(key, np.full(len(values["force"]), np.nan)) for key in QUANTITIES}
    good = np.isfinite(full["force"]) & np.isfinite(full["speed" if "speed" in values else "pulse"])
    if np.count_nonzero(good) < 3:
        raise CalibrationError(f"{label}: {np.count_nonzero(good)} rows hold numbers, expected at least 3")
    full = {key: value[good] for key, value in full.items()}
    for key, (least, greatest, unit) in PLAUSIBLE.items():
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
    """Headers and numbers of a file; a second header line of units is joined to the first."""
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
    """Forces less the median reading at standstill."""
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
    """The rows whose direction of rotation is known, with its sign in speed and force.

    The direction is that of the first of speed, pulse and force that has both signs, else of pulse or force.
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


# The thrust curve and the dead zone.

BLOCKS = 10
"""Parts of equal weight that a table is cut into for intervals."""
OUTLIER = 6.0
"""Scaled median deviations beyond which a row is left out, if it is also off by `COARSE` of the largest force."""
COARSE = 0.05


@dataclass(frozen=True, kw_only=True)
class Side:
    """c of one direction of rotation."""

    c: float
    """T = c ω², [N s²/rad²]."""
    half_width: float
    """Of the 95 % interval; infinite from a single row."""
    r2: float
    """Share of the variance of the forces of this direction that the curve explains."""
    rmse: float
    """[N]"""
    samples: int
    rejected: int


def fit_side(tables: Sequence[tuple[Array, Array]]) -> Side | None:
    """Least squares of |T| = c ω² (paper, eq. 16) over one direction of rotation.

    The residuals of real tables are not noise but the curve's own misfit, alike in neighbouring rows. The interval is
    the widest of three (`finssim.calibration.uncertainty`): from the disagreement of blocks of neighbouring speeds,
    from that of several tables, and from the rows that count as independent.

    Args:
        tables: Speed |ω| [rad/s] and thrust along this direction [N] of the turning rows, (n,) each, per table.

    Returns:
        None where there is no row.
    """
    tables = [(w, f) for w, f in tables if len(w)]
    if not tables:
        return None
    square, force = np.concatenate([w**2 for w, _ in tables]), np.concatenate([f for _, f in tables])
    keep = np.ones(len(square), bool)
    for _ in range(5):
        c = _slope(square[keep], force[keep])
        error = np.abs(force - c * square)
        limit = max(OUTLIER * 1.4826 * float(np.median(error)), COARSE * float(np.max(np.abs(force))))
        if np.array_equal(keep, error <= limit):
            break
        keep = error <= limit
    owner = np.concatenate([np.full(len(w), i) for i, (w, _) in enumerate(tables)])
    rows = [keep & (owner == i) for i in range(len(tables))]
    half_width = _half_width([(square[row], force[row] - c * square[row]) for row in rows if row.any()])
    error = force[keep] - c * square[keep]
    total = float(np.sum((force[keep] - np.mean(force[keep])) ** 2))
    return Side(
        c=c,
        half_width=float(half_width),
        r2=1.0 - float(error @ error) / total if total > 0.0 else float("nan"),
        rmse=float(np.sqrt(np.mean(error**2))),
        samples=int(np.count_nonzero(keep)),
        rejected=int(np.count_nonzero(~keep)),
    )


def jackknife(estimates: Array) -> Array:
    """Half-widths of 95 % intervals from estimates that each leave one of G blocks out, (G, P) -> (P,)."""
    G = len(estimates)
    deviation = estimates - np.mean(estimates, axis=0)
    return t_quantile(G - 1) * np.sqrt((G - 1) / G * np.sum(deviation**2, axis=0))


def t_quantile(dof: int) -> float:
    """97.5 % point of Student's t."""
    from scipy.stats import t  # SciPy is slow to import

    return float(t.ppf(0.975, dof))


def _slope(square: Array, force: Array) -> float:
    return float(square @ force / (square @ square))


def _blocks(square: Array, force: Array) -> list[tuple[Array, Array]]:
    """Neighbouring speeds in at most `BLOCKS` parts of about equal Σ ω⁴; of a short table every row."""
    if square.size == 0:
        return []
    order = np.argsort(square)
    square, force = square[order], force[order]
    if len(square) < 2 * BLOCKS:
        return [(square[i : i + 1], force[i : i + 1]) for i in range(len(square))]
    share = (np.cumsum(square**2) - 0.5 * square**2) / np.sum(square**2)
    label = np.minimum(share * BLOCKS, BLOCKS - 1).astype(int)
    return [(square[label == i], force[label == i]) for i in np.unique(label)]


def _half_width(tables: Sequence[tuple[Array, Array]]) -> float:
    """Of the 95 % interval of c, from ω² and residuals of each table; infinite for a single row."""
    ordered = [(x[np.argsort(x)], error[np.argsort(x)]) for x, error in tables]
    errors = [error for _, error in ordered]
    rows = sum(map(len, errors))
    if rows < 2:
        return math.inf
    breaks = np.cumsum([len(error) for error in errors])[:-1].tolist()
    correlated = correlated_samples(np.concatenate(errors), breaks)
    least = 1e-26 * float(sum(x @ x for x, _ in ordered)) / rows  # of an exact curve
    variance = float(sum(error @ error for error in errors)) / (rows - 1) * correlated + least
    widths = []
    for groups in ([part for table in ordered for part in _blocks(*table)], ordered):
        evidence = Evidence(
            names=("c",),
            normal=np.array([[[x @ x / variance]] for x, _ in groups]),
            score=np.array([[x @ error / variance] for x, error in groups]),
            unit="blocks",
        )
        covariance = trial_covariance(evidence)
        widths.append(float(intervals(np.zeros(1), covariance)[0, 1]))
    independent = t_quantile(max(int(rows / correlated) - 1, 1)) * math.sqrt(float(covariance.local[0, 0]))
    return max(*widths, independent)


@dataclass(frozen=True, kw_only=True)
class DeadZone:
    """The slowest speed of one direction that turns the shaft [rad/s, >= 0]."""

    speed: float
    interval: tuple[float, float]
    measured: bool
    """Whether the table shows a gap; otherwise `speed` is 0 and the interval ends at the slowest speed seen."""
    note: str = ""


def dead_zone(speed: Array) -> DeadZone | None:
    """The gap between standstill and the slowest turning shaft.

    It shows only where the table goes down to standstill and the gap is more than three times the distance between the
    speeds above it; otherwise the speeds in between were not tried.

    Args:
        speed: Along one direction [rad/s]; standing rows near 0, (n,).

    Returns:
        None where nothing turns.
    """
    fastest = float(np.max(speed, initial=0.0))
    turning = np.sort(speed[speed > STANDING * fastest])
    if fastest <= 0.0 or turning.size < 2:
        return None
    slowest = float(turning[0])
    standing = speed[np.abs(speed) <= STANDING * fastest]
    if standing.size == 0:
        note = "the table holds no standstill: its slowest speed is an upper limit"
        return DeadZone(speed=0.0, interval=(0.0, slowest), measured=False, note=note)
    gap, spacing = slowest - float(np.max(standing)), float(np.median(np.diff(turning[:8])))
    if gap <= 3.0 * spacing:
        note = "speeds between standstill and the slowest were not tried"
        return DeadZone(speed=0.0, interval=(0.0, slowest), measured=False, note=note)
    return DeadZone(speed=slowest, interval=(max(slowest - 2.0 * spacing, 0.0), slowest), measured=True)


# The law between pulse width, battery voltage and shaft speed, fitted to tables.

PULSE_BLOCKS = 8
"""Parts that the pulses of a direction are cut into for intervals."""
LEAST_ROWS = 5
"""Turning rows per direction from which the law is fitted."""


@dataclass(frozen=True, kw_only=True)
class EscFit:
    """A fitted speed controller."""

    esc: Esc
    intervals: dict[str, tuple[float, float]]
    """95 %, of every fitted field of `esc`."""
    rmse: float
    """Of the speed [rad/s]."""
    fastest: float
    """Fastest speed among the rows [rad/s]."""
    unsure: dict[str, str]
    """Field -> why the data do not determine it."""


def fit_esc(
    pulse: Array,
    speed: Array,
    voltage: Array,
    *,
    pulse_range: tuple[float, float, float],
    weight: Array | None = None,
    at: float | None = None,
) -> EscFit:
    """Fit `finssim.vehicles.Esc` by least squares of the shaft speed, each direction by itself.

    Args:
        pulse: [µs], (n,).
        speed: Steady shaft speed [rad/s], of the sign of pulse - neutral, 0 where the shaft stands, (n,).
        voltage: Of the battery [V], (n,).
        pulse_range: Full reverse, neutral, full forward [µs].
        weight: Of the rows' speeds, (n,); 1 where not given.
        at: Voltage for which the dead band is told [V]; the mean where not given.

    Raises:
        CalibrationError: A direction has too few turning rows, or the shaft turns against the pulse.
    """
    low, neutral, high = pulse_range
    volts = float(np.mean(voltage)) if at is None else at
    weight = np.ones_like(speed) if weight is None else weight
    numbers: dict[str, float] = {}
    intervals: dict[str, tuple[float, float]] = {}
    unsure: dict[str, str] = {}
    for name, sign, span in (("minus", -1, neutral - low), ("plus", 1, high - neutral)):
        side = sign * (pulse - neutral) > 0.0
        throw, omega = sign * (pulse[side] - neutral), sign * speed[side]
        turning = np.abs(omega) > STANDING * np.max(np.abs(omega), initial=0.0)
        _check(omega[turning], name)
        near = np.abs(voltage[side] - volts) <= 0.05 * volts
        edge, edge_interval, note = _edge(throw, turning, near if np.any(near & turning) else near | True)
        if note:
            unsure[f"dead_{name}"] = note
        law = (throw[turning] / span, voltage[side][turning], omega[turning], weight[side][turning])
        zero, emf, load = _law(*law, edge / span)
        label = np.argsort(np.argsort(law[0], kind="stable")) * PULSE_BLOCKS // len(law[0])
        jackknifed = [
            _law(*(column[label != i] for column in law), edge / span)
            for i in range(PULSE_BLOCKS)
            if np.any(label == i)
        ]
        half = jackknife(np.array(jackknifed))
        numbers |= {f"dead_{name}": neutral + sign * edge, f"zero_{name}": neutral + sign * span * zero}
        numbers |= {f"emf_{name}": emf, f"load_{name}": load}
        ends = sorted(neutral + sign * x for x in edge_interval)
        intervals[f"dead_{name}"] = (ends[0], ends[1])
        for key, value, width, ceiling in (
            ("zero", zero, span * half[0], edge / span),
            ("emf", emf, half[1], np.inf),
            ("load", load, half[2], np.inf),
        ):
            intervals[f"{key}_{name}"] = _around(numbers[f"{key}_{name}"], width)
            if value <= 1e-9 or value >= ceiling * (1.0 - 1e-9):
                unsure[f"{key}_{name}"] = "rests on a bound of the law"
    esc = Esc(pulse_neutral=neutral, pulse_min=low, pulse_max=high, voltage=volts, **numbers)
    error = esc.shaft_speed(pulse, voltage) - speed
    both = (speed != 0.0) & (esc.shaft_speed(pulse, voltage) != 0.0)
    return EscFit(
        esc=esc,
        intervals=intervals,
        rmse=float(np.sqrt(np.mean(error[both] ** 2))),
        fastest=float(np.max(np.abs(speed))),
        unsure=unsure,
    )


def _check(omega: Array, name: str) -> None:
    direction = {"minus": "below", "plus": "above"}[name]
    if omega.size < LEAST_ROWS:
        raise CalibrationError(
            f"{omega.size} rows turn the shaft at pulses {direction} neutral, expected at least {LEAST_ROWS}: "
            "add rows, or leave the pulse column out to fit the thrust curve alone"
        )
    if np.count_nonzero(omega < 0.0) > 0.5 * omega.size:
        raise CalibrationError(
            f"the shaft turns backwards at pulses {direction} neutral: turn the sign of the pulse's thruster or of "
            "speed and force in the table"
        )


def _edge(
    throw: Array, turning: NDArray[np.bool_], near: NDArray[np.bool_]
) -> tuple[float, tuple[float, float], str]:
    """Pulse from neutral at which the shaft starts [µs], its interval, and why it is not known."""

    first = float(np.min(throw[turning & near]))
    standing = throw[~turning & near & (throw < first)]
    if standing.size == 0:
        return first, (0.0, first), "the table holds no pulse that leaves the shaft standing"
    last = float(np.max(standing))
    return 0.5 * (last + first), (last, first), ""


def _law(duty: Array, volts: Array, omega: Array, weight: Array, edge: float) -> tuple[float, float, float]:
    """zero, emf and load of (duty - zero) V = emf ω + load ω² with 0 <= zero <= edge."""
    from scipy.optimize import least_squares, nnls  # SciPy is slow to import

    # Linear in the parameters where the balance of voltages is the residual: the start of the search in speed.
    rows = np.column_stack([omega, omega**2, volts])
    start, _ = nnls(rows, duty * volts)
    scale = np.array([max(edge, 1e-3), float(np.median(volts / omega)), float(np.median(volts / omega**2))])
    first = np.clip(
        [min(start[2], 0.9 * edge), start[0], start[1]], 1e-3 * scale, [max(edge, 1e-3), np.inf, np.inf]
    )
    solution = least_squares(
        partial(_residual, duty=duty, volts=volts, omega=omega, weight=weight),
        first,
        bounds=([0.0, 0.0, 0.0], [max(edge, 2e-3), np.inf, np.inf]),
        x_scale=scale,
    )
    zero, emf, load = (float(x) for x in solution.x)
    return min(zero, edge), emf, load


def _residual(parameters: Array, duty: Array, volts: Array, omega: Array, weight: Array) -> Array:
    zero, emf, load = parameters
    share = np.maximum((duty - zero) * volts, 0.0)
    denominator = np.maximum(emf + np.sqrt(emf**2 + 4.0 * load * share), 1e-12)
    return weight * (2.0 * share / denominator - omega)


def _around(value: float, half: float) -> tuple[float, float]:
    return (float(value - half), float(value + half))


# What the tables of one thruster, or of several alike, say.

SIDES = (("plus", 1.0), ("minus", -1.0))
"""Name and sign of the two directions of rotation."""
SAME_VOLTAGE = 0.75
"""Voltages nearer than this are one level [V]; a battery's sag within a run is not another level."""
PULSE_RANGE = (1100.0, 1500.0, 1900.0)
"""Reverse, neutral and forward of hobby speed controllers [µs], where the vehicle file does not say."""
TO_RPM = 30.0 / math.pi
CHOSEN_LIMIT = 0.02
"""A force limit this far below the curve at the speed limit was chosen, not measured: it stays."""


@dataclass(frozen=True, kw_only=True)
class Bench:
    """What the tables of one target say."""

    levels: dict[float, ThrustTable]
    """All rows of each voltage [V], to 0.1 V; of NaN those whose voltage is not known."""
    voltage: float
    """At which the numbers hold [V]; NaN where it is not known."""
    rows: ThrustTable
    """Those that were fitted; the others only check the prediction."""
    sides: dict[str, Side]
    """By `plus` and `minus`."""
    dead: dict[str, DeadZone]
    fastest: dict[str, tuple[float, bool, float]]
    """Fastest speed at the voltage [rad/s, > 0], whether the pulse was at its end there, and the distance to the row
    that is next in speed [rad/s]."""
    esc: EscFit | None
    speeds_measured: bool
    """Whether there are speeds; otherwise they follow from the forces by the vehicle file's curve."""
    before: Thruster
    """As the vehicle file has it."""
    findings: tuple[Finding, ...]

    def thrust(self, speed: Array) -> Array:
        """T = c± ω|ω| with the fitted c±, those of the vehicle file where there is none [N], (n,).

        Args:
            speed: Of the shaft, positive for positive thrust [rad/s], (n,).
        """
        plus, minus = (
            self.sides[name].c if name in self.sides else getattr(self.before, f"c_{name}")
            for name, _ in SIDES
        )
        return np.where(speed >= 0.0, plus, minus) * speed * np.abs(speed)


def bench(tables: Sequence[ThrustTable], thruster: Thruster, label: str, voltage: float | None) -> Bench:
    """Analyse tables of one thruster or of several alike.

    Args:
        tables: At least one.
        thruster: As the vehicle file has it.
        label: How messages call the target.
        voltage: At which the numbers shall hold [V]; where not given, the only one of the tables, else that of the
            vehicle file's ESC, else the middle one.

    Raises:
        CalibrationError: The tables hold no such voltage, or nothing to fit.
    """
    findings: list[Finding] = []
    measured = any(np.isfinite(table.speed).any() for table in tables)
    if measured:
        tables = [table for table in tables if np.isfinite(table.speed).any()]
    else:
        tables = [_with_speeds(table, thruster) for table in tables]
        findings.append(finding("no_shaft_speeds", label))
    levels = [level for table in tables for level in split_by_voltage(table)]
    chosen = _reference([volts for volts, _ in levels], thruster, label, voltage)
    at = [table for volts, table in levels if not abs(volts - chosen) > SAME_VOLTAGE]
    if others := sorted({round(volts, 1) for volts, _ in levels if abs(volts - chosen) > SAME_VOLTAGE}):
        findings.append(
            finding("voltage_chosen", label, voltage=chosen, others=tuple(f"{v:g}" for v in others))
        )
    pulse_range = _pulse_range(thruster, tables)
    sides, dead, fastest = {}, {}, {}
    for name, sign in SIDES:
        fastest[name] = max((_fastest(table, sign, pulse_range) for table in at), default=(0.0, False, 0.0))
        side = fit_side([_turning(table, sign) for table in at]) if measured else None
        if side is not None:
            sides[name] = side
        zones = [zone for table in at if (zone := dead_zone(sign * table.speed)) is not None]
        if zones and measured:  # their median, over all of their intervals
            zones = [zone for zone in zones if zone.measured] or zones
            ends = [end for zone in zones for end in zone.interval]
            middle = float(np.median([zone.speed for zone in zones]))
            dead[name] = replace(zones[0], speed=middle, interval=(min(ends), max(ends)))
    if not measured and (times := _times_the_file(fastest, thruster, chosen, pulse_range)):
        findings.append(finding("another_thruster", label, times=times))
    rows, esc = _stack(at), None
    if any(np.isfinite(table.pulse).any() for table in tables):
        if math.isnan(chosen):
            findings.append(finding("law_without_voltage", label))
        else:
            good = np.isfinite(rows.pulse) & np.isfinite(rows.speed) & (rows.pulse > 0.0)
            volts = np.where(np.isfinite(rows.voltage), rows.voltage, chosen)[good]
            speed = rows.speed[good]
            # Speeds that follow from forces are the surer the faster: dω = dT / (2 c ω).
            weight = None if measured else np.abs(speed) / np.max(np.abs(speed))
            try:
                esc = fit_esc(
                    rows.pulse[good], speed, volts, pulse_range=pulse_range, weight=weight, at=chosen
                )
            except CalibrationError as error:
                findings.append(finding("law_refused", label, reason=str(error)))
    if not sides and esc is None:
        reasons = "; ".join(sentences(findings)) or f"{label}: no row turns the shaft"
        raise CalibrationError(f"{reasons}: nothing could be fitted")
    findings += [item.about(table.name) for table in tables for item in table.findings]
    by_voltage: dict[float, list[ThrustTable]] = {}
    for volts, table in levels:
        by_voltage.setdefault(round(volts, 1) if math.isfinite(volts) else math.nan, []).append(table)
    return Bench(
        levels={volts: _stack(by_voltage[volts]) for volts in sorted(by_voltage)}, voltage=chosen, rows=rows,
        sides=sides, dead=dead, fastest=fastest, esc=esc, speeds_measured=measured, before=thruster,
        findings=tuple(dict.fromkeys(findings)),
    )  # fmt: skip


def _times_the_file(
    fastest: Mapping[str, tuple[float, bool, float]],
    thruster: Thruster,
    voltage: float,
    pulse_range: tuple[float, float, float],
) -> float:
    """Return forces over those of the vehicle file's thruster where they show another one, else 0.

    Args:
        fastest: As of a `Bench`, from the forces by the file's curve.
        thruster: As the vehicle file has it.
        voltage: Of these rows [V]; NaN where it is not known.
        pulse_range: Reverse, neutral and forward [µs].
    """
    ratios = [1.0]
    for (name, sign), pulse in zip(SIDES, (pulse_range[2], pulse_range[0]), strict=True):
        speed, at_end, _ = fastest[name]
        if at_end and thruster.esc is not None and math.isfinite(voltage):
            ratios.append(speed / abs(float(thruster.shaft_speed(np.array([pulse]), voltage)[0])))
        else:  # a table may end before the limit
            limit = abs(thruster.rpm_max if sign > 0.0 else thruster.rpm_min) / TO_RPM
            ratios.append(max(1.0, speed / limit))
    worst = max(ratios, key=lambda ratio: abs(math.log(max(ratio, 1e-6))))
    return worst**2 if abs(math.log(max(worst, 1e-6))) > math.log(ANOTHER) else 0.0


def _turning(table: ThrustTable, sign: float) -> tuple[Array, Array]:
    """Speed and thrust along one direction of the rows in which the shaft turns that way."""
    speed = sign * table.speed
    rows = speed > STANDING * float(np.max(np.abs(table.speed)))
    return speed[rows], sign * table.force[rows]


def split_by_voltage(table: ThrustTable) -> list[tuple[float, ThrustTable]]:
    """The rows of every voltage level with its mean [V]; (NaN, table) where no voltage is known."""
    valid = np.isfinite(table.voltage)
    if not valid.any():
        return [(math.nan, table)]
    values = np.sort(table.voltage[valid])
    cuts = values[:-1][np.diff(values) > SAME_VOLTAGE] + 0.5 * SAME_VOLTAGE
    label = np.searchsorted(cuts, table.voltage)
    parts = [table.at(valid & (label == i)) for i in range(len(cuts) + 1)]
    return [(float(np.mean(part.voltage)), part) for part in parts]


def _reference(volts: Sequence[float], thruster: Thruster, label: str, requested: float | None) -> float:
    available = sorted(v for v in volts if not math.isnan(v))
    if not available:
        return math.nan if requested is None else requested
    preferred = requested if requested is not None else thruster.esc.voltage if thruster.esc else math.nan
    near = [v for v in available if abs(v - preferred) <= SAME_VOLTAGE]
    if requested is not None and not near:
        listed = ", ".join(f"{v:g}" for v in dict.fromkeys(round(v, 2) for v in available))
        raise CalibrationError(f"{label}: no table at {requested:g} V; there are {listed} V")
    return min(near, key=lambda v: abs(v - preferred)) if near else available[len(available) // 2]


def _pulse_range(thruster: Thruster, tables: Sequence[ThrustTable]) -> tuple[float, float, float]:
    """Reverse, neutral and forward [µs], wide enough for every pulse of the tables."""
    low, neutral, high = PULSE_RANGE
    if thruster.esc is not None:
        low, neutral, high = thruster.esc.pulse_min, thruster.esc.pulse_neutral, thruster.esc.pulse_max
    pulses = [x for table in tables for x in table.pulse[table.pulse > 0.0].tolist()]
    return min([low, *pulses]), neutral, max([high, *pulses])


def _fastest(
    table: ThrustTable, sign: float, pulse_range: tuple[float, float, float]
) -> tuple[float, bool, float]:
    """Fastest steady speed along a direction, whether the pulse was at its end, and the distance to the next speed."""
    speeds = np.sort(np.maximum(sign * table.speed, 0.0))
    low, neutral, high = pulse_range
    end = (high - neutral) if sign > 0.0 else (neutral - low)
    throws = sign * (table.pulse - neutral)
    at_end = bool(np.isfinite(throws).any() and np.nanmax(throws) >= 0.98 * end)
    return float(speeds[-1]), at_end, float(speeds[-1] - speeds[-2])


def _with_speeds(table: ThrustTable, thruster: Thruster) -> ThrustTable:
    """The same with the speeds that the vehicle file's curve gives to the forces."""
    force = np.where(np.abs(table.force) <= STANDING * np.max(np.abs(table.force)), 0.0, table.force)
    return replace(table, speed=thruster.speed(force))


def _stack(tables: Sequence[ThrustTable]) -> ThrustTable:
    """All rows of several tables as one."""
    columns = {key: np.concatenate([getattr(table, key) for table in tables]) for key in QUANTITIES}
    return ThrustTable(name=tables[0].name, **columns)  # type: ignore[arg-type]


# Which tables speak about which thrusters of a vehicle.


def find_targets(
    tables: Sequence[ThrustTable], vehicle: Vehicle, group: str | None
) -> tuple[dict[str, tuple[tuple[str, ...], list[ThrustTable]]], list[Finding]]:
    """Propeller group, thruster or `all` -> its thrusters and its tables; and findings.

    A group that the caller names comes first. Otherwise a table speaks about the thruster or group whose name is a
    word of its file's name (`H_LF.csv`, `run2-CCW.csv`); or about all.

    Raises:
        CalibrationError: Unknown names.
    """
    groups: dict[str, tuple[str, ...]] = {}
    for name, thruster in vehicle.thrusters.items():
        if thruster.group:
            groups[thruster.group] = (*groups.get(thruster.group, ()), name)
    if group is not None:
        if group not in groups:
            raise CalibrationError(
                f"{vehicle.name} has no propeller group '{group}': it has {', '.join(sorted(groups)) or 'none'}"
            )
        return {group: (groups[group], list(tables))}, []
    by_name: dict[str, list[ThrustTable]] = {}
    for table in tables:
        mentioned = (
            [
                name
                for name in names
                if re.search(rf"(?<![A-Za-z0-9]){re.escape(name)}(?![A-Za-z0-9])", table.name)
            ]
            for names in (vehicle.thrusters, groups)
        )
        by_name.setdefault(max(next(filter(None, mentioned), [""]), key=len), []).append(table)
    if "" not in by_name:
        return {name: (groups.get(name, (name,)), of_name) for name, of_name in by_name.items()}, []
    if len(by_name) > 1:
        names = ", ".join(table.name for table in by_name[""])
        raise CalibrationError(
            f"{names}: no thruster or group of {vehicle.name} is named, but other tables name theirs: put the name "
            "into the file's name, or fit these by themselves"
        )
    findings = []
    if len(groups) > 1:
        findings.append(finding("groups_unnamed", vehicle=vehicle.name, groups=tuple(sorted(groups))))
    name = next(iter(groups)) if len(groups) == 1 else "all"
    return {name: (vehicle.thruster_names, list(tables))}, findings


# How well the curve and the speed controller describe the tables, also those they were not fitted to.


def quality_of(name: str, result: Bench) -> dict[str, dict[str, float]]:
    """Figures of the fitted rows, and `NAME at V V` for every voltage when there are several.

    `rmse` are in N or rad/s, `nrmse` are rmse over the largest magnitude in the rows compared.
    """
    rows, figures = result.rows, dict[str, float]()
    if result.speeds_measured:
        error, turning = result.thrust(rows.speed) - rows.force, rows.speed != 0.0
        figures |= {"r2": _r2(rows.force[turning], error[turning]), "rmse": _rms(error[turning])}
        figures["samples"] = float(np.count_nonzero(turning))
        figures["rejected"] = float(sum(side.rejected for side in result.sides.values()))
        for side, word in (("plus", "forward"), ("minus", "reverse")):
            if side in result.sides:
                figures[f"r2_{word}"] = result.sides[side].r2
    if result.esc is not None:
        figures["esc_rmse"] = result.esc.rmse
        figures["esc_nrmse"] = result.esc.rmse / result.esc.fastest
    several = [volts for volts in result.levels if math.isfinite(volts)]
    at = {f"{name} at {v:g} V": _at_voltage(result, result.levels[v]) for v in several[1:] and several}
    return {name: figures, **at}


def _at_voltage(result: Bench, table: ThrustTable) -> dict[str, float]:
    """Errors of the thrust told from the speed, and of speed and thrust told from pulse and voltage."""
    figures: dict[str, float] = {}

    def add(key: str, error: Array, measured: Array) -> None:
        figures[f"rmse_{key}"] = _rms(error)
        figures[f"nrmse_{key}"] = _rms(error) / float(np.max(np.abs(measured)))

    if result.speeds_measured:
        turning = np.abs(table.speed) > STANDING * np.max(np.abs(table.speed))
        error = (result.thrust(table.speed) - table.force)[turning]
        figures["r2_thrust_from_speed"] = _r2(table.force[turning], error)
        add("thrust_from_speed", error, table.force)
    if result.esc is not None:
        speed = result.esc.esc.shaft_speed(table.pulse, table.voltage)
        add("thrust_from_pulse", result.thrust(speed) - table.force, table.force)
        if result.speeds_measured:
            add("speed_from_pulse", speed - table.speed, table.speed)
    return figures


def curves_of(name: str, result: Bench) -> list[Curve]:
    """For the report: thrust against speed; speed and thrust against pulse at every voltage."""
    curves = list[Curve]()

    def add(title: str, x_label: str, y_label: str, x: Array, measured: Array, fitted: Array) -> None:
        if not np.isfinite(x).any():
            return
        order = np.argsort(x)
        labels = {"title": f"{name}: {title}", "x_label": x_label, "y_label": y_label, "kind": "scatter"}
        curves.append(Curve(x=x[order], measured=measured[order], fitted=fitted[order], **labels))

    if result.speeds_measured:
        rows = result.rows
        axes = ("shaft speed [rpm]", "thrust [N]")
        add("thrust", *axes, rows.speed * TO_RPM, rows.force, result.thrust(rows.speed))
    for volts, level in result.levels.items() if result.esc is not None else ():
        label = "" if math.isnan(volts) else f" at {volts:g} V"
        assert result.esc is not None
        speed = result.esc.esc.shaft_speed(level.pulse, level.voltage if label else None)
        if result.speeds_measured:
            measured, axes = level.speed * TO_RPM, ("pulse [µs]", "shaft speed [rpm]")
            add(f"speed from pulse{label}", *axes, level.pulse, measured, speed * TO_RPM)
        axes = ("pulse [µs]", "thrust [N]")
        add(f"thrust from pulse{label}", *axes, level.pulse, level.force, result.thrust(speed))
    return curves


def _rms(error: Array) -> float:
    return float(np.sqrt(np.nanmean(error**2))) if np.isfinite(error).any() else math.nan


def _r2(measured: Array, error: Array) -> float:
    total = float(np.sum((measured - np.mean(measured)) ** 2))
    return 1.0 - float(error @ error) / total if total > 0.0 else math.nan


# The numbers that a bench gives a vehicle file, with their intervals and what they rest on.


def estimates_of(name: str, path: str, result: Bench) -> list[Estimate]:
    """Everything found about a target, named `TARGET.c_plus` and so on.

    A speed limit moves where the table reached the end of the pulse, or went beyond the limit of the vehicle file. The
    force limit is the curve at the speed limit, unless the vehicle file chose a lower one.

    Args:
        name: Of the target.
        path: Where its numbers stand in the vehicle file; those of a group in `thruster_groups`.
        result: What its tables say.
    """
    before, rows = result.before, list[Estimate]()
    volts = f"{result.voltage:g} V" if math.isfinite(result.voltage) else ""

    def add(key: str, value: float, ends: tuple[float, float], unit: str, sure: bool, note: str = "") -> None:
        rows.append(
            Estimate(
                name=f"{name}.{key}", estimate=float(value), ci95=ends, unit=unit, identifiable=sure, note=note,
                path=None if key == "reverse_ratio" else f"{path}.{key}",
            )
        )  # fmt: skip

    for direction, sign in SIDES:
        side, zone = result.sides.get(direction), result.dead.get(direction)
        if side is None:
            continue
        sure = math.isfinite(side.half_width) and side.c > side.half_width
        note = f"{side.samples} rows, R² {side.r2:.4f}, rms {side.rmse:.2g} N{volts and ', '}{volts}"
        note += "" if sure else ": too few or too scattered"
        add(f"c_{direction}", side.c, _around(side.c, side.half_width), "N s²/rad²", sure, note)
        if zone is not None:
            low, high = sorted(sign * TO_RPM * end for end in zone.interval)
            note = zone.note or f"slowest speed that turns; {side.c * zone.speed**2:.2g} N there"
            speed = sign * TO_RPM * zone.speed + 0.0
            add(f"dead_rpm_{direction}", speed, (low, high), "rpm", zone.measured, note)
    if len(result.sides) == 2:
        plus, minus = result.sides["plus"], result.sides["minus"]
        ratio = minus.c / plus.c
        half = ratio * math.hypot(plus.half_width / plus.c, minus.half_width / minus.c)
        add("reverse_ratio", ratio, _around(ratio, half), "-", math.isfinite(half))
    for direction, sign in SIDES:
        end, side = "max" if sign > 0.0 else "min", result.sides.get(direction)
        old_c = getattr(before, f"c_{direction}")
        c = side.c if side else old_c
        old_speed = sign * getattr(before, f"rpm_{end}") / TO_RPM
        old_force = sign * getattr(before, f"force_{end}")
        speed, at_end, scatter = result.fastest[direction]
        if speed <= 0.0:
            continue
        moves = at_end or speed > old_speed
        note = "beyond the vehicle file's" if moves else "the table ends here; the vehicle file's stays"
        note = f"full pulse{volts and ' at '}{volts}" if at_end else note
        note = note if result.speeds_measured else NOMINAL
        rpm = sign * speed * TO_RPM
        known = moves and result.speeds_measured
        add(f"rpm_{end}", rpm, _around(rpm, scatter * TO_RPM), "rpm", known, note)
        force = c * (speed if moves else old_speed) ** 2
        half = force * side.half_width / side.c if side else 0.0
        sure, note = math.isfinite(half), f"c_{direction} at the speed limit"
        if old_force < (1.0 - CHOSEN_LIMIT) * old_c * old_speed**2 and old_force < force:
            force, half, sure, note = old_force, 0.0, False, "the vehicle file's own, below the curve"
        add(f"force_{end}", sign * force, _around(sign * force, half), "N", sure, note)
    if result.esc is not None:
        units = {"dead": "µs", "zero": "µs", "emf": "V s/rad", "load": "V s²/rad²"}
        caution = "zero, emf and load of a direction vary together: the speed they give is surer than each"
        for key, ends in result.esc.intervals.items():
            note = result.esc.unsure.get(key, "" if key.startswith("dead") else caution)
            value, sure = float(getattr(result.esc.esc, key)), key not in result.esc.unsure
            if not (result.speeds_measured or key.startswith("dead")):
                note, sure = NOMINAL, False
            add(f"esc.{key}", value, ends, units[key.partition("_")[0]], sure, note)
    return rows


NOMINAL = "nominal: no shaft speed was measured, the vehicle file's curve gives it from the force"
ANOTHER = 1.15
"""Factor on the vehicle file's fastest speed beyond which speeds from forces show another thruster."""

WRITTEN = ("c_", "dead_rpm_", "rpm_", "force_")
"""Beginnings of the keys of a thruster that an estimate goes to."""


def fit_thruster(
    tables: Sequence[ThrustTable | str | os.PathLike[str]],
    vehicle: Vehicle,
    *,
    group: str | None = None,
    voltage: float | None = None,
    seed: int = 0,
) -> Fit:
    """Fit T = c± ω|ω| (paper, eq. 16) and, where there are pulses, the speed controller's law.

    Args:
        tables: CSV files (see `read_table`), or what was read from them.
        vehicle: Whose thrusters they are.
        group: Propeller group of all tables.
        voltage: At which the numbers shall hold [V], and for tables without a voltage column the voltage they were
            taken at; where not given, the tables' only one, else that of the vehicle file's ESC, else the middle one.
            Tables of other voltages check the prediction.
        seed: For the record; the intervals need no random numbers.

    Returns:
        Estimates named `GROUP.c_plus`, `THRUSTER.c_plus` or `all.c_plus` and so on; changes for every thruster.

    Raises:
        CalibrationError: A table that cannot be read, names that the vehicle does not have, too few rows.
    """
    neutral = next((t.esc.pulse_neutral for t in vehicle.thrusters.values() if t.esc), PULSE_RANGE[1])
    read = _distinct_names(
        [(x, x if isinstance(x, ThrustTable) else read_table(x, neutral=neutral)) for x in tables]
    )
    if not read:
        raise CalibrationError("no table given: name at least one CSV file of speeds and thrusts")
    first_names: dict[str, str] = {}
    for table in read:
        if first := first_names.get(table.sha256):
            raise CalibrationError(
                f"{first} and {table.name}: the same numbers are given twice: give every table once"
            )
        first_names[table.sha256] = table.name
    targets, findings = find_targets(read, vehicle, group)
    estimates: dict[str, Estimate] = {}
    changes: dict[str, Any] = {}
    quality: dict[str, dict[str, float]] = {}
    curves: list[Curve] = []
    for target, (thrusters, of_target) in targets.items():
        result = bench(of_target, vehicle.thrusters[thrusters[0]], target, voltage)
        kind = "thrusters" if target in thrusters else "thruster_groups"
        path = "thrusters.*" if target == "all" else f"{kind}.{target}"
        for estimate in estimates_of(target, path, result):
            estimates[estimate.name] = estimate
            key = estimate.name.rpartition(".")[2]
            old = abs(getattr(result.before, key)) if key.startswith("rpm_") else math.inf
            if key.startswith(WRITTEN) and (estimate.identifiable or _raised(result, estimate, old)):
                changes |= {f"thrusters.{name}.{key}": estimate.estimate for name in thrusters}
        if result.esc is not None:
            changes |= {f"thrusters.{name}.esc": result.esc.esc.values() for name in thrusters}
        quality |= quality_of(target, result)
        curves += curves_of(target, result)
        findings += result.findings
    return Fit(
        kind="thruster",
        method="least squares of T = c± ω|ω|",
        before=vehicle,
        estimates=estimates,
        changes=changes,
        quality=quality,
        curves=tuple(curves),
        findings=tuple(dict.fromkeys(findings)),
        trials={table.name: table.sha256 for table in read},
        settings={"voltage": voltage, "group": group, "seed": seed},
    )


def _raised(result: Bench, estimate: Estimate, old: float) -> bool:
    """Return whether a nominal speed limit has to rise, so that pulses give the forces that were measured."""
    return not result.speeds_measured and abs(estimate.estimate) > old


def _distinct_names(read: Sequence[tuple[Any, ThrustTable]]) -> list[ThrustTable]:
    """Tables of files with the same name are called by their folder too: `H_LF/sweep`."""
    names = [table.name for _, table in read]
    return [
        replace(table, name=f"{Path(item).parent.name}/{table.name}")
        if isinstance(item, str | os.PathLike) and names.count(table.name) > 1
        else table
        for item, table in read
    ]


def calibrate_thruster(
    tables: Sequence[Path],
    *,
    vehicle: str,
    out: Path,
    group: str | None = None,
    voltage: float | None = None,
    report: Path | None = None,
    seed: int = 1,
    as_json: bool = False,
) -> Vehicle:
    """Fit thrust curves: c+ and c- [N s²/rad²], dead zones [rpm], limits [N], pulse width to speed.

    Example: finssim calibrate thruster T200-16V.csv --vehicle bluerov2 --out mine.yaml

    Args:
        tables (TABLE): Tables of force against rpm or pulse width (.csv).
        vehicle (NAME|FILE): Vehicle in the catalogue, or path of a vehicle file.
        out (FILE): Vehicle file to write (.yaml).
        group (NAME): Propeller group of all tables.
        voltage: Battery voltage of the fit [V], if the tables have several; the others validate it.
        report (DIR): Directory for report.html, report.md, figures and fit.json.
        seed: Seed of every random number; equal seeds give equal results.
        as_json: Print one JSON object instead of tables.
    """
    options = dict(locals())
    refuse_places(out, report, "vehicle")
    fit = fit_thruster(list(tables), load_vehicle(vehicle), group=group, voltage=voltage, seed=seed)
    return finish("thruster", fit, options)
