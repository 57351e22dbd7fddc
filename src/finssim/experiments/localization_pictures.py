"""From a campaign to detections: its pictures rendered by our camera or by Mitsuba, or corners by geometry alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.experiments.localization_campaign import TAG, WATER_HEIGHT, Campaign, Visit
from finssim.geometry.optics import Projection, Status, project
from finssim.geometry.rotations import matrix_to_quat
from finssim.localization.detection.detections import Detection
from finssim.localization.detection.families import bitmap
from finssim.localization.detection.tags import corners
from finssim.sensors.overhead_camera import Basin, OverheadCamera, Pose, Ripples, Scene, TagInScene

__all__ = ["RENDERERS", "Picture", "pictures", "scene_of"]

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


@dataclass(frozen=True)
class Picture:
    """One picture of a campaign."""

    visit: int
    name: str
    detection: Detection | None
    """None where the detector did not find the tag."""


Look = Callable[[Visit, float, int], Detection | None]
"""A visit, the time [s] and a seed -> what was found."""


def pictures(campaign: Campaign, renderer: str = "own") -> Iterator[Picture]:
    """All pictures of a campaign, visit by visit.

    Args:
        campaign: What was laid where.
        renderer: Key of `RENDERERS`.

    Raises:
        ValueError: There is no such renderer.
    """
    if renderer not in RENDERERS:
        raise ValueError(f"unknown renderer '{renderer}'; available: {', '.join(RENDERERS)}")
    look = RENDERERS[renderer](campaign)
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


def _geometry(campaign: Campaign) -> Look:
    """Exact projection with white noise: no picture, no ripples."""

    def look(visit: Visit, time: float, seed: int) -> Detection | None:
        seen = _seen(campaign, visit)
        if (seen.status != Status.OK).any():
            return None
        noise = np.random.default_rng(seed).normal(0.0, CORNER_NOISE, (4, 2))
        return Detection(TAG_ID, seen.pixels + noise, family=TAG.family)

    return look


def _rendered(campaign: Campaign, *, renderer: str) -> Look:
    """A picture, and what the default detector finds in it."""
    from finssim.localization.detection.detector import detector

    draw = _draw_own(campaign) if renderer == "own" else _draw_mitsuba(campaign)
    find = detector(TAG.family)

    def look(visit: Visit, time: float, seed: int) -> Detection | None:
        region = region_of(campaign, visit)
        found = find.detect(draw(visit, time, seed, region), region)
        return next((d for d in found if d.tag == TAG_ID), None)

    return look


def _draw_own(campaign: Campaign) -> Callable[..., NDArray[np.uint8]]:
    camera = OverheadCamera(scene_of(campaign))

    def draw(visit: Visit, time: float, seed: int, region: tuple[int, int, int, int]) -> NDArray[np.uint8]:
        return camera.render(tags=[tag_of(visit)], time=time, seed=seed, region=region)

    return draw


def _draw_mitsuba(campaign: Campaign) -> Callable[..., NDArray[np.uint8]]:
    from finssim.experiments.mitsuba_renderer import render_with_mitsuba

    empty = scene_of(campaign)

    def draw(visit: Visit, time: float, seed: int, region: tuple[int, int, int, int]) -> NDArray[np.uint8]:
        scene = replace(empty, tags=(tag_of(visit),))
        return render_with_mitsuba(scene, time=time, seed=seed, region=region, rays=MITSUBA_RAYS)

    return draw


RENDERERS: Mapping[str, Callable[[Campaign], Any]] = MappingProxyType(
    {
        "own": partial(_rendered, renderer="own"),
        "mitsuba": partial(_rendered, renderer="mitsuba"),
        "geometry": _geometry,
    }
)
"""Name -> what looks at a visit of a campaign."""
