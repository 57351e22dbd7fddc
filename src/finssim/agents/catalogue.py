"""Baselines of tasks by name; each task's class names its own."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any

from finssim.agents.baselines import Baseline
from finssim.core.registry import object_at
from finssim.tasks.catalogue import task_named
from finssim.tasks.task import Task
from finssim.vehicles import Vehicle, load_vehicle


class BaselineError(ValueError):
    """A baseline that does not exist."""


def baselines_of(task: Task | str) -> Mapping[str, str | Callable[..., Any]]:
    """Return the makers of a task's baselines by name; see `Task.baselines`.

    A subclass under another name may observe something else, so it has the baselines alone that it defines.

    Raises:
        EnvironmentSetupError: There is no task of that name.
    """
    task = task_named(task)
    owner = next(kind for kind in type(task).__mro__ if "baselines" in vars(kind))
    names = [field.default for field in fields(owner) if field.name == "name"]
    return owner.baselines if task.name in names else {}


def baseline(task: Task | str, name: str, vehicle: Vehicle | str = "finsrov") -> Baseline:
    """Return a task's baseline by name, made for a vehicle; its `period` is the task's control step.

    Raises:
        BaselineError: The task has none of that name.
        EnvironmentSetupError: There is no task of that name.
        ControlError: The vehicle's file does not give what the baseline needs.
    """
    task = task_named(task)
    have = baselines_of(task)
    if name not in have:
        raise BaselineError(
            f"unknown baseline '{name}' of task '{task.name}'; available: {', '.join(have) or 'none'}"
        )
    maker = have[name]
    if isinstance(maker, str):
        maker = object_at(maker).for_vehicle
    made: Baseline = maker(load_vehicle(vehicle))
    return made
