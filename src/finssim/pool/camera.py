"""Overhead camera of the virtual pool: pictures through rippled water, or the tag corners that a detector finds in
them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from finssim.core.optics import Camera, Interface, Lens
from finssim.core.rotations import quat_from_rotvec, quat_multiply, quat_rotate, quat_to_matrix
from finssim.localization.detection.detector import adjugate, from_square
from finssim.localization.detection.families import bitmap, family_named
from finssim.localization.overhead_camera import Pool
from finssim.pool.plant_spec import Basin, PlantSpecError, Severity, basin_of, by_severity
from finssim.pool.positioning import ArrivalQueue, Exposure, PoseAt, Shutter
from finssim.robot.messages import Picture, TagCorners
from finssim.sim import overhead_camera as oc
from finssim.sim.overhead_camera import Ripples
from finssim.sim.overhead_camera.scene import surface_frame
from finssim.sim.overhead_camera.surface import waves_of
from finssim.vehicles import Vehicle
from finssim.vehicles.equipment import TagMount, Tags

__all__ = [
    "CameraSettings", "CornerCamera", "CornerFit", "PictureCamera", "PoolCamera", "RippledView", "camera_of",
    "paper_lens", "true_site",
]  # fmt: skip

Array = npt.NDArray[np.float64]


# Result of a detector that fits the known tag to the picture, for a tag whose image is distorted by ripples.
#
# The fit of `localization.detection` adjusts a homography until the edges of all cells agree with the picture, so its
# corners are those of the mean shift of the tag, not of the distorted image. For small distortions this is linear: the
# corners follow from a few points of the tag by a matrix that depends only on the tag's cells.


NODES = 6
"""Number of nodes along each side of the tag: a polynomial of degree 5 represents ripples as long as the tag's
edge."""
HOMOGENEOUS = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [1.0, 1.0, 1.0], [0.0, 1.0, 1.0]])
"""Corners of the unit square."""
_UNITY = np.eye(3)


class CornerFit:
    """Tags of a vehicle: the sampled points of each, and the corners that the fit reports."""

    def __init__(self, family: str, tags: Sequence[int]) -> None:
        """
        Args:
            family: Name of the tags' family.
            tags: Their ids.
        """
        along = 0.5 - 0.5 * np.cos(np.pi * np.arange(NODES) / (NODES - 1))  # Chebyshev nodes, with the ends
        self._square = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
        self._at_corner = [0, NODES - 1, NODES * NODES - 1, NODES * (NODES - 1)]
        self.nodes = np.zeros((NODES * NODES, 3))
        """Points of a tag whose pixels `corners` needs, tag frame, in edges of its black border, (N, 3)."""
        self.nodes[:, 0] = self._square[:, 0] - 0.5
        self.nodes[:, 1] = 0.5 - self._square[:, 1]
        self._matrix = np.stack([_fit_matrix(family, tag, along, self._square) for tag in tags])

    def corners(self, pixels: Array) -> tuple[Array, Array]:
        """Return the corners that the fit reports, and the distortion of each tag by ripples.

        Args:
            pixels: Pixels of the `nodes` of every tag, (T, N, 2).

        Returns:
            Corners (T, 4, 2) [px], and the rms distance of the nodes from the fit, in edges of the tag, (T,). Values of
            a tag are meaningless unless all its nodes have pixels.
        """
        with np.errstate(all="ignore"):
            square = [from_square(tag) for tag in pixels[:, self._at_corner].tolist()]
            H, back = np.array(square), np.array([adjugate(tag) for tag in square])
            projected = pixels @ back[:, :, :2].transpose(0, 2, 1) + back[:, None, :, 2]
            moved = (
                (projected[..., :2] / projected[..., 2:] - self._square)
                .transpose(0, 2, 1)
                .reshape(len(H), -1)
            )
            change = (self._matrix @ moved[..., None])[..., 0]
            warp = np.zeros((len(H), 9))
            warp[:, :8] = change[:, :8]
            image = HOMOGENEOUS @ (H @ (warp.reshape(-1, 3, 3) + _UNITY)).transpose(0, 2, 1)
            bending = change[:, 8:]
            bend = np.sqrt(2.0 * (bending * bending).sum(axis=1) / bending.shape[1])
            return image[..., :2] / image[..., 2:], bend


def _fit_matrix(family: str, tag: int, along: Array, square: Array) -> Array:
    """Return the matrix from shifts of the nodes, all x before all y, to the fit's homography (8 rows) and its
    residual."""
    points, across = _cell_edges(family, tag)
    columns, there = _warp_columns(points), _interpolation(along, points)
    rows = np.where(across[:, None], columns[:, 0], columns[:, 1])
    u, v = np.where(across[:, None], there, 0.0), np.where(across[:, None], 0.0, there)
    warp = np.linalg.pinv(rows) @ np.concatenate([u, v], axis=1)
    at_nodes = _warp_columns(square)
    remainder = np.eye(2 * len(square)) - np.concatenate([at_nodes[:, 0], at_nodes[:, 1]]) @ warp
    return np.concatenate([warp, remainder])


def _cell_edges(family: str, tag: int) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Return the midpoints of all edges between a black and a white cell, unit square of the border with y down, (E,
    2), and whether each edge is vertical, so that the fit is sensitive to motion along x, (E,)."""
    kind = family_named(family)
    cells = np.pad(bitmap(family, tag).astype(bool), 1, constant_values=True)
    upright = np.argwhere(cells[:, 1:] != cells[:, :-1])[:, ::-1] + np.array([0.0, -0.5])
    level = np.argwhere(cells[1:] != cells[:-1])[:, ::-1] + np.array([-0.5, 0.0])
    points = (np.concatenate([upright, level]) - kind.outside) / kind.border
    return points, np.arange(len(points)) < len(upright)


def _warp_columns(points: Array) -> Array:
    """Return d(x, y)/d(h) of the homography I + [[h0, h1, h2], [h3, h4, h5], [h6, h7, 0]] at points, (E, 2, 8)."""
    x, y = points.T
    ones, zero = np.ones_like(x), np.zeros_like(x)
    return np.stack(
        [
            np.stack([x, y, ones, zero, zero, zero, -x * x, -x * y], axis=-1),
            np.stack([zero, zero, zero, x, y, ones, -x * y, -y * y], axis=-1),
        ],
        axis=1,
    )


def _interpolation(along: Array, points: Array) -> Array:
    """Return the weights of the nodes of a square grid in the interpolating polynomial, at points, (E, N)."""
    vandermonde = np.vander(along, len(along))
    by_x, by_y = (np.vander(x, len(along)) @ np.linalg.inv(vandermonde) for x in points.T)
    return np.asarray((by_y[:, :, None] * by_x[:, None, :]).reshape(len(points), -1))


# Pixels of points in the water for a camera above a rippled surface, without rendering a picture.


FLAT_STEPS = 2
"""Newton steps for still water: within 1e-5 px. One is enough as a start for ripples."""
RIPPLE_STEPS = 2
"""Newton steps for ripples, with the surface curvature of the first: within 0.001 px rms at a slope of 0.01, 0.03 px at
0.03."""


class RippledView:
    """Projection from a point to its pixel, with the surface and the refraction of the renderer."""

    def __init__(self, camera: Camera, interface: Interface, ripples: Ripples | None = None) -> None:
        """
        Args:
            camera: Camera above the water.
            interface: Still surface, without a window.
            ripples: Same as in `sim.overhead_camera.Scene`; None for a flat surface.
        """
        self.camera = camera
        self._frame = surface_frame(camera, interface)
        self._ratio = interface.index_near / interface.index_far
        self._R_sc = np.ascontiguousarray((camera.R_pc.T @ self._frame.R_sp.T).T)
        self._surface = (
            None if ripples is None or not ripples.rms_slope else _Surface(ripples, self._frame.offset)
        )

    def pixels(self, points_p: Array, time: float) -> tuple[Array, npt.NDArray[np.bool_]]:
        """Return the pixels at which points appear.

        Args:
            points_p: Pool frame [m], (N, 3).
            time: Middle of the exposure [s].

        Returns:
            Pixels (N, 2), inside or outside the picture, and whether each is valid: the point is under water and within
            the domain of the lens, (N,).
        """
        points = self._frame.point(points_p)
        direction = np.empty_like(points)
        with np.errstate(all="ignore"):
            x, y, height = self._crossing(points[:, 0], points[:, 1], -points[:, 2], time)
            direction[:, 0], direction[:, 1], direction[:, 2] = x, y, height - self._frame.camera_height
            pixels, visible = self.camera.lens.project(direction @ self._R_sc)
        return pixels, visible & (points[:, 2] < height) & np.isfinite(x)

    def _crossing(
        self, px: Array, py: Array, depth: Array, time: float
    ) -> tuple[Array, Array, Array | float]:
        """Return the point where the ray from the camera to each target crosses the surface: x, y, height, surface
        frame [m], (N,).

        It is the root of the miss distance: the ray through a surface point, refracted by the slope there, misses the
        target.
        """
        H, r = self._frame.camera_height, self._ratio
        reach = np.hypot(px, py)
        radius = reach * (H / (H + r * depth))
        for _ in range(FLAT_STEPS if self._surface is None else 1):
            cosine = H / np.sqrt(H * H + radius * radius)
            beyond = np.sqrt(1.0 - r * r * (1.0 - cosine * cosine))
            spread = depth * r * cosine / (beyond * H)
            along = 1.0 + spread * (cosine / beyond) ** 2
            radius = radius + (reach - radius * (1.0 + spread)) / along
        share = radius / np.maximum(reach, 1e-12)
        x, y = px * share, py * share
        if self._surface is None:
            return x, y, 0.0
        across = 1.0 + spread
        return self._rippled((x, y), (px, py), depth, (along, across, (1.0 - r) / beyond * depth), time)

    def _rippled(
        self,
        still: tuple[Array, Array],
        target: tuple[Array, Array],
        depth: Array,
        flat: tuple[Array, Array, Array],
        time: float,
    ) -> tuple[Array, Array, Array]:
        """Return the crossing points on rippled water from those on still water. `flat`: derivatives of the landing
        point by the crossing point, along and across the radius on still water, and their change with curvature."""
        assert self._surface is not None
        x, y = still
        along, across, by_curvature = flat
        height, sx, sy, hxx, hxy, hyy = self._surface.at(x, y, time)
        pull = (along - across) / np.maximum(x * x + y * y, 1e-12)
        a, b, c = (
            across + pull * x * x + by_curvature * hxx,
            pull * x * y + by_curvature * hxy,
            across + pull * y * y + by_curvature * hyy,
        )
        inverse = 1.0 / (a * c - b * b)
        for k in range(RIPPLE_STEPS):
            if k > 0:
                height, sx, sy, *_ = self._surface.at(x, y, time)
            fx, fy = self._step(x, y, height, sx, sy, depth)
            miss_x, miss_y = (target[0] - x - fx) * inverse, (target[1] - y - fy) * inverse
            x, y = x + c * miss_x - b * miss_y, y + a * miss_y - b * miss_x
        return x, y, height

    def _step(
        self, x: Array, y: Array, height: Array, sx: Array, sy: Array, depth: Array
    ) -> tuple[Array, Array]:
        """Return the horizontal displacement of an underwater ray down to a depth [m], (N,) each."""
        r = self._ratio
        drop = self._frame.camera_height - height
        length = np.sqrt(x * x + y * y + drop * drop)
        steep = 1.0 / np.sqrt(1.0 + sx * sx + sy * sy)
        cosine = (x * sx + y * sy + drop) * steep / length
        # Snell's law: b = r ray + (r cos - cos') n, with ray = (x, y, -drop)/length and n = (-sx, -sy, 1) steep.
        turn = (r * cosine - np.sqrt(1.0 - r * r * (1.0 - cosine * cosine))) * steep
        short = r / length
        scale = (depth + height) / (drop * short - turn)
        return (x * short - sx * turn) * scale, (y * short - sy * turn) * scale


class _Surface:
    """Height, slope and curvature of the ripples, surface frame."""

    def __init__(self, ripples: Ripples, offset: Array) -> None:
        waves = waves_of(ripples)
        self._k = np.ascontiguousarray(waves.k.T)
        self._omega = waves.omega
        self._phase = waves.phase + offset @ self._k
        kx, ky = self._k
        a = waves.amplitude
        self._of_sine = np.stack([a, -a * kx * kx, -a * kx * ky, -a * ky * ky])
        self._of_cosine = np.stack([a * kx, a * ky])

    def at(self, x: Array, y: Array, time: float) -> tuple[Array, Array, Array, Array, Array, Array]:
        """Return h [m], h_x, h_y, h_xx, h_xy, h_yy [1/m] at points, (N,) each."""
        angle = np.array((x, y)).T @ self._k
        angle += self._phase - self._omega * time
        h, h_xx, h_xy, h_yy = self._of_sine @ np.sin(angle).T
        h_x, h_y = self._of_cosine @ np.cos(angle).T
        return h, h_x, h_y, h_xx, h_xy, h_yy


# Tag corners as a detector reports them, computed from the optics without rendering a picture.


LEAST_EDGE = 12.0
"""Shortest edge of a tag that is detected [px]."""
RIM = 0.15
"""White margin of the tag that must be in the picture too, as a fraction of its edge."""
NARROWEST = 0.25
"""Smallest ratio of a detected tag's image area to the square of its longest side: less means a view from more than 75°
off its normal, or from behind."""
OPPOSITE = [2, 3, 0, 1]
MOST_BENT = 0.031
"""Largest distortion by ripples at which a tag is detected, rms in edges of the tag: at this value half of the tags are
found in rendered pictures."""
UNEXPLAINED = 0.33
"""Ratio of a corner's error to the distortion [-]: the fit reduces the weight of strongly distorted cells."""


class CornerCamera:
    """Camera whose output is the tag corners of a vehicle."""

    def __init__(
        self, tags: Tags, site: Pool, ripples: Ripples | None, *, pixel_noise: float, seed: int
    ) -> None:
        """
        Args:
            tags: Tags with their true mounts.
            site: True camera and water.
            ripples: Ripples of the water; None for a flat surface.
            pixel_noise: Standard deviation of a corner, per axis [px].
            seed: Seed of the noise.
        """
        self._noise, self._seed = pixel_noise, seed
        self._inside = site.camera.lens.inside
        self._view = RippledView(site.camera, site.interface, ripples)
        self._ids = list(tags.mounts)
        self._fit = CornerFit(tags.family, self._ids)
        self._nodes_b = np.concatenate(
            [
                np.asarray(m.position) + tags.edge_of(tag) * self._fit.nodes @ quat_to_matrix(m.orientation).T
                for tag, m in tags.mounts.items()
            ]
        )

    def picture(
        self, start: tuple[Array, Array], end: tuple[Array, Array], middle: float, sequence: int
    ) -> Picture:
        """Return the corners at the middle of an exposure.

        Args:
            start: Position [m] and orientation (xyzw) of the body at its start, pool frame.
            end: Position [m], (3,), and quaternion at its end.
            middle: Time [s].
            sequence: Number of the picture.
        """
        q = start[1] + math.copysign(1.0, float(start[1] @ end[1])) * end[1]
        position, R = 0.5 * (start[0] + end[0]), quat_to_matrix(q / np.linalg.norm(q))
        pixels, visible = self._view.pixels(position + self._nodes_b @ R.T, middle)
        shape = len(self._ids), -1
        visible = visible.reshape(shape).all(axis=1)
        corners, bend = self._fit.corners(pixels.reshape(*shape, 2))
        rim = self._inside(corners + RIM * (corners - corners[:, OPPOSITE])).all(axis=1)
        noise = np.random.default_rng([self._seed, sequence]).standard_normal(corners.shape)
        tags = [
            TagCorners(tag, reported)
            for tag, there, c, b, e in zip(
                self._ids, visible & rim, corners, bend.tolist(), noise, strict=True
            )
            if there and (reported := _reported(c, b, self._noise, e)) is not None
        ]
        return Picture(middle, sequence, tags=tuple(tags))


def _reported(corners: Array, bend: float, pixel_noise: float, noise: Array) -> Array | None:
    """Return the corners of one tag in the picture; None if a detector would not find it."""
    (ax, ay), (bx, by), (cx, cy), (dx, dy) = corners.tolist()
    sides = math.hypot(bx - ax, by - ay), math.hypot(cx - bx, cy - by), math.hypot(dx - cx, dy - cy)
    area = 0.5 * ((cx - ax) * (dy - by) - (cy - ay) * (dx - bx))
    if bend > MOST_BENT or min(sides) < LEAST_EDGE or area < NARROWEST * max(sides) ** 2:
        return None
    error = math.hypot(pixel_noise, UNEXPLAINED * bend * math.sqrt(area))
    return np.asarray(corners + error * noise)


# Overhead camera of a virtual pool: its true parameters, its calibration, and the quality of its pictures.


HEIGHT = 1.4
"""Height of the camera above the water, for a pool of 4 m x 2 m [m]. The paper's was at 1.21 m, where its lens does not
cover the ends of the pool. At this height it covers everything from 0.4 m below the surface, and everything from 0.1 m
down except the last 0.23 m at the walls."""
SWIM = 0.4
"""Usual depth of the tags, as a fraction of the pool's depth."""
PAPER_POOL = 4.0, 2.0
"""Length and width of the paper's pool [m]."""
LATENCY = 0.045
"""Mean time from the middle of the exposure to the robot's computer [s]: readout, compression, USB."""


@dataclass(frozen=True, kw_only=True)
class CameraSettings:
    """Settings of the camera, and true mounts of the tags."""

    rate: float = 30.0
    """Picture rate [Hz]."""
    exposure: float = 0.006
    """[s]"""
    latency: float = LATENCY
    """True mean time from the middle of the exposure to arrival [s]."""
    jitter: float = 0.0
    """Standard deviation of the latency between pictures [s]."""
    dropout: float = 0.0
    """Probability that a picture is lost."""
    ripples: float = 0.0
    """Root mean square of the water's slope [-]."""
    pixel_noise: float = 0.03
    """Noise of corners without a rendered picture, per axis [px]; rendered pictures have pixel noise instead."""
    mounts: Mapping[int, TagMount] = field(default_factory=dict)
    """True mounts of tags, by id; missing ones are as in the vehicle file."""

    def shutter(self, seed: int) -> Shutter:
        """Return the shutter, from the seed of jitter and losses."""
        return Shutter(
            rate=self.rate, exposure=self.exposure, latency=self.latency, jitter=self.jitter, dropout=self.dropout,
            seed=seed,
        )  # fmt: skip


@dataclass(frozen=True)
class _Errors:
    """Standard deviations of the calibration errors, and faults of the pictures."""

    position: float  # of the camera, per axis [m]
    tilt: float  # about each axis [rad]
    focal: float  # relative
    water: float  # height [m]
    latency: float  # [s]
    mount_position: float  # per axis [m]
    mount_turn: float  # per axis [rad]
    jitter: float  # [s]
    dropout: float
    ripples: float


ERRORS = by_severity(
    _Errors,
    position=(0.0, 0.002, 0.004),
    tilt=(0.0, math.radians(0.1), math.radians(0.2)),
    focal=(0.0, 0.001, 0.002),
    water=(0.0, 0.002, 0.004),
    latency=(0.0, 0.003, 0.006),
    mount_position=(0.0, 0.001, 0.002),
    mount_turn=(0.0, math.radians(0.2), math.radians(0.4)),
    jitter=(0.0, 0.002, 0.005),
    dropout=(0.0, 0.005, 0.02),
    ripples=(0.0, 0.01, 0.03),
)
"""Severity -> errors."""


def paper_lens(finer: float = 1.0) -> Lens:
    """Return the lens of the published pool, 100° wide, with 1280 x 720 pixels or `finer` times as many in each
    direction."""
    distortion = (0.02944176, -0.05975546, 0.00088098, 0.00179148, 0.01256862)
    f, cx, cy = finer * 540.9305, finer * (682.2341 + 0.5) - 0.5, finer * (348.6136 + 0.5) - 0.5
    return Lens(round(1280 * finer), round(720 * finer), f, f, cx, cy, "plumb_bob", distortion)


def true_site(basin: Basin | None = None, *, finer: float = 1.0) -> Pool:
    """Return the camera above the middle of a pool. Pool frame: x and y of the world frame, z = 0 on the floor.

    Args:
        basin: Basin of the pool; 4 m x 2 m, 1 m deep if not given; above a larger one the camera is higher.
        finer: Factor on the paper's number of pixels in each direction.
    """
    basin = basin or Basin()
    lens, height = paper_lens(finer), _height(basin)
    # Offset from the middle such that both ends of the pool are equally far from the edges of the picture.
    middle = 0.5 * (lens.width - 1), 0.5 * (lens.height - 1)
    edges = [[0.0, middle[1]], [2.0 * middle[0], middle[1]], [middle[0], 0.0], [middle[0], 2.0 * middle[1]]]
    left, right, top, bottom = lens.rays(edges)[0]
    distance = height + SWIM * basin.depth / Interface.water(0.0).index_far
    x = -0.5 * distance * float(left[0] / left[2] + right[0] / right[2])
    y = 0.5 * distance * float(top[1] / top[2] + bottom[1] / bottom[2])
    camera = Camera(lens, np.array([x, y, basin.depth + height]), np.array([1.0, 0.0, 0.0, 0.0]))
    return Pool(camera, Interface.water(basin.depth), LATENCY)


def _height(basin: Basin) -> float:
    """Return the height of the camera above the water at which it covers all of a pool [m]."""
    return HEIGHT * max(basin.length / PAPER_POOL[0], basin.width / PAPER_POOL[1])


def camera_of(
    vehicle: Vehicle, seed: int, severity: Severity = "realistic", *, basin: Basin | None = None
) -> tuple[Pool, Pool, CameraSettings]:
    """Draw the camera of a plant.

    Args:
        vehicle: Vehicle with tags.
        seed: Seed of all errors; equal seeds give equal cameras.
        severity: Size of the errors: nominal has none.
        basin: Basin of the plant; None for that of plants drawn for the vehicle. Above a larger basin, the number of
            pixels grows with the height of the camera, so that it still finds the vehicle's tags.

    Returns:
        The true pool, the calibrated pool, and the settings for `PoolCamera`.

    Raises:
        PlantSpecError: The vehicle has no tags, or the severity does not exist.
    """
    if severity not in ERRORS:
        raise PlantSpecError(f"unknown severity '{severity}'; available: {', '.join(ERRORS)}")
    tags = _tags_of(vehicle)
    errors, random = ERRORS[severity], np.random.default_rng([seed, 0x517E])
    nominal = basin_of(vehicle)
    true = true_site(basin or nominal, finer=max(_height(basin or nominal) / _height(nominal), 1.0))
    late = float(random.normal(0.0, errors.latency))
    settings = CameraSettings(
        latency=max(LATENCY + late, 0.01),
        jitter=errors.jitter,
        dropout=errors.dropout,
        ripples=errors.ripples,
        mounts={tag: _moved(mount, errors, random) for tag, mount in tags.mounts.items()},
    )
    return replace(true, latency=settings.latency), _calibrated(true, errors, random, severity), settings


def _tags_of(vehicle: Vehicle) -> Tags:
    if vehicle.tags is None:
        raise PlantSpecError(f"vehicle {vehicle.name} has no tags: a camera cannot find it, run without one")
    return vehicle.tags


def _calibrated(true: Pool, errors: _Errors, random: np.random.Generator, severity: str) -> Pool:
    """Return the result of a calibration with these errors."""
    lens, focal = true.camera.lens, 1.0 + errors.focal * random.normal(0.0, 1.0)
    lens = replace(lens, fx=lens.fx * focal, fy=lens.fy * focal)
    turn = quat_from_rotvec(random.normal(0.0, errors.tilt, 3))
    camera = Camera(
        lens,
        true.camera.position + random.normal(0.0, errors.position, 3),
        np.asarray(quat_multiply(turn, true.camera.orientation)),
    )
    height = float(true.interface.height(0.0, 0.0)) + random.normal(0.0, errors.water)
    return Pool(
        camera, Interface.water(height), true.latency, record={"made_by": f"virtual pool, {severity}"}
    )


def _moved(mount: TagMount, errors: _Errors, random: np.random.Generator) -> TagMount:
    turn = quat_from_rotvec(random.normal(0.0, errors.mount_turn, 3))
    position = np.asarray(mount.position) + random.normal(0.0, errors.mount_position, 3)
    orientation = np.asarray(quat_multiply(turn, mount.orientation))
    return mount.model_copy(update={"position": position, "orientation": orientation})


# Pictures of a vehicle's tags under water, from the overhead camera's renderer, without the hull.


MARGIN = 0.15
"""White margin around a tag, as a fraction of its edge."""
STILL = 0.05
"""Motion during the exposure that is neglected [px]."""
SLOW = 0.4
"""Motion up to which one ray per pixel locates corners to 0.03 px; beyond it, pixels have two by two rays [px]."""
REACH = 0.2
"""Distance of a tag's corner from the body's origin, for its motion by rotation [m]."""
FREEBOARD = 0.1
"""Height of the pool's edge above the water [m]."""


class PictureCamera:
    """Camera that renders moving tags in every picture, and the pool around them once."""

    def __init__(
        self,
        tags: Tags,
        site: Pool,
        ripples: oc.Ripples | None,
        *,
        basin: Basin,
        exposure: float,
        seed: int,
    ) -> None:
        """
        Args:
            tags: Tags with their true mounts.
            site: True camera and water; the pool's floor is at z = 0 below its middle.
            ripples: Ripples of the water; None for a flat surface.
            basin: Basin of the pool.
            exposure: [s]
            seed: Seed of the noise.
        """
        self._tags, self._seed = tags, seed
        self._bitmaps = {tag: bitmap(tags.family, tag).astype(bool) for tag in tags.mounts}
        reach = (0.5 * basin.length, 0.5 * basin.width)
        surface = float(site.interface.height(0.0, 0.0))
        scene = oc.Scene(
            camera=site.camera,
            interface=site.interface,
            basin=oc.TiledBasin(
                lower=(-reach[0], -reach[1], surface - basin.depth),
                upper=(reach[0], reach[1], surface + FREEBOARD),
            ),
            ripples=ripples,
            sensor=oc.ImageSensor(shutter=exposure),
            samples=1,
        )
        self._slow = oc.OverheadCamera(scene)
        self._fast = oc.OverheadCamera(replace(scene, samples=2))
        height = float(site.interface.distance(site.camera.position))
        self._per_metre = site.camera.lens.fx / (height + 0.25 * basin.depth)

    def picture(
        self, start: tuple[Array, Array], end: tuple[Array, Array], middle: float, sequence: int
    ) -> Picture:
        """Return the rendered picture; arguments as for `CornerCamera.picture`."""
        motion = self._motion(start, end)
        moves = motion > STILL
        image = (self._slow if motion < SLOW else self._fast).render(
            tags=[self._tag(t, m, start, end if moves else None) for t, m in self._tags.mounts.items()],
            time=middle,
            seed=(self._seed * 1_000_003 + sequence) % 2**31,
            region="tags",
        )
        return Picture(middle, sequence, image=image)

    def _motion(self, start: tuple[Array, Array], end: tuple[Array, Array]) -> float:
        """Estimate the motion of a tag in the picture [px]."""
        turn = 2.0 * math.sqrt(max(1.0 - float(start[1] @ end[1]) ** 2, 0.0))
        return self._per_metre * (float(np.linalg.norm(end[0] - start[0])) + REACH * turn)

    def _tag(
        self, tag: int, mount: TagMount, start: tuple[Array, Array], end: tuple[Array, Array] | None
    ) -> oc.TagInScene:
        family = family_named(self._tags.family)
        return oc.TagInScene(
            bitmap=self._bitmaps[tag],
            edge=self._tags.edge_of(tag),
            border_cells=family.border,
            margin=MARGIN * self._tags.edge_of(tag),
            pose=_placed(start, mount),
            end=None if end is None else _placed(end, mount),
        )


def _placed(body: tuple[Array, Array], mount: TagMount) -> oc.ObjectPose:
    """Return the pose of a tag on the body, pool frame."""
    x, y, z = (body[0] + quat_rotate(body[1], np.asarray(mount.position))).tolist()
    q = np.asarray(quat_multiply(body[1], mount.orientation))
    a, b, c, d = (q / np.linalg.norm(q)).tolist()
    return oc.ObjectPose(position=(x, y, z), orientation=(a, b, c, d))


class PoolCamera:
    """Overhead camera of a vehicle, with a fixed picture rate and a delivery latency."""

    def __init__(
        self,
        vehicle: Vehicle,
        site: Pool,
        *,
        mode: Literal["pictures", "corners"] = "pictures",
        settings: CameraSettings | None = None,
        basin: Basin | None = None,
        seed: int = 0,
        noise_seed: int | None = None,
    ) -> None:
        """
        Args:
            vehicle: Vehicle with tags.
            site: True camera and water, from `camera_of`.
            mode: pictures are rendered; corners are computed by the same optics without a picture, with the detector's
            errors
                by ripples and pixel noise, and without tags that it would not find.
            settings: Settings of the camera, from `camera_of`.
            basin: Surroundings of the vehicle in the pictures; None for the basin of plants drawn for the vehicle.
            seed: Seed of ripples, noise, jitter and losses.
            noise_seed: Separate seed of the noise, for another vehicle in the same pictures; None for `seed`.

        Raises:
            PlantSpecError: The vehicle has no tags, or the mode does not exist.
        """
        s = settings or CameraSettings(latency=site.latency)
        tags = _tags_of(vehicle)
        if mode not in ("pictures", "corners"):
            raise PlantSpecError(f"unknown camera mode '{mode}'; available: pictures, corners")
        tags = tags.model_copy(update={"mounts": {**tags.mounts, **s.mounts}})
        ripples = Ripples(rms_slope=s.ripples, seed=seed) if s.ripples else None
        self._view: CornerCamera | PictureCamera
        if mode == "corners":
            self._view = CornerCamera(tags, site, ripples, pixel_noise=s.pixel_noise, seed=noise_seed or seed)
        else:
            self._view = PictureCamera(
                tags,
                site,
                ripples,
                basin=basin or basin_of(vehicle),
                exposure=s.exposure,
                seed=seed,
            )
        self._shutter = s.shutter(seed)
        self._arrivals = ArrivalQueue()
        self._R_pw, self._t_pw = site.T_pw[:3, :3], site.T_pw[:3, 3]
        self._q_pw = np.asarray(site.world_orientation)

    def advance(self, t0: float, t1: float, pose_at: PoseAt) -> list[Picture]:
        """Return the pictures that arrive in (t0, t1], oldest first.

        Args:
            t0: End of the last call [s].
            t1: Present time [s].
            pose_at: Time in [t0, t1] -> position [m] and orientation (xyzw) of the body, world frame.
        """
        return [self.develop(exposure) for exposure in self.exposures(t0, t1, pose_at)]

    def exposures(self, t0: float, t1: float, pose_at: PoseAt) -> list[Exposure]:
        """Return the exposures of `advance` before rendering, for a process that renders them in parallel.

        Times are in [s].
        """
        self._arrivals.post(self._shutter.advance(t0, t1, pose_at))
        return self._arrivals.arrived(t1)

    def develop(self, exposure: Exposure) -> Picture:
        """Return the robot's picture of an exposure."""
        start, end = (
            (self._R_pw @ position + self._t_pw, quat_multiply(self._q_pw, quaternion))
            for position, quaternion in (exposure.start, exposure.end)
        )
        picture = self._view.picture(start, end, exposure.middle, exposure.sequence)
        return replace(picture, time=exposure.arrival)
