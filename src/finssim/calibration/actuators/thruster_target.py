"""Which tables speak about which thrusters of a vehicle."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

from finssim.calibration.actuators.thrust_table import ThrustTable
from finssim.calibration.errors import CalibrationError
from finssim.vehicles import Vehicle

__all__ = ["Target", "find_targets"]


class Target(NamedTuple):
    """Thrusters that get the same numbers."""

    name: str
    """Of the propeller group or the thruster, or `all`."""
    thrusters: tuple[str, ...]
    tables: tuple[ThrustTable, ...]


def find_targets(
    tables: Sequence[ThrustTable], vehicle: Vehicle, thrusters: Sequence[str] | None, group: str | None
) -> tuple[list[Target], list[str]]:
    """Targets with their tables, and warnings.

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
        warnings = []
        if len(groups) > 1:
            warnings.append(
                f"{vehicle.name} has the propeller groups {', '.join(sorted(groups))}, and the tables name none: all "
                "thrusters get the same curve; name a group in the file's name to fit it by itself"
            )
        name = groups.pop() if len(groups) == 1 else "all"
        return [Target(name, vehicle.thruster_names, tuple(tables))], warnings
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
