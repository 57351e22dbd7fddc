"""`finssim tasks`: all tasks in a table, and one of them in full: as plain data, and as a person reads it."""

from __future__ import annotations

import ast
import inspect
import json
import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields, is_dataclass
from typing import Any

from rich.console import Console
from rich.text import Text

from finssim.control.modes import AXES, action_mode
from finssim.experiments.tables import console_table
from finssim.tasks import TASKS
from finssim.tasks import terms as library
from finssim.tasks.agents import BASELINES
from finssim.tasks.given import crew
from finssim.tasks.make import task_named
from finssim.tasks.sensing import Sensing, seen_with
from finssim.tasks.task import Task
from finssim.vehicles import Vehicle

__all__ = ["attribute_docs", "describe_task", "tasks_list", "tasks_show"]


# A task as plain data: what is seen, done, rewarded and called a success, as vehicles do it.


# The sentences written under a dataclass' fields: Python does not keep them, their source does.


def attribute_docs(kind: type) -> dict[str, str]:
    """Field -> the string that follows it, of a class and those it is derived from; where the source can be had."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__[:-1]):
        try:
            (tree,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        except (OSError, TypeError, SyntaxError):
            continue
        body = tree.body if isinstance(tree, ast.ClassDef) else []
        for line, after in zip(body, body[1:], strict=False):
            told = after.value if isinstance(after, ast.Expr) else None
            if (
                isinstance(line, ast.AnnAssign)
                and isinstance(line.target, ast.Name)
                and isinstance(told, ast.Constant)
            ):
                found[line.target.id] = " ".join(str(told.value).split())
    return found


APART = ("name", "observation", "control_step", "substeps", "time_limit", "training_noise")
"""Fields that are told by themselves."""


def describe_task(
    task: str | Task, vehicle: Vehicle | str | Sequence[Vehicle | str] = "finsrov", action: str | None = None
) -> dict[str, Any]:
    """Everything about a task.

    Args:
        task: A task, its name, or FILE.py:CLASS of one's own.
        vehicle: Whose numbers: one for all places, or one for each.
        action: Mode; the task's own if None.

    Returns:
        Plain data: title, agents, others, observation, action, reward, success, settings, baselines, ...

    Raises:
        EnvironmentSetupError: There is no such task, or the vehicle cannot do it.
        ControlError: There is no such action mode.
        VehicleError: There is no such vehicle.
    """
    the_task = task_named(task)
    mode = action or the_task.action
    vehicles = crew(vehicle, the_task, mode)
    the_task = the_task.fitted(vehicles)
    return {
        "name": the_task.name,
        "title": title_of(the_task),
        "vehicles": {
            place: {"name": one.name, "sha256": one.sha256}
            for place, one in zip(the_task.vehicles, vehicles, strict=True)
        },
        "agents": list(the_task.agents),
        "others": list(the_task.others),
        "observation": {"size": the_task.observation_size, "parts": _observation(the_task)},
        "action": _action(mode, vehicles[0]),
        "period_s": the_task.control_step,
        "substeps": the_task.substeps,
        "time_limit_s": the_task.time_limit,
        "levels": the_task.levels,
        "reward": _reward(the_task),
        "ends": _ends(the_task),
        "totals": _totals(the_task),
        "inside": _told(the_task, the_task.terms().inside),
        "success": the_task.success_rule(),
        "settings": _settings(the_task),
        "training_noise": seen_with(the_task.training_noise, vehicles[0]),
        "sensors": seen_with(Sensing(), vehicles[0]),
        "baselines": list(BASELINES.get(the_task.name, {})),
    }


def title_of(task: Task) -> str:
    """What is to be done, in a few words."""
    return task.title or (inspect.getdoc(type(task)) or "").partition("\n")[0].rstrip(".")


def _observation(task: Task) -> list[dict[str, Any]]:
    parts, first = [], 0
    for part in task.observation:
        parts.append(
            {
                "first": first,
                "name": part.name,
                "size": part.size,
                "unit": part.unit,
                "scale": part.scale,
                "clip": part.clip,
                "told": _told(task, part.term),
            }
        )
        first += part.size
    return parts


def _told(task: Task, term: Any) -> str:
    """What is written of a term, or of what is shared under its name; an expression itself."""
    if isinstance(term, str):
        terms = task.terms()
        named = {**terms.shared, **terms.seen}.get(term, getattr(library, term, None))
        return term.replace("wp.", "") if named is None else _told(task, named)
    return " ".join((inspect.getdoc(term.func) or "").split()) if term is not None else ""


def _action(mode: str, vehicle: Vehicle) -> dict[str, Any]:
    """What 1 and -1 of every component stand for."""
    chosen = action_mode(mode, vehicle)
    components = [
        {"name": label, "low": low, "high": high, "unit": "N m" if label in AXES[3:] else "N"}
        for label, low, high in zip(chosen.labels, *(x.tolist() for x in chosen.ends), strict=True)
    ]
    return {"mode": mode, "size": len(components), "components": components}


def _reward(task: Task) -> dict[str, Any]:
    """Terms with their weights, and what is written of them all; of a task in torch, of its function."""
    own: Any = getattr(task, "reward", None)
    weights = asdict(own) if is_dataclass(own) and not isinstance(own, type) else {}
    told = inspect.getdoc(type(own) if weights else own) if weights or callable(own) else ""
    terms = [
        {"name": one.name, "weight": one.weight, "told": _told(task, one.term)}
        for one in task.terms().rewards
    ]
    return {"terms": terms, "weights": weights, "told": told or ""}


def _ends(task: Task) -> list[dict[str, Any]]:
    return [
        {"name": one.name, "reward": one.reward, "told": _told(task, one.term)} for one in task.terms().ends
    ]


def _totals(task: Task) -> list[dict[str, Any]]:
    return [{"name": one.name, "told": _told(task, one.term)} for one in task.terms().totals]


def _settings(task: Task) -> list[dict[str, Any]]:
    """What can be changed, and what is drawn in every episode."""
    docs, told = attribute_docs(type(task)), []
    for field in fields(task):
        value = getattr(task, field.name)
        if field.name in APART or field.name == "reward":
            continue
        plain = asdict(value) if is_dataclass(value) and not isinstance(value, type) else value
        told.append({"name": field.name, "value": _limited(plain), "told": docs.get(field.name, "")})
    return told


def _limited(value: Any) -> Any:
    """None for a limit that is infinite, such as the level speed of a vehicle that never tips over: JSON has no inf."""
    if isinstance(value, dict):
        return {name: _limited(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [_limited(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


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
