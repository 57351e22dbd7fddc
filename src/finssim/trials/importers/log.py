"""Arguments and results of importers of logs, and the selection of an importer by name or content."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from finssim.core.importer import importers, recognised
from finssim.trials.findings import CalibrationError
from finssim.trials.importers.assemble import Stream
from finssim.trials.importers.column_map import ColumnMap
from finssim.vehicles import Vehicle

__all__ = ["Request", "TrialStreams", "importer_of"]


@dataclass(frozen=True)
class Request:
    """Options of the user for a log."""

    mapped: ColumnMap
    """Map file; an empty one if there is none."""
    vehicle: Vehicle | None = None
    """Vehicle of the log, if the user or the map names one."""

    @property
    def passive(self) -> bool:
        """True if the thrusters were off, so that no commands are read."""
        return bool(self.mapped.header.get("passive", False))


@dataclass(frozen=True)
class TrialStreams:
    """Content of a log that forms one trial."""

    streams: list[Stream]
    """Streams in canonical columns; their findings list all contents that were not read."""
    header: dict[str, Any] = field(default_factory=dict)
    """Keys of `trial.yaml` that the log contains."""


def importer_of(path: Path, format: str = "auto") -> str:
    """Return the name of the importer of a log: the given one, or the first that recognises its content.

    Raises:
        CalibrationError: There is no importer of that name, or none recognises the log.
    """
    known = importers("trial")
    if format not in ("auto", *known):
        raise CalibrationError(f"format is '{format}', expected one of auto, {', '.join(known)}")
    if not path.exists():
        raise CalibrationError(f"{path}: no such file")
    name = format if format in known else recognised("trial", path)
    if name is None:
        titles = ", ".join(importer.title for importer in known.values())
        raise CalibrationError(
            f"{path}: unknown format of the log, expected one of {titles}; or give --format"
        )
    return name
