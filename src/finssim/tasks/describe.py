"""A task as plain data: what is seen, done, rewarded and called a success, as vehicles do it."""

from __future__ import annotations

import ast
import inspect
import math
import textwrap
from collections.abc import Sequence
from dataclasses import asdict, fields, is_dataclass
from typing import Any

from finssim.control.modes import Thruster8, action_mode
from finssim.tasks.baselines import BASELINES
from finssim.tasks.given import crew
from finssim.tasks.make import task_named
from finssim.tasks.sensing import Sensing, seen_with
from finssim.tasks.task import Task
from finssim.vehicles import Vehicle

__all__ = ["attribute_docs", "describe_task"]

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
    """What is written of a term, or of what is shared under its name."""
    if isinstance(term, str):
        terms = task.terms()
        term = {**terms.shared, **terms.seen}[term]
    return " ".join((inspect.getdoc(term.func) or "").split()) if term is not None else ""


def _action(mode: str, vehicle: Vehicle) -> dict[str, Any]:
    """What 1 and -1 of every component stand for."""
    chosen = action_mode(mode, vehicle)
    if isinstance(chosen, Thruster8):
        ends = [
            (low * k, high * k) for low, high, k in zip(chosen.lower, chosen.upper, chosen.scale, strict=True)
        ]
        units = ["N"] * len(ends)
    else:
        most = [chosen.limits[axis] * chosen.scale[axis] for axis in chosen.axes]
        ends = [(-x, x) for x in most]
        units = ["N" if axis < 3 else "N m" for axis in chosen.axes]
    components = [
        {"name": label, "low": low, "high": high, "unit": unit}
        for label, (low, high), unit in zip(chosen.labels, ends, units, strict=True)
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
