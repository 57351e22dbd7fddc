"""Which pixels tags and bodies may touch: rectangles of the image, with room for ripples and motion."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from finssim.geometry.optics import Camera, Interface, Status, project
from finssim.geometry.rotations import quat_rotate
from finssim.sensors.overhead_camera.scene import Body, Pose, TagInScene

Array = NDArray[np.float64]


class Rectangle(NamedTuple):
    """Pixels [left, right) x [top, bottom)."""

    left: int
    top: int
    right: int
    bottom: int

    def clipped(self, width: int, height: int) -> Rectangle:
        """The part of it within an image."""
        left, top = min(max(self.left, 0), width), min(max(self.top, 0), height)
        return Rectangle(left, top, max(min(self.right, width), left), max(min(self.bottom, height), top))

    @property
    def area(self) -> int:
        """Number of pixels."""
        return (self.right - self.left) * (self.bottom - self.top)


_CUBE = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)


def rectangles(
    camera: Camera,
    interface: Interface,
    things: Sequence[TagInScene | Body],
    steepest: float,
    border: int = 2,
) -> list[Rectangle]:
    """A rectangle around the image of each thing; the whole image where that cannot be told.

    Args:
        camera: The camera.
        interface: Still surface.
        things: Tags and bodies.
        steepest: Bound on the slope of ripples.
        border: Pixels added on every side.
    """
    if not things:
        return []
    corners = np.stack([_corners(thing) for thing in things])
    pixels, seen = _seen(camera, interface, corners)
    depth = np.max(np.abs(interface.distance(corners)), axis=1)
    margin = border + _ripple_shift(camera, interface, corners, depth, steepest)
    lens = camera.lens
    whole = Rectangle(0, 0, lens.width, lens.height)
    found = []
    for i in range(len(things)):
        if not seen[i].all():
            found.append(whole)
            continue
        low, high = np.floor(pixels[i].min(0) - margin[i]), np.ceil(pixels[i].max(0) + margin[i]) + 1
        box = Rectangle(*(int(x) for x in np.clip([*low, *high], -(2**30), 2**30)))
        found.append(box.clipped(lens.width, lens.height))
    return found


def merged(found: Iterable[Rectangle]) -> list[Rectangle]:
    """Rectangles that cover the same pixels, with those that overlap joined while that costs few pixels more."""
    rest = [r for r in found if r.area > 0]
    done: list[Rectangle] = []
    while rest:
        a = rest.pop()
        for b in rest:
            both = Rectangle(*np.minimum(a[:2], b[:2]).tolist(), *np.maximum(a[2:], b[2:]).tolist())
            if both.area <= a.area + b.area:
                rest.remove(b)
                rest.append(both)
                break
        else:
            done.append(a)
    return done


def _corners(thing: TagInScene | Body) -> Array:
    """Corners of the thing at the start and the end of the exposure, pool frame, (16, 3)."""
    half = np.array([thing.half_size, thing.half_size, 0.0]) if isinstance(thing, TagInScene) else None
    half = 0.5 * np.asarray(thing.size, float) if half is None else half  # type: ignore[union-attr]
    return np.concatenate([_placed(pose, half) for pose in (thing.pose, thing.end or thing.pose)])


def _placed(pose: Pose, half: Array) -> Array:
    return np.asarray(quat_rotate(pose.orientation, _CUBE * half) + np.asarray(pose.position))


def _seen(camera: Camera, interface: Interface, corners: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Where corners appear, on whichever side of the surface they are, and whether they do."""
    view = project(camera, interface, corners)
    dry = view.status == Status.WRONG_SIDE
    direct, ok = camera.lens.project((corners - camera.position) @ camera.R_pc)
    pixels = np.where(dry[..., None], direct, view.pixels)
    ok = np.where(dry, ok, np.isin(view.status, (Status.OK, Status.OUTSIDE_IMAGE)))
    return pixels, ok & np.isfinite(pixels).all(-1)


def _ripple_shift(
    camera: Camera, interface: Interface, corners: Array, depth: Array, steepest: float
) -> Array:
    """Bound on how far ripples move the image of each thing [px]."""
    if steepest == 0.0:
        return np.zeros(len(depth))
    distance = np.linalg.norm(corners - camera.position, axis=-1)
    height = float(interface.distance(camera.position))
    cosine = np.clip((height + depth) / distance.max(axis=1), 0.1, 1.0)
    bend = abs(1.0 - interface.index_near / interface.index_far) * steepest / cosine**2
    focal = math.sqrt(camera.lens.fx * camera.lens.fy)
    return np.asarray(focal * depth * bend / (distance.min(axis=1) * cosine))
