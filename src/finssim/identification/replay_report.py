"""Output of a replay: figures, tables, plain values, and the folder of `--out`."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from finssim.core.files import atomic_directory
from finssim.core.page import notebook_html
from finssim.core.palette import BLUE, GREEN, ORANGE, PINK, SKY, VERMILION
from finssim.core.provenance import provenance
from finssim.identification.replay_metrics import (
    RESAMPLES,
    UNITS,
    Aggregate,
    Pair,
    aggregate,
    models_of,
    onset,
    response_span,
    score,
)
from finssim.identification.report import new_figure
from finssim.trials.findings import Finding, finding, plain, sentences
from finssim.trials.trial import Array
from finssim.vehicles.vehicle import AXES, Axis

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from finssim.identification.prediction import Replay

MODEL_LABELS = {"calibrated": "Calibrated Fossen", "mesh": "Physics-mesh", "simplified": "Simplified Fossen"}
COLORS = {"calibrated": BLUE, "mesh": GREEN, "simplified": VERMILION}
OTHERS = (PINK, SKY, ORANGE)
BLACK = "#1a1a1a"
STYLES = {"calibrated": (0, ()), "mesh": (0, (6, 1.6)), "simplified": (0, (1.6, 1.2))}
"""Line styles, for print without colours."""

BEFORE = 0.5
"""Time shown before the onset [s]."""
SYMBOLS = {"roll": "roll", "pitch": "pitch", "depth": "depth"} | {name: f"${name}$" for name in "uvwpqr"}


def normalised(pair: Pair, values: Array, axis: Axis) -> tuple[Array, Array] | None:
    """Return a response over the time since the onset, sign-aligned and relative to the measured P5-P95 span.

    Signs are those of the input, or of the response itself if there is no input.

    Args:
        pair: The trial.
        values: Measured or simulated response of the axis in its unit, (n,).
        axis: The axis.

    Returns:
        Times since the onset of the input [s] and values [-], (n,) each; None if the trial lacks the
        response. A passive trial starts at its first scored sample.
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
    """Draw axis-wise envelopes: a panel for each axis, with pointwise median and interquartile range over its trials.

    Held-out trials are drawn if there are any; otherwise those that the vehicle was fitted on, which the
    figure states.

    Args:
        pairs: Trials with their replays.

    Raises:
        ValueError: No trial has a response that can be drawn.
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
    """Draw one trial: the input if any, the responses of the excited axes, and measured attitude and depth."""
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
    """Return a figure of a size [inch] with `count` visible axes in a grid, (rows, columns)."""
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
    """Return times since the onset that three quarters of the trials cover [s], so that the end of a trial
    causes no step."""
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
    """Draw median and interquartile range where at least half of the trials have a value."""
    enough = np.isfinite(values).mean(axis=0) >= 0.5
    quartiles = np.full((3, len(grid)), np.nan)
    if enough.any():
        quartiles[:, enough] = np.nanquantile(values[:, enough], (0.25, 0.5, 0.75), axis=0)
    low, median, high = quartiles
    axes.fill_between(grid, low, high, color=color, alpha=0.18, linewidth=0.0, zorder=zorder - 1.0)
    axes.plot(grid, median, color=color, linewidth=width, linestyle=style, label=label, zorder=zorder)


def _broken(pair: Pair, values: Array) -> Array:
    """Return values with a gap in the line wherever a new replay starts."""
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


DEFINITION = (
    "nrmse: RMSE / (P95 - P5 of the measured response), both over excitation and coast of a trial; phases use the "
    "same span. Measured velocities and angles are smoothed as for a fit. aggregate: median over the trials of an "
    "axis, then the mean of the axes. ci95: trial bootstrap. Held-out trials count if there are any; in_sample "
    "states that there are none."
)

PHASES = ("excitation", "coast")


def replay_json(replay: Replay) -> dict[str, Any]:
    """Return the content of `finssim replay --json` and `replay.json`.

    The numbers at the top are those of the first model; `models` contains those of all. Missing numbers are
    null, and `why` states the reason.
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
    """Print NRMSE by axis and model, the trials, and the reasons for missing scores."""
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
    """Return the content of `replay.md`."""
    parts = [f"# Replay of {replay.vehicle.name}", _headline(replay)]
    for title, heads, rows in _tables(replay):
        lines = [heads, ["---"] + ["--:"] * (len(heads) - 1), *rows]
        parts += [f"## {title}" if title else "", "\n".join("| " + " | ".join(line) + " |" for line in lines)]
    if any(p.axes for p in replay.pairs):
        parts.append("![Response envelopes](envelope.png)")
    parts += ["\n".join(f"- {sentence}" for sentence in _remarks(replay)), DEFINITION]
    parts.append(f"Vehicle {replay.vehicle.sha256}.")
    return "\n\n".join(part for part in parts if part) + "\n"


def replay_html(replay: Replay) -> str:
    """Return the tables as a notebook displays them."""
    (_, *first), *others = _tables(replay)
    tables = [(_headline(replay), *first), *others]
    return "".join(notebook_html(title, heads, rows) for title, heads, rows in tables)


def _tables(replay: Replay) -> list[tuple[str, list[str], Rows]]:
    """Return title, heads and rows of each table."""
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
            pass  # nothing was measured on an excited axis; the tables state it
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
    """Return NRMSE by axis, with a column for each model, and separate held-out and in-sample trials."""
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
    """Return every trial with the scores of the first model."""
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
    """Return remarks: missing scores or replays, derived velocities, and missing intervals; equal ones are
    combined."""
    findings: list[Finding] = [*replay.left_out]
    records = [one.settings for one in replay.vehicle.calibrations if "speeds" in one.settings]
    fitted = dict(records[-1]["speeds"]) if records else {}
    for model in replay.models:
        reason = replay.aggregate(model).why
        findings += [finding("no_interval", _label(model), reason=reason)] if reason else []
    for pair, scores in zip(replay.pairs, replay.scores[replay.models[0]], strict=True):
        for axis, one in scores.items():
            if one.why:
                findings.append(finding("not_scored", pair.name, axis=str(axis), reason=one.why))
            source = pair.source.get(pair.response(axis), "")
            if source not in ("", "measured"):
                findings.append(finding("velocity_derived", pair.name, axis=str(axis), source=source))
            top = np.nanpercentile(np.abs(pair.measured.get(pair.response(axis), np.zeros(1))), 99.0)
            if 0.0 < BEYOND * fitted.get(axis, 0.0) < top:
                fields = {"top": float(top), "fitted": fitted[axis], "unit": UNITS[pair.response(axis)]}
                findings.append(finding("extrapolates", pair.name, axis=axis, **fields))
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
