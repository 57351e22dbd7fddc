"""From tables of a bench to the thrust curve, dead zone, limits and speed controller of a vehicle's thrusters."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.actuators.thrust_table import STANDING, ThrustTable, read_table, tables_of_trial
from finssim.calibration.actuators.thruster_bench import SIDES, Bench, bench
from finssim.calibration.errors import CalibrationError
from finssim.calibration.findings import Finding, finding
from finssim.calibration.fit import Curve, Estimate, Fit
from finssim.calibration.trials.trial import Trial
from finssim.calibration.trials.trial_files import load_trial
from finssim.vehicles import Vehicle
from finssim.vehicles.thruster import Thruster

__all__ = ["fit_thruster"]

# Which tables speak about which thrusters of a vehicle.


class Target(NamedTuple):
    """Thrusters that get the same numbers."""

    name: str
    """Of the propeller group or the thruster, or `all`."""
    thrusters: tuple[str, ...]
    tables: tuple[ThrustTable, ...]


def find_targets(
    tables: Sequence[ThrustTable], vehicle: Vehicle, thrusters: Sequence[str] | None, group: str | None
) -> tuple[list[Target], list[Finding]]:
    """Targets with their tables, and findings.

    What the caller names comes first. Otherwise a table speaks about the thruster that its columns name; or about the
    thruster or group whose name is a word of its file's name (`H_LF.csv`, `run2-CCW.csv`); or about all thrusters.

    Raises:
        CalibrationError: Unknown names, or both kinds of names given.
    """
    groups = {thruster.group for thruster in vehicle.thrusters.values()} - {""}
    if thrusters is not None and group is not None:
        raise CalibrationError("thrusters and group are both given, expected one of them")
    if group is not None:
        if group not in groups:
            raise CalibrationError(
                f"{vehicle.name} has no propeller group '{group}': it has {', '.join(sorted(groups)) or 'none'}"
            )
        return [Target(group, _members(vehicle, group), tuple(tables))], []
    if thrusters is not None:
        unknown = [name for name in thrusters if name not in vehicle.thrusters]
        if unknown or not thrusters:
            raise CalibrationError(
                f"{vehicle.name} has no thruster '{', '.join(unknown)}': it has {', '.join(vehicle.thrusters)}"
            )
        named = {table.thruster for table in tables}
        if named <= set(thrusters):
            return [_own(name, tables) for name in thrusters if name in named], []
        return [Target(name, (name,), tuple(tables)) for name in thrusters], []
    found: dict[str, list[ThrustTable]] = {}
    for table in tables:
        found.setdefault(_spoken_of(table, vehicle, groups), []).append(table)
    if "" in found and len(found) > 1:
        names = ", ".join(table.name for table in found[""])
        raise CalibrationError(
            f"{names}: no thruster or group of {vehicle.name} is named, but other tables name theirs: put the name "
            "into the file's name, or fit these by themselves"
        )
    if "" in found:
        unnamed = []
        if len(groups) > 1:
            unnamed.append(finding("groups_unnamed", vehicle=vehicle.name, groups=tuple(sorted(groups))))
        name = groups.pop() if len(groups) == 1 else "all"
        return [Target(name, vehicle.thruster_names, tuple(tables))], unnamed
    return [
        Target(name, _members(vehicle, name) if name in groups else (name,), tuple(of_name))
        for name, of_name in found.items()
    ], []


def _own(name: str, tables: Sequence[ThrustTable]) -> Target:
    return Target(name, (name,), tuple(table for table in tables if table.thruster == name))


def _members(vehicle: Vehicle, group: str) -> tuple[str, ...]:
    return tuple(name for name, thruster in vehicle.thrusters.items() if thruster.group == group)


def _spoken_of(table: ThrustTable, vehicle: Vehicle, groups: set[str]) -> str:
    """Name of the thruster or group that a table names, or ""."""
    if table.thruster is not None and table.thruster in vehicle.thrusters:
        return table.thruster
    if table.thruster is not None and len(vehicle.thrusters) > 1:
        raise CalibrationError(
            f"{table.name}: {vehicle.name} has no thruster '{table.thruster}': its thrusters are "
            f"{', '.join(vehicle.thrusters)}; rename the columns, or say thrusters="
        )
    for known in (list(vehicle.thrusters), sorted(groups)):
        said = [
            name
            for name in known
            if re.search(rf"(?<![A-Za-z0-9]){re.escape(name)}(?![A-Za-z0-9])", table.name)
        ]
        if said:
            return max(said, key=len)
    return ""


# How well a thruster's curve and speed controller describe the tables, also those they were not fitted to.

Array = NDArray[np.float64]


def predicted_thrust(result: Bench, before: Thruster, speed: Array) -> Array:
    """T = c± ω|ω| with the fitted c±, those of the vehicle file where there is none [N], (n,).

    Args:
        result: The fit.
        before: The thruster of the vehicle file.
        speed: Of the shaft, positive for positive thrust [rad/s], (n,).
    """
    c = {
        name: result.sides[name].c if name in result.sides else getattr(before, f"c_{name}")
        for name, _ in SIDES
    }
    return np.where(speed >= 0.0, c["plus"], c["minus"]) * speed * np.abs(speed)


def quality_of(name: str, result: Bench, before: Thruster) -> dict[str, dict[str, float]]:
    """Figures of the fitted tables, and `NAME at V V` for every voltage when there are several.

    `rmse` are in N or rad/s, `nrmse` are rmse over the largest magnitude in the rows compared.
    """
    rows = _stack(result.fitted)
    figures: dict[str, float] = {}
    if result.speeds_measured:
        error = predicted_thrust(result, before, rows.speed) - rows.force
        turning = rows.speed != 0.0
        figures |= {"r2": _r2(rows.force[turning], error[turning]), "rmse": _rms(error[turning])}
        figures["samples"] = float(np.count_nonzero(turning))
        figures["rejected"] = float(sum(side.rejected for side in result.sides.values()))
        for side, word in (("plus", "forward"), ("minus", "reverse")):
            if side in result.sides:
                figures[f"r2_{word}"] = result.sides[side].r2
    if result.esc is not None:
        figures["esc_rmse"] = result.esc.rmse
        figures["esc_nrmse"] = result.esc.rmse / result.esc.fastest
    found = {name: figures}
    volts = sorted({round(v, 1) for v, _ in result.levels if not math.isnan(v)})
    for volt in volts if len(volts) > 1 else []:
        level = _stack([table for v, table in result.levels if round(v, 1) == volt])
        found[f"{name} at {volt:g} V"] = _at_voltage(result, before, level)
    return found


def _at_voltage(result: Bench, before: Thruster, table: ThrustTable) -> dict[str, float]:
    """Errors of the thrust told from the speed, and of speed and thrust told from pulse and voltage."""
    figures: dict[str, float] = {}
    largest = float(np.max(np.abs(table.force)))
    if result.speeds_measured:
        error = predicted_thrust(result, before, table.speed) - table.force
        turning = np.abs(table.speed) > STANDING * np.max(np.abs(table.speed))
        figures |= {
            "r2_thrust_from_speed": _r2(table.force[turning], error[turning]),
            "rmse_thrust_from_speed": _rms(error[turning]),
            "nrmse_thrust_from_speed": _rms(error[turning]) / largest,
        }
    if result.esc is not None:
        speed = result.esc.esc.shaft_speed(table.pulse, table.voltage)
        error = predicted_thrust(result, before, speed) - table.force
        figures |= {"rmse_thrust_from_pulse": _rms(error), "nrmse_thrust_from_pulse": _rms(error) / largest}
        if result.speeds_measured:
            error = speed - table.speed
            fastest = float(np.max(np.abs(table.speed)))
            figures |= {"rmse_speed_from_pulse": _rms(error), "nrmse_speed_from_pulse": _rms(error) / fastest}
    return figures


def curves_of(name: str, result: Bench, before: Thruster) -> list[Curve]:
    """For the report: thrust against speed; speed and thrust against pulse at every voltage."""
    rows = _stack(result.fitted)
    order = np.argsort(rows.speed)
    rpm = rows.speed[order] * TO_RPM
    fitted = predicted_thrust(result, before, rows.speed[order])
    curves = []
    if result.speeds_measured:
        force = rows.force[order]
        curves.append(
            _quality_curve(f"{name}: thrust", "shaft speed [rpm]", "thrust [N]", rpm, force, fitted)
        )
    if result.esc is None:
        return curves
    for volt in sorted({round(v, 1) for v, _ in result.levels if not math.isnan(v)}) or [math.nan]:
        level = _stack([table for v, table in result.levels if math.isnan(volt) or round(v, 1) == volt])
        order = np.argsort(level.pulse)
        pulse, label = level.pulse[order], "" if math.isnan(volt) else f" at {volt:g} V"
        speed = result.esc.esc.shaft_speed(pulse, level.voltage[order] if label else None)
        thrust = predicted_thrust(result, before, speed)
        axes = ("pulse [µs]", "shaft speed [rpm]")
        if result.speeds_measured:
            measured = level.speed[order] * TO_RPM
            curves.append(
                _quality_curve(f"{name}: speed from pulse{label}", *axes, pulse, measured, speed * TO_RPM)
            )
        curves.append(
            _quality_curve(
                f"{name}: thrust from pulse{label}", axes[0], "thrust [N]", pulse, level.force[order], thrust
            )
        )
    return curves


def _quality_curve(title: str, x_label: str, y_label: str, x: Array, measured: Array, fitted: Array) -> Curve:
    return Curve(
        title=title, x_label=x_label, y_label=y_label, x=x, measured=measured, fitted=fitted, kind="scatter"
    )


def _stack(tables: list[ThrustTable] | tuple[ThrustTable, ...]) -> ThrustTable:
    """All rows of several tables as one."""
    return ThrustTable(
        name=tables[0].name,
        speed=np.concatenate([table.speed for table in tables]),
        force=np.concatenate([table.force for table in tables]),
        pulse=np.concatenate([table.pulse for table in tables]),
        voltage=np.concatenate([table.voltage for table in tables]),
    )


def _rms(error: Array) -> float:
    good = error[np.isfinite(error)]
    return float(np.sqrt(np.mean(good**2))) if good.size else math.nan


def _r2(measured: Array, error: Array) -> float:
    total = float(np.sum((measured - np.mean(measured)) ** 2))
    return 1.0 - float(error @ error) / total if total > 0.0 else math.nan


# The numbers that a bench gives a vehicle file, with their intervals and what they rest on.

TO_RPM = 30.0 / math.pi
CHOSEN_LIMIT = 0.02
"""A force limit this far below the curve at the speed limit was chosen, not measured: it stays."""


def estimates_of(target: Target, result: Bench, vehicle: Vehicle) -> list[Estimate]:
    """Everything found about a target, named `TARGET.c_plus` and so on."""
    return [*_curve(target, result), *_limits(target, result, vehicle), *_controller(target, result)]


def _path(target: Target, key: str) -> str:
    """Where the number stands in the vehicle file; that of a group in `thruster_groups`."""
    if target.name in target.thrusters:
        return f"thrusters.{target.name}.{key}"
    return f"thrusters.*.{key}" if target.name == "all" else f"thruster_groups.{target.name}.{key}"


def _curve(target: Target, result: Bench) -> list[Estimate]:
    """c±, their ratio and the dead zone."""
    estimates = []
    for name, sign in SIDES:
        side = result.sides.get(name)
        if side is None:
            continue
        sure = math.isfinite(side.half_width) and side.c > side.half_width
        rows = f"{side.samples} rows, R² {side.r2:.4f}, rms {side.rmse:.2g} N"
        if math.isfinite(result.voltage):
            rows += f", {result.voltage:g} V"
        note = rows if sure else f"{rows}: too few or too scattered to tell"
        estimates.append(
            _estimate(target, f"c_{name}", side.c, side.half_width, "N s²/rad²", sure=sure, note=note)
        )
        zone = result.dead.get(name)
        if zone is not None:
            ends = sorted(sign * TO_RPM * end for end in zone.interval)
            estimates.append(
                Estimate(
                    name=f"{target.name}.dead_rpm_{name}",
                    estimate=sign * TO_RPM * zone.speed + 0.0,
                    ci95=(ends[0], ends[1]),
                    unit="rpm",
                    identifiable=zone.known,
                    note=zone.note or f"slowest speed that turns; {side.c * zone.speed**2:.2g} N there",
                    path=_path(target, f"dead_rpm_{name}"),
                )
            )
    if len(result.sides) == 2:
        plus, minus = result.sides["plus"], result.sides["minus"]
        ratio = minus.c / plus.c
        half = ratio * math.hypot(plus.half_width / plus.c, minus.half_width / minus.c)
        estimates.append(
            _estimate(target, "reverse_ratio", ratio, half, "-", sure=math.isfinite(half), path=False)
        )
    return estimates


def _limits(target: Target, result: Bench, vehicle: Vehicle) -> list[Estimate]:
    """Fastest speeds and the thrusts there.

    A speed limit moves where the table reached the end of the pulse, or went beyond the limit of the vehicle file. The
    force limit is the curve at the speed limit, unless the vehicle file chose a lower one.
    """
    estimates = []
    before = vehicle.thrusters[target.thrusters[0]]
    for name, sign in SIDES:
        end = "max" if sign > 0.0 else "min"
        side = result.sides.get(name)
        c = side.c if side else getattr(before, f"c_{name}")
        relative = side.half_width / side.c if side else 0.0
        old_speed = sign * getattr(before, f"rpm_{end}") / TO_RPM
        old_force = sign * getattr(before, f"force_{end}")
        speed, at_end, scatter = result.fastest[name]
        if speed <= 0.0:
            continue
        moves = at_end or speed > old_speed
        if not at_end:
            note = "beyond the vehicle file's" if moves else "the table ends here; the vehicle file's stays"
        else:
            note = f"full pulse{f' at {result.voltage:g} V' if math.isfinite(result.voltage) else ''}"
        estimates.append(
            _estimate(
                target, f"rpm_{end}", sign * speed * TO_RPM, scatter * TO_RPM, "rpm", sure=moves, note=note
            )
        )
        force = c * (speed if moves else old_speed) ** 2
        chosen = (
            old_force < (1.0 - CHOSEN_LIMIT) * getattr(before, f"c_{name}") * old_speed**2
            and old_force < force
        )
        note = "the vehicle file's own, below the curve" if chosen else f"c_{name} at the speed limit"
        value, half = (old_force, 0.0) if chosen else (force, relative * force)
        sure = not chosen and math.isfinite(half)
        estimates.append(_estimate(target, f"force_{end}", sign * value, half, "N", sure=sure, note=note))
    return estimates


def _controller(target: Target, result: Bench) -> list[Estimate]:
    """The numbers of the pulse's law."""
    if result.esc is None:
        return []
    units = {"dead": "µs", "zero": "µs", "emf": "V s/rad", "load": "V s²/rad²"}
    together = "zero, emf and load of a direction vary together: the speed they give is surer than each"
    return [
        Estimate(
            name=f"{target.name}.esc.{key}",
            estimate=float(getattr(result.esc.esc, key)),
            ci95=interval,
            unit=units[key.partition("_")[0]],
            identifiable=key not in result.esc.unsure,
            note=result.esc.unsure.get(key, "" if key.startswith("dead") else together),
            path=_path(target, f"esc.{key}"),
        )
        for key, interval in result.esc.intervals.items()
    ]


def _estimate(
    target: Target,
    key: str,
    value: float,
    half: float,
    unit: str,
    *,
    sure: bool,
    note: str = "",
    path: bool = True,
) -> Estimate:
    return Estimate(
        name=f"{target.name}.{key}",
        estimate=float(value),
        ci95=(float(value - half), float(value + half)),
        unit=unit,
        identifiable=sure,
        note=note,
        path=_path(target, key) if path else None,
    )


def fit_thruster(
    tables: Iterable[ThrustTable | Trial | str | os.PathLike[str]],
    vehicle: Vehicle,
    *,
    thrusters: Sequence[str] | None = None,
    group: str | None = None,
    columns: Mapping[str, str] | None = None,
    voltage: float | None = None,
    pool_voltages: bool = False,
    seed: int = 0,
) -> Fit:
    """Fit T = c± ω|ω| (paper, eq. 16) and, where there are pulses, the speed controller's law.

    Args:
        tables: CSV files (see `read_table`), folders of bench trials, or what was read from them.
        vehicle: Whose thrusters they are.
        thrusters: Thrusters that the tables speak about, instead of what columns and file names say.
        group: Propeller group that all tables speak about.
        columns: What the headers do not tell; see `read_table`.
        voltage: At which the numbers shall hold [V], and for tables without a voltage column the voltage they were
            taken at; where not given, the tables' only one, else that of the vehicle file's ESC, else the middle one.
        pool_voltages: Fit all voltages together; otherwise the others only check the prediction.
        seed: For the record; the intervals need no random numbers.

    Returns:
        Estimates named `GROUP.c_plus`, `THRUSTER.c_plus` or `all.c_plus` and so on; changes for every thruster.

    Raises:
        CalibrationError: A table that cannot be read, names that the vehicle does not have, too few rows.
    """
    read = _named_apart([(item, table) for item in tables for table in _read(item, vehicle, columns)])
    if not read:
        raise CalibrationError("no table given: name at least one CSV file of speeds and thrusts")
    _refuse_duplicates(read)
    found, findings = find_targets(read, vehicle, thrusters, group)
    estimates: dict[str, Estimate] = {}
    changes: dict[str, Any] = {}
    quality: dict[str, dict[str, float]] = {}
    curves: list[Curve] = []
    for target in found:
        first = vehicle.thrusters[target.thrusters[0]]
        result = bench(target.tables, first, target.name, voltage=voltage, pool_voltages=pool_voltages)
        own = estimates_of(target, result, vehicle)
        estimates |= {estimate.name: estimate for estimate in own}
        for estimate in own:
            if estimate.identifiable and (key := estimate.name.rpartition(".")[2]) in _WRITTEN:
                changes |= {f"thrusters.{name}.{key}": estimate.estimate for name in target.thrusters}
        if result.esc is not None:
            changes |= {f"thrusters.{name}.esc": result.esc.esc.values() for name in target.thrusters}
        quality |= quality_of(target.name, result, first)
        curves += curves_of(target.name, result, first)
        findings += result.findings
    return Fit(
        kind="thruster",
        method="least squares of T = c± ω|ω|",
        vehicle=vehicle,
        estimates=estimates,
        changes=changes,
        quality=quality,
        curves=tuple(curves),
        findings=tuple(dict.fromkeys(findings)),
        trials={table.name: table.sha256 for table in read},
        settings={
            "voltage": voltage,
            "pool_voltages": pool_voltages,
            "thrusters": thrusters,
            "group": group,
            "seed": seed,
        },
    )


_WRITTEN = {
    f"{key}{end}"
    for key, ends in (("c_", ("plus", "minus")), ("dead_rpm_", ("plus", "minus")), ("rpm_", ("max", "min")),
                      ("force_", ("max", "min")))
    for end in ends
}  # fmt: skip
"""Keys of a thruster that an estimate goes to."""


def _read(
    item: ThrustTable | Trial | str | os.PathLike[str], vehicle: Vehicle, columns: Mapping[str, str] | None
) -> list[ThrustTable]:
    if isinstance(item, ThrustTable):
        return [item]
    neutrals = [thruster.esc.pulse_neutral for thruster in vehicle.thrusters.values() if thruster.esc]
    neutral = neutrals[0] if neutrals else 1500.0
    if (
        isinstance(item, Trial)
        or Path(item).is_dir()
        or Path(item).suffix == ".parquet"
        or _is_trial(Path(item))
    ):
        trial = item if isinstance(item, Trial) else load_trial(item)
        turned = [name for name, thruster in vehicle.thrusters.items() if thruster.motor_sign == -1]
        return tables_of_trial(trial, neutral=neutral, reversed_wiring=turned)
    return [read_table(item, columns=columns, neutral=neutral)]


def _is_trial(path: Path) -> bool:
    """Whether a CSV file's header names a thruster's force and what drove it, as trials do."""
    if not path.is_file():
        return False
    with path.open(encoding="utf-8", errors="replace") as lines:
        header = {word.strip() for word in next(lines, "").split(",")}
    names = {word.removeprefix("force_") for word in header if word.startswith("force_")}
    return any({f"rpm_{name}", f"pwm_{name}"} & header for name in names)


def _named_apart(read: Sequence[tuple[Any, ThrustTable]]) -> list[ThrustTable]:
    """Tables of files with the same name are called by their folder too: `H_LF/sweep`."""
    names = [table.name for _, table in read]
    return [
        replace(table, name=f"{Path(item).parent.name}/{table.name}")
        if isinstance(item, str | os.PathLike) and table.thruster is None and names.count(table.name) > 1
        else table
        for item, table in read
    ]


def _refuse_duplicates(tables: Sequence[ThrustTable]) -> None:
    seen: dict[tuple[str, str | None], str] = {}
    for table in tables:
        first = seen.setdefault((table.sha256, table.thruster), table.name)
        if sum((t.sha256, t.thruster) == (table.sha256, table.thruster) for t in tables) > 1:
            names = table.name if first == table.name else f"{first} and {table.name}"
            raise CalibrationError(f"{names}: the same numbers are given twice: give every table once")
