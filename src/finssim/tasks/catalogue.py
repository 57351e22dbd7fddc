"""All tasks by name, user-defined tasks, and `finssim.make`: the batched environment of a task."""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from finssim.core.registry import TASKS, RegistryError
from finssim.sim.randomize import Randomization
from finssim.tasks.environment import Environment, EnvironmentSetupError
from finssim.tasks.measurement import ESTIMATOR, MeasurementNoise
from finssim.tasks.sensing import Sensing, load_sensing
from finssim.tasks.task import Task
from finssim.vehicles import Vehicle
from finssim.vehicles.part import did_you_mean

# User-defined tasks by name: `path/to/file.py:ClassName`, or `package.module:ClassName` of an importable module.


def own_task(reference: str, **settings: Any) -> Task:
    """Return the task that a class (or any other callable) of a file or module creates.

    Args:
        reference: FILE.py:NAME or MODULE:NAME.
        settings: Arguments of the class.

    Raises:
        EnvironmentSetupError: There is no such file, module or name; its code fails; or it does not create a task.
    """
    return _made(reference, own_class(reference, Task, "task"), settings)


def _made(reference: str, factory: Any, settings: Mapping[str, Any]) -> Task:
    """Return the task that a class or function creates; `reference` is its name in messages."""
    try:
        task = factory(**settings)
    except TypeError as error:
        raise EnvironmentSetupError(f"task '{reference}' cannot be made: {error}") from error
    if not isinstance(task, Task):
        raise EnvironmentSetupError(
            f"'{reference}' makes a {type(task).__name__}, expected a Task: derive it from finssim.tasks.Task or "
            "TorchTask"
        )
    return task


def own_class(reference: str, base: type, kind: str) -> Any:
    """Return a class (or any other callable) of a user's file or module.

    Args:
        reference: FILE.py:NAME or MODULE:NAME.
        base: Base class, whose subclasses are listed in the message if there is no such name.
        kind: Kind of class, for messages.

    Raises:
        EnvironmentSetupError: There is no such file, module or name, or its code fails.
    """
    module_path, _, name = reference.rpartition(":")
    module = _of_file(Path(module_path)) if module_path.endswith(".py") else _of_import(module_path)
    result = getattr(module, name, None)
    if not callable(result):
        have = [
            key
            for key, value in vars(module).items()
            if isinstance(value, type) and issubclass(value, base) and value.__module__ == module.__name__
        ]
        missing = f"{module_path} has no {kind} '{name}'" if name else f"give {module_path}:CLASS"
        raise EnvironmentSetupError(f"{missing}; {kind}s there: {', '.join(have) or 'none'}")
    return result


def _of_file(path: Path) -> ModuleType:
    """Return the module of a file, executed once; it can import other files of its folder."""
    if not path.is_file():
        raise EnvironmentSetupError(f"there is no file {path}: give FILE.py:CLASS")
    full_path = path.resolve()
    # A unique name: two files with the same name are two modules, and Warp caches kernels by module.
    name = f"{full_path.stem}_{hashlib.sha256(str(full_path).encode()).hexdigest()[:8]}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, full_path)
    if spec is None or spec.loader is None:
        raise EnvironmentSetupError(f"{path} cannot be read as Python")
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    sys.path.insert(0, str(full_path.parent))
    try:
        spec.loader.exec_module(module)
    except Exception as error:  # a user's file may raise anything when it is imported
        del sys.modules[name]
        raise EnvironmentSetupError(f"{path} fails: {type(error).__name__}: {error}") from error
    finally:
        sys.path.remove(str(full_path.parent))
    return module


def _of_import(name: str) -> ModuleType:
    try:
        return importlib.import_module(name)
    except (ImportError, ValueError) as error:
        raise EnvironmentSetupError(f"module '{name}' cannot be imported: {error}") from error


def numeric_tasks() -> list[str]:
    """Return the names of the tasks without pictures; those that cannot be imported are omitted."""
    return [name for name, kind in TASKS.usable().items() if not kind().pictures]


def check_registered(name: str, task: Any) -> None:
    """Refuse a registered object that does not create a task.

    Args:
        name: Name of the task.
        task: The object that is registered under it.

    Raises:
        EnvironmentSetupError: It is not callable, or a class that is not derived from `Task`.
    """
    if not callable(task) or (isinstance(task, type) and not issubclass(task, Task)):
        raise EnvironmentSetupError(
            f"{name} is {task!r:.80}, expected a class derived from finssim.tasks.Task, or a function that returns one"
        )


OBSERVED: dict[str, MeasurementNoise | Sensing] = {
    "truth": MeasurementNoise(),
    "estimator": ESTIMATOR,
    "sensors": Sensing(),
}
"""Observations of a controller by name; there is also `training`, with the noise that a task is trained with."""


def observed(name: str, task: Task | None = None) -> MeasurementNoise | Sensing:
    """Return the observation of a controller by its name, for a task, or by a file of position fixes.

    Raises:
        EnvironmentSetupError: There is no such name, or the file is invalid.
    """
    available = {**OBSERVED, **({} if task is None else {"training": task.training_noise})}
    if name not in available and name.endswith((".yaml", ".yml")):
        return load_sensing(name)
    if name not in available:
        raise EnvironmentSetupError(
            f"observe is '{name}', expected {', '.join(available)} or a file of fixes (.yaml)"
        )
    return available[name]


def task_named(task: str | Task, **settings: Any) -> Task:
    """Return a task by its name, or a user-defined task by FILE.py:CLASS or MODULE:CLASS, with the given settings.

    Raises:
        EnvironmentSetupError: No task has that name.
    """
    if isinstance(task, Task):
        return task
    if task not in TASKS and (":" in task or task.endswith(".py")):
        return own_task(task if ":" in task else f"{task}:", **settings)
    if task not in TASKS:
        hint = did_you_mean(task, list(TASKS))
        raise EnvironmentSetupError(
            f"unknown task '{task}'{hint} available: {', '.join(TASKS)}; or your own: FILE.py:CLASS"
        )
    try:
        factory = TASKS[task]
    except RegistryError as error:
        raise EnvironmentSetupError(str(error)) from error
    return _made(task, factory, settings)


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
    """Return the batched environment of a task; every adapter has the same arguments.

    Args:
        task: A task or its name.
        worlds: Number of worlds.
        vehicle: A vehicle, a catalogue name or a file; or one for each of the task's vehicles.
        hydrodynamics: calibrated, mesh or simplified.
        action: thruster8, wrench6, wrench4, pilot6 (ArduSub's axes), surfaces, course or course_pitch; the task's
            own if None.
        randomize: Ranges, or their name or file, from which vehicle and water are drawn in every episode.
        observe: Observation of the controller: truth, estimator (noise, offset and delay of the robot's own
            localization), training (the noise that the task is trained with), sensors (the vehicle's own sensors and
            position fixes, fused by a filter), a file of fixes (.yaml) for the same at another site, or a
            `MeasurementNoise` or `Sensing`.
        options: Other arguments of `Environment`: seed, device, threads, water, pool, tether, ...

    Returns:
        The environment.

    Raises:
        EnvironmentSetupError: A name does not exist, or vehicles do not fit the task.
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
