"""Motors that were already running when a segment begins: their state and their delay line, for every candidate."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["warm_motors"]

Array = NDArray[Any]


def warm_motors(
    before: Array, fields: Mapping[str, Array], step: float, substeps: int, *, slots: int
) -> tuple[Array, Array]:
    """Run the commands before a segment through limits, dead zone, delay, lag and slew as the simulator does.

    Args:
        before: Commanded forces of the steps before the start, the newest last [N], (m, S, 8).
        fields: Plant fields by (C, S, ...); either axis may be 1.
        step: Between commands [s].
        substeps: Physics steps in it.
        slots: Of the simulator's delay line.

    Returns:
        State of the lag at the start [N or rad/s], (C, S, 8), and the delay line as the simulator keeps it before its
        first step: slot -k holds the command of k steps before, (C, S, slots, 8). C may be 1.
    """
    f = {
        k: np.asarray(fields[k], float)
        for k in (
            "force_min",
            "force_max",
            "dead_minus",
            "dead_plus",
            "time_constant",
            "slew",
            "c_plus",
            "c_minus",
        )
    }
    delay = np.asarray(fields["delay"], float)
    speed = np.asarray(fields["speed_lag"])[..., None] != 0
    told = np.clip(before[:, None], f["force_min"], f["force_max"])
    told = np.where((told > f["dead_minus"]) & (told < f["dead_plus"]), 0.0, told)
    if speed.any():
        c = np.where(told >= 0.0, f["c_plus"], f["c_minus"])
        omega = np.sign(told) * np.sqrt(np.abs(told) / np.where(c > 0.0, c, np.inf))
        told = np.where(speed, omega, told)
    m, C, S = told.shape[0], max(told.shape[1], delay.shape[0], f["time_constant"].shape[0]), told.shape[2]
    told = np.broadcast_to(told, (m, C, S, 8))
    line = np.zeros((C, S, slots, 8))
    count = min(m, slots - 1)
    line[:, :, slots - count :] = np.moveaxis(told[m - count :], 0, 2)
    tc = np.broadcast_to(f["time_constant"], (C, S, 8))
    if not (tc > 0.0).any() and not (delay > 0.0).any():
        return told[-1], line

    h = step / substeps
    alpha = np.where(tc > 0.0, -np.expm1(-h / np.where(tc > 0.0, tc, 1.0)), 1.0)
    late = np.broadcast_to(delay, (C, S))
    x = told[0]
    worlds = np.indices((C, S))
    for i in range(m):
        for k in range(substeps):
            age = late - k * h
            old, new = (np.maximum(np.ceil(a / step - 1e-4), 0).astype(int) for a in (age, age - h))
            part = np.clip((age / step - new) / (h / step), 0.0, 1.0)[..., None]
            older, newer = (told[(np.maximum(i - ago, 0), *worlds)] for ago in (old, new))
            target = np.where((new != old)[..., None], part * older + (1.0 - part) * newer, older)
            x = x + np.clip(alpha * (target - x), -h * f["slew"], h * f["slew"])
    return x, line
