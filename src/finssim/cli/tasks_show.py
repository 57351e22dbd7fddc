"""`finssim tasks`: table of all tasks, and full description of one, as plain data and as tables."""

from __future__ import annotations

import ast
import inspect
import math
import textwrap
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, fields, is_dataclass
from functools import cache
from itertools import pairwise
from typing import Any

from finssim.agents.catalogue import baselines_of
from finssim.control.modes import AXES, ActionMode, action_mode
from finssim.core.registry import ACTUATORS
from finssim.evaluation.tables import Table
from finssim.tasks import TASKS
from finssim.tasks.catalogue import task_named
from finssim.tasks.sensing import Sensing, seen_with
from finssim.tasks.task import Task
from finssim.tasks.terms import End, ObservationPart, RewardTerm, Total
from finssim.tasks.validation import vehicles_of_task
from finssim.vehicles import Vehicle


def attribute_docs(kind: type) -> dict[str, str]:
    """Return field -> the string below it, for a class and its bases, as far as their source is available."""
    docs: dict[str, str] = {}
    for base in reversed(kind.__mro__[:-1]):
        docs |= _own_docs(base)
    return docs


@cache
def _own_docs(kind: type) -> dict[str, str]:
    """Return the strings below a class's own fields from its source; cached, since tasks share their bases."""
    docs: dict[str, str] = {}
    with suppress(OSError, TypeError, SyntaxError):
        (tree,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
        for line, below in pairwise(getattr(tree, "body", ())):
            if isinstance(line, ast.AnnAssign) and isinstance(below, ast.Expr):
                docs[ast.unparse(line.target)] = " ".join(str(ast.literal_eval(below.value)).split())
    return docs


SEPARATE = ("name", "observation", "control_step", "substeps", "time_limit", "training_noise", "reward")
"""Fields that are shown separately."""


def describe_task(
    task: str | Task, vehicle: Vehicle | str | Sequence[Vehicle | str] = "finsrov", action: str | None = None
) -> dict[str, Any]:
    """Return the description of a task.

    Args:
        task: A task, its name, or FILE.py:CLASS of your own.
        vehicle: Vehicle of the description: one for all roles, or one for each.
        action: Action mode; None: the task's own.

    Returns:
        Plain data: title, agents, others, observation, action, reward, success, settings, baselines, ...

    Raises:
        EnvironmentSetupError: There is no such task, or the vehicle cannot perform it.
        ControlError: There is no such action mode.
        VehicleError: There is no such vehicle.
    """
    the_task = task_named(task)
    mode = action or the_task.action
    vehicles = vehicles_of_task(vehicle, the_task, mode)
    the_task = the_task.fitted(vehicles)
    terms, entries = the_task.terms(), the_task.schema.entries
    parts = [
        {
            "first": entry.indices[0],
            **{name: getattr(part, name) for name in ("name", "size", "unit", "scale", "clip")},
            "meaning": _text(the_task, part),
        }
        for entry, part in zip(entries, the_task.observation, strict=True)
    ]
    return {
        "name": the_task.name,
        "title": the_task.title or (inspect.getdoc(type(the_task)) or "").partition("\n")[0].rstrip("."),
        "vehicles": {
            role: {"name": item.name, "sha256": item.sha256}
            for role, item in zip(the_task.vehicles, vehicles, strict=True)
        },
        "agents": list(the_task.agents),
        "others": list(the_task.others),
        "observation": {"size": the_task.observation_size, "parts": parts},
        "action": _action(mode, vehicles[0]),
        "period_s": the_task.control_step,
        "substeps": the_task.substeps,
        "time_limit_s": the_task.time_limit,
        "reward": _reward(the_task),
        "ends": [
            {"name": item.name, "reward": item.reward, "meaning": _text(the_task, item)}
            for item in terms.ends
        ],
        "totals": [{"name": item.name, "meaning": _text(the_task, item)} for item in terms.totals],
        "success": the_task.success_rule(),
        "settings": _settings(the_task),
        "training_noise": seen_with(the_task.training_noise, vehicles[0]),
        "sensors": seen_with(Sensing(), vehicles[0]),
        "baselines": list(baselines_of(the_task)),
    }


def _text(task: Task, part: ObservationPart | RewardTerm | End | Total) -> str:
    """Return the task's text of a term, or the first paragraph of the docstring of its function or shared value."""
    terms, term = task.terms(), part.term
    while isinstance(term, str):
        term = {**terms.shared, **terms.seen}.get(term)
    text = "" if term is None else (inspect.getdoc(term.func) or "").partition("\n\n")[0]
    text = " ".join(text.split()).removeprefix("Return ")
    return terms.meanings.get(part.name) or text[:1].upper() + text[1:]


def _action(mode: str, vehicle: Vehicle) -> dict[str, Any]:
    """Return the limits of every action component at -1 and 1."""
    chosen = action_mode(mode, vehicle)
    components = [
        {"name": label, "low": low, "high": high, "unit": _unit(label, chosen, vehicle)}
        for label, low, high in zip(chosen.labels, *(x.tolist() for x in chosen.ends), strict=True)
    ]
    return {"mode": mode, "size": len(components), "components": components}


ORDERS = {"speed": "m/s", "course": "rad", "depth": "m", "pitch": "rad"}
"""Unit of each set-point of the course autopilot."""


def _unit(label: str, mode: ActionMode, vehicle: Vehicle) -> str:
    """Return the unit of a component of an action."""
    if label in vehicle.actuators:
        return str(ACTUATORS[vehicle.actuators[label].kind].unit)
    if mode.labels[0] == "speed":
        return ORDERS[label]
    return "N m" if label in AXES[3:] else "N"


def _reward(task: Task) -> dict[str, Any]:
    """Return the reward terms with their weights and the reward's docstring; for a task in torch, that of its
    function."""
    reward: Any = getattr(task, "reward", None)
    weights = asdict(reward) if is_dataclass(reward) and not isinstance(reward, type) else {}
    text = inspect.getdoc(type(reward) if weights else reward) if weights or callable(reward) else ""
    terms = [
        {"name": term.name, "weight": term.weight, "meaning": _text(task, term)}
        for term in task.terms().rewards
    ]
    return {"terms": terms, "weights": weights, "meaning": text or ""}


def _settings(task: Task) -> list[dict[str, Any]]:
    """Return the settings, with the ranges that are drawn in every episode."""
    docs, values = attribute_docs(type(task)), task.record()
    names = (field.name for field in fields(task) if field.name not in SEPARATE)
    return [{"name": name, "value": _limited(values[name]), "meaning": docs.get(name, "")} for name in names]


def _limited(value: Any) -> Any:
    """Return None for an infinite limit, such as the level speed of a vehicle that never tips over: JSON has
    no infinity."""
    if isinstance(value, dict):
        return {name: _limited(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_limited(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def tasks_list() -> dict[str, Any]:
    """List the tasks: agents, sizes of observation and action, period and length [s]; `show NAME` describes one.

    Example: finssim tasks
    """
    return {name: describe_task(name) for name in TASKS.usable()}


def tasks_show(task: str, *, vehicle: str = "finsrov", action: str | None = None) -> dict[str, Any]:
    """Describe a task for a vehicle: observation, action [N, N m], reward, success, settings.

    Example: finssim tasks show docking --vehicle bluerov2_heavy

    Args:
        task (NAME|FILE.py:CLASS): Task, or your own as FILE.py:CLASS.
        vehicle (NAME|FILE): Vehicle in the catalogue, or path of a vehicle file.
        action (MODE): wrench6, wrench4, thruster8, pilot6, surfaces, course or course_pitch; default the
            task's own.

    Raises:
        EnvironmentSetupError: There is no such task, or the vehicle cannot perform it.
        ControlError: There is no such action mode.
        VehicleError: There is no such vehicle.
    """
    return describe_task(task, vehicle, action)


def tables_of(result: Mapping[str, Any]) -> list[Table]:
    """Return a table with a row for each task, or tables that describe one task."""
    if "observation" not in result:
        rows = [
            [
                name, str(len(task["agents"])), str(task["observation"]["size"]), str(task["action"]["size"]),
                f"{task['period_s']:g}", f"{task['time_limit_s']:g}", ", ".join(task["baselines"]),
            ]
            for name, task in result.items()
        ]  # fmt: skip
        heads = ("task", "agents", "observed", "actions", "period [s]", "length [s]", "baseline")
        goals = [[name, task["title"]] for name, task in result.items()]
        return [  # two tables, each at most 80 columns wide
            Table(title="", heads=("task", "goal"), rows=goals, left=(0, 1), whole=(0,)),
            Table(title="", heads=heads, rows=rows, left=(0, 6), whole=(0, 6)),
        ]
    parts = {
        "Observation, of one agent: each over its scale, within ± clip": (result["observation"]["parts"], ""),
        "Action: limits at -1 and 1": (result["action"]["components"], ""),
        "Reward, in every step": (result["reward"]["terms"], result["reward"]["meaning"]),
        "Ends": (result["ends"], ""),
        "Counted": (result["totals"], ""),
        "Settings": (result["settings"], ""),
    }
    first = Table(title=result["name"], headline="\n".join(_head(result)))
    return [
        first,
        *(
            Table(
                title=title,
                heads=list((rows or ({},))[0]),
                rows=[[_value(value) for value in row.values()] for row in rows],
                left=range(9),
                note=note,
            )
            for title, (rows, note) in parts.items()
            if rows or note
        ),
    ]


def _head(result: Mapping[str, Any]) -> list[str]:
    crew = {
        role: ", ".join(f"{name} ({result['vehicles'][name]['name']})" for name in result[role])
        for role in ("agents", "others")
    }
    lines = {
        result["name"]: result["title"],
        "agents": crew["agents"],
        "commanded by the task": crew["others"],
        "success": result["success"],
        "acts every": f"{result['period_s']:g} s, in {result['substeps']} physics steps; an episode takes up to "
        f"{result['time_limit_s']:g} s",
        "baselines": ", ".join(result["baselines"]) or "none",
        "noise in training": _value(result["training_noise"]) or "none",
        **{f"measured with {name}": _value(sensor) for name, sensor in result["sensors"].items()},
    }
    return [f"{name}: {text}" for name, text in lines.items() if text]


def _value(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_value(item)}" for name, item in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(map(_value, value))
    return "none" if value is None else str(value)
