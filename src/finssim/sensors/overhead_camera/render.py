"""The overhead camera: pictures of a scene, whole or around the tags alone."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.geometry.optics import Camera, Interface, Status, project
from finssim.geometry.rotations import quat_rotate, quat_to_matrix
from finssim.sensors.batch import SensorError
from finssim.sensors.overhead_camera.photometry import digitise, noise_key
from finssim.sensors.overhead_camera.raycast import BasinData, BodyData, LampData, SceneData, TagData, cast
from finssim.sensors.overhead_camera.scene import Basin, Body, Light, Pose, Scene, TagInScene
from finssim.sensors.overhead_camera.surface import Wave, Waves, layout_of, pack_waves, waves_of
from finssim.sensors.overhead_camera.view import SurfaceFrame, corner_rays_s, surface_frame

# Which pixels tags and bodies may touch: rectangles of the image, with room for ripples and motion.


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


# A scene as the structs that the ray caster reads, on one device.


# mypy: disable-error-code="attr-defined,call-overload,no-untyped-call,index"


def pack_scene(scene: Scene, frame: SurfaceFrame, device: Any) -> SceneData:
    """Everything but tags, bodies and waves, which change from picture to picture."""
    data = SceneData()
    data.camera_height = frame.camera_height
    data.index_near, data.index_far = scene.interface.index_near, scene.interface.index_far
    layers = scene.interface.window
    data.layer_thickness = wp.array([x.thickness for x in layers], dtype=float, device=device)
    data.layer_index = wp.array([x.index for x in layers], dtype=float, device=device)
    data.caustics = 0.0 if scene.ripples is None else scene.ripples.caustics
    data.attenuation, data.veil = wp.vec3(*scene.water.attenuation), wp.vec3(*scene.water.veil)
    data.sky = scene.light.sky
    data.lamps = on_device(_lamps(scene.light, frame), LampData, device)
    data.basin = _basin(scene.basin, frame, device)
    data.shutter, data.spot = scene.sensor.shutter, scene.sensor.spot
    return data


def put_things(
    data: SceneData,
    frame: SurfaceFrame,
    tags: Sequence[TagInScene],
    bodies: Sequence[Body],
    waves: Waves | None,
    time: float,
    device: Any,
) -> None:
    """Put tags, bodies and the waves of a moment into a packed scene.

    Args:
        data: From `pack_scene`.
        frame: The surface frame.
        tags: In the scene.
        bodies: In the scene.
        waves: The surface; None for a flat one.
        time: Middle of the exposure [s].
        device: Warp device.
    """
    data.tags = on_device(_tags(tags, frame), TagData, device)
    cells = [np.asarray(tag.bitmap, np.uint8).ravel() for tag in tags]
    data.cells = on_device(np.concatenate([*cells, np.zeros(0, np.uint8)]), wp.uint8, device)
    data.bodies = on_device(_bodies(bodies, frame), BodyData, device)
    data.waves = on_device(pack_waves(waves, frame.offset, time), Wave, device)


def on_device(table: NDArray[Any], dtype: Any, device: Any) -> wp.array[Any]:
    """A contiguous table as Warp's array: its own memory on the CPU, where Warp would look at it for 0.6 ms first."""
    if not table.size:
        return wp.empty(table.shape, dtype=dtype, device=device)
    if not wp.get_device(device).is_cpu:
        return wp.array(table, dtype=dtype, device=device)
    array = wp.array(ptr=table.ctypes.data, dtype=dtype, shape=table.shape, device=device)
    array.table = table  # lives as long as the array
    return array


def _poses(table: NDArray[Any], i: int, pose: Pose, end: Pose | None, frame: SurfaceFrame) -> None:
    for pose_then, place, axes in ((pose, "start", "q_start"), (end or pose, "end", "q_end")):
        table[place][i] = frame.point(pose_then.position)
        table[axes][i] = frame.quaternion(quat_to_matrix(pose_then.orientation))
    if np.dot(table["q_start"][i], table["q_end"][i]) < 0.0:
        table["q_end"][i] *= -1.0  # the same axes, on the short way from the start
    table["moving"][i] = end is not None


def _tags(tags: Sequence[TagInScene], frame: SurfaceFrame) -> NDArray[Any]:
    table = np.zeros(len(tags), dtype=layout_of(TagData))
    offset = 0
    for i, tag in enumerate(tags):
        _poses(table, i, tag.pose, tag.end, frame)
        table["cell"][i], table["half"][i] = tag.cell, tag.half_size
        table["cells"][i], table["offset"][i] = len(tag.bitmap), offset
        table["white"][i], table["black"][i] = tag.white, tag.black
        offset += tag.bitmap.size
    return table


def _bodies(bodies: Sequence[Body], frame: SurfaceFrame) -> NDArray[Any]:
    table = np.zeros(len(bodies), dtype=layout_of(BodyData))
    for i, body in enumerate(bodies):
        _poses(table, i, body.pose, body.end, frame)
        table["half"][i], table["colour"][i] = 0.5 * np.asarray(body.size), body.colour
    return table


def _lamps(light: Light, frame: SurfaceFrame) -> NDArray[Any]:
    table = np.zeros(len(light.lamps), dtype=layout_of(LampData))
    for i, lamp in enumerate(light.lamps):
        table["centre"][i], table["half"][i] = frame.point(lamp.centre), 0.5 * np.asarray(lamp.size)
        table["radiance"][i] = lamp.radiance
    return table


def _basin(basin: Basin, frame: SurfaceFrame, device: Any) -> BasinData:
    data = BasinData()
    normal_p = frame.R_sp[2]
    data.R_bs = wp.mat33(*frame.R_sp.T.ravel())
    data.origin = wp.vec3(*frame.point(basin.lower))
    data.size = wp.vec3(*np.subtract(basin.upper, basin.lower))
    data.up = int(np.argmax(np.abs(normal_p)))
    data.up_sign = float(np.sign(normal_p[data.up]))
    data.tile, data.joint, data.variation = basin.tile, basin.joint, basin.variation
    data.colour, data.joint_colour = wp.vec3(*basin.colour), wp.vec3(*basin.joint_colour)
    middles = np.asarray(basin.lanes, np.float32) - np.float32(basin.lower[basin.lane_axis])
    data.lanes = wp.array(middles.reshape(-1), dtype=float, device=device)
    data.lane_axis, data.lane_width = basin.lane_axis, basin.lane_width
    data.lane_colour, data.deck_colour = wp.vec3(*basin.lane_colour), wp.vec3(*basin.deck_colour)
    return data


# mypy: disable-error-code="no-untyped-call"


Image = NDArray[np.uint8]
Thing = TagInScene | Body
Region = Rectangle | tuple[int, int, int, int]


class OverheadCamera:
    """A fixed camera above a pool.

    Its pictures are a function of the scene, the time and the seed: the same on every call, and in every region the
    same as in the whole picture.
    """

    def __init__(self, scene: Scene, *, device: Any = "cpu") -> None:
        """Compute what stays: the pixels' directions and the waves.

        Args:
            scene: What stands before the camera.
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
        self._background: Image | None = None

    def render(
        self,
        *,
        tags: Sequence[TagInScene] | None = None,
        bodies: Sequence[Body] | None = None,
        time: float = 0.0,
        seed: int = 0,
        region: Literal["tags"] | Region | Sequence[Region] | None = None,
    ) -> Image:
        """One picture.

        Args:
            tags: Those to draw; the scene's if not given.
            bodies: Those to draw; the scene's if not given.
            time: Middle of the exposure [s], for ripples and noise.
            seed: Of the noise.
            region: What to draw anew, as (left, top, right, bottom) in pixels with right and bottom excluded, or a list
                of these, or "tags" for the neighbourhood of all tags and bodies that are not fixed. The rest is the
                background: the scene without them, at the time and with the seed of the first such call. None draws
                everything.

        Returns:
            (height, width) grey or (height, width, 3) red, green, blue.
        """
        tags = self.scene.tags if tags is None else tuple(tags)
        bodies = self.scene.bodies if bodies is None else tuple(bodies)
        lens = self.scene.camera.lens
        boxes = self._rectangles((*bodies, *tags))
        if region is None:
            whole = [Rectangle(0, 0, lens.width, lens.height)]
            return self._picture(tags, bodies, time, seed, whole, boxes, None)
        if self._background is None:
            self._background = self.render(
                tags=[x for x in self.scene.tags if x.fixed],
                bodies=[x for x in self.scene.bodies if x.fixed],
                time=time,
                seed=seed,
            )
        if isinstance(region, str):
            moving = zip((*bodies, *tags), boxes, strict=True)
            chosen = [box for thing, box in moving if not thing.fixed]
        else:
            chosen = _listed(region)
        chosen = merged(r.clipped(lens.width, lens.height) for r in chosen)
        return self._picture(tags, bodies, time, seed, chosen, boxes, self._background)

    def radiance(self, *, time: float = 0.0, region: Region | None = None) -> NDArray[np.float32]:
        """Mean radiance of every pixel of the scene before it becomes a number, (height, width, 3); white paper has 1.

        Args:
            time: Middle of the exposure [s].
            region: (left, top, right, bottom) in pixels; None for all.
        """
        lens = self.scene.camera.lens
        r = Rectangle(*(region or (0, 0, lens.width, lens.height))).clipped(lens.width, lens.height)
        tags, bodies = self.scene.tags, self.scene.bodies
        samples = self._prepare(tags, bodies, time, self._rectangles((*bodies, *tags)))
        return np.asarray(self._cast(r, samples).numpy())

    def neighbourhood(
        self, tags: Sequence[TagInScene] | None = None, bodies: Sequence[Body] | None = None
    ) -> list[Rectangle]:
        """The rectangles that `region="tags"` draws."""
        tags = self.scene.tags if tags is None else tags
        bodies = self.scene.bodies if bodies is None else bodies
        return merged(self._rectangles(_moving(tags, bodies)))

    def _rectangles(self, things: Sequence[Thing]) -> list[Rectangle]:
        steepest = 0.0 if self._waves is None else self._waves.steepest
        border = 2 + math.ceil(self.scene.sensor.spot)
        return rectangles(self.scene.camera, self.scene.interface, things, steepest, border)

    def _prepare(
        self,
        tags: Sequence[TagInScene],
        bodies: Sequence[Body],
        time: float,
        boxes: Sequence[Rectangle],
    ) -> wp.array[Any]:
        """Pack what changes; rays per pixel, (height, width). `boxes`: of the bodies, then of the tags."""
        put_things(self._data, self._frame, tags, bodies, self._waves, time, self.device)
        lens = self.scene.camera.lens
        samples = np.zeros((lens.height, lens.width), np.uint8)
        for i, r in enumerate(boxes):
            samples[r.top : r.bottom, r.left : r.right] = 1 if i < len(bodies) else self.scene.samples
        return on_device(samples, wp.uint8, self.device)

    def _cast(self, r: Rectangle, samples: wp.array[Any]) -> wp.array[Any]:
        shape = (r.bottom - r.top, r.right - r.left)
        radiance = wp.empty(shape, dtype=wp.vec3, device=self.device)
        inputs = [self._data, self._rays, samples, r.top, r.left, radiance]
        blocks = ((r.bottom + 1) // 2 - r.top // 2, (r.right + 1) // 2 - r.left // 2)
        wp.launch(cast, dim=blocks, inputs=inputs, device=self.device)
        return radiance

    def _picture(
        self,
        tags: Sequence[TagInScene],
        bodies: Sequence[Body],
        time: float,
        seed: int,
        region: Sequence[Rectangle],
        boxes: Sequence[Rectangle],
        background: Image | None,
    ) -> Image:
        sensor, lens = self.scene.sensor, self.scene.camera.lens
        shape = (lens.height, lens.width, 3 if sensor.colour else 1)
        start = np.zeros(shape, np.uint8) if background is None else background.reshape(shape).copy()
        image = on_device(start, wp.uint8, self.device)
        samples = self._prepare(tags, bodies, time, boxes)
        levels = [sensor.gain, sensor.full_well, sensor.read_noise, sensor.gamma, sensor.noise]
        for r in region:
            radiance = self._cast(r, samples)
            inputs = [radiance, r.top, r.left, *levels, noise_key(seed, time), image]
            wp.launch(digitise, dim=radiance.shape, inputs=inputs, device=self.device)
        return np.asarray(image.numpy()).reshape(shape if sensor.colour else shape[:2])


def render(
    scene: Scene, *, time: float = 0.0, seed: int = 0, region: Any = None, device: Any = "cpu"
) -> Image:
    """One picture of a scene; many pictures of one scene are faster from one `OverheadCamera`.

    Args:
        scene: What stands before the camera.
        time: Middle of the exposure [s].
        seed: Of the noise.
        region: As of `OverheadCamera.render`.
        device: Warp device.
    """
    return OverheadCamera(scene, device=device).render(time=time, seed=seed, region=region)


def _moving(tags: Sequence[TagInScene], bodies: Sequence[Body]) -> list[Thing]:
    things: tuple[Thing, ...] = (*tags, *bodies)
    return [thing for thing in things if not thing.fixed]


def _listed(region: Any) -> list[Rectangle]:
    """One rectangle or several as a list.

    Raises:
        SensorError: They are not rectangles of four numbers.
    """
    several = region if len(region) == 0 or np.ndim(region[0]) == 1 else [region]
    if any(len(r) != 4 for r in several):
        raise SensorError(
            f"region {region}: expected (left, top, right, bottom) in pixels, or a list of these"
        )
    return [Rectangle(*(int(x) for x in r)) for r in several]
