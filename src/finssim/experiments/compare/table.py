"""A comparison as a person reads it: on a screen and as Markdown."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

__all__ = ["markdown", "print_comparison", "rows_of", "sentences_of"]

NOTE = (
    "interquartile mean over seeds and targets; in brackets 95 % of a bootstrap over the seeds, stratified by target. "
    "With fewer than five seeds an interval is too narrow; with fewer than three nobody is called better."
)


def rows_of(result: Mapping[str, Any]) -> list[list[str]]:
    """The heads, then a row for each group."""
    heads = ["", "seeds", "steps", "time [s]", *result["measures"]]
    return [heads] + [
        [
            name,
            str(len(group["seeds"])),
            "–" if group["steps"] is None else f"{group['steps']:,}",
            "–" if group["seconds"] is None else f"{group['seconds']:.0f}",
            *(_cell(group["measures"][measure]) for measure in result["measures"]),
        ]
        for name, group in result["groups"].items()
    ]


def sentences_of(result: Mapping[str, Any]) -> list[str]:
    """What the intervals support of each pair, and what they leave open."""
    words = {
        "better": "{a} is better than {b} in {measure}",
        "worse": "{b} is better than {a} in {measure}",
        "open": "{a} and {b} are not told apart in {measure}",
    }
    sentences = []
    for pair in result["pairs"]:
        low, high = pair["ci95"]
        chance = f"chance that {pair['a']} is better: {pair['probability']:.2f} [{low:.2f}, {high:.2f}]"
        sentences.append(f"{words[pair['verdict']].format(**pair)} ({chance})")
    return sentences


def print_comparison(result: Mapping[str, Any], console: Console) -> None:
    """Print the table and the sentences."""
    heads, *rows = rows_of(result)
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for k, head in enumerate(heads):
        table.add_column(Text(head), justify="right" if k else "left")
    for row in rows:
        table.add_row(*map(Text, row))
    console.print(f"{result['task']}, plant {result['plant']}", highlight=False)
    console.print(table)
    console.print(NOTE, highlight=False)
    for sentence in sentences_of(result):
        console.print(f"- {sentence}", highlight=False, markup=False)


def markdown(result: Mapping[str, Any]) -> str:
    """`compare.md`."""
    heads, *rows = rows_of(result)
    lines = [heads, ["---"] + ["--:"] * (len(heads) - 1), *rows]
    table = "\n".join("| " + " | ".join(line) + " |" for line in lines)
    sentences = "\n".join(f"- {sentence}" for sentence in sentences_of(result))
    return f"# {result['task']}, plant {result['plant']}\n\n{table}\n\n{NOTE}\n\n{sentences}\n"


def _cell(found: Mapping[str, Any]) -> str:
    low, high = found["ci95"]
    bounds = ", ".join("–" if x is None else f"{x:.4g}" for x in (low, high))
    value = "not reached" if found["value"] is None else f"{found['value']:.4g}"
    return f"{value} [{bounds}]"
