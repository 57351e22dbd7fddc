"""What a simulation-error fit shows besides its estimates: figures by axis, curves, findings."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.findings import Finding, finding
from finssim.calibration.fit import Curve, Estimate
from finssim.calibration.simulation.bordered import CUT
from finssim.calibration.simulation.evidence import Confidence
from finssim.calibration.simulation.excited import TELL, speeds
from finssim.calibration.simulation.gauss_newton import Solution
from finssim.calibration.simulation.segments import Streams
from finssim.calibration.simulation.shooting import Shooting

__all__ = ["Clock", "doubts", "pictures", "quality"]

Array = NDArray[np.float64]

LATE = 0.03
"""Lag of a stream worth a warning [s]."""

SHOWN = 4
"""Trials in the curve of an axis."""

DECADE = 10.0


def _column(problem: Shooting, axis: str) -> int | None:
    """The most direct channel in use that tells of an axis."""
    names = problem.measured.names
    return next((names.index(c) for c in TELL[axis] if c in names), None)


def quality(
    problem: Shooting, solution: Solution, axes: Sequence[str], used: Sequence[Streams]
) -> dict[str, dict[str, float]]:
    """Figures of each axis over the trials that move it: the simulated against the measured channel."""
    m, out = problem.measured, {}
    trial = problem.groups[m.segment]
    for axis in axes:
        column = _column(problem, axis)
        if column is None:
            continue
        rows = np.flatnonzero(m.channel == column)
        spread = {
            g: float(np.ptp(np.percentile(m.value[rows][trial[rows] == g], [5.0, 95.0])))
            for g in np.unique(trial[rows])
        }
        moving = [g for g, s in spread.items() if s > 0.2 * max(spread.values())]
        rows = rows[np.isin(trial[rows], moving)]
        residual, value = solution.linear.residual[rows], m.value[rows]
        nrmse = [
            float(np.sqrt(np.mean(residual[trial[rows] == g] ** 2))) / max(spread[g], 1e-12) for g in moving
        ]
        low, high = speeds([s.motion for s in used], axis)
        out[axis] = {
            "r2": 1.0 - float(np.mean(residual**2)) / max(float(np.var(value)), 1e-300),
            "rmse": float(np.sqrt(np.mean(residual**2))),
            "nrmse": float(np.mean(nrmse)),
            "samples": float(len(rows)),
            "rejected": float(np.sum(np.abs(residual) > 2.0 * CUT * solution.std[rows])),
            "trials": float(len(moving)),
            "speed_low": low,
            "speed_high": high,
            "noise": float(np.median(solution.std[rows])),
        }
    return out


def pictures(problem: Shooting, solution: Solution, axes: Sequence[str]) -> tuple[Curve, ...]:
    """Measured and simulated channel of each axis, over the trials that move it most."""
    m, out = problem.measured, []
    trial = problem.groups[m.segment]
    clock = m.time + np.array([s.t0 for s in problem.segments])[m.segment]
    for axis in axes:
        column = _column(problem, axis)
        if column is None:
            continue
        rows = np.flatnonzero(m.channel == column)
        present = np.unique(trial[rows])
        spread = [float(np.ptp(np.percentile(m.value[rows][trial[rows] == g], [5.0, 95.0]))) for g in present]
        x, y, p, offset = [], [], [], 0.0
        for g in np.sort(present[np.argsort(spread)[::-1][:SHOWN]]):
            those = rows[trial[rows] == g]
            those = those[np.argsort(clock[those], kind="stable")]
            t = clock[those] - clock[those[0]] + offset
            x += [t, [np.nan]]
            y += [m.value[those], [np.nan]]
            p += [m.value[those] - solution.linear.residual[those], [np.nan]]
            offset = float(t[-1]) + 1.0
        name = m.names[column]
        out.append(
            Curve(
                title=f"{axis}: {name}, simulated from the inputs alone",
                x_label="time, trial after trial [s]",
                y_label=f"{name} [{_unit(name)}]",
                x=np.concatenate(x),
                measured=np.concatenate(y),
                fitted=np.concatenate(p),
            )
        )
    return tuple(out)


def _unit(name: str) -> str:
    if name in ("u", "v", "w"):
        return "m/s"
    return "rad/s" if name in ("p", "q", "r") else "rad" if name in ("roll", "pitch", "yaw") else "m"


def doubts(
    problem: Shooting,
    solution: Solution,
    found: Confidence,
    estimates: dict[str, Estimate],
    used: Sequence[Streams],
) -> list[Finding]:
    """What a reader should know before using the numbers."""
    out = []
    if solution.interrupted:
        out.append(finding("interrupted"))
    elif not solution.converged:
        out.append(finding("not_converged", iterations=solution.iterations))
    p = problem.parameters
    for axis, i in zip(p.axes, p.index, strict=True):
        if f"{axis}.m_eff" not in estimates:
            continue
        whole, added = estimates[f"{axis}.m_eff"], estimates[f"{axis}.added_mass"]
        if added.estimate <= 0.0:
            fields = {"effective": whole.estimate, "rigid": p.M_RB[i, i], "unit": whole.unit}
            out.append(finding("inertia_too_small", axis, **fields))
        low, high = speeds([s.motion for s in used], axis)
        if 0.0 < low and high < DECADE * low:
            unit = "m/s" if i < 3 else "rad/s"
            out.append(finding("few_speeds", axis, low=low, high=high, unit=unit))
    P = len(p.names)
    for stream, late, (low, high) in zip(
        problem.errors.streams, solution.point.theta[P:], found.interval[P:], strict=True
    ):
        if abs(late) > LATE and (low > 0.0 or high < 0.0):
            sense = "lags" if late > 0.0 else "leads"
            out.append(finding("motion_late", stream, sense=sense, lag=abs(late), low=low, high=high))
    if found.evidence.unit == "blocks":
        out.append(finding("block_intervals", trials=len(used)))
    return out


class Clock:
    """Tells progress over several stages: iteration, cost, rate and what may remain."""

    def __init__(self, progress: Callable[[float, str], None] | None) -> None:
        self.progress, self.begin, self.part, self.worlds = progress, time.perf_counter(), 0.0, 0

    def __call__(self, words: str, toward: float = 1.0) -> None:
        # How many iterations remain nobody knows; each takes a share of the rest.
        self.part += 0.2 * max(toward - self.part, 0.0)
        spent = time.perf_counter() - self.begin
        if self.progress:
            self.progress(self.part, f"{words}, {spent:.0f} s")
