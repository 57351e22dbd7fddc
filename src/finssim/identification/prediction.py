"""Replay: validation of hydrodynamic models with recorded trials, in particular held-out ones."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from finssim.core.files import atomic_directory, refuse_unwritable
from finssim.core.quiet import start_warp
from finssim.core.rotations import quat_rotate, quat_to_euler
from finssim.identification.excitation import SWINGING
from finssim.identification.replay_metrics import (
    RESPONSES,
    SEED,
    Aggregate,
    Ahead,
    Pair,
    Score,
    aggregate,
    error_ahead,
    excited_axes,
    find_phases,
    resampled,
    response_span,
    score,
    steered,
)
from finssim.identification.replay_report import (
    REPLAY_FILE,
    print_replay,
    replay_html,
    replay_json,
    write_replay,
)
from finssim.identification.rollout import Response, Rollouts, Segment, Streams, segments, streams
from finssim.physics.hydrodynamics import HYDRODYNAMICS
from finssim.trials.findings import CalibrationError, Finding, finding
from finssim.trials.motion import answers, phase_at, white_noise
from finssim.trials.trial import NU, Array, Trial
from finssim.vehicles import Vehicle, load_vehicle
from finssim.vehicles.vehicle import AXES, Axis

__all__ = ["Replay", "replay", "run_replay"]

# Simulation of models with the recorded inputs of trials, from their recorded initial states.

RATE = 50.0
"""Rate at which responses are compared, or the log's own rate if it is lower [1/s]."""

STEP = 0.02
"""Time step of the simulation; integrated by RK4 [s]."""

LATEST, LEAST_LATE = 0.25, 0.02
"""Largest and smallest offset between the clocks of commands and motion that a comparison compensates [s]."""

SURE = 0.8
"""Factor on the squared error below which an offset is accepted."""


def check_models(vehicle: Vehicle, models: Sequence[str]) -> tuple[str, ...]:
    """Return the models without duplicates.

    Raises:
        CalibrationError: A model is unknown, or the vehicle file has no parameters for it.
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
    """Return every trial with each model's prediction, simulated from its start and restarted after every gap.

    Args:
        trials: Recorded trials.
        vehicle: Vehicle of all models.
        models: Keys of its hydrodynamics.
        progress: Function that is called with the name of each model before it runs.

    Returns:
        Pairs in the order of the trials, and a finding for every trial that could not be replayed.
    """
    prepared: list[Streams] = []
    cut: list[Segment] = []
    excluded: list[Finding] = []
    for trial in trials:
        try:
            s = streams(trial, vehicle)
            parts = segments(s, vehicle, step=STEP, index=len(prepared), changes=True)
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
    """Return the measured data of a pair, on the grid of comparison."""
    trial, m = s.trial, s.motion
    rate = _rate(s, vehicle)
    t = np.arange(0.0, float(trial.t[-1] - trial.t[0]) + 0.5 / rate, 1.0 / rate)
    clock = t + float(trial.t[0])
    tau = _shifted(resampled(m.t, m.tau, clock), vehicle.wrench_reference)
    axes = _excited(s, vehicle)
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
        phase=find_phases(t, tau, steered(axes), phase_at(trial, clock)),
        tau=tau,
        measured={name: x for name, x in measured.items() if np.isfinite(x).any()},
        raw={name: x for name, x in raw.items() if np.isfinite(x).any()},
        source=source,
        noise=noise,
        segment=np.full(len(t), -1),
        in_sample=vehicle.fitted_on(trial.sha256),
        findings=trial.findings,
    )


def _excited(s: Streams, vehicle: Vehicle) -> tuple[Axis, ...]:
    tau = _shifted(s.motion.tau, vehicle.wrench_reference)
    swinging = [axis for axis in SWINGING if answers(s.motion, AXES.index(axis))]
    return excited_axes(tau, np.asarray(vehicle.wrench_limits), s.trial.header.axis, swinging)


def _rate(s: Streams, vehicle: Vehicle) -> float:
    """Return 50 Hz, or the rate of the slowest measured velocity of an excited axis if it is lower [1/s]."""
    axes = steered(_excited(s, vehicle)) or AXES
    clocks = [s.trial.series(NU[AXES.index(axis)])[0] for axis in axes]
    rates = [1.0 / float(np.median(np.diff(t))) for t in clocks if len(t) > 1]
    rate = min([RATE, s.motion.rate, *rates])
    return float(round(rate)) if rate >= 2.0 and abs(rate / round(rate) - 1.0) < 0.01 else rate


def _axes_of_passive(pair: Pair) -> Pair:
    """Return the pair of a passive trial, which is scored on every axis with a measured motion."""
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
    """Store a model's prediction of a trial's segments in its pair."""
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

    commanded = all(segment.drive.commanded for segment in segments)
    late = _late(pair, at) if commanded and model not in pair.diverged else 0.0
    if late:
        pair.late[model] = late
    pair.simulated[model] = at(late)


def _late(pair: Pair, at: Callable[[float], dict[str, Array]]) -> float:
    """Return the lag of a log's motion behind its commands that fits best [s]; 0 if it is not significant.

    Commands and motion are often recorded by two computers, and a fit compensates their clock offset as well.
    """
    scored = pair.scored()
    names = [pair.response(axis) for axis in steered(pair.axes) if pair.response(axis) in pair.measured]

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
    """Return all responses of one segment over its own steps, (steps + 1,) each."""
    nu = response.nu[rows, 0, k].astype(float)
    q = response.quaternion[rows, 0, k].astype(float)
    depth_at = np.broadcast_to(segment.sensors.depth_at, (len(q), 3))
    out = {name: nu[:, i] for i, name in enumerate(NU)}
    out["roll"], out["pitch"], _ = quat_to_euler(q)
    out["depth"] = -(response.position[rows, 0, k].astype(float) + quat_rotate(q, depth_at))[:, 2]
    return out


def _shifted(tau: Array, point: Array) -> Array:
    """Return wrenches with moments about a body point, from wrenches about the body origin, (n, 6)."""
    out = np.array(tau, dtype=np.float64)
    out[:, 3:] -= np.cross(np.asarray(point, dtype=np.float64), out[:, :3])
    return out


# Short replays from measured states throughout trials: prediction some seconds ahead.

STAGGER = 4
"""Number of predictions that start per horizon."""


def replay_predictions(
    trials: Sequence[Trial], pairs: Sequence[Pair], vehicle: Vehicle, models: Sequence[str], horizon: float
) -> dict[Axis, dict[str, Ahead]]:
    """Return errors of short replays that start from measured states throughout the trials.

    Args:
        trials: Trials of the pairs, in their order.
        pairs: Pairs with the scored axes and samples.
        vehicle: The vehicle.
        models: Keys of its hydrodynamics.
        horizon: Prediction horizon [s].

    Returns:
        Errors by axis and model, where predictions can be compared.
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
                cut += segments(s, vehicle, length=length, step=STEP, start=start, index=i, changes=True)
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
            and segment.start.known[k]
            and response_span(pairs[segment.index], NU[k]).value is not None
        ]
        if not chosen:
            continue
        start = np.array([cut[i].start.nu[k] for i in chosen])
        measured = np.stack([_ahead(pairs[cut[i].index], cut[i], ahead, NU[k]) for i in chosen], axis=-1)
        width = np.array([response_span(pairs[cut[i].index], NU[k]).value for i in chosen])
        out[axis] = {}
        for model, response in responses.items():
            simulated = _padded(response.nu[:, 0, chosen, k], steps + 1)
            out[axis][model] = error_ahead(start, ahead, measured, simulated, width, seconds)
    return out


def _ahead(pair: Pair, segment: Segment, ahead: Array, response: str) -> Array:
    """Return the scored measurements at times after a segment's start, (T,)."""
    since = ahead + segment.t0 - pair.t0
    values = resampled(pair.t, np.where(pair.scored(), pair.measured[response], np.nan), since)
    return np.where(ahead <= segment.duration + 1e-9, values, np.nan)


def _padded(values: NDArray[np.float32], rows: int) -> Array:
    """Return the first rows, padded with NaN, (rows, S)."""
    out = np.full((rows, values.shape[1]), np.nan)
    out[: len(values[:rows])] = values[:rows]
    return out


SHORTEST_HORIZON, LONGEST_HORIZON = 0.1, 60.0
"""Shortest and longest prediction horizon [s]."""


@dataclass(frozen=True, kw_only=True)
class Replay:
    """Replay of trials with one or several models."""

    vehicle: Vehicle
    models: tuple[str, ...]
    """Models; single numbers refer to the first."""
    pairs: tuple[Pair, ...]
    """Trials with their replays."""
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
        """Model -> for each trial: excited axis -> NRMSE over excitation and coast."""
        return {
            model: tuple({axis: score(p, model, p.response(axis)) for axis in p.axes} for p in self.pairs)
            for model in self.models
        }

    @property
    def in_sample(self) -> bool:
        """Return whether there is no held-out trial: all numbers are then based on trials that the vehicle
        was fitted on."""
        return bool(self.pairs) and all(pair.in_sample for pair in self.pairs)

    def aggregate(self, model: str, *, in_sample: bool | None = None) -> Aggregate:
        """Return the equal-weight mean over the axes of the median over trials, with its bootstrap interval.

        Args:
            model: One of `models`.
            in_sample: True for the in-sample, False for the held-out trials; if None, the held-out ones if
                there are any.
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
        """Return the JSON object that `--json` prints."""
        return replay_json(self)

    def __repr__(self) -> str:
        return f"<Replay of {self.vehicle.name} ({' '.join(self.models)}): {len(self.pairs)} trials>"

    def _repr_html_(self) -> str:
        return replay_html(self)


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
    """Simulate models with the recorded inputs from the recorded initial states and compare their responses.

    A complete trial is one replay, restarted only after a gap. Responses are compared at 50 Hz, or at the
    log's own rate if it is lower.

    Args:
        trials: Recorded trials, with or without inputs (passive).
        vehicle: The vehicle; its calibration records name the trials that it was fitted on.
        hydrodynamics: One or several models: keys of the vehicle's hydrodynamics.
        horizon: Horizon of additional predictions from measured states throughout the trials [s].
        out: Directory for `replay.json`, `replay.md` and the figures.
        seed: Seed of the bootstrap.
        progress: Function that is called with the name of each model before it runs.

    Raises:
        CalibrationError: A model or horizon is invalid, or no trial could be replayed.
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
    """Return 1, 2, ... s up to the horizon; quarters of it if it is below 2 s."""
    full = np.arange(1.0, np.floor(horizon + 1e-9) + 1.0)
    if len(full) < 2:
        return np.asarray(horizon * np.arange(1, 5) / 4.0)
    return full if abs(full[-1] - horizon) < 1e-6 else np.append(full, horizon)


def run_replay(
    paths: Sequence[str | Path],
    *,
    vehicle: str,
    hydrodynamics: str | Sequence[str] = "calibrated",
    horizon: float | None = None,
    out: Path | None = None,
    seed: int = 1,
    as_json: bool = False,
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

    Raises:
        CalibrationError, VehicleError, OutputError: See these classes.
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
    console = Console()
    print_replay(result, console)
    if out is not None:
        console.print(f"written: {out}", highlight=False, soft_wrap=True)
    return result
