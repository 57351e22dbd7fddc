"""Appearance of water: tiles or sand with moving caustics, a rippled surface, and the attenuation of colours
with depth."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from io import BytesIO
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from finssim.extensions.viewer.shapes import Mesh

if TYPE_CHECKING:
    import trimesh

__all__ = [
    "FRAMES", "PERIOD", "TILES", "backdrop", "caustics", "draped", "floor", "floor_images", "surface", "tint", "walls",
    "water_colour",
]  # fmt: skip

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8]
Pattern = Literal["tiles", "sand"]

ATTENUATION = np.array([0.30, 0.06, 0.04])
"""Diffuse attenuation of red, green and blue [1/m], of the order of clear coastal water."""
WATER = np.array([118.0, 186.0, 208.0])
"""Colour of water of great optical depth just below the surface."""
TILES = (236, 244, 246)
"""Colour of a pool's tiles."""
PATCH, PIXELS = 2.0, 256
"""Edge of the repeating square of floor [m], and of its picture [px]."""
TILE, JOINT = 0.25, 2
"""Edge of a tile [m] and width of a joint [px]."""
FRAMES, PERIOD = 16, 3.2
"""Number of pictures of the caustics, and the time after which they repeat [s]."""
WAVES, BEND = 14, 0.25
"""Number of waves of the surface; 1 - 1/n of water, the share of a small slope by which a vertical ray is
refracted [-]."""
FOCUS = 0.55
"""Root mean square of the convergence of the rays on the floor [-]; at 1 the rays are focused on average."""


RIPPLE = 8.0
"""Ratio of the height of the drawn surface to the deflection potential [1/m], so that ripples are visible."""


@lru_cache(maxsize=4)
def _waves(seed: int) -> tuple[Array, Array, Array, Array]:
    """Return wave vectors [1/m], (w, 2), amplitudes of the deflection potential [m²], phases [rad] and cycles
    per period."""
    random = np.random.default_rng(seed)
    turns = random.uniform(0.0, 2.0 * np.pi, WAVES)
    k = np.rint(random.uniform(2.5, 9.0, WAVES)[:, None] * np.stack([np.cos(turns), np.sin(turns)], axis=1))
    k *= 2.0 * np.pi / PATCH
    length = np.linalg.norm(k, axis=1)
    cycles = np.maximum(np.rint(np.sqrt(9.81 * length) * PERIOD / (2.0 * np.pi) / 3.0), 1.0)  # slowed down
    return k, FOCUS * np.sqrt(2.0 / WAVES) / length**2, random.uniform(0.0, 2.0 * np.pi, WAVES), cycles


def caustics(frame: int, *, seed: int = 1) -> Array:
    """Return the brightness of a level floor under a rippled surface, mean 1, in a picture that repeats.

    A vertical ray that meets the slope ∇ζ is refracted by (1 - 1/n) ∇ζ from the vertical, and so lights the
    floor at depth d below x at x + d (1 - 1/n) ∇ζ; brightness is the density of rays. The waves are scaled so
    that the floor is near the focus at any depth: the pattern shows that there is a surface, not its actual
    state.

    Args:
        frame: Number of the picture, from 0; a period has `FRAMES` pictures.
        seed: Seed of the waves.

    Returns:
        Brightness, (PIXELS, PIXELS) [-].
    """
    k, amplitude, phase, cycles = _waves(seed)
    rays = 2 * PIXELS
    x, y = np.meshgrid(*[(np.arange(rays, dtype=np.float32) + 0.5) * np.float32(PATCH / rays)] * 2)
    shift = np.zeros((2, rays, rays), np.float32)
    for (kx, ky), a, start, c in zip(*(v.tolist() for v in (k, amplitude, phase, cycles)), strict=True):
        slope = np.sin(kx * x + ky * y + (start - 2.0 * np.pi * c * frame / FRAMES))
        shift[0] -= a * kx * slope
        shift[1] -= a * ky * slope
    column, row = (
        np.floor((p + s) * PIXELS / PATCH).astype(int) % PIXELS for p, s in zip((x, y), shift, strict=True)
    )
    light = np.bincount((row * PIXELS + column).ravel(), minlength=PIXELS**2).reshape(PIXELS, PIXELS) / 4.0
    for axis in (0, 1, 0, 1):
        light = (np.roll(light, 1, axis) + 2.0 * light + np.roll(light, -1, axis)) / 4.0
    return np.asarray(light)


def tint(depth: float) -> Array:
    """Return the shares of red, green and blue that are transmitted down to a depth [m] and back [-], (3,)."""
    return np.asarray(np.exp(-2.0 * ATTENUATION * np.clip(depth, 0.0, 6.0)))


def water_colour(depth: float) -> tuple[int, int, int]:
    """Return the colour of water of great optical depth at a depth [m], each 0 to 255."""
    red, green, blue = (WATER * tint(0.3 * depth)).astype(int).tolist()
    return red, green, blue


def backdrop(depth: float) -> Image:
    """Return the background of the scene for water of a depth [m], (h, w, 3): light at the top, dark at the bottom."""
    down = np.linspace(0.0, 1.0, 256)[:, None, None]
    top, bottom = np.array([232.0, 244.0, 248.0]), np.array(water_colour(depth)) * 0.92
    return np.broadcast_to(top + (bottom - top) * down, (256, 8, 3)).astype(np.uint8)


def floor_images(
    colour: tuple[int, int, int], pattern: Pattern, depth: float, *, seed: int = 1
) -> Iterator[Image]:
    """Yield the pictures of a floor with caustics at a depth [m], (PIXELS, PIXELS, 3), for one period."""
    plain = np.array(colour) * tint(depth) * _pattern(pattern, PIXELS, PIXELS, seed)
    for frame in range(FRAMES):
        light = 0.60 + 0.32 * np.minimum(caustics(frame, seed=seed), 2.6)
        yield np.clip(plain * light[..., None], 0.0, 255.0).astype(np.uint8)


def _pattern(kind: Pattern, rows: int, columns: int, seed: int) -> Array:
    """Return the brightness of tiles with joints, or of mottled sand, about 1 [-], (rows, columns, 1)."""
    if kind == "sand":
        grain = np.random.default_rng(seed).normal(1.0, 0.06, (rows, columns))
        return np.asarray((grain + np.roll(grain, 1, 0) + np.roll(grain, 1, 1))[..., None] / 3.0)
    every = round(TILE * PIXELS / PATCH)
    joint = (np.arange(rows) % every < JOINT)[:, None] | (np.arange(columns) % every < JOINT)[None]
    return np.asarray(np.where(joint, 0.80, 1.0)[..., None])


def floor(lower: Array, upper: Array) -> Mesh:
    """Return the floor of a box of water; corners in [m], (3,)."""
    (x0, y0, z), (x1, y1, _) = lower, upper
    return Mesh(
        np.array([[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z]]), np.array([[0, 1, 2], [0, 2, 3]])
    )


def draped(vertices: Array, faces: npt.NDArray[np.int64], image: Image) -> trimesh.Trimesh:
    """Return triangles with a repeating picture projected on them from above; vertices in [m], (v, 3)."""
    return _textured(vertices, faces, vertices[:, :2] / PATCH, image)


def walls(lower: Array, upper: Array) -> trimesh.Trimesh:
    """Return four tiled walls, visible only from inside, darker and bluer with depth; corners in [m], (3,)."""
    depth = float(upper[2] - lower[2])
    rows = max(2, round(depth * PIXELS / PATCH))
    down = np.linspace(0.0, depth, rows)
    colour = np.array([tint(0.25 + 0.75 * d) for d in down])[:, None] * TILES
    image = (colour * _pattern("tiles", rows, PIXELS, 0)).astype(np.uint8)
    x0, y0, z0, x1, y1, z1 = *lower, *upper
    ring = np.array([[x0, y0], [x0, y1], [x1, y1], [x1, y0], [x0, y0]])
    corners, uv, faces = list[Any](), list[Any](), list[Any]()
    for a, b in zip(ring[:-1], ring[1:], strict=True):
        i = len(corners)
        width = float(np.linalg.norm(b - a)) / PATCH
        corners += [[*a, z0], [*b, z0], [*b, z1], [*a, z1]]
        uv += [[0.0, 0.0], [width, 0.0], [width, 1.0], [0.0, 1.0]]
        faces += [[i, i + 1, i + 2], [i, i + 2, i + 3]]
    return _textured(np.array(corners), faces, np.array(uv), image)


def surface(lower: Array, upper: Array, *, seed: int = 1) -> trimesh.Trimesh:
    """Return the rippled surface of a box of water, transparent, visible from both sides; corners in [m], (3,)."""
    import trimesh

    x, y = np.meshgrid(*[np.linspace(lower[i], upper[i], 49) for i in (0, 1)])
    k, amplitude, phase, _ = _waves(seed)
    waves = (a * np.cos(kx * x + ky * y + p) for (kx, ky), a, p in zip(k, amplitude, phase, strict=True))
    points = np.stack([x, y, RIPPLE * np.sum(list(waves), axis=0)], axis=-1).reshape(-1, 3)
    corner = (np.arange(48)[:, None] * 49 + np.arange(48)).ravel()
    faces = np.concatenate([corner[:, None] + [0, 1, 50], corner[:, None] + [0, 50, 49]])
    material = trimesh.visual.material.PBRMaterial(
        baseColorFactor=[40, 125, 175, 60], alphaMode="BLEND", roughnessFactor=0.8, metallicFactor=0.0, doubleSided=True
    )  # fmt: skip
    return trimesh.Trimesh(
        points, faces, visual=trimesh.visual.TextureVisuals(material=material), process=False
    )


def _textured(vertices: Array, faces: npt.ArrayLike, uv: Array, image: Image) -> trimesh.Trimesh:
    """Return triangles that show a picture, which extends from 0 to 1 along each axis of `uv`."""
    import trimesh
    from PIL import Image as pictures

    packed = BytesIO()
    pictures.fromarray(image).save(packed, "JPEG", quality=85)
    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=pictures.open(packed), roughnessFactor=0.9, metallicFactor=0.0
    )
    visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    return trimesh.Trimesh(vertices, faces, visual=visual, process=False)
