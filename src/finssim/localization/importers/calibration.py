"""Importers of camera files written by calibration programs: ROS, Kalibr, OpenCV and MATLAB.

ROS, Kalibr and OpenCV use FinsSim's pixel coordinates: integers at pixel centres. MATLAB's first pixel is 1.
"""

from __future__ import annotations

import io
import re
import struct
import zlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
import yaml

from finssim.core.budget import read_bytes
from finssim.core.importer import Importer
from finssim.core.optics import Lens
from finssim.core.xml_file import read_xml
from finssim.core.yaml_file import read_mapping
from finssim.localization import LocalizationError
from finssim.localization.camera_file import Fields, lens_of, model_of, only

__all__ = ["KALIBR", "MATLAB", "OPENCV", "OTHER_KEYS", "ROS", "key_in", "read_tree", "refuse_strange"]

LARGEST = 64 << 20
"""Greatest size of a MATLAB file, and of an uncompressed variable in it [bytes]."""
COMPRESSED = 15
"""Type number of a compressed variable in a MATLAB file."""
PART_OF_PICTURE = ("binning_x", "binning_y", "roi")
"""Keys of ROS that change the meaning of a pixel, unless their numbers are 0 or 1."""
OTHER_KEYS: dict[str, list[str]] = {
    program: keys.split()
    for program, keys in yaml.safe_load(
        Path(__file__).with_name("other_keys.yaml").read_text(encoding="utf-8")
    ).items()
}
"""Program -> keys of its files that do not describe the lens (`other_keys.yaml`)."""
OPENCV_WORDS = {
    "width": ("imagewidth", "width"), "height": ("imageheight", "height"),
    "matrix": ("cameramatrix", "k", "mtx", "intrinsicmatrix"),
    "distortion": ("distortioncoefficients", "distcoeffs", "distortion", "dist", "d"),
    "model": ("distortionmodel", "cameramodel", "lensmodel", "model"), "fisheye": ("fisheyemodel",),
}  # fmt: skip
"""Part of a lens -> keys used by programs that write files with OpenCV, as `_plain` normalizes them."""


# Functions shared by the readers.


def read_tree(path: Path) -> dict[Any, Any]:
    """Return the mapping of a YAML or JSON file, or of OpenCV's dialect of YAML.

    Raises:
        LocalizationError: The file cannot be read.
    """

    def standard(text: str) -> str:
        text = re.sub(r"\A\ufeff?%YAML[: ]1\.[01][^\n]*\n", "", text)
        return re.sub(r"!!opencv-[\w-]+", "", text)

    return dict(read_mapping(path, LocalizationError, such_as="camera_matrix: {...}", cleaned=standard))


def key_in(head: bytes, *keys: str) -> bool:
    """Return whether a text contains one of the keys, with or without quotes, at any depth."""
    words = "|".join(re.escape(key) for key in keys).encode()
    return re.search(rb"(^|[\s,{\"'])(" + words + rb")[\"']?\s*:", head) is not None


def refuse_strange(tree: Mapping[Any, Any], known: Collection[str], label: str) -> None:
    """Refuse unknown keys with numbers that might belong to the lens.

    Args:
        tree: Mapping of the file.
        known: Its known keys.
        label: Label of the file in messages.
    """
    for key, value in tree.items():
        if key in PART_OF_PICTURE:
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
        only(value, ("type_id", "rows", "cols", "dt", "data"), label)
        value = value.get("data")
    if isinstance(value, (list, tuple)):
        return tuple(x for item in value for x in _flat(item, label))
    return (Fields({"a coefficient": value}, label).number("a coefficient"),)


def _pinhole(numbers: Sequence[float], key: str, label: str) -> dict[str, float]:
    """Return fx, fy, cx and cy of a camera matrix [px].

    Args:
        numbers: The matrix, row by row.
        key: Its key.
        label: Label of the file in messages.
    """
    if len(numbers) != 9:
        raise LocalizationError(f"{label}: {key} holds {len(numbers)} numbers, expected 9")
    if abs(numbers[1]) > 1e-6 * abs(numbers[0]):
        raise LocalizationError(
            f"{label}: the camera matrix has a skew of {numbers[1]:.4g} px, expected 0: calibrate without skew"
        )
    if (numbers[3], *numbers[6:]) != (0.0, 0.0, 0.0, 1.0):
        raise LocalizationError(
            f"{label}: the camera matrix is {list(numbers)}, expected rows [fx, 0, cx], [0, fy, cy], [0, 0, 1]"
        )
    return {"fx": numbers[0], "fy": numbers[4], "cx": numbers[2], "cy": numbers[5]}


def _size(values: Sequence[Any], keys: str, label: str) -> dict[str, int]:
    """Return width and height [px]; the message about missing ones names `keys`."""
    if len(values) != 2 or any(value is None for value in values):
        raise LocalizationError(f"{label}: the size of the image is missing: add {keys}")
    width, height = (_flat(value, label)[0] for value in values)
    return {"width": int(width), "height": int(height)}


def _required(tree: Mapping[Any, Any], key: str, label: str, hint: str = "") -> Any:
    if tree.get(key) is None:
        raise LocalizationError(f"{label}: {key} is missing{hint}")
    return tree[key]


ZEROS = "; zeros mean no distortion"


def _perspective(distortion: Sequence[float]) -> str:
    """Return the lens model for OpenCV's coefficients: rational if there are 8."""
    return "rational" if len(distortion) == 8 else "plumb_bob"


# ROS


def read_ros(path: Path) -> Lens:
    """Read `camera_info`, as a file or as a message of ROS 1 or ROS 2, or the `ost.txt` of its calibrator.

    Raises:
        LocalizationError: The file cannot be read.
    """
    if path.suffix.lower() in (".txt", ".ini"):
        return _read_ost(path)
    tree, label = read_tree(path), str(path)
    names = ("image_width", "image_height", "camera_matrix", "distortion_coefficients")
    if "camera_matrix" not in tree:
        names = ("width", "height", *(("K", "D") if "K" in tree else ("k", "d")))
    width, height, matrix, distortion = names
    refuse_strange(tree, {*names, "distortion_model", *OTHER_KEYS["ros"]}, label)
    given = _flat(_required(tree, distortion, label, ZEROS), label)
    model = model_of(Fields(tree, label).word("distortion_model"), label)
    return lens_of(
        {
            **_size((tree.get(width), tree.get(height)), f"{width} and {height}", label),
            **_pinhole(_flat(tree[matrix], label), matrix, label),
            "model": _perspective(given) if model == "plumb_bob" else model,
            "distortion": given,
        },
        label,
    )


def _read_ost(path: Path) -> Lens:
    """Read the text file of camera_calibration: headings, each followed by its numbers."""
    text = read_bytes(path, LocalizationError, limit=1 << 20).decode("utf-8", "replace")
    sections: dict[str, list[float]] = {}
    heading = ""
    for line in text.splitlines():
        words = line.split()
        try:
            numbers = [float(word) for word in words]
        except ValueError:
            heading = line.strip().lower()
            continue
        if numbers:
            sections.setdefault(heading, []).extend(numbers)
    label = str(path)
    for heading in ("width", "height", "camera matrix", "distortion"):
        _required(sections, heading, label, ": give the ost.txt of camera_calibration, or its ost.yaml")
    distortion = sections["distortion"]
    if len(distortion) == 4:
        raise LocalizationError(
            f"{label}: has 4 coefficients without the name of their model, which may be equidistant or plumb_bob: give "
            "ost.yaml, which names it"
        )
    return lens_of(
        {
            **_size([sections[key][0] for key in ("width", "height")], "width and height", label),
            **_pinhole(sections["camera matrix"], "camera matrix", label),
            "model": _perspective(distortion),
            "distortion": distortion,
        },
        label,
    )


# Kalibr


def read_kalibr(path: Path) -> Lens:
    """Read a camchain of one camera, with a pinhole and radtan, equidistant or no distortion.

    Raises:
        LocalizationError: The file cannot be read, or has several cameras or another model.
    """
    tree, label = read_tree(path), str(path)
    cameras = [key for key in tree if re.fullmatch(r"cam\d+", str(key))]
    if len(cameras) > 1:
        raise LocalizationError(
            f"{label}: holds {', '.join(cameras)}, expected one camera: keep its section alone"
        )
    if cameras:
        inner = _required(tree, cameras[0], label)
        refuse_strange(tree, {cameras[0]}, label)
        label = f"{label}: {cameras[0]}"
        tree = dict(inner) if isinstance(inner, Mapping) else {}
    fields = Fields(tree, label)
    kind = fields.word("camera_model")
    if kind != "pinhole":
        raise fields.error(
            f"unknown camera_model '{kind[:40]}', expected pinhole: lenses of omni, ds and eucm are not read: "
            "calibrate with pinhole-radtan or pinhole-equi"
        )
    known = {"camera_model", "distortion_model", "distortion_coeffs", "intrinsics", "resolution"}
    refuse_strange(tree, {*known, *OTHER_KEYS["kalibr"]}, label)
    word = fields.word("distortion_model")
    given = _flat(_required(tree, "distortion_coeffs", label, ZEROS), label)
    focal = _flat(_required(tree, "intrinsics", label), label)
    if len(focal) != 4:
        raise fields.error(f"intrinsics holds {len(focal)} numbers, expected 4")
    return lens_of(
        {
            **_size(tree.get("resolution") or (), "resolution", label),
            **dict(zip(("fx", "fy", "cx", "cy"), focal, strict=True)),
            "model": "plumb_bob" if word == "none" else model_of(word, label),
            "distortion": () if word == "none" else given,
        },
        label,
    )


# OpenCV


def read_opencv(path: Path) -> Lens:
    """Read a YAML, JSON or XML file of OpenCV's FileStorage, with the key names of OpenCV's samples.

    Raises:
        LocalizationError: The file cannot be read.
    """
    tree, label = _opencv_tree(path), str(path)
    plain = {_plain(key): value for key, value in tree.items()}
    found = {part: next((key for key in keys if key in plain), "") for part, keys in OPENCV_WORDS.items()}
    for part, name in (("matrix", "camera_matrix"), ("distortion", "distortion_coefficients")):
        if not found[part]:
            raise LocalizationError(f"{label}: {name} is missing{ZEROS if part == 'distortion' else ''}")
    given = _flat(plain[found["distortion"]], label)
    if "imagesize" in plain:
        raise LocalizationError(
            f"{label}: image_size may be width and height, or rows and columns: give image_width and image_height"
        )
    refuse_strange(plain, {*found.values(), *OTHER_KEYS["opencv"]}, label)
    size = (plain.get(found["width"]), plain.get(found["height"]))
    model = _model_of_opencv(plain, given, label)
    return lens_of(
        {
            **_size(size, "image_width and image_height", label),
            **_pinhole(_flat(plain[found["matrix"]], label), "camera_matrix", label),
            "model": model,
            "distortion": given,
        },
        label,
    )


def _model_of_opencv(plain: Mapping[str, Any], distortion: Sequence[float], label: str) -> str:
    """Return the lens model by its name or flag; the number of coefficients alone identifies it only for 5 and 8."""
    word = next((plain[key] for key in OPENCV_WORDS["model"] if isinstance(plain.get(key), str)), None)
    if word is not None:
        model = model_of(word.lower(), label)
        return _perspective(distortion) if model == "plumb_bob" else model
    flag = next((plain[key] for key in OPENCV_WORDS["fisheye"] if key in plain), None)
    if flag is None and len(distortion) == 4:
        raise LocalizationError(
            f"{label}: has 4 coefficients and no name of their model: add distortion_model: plumb_bob or equidistant"
        )
    return "fisheye" if flag in (True, 1) else _perspective(distortion)


def _plain(key: Any) -> str:
    """Return a key without separators and in lower case: camera_matrix, Camera_Matrix and cameraMatrix are equal."""
    return str(key).replace("_", "").replace("-", "").lower()


def _opencv_tree(path: Path) -> dict[Any, Any]:
    if path.suffix.lower() != ".xml":
        return read_tree(path)
    return {child.tag: _value(child) for child in read_xml(path, LocalizationError)}


def _value(element: Element) -> Any:
    """Return the content of an element of OpenCV's XML: a mapping, a list, a number or a text."""
    if len(element):
        return {child.tag: _value(child) for child in element}
    words = (element.text or "").replace('"', " ").split()
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        return " ".join(words)
    return numbers[0] if len(numbers) == 1 else numbers


# MATLAB


def read_matlab(path: Path) -> Lens:
    """Read `toStruct(cameraParams)` or `toStruct(intrinsics)`, saved as a .mat file or by jsonencode.

    Raises:
        LocalizationError: The file cannot be read, or holds a fisheye of MATLAB or an object.
    """
    tree, label = _matlab_tree(path), str(path)
    if "MappingCoefficients" in tree or "Intrinsics" in tree:
        raise LocalizationError(
            f"{label}: MATLAB's fisheyeParameters have a model (Scaramuzza's) that is not read: calibrate with "
            "estimateCameraParameters, or with another program"
        )
    refuse_strange(tree, OTHER_KEYS["matlab"], label)
    if tree.get("K") is not None:
        matrix = _flat(tree["K"], label)
    elif tree.get("IntrinsicMatrix") is not None:  # older releases store the transpose
        older = _flat(tree["IntrinsicMatrix"], label)
        matrix = tuple(older[3 * j + i] for i in range(3) for j in range(3)) if len(older) == 9 else older
    else:
        (fx, fy), (cx, cy) = (_two(tree, key, label) for key in ("FocalLength", "PrincipalPoint"))
        matrix = (fx, float(_flat(tree.get("Skew", 0.0), label)[0]), cx, 0.0, fy, cy, 0.0, 0.0, 1.0)
    radial = _flat(_required(tree, "RadialDistortion", label, ZEROS), label)
    tangential = _flat(tree.get("TangentialDistortion") or [0.0, 0.0], label)
    if len(radial) not in (2, 3) or len(tangential) != 2:
        raise LocalizationError(
            f"{label}: expected a RadialDistortion of 2 or 3 numbers, and a TangentialDistortion of 2"
        )
    pinhole = _pinhole(matrix, "the camera matrix", label)
    size = _flat(tree.get("ImageSize") or [], label)
    return lens_of(
        {
            **_size(size[::-1], "ImageSize", label),
            **pinhole,
            "cx": pinhole["cx"] - 1.0,  # the first pixel is 1
            "cy": pinhole["cy"] - 1.0,
            "model": "plumb_bob",
            "distortion": (*radial[:2], *tangential, *(radial[2:] or (0.0,))),
        },
        label,
    )


def _two(tree: Mapping[Any, Any], key: str, label: str) -> tuple[float, float]:
    numbers = _flat(_required(tree, key, label, ": save toStruct(cameraParams)"), label)
    if len(numbers) != 2:
        raise LocalizationError(f"{label}: {key} holds {len(numbers)} numbers, expected 2")
    return numbers[0], numbers[1]


def _matlab_tree(path: Path) -> dict[Any, Any]:
    if path.suffix.lower() != ".mat":
        return read_tree(path)
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    data = read_bytes(path, LocalizationError, limit=LARGEST)
    if data[:10] == b"MATLAB 7.3":
        raise LocalizationError(f"{path}: is of MATLAB's version 7.3: write save(file, 's', '-v7')")
    _refuse_unpacked(data, path)
    broken = (MatReadError, NotImplementedError, ValueError, TypeError, OSError, MemoryError, IndexError)
    try:
        values = loadmat(io.BytesIO(data), simplify_cells=True)
    except broken as error:
        raise LocalizationError(f"{path}: cannot be read as a MATLAB file: {error}") from None
    structs = [
        value for name, value in values.items() if isinstance(value, dict) and not name.startswith("__")
    ]
    if len(structs) != 1:
        raise LocalizationError(
            f"{path}: holds {len(structs)} structs, expected one (an object cannot be read): write "
            "s = toStruct(cameraParams); save(file, 's', '-v7')"
        )
    return {
        key: value.tolist() if isinstance(value, np.ndarray) and value.dtype.kind in "fiub" else value
        for key, value in structs[0].items()
    }


def _refuse_unpacked(data: bytes, path: Path) -> None:
    """Refuse a MATLAB file with a variable that uncompresses to more than a lens can need."""
    order, offset = "<" if data[126:128] == b"IM" else ">", 128
    while offset + 8 <= len(data):
        kind, size = struct.unpack_from(f"{order}II", data, offset)
        packed = data[offset + 8 : offset + 8 + size]
        try:
            large = kind == COMPRESSED and len(zlib.decompressobj().decompress(packed, LARGEST)) == LARGEST
        except zlib.error as error:
            raise LocalizationError(f"{path}: cannot be read as a MATLAB file: {error}") from None
        if large:
            raise LocalizationError(
                f"{path}: holds more than {LARGEST >> 20} MB: save the struct of the lens alone"
            )
        offset += 8 + size


ROS = Importer(
    "lens",
    "ROS (camera_info, ost.txt)",
    lambda path, head: (
        (key_in(head, "distortion_model") and key_in(head, "camera_matrix", "K", "k"))
        or (path.suffix.lower() in (".txt", ".ini") and b"camera matrix" in head.lower())
    ),
    read_ros,
)
KALIBR = Importer(
    "lens",
    "Kalibr (camchain)",
    lambda path, head: key_in(head, "camera_model") and key_in(head, "intrinsics"),
    read_kalibr,
)
OPENCV = Importer(
    "lens",
    "OpenCV (YAML, XML)",
    lambda path, head: (
        b"<opencv_storage" in head
        or key_in(head, "camera_matrix", "Camera_Matrix", "cameraMatrix", "K", "k", "mtx", "intrinsic_matrix")
    ),
    read_opencv,
)
MATLAB = Importer(
    "lens",
    "MATLAB (toStruct as .mat or JSON)",
    lambda path, head: head[:7] == b"MATLAB " or key_in(head, "RadialDistortion", "MappingCoefficients"),
    read_matlab,
)
