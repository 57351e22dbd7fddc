"""What a policy directory says of its task: the observation's layout, and the settings trained with."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from finssim.control.policy_description import ObservationEntry, ObservationSchema
from finssim.tasks import Task

__all__ = ["observation_schema", "task_record"]


def observation_schema(task: Task) -> ObservationSchema:
    """The task's observation, part by part."""
    entries, first = [], 0
    for part in task.observation:
        clip = None if part.clip is None else (-part.clip, part.clip)
        indices = tuple(range(first, first + part.size))
        entries.append(
            ObservationEntry(name=part.name, indices=indices, unit=part.unit, scale=part.scale, clip=clip)
        )
        first += part.size
    return ObservationSchema(size=first, entries=tuple(entries))


def task_record(task: Task) -> dict[str, Any]:
    """The task's settings as plain data: ranges, limits, reward weights."""
    record = asdict(task)
    record.pop("observation")
    return record
