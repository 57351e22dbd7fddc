"""From tables of a bench to the thrust curve, dead zone, limits and speed controller of a vehicle's thrusters."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from finssim.calibration.actuators.thrust_table import ThrustTable, read_table, tables_of_trial
from finssim.calibration.actuators.thruster_bench import bench
from finssim.calibration.actuators.thruster_estimates import estimates_of
from finssim.calibration.actuators.thruster_quality import curves_of, quality_of
from finssim.calibration.actuators.thruster_target import find_targets
from finssim.calibration.errors import CalibrationError
from finssim.calibration.fit import Curve, Estimate, Fit
from finssim.calibration.trials.trial import Trial
from finssim.calibration.trials.trial_files import load_trial
from finssim.vehicles import Vehicle

__all__ = ["fit_thruster"]


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
    found, warnings = find_targets(read, vehicle, thrusters, group)
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
        warnings += result.warnings
    return Fit(
        kind="thruster",
        method="least squares of T = c± ω|ω|",
        vehicle=vehicle,
        estimates=estimates,
        changes=changes,
        quality=quality,
        curves=tuple(curves),
        warnings=tuple(dict.fromkeys(warnings)),
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
