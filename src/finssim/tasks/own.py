"""Tasks of one's own by name: `path/to/file.py:ClassName`, or `package.module:ClassName` of what Python can import."""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

from finssim.tasks.given import EnvironmentSetupError
from finssim.tasks.task import Task

__all__ = ["own_task"]


def own_task(words: str, **settings: Any) -> Task:
    """The task that a class (or any other callable) of a file or module makes.

    Args:
        words: FILE.py:NAME or MODULE:NAME.
        settings: Its arguments.

    Raises:
        EnvironmentSetupError: There is no such file, module or name; its code fails; or it makes no task.
    """
    place, _, name = words.rpartition(":")
    module = _of_file(Path(place)) if place.endswith(".py") else _of_import(place)
    found = getattr(module, name, None)
    if not callable(found):
        have = [key for key, value in vars(module).items() if _is_task_class(value, module)]
        raise EnvironmentSetupError(f"{place} has no task '{name}'; tasks there: {', '.join(have) or 'none'}")
    try:
        task = found(**settings)
    except TypeError as error:
        raise EnvironmentSetupError(f"task '{words}' cannot be made: {error}") from error
    if not isinstance(task, Task):
        raise EnvironmentSetupError(
            f"'{words}' makes a {type(task).__name__}, expected a Task: derive it from finssim.tasks.Task or TorchTask"
        )
    return task


def _is_task_class(value: Any, module: ModuleType) -> bool:
    return isinstance(value, type) and issubclass(value, Task) and value.__module__ == module.__name__


def _of_file(path: Path) -> ModuleType:
    """The module of a file, run once; files beside it can be imported by it."""
    if not path.is_file():
        raise EnvironmentSetupError(f"there is no file {path}: give FILE.py:CLASS")
    whole = path.resolve()
    # A name of its own: two files of one name are two modules, and Warp keeps kernels by module.
    name = f"{whole.stem}_{hashlib.sha256(str(whole).encode()).hexdigest()[:8]}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, whole)
    if spec is None or spec.loader is None:
        raise EnvironmentSetupError(f"{path} cannot be read as Python")
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    sys.path.insert(0, str(whole.parent))
    try:
        spec.loader.exec_module(module)
    except Exception as error:  # somebody's own file may raise anything as it is imported
        del sys.modules[name]
        raise EnvironmentSetupError(f"{path} fails: {type(error).__name__}: {error}") from error
    finally:
        sys.path.remove(str(whole.parent))
    return module


def _of_import(name: str) -> ModuleType:
    try:
        return importlib.import_module(name)
    except (ImportError, ValueError) as error:
        raise EnvironmentSetupError(f"module '{name}' cannot be imported: {error}") from error
