"""The gates of the replay validation: does a model respond as the vehicle does, or where not."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from finssim.calibration.replay.metrics import Score, phase_score, response_span
from finssim.calibration.replay.pairs import Pair, onset
from finssim.calibration.trials.trial import Array
from finssim.vehicles.vehicle import AXES, Axis

__all__ = ["LIMITS", "Gate", "classify", "coupling", "gates"]

LIMITS = {
    "input wrench": 0.05,
    "excitation": 0.20,
    "coast": 0.30,
    "initial slope": 0.30,
    "steady value": 0.20,
    "coast t10": 0.25,
}
"""Gate -> largest value that passes (facts of the published replay validation)."""

INITIAL = 0.5
"""Time after the onset over which the initial slope is taken [s]."""
LAST = 0.25
"""Share of the excitation, at its end, over which the steady value is taken."""
STEADY = 0.2
"""An input is steady there if its deviation stays below this share of its mean."""
SMOOTHING = 0.2
"""Width of the moving average before the decay time of a coast is read [s]."""


class Gate(NamedTuple):
    """One check."""

    value: float | None
    limit: float
    why: str = ""
    """Why there is no value."""

    @property
    def passed(self) -> bool | None:
        """None where it could not be evaluated."""
        return None if self.value is None else self.value <= self.limit


def gates(pair: Pair, model: str, axis: Axis) -> dict[str, Gate]:
    """Every gate of one model on one axis of one trial.

    - input wrench: P95 of the difference between the wrench simulated and logged, over the P95 of the logged one
    - excitation, coast: NRMSE of the phase
    - initial slope: relative difference of the slopes over the first 0.5 s after the onset
    - steady value: relative difference of the means over the last quarter of the excitation
    - coast t10: relative difference of the times to fall to a tenth of the speed at the start of the coast

    The onset is where the input reaches a tenth of its greatest magnitude. Slope, steady value and decay are those of
    the measurement before smoothing, which would delay them.

    Args:
        pair: Trial and replays.
        model: Which replay.
        axis: Which axis.

    Returns:
        Key of `LIMITS` -> gate.
    """
    response = pair.response(axis)
    width = response_span(pair, response)
    if width.value is None:
        return {name: Gate(None, limit, width.why) for name, limit in LIMITS.items()}
    real, simulated = pair.raw.get(response, pair.measured[response]), pair.simulated[model][response]
    found = {
        "input wrench": _input_difference(pair, model, axis),
        "excitation": phase_score(pair, model, response, "excitation"),
        "coast": phase_score(pair, model, response, "coast"),
        "initial slope": _initial_slope(pair, axis, real, simulated),
        "steady value": _steady_value(pair, axis, real, simulated),
        "coast t10": _decay(pair, real, simulated),
    }
    return {name: Gate(s.value, LIMITS[name], s.why) for name, s in found.items()}


def classify(results: dict[str, Gate]) -> str:
    """`mismatch` where a gate fails, else `incomplete` where one could not be evaluated, else `consistent`."""
    passed = [gate.passed for gate in results.values()]
    if False in passed:
        return "mismatch"
    return "incomplete" if None in passed else "consistent"


def coupling(pair: Pair, values: dict[str, Array], axis: Axis) -> dict[str, float]:
    """Response on the other axes per response on the excited one, by root mean square over the excitation.

    There is no gate on it: it shows what a model without coupling terms leaves out. Noise counts as response.

    Args:
        pair: The trial.
        values: `pair.measured` or those of a model.
        axis: The excited axis.

    Returns:
        Axis of the same kind (linear or angular) -> ratio [-]; only where both were measured.
    """
    here = pair.phase == "excitation"
    kind = AXES[:3] if axis in AXES[:3] else AXES[3:]

    def rms(other: Axis) -> float:
        x = values.get(pair.response(other), np.empty(0))
        x = x[here & np.isfinite(x)] if len(x) else x
        return float(np.sqrt(np.mean(np.square(x)))) if len(x) else float("nan")

    ratios = {other: rms(other) / max(rms(axis), 1e-12) for other in kind if other != axis}
    return {other: ratio for other, ratio in ratios.items() if np.isfinite(ratio)}


def _input_difference(pair: Pair, model: str, axis: Axis) -> Score:
    k = AXES.index(axis)
    logged = np.abs(pair.tau[pair.scored(), k])
    logged = logged[np.isfinite(logged)]
    level = float(np.percentile(logged, 95.0)) if len(logged) else 0.0
    if not level > 0.0:
        return Score(None, f"no input on {axis}")
    if model not in pair.applied:
        return Score(None, "the wrench that was simulated is not known")
    difference = np.abs(pair.applied[model][:, k] - pair.tau[:, k])[pair.scored()]
    difference = difference[np.isfinite(difference)]
    if not len(difference):
        return Score(None, "the input and the replay have no time in common")
    return Score(float(np.percentile(difference, 95.0)) / level)


def _initial_slope(pair: Pair, axis: Axis, real: Array, simulated: Array) -> Score:
    start = onset(pair, axis)
    if start is None:
        return Score(None, f"no input on {axis}")
    rows = slice(start, start + round(INITIAL * pair.rate) + 1)
    both = np.isfinite(real[rows]) & np.isfinite(simulated[rows])
    if both.sum() < 4:
        return Score(None, f"fewer than 4 samples in the first {INITIAL:g} s after the onset")
    t = pair.t[rows][both]
    covered = pair.measured[pair.response(axis)][rows]
    covered = covered[np.isfinite(covered)]
    theirs, ours = np.polyfit(t - t[0], np.c_[real[rows][both], simulated[rows][both]], 1)[0]
    if abs(theirs) * INITIAL < 0.5 * float(np.ptp(covered)):
        return Score(None, f"the response turns within {INITIAL:g} s of the onset")
    return _relative(ours, theirs, _slope_noise(t, pair.noise.get(pair.response(axis), 0.0)), "initial slope")


def _slope_noise(t: Array, noise: float) -> float:
    """Standard deviation of a fitted slope."""
    return float(noise / np.sqrt(np.sum(np.square(t - t.mean()))))


def _steady_value(pair: Pair, axis: Axis, real: Array, simulated: Array) -> Score:
    rows = np.flatnonzero(pair.phase == "excitation")
    rows = rows[len(rows) - int(LAST * len(rows)) :]
    tau = pair.tau[rows, AXES.index(axis)]
    rows, tau = rows[np.isfinite(tau)], tau[np.isfinite(tau)]
    if len(rows) < 4:
        return Score(None, "the excitation is too short for a steady value")
    if np.std(tau) > STEADY * abs(float(np.mean(tau))):
        return Score(None, "the input is not steady at the end of the excitation")
    both = np.isfinite(real[rows]) & np.isfinite(simulated[rows])
    if both.sum() < 4:
        return Score(None, "fewer than 4 samples at the end of the excitation")
    smooth = pair.measured[pair.response(axis)][rows]
    if np.nanstd(smooth) > STEADY * abs(float(np.nanmean(smooth))):
        return Score(None, "the response is not steady at the end of the excitation")
    noise = pair.noise.get(pair.response(axis), 0.0) / np.sqrt(both.sum())
    return _relative(
        float(simulated[rows][both].mean()), float(real[rows][both].mean()), noise, "steady value"
    )


def _relative(ours: float, theirs: float, noise: float, what: str) -> Score:
    if not abs(theirs) > 3.0 * (noise if np.isfinite(noise) else 0.0) or theirs == 0.0:
        return Score(None, f"the measured {what} is zero within its noise")
    return Score(abs(float(ours) - float(theirs)) / abs(float(theirs)))


def _decay(pair: Pair, real: Array, simulated: Array) -> Score:
    rows = np.flatnonzero(pair.phase == "coast")
    before = np.flatnonzero(pair.phase == "excitation")
    if len(rows) < 4 or not len(before) or before[-1] > rows[0]:
        return Score(None, "no coast after the excitation")
    first = rows[: np.argmax(np.diff(rows, append=rows[-1] + 2) > 1) + 1]
    theirs, ours = (_fall_time(x[first], pair.rate) for x in (real, simulated))
    if theirs == 0.0:
        return Score(None, "the coast is no decay: the response oscillates, or there is none")
    if theirs is None:
        return Score(None, "the measured speed does not fall to a tenth within the coast")
    if ours is None:
        # It takes longer than the coast lasts: at least that much is known, and where that fails the gate, it fails.
        least = len(first) / pair.rate / theirs - 1.0
        if least > LIMITS["coast t10"]:
            return Score(least)
        return Score(None, "the simulated speed does not fall to a tenth within the coast")
    return Score(abs(ours - theirs) / theirs)


def _fall_time(x: Array, rate: float) -> float | None:
    """Time until the magnitude is a tenth of what it was at first [s]; None if it never is, 0 if it comes back."""
    width = max(1, round(SMOOTHING * rate))
    good = np.isfinite(x)
    if good.sum() < 4 * min(width, 2):
        return None
    full = np.interp(np.arange(len(x)), np.flatnonzero(good), x[good])
    padded = np.pad(full, (width // 2, width - 1 - width // 2), mode="edge")
    smooth = np.abs(np.convolve(padded, np.full(width, 1.0 / width), mode="valid"))
    below = np.flatnonzero(smooth <= 0.1 * smooth[0])
    if not len(below):
        return None
    return 0.0 if smooth[below[0] :].max() > 0.3 * smooth[0] else float(max(below[0], 1) / rate)
