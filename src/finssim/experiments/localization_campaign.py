"""The published localization test drawn anew, with honest errors: a tag at surveyed places, and its pictures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from finssim.geometry.optics import Camera, Interface, Lens
from finssim.geometry.rotations import quat_from_euler, quat_to_matrix
from finssim.localization.pool import Pool
from finssim.vehicles.equipment import Mount, Tags

__all__ = [
    "CONDITIONS",
    "TAG",
    "Campaign",
    "Conditions",
    "Visit",
    "draw_campaign",
    "lifted",
    "published_pool",
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
        "quiet": Conditions(
            depth=0.0, tilt=0.0, survey=0.0, heading=0.0, lens=0.0, tape=0.0, level=0.0, ripples=0.0
        ),
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
    shift = random.normal(0.0, conditions.lens, 3).tolist()
    true_lens = truth.camera.lens
    lens = replace(
        true_lens,
        fx=true_lens.fx + shift[0],
        fy=true_lens.fy + shift[0],
        cx=true_lens.cx + shift[1],
        cy=true_lens.cy + shift[2],
    )
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
    depth = -float(truth.interface.distance(position))
    return Visit(
        nominal,
        position,
        R_pb,
        float(depth + off[0]),
        float(roll + off[1]),
        float(pitch + off[2]),
        int(images),
    )
