"""Thrust curve, dead zone, limits and speed controller of a vehicle's thrusters, fitted to bench tables."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.bench.curves import DeadZone, DirectionCurve, EscFit, dead_zone, fit_esc, fit_side
from finssim.bench.tables import QUANTITIES, STANDING, ThrustTable, read_table
from finssim.identification.fit import Curve, Estimate, Fit
from finssim.identification.report import finish, refuse_places
from finssim.trials.findings import CalibrationError, Finding, finding, sentences
from finssim.vehicles import Vehicle, load_vehicle
from finssim.vehicles.thruster import Thruster

__all__ = ["fit_thruster"]

Array = NDArray[np.float64]


def _around(value: float, half: float) -> tuple[float, float]:
    return (float(value - half), float(value + half))


SIDES = (("plus", 1.0), ("minus", -1.0))
"""Name and sign of the two directions of rotation."""
SAME_VOLTAGE = 0.75
"""Difference of voltages below which they are one level [V], since a battery sags within a run."""
PULSE_RANGE = (1100.0, 1500.0, 1900.0)
"""Reverse, neutral and forward of hobby speed controllers, for vehicle files without a controller [µs]."""
TO_RPM = 30.0 / math.pi
CHOSEN_LIMIT = 0.02
"""Relative distance of a force limit below the curve at the speed limit from which it was chosen rather than
measured, and is kept [-]."""


@dataclass(frozen=True, kw_only=True)
class Bench:
    """Results for the tables of one target."""

    levels: dict[float, ThrustTable]
    """All rows by voltage [V], rounded to 0.1 V; rows of unknown voltage under NaN."""
    voltage: float
    """Voltage to which the numbers refer [V]; NaN if unknown."""
    rows: ThrustTable
    """Rows that were fitted; the others only validate the prediction."""
    sides: dict[str, DirectionCurve]
    """Thrust curves of `plus` and `minus`."""
    dead: dict[str, DeadZone]
    fastest: dict[str, tuple[float, bool, float]]
    """Greatest speed at the voltage [rad/s, > 0], whether the pulse was at its limit, and the distance to the next
    lower speed [rad/s]."""
    esc: EscFit | None
    speeds_measured: bool
    """True if speeds were measured; otherwise they are computed from the forces with the vehicle file's curve."""
    before: Thruster
    """The thruster of the vehicle file."""
    findings: tuple[Finding, ...]

    def thrust(self, speed: Array) -> Array:
        """Return T = c± ω|ω| with the fitted c±, or the vehicle file's for a direction without a fit [N], (n,).

        Args:
            speed: Shaft speed, positive for positive thrust [rad/s], (n,).
        """
        plus, minus = (
            self.sides[name].c if name in self.sides else getattr(self.before, f"c_{name}")
            for name, _ in SIDES
        )
        return np.where(speed >= 0.0, plus, minus) * speed * np.abs(speed)


def bench(tables: Sequence[ThrustTable], thruster: Thruster, label: str, voltage: float | None) -> Bench:
    """Analyse tables of one thruster or of several equal ones.

    Args:
        tables: Tables; at least one.
        thruster: The thruster of the vehicle file.
        label: Name of the target in messages.
        voltage: Voltage to which the numbers shall refer [V]; if None, the only one of the tables, otherwise
            that of the vehicle file's speed controller, otherwise the middle one.

    Raises:
        CalibrationError: The tables do not contain this voltage, or nothing that can be fitted.
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
        if zones and measured:  # their median, with the union of their intervals
            zones = [zone for zone in zones if zone.measured] or zones
            ends = [end for zone in zones for end in zone.interval]
            middle = float(np.median([zone.speed for zone in zones]))
            dead[name] = replace(zones[0], speed=middle, interval=(min(ends), max(ends)))
    if not measured and (times := _times_the_file(fastest, thruster, chosen, pulse_range)):
        findings.append(finding("another_thruster", label, times=times))
    rows, esc = _stack(at), None
    pulses = any(np.isfinite(table.pulse).any() for table in tables)
    if pulses and math.isnan(chosen):
        findings.append(finding("law_without_voltage", label))
    elif pulses:
        try:
            esc = _speed_controller(rows, chosen, pulse_range, measured)
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


def _speed_controller(
    rows: ThrustTable, voltage: float, pulse_range: tuple[float, float, float], measured: bool
) -> EscFit:
    """Fit the law of the speed controller to the rows with pulses, at a voltage [V]."""
    good = np.isfinite(rows.pulse) & np.isfinite(rows.speed) & (rows.pulse > 0.0)
    volts = np.where(np.isfinite(rows.voltage), rows.voltage, voltage)[good]
    speed = rows.speed[good]
    # Speeds computed from forces are the more accurate the faster: dω = dT / (2 c ω).
    weight = None if measured else np.abs(speed) / np.max(np.abs(speed))
    return fit_esc(rows.pulse[good], speed, volts, pulse_range=pulse_range, weight=weight, at=voltage)


def _times_the_file(
    fastest: Mapping[str, tuple[float, bool, float]],
    thruster: Thruster,
    voltage: float,
    pulse_range: tuple[float, float, float],
) -> float:
    """Return the ratio of the forces to those of the file's thruster if it is clearly another thruster,
    otherwise 0.

    Args:
        fastest: Greatest speeds as in a `Bench`, computed from the forces with the file's curve.
        thruster: The thruster of the vehicle file.
        voltage: Voltage of these rows [V]; NaN if unknown.
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
    """Return speed and thrust along one direction of the rows in which the shaft turns in that direction."""
    speed = sign * table.speed
    rows = speed > STANDING * float(np.max(np.abs(table.speed)))
    return speed[rows], sign * table.force[rows]


def split_by_voltage(table: ThrustTable) -> list[tuple[float, ThrustTable]]:
    """Return the mean voltage [V] and the rows of every voltage level; (NaN, table) if no voltage is known."""
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
    """Return reverse, neutral and forward [µs], wide enough for every pulse of the tables."""
    low, neutral, high = PULSE_RANGE
    if thruster.esc is not None:
        low, neutral, high = thruster.esc.pulse_min, thruster.esc.pulse_neutral, thruster.esc.pulse_max
    pulses = [x for table in tables for x in table.pulse[table.pulse > 0.0].tolist()]
    return min([low, *pulses]), neutral, max([high, *pulses])


def _fastest(
    table: ThrustTable, sign: float, pulse_range: tuple[float, float, float]
) -> tuple[float, bool, float]:
    """Return the greatest speed along a direction, whether the pulse was at its limit, and the distance to
    the next speed."""
    speeds = np.sort(np.maximum(sign * table.speed, 0.0))
    low, neutral, high = pulse_range
    end = (high - neutral) if sign > 0.0 else (neutral - low)
    throws = sign * (table.pulse - neutral)
    at_end = bool(np.isfinite(throws).any() and np.nanmax(throws) >= 0.98 * end)
    return float(speeds[-1]), at_end, float(speeds[-1] - speeds[-2])


def _with_speeds(table: ThrustTable, thruster: Thruster) -> ThrustTable:
    """Return the table with speeds computed from the forces with the vehicle file's curve."""
    force = np.where(np.abs(table.force) <= STANDING * np.max(np.abs(table.force)), 0.0, table.force)
    return replace(table, speed=thruster.speed(force))


def _stack(tables: Sequence[ThrustTable]) -> ThrustTable:
    """Return all rows of several tables as one table."""
    columns = {key: np.concatenate([getattr(table, key) for table in tables]) for key in QUANTITIES}
    return ThrustTable(name=tables[0].name, **columns)  # type: ignore[arg-type]


def find_targets(
    tables: Sequence[ThrustTable], vehicle: Vehicle, group: str | None
) -> tuple[dict[str, tuple[tuple[str, ...], list[ThrustTable]]], list[Finding]]:
    """Return propeller group, thruster or `all` -> its thrusters and its tables; and findings.

    If a group is given, it gets all tables. Otherwise a table belongs to the thruster or group whose name is
    a word of its file's name (`H_LF.csv`, `run2-CCW.csv`), or to all thrusters.

    Raises:
        CalibrationError: A group is unknown, or only some of the tables name a thruster.
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


def quality_of(name: str, result: Bench) -> dict[str, dict[str, float]]:
    """Return figures of the fitted rows, and under `NAME at V V` those of every voltage if there are several.

    `rmse` is in [N] or [rad/s], `nrmse` is the rmse divided by the greatest magnitude in the rows compared.
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
    """Return errors of the thrust predicted from the speed, and of speed and thrust from pulse and voltage."""
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
    """Return the report's curves: thrust over speed; speed and thrust over pulse at every voltage."""
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


def estimates_of(name: str, path: str, result: Bench) -> list[Estimate]:
    """Return the estimates of a target, named `TARGET.c_plus` and so on.

    A speed limit changes if the table reached the pulse limit or exceeded the vehicle file's speed limit. The force
    limit is the curve at the speed limit, unless the vehicle file has a lower one.

    Args:
        name: Name of the target.
        path: Path of its numbers in the vehicle file; those of a group are in `thruster_groups`.
        result: Results of its tables.
    """
    rows = (*_of_curves(result), *_of_limits(result), *_of_law(result))
    return [
        Estimate(
            f"{name}.{key}",
            float(value),
            ends,
            unit,
            sure,
            note,
            None if key == "reverse_ratio" else f"{path}.{key}",
        )
        for key, value, ends, unit, sure, note in rows
    ]


Row = tuple[str, float, tuple[float, float], str, bool, str]
"""Key, value, interval, unit, whether the data determine it, and note."""


def _of_curves(result: Bench) -> Iterator[Row]:
    """Yield the coefficients, dead zones and their ratio."""
    volts = f", {result.voltage:g} V" if math.isfinite(result.voltage) else ""
    for direction, sign in SIDES:
        side, zone = result.sides.get(direction), result.dead.get(direction)
        if side is None:
            continue
        sure = math.isfinite(side.half_width) and side.c > side.half_width
        note = f"{side.samples} rows, R² {side.r2:.4f}, rms {side.rmse:.2g} N{volts}"
        note += "" if sure else ": too few or too scattered"
        yield f"c_{direction}", side.c, _around(side.c, side.half_width), "N s²/rad²", sure, note
        if zone is not None:
            low, high = sorted(sign * TO_RPM * end for end in zone.interval)
            note = zone.note or f"slowest speed that turns; {side.c * zone.speed**2:.2g} N there"
            speed = sign * TO_RPM * zone.speed + 0.0
            yield f"dead_rpm_{direction}", speed, (low, high), "rpm", zone.measured, note
    if len(result.sides) == 2:
        plus, minus = result.sides["plus"], result.sides["minus"]
        ratio = minus.c / plus.c
        half = ratio * math.hypot(plus.half_width / plus.c, minus.half_width / minus.c)
        yield "reverse_ratio", ratio, _around(ratio, half), "-", math.isfinite(half), ""


def _of_limits(result: Bench) -> Iterator[Row]:
    """Yield the limits of speed and force."""
    before = result.before
    volts = f" at {result.voltage:g} V" if math.isfinite(result.voltage) else ""
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
        note = f"full pulse{volts}" if at_end else note
        note = note if result.speeds_measured else NOMINAL
        rpm = sign * speed * TO_RPM
        known = moves and result.speeds_measured
        yield f"rpm_{end}", rpm, _around(rpm, scatter * TO_RPM), "rpm", known, note
        force = c * (speed if moves else old_speed) ** 2
        half = force * side.half_width / side.c if side else 0.0
        sure, note = math.isfinite(half), f"c_{direction} at the speed limit"
        if old_force < (1.0 - CHOSEN_LIMIT) * old_c * old_speed**2 and old_force < force:
            force, half, sure, note = old_force, 0.0, False, "the vehicle file's own, below the curve"
        yield f"force_{end}", sign * force, _around(sign * force, half), "N", sure, note


def _of_law(result: Bench) -> Iterator[Row]:
    """Yield the numbers of the speed controller."""
    if result.esc is None:
        return
    units = {"dead": "µs", "zero": "µs", "emf": "V s/rad", "load": "V s²/rad²"}
    caution = "zero, emf and load of a direction vary together: the speed they give is surer than each"
    for key, ends in result.esc.intervals.items():
        note = result.esc.unsure.get(key, "" if key.startswith("dead") else caution)
        value, sure = float(getattr(result.esc.esc, key)), key not in result.esc.unsure
        if not (result.speeds_measured or key.startswith("dead")):
            note, sure = NOMINAL, False
        yield f"esc.{key}", value, ends, units[key.partition("_")[0]], sure, note


NOMINAL = "nominal: no shaft speed was measured, the vehicle file's curve gives it from the force"
ANOTHER = 1.15
"""Ratio to the vehicle file's greatest speed above which speeds computed from forces indicate another thruster [-]."""

WRITTEN = ("c_", "dead_rpm_", "rpm_", "force_")
"""Prefixes of the thruster's keys that estimates are written to."""


def fit_thruster(
    tables: Sequence[ThrustTable | str | os.PathLike[str]],
    vehicle: Vehicle,
    *,
    group: str | None = None,
    voltage: float | None = None,
) -> Fit:
    """Fit T = c± ω|ω| (paper, eq. 16) and, for tables with pulses, the speed controller's law.

    Args:
        tables: CSV files (see `finssim.bench.tables.read_table`), or tables that were read from them.
        vehicle: Vehicle of the thrusters.
        group: Propeller group of all tables.
        voltage: Voltage to which the numbers shall refer [V], also that of tables without a voltage column;
            if None, the tables' only one, otherwise that of the vehicle file's speed controller, otherwise
            the middle one. Tables of other voltages validate the prediction.

    Returns:
        Estimates named `GROUP.c_plus`, `THRUSTER.c_plus` or `all.c_plus` and so on; changes for every thruster.

    Raises:
        CalibrationError: A table cannot be read, the vehicle lacks a name, or there are too few rows.
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
            # A nominal speed limit must increase if needed, so that pulses give the measured forces.
            old = abs(getattr(result.before, key)) if key.startswith("rpm_") else math.inf
            raised = not result.speeds_measured and abs(estimate.estimate) > old
            if key.startswith(WRITTEN) and (estimate.identifiable or raised):
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
        settings={"voltage": voltage, "group": group},
    )


def _distinct_names(read: Sequence[tuple[Any, ThrustTable]]) -> list[ThrustTable]:
    """Return the tables; those of files with equal names are named with their folder, as in `H_LF/sweep`."""
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
        report (DIR): Directory for report.html, figures and fit.json.
        as_json: Print one JSON object instead of tables.
    """
    options = dict(locals())
    refuse_places(out, report, "vehicle")
    fit = fit_thruster(list(tables), load_vehicle(vehicle), group=group, voltage=voltage)
    return finish("thruster", fit, options)
