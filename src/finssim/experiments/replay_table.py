"""The replay experiment as a person reads it: its table beside the paper's, and its folder."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from finssim.calibration.output.vehicle_file import write_vehicle
from finssim.calibration.replay.as_json import DEFINITION
from finssim.calibration.replay.figure import MODEL_LABELS, draw_response_envelopes
from finssim.calibration.replay.pairs import Pair
from finssim.files import atomic_directory
from finssim.vehicles import Vehicle

__all__ = ["RESULT_FILE", "markdown", "print_table", "tables_of", "write_results"]

RESULT_FILE = "replay_experiment.json"

NOTE = (
    "ours: held-out trials of a virtual plant outside all three model classes. paper: Unity replaying trials of the "
    "real FinsROV in its pool. These are different experiments and stand side by side for orientation."
)
LEVELS = {
    "same_levels": "held-out repeats of the fitted levels",
    "other_levels": "the validation sweeps, levels that no fit has seen",
}


def tables_of(result: Mapping[str, Any]) -> dict[str, tuple[list[str], list[list[str]]]]:
    """Words about a table -> its head and rows: ours by set of levels, then the paper's."""
    axes = list(next(iter(result["same_levels"]["models"].values()))["by_axis"])
    out = {}
    for key, words in LEVELS.items():
        rows = []
        for model, m in result[key]["models"].items():
            values = [f"{m['by_axis'][a]:.3f}" if a in m["by_axis"] else "–" for a in axes]
            rows.append([f"ours, {MODEL_LABELS[model]}", f"{m['aggregate']:.3f}", _range(m["ci95"]), *values])
        out[words] = (["", "NRMSE", "95 % interval", *axes], rows)
    theirs = [
        [f"paper, {MODEL_LABELS[model]}", f"{p['aggregate']:.3f}", _range(p["ci95"])]
        for model, p in result["paper"].items()
    ]
    return {**out, "the paper: its vehicle in its pool": (["", "NRMSE", "95 % interval"], theirs)}


def print_table(result: Mapping[str, Any], console: Console) -> None:
    """Print it."""
    console.print(_headline(result), highlight=False)
    for words, (heads, rows) in tables_of(result).items():
        table = Table(
            box=box.SIMPLE_HEAD,
            padding=(0, 1, 0, 0),
            pad_edge=False,
            title=words,
            title_justify="left",
            title_style="bold",
        )
        for k, head in enumerate(heads):
            table.add_column(
                Text(head), justify="right" if k else "left", no_wrap=True, min_width=0 if k else 24
            )
        for row in rows:
            table.add_row(*row, style="dim" if row[0].startswith("paper") else None)
        console.print(table)
    console.print(NOTE, highlight=False)


def markdown(result: Mapping[str, Any]) -> str:
    """`replay_experiment.md`."""
    parts = ["# Replay error of three hydrodynamic models", _headline(result)]
    for words, (heads, rows) in tables_of(result).items():
        lines = [heads, ["---"] + ["--:"] * (len(heads) - 1), *rows]
        table = "\n".join("| " + " | ".join(line) + " |" for line in lines)
        parts += [f"## {words[0].upper()}{words[1:]}", table]
    hashes = ", ".join(fit["vehicle_sha256"][:12] for fit in result["fits"])
    origin = result["provenance"]
    about = (
        f"Vehicle file {result['vehicle']['name']} {result['vehicle']['sha256'][:12]}; calibrated vehicles {hashes}; "
        f"seeds {', '.join(map(str, result['seeds']))}; FinsSim {origin['finssim']}, revision {origin['revision']}."
    )
    parts += [NOTE, "![Response envelopes](envelope.png)", DEFINITION, about]
    return "\n\n".join(parts) + "\n"


def write_results(
    result: Mapping[str, Any], out: Path, pairs: Sequence[Pair], vehicles: Sequence[Vehicle]
) -> None:
    """Write the folder; an earlier experiment there is replaced.

    Args:
        result: What `replay_experiment` returns.
        out: The directory.
        pairs: Held-out trials with their replays, for the figure.
        vehicles: Calibrated, one for each seed.

    Raises:
        OutputError: The directory cannot be written.
    """
    with atomic_directory(out, replaces=RESULT_FILE) as folder:
        text = json.dumps(result, indent=2, allow_nan=False) + "\n"
        (folder / RESULT_FILE).write_text(text, encoding="utf-8")
        (folder / "replay_experiment.md").write_text(markdown(result), encoding="utf-8")
        draw_response_envelopes(pairs).savefig(folder / "envelope.png", dpi=200)
        (folder / "vehicles").mkdir()
        for seed, vehicle in zip(result["seeds"], vehicles, strict=True):
            write_vehicle(vehicle, folder / "vehicles" / f"seed_{seed}.yaml")


def _headline(result: Mapping[str, Any]) -> str:
    counts = result["trials_per_seed"]
    seeds = len(result["seeds"])
    note = f" (interrupted: {result['seeds_asked_for']} were asked for)" if result["interrupted"] else ""
    who = f"{result['vehicle']['name']}, {seeds} seed{'s' if seeds != 1 else ''}{note}"
    return (
        f"{who}: fitted on {counts['fitted']} trials each, replayed on {counts['same_levels']} others of the same "
        f"levels and {counts['other_levels']} of other levels"
    )


def _range(ci95: Sequence[float]) -> str:
    return f"[{ci95[0]:.3f}, {ci95[1]:.3f}]"
