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
"""Axes with a hydrostatic restoring moment."""

DRIFTING = {"x": "u", "y": "v", "z": "w", "depth": "w", "yaw": "r"}
"""Integrals without a restoring force: if the rate is measured, they add drift but no information."""

SEEN = 0.9
"""Fraction of a segment for which a velocity must be known to be imposed."""

PUSH = 0.03
"""Range of a wrench, relative to the vehicle's limit, below which an axis is not driven."""


def compared(segment: Segment, motion: Motion, axes: Sequence[str], *, free: bool = False) -> Segment:
    """Return the segment as a fit of some axes uses it.

    Axes that are not fitted follow their measured motion where it is known: their numbers in the vehicle file
    may be wrong, and couplings would transfer the error to the others. They are not compared, nor are
    integrals that add drift. An axis whose motion is within its noise is simulated instead, since the noise
    would excite the others; but not in a free motion, where it is not driven. The bias of the gyroscope is
    subtracted from the rates, since they are integrated to an attitude.
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
    """Return the axes for which some trial contains a measurement."""
    columns = {c for s in trials for c in s.measured}
    return tuple(a for a in AXES if columns & set(DETERMINED_BY[a]))


def excited(trials: Sequence[Streams], vehicle: Vehicle) -> tuple[str, ...]:
    """Return the axes that the trials excite, among those that some trial measures."""
    found = set[str]().union(*excitations(trials, vehicle))
    return tuple(a for a in AXES if a in found and a in observable(trials))


def excitations(trials: Sequence[Streams], vehicle: Vehicle) -> list[set[str]]:
    """Return the axes that each trial excites.

    Pushes along the body of a tilted vehicle have a vertical component. If no trial drives heave, trials with tilt
    count as exciting it: with heave imposed from its measurement, the drag of surge and sway would be biased.
    """
    out = [excites(s, vehicle) for s in trials]
    if any("heave" in moved for moved in out):
        return out
    for s, moved in zip(trials, out, strict=True):
        is_known = s.drive.source == "passive" or s.trial.header.axis
        if not is_known and moved & {"roll", "pitch"} and answers(s.motion, AXES.index("heave")):
            moved.add("heave")
    return out


def exciting_trials(trials: Sequence[Streams], vehicle: Vehicle, axes: Sequence[str]) -> list[Streams]:
    """Return the trials that excite at least one of some axes; all of them if none does.

    In the other trials the vehicle moves on axes that are not fitted and possibly not measured, which affects
    the fitted ones through couplings.
    """
    return [s for s in trials if set(excites(s, vehicle)) & set(axes)] or list(trials)


def excites(s: Streams, vehicle: Vehicle) -> set[str]:
    """Return the axes that one trial excites: without thrust those that move freely, otherwise those that its
    header names, otherwise those that were driven or swing."""
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
        # Roll and pitch have a restoring moment: a small swing determines them, whatever its cause. If they were not
        # fitted, the file's stiffness, which may be a guess, would affect the later course of surge and sway.
        swings = i in (3, 4)
        if answers(s.motion, i) and (pushed or swings):
            out.add(axis)
    return out


def speeds(motions: Sequence[Motion], axis: str) -> tuple[float, float]:
    """Return the range of measured speeds of an axis in motion [m/s, rad/s], from the 20th to the
    99th percentile."""
    i = AXES.index(axis)
    values = np.concatenate([np.abs(m.nu[:, i]) for m in motions] or [np.empty(0)])
    values = values[np.isfinite(values)]
    moving = values[values > max(0.02 * values.max(initial=0.0), 1e-9)]
    low, high = np.percentile(moving, [20.0, 99.0]).tolist() if len(moving) else (0.0, 0.0)
    return low, high


def horizon(vehicle: Vehicle, trials: Sequence[Streams], axes: Sequence[str]) -> float:
    """Return a segment length that includes steady motion and limits the growth of model errors [s]: five
    times the slowest time constant, at least forty samples, between 5 and 12 s."""
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
    """Return the median interval between the samples of a channel [s]."""
    steps = [float(np.median(np.diff(t))) for s in trials for t, _ in s.measured.values() if len(t) > 2]
    return float(np.median(steps or [0.02]))
