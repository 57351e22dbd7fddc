"""Replay: how well do hydrodynamic models reproduce recorded trials, above all trials they were not fitted on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from finssim.calibration.errors import CalibrationError
from finssim.calibration.replay.metrics import SEED, Aggregate, Ahead, Score, aggregate, error_ahead, score
from finssim.calibration.replay.pairs import Pair
from finssim.calibration.replay.predictions import replay_predictions
from finssim.calibration.replay.run import check_models, replay_pairs
from finssim.calibration.trials.trial import Array, Trial
from finssim.files import atomic_directory, refuse_unwritable
from finssim.quiet import start_warp
from finssim.vehicles import Vehicle, load_vehicle
from finssim.vehicles.vehicle import Axis

if TYPE_CHECKING:
    from rich.console import Console

__all__ = ["Replay", "replay", "run_replay"]

LONGEST_HORIZON = 60.0
"""[s]"""


@dataclass(frozen=True, kw_only=True)
class Replay:
    """Trials replayed with one model or several."""

    vehicle: Vehicle
    models: tuple[str, ...]
    """The first is the one that single numbers are of."""
    pairs: tuple[Pair, ...]
    """Trials beside their replays."""
    left_out: tuple[str, ...] = ()
    """A sentence for each trial that could not be replayed."""
    horizon: float | None = None
    """How far predictions from measured states looked ahead [s]; None for none."""
    ahead: dict[Axis, dict[str, Ahead]] = field(default_factory=dict)
    """Axis -> model -> error of those predictions."""
    seed: int = SEED
    """Of the bootstrap."""

    @cached_property
    def scores(self) -> dict[str, tuple[dict[Axis, Score], ...]]:
        """Model -> for each trial, excited axis -> NRMSE over excitation and coast."""
        return {
            model: tuple({axis: score(p, model, p.response(axis)) for axis in p.axes} for p in self.pairs)
            for model in self.models
        }

    @property
    def in_sample(self) -> bool:
        """Whether there is no held-out trial: then all numbers rest on trials that the vehicle was fitted on."""
        return bool(self.pairs) and all(pair.in_sample for pair in self.pairs)

    def aggregate(
        self,
        model: str,
        *,
        in_sample: bool | None = None,
        statistic: Callable[..., Array] = np.nanmedian,
    ) -> Aggregate:
        """Equal-weight mean over the axes of the median (or mean) over trials, with its bootstrap interval.

        Args:
            model: One of `models`.
            in_sample: Of the in-sample or the held-out trials; the held-out ones where there are any if None.
            statistic: `np.nanmedian` or `np.nanmean`, over the trials of an axis.
        """
        wanted = self.in_sample if in_sample is None else in_sample
        chosen = [
            (p, s) for p, s in zip(self.pairs, self.scores[model], strict=True) if p.in_sample == wanted
        ]
        broken = [p.name for p, _ in chosen if model in p.diverged]
        if broken:
            return Aggregate(
                None, None, {}, len(chosen), f"the simulation of {broken[0]} does not stay finite"
            )
        rows = [{axis: one.value for axis, one in scores.items()} for _, scores in chosen]
        return aggregate(rows, statistic, seed=self.seed)

    def as_json(self) -> dict[str, Any]:
        """What `--json` prints."""
        from finssim.calibration.replay.as_json import replay_json

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
    if horizon is not None and not 0.0 < horizon <= LONGEST_HORIZON:
        raise CalibrationError(
            f"horizon is {horizon:g} s, expected above 0 and at most {LONGEST_HORIZON:g} s"
        )
    if not trials:
        raise CalibrationError("no trial to replay: give at least one")
    if out is not None:
        from finssim.calibration.replay.report import REPLAY_FILE

        refuse_unwritable(atomic_directory(out, replaces=REPLAY_FILE))
    pairs, left_out = replay_pairs(trials, vehicle, models, progress)
    if not pairs:
        raise CalibrationError(f"no trial could be replayed: {left_out[0]}")
    ahead: dict[Axis, dict[str, Ahead]] = {}
    if horizon is not None:
        named = {trial.name: trial for trial in trials}
        predictions = replay_predictions([named[p.name] for p in pairs], pairs, vehicle, models, horizon)
        seconds = _seconds(horizon)
        for axis, p in predictions.items():
            ahead[axis] = {
                m: error_ahead(p.start, p.ahead, p.measured, x, p.width, seconds)
                for m, x in p.simulated.items()
            }
    result = Replay(
        vehicle=vehicle,
        models=models,
        pairs=tuple(pairs),
        left_out=tuple(left_out),
        horizon=horizon,
        ahead=ahead,
        seed=seed,
    )
    if out is not None:
        from finssim.calibration.replay.report import write_replay

        write_replay(result, out)
    return result


def _seconds(horizon: float) -> Array:
    """1, 2, ... s up to the horizon; quarters of it where it is below 2 s."""
    whole = np.arange(1.0, np.floor(horizon + 1e-9) + 1.0)
    if len(whole) < 2:
        return np.asarray(horizon * np.arange(1, 5) / 4.0)
    return whole if abs(whole[-1] - horizon) < 1e-6 else np.append(whole, horizon)


def run_replay(
    paths: Sequence[str | Path],
    *,
    vehicle: str | Path | Vehicle,
    hydrodynamics: str | Sequence[str] = "calibrated",
    horizon: float | None = None,
    out: Path | None = None,
    as_json: bool = False,
    seed: int = SEED,
    console: Console | None = None,
) -> Replay:
    """`finssim replay`: read trials and vehicle, replay, print a table (or one JSON object) and write the folder.

    Args:
        paths: Trials, or folders of trials.
        vehicle: A vehicle, a catalogue name or a file.
        hydrodynamics: As for `replay`.
        horizon: As for `replay` [s].
        out: As for `replay`.
        as_json: Print one JSON object in place of the tables.
        seed: Of the bootstrap.
        console: Where the tables go; standard output if None.

    Raises:
        CalibrationError, VehicleError, OutputError: As they say.
    """
    import json

    from rich.console import Console

    from finssim.calibration.replay.report import print_replay
    from finssim.calibration.trials.trial_files import load_trials

    body = vehicle if isinstance(vehicle, Vehicle) else load_vehicle(vehicle)
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
