"""`finssim tasks`: all tasks in a table, and one of them in full."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from finssim.tasks import TASKS
from finssim.tasks.describe import describe_task

__all__ = ["tasks_list", "tasks_show"]


def tasks_list(*, as_json: bool = False, console: Console | None = None) -> None:
    """Print every task of the catalogue in a line, or all as one JSON object."""
    found = {name: describe_task(name) for name in TASKS}
    if as_json:
        print(json.dumps(found, allow_nan=False))
        return
    table = _table("task", "agents", "sees", "does", "every [s]", "for [s]", "baseline", "what is to be done")
    for name, told in found.items():
        table.add_row(
            *(name, str(len(told["agents"])), str(told["observation"]["size"])),
            *(str(told["action"]["size"]), f"{told['period_s']:g}"),
            *(f"{told['time_limit_s']:g}", ", ".join(told["baselines"]), Text(told["title"])),
        )
    (console or Console()).print(table)


def tasks_show(
    task: str,
    *,
    vehicle: str = "finsrov",
    action: str | None = None,
    as_json: bool = False,
    console: Console | None = None,
) -> None:
    """Print one task as a vehicle does it, or as one JSON object.

    Args:
        task: Key of `TASKS`, or FILE.py:CLASS of one's own.
        vehicle: Name or file.
        action: Mode; the task's own if None.
        as_json: Print data in place of tables.
        console: Standard output if None.

    Raises:
        EnvironmentSetupError, ControlError, VehicleError: As `describe_task`.
    """
    told = describe_task(task, vehicle, action)
    if as_json:
        print(json.dumps(told, allow_nan=False))
        return
    console = console or Console()
    for line in _head(told):
        console.print(Text(line))
    for title, table in (
        ("Observation, of one agent", _observation(told)),
        ("Action, from -1 to 1", _action(told)),
        ("Reward, in every step", _terms(told["reward"]["terms"], "weight")),
        ("Ends", _terms(told["ends"], "reward")),
        ("Counted", _terms(told["totals"])),
        ("Settings", _settings(told)),
    ):
        if table.row_count:
            console.print(Text(f"\n{title}", style="bold"))
            console.print(table)
        if title.startswith("Reward") and told["reward"]["told"]:
            console.print(Text(told["reward"]["told"]))


def _head(told: Mapping[str, Any]) -> list[str]:
    vehicles = told["vehicles"]
    lines = [
        f"{told['name']}: {told['title']}",
        "agents: " + ", ".join(f"{name} ({vehicles[name]['name']})" for name in told["agents"]),
        f"success: {told['success']}",
        f"acts every {told['period_s']:g} s, in {told['substeps']} physics steps; an episode takes up to "
        f"{told['time_limit_s']:g} s",
        f"baselines: {', '.join(told['baselines']) or 'none'}",
        "noise in training: " + (_words(told["training_noise"]) or "none"),
        *(f"seen with sensors, {name}: {_words(one)}" for name, one in told["sensors"].items()),
    ]
    if told["others"]:
        others = ", ".join(f"{name} ({vehicles[name]['name']})" for name in told["others"])
        lines.insert(2, f"commanded by the task: {others}")
    if told["levels"]:
        lines.append(f"levels: 0 to {told['levels'] - 1}; training may climb them with --set level_at=0.8")
    return lines


def _observation(told: Mapping[str, Any]) -> Table:
    table = _table("index", "quantity", "unit", "divided by", "limited to")
    for part in told["observation"]["parts"]:
        first, last = part["first"], part["first"] + part["size"] - 1
        table.add_row(
            str(first) if first == last else f"{first}–{last}",
            Text(part["name"]),
            Text("" if part["unit"] == "1" else f"[{part['unit']}]"),
            "" if part["scale"] == 1.0 else f"{part['scale']:g}",
            "" if part["clip"] is None else f"±{part['clip']:g}",
        )
    return table


def _action(told: Mapping[str, Any]) -> Table:
    table = _table("component", "at -1", "at 1", "unit")
    for one in told["action"]["components"]:
        table.add_row(Text(one["name"]), f"{one['low']:.4g}", f"{one['high']:.4g}", Text(f"[{one['unit']}]"))
    return table


def _terms(terms: Sequence[Mapping[str, Any]], number: str | None = None) -> Table:
    table = _table("name", *([number] if number else []), "term")
    for one in terms:
        table.add_row(Text(one["name"]), *([f"{one[number]:g}"] if number else []), Text(one["told"]))
    return table


def _settings(told: Mapping[str, Any]) -> Table:
    table = _table("name", "value", "meaning")
    for one in told["settings"]:
        table.add_row(one["name"], Text(_value(one["value"])), Text(one["told"]))
    return table


def _value(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, Mapping):
        return _words(value)
    if isinstance(value, list | tuple):
        return ", ".join(_value(one) for one in value)
    return "none" if value is None else str(value)


def _words(values: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} {_value(value)}" for name, value in values.items())


def _table(*heads: str) -> Table:
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    numbers = (
        "agents",
        "sees",
        "does",
        "every [s]",
        "for [s]",
        "divided by",
        "limited to",
        "at -1",
        "at 1",
        "weight",
        "reward",
    )
    for head in heads:
        table.add_column(
            Text(head),
            justify="right" if head in numbers else "left",
            overflow="fold",
            no_wrap=head in ("task", "baseline", *numbers),
        )
    return table
