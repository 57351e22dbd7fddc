"""`finssim experiment ablation` and `all`: what each module is worth, and every table of the paper beside ours."""

from __future__ import annotations

import json
from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

from finssim.experiments import localization_experiment as localization
from finssim.experiments import replay_experiment as replay
from finssim.experiments.campaign import ResultError, Say, write_json
from finssim.experiments.tables import Table, figure_text, html_of
from finssim.experiments.transfer import MEASURES, SPECS, played_in, transfer_experiment
from finssim.files import atomic_write
from finssim.page import html_page
from finssim.provenance import provenance
from finssim.yaml_file import read_json

__all__ = ["ablation", "everything", "tables_of"]

NOTE = (
    "Each figure is the mean of row less reference, over pairs of trials with the same pool, seed and target; in "
    "brackets 95 % from a bootstrap of plants and seeds. paper: the difference of its rows, on hardware, single runs."
)
LEAD = (
    "Rows in gray are the paper's own, measured on its real vehicle in its pool. All others are measured here: "
    "localization and replay by simulation, station keeping and tracking in a virtual pool whose vehicle, water and "
    "camera differ from everything that was trained or calibrated with. One is never passed for the other."
)
REPORT_FILE = "report.html"


def ablation(*, out: Path, say: Say = lambda part, what: None, **options: Any) -> dict[str, Any]:
    """What each module is worth: differences of paired trials with intervals, and a sentence that they support.

    Example: finssim experiment ablation --seeds 3 --out ablation

    Args:
        out (DIR): Directory for JSON, Markdown, figures, policies and trials; one that was interrupted goes on.
        say: Told the share that is done and what comes next.
        options: As of `experiments.transfer.transfer_experiment`, without rows, robot.

    Returns:
        Experiment -> its result, without the single trials.
    """
    results = {}
    for k, (name, spec) in enumerate(SPECS.items()):
        result = transfer_experiment(
            spec,
            out=Path(out) / name,
            say=lambda part, what, k=k, name=name: say((k + part) / len(SPECS), f"{name}: {what}"),
            **options,
        )
        results[name] = {key: value for key, value in result.items() if key != "trials"}
    write_json(Path(out) / "ablation.json", results, tables_of(results))
    return results


def tables_of(results: Mapping[str, Any]) -> list[Table]:
    """One table of differences for each experiment; those of all of them, with the path of the report, if there is."""
    if "report" in results:
        return [
            *(SPECS[name].table(results[name]) for name in SPECS),
            Table(title="Report", headline=f"report: {results['report']}"),
        ]
    tables = []
    for name in SPECS.keys() & results.keys():
        spec, result, rows = SPECS[name], results[name], []
        units = {key: MEASURES[key] for key in spec.differences}
        for row_name, differences in result["differences"].items():
            row = spec.rows[row_name]
            texts = (figure_text(differences[key], f"+{u[4]}", u[2]) for key, u in units.items())
            rows.append([row.title, *texts])
            theirs = spec.paper_differences(row)
            if theirs is not None:
                rows.append(["  paper", *(f"{u[2] * theirs[key]:+{u[4]}}" for key, u in units.items())])
        tables.append(
            Table(
                title=f"Ablation, {name.upper()}: differences from {spec.rows[spec.base].title}",
                headline=f"{name.upper()} {played_in(result, 'targets')}",
                heads=["", *(heading for _, heading, *_ in units.values())],
                rows=rows,
                note=NOTE,
                sentences=result["sentences"],
            )
        )
    return tables


def everything(*, out: Path, say: Say = lambda part, what: None, **options: Any) -> dict[str, Any]:
    """Run localization, replay, t1, t2 and ablation, and write one report with the paper's figures beside ours.

    Example: finssim experiment all --seeds 1 --plants 1 --out everything

    Args:
        out (DIR): Directory for JSON, Markdown, figures, policies and trials; one that was interrupted goes on.
        say: Told the share that is done and what comes next.
        options: As of `experiments.ablation.ablation`; localization and replay are of the published vehicle.

    Returns:
        Experiment -> what its JSON file holds, without single trials; `report`: its path.
    """
    results: dict[str, Any] = {}
    same = {name: options[name] for name in ("seeds", "seed") if name in options}
    for k, (name, module, work) in enumerate(
        (
            ("localization", localization, localization.localization_experiment),
            ("replay", replay, replay.replay_experiment),
        )
    ):
        file = Path(out) / name / module.RESULT_FILE
        if not file.is_file():
            tell: Say = lambda part, what, k=k, name=name: say(0.1 * (k + part), f"{name}: {what}")  # noqa: E731
            work(out=file.parent, say=tell, **same)
        results[name] = read_json(file, ResultError, such_as="provenance")
    ablated = ablation(out=out, say=lambda part, what: say(0.2 + 0.8 * part, what), **options)
    report = Path(out) / REPORT_FILE
    sections = [
        "<h1>FinsSim beside the paper</h1>",
        f'<p class="lead">{escape(LEAD)}</p>',
        *html_of(localization.tables_of(results["localization"]), report.parent / "localization"),
        *html_of(replay.tables_of(results["replay"]), report.parent / "replay"),
        *(
            part
            for name in SPECS
            for part in html_of([SPECS[name].table(ablated[name])], report.parent / name)
        ),
        *html_of(tables_of(ablated), report.parent),
        "<h2>Provenance</h2>",
        f"<pre>{escape(json.dumps(provenance(), indent=2))}</pre>",
    ]
    with atomic_write(report) as temporary:
        temporary.write_text(html_page("FinsSim beside the paper", sections), encoding="utf-8")
    return {**results, **ablated, "report": str(report)}
