"""Which trials tell of which axis, and their rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.motion.attitude_signal import attitude_samples
from finssim.calibration.motion.signals import Motion, motion
from finssim.calibration.regression.axis_fit import AxisData, informative
from finssim.calibration.regression.plant_terms import Matrices
from finssim.calibration.regression.rows import Signals, axis_rows, kernel, signals
from finssim.calibration.trials.inputs import drive
from finssim.calibration.trials.trial import Trial
from finssim.geometry.rotations import quat_inverse_rotate
from finssim.vehicles import AXES, Vehicle

__all__ = ["Prepared", "axis_data", "excited", "later", "prepare"]

Array = NDArray[np.float64]

LEAST_WRENCH = 0.05
"""Part of the vehicle's wrench limit that an input has to span to count as an excitation of its axis."""

LEAST_OF_LARGEST = 0.1
"""Part of the largest span among the trials that an input has to reach."""

FEWEST_ROWS = 10

HALF_WIDTH = (0.5, 0.25)
"""Of the bump [s]: wide, so that a smoothed velocity is no harm; shorter for roll and pitch, which swing."""

QUIET = 0.02
"""Noise of the velocity, as a part of its range, that needs no smoothing before |nu| nu is formed."""


LARGEST_TILT = 25.0
"""Beyond it samples of surge, sway, heave and yaw rest on the other axes [deg] (published procedure: 20)."""


WORTH_SAYING = 0.1
"""Share of tilted samples that were kept from which a warning says so."""


@dataclass(frozen=True, kw_only=True)
class Prepared:
    """A trial on its grid."""

    trial: Trial
    motion: Motion
    up: Array
    """World z in the body frame, in straight lines between samples and not smoothed, (n, 3); NaN where unknown."""
    current: Array | None
    """Of the water, where the velocity does not know of it, world frame [m/s], (3,)."""


def prepare(trials: Sequence[Trial], vehicle: Vehicle) -> tuple[list[Prepared], list[str]]:
    """Trials on their grids, and a sentence on each that cannot be used or that something was assumed of."""
    out, notes = [], []
    for trial in trials:
        try:
            found = motion(trial, vehicle)
            held = drive(trial, vehicle)
        except CalibrationError as error:
            text = str(error)
            notes.append(text if text.startswith(trial.name) else f"{trial.name}: {text}")
            continue
        notes += [f"{trial.name}: {note}" for note in found.notes]
        if held.held and not held.commanded:
            # A row's value acts until the next row: at the row itself the wrench jumps, and the middle of the jump has
            # the same integral under any smooth weight.
            before = np.concatenate([found.tau[:1], found.tau[:-1]])
            found = _with_wrench(found, 0.5 * (np.where(np.isfinite(before), before, found.tau) + found.tau))
        water = trial.header.water
        moving = water.current is not None and any(water.current)
        current = np.asarray(water.current) if moving else None
        out.append(Prepared(trial=trial, motion=found, up=_up(trial, found), current=current))
    return out, notes


def _up(trial: Trial, found: Motion) -> Array:
    """Not smoothed, for that would bias inertia and damping of roll and pitch; the regression handles noise itself."""
    t, q, _ = attitude_samples(trial)
    known = np.asarray(np.isfinite(found.quaternion).all(axis=1))
    if not known.any():
        return np.full((len(found.t), 3), np.nan)
    sampled = quat_inverse_rotate(q / np.linalg.norm(q, axis=1, keepdims=True), np.array([0.0, 0.0, 1.0]))
    up = np.stack([np.interp(found.t, t, column) for column in sampled.T], axis=-1)
    return np.where(known[:, None], up, np.nan)


def _with_wrench(found: Motion, tau: Array) -> Motion:
    return replace(found, tau=tau)


def excited(prepared: Sequence[Prepared], vehicle: Vehicle) -> NDArray[np.bool_]:
    """Which axes each trial excites, (trials, 6): as its header says, else by the span of its input."""
    span = np.array([_span(one.motion.tau, vehicle) for one in prepared]).reshape(-1, 6)
    enough = span >= np.maximum(
        LEAST_WRENCH * vehicle.wrench_limits, LEAST_OF_LARGEST * span.max(axis=0, initial=0.0)
    )
    for g, one in enumerate(prepared):
        if one.trial.header.axis:
            enough[g] = [axis in one.trial.header.axis for axis in AXES]
        elif one.trial.header.passive:
            enough[g] = False
    return np.asarray(enough & (span > 0.0))


def _span(tau: Array, vehicle: Vehicle) -> Array:
    """Range of the wrench about the vehicle's wrench reference without the outermost hundredths, (6,)."""
    from finssim.engine.plant_arrays import twist_shift

    about = tau @ np.linalg.inv(twist_shift(list(vehicle.wrench_reference)))
    good = about[np.isfinite(about).all(axis=1)]
    if len(good) < 2:
        return np.zeros(6)
    low, high = np.percentile(good, [1.0, 99.0], axis=0)
    return np.asarray(high - low)


def axis_data(
    axis: int, prepared: Sequence[Prepared], plants: Sequence[Matrices], *, keep_tilted: bool = False
) -> tuple[AxisData | None, list[str]]:
    """Rows of one axis from the trials that excite it.

    Args:
        axis: 0 surge to 5 yaw.
        prepared: The trials.
        plants: The vehicle in the water of each.
        keep_tilted: Whether samples beyond `LARGEST_TILT` stay: where the axes that they depend on are fitted too.

    Returns:
        None where no trial can be used; and sentences on what was left out.
    """
    said, kept, tilted = [], [], 0.0
    for one, plant in zip(prepared, plants, strict=True):
        found, name = one.motion, one.trial.name
        if not np.isfinite(found.nu[:, axis]).any():
            said.append(f"left out: {name}: no {AXES[axis]} velocity, measured or derived")
        elif axis in (3, 4) and not np.isfinite(found.quaternion).any():
            said.append(f"left out: {name}: {AXES[axis]} needs the attitude for its restoring moment")
        else:
            kept.append(signals(name, found, one.up, plant, current=one.current))
    if axis not in (3, 4):
        kept, tilted, note = _level(kept, keep_tilted)
        said += note
    spread = [_noise_and_range(s.nu[s.usable, axis]) for s in kept]
    largest = max((r for _, r in spread), default=0.0)
    out = []
    for s, (noise, _) in zip(kept, spread, strict=True):
        # White noise of n samples shrinks by √n; a bump of half width w averages some 1.2 w rate of them.
        needed = (noise / max(QUIET * largest, 1e-12)) ** 2
        kernels = kernel(
            s.rate, half_width=HALF_WIDTH[axis in (3, 4)], short=float(min(0.15, needed / (1.2 * s.rate)))
        )
        rows = axis_rows(s, axis, kernels)
        if rows is None:
            said.append(f"left out: {s.name}: no stretch of {len(kernels.phi) / s.rate:.1f} s without a gap")
        elif informative(rows, s).sum() < FEWEST_ROWS:
            said.append(f"left out: {s.name}: hardly any wrench or motion on {AXES[axis]}")
        else:
            out.append((s, rows, kernels))
    if not out:
        return None, said
    return AxisData(
        axis=axis,
        signals=tuple(s for s, _, _ in out),
        rows=tuple(r for _, r, _ in out),
        kernels=tuple(k for _, _, k in out),
        tilted=tilted,
        estimated=plants[0].estimated,
        lowest=plants[0].lowest,
    ), said


def later(data: AxisData, by: float) -> AxisData:
    """The same with the wrench put later by a time [s], as the motion was recorded; the column of `delay` has the rest.

    That column alone is right to first order only, which a tenth of a second is too long for.
    """
    moved, rows = [], []
    for s, own, kernels in zip(data.signals, data.rows, data.kernels, strict=True):
        known = np.isfinite(s.left[:, data.axis])
        left = s.left.copy()
        if known.any():
            line = np.interp(s.t - by, s.t[known], s.left[known, data.axis])
            left[:, data.axis] = np.where(known, line, np.nan)
        moved.append(replace(s, left=left))
        rows.append(axis_rows(moved[-1], data.axis, kernels) or own)
    return replace(data, signals=tuple(moved), rows=tuple(rows), shift=data.shift + by)


def _level(found: list[Signals], keep: bool) -> tuple[list[Signals], float, list[str]]:
    """Without samples at large tilt, the share of those, and a sentence where there were any.

    There weight, Coriolis forces and the other axes' drag are as large as the thrust; the file knows them at best.
    """
    level = [~(s.up[:, 2] < np.cos(np.radians(LARGEST_TILT))) for s in found]
    inside = [s.usable & s.wanted for s in found]
    total = sum(int(own.sum()) for own in inside)
    beyond = sum(int((own & ~flat).sum()) for own, flat in zip(inside, level, strict=True))
    if not beyond:
        return found, 0.0, []
    share = f"{100.0 * beyond / total:.0f} %" if beyond >= 0.01 * total else "less than 1 %"
    if keep and beyond < WORTH_SAYING * total:
        return found, 0.0, []
    if keep:
        note = (
            f"{share} of the samples are at a tilt beyond {LARGEST_TILT:.0f}°; they were kept, as the axes that they "
            "depend on are fitted too, but the intervals are then somewhat too sure"
        )
        return found, 0.0, [note]
    cut = [replace(s, usable=s.usable & flat) for s, flat in zip(found, level, strict=True)]
    said = [f"{share} of the samples, at a tilt beyond {LARGEST_TILT:.0f}°, were left out"]
    return cut, beyond / total, said


def _noise_and_range(nu: Array) -> tuple[float, float]:
    """Standard deviation of white noise from second differences, and the 95th percentile of |nu|."""
    good = nu[np.isfinite(nu)]
    if len(good) < 10:
        return 0.0, 0.0
    second = np.diff(good, 2)
    return float(np.median(np.abs(second)) / 0.6745 / np.sqrt(6.0)), float(np.percentile(np.abs(good), 95.0))
