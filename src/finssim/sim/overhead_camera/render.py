"""The overhead camera: pictures of a complete scene, or of the regions around the tags alone."""
# mypy: disable-error-code="attr-defined,call-overload,no-untyped-call,index"

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.core.optics import Status, project
from finssim.core.rotations import quat_rotate, quat_to_matrix
from finssim.sim.overhead_camera.photometry import SensorLevels, digitise, noise_key
from finssim.sim.overhead_camera.raycast import BasinData, SceneData, TagData, cast
from finssim.sim.overhead_camera.scene import (
    ImageSensor,
    Scene,
    SurfaceFrame,
    TagInScene,
    TiledBasin,
    corner_rays_s,
    surface_frame,
)
from finssim.sim.overhead_camera.surface import SurfaceWave, layout_of, pack_waves, waves_of
from finssim.sim.sensors.batch import SensorError

# Pixels that tags may affect: rectangles of the image, with margins for ripples and motion.


Array = NDArray[np.float64]


class Rectangle(NamedTuple):
    """Pixels [left, right) x [top, bottom)."""

    left: int
    top: int
    right: int
    bottom: int

    def clipped(self, width: int, height: int) -> Rectangle:
        """Return the part of the rectangle within an image."""
        x0, top = min(max(self.left, 0), width), min(max(self.top, 0), height)
        return Rectangle(x0, top, max(min(self.right, width), x0), max(min(self.bottom, height), top))

    @property
    def area(self) -> int:
        """Number of pixels."""
        return (self.right - self.left) * (self.bottom - self.top)


_SQUARE = np.array([[x, y, 0.0] for x in (-1, 1) for y in (-1, 1)])
BORDER = 2
"""Margin around a tag that its picture may affect, besides the lens' spot [px]."""


def rectangles(scene: Scene, tags: Sequence[TagInScene], steepest: float) -> list[Rectangle]:
    """Return a rectangle around the image of each tag, or the complete image where the tag cannot be bounded.

    Args:
        scene: Camera and still surface.
        tags: The tags.
        steepest: Bound on the slope of ripples [-].
    """
    if not tags:
        return []
    lens = scene.camera.lens
    corners = np.stack([_corners(tag) for tag in tags])
    pixels, visible = _seen(scene, corners)
    depth = np.max(np.abs(scene.interface.distance(corners)), axis=1)
    margin = BORDER + math.ceil(scene.sensor.spot) + _ripple_shift(scene, corners, depth, steepest)
    boxes = []
    for i in range(len(tags)):
        box = Rectangle(0, 0, lens.width, lens.height)
        if visible[i].all():
            low, high = np.floor(pixels[i].min(0) - margin[i]), np.ceil(pixels[i].max(0) + margin[i]) + 1
            box = Rectangle(*(int(x) for x in np.clip([*low, *high], -(2**30), 2**30)))
        boxes.append(box.clipped(lens.width, lens.height))
    return boxes


def merged(boxes: Iterable[Rectangle]) -> list[Rectangle]:
    """Return rectangles that cover the same pixels; overlapping ones are joined where that adds no more
    pixels."""
    rest = [r for r in boxes if r.area > 0]
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


def _corners(tag: TagInScene) -> Array:
    """Return the corners of a tag at the start and the end of the exposure, pool frame, (8, 3)."""
    poses, half = (tag.pose, tag.end or tag.pose), tag.half_size
    return np.concatenate(
        [quat_rotate(x.orientation, half * _SQUARE) + np.asarray(x.position) for x in poses]
    )


def _seen(scene: Scene, corners: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return the image points of corners, above or below the surface, and whether each is visible."""
    camera = scene.camera
    view = project(camera, scene.interface, corners)
    dry = view.status == Status.WRONG_SIDE
    direct, ok = camera.lens.project((corners - camera.position) @ camera.R_pc)
    pixels = np.where(dry[..., None], direct, view.pixels)
    ok = np.where(dry, ok, np.isin(view.status, (Status.OK, Status.OUTSIDE_IMAGE)))
    return pixels, ok & np.isfinite(pixels).all(-1)


def _ripple_shift(scene: Scene, corners: Array, depth: Array, steepest: float) -> Array:
    """Return a bound on the displacement of each tag's image by ripples [px]."""
    camera, interface = scene.camera, scene.interface
    if steepest == 0.0:
        return np.zeros(len(depth))
    distance = np.linalg.norm(corners - camera.position, axis=-1)
    height = float(interface.distance(camera.position))
    cosine = np.clip((height + depth) / distance.max(axis=1), 0.1, 1.0)
    bend = abs(1.0 - interface.index_near / interface.index_far) * steepest / cosine**2
    focal = math.sqrt(camera.lens.fx * camera.lens.fy)
    return np.asarray(focal * depth * bend / (distance.min(axis=1) * cosine))


# The scene as the structs that the ray caster reads, on one device.


def pack_scene(scene: Scene, frame: SurfaceFrame, device: Any) -> SceneData:
    """Return the struct of everything except tags and waves, which change from picture to picture."""
    data = SceneData()
    data.camera_height = frame.camera_height
    data.index_near, data.index_far = scene.interface.index_near, scene.interface.index_far
    layers = scene.interface.window
    data.layer_thickness = wp.array([x.thickness for x in layers], dtype=float, device=device)
    data.layer_index = wp.array([x.index for x in layers], dtype=float, device=device)
    data.attenuation, data.veil = wp.vec3(*scene.water.attenuation), wp.vec3(*scene.water.veil)
    data.sky = scene.sky
    data.basin = _basin(scene.basin, frame)
    data.shutter, data.spot = scene.sensor.shutter, scene.sensor.spot
    return data


def on_device(table: NDArray[Any], dtype: Any, device: Any) -> wp.array[Any]:
    """Return a contiguous table of any unit as a Warp array.

    On a CPU the array shares the memory; Warp's own constructor would inspect it for 0.6 ms first.
    """
    if not table.size:
        return wp.empty(table.shape, dtype=dtype, device=device)
    if not wp.get_device(device).is_cpu:
        return wp.array(table, dtype=dtype, device=device)
    array = wp.array(ptr=table.ctypes.data, dtype=dtype, shape=table.shape, device=device)
    array.table = table  # lives as long as the array
    return array


def _tags(tags: Sequence[TagInScene], frame: SurfaceFrame) -> NDArray[Any]:
    table = np.zeros(len(tags), dtype=layout_of(TagData))
    offset = 0
    for row, tag in zip(table, tags, strict=True):
        for pose, position_field, axes in (
            (tag.pose, "start", "q_start"),
            (tag.end or tag.pose, "end", "q_end"),
        ):
            row[position_field] = frame.point(pose.position)
            row[axes] = frame.quaternion(quat_to_matrix(pose.orientation))
        if np.dot(row["q_start"], row["q_end"]) < 0.0:
            row["q_end"] *= -1.0  # the same axes, with the shorter rotation from the start
        row["moving"] = tag.end is not None
        row["cell"], row["half"] = tag.cell, tag.half_size
        row["cells"], row["offset"] = len(tag.bitmap), offset
        row["white"], row["black"] = tag.white, tag.black
        offset += tag.bitmap.size
    return table


def _basin(basin: TiledBasin, frame: SurfaceFrame) -> BasinData:
    data = BasinData()
    data.R_bs = wp.mat33(*frame.R_sp.T.ravel())
    data.origin = wp.vec3(*frame.point(basin.lower))
    data.size = wp.vec3(*np.subtract(basin.upper, basin.lower))
    data.up = int(np.argmax(np.abs(frame.R_sp[2])))
    data.tile, data.joint, data.variation = basin.tile, basin.joint, basin.variation
    data.colour, data.joint_colour = wp.vec3(*basin.colour), wp.vec3(*basin.joint_colour)
    data.deck_colour = wp.vec3(*basin.deck_colour)
    return data


Image = NDArray[np.uint8]
Region = Rectangle | tuple[int, int, int, int]


def sensor_levels(sensor: ImageSensor) -> SensorLevels:
    """Return the parameters of an image sensor for the kernel that computes its pixel values."""
    levels = SensorLevels()
    levels.gain, levels.full_well, levels.read_noise = sensor.gain, sensor.full_well, sensor.read_noise
    levels.gamma, levels.noisy = sensor.gamma, sensor.noise
    return levels


class OverheadCamera:
    """A fixed camera above a pool.

    Its pictures are a function of the scene, the tags, the time and the seed: identical on every call, and
    identical in every region to the complete picture.
    """

    def __init__(self, scene: Scene, *, device: Any = "cpu") -> None:
        """Compute what is constant: the pixels' viewing directions and the waves.

        Args:
            scene: Scene in front of the camera.
            device: Warp device.

        Raises:
            SensorError: The camera is behind the interface.
        """
        self.scene = scene
        self.device = wp.get_device(device)
        self._frame = surface_frame(scene.camera, scene.interface)
        rays = corner_rays_s(scene.camera, self._frame)
        self._rays: wp.array[Any] = wp.array(rays, dtype=wp.vec3, device=self.device)
        self._data = pack_scene(scene, self._frame, self.device)
        self._waves = None if scene.ripples is None else waves_of(scene.ripples)
        lens = scene.camera.lens
        self._full = Rectangle(0, 0, lens.width, lens.height)
        self._background: Image | None = None

    def render(
        self,
        *,
        tags: Sequence[TagInScene] = (),
        time: float = 0.0,
        seed: int = 0,
        region: Literal["tags"] | Region | None = None,
    ) -> Image:
        """Render one picture.

        Args:
            tags: Moving tags, besides those of the scene.
            time: Middle of the exposure [s], for ripples and noise.
            seed: Seed of the noise.
            region: Region to render, as (left, top, right, bottom) in pixels with right and bottom excluded,
                or "tags" for the neighbourhood of `tags`. The remainder is the background: the scene without
                them, at the time and with the seed of the first such call. None renders everything.

        Returns:
            (height, width) grey or (height, width, 3) red, green, blue.
        """
        sensor = self.scene.sensor
        shape = (self._full.bottom, self._full.right, 3 if sensor.colour else 1)
        start, chosen = np.zeros(shape, np.uint8), [self._full]
        if region is not None:
            chosen = self.neighbourhood(tags) if isinstance(region, str) else [self._clipped(region)]
            if self._background is None:
                self._background = self.render(time=time, seed=seed)
            start = self._background.reshape(shape).copy()
        image = on_device(start, wp.uint8, self.device)
        samples = self._prepare((*self.scene.tags, *tags), time)
        levels = sensor_levels(sensor)
        for r in chosen:
            radiance = self._cast(r, samples)
            inputs = [radiance, r.top, r.left, levels, noise_key(seed, time), image]
            wp.launch(digitise, dim=radiance.shape, inputs=inputs, device=self.device)
        return np.asarray(image.numpy()).reshape(shape if sensor.colour else shape[:2])

    def radiance(self, *, time: float = 0.0, region: Region | None = None) -> NDArray[np.float32]:
        """Return the mean radiance of every pixel before its digitisation, (height, width, 3); that of white
        paper is 1.

        Args:
            time: Middle of the exposure [s].
            region: (left, top, right, bottom) in pixels; None for all.
        """
        r = self._full if region is None else self._clipped(region)
        return np.asarray(self._cast(r, self._prepare(self.scene.tags, time)).numpy())

    def neighbourhood(self, tags: Sequence[TagInScene]) -> list[Rectangle]:
        """Return the rectangles that `region="tags"` renders."""
        return merged(self._rectangles(tags))

    def _clipped(self, region: Region) -> Rectangle:
        if len(region) != 4:
            raise SensorError(f"region {region}: expected (left, top, right, bottom) in pixels")
        return Rectangle(*(int(x) for x in region)).clipped(self._full.right, self._full.bottom)

    def _rectangles(self, tags: Sequence[TagInScene]) -> list[Rectangle]:
        return rectangles(self.scene, tags, 0.0 if self._waves is None else self._waves.steepest)

    def _prepare(self, tags: Sequence[TagInScene], time: float) -> wp.array[Any]:
        """Pack the tags and waves of a picture; return the rays per pixel, (height, width)."""
        self._data.tags = on_device(_tags(tags, self._frame), TagData, self.device)
        cells = [np.asarray(tag.bitmap, np.uint8).ravel() for tag in tags]
        self._data.cells = on_device(np.concatenate([*cells, np.zeros(0, np.uint8)]), wp.uint8, self.device)
        self._data.waves = on_device(
            pack_waves(self._waves, self._frame.offset, time), SurfaceWave, self.device
        )
        samples = np.zeros((self._full.bottom, self._full.right), np.uint8)
        for r in self._rectangles(tags):
            samples[r.top : r.bottom, r.left : r.right] = self.scene.samples
        return on_device(samples, wp.uint8, self.device)

    def _cast(self, r: Rectangle, samples: wp.array[Any]) -> wp.array[Any]:
        shape = (r.bottom - r.top, r.right - r.left)
        radiance = wp.empty(shape, dtype=wp.vec3, device=self.device)
        inputs = [self._data, self._rays, samples, r.top, r.left, radiance]
        blocks = ((r.bottom + 1) // 2 - r.top // 2, (r.right + 1) // 2 - r.left // 2)
        wp.launch(cast, dim=blocks, inputs=inputs, device=self.device)
        return radiance
