"""The vehicle and the pool of a record, from the files that it keeps."""

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
    """Return the vehicle that a record names, from the file that it keeps where the catalogue has another one now.

    Raises:
        RecordError: It names none, or one by a path.
        VehicleError: The catalogue has none of that name and the record keeps none, or the file is wrong.
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
    """Return the pool that a record keeps; None where it keeps none.

    Raises:
        RecordError: The pool's file names another file by a path.
        LocalizationError: The pool's file is wrong.
    """
    if POOL not in record.files:
        return None
    with _kept_file(record, POOL, ("camera", "lens")) as file:
        return load_pool(file)


@contextmanager
def _kept_file(record: Record, name: str, *references: tuple[str, ...]) -> Iterator[Path]:
    """Yield a file that the record keeps, in a folder of its own, beside those that it extends.

    `references` are the keys that may name other files. So may the devices of a vehicle's `perception`.
    """
    with tempfile.TemporaryDirectory() as folder:
        names = [name]
        for one in names:  # which grows
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
    """Return the value below some keys of nested mappings; None where there is none."""
    for key in keys:
        tree = tree.get(key) if isinstance(tree, dict) else None
    return tree
