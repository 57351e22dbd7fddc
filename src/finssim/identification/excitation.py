"""Content of trials: excited axes, measurements of each axis, response time of the vehicle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from finssim.identification.rollout import Segment, Streams
from finssim.sim.plant_arrays import twist_shift
from finssim.trials.free_motion import DETERMINED_BY
from finssim.trials.motion import Motion, answers, gyroscope_bias, usual_range
from finssim.vehicles import AXES, HydrodynamicSet, Vehicle, VehicleError

Array = NDArray[np.float64]


SWINGING = ("roll", "pitch")
"""Axes that the weight rights."""

DRIFTING = {"x": "u", "y": "v", "z": "w", "depth": "w", "yaw": "r"}
"""Integrals without a restoring force: where the rate is measured they add drift, not knowledge."""

SEEN = 0.9
"""Part of a segment for which a velocity has to be known to be imposed."""

PUSH = 0.03
"""Range of a wrench, as part of the vehicle's limit, below which an axis is not driven."""


def compared(segment: Segment, motion: Motion, axes: Sequence[str], *, free: bool = False) -> Segment:
    """The segment as a fit of some axes uses it.

    Axes that are not fitted move as they were seen to, where they were seen: their numbers in the vehicle file may be
    wrong, and couplings would carry that into the others. They are not compared, nor are integrals that add drift. An
    axis whose motion does not stand out of its noise is simulated instead, for the noise would shake the others; but
    not in a free motion, where nothing drives it. The bias of the gyroscope is taken off the rates: what they add up to
    is an attitude.
    """
    held = np.full((segment.steps + 1, 6), np.nan)
    t = segment.t0 + segment.step * np.arange(segment.steps + 1)
    drop = {column for column, rate in DRIFTING.items() if rate in segment.measured}
    inside = (motion.t >= t[0] - 0.1) & (motion.t <= t[-1] + 0.1)
    bias = np.concatenate([np.zeros(3), gyroscope_bias(motion)])
    for i, axis in enumerate(AXES):
        good = inside & np.isfinite(motion.nu[:, i])
        if axis not in axes and good.sum() >= max(2.0, SEEN * inside.sum()):
            if free or axis in SWINGING or answers(motion, i):
                held[:, i] = np.interp(t, motion.t[good], motion.nu[good, i]) - bias[i]
            drop |= {DETERMINED_BY[axis][0]}
    if not np.isnan(held[:, 3:5]).any():
        drop |= {"roll", "pitch"}
    offsets = dict(zip("pqr", bias[3:], strict=True))
    measured = {c: (t, x - offsets.get(c, 0.0)) for c, (t, x) in segment.measured.items() if c not in drop}
    return replace(segment, measured=measured, held=held)


def observable(trials: Sequence[Streams]) -> tuple[str, ...]:
    """Axes that some trial measures anything of."""
    columns = {c for s in trials for c in s.measured}
    return tuple(a for a in AXES if columns & set(DETERMINED_BY[a]))


def excited(trials: Sequence[Streams], vehicle: Vehicle) -> tuple[str, ...]:
    """Return the axes that the trials excite, of those that some trial measures."""
    found = set[str]().union(*excitations(trials, vehicle))
    return tuple(a for a in AXES if a in found and a in observable(trials))


def excitations(trials: Sequence[Streams], vehicle: Vehicle) -> list[set[str]]:
    """Return the axes that each trial excites.

    Pushes along the body of a tilted vehicle move it up and down. If no trial drives heave, those count that tilt:
    imposed as it was seen, heave would bias the drag of surge and sway.
    """
    out = [excites(s, vehicle) for s in trials]
    if any("heave" in moved for moved in out):
        return out
    for s, moved in zip(trials, out, strict=True):
        told = s.drive.source == "passive" or s.trial.header.axis
        if not told and moved & {"roll", "pitch"} and answers(s.motion, AXES.index("heave")):
            moved.add("heave")
    return out


def telling(trials: Sequence[Streams], vehicle: Vehicle, axes: Sequence[str]) -> list[Streams]:
    """Trials that excite one of some axes; all of them where none does.

    In the others the vehicle moves on axes that are not fitted, maybe not even measured, and couplings carry that over.
    """
    return [s for s in trials if set(excites(s, vehicle)) & set(axes)] or list(trials)


def excites(s: Streams, vehicle: Vehicle) -> set[str]:
    """Return the axes that one trial excites: without thrust those that move freely, else those its header names, else
    those that were driven, or swing."""
    if s.drive.source == "passive":
        return set(s.released)
    if s.trial.header.axis:
        return set(s.trial.header.axis)
    try:
        limits = vehicle.wrench_limits
    except VehicleError:
        limits = np.zeros(6)
    tau = s.motion.tau @ np.linalg.inv(twist_shift(list(vehicle.wrench_reference)))
    out: set[str] = set()
    for i, axis in enumerate(AXES):
        pushed = limits[i] > 0.0 and usual_range(tau[:, i]) > PUSH * limits[i]
        # Weight rights roll and pitch: a small swing determines them, whatever started it. If they were not
        # fitted, the file's stiffness, which may be a guess, would determine the later course of surge and sway.
        swings = i in (3, 4)
        if answers(s.motion, i) and (pushed or swings):
            out.add(axis)
    return out


def speeds(motions: Sequence[Motion], axis: str) -> tuple[float, float]:
    """Range of speeds at which an axis was seen moving, from the 20th to the 99th percentile [m/s or rad/s]."""
    i = AXES.index(axis)
    values = np.concatenate([np.abs(m.nu[:, i]) for m in motions] or [np.empty(0)])
    values = values[np.isfinite(values)]
    moving = values[values > max(0.02 * values.max(initial=0.0), 1e-9)]
    low, high = np.percentile(moving, [20.0, 99.0]).tolist() if len(moving) else (0.0, 0.0)
    return low, high


def horizon(vehicle: Vehicle, trials: Sequence[Streams], axes: Sequence[str]) -> float:
    """Length of segments that shows steady motion and yet forgets what no model knows [s]: five of the slowest time
    constant, at least forty samples, between 5 and 12 s."""
    chosen = vehicle.hydrodynamic_set("calibrated")
    M = np.diag(vehicle.mass_matrix("calibrated"))
    slowest = 0.5
    if isinstance(chosen, HydrodynamicSet):
        for axis in axes:
            i = AXES.index(axis)
            top = speeds([s.motion for s in trials], axis)[1]
            drag = chosen.linear_damping[i, i] + chosen.quadratic_damping[i, i] * top
            slowest = max(slowest, float(M[i] / drag) if drag > 0.0 else 3.0)
    return float(np.clip(max(5.0 * slowest, 40.0 * sampling(trials)), 5.0, 12.0))


def sampling(trials: Sequence[Streams]) -> float:
    """Usual time between the samples of a channel [s]."""
    steps = [float(np.median(np.diff(t))) for s in trials for t, _ in s.measured.values() if len(t) > 2]
    return float(np.median(steps or [0.02]))
