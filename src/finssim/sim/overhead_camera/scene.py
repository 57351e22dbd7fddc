"""Scene in front of a fixed camera above a pool: basin, water, light and tags, as plain data.

Everything is in the pool frame unless stated otherwise. Radiance is relative: that of white paper in the
pool's light is 1. Colours and water constants are triples (red, green, blue).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from finssim.core.optics import Camera, Interface, Lens
from finssim.core.rotations import matrix_to_quat
from finssim.sim.sensors.batch import SensorError

Triple = tuple[float, float, float]
Quadruple = tuple[float, float, float, float]

UPRIGHT: Quadruple = (0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class ObjectPose:
    """Pose of an object: its origin [m] and its axes, q_p<object> xyzw."""

    position: Triple
    orientation: Quadruple = UPRIGHT

    def __post_init__(self) -> None:
        length = math.hypot(*self.orientation)
        if abs(length - 1.0) > 1e-6:
            raise SensorError(f"orientation has length {length:.4g}, expected 1: give a unit quaternion xyzw")


@dataclass(frozen=True, kw_only=True, eq=False)
class TagInScene:
    """A printed square tag: x right and y up in the print, z out of the printed side, origin at its middle."""

    bitmap: NDArray[np.bool_]
    """Cells as printed, row 0 at the top, column 0 at the left; true is white; (n, n)."""
    edge: float
    """Distance between the corners that a detector reports [m]."""
    pose: ObjectPose
    """Pose at the start of the exposure."""
    end: ObjectPose | None = None
    """Pose at the end of the exposure; None for a tag at rest."""
    border_cells: int | None = None
    """Cells along `edge`; all cells of the bitmap if None. Some families also print cells outside the
    border."""
    margin: float = 0.0
    """White rim around the bitmap [m]."""
    white: float = 0.90
    """Reflectance of paper; laminated white paper has 0.85 to 0.92."""
    black: float = 0.05
    """Reflectance of print; toner has 0.03 to 0.06."""

    def __post_init__(self) -> None:
        if self.bitmap.ndim != 2 or self.bitmap.shape[0] != self.bitmap.shape[1]:
            raise SensorError(
                f"tag bitmap has shape {self.bitmap.shape}, expected a square: give (n, n) cells"
            )
        if not self.edge > 0.0 or self.margin < 0.0:
            raise SensorError(
                f"tag edge {self.edge} m and margin {self.margin} m, expected edge > 0, margin >= 0"
            )

    @property
    def cell(self) -> float:
        """Size of one cell [m]."""
        return self.edge / (self.border_cells or len(self.bitmap))

    @property
    def half_size(self) -> float:
        """Distance from the middle to the rim's edge [m]."""
        return 0.5 * self.cell * len(self.bitmap) + self.margin


@dataclass(frozen=True, kw_only=True)
class TiledBasin:
    """Tiled interior of the pool, an axis-aligned box between two corners; the deck surrounds it."""

    lower: Triple
    """Corner with the least coordinates [m]."""
    upper: Triple
    """Corner with the greatest coordinates [m]; the box must reach above the water."""
    tile: float = 0.15
    """Edge of a tile with its joint [m]; 0 for plain walls."""
    joint: float = 0.006
    """Width of a joint [m]."""
    colour: Triple = (0.62, 0.80, 0.86)
    """Reflectance of the tiles."""
    joint_colour: Triple = (0.80, 0.84, 0.84)
    """Reflectance of the joints, (red, green, blue)."""
    variation: float = 0.05
    """Relative standard deviation of the reflectance from tile to tile."""
    deck_colour: Triple = (0.62, 0.60, 0.56)
    """Reflectance of the pool's surroundings."""

    def __post_init__(self) -> None:
        if not all(a < b for a, b in zip(self.lower, self.upper, strict=True)):
            raise SensorError(
                f"basin from {self.lower} to {self.upper}: each upper must exceed its lower [m]"
            )


@dataclass(frozen=True, kw_only=True)
class WaterOptics:
    """Water that absorbs light from an object to the surface and adds veiling light: L = L0 exp(-c s) + B (1
    - exp(-c s))."""

    attenuation: Triple = (0.40, 0.10, 0.08)
    """Beam attenuation c [1/m]. Pure water absorbs 0.35 of red, 0.06 of green and 0.01 of blue; a filtered pool
    scatters some 0.05 to 0.1 more."""
    veil: Triple = (0.10, 0.28, 0.33)
    """Radiance B of infinitely deep water [-]: backscattered light."""


@dataclass(frozen=True, kw_only=True)
class Ripples:
    """A water surface of small gravity-capillary waves that run in all directions."""

    rms_slope: float
    """Root mean square of the surface's slope |∇h| [-]. Still indoor water has below 0.005, a pool in use 0.02 to
    0.06."""
    wavelengths: tuple[float, float] = (0.08, 0.60)
    """Shortest and longest wavelength [m]."""
    waves: int = 16
    """Number of sines; their wavelengths are evenly spaced on a logarithmic scale and share the mean square
    slope equally."""
    seed: int = 0
    """Seed of wavelengths, headings and phases."""

    def __post_init__(self) -> None:
        shortest, longest = self.wavelengths
        if self.rms_slope < 0.0 or self.waves < 1 or not 0.0 < shortest <= longest:
            raise SensorError(
                f"ripples: slope {self.rms_slope}, {self.waves} waves of {shortest} to {longest} m:"
                " expected slope >= 0, waves >= 1 and 0 < shortest <= longest"
            )


@dataclass(frozen=True, kw_only=True)
class ImageSensor:
    """Conversion of light to pixel values. All pixels are exposed together, centred on the requested time."""

    shutter: float = 0.0
    """Exposure time [s], during which tags and ripples move."""
    gain: float = 0.9
    """Fraction of the full scale that radiance 1 reaches."""
    full_well: float = 10_000.0
    """Electrons at full scale: small sensors hold 5 000 to 15 000."""
    read_noise: float = 5.0
    """Standard deviation [electrons]; small CMOS sensors have 2 to 8."""
    noise: bool = True
    """True with shot and read noise."""
    gamma: float = 1.0
    """Pixel values are (charge)^(1/gamma): 1 for linear, 2.2 for video, in which dark tags look smaller
    [-]."""
    spot: float = 1.0
    """Width of the square from which a pixel gathers light [px]: 1 for perfect optics, 1.5 to 2 for a cheap lens."""
    colour: bool = False
    """True if images have red, green and blue; otherwise one channel, 0.299 R + 0.587 G + 0.114 B."""

    def __post_init__(self) -> None:
        if min(self.shutter, self.read_noise) < 0.0 or min(self.gain, self.full_well, self.gamma) <= 0.0:
            raise SensorError("sensor: shutter and read_noise must be >= 0; gain, full_well and gamma > 0")
        if self.spot <= 0.0:
            raise SensorError(f"sensor: spot is {self.spot} px, expected more than 0")


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """Everything that a picture depends on, except the time and the seed of its noise."""

    camera: Camera
    interface: Interface
    """Interface between camera and water; its layers are flat, so ripples need an interface without a
    window."""
    basin: TiledBasin
    water: WaterOptics = field(default_factory=WaterOptics)
    sky: float = 0.3
    """Radiance [-] of ceiling or sky; the surface reflects 2 % of it at normal incidence. The scene is lit
    evenly from above."""
    ripples: Ripples | None = None
    tags: tuple[TagInScene, ...] = ()
    """Tags at rest, such as surveyed tags on the floor."""
    sensor: ImageSensor = field(default_factory=ImageSensor)
    samples: int = 2
    """Rays per pixel along each image axis near tags (elsewhere one ray). Texture and tiles are filtered over
    each ray's part of the pixel, so 2 resolves a straight edge to about 0.01 px."""

    def __post_init__(self) -> None:
        if self.ripples is not None and self.interface.window:
            raise SensorError("ripples on a window: give an interface without window, or no ripples")
        if not 1 <= self.samples <= 16:
            raise SensorError(f"samples is {self.samples}, expected 1 to 16 along each axis of a pixel")


# Geometry fixed by the camera's pose: the surface frame, and the viewing direction of every pixel corner.


Array = NDArray[np.float64]


@dataclass(frozen=True)
class SurfaceFrame:
    """Surface frame s: z along the interface's normal, origin on the still surface vertically below the
    camera.

    Coordinates near the camera are small in this frame, as single precision requires.
    """

    origin_p: Array
    """Origin, pool frame [m], (3,)."""
    R_sp: Array
    """Rotation matrix from pool frame to surface frame, (3, 3)."""
    camera_height: float
    """Height of the camera above the plane [m]."""

    def point(self, point_p: ArrayLike) -> Array:
        """Return a point of the pool frame in the surface frame [m], (..., 3)."""
        return np.asarray((np.asarray(point_p, float) - self.origin_p) @ self.R_sp.T)

    def quaternion(self, R_px: Array) -> Array:
        """Return the quaternion q_sx (xyzw), (4,), of axes x given by a rotation matrix to the pool frame, (3, 3)."""
        return matrix_to_quat(self.R_sp @ R_px)

    @property
    def offset(self) -> Array:
        """Tangential offset of the origin from the pool's origin [m], (2,)."""
        return np.asarray(self.R_sp[:2] @ self.origin_p)


def surface_frame(camera: Camera, interface: Interface) -> SurfaceFrame:
    """Return the surface frame below a camera.

    Raises:
        SensorError: The camera is not on the side that the interface's normal points to.
    """
    n = np.asarray(interface.normal, float)
    first = np.asarray(interface.tangents()[0], float)
    position = np.asarray(camera.position, float)
    height = float(n @ position + interface.offset)
    if height <= 0.0:
        raise SensorError(
            f"camera is {-height:.4g} m behind the interface: reverse the normal so that it points to the camera"
        )
    return SurfaceFrame(position - height * n, np.stack([first, np.cross(n, first), n]), height)


@lru_cache(maxsize=4)
def corner_rays(lens: Lens) -> Array:
    """Return unit directions through the corners of all pixels, optical frame, (height + 1, width + 1, 3).

    Corner (i, j) is at pixel coordinates (j - 0.5, i - 0.5). Directions are zero outside the lens' field of
    view.

    Note:
        Directions inside a pixel are interpolated between its corners, with an error of at most (1/8)
        |d²ray/du²|, below 0.001 px for focal lengths above 100 px.
    """
    u, v = np.meshgrid(np.arange(lens.width + 1) - 0.5, np.arange(lens.height + 1) - 0.5)
    rays, ok = lens.rays(np.stack([u, v], axis=-1))
    rays = np.where(ok[..., None], rays, 0.0)
    rays.setflags(write=False)
    return np.asarray(rays)


def corner_rays_s(camera: Camera, frame: SurfaceFrame) -> NDArray[np.float32]:
    """Return the unit rays of `corner_rays` in the surface frame, single precision."""
    R_sc = frame.R_sp @ np.asarray(camera.R_pc, float)
    return np.asarray(corner_rays(camera.lens) @ R_sc.T, dtype=np.float32)
