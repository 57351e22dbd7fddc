"""Camera files: a lens with its record, ours or as OpenCV, ROS, Kalibr and plain lists of numbers write it."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from finssim.files import atomic_write
from finssim.geometry.optics import COEFFICIENTS, Lens, OpticsError, lens_model
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


_SECTIONS = ("lens", "camera", "intrinsics", "cam0")
"""Where foreign files keep a camera, if not at the top."""
_WIDTH = ("image_width", "width", "img_width")
_HEIGHT = ("image_height", "height", "img_height")
_SIZE = ("image_size", "resolution", "img_size", "size")
_MATRIX = ("camera_matrix", "K", "mtx", "intrinsic_matrix", "cameraMatrix", "intrinsics", "camera_intrinsics")
_DISTORTION = (
    "distortion_coefficients",
    "distortion_coeffs",
    "dist_coeffs",
    "distCoeffs",
    "dist_coefs",
    "distortion",
    "dist",
    "D",
)
_MODEL = (
    "distortion_model",
    "model",
    "lens_model",
    "camera_model",
    "projection_model",
    "camera_type",
    "distortion_type",
)
_ANY_MODEL = ("pinhole", "perspective", "none")
"""Words that leave the distortion open."""
_FISHEYE = ("fisheye", "is_fisheye", "fisheye_model")
"""Keys of a truth value."""
_PART_OF_PICTURE = ("binning_x", "binning_y", "roi")
"""Keys that change what a pixel is, unless their numbers are 0 or 1."""
_NAMES = ("fx", "fy", "cx", "cy", *COEFFICIENTS["rational"], "p1", "p2")
_NO_LENS = set(
    "nframes nrofframes boardwidth boardheight squaresize markersize aspectratio fixaspectratio flags calibrationtime "
    "avgreprojectionerror perviewreprojectionerrors reprojectionerror meanreprojectionerror extrinsicparameters "
    "imagepoints gridpoints rms rmserror meanerror error ret rvecs tvecs rectificationmatrix projectionmatrix r p seq "
    "ratehz "
    "header stamp timestamp date time tcamimu timucam tcncnm1 tbs timeshiftcamimu camoverlaps fps framerate rate "
    "version format id cameraid serial serialnumber numimages nimages calibration".split()
)
"""Keys, in small letters and digits alone, whose numbers are no part of a lens."""


@dataclass(frozen=True)
class CameraFile:
    """What a camera file holds."""

    lens: Lens
    record: Mapping[str, Any] = field(default_factory=dict)
    """How it was found: estimates, intervals, provenance; empty for a foreign file."""


def load_camera(path: str | Path) -> CameraFile:
    """Read a camera file.

    Ours (`lens:`), OpenCV's FileStorage YAML, ROS's `camera_info` YAML, Kalibr's camchain, JSON or YAML with
    `camera_matrix` (or K) and distortion under one of their usual names, and our pool files.

    Raises:
        LocalizationError: Unreadable, or without image size or focal length; names the file and what to write.
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
    """OpenCV's dialect as YAML: its version line and its tags away."""
    text = re.sub(r"\A\ufeff?%YAML[: ]1\.0[^\n]*\n", "", text)
    return re.sub(r"!!opencv-[\w-]+", "", text)


def _foreign(tree: Mapping[str, Any], label: str) -> Lens:
    """The lens in other people's words."""
    for key in _SECTIONS:
        inner = tree.get(key)
        if isinstance(inner, Mapping) and _first(inner, (*_MATRIX, "fx")) is not None:
            return _foreign({**{k: v for k, v in tree.items() if k != key}, **inner}, f"{label}: {key}")
    _refuse_strange(tree, label)
    width, height = _size(tree, label)
    fx, fy, cx, cy = _focal(tree, label)
    value = _first(tree, _DISTORTION)
    given = None if value is None else _flat(value, label)
    model = _model(tree, given, label)
    return _lens(
        {
            "width": width,
            "height": height,
            "fx": fx,
            "fy": fy,
            "cx": cx,
            "cy": cy,
            "model": model,
            "distortion": _named(tree, model, label) if given is None else given,
        },
        label,
    )


def _refuse_strange(tree: Mapping[Any, Any], label: str) -> None:
    """Refuse numbers that would be ignored although they may belong to the lens."""
    known = {*_WIDTH, *_HEIGHT, *_SIZE, *_MATRIX, *_DISTORTION, *_MODEL, *_FISHEYE, *_NAMES}
    for key, value in tree.items():
        if key in _PART_OF_PICTURE:
            if any(x not in (0, 1) for x in _numbers_in(value)):
                raise LocalizationError(
                    f"{label}: {key} is {value!r}, expected the whole picture, every pixel: calibrate without it"
                )
        elif key not in known and re.sub("[^a-z0-9]", "", str(key).lower()) not in _NO_LENS:
            if any(_numbers_in(value)):
                raise LocalizationError(
                    f"{label}: unknown key '{key}' holds numbers: remove it, or rename it, if it belongs to the lens, "
                    f"to one of {', '.join(sorted(known))}"
                )


def _numbers_in(value: Any) -> Iterator[float]:
    """All numbers in lists and mappings of any depth."""
    if isinstance(value, (Mapping, list, tuple)):
        for item in value.values() if isinstance(value, Mapping) else value:
            yield from _numbers_in(item)
    elif isinstance(value, (int, float)) and not isinstance(value, bool):
        yield value


def _first(tree: Mapping[str, Any], names: tuple[str, ...]) -> Any:
    return next((tree[name] for name in names if tree.get(name) is not None), None)


def _flat(value: Any, label: str) -> tuple[float, ...]:
    """Numbers of a list, of nested lists, or of OpenCV's and ROS's {rows, cols, data}."""
    if isinstance(value, Mapping):
        _only(value, ("type_id", "rows", "cols", "dt", "data"), label)
        value = value.get("data")
    if isinstance(value, (list, tuple)):
        return tuple(x for item in value for x in _flat(item, label))
    return Fields({"it": value}, label).numbers("it", None, ()) if value is None else (_number(value, label),)


def _number(value: Any, label: str) -> float:
    return Fields({"a coefficient": value}, label).number("a coefficient")


def _size(tree: Mapping[str, Any], label: str) -> tuple[int, int]:
    size = _first(tree, _SIZE)
    width, height = _first(tree, _WIDTH), _first(tree, _HEIGHT)
    if width is None and size is not None:
        width, height = (*_flat(size, label), None, None)[:2]
    if width is None or height is None:
        raise LocalizationError(
            f"{label}: the size of the image is missing: add image_width and image_height"
        )
    return int(_number(width, label)), int(_number(height, label))


def _focal(tree: Mapping[str, Any], label: str) -> tuple[float, float, float, float]:
    value = _first(tree, _MATRIX)
    if value is None and tree.get("fx") is not None:
        fields = Fields(tree, label)
        fx = fields.number("fx")
        return fx, fields.number("fy", fx), fields.number("cx"), fields.number("cy")
    numbers = _flat(value, label)
    if len(numbers) == 4:
        return numbers[0], numbers[1], numbers[2], numbers[3]
    if len(numbers) == 9:
        if (numbers[2], numbers[5]) == (0.0, 0.0) and (numbers[6], numbers[7]) != (0.0, 0.0):
            raise LocalizationError(
                f"{label}: the camera matrix is transposed, as MATLAB writes it: write its columns as rows, and "
                "subtract 1 from cx and cy if MATLAB computed them (its first pixel is 1, here it is 0)"
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
    raise LocalizationError(
        f"{label}: no camera matrix found: give fx, fy, cx, cy [px], or camera_matrix with 9 numbers"
    )


def _model(tree: Mapping[str, Any], given: tuple[float, ...] | None, label: str) -> str:
    """The model that the file names, or else that its coefficients mean.

    Args:
        tree: The file.
        given: Its list of coefficients; None where it names each, or none.
        label: What messages call it.

    Raises:
        LocalizationError: An unknown word, or two words that differ.
    """
    words = {key: Fields(tree, label).word(key) for key in _MODEL if tree.get(key) is not None}
    models = {_model_of(word, label) for word in words.values() if word.lower() not in _ANY_MODEL}
    models |= {"fisheye" for key in _FISHEYE if tree.get(key) in (True, 1)}
    if len(models) > 1:
        raise LocalizationError(
            f"{label}: the file names two lens models, {' and '.join(sorted(models))}: keep one"
        )
    if models == {"plumb_bob"} and len(given or ()) == 8:
        return "rational"  # OpenCV's superset
    if models:
        return models.pop()
    names = {name for name in _NAMES if tree.get(name) is not None}
    if given is None and "k4" in names and not names & {"p1", "p2", "k5", "k6"}:
        return "fisheye"
    return "rational" if len(given or ()) >= 8 or names & {"k4", "k5", "k6"} else "plumb_bob"


def _named(tree: Mapping[str, Any], model: str, label: str) -> tuple[float, ...]:
    """Coefficients that stand alone, each under its name; none where there are none."""
    names = [name for name in COEFFICIENTS["rational"] if tree.get(name) is not None]
    for name in names:
        if name not in COEFFICIENTS[model]:
            raise LocalizationError(
                f"{label}: a {model} lens has no {name}: remove it, or name another model"
            )
    return tuple(_number(tree.get(name) or 0.0, label) for name in COEFFICIENTS[model]) if names else ()
