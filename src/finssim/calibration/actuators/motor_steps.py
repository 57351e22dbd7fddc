"""One step of a motor: its samples, and what they say by themselves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.actuators.steps import Step

__all__ = ["NRMSE", "OVERSHOOT", "StepFit", "StepRecord", "cut_steps", "step_fit", "unit_response"]

Array = NDArray[np.float64]

OVERSHOOT, NRMSE = 0.10, 0.10
"""A step is accepted up to this overshoot and this error over its height (facts, §5)."""
BEFORE = 0.3
"""Longest part of the level before a step that is fitted with it [s]."""


@dataclass(frozen=True, kw_only=True)
class StepRecord:
    """Samples around one step of the command."""

    trial: str
    t: Array
    """Since the step [s], (n,)."""
    y: Array
    """Response, (n,)."""
    before: float
    """Command until the step."""
    after: float
    """Command from the step on."""
    sample: float
    """Time in which the command's change is not told apart [s]."""


@dataclass(frozen=True, kw_only=True)
class StepFit:
    """One step by itself."""

    height: float
    """Of the response, from level to level."""
    final: float
    """Level that the response ends on."""
    nrmse: float
    """Error of the common response, over the height."""
    overshoot: float
    """Beyond the final level, over the height; noise taken off."""
    rise: float
    """From 10 % to 90 % of the height [s]; NaN where the samples are too few."""
    moved: bool
    """Whether the response follows the command at all; it does not inside a dead zone."""
    accepted: bool


def cut_steps(
    trial: str, t: Array, y: Array, command_times: Array, steps: Sequence[Step], *, least: int = 5
) -> list[StepRecord]:
    """Samples of the response around every step; steps with fewer than `least` samples after them are left out.

    The level before a step is taken along where it has settled.

    Args:
        trial: Its name.
        t: Times of the response's samples [s], (n,).
        y: Response, (n,).
        command_times: Times of the command's samples [s], (m,).
        steps: Of the command; see `find_steps`.
        least: Samples.
    """
    records = []
    previous = float(t[0]) if t.size else 0.0
    for step in steps:
        after = (t >= step.time) & (t <= step.end)
        before = (t < step.time) & (t >= max(previous, step.time - BEFORE))
        lately = y[(t < step.time) & (t >= previous + 0.5 * (step.time - previous))]
        scatter = float(np.ptp(lately)) if lately.size else np.inf
        moved = float(np.ptp(y[after])) if after.any() else 0.0
        rows = after | before if scatter < 0.25 * moved else after
        if np.count_nonzero(after) >= least:
            near = np.diff(command_times[(command_times >= previous) & (command_times <= step.end)])
            records.append(
                StepRecord(
                    trial=trial,
                    t=t[rows] - step.time,
                    y=y[rows],
                    before=step.before,
                    after=step.after,
                    sample=float(np.median(near)) if near.size else step.time - step.start,
                )
            )
        previous = step.time
    return records


def unit_response(t: Array, delay: Array | float, time_constant: Array | float) -> Array:
    """Unit response of first order plus dead time, (n,).

    Args:
        t: Time since the step [s], (n,).
        delay: Dead time [s], a number or (n,).
        time_constant: Of the first order [s], a number or (n,).
    """
    since = np.maximum(t - delay, 0.0)
    return 1.0 - np.exp(-since / time_constant)


def step_fit(record: StepRecord, delay: float, time_constant: float, *, moved: bool) -> StepFit:
    """Levels, error, overshoot and rise of one step under the common response.

    Args:
        record: The step.
        delay: Dead time [s].
        time_constant: Of the first order [s].
        moved: Whether the response followed the command.
    """
    r = unit_response(record.t, delay, time_constant)
    rows = np.column_stack([np.ones_like(r), r])
    (a, b), *_ = np.linalg.lstsq(rows, record.y, rcond=None)
    error = record.y - rows @ np.array([a, b])
    final = float(np.mean(record.y[record.t >= 0.75 * record.t[-1]]))
    height = final - float(a)
    size = max(abs(height), 1e-300)
    nrmse = float(np.sqrt(np.mean(error**2))) / size
    overshoot = _overshoot(record, float(a), final)
    return StepFit(
        height=height,
        final=final,
        nrmse=nrmse,
        overshoot=overshoot,
        rise=_rise(record, float(a), final),
        moved=moved,
        accepted=bool(moved and nrmse <= NRMSE and overshoot <= OVERSHOOT and size > 1e-12),
    )


def _overshoot(record: StepRecord, start: float, final: float) -> float:
    """Largest excursion beyond the final level over the height, of means of three samples, less twice their noise."""
    beyond = (record.y[record.t > 0.0] - final) * np.sign(final - start)
    if beyond.size < 5 or final == start:
        return 0.0
    settled = record.y[record.t >= 0.75 * record.t[-1]]
    smooth = np.convolve(beyond, np.full(3, 1.0 / 3.0), "valid")
    noise = 2.0 * float(np.std(settled)) / math.sqrt(3.0)
    return max(float(np.max(smooth)) - noise, 0.0) / float(abs(final - start))


def _rise(record: StepRecord, start: float, final: float) -> float:
    """Time from 10 % to 90 % of the height, by the samples' first crossings."""
    after = record.t >= 0.0
    t, share = (
        record.t[after],
        (record.y[after] - start) / (final - start) if final != start else record.y[after],
    )
    crossings = []
    for level in (0.1, 0.9):
        above = np.flatnonzero(share >= level)
        if above.size == 0:
            return float("nan")
        k = int(above[0])
        crossings.append(
            float(t[k]) if k == 0 else float(np.interp(level, [share[k - 1], share[k]], [t[k - 1], t[k]]))
        )
    return crossings[1] - crossings[0]
