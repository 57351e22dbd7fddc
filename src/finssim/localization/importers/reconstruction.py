"""Importers of lenses from programs for 3D reconstruction and SLAM: COLMAP, nerfstudio and ORB-SLAM.

COLMAP and nerfstudio measure pixels from the corner of the first one, so that its centre is at 0.5; ORB-SLAM
follows OpenCV.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path

from finssim.core.budget import read_bytes
from finssim.core.importer import Importer
from finssim.core.optics import COEFFICIENTS, Lens
from finssim.localization import LocalizationError
from finssim.localization.camera_file import Fields, lens_of
from finssim.localization.importers.calibration import OTHER_KEYS, key_in, read_tree, refuse_strange

__all__ = ["COLMAP", "NERFSTUDIO", "ORB_SLAM"]

CORNER = 0.5
"""Coordinate of the centre of the first pixel in COLMAP and nerfstudio [px]."""
LARGEST = 16 << 20
"""Greatest size of COLMAP's camera file [bytes]."""
MODELS = {
    "SIMPLE_PINHOLE": ("plumb_bob", "f cx cy"),
    "PINHOLE": ("plumb_bob", "fx fy cx cy"),
    "SIMPLE_RADIAL": ("plumb_bob", "f cx cy k1"),
    "RADIAL": ("plumb_bob", "f cx cy k1 k2"),
    "OPENCV": ("plumb_bob", "fx fy cx cy k1 k2 p1 p2"),
    "OPENCV_FISHEYE": ("fisheye", "fx fy cx cy k1 k2 k3 k4"),
    "FULL_OPENCV": ("rational", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    "FOV": ("", "fx fy cx cy omega"),
    "SIMPLE_RADIAL_FISHEYE": ("fisheye", "f cx cy k1"),
    "RADIAL_FISHEYE": ("fisheye", "f cx cy k1 k2"),
    "THIN_PRISM_FISHEYE": ("", "fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1"),
}  # fmt: skip
"""COLMAP's model, in the order of its ids -> our lens model (empty if none matches), and its parameters."""


def _lens(
    model: str, size: tuple[int, int], values: Mapping[str, float], label: str, first: float = 0.0
) -> Lens:
    """Return a lens from named values; missing coefficients are 0.

    Args:
        model: Our name of the lens model.
        size: Width and height [px].
        values: fx, fy, cx, cy [px] and coefficients, by name.
        label: Label of the camera in messages.
        first: Centre of the first pixel in the file [px].
    """
    order = COEFFICIENTS[model]
    if strange := [
        name for name, x in values.items() if re.fullmatch(r"[kp]\d", name) and x and name not in order
    ]:
        raise LocalizationError(
            f"{label}: {strange[0]} is {values[strange[0]]:g}, but the lens {model} has none"
        )
    return lens_of(
        {
            "width": size[0], "height": size[1], "fx": values["fx"], "fy": values["fy"],
            "cx": values["cx"] - first, "cy": values["cy"] - first,
            "model": model, "distortion": tuple(values.get(name, 0.0) for name in order),
        },
        label,
    )  # fmt: skip


def _model(name: str, refusal: str) -> tuple[str, str]:
    """Return our lens model and the parameter names of a COLMAP model; `refusal` begins the error message."""
    model, words = MODELS.get(name, ("", ""))
    if not model:
        readable = ", ".join(known for known, (ours, _) in MODELS.items() if ours)
        raise LocalizationError(f"{refusal}, expected one of {readable}")
    return model, words


# COLMAP


def read_colmap(path: Path) -> Lens:
    """Read `cameras.txt` or `cameras.bin` of a reconstruction with one camera.

    Raises:
        LocalizationError: The file cannot be read, or has several cameras or another model.
    """
    data = read_bytes(path, LocalizationError, limit=LARGEST)
    cameras = _binary(data, path) if path.suffix.lower() == ".bin" else _text(data, path)
    if len(cameras) != 1:
        numbers = ", ".join(str(camera[0]) for camera in cameras[:9]) or "none"
        raise LocalizationError(
            f"{path}: its cameras are {numbers}, expected one: keep the line of the one you mean"
        )
    number, name, size, parameters = cameras[0]
    label = f"{path}: camera {number}"
    model, words = _model(name, f"{label}: its model is {name[:40]}")
    names = words.split()
    if len(parameters) != len(names):
        raise LocalizationError(f"{label}: {name} has {len(parameters)} numbers, expected {words}")
    values = dict(zip(names, parameters, strict=True))
    if "f" in values:
        values["fx"] = values["fy"] = values.pop("f")
    return _lens(model, size, values, label, CORNER)


Cameras = list[tuple[int, str, tuple[int, int], Sequence[float]]]
"""Number, model, width and height [px], and parameters of each camera."""


def _text(data: bytes, path: Path) -> Cameras:
    cameras: Cameras = []
    for line, text in enumerate(data.decode("utf-8", "replace").splitlines(), 1):
        words = text.partition("#")[0].split()
        if not words:
            continue
        try:
            number, model, width, height, *parameters = words
            cameras.append((int(number), model, (int(width), int(height)), [float(x) for x in parameters]))
        except ValueError:
            raise LocalizationError(
                f"{path}: line {line} is '{text[:60]}', expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS"
            ) from None
    return cameras


def _binary(data: bytes, path: Path) -> Cameras:
    cameras: Cameras = []
    try:
        (count,), offset = struct.unpack_from("<Q", data), 8
        for _ in range(min(count, len(data))):
            number, kind, width, height = struct.unpack_from("<iiQQ", data, offset)
            model, (_, words) = (
                list(MODELS.items())[kind] if 0 <= kind < len(MODELS) else (str(kind), ("", ""))
            )
            if not words:
                raise LocalizationError(f"{path}: camera {number}: unknown model {kind}")
            parameters = struct.unpack_from(f"<{len(words.split())}d", data, offset + 24)
            cameras.append((number, model, (width, height), parameters))
            offset += 24 + 8 * len(parameters)
    except struct.error:
        raise LocalizationError(
            f"{path}: is cut short, expected COLMAP's cameras.bin: write it again"
        ) from None
    return cameras


# nerfstudio

OF_ONE = ("camera_model", "fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "k3", "k4", "p1", "p2")
"""Keys of nerfstudio that describe a lens."""


def read_nerfstudio(path: Path) -> Lens:
    """Read `transforms.json`; numbers given per frame must be equal in all frames.

    Raises:
        LocalizationError: The file cannot be read, or its frames have different lenses.
    """
    tree, label = read_tree(path), str(path)
    given = {key: tree[key] for key in OF_ONE if key in tree}
    frames = tree.get("frames")
    for frame in frames if isinstance(frames, list) else []:
        of_frame = {key: frame[key] for key in OF_ONE if isinstance(frame, Mapping) and key in frame}
        if any(given.setdefault(key, value) != value for key, value in of_frame.items()):
            raise LocalizationError(
                f"{label}: its frames have different lenses, expected one: keep one frame"
            )
    fields = Fields(given, label)
    refuse_strange(tree, (*OF_ONE, *OTHER_KEYS["nerfstudio"]), label)
    name = fields.word("camera_model", "OPENCV_FISHEYE" if tree.get("is_fisheye") is True else "OPENCV")
    model, _ = _model(name, f"{label}: camera_model is '{name[:40]}'")
    values = {key: fields.number(key, 0.0) for key in OF_ONE if re.fullmatch(r"[kp]\d", key)}
    values |= {"fx": fields.number("fl_x"), "fy": fields.number("fl_y", fields.number("fl_x"))}
    values |= {key: fields.number(key) for key in ("cx", "cy")}
    return _lens(model, (int(fields.number("w")), int(fields.number("h"))), values, label, CORNER)


# ORB-SLAM

TYPES = {"PinHole": "plumb_bob", "Rectified": "plumb_bob", "KannalaBrandt8": "fisheye"}
"""Camera.type of ORB-SLAM3 -> our lens model."""


def read_orb_slam(path: Path) -> Lens:
    """Read the settings of ORB-SLAM2 or ORB-SLAM3 with one camera.

    Raises:
        LocalizationError: The file cannot be read, has two cameras, or has an unknown key of a camera.
    """
    tree, label = read_tree(path), str(path)
    if any(str(key).startswith("Camera2.") for key in tree):
        raise LocalizationError(f"{label}: holds two cameras, expected one: remove the lines of Camera2")
    of_lens, fields = {}, Fields(tree, label)
    for key in tree:
        prefix, _, name = str(key).partition(".")
        if prefix in ("Camera", "Camera1") and name not in OTHER_KEYS["orb_slam"]:
            if not re.fullmatch(r"fx|fy|cx|cy|k\d|p\d", name):
                raise fields.error(f"unknown key '{key}': remove it if it is no part of the lens")
            of_lens[name] = fields.number(key)
    kind = fields.word("Camera.type", "PinHole")
    if kind not in TYPES:
        raise fields.error(f"Camera.type is '{kind[:40]}', expected one of {', '.join(TYPES)}")
    for name in ("fx", "fy", "cx", "cy"):
        if name not in of_lens:
            raise fields.error(f"Camera.{name} is missing")
    if not fields.has("Camera.width") or not fields.has("Camera.height"):
        raise fields.error("the size of the image is missing: add Camera.width and Camera.height")
    size = int(fields.number("Camera.width")), int(fields.number("Camera.height"))
    return _lens(TYPES[kind], size, of_lens, label)


COLMAP = Importer(
    "lens",
    "COLMAP (cameras.txt, .bin)",
    lambda path, head: (
        path.name.lower().endswith("cameras.bin")
        or re.search(rb"(?m)^\s*\d+\s+(" + "|".join(MODELS).encode() + rb")\s+\d+\s+\d+\s", head) is not None
        or b"CAMERA_ID, MODEL" in head
    ),
    read_colmap,
)
NERFSTUDIO = Importer(
    "lens",
    "nerfstudio (transforms.json)",
    lambda path, head: key_in(head, "fl_x", "camera_angle_x"),
    read_nerfstudio,
)
ORB_SLAM = Importer(
    "lens", "ORB-SLAM (settings)", lambda path, head: key_in(head, "Camera.fx", "Camera1.fx"), read_orb_slam
)
