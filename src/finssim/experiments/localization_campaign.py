"""The published localization test drawn anew, with honest errors: places, pictures, and their calibration."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.vision.pool_command import pool_record
from finssim.calibration.vision.pool_fit import PoolFit, calibrate_pool
from finssim.calibration.vision.pool_model import Settings
from finssim.calibration.vision.survey import Observations, observe, read_survey
from finssim.experiments.campaign import choice
from finssim.geometry.optics import Camera, Interface, Lens, Projection, Status, project
from finssim.geometry.rotations import matrix_to_quat, quat_from_euler, quat_to_matrix
from finssim.localization.detection.detections import Detection, Frame, write_detections
from finssim.localization.detection.families import bitmap
from finssim.localization.detection.tags import corners
from finssim.localization.pool import Pool
from finssim.sensors.overhead_camera import Basin, OverheadCamera, Pose, Ripples, Scene, TagInScene
from finssim.vehicles import Mount, Tags

__all__ = [
    "CONDITIONS",
    "Calibrated",
    "Campaign",
    "Picture",
    "REACH",
    "RENDERERS",
    "TAG",
    "Visit",
    "calibrate",
    "draw_campaign",
    "lifted",
    "pictures",
    "write_survey",
]

Array = NDArray[np.float64]

LOCATIONS = (17, 10)
"""170 surveyed places, along and across the pool."""
IMAGES = 720
REACH = (1.84, 0.84)
"""Outermost places from the middle of the 4 m x 2 m pool [m]."""
WATER_HEIGHT = 1.0
"""Of the surface over the floor, where z = 0 [m]."""

TAG = Tags(family="tag25h9", edge=0.098, mounts={1: Mount(position=np.zeros(3))})
"""The tag of the published test; its own frame is the body."""


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """What goes wrong, as standard deviations."""

    depth: float = 0.01
    """Of the depth reading, once a visit [m]."""
    tilt: float = float(np.radians(0.5))
    """Of the roll and pitch readings, once a visit [rad]."""
    survey: float = 0.002
    """Of a place along each axis [m]."""
    heading: float = float(np.radians(0.5))
    """Of the tag's yaw as it was set down [rad]."""
    lens: float = 0.5
    """Of focal length and principal point in the camera file [px]."""
    tape: float = 0.003
    """Of the water's height as measured with a tape [m]."""
    level: float = float(np.radians(0.1))
    """Of the survey's frame against the plumb line, about x and about y [rad]."""
    ripples: float = 0.01
    """Rms slope of the surface [-]."""


CONDITIONS: Mapping[str, Conditions] = MappingProxyType(
    {
        "published": Conditions(),
        "flat": Conditions(ripples=0.0),
        "quiet": Conditions(**dict.fromkeys(Conditions.__dataclass_fields__, 0.0)),
    }
)
"""`published`: every error; `flat`: every error but ripples; `quiet`: noise of the pictures alone."""


@dataclass(frozen=True)
class Visit:
    """The tag at one surveyed place."""

    nominal: Array
    """Position as surveyed, pool frame [m], (3,); the yaw as surveyed is 0."""
    position: Array
    """Where it truly is [m], (3,)."""
    R_pb: Array
    """How it truly lies, (3, 3)."""
    depth_read: float
    """Depth of the tag as the pressure sensor tells it [m]."""
    roll_read: float
    pitch_read: float
    images: int
    """Pictures taken there."""


@dataclass(frozen=True)
class Campaign:
    """One drawing of the test."""

    seed: int
    conditions: Conditions
    truth: Pool
    """Camera and water as they are."""
    lens: Lens
    """As the camera file has it."""
    water_read: float
    """Height of the water as measured with a tape [m]."""
    visits: tuple[Visit, ...]
    calibrates: NDArray[np.bool_]
    """Which visits calibrate; the others are held out, (170,)."""


def published_pool(*, tilt_x: float = 0.0, tilt_y: float = 0.0) -> Pool:
    """Camera of the FinsROV pool, 1.17 m above 1 m of water; the floor is z = 0."""
    lens = Lens(
        width=1280,
        height=720,
        fx=540.9305,
        fy=540.9305,
        cx=682.2341,
        cy=348.6136,
        distortion=(0.02944176, -0.05975546, 0.00088098, 0.00179148, 0.01256862),
    )
    orientation = np.array([0.99876852, -0.00261252, 0.00069494, -0.04953919])
    camera = Camera(
        lens, np.array([0.032897, -0.167178, 2.171935]), orientation / np.linalg.norm(orientation)
    )
    return Pool(camera, Interface.water(WATER_HEIGHT, tilt_x=tilt_x, tilt_y=tilt_y))


def draw_campaign(
    conditions: Conditions, seed: int, *, locations: tuple[int, int] = LOCATIONS, images: int = IMAGES
) -> Campaign:
    """Draw places, readings and the split into two halves.

    Args:
        conditions: What goes wrong.
        seed: Of all random numbers.
        locations: Places along and across the pool.
        images: Pictures in all, spread evenly.
    """
    random = np.random.default_rng(seed)
    truth = published_pool(
        tilt_x=random.normal(0.0, conditions.level), tilt_y=random.normal(0.0, conditions.level)
    )
    focal, x, y = random.normal(0.0, conditions.lens, 3).tolist()
    true = truth.camera.lens
    lens = replace(true, fx=true.fx + focal, fy=true.fy + focal, cx=true.cx + x, cy=true.cy + y)
    places = np.stack(
        np.meshgrid(*(np.linspace(-r, r, n) for r, n in zip(REACH, locations, strict=True)), indexing="ij"),
        -1,
    ).reshape(-1, 2)
    count = len(places)
    pictures = np.full(count, images // count)
    pictures[random.permutation(count)[: images - pictures.sum()]] += 1
    visits = tuple(
        _visit(place, n, conditions, truth, random) for place, n in zip(places, pictures, strict=True)
    )
    half = np.zeros(count, bool)
    half[random.permutation(count)[: count // 2]] = True
    water_read = WATER_HEIGHT + random.normal(0.0, conditions.tape)
    return Campaign(seed, conditions, truth, lens, water_read, visits, half)


def lifted(campaign: Campaign, height: float) -> Campaign:
    """The held-out visits again with the tag higher in the water, every error the same.

    Args:
        campaign: As it was.
        height: How much higher [m].
    """
    up = np.array([0.0, 0.0, height])
    visits = tuple(
        replace(
            visit,
            nominal=visit.nominal + up,
            position=visit.position + up,
            depth_read=visit.depth_read - height * float(campaign.truth.interface.normal[2]),
        )
        for visit, calibrates in zip(campaign.visits, campaign.calibrates, strict=True)
        if not calibrates
    )
    return replace(campaign, visits=visits, calibrates=np.zeros(len(visits), bool))


def _visit(
    place: Array, images: int, conditions: Conditions, truth: Pool, random: np.random.Generator
) -> Visit:
    nominal = np.array([*place, 0.0])
    position = nominal + random.normal(0.0, conditions.survey, 3)
    # It lies as flat as the floor; what its bearer reads of the tilt is off by the same spread again.
    roll, pitch = random.normal(0.0, conditions.tilt, 2)
    R_pb = quat_to_matrix(quat_from_euler(roll, pitch, random.normal(0.0, conditions.heading)))
    off = random.normal(0.0, [conditions.depth, conditions.tilt, conditions.tilt])
    readings = off + (-float(truth.interface.distance(position)), roll, pitch)
    return Visit(nominal, position, R_pb, *readings.tolist(), int(images))


(TAG_ID,) = TAG.mounts
MARGIN = 0.011
"""White rim around the tag [m]: its sheet is 0.12 m wide."""
SURROUND = 40
"""Pixels around the tag that the detector is given."""
INTERVAL = 0.5
"""Between pictures, as the published replay ran [s]."""
MITSUBA_RAYS = 16
"""Rays a fine pixel."""
CORNER_NOISE = 0.2
"""Of the corners that `geometry` makes up [px]."""
RENDERERS = ("own", "mitsuba", "geometry")
"""What looks at a visit: our camera, Mitsuba, or exact projection and noise, without pictures."""


@dataclass(frozen=True)
class Picture:
    """One picture of a campaign."""

    visit: int
    name: str
    detection: Detection | None
    """None where the detector did not find the tag."""


def pictures(campaign: Campaign, renderer: str = "own") -> Iterator[Picture]:
    """All pictures of a campaign, visit by visit.

    Args:
        campaign: What was laid where.
        renderer: One of `RENDERERS`.

    Raises:
        ValueError: There is no such renderer.
    """
    choice(RENDERERS, renderer, "renderer", ValueError)
    look = _geometry(campaign) if renderer == "geometry" else _rendered(campaign, renderer)
    number = 0
    for k, visit in enumerate(campaign.visits):
        for _ in range(visit.images):
            seed = int(np.random.SeedSequence([campaign.seed, number]).generate_state(1)[0] % 2**31)
            yield Picture(k, f"{number:04d}.png", look(visit, INTERVAL * number, seed))
            number += 1


def scene_of(campaign: Campaign) -> Scene:
    """The pool as our camera and Mitsuba see it, without the tag."""
    slope = campaign.conditions.ripples
    return Scene(
        camera=campaign.truth.camera,
        interface=campaign.truth.interface,
        # The tag lies on the tiles; a floor a little lower keeps tilted tags above it.
        basin=Basin(lower=(-2.0, -1.0, -0.02), upper=(2.0, 1.0, WATER_HEIGHT + 0.1)),
        ripples=Ripples(rms_slope=slope, seed=campaign.seed) if slope else None,
    )


def tag_of(visit: Visit) -> TagInScene:
    """The tag where it truly lies."""
    x, y, z = visit.position.tolist()
    q = matrix_to_quat(visit.R_pb).tolist()
    return TagInScene(
        bitmap=bitmap(TAG.family, TAG_ID).astype(bool),
        edge=TAG.edge,
        pose=Pose(position=(x, y, z), orientation=(q[0], q[1], q[2], q[3])),
        margin=MARGIN,
    )


def region_of(campaign: Campaign, visit: Visit) -> tuple[int, int, int, int]:
    """Left, top, right and bottom of the pixels around the tag."""
    seen = _seen(campaign, visit).pixels
    lens = campaign.truth.camera.lens
    low, high = np.floor(seen.min(0)) - SURROUND, np.ceil(seen.max(0)) + SURROUND + 1
    left, top = np.maximum(low, 0).astype(int).tolist()
    right, bottom = np.minimum(high, [lens.width, lens.height]).astype(int).tolist()
    return left, top, right, bottom


def _seen(campaign: Campaign, visit: Visit) -> Projection:
    points = visit.position + corners(TAG.edge) @ visit.R_pb.T
    return project(campaign.truth.camera, campaign.truth.interface, points)


def _geometry(campaign: Campaign) -> Callable[..., Detection | None]:
    """Exact projection with white noise: no picture, no ripples."""

    def look(visit: Visit, time: float, seed: int) -> Detection | None:
        seen = _seen(campaign, visit)
        if (seen.status != Status.OK).any():
            return None
        noise = np.random.default_rng(seed).normal(0.0, CORNER_NOISE, (4, 2))
        return Detection(TAG_ID, seen.pixels + noise, family=TAG.family)

    return look


def _rendered(campaign: Campaign, renderer: str) -> Callable[..., Detection | None]:
    """A picture, and what the default detector finds in it."""
    from finssim.localization.detection.detector import detector

    scene, find = scene_of(campaign), detector(TAG.family)
    if renderer == "own":
        camera = OverheadCamera(scene)
    else:
        from finssim.experiments.mitsuba_renderer import render_with_mitsuba

    def look(visit: Visit, time: float, seed: int) -> Detection | None:
        tags, region = (tag_of(visit),), region_of(campaign, visit)
        moment: Any = {"time": time, "seed": seed, "region": region}
        if renderer == "own":
            picture = camera.render(tags=tags, **moment)
        else:
            picture = render_with_mitsuba(replace(scene, tags=tags), rays=MITSUBA_RAYS, **moment)
        return next((d for d in find.detect(picture, region) if d.tag == TAG_ID), None)

    return look


Row = dict[str, float | int | str]


@dataclass(frozen=True)
class Calibrated:
    """What the operator has afterwards."""

    refractive: Pool
    pinhole: Pool
    """Straight lines fitted to the same half."""
    fit: PoolFit
    frames: list[Frame]
    """Detections of the half that calibrates."""
    survey: list[Row]
    """Where the tag was said to lie in each of them."""

    @property
    def pixel_std(self) -> float:
        """Standard deviation of a corner per axis, ripples included, as the residuals tell it [px]."""
        return self.refractive.pixel_std


def calibrate(campaign: Campaign, seen: Sequence[Picture]) -> Calibrated:
    """Calibrate on the visits chosen for it; the truth is not looked at.

    Args:
        campaign: What was surveyed and read.
        seen: Its pictures.
    """
    chosen = [p for p in seen if campaign.calibrates[p.visit] and p.detection is not None]
    frames = [Frame(np.nan, p.name, (p.detection,)) for p in chosen if p.detection is not None]
    rows = survey_rows(campaign, chosen)
    settings = Settings(
        interface="surface",
        water_height=campaign.water_read,
        water_height_sigma=max(campaign.conditions.tape, 5e-4),
        survey_sigma=max(campaign.conditions.survey, 1e-4),
        focal_sigma=campaign.conditions.lens / campaign.lens.fx,
        center_sigma=campaign.conditions.lens,
        seed=campaign.seed,
    )
    fit = calibrate_pool(_observed(frames, rows), campaign.lens, settings)
    level = Interface.water(campaign.water_read, n_air=1.0, n_water=1.0)
    straight = fit.pinhole.model.shifted(fit.seen.points.mean(axis=0))  # it was fitted about their middle
    return Calibrated(
        Pool(fit.model.camera, fit.model.interface, record=pool_record(fit, {})),
        Pool(straight.camera, level),
        fit,
        frames,
        rows,
    )


def survey_rows(campaign: Campaign, chosen: Sequence[Picture]) -> list[Row]:
    """The survey as a table: where the tag was said to lie in each picture."""
    rows: list[Row] = []
    for picture in chosen:
        place = dict(zip("xyz", campaign.visits[picture.visit].nominal.tolist(), strict=True))
        tag = {"yaw_deg": 0.0, "tag": TAG_ID, "edge": TAG.edge}
        # All pictures of a visit share its survey error.
        rows.append({"image": picture.name, **place, **tag, "group": f"place {picture.visit}"})
    return rows


def write_survey(rows: Sequence[Row], path: Path) -> None:
    """Write the table as `finssim calibrate pool --surveyed` reads it."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys(), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def _observed(frames: list[Frame], rows: list[Row]) -> Observations:
    """Through files, as a user's data come."""
    with TemporaryDirectory() as folder:
        detections, survey = Path(folder) / "detections.csv", Path(folder) / "survey.csv"
        write_detections(frames, detections)
        write_survey(rows, survey)
        return observe([detections], read_survey(survey))
