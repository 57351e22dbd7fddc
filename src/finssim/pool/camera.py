"""The overhead camera of the virtual pool: pictures through rippling water, or the tag corners found in them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from finssim.geometry.optics import Camera, Interface, Lens
from finssim.geometry.rotations import quat_from_rotvec, quat_multiply, quat_rotate
from finssim.localization.detection.families import bitmap, family_named
from finssim.localization.pool import Pool
from finssim.pool.corner_camera import CornerCamera
from finssim.pool.plant_spec import Basin, PlantSpecError, Severity, basin_of, by_severity
from finssim.pool.positioning import Exposure, Mail, PoseAt, Shutter
from finssim.robot.messages import Picture
from finssim.sensors import overhead_camera as oc
from finssim.sensors.overhead_camera import Ripples
from finssim.vehicles import Vehicle
from finssim.vehicles.equipment import Mount, Tags

__all__ = ["CameraSettings", "PictureCamera", "PoolCamera", "camera_of", "paper_lens", "true_site"]


# The overhead camera of a virtual pool as it truly hangs, as its calibration has it, and how good its pictures are.


Array = npt.NDArray[np.float64]

HEIGHT = 1.4
"""Of the camera above the water, for a pool of 4 m x 2 m [m]. The paper's hung at 1.21 m, from where its lens does not
see the ends of the pool. From here it sees everything that is 0.4 m under the surface, and between the walls' last
0.23 m everything from 0.1 m down."""
SWIM = 0.4
"""Where tags usually are, part of the pool's depth."""
PAPER_POOL = 4.0, 2.0
"""[m]"""
LATENCY = 0.045
"""From the middle of the exposure to the robot's computer, on average [s]: readout, compression, USB."""


@dataclass(frozen=True, kw_only=True)
class CameraSettings:
    """How the camera takes its pictures, and what is on the vehicle that it looks at."""

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
    """Root mean square of the water's slope."""
    pixel_noise: float = 0.03
    """Of corners that are made without a picture, per axis [px]; rendered pictures have the noise of their pixels."""
    mounts: Mapping[int, Mount] = field(default_factory=dict)
    """Where tags truly sit, by id; those not named as the vehicle file has them."""

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
    """Of the camera above the water, from where it sees all of a pool [m]."""
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
    if vehicle.tags is None:
        raise PlantSpecError(f"vehicle {vehicle.name} has no tags: a camera cannot find it, run without one")
    errors, random = ERRORS[severity], np.random.default_rng([seed, 0x517E])
    own = basin_of(vehicle)
    true = true_site(basin or own, finer=max(_height(basin or own) / _height(own), 1.0))
    late = float(random.normal(0.0, errors.latency))
    settings = CameraSettings(
        latency=max(LATENCY + late, 0.01),
        jitter=errors.jitter,
        dropout=errors.dropout,
        ripples=errors.ripples,
        mounts={tag: _moved(mount, errors, random) for tag, mount in vehicle.tags.mounts.items()},
    )
    return replace(true, latency=settings.latency), _calibrated(true, errors, random, severity), settings


def _calibrated(true: Pool, errors: _Errors, random: np.random.Generator, severity: str) -> Pool:
    """What a survey with these errors finds of a camera."""
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


def _moved(mount: Mount, errors: _Errors, random: np.random.Generator) -> Mount:
    turn = quat_from_rotvec(random.normal(0.0, errors.mount_turn, 3))
    return Mount(
        position=np.asarray(mount.position) + random.normal(0.0, errors.mount_position, 3),
        orientation=np.asarray(quat_multiply(turn, mount.orientation)),
    )


# Pictures of a vehicle's tags under water, drawn by the overhead camera's renderer; its hull is left out.


MARGIN = 0.15
"""White around a tag, part of its edge."""
STILL = 0.05
"""Motion during the exposure that is left out [px]."""
SLOW = 0.4
"""Motion up to which one ray a pixel will do, where corners are placed to 0.03 px; beyond it, two by two [px]."""
REACH = 0.2
"""Of a tag's corner from the body's origin, for the motion that a turn makes [m]."""
FREEBOARD = 0.1
"""Of the pool's edge above the water [m]."""


class PictureCamera:
    """Draws what moves anew in every picture, and the pool around it once."""

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
            basin=oc.Basin(
                lower=(-reach[0], -reach[1], surface - basin.depth),
                upper=(reach[0], reach[1], surface + FREEBOARD),
            ),
            ripples=ripples,
            sensor=oc.Sensor(shutter=exposure),
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
        self, tag: int, mount: Mount, start: tuple[Array, Array], end: tuple[Array, Array] | None
    ) -> oc.TagInScene:
        family = family_named(self._tags.family)
        return oc.TagInScene(
            bitmap=self._bitmaps[tag],
            edge=self._tags.edge,
            border_cells=family.border,
            margin=MARGIN * self._tags.edge,
            pose=_placed(start, mount.position, mount.orientation),
            end=None if end is None else _placed(end, mount.position, mount.orientation),
        )


def _placed(body: tuple[Array, Array], position: npt.ArrayLike, orientation: npt.ArrayLike) -> oc.Pose:
    """Pose of a thing fixed to the body, pool frame."""
    x, y, z = (body[0] + quat_rotate(body[1], np.asarray(position))).tolist()
    q = np.asarray(quat_multiply(body[1], orientation))
    a, b, c, d = (q / np.linalg.norm(q)).tolist()
    return oc.Pose(position=(x, y, z), orientation=(a, b, c, d))


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
        if vehicle.tags is None:
            raise PlantSpecError(
                f"vehicle {vehicle.name} has no tags: a camera cannot find it, run without one"
            )
        if mode not in ("pictures", "corners"):
            raise PlantSpecError(f"unknown camera mode '{mode}'; available: pictures, corners")
        tags = vehicle.tags.model_copy(update={"mounts": {**vehicle.tags.mounts, **s.mounts}})
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
        """As `advance`, before they are developed: for a process that draws them while another one goes on."""
        self._mail.post(self._shutter.advance(t0, t1, pose_at))
        return self._mail.arrived(t1)

    def develop(self, exposure: Exposure) -> Picture:
        """What the robot gets of an exposure."""
        start, end = (
            (self._R_pw @ position + self._t_pw, quat_multiply(self._q_pw, quaternion))
            for position, quaternion in (exposure.start, exposure.end)
        )
        picture = self._view.picture(start, end, exposure.middle, exposure.sequence)
        return replace(picture, time=exposure.arrival)
