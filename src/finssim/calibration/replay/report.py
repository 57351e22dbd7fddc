"""A replay as a person reads it: tables on the terminal and in Markdown, and the folder of `--out`."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from finssim.calibration.findings import Finding, finding, sentences
from finssim.calibration.replay.figure import MODEL_LABELS, draw_ahead, draw_overlay, draw_response_envelopes
from finssim.calibration.replay.gates import classify, coupling, gates
from finssim.calibration.replay.metrics import RESAMPLES, Aggregate, phase_score, score
from finssim.calibration.replay.pairs import Pair
from finssim.calibration.replay.replay import Replay
from finssim.files import atomic_directory
from finssim.provenance import provenance
from finssim.vehicles.vehicle import AXES

__all__ = ["REPLAY_FILE", "print_replay", "replay_markdown", "write_replay", "DEFINITION", "replay_json"]

# A replay as plain values.

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


REPLAY_FILE = "replay.json"

Rows = list[list[str]]


def print_replay(replay: Replay, console: Console) -> None:
    """Print NRMSE by axis and model, the trials, and what could not be scored."""
    console.print(_headline(replay), highlight=False)
    _print_table(console, *_axis_table(replay))
    if replay.ahead:
        console.print(
            "error ahead, relative to the span; in brackets the skill against persistence", highlight=False
        )
        _print_table(console, *_ahead_table(replay))
    console.print(f"NRMSE of {_label(replay.models[0])} by trial", highlight=False)
    _print_table(console, *_trial_table(replay))
    for sentence in _remarks(replay):
        console.print(sentence, highlight=False, markup=False)


def replay_markdown(replay: Replay) -> str:
    """`replay.md`."""
    parts = [f"# Replay of {replay.vehicle.name}", _headline(replay), _markdown(*_axis_table(replay))]
    if any(p.axes for p in replay.pairs):
        parts.append("![Response envelopes](envelope.png)")
    if replay.ahead:
        parts += ["## Error ahead", "Relative to the span; in brackets the skill against persistence."]
        parts += [_markdown(*_ahead_table(replay)), "![Error ahead](ahead.png)"]
    parts += [f"## Trials with {_label(replay.models[0])}", _markdown(*_trial_table(replay))]
    parts += ["\n".join(f"- {sentence}" for sentence in _remarks(replay)), DEFINITION]
    parts.append(f"Vehicle {replay.vehicle.sha256}.")
    return "\n\n".join(part for part in parts if part) + "\n"


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
        if replay.ahead:
            draw_ahead(replay.ahead).savefig(folder / "ahead.png", dpi=200)
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
    """NRMSE by axis, a column for each model; held-out and in-sample apart."""
    kinds = [k for k in (False, True) if any(p.in_sample == k for p in replay.pairs)]
    rows: Rows = []
    for kind in kinds:
        found = {m: replay.aggregate(m, in_sample=kind) for m in replay.models}
        mark = " in-sample" if kind else ""
        for axis in AXES:
            count = sum(axis in p.axes and p.in_sample == kind for p in replay.pairs)
            if count:
                values = [_number(found[m].by_axis.get(axis)) for m in replay.models]
                rows.append([axis, f"{count}{mark}", *values])
        count = sum(p.in_sample == kind for p in replay.pairs)
        rows.append(["aggregate", f"{count}{mark}", *(_number(found[m].value) for m in replay.models)])
        rows.append(["95 % interval", "", *(_interval(found[m]) for m in replay.models)])
    return ["NRMSE", "trials", *(_label(m) for m in replay.models)], rows


def _trial_table(replay: Replay) -> tuple[list[str], Rows]:
    """Every trial with the first model."""
    model = replay.models[0]
    rows: Rows = []
    for pair, scores in zip(replay.pairs, replay.scores[model], strict=True):
        for axis, one in scores.items():
            phases = [
                _number(phase_score(pair, model, pair.response(axis), p).value)
                for p in ("excitation", "coast")
            ]
            verdict = classify(gates(pair, model, axis))
            kind = "in-sample" if pair.in_sample else "held-out"
            rows.append([pair.name, axis, kind, _number(one.value), *phases, verdict])
    return ["trial", "axis", "", "NRMSE", "excitation", "coast", "gates"], rows


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
    """What could not be scored or replayed, what was derived, and why there is no interval; equal ones together."""
    found: list[Finding] = [*replay.left_out]
    for model in replay.models:
        why = replay.aggregate(model).why
        found += [finding("no_interval", _label(model), reason=why)] if why else []
    for pair, scores in zip(replay.pairs, replay.scores[replay.models[0]], strict=True):
        for axis, one in scores.items():
            if one.why:
                found.append(finding("not_scored", pair.name, axis=str(axis), reason=one.why))
            source = pair.source.get(pair.response(axis), "")
            if source not in ("", "measured"):
                found.append(finding("velocity_derived", pair.name, axis=str(axis), source=source))
        if not scores:
            found.append(finding("no_axis", pair.name))
        for model, late in pair.late.items():
            sense = "lags" if late > 0.0 else "leads"
            found.append(finding("clocks_apart", pair.name, model=_label(model), sense=sense, late=abs(late)))
    return sentences(found)


def _label(model: str) -> str:
    return MODEL_LABELS.get(model, model)


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.3f}"


def _interval(a: Aggregate) -> str:
    return "–" if a.ci95 is None else f"[{a.ci95[0]:.3f}, {a.ci95[1]:.3f}]"


def _print_table(console: Console, heads: Sequence[str], rows: Rows) -> None:
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for k, head in enumerate(heads):
        table.add_column(Text(head), justify="left" if k == 0 else "right", no_wrap=k == 0)
    for row in rows:
        table.add_row(*row, style="bold" if row[0].startswith("aggregate") else None)
    console.print(table)


def _markdown(heads: Sequence[str], rows: Rows) -> str:
    lines = [heads, ["---"] + ["--:"] * (len(heads) - 1), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
