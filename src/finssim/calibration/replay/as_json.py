"""A replay as plain values."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from finssim.calibration.replay.gates import classify, coupling, gates
from finssim.calibration.replay.metrics import RESAMPLES, Aggregate, phase_score, score
from finssim.calibration.replay.pairs import Pair
from finssim.calibration.replay.replay import Replay
from finssim.provenance import provenance

__all__ = ["DEFINITION", "replay_json"]

DEFINITION = (
    "nrmse: RMSE / (P95 - P5 of the measured response), both over excitation and coast of a trial; phases use the "
    "same span. Measured velocities and angles are smoothed as for a fit; nrmse_unsmoothed counts their noise too. "
    "aggregate: median over the trials of an axis, then the mean of the axes; aggregate_mean: mean over the trials "
    "instead. ci95: trial bootstrap. Held-out trials count where there are any; in_sample says that there are none."
)

PHASES = ("excitation", "coast")


def replay_json(replay: Replay) -> dict[str, Any]:
    """What `finssim replay --json` prints and `replay.json` holds.

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
        "left_out": [one.as_json() for one in replay.left_out],
        "bootstrap": {"resamples": RESAMPLES, "seed": replay.seed, "unit": "trial"},
        "provenance": provenance(),
    }


def _model(replay: Replay, model: str) -> dict[str, Any]:
    main = replay.aggregate(model)
    mean = replay.aggregate(model, statistic=np.nanmean)
    axes = list(dict.fromkeys(axis for pair in replay.pairs for axis in pair.axes))
    rows = list(zip(replay.pairs, replay.scores[model], strict=True))
    return {
        "nrmse": {a: {p.name: s[a].value for p, s in rows if a in s} for a in axes},
        "nrmse_by_axis": {a: main.by_axis.get(a) for a in axes},
        "aggregate": main.value,
        "ci95": main.ci95,
        "aggregate_mean": mean.value,
        "ci95_mean": mean.ci95,
        "why": main.why,
        "held_out": _aggregate(replay.aggregate(model, in_sample=False)),
        "in_sample_only": _aggregate(replay.aggregate(model, in_sample=True)),
        "ahead": {axis: _ahead(by_model[model]) for axis, by_model in replay.ahead.items()},
    }


def _aggregate(a: Aggregate) -> dict[str, Any] | None:
    if not a.trials:
        return None
    return {"aggregate": a.value, "ci95": a.ci95, "by_axis": a.by_axis, "trials": a.trials, "why": a.why}


def _ahead(a: Any) -> dict[str, Any]:
    return {
        "seconds": a.seconds.tolist(),
        "rmse": _plain(a.rmse),
        "nrmse": _plain(a.nrmse),
        "persistence_rmse": _plain(a.persistence),
        "skill": _plain(a.skill),
        "predictions": a.count.tolist(),
    }


def _plain(x: Any) -> list[float | None]:
    return [float(v) if math.isfinite(v) else None for v in x]


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
        "findings": [one.as_json() for one in pair.findings],
        "models": {
            model: {
                "nrmse": {a: s.value for a, s in replay.scores[model][i].items()},
                "nrmse_unsmoothed": {
                    a: score(pair, model, pair.response(a), raw=True).value for a in pair.axes
                },
                "late_s": pair.late.get(model, 0.0),
                "why": {a: s.why for a, s in replay.scores[model][i].items() if s.why},
                "phases": {
                    a: {p: phase_score(pair, model, pair.response(a), p).value for p in PHASES}
                    for a in pair.axes
                },
                "other_responses": _others(pair, model, others),
                **_gates(pair, model),
            }
            for model in replay.models
        },
    }


def _others(pair: Pair, model: str, responses: list[str]) -> dict[str, float]:
    """NRMSE of what was measured besides the excited axes, where it is more than noise."""
    found = {r: score(pair, model, r).value for r in responses}
    return {r: value for r, value in found.items() if value is not None}


def _gates(pair: Pair, model: str) -> dict[str, Any]:
    checked = {axis: gates(pair, model, axis) for axis in pair.axes}
    return {
        "gates": {
            axis: {
                name: {"value": g.value, "limit": g.limit, "passed": g.passed, "why": g.why}
                for name, g in found.items()
            }
            for axis, found in checked.items()
        },
        "class": {axis: classify(found) for axis, found in checked.items()},
        "coupling": {
            axis: {
                "measured": coupling(pair, pair.measured, axis),
                "simulated": coupling(pair, pair.simulated[model], axis),
            }
            for axis in pair.axes
        },
    }
