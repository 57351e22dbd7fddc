"""What a policy directory says of itself: `policy.yaml`, its schema and how two of them are compared."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

__all__ = [
    "DESCRIPTION_FILE",
    "FORMAT",
    "NETWORK_FILE",
    "ObservationEntry",
    "ObservationSchema",
    "PolicyDescription",
    "PolicyError",
    "VehicleIdentity",
    "first_difference",
    "plain_data",
    "read_description",
    "read_file",
]

FORMAT = 1
"""Version of the directory's layout; raised when an older reader would misread it."""

NETWORK_FILE = "policy.onnx"
DESCRIPTION_FILE = "policy.yaml"


class PolicyError(ValueError):
    """A policy directory cannot be read, or does not fit what it is asked to control."""


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class ObservationEntry(_Record):
    """A run of observation elements holding one quantity, as clip(quantity / scale)."""

    name: str
    """What it is, with its frame, such as `position_error_body`."""
    indices: tuple[int, ...]
    """Where its components lie in the observation, in order."""
    unit: str
    """Unit of the quantity before division; "1" when it has none."""
    scale: float = Field(default=1.0, gt=0.0)
    """Divisor, in `unit`."""
    clip: tuple[float, float] | None = None
    """Bounds (low, high) put on the divided value, or None."""


class ObservationSchema(_Record):
    """The observation's layout: which quantity stands where, in which unit and scale."""

    size: int = Field(gt=0)
    entries: tuple[ObservationEntry, ...]

    @model_validator(mode="after")
    def _covers_every_index_once(self) -> ObservationSchema:
        indices = sorted(index for entry in self.entries for index in entry.indices)
        if indices != list(range(self.size)):
            raise ValueError(f"entries hold indices {indices}, expected each of 0 to {self.size - 1} once")
        return self

    def name_at(self, index: int) -> str:
        """Name of the entry that holds observation element `index`."""
        return next(entry.name for entry in self.entries if index in entry.indices)


class VehicleIdentity(_Record):
    """The vehicle a policy was trained for."""

    name: str
    sha256: str
    """Hex digest of the resolved vehicle file."""


class PolicyDescription(_Record):
    """Everything `policy.yaml` says. Mappings are plain data: numbers, strings, lists and dictionaries."""

    format: int = FORMAT
    task: str
    observation: ObservationSchema
    action: dict[str, Any]
    """The action mode, as its `describe()` gives it: at least `mode` (name), `size`, and its limits and scale."""
    control_period: float = Field(gt=0.0)
    """Time between two actions [s]."""
    memory: int = Field(default=0, ge=0)
    """Numbers that the network hands on to its next action, zeros at an episode's start; 0: it remembers nothing."""
    vehicle: VehicleIdentity
    hydrodynamics: str
    """Hydrodynamic set or model it was trained in."""
    seed: int
    training: dict[str, Any] = Field(default_factory=dict)
    """Training configuration, complete enough to repeat the run."""
    provenance: dict[str, Any] = Field(default_factory=dict)
    """Git revision, package versions and platform."""
    created: str = ""
    """When it was written, ISO 8601, UTC."""
    files: dict[str, str] = Field(default_factory=dict)
    """SHA-256 of the other files of the directory that must not change (the network)."""

    @field_validator("action", "training", "provenance", mode="before")
    @classmethod
    def _plain_data(cls, value: Any) -> Any:
        return plain_data(value)

    @field_validator("action")
    @classmethod
    def _names_mode_and_size(cls, action: dict[str, Any]) -> dict[str, Any]:
        if not isinstance(action.get("mode"), str):
            raise ValueError("needs `mode`, the action mode's name")
        if not isinstance(action.get("size"), int) or action["size"] < 1:
            raise ValueError(f"size is {action.get('size')!r}, expected a positive whole number")
        return action

    @property
    def action_size(self) -> int:
        """Number of action elements, m."""
        return int(self.action["size"])


def read_file(path: Path) -> bytes:
    """Content of one file of a policy directory; a `PolicyError` where it cannot be read."""
    try:
        return path.read_bytes()
    except OSError as error:
        sentence = f"{path}: cannot be read ({error.strerror}): this is not a complete policy directory"
        raise PolicyError(sentence) from error


def read_description(folder: Path) -> PolicyDescription:
    """`policy.yaml` of a directory, checked; a `PolicyError` names the file, the key and what is expected there."""
    path = folder / DESCRIPTION_FILE
    if not folder.is_dir():
        raise PolicyError(f"{folder}: no such policy directory: give the folder that `finssim train` wrote")
    try:
        data = yaml.safe_load(read_file(path).decode("utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise PolicyError(f"{path}: not valid YAML ({' '.join(str(error).split())})") from error
    if not isinstance(data, dict):
        raise PolicyError(f"{path}: holds {type(data).__name__}, expected a mapping")
    if data.get("format") != FORMAT:
        raise PolicyError(f"{path}: format is {data.get('format')!r}, but this version reads format {FORMAT}")
    try:
        return PolicyDescription.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise PolicyError(f"{path}: {where}: {first['msg']}") from error


def plain_data(value: Any) -> Any:
    """`value` as the YAML file would give it back: NumPy arrays and tuples become lists, NumPy scalars Python's."""
    if isinstance(value, Mapping):
        return {str(key): plain_data(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, list | tuple):
        return [plain_data(item) for item in value]
    return value


def first_difference(trained: Any, given: Any, path: str) -> str | None:
    """Where two pieces of plain data first differ, as "PATH is A in the policy and B here", or None."""
    if isinstance(trained, dict) and isinstance(given, dict):
        for key in [*trained, *(key for key in given if key not in trained)]:
            if key not in trained or key not in given:
                return f"{path}.{key} is {'only' if key in trained else 'not'} in the policy"
            difference = first_difference(trained[key], given[key], f"{path}.{key}")
            if difference:
                return difference
        return None
    if isinstance(trained, list) and isinstance(given, list) and len(trained) == len(given):
        pairs = enumerate(zip(trained, given, strict=True))
        return next((d for i, (a, b) in pairs if (d := first_difference(a, b, f"{path}[{i}]"))), None)
    numbers = isinstance(trained, int | float) and isinstance(given, int | float)
    if trained == given or (numbers and math.isclose(trained, given, rel_tol=1e-9)):
        return None
    return f"{path} is {trained!r} in the policy and {given!r} here"
