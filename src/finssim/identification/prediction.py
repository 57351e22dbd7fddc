"""Replay: how well do hydrodynamic models reproduce recorded trials, above all trials they were not fitted on."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from finssim.core.files import atomic_directory, refuse_unwritable
from finssim.core.provenance import provenance
from finssim.core.quiet import start_warp
from finssim.core.rotations import quat_rotate, quat_to_euler
from finssim.identification.report import new_figure
from finssim.identification.rollout import Response, Rollouts, Segment, Streams, segments, streams
from finssim.physics.hydrodynamics import HYDRODYNAMICS
from finssim.trials.findings import CalibrationError, Finding, finding, plain, sentences
from finssim.trials.motion import phase_at, white_noise
from finssim.trials.trial import COLUMNS, NU, Array, Trial
from finssim.vehicles import Vehicle, load_vehicle
from finssim.vehicles.vehicle import AXES, Axis

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "Aggregate", "Ahead", "Pair", "RESAMPLES", "Replay", "Score", "UNITS", "aggregate", "error_ahead",
    "excited_axes", "find_phases", "models_of", "nrmse", "onset", "replay", "response_span",
    "run_replay", "score", "span",
]  # fmt: skip

RESPONSES = (*NU, "roll", "pitch", "depth")
"""Compared columns: body velocities, and attitude and depth if they were measured."""

UNITS = {name: COLUMNS[name].unit for name in RESPONSES}
"""Response -> unit."""

EXCITED = 0.3
"""An axis counts as excited where its input reaches this share of that of the most excited axis."""

ONSET = 0.1
"""Share of its greatest magnitude at which the input has begun, and has ended."""


@dataclass(frozen=True, kw_only=True)
class Pair:
    """One trial and its replays. All arrays are over the same n times; numbers that are not there are NaN."""

    name: str
    sha256: str
    t: Array
    """Since the trial's first sample [s], uniform, (n,)."""
    t0: float = 0.0
    """The trial's first sample on its own clock [s]."""
    rate: float
    """[1/s]"""
    axes: tuple[Axis, ...]
    """Axes that the trial excites, which are scored."""
    phase: NDArray[np.str_]
    """Words of `PHASES`, (n,)."""
    tau: Array
    """Wrench that acted, from the log, about the vehicle's `wrench_reference` [N, N m], (n, 6)."""
    measured: dict[str, Array]
    """Response (of `RESPONSES`) -> values in the unit of the response, (n,); velocities and angles smoothed as for a
    fit."""
    raw: dict[str, Array] = field(default_factory=dict)
    """Measured values in the unit of the response, not smoothed."""
    source: dict[str, str] = field(default_factory=dict)
    """Response -> "measured", or what it was derived from."""
    noise: dict[str, float] = field(default_factory=dict)
    """Response -> standard deviation of the noise of one measured sample, in its unit."""
    simulated: dict[str, dict[str, Array]] = field(default_factory=dict)
    """Model -> response -> values in the unit of the response, (n,)."""
    segment: NDArray[np.int64] | None = None
    """Uninterrupted replay that a sample belongs to, -1 for none, (n,); None for a single one."""
    diverged: dict[str, float] = field(default_factory=dict)
    """Model -> time when its simulation stopped being finite [s]; only where it did."""
    late: dict[str, float] = field(default_factory=dict)
    """Model -> by how much the recorded motion lags the recorded commands beyond the model's motors [s], for which the
    comparison allows; only where it shows."""
    in_sample: bool = False
    """True if the vehicle was fitted on this very trial."""
    findings: tuple[Finding, ...] = ()

    def response(self, axis: Axis) -> str:
        """The velocity of an axis: `u` of surge."""
        return NU[AXES.index(axis)]

    def scored(self) -> NDArray[np.bool_]:
        """Return the samples that a score of the trial covers: excitation and coast; all if there is neither, (n,)."""
        inside = np.isin(self.phase, ("excitation", "coast"))
        return inside if inside.any() else np.ones(len(self.t), dtype=bool)


def excited_axes(tau: Array, limits: Array, named: Sequence[Axis] = ()) -> tuple[Axis, ...]:
    """The axes that a trial excites.

    Args:
        tau: Wrench about the vehicle's `wrench_reference` [N, N m], (n, 6).
        limits: `Vehicle.wrench_limits` [N, N m], (6,): what counts as much on each axis; 0 where the thrusters have
            no hold on an axis.
        named: What the header says; taken as it is where it says anything.

    Returns:
        In canonical order; empty where there is no input (a passive trial, thrusters off).
    """
    if named:
        return tuple(axis for axis in AXES if axis in named)
    # A vehicle without a limit on an axis can still be towed or pushed there: count it against 1 N or 0.1 N m of arm.
    scale = np.where(
        limits > 0.0, limits, max(float(limits.max(initial=0.0)), 1.0) * np.repeat([1.0, 0.1], 3)
    )
    share = np.sqrt(np.nanmean(np.square(tau / scale), axis=0)) if len(tau) else np.zeros(6)
    largest = float(share.max(initial=0.0))
    return tuple(a for a, x in zip(AXES, share, strict=True) if largest > 1e-9 and x >= EXCITED * largest)


def find_phases(
    t: Array, tau: Array, axes: Sequence[Axis], named: NDArray[np.str_] | None = None
) -> NDArray[np.str_]:
    """Phase of every sample: as the log names it, else found from the input of the excited axes.

    Excitation lasts from the first to the last time that the input is above a tenth of its greatest magnitude; before
    it is baseline, after it coast. Without input there is only coast.

    Args:
        t: [s], (n,).
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
    """Index of the sample where the input of an axis first reaches a tenth of its greatest magnitude."""
    active = np.flatnonzero(_active(pair.tau, (axis,)))
    return int(active[0]) if len(active) else None


def _active(tau: Array, axes: Sequence[Axis]) -> NDArray[np.bool_]:
    """Return where the input of one of the axes is above a tenth of its greatest magnitude there, (n,)."""
    magnitude = np.abs(np.nan_to_num(tau[:, [AXES.index(a) for a in axes]]))
    greatest = magnitude.max(axis=0, initial=0.0)
    return np.asarray(((magnitude >= ONSET * greatest) & (greatest > 0.0)).any(axis=1))


def models_of(pairs: Sequence[Pair]) -> tuple[str, ...]:
    """The replayed models, in their order."""
    models: Mapping[str, None] = {model: None for pair in pairs for model in pair.simulated}
    return tuple(models)


def resampled(t: Array, values: Array, times: Array) -> Array:
    """Linear interpolation that leaves holes holes: NaN where a neighbour is, or is far, or there is none.

    Units are kept.
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
"""Samples that a score needs at least."""

NOISE_SPAN = 2.0
"""A smoothed response must span this many standard deviations of a sample's noise, another twice as many: noise alone
spans 3.3 from P5 to P95, and half of that or less after smoothing."""


STILL = 0.002
"""Spans below this are those of a vehicle at rest, whatever the noise [m/s, rad/s, rad]."""


class Score(NamedTuple):
    """A number, or the reason why there is none."""

    value: float | None
    """The score [-], or None."""
    why: str = ""


def span(values: ArrayLike) -> float:
    """P95 - P5 of the finite values; NaN if there are none. The unit is kept."""
    x = np.asarray(values, dtype=np.float64)
    x = x[np.isfinite(x)]
    return float(np.subtract(*np.percentile(x, (95.0, 5.0)))) if len(x) else float("nan")


def nrmse(measured: Array, simulated: Array, scale: float, mask: NDArray[np.bool_] | None = None) -> Score:
    """RMSE / (P95 - P5 of the measurement)                                            (paper, section IV-B)

    Args:
        measured: Values in the unit of the response, (n,), NaN where there is no measurement.
        simulated: (n,), same unit.
        scale: P95 - P5 of the measurement over the scored part of the trial, same unit.
        mask: Samples to take; all if None.
    """
    error = (simulated - measured)[mask if mask is not None else slice(None)]
    error = error[np.isfinite(error)]
    if len(error) < FEWEST:
        return Score(None, f"too short: {len(error)} samples compared, at least {FEWEST} are needed")
    if not scale > 0.0:
        return Score(None, "the measured response does not vary: its P5 to P95 span is zero")
    return Score(float(np.sqrt(np.mean(np.square(error)))) / scale)


def response_span(pair: Pair, response: str) -> Score:
    """P95 - P5 of a response over the scored part of a trial; none where it is absent or is but noise."""
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
    """NRMSE of one response of one model over the excitation and the coast of a trial, or over one phase.

    The RMSE is of the phase, the span is that of the trial, so that phases can be compared.

    Args:
        pair: Trial and replays.
        model: Which replay.
        response: Of `RESPONSES`.
        phase: Of `PHASES`; excitation and coast if None.
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
    """One number for many trials."""

    value: float | None
    """Mean NRMSE [-], or None."""
    ci95: tuple[float, float] | None
    """Trial-level bootstrap [-], 2.5 and 97.5 %."""
    by_axis: dict[str, float]
    """Axis -> median NRMSE [-]."""
    trials: int
    why: str = ""
    """Reason why there is no number, or no interval."""


def aggregate(
    scores: Sequence[Mapping[Any, float | None]],
    *,
    resamples: int = RESAMPLES,
    seed: int = SEED,
) -> Aggregate:
    """Equal-weight mean over the axes of the median over the trials of an axis.

    The bootstrap draws whole trials with replacement, among those that have the same axes, so that every axis keeps as
    many trials as it has. An axis with one trial has nothing to draw from: then there is no interval.

    Args:
        scores: For each trial, axis -> NRMSE [-] or None.
        resamples: How many.
        seed: Of the draws.
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
    """Error of predictions made from measured states, by how far they look ahead."""

    seconds: Array
    """Times ahead [s], (H,)."""
    rmse: Array
    """Root mean square errors in the response's unit, (H,); NaN if nothing could be compared."""
    persistence: Array
    """Errors of the prediction that nothing changes, in the unit of the response, (H,)."""
    nrmse: Array
    """Root mean square of error over span [-], (H,)."""
    count: NDArray[np.int64]
    """Predictions compared, (H,)."""

    @property
    def skill(self) -> Array:
        """1 - rmse / persistence: 1 is perfect, 0 is no better than to say that nothing changes, (H,) [-]."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.where(self.persistence > 0.0, 1.0 - self.rmse / self.persistence, np.nan))


def error_ahead(
    starts: Array, ahead: Array, measured: Array, simulated: Array, width: ArrayLike, seconds: ArrayLike
) -> Ahead:
    """Root mean square over all predictions of the error a given time after each start.

    Args:
        starts: Response, in its unit, in the state that each prediction starts from, (S,).
        ahead: Times since the start [s], (T,).
        measured: Response in its unit, (T, S), NaN where there is no measurement.
        simulated: Response in its unit, (T, S).
        width: Span that `nrmse` is relative to [unit of the response], of all or for each prediction, (S,).
        seconds: Times of interest [s], (H,); the nearest of `ahead` is taken.
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


# Drive models with the recorded inputs of trials, from their recorded initial states.

RATE = 50.0
"""Responses are compared at this rate, or at the log's own where that is slower [1/s]."""

STEP = 0.02
"""Step of the simulation; integrated by RK4 [s]."""

LATEST, LEAST_LATE = 0.25, 0.02
"""Largest and smallest offset between the clocks of commands and motion that a comparison allows for [s]."""

SURE = 0.8
"""Factor on the squared error that an offset has to reach to be believed."""


def check_models(vehicle: Vehicle, models: Sequence[str]) -> tuple[str, ...]:
    """The models, each once.

    Raises:
        CalibrationError: One is unknown, or the vehicle file has no numbers for it.
    """
    for model in models:
        if model not in HYDRODYNAMICS:
            raise CalibrationError(
                f"unknown hydrodynamic model '{model}'; available: {', '.join(sorted(HYDRODYNAMICS))}"
            )
        if model not in vehicle.hydrodynamics:
            raise CalibrationError(
                f"vehicle '{vehicle.name}' has no hydrodynamics '{model}'; its file gives: "
                f"{', '.join(vehicle.hydrodynamics)}"
            )
    if not models:
        raise CalibrationError(f"no model to replay: name one of {', '.join(vehicle.hydrodynamics)}")
    return tuple(dict.fromkeys(models))


def replay_pairs(
    trials: Sequence[Trial],
    vehicle: Vehicle,
    models: Sequence[str],
    progress: Callable[[str], None] | None = None,
) -> tuple[list[Pair], list[Finding]]:
    """Return every trial with each model's prediction, simulated from its start and again after every gap.

    Args:
        trials: Recorded trials.
        vehicle: The vehicle that all models are of.
        models: Keys of its hydrodynamics.
        progress: Told the name of each model before it runs.

    Returns:
        Pairs in the order of the trials, and a finding for every trial that could not be replayed.
    """
    prepared: list[Streams] = []
    cut: list[Segment] = []
    excluded: list[Finding] = []
    for trial in trials:
        try:
            s = streams(trial, vehicle)
            parts = segments(s, vehicle, step=STEP, index=len(prepared))
        except CalibrationError as error:
            excluded.append(finding("unusable", trial.name, reason=error.reason))
            continue
        if not parts:
            excluded.append(finding("nothing_to_replay", trial.name))
            continue
        prepared.append(s)
        cut += parts
    pairs = [_bare_pair(s, vehicle) for s in prepared]
    for model in models if cut else ():
        if progress is not None:
            progress(model)
        response = Rollouts(vehicle, cut, hydrodynamics=model).run()
        for i, pair in enumerate(pairs):
            segments_of_trial = [k for k, segment in enumerate(cut) if segment.index == i]
            _add(pair, model, [cut[k] for k in segments_of_trial], response, segments_of_trial, vehicle)
    return [_axes_of_passive(pair) for pair in pairs], excluded


def _bare_pair(s: Streams, vehicle: Vehicle) -> Pair:
    """The measured side of a pair, on the grid of comparison."""
    trial, m = s.trial, s.motion
    rate = _rate(s, vehicle)
    t = np.arange(0.0, float(trial.t[-1] - trial.t[0]) + 0.5 / rate, 1.0 / rate)
    clock = t + float(trial.t[0])
    tau = _shifted(resampled(m.t, m.tau, clock), vehicle.wrench_reference)
    axes = excited_axes(tau, np.asarray(vehicle.wrench_limits), trial.header.axis)
    nu, raw_nu = resampled(m.t, m.nu, clock), resampled(m.t, m.raw, clock)
    measured = {name: nu[:, k] for k, name in enumerate(NU)}
    raw = {name: raw_nu[:, k] for k, name in enumerate(NU)}
    source = {name: m.nu_source[k] for k, name in enumerate(NU)}
    noise = {name: float(m.noise_std[k]) for k, name in enumerate(NU)}
    smooth = dict(zip(("roll", "pitch"), quat_to_euler(m.quaternion), strict=False))
    for name in ("roll", "pitch", "depth"):
        if name in s.measured:
            t_raw, values = s.measured[name]
            raw[name] = resampled(t_raw, values, clock)
            measured[name] = resampled(m.t, smooth[name], clock) if name in smooth else raw[name]
            source[name], noise[name] = "measured", white_noise(values)
    return Pair(
        name=trial.name,
        sha256=trial.sha256,
        t=t,
        t0=float(trial.t[0]),
        rate=rate,
        axes=axes,
        phase=find_phases(t, tau, axes, phase_at(trial, clock)),
        tau=tau,
        measured={name: x for name, x in measured.items() if np.isfinite(x).any()},
        raw={name: x for name, x in raw.items() if np.isfinite(x).any()},
        source=source,
        noise=noise,
        segment=np.full(len(t), -1),
        in_sample=vehicle.fitted_on(trial.sha256),
        findings=trial.findings,
    )


def _rate(s: Streams, vehicle: Vehicle) -> float:
    """50 Hz, or that of the slowest measured velocity of an excited axis where it is below [1/s]."""
    tau = _shifted(s.motion.tau, vehicle.wrench_reference)
    axes = excited_axes(tau, np.asarray(vehicle.wrench_limits), s.trial.header.axis) or AXES
    clocks = [s.trial.series(NU[AXES.index(axis)])[0] for axis in axes]
    rates = [1.0 / float(np.median(np.diff(t))) for t in clocks if len(t) > 1]
    rate = min([RATE, s.motion.rate, *rates])
    return float(round(rate)) if rate >= 2.0 and abs(rate / round(rate) - 1.0) < 0.01 else rate


def _axes_of_passive(pair: Pair) -> Pair:
    """A passive trial is scored on every axis that was measured to move."""
    if pair.axes:
        return pair
    moving = tuple(axis for axis in AXES if response_span(pair, pair.response(axis)).value is not None)
    return replace(pair, axes=moving, findings=(*pair.findings, finding("no_input")))


def _add(
    pair: Pair,
    model: str,
    segments: Sequence[Segment],
    response: Response,
    which: Sequence[int],
    vehicle: Vehicle,
) -> None:
    """Write a model's prediction of a trial's segments into its pair."""
    n = len(pair.t)
    pieces = []
    for number, (segment, k) in enumerate(zip(segments, which, strict=True)):
        since = pair.t + pair.t0 - segment.t0
        inside = (since >= -1e-9) & (since <= segment.duration + 1e-9)
        assert pair.segment is not None
        pair.segment[inside] = number
        rows = slice(0, segment.steps + 1)
        t = response.t[rows]
        if not response.finite[0, k]:
            finite = np.isfinite(response.nu[rows, 0, k]).all(axis=1)
            pair.diverged.setdefault(model, float(segment.t0 - pair.t0 + t[int(np.argmin(finite))]))
        pieces.append((inside, since[inside], t, _responses(segment, response, rows, k)))

    def at(late: float) -> dict[str, Array]:
        values = {name: np.full(n, np.nan) for name in RESPONSES}
        for inside, since, t, pieces_of_response in pieces:
            for name, x in pieces_of_response.items():
                values[name][inside] = np.interp(since - late, t, x)
        return values

    late = (
        _late(pair, at)
        if all(segment.commanded for segment in segments) and model not in pair.diverged
        else 0.0
    )
    if late:
        pair.late[model] = late
    pair.simulated[model] = at(late)


def _late(pair: Pair, at: Callable[[float], dict[str, Array]]) -> float:
    """The lag of a log's motion behind its commands that fits best [s]; 0 where it does not show.

    Commands and motion are often recorded by two computers, and a fit allows for their clocks as well.
    """
    scored = pair.scored()
    names = [pair.response(axis) for axis in pair.axes if pair.response(axis) in pair.measured]

    def cost(late: float) -> float:
        values, total = at(late), 0.0
        for name in names:
            error = (values[name] - pair.measured[name])[scored]
            error = error[np.isfinite(error)]
            spread = float(np.nanvar(pair.measured[name][scored]))
            total += float(np.mean(error**2)) / max(spread, 1e-12) if len(error) else 0.0
        return total

    offsets = np.arange(-LATEST, LATEST + 1e-9, 0.01)
    costs = [cost(float(offset)) for offset in offsets]
    best = int(np.argmin(costs))
    shows = 0 < best < len(offsets) - 1 and abs(offsets[best]) >= LEAST_LATE
    return float(offsets[best]) if shows and costs[best] < SURE * cost(0.0) else 0.0


def _responses(segment: Segment, response: Response, rows: slice, k: int) -> dict[str, Array]:
    """All responses of one segment over its own steps, (steps + 1,) each."""
    nu = response.nu[rows, 0, k].astype(float)
    q = response.quaternion[rows, 0, k].astype(float)
    depth_at = np.broadcast_to(segment.depth_at, (len(q), 3))
    out = {name: nu[:, i] for i, name in enumerate(NU)}
    out["roll"], out["pitch"], _ = quat_to_euler(q)
    out["depth"] = -(response.position[rows, 0, k].astype(float) + quat_rotate(q, depth_at))[:, 2]
    return out


def _shifted(tau: Array, point: Array) -> Array:
    """Moments about a body point, of wrenches about the body origin, (n, 6)."""
    out = np.array(tau, dtype=np.float64)
    out[:, 3:] -= np.cross(np.asarray(point, dtype=np.float64), out[:, :3])
    return out


# Short replays from measured states all along trials: what a model predicts some seconds ahead.

STAGGER = 4
"""Predictions start this many times per horizon."""


def replay_predictions(
    trials: Sequence[Trial], pairs: Sequence[Pair], vehicle: Vehicle, models: Sequence[str], horizon: float
) -> dict[Axis, dict[str, Ahead]]:
    """Errors of short replays that start from measured states all along the trials.

    Args:
        trials: Those of the pairs, in their order.
        pairs: Which axes and samples count.
        vehicle: The vehicle.
        models: Keys of its hydrodynamics.
        horizon: How far to look ahead [s].

    Returns:
        By axis and model; only where a prediction can be compared.
    """
    cut: list[Segment] = []
    for i, trial in enumerate(trials):
        s = streams(trial, vehicle)
        late = next(iter(pairs[i].late.values()), 0.0)
        if late:
            s = replace(s, drive=replace(s.drive, t=s.drive.t + late, spans=s.drive.spans + late))
        for k in range(STAGGER):
            start = k * horizon / STAGGER
            parts = int((trial.duration - start) / horizon)
            if parts > 0:
                length = (trial.duration - start) / parts
                cut += segments(s, vehicle, length=length, step=STEP, start=start, index=i)
    if not cut:
        return {}
    steps = round(horizon / STEP)
    ahead = STEP * np.arange(steps + 1)
    responses = {model: Rollouts(vehicle, cut, hydrodynamics=model).run() for model in models}
    seconds = _seconds(horizon)
    out: dict[Axis, dict[str, Ahead]] = {}
    for axis in AXES:
        k = AXES.index(axis)
        chosen = [
            i
            for i, segment in enumerate(cut)
            if axis in pairs[segment.index].axes
            and segment.known[k]
            and response_span(pairs[segment.index], NU[k]).value is not None
        ]
        if not chosen:
            continue
        start = np.array([cut[i].nu[k] for i in chosen])
        measured = np.stack([_ahead(pairs[cut[i].index], cut[i], ahead, NU[k]) for i in chosen], axis=-1)
        width = np.array([response_span(pairs[cut[i].index], NU[k]).value for i in chosen])
        out[axis] = {}
        for model, response in responses.items():
            simulated = _padded(response.nu[:, 0, chosen, k], steps + 1)
            out[axis][model] = error_ahead(start, ahead, measured, simulated, width, seconds)
    return out


def _ahead(pair: Pair, segment: Segment, ahead: Array, response: str) -> Array:
    """Return the measurements at times after a segment's start that count, (T,)."""
    since = ahead + segment.t0 - pair.t0
    values = resampled(pair.t, np.where(pair.scored(), pair.measured[response], np.nan), since)
    return np.where(ahead <= segment.duration + 1e-9, values, np.nan)


def _padded(values: NDArray[np.float32], rows: int) -> Array:
    """The first rows, NaN below the last, (rows, S)."""
    out = np.full((rows, values.shape[1]), np.nan)
    out[: len(values[:rows])] = values[:rows]
    return out


SHORTEST_HORIZON, LONGEST_HORIZON = 0.1, 60.0
"""[s]"""


@dataclass(frozen=True, kw_only=True)
class Replay:
    """Trials replayed with one model or several."""

    vehicle: Vehicle
    models: tuple[str, ...]
    """The first is the one that single numbers are of."""
    pairs: tuple[Pair, ...]
    """Trials beside their replays."""
    left_out: tuple[Finding, ...] = ()
    """Reason for each trial that could not be replayed."""
    horizon: float | None = None
    """Horizon of predictions from measured states [s]; None without them."""
    ahead: dict[Axis, dict[str, Ahead]] = field(default_factory=dict)
    """Axis -> model -> error of those predictions."""
    seed: int = SEED
    """Seed of the bootstrap."""

    @cached_property
    def scores(self) -> dict[str, tuple[dict[Axis, Score], ...]]:
        """Model -> for each trial, excited axis -> NRMSE over excitation and coast."""
        return {
            model: tuple({axis: score(p, model, p.response(axis)) for axis in p.axes} for p in self.pairs)
            for model in self.models
        }

    @property
    def in_sample(self) -> bool:
        """Return whether there is no held-out trial: then all numbers rest on trials that the vehicle was fitted on."""
        return bool(self.pairs) and all(pair.in_sample for pair in self.pairs)

    def aggregate(self, model: str, *, in_sample: bool | None = None) -> Aggregate:
        """Equal-weight mean over the axes of the median over trials, with its bootstrap interval.

        Args:
            model: One of `models`.
            in_sample: Of the in-sample or the held-out trials; the held-out ones where there are any if None.
        """
        requested = self.in_sample if in_sample is None else in_sample
        chosen = [
            (p, s) for p, s in zip(self.pairs, self.scores[model], strict=True) if p.in_sample == requested
        ]
        broken = [p.name for p, _ in chosen if model in p.diverged]
        if broken:
            return Aggregate(
                None, None, {}, len(chosen), f"the simulation of {broken[0]} does not stay finite"
            )
        rows = [{axis: score.value for axis, score in scores.items()} for _, scores in chosen]
        return aggregate(rows, seed=self.seed)

    def as_json(self) -> dict[str, Any]:
        """Return what `--json` prints."""
        return replay_json(self)


def replay(
    trials: Sequence[Trial],
    vehicle: Vehicle,
    *,
    hydrodynamics: str | Sequence[str] = "calibrated",
    horizon: float | None = None,
    out: Path | None = None,
    seed: int = SEED,
    progress: Callable[[str], None] | None = None,
) -> Replay:
    """Drive models with the recorded inputs from the recorded initial states and compare their responses.

    A whole trial is one replay, begun anew only after a gap. Responses are compared at 50 Hz, or at the
    log's own rate where that is slower.

    Args:
        trials: Recorded trials, with or without inputs (passive).
        vehicle: The vehicle; it remembers the trials that it was fitted on.
        hydrodynamics: A model or several: keys of the vehicle's hydrodynamics.
        horizon: Also predict this far ahead from measured states all along the trials [s].
        out: Directory for `replay.json`, `replay.md` and the figures.
        seed: Of the bootstrap.
        progress: Told the name of each model before it runs.

    Raises:
        CalibrationError: A model or horizon that cannot be, or no trial could be replayed.
    """
    models = check_models(vehicle, [hydrodynamics] if isinstance(hydrodynamics, str) else list(hydrodynamics))
    if horizon is not None and not SHORTEST_HORIZON <= horizon <= LONGEST_HORIZON:
        raise CalibrationError(
            f"horizon is {horizon:g} s, expected {SHORTEST_HORIZON:g} to {LONGEST_HORIZON:g} s"
        )
    if not trials:
        raise CalibrationError("no trial to replay: give at least one")
    if out is not None:
        refuse_unwritable(atomic_directory(out, replaces=REPLAY_FILE))
    pairs, excluded = replay_pairs(trials, vehicle, models, progress)
    if not pairs:
        raise CalibrationError(f"no trial could be replayed: {excluded[0]}")
    ahead: dict[Axis, dict[str, Ahead]] = {}
    if horizon is not None:
        named = {trial.name: trial for trial in trials}
        ahead = replay_predictions([named[p.name] for p in pairs], pairs, vehicle, models, horizon)
    result = Replay(
        vehicle=vehicle,
        models=models,
        pairs=tuple(pairs),
        left_out=tuple(excluded),
        horizon=horizon,
        ahead=ahead,
        seed=seed,
    )
    if out is not None:
        write_replay(result, out)
    return result


def _seconds(horizon: float) -> Array:
    """1, 2, ... s up to the horizon; quarters of it where it is below 2 s."""
    full = np.arange(1.0, np.floor(horizon + 1e-9) + 1.0)
    if len(full) < 2:
        return np.asarray(horizon * np.arange(1, 5) / 4.0)
    return full if abs(full[-1] - horizon) < 1e-6 else np.append(full, horizon)


def run_replay(
    paths: Sequence[str | Path],
    *,
    vehicle: str | Path | Vehicle,
    hydrodynamics: str | Sequence[str] = "calibrated",
    horizon: float | None = None,
    out: Path | None = None,
    seed: int = 1,
    as_json: bool = False,
    console: Console | None = None,
) -> Replay:
    """Simulate models with recorded inputs and score them: NRMSE per axis and trial, in-sample trials labelled.

    Example: finssim replay trials/held-out --vehicle fitted.yaml --hydrodynamics calibrated --out replay

    Args:
        paths (TRIAL): Trial folders, folders of them, or bare .csv or .parquet tables.
        vehicle (NAME|FILE): Vehicle in the catalogue, or path of a vehicle file.
        hydrodynamics (MODEL): Model to replay: calibrated, simplified or mesh. May be repeated.
        horizon: Also score predictions this far ahead [s] from measured states throughout the trials.
        out (DIR): Directory for replay.json, replay.md and figures.
        seed: Seed of every random number; equal seeds give equal results.
        as_json: Print one JSON object instead of tables.
        console: Where the tables go; standard output if None.

    Raises:
        CalibrationError, VehicleError, OutputError: As they say.
    """
    from finssim.trials.trial_files import load_trials

    body = load_vehicle(vehicle)
    trials = load_trials(paths)
    start_warp()
    screen = Console(stderr=True)
    with screen.status("replaying") as status:
        result = replay(
            trials,
            body,
            hydrodynamics=hydrodynamics,
            horizon=horizon,
            out=out,
            seed=seed,
            progress=lambda model: status.update(f"replaying {len(trials)} trials: {model}"),
        )
    if as_json:
        print(json.dumps(result.as_json(), allow_nan=False))
        return result
    console = console or Console()
    print_replay(result, console)
    if out is not None:
        console.print(f"written: {out}", highlight=False, soft_wrap=True)
    return result


# A replay as a person reads it: tables on the terminal and in Markdown, and the folder of `--out`.

MODEL_LABELS = {"calibrated": "Calibrated Fossen", "mesh": "Physics-mesh", "simplified": "Simplified Fossen"}
COLORS = {"calibrated": "#0072B2", "mesh": "#009E73", "simplified": "#D55E00"}
OTHERS = ("#CC79A7", "#56B4E9", "#E69F00")
"""Okabe and Ito's palette, which the colour-blind can distinguish too."""
BLACK = "#1a1a1a"
STYLES = {"calibrated": (0, ()), "mesh": (0, (6, 1.6)), "simplified": (0, (1.6, 1.2))}
"""Line styles, for a print without colours."""

BEFORE = 0.5
"""Time shown before the onset [s]."""
SYMBOLS = {"roll": "roll", "pitch": "pitch", "depth": "depth"} | {name: f"${name}$" for name in "uvwpqr"}


def normalised(pair: Pair, values: Array, axis: Axis) -> tuple[Array, Array] | None:
    """A response over the time since the onset, sign-aligned and relative to the measured P5-P95 span.

    Signs are those of the input, and of the response itself where there is none.

    Args:
        pair: The trial.
        values: Measured or simulated response of the axis in its unit, (n,).
        axis: The axis.

    Returns:
        Times since the onset of the input [s] and values [-], (n,) each; None where the trial has no such response. A
        passive trial starts at its first scored sample.
    """
    width = response_span(pair, pair.response(axis)).value
    if width is None:
        return None
    start = onset(pair, axis)
    begin = int(np.argmax(pair.scored())) if start is None else start
    inside = pair.scored()
    push = pair.tau[inside, AXES.index(axis)]
    leading = push if start is not None else pair.measured[pair.response(axis)][inside]
    sign = 1.0 if np.nansum(leading) >= 0.0 else -1.0
    return pair.t - pair.t[begin], sign * values / width


def draw_response_envelopes(pairs: Sequence[Pair]) -> Figure:
    """Axis-wise envelopes: a panel for each axis, pointwise median and middle half over its trials.

    Held-out trials are drawn where there are any; else those the vehicle was fitted on, and the figure says so.

    Args:
        pairs: Trials with their replays.

    Raises:
        ValueError: No trial has a response that could be drawn.
    """
    held_out = [pair for pair in pairs if not pair.in_sample]
    drawn = held_out or list(pairs)

    def drawable(pair: Pair, axis: Axis) -> bool:
        return axis in pair.axes and response_span(pair, pair.response(axis)).value is not None

    panels = {axis: chosen for axis in AXES if (chosen := [p for p in drawn if drawable(p, axis)])}
    if not panels:
        raise ValueError(
            "no trial has a response that could be drawn: nothing was measured on an excited axis"
        )
    models = models_of(drawn)
    columns = 1 if len(panels) == 1 else 2
    rows = -(-len(panels) // columns)
    figure, axes_of = _panels(len(panels), rows, columns, (3.6 * columns, 2.15 * rows + 0.55))
    for i, (axis, chosen) in enumerate(panels.items()):
        _envelope_panel(axes_of.flat[i], axis, chosen, models)
    for i in range(0, len(panels), columns):
        axes_of.flat[i].set_ylabel("normalised response")
    for axes in axes_of.flat[max(len(panels) - columns, 0) : len(panels)]:
        axes.set_xlabel("time since onset [s]")
    handles, labels = axes_of.flat[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False, fontsize=8.5)
    if not held_out:
        figure.suptitle("in-sample: the vehicle was fitted on these trials", fontsize=10, color="#a00000")
    return figure


def draw_overlay(pair: Pair) -> Figure:
    """One trial: the input if any, the responses of the excited axes, attitude and depth where they were measured."""
    responses = [pair.response(axis) for axis in pair.axes]
    responses += [r for r in ("roll", "pitch", "depth") if response_span(pair, r).value is not None]
    responses = [r for r in responses if r in pair.measured]
    driven = bool(np.nan_to_num(pair.tau).any())
    rows = len(responses) + driven
    figure, grid = _panels(rows, rows, 1, (7.2, 1.1 + 1.45 * rows), sharex=True)
    axes_of = grid[:, 0]
    if driven:
        _input_panel(axes_of[0], pair)
    models = models_of([pair])
    for axes, response in zip(axes_of[driven:], responses, strict=True):
        if response in pair.raw:
            axes.plot(pair.t, pair.raw[response], color="0.8", linewidth=0.8)
        axes.plot(pair.t, pair.measured[response], color=BLACK, linewidth=2.4, label="measured")
        for model in models:
            values = _broken(pair, pair.simulated[model][response])
            figure_of = score(pair, model, response).value
            note = "" if figure_of is None else f" {figure_of:.3f}"
            label = f"{_label(model)}{note}"
            axes.plot(
                pair.t, values, color=_color(model, models), linestyle=_style(model), lw=1.3, label=label
            )
        axes.set_ylabel(f"{SYMBOLS[response]} [{UNITS[response]}]")
        source = pair.source.get(response, "")
        if source not in ("", "measured"):
            axes.plot([], [], " ", label=f"({source})")
        axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False, fontsize=7.5)
    for axes in axes_of:
        _tidy(axes)
        axes.set_xlim(pair.t[0], pair.t[-1])
    axes_of[-1].set_xlabel("time [s]")
    label = f"{pair.name}: {', '.join(pair.axes) if driven else 'passive'}" + (
        ", in-sample" if pair.in_sample else ""
    )
    figure.suptitle(label, fontsize=10, color="#a00000" if pair.in_sample else BLACK)
    return figure


def _panels(
    count: int, rows: int, columns: int, size: tuple[float, float], **shared: Any
) -> tuple[Figure, Any]:
    """A figure of that size [inch] with `count` visible axes in a grid, (rows, columns)."""
    figure = new_figure(*size)
    axes_of = figure.subplots(rows, columns, squeeze=False, **shared)
    for axes in axes_of.flat[count:]:
        axes.set_visible(False)
    return figure, axes_of


def _envelope_panel(axes: Any, axis: Axis, pairs: Sequence[Pair], models: Sequence[str]) -> None:
    grid = _grid(pairs, axis)
    measured = [_on(grid, normalised(p, p.measured[p.response(axis)], axis)) for p in pairs]
    _band(axes, grid, np.array(measured), BLACK, "measured", (0, ()), zorder=2.5, width=3.2)
    for k, model in enumerate(models):
        values = [
            _on(grid, normalised(p, p.simulated[model][p.response(axis)], axis))
            for p in pairs
            if model in p.simulated
        ]
        color = _color(model, models)
        _band(axes, grid, np.array(values), color, _label(model), _style(model), zorder=3)
        scores = [{axis: score(p, model, p.response(axis)).value} for p in pairs if model in p.simulated]
        value = aggregate(scores, resamples=1).value
        if value is not None:
            position = (1.0 - 0.14 * (len(models) - 1 - k), 1.03)
            axes.text(
                *position, f"{value:.3f}", transform=axes.transAxes, color=color, fontsize=8, ha="right"
            )
    position = (1.0 - 0.14 * len(models), 1.03)
    axes.text(*position, "NRMSE", transform=axes.transAxes, color="0.45", fontsize=7, ha="right")
    coast = [p.t[np.argmax(p.phase == "coast")] - p.t[onset(p, axis) or 0] for p in pairs if _coasts(p, axis)]
    if coast:
        axes.axvspan(float(np.median(coast)), grid[-1], color="0.945", zorder=0, linewidth=0.0)
        axes.annotate(
            "coast", (float(np.median(coast)), 0.02), xycoords=("data", "axes fraction"),
            xytext=(3, 1), textcoords="offset points", fontsize=7, color="0.45",
        )  # fmt: skip
    count = f"{len(pairs)} trial{'s' if len(pairs) != 1 else ''}"
    axes.set_title(f"{axis} ({count})", fontsize=9, loc="left")
    axes.set_xlim(grid[0], grid[-1])
    _tidy(axes)


def _input_panel(axes: Any, pair: Pair) -> None:
    names = pair.axes or AXES[:1]
    for axis, style in zip(names, ("-", "--", ":", "-.", "-", "--"), strict=False):
        unit = "N" if axis in AXES[:3] else "N m"
        values = pair.tau[:, AXES.index(axis)]
        axes.plot(pair.t, values, color="0.35", linestyle=style, linewidth=1.1, label=f"{axis} [{unit}]")
    axes.set_ylabel("input")
    axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False, fontsize=7.5)


def _coasts(pair: Pair, axis: Axis) -> bool:
    return bool((pair.phase == "coast").any()) and onset(pair, axis) is not None


def _grid(pairs: Sequence[Pair], axis: Axis) -> Array:
    """Times since the onset that three quarters of the trials cover [s], so that no trial's end shows as a step."""
    ends = []
    for pair in pairs:
        aligned = normalised(pair, pair.t, axis)
        assert aligned is not None
        ends.append(aligned[0][np.flatnonzero(pair.scored())[-1]])
    first = max(-BEFORE, float(np.median([-(p.t[onset(p, axis) or 0] - p.t[0]) for p in pairs])))
    rate = max(pair.rate for pair in pairs)
    return np.asarray(
        np.arange(np.ceil(first * rate), np.floor(float(np.quantile(ends, 0.25)) * rate) + 1) / rate
    )


def _on(grid: Array, aligned: tuple[Array, Array] | None) -> Array:
    assert aligned is not None
    t, x = aligned
    good = np.isfinite(x)
    if not good.any():
        return np.full(len(grid), np.nan)
    return np.asarray(np.interp(grid, t[good], x[good], left=np.nan, right=np.nan))


def _band(
    axes: Any,
    grid: Array,
    values: Array,
    color: str,
    label: str,
    style: Any,
    zorder: float,
    width: float = 1.5,
) -> None:
    """Median and middle half where at least half of the trials have a value."""
    enough = np.isfinite(values).mean(axis=0) >= 0.5
    quartiles = np.full((3, len(grid)), np.nan)
    if enough.any():
        quartiles[:, enough] = np.nanquantile(values[:, enough], (0.25, 0.5, 0.75), axis=0)
    low, median, high = quartiles
    axes.fill_between(grid, low, high, color=color, alpha=0.18, linewidth=0.0, zorder=zorder - 1.0)
    axes.plot(grid, median, color=color, linewidth=width, linestyle=style, label=label, zorder=zorder)


def _broken(pair: Pair, values: Array) -> Array:
    """A gap in the line wherever a new replay starts."""
    if pair.segment is None:
        return values
    out = values.copy()
    out[1:][np.diff(pair.segment) != 0] = np.nan
    return out


def _color(model: str, models: Sequence[str]) -> str:
    strange = [name for name in models if name not in COLORS]
    return COLORS[model] if model in COLORS else OTHERS[strange.index(model) % len(OTHERS)]


def _style(model: str) -> Any:
    return STYLES.get(model, (0, (4, 1, 1, 1)))


def _tidy(axes: Any) -> None:
    axes.grid(True, color="0.88", linewidth=0.5)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=8)


# A replay as plain values.

DEFINITION = (
    "nrmse: RMSE / (P95 - P5 of the measured response), both over excitation and coast of a trial; phases use the "
    "same span. Measured velocities and angles are smoothed as for a fit. aggregate: median over the trials of an "
    "axis, then the mean of the axes. ci95: trial bootstrap. Held-out trials count where there are any; in_sample "
    "says that there are none."
)

PHASES = ("excitation", "coast")


def replay_json(replay: Replay) -> dict[str, Any]:
    """Return what `finssim replay --json` prints and `replay.json` holds.

    The numbers at the top are of the first model; `models` has those of all. What could not be computed is null, and
    `why` says why.
    """
    models = {model: _model(replay, model) for model in replay.models}
    first = models[replay.models[0]]
    return {
        "vehicle": {"name": replay.vehicle.name, "sha256": replay.vehicle.sha256},
        "hydrodynamics": replay.models[0],
        **first,
        "in_sample": replay.in_sample,
        "in_sample_trials": [p.name for p in replay.pairs if p.in_sample],
        "definition": DEFINITION,
        "models": models,
        "horizon": replay.horizon,
        "trials": {pair.name: _trial(replay, i, pair) for i, pair in enumerate(replay.pairs)},
        "left_out": [item.as_json() for item in replay.left_out],
        "bootstrap": {"resamples": RESAMPLES, "seed": replay.seed, "unit": "trial"},
        "provenance": provenance(),
    }


def _model(replay: Replay, model: str) -> dict[str, Any]:
    main = replay.aggregate(model)
    axes = list(dict.fromkeys(axis for pair in replay.pairs for axis in pair.axes))
    rows = list(zip(replay.pairs, replay.scores[model], strict=True))
    return {
        "nrmse": {a: {p.name: s[a].value for p, s in rows if a in s} for a in axes},
        "nrmse_by_axis": {a: main.by_axis.get(a) for a in axes},
        "aggregate": main.value,
        "ci95": main.ci95,
        "why": main.why,
        "held_out": _aggregate(replay.aggregate(model, in_sample=False)),
        "in_sample_only": _aggregate(replay.aggregate(model, in_sample=True)),
        "ahead": {axis: _ahead_json(by_model[model]) for axis, by_model in replay.ahead.items()},
    }


def _aggregate(a: Aggregate) -> dict[str, Any] | None:
    if not a.trials:
        return None
    return {"aggregate": a.value, "ci95": a.ci95, "by_axis": a.by_axis, "trials": a.trials, "why": a.why}


def _ahead_json(a: Any) -> dict[str, Any]:
    return {
        "seconds": a.seconds.tolist(),
        "rmse": plain(a.rmse),
        "nrmse": plain(a.nrmse),
        "persistence_rmse": plain(a.persistence),
        "skill": plain(a.skill),
        "predictions": a.count.tolist(),
    }


def _trial(replay: Replay, i: int, pair: Pair) -> dict[str, Any]:
    others = [r for r in pair.measured if r not in {pair.response(a) for a in pair.axes}]
    return {
        "sha256": pair.sha256,
        "in_sample": pair.in_sample,
        "axes": list(pair.axes),
        "rate_hz": pair.rate,
        "duration_s": float(pair.t[-1]),
        "source": {r: pair.source.get(r, "") for r in pair.measured},
        "noise_std": {r: x for r, x in pair.noise.items() if r in pair.measured and math.isfinite(x)},
        "findings": [item.as_json() for item in pair.findings],
        "models": {
            model: {
                "nrmse": {a: s.value for a, s in replay.scores[model][i].items()},
                "late_s": pair.late.get(model, 0.0),
                "why": {a: s.why for a, s in replay.scores[model][i].items() if s.why},
                "phases": {
                    a: {p: score(pair, model, pair.response(a), p).value for p in PHASES} for a in pair.axes
                },
                "other_responses": {
                    r: value for r in others if (value := score(pair, model, r).value) is not None
                },
            }
            for model in replay.models
        },
    }


REPLAY_FILE = "replay.json"

BEYOND = 1.1
"""Factor on the top speed of the fit above which a replay extrapolates."""

Rows = list[list[str]]


def print_replay(replay: Replay, console: Console) -> None:
    """Print NRMSE by axis and model, the trials, and what could not be scored."""
    console.print(_headline(replay), highlight=False, markup=False)
    for title, heads, rows in _tables(replay):
        if title:
            console.print(title, highlight=False, markup=False)
        table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
        for k, head in enumerate(heads):
            table.add_column(Text(head), justify="left" if k == 0 else "right", no_wrap=k == 0)
        for row in rows:
            table.add_row(*map(Text, row), style="bold" if row[0].startswith("aggregate") else None)
        console.print(table)
    for sentence in _remarks(replay):
        console.print(sentence, highlight=False, markup=False)


def replay_markdown(replay: Replay) -> str:
    """`replay.md`."""
    parts = [f"# Replay of {replay.vehicle.name}", _headline(replay)]
    for title, heads, rows in _tables(replay):
        lines = [heads, ["---"] + ["--:"] * (len(heads) - 1), *rows]
        parts += [f"## {title}" if title else "", "\n".join("| " + " | ".join(line) + " |" for line in lines)]
    if any(p.axes for p in replay.pairs):
        parts.append("![Response envelopes](envelope.png)")
    parts += ["\n".join(f"- {sentence}" for sentence in _remarks(replay)), DEFINITION]
    parts.append(f"Vehicle {replay.vehicle.sha256}.")
    return "\n\n".join(part for part in parts if part) + "\n"


def _tables(replay: Replay) -> list[tuple[str, list[str], Rows]]:
    """Title, heads and rows of each table."""
    tables = [("", *_axis_table(replay))]
    if replay.ahead:
        title = "Error ahead, relative to the span; in brackets the skill against persistence"
        tables.append((title, *_ahead_table(replay)))
    return [*tables, (f"NRMSE of {_label(replay.models[0])} by trial", *_trial_table(replay))]


def write_replay(replay: Replay, out: Path) -> None:
    """Write `replay.json`, `replay.md`, the envelope and a figure of each trial; an earlier replay is replaced.

    Raises:
        OutputError: The directory cannot be written.
    """
    with atomic_directory(out, replaces=REPLAY_FILE) as folder:
        text = json.dumps(replay.as_json(), indent=2, allow_nan=False) + "\n"
        (folder / REPLAY_FILE).write_text(text, encoding="utf-8")
        (folder / "replay.md").write_text(replay_markdown(replay), encoding="utf-8")
        try:
            draw_response_envelopes(replay.pairs).savefig(folder / "envelope.png", dpi=200)
        except ValueError:
            pass  # nothing was measured on an excited axis; the tables say so
        (folder / "trials").mkdir()
        for pair in replay.pairs:
            name = "".join(c if c.isalnum() or c in "-_.+" else "_" for c in pair.name)
            draw_overlay(pair).savefig(folder / "trials" / f"{name}.png", dpi=110)


def _headline(replay: Replay) -> str:
    total, held_out = len(replay.pairs), sum(not p.in_sample for p in replay.pairs)
    kinds = [f"{held_out} held-out"] if held_out else []
    if held_out < total:
        kinds.append(f"{total - held_out} IN-SAMPLE (the vehicle was fitted on them)")
    rates = sorted({p.rate for p in replay.pairs})
    rate = f"{rates[0]:.4g} Hz" if len(rates) == 1 else f"{rates[0]:.4g} to {rates[-1]:.4g} Hz"
    noun = "trial" if total == 1 else "trials"
    return f"{replay.vehicle.name}: {total} {noun}, {' and '.join(kinds)}, compared at {rate}"


def _axis_table(replay: Replay) -> tuple[list[str], Rows]:
    """Return NRMSE by axis, a column for each model, with held-out and in-sample trials separate."""
    kinds = [k for k in (False, True) if any(p.in_sample == k for p in replay.pairs)]
    rows: Rows = []
    for kind in kinds:
        aggregates = {m: replay.aggregate(m, in_sample=kind) for m in replay.models}
        mark = " in-sample" if kind else ""
        for axis in AXES:
            count = sum(axis in p.axes and p.in_sample == kind for p in replay.pairs)
            if count:
                values = [_number(aggregates[m].by_axis.get(axis)) for m in replay.models]
                rows.append([axis, f"{count}{mark}", *values])
        count = sum(p.in_sample == kind for p in replay.pairs)
        rows.append(["aggregate", f"{count}{mark}", *(_number(aggregates[m].value) for m in replay.models)])
        rows.append(["95 % interval", "", *(_interval(aggregates[m]) for m in replay.models)])
    return ["NRMSE", "trials", *(_label(m) for m in replay.models)], rows


def _trial_table(replay: Replay) -> tuple[list[str], Rows]:
    """Every trial with the first model."""
    model = replay.models[0]
    rows: Rows = []
    for pair, scores in zip(replay.pairs, replay.scores[model], strict=True):
        for axis, total in scores.items():
            phases = [_number(score(pair, model, pair.response(axis), p).value) for p in PHASES]
            kind = "in-sample" if pair.in_sample else "held-out"
            rows.append([pair.name, axis, kind, _number(total.value), *phases])
    return ["trial", "axis", "", "NRMSE", "excitation", "coast"], rows


def _ahead_table(replay: Replay) -> tuple[list[str], Rows]:
    first = next(iter(next(iter(replay.ahead.values())).values()))
    rows = [
        [axis, _label(model)]
        + [
            "–" if x != x else f"{x:.3f} ({s:+.2f})" if s == s else f"{x:.3f}"
            for x, s in zip(a.nrmse, a.skill, strict=True)
        ]
        for axis, by_model in replay.ahead.items()
        for model, a in by_model.items()
    ]
    return ["axis", "model", *(f"{s:g} s" for s in first.seconds)], rows


def _remarks(replay: Replay) -> list[str]:
    """Return remarks: what could not be scored or replayed, what was derived, and missing intervals; equal ones
    together."""
    findings: list[Finding] = [*replay.left_out]
    records = [one.settings for one in replay.vehicle.calibrations if "speeds" in one.settings]
    fitted = dict(records[-1]["speeds"]) if records else {}
    for model in replay.models:
        reason = replay.aggregate(model).why
        findings += [finding("no_interval", _label(model), reason=reason)] if reason else []
    for pair, scores in zip(replay.pairs, replay.scores[replay.models[0]], strict=True):
        for axis, score in scores.items():
            if score.why:
                findings.append(finding("not_scored", pair.name, axis=str(axis), reason=score.why))
            source = pair.source.get(pair.response(axis), "")
            if source not in ("", "measured"):
                findings.append(finding("velocity_derived", pair.name, axis=str(axis), source=source))
            top = np.nanpercentile(np.abs(pair.measured.get(pair.response(axis), np.zeros(1))), 99.0)
            if 0.0 < BEYOND * fitted.get(axis, 0.0) < top:
                unit = UNITS[pair.response(axis)]
                findings.append(
                    finding(
                        "extrapolates", pair.name, axis=axis, top=float(top), fitted=fitted[axis], unit=unit
                    )
                )
        if not scores:
            findings.append(finding("no_axis", pair.name))
        for model, late in pair.late.items():
            sense = "lags" if late > 0.0 else "leads"
            findings.append(
                finding("clocks_apart", pair.name, model=_label(model), sense=sense, late=abs(late))
            )
    return sentences(findings)


def _label(model: str) -> str:
    return MODEL_LABELS.get(model, model)


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.3f}"


def _interval(a: Aggregate) -> str:
    return "–" if a.ci95 is None else f"[{a.ci95[0]:.3f}, {a.ci95[1]:.3f}]"
