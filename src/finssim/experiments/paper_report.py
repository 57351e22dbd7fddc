"""`finssim experiment all`: every table of the paper beside ours, in one report."""

from __future__ import annotations

import json
from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

from finssim.experiments import localization_experiment as localization
from finssim.experiments import replay_experiment as replay
from finssim.experiments import transfer
from finssim.experiments.campaign import Progress, ResultError
from finssim.experiments.tables import Table, html_of
from finssim.files import atomic_write
from finssim.page import html_page
from finssim.provenance import provenance
from finssim.yaml_file import read_json

LEAD = (
    "Rows in gray are the paper's own, measured on its real vehicle in its pool. All others are measured here: "
    "localization and replay by simulation, station keeping and tracking in a virtual pool whose vehicle, water and "
    "camera differ from everything that was trained or calibrated with. One is never passed for the other."
)
REPORT_FILE = "report.html"
SHARES = {"localization": 0.1, "replay": 0.1, "t1": 0.4, "t2": 0.4}
"""Experiment -> its part of the progress bar."""
ONCE = {
    "localization": (localization.RESULT_FILE, localization.localization_experiment),
    "replay": (replay.RESULT_FILE, replay.replay_experiment),
}
"""Experiments of the published vehicle that are not run again where their result is there."""
TABLES = {
    "localization": localization.tables_of,
    "replay": replay.tables_of,
    **dict.fromkeys(transfer.SPECS, transfer.tables_of),
}


def everything(*, out: Path, progress: Progress = lambda part, what: None, **options: Any) -> dict[str, Any]:
    """Run localization, replay, t1 and t2, and write one report with the paper's figures beside ours.

    Example: finssim experiment all --seeds 1 --plants 1 --out everything

    Args:
        out (DIR): Directory for JSON, Markdown, figures, policies and trials; one that was interrupted goes on.
        progress: Told the share that is done and what comes next.
        options: As of `experiments.transfer.transfer_experiment`, without rows, robot; localization and replay are of
            the published vehicle.

    Returns:
        Experiment -> what its JSON file holds, without single trials; `report`: its path.
    """
    results: dict[str, Any] = {}
    done, report = 0.0, Path(out) / REPORT_FILE
    for name, share in SHARES.items():
        folder = Path(out) / name

        def tell(part: float, what: str, name: str = name, done: float = done, share: float = share) -> None:
            progress(done + share * part, f"{name}: {what}")

        if name in ONCE:
            file, work = ONCE[name]
            if not (folder / file).is_file():
                work(
                    out=folder,
                    progress=tell,
                    **{key: options[key] for key in ("seeds", "seed") if key in options},
                )
            results[name] = read_json(folder / file, ResultError, such_as="provenance")
        else:
            result = transfer.transfer_experiment(transfer.SPECS[name], out=folder, progress=tell, **options)
            results[name] = {key: value for key, value in result.items() if key != "trials"}
        done += share
    sections = [
        "<h1>FinsSim beside the paper</h1>",
        f'<p class="lead">{escape(LEAD)}</p>',
        *(part for name in SHARES for part in html_of(TABLES[name](results[name]), report.parent / name)),
        "<h2>Provenance</h2>",
        f"<pre>{escape(json.dumps(provenance(), indent=2))}</pre>",
    ]
    with atomic_write(report) as temporary:
        temporary.write_text(html_page("FinsSim beside the paper", sections), encoding="utf-8")
    return {**results, "report": str(report)}


def tables_of(results: Mapping[str, Any]) -> list[Table]:
    """Those of T1 and T2, and the path of the report."""
    tables = [table for name in transfer.SPECS for table in transfer.tables_of(results[name])]
    return [*tables, Table(title="Report", headline=f"report: {results['report']}")]
