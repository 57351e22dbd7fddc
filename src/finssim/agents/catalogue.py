"""Baselines of tasks by name, as listed by each task's class."""

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
    """Return the constructors of a task's baselines by name; see `Task.baselines`.

    A subclass under another name may have another observation, so it has only the baselines that it defines.

    Raises:
        EnvironmentSetupError: There is no task with that name.
    """
    task = task_named(task)
    owner = next(kind for kind in type(task).__mro__ if "baselines" in vars(kind))
    names = [field.default for field in fields(owner) if field.name == "name"]
    return owner.baselines if task.name in names else {}


def baseline(task: Task | str, name: str, vehicle: Vehicle | str = "finsrov") -> Baseline:
    """Return a task's baseline by name, for a vehicle; its `period` is the task's control step.

    Raises:
        BaselineError: The task has no baseline with that name.
        EnvironmentSetupError: There is no task with that name.
        ControlError: The vehicle's file lacks a quantity that the baseline requires.
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
