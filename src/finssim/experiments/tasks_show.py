"""`finssim tasks`: all tasks in a table, and one of them in full."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.text import Text

from finssim.experiments.tables import console_table
from finssim.tasks import TASKS
from finssim.tasks.describe import describe_task

__all__ = ["tasks_list", "tasks_show"]


def tasks_list(*, as_json: bool = False, console: Console | None = None) -> None:
    """List the tasks: agents, sizes of observation and action, period and length [s]; `show NAME` tells one in full.

    Example: finssim tasks
    """
    found = {name: describe_task(name) for name in TASKS}
    if as_json:
        print(json.dumps(found, allow_nan=False))
        return
    rows = [
        [
            name, str(len(told["agents"])), str(told["observation"]["size"]), str(told["action"]["size"]),
            f"{told['period_s']:g}", f"{told['time_limit_s']:g}", ", ".join(told["baselines"]), told["title"],
        ]
        for name, told in found.items()
    ]  # fmt: skip
    heads = ("task", "agents", "sees", "does", "every [s]", "for [s]", "baseline", "what is to be done")
    (console or Console()).print(console_table(heads, rows, left=(0, 6, 7), whole=(0, 6)))


def tasks_show(
    task: str,
    *,
    vehicle: str = "finsrov",
    action: str | None = None,
    as_json: bool = False,
    console: Console | None = None,
) -> None:
    """Tell all of a task as a vehicle does it: observation, action [N, N m], reward, success, settings.

    Example: finssim tasks show docking --vehicle bluerov2_heavy

    Args:
        task (NAME|FILE.py:CLASS): Task, or one's own as FILE.py:CLASS.
        vehicle (NAME|FILE): Vehicle of the catalogue, or the path of a vehicle file.
        action (MODE): wrench6, wrench4 or thruster8; the task's own if not given.
        as_json: Print one JSON object instead of tables.
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
    parts = [
        [
            f"{one['first']}–{one['first'] + one['size'] - 1}" if one["size"] > 1 else str(one["first"]),
            one["name"],
            "" if one["unit"] == "1" else f"[{one['unit']}]",
            "" if one["scale"] == 1.0 else f"{one['scale']:g}",
            "" if one["clip"] is None else f"±{one['clip']:g}",
        ]
        for one in told["observation"]["parts"]
    ]
    action = [
        [one["name"], f"{one['low']:.4g}", f"{one['high']:.4g}", f"[{one['unit']}]"]
        for one in told["action"]["components"]
    ]
    settings = [[one["name"], _value(one["value"]), one["told"]] for one in told["settings"]]
    rewards, ends = told["reward"]["terms"], told["ends"]
    for title, heads, rows, left in (
        (
            "Observation, of one agent",
            ("index", "quantity", "unit", "divided by", "limited to"),
            parts,
            (0, 1, 2),
        ),
        ("Action, from -1 to 1", ("component", "at -1", "at 1", "unit"), action, (0, 3)),
        ("Reward, in every step", ("name", "weight", "term"), _terms(rewards, "weight"), (0, 2)),
        ("Ends", ("name", "reward", "term"), _terms(ends, "reward"), (0, 2)),
        ("Counted", ("name", "term"), [[one["name"], one["told"]] for one in told["totals"]], (0, 1)),
        ("Settings", ("name", "value", "meaning"), settings, (0, 1, 2)),
    ):
        if rows:
            console.print(Text(f"\n{title}", style="bold"))
            console.print(console_table(heads, rows, left=left))
        if title.startswith("Reward") and told["reward"]["told"]:
            console.print(Text(told["reward"]["told"]))


def _terms(terms: Sequence[Mapping[str, Any]], number: str) -> list[list[str]]:
    return [[one["name"], f"{one[number]:g}", one["told"]] for one in terms]


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
