"""Writing a vehicle to a file of its own, which reads back as the same vehicle."""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from finssim.calibration.errors import CalibrationError
from finssim.calibration.output import origins as tree_of
from finssim.calibration.output.vehicle_text import vehicle_text
from finssim.files import atomic_write
from finssim.vehicles import Provenance, Vehicle, load_vehicle

__all__ = ["check_vehicle_path", "write_vehicle"]

OWN = ("position", "axis", "group", "motor_index", "motor_sign")
"""What a thruster keeps for itself; the rest goes to its group where all its members agree."""


def write_vehicle(vehicle: Vehicle, path: str | os.PathLike[str]) -> None:
    """Write a self-contained vehicle file: every number, its origin, and the calibrations behind it.

    It reads back with the same `sha256` and the same origins. A hull mesh is copied beside it, under a name that ends
    with a part of its digest, unless it lies there already; the notice of its licence, `NAME.NOTICE`, goes with it.

    Args:
        vehicle: Any vehicle.
        path: File to write, .yaml; an earlier file is replaced.

    Raises:
        CalibrationError: Another suffix.
        OutputError: The place cannot be written.
    """
    target = check_vehicle_path(path)
    tree, origins = tree_of.file_tree(vehicle), tree_of.number_origins(vehicle)
    tree, origins = _grouped(tree, origins)
    with atomic_write(target) as temporary:
        if vehicle.hull is not None and vehicle.hull.file is not None:
            tree["hull"]["file"] = _beside(vehicle.hull.file, target)
        temporary.write_text(vehicle_text(tree, origins), encoding="utf-8")
        if load_vehicle(temporary).sha256 != vehicle.sha256:
            raise RuntimeError(f"{path}: the file would not hold the same vehicle; nothing was written")


def check_vehicle_path(path: str | os.PathLike[str]) -> Path:
    """The path of a vehicle file to write.

    Raises:
        CalibrationError: It does not end in .yaml or .yml.
    """
    target = Path(path)
    if target.suffix not in (".yaml", ".yml"):
        raise CalibrationError(
            f"{path} ends in '{target.suffix}', expected .yaml: name a vehicle file to write"
        )
    return target


def _beside(mesh: Path, target: Path) -> str:
    """Name of the mesh beside the target, copied there if need be; never over another file."""
    folder = Path(os.path.realpath(target)).parent
    if mesh.resolve().parent == folder:
        return mesh.name
    data = mesh.read_bytes()
    name = f"{mesh.stem}-{hashlib.sha256(data).hexdigest()[:8]}"
    copy = folder / f"{name}{mesh.suffix}"
    if not (copy.is_file() and copy.read_bytes() == data):
        with atomic_write(copy) as temporary:
            temporary.write_bytes(data)
    notice = mesh.with_suffix(".NOTICE")
    if notice.is_file():
        with atomic_write(folder / f"{name}.NOTICE") as temporary:
            shutil.copyfile(notice, temporary)
    return copy.name


def _grouped(
    tree: dict[str, Any], origins: dict[tuple[str, ...], Provenance]
) -> tuple[dict[str, Any], dict[tuple[str, ...], Provenance]]:
    """Numbers that all thrusters of a group share, with one origin, move to `thruster_groups`."""
    groups: dict[str, dict[str, Any]] = {}
    origins = dict(origins)
    thrusters = {name: dict(values) for name, values in tree["thrusters"].items()}
    for group in dict.fromkeys(t["group"] for t in thrusters.values() if t.get("group")):
        members = [name for name, values in thrusters.items() if values.get("group") == group]
        first = members[0]
        shared = [
            key
            for key in thrusters[first]
            if key not in OWN and all(_same(key, first, member, thrusters, origins) for member in members[1:])
        ]
        groups[group] = {key: thrusters[first][key] for key in shared}
        for key in shared:
            for path, _ in tree_of.leaves(thrusters[first][key], ("thrusters", first, key)):
                origins[("thruster_groups", group, *path[2:])] = origins[path]
            for member in members:
                del thrusters[member][key]
    result: dict[str, Any] = {}
    for section, values in tree.items():
        if section == "thrusters":
            if groups:
                result["thruster_groups"] = groups
            result["thrusters"] = {name: _group_first(values) for name, values in thrusters.items()}
        else:
            result[section] = dict(values) if isinstance(values, dict) else values
    return result, origins


def _same(
    key: str,
    first: str,
    member: str,
    thrusters: Mapping[str, Any],
    origins: Mapping[tuple[str, ...], Provenance],
) -> bool:
    """Whether two thrusters hold the same under a key, of the same origin."""
    if key not in thrusters[member] or thrusters[first][key] != thrusters[member][key]:
        return False
    paths = [path for path, _ in tree_of.leaves(thrusters[first][key], (key,))]
    return all(origins[("thrusters", first, *p)] == origins[("thrusters", member, *p)] for p in paths)


def _group_first(values: Mapping[str, Any]) -> dict[str, Any]:
    """Keys of a thruster as a person writes them: the group, the place, then the rest."""
    return {key: values[key] for key in ("group", "position", "axis") if key in values} | dict(values)
