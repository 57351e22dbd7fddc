"""Reader of the numbers that Python and MATLAB files assign to names; the files are not executed.

Constants, arithmetic, matrices and a few known functions are evaluated. Any other assignment is skipped, and its name
has no value afterwards. MATLAB statements are first converted to Python.
"""

from __future__ import annotations

import ast
import math
import operator
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from finssim.core.budget import read_bytes
from finssim.core.rotations import skew
from finssim.vehicles.importers import torpedo
from finssim.vehicles.part import VehicleError

__all__ = ["Assignments", "read_assignments"]

LARGEST = 1 << 20
"""Largest size of a file [bytes]."""
GREATEST_SIZE = 1000
"""Largest number of entries of a matrix."""
UNREAD = (KeyError, TypeError, ValueError, IndexError, AttributeError, ArithmeticError, np.linalg.LinAlgError)
"""Errors for an expression that cannot be evaluated."""
Names = dict[str, Any]


def _filled(make: Callable[[Any], Any]) -> Callable[..., Any]:
    def of(*sides: Any) -> Any:
        shape = [int(x) for side in sides for x in np.ravel(side)]
        if len(shape) > 2 or max(shape) ** 2 > GREATEST_SIZE:
            raise ValueError
        return make(shape)

    return of


def _hmtrx(r: Any) -> Any:
    """Return the matrix H(r) of Fossen's toolboxes."""
    return np.block([[np.eye(3), -skew(np.ravel(r))], [np.zeros((3, 3)), np.eye(3)]])


def _spheroid(a: float, b: float, _: Any, r: Any) -> Any:
    m = 4.0 / 3.0 * math.pi * 1025.0 * a * b**2
    return _hmtrx(r).T @ np.diag([m, m, m, *torpedo.spheroid_moments(a, b, m)]) @ _hmtrx(r)


def _imlay61(a: float, b: float, _: Any, r44: float = 0.0) -> Any:
    return np.diag(torpedo.spheroid_added_mass(a, b, 4.0 / 3.0 * math.pi * torpedo.RHO * a * b**2, r44))


def _dmtrx(times: Any, ratios: Any, rigid: Any, added: Any, hydrostatics: Any) -> Any:
    W, _, _, z_g, _, _, z_b = np.ravel(hydrostatics)
    return np.diag(
        torpedo.slow_damping(np.diag(rigid + added), np.ravel(times), np.ravel(ratios), W * (z_g - z_b))
    )


OPERATORS: dict[type[ast.AST], Callable[..., Any]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv,
    ast.Pow: operator.pow, ast.MatMult: operator.matmul, ast.USub: operator.neg, ast.UAdd: operator.pos,
}  # fmt: skip
FUNCTIONS: dict[str, Callable[..., Any]] = {
    **{x: getattr(np, x) for x in "sqrt exp log sin cos tan abs sign deg2rad radians dot cross".split()},
    "transpose": np.transpose, "matmul": np.matmul, "pow": operator.pow, "power": operator.pow,
    **dict.fromkeys(("array", "asarray", "matrix", "float", "int"), np.array),
    "diag": lambda x: np.diag(np.ravel(x) if 1 in np.shape(x) else x), "inv": np.linalg.inv, "norm": np.linalg.norm,
    "eye": _filled(lambda n: np.eye(n[0])), "identity": _filled(lambda n: np.eye(n[0])), "zeros": _filled(np.zeros),
    "ones": _filled(np.ones), "Smtrx": lambda r: skew(np.ravel(r)), "skew": lambda r: skew(np.ravel(r)),
    "Hmtrx": _hmtrx, "block": lambda rows: np.block([[np.atleast_2d(x) for x in row] for row in rows if row]),
    "spheroid": _spheroid, "imlay61": _imlay61, "Dmtrx": _dmtrx,
    "gravity": lambda mu: 9.78032534 * (1 + 1.93185e-3 * np.sin(mu) ** 2) / (1 - 6.69438e-3 * np.sin(mu) ** 2) ** 0.5,
    "struct": lambda *words: dict(zip(words[::2], words[1::2], strict=True)),
}  # fmt: skip
"""Last component of a function's name -> the function; some are from MSS."""


@dataclass
class Assignments:
    """Names in a file with their numbers."""

    matlab: bool = False
    values: Names = field(default_factory=dict)
    """Name, such as `self.L` or `m` -> number or array, in the unit of the file; the first value if several
    functions assign the name."""
    cleared: dict[str, set[tuple[int, ...]]] = field(default_factory=dict)
    """Name of a matrix that is not read -> its entries, counted from 0, that the file sets to 0."""
    altered: dict[str, set[tuple[int, ...]]] = field(default_factory=dict)
    """Name of a matrix that is read -> its entries that statements that are not read change later."""
    calls: dict[str, list[Any]] = field(default_factory=dict)
    """Name of a function that is called but not evaluated -> its arguments, None where they cannot be evaluated."""
    mappings: Names = field(default_factory=dict)
    """Name -> mapping that is assigned to it."""
    unread: dict[str, None] = field(default_factory=dict)
    """Names whose assignments cannot be evaluated, in order."""

    def of(self, *names: str) -> Names:
        """Return the values whose last name component is one of some names."""
        return {name: x for name, x in self.values.items() if name.rpartition(".")[2] in names}

    # Statements, in order.

    def read(self, nodes: list[Any], names: Names) -> None:
        """Read statements; names are those of the module, or of one function."""
        for node in nodes:
            if isinstance(node, ast.FunctionDef):
                inner, count = dict(names), len(node.args.defaults)
                for argument, default in zip(
                    node.args.args[len(node.args.args) - count :], node.args.defaults, strict=True
                ):
                    self._assign(ast.Name(argument.arg), default, inner)
                self.read(node.body, inner)
                names |= {name: x for name, x in inner.items() if name.startswith("self.")}
                self.values = {**inner, **self.values, **names}
            elif isinstance(node, ast.ClassDef):
                self.read(node.body, names)
            elif isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
                for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
                    self._assign(target, node.value, names)
            elif isinstance(node, ast.AugAssign):
                self._assign(node.target, ast.BinOp(node.target, node.op, node.value), names)
            else:  # under a condition: its assignments have no certain value
                for inside in ast.walk(node):
                    if isinstance(inside, ast.Name | ast.Attribute) and isinstance(inside.ctx, ast.Store):
                        self._lose(inside, names)

    def _assign(self, target: Any, node: Any, names: Names) -> None:
        if isinstance(target, ast.Tuple | ast.List):
            several = isinstance(node, ast.Tuple | ast.List) and len(node.elts) == len(target.elts)
            for k, part in enumerate(target.elts):
                first = node if self.matlab and k == 0 else ast.Constant(None)
                self._assign(part, node.elts[k] if several else first, names)
            return
        try:
            value = self.value(node, names)
        except UNREAD:
            value = None
            for call in (inside for inside in ast.walk(node) if isinstance(inside, ast.Call)):
                self.calls.setdefault(_last(call.func), [self._or_none(x, names) for x in call.args])
        if isinstance(target, ast.Subscript):
            self._assign_entry(target, value, names)
        elif isinstance(value, str):
            names[_dotted(target)] = value
        elif value is None or not self._store(_dotted(target), value, names):
            self._lose(target, names)

    def _or_none(self, node: Any, names: Names) -> Any:
        try:
            return self.value(node, names)
        except UNREAD:
            return None

    def _store(self, name: str, value: Any, names: Names) -> bool:
        """Assign a value to a name, and the values of a mapping to `name.key`; return whether they are numbers."""
        if isinstance(value, dict):
            self.mappings[name] = value
            return sum(self._store(f"{name}.{key}", item, names) for key, item in value.items()) > 0
        try:
            array = np.array(value, dtype=np.float64)
        except (ValueError, TypeError):
            return False
        if 0 < array.size <= GREATEST_SIZE and np.all(np.isfinite(array)):
            names[name] = float(array) if array.ndim == 0 else array
            return True
        return False

    def _lose(self, target: Any, names: Names) -> None:
        names.pop(_dotted(target), None)
        self.unread[_dotted(target)] = None

    def _assign_entry(self, target: ast.Subscript, value: Any, names: Names) -> None:
        index: tuple[Any, ...] = ()
        base: Any = target
        try:
            while isinstance(base, ast.Subscript):
                index, base = (*self._index(base.slice, names), *index), base.value
        except UNREAD:
            return
        name = _dotted(base)
        plain = not any(isinstance(part, slice) for part in index)
        if isinstance(names.get(name), np.ndarray) and value is not None:
            names[name] = names[name].copy()
            names[name][index] = value
        elif name in names and plain:
            self.altered.setdefault(name, set()).add(index)
        elif name in names:
            self._lose(base, names)
        elif plain and np.ndim(value) == 0 and value == 0.0:
            self.cleared.setdefault(name, set()).add(index)

    # Expressions.

    def value(self, node: Any, names: Names) -> Any:
        """Return the value of an expression, in the unit of the file; raise an error of `UNREAD` if it cannot
        be evaluated."""
        if isinstance(node, ast.Constant) and isinstance(node.value, int | float | str):
            return node.value if isinstance(node.value, str) else float(node.value)
        if isinstance(node, ast.Attribute) and node.attr == "T" and _dotted(node) not in names:
            return np.transpose(np.atleast_2d(self.value(node.value, names)))
        if isinstance(node, ast.Name | ast.Attribute):
            name = _dotted(node)
            return (
                math.pi
                if name in ("pi", "math.pi", "np.pi", "numpy.pi") and name not in names
                else names[name]
            )
        if isinstance(node, ast.UnaryOp):
            return OPERATORS[type(node.op)](self.value(node.operand, names))
        if isinstance(node, ast.BinOp):
            left, right = self.value(node.left, names), self.value(node.right, names)
            if self.matlab and np.ndim(left) == 2 and isinstance(node.op, ast.Pow):
                return np.linalg.matrix_power(left, int(right))
            matrices = self.matlab and isinstance(node.op, ast.Mult) and np.ndim(left) == np.ndim(right) == 2
            return left @ right if matrices else OPERATORS[type(node.op)](left, right)
        if isinstance(node, ast.List | ast.Tuple):
            items = [self.value(item, names) for item in node.elts]
            if _count(items) > GREATEST_SIZE:
                raise ValueError
            mappings = any(isinstance(x, dict) for x in items)
            return {str(k): x for k, x in enumerate(items)} if mappings else items
        if isinstance(node, ast.Dict):
            pairs = zip(node.keys, node.values, strict=True)
            read = {self._or_none(key, names): self._or_none(item, names) for key, item in pairs}
            return {key: item for key, item in read.items() if item is not None}
        if isinstance(node, ast.Subscript):
            return np.asarray(self.value(node.value, names))[self._index(node.slice, names)]
        if isinstance(node, ast.Call):
            types = ("float", "int")  # of np.array(..., float)
            # The spheroid functions also take velocities, which are not read.
            one = self._or_none if _last(node.func) in ("spheroid", "imlay61") else self.value
            arguments = [one(x, names) for x in node.args if _dotted(x) not in types]
            if self.matlab and _dotted(node.func) in names:
                return np.asarray(names[_dotted(node.func)])[tuple(int(x) - 1 for x in arguments)]
            return FUNCTIONS[_last(node.func)](*arguments)
        raise KeyError

    def _index(self, node: Any, names: Names) -> tuple[Any, ...]:
        if isinstance(node, ast.Tuple):
            return tuple(part for item in node.elts for part in self._index(item, names))
        if isinstance(node, ast.Slice):
            return (
                slice(*(None if x is None else int(self.value(x, names)) for x in (node.lower, node.upper))),
            )
        return (int(self.value(node, names)),)


def _dotted(node: Any) -> str:
    """Return the dotted name of an expression; empty if it is not a name."""
    if isinstance(node, ast.Attribute):
        return f"{_dotted(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else ""


def _count(value: Any) -> int:
    return sum(map(_count, value)) if isinstance(value, list) else int(np.size(value))


def _last(node: Any) -> str:
    return _dotted(node).rpartition(".")[2]


def read_assignments(path: Path) -> Assignments:
    """Read the assignments of a .py or .m file.

    Raises:
        VehicleError: The file cannot be read, is too large, or is not valid Python.
    """
    text = read_bytes(path, VehicleError, limit=LARGEST).decode("utf-8", "replace")
    found = Assignments(path.suffix.lower() == ".m")
    try:
        nodes = (
            [node for line in _statements(text) for node in _parsed(line)]
            if found.matlab
            else ast.parse(text).body
        )
        names: Names = {}
        found.read(nodes, names)
        found.values = {name: x for name, x in (found.values | names).items() if not isinstance(x, str)}
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise VehicleError(
            f"{path}: cannot be read as {'MATLAB' if found.matlab else 'Python'}: {error}"
        ) from None
    return found


# Translation of MATLAB to Python's grammar.

TOKEN = re.compile(
    r"(?P<skip>\.\.\.[^\n]*\n|%\{[ \t\r]*\n.*?\n[ \t]*%\}|[%#][^\n]*)|(?P<word>[A-Za-z_][\w.]*|(?:\d+\.?\d*|\.\d+)"
    r"(?:[eE][-+]?\d+)?)|(?P<text>\"[^\"\n]*\"|'(?:[^'\n]|'')*')|(?P<space>[ \t\r]+)"
    r"|(?P<operator>\.?[*/^']|[=~<>]=|.|\n)",
    re.DOTALL,
)
"""Token of MATLAB; a quote after a word or a bracket is an operator."""
PART = re.compile(r"[-+](?!\s)|[\w(\[\"'@.~](?![*/^'])")
"""Start of an operand that starts an element of a matrix."""
CONTROL = {"if", "for", "while", "switch", "try", "parfor"}


def _statements(text: str) -> Iterator[str]:
    """Yield the assignments of a MATLAB text with Python expressions; conditional ones have the value None.

    A matrix becomes a call of `block`: in brackets, spaces between operands separate elements, and new lines
    separate rows.
    """
    line, brackets, depth, k = "", "", 0, 0
    while k < len(text) + 1:
        match = TOKEN.match(text, k)
        kind, token = ("operator", "\n") if match is None else (str(match.lastgroup), match[0])
        operand = line[-1:].isalnum() or line[-1:] in ("_", ")", "]", ".")
        behind = operand and text[k - 1 : k] not in (" ", "\t")
        if kind == "text" and behind:
            kind, token = "operator", "'"
        k += len(token)
        if kind == "skip" or (kind == "space" and not brackets.endswith("[")):
            line += " " if kind == "space" else ""
            continue
        if kind == "space":
            line += "," if operand and PART.match(text, k) else " "
        elif kind == "operator" and not brackets and token in ";,\n":
            word = (re.match(r"\w+", line.strip()) or [""])[0]
            depth += (word in CONTROL) - (word in ("end", "endif", "endfor") and depth > 0)
            if "=" in line and word not in (*CONTROL, "function"):
                line = line.strip().removeprefix("global ")
                yield line if depth == 0 else f"{line.partition('=')[0]} = None"
            line = ""
        elif kind == "operator" and token in (";", "\n"):
            line += "],[" if brackets.endswith("[") else ""
        elif token == ":" and brackets.endswith("("):
            line += ",None,"  # a range, which is not read
        elif kind == "operator" and token in "[({])}":
            brackets = brackets + token if token in "[({" else brackets[:-1]
            line += {"[": "block([[", "]": "]])", "{": "(", "}": ")"}.get(token, token)
        else:
            line += {"^": "**", ".^": "**", ".*": "*", "./": "/", "'": ".T", ".'": ".T"}.get(token, token)


def _parsed(line: str) -> list[Any]:
    """Return the statement of a line in Python's grammar; empty if it is not an assignment that can be read."""
    line = re.sub(r"^block\(\[\[(.*?)\]\]\)\s*=(?!=)", r"\1, _ =", line)
    line = re.sub(
        r"^([\w.]+)\s*\(([^()=]*)\)\s*=(?!=)",
        lambda m: f"{m[1]}[{','.join(f'({x})-1' for x in m[2].split(','))}] =",
        line,
    )
    try:
        return ast.parse(line.strip()).body
    except SyntaxError:
        name = re.match(r"[A-Za-z_][\w.]*(?=\s*=)", line)
        return ast.parse(f"{name[0]} = None").body if name else []
