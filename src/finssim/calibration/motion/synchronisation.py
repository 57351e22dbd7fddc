"""Constant time offsets between streams that see the same motion."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.motion.signals import (
    ACCELERATION,
    accelerometer_place,
    attitude_signal,
    holds_gravity,
    up_in_body,
)
from finssim.calibration.motion.smoothing import smooth
from finssim.calibration.trials.trial import Trial
from finssim.geometry.rotations import quat_rotate
from finssim.vehicles import Vehicle

__all__ = ["Offset", "on_grid", "stream_offsets"]

Array = NDArray[np.float64]

RATE = 100.0
"""Of the grid on which streams are compared [Hz]; the peak is found between its points."""

LONGEST = 1.0
"""Offsets up to this are looked for [s]."""

NEAR = 0.15
"""Distance from the most shared motion within which the peak is refined [s]."""

BLOCKS = 10
"""Parts of a recording, each left out in turn to see how far the offset rests on it."""

LEAST = 0.6
"""Correlation below which two streams do not agree on any motion, so that nothing is said."""


class Offset(NamedTuple):
    """How one stream lies in time to another."""

    reference: str
    """Group of columns that it was compared with."""
    seconds: float
    """What to add to the stream's times so that both agree: a value for `convert.time_offset`."""
    std: float
    """Standard deviation of `seconds` [s]."""
    correlation: float
    """Of the two streams once they agree, -1 to 1."""


def stream_offsets(trial: Trial, vehicle: Vehicle) -> dict[str, Offset]:
    """Offsets of streams whose motion another stream measures too.

    They hold together, so that all of them may be given at once: a stream is compared with others as those are once
    their own offsets are taken off. The chain is gyro, attitude, acceleration, velocity, position, depth. An
    accelerometer sampled with the gyro is on its clock, and tells whether the velocity is late, as a DVL's is; any
    other is compared with velocity and attitude.

    Args:
        trial: The trial.
        vehicle: Gives gravity.

    Returns:
        Group of columns -> its offset to another group. Groups that nothing else sees, or whose motion is not above the
        noise, are left out.
    """
    t = np.arange(trial.t[0], trial.t[-1], 1.0 / RATE)
    if len(t) < 10:
        return {}
    omega, _ = on_grid(trial, ("p", "q", "r"), t, 2)
    attitude = attitude_signal(trial, t)
    found = {"attitude": _offset("rates", omega, attitude.rates)}
    if found["attitude"] is not None:  # the others are compared through the attitude as it should be
        attitude = attitude_signal(trial, t - found["attitude"].seconds)
    nu, nu_slope = on_grid(trial, ("u", "v", "w"), t, 2)
    reference, predicted = _predicted(trial, vehicle, t, attitude.quaternion, nu, nu_slope, omega)
    measured = on_grid(trial, ACCELERATION, t, 2)[0]
    if not _sampled_together(trial):
        found["acceleration"] = _offset(reference, predicted, measured)
    elif reference == "velocity":
        weight = _gravity(trial, vehicle, attitude.quaternion)
        found["velocity"] = _offset("acceleration", measured - weight, predicted - weight)
    nu = on_grid(trial, ("u", "v", "w"), t - _seconds(found.get("velocity")), 2)[0]
    through_world = quat_rotate(attitude.turn, nu)
    if not attitude.tilt:
        through_world[:, 2] = np.nan
    found["position"] = _offset("velocity", through_world, on_grid(trial, ("x", "y", "z"), t, 3)[1])
    if trial.has("z"):
        vertical = on_grid(trial, ("z",), t - _seconds(found["position"]), 3)[1]
    else:
        vertical = through_world[:, 2:]
    depth = on_grid(trial, ("depth",), t, 3)[1]
    found["depth"] = _offset("position" if trial.has("z") else "velocity", vertical, -depth)
    return {group: offset for group, offset in found.items() if offset is not None}


def _seconds(offset: Offset | None) -> float:
    return 0.0 if offset is None else offset.seconds


def _sampled_together(trial: Trial) -> bool:
    """Whether accelerometer and gyro have the same times nearly everywhere: one instrument, one clock."""
    if not trial.has("p", "q", "r", *ACCELERATION):
        return False
    rates, felt = np.isfinite(trial.channels["r"]), np.isfinite(trial.channels["ax"])
    return bool(np.sum(rates & felt) >= 0.9 * np.sum(felt))


def on_grid(trial: Trial, columns: tuple[str, ...], t: Array, order: int = 2) -> tuple[Array, Array]:
    """Columns of a trial, smoothed, and their slopes at times t (m,), (m, c) each; NaN where there are none."""
    value, slope = np.full((len(t), len(columns)), np.nan), np.full((len(t), len(columns)), np.nan)
    for i, name in enumerate(columns):
        at, y = trial.series(name)
        if len(at) >= 2:
            s = smooth(at, y[:, None], t, order=order)
            value[:, i], slope[:, i] = s.value[:, 0], s.slope[:, 0]
    return value, slope


def _predicted(
    trial: Trial, vehicle: Vehicle, t: Array, quaternion: Array, v: Array, v_dot: Array, omega: Array
) -> tuple[str, Array]:
    """What the accelerometer should read by the other streams, and the group that tells most of it, (m, 3).

    Velocity, rates and attitude have their right times here, and the accelerometer is compared as it is: gravity taken
    off a late signal would leave what the tilt did meanwhile.
    """
    if np.isfinite(v).any(axis=0).all():
        group = "velocity"
        turning = np.nan_to_num(omega)
        turning_dot = np.nan_to_num(on_grid(trial, ("p", "q", "r"), t, 2)[1])
        r = accelerometer_place(trial, vehicle)
        a = v_dot + np.cross(turning, v) + np.cross(turning_dot, r) + np.cross(turning, np.cross(turning, r))
    else:
        group, a = "attitude", np.zeros((len(t), 3))
    return group, a + _gravity(trial, vehicle, quaternion)


def _gravity(trial: Trial, vehicle: Vehicle, quaternion: Array) -> Array:
    """What the accelerometer feels of gravity at an attitude, (m, 3); nothing if it was taken off before."""
    if holds_gravity(trial, vehicle.water.gravity):
        return np.asarray(vehicle.water.gravity * up_in_body(quaternion))
    return np.zeros((len(quaternion), 3))


def _offset(reference: str, fixed: Array, moved: Array) -> Offset | None:
    """The offset of `moved` to `fixed`, (m, c) each, from the peak of their correlation."""
    both = np.isfinite(fixed).any(axis=0) & np.isfinite(moved).any(axis=0)
    if not both.any():
        return None
    x, y = _centred(fixed[:, both]), _centred(moved[:, both])
    longest = min(int(LONGEST * RATE), len(x) // 3)
    lags = np.arange(-longest, longest + 1)
    edges = np.linspace(0, len(x), BLOCKS + 1).astype(int)[:-1]
    sums = np.array([_sums(x, y, int(k), edges) for k in lags])  # (lags, blocks, xx yy xy)
    energy = np.sqrt(np.nansum(x**2) * np.nansum(y**2))
    if not energy > 0.0:
        return None
    # The most shared motion finds the peak; the correlation of what overlaps, which the ends do not pull, refines it.
    near = np.abs(lags - lags[int(np.argmax(sums[..., 2].sum(axis=1)))]) <= NEAR * RATE
    place, height = _peak(_correlation(sums.sum(axis=1)), near)
    if not height >= LEAST:
        return None
    parts = [_peak(_correlation(np.delete(sums, b, axis=1).sum(axis=1)), near)[0] for b in range(BLOCKS)]
    spread = float(np.sqrt((BLOCKS - 1) * np.var(parts)))  # jackknife: one short event must not look certain
    if not np.isfinite(spread):  # without one part there is no peak
        return None
    return Offset(reference, -float(lags[0] + place) / RATE, max(spread, 0.1) / RATE, height)


def _peak(correlation: Array, near: NDArray[np.bool_]) -> tuple[float, float]:
    """Place, between the samples, and height of the highest peak of the part that is near; NaN if on its edge."""
    best = int(np.argmax(np.where(near, correlation, -2.0)))
    if best in (0, len(near) - 1) or not (near[best - 1] and near[best + 1]):
        return np.nan, np.nan
    before, peak, after = correlation[best - 1 : best + 2]
    bend = before - 2.0 * peak + after
    return best + (0.5 * (before - after) / bend if bend < 0.0 else 0.0), float(peak)


def _centred(x: Array) -> Array:
    return np.asarray(x - np.nanmedian(x, axis=0))


def _sums(x: Array, y: Array, lag: int, edges: NDArray[np.int64]) -> Array:
    """Sums of x², y² and x y of x(t) and y(t + lag) where both are known, by block of t, (blocks, 3)."""
    n = len(x)
    products = np.zeros((n, 3))
    rows = slice(max(0, -lag), n - max(0, lag))
    a, b = x[rows], y[max(0, lag) : n - max(0, -lag)]
    known = np.isfinite(a) & np.isfinite(b)
    a, b = np.where(known, a, 0.0), np.where(known, b, 0.0)
    products[rows] = np.stack([np.sum(a * a, axis=1), np.sum(b * b, axis=1), np.sum(a * b, axis=1)], axis=-1)
    return np.add.reduceat(products, edges, axis=0)


def _correlation(sums: Array) -> Array:
    """From sums of x², y² and x y, (lags, 3) -> (lags,)."""
    return np.asarray(sums[:, 2] / np.maximum(np.sqrt(sums[:, 0] * sums[:, 1]), 1e-300))
