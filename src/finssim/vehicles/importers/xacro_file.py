"""Expansion of xacro files by the xacro library, without executing code of the file and within limits; ROS
packages nearby.

The library evaluates expressions as Python and reads any file. Here, a copy of its module is restricted:
expressions are numbers, strings and lists with the functions of `CALLS`, files must be in the folder of the
file or in a package that was found, and every step is counted.
"""

from __future__ import annotations

import ast
import importlib.util
import math
import operator
import re
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any
from xml.dom import minidom

from finssim.core.budget import read_bytes
from finssim.core.xml_file import parse_xml
from finssim.vehicles.importers.elements import Element
from finssim.vehicles.part import VehicleError

__all__ = ["evaluate", "expanded", "packages_near"]

FILE = 1 << 20
"""Largest size of one file [bytes]."""
TEXT = 20_000
"""Largest length of a text or attribute [characters]."""
STEPS = 1_000_000
"""Largest number of characters and elements that an expansion processes."""
FOLDERS = 5_000
"""Largest number of folders that are searched for packages."""

CALLS: dict[str, Callable[..., Any]] = {
    name: getattr(math, name)
    for name in (
        "acos", "asin", "atan", "atan2", "ceil", "cos", "cosh", "degrees", "exp", "fabs", "floor", "fmod", "hypot",
        "log", "log10", "pow", "radians", "sin", "sinh", "sqrt", "tan", "tanh",
    )
} | {f.__name__: f for f in (abs, bool, float, int, len, max, min, round, str, sum)}  # fmt: skip
"""Functions allowed in an expression."""
CONSTANTS = {"pi": math.pi, "e": math.e, "tau": math.tau, "True": True, "False": False}
"""Predefined names in expressions; angles in rad."""
OPERATORS: dict[type[ast.AST], Callable[..., Any]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv,
    ast.FloorDiv: operator.floordiv, ast.Mod: operator.mod, ast.Pow: operator.pow, ast.USub: operator.neg,
    ast.UAdd: operator.pos, ast.Not: operator.not_, ast.Eq: operator.eq, ast.NotEq: operator.ne, ast.Lt: operator.lt,
    ast.LtE: operator.le, ast.Gt: operator.gt, ast.GtE: operator.ge, ast.In: lambda a, b: a in b,
    ast.NotIn: lambda a, b: a not in b,
}  # fmt: skip


def evaluate(text: str, names: Mapping[str, Any], calls: Mapping[str, Callable[..., Any]] = CALLS) -> Any:
    """Return the value of an xacro expression: a number, a string, a Boolean or a list.

    Args:
        text: The expression.
        names: Name -> value.
        calls: Name -> function.

    Raises:
        VehicleError: The expression is invalid, or its value is too large.
    """
    try:
        if len(text) > 1000:
            raise ValueError("it is longer than 1000 characters")
        return _value(ast.parse(text.strip(), mode="eval").body, names, calls)
    except VehicleError:
        raise
    except (
        ArithmeticError,
        LookupError,
        MemoryError,
        RecursionError,
        SyntaxError,
        TypeError,
        ValueError,
    ) as error:
        raise VehicleError(f"the expression '{text.strip()[:80]}' has no value: {error}") from None


def _value(node: ast.AST, names: Mapping[str, Any], calls: Mapping[str, Callable[..., Any]]) -> Any:
    def of(inner: ast.AST) -> Any:
        return _value(inner, names, calls)

    match node:
        case ast.Constant(value=bool() | int() | float() | str()):
            return node.value
        case ast.Name():
            return names[node.id]
        case ast.Attribute(value=ast.Name(id="math" | "python")):
            return CONSTANTS[node.attr]
        case ast.Attribute():
            space = of(node.value)
            if not isinstance(space, dict):
                raise ValueError(f"'{node.attr}' is not in a known namespace")
            return space[node.attr]
        case ast.Call(
            func=ast.Name(id=name) | ast.Attribute(value=ast.Name(id="math" | "python"), attr=name)
        ):
            if name not in calls or node.keywords:
                raise ValueError(
                    f"the function '{name}' is not read, expected one of {', '.join(sorted(calls))}"
                )
            return _bounded(calls[name](*(of(argument) for argument in node.args)))
        case ast.List() | ast.Tuple():
            return [of(element) for element in node.elts]
        case ast.Subscript(slice=ast.Constant() | ast.UnaryOp() | ast.Name()):
            return of(node.value)[of(node.slice)]
        case ast.IfExp():
            return of(node.body) if of(node.test) else of(node.orelse)
        case ast.BoolOp():
            stop = isinstance(node.op, ast.Or)
            value = None
            for part in node.values:
                value = of(part)
                if bool(value) == stop:
                    break
            return value
        case ast.Compare(ops=[op], comparators=[right]) if type(op) in OPERATORS:
            return OPERATORS[type(op)](of(node.left), of(right))
        case ast.UnaryOp() if type(node.op) in OPERATORS:
            return OPERATORS[type(node.op)](of(node.operand))
        case ast.BinOp() if type(node.op) in OPERATORS:
            a, b = of(node.left), of(node.right)
            joined = isinstance(node.op, ast.Add) and isinstance(a, str) and isinstance(b, str)
            if not joined and not all(isinstance(x, int | float) for x in (a, b)):
                raise ValueError("only numbers can be combined")
            if isinstance(node.op, ast.Pow) and abs(b) > 64:
                raise ValueError("an exponent is larger than 64")
            return _bounded(OPERATORS[type(node.op)](a, b))
        case _:
            raise ValueError(f"{type(node).__name__} is not read in an expression")


def _bounded(value: Any) -> Any:
    if isinstance(value, str) and len(value) > TEXT or isinstance(value, int) and abs(value) > 10**300:
        raise ValueError("its value is too large")
    if not isinstance(value, bool | int | float | str):
        raise ValueError("its value is no number or text")
    return value


def packages_near(path: Path, folders: Iterable[Path] = ()) -> dict[str, Path]:
    """Return name -> folder of ROS packages: in the folders, and around the package that contains a file.

    Args:
        path: The file; its package and the two parent folders of that are searched.
        folders: Folders that are searched first.
    """
    parents = path.resolve().parents
    home = next((i for i, folder in enumerate(parents) if (folder / "package.xml").is_file()), None)
    around = [] if home is None else [x for x in parents[home : home + 3] if x.name]
    found: dict[str, Path] = {}
    seen = 0
    for root in (*(folder.resolve() for folder in folders), *around):
        level = [root]
        for _ in range(5):
            below: list[Path] = []
            for folder in level:
                seen += 1
                if seen > FOLDERS:
                    return found
                manifest = folder / "package.xml"
                if manifest.is_file():
                    name = re.search(
                        rb"<name>\s*([\w.-]+)\s*</name>", read_bytes(manifest, VehicleError, limit=FILE)
                    )
                    if name:
                        found.setdefault(name[1].decode(), folder)
                with suppress(OSError):
                    below += sorted(
                        entry
                        for entry in folder.iterdir()
                        if entry.is_dir() and not entry.is_symlink() and not entry.name.startswith(".")
                    )
            level = below
    return found


def expanded(path: Path, packages: Mapping[str, Path]) -> Element:
    """Return the root element of a file after expansion.

    Args:
        path: The xacro file.
        packages: Name -> folder of the packages that `$(find NAME)` may refer to.

    Raises:
        VehicleError: The file cannot be expanded.
    """
    spec = importlib.util.find_spec("xacro")
    if spec is None or spec.loader is None:
        raise VehicleError(
            f"{path}: xacro is not installed: pip install 'finssim[xacro]', or expand the file to URDF"
        )
    library: Any = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(library)
    _restrict(library, path, packages)
    try:
        document = library.process_file(str(path), verbosity=0)
        return parse_xml(document.documentElement.toxml().encode(), path, VehicleError)
    except RecursionError:
        raise VehicleError(
            f"{path}: its macros call one another too often: expand the file to URDF"
        ) from None
    except Exception as error:  # raised by the library, by its parser, or here and wrapped by the library
        while isinstance(getattr(error, "exc", None), VehicleError | library.XacroException):
            error = error.exc
        sentence = " ".join(str(error).split())
        raise VehicleError(sentence if sentence.startswith(str(path)) else f"{path}: {sentence}") from None


def _restrict(library: Any, path: Path, packages: Mapping[str, Path]) -> None:
    """Replace the functions that evaluate, read and print in a copy of the library's module."""
    inside = [path.resolve().parent, *packages.values()]
    spent = 0

    def spend(steps: int) -> None:
        nonlocal spent
        spent += steps
        if spent > STEPS:
            raise VehicleError("its macros expand to too much text: expand the file to URDF")

    def symbol_names(symbols: Any) -> Any:
        return symbols if symbols is not None else CONSTANTS

    def eval_text(text: str, symbols: Any, original: Any = library.eval_text) -> Any:
        spend(len(text))
        if len(text) > TEXT:
            raise VehicleError(f"a text is longer than {TEXT} characters: make it shorter")
        value = original(text, symbols)
        spend(len(value) if isinstance(value, str) else 1)
        return value

    def eval_all(node: Any, macros: Any, symbols: Any, original: Any = library.eval_all) -> None:
        spend(1 + len(node.getElementsByTagName("*")))
        original(node, macros, symbols)
        spend(len(node.childNodes) ** 2 // 100)  # the library moves the children one by one

    def argument(name: str) -> str:
        arguments = library.substitution_args_context["arg"]
        if name not in arguments:
            raise VehicleError(
                f"argument '{name}' has no default: expand the file with it, xacro FILE {name}:=VALUE"
            )
        return str(arguments[name])

    def eval_extension(text: str) -> Any:
        kind, _, rest = text[2:-1].strip().partition(" ")
        if kind == "arg":
            return argument(rest.strip())
        if kind == "find":
            if rest.strip() not in packages:
                raise VehicleError(
                    f"$(find {rest.strip()}): this package is not near the file: give its folder with --folder"
                )
            return str(packages[rest.strip()])
        if kind == "dirname":
            return str(path.resolve().parent)
        if kind == "eval":
            own = {
                name: library.Table._eval_literal(x)
                for name, x in library.substitution_args_context["arg"].items()
            }
            return evaluate(rest, CONSTANTS | own, CALLS | {"arg": lambda name: own[name]})
        raise VehicleError(f"{text[:80]} is not read: write its value instead")

    def parse(_: Any, filename: str) -> Any:
        file = Path(filename)
        if not any(file.resolve().is_relative_to(folder) for folder in inside):
            raise VehicleError(
                f"includes {filename}, which is in no package near the file: give --folder FOLDER"
            )
        if not file.is_file():
            library.filestack.pop()
            raise library.XacroException(f"includes {filename}, which is not there: add it", exc=OSError())
        data = read_bytes(file, VehicleError, limit=FILE)
        parse_xml(data, file, VehicleError)
        return minidom.parseString(data)

    def include(filename: str, symbols: Any) -> list[str]:
        return [library.abs_filename_spec(library.eval_text(filename, symbols))]

    library._global_symbols = dict(CONSTANTS)
    library.safe_eval = lambda text, symbols: evaluate(text, symbol_names(symbols))
    library.eval_text, library.eval_all, library.parse = eval_text, eval_all, parse
    library.eval_extension, library.get_include_files = eval_extension, include
    library.warning = library.message = library.error = library.print_location = lambda *_, **__: None
