"""Trials with their replays, and the scores of a replay: NRMSE by axis, its aggregate, errors some seconds ahead."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from finssim.identification.excitation import SWINGING
from finssim.trials.findings import Finding
from finssim.trials.trial import COLUMNS, NU, Array
from finssim.vehicles.vehicle import AXES, Axis

RESPONSES = (*NU, "roll", "pitch", "depth")
"""Compared columns: body velocities, and attitude and depth if they were measured."""

UNITS = {name: COLUMNS[name].unit for name in RESPONSES}
"""Response -> unit."""

EXCITED = 0.3
"""Input of an excited axis, relative to that of the most excited axis."""

ONSET = 0.1
"""Fraction of its greatest magnitude at which the input counts as started, and as ended."""


@dataclass(frozen=True, kw_only=True)
class Pair:
    """Trial and its replays. All arrays are over the same n times; missing numbers are NaN."""

    name: str
    sha256: str
    t: Array
    """Times since the trial's first sample [s], uniform, (n,)."""
    t0: float = 0.0
    """Time of the trial's first sample on its own clock [s]."""
    rate: float
    """Rate of the times [1/s]."""
    axes: tuple[Axis, ...]
    """Axes that the trial excites, which are scored."""
    phase: NDArray[np.str_]
    """Words of `PHASES`, (n,)."""
    tau: Array
    """Applied wrench, from the log, about the vehicle's `wrench_reference` [N, N m], (n, 6)."""
    measured: dict[str, Array]
    """Response (of `RESPONSES`) -> values in the unit of the response, (n,); velocities and angles are
    smoothed as for a fit."""
    raw: dict[str, Array] = field(default_factory=dict)
    """Unsmoothed measured values in the unit of the response."""
    source: dict[str, str] = field(default_factory=dict)
    """Response -> "measured", or the quantity it was derived from."""
    noise: dict[str, float] = field(default_factory=dict)
    """Response -> standard deviation of the noise of one measured sample, in its unit."""
    simulated: dict[str, dict[str, Array]] = field(default_factory=dict)
    """Model -> response -> values in the unit of the response, (n,)."""
    segment: NDArray[np.int64] | None = None
    """Index of the uninterrupted replay of each sample, -1 for none, (n,); None for a single replay."""
    diverged: dict[str, float] = field(default_factory=dict)
    """Model -> time at which its simulation became non-finite [s]; only where it did."""
    late: dict[str, float] = field(default_factory=dict)
    """Model -> lag of the recorded motion behind the recorded commands beyond the model's motors [s], which
    the comparison compensates; only where it is significant."""
    in_sample: bool = False
    """True if the vehicle was fitted on this trial."""
    findings: tuple[Finding, ...] = ()

    def response(self, axis: Axis) -> str:
        """Return the velocity of an axis, such as `u` for surge."""
        return NU[AXES.index(axis)]

    def scored(self) -> NDArray[np.bool_]:
        """Return a mask of the samples that a score of the trial covers: excitation and coast; all if there
        is neither, (n,)."""
        inside = np.isin(self.phase, ("excitation", "coast"))
        return inside if inside.any() else np.ones(len(self.t), dtype=bool)


def excited_axes(
    tau: Array, limits: Array, named: Sequence[Axis] = (), swinging: Sequence[Axis] = ()
) -> tuple[Axis, ...]:
    """Return the axes that a trial excites.

    If other axes are driven, roll and pitch count if they swing measurably: their wrench depends on heights
    in the vehicle file, which a calibration changes, and both replays must be scored on the same axes.

    Args:
        tau: Wrench about the vehicle's `wrench_reference` [N, N m], (n, 6).
        limits: `Vehicle.wrench_limits` [N, N m], (6,), to which the inputs are related; 0 for axes without control.
        named: Axes in the header; used unchanged if there are any.
        swinging: Those of roll and pitch with a measurable motion.

    Returns:
        Axes in canonical order; empty if there is no input (a passive trial, thrusters off).
    """
    if named:
        return tuple(axis for axis in AXES if axis in named)
    # A vehicle without a limit on an axis can still be towed or pushed: relate the input to 1 N or 0.1 N m.
    scale = np.where(
        limits > 0.0, limits, max(float(limits.max(initial=0.0)), 1.0) * np.repeat([1.0, 0.1], 3)
    )
    share = np.sqrt(np.nanmean(np.square(tau / scale), axis=0)) if len(tau) else np.zeros(6)
    largest = float(share.max(initial=0.0))
    pushed = tuple(a for a, x in zip(AXES, share, strict=True) if largest > 1e-9 and x >= EXCITED * largest)
    if set(pushed) <= set(SWINGING):
        return pushed
    return tuple(axis for axis in AXES if axis in (*steered(pushed), *swinging))


def steered(axes: Sequence[Axis]) -> tuple[Axis, ...]:
    """Return axes without roll and pitch, which a push along another axis tilts; all if there are no others."""
    return tuple(axis for axis in axes if axis not in SWINGING) or tuple(axes)


def find_phases(
    t: Array, tau: Array, axes: Sequence[Axis], named: NDArray[np.str_] | None = None
) -> NDArray[np.str_]:
    """Return the phase of every sample: as named in the log, otherwise detected from the input of the excited axes.

    Excitation lasts from the first to the last time at which the input is above a tenth of its greatest
    magnitude; it is preceded by the baseline and followed by the coast. Without input there is only coast.

    Args:
        t: Times [s], (n,).
        tau: Wrench [N, N m], (n, 6).
        axes: The excited axes.
        named: Phases of the log, (n,), or None.

    Returns:
        Words of `PHASES`, (n,).
    """
    if named is not None and np.isin(named, ("excitation", "coast")).any():
        return named.astype("<U10")
    phase = np.full(len(t), "coast", dtype="<U10")
    active = np.flatnonzero(_active(tau, axes))
    if len(active):
        phase[: active[0]] = "baseline"
        phase[active[0] : active[-1] + 1] = "excitation"
    return phase


def onset(pair: Pair, axis: Axis) -> int | None:
    """Return the index of the sample at which the input of an axis first reaches a tenth of its greatest
    magnitude."""
    active = np.flatnonzero(_active(pair.tau, (axis,)))
    return int(active[0]) if len(active) else None


def _active(tau: Array, axes: Sequence[Axis]) -> NDArray[np.bool_]:
    """Return a mask of the samples with an input of one of the axes above a tenth of its greatest magnitude, (n,)."""
    magnitude = np.abs(np.nan_to_num(tau[:, [AXES.index(a) for a in axes]]))
    greatest = magnitude.max(axis=0, initial=0.0)
    return np.asarray(((magnitude >= ONSET * greatest) & (greatest > 0.0)).any(axis=1))


def models_of(pairs: Sequence[Pair]) -> tuple[str, ...]:
    """Return the replayed models, in order."""
    return tuple(dict.fromkeys(model for pair in pairs for model in pair.simulated))


def resampled(t: Array, values: Array, times: Array) -> Array:
    """Return linearly interpolated values that are NaN where a neighbour is NaN, distant, or missing.

    Units are unchanged.
    """
    if values.ndim == 2:
        return np.stack([resampled(t, column, times) for column in values.T], axis=-1)
    good = np.isfinite(values)
    if not good.any():
        return np.full(len(times), np.nan)
    t, values = t[good], values[good]
    out = np.interp(times, t, values, left=np.nan, right=np.nan)
    right = np.clip(np.searchsorted(t, times), 0, len(t) - 1)
    before = np.maximum(np.searchsorted(t, times, side="right") - 1, 0)
    usual = float(np.median(np.diff(t))) if len(t) > 1 else np.inf
    out[t[right] - t[before] > max(3.0 * usual, 0.1)] = np.nan
    return np.asarray(out)


RESAMPLES, SEED = 2000, 20260903
"""Settings of the trial bootstrap, as in the paper's replay validation."""

FEWEST = 8
"""Least number of samples for a score."""

NOISE_SPAN = 2.0
"""Number of standard deviations of a sample's noise that a smoothed response must span, another response
twice as many: noise alone spans 3.3 from P5 to P95, and at most half of that after smoothing."""


STILL = 0.002
"""Span below which a vehicle counts as at rest, whatever the noise [m/s, rad/s, rad]."""


class Score(NamedTuple):
    """A number, or the reason why there is none."""

    value: float | None
    """The score [-], or None."""
    why: str = ""


def span(values: ArrayLike) -> float:
    """Return P95 - P5 of the finite values; NaN if there are none. The unit is unchanged."""
    x = np.asarray(values, dtype=np.float64)
    x = x[np.isfinite(x)]
    return float(np.subtract(*np.percentile(x, (95.0, 5.0)))) if len(x) else float("nan")


def nrmse(measured: Array, simulated: Array, scale: float, mask: NDArray[np.bool_] | None = None) -> Score:
    """Return RMSE / (P95 - P5 of the measurement)                                            (paper, section IV-B)

    Args:
        measured: Values in the unit of the response, (n,), NaN where there is no measurement.
        simulated: Simulated values, (n,), same unit.
        scale: P95 - P5 of the measurement over the scored part of the trial, same unit.
        mask: Samples to use; all if None.
    """
    error = (simulated - measured)[mask if mask is not None else slice(None)]
    error = error[np.isfinite(error)]
    if len(error) < FEWEST:
        return Score(None, f"too short: {len(error)} samples compared, at least {FEWEST} are needed")
    if not scale > 0.0:
        return Score(None, "the measured response does not vary: its P5 to P95 span is zero")
    return Score(float(np.sqrt(np.mean(np.square(error)))) / scale)


def response_span(pair: Pair, response: str) -> Score:
    """Return P95 - P5 of a response over the scored part of a trial; no value if it is missing or only noise."""
    values = pair.measured.get(response)
    if values is None or not np.isfinite(values).any():
        return Score(None, "not measured")
    x = values[pair.scored()]
    count = int(np.isfinite(x).sum())
    if count < FEWEST:
        return Score(None, f"too short: {count} samples measured, at least {FEWEST} are needed")
    width, noise = span(x), pair.noise.get(response, 0.0)
    if not width > 1e-12:
        return Score(None, "the measured response does not vary: its P5 to P95 span is zero")
    if width < STILL:
        return Score(None, f"the vehicle was at rest: the measured response spans {width:.2g} from P5 to P95")
    smoothed = pair.raw.get(response) is not values
    if np.isfinite(noise) and width < (NOISE_SPAN if smoothed else 2.0 * NOISE_SPAN) * noise:
        return Score(
            None, f"the measured response, {width:.3g} from P5 to P95, is its noise (std {noise:.3g})"
        )
    return Score(width)


def score(pair: Pair, model: str, response: str, phase: str | None = None) -> Score:
    """Return the NRMSE of one response of one model over the excitation and the coast of a trial, or over one phase.

    The RMSE is that of the phase, the span that of the trial, so that phases can be compared.

    Args:
        pair: Trial and replays.
        model: Name of the model.
        response: One of `RESPONSES`.
        phase: One of `PHASES`; excitation and coast if None.
    """
    mask = pair.scored() if phase is None else pair.phase == phase
    if not mask.any():
        return Score(None, f"the trial has no {phase}")
    width = response_span(pair, response)
    if width.value is None:
        return width
    if model in pair.diverged:
        return Score(
            None, f"the simulation does not stay finite: it ends {pair.diverged[model]:.2f} s into the trial"
        )
    return nrmse(pair.measured[response], pair.simulated[model][response], width.value, mask)


class Aggregate(NamedTuple):
    """Aggregate score of many trials."""

    value: float | None
    """Mean NRMSE [-], or None."""
    ci95: tuple[float, float] | None
    """95 % interval by trial-level bootstrap [-]."""
    by_axis: dict[str, float]
    """Axis -> median NRMSE [-]."""
    trials: int
    why: str = ""
    """Reason why there is no number, or no interval."""


def aggregate(
    scores: Sequence[Mapping[Any, float | None]], *, resamples: int = RESAMPLES, seed: int = SEED
) -> Aggregate:
    """Return the equal-weight mean over the axes of the median over the trials of an axis.

    The bootstrap draws complete trials with replacement, among those with the same axes, so that the number of trials
    of every axis is preserved. For an axis with one trial, resampling is not possible: there is no interval then.

    Args:
        scores: For each trial, axis -> NRMSE [-] or None.
        resamples: Number of resamples.
        seed: Seed of the draws.
    """
    axes = list(dict.fromkeys(a for row in scores for a, x in row.items() if x is not None))
    if not axes:
        return Aggregate(None, None, {}, 0, "no trial has a score")
    table = np.array(
        [[np.nan if row.get(a) is None else row[a] for a in axes] for row in scores], dtype=float
    )
    table = table[np.isfinite(table).any(axis=1)]
    by_axis = np.nanmedian(table, axis=0)
    value = float(by_axis.mean())
    named = {a: float(x) for a, x in zip(axes, by_axis, strict=True)}
    lonely = [a for a, n in zip(axes, np.isfinite(table).sum(axis=0), strict=True) if n < 2]
    if lonely:
        return Aggregate(
            value, None, named, len(table), f"no interval: a single trial of {', '.join(lonely)}"
        )
    random = np.random.default_rng(seed)
    patterns, stratum = np.unique(np.isfinite(table), axis=0, return_inverse=True)
    rows = np.empty((resamples, len(table)), dtype=np.int64)
    for k in range(len(patterns)):
        members = np.flatnonzero(stratum.reshape(-1) == k)
        rows[:, members] = random.choice(members, (resamples, len(members)))
    replicates = np.nanmedian(table[rows], axis=1).mean(axis=1)
    low, high = np.percentile(replicates, (2.5, 97.5))
    return Aggregate(value, (float(low), float(high)), named, len(table))


class Ahead(NamedTuple):
    """Error of predictions from measured states, by prediction time."""

    seconds: Array
    """Prediction times [s], (H,)."""
    rmse: Array
    """Root mean square errors in the response's unit, (H,); NaN if there is nothing to compare."""
    persistence: Array
    """Errors of the constant prediction, in the unit of the response, (H,)."""
    nrmse: Array
    """Root mean square of error over span [-], (H,)."""
    count: NDArray[np.int64]
    """Number of compared predictions, (H,)."""

    @property
    def skill(self) -> Array:
        """Skill 1 - rmse / persistence: 1 is perfect, 0 is no better than the constant prediction, (H,) [-]."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.where(self.persistence > 0.0, 1.0 - self.rmse / self.persistence, np.nan))


def error_ahead(
    starts: Array, ahead: Array, measured: Array, simulated: Array, width: ArrayLike, seconds: ArrayLike
) -> Ahead:
    """Return the root mean square over all predictions of the error at given times after each start.

    Args:
        starts: Response, in its unit, in the initial state of each prediction, (S,).
        ahead: Times since the start [s], (T,).
        measured: Response in its unit, (T, S), NaN where there is no measurement.
        simulated: Response in its unit, (T, S).
        width: Span that `nrmse` is relative to [unit of the response], for all or for each prediction, (S,).
        seconds: Prediction times [s], (H,); the nearest of `ahead` is used.
    """
    horizons = np.asarray(seconds, dtype=np.float64)
    rows = np.abs(ahead[:, None] - horizons).argmin(axis=0)
    ours, theirs = simulated[rows] - measured[rows], starts - measured[rows]
    both = np.isfinite(ours) & np.isfinite(theirs)
    count = both.sum(axis=1)

    def rms(x: Array) -> Array:
        total = np.sum(np.square(x), axis=1, where=both)
        return np.asarray(
            np.sqrt(np.divide(total, count, out=np.full(len(horizons), np.nan), where=count > 0))
        )

    rmse = rms(ours)
    scale = np.asarray(width, dtype=np.float64)
    return Ahead(horizons, rmse, rms(theirs), rms(ours / scale), count)
