"""The tables of `results/seeing.json`: of tasks that see, what `train`, `evaluate` and `experiment stack` gave."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from finssim.experiments.tables import Table, figure_text

HEADS = ("task", "controller", "seeds", "success", "after [s]", "off by [cm]", "training [processor-s]")


def tables_of(result: Mapping[str, Any]) -> list[Table]:
    """Controllers on the looks that are held out, all seeds together; each seed; and through the stack.

    Args:
        result: `rows` by task, controller and seed, `pooled` over the seeds, `stack` by task: each with `metrics` as
            `finssim evaluate` has them.
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
            *(figure_text(row[key], ".3f") for key in KEYS),
        ]
        for row in result["stack"]
    ]
    return [
        Table(title="held_out", heads=HEADS, rows=held_out, left=(0, 1)),
        Table(title="by seed", heads=HEADS, rows=[cells(row) for row in result["rows"]], left=(0, 1)),
        Table(title="through the stack", heads=("task", "water", "episodes", *KEYS), rows=stack, left=(0, 1)),
    ]


KEYS = ("stack", "batch")
"""Where the same policy was played: through the deployed software, and in the batch."""
