"""Names of a package that are imported when they are first used.

    if TYPE_CHECKING:
        from finssim.sim.simulator import Simulator

    __all__ = ["Simulator"]
    __getattr__, __dir__ = exports(__name__)

Editors and type checkers read the imports; a program loads a module only when it uses a name of it, and two
packages can import each other's modules.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Callable, Iterator
from importlib import import_module
from typing import Any

__all__ = ["exports", "imported_lazily"]


def exports(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return `__getattr__` and `__dir__` of a package for the names that it imports under `TYPE_CHECKING`.

    Args:
        package: Dotted name of the package, which is being imported.
    """
    module = sys.modules[package]
    homes = dict(imported_lazily(str(module.__file__)))

    def get(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        value = getattr(import_module(homes[name]), name)
        setattr(module, name, value)
        return value

    def names() -> list[str]:
        return sorted({*vars(module), *homes})

    return get, names


def imported_lazily(file: str) -> Iterator[tuple[str, str]]:
    """Yield the name and the module of each import under `TYPE_CHECKING` in a file."""
    with open(file, encoding="utf-8") as source:
        nodes = ast.parse(source.read()).body
    for node in nodes:
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
            for imported in node.body:
                if isinstance(imported, ast.ImportFrom):
                    for alias in imported.names:
                        yield alias.name, str(imported.module)
