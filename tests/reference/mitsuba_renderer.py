"""The overhead camera's scene rendered by Mitsuba 3: an independent reference for the ray caster.

Geometry and Fresnel losses are Mitsuba's: a smooth dielectric surface (a mesh with interpolated normals where it
ripples), window layers, tags and the plain basin as surfaces that glow with the scene's radiance. Light therefore
needs no path in through the surface, which a path tracer would hardly find. Water is clear: attenuation and veil,
tiles and motion are not checked here.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.core.rotations import quat_to_matrix
from finssim.sim.overhead_camera import ObjectPose, Rectangle, Scene, TagInScene
from finssim.sim.overhead_camera.photometry import digitise, noise_key
from finssim.sim.overhead_camera.render import sensor_levels
from finssim.sim.overhead_camera.scene import SurfaceFrame, surface_frame
from finssim.sim.overhead_camera.surface import waves_of
from finssim.sim.sensors.batch import SensorError

__all__ = ["radiance_by_mitsuba", "render_with_mitsuba"]

Array = NDArray[np.float64]

FINE = 2
"""Mitsuba's pixels per pixel along each axis; it has no lens distortion, so its picture is resampled."""
CELL = 0.004
"""Spacing of the vertices of a rippling surface [m]."""
FAR = 50.0
"""Half the extent of a flat surface [m]."""


def render_with_mitsuba(
    scene: Scene, *, time: float = 0.0, seed: int = 0, region: Any = None, rays: int = 16
) -> NDArray[np.uint8]:
    """Return one picture of a scene, like `OverheadCamera.render`; zero outside the region.

    Args:
        scene: The scene; its sensor turns Mitsuba's radiance into numbers.
        time: Middle of the exposure [s].
        seed: Seed of Mitsuba and of the noise.
        region: (left, top, right, bottom) in pixels, or several; None for the whole picture, which takes minutes.
        rays: Rays per pixel of Mitsuba's picture, which has 4 for one of the camera's.

    Raises:
        SensorError: Something in the scene moves.
    """
    sensor, lens = scene.sensor, scene.camera.lens
    image = wp.zeros((lens.height, lens.width, 3 if sensor.colour else 1), dtype=wp.uint8, device="cpu")
    levels = sensor_levels(sensor)
    whole = (0, 0, lens.width, lens.height)
    for rectangle in np.atleast_2d(whole if region is None else region).tolist():
        r = Rectangle(*rectangle).clipped(lens.width, lens.height)
        radiance = radiance_by_mitsuba(scene, r, time=time, seed=seed, rays=rays)
        light: wp.array[Any] = wp.array(radiance, dtype=wp.vec3, device="cpu")
        inputs = [light, r.top, r.left, levels, noise_key(seed, time), image]
        wp.launch(digitise, dim=light.shape, inputs=inputs, device="cpu")
    return np.asarray(image.numpy() if sensor.colour else image.numpy()[..., 0])


def radiance_by_mitsuba(
    scene: Scene, region: Rectangle, *, time: float = 0.0, seed: int = 0, rays: int = 16
) -> NDArray[np.float32]:
    """Return the radiance of the pixels of a rectangle, (rows, columns, 3).

    Args:
        scene: The scene, as in `render_with_mitsuba`.
        region: The rectangle [px].
        time: Middle of the exposure [s].
        seed: Seed of Mitsuba.
        rays: Rays per pixel of Mitsuba's picture, which has 4 for one of the camera's.

    Raises:
        SensorError: Something in the scene moves.
    """
    import mitsuba as mi

    mi.set_variant("scalar_rgb")
    if any(x.end for x in scene.tags):
        raise SensorError(
            "the Mitsuba renderer shows things at rest: leave out `end`, or use our own renderer"
        )
    film = _Film(scene, region)
    frame = surface_frame(scene.camera, scene.interface)
    parts: dict[str, Any] = {"type": "scene", "integrator": {"type": "path", "max_depth": 4, "rr_depth": 99}}
    parts["integrator"]["max_depth"] += len(scene.interface.window)
    parts["sensor"] = film.sensor(mi, scene, rays)
    parts |= _surface(mi, scene, frame, film.footprint(scene, frame), time) | _basin(mi, scene)
    for i, tag in enumerate(scene.tags):
        parts |= _tag(mi, tag, f"tag{i}", _gain(scene, tag.pose))
    if scene.sky > 0.0:
        parts["sky"] = {"type": "constant", "radiance": {"type": "rgb", "value": scene.sky}}
    picture = np.array(mi.render(mi.load_dict(parts), seed=seed))
    return film.resampled(picture[..., :3], scene)


class _Film:
    """Mitsuba's undistorted picture of a rectangle of the camera's: a film centred on the optical axis,
    cropped."""

    def __init__(self, scene: Scene, region: Rectangle) -> None:
        lens = scene.camera.lens
        step = (np.arange(FINE) + 0.5) / FINE - 0.5
        u = (np.arange(region.left, region.right)[:, None] + step).ravel()
        v = (np.arange(region.top, region.bottom)[:, None] + step).ravel()
        rays, ok = lens.rays(np.stack(np.meshgrid(u, v), axis=-1))
        if not ok.all() or (rays[..., 2] < 0.1).any():
            raise SensorError(
                "the Mitsuba renderer sees less than 168 degrees: give a region nearer the axis"
            )
        self.rays = rays
        self.focal = FINE * math.sqrt(lens.fx * lens.fy)
        self.at = self.focal * rays[..., :2] / rays[..., 2:]  # [fine px] from the axis
        self.half = math.ceil(np.abs(self.at).max()) + 4
        self.first = np.floor(self.at.min((0, 1))).astype(int) - 2 + self.half
        self.size = np.ceil(self.at.max((0, 1))).astype(int) + 2 + self.half - self.first

    def sensor(self, mi: Any, scene: Scene, rays: int) -> dict[str, Any]:
        """Return camera and film."""
        matrix = np.eye(4)
        matrix[:3, :3] = scene.camera.R_pc @ np.diag([-1.0, -1.0, 1.0])  # Mitsuba's x is left, y up
        matrix[:3, 3] = scene.camera.position
        return {
            "type": "perspective",
            "fov": math.degrees(2.0 * math.atan(self.half / self.focal)),
            "fov_axis": "x",
            "near_clip": 1e-3,
            "far_clip": 1e3,
            "to_world": mi.ScalarTransform4f(matrix),
            "sampler": {"type": "stratified", "sample_count": rays},
            "film": {
                "type": "hdrfilm",
                "width": 2 * self.half,
                "height": 2 * self.half,
                "crop_offset_x": int(self.first[0]),
                "crop_offset_y": int(self.first[1]),
                "crop_width": int(self.size[0]),
                "crop_height": int(self.size[1]),
                "rfilter": {"type": "box"},
                "pixel_format": "rgb",
            },
        }

    def footprint(self, scene: Scene, frame: SurfaceFrame) -> Array:
        """Return corners of the area where rays meet the still surface, surface frame: lower and upper [m],
        (2, 2)."""
        ray = self.rays @ (frame.R_sp @ scene.camera.R_pc).T
        at = -frame.camera_height * ray[..., :2] / np.minimum(ray[..., 2:], -0.05)
        return np.stack([at.min((0, 1)), at.max((0, 1))])

    def resampled(self, picture: NDArray[np.float32], scene: Scene) -> NDArray[np.float32]:
        """Return the camera's pixels from Mitsuba's, bilinear at FINE x FINE points of each."""
        from scipy.ndimage import map_coordinates

        x, y = np.moveaxis(self.at + self.half - self.first - 0.5, -1, 0)
        fine = np.stack([map_coordinates(picture[..., c], [y, x], order=1) for c in range(3)], axis=-1)
        rows, columns = fine.shape[0] // FINE, fine.shape[1] // FINE
        mean = fine.reshape(rows, FINE, columns, FINE, 3).mean((1, 3))
        return np.asarray(mean, np.float32)


def _matrix(mi: Any, R: Array, origin: Any, scale: Any) -> Any:
    matrix = np.eye(4)
    matrix[:3, :3] = np.asarray(R) * np.asarray(scale, float)
    matrix[:3, 3] = origin
    return mi.ScalarTransform4f(matrix)


def _glowing(mi: Any, radiance: Any, gain: float) -> dict[str, Any]:
    """Return a surface that emits and reflects nothing; `radiance` is a colour, or cells as printed, top row
    first."""
    if np.ndim(radiance) == 2:
        cells = np.repeat(np.asarray(radiance, np.float32)[::-1, :, None], 3, axis=2)
        light = {"type": "bitmap", "bitmap": mi.Bitmap(gain * cells), "raw": True, "filter_type": "nearest"}
    else:
        light = {"type": "rgb", "value": [gain * float(x) for x in np.broadcast_to(radiance, 3)]}
    black = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
    return {"bsdf": black, "light": {"type": "area", "radiance": light}}


def _gain(scene: Scene, pose: ObjectPose) -> float:
    """Return the factor from radiance behind the surface to the camera's side: light spreads by the indices
    squared."""
    wet = float(scene.interface.distance(np.asarray(pose.position))) < 0.0
    return (scene.interface.index_far / scene.interface.index_near) ** 2 if wet else 1.0


def _tag(mi: Any, tag: TagInScene, name: str, gain: float) -> dict[str, Any]:
    """Return the bitmap 0.1 mm above the tag's plane, and half-way to it the white board whose rim is the margin.

    Both are therefore visible where the tag lies on a wall.
    """
    R = quat_to_matrix(tag.pose.orientation)
    print_half, board = 0.5 * tag.cell * len(tag.bitmap), tag.half_size
    reflectance = np.where(np.asarray(tag.bitmap, bool), tag.white, tag.black)
    origin = np.asarray(tag.pose.position)
    return {
        name: {
            "type": "rectangle",
            "to_world": _matrix(mi, R, origin + 1e-4 * R[:, 2], [print_half, print_half, 1.0]),
            **_glowing(mi, reflectance, gain),
        },
        f"{name}_board": {
            "type": "rectangle",
            "to_world": _matrix(mi, R, origin + 5e-5 * R[:, 2], [board, board, 1.0]),
            **_glowing(mi, tag.white, gain),
        },
    }


def _basin(mi: Any, scene: Scene) -> dict[str, Any]:
    """Return the inside of the box without its lid, the face on the camera's side."""
    lower, upper = np.asarray(scene.basin.lower, float), np.asarray(scene.basin.upper, float)
    middle, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
    gain = (scene.interface.index_far / scene.interface.index_near) ** 2
    faces = {}
    for axis in range(3):
        for side in (-1.0, 1.0):
            outwards = side * np.eye(3)[axis]
            if outwards @ scene.interface.normal > 0.7:
                continue
            inwards, first = -outwards, np.eye(3)[(axis + 1) % 3]
            R = np.stack([first, np.cross(inwards, first), inwards], axis=-1)
            size = [half[(axis + 1) % 3], half[(axis + 2) % 3], 1.0]
            to_world = _matrix(mi, R, middle + outwards * half, size)
            glow = _glowing(mi, scene.basin.colour, gain)
            faces[f"basin{axis}{side:+.0f}"] = {"type": "rectangle", "to_world": to_world, **glow}
    return faces


def _surface(mi: Any, scene: Scene, frame: SurfaceFrame, footprint: Array, time: float) -> dict[str, Any]:
    """Return smooth dielectric faces, in order from the camera's side."""
    interface = scene.interface
    if scene.ripples is not None:
        return {"surface": _rippling(mi, scene, frame, footprint, time)}
    indices = [interface.index_near, *(x.index for x in interface.window), interface.index_far]
    depths = np.cumsum([0.0, *(x.thickness for x in interface.window)])
    faces = {}
    for i, depth in enumerate(depths):
        origin = frame.origin_p - depth * frame.R_sp[2]
        if indices[i] != indices[i + 1]:
            faces[f"face{i}"] = {
                "type": "rectangle",
                "to_world": _matrix(mi, frame.R_sp.T, origin, [FAR, FAR, 1.0]),
                "bsdf": {"type": "dielectric", "ext_ior": indices[i], "int_ior": indices[i + 1]},
            }
    return faces


def _rippling(mi: Any, scene: Scene, frame: SurfaceFrame, footprint: Array, time: float) -> Any:
    """Return a mesh of the heights under the picture, with normals of the slopes."""
    assert scene.ripples is not None
    low, high = footprint[0] - 0.05, footprint[1] + 0.05
    x, y = (np.arange(a, b + CELL, CELL) for a, b in zip(low, high, strict=True))
    xy = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    waves = waves_of(scene.ripples)
    z, slope = waves.height(xy + frame.offset, time), waves.slope(xy + frame.offset, time)
    normals = np.concatenate([-slope, np.ones((len(xy), 1))], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    corner = (np.arange(len(y) - 1)[:, None] * len(x) + np.arange(len(x) - 1)).ravel()
    right, up = corner + 1, corner + len(x)
    faces = np.concatenate([np.stack([corner, right, up + 1], -1), np.stack([corner, up + 1, up], -1)])
    vertices = np.column_stack([xy, z]) @ frame.R_sp + frame.origin_p
    properties = mi.Properties()
    bsdf = {"type": "dielectric", "ext_ior": scene.interface.index_near, "int_ior": scene.interface.index_far}
    properties["bsdf"] = mi.load_dict(bsdf)
    mesh = mi.Mesh("surface", len(vertices), len(faces), has_vertex_normals=True, props=properties)
    values = mi.traverse(mesh)
    values["vertex_positions"] = vertices.ravel().astype(np.float32)
    values["vertex_normals"] = (normals @ frame.R_sp).ravel().astype(np.float32)
    values["faces"] = faces.ravel().astype(np.uint32)
    values.update()
    return mesh
