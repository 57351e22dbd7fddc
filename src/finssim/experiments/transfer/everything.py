"""`finssim experiment all`: every table of the paper beside ours, in one report."""

from __future__ import annotations

import json
from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

from rich.console import Console

from finssim.experiments.localization_experiment import localization_experiment
from finssim.experiments.localization_table import HEADS as LOCALIZATION_HEADS
from finssim.experiments.localization_table import RESULT_FILE as LOCALIZATION_FILE
from finssim.experiments.localization_table import rows_of as localization_rows
from finssim.experiments.replay_experiment import replay_experiment
from finssim.experiments.replay_table import RESULT_FILE as REPLAY_FILE
from finssim.experiments.replay_table import tables_of as replay_tables
from finssim.experiments.running import Say, run_experiment
from finssim.experiments.transfer.ablation import SPECS, ablation, ablation_tables
from finssim.experiments.transfer.table import html_of, print_shown
from finssim.files import atomic_write
from finssim.page import html_page, html_picture, html_table
from finssim.provenance import provenance

__all__ = ["everything", "run"]

REPORT_FILE = "report.html"

LEAD = (
    "Rows in gray are the paper's own, measured on its real vehicle in its pool. All others are measured here: "
    "localization and replay by simulation, station keeping and tracking in a virtual pool whose vehicle, water and "
    "camera differ from everything that was trained or calibrated with. One is never passed for the other."
)

FIGURES = {
    "Error map of localization": "localization/error_map.png",
    "Replay: measured and replayed responses": "replay/envelope.png",
    "Station keeping: error against time": "t1/t1_envelopes.png",
    "Trajectory tracking: paths from above": "t2/t2_paths.png",
}
"""Words -> picture in the folder; one that an experiment did not draw is left out."""


def run(
    *, out: Path, as_json: bool = False, console: Console | None = None, **options: Any
) -> dict[str, Any]:
    """Run everything with a progress bar, print the tables (or one JSON object) and write the directory.

    Arguments as `everything`; console is where the tables go, standard output if None.
    """

    def show(result: Mapping[str, Any], screen: Console) -> None:
        for name, spec in SPECS.items():
            print_shown(spec.shown(result[name]), screen)
        screen.print(f"report: {out / REPORT_FILE}", highlight=False, soft_wrap=True)

    return run_experiment(
        "experiment all",
        lambda say: everything(out=out, say=say, **options),
        show,
        out=out,
        as_json=as_json,
        console=console,
    )


def everything(
    *, out: Path, seeds: int = 3, seed: int = 1, say: Say = lambda part, what: None, **options: Any
) -> dict[str, Any]:
    """Run every experiment that has no result in `out` yet, and write the report.

    Args:
        out: Directory for `report.html` and a folder for each experiment.
        seeds: Of each.
        seed: The first.
        say: Told the share that is done and what comes next.
        options: As of `ablation`.

    Returns:
        Experiment -> what its JSON file holds, without single trials.
    """
    out = Path(out)
    found: dict[str, Any] = {
        "localization": _once(
            out / "localization" / LOCALIZATION_FILE,
            lambda: localization_experiment(
                renderer="own", seeds=seeds, out=out / "localization", seed=seed,
                progress=lambda part, what: say(0.1 * part, f"localization: {what}"),
            ),
        ),
        "replay": _once(
            out / "replay" / REPLAY_FILE,
            lambda: replay_experiment(
                seeds=seeds, out=out / "replay", seed=seed,
                progress=lambda part, what: say(0.1 + 0.1 * part, f"replay: {what}"),
            ),
        ),
    }  # fmt: skip
    found |= ablation(
        out=out, seeds=seeds, seed=seed, say=lambda part, what: say(0.2 + 0.8 * part, what), **options
    )
    with atomic_write(out / REPORT_FILE) as temporary:
        temporary.write_text(_report(found, out), encoding="utf-8")
    return found


def _once(file: Path, work: Any) -> dict[str, Any]:
    """What a file holds; where it is not there yet, the work is done that writes it."""
    if not file.is_file():
        work()
    result: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    return result


def _report(found: Mapping[str, Any], out: Path) -> str:
    plain = {
        f"Localization. {words}": (LOCALIZATION_HEADS, rows)
        for words, rows in localization_rows(found["localization"]).items()
    } | {f"Replay. {words}": table for words, table in replay_tables(found["replay"]).items()}
    sections = ["<h1>FinsSim beside the paper</h1>", f'<p class="lead">{escape(LEAD)}</p>']
    for words, (heads, rows) in plain.items():
        theirs = ' class="theirs"' if "the paper" in words else ""
        lines = [f"<tr{theirs}>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows]
        sections += [f"<h2>{escape(words)}</h2>", html_table(heads, lines)]
    sections += [html_of(spec.shown(found[name])) for name, spec in SPECS.items()]
    sections += [html_of(shown) for shown in ablation_tables({name: found[name] for name in SPECS})]
    for words, name in FIGURES.items():
        if (out / name).is_file():
            sections += [f"<h2>{escape(words)}</h2>", html_picture((out / name).read_bytes(), words)]
    sections += ["<h2>Provenance</h2>", f"<pre>{escape(json.dumps(provenance(), indent=2))}</pre>"]
    return html_page("FinsSim beside the paper", sections)
