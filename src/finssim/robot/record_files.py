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
    if "pool.yaml" not in record.files:
        return None
    with _kept_file(record, "pool.yaml", ("camera", "lens")) as file:
        return load_pool(file)


@contextmanager
def _kept_file(record: Record, name: str, *references: tuple[str, ...]) -> Iterator[Path]:
    """Yield a file that the record keeps, in a separate folder; `references` are its keys that may name other files.

    So may the devices of a vehicle's `perception`.
    """
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / name
        file.write_text(record.files[name], encoding="utf-8")
        tree: Any = read_mapping(file, RecordError, such_as="name: value")
        for keys in references:
            value = tree
            for key in keys:
                value = value.get(key) if isinstance(value, dict) else None
            if isinstance(value, str):
                plain_name(value, f"{record.path}: {name}: {': '.join(keys)}", RecordError)
        entries = tree.get("perception")
        for entry in entries.values() if isinstance(entries, dict) else ():
            if isinstance(entry, dict) and isinstance(entry.get("device"), str):
                plain_name(entry["device"], f"{record.path}: {name}: perception: device", RecordError)
        yield file
