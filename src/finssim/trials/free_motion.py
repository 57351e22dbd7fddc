"""Free motions in trials with the thrusters off: from the release until the vehicle is at rest or pushed again."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from finssim.core.rotations import quat_to_euler
from finssim.trials.conversion import EULER
from finssim.trials.findings import CalibrationError
from finssim.trials.inputs import within_reach
from finssim.trials.motion import Motion, attitude_samples, spans_of, white_noise, without_spikes
from finssim.trials.trial import Trial
from finssim.vehicles import AXES

Array = NDArray[np.float64]

CHANNELS = ("u", "v", "w", "p", "q", "r", "roll", "pitch", "yaw", "x", "y", "z", "depth")
"""Measured columns that are compared with a simulation."""

DETERMINED_BY = {
    "surge": ("u", "x", "y"),
    "sway": ("v", "x", "y"),
    "heave": ("w", "z", "depth"),
    "roll": ("p", "roll"),
    "pitch": ("q", "pitch"),
    "yaw": ("r", "yaw"),
}
"""Measured columns that determine the motion of an axis, the most direct first."""

FEWEST_SAMPLES, FEWEST_SPEEDS, FEWEST_COASTING = 20, 5, 3
"""Smallest numbers of samples of a swing, of a coast or a rise, and of a coast until the vehicle is pushed."""

SLOWEST, FASTEST = 0.05, 3.0
"""Range of natural frequencies that is searched [Hz]."""

FEWEST_PERIODS = 1.5
"""Shortest usable decay, in periods."""

FAINT = 4.0
"""Number of standard deviations of the rate's noise below which a swing cannot be analysed."""

LEAST_SPEED = 0.03
"""Least initial speed of a coast [m/s, rad/s]."""

FALLS_TO = 0.7
"""Fraction of its initial speed to which a coast must decrease."""

GROWS, TUGGED = 1.15, 0.1
"""Factor above the lowest speed so far from which the vehicle is considered pushed again, and the fraction of
the initial speed that a tether may add."""

HELD = 0.15
"""Fraction of the top speed of a rise below which the vehicle may still be held, considering smoothing."""

RISING, SHORTEST_RISE = 0.01, 3.0
"""Vertical speed that counts as a rise [m/s] (published procedure), and its shortest duration [s]."""


def compared_columns(trial: Trial) -> dict[str, tuple[Array, Array]]:
    """Return the columns of `CHANNELS` that a trial measures: times on its clock [s] and values in their units.

    Implausible speeds are removed.
    """
    measured = {c: trial.series(c) for c in CHANNELS}
    t, q, given = attitude_samples(trial)
    for name, angle in zip(EULER, quat_to_euler(q), strict=True):
        if name in given and not len(measured[name][0]):
            measured[name] = (t, angle)
    kept = {c: (t, y, within_reach(c, y)) for c, (t, y) in measured.items()}
    return {c: (t[good], y[good]) for c, (t, y, good) in kept.items() if good.any()}


def free_motion(moved: Motion, measured: Mapping[str, tuple[Array, Array]], axis: str) -> tuple[float, float]:
    """Return start and end of the free motion of one axis of a trial without thrust [s].

    Args:
        moved: Motion of the trial.
        measured: Column -> times [s] and values in its unit, from `compared_columns`.
        axis: Name of the axis.

    Raises:
        CalibrationError: The axis does not move freely, or has too few measurements.
    """
    count = max((len(measured[c][0]) for c in DETERMINED_BY[axis] if c in measured), default=0)
    swings = axis in ("roll", "pitch")
    fewest = FEWEST_SAMPLES if swings else FEWEST_SPEEDS
    if count < fewest:
        raise CalibrationError(
            f"{axis} was measured {count} times, expected {fewest} or more"
            if count
            else f"the motion of {axis} was not measured"
        )
    if swings:
        rate, angle = (measured.get(c, (np.empty(0), np.empty(0))) for c in DETERMINED_BY[axis])
        if len(rate[0]) < FEWEST_SAMPLES:
            rate = (angle[0], np.gradient(angle[1], angle[0]))
        good = without_spikes(rate[0], rate[1][:, None])
        return _ringing(rate[0][good], rate[1][good], axis)
    if axis == "heave":
        return _rising(moved)
    # A fast coast lasts only a few samples, which smoothing would truncate.
    t, speed = measured.get(DETERMINED_BY[axis][0], (moved.t, moved.nu[:, AXES.index(axis)]))
    return _coasting(t, speed, float(np.nan_to_num(moved.noise_std[AXES.index(axis)])), axis)


def _ringing(t: Array, y: Array, axis: str) -> tuple[float, float]:
    """Return the segment from the largest rate until the swing grows again or falls below the noise [s]."""
    from scipy.signal import lombscargle

    smooth = np.convolve(np.pad(y, 1, mode="edge"), [0.25, 0.5, 0.25], "valid")
    noise = white_noise(y)
    begin = float(t[int(np.argmax(np.abs(smooth)))])
    after = (t >= begin) & (t <= begin + 20.0)
    span = float(t[after][-1] - begin) if after.any() else 0.0
    refusal = CalibrationError(
        f"{axis} does not ring down: expected a release after which it swings freely for {FEWEST_PERIODS:g} periods or "
        "more"
    )
    if after.sum() < FEWEST_SAMPLES or span < 1.0:
        raise refusal
    frequencies = np.linspace(max(SLOWEST, 1.0 / span), FASTEST, 400)
    fade = np.exp(-2.0 * (t[after] - begin) / span)  # the first swings have the largest amplitude
    power = lombscargle(t[after], (smooth[after] - smooth[after].mean()) * fade, 2.0 * np.pi * frequencies)
    period = 1.0 / float(frequencies[int(np.argmax(power))])
    end, swing = begin, np.inf
    while end + 0.5 * period <= t[-1] + 0.25 * period:
        part = np.abs(smooth[(t >= end) & (t < end + 0.5 * period)])
        if not len(part) or part.max() > 1.1 * swing or part.max() < FAINT * noise:
            break
        end, swing = end + 0.5 * period, max(float(part.max()), 1e-12)
    if end - begin < FEWEST_PERIODS * period:
        raise refusal
    return begin, min(end, float(t[-1]))


def _coasting(t: Array, nu: Array, noise: float, axis: str) -> tuple[float, float]:
    """Return the segment from the largest speed until the vehicle is pushed again [s]."""
    known = np.isfinite(nu)
    t, speed = t[known], np.abs(nu[known])
    begin = int(np.argmax(speed)) if len(speed) else 0
    after = speed[begin:]
    floor = max(3.0 * noise, TUGGED * float(after.max(initial=0.0)))
    pushed = np.flatnonzero(after > GROWS * np.minimum.accumulate(after) + floor)
    end = begin + (int(pushed[0]) if len(pushed) else len(after)) - 1
    slow = end - begin < FEWEST_COASTING - 1 or speed[begin] < max(LEAST_SPEED, 5.0 * noise)
    if slow or speed[end] > FALLS_TO * speed[begin]:
        raise CalibrationError(f"{axis} does not coast to a lower speed")
    return float(t[begin]), float(t[end])


def _rising(moved: Motion) -> tuple[float, float]:
    """Return the longest segment with a climb rate above `RISING`, without the last contact of the hand [s]."""
    speed = np.gradient(moved.position[:, 2], moved.t)
    begin, end = max(spans_of(speed > RISING), key=lambda e: e[1] - e[0], default=(0, 1))
    begin += int(np.argmax(speed[begin:end] > HELD * speed[begin:end].max()))
    if moved.t[end - 1] - moved.t[begin] < SHORTEST_RISE:
        raise CalibrationError(
            f"no rise faster than {RISING} m/s for {SHORTEST_RISE:g} s: expected a vehicle let go under water"
        )
    return float(moved.t[begin]), float(moved.t[end - 1])
