"""Camera files: a lens with its record, in our format or in that of ROS, OpenCV, Kalibr or MATLAB."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from finssim.core.files import atomic_write
from finssim.core.optics import Lens, OpticsError, lens_model
from finssim.core.yaml_file import read_mapping, yaml_text
from finssim.localization import LocalizationError

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
        """Return whether the key has a value that is not null."""
        return self._values.get(key) is not None

    def given(self, key: str) -> bool:
        """Return whether the key is there, with a value or without."""
        return key in self._values

    def take(self, key: str, default: Any = None) -> Any:
        """Return the value as it is, or the default."""
        self._known.append(key)
        value = self._values.get(key)
        return default if value is None else value

    def number(self, key: str, default: float | None = None) -> float:
        """Return a finite number.

        The unit is that of the key.

        Raises:
            LocalizationError: It is missing without a default, or not a finite number.
        """
        value = self.take(key, default)
        if value is None:
            raise self.error(f"{key} is missing, expected a number")
        return self._finite(key, value)

    def numbers(self, key: str, count: int | None, default: Any = None) -> tuple[float, ...]:
        """Return a list of finite numbers, of that many where `count` is given.

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
        """Return a word.

        Raises:
            LocalizationError: It is missing without a default, or is not a word.
        """
        value = self.take(key, default)
        if not isinstance(value, str):
            raise self.error(f"{key} is {value!r}, expected a word")
        return value

    def section(self, key: str) -> Fields:
        """Return a mapping inside this one; empty where it is not given.

        Raises:
            LocalizationError: It is no mapping.
        """
        value = self.take(key, {})
        if not isinstance(value, Mapping):
            raise self.error(f"{key} is {value!r}, expected a section of keys and values")
        return Fields(value, f"{self.where}: {key}")

    def finish(self) -> None:
        """Refuse keys that were not taken.

        Raises:
            LocalizationError: There is one.
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
class _Format:
    """Words of another program's camera file."""

    name: str
    width: str = ""
    height: str = ""
    matrix: str = ""
    """Key of the camera matrix: 9 numbers, or fx, fy, cx, cy."""
    distortion: str = ""
    model: str = ""
    """Key of the lens model's word; empty: the file names none."""
    ignored: str = ""
    """Keys whose numbers are no part of the lens, separated by spaces."""


_ROS = "camera_name rectification_matrix projection_matrix header R P"
_FORMATS = (
    _Format(
        "ROS", "image_width", "image_height", "camera_matrix", "distortion_coefficients", "distortion_model", _ROS
    ),
    _Format("ROS", "width", "height", "K", "D", "distortion_model", _ROS),
    _Format(
        "OpenCV", "image_width", "image_height", "camera_matrix", "distortion_coefficients", "",
        "nframes nr_of_frames board_width board_height square_size marker_size aspectRatio fix_aspect_ratio flags "
        "calibration_time avg_reprojection_error per_view_reprojection_errors extrinsic_parameters image_points "
        "grid_points",
    ),
    _Format(
        "Kalibr", "resolution", "resolution", "intrinsics", "distortion_coeffs", "distortion_model",
        "rostopic cam_overlaps T_cam_imu T_cn_cnm1 timeshift_cam_imu",
    ),
    _Format(
        "MATLAB", "ImageSize", "ImageSize", "IntrinsicMatrix", "RadialDistortion", "",
        "WorldPoints EstimateSkew NumRadialDistortionCoefficients EstimateTangentialDistortion RotationVectors "
        "TranslationVectors ReprojectionErrors DetectedKeypoints Version FocalLength PrincipalPoint Skew",
    ),
)  # fmt: skip
"""Formats of other programs that are read."""

READ = "FinsSim (lens), ROS (camera_info), OpenCV (FileStorage), Kalibr (cam0) and MATLAB (toStruct as JSON)"
"""Formats of camera files, as refusals name them."""

_PART_OF_PICTURE = ("binning_x", "binning_y", "roi")
"""Keys of ROS that change what a pixel is, unless their numbers are 0 or 1."""


@dataclass(frozen=True)
class CameraFile:
    """Content of a camera file."""

    lens: Lens
    record: Mapping[str, Any] = field(default_factory=dict)
    """Record of the calibration: estimates, intervals, provenance; empty for another program's file."""


def load_camera(path: str | Path) -> CameraFile:
    """Read a camera file.

    Formats: ours (`lens:`) and our pool files, OpenCV's FileStorage YAML, ROS's `camera_info` (file or message),
    Kalibr's camchain of one camera, and MATLAB's `jsonencode(toStruct(cameraParams))`.

    Raises:
        LocalizationError: The file is unreadable, in another format, or lacks image size, camera matrix or distortion.
    """
    path = Path(path)
    tree = read_mapping(
        path, LocalizationError, such_as="lens: {width: 1280, height: 720, fx: 541}", cleaned=_standard
    )
    top = tree.get("camera")
    if isinstance(top, Mapping) and isinstance(top.get("lens"), Mapping):  # a pool file
        _only(tree, ("format", "camera", "interface", "frames", "calibration"), str(path))
        return CameraFile(lens_from(top["lens"], f"{path}: camera: lens"))
    if isinstance(tree.get("lens"), Mapping):
        _only(tree, ("lens", "calibration"), str(path))
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
        "model": _model_of(fields.word("model", "plumb_bob"), label),
        "distortion": fields.numbers("distortion", None, ()),
    }
    fields.finish()
    return _lens(arguments, label)


def _only(tree: Mapping[Any, Any], known: tuple[str, ...], label: str) -> None:
    fields = Fields(tree, label)
    for key in known:
        fields.take(key)
    fields.finish()


def _model_of(word: str, label: str) -> str:
    try:
        return lens_model(word)
    except OpticsError as error:
        raise LocalizationError(f"{label}: {error}") from None


def _lens(arguments: dict[str, Any], label: str) -> Lens:
    try:
        return Lens(**arguments)
    except OpticsError as error:
        raise LocalizationError(f"{label}: {error}") from None


def _standard(text: str) -> str:
    """Return OpenCV's dialect as YAML, without its version line and tags."""
    text = re.sub(r"\A\ufeff?%YAML[: ]1\.0[^\n]*\n", "", text)
    return re.sub(r"!!opencv-[\w-]+", "", text)


def _foreign(tree: Mapping[str, Any], label: str) -> Lens:
    """Return the lens of another program's file."""
    if isinstance(tree.get("cam0"), Mapping):
        rest = {key: value for key, value in tree.items() if key != "cam0"}
        return _foreign({**rest, **tree["cam0"]}, f"{label}: cam0")
    fields = Fields(tree, label)
    if tree.get("IntrinsicMatrix") is None and "RadialDistortion" in tree and "K" in tree:
        tree = {
            **{k: v for k, v in tree.items() if k != "K"},
            "IntrinsicMatrix": _transposed(tree["K"], label),
        }
    for words in _FORMATS:
        if tree.get(words.matrix) is not None and (not words.model or tree.get(words.model) is not None):
            break
    else:
        raise fields.error(f"no camera in a known format; expected a camera file of {READ}")
    extra = {"Kalibr": ("camera_model",), "OpenCV": ("fisheye_model",), "MATLAB": ("TangentialDistortion",)}
    known = {
        words.width,
        words.height,
        words.matrix,
        words.distortion,
        words.model,
        *extra.get(words.name, ()),
    }
    _refuse_strange(tree, {*known, *words.ignored.split()}, label)
    width, height = _size(tree, words, label)
    fx, fy, cx, cy = _focal(tree, words, label)
    if tree.get(words.distortion) is None:
        raise fields.error(f"{words.distortion} is missing; zeros mean no distortion")
    given = _flat(tree[words.distortion], label)
    model = _model_of(fields.word(words.model), label) if words.model else "plumb_bob"
    if words.name == "Kalibr" and fields.word("camera_model") != "pinhole":
        raise fields.error(f"unknown camera_model '{tree['camera_model']}', expected pinhole")
    if words.name == "OpenCV" and tree.get("fisheye_model") in (True, 1):
        model = "fisheye"
    if words.name == "MATLAB":  # its first pixel is 1
        tangential = _flat(tree.get("TangentialDistortion") or [0.0, 0.0], label)
        if len(given) not in (2, 3) or len(tangential) != 2:
            raise fields.error(
                "expected a RadialDistortion of 2 or 3 numbers, and a TangentialDistortion of 2"
            )
        given = (*given[:2], *tangential, *(given[2:] or (0.0,)))
        cx, cy = cx - 1.0, cy - 1.0
    if model == "plumb_bob" and len(given) == 8:
        model = "rational"  # OpenCV's superset
    arguments = {"width": width, "height": height, "fx": fx, "fy": fy, "cx": cx, "cy": cy}
    return _lens({**arguments, "model": model, "distortion": given}, label)


def _refuse_strange(tree: Mapping[Any, Any], known: set[str], label: str) -> None:
    """Refuse numbers that would be ignored although they may belong to the lens."""
    for key, value in tree.items():
        if key in _PART_OF_PICTURE:
            if any(x not in (0, 1) for x in _numbers_in(value)):
                raise LocalizationError(
                    f"{label}: {key} is {value!r}, expected every pixel of the full image: calibrate without it"
                )
        elif key not in known and any(_numbers_in(value)):
            raise LocalizationError(
                f"{label}: unknown key '{key}' holds numbers: remove it if it is no part of the lens"
            )


def _numbers_in(value: Any) -> Iterator[float]:
    """Yield all numbers in lists and mappings of any depth."""
    if isinstance(value, (Mapping, list, tuple)):
        for item in value.values() if isinstance(value, Mapping) else value:
            yield from _numbers_in(item)
    elif isinstance(value, (int, float)) and not isinstance(value, bool):
        yield value


def _flat(value: Any, label: str) -> tuple[float, ...]:
    """Return the numbers of a list, of nested lists, or of OpenCV's and ROS's {rows, cols, data}."""
    if isinstance(value, Mapping):
        _only(value, ("type_id", "rows", "cols", "dt", "data"), label)
        value = value.get("data")
    if isinstance(value, (list, tuple)):
        return tuple(x for item in value for x in _flat(item, label))
    return (_number(value, label),)


def _number(value: Any, label: str) -> float:
    return Fields({"a coefficient": value}, label).number("a coefficient")


def _transposed(value: Any, label: str) -> list[float]:
    numbers = _flat(value, label)
    return [numbers[3 * column + row] for row in range(3) for column in range(3)] if len(numbers) == 9 else []


def _size(tree: Mapping[str, Any], words: _Format, label: str) -> tuple[int, int]:
    """Return width and height of the image [px]."""
    if words.width == words.height:  # one list: [width, height] of Kalibr, [rows, columns] of MATLAB
        size = _flat(tree.get(words.width) or [], label)
        width, height = size[:: -1 if words.name == "MATLAB" else 1] if len(size) == 2 else (None, None)
    else:
        width, height = tree.get(words.width), tree.get(words.height)
    if width is None or height is None:
        names = " and ".join(dict.fromkeys((words.width, words.height)))
        raise LocalizationError(f"{label}: the size of the image is missing: add {names}")
    return int(_number(width, label)), int(_number(height, label))


def _focal(tree: Mapping[str, Any], words: _Format, label: str) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy as the file has them [px]."""
    numbers = _flat(tree[words.matrix], label)
    if words.name == "Kalibr" and len(numbers) == 4:
        return numbers[0], numbers[1], numbers[2], numbers[3]
    if words.name == "MATLAB":
        numbers = tuple(_transposed(numbers, label))
    if len(numbers) != 9 or words.name == "Kalibr":
        raise LocalizationError(
            f"{label}: {words.matrix} holds {len(numbers)} numbers, expected {4 if words.name == 'Kalibr' else 9}"
        )
    if abs(numbers[1]) > 1e-6 * abs(numbers[0]):
        raise LocalizationError(
            f"{label}: the camera matrix has a skew of {numbers[1]:.4g} px, expected 0: calibrate without skew"
        )
    if (numbers[3], *numbers[6:]) != (0.0, 0.0, 0.0, 1.0):
        raise LocalizationError(
            f"{label}: the camera matrix is {list(numbers)}, expected rows [fx, 0, cx], [0, fy, cy], [0, 0, 1]"
        )
    return numbers[0], numbers[4], numbers[2], numbers[5]
