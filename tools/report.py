"""Fill the tables of pages from results: `python tools/report.py results/*.json --into docs/evidence.md`."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from finssim.cli.command_line import run_script
from finssim.core.files import atomic_write
from finssim.evaluation.tables import Table, figure_text, markdown_table
from finssim.studies import transfer

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from studies import anatomy, changes, faults, soak

SEEING_HEADS = (
    "task",
    "controller",
    "seeds",
    "success",
    "after [s]",
    "off by [cm]",
    "training [processor-s]",
)


def seeing_tables(result: Mapping[str, Any]) -> list[Table]:
    """Return the tables of `results/seeing.json`: tasks with images in held-out appearances, and through the stack.

    Args:
        result: Results of `train`, `evaluate` and the stack: `rows` by task, controller and seed, `pooled` over the
            seeds, `stack` by task, each with `metrics` as those of `finssim evaluate`.
    """

    def cells(row: Mapping[str, Any]) -> list[str]:
        m = row["metrics"]
        seeds, training = (", ".join(map(str, row.get(key, ()))) for key in ("seeds", "training_s"))
        figures = [
            figure_text(m["success"], ".3f"),
            figure_text(m["success_time"], ".1f"),
            figure_text(m.get("error"), ".2f", 100.0),
        ]
        return [row["task"], row["controller"], seeds or "–", *figures, training or "–"]

    held_out = [[f"`{task}`", f"`{who}`", *rest] for task, who, *rest in map(cells, result["pooled"])]
    stack = [
        [
            f"`{row['task']}`",
            row["severity"],
            f"{row['episodes']}",
            *(figure_text(row[key], ".3f") for key in SEEING_KEYS),
        ]
        for row in result["stack"]
    ]
    return [
        Table(title="held_out", heads=SEEING_HEADS, rows=held_out, left=(0, 1)),
        Table(title="by seed", heads=SEEING_HEADS, rows=[cells(row) for row in result["rows"]], left=(0, 1)),
        Table(
            title="through the stack",
            heads=("task", "water", "episodes", *SEEING_KEYS),
            rows=stack,
            left=(0, 1),
        ),
    ]


SEEING_KEYS = ("stack", "batch")
"""Keys of a policy's success through the deployed software, and in the batch."""


TABLES: Mapping[str, Callable[[Mapping[str, Any]], Sequence[Table]]] = {
    **dict.fromkeys(transfer.SPECS, transfer.tables_of),
    "anatomy": anatomy.tables_of,
    "changes": changes.tables_of,
    "faults": faults.tables_of,
    "seeing": seeing_tables,
    "soak": soak.tables_of,
}
"""Experiment -> function that returns the tables of its result."""

BLOCK = re.compile(r"<!-- report: (?P<what>.*?) -->\n(?P<old>.*?)<!-- end -->", re.DOTALL)


class ReportError(ValueError):
    """A page asks for a table that the results do not contain."""


def report(results: Sequence[Path], *, into: Annotated[Sequence[Path], "--into"], check: bool = False) -> int:
    """Fill the tables of Markdown pages from results of experiments.

    A page marks a table with <!-- report: t1 --> and <!-- end -->, for the result in t1.json; options after
    the name are table=2 (the second table of the result), columns=0,1,3, rows=calibrated;paper: calibrated (names
    as in the table; all rows of a name), and headline=yes. A result in sentences, such as soak, becomes a list.

    Example: python tools/report.py results/t1.json results/anatomy.json --into docs/evidence.md --into README.md

    Args:
        results (FILE.json...): Results of experiments t1, t2, anatomy, faults and soak, and `seeing.json`.
        into (PAGE.md): Page whose tables are filled. May be repeated.
        check: Change nothing; exit status 1 if a page differs from the results.

    Raises:
        ReportError: A file is no result of such an experiment, or a page asks for a table that does not exist.
    """
    by_name = {path.stem: _read(path) for path in results}
    stale = []
    for page in into:
        text = page.read_text(encoding="utf-8")
        new = filled(text, by_name, str(page))
        if new == text:
            continue
        stale.append(page)
        if not check:
            with atomic_write(page) as temporary:
                temporary.write_text(new, encoding="utf-8")
    for page in stale:
        print(f"{page}: {'differs from the results' if check else 'filled'}")
    return int(check and bool(stale))


def _read(path: Path) -> Mapping[str, Any]:
    """Read the result of an experiment."""
    try:
        result: Mapping[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        name = result["experiment"]
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise ReportError(f"{path}: not the result of an experiment ({error})") from None
    if name not in TABLES:
        raise ReportError(f"{path}: result of experiment '{name}', expected one of {', '.join(TABLES)}")
    return result


def filled(page: str, results: Mapping[str, Mapping[str, Any]], name: str) -> str:
    """Return a page with its tables filled from results.

    Args:
        page: Text of the page.
        results: Name of a file without its suffix -> result.
        name: Name of the page, for refusals.

    Raises:
        ReportError: The page asks for a table, row or column that does not exist.
    """

    def made(match: re.Match[str]) -> str:
        name_of_result, *options = match["what"].split(" ", 1)
        try:
            if name_of_result not in results:
                raise ReportError(f"no result '{name_of_result}.json' was given")
            result = results[name_of_result]
            text = _table(TABLES[result["experiment"]](result), options[0] if options else "")
        except ReportError as error:
            raise ReportError(f"{name}: <!-- report: {match['what']} -->: {error}") from None
        return f"<!-- report: {match['what']} -->\n{text}\n<!-- end -->"

    return BLOCK.sub(made, page)


def _table(tables: Sequence[Table], options: str) -> str:
    chosen = dict(re.findall(r"(table|columns|rows|headline)=((?:[^=]*?)(?=\s+\w+=|$))", options))
    number = int(chosen.get("table", "1"))
    if not 1 <= number <= len(tables):
        raise ReportError(f"table {number}: the result has {len(tables)}")
    selected = tables[number - 1]
    if "rows" in chosen:
        by_name: dict[str, list[Any]] = {}
        for row in filter(None, selected.rows):
            by_name.setdefault(row[0].strip(), []).append(row)
        names = chosen["rows"].split(";")
        missing = [row for row in names if row not in by_name]
        if missing:
            raise ReportError(f"no row '{missing[0]}'; there are: {'; '.join(by_name)}")
        selected = replace(selected, rows=[row for name in names for row in by_name[name]])
    if "columns" in chosen:
        columns = [int(word) for word in chosen["columns"].split(",")]
        if max(columns) >= len(selected.heads):
            raise ReportError(f"no column {max(columns)}: the table has 0 to {len(selected.heads) - 1}")
        selected = replace(
            selected,
            heads=[selected.heads[k] for k in columns],
            rows=[[row[k] for k in columns] for row in selected.rows if row],
        )
    rows = [[row[0].strip(), *row[1:]] for row in selected.rows if row]
    table = (
        markdown_table(selected.heads, rows)
        if rows
        else "\n".join(f"- {text}" for text in selected.sentences)
    )
    return f"{selected.headline}:\n\n{table}" if chosen.get("headline") == "yes" else table


if __name__ == "__main__":
    run_script("__main__:report")
