"""Camera files: a lens with its record, ours or as OpenCV, ROS and Kalibr write it."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from finssim.files import atomic_write
from finssim.geometry.optics import Lens, OpticsError
from finssim.localization import LocalizationError
from finssim.yaml_file import read_mapping, yaml_text

# Reading typed values out of a YAML mapping, each refusal one sentence with the place.


class Fields:
    """One section of a file; what was not asked for is refused by `finish`."""

    def __init__(self, values: Mapping[Any, Any], label: str) -> None:
        """
        Args:
            values: The section.
            label: File and section, as messages call it.
        """
        self._values = dict(values)
        self._known: list[str] = []
        self.where = label

    def has(self, key: str) -> bool:
        """Whether the key is given, and not null."""
        return self._values.get(key) is not None

    def take(self, key: str, default: Any = None) -> Any:
        """The value as it stands, or the default."""
        self._known.append(key)
        value = self._values.get(key)
        return default if value is None else value

    def number(self, key: str, default: float | None = None) -> float:
        """A finite number.

        Raises:
            LocalizationError: It is missing without a default, or not a finite number.
        """
        value = self.take(key, default)
        if value is None:
            raise self.error(f"{key} is missing, expected a number")
        return self._finite(key, value)

    def numbers(self, key: str, count: int | None, default: Any = None) -> tuple[float, ...]:
        """A list of finite numbers, of that many where `count` is given.

        Raises:
            LocalizationError: It is missing without a default, of another length, or holds something else.
        """
        value = self.take(key, default)
        if value is None:
            raise self.error(f"{key} is missing, expected {count or 'some'} numbers")
        if not isinstance(value, (list, tuple)) or (count is not None and len(value) != count):
            raise self.error(f"{key} is {value!r}, expected {count or 'a list of'} numbers")
        return tuple(self._finite(key, item) for item in value)

    def word(self, key: str, default: str | None = None) -> str:
        """A word.

        Raises:
            LocalizationError: It is missing without a default, or is not a word.
        """
        value = self.take(key, default)
        if not isinstance(value, str):
            raise self.error(f"{key} is {value!r}, expected a word")
        return value

    def section(self, key: str) -> Fields:
        """A mapping inside this one; empty where it is not given.

        Raises:
            LocalizationError: It is no mapping.
        """
        value = self.take(key, {})
        if not isinstance(value, Mapping):
            raise self.error(f"{key} is {value!r}, expected a section of keys and values")
        return Fields(value, f"{self.where}: {key}")

    def finish(self) -> None:
        """Refuse keys that nobody asked for.

        Raises:
            LocalizationError: There is one.
        """
        for key in self._values:
            if key not in self._known:
                raise self.error(f"unknown key '{key}'; known keys: {', '.join(self._known)}")

    def error(self, sentence: str) -> LocalizationError:
        """The error that says so of this section."""
        return LocalizationError(f"{self.where}: {sentence}")

    def _finite(self, key: str, value: Any) -> float:
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
            raise self.error(f"{key} holds {value!r}, expected finite numbers")
        return float(value)


_FISHEYE = ("fisheye", "equidistant", "equi", "kannala_brandt4", "kb4")
"""Names of the fisheye's distortion in other people's files."""


@dataclass(frozen=True)
class CameraFile:
    """What a camera file holds."""

    lens: Lens
    record: Mapping[str, Any] = field(default_factory=dict)
    """How it was found: estimates, intervals, provenance; empty for a foreign file."""


def load_camera(path: str | Path) -> CameraFile:
    """Read a camera file.

    Ours (`lens:`), OpenCV's FileStorage YAML, ROS's `camera_info` (its file, or the message), Kalibr's camchain, and
    our pool files.

    Raises:
        LocalizationError: Unreadable, or without image size or focal length; names the file and what to write.
    """
    path = Path(path)
    tree = read_mapping(
        path, LocalizationError, such_as="lens: {width: 1280, height: 720, fx: 541}", cleaned=_standard
    )
    top = tree.get("camera")
    if isinstance(top, Mapping) and isinstance(top.get("lens"), Mapping):  # a pool file
        return CameraFile(lens_from(top["lens"], f"{path}: camera: lens"))
    if isinstance(tree.get("lens"), Mapping):
        record = tree.get("calibration")
        return CameraFile(
            lens_from(tree["lens"], f"{path}: lens"), record if isinstance(record, Mapping) else {}
        )
    return CameraFile(_foreign(tree, str(path)))


def write_camera(path: str | Path, lens: Lens, record: Mapping[str, Any]) -> None:
    """Write a camera file.

    Args:
        path: The file (.yaml).
        lens: The lens.
        record: How it was found, as plain values.

    Raises:
        OutputError: The file cannot be written.
    """
    head = "# Camera. Pixels: integer coordinates are pixel centres, u to the right, v down; lengths in pixels.\n"
    body = yaml_text({"lens": lens_values(lens), "calibration": dict(record)}, width=110)
    with atomic_write(path) as temporary:
        temporary.write_text(head + body, encoding="utf-8")


def lens_values(lens: Lens) -> dict[str, Any]:
    """A lens as plain values, ready for YAML."""
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
    """The lens of a `lens:` section.

    Args:
        values: The section.
        label: File and section, as messages call it.

    Raises:
        LocalizationError: A key is missing, unknown, or refused by the lens.
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
        "model": fields.word("model", "plumb_bob"),
        "distortion": fields.numbers("distortion", None, ()),
    }
    fields.finish()
    return _lens(arguments, label)


def _lens(arguments: dict[str, Any], label: str) -> Lens:
    try:
        return Lens(**arguments)
    except OpticsError as error:
        raise LocalizationError(f"{label}: {error}") from None


def _standard(text: str) -> str:
    """OpenCV's dialect as YAML: its version line and its tags away."""
    text = re.sub(r"\A\ufeff?%YAML[: ]1\.0[^\n]*\n", "", text)
    return re.sub(r"!!opencv-[\w-]+", "", text)


def _foreign(tree: Mapping[str, Any], label: str) -> Lens:
    """The lens of OpenCV, ROS or Kalibr."""
    kalibr = isinstance(tree.get("cam0"), Mapping)
    fields = Fields(tree["cam0"] if kalibr else tree, f"{label}: cam0" if kalibr else label)
    if kalibr:
        width, height = fields.numbers("resolution", 2)
        fx, fy, cx, cy = fields.numbers("intrinsics", 4)
        distortion = fields.numbers("distortion_coeffs", None, ())
    else:
        size = [*_values(fields, "image_width", "width"), *_values(fields, "image_height", "height")]
        if len(size) != 2:
            raise fields.error("the size of the image is missing: add image_width and image_height")
        width, height = size
        K = _values(fields, "camera_matrix", "K", "k")
        if len(K) != 9:
            raise fields.error("no camera matrix found: give camera_matrix with 9 numbers, or a section lens")
        if abs(K[1]) > 1e-6 * abs(K[0]):
            raise fields.error(
                f"the camera matrix has a skew of {K[1]:.4g} px, expected 0: calibrate without skew"
            )
        fx, fy, cx, cy = K[0], K[4], K[2], K[5]
        distortion = _values(fields, "distortion_coefficients", "D", "d")
    name = fields.word("distortion_model", "").lower()
    if len(distortion) > 8 and not any(distortion[8:]):
        raise fields.error(f"{len(distortion)} distortion coefficients: keep the first 8")
    model = "rational" if name.startswith("rational") or len(distortion) == 8 else "plumb_bob"
    arguments = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "distortion": distortion}
    model = "fisheye" if name in _FISHEYE else model
    return _lens({"width": int(width), "height": int(height), "model": model, **arguments}, label)


def _values(fields: Fields, *names: str) -> tuple[float, ...]:
    """Numbers under the first of some names that is there: one, a list, or OpenCV's and ROS's {rows, cols, data}."""
    key = next((name for name in names if fields.has(name)), None)
    value = None if key is None else fields.take(key)
    if isinstance(value, Mapping):
        fields, key = Fields(value, f"{fields.where}: {key}"), "data"
    elif key is not None and not isinstance(value, (list, tuple)):
        return (fields.number(key),)
    return () if key is None else fields.numbers(key, None)
