"""How far located tags are from where they lie: by visit, by method, and with something wrong on purpose."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.experiments.localization_campaign import TAG, Campaign, Visit
from finssim.experiments.localization_pictures import Picture
from finssim.localization.detection.tags import tag_corners_b
from finssim.localization.pool import Pool
from finssim.localization.poses.methods import METHODS, Constraints

__all__ = ["Scores", "locate", "pooled", "rmse_cm", "sensitivity"]

Array = NDArray[np.float64]

RESAMPLES = 2000
SEED = 20260903
Z_STD = 0.01
TILT_STD = float(np.radians(0.5))

TAGS_B = tag_corners_b(TAG)


@dataclass(frozen=True)
class Scores:
    """One method on one campaign's held-out visits."""

    visits: NDArray[np.intp]
    """Those that were located at least once, (n,)."""
    surveyed: Array
    """Mean estimate minus surveyed place, x and y [m], (n, 2)."""
    true: Array
    """Mean estimate minus true place [m], (n, 2)."""
    pictures: int
    located: int
    reasons: Mapping[str, int]
    """Why pictures gave no position, with how many."""

    @property
    def rmse(self) -> float:
        """Horizontal error against the surveyed places [m]; NaN where nothing was located."""
        return float(np.sqrt(np.mean(np.sum(self.surveyed**2, 1)))) if len(self.visits) else math.nan


def locate(
    campaign: Campaign,
    seen: Sequence[Picture],
    pool: Pool,
    method: str,
    *,
    pixel_std: float,
    depth_offset: float = 0.0,
) -> Scores:
    """Locate the tag in every picture of the held-out visits and average over each visit.

    Args:
        campaign: What lay where.
        seen: Its pictures.
        pool: As calibrated.
        method: Key of `finssim.localization.poses.methods.METHODS`.
        pixel_std: Standard deviation of a corner, as the calibration found it [px].
        depth_offset: Added to the depth reading [m].
    """
    found: dict[int, list[tuple[float, float]]] = {}
    reasons: dict[str, int] = {}
    pictures = 0
    for picture in seen:
        if campaign.calibrates[picture.visit]:
            continue
        pictures += 1
        visit = campaign.visits[picture.visit]
        place, reason = _one(picture, visit, pool, method, pixel_std, depth_offset)
        if place is None:
            kind = reason.partition(":")[0]
            reasons[kind] = reasons.get(kind, 0) + 1
        else:
            found.setdefault(picture.visit, []).append(place)
    index = np.array(sorted(found), np.intp)
    means = np.array([np.mean(found[k], axis=0) for k in index]).reshape(-1, 2)
    surveyed = np.array([campaign.visits[k].nominal[:2] for k in index]).reshape(-1, 2)
    true = np.array([campaign.visits[k].position[:2] for k in index]).reshape(-1, 2)
    located = sum(map(len, found.values()))
    return Scores(index, means - surveyed, means - true, pictures, located, reasons)


def _one(
    picture: Picture, visit: Visit, pool: Pool, method: str, pixel_std: float, depth_offset: float
) -> tuple[tuple[float, float] | None, str]:
    if picture.detection is None:
        return None, "tag not detected"
    water = pool.interface  # depth is measured along its normal, which is up
    given = Constraints(
        z_b=-water.offset - visit.depth_read - depth_offset,
        z_std=Z_STD,
        roll=visit.roll_read,
        pitch=visit.pitch_read,
        tilt_std=TILT_STD,
        up=tuple(water.normal.tolist()),
    )
    measured = METHODS[method]((picture.detection,), pool, TAGS_B, given, pixel_std)
    return ((measured.x, measured.y), "") if measured.ok else (None, measured.reason)


def pooled(scores: Sequence[Scores]) -> dict[str, Any]:
    """RMSE and 95th percentile over all seeds, with intervals from a bootstrap of seeds, then of visits.

    Args:
        scores: One for each seed.

    Returns:
        Centimetres, as the paper's table has them; None where nothing was located.
    """
    scored = [s for s in scores if len(s.visits)]
    errors = [np.linalg.norm(100.0 * s.surveyed, axis=1) for s in scored]
    true = [np.linalg.norm(100.0 * s.true, axis=1) for s in scored]
    random = np.random.default_rng(SEED)
    drawn = []
    for _ in range(RESAMPLES if scored else 0):
        chosen = random.integers(len(errors), size=len(errors))
        again = [errors[k][random.integers(len(errors[k]), size=len(errors[k]))] for k in chosen]
        drawn.append(_figures(np.concatenate(again)))
    nothing: tuple[None, None] = (None, None)
    rmse, p95 = _figures(np.concatenate(errors)) if scored else nothing
    true_rmse, true_p95 = _figures(np.concatenate(true)) if scored else nothing
    low, high = np.percentile(drawn, [2.5, 97.5], axis=0).tolist() if scored else (nothing, nothing)
    reasons: dict[str, int] = {}
    for s in scores:
        for reason, count in s.reasons.items():
            reasons[reason] = reasons.get(reason, 0) + count
    return {
        "rmse_cm": rmse,
        "rmse_ci95_cm": [low[0], high[0]],
        "p95_cm": p95,
        "p95_ci95_cm": [low[1], high[1]],
        "rmse_to_truth_cm": true_rmse,
        "p95_to_truth_cm": true_p95,
        "visits": sum(len(e) for e in errors),
        "pictures": sum(s.pictures for s in scores),
        "located": sum(s.located for s in scores),
        "reasons": reasons,
    }


def _figures(errors: Array) -> tuple[float, float]:
    return float(np.sqrt(np.mean(errors**2))), float(np.percentile(errors, 95))


def rmse_cm(scores: Scores) -> float | None:
    """Horizontal error against the surveyed places [cm]; None where nothing was located."""
    return 100.0 * scores.rmse if len(scores.visits) else None


DEPTHS = (-0.05, -0.02, -0.01, 0.0, 0.01, 0.02, 0.05)
TILTS = tuple(np.radians([0.0, 0.1, 0.2, 0.5, 1.0]).tolist())
INDICES = (-0.02, -0.01, -0.005, 0.0, 0.005, 0.01, 0.02)


def sensitivity(
    campaign: Campaign, seen: Sequence[Picture], pool: Pool, pixel_std: float
) -> dict[str, list[list[float | None]]]:
    """RMSE of the refractive method with one thing wrong on purpose.

    Returns:
        `depth_cm`, `tilt_deg` and `index` -> pairs of the error put in and the RMSE [cm] that comes out, None where
        nothing was located.
    """

    def rmse(changed: Pool, depth_offset: float = 0.0) -> float | None:
        given = {"pixel_std": pixel_std, "depth_offset": depth_offset}
        return rmse_cm(locate(campaign, seen, changed, "refractive", **given))

    water = pool.interface
    return {
        "depth_cm": [[100.0 * d, rmse(pool, d)] for d in DEPTHS],
        "tilt_deg": [[float(np.degrees(t)), rmse(replace(pool, interface=_leaning(pool, t)))] for t in TILTS],
        "index": [
            [i, rmse(replace(pool, interface=replace(water, index_far=water.index_far + i)))] for i in INDICES
        ],
    }


def _leaning(pool: Pool, angle: float) -> Any:
    """The water tilted about the point below the camera, which keeps its height."""
    x, y = pool.camera.position[:2]
    height = float(pool.interface.height(x, y))
    leaning = pool.interface.tilted(angle, 0.0)
    return replace(leaning, offset=-float(leaning.normal @ [x, y, height]))
