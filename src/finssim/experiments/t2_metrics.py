"""Measures of trajectory tracking from any series of times and positions: the simulator's, the virtual pool's, a log's.

The paper reports three errors against the reference at the same time: horizontal RMSE, vertical RMSE and the 95th
percentile of the distance. The others are those its published configuration names; where that gives no formula, the
reading is ours and stands here.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from finssim.control.guidance import Guide
from finssim.geometry.rotations import quat_rotate

__all__ = [
    "ERRORS",
    "MEASURES",
    "effort_measures",
    "measure_tracking",
    "projected_times",
    "summarize_tracking",
]

Array = NDArray[np.float64]

DENSE_RATE = 50.0
"""Samples per second of the reference that a position is projected on [Hz]."""

SEARCH_WINDOW = 2.0
"""A position is projected on the reference at most this long after the last one, and after its own time [s]."""

COMPLETE = 0.98
"""Part of the way that counts as the whole."""

MIN_VALID = 0.9
"""Smallest share of the duration's samples that must have a position."""

SATURATED = 0.99
"""A thruster at this part of its limit is saturated."""

ERRORS = ("horizontal_rmse_m", "vertical_rmse_m", "p95_m")
"""What the paper reports."""

MEASURES = (
    *ERRORS,
    *("cross_track_rmse_m", "cross_track_p95_m", "completion"),
    *("energy", "smoothness_per_s", "saturation", "max_tilt_deg"),
)
"""Every measure that `measure_tracking` gives."""


def measure_tracking(
    t: ArrayLike,
    position: ArrayLike,
    guide: Guide,
    *,
    quaternion: ArrayLike | None = None,
    thrust: ArrayLike | None = None,
    limits: tuple[ArrayLike, ArrayLike] | None = None,
) -> dict[str, Any]:
    """Measures of one run, over the samples from the start to the end of the trajectory.

    With e = position - reference at the same time:

        horizontal = sqrt(mean(e_x² + e_y²))    vertical = sqrt(mean e_z²)    p95: 95 % of |e| are smaller

    Cross-track errors are distances to the nearest point of the way (`projected_times`); `completion` is the part of
    the way, by length, that lies before the last sample's projection.

    Args:
        t: Times since the start of the trajectory [s], increasing, (T,).
        position: Body origin, world frame [m], (T, 3); NaN where unknown.
        guide: What was to be followed.
        quaternion: Body to world, xyzw, (T, 4), for the tilt.
        thrust: Of each thruster [N], (T, n), for energy, smoothness and saturation.
        limits: Lower and upper limit of each thruster [N], (n,) each; needed with `thrust`.

    Returns:
        `MEASURES`, None where what they need is missing; `valid`, the share of samples with a position; `complete`.

    Raises:
        ValueError: Times do not increase, or lengths differ.
    """
    t, position = np.asarray(t, np.float64), np.asarray(position, np.float64)
    if t.ndim != 1 or position.shape != (len(t), 3):
        raise ValueError(f"t and position are {t.shape} and {position.shape}, expected (T,) and (T, 3)")
    if np.any(np.diff(t) <= 0.0):
        raise ValueError("sample times do not increase: sort the samples and drop repeated ones")
    during = (t >= 0.0) & (t <= guide.duration + 1e-6)
    known = during & np.isfinite(position).all(axis=-1)
    measures: dict[str, Any] = dict.fromkeys(MEASURES)
    measures["valid"] = float(known.sum() / max(during.sum(), 1))
    measures["complete"] = False
    if measures["valid"] >= MIN_VALID:
        measures |= _errors(t[known], position[known], guide)
    if quaternion is not None:
        up = quat_rotate(np.asarray(quaternion, np.float64)[known], [0.0, 0.0, 1.0])[:, 2]
        measures["max_tilt_deg"] = math.degrees(np.arccos(np.clip(up.min(initial=1.0), -1.0, 1.0)))
    if thrust is not None and limits is not None and known.sum() > 1:
        measures |= effort_measures(t[known], np.asarray(thrust, np.float64)[known], limits)
    return measures


def _errors(t: Array, position: Array, guide: Guide) -> dict[str, Any]:
    error = position - guide.at(t).position
    projected = projected_times(t, position, guide)
    away = np.linalg.norm(position - guide.at(projected).position, axis=-1)
    completion = _way_share(guide, float(projected[-1]))
    return {
        "horizontal_rmse_m": _rms(np.linalg.norm(error[:, :2], axis=-1)),
        "vertical_rmse_m": _rms(error[:, 2]),
        "p95_m": float(np.percentile(np.linalg.norm(error, axis=-1), 95.0)),
        "cross_track_rmse_m": _rms(away),
        "cross_track_p95_m": float(np.percentile(away, 95.0)),
        "completion": completion,
        "complete": completion >= COMPLETE,
    }


def projected_times(t: Array, position: Array, guide: Guide) -> Array:
    """Times at which the reference is nearest to each position, (T,): never backwards, and never far ahead.

    Both matter where a way crosses or repeats itself. The reference is searched at 50 Hz from the last projection to
    2 s after it, but not to more than 2 s after the sample's own time. Who stops is projected where he stopped.
    """
    times = np.arange(math.floor(guide.duration * DENSE_RATE + 1e-6) + 1) / DENSE_RATE
    way = guide.at(times).position
    window = round(SEARCH_WINDOW * DENSE_RATE)
    latest = np.searchsorted(times, t + SEARCH_WINDOW + 1e-9)
    nearest, reached = np.zeros(len(t), dtype=int), 0
    for i, x in enumerate(position):
        end = max(min(reached + window, int(latest[i])), reached) + 1
        reached += int(np.argmin(np.sum((way[reached:end] - x) ** 2, axis=-1)))
        nearest[i] = reached
    return np.asarray(times[nearest])


def _way_share(guide: Guide, time: float) -> float:
    """Part of the way's length that lies before a time: near a rest, seconds are millimetres."""
    times = np.linspace(0.0, guide.duration, round(guide.duration * DENSE_RATE) + 2)
    length = np.concatenate(
        [[0.0], np.cumsum(np.linalg.norm(np.diff(guide.at(times).position, axis=0), axis=-1))]
    )
    return float(np.interp(time, times, length) / length[-1])


def effort_measures(t: Array, thrust: Array, limits: tuple[ArrayLike, ArrayLike]) -> dict[str, float]:
    """What the thrusters were asked.

        energy = ∫ sum |f|^1.5 dt [N^1.5 s]: up to a factor, a propeller's shaft energy (momentum theory)
        smoothness = RMS of the thrusts' change per second, as a part of their limits [1/s]; 0 is smoothest
        saturation = share of samples and thrusters at 99 % of the limit or more

    Args:
        t: [s], (T,).
        thrust: [N], (T, n).
        limits: Lower and upper [N], (n,) each.
    """
    lower, upper = (np.asarray(x, np.float64) for x in limits)
    part = np.where(thrust >= 0.0, thrust / upper, thrust / lower)
    step = np.diff(t)
    power = np.sum(np.abs(thrust) ** 1.5, axis=-1)
    reach = np.maximum(upper, -lower)
    return {
        "energy": float(np.sum(0.5 * (power[1:] + power[:-1]) * step)),
        "smoothness_per_s": _rms(np.diff(thrust / reach, axis=0) / step[:, None]),
        "saturation": float(np.mean(part >= SATURATED)),
    }


def summarize_tracking(trials: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """One row of the table, from the measures of its trials: means over the trials that have them.

    Returns:
        `trials`, `valid` (trials with errors), `complete` (count) and the means of `MEASURES`, None where none has one.
    """
    row: dict[str, Any] = {
        "trials": len(trials),
        "valid": sum(trial["p95_m"] is not None for trial in trials),
        "complete": sum(bool(trial["complete"]) for trial in trials),
    }
    for key in MEASURES:
        values = [trial[key] for trial in trials if trial[key] is not None]
        row[key] = float(np.mean(values)) if values else None
    return row


def _rms(x: Array) -> float:
    return math.sqrt(float(np.mean(np.square(x))))
