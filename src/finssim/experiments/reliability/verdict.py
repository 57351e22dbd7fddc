"""What a fault did to a vehicle, measured from the truth, and whether that is good enough."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.experiments.reliability.wire import Course

__all__ = ["LONGEST_LOSS", "QUIET", "STILL", "STOP_WITHIN", "inset", "measured", "passed"]

Array = NDArray[np.float64]

STILL = 0.05
"""Thrust below which a thruster counts as stopped [N]."""
QUIET = 1.0
"""Thrusters have stopped if none pushed for the last so much of the fault [s]; less is a pause between two pulses."""
STOP_WITHIN = 0.5
"""Thrusters shall be at zero so soon after a fault, or the vehicle shall stay inside the workspace [s]."""
LONGEST_LOSS = 1.0
"""The most that a record may lack at its end [s]."""
INSET = np.array([0.4, 0.4, 0.2])
"""The workspace of these trials is so much smaller than the vehicle file's on every side [m]: that of the pool's walls
could not be left by a vehicle that does everything wrong."""


def inset(lower: Any, upper: Any) -> tuple[Array, Array]:
    """Lower and upper corner of the workspace in which faults are tried, world frame [m], each (3,)."""
    return np.asarray(lower, float) + INSET, np.asarray(upper, float) - INSET


def measured(course: Course, began: float, ended: float, box: tuple[Array, Array] | None) -> dict[str, Any]:
    """Measures of a course.

    Args:
        course: The truth, to the end of the trial.
        began: When the fault began, pool's clock [s].
        ended: When it ended, or the trial [s].
        box: Lower and upper corner of the workspace; None: where the vehicle is does not count.

    Returns:
        `thrust_gone_s`, `frames_off_s`: from the fault to the last thrust, and to the last frame that enables motors;
        None where they did not end. `margin_m`: least distance to the workspace's faces after the fault, negative
        outside. `speed_m_s` and `thrust_n` (sum of magnitudes, mean over a second) before it.
    """
    t, fault = course.time, (course.time >= began) & (course.time <= ended)
    pushes = np.abs(course.thrust).max(axis=1) > STILL
    before = (t >= began - 1.0) & (t <= began)
    after = course.position[t >= began]
    margin = None if box is None else float(np.min([after - box[0], box[1] - after]))
    travelled = np.linalg.norm(np.diff(course.position[before], axis=0), axis=1).sum()
    return {
        "thrust_gone_s": _ended(t[fault], pushes[fault], began),
        "frames_off_s": _ended(t[fault], course.enabled[fault] > 0.0, began),
        "margin_m": margin,
        "speed_m_s": float(travelled / max(np.ptp(t[before]), 1e-9)),
        "thrust_n": float(np.abs(course.thrust[before]).sum(axis=1).mean()),
    }


def passed(result: Mapping[str, Any]) -> bool:
    """Whether a trial fulfils the contract: stopped in time or inside, nothing raised, the record readable."""
    gone, margin = result["thrust_gone_s"], result["margin_m"]
    stopped = gone is not None and gone <= STOP_WITHIN
    inside = margin is not None and margin >= 0.0
    lost = result["record_lost_s"]
    recorded = not result["record_problem"] and lost is not None and lost <= LONGEST_LOSS
    return bool((stopped or inside) and not result["raised"] and recorded)


def _ended(time: Array, active: Array, began: float) -> float | None:
    """When the last activity ended, counted from `began` [s]; None if it had not ended for `QUIET`."""
    last = float(time[active][-1]) if active.any() else began
    return None if time[-1] - last < QUIET else last - began
