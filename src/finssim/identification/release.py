"""Free motions in trials with the thrusters off: from the release until the vehicle rests or is pushed again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from finssim.identification.rollout import DETERMINED_BY, Streams
from finssim.trials.findings import CalibrationError
from finssim.trials.motion import Motion, spans_of, white_noise, without_spikes
from finssim.vehicles import AXES

Array = NDArray[np.float64]

FEWEST_SAMPLES = 20

SLOWEST, FASTEST = 0.05, 3.0
"""Natural frequencies that are looked for [Hz]."""

FEWEST_PERIODS = 1.5
"""Shortest decay that counts, in periods."""

FAINT = 4.0
"""Standard deviations of the rate's noise below which a swing shows nothing."""

LEAST_SPEED = 0.03
"""Speed at the release below which nothing coasts [m/s, rad/s]."""

FALLS_TO = 0.7
"""Part of its first speed to which a coast has to fall."""

GROWS = 1.15
"""Factor above the lowest speed so far at which something pushes again."""

HELD = 0.15
"""Part of the top speed of a rise below which a smoothed speed may still be that of a vehicle that is held."""

RISING, SHORTEST_RISE = 0.01, 3.0
"""Vertical speed that counts as a rise [m/s] (published procedure), and its shortest duration [s]."""


def released(s: Streams, axes: Sequence[str]) -> Streams:
    """Return a trial without thrust cut to its free motions.

    Each axis is compared within its own free motion alone.

    Args:
        s: A trial whose header says that it is passive.
        axes: Axes to look at.

    Raises:
        CalibrationError: No axis moves freely; the message has the reason for each measured axis.
    """
    windows, reasons = dict[str, tuple[float, float]](), list[str]()
    for axis in axes:
        try:
            windows[axis] = _window(s, axis)
        except CalibrationError as error:
            reasons.append(error.reason)
    if not windows:
        raise CalibrationError("; ".join(reasons), s.trial.name)
    begin, end = min(a for a, _ in windows.values()), max(b for _, b in windows.values())
    spans = [(max(a, begin), min(b, end)) for a, b in s.drive.spans]
    spans = np.array([span for span in spans if span[1] > span[0]])
    nu, t = s.motion.nu.copy(), s.motion.t
    measured = dict(s.measured)
    for axis, (a, b) in windows.items():
        nu[(t < a) | (t > b), AXES.index(axis)] = np.nan
    for column, (at, values) in s.measured.items():
        own = [windows[axis] for axis in windows if column in DETERMINED_BY[axis]]
        if own:
            inside = np.any([(at >= a) & (at <= b) for a, b in own], axis=0)
            measured[column] = (at[inside], values[inside])
    return replace(
        s,
        drive=replace(s.drive, spans=spans),
        motion=replace(s.motion, nu=nu),
        measured={column: pair for column, pair in measured.items() if len(pair[0])},
        released=frozenset(windows),
    )


def _window(s: Streams, axis: str) -> tuple[float, float]:
    """Return begin and end of the free motion of one axis [s]."""
    count = max((len(s.measured[c][0]) for c in DETERMINED_BY[axis] if c in s.measured), default=0)
    if count < FEWEST_SAMPLES:
        raise CalibrationError(f"the motion of {axis} was not measured")
    if axis in ("roll", "pitch"):
        rate, angle = (s.measured.get(c, (np.empty(0), np.empty(0))) for c in DETERMINED_BY[axis])
        if len(rate[0]) < FEWEST_SAMPLES:
            rate = (angle[0], np.gradient(angle[1], angle[0]))
        good = without_spikes(rate[0], rate[1][:, None])
        return _ringing(rate[0][good], rate[1][good], axis)
    return _rising(s.motion) if axis == "heave" else _coasting(s.motion, axis)


def _ringing(t: Array, y: Array, axis: str) -> tuple[float, float]:
    """Return the stretch from the largest rate until the swing grows again or is lost in noise [s]."""
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
    fade = np.exp(-2.0 * (t[after] - begin) / span)  # the first swings are the largest
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


def _coasting(moved: Motion, axis: str) -> tuple[float, float]:
    """Return the stretch from the largest speed until something pushes again [s]."""
    nu = moved.nu[:, AXES.index(axis)]
    known = np.isfinite(nu)
    noise = float(np.nan_to_num(moved.noise_std[AXES.index(axis)]))
    t, speed = moved.t[known], np.abs(nu[known])
    begin = int(np.argmax(speed)) if len(speed) else 0
    after = speed[begin:]
    floor = max(3.0 * noise, 0.02 * float(after.max(initial=0.0)))
    pushed = np.flatnonzero(after > GROWS * np.minimum.accumulate(after) + floor)
    end = begin + (int(pushed[0]) if len(pushed) else len(after)) - 1
    slow = end - begin < FEWEST_SAMPLES or speed[begin] < max(LEAST_SPEED, 5.0 * noise)
    if slow or speed[end] > FALLS_TO * speed[begin]:
        raise CalibrationError(f"{axis} does not coast to a lower speed")
    return float(t[begin]), float(t[end])


def _rising(moved: Motion) -> tuple[float, float]:
    """Return the longest stretch in which the height grows faster than `RISING`, without the hand's last touch [s]."""
    speed = np.gradient(moved.position[:, 2], moved.t)
    begin, end = max(spans_of(speed > RISING), key=lambda e: e[1] - e[0], default=(0, 1))
    begin += int(np.argmax(speed[begin:end] > HELD * speed[begin:end].max()))
    if moved.t[end - 1] - moved.t[begin] < SHORTEST_RISE:
        raise CalibrationError(
            f"nothing rises faster than {RISING} m/s for {SHORTEST_RISE:g} s: expected a vehicle let go under water"
        )
    return float(moved.t[begin]), float(moved.t[end - 1])
