"""A small camera above a small pool, and how far printed edges lie from where optics puts them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from finssim.core.optics import Camera, Interface, Lens, project
from finssim.core.rotations import matrix_to_quat, quat_from_euler, quat_rotate
from finssim.sim.overhead_camera import ImageSensor, ObjectPose, Scene, TagInScene, TiledBasin, WaterOptics

LENS = Lens(320, 240, 200.0, 201.0, 161.3, 118.2)
CLEAR = WaterOptics(attenuation=(0.0, 0.0, 0.0))
DOWN = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
"""Optical axes of a camera that looks straight down, pool frame."""


def camera_at(position: Any = (0.1, -0.05, 1.9), roll: float = 0.05, pitch: float = -0.04) -> Camera:
    """A camera that looks almost straight down."""
    R = np.stack([quat_rotate(quat_from_euler(roll, pitch, 0.3), axis) for axis in DOWN.T], axis=-1)
    return Camera(LENS, np.asarray(position, float), matrix_to_quat(R))


def square(
    x: float, y: float, z: float = 0.3, yaw: float = 0.2, edge: float = 0.3, **more: Any
) -> TagInScene:
    """A black square in a wide white margin."""
    roll, pitch = more.pop("tilt", (0.0, 0.0))
    q = tuple(float(a) for a in quat_from_euler(roll, pitch, yaw))
    return TagInScene(
        bitmap=np.zeros((8, 8), bool),
        edge=edge,
        margin=edge / 3,
        pose=ObjectPose(position=(x, y, z), orientation=q),
        **more,
    )


def pool(**changes: Any) -> Scene:
    """1 m of clear water without glare, a plain basin, no noise, no tags."""
    parts: dict[str, Any] = {
        "camera": camera_at(),
        "interface": Interface.water(1.0),
        "basin": TiledBasin(lower=(-4.0, -4.0, 0.0), upper=(4.0, 4.0, 3.0), tile=0.0),
        "water": CLEAR,
        "sky": 0.0,
        "sensor": ImageSensor(noise=False),
    }
    return Scene(**{**parts, **changes})


def border_points(tag: TagInScene) -> tuple[np.ndarray, np.ndarray]:
    """Points along the border of a tag and points a little further out, pool frame, (4, 15, 3) each."""
    h = 0.5 * tag.edge
    corners = np.array([[-h, h, 0], [h, h, 0], [h, -h, 0], [-h, -h, 0]])
    along = np.linspace(0.15, 0.85, 15)[:, None]
    edges = np.stack([(1 - along) * corners[i] + along * corners[(i + 1) % 4] for i in range(4)])
    return tuple(
        quat_rotate(tag.pose.orientation, scale * edges) + np.asarray(tag.pose.position)
        for scale in (1.0, 1.02)
    )


def edge_offsets(
    image: np.ndarray, camera: Camera, interface: Interface, tag: TagInScene, reach: float = 3.0
) -> np.ndarray:
    """How far outside of its projection the printed border is seen [px], (4, 15).

    Along the normal of the border's projection the brightness rises from black to white; the border is where it
    is halfway.
    """
    on, out = (project(camera, interface, points).pixels for points in border_points(tag))
    normal = (out - on) / np.linalg.norm(out - on, axis=-1, keepdims=True)
    s = np.arange(-reach, reach + 0.01, 0.05)
    at = on[..., None, :] + s[:, None] * normal[..., None, :]
    grey = image.mean(-1) if image.ndim == 3 else image.astype(float)
    profile = map_coordinates(grey, [at[..., 1], at[..., 0]], order=1)
    low, high = profile[..., :10].mean(-1, keepdims=True), profile[..., -10:].mean(-1, keepdims=True)
    # The area under the step tells where it is, without a search for the crossing.
    return reach - (0.5 * (profile[..., 1:] + profile[..., :-1]) - low).sum(-1) * 0.05 / (high - low)[..., 0]


@pytest.fixture(name="pool")
def _pool() -> Any:
    return pool


@pytest.fixture(name="camera_at")
def _camera_at() -> Any:
    return camera_at


@pytest.fixture(name="square")
def _square() -> Any:
    return square


@pytest.fixture(name="edge_offsets")
def _edge_offsets() -> Any:
    return edge_offsets
