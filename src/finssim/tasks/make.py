"""`finssim.make`: any task's batched environment, from names."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from finssim.engine.randomize import Randomization
from finssim.tasks.catalogue import TASKS
from finssim.tasks.environment import Environment, EnvironmentSetupError
from finssim.tasks.measurement import ESTIMATOR, MeasurementNoise
from finssim.tasks.own import own_task
from finssim.tasks.sensing import Sensing, load_sensing
from finssim.tasks.task import Task
from finssim.vehicles import Vehicle

__all__ = ["OBSERVED", "make", "observed", "task_named"]

OBSERVED: dict[str, MeasurementNoise | Sensing] = {
    "truth": MeasurementNoise(),
    "estimator": ESTIMATOR,
    "sensors": Sensing(),
}
"""What a controller may see, by name; besides them `training`, the noise that a task is trained with."""


def observed(name: str, task: Task | None = None) -> MeasurementNoise | Sensing:
    """What a controller sees under that name, in a task; or with the fixes of a file.

    Raises:
        EnvironmentSetupError: There is no such name, or the file is wrong.
    """
    known = {**OBSERVED, **({} if task is None else {"training": task.training_noise})}
    if name not in known and name.endswith((".yaml", ".yml")):
        return load_sensing(name)
    if name not in known:
        raise EnvironmentSetupError(
            f"observe is '{name}', expected {', '.join(known)} or a file of fixes (.yaml)"
        )
    return known[name]


def task_named(task: str | Task, **settings: Any) -> Task:
    """A task by its name, or one's own by FILE.py:CLASS or MODULE:CLASS, with settings of its own.

    Raises:
        EnvironmentSetupError: There is none of that name.
    """
    if isinstance(task, Task):
        return task
    if task not in TASKS and ":" in task:
        return own_task(task, **settings)
    if task not in TASKS:
        raise EnvironmentSetupError(
            f"unknown task '{task}'; available: {', '.join(TASKS)}; or one's own: FILE.py:CLASS"
        )
    made: Task = TASKS[task](**settings)
    return made


def make(
    task: str | Task = "t1",
    *,
    worlds: int = 1,
    vehicle: Vehicle | str | Sequence[Vehicle | str] = "finsrov",
    hydrodynamics: str = "calibrated",
    action: str | None = None,
    randomize: Randomization | str | Path | None = None,
    observe: MeasurementNoise | Sensing | str = "truth",
    **options: Any,
) -> Environment:
    """The batched environment of a task; every adapter takes the same arguments.

    Args:
        task: A task or its name.
        worlds: How many at once.
        vehicle: A vehicle, a catalogue name or a file; or one for each of the task's vehicles.
        hydrodynamics: calibrated, mesh or simplified.
        action: thruster8, wrench6 or wrench4; the task's own if None.
        randomize: Ranges, or the name or file of some, from which vehicle and water are drawn in every episode.
        observe: What the controller sees: truth, estimator (noise, offset and delay of the robot's own localization),
            training (the noise that the task is trained with), sensors (what the vehicle's own sensors and position
            fixes say, through a filter), a file of fixes (.yaml) for the same on another site, or a noise or `Sensing`
            of one's own.
        options: The rest of what `Environment` takes: seed, device, threads, water, pool, tether, ...

    Returns:
        The environment.

    Raises:
        EnvironmentSetupError: A name that does not exist, or vehicles that do not fit the task.
    """
    chosen = task_named(task)
    if isinstance(observe, str):
        observe = observed(observe, chosen)
    ranges = Randomization(randomize) if isinstance(randomize, str | Path) else randomize
    return Environment(
        chosen,
        vehicle,
        worlds=worlds,
        hydrodynamics=hydrodynamics,
        action=action,
        randomization=ranges,
        noise=observe,
        **options,
    )
