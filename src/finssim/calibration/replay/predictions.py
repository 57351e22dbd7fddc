"""Short replays from measured states all along trials: what a model predicts some seconds ahead."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.replay.metrics import response_span
from finssim.calibration.replay.pairs import Pair, resampled
from finssim.calibration.replay.run import STEP
from finssim.calibration.simulation.rollout import Rollouts
from finssim.calibration.simulation.segments import Segment, segments, streams
from finssim.calibration.trials.columns import NU
from finssim.calibration.trials.trial import Array, Trial
from finssim.vehicles import Vehicle
from finssim.vehicles.vehicle import AXES, Axis

__all__ = ["Predictions", "replay_predictions"]

STAGGER = 4
"""Predictions start this many times per horizon."""


@dataclass(frozen=True)
class Predictions:
    """Predictions of one axis of several trials from many measured states, by one model."""

    ahead: Array
    """Times since each start [s], (T,)."""
    start: Array
    """Response in the state that each starts from, (S,)."""
    measured: Array
    """(T, S), NaN where not measured or outside excitation and coast."""
    simulated: dict[str, Array]
    """Model -> (T, S)."""
    width: Array
    """P95 - P5 of the trial that each belongs to, (S,)."""


def replay_predictions(
    trials: Sequence[Trial], pairs: Sequence[Pair], vehicle: Vehicle, models: Sequence[str], horizon: float
) -> dict[Axis, Predictions]:
    """Short replays that start from measured states all along the trials.

    Args:
        trials: Those of the pairs, in their order.
        pairs: Which axes and samples count.
        vehicle: The vehicle.
        models: Keys of its hydrodynamics.
        horizon: How far to look ahead [s].

    Returns:
        By axis; only where a prediction can be compared.
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
    out: dict[Axis, Predictions] = {}
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
        out[axis] = Predictions(
            ahead=ahead,
            start=np.array([cut[i].nu[k] for i in chosen]),
            measured=np.stack([_ahead(pairs[cut[i].index], cut[i], ahead, NU[k]) for i in chosen], axis=-1),
            simulated={m: _padded(r.nu[:, 0, chosen, k], steps + 1) for m, r in responses.items()},
            width=np.array([response_span(pairs[cut[i].index], NU[k]).value for i in chosen]),
        )
    return out


def _ahead(pair: Pair, segment: Segment, ahead: Array, response: str) -> Array:
    """What was measured at times after a segment's start, where it counts, (T,)."""
    since = ahead + segment.t0 - pair.t0
    values = resampled(pair.t, np.where(pair.scored(), pair.measured[response], np.nan), since)
    return np.where(ahead <= segment.duration + 1e-9, values, np.nan)


def _padded(values: NDArray[np.float32], rows: int) -> Array:
    """The first rows, NaN below the last, (rows, S)."""
    out = np.full((rows, values.shape[1]), np.nan)
    out[: len(values[:rows])] = values[:rows]
    return out
