"""`finssim sweep`: trainings over settings and seeds, one table of what came of them."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from finssim.experiments.sweep.cluster import running, spread
from finssim.experiments.sweep.plan import Job, load_sweep
from finssim.experiments.sweep.table import print_sweep, table_of
from finssim.experiments.sweep.worker import unpack
from finssim.files import atomic_directory, atomic_write
from finssim.provenance import provenance

__all__ = ["sweep"]

RESULT_FILE = "sweep.json"
ROW_FILE = "sweep-row.json"


def sweep(
    file: Path,
    *,
    out: Path,
    address: str | None = None,
    processes: int | None = None,
    as_json: bool = False,
    console: Console | None = None,
) -> dict[str, Any]:
    """Train and evaluate every setting with every seed; what is in the directory already is not done again.

    Args:
        file: What to do (`finssim.experiments.sweep.plan.Sweep`).
        out: Directory: `runs/` with a policy directory for each job, `sweep.json`, `sweep.md`.
        address: Of a Ray cluster; this machine alone if None.
        processes: Jobs at once on this machine; as many as processors if None.
        as_json: Print one JSON object in place of the table.
        console: Where the table goes; standard output if None.

    Returns:
        What `sweep.json` has: `rows` (name, seed, run, training_s, machine, plants; or `error`), `ok`, provenance.

    Raises:
        SweepError: The file says what cannot be, or there is no Ray.
        KeyboardInterrupt: After Ctrl-C; what was finished stays.
    """
    jobs = load_sweep(file).jobs()
    runs = out / "runs"
    rows = {job.key: _finished(job, runs) for job in jobs}
    missing = [job for job in jobs if rows[job.key] is None]
    began = time.perf_counter()
    screen = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    if missing:
        with (
            running(address, processes) as at_once,
            Progress(*columns, console=screen, disable=not screen.is_terminal) as bar,
        ):
            task = bar.add_task(
                f"sweep, {at_once} at once", total=len(jobs), completed=len(jobs) - len(missing)
            )

            def done(job: Job, row: dict[str, Any] | None, content: bytes, error: str) -> None:
                rows[job.key] = _keep(job, row, content, error, runs)
                bar.advance(task)
                if not screen.is_terminal:
                    count = sum(r is not None for r in rows.values())
                    screen.print(
                        f"{count} of {len(jobs)}: {job.key}{': ' + error if error else ''}", highlight=False
                    )

            spread(missing, done)
    result = _result([row for job in jobs if (row := rows[job.key]) is not None], time.perf_counter() - began)
    for name, text in ((RESULT_FILE, json.dumps(result, indent=1)), ("sweep.md", table_of(result))):
        with atomic_write(out / name) as temporary:
            Path(temporary).write_text(text + "\n", encoding="utf-8")
    if as_json:
        print(json.dumps(result, allow_nan=False))
    else:
        print_sweep(result, console or Console())
    return result


def _finished(job: Job, runs: Path) -> dict[str, Any] | None:
    path = runs / job.key / ROW_FILE
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None


def _keep(job: Job, row: dict[str, Any] | None, content: bytes, error: str, runs: Path) -> dict[str, Any]:
    """A job's row; with its policy it is written whole or not at all."""
    about = {"name": job.name, "seed": job.seed, "run": job.key, "options": dict(job.options)}
    if row is None:
        return {**about, "error": error}
    kept = {**about, **row}
    with atomic_directory(runs / job.key, replaces=ROW_FILE) as folder:
        unpack(content, folder)
        (folder / ROW_FILE).write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")
    return kept


def _result(rows: Sequence[dict[str, Any]], seconds: float) -> dict[str, Any]:
    return {
        "rows": list(rows),
        "ok": all("error" not in row for row in rows),
        "seconds": seconds,
        "provenance": provenance(),
    }
