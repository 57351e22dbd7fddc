"""What the pictures of a board leave open about a lens, in sentences that say what to photograph."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from finssim.calibration.fit import Estimate
from finssim.calibration.vision.camera.lens_reach import LensReach
from finssim.geometry.optics import Lens

if TYPE_CHECKING:
    from finssim.calibration.vision.camera.camera_fit import View

__all__ = ["camera_advice"]

BORDER = 0.10
"""Empty share of the picture's width or height that is spoken of."""

FLAT = math.radians(10.0)
"""Tilt below which a board tells next to nothing of the focal length."""

TILTED = math.radians(20.0)
FEW_VIEWS = 10
LARGE_ERROR = 1.0
"""Uncertainty somewhere in the picture that is spoken of [px]."""


def camera_advice(
    lens: Lens,
    views: Sequence[View],
    estimates: Mapping[str, Estimate],
    reach: LensReach,
) -> tuple[str, ...]:
    """Sentences on coverage, tilt and what cannot be told; none if there is nothing to say."""
    return (
        *_tilt(views),
        *_border(reach),
        *_number(views),
        *_open(lens, estimates),
        *_far(reach),
    )


def _tilt(views: Sequence[View]) -> list[str]:
    tilts = np.array([view.tilt for view in views])
    if tilts.max() < FLAT:
        return [
            f"all views are within {math.degrees(tilts.max()):.0f} degrees of fronto-parallel: focal length and "
            "distance are not separable: tilt the board by 20 to 50 degrees about both its axes"
        ]
    if np.sum(tilts > TILTED) < 3:
        return [
            f"only {int(np.sum(tilts > TILTED))} views show the board tilted by more than 20 degrees: the focal length "
            "rests on them: tilt the board in more pictures"
        ]
    return []


def _border(reach: LensReach) -> list[str]:
    empty = {side: share for side, share in reach.edges.items() if share > BORDER}
    if not empty:
        return []
    words = ", ".join(f"{100.0 * share:.0f} % of the {side} edge" for side, share in empty.items())
    return [
        f"no corner within {words}: distortion there is extrapolated: take pictures with the board in the corners"
    ]


def _number(views: Sequence[View]) -> list[str]:
    if len(views) >= FEW_VIEWS:
        return []
    return [f"{len(views)} views are few: intervals are wide and rest on single pictures: take 15 to 30"]


def _open(lens: Lens, estimates: Mapping[str, Estimate]) -> list[str]:
    unsure = [e for e in estimates.values() if not e.identifiable]
    sentences = []
    if unsure:
        names = ", ".join(e.name for e in unsure)
        sentences.append(
            f"the pictures do not determine {names}: {unsure[0].note}: take more, with the board tilted"
        )
    nothing = [e.name for e in estimates.values() if e.identifiable and e.note]
    if lens.model == "rational" and len(nothing) >= 3:
        sentences.append(
            f"{', '.join(nothing)} are not told apart from 0: plumb_bob does as well: --model plumb_bob"
        )
    return sentences


def _far(reach: LensReach) -> list[str]:
    if not np.isfinite(reach.anywhere) or reach.anywhere < LARGE_ERROR:
        return []
    return [
        f"pixels are known to {reach.inside:.2f} px (95 %) where corners were seen, but only to "
        f"{reach.anywhere:.1f} px at the worst place of the picture"
    ]
