"""The overhead camera of the virtual pool: pictures through rippling water, or the tag corners found in them."""

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
from finssim.pool.positioning import Exposure, Mail, PoseAt, Shutter
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


# Result of a detector that fits the known tag to the picture when ripples bend the tag's image.
#
# The fit of `localization.detection` moves a homography until the edges of all cells agree with the picture, so its
# corners are those of the tag as ripples shift it on average, not of the bent image. For small bends that is linear:
# the corners follow from a few points of the tag by a matrix that the tag's cells alone decide.


NODES = 6
"""Along each side of the tag: a polynomial of degree 5 follows ripples as long as the tag's edge."""
HOMOGENEOUS = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [1.0, 1.0, 1.0], [0.0, 1.0, 1.0]])
"""Corners of the unit square."""
_UNITY = np.eye(3)


class CornerFit:
    """The tags of a vehicle: where to look at each, and which corners the fit reports."""

    def __init__(self, family: str, tags: Sequence[int]) -> None:
        """
        Args:
            family: Name of the tags' family.
            tags: Their ids.
        """
        along = 0.5 - 0.5 * np.cos(np.pi * np.arange(NODES) / (NODES - 1))  # Chebyshev's, the ends included
        self._square = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
        self._at_corner = [0, NODES - 1, NODES * NODES - 1, NODES * (NODES - 1)]
        self.nodes = np.zeros((NODES * NODES, 3))
        """Points of a tag whose pixels `corners` wants, tag frame, in edges of its black border, (N, 3)."""
        self.nodes[:, 0] = self._square[:, 0] - 0.5
        self.nodes[:, 1] = 0.5 - self._square[:, 1]
        self._matrix = np.stack([_fit_matrix(family, tag, along, self._square) for tag in tags])

    def corners(self, pixels: Array) -> tuple[Array, Array]:
        """Corners that the fit reports, and how far ripples bend each tag.

        Args:
            pixels: Of `nodes` of every tag, (T, N, 2).

        Returns:
            Corners (T, 4, 2) [px], and the rms distance of the nodes from where the fit has them, in edges of the tag,
            (T,). Those of a tag of which not all nodes have pixels mean nothing.
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
    """Return the matrix from motions of the nodes, all x before all y, to the fit's homography (8 rows) and its
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
    """Middles of all edges between a black and a white cell, unit square of the border with y down, (E, 2), and
    whether each is upright, so that the fit feels motion along x there, (E,)."""
    kind = family_named(family)
    cells = np.pad(bitmap(family, tag).astype(bool), 1, constant_values=True)
    upright = np.argwhere(cells[:, 1:] != cells[:, :-1])[:, ::-1] + np.array([0.0, -0.5])
    level = np.argwhere(cells[1:] != cells[:-1])[:, ::-1] + np.array([-0.5, 0.0])
    points = (np.concatenate([upright, level]) - kind.outside) / kind.border
    return points, np.arange(len(points)) < len(upright)


def _warp_columns(points: Array) -> Array:
    """d(x, y)/d(h) of the homography I + [[h0, h1, h2], [h3, h4, h5], [h6, h7, 0]] at points, (E, 2, 8)."""
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
    """Weights of the nodes of a square grid in the polynomial through them, at points, (E, N)."""
    vandermonde = np.vander(along, len(along))
    by_x, by_y = (np.vander(x, len(along)) @ np.linalg.inv(vandermonde) for x in points.T)
    return np.asarray((by_y[:, :, None] * by_x[:, None, :]).reshape(len(points), -1))


# Where points in the water appear to a camera above a rippling surface, without drawing a picture.


FLAT_STEPS = 2
"""Steps of Newton's method for still water: within 1e-5 px. One is enough as a start for ripples."""
RIPPLE_STEPS = 2
"""For ripples, with the surface's curvature from the first: within 0.001 px rms at a slope of 0.01, 0.03 px at 0.03."""


class RippledView:
    """The renderer's surface and law of refraction, solved from the point to the pixel."""

    def __init__(self, camera: Camera, interface: Interface, ripples: Ripples | None = None) -> None:
        """
        Args:
            camera: Above the water.
            interface: Still surface, without a window.
            ripples: As in `sim.overhead_camera.Scene`; None for a flat surface.
        """
        self.camera = camera
        self._frame = surface_frame(camera, interface)
        self._ratio = interface.index_near / interface.index_far
        self._R_sc = np.ascontiguousarray((camera.R_pc.T @ self._frame.R_sp.T).T)
        self._surface = (
            None if ripples is None or not ripples.rms_slope else _Surface(ripples, self._frame.offset)
        )

    def pixels(self, points_p: Array, time: float) -> tuple[Array, npt.NDArray[np.bool_]]:
        """Pixels at which points appear.

        Args:
            points_p: Pool frame [m], (N, 3).
            time: Middle of the exposure [s].

        Returns:
            Pixels (N, 2), inside the picture or not, and which of them mean something: the point is under water and
            the lens has a place for it, (N,).
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
        """Return where the ray from the camera to each point crosses the surface: x, y, height, surface frame [m],
        (N,).

        Found as the root of the miss: the ray through a place of the surface, bent by the slope there, lands beside
        the point.
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
        """Return the place on ripples for a place on still water. `flat`: d landing / d place along the radius and
        across it on still water, and how much curvature adds to them."""
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
        """Return the sideways distance of a ray under water until it is at a depth [m], (N,) each."""
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
        """h [m], h_x, h_y, h_xx, h_xy, h_yy [1/m] at places, (N,) each."""
        angle = np.array((x, y)).T @ self._k
        angle += self._phase - self._omega * time
        h, h_xx, h_xy, h_yy = self._of_sine @ np.sin(angle).T
        h_x, h_y = self._of_cosine @ np.cos(angle).T
        return h, h_x, h_y, h_xx, h_xy, h_yy


# Tag corners as a detector reports them, computed from the optics without drawing a picture.


LEAST_EDGE = 12.0
"""A tag with a shorter edge is not found [px]."""
RIM = 0.15
"""White around the tag that must be in the picture too, part of its edge."""
NARROWEST = 0.25
"""A tag whose image covers less of the square over its longest side is not found: it is seen from 75° off its normal,
or from behind."""
OPPOSITE = [2, 3, 0, 1]
MOST_BENT = 0.031
"""A tag that ripples bend further from a plane one is not found, rms in edges of the tag: half of those that are bent
so are found in rendered pictures."""
UNEXPLAINED = 0.33
"""Error of a corner, part of the bend [px]: the fit gives less weight to the cells that are bent most."""


class CornerCamera:
    """Looks at the tags of a vehicle."""

    def __init__(
        self, tags: Tags, site: Pool, ripples: Ripples | None, *, pixel_noise: float, seed: int
    ) -> None:
        """
        Args:
            tags: Where they truly sit.
            site: Camera and water as they are.
            ripples: Of the water; None for flat.
            pixel_noise: Standard deviation of a corner, per axis [px].
            seed: Of the noise.
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
        """Corners at the middle of an exposure.

        Args:
            start: Position [m] and orientation (xyzw) of the body when it began, pool frame.
            end: Position [m], (3,), and attitude when it ended.
            middle: [s]
            sequence: Of the picture.
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
    """Corners of one tag in the picture, None where a detector would not find it."""
    (ax, ay), (bx, by), (cx, cy), (dx, dy) = corners.tolist()
    sides = math.hypot(bx - ax, by - ay), math.hypot(cx - bx, cy - by), math.hypot(dx - cx, dy - cy)
    area = 0.5 * ((cx - ax) * (dy - by) - (cy - ay) * (dx - bx))
    if bend > MOST_BENT or min(sides) < LEAST_EDGE or area < NARROWEST * max(sides) ** 2:
        return None
    error = math.hypot(pixel_noise, UNEXPLAINED * bend * math.sqrt(area))
    return np.asarray(corners + error * noise)


# The overhead camera of a virtual pool as it truly hangs, as its calibration has it, and how good its pictures are.


HEIGHT = 1.4
"""Height of the camera above the water, for a pool of 4 m x 2 m [m]. The paper's was at 1.21 m, from where its lens
does not see the ends of the pool. From here it sees everything that is 0.4 m under the surface, and between the walls'
last 0.23 m everything from 0.1 m down."""
SWIM = 0.4
"""Usual depth of the tags, as a share of the pool's depth."""
PAPER_POOL = 4.0, 2.0
"""[m]"""
LATENCY = 0.045
"""Average time from the middle of the exposure to the robot's computer [s]: readout, compression, USB."""


@dataclass(frozen=True, kw_only=True)
class CameraSettings:
    """Settings of the camera, and true mounts of the tags."""

    rate: float = 30.0
    """Pictures a second [Hz]."""
    exposure: float = 0.006
    """[s]"""
    latency: float = LATENCY
    """True mean time from the middle of the exposure to arrival [s]."""
    jitter: float = 0.0
    """Standard deviation of the latency from picture to picture [s]."""
    dropout: float = 0.0
    """Chance that a picture is lost."""
    ripples: float = 0.0
    """Root mean square of the water's slope [-]."""
    pixel_noise: float = 0.03
    """Noise of corners that are made without a picture, per axis [px]; rendered pictures have the noise of their
    pixels."""
    mounts: Mapping[int, TagMount] = field(default_factory=dict)
    """True mounts of tags, by id; the others are as in the vehicle file."""

    def shutter(self, seed: int) -> Shutter:
        """Its shutter, from the seed of jitter and losses."""
        return Shutter(
            rate=self.rate, exposure=self.exposure, latency=self.latency, jitter=self.jitter, dropout=self.dropout,
            seed=seed,
        )  # fmt: skip


@dataclass(frozen=True)
class _Errors:
    """Standard deviations of what a calibration does not know, and the pictures' faults."""

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
    """The lens of the published pool, 100° across, before 1280 x 720 pixels or `finer` times as many each way."""
    distortion = (0.02944176, -0.05975546, 0.00088098, 0.00179148, 0.01256862)
    f, cx, cy = finer * 540.9305, finer * (682.2341 + 0.5) - 0.5, finer * (348.6136 + 0.5) - 0.5
    return Lens(round(1280 * finer), round(720 * finer), f, f, cx, cy, "plumb_bob", distortion)


def true_site(basin: Basin | None = None, *, finer: float = 1.0) -> Pool:
    """The camera above the middle of a pool. Pool frame: x and y as the world's, z = 0 on the floor.

    Args:
        basin: 4 m x 2 m, 1 m deep if not given; the camera hangs higher over a larger one.
        finer: How many times as many pixels as the paper's it has each way.
    """
    basin = basin or Basin()
    lens, height = paper_lens(finer), _height(basin)
    # So far beside the middle that both ends of the pool are as far from the edges of the picture.
    middle = 0.5 * (lens.width - 1), 0.5 * (lens.height - 1)
    edges = [[0.0, middle[1]], [2.0 * middle[0], middle[1]], [middle[0], 0.0], [middle[0], 2.0 * middle[1]]]
    left, right, top, bottom = lens.rays(edges)[0]
    distance = height + SWIM * basin.depth / Interface.water(0.0).index_far
    x = -0.5 * distance * float(left[0] / left[2] + right[0] / right[2])
    y = 0.5 * distance * float(top[1] / top[2] + bottom[1] / bottom[2])
    camera = Camera(lens, np.array([x, y, basin.depth + height]), np.array([1.0, 0.0, 0.0, 0.0]))
    return Pool(camera, Interface.water(basin.depth), LATENCY)


def _height(basin: Basin) -> float:
    """Return the height of the camera above the water from which it sees all of a pool [m]."""
    return HEIGHT * max(basin.length / PAPER_POOL[0], basin.width / PAPER_POOL[1])


def camera_of(
    vehicle: Vehicle, seed: int, severity: Severity = "realistic", *, basin: Basin | None = None
) -> tuple[Pool, Pool, CameraSettings]:
    """Draw the camera of a plant.

    Args:
        vehicle: Has tags.
        seed: Of all errors; equal seeds give equal cameras.
        severity: How large they are: nominal has none.
        basin: Of the plant; that of plants drawn around the vehicle if None. Over a larger one the camera has as many
            more pixels as it hangs higher, so that it finds the vehicle's tags there too.

    Returns:
        The pool as it is, the pool as its calibration has it, and the settings for `PoolCamera`.

    Raises:
        PlantSpecError: The vehicle has no tags, or there is no such severity.
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
    """Return the result of a survey of a camera with these errors."""
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


# Pictures of a vehicle's tags under water, drawn by the overhead camera's renderer; its hull is left out.


MARGIN = 0.15
"""White around a tag, part of its edge."""
STILL = 0.05
"""Motion during the exposure that is left out [px]."""
SLOW = 0.4
"""Motion up to which one ray a pixel will do, where corners are placed to 0.03 px; beyond it, two by two [px]."""
REACH = 0.2
"""Distance of a tag's corner from the body's origin, for the motion by a turn [m]."""
FREEBOARD = 0.1
"""Height of the pool's edge above the water [m]."""


class PictureCamera:
    """Renders what moves in every picture, and the pool around it once."""

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
            tags: Where they truly sit.
            site: Camera and water as they are; the pool's floor is at z = 0 under its middle.
            ripples: Of the water; None for flat.
            basin: Of the pool.
            exposure: [s]
            seed: Of the noise.
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
        """Expose; arguments as of `CornerCamera.picture`."""
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
        """About how far a tag moves in the picture [px]."""
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
    """Pose of a tag on the body, pool frame."""
    x, y, z = (body[0] + quat_rotate(body[1], np.asarray(mount.position))).tolist()
    q = np.asarray(quat_multiply(body[1], mount.orientation))
    a, b, c, d = (q / np.linalg.norm(q)).tolist()
    return oc.ObjectPose(position=(x, y, z), orientation=(a, b, c, d))


class PoolCamera:
    """Takes pictures of a vehicle at a fixed rate and delivers them late, as a camera does."""

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
            vehicle: Carries tags.
            site: The camera and the water as they are, from `camera_of`.
            mode: pictures are rendered; corners are computed by the same optics without a picture, with what the
                detector would make of ripples, pixel noise and tags that it would not find.
            settings: How it takes pictures, from `camera_of`.
            basin: What the pictures show around the vehicle; that of plants drawn around it if None.
            seed: Of ripples, noise, jitter and losses.
            noise_seed: Of the noise alone, for another vehicle in the same corners; `seed` if None.

        Raises:
            PlantSpecError: The vehicle has no tags, or there is no such mode.
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
        self._mail = Mail()
        self._R_pw, self._t_pw = site.T_pw[:3, :3], site.T_pw[:3, 3]
        self._q_pw = np.asarray(site.world_orientation)

    def advance(self, t0: float, t1: float, pose_at: PoseAt) -> list[Picture]:
        """Pictures that arrive in (t0, t1], oldest first.

        Args:
            t0: Where the last call ended [s].
            t1: Now [s].
            pose_at: Time in [t0, t1] -> position [m] and orientation (xyzw) of the body, world frame.
        """
        return [self.develop(exposure) for exposure in self.exposures(t0, t1, pose_at)]

    def exposures(self, t0: float, t1: float, pose_at: PoseAt) -> list[Exposure]:
        """Return the exposures of `advance` before they are developed: for a process that renders them in parallel.

        Times are in [s].
        """
        self._mail.post(self._shutter.advance(t0, t1, pose_at))
        return self._mail.arrived(t1)

    def develop(self, exposure: Exposure) -> Picture:
        """Return the robot's picture of an exposure."""
        start, end = (
            (self._R_pw @ position + self._t_pw, quat_multiply(self._q_pw, quaternion))
            for position, quaternion in (exposure.start, exposure.end)
        )
        picture = self._view.picture(start, end, exposure.middle, exposure.sequence)
        return replace(picture, time=exposure.arrival)
