"""Pool file: one camera, the water in front of it, and the pose of the world frame in the frame of the survey."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from finssim.core.files import atomic_write
from finssim.core.optics import Camera, Interface, Layer, OpticsError
from finssim.core.rotations import quat_to_matrix
from finssim.core.yaml_file import read_mapping, yaml_text
from finssim.localization import LocalizationError
from finssim.localization.camera_file import Fields, lens_from, lens_values, load_camera

Array = npt.NDArray[np.float64]

FORMAT = 1
SUREST_PIXEL = 0.05
"""Smallest standard deviation assumed for a corner [px], even if the residuals are smaller."""
USUAL_PIXEL = 0.5
"""Standard deviation of a corner without a calibration [px]."""


@dataclass(frozen=True)
class Pool:
    """Camera that views the water through a plane. All quantities are in the pool frame, that of the survey."""

    camera: Camera
    interface: Interface
    latency: float = 0.0
    """Time stamp of a picture minus the middle of its exposure [s]."""
    world_position: tuple[float, float, float] | None = None
    """Origin of the world frame, pool frame [m]; None: on the surface at x = y = 0, or the pool's own origin if the
    plane is a wall."""
    world_orientation: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    """Rotation of world axes to pool axes, xyzw."""
    record: Mapping[str, Any] = field(default_factory=dict)
    """Record of the calibration: estimates, intervals, provenance."""

    @property
    def is_surface(self) -> bool:
        """Return whether the plane is a water surface with z up: its normal is nearer to z than to the horizontal."""
        return bool(self.interface.normal[2] > np.sqrt(0.5))

    @property
    def T_pw(self) -> Array:
        """Return the transformation from world frame to pool frame [m], (4, 4)."""
        T = np.eye(4)
        T[:3, :3] = quat_to_matrix(self.world_orientation)
        if self.world_position is not None:
            T[:3, 3] = self.world_position
        elif self.is_surface:
            T[2, 3] = self.interface.height(0.0, 0.0)
        return T

    @property
    def T_wp(self) -> Array:
        """Return the transformation from pool frame to world frame [m], (4, 4)."""
        T = self.T_pw
        R, t = T[:3, :3], T[:3, 3].copy()
        T[:3, :3], T[:3, 3] = R.T.copy(), -R.T @ t
        return T

    @property
    def pixel_std(self) -> float:
        """Return the standard deviation of a corner, per axis [px]: that of the calibration's residuals,
        otherwise 0.5."""
        residual = self.record.get("residual")
        value = residual.get("pixel_sigma") if isinstance(residual, Mapping) else None
        return max(float(value), SUREST_PIXEL) if isinstance(value, (int, float)) else USUAL_PIXEL

    @property
    def sha256(self) -> str:
        """Hash of everything that affects a measurement: camera, plane, latency and world frame, but not the
        record."""
        return hashlib.sha256(json.dumps(_values(self), sort_keys=True).encode()).hexdigest()


def load_pool(path: str | Path) -> Pool:
    """Read a pool file.

    Raises:
        LocalizationError: The file is unreadable, a key is missing or unknown, or a number is refused.
    """
    path = Path(path)
    tree = read_mapping(path, LocalizationError, such_as="camera: {position: [0, 0, 2.2]}")
    top = Fields(tree, str(path))
    if int(top.number("format", FORMAT)) != FORMAT:
        raise top.error(f"format is {tree['format']}, expected {FORMAT}: this FinsSim cannot read it")
    camera, latency = _camera(top.section("camera"), path)
    interface = _interface(top.section("interface"))
    frames = top.section("frames")
    world = frames.section("world")
    position = world.numbers("position", 3) if world.has("position") else None
    orientation = _unit(world, "orientation", world.numbers("orientation", 4, (0.0, 0.0, 0.0, 1.0)))
    world.finish()
    frames.finish()
    top.section("calibration")  # a record, not read further
    top.finish()
    return Pool(
        camera, interface, latency, _three(position), _four(orientation), dict(tree.get("calibration") or {})
    )


def write_pool(pool: Pool, path: str | Path) -> None:
    """Write a pool file; `load_pool` reads it back with the same hash.

    Raises:
        OutputError: The file cannot be written.
    """
    head = (
        "# Camera, water plane and frames of a pool; metres, the frame of the survey (the pool frame).\n"
        "# camera.orientation: optical axes (x right, y down, z along the view) to pool axes, xyzw.\n"
        "# interface: n . X + b = 0 with n into the camera's side; index_near on that side, index_far beyond.\n"
    )
    body = yaml_text({**_values(pool), "calibration": dict(pool.record)}, width=110)
    with atomic_write(path) as temporary:
        temporary.write_text(head + body, encoding="utf-8")


def _values(pool: Pool) -> dict[str, Any]:
    camera, interface = pool.camera, pool.interface
    return {
        "format": FORMAT,
        "camera": {
            "lens": lens_values(camera.lens),
            "position": [float(x) for x in camera.position],
            "orientation": [float(x) for x in camera.orientation],
            "latency": float(pool.latency),
        },
        "interface": {
            "normal": [float(x) for x in interface.normal],
            "offset": float(interface.offset),
            "index_near": float(interface.index_near),
            "index_far": float(interface.index_far),
            "window": [
                {"thickness": float(layer.thickness), "index": float(layer.index)}
                for layer in interface.window
            ],
        },
        "frames": {
            "world": {
                "position": [float(x) for x in pool.T_pw[:3, 3]],
                "orientation": [float(x) for x in pool.world_orientation],
            }
        },
    }


def _camera(fields: Fields, path: Path) -> tuple[Camera, float]:
    lens = fields.get("lens")
    if isinstance(lens, str):  # a camera file in the same folder
        lens_ = load_camera(path.parent / lens).lens
    elif isinstance(lens, Mapping):
        lens_ = lens_from(lens, f"{fields.where}: lens")
    else:
        raise fields.error("lens is missing: write the section of a camera file, or the file's name")
    position = fields.numbers("position", 3)
    orientation = _unit(fields, "orientation", fields.numbers("orientation", 4))
    latency = fields.number("latency", 0.0)
    fields.finish()
    return Camera(lens_, np.array(position), np.array(orientation)), latency


def _interface(fields: Fields) -> Interface:
    """Read the plane, from its normal and offset (or a point on it), or from the height of level water."""
    near, far = fields.number("index_near", 1.0003), fields.number("index_far", 1.333)
    layers = []
    for item in fields.get("window", ()):
        layer = Fields(item if isinstance(item, Mapping) else {}, f"{fields.where}: window")
        layers.append(Layer(layer.number("thickness"), layer.number("index")))
        layer.finish()
    if fields.has("height"):
        normal: tuple[float, ...] = (0.0, 0.0, 1.0)
        offset = -fields.number("height")
    else:
        normal = _unit(fields, "normal", fields.numbers("normal", 3))
        if fields.has("point"):
            offset = -float(np.dot(normal, fields.numbers("point", 3)))
        else:
            offset = fields.number("offset")
    fields.finish()
    try:
        return Interface(np.array(normal), offset, near, far, tuple(layers))
    except OpticsError as error:
        raise fields.error(str(error)) from None


def _unit(fields: Fields, key: str, values: tuple[float, ...]) -> tuple[float, ...]:
    length = float(np.linalg.norm(values))
    if abs(length - 1.0) > 1e-3:
        raise fields.error(f"{key} has length {length:.4g}, expected 1")
    # A normalized value stays unchanged to the last bit, so that a file keeps its hash.
    return values if abs(length - 1.0) < 1e-15 else tuple(float(x / length) for x in values)


def _three(values: tuple[float, ...] | None) -> tuple[float, float, float] | None:
    return None if values is None else (values[0], values[1], values[2])


def _four(values: tuple[float, ...]) -> tuple[float, float, float, float]:
    return values[0], values[1], values[2], values[3]
