"""The overhead camera: pictures of a scene, whole or around the tags alone."""
# mypy: disable-error-code="no-untyped-call"

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.sensors.batch import SensorError
from finssim.sensors.overhead_camera.neighbourhood import Rectangle, merged, rectangles
from finssim.sensors.overhead_camera.packing import on_device, pack_scene, put_things
from finssim.sensors.overhead_camera.photometry import digitise, noise_key
from finssim.sensors.overhead_camera.raycast import cast
from finssim.sensors.overhead_camera.scene import Body, Scene, TagInScene
from finssim.sensors.overhead_camera.surface import waves_of
from finssim.sensors.overhead_camera.view import corner_rays_s, surface_frame

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
