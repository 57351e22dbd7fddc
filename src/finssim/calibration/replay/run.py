"""Drive models with the recorded inputs of trials, from their recorded initial states."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from finssim.calibration.errors import CalibrationError
from finssim.calibration.replay.metrics import response_span
from finssim.calibration.replay.pairs import Pair, excited_axes, find_phases, resampled
from finssim.calibration.simulation.rollout import Response, Rollouts
from finssim.calibration.simulation.segments import Segment, Streams, segments, streams
from finssim.calibration.trials.columns import NU
from finssim.calibration.trials.trial import Array, Trial
from finssim.geometry.rotations import quat_rotate, quat_to_euler
from finssim.physics.hydrodynamics import HYDRODYNAMICS
from finssim.vehicles import Vehicle
from finssim.vehicles.vehicle import AXES

__all__ = ["STEP", "check_models", "replay_pairs"]

RATE = 50.0
"""Responses are compared at this rate, or at the log's own where that is slower [1/s]."""

STEP = 0.02
"""Of the simulation; integrated by RK4 [s]."""

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
) -> tuple[list[Pair], list[str]]:
    """Every trial beside what each model makes of it, simulated from its start and anew after every gap.

    Args:
        trials: Recorded trials.
        vehicle: The vehicle that all models are of.
        models: Keys of its hydrodynamics.
        progress: Told the name of each model before it runs.

    Returns:
        Pairs in the order of the trials, and a sentence for every trial that could not be replayed.
    """
    prepared: list[Streams] = []
    cut: list[Segment] = []
    left_out = []
    for trial in trials:
        try:
            s = streams(trial, vehicle)
            parts = segments(s, vehicle, step=STEP, index=len(prepared))
        except CalibrationError as error:
            left_out.append(str(error) if trial.name in str(error) else f"{trial.name}: {error}")
            continue
        if not parts:
            left_out.append(f"{trial.name}: nothing measured while the input is known")
            continue
        prepared.append(s)
        cut += parts
    pairs = [_bare_pair(s, vehicle) for s in prepared]
    for model in models if cut else ():
        if progress is not None:
            progress(model)
        response = Rollouts(vehicle, cut, hydrodynamics=model).run()
        for i, pair in enumerate(pairs):
            own = [k for k, segment in enumerate(cut) if segment.index == i]
            _add(pair, model, [cut[k] for k in own], response, own, vehicle)
    return [_axes_of_passive(pair) for pair in pairs], left_out


def _bare_pair(s: Streams, vehicle: Vehicle) -> Pair:
    """The measured side of a pair, on the grid of comparison."""
    trial, m = s.trial, s.motion
    rate = _rate(s, vehicle)
    t = np.arange(0.0, float(trial.t[-1] - trial.t[0]) + 0.5 / rate, 1.0 / rate)
    clock = t + float(trial.t[0])
    tau = _shifted(resampled(m.t, m.tau, clock), vehicle.wrench_reference)
    axes = excited_axes(tau, np.asarray(vehicle.wrench_limits), trial.header.axis)
    named = None
    if trial.phase is not None:
        rows = np.clip(np.searchsorted(trial.t, clock + 1e-9, side="right") - 1, 0, len(trial.t) - 1)
        named = trial.phase[rows]
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
            source[name], noise[name] = "measured", _sample_noise(values)
    return Pair(
        name=trial.name,
        sha256=trial.sha256,
        t=t,
        t0=float(trial.t[0]),
        rate=rate,
        axes=axes,
        phase=find_phases(t, tau, axes, named),
        tau=tau,
        measured={name: x for name, x in measured.items() if np.isfinite(x).any()},
        raw={name: x for name, x in raw.items() if np.isfinite(x).any()},
        source=source,
        noise=noise,
        segment=np.full(len(t), -1),
        in_sample=vehicle.fitted_on(trial.sha256),
        notes=trial.notes,
    )


def _rate(s: Streams, vehicle: Vehicle) -> float:
    """50 Hz, or that of the slowest measured velocity of an excited axis where it is below [1/s]."""
    tau = _shifted(s.motion.tau, vehicle.wrench_reference)
    axes = excited_axes(tau, np.asarray(vehicle.wrench_limits), s.trial.header.axis) or AXES
    clocks = [s.trial.series(NU[AXES.index(axis)])[0] for axis in axes]
    rates = [1.0 / float(np.median(np.diff(t))) for t in clocks if len(t) > 1]
    rate = min([RATE, s.motion.rate, *rates])
    return float(round(rate)) if rate >= 2.0 and abs(rate / round(rate) - 1.0) < 0.01 else rate


def _sample_noise(values: Array) -> float:
    """Standard deviation of white noise on a signal that is smooth from sample to sample: of its second differences."""
    if len(values) < 10:
        return float("nan")
    second = np.diff(values, n=2)
    return float(1.4826 * np.median(np.abs(second - np.median(second))) / np.sqrt(6.0))


def _axes_of_passive(pair: Pair) -> Pair:
    """A passive trial is scored on every axis that was measured to move."""
    if pair.axes:
        return pair
    moving = tuple(axis for axis in AXES if response_span(pair, pair.response(axis)).value is not None)
    return replace(pair, axes=moving, notes=(*pair.notes, "no input: every axis that moves is compared"))


def _add(
    pair: Pair, model: str, own: Sequence[Segment], response: Response, which: Sequence[int], vehicle: Vehicle
) -> None:
    """Write what a model made of a trial's segments into its pair."""
    n = len(pair.t)
    applied = np.full((n, 6), np.nan)
    pieces = []
    for number, (segment, k) in enumerate(zip(own, which, strict=True)):
        since = pair.t + pair.t0 - segment.t0
        inside = (since >= -1e-9) & (since <= segment.duration + 1e-9)
        assert pair.segment is not None
        pair.segment[inside] = number
        rows = slice(0, segment.steps + 1)
        t = response.t[rows]
        if not response.finite[0, k]:
            whole = np.isfinite(response.nu[rows, 0, k]).all(axis=1)
            pair.diverged.setdefault(model, float(segment.t0 - pair.t0 + t[int(np.argmin(whole))]))
        pieces.append((inside, since[inside], t, _responses(segment, response, rows, k)))
        if not segment.commanded:
            force = np.concatenate([segment.before[-1:], segment.force])
            tau = _shifted(force @ segment.B.T, vehicle.wrench_reference)
            applied[inside] = np.stack([np.interp(since[inside], t, x) for x in tau.T], axis=-1)

    def at(late: float) -> dict[str, Array]:
        values = {name: np.full(n, np.nan) for name in (*NU, "roll", "pitch", "depth")}
        for inside, since, t, found in pieces:
            for name, x in found.items():
                values[name][inside] = np.interp(since - late, t, x)
        return values

    late = (
        _late(pair, at) if all(segment.commanded for segment in own) and model not in pair.diverged else 0.0
    )
    if late:
        pair.late[model] = late
    pair.simulated[model] = at(late)
    if np.isfinite(applied).any():
        pair.applied[model] = applied


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
