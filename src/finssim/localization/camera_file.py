"""Camera files: a lens with its calibration record, in FinsSim's format or one that an importer reads."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from finssim.core.files import atomic_write
from finssim.core.importer import first_bytes, importers, recognised
from finssim.core.optics import Lens, OpticsError, lens_model
from finssim.core.yaml_file import read_mapping, yaml_text
from finssim.localization import LocalizationError

OWN = re.compile(rb"^(lens|camera)\s*:", re.MULTILINE)
"""Beginning of a line that identifies FinsSim's own camera and pool files."""

# Typed values of a YAML mapping; every error message is one sentence that names the file and section.


class Fields:
    """One section of a file; `finish` refuses the keys that were not read."""

    def __init__(self, values: Mapping[Any, Any], label: str) -> None:
        """
        Args:
            values: The section.
            label: Label of the file and section in messages.
        """
        self._values = dict(values)
        self._known: list[str] = []
        self.where = label

    def has(self, key: str) -> bool:
        """Return whether the key has a value that is not null."""
        return self._values.get(key) is not None

    def contains(self, key: str) -> bool:
        """Return whether the key is present, with or without a value."""
        return key in self._values

    def get(self, key: str, default: Any = None) -> Any:
        """Return the unchecked value, or the default."""
        self._known.append(key)
        value = self._values.get(key)
        return default if value is None else value

    def number(self, key: str, default: float | None = None) -> float:
        """Return a finite number, in the unit that the key implies.

        Raises:
            LocalizationError: The key is missing without a default, or its value is not a finite number.
        """
        value = self.get(key, default)
        if value is None:
            raise self.error(f"{key} is missing, expected a number")
        return self._finite(key, value)

    def numbers(self, key: str, count: int | None, default: Any = None) -> tuple[float, ...]:
        """Return a list of finite numbers, `count` of them unless it is None.

        Raises:
            LocalizationError: The key is missing without a default, the length differs, or an item is not a
                finite number.
        """
        value = self.get(key, default)
        if value is None:
            raise self.error(f"{key} is missing, expected {count or 'some'} numbers")
        if not isinstance(value, (list, tuple)) or (count is not None and len(value) != count):
            raise self.error(f"{key} is {value!r}, expected {count or 'a list of'} numbers")
        return tuple(self._finite(key, item) for item in value)

    def word(self, key: str, default: str | None = None) -> str:
        """Return a string.

        Raises:
            LocalizationError: The key is missing without a default, or its value is not a string.
        """
        value = self.get(key, default)
        if not isinstance(value, str):
            raise self.error(f"{key} is {value!r}, expected a word")
        return value

    def section(self, key: str) -> Fields:
        """Return a nested mapping; empty if the key is missing.

        Raises:
            LocalizationError: The value is not a mapping.
        """
        value = self.get(key, {})
        if not isinstance(value, Mapping):
            raise self.error(f"{key} is {value!r}, expected a section of keys and values")
        return Fields(value, f"{self.where}: {key}")

    def finish(self) -> None:
        """Refuse keys that were not read.

        Raises:
            LocalizationError: There is an unread key.
        """
        for key in self._values:
            if key not in self._known:
                raise self.error(f"unknown key '{key}'; known keys: {', '.join(self._known)}")

    def error(self, sentence: str) -> LocalizationError:
        """Return the error for a sentence about this section."""
        return LocalizationError(f"{self.where}: {sentence}")

    def _finite(self, key: str, value: Any) -> float:
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
            raise self.error(f"{key} holds {value!r}, expected finite numbers")
        return float(value)


@dataclass(frozen=True)
class CameraFile:
    """Content of a camera file."""

    lens: Lens
    record: Mapping[str, Any] = field(default_factory=dict)
    """Record of the calibration: estimates, intervals, provenance; empty for another program's file."""


class LensWarning(UserWarning):
    """Warning about a lens that is possible but probably not the intended one."""


def load_camera(path: str | Path) -> CameraFile:
    """Read a camera file: FinsSim's own (`lens:`), a pool file, or a format for which a lens importer exists.

    Warns with a `LensWarning` if the principal point lies outside the middle half of the picture.

    Raises:
        LocalizationError: The file is unreadable, in another format, or lacks image size, camera matrix or
            distortion.
    """
    path = Path(path)
    file = _camera_file(path)
    lens = file.lens
    if (
        abs(2.0 * lens.cx - lens.width) > 0.5 * lens.width
        or abs(2.0 * lens.cy - lens.height) > 0.5 * lens.height
    ):
        warnings.warn(
            f"{path}: the principal point is ({lens.cx:.0f}, {lens.cy:.0f}), outside the middle half of the picture of "
            f"{lens.width} x {lens.height}: are width and height those of the pictures of the calibration, and cx and "
            "cy not exchanged?",
            LensWarning,
            stacklevel=2,
        )
    return file


def _camera_file(path: Path) -> CameraFile:
    try:
        path.open("rb").close()
    except OSError as error:
        raise LocalizationError(f"{path}: cannot be read: {error.strerror or error}") from None
    known = importers("lens")
    if OWN.search(first_bytes(path)) is None and (format := recognised("lens", path)) is not None:
        return CameraFile(known[format].read(path))
    tree = read_mapping(path, LocalizationError, such_as="lens: {width: 1280, height: 720, fx: 541}")
    top = tree.get("camera")
    if isinstance(top, Mapping) and isinstance(top.get("lens"), Mapping):  # a pool file
        only(tree, ("format", "camera", "interface", "frames", "calibration"), str(path))
        return CameraFile(lens_from(top["lens"], f"{path}: camera: lens"))
    if isinstance(tree.get("lens"), Mapping):
        only(tree, ("lens", "calibration"), str(path))
        record = tree.get("calibration")
        return CameraFile(
            lens_from(tree["lens"], f"{path}: lens"), record if isinstance(record, Mapping) else {}
        )
    titles = ", ".join(importer.title for importer in known.values())
    raise LocalizationError(f"{path}: no camera in a known format; expected FinsSim (lens), {titles}")


def write_camera(path: str | Path, lens: Lens, record: Mapping[str, Any]) -> None:
    """Write a camera file.

    Args:
        path: The file (.yaml).
        lens: The lens.
        record: Record of the calibration, as plain values.

    Raises:
        OutputError: The file cannot be written.
    """
    head = "# Camera. Pixels: integer coordinates are pixel centres, u to the right, v down; lengths in pixels.\n"
    body = yaml_text({"lens": lens_values(lens), "calibration": dict(record)}, width=110)
    with atomic_write(path) as temporary:
        temporary.write_text(head + body, encoding="utf-8")


def lens_values(lens: Lens) -> dict[str, Any]:
    """Return a lens as plain values, ready for YAML."""
    return {
        "model": lens.model,
        "width": lens.width,
        "height": lens.height,
        "fx": float(lens.fx),
        "fy": float(lens.fy),
        "cx": float(lens.cx),
        "cy": float(lens.cy),
        "distortion": [float(x) for x in lens.distortion],
    }


def lens_from(values: Mapping[Any, Any], label: str) -> Lens:
    """Return the lens of a `lens:` section.

    Args:
        values: Content of the section.
        label: Label of the file and section in messages.

    Raises:
        LocalizationError: A key is missing or unknown, or `Lens` refuses a value.
    """
    fields = Fields(values, label)
    fx = fields.number("fx")
    arguments = {
        "width": int(fields.number("width")),
        "height": int(fields.number("height")),
        "fx": fx,
        "fy": fields.number("fy", fx),
        "cx": fields.number("cx"),
        "cy": fields.number("cy"),
        "model": model_of(fields.word("model", "plumb_bob"), label),
        "distortion": fields.numbers("distortion", None, ()),
    }
    fields.finish()
    return lens_of(arguments, label)


def only(tree: Mapping[Any, Any], known: Sequence[str], label: str) -> None:
    """Refuse unknown keys.

    Raises:
        LocalizationError: There is an unknown key.
    """
    fields = Fields(tree, label)
    for key in known:
        fields.get(key)
    fields.finish()


def model_of(word: str, label: str) -> str:
    """Return the lens model of a name, as `lens_model`.

    Raises:
        LocalizationError: The name is unknown.
    """
    try:
        return lens_model(word)
    except OpticsError as error:
        raise LocalizationError(f"{label}: {error}") from None


def lens_of(arguments: Mapping[str, Any], label: str) -> Lens:
    """Return the lens with the given arguments of `Lens`.

    Raises:
        LocalizationError: `Lens` refuses them.
    """
    try:
        return Lens(**arguments)
    except OpticsError as error:
        raise LocalizationError(f"{label}: {error}") from None
