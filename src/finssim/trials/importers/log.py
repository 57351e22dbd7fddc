"""Importers of logs: the class of their members in the registry, and the choice of one by content.

An importer is one file with a `LogImporter`, registered as `trial.FORMAT` in the family `IMPORTERS`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from finssim.core.registry import IMPORTERS
from finssim.trials.findings import CalibrationError
from finssim.trials.importers.assemble import ColumnMap, Stream
from finssim.vehicles import Vehicle

__all__ = ["TrialStreams", "LogImporter", "Request", "check_registered", "importer_of", "importers"]

KIND = "trial."
"""Beginning of the names of importers that read logs."""
HEAD = 1 << 16
"""Bytes from which an importer recognises its format."""


@dataclass(frozen=True)
class Request:
    """Options of the user for a log."""

    mapped: ColumnMap
    """Map file; an empty one if there is none."""
    vehicle: Vehicle | None = None
    """Vehicle of the log, if the user or the map names one."""

    @property
    def passive(self) -> bool:
        """Whether the thrusters were off, so that no commands are read."""
        return bool(self.mapped.header.get("passive", False))


@dataclass(frozen=True)
class TrialStreams:
    """Content of a log that makes one trial."""

    streams: list[Stream]
    """Streams in canonical columns; their findings name everything that was not read."""
    header: dict[str, Any] = field(default_factory=dict)
    """Keys of `trial.yaml` that the log contains."""


@dataclass(frozen=True)
class LogImporter:
    """An importer of logs."""

    title: str
    """Name of the format."""
    recognises: Callable[[Path, bytes], bool]
    """Function of a path and the first bytes of its file (none of a folder): whether it is of this format."""
    read: Callable[[Path, Request], TrialStreams]
    """Function that reads a log; it refuses by a `CalibrationError` of one sentence."""
    general: bool = False
    """True if more special formats are tried before."""


def check_registered(name: str, member: Any) -> None:
    """Refuse what is no importer of logs.

    Args:
        name: Name in the family: what is imported, a dot, and the format.
        member: The object that is registered under it.

    Raises:
        CalibrationError: The object does not fit.
    """
    if not isinstance(member, LogImporter):
        raise CalibrationError(f"{name} is {member!r}, expected a LogImporter: register it so")


def importers() -> dict[str, LogImporter]:
    """Return the importers of logs by format, the general ones last."""
    usable = {
        name.removeprefix(KIND): member
        for name, member in IMPORTERS.usable().items()
        if name.startswith(KIND)
    }
    return dict(sorted(usable.items(), key=lambda item: item[1].general))


def importer_of(path: Path, format: str = "auto") -> str:
    """Return the name of the importer of a log: the given one, or the first that recognises its content.

    Raises:
        CalibrationError: No importer of that name, or none recognises it.
    """
    known = importers()
    if format not in ("auto", *known):
        raise CalibrationError(f"format is '{format}', expected one of auto, {', '.join(known)}")
    if not path.exists():
        raise CalibrationError(f"{path}: no such file")
    if format in known:
        return format
    head = b""
    if path.is_file():
        with path.open("rb") as file:
            head = file.read(HEAD)
    for name, importer in known.items():
        if importer.recognises(path, head):
            return name
    titles = ", ".join(importer.title for importer in known.values())
    raise CalibrationError(f"{path}: unknown kind of log, expected one of {titles}; or give --format")
