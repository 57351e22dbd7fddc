"""Vehicle and pool of a record, from the files attached to it."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from finssim.core.files import plain_name
from finssim.core.yaml_file import read_mapping
from finssim.localization.overhead_camera import Pool, load_pool
from finssim.robot.record_messages import RecordError
from finssim.robot.record_reader import Record
from finssim.vehicles import Vehicle, VehicleError, catalogue_vehicle, load_vehicle

POOL = "pool.yaml"
"""Name of the pool's file in a record."""


def vehicle_of(record: Record) -> Vehicle:
    """Return the vehicle of a record, from the attached file if that of the catalogue has changed.

    Raises:
        RecordError: The record names no vehicle, or one by a path.
        VehicleError: Neither the catalogue nor the record has that vehicle, or the file is invalid.
    """
    name = record.metadata.get("vehicle")
    if name is None:
        raise RecordError(f"{record.path}: does not name its vehicle: give --vehicle")
    file_name = f"{plain_name(name, f'{record.path}: vehicle', RecordError)}.yaml"
    try:
        vehicle = catalogue_vehicle(name, str(record.path))
        if vehicle.sha256 == record.metadata.get("vehicle_sha256") or file_name not in record.files:
            return vehicle
    except VehicleError:
        if file_name not in record.files:
            raise
    with _kept_file(record, file_name, ("extends",), ("hull", "file")) as file:
        return load_vehicle(file)


def pool_of(record: Record) -> Pool | None:
    """Return the pool attached to a record; None if there is none.

    Raises:
        RecordError: The pool's file refers to another file by a path.
        LocalizationError: The pool's file is invalid.
    """
    if POOL not in record.files:
        return None
    with _kept_file(record, POOL, ("camera", "lens")) as file:
        return load_pool(file)


@contextmanager
def _kept_file(record: Record, name: str, *references: tuple[str, ...]) -> Iterator[Path]:
    """Yield an attached file in a temporary folder, together with those that it extends.

    `references` are the keys that may name other files; the devices of a vehicle's `perception` may as well.
    """
    with tempfile.TemporaryDirectory() as folder:
        names = [name]
        for one in names:  # the list grows within the loop
            file = Path(folder) / one
            file.write_text(record.files[one], encoding="utf-8")
            tree: Any = read_mapping(file, RecordError, such_as="name: value")
            entries = tree.get("perception")
            devices = entries.values() if isinstance(entries, dict) else ()
            named = [(": ".join(keys), _value_at(tree, keys)) for keys in references]
            named += [("perception: device", _value_at(entry, ("device",))) for entry in devices]
            for keys, value in named:
                if isinstance(value, str):
                    plain_name(value, f"{record.path}: {one}: {keys}", RecordError)
            parents = (f"{tree.get('extends')}{suffix}" for suffix in ("", ".yaml"))
            names += [p for p in parents if p in record.files and p not in names][:1]
        yield Path(folder) / name


def _value_at(tree: Any, keys: tuple[str, ...]) -> Any:
    """Return the value at a sequence of keys in nested mappings; None if there is none."""
    for key in keys:
        tree = tree.get(key) if isinstance(tree, dict) else None
    return tree
