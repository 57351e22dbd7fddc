"""Vectorized C++ for blocks of eight worlds, traced from the Warp functions that a kernel runs for one world.

A compiler that sees one world at a time fills one of eight lanes of a processor's vector register. This module
therefore calls the Warp functions of a step once, from plain Python, with *lane numbers* in place of floats. Each
operation then writes a line of C++ that computes it for eight worlds at once. The equations have a single source.

Where a function branches, for example at a wall or at the surface, the trace follows both branches, and each world uses
the result of its own branch. Code for another branch than that of the example, a submerged vehicle in open water, runs
only if a world of the block needs it. A block therefore consists of worlds that took the same branches in the last
step. A world whose branch cannot be traced is computed by the kernel for one world. The result of a world thus depends
on this world alone, never on the others in its block.
"""

# mypy: disable-error-code="no-any-return"

from __future__ import annotations

import builtins
import itertools
import math
from collections import ChainMap
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import CellType, FunctionType, SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import warp as wp

LANES = 8
"""Number of worlds in a block."""
GROUP = 1024
"""Number of worlds that are sorted into blocks by their branches in the last step."""
REMEMBERED_BRANCHES = 5
"""Number of branches, in the order of the trace, by which worlds are sorted into blocks."""


class LaneError(TypeError):
    """A function uses an operation that is not available for several worlds together."""


class Lane:
    """One number in each world of a block, with an example value whose branches are traced first.

    Attributes:
        kind: F (float32), D (float64), I (int32) or M (boolean mask).
    """

    __hash__ = None  # type: ignore[assignment]

    def __init__(self, trace: Trace, kind: str, name: str, example: Any, level: int) -> None:
        self.trace, self.kind, self.name, self.example, self.level = trace, kind, name, example, level

    def _with(self, other: Any, symbol: str, function: Callable[[Any, Any], Any], kind: str = "") -> Any:
        if isinstance(other, LaneRow):
            return NotImplemented
        return self.trace.apply(kind or self.kind, f"({{}} {symbol} {{}})", function, self, other)

    def _from(self, other: Any, symbol: str, function: Callable[[Any, Any], Any]) -> Any:
        return self.trace.apply(self.kind, f"({{}} {symbol} {{}})", function, other, self)

    def __add__(self, other: Any) -> Any:
        return self if _is(other, 0.0) else self._with(other, "+", lambda a, b: a + b)

    def __radd__(self, other: Any) -> Any:
        return self if _is(other, 0.0) else self._from(other, "+", lambda a, b: a + b)

    def __sub__(self, other: Any) -> Any:
        return self._with(other, "-", lambda a, b: a - b)

    def __rsub__(self, other: Any) -> Any:
        return self._from(other, "-", lambda a, b: a - b)

    def __mul__(self, other: Any) -> Any:
        if _is(other, 0.0) or _is(other, 1.0):
            return self if other else 0.0
        return self._with(other, "*", lambda a, b: a * b)

    def __rmul__(self, other: Any) -> Any:
        if _is(other, 0.0) or _is(other, 1.0):
            return self if other else 0.0
        return self._from(other, "*", lambda a, b: a * b)

    def __truediv__(self, other: Any) -> Any:
        return self._with(other, "/", _divide)

    def __rtruediv__(self, other: Any) -> Any:
        return self._from(other, "/", _divide)

    def __mod__(self, other: Any) -> Any:
        return self._with(other, "%", lambda a, b: a % b)

    def __and__(self, other: Any) -> Any:
        return self._with(other, "&", lambda a, b: a & b)

    def __rshift__(self, other: Any) -> Any:
        return self._with(other, ">>", lambda a, b: a >> b)

    def __neg__(self) -> Any:
        return self.trace.apply(self.kind, "(-{})", lambda a: -a, self)

    def __lt__(self, other: Any) -> Any:
        return self._with(other, "<", lambda a, b: a < b, "M")

    def __le__(self, other: Any) -> Any:
        return self._with(other, "<=", lambda a, b: a <= b, "M")

    def __gt__(self, other: Any) -> Any:
        return self._with(other, ">", lambda a, b: a > b, "M")

    def __ge__(self, other: Any) -> Any:
        return self._with(other, ">=", lambda a, b: a >= b, "M")

    def __eq__(self, other: Any) -> Any:
        return self._with(other, "==", lambda a, b: a == b, "M")

    def __ne__(self, other: Any) -> Any:
        return self._with(other, "!=", lambda a, b: a != b, "M")

    def __bool__(self) -> bool:
        """Return the truth of a branch: both values in turn while exploring; else that of the example, and other
        worlds leave."""
        truth = self if self.kind == "M" else self != 0
        return self.trace.decide(truth) if isinstance(truth, Lane) else bool(truth)

    def __index__(self) -> int:
        """Return the example's number of loop passes; worlds with another number leave the block."""
        self.trace.require(self == self.example)
        return int(self.example)


def _is(x: Any, value: float) -> bool:
    """Return whether x is that constant, so that adding or multiplying it needs no code."""
    return isinstance(x, float | int) and x == value


def _divide(a: Any, b: Any) -> Any:
    return a / b if b else math.copysign(math.inf, a)


class LaneRow:
    """Vector, quaternion or matrix of lane numbers and constants, row by row."""

    def __init__(self, shape: tuple[int, ...], numbers: Sequence[Any], quaternion: bool = False) -> None:
        self.shape, self.numbers, self.quaternion = shape, list(numbers), quaternion

    def like(self, numbers: Sequence[Any]) -> LaneRow:
        """Return a row of the same shape with other numbers."""
        return LaneRow(self.shape, numbers, self.quaternion)

    def _index(self, index: Any) -> int:
        return int(index[0] * self.shape[1] + index[1]) if isinstance(index, tuple) else int(index)

    def __getitem__(self, index: Any) -> Any:
        if len(self.shape) == 2 and not isinstance(index, tuple):
            columns = self.shape[1]
            return LaneRow((columns,), self.numbers[columns * index : columns * (index + 1)])
        return self.numbers[self._index(index)]

    def __setitem__(self, index: Any, value: Any) -> None:
        self.numbers[self._index(index)] = value

    def __add__(self, other: LaneRow) -> LaneRow:
        return self.like([a + b for a, b in zip(self.numbers, other.numbers, strict=True)])

    def __sub__(self, other: LaneRow) -> LaneRow:
        return self.like([a - b for a, b in zip(self.numbers, other.numbers, strict=True)])

    def __neg__(self) -> LaneRow:
        return self.like([-a for a in self.numbers])

    def __truediv__(self, other: Any) -> LaneRow:
        return self.like([a / other for a in self.numbers])

    def __rmul__(self, other: Any) -> LaneRow:
        return self.like([other * a for a in self.numbers])

    def __mul__(self, other: Any) -> LaneRow:
        if not isinstance(other, LaneRow):
            return self.like([a * other for a in self.numbers])
        if self.quaternion:
            (ax, ay, az, aw), (bx, by, bz, bw) = self.numbers, other.numbers
            return self.like(
                [
                    aw * bx + bw * ax + ay * bz - by * az,
                    aw * by + bw * ay + az * bx - bz * ax,
                    aw * bz + bw * az + ax * by - bx * ay,
                    aw * bw - ax * bx - ay * by - az * bz,
                ]
            )
        if len(self.shape) == 2:
            rows, columns = self.shape
            return LaneRow(
                (rows,), [_sum([self[i, j] * other[j] for j in range(columns)]) for i in range(rows)]
            )
        rows, columns = other.shape
        return LaneRow(
            (columns,), [_sum([self[i] * other[i, j] for i in range(rows)]) for j in range(columns)]
        )


def _sum(terms: Sequence[Any]) -> Any:
    total = terms[0]
    for term in terms[1:]:
        total = total + term
    return total


class _Path:
    """Truth values at the branches in one run of a function."""

    def __init__(self, answers: Sequence[bool]) -> None:
        self.given = list(answers)
        self.taken: list[tuple[Lane, bool]] = []


BRANCHES = 8
"""Largest number of branches in one run of a function."""
SHORT = 24
"""Number of lines up to which another branch is computed for every block, even if no world needs it."""


class Trace:
    """Lines of C++ written by functions that are called with lane numbers of the trace.

    A line stands outside the loop over substeps if all its operands do.

    Attributes:
        sections: Lines before, in and after the loop.
        level: Section of lines without operands.
        active: Traces that follow both sides of branches. Each call of a function runs once for every combination of
            branches, and each world uses the result of its own. Code that only some combinations need runs if a world
            of the block takes one of them.
    """

    active: ClassVar[list[Trace]] = []

    def __init__(self) -> None:
        self.sections: list[list[str]] = [[], [], []]
        self.level = 0
        self._known: ChainMap[Any, Any] = ChainMap()
        self._names, self._branch_numbers = itertools.count(), itertools.count()
        self._other_branches: list[tuple[Lane, list[str]]] = []
        self._path: _Path | None = None
        self._world_by_world = False
        self.written = 0
        """Number of assignments to `WorldArray`s."""
        self.arrays: dict[str, WorldArray] = {}
        """The arrays in use, by name in C++."""
        self.outside: dict[str, None] = {}
        """Declarations before the loop over blocks, in the order of insertion."""

    @property
    def in_other_branch(self) -> bool:
        """Return whether the lines belong to another branch than that of the example."""
        return bool(self._other_branches)

    @contextmanager
    def exploration(self) -> Iterator[None]:
        """Follow both sides of branches inside the context."""
        Trace.active.append(self)
        try:
            yield
        finally:
            Trace.active.pop()

    def symbol(self, kind: str, name: str, example: Any) -> Lane:
        """Return a lane number that the C++ around the trace declares."""
        return Lane(self, kind, name, example, self.level)

    def place(self, level: int) -> list[str]:
        """Return the lines of a section, or those of the other branch that is being traced."""
        return self._other_branches[-1][1] if self._other_branches else self.sections[level]

    def line(self, kind: str, expression: str, example: Any, level: int | None = None) -> Lane:
        """Return the lane number of a C++ expression; equal expressions in a section share one lane number."""
        level = self.level if level is None else level
        key = (kind, expression, level)
        if key not in self._known:
            name = f"n{next(self._names)}"
            self.place(level).append(f"const {kind} {name} = {expression};")
            self._known[key] = Lane(self, kind, name, example, level)
        return self._known[key]

    def once(self, statement: str, level: int) -> None:
        """Write a statement, unless it is already present."""
        if (statement, level) not in self._known:
            self._known[statement, level] = True
            self.place(level).append(statement)

    def set_known(self, truth: Lane, value: bool) -> None:
        """Treat a lane number as a known truth value from now on."""
        key = next(key for key, lane in self._known.items() if lane is truth)
        self._known[key] = value

    def apply(self, kind: str, form: str, function: Callable[..., Any], *arguments: Any) -> Any:
        """Return the result of an operation on lane numbers and constants; a constant if all arguments are
        constants."""
        lanes = [a for a in arguments if isinstance(a, Lane)]
        example = function(*(a.example if isinstance(a, Lane) else a for a in arguments))
        if not lanes:
            return example
        operand = next((a.kind for a in lanes if a.kind != "M"), "M")
        operands = [a.name if isinstance(a, Lane) else _constant(operand, a) for a in arguments]
        return self.line(kind, form.format(*operands), example, max(a.level for a in lanes))

    def require(self, truth: Any) -> None:
        """Remove the worlds in which this truth differs from the example from the block; the kernel for one world
        computes them."""
        if isinstance(truth, Lane):
            elsewhere = "".join(f" | ~{mask.name}" for mask, _ in self._other_branches)
            self._keep(f"{'' if truth.example else '~'}{truth.name}{elsewhere}", truth.level)

    def _keep(self, truth: str, level: int) -> None:
        if self._world_by_world:
            raise LaneError("a sum over an index cannot leave a world out")
        self.place(level).append(f"ok &= {truth};")

    def size(self, name: str, value: int) -> int:
        """Return a number that all worlds share; if it differs at run time, all worlds leave the block."""
        self.once(f"if ({name} != {value}) return 0;", 0)
        return value

    def decide(self, truth: Lane) -> bool:
        """Return the truth value of a branch in the run that is being traced."""
        if self._path is None:
            self.require(truth)
            return bool(truth.example)
        for known, answer in self._path.taken:
            if known.name == truth.name:
                return answer
        i = len(self._path.taken)
        if i == BRANCHES:
            raise LaneError(f"a function branches more than {BRANCHES} times")
        answer = self._path.given[i] if i < len(self._path.given) else bool(truth.example)
        self._path.taken.append((truth, answer))
        return answer

    def call(self, function: Callable[..., Any], arguments: Sequence[Any]) -> Any:
        """Call a function once for every combination of branches; only for the example's if it writes into arrays."""
        key = (function, *(_signature(a) for a in arguments))
        if key in self._known:
            return _mapped(lambda x: x, self._known[key])
        written = self.written
        result = self._explored(function, arguments, [])
        if self.written == written:
            self._known[key] = result
        return _mapped(lambda x: x, result)

    def sum_over(self, function: Callable[..., Any], first: Lane, end: Lane, arguments: Sequence[Any]) -> Any:
        """Sum a function over its first argument in a C++ loop; the loop's limits are the same in all worlds of the
        block."""
        lines: list[str] = []
        ends = [_shared(number) for number in (first, end)]
        known, self._known = self._known, self._known.new_child()
        self._other_branches.append((Lane(self, "M", "all_i(-1)", True, self.level), lines))
        each = function(Lane(self, "I", "all_i(index)", 0, self.level), *arguments)
        self._other_branches.pop()
        self._known = known
        names = [f"n{next(self._names)}" for _ in each.numbers]
        self.place(self.level).extend(
            [
                *(f"F {name} = all(0.0f);" for name in names),
                f"for (int index = {ends[0]}; index < {ends[1]}; ++index) {{",
                *lines,
                *(f"{name} += {_word(x)};" for name, x in zip(names, each.numbers, strict=True)),
                "}",
            ]
        )
        return each.like([Lane(self, "F", name, 0.0, self.level) for name in names])

    def world_by_world(self, function: Callable[..., Any], count: int, arguments: Sequence[Any]) -> Any:
        """Sum a function over its first argument, 0 to count - 1, in the lanes, for one world after another.

        The sum is computed only in the worlds that take the branch being traced.
        """
        if count > LANES or not self._other_branches:
            return _row_sum([function(i, *arguments) for i in range(count)])
        lines: list[str] = []
        known, self._known = self._known, self._known.new_child()
        truth = " & ".join(f"{mask.name}[world]" for mask, _ in self._other_branches)
        self._other_branches.append((self._other_branches[-1][0], lines))
        index = self.line("I", "all_i(0) + I{" + ", ".join(map(str, range(LANES))) + "}", 0)
        alike = [
            _mapped(
                lambda x: (
                    self.line(x.kind, f"all{'' if x.kind == 'F' else '_i'}({x.name}[world])", x.example)
                    if isinstance(x, Lane)
                    else x
                ),
                a,
            )
            for a in arguments
        ]
        self._world_by_world = True
        try:
            each = function(index, *alike)
        finally:
            self._world_by_world = False
        self._other_branches.pop()
        self._known = known
        names = [f"n{next(self._names)}" for _ in each.numbers]
        lines += [
            f"{name}[world] = total({_word(number)}, {count});"
            for name, number in zip(names, each.numbers, strict=True)
        ]
        self.place(self.level).extend(
            [
                *(f"F {name} = all(0.0f);" for name in names),
                f"for (int world = 0; world < LANES; ++world) if (ok[world] & {truth}) {{",
                "const M ok = all_i(-1);",
                *lines,
                "}",
            ]
        )
        return each.like([Lane(self, "F", name, 0.0, self.level) for name in names])

    def _explored(self, function: Callable[..., Any], arguments: Sequence[Any], answers: list[bool]) -> Any:
        outer, self._path, written = self._path, _Path(answers), self.written
        result = function(*(_mapped(lambda x: x, a) for a in arguments))
        taken, self._path = self._path.taken, outer
        if self.written != written:
            for truth, _ in taken:
                self.require(truth)
            return result
        # The first of several branches is outermost: its other side is chosen last.
        for i in reversed(range(len(answers), len(taken))):
            truth, answer = taken[i]
            mask = self.apply("M", "(~{})", lambda a: not a, truth) if answer else truth
            other_answers = [other for _, other in taken[:i]] + [not answer]
            result = self._chosen(mask, function, arguments, other_answers, result)
        return result

    def _chosen(
        self,
        mask: Lane,
        function: Callable[..., Any],
        arguments: Sequence[Any],
        answers: list[bool],
        result: Any,
    ) -> Any:
        """Return the result, replaced in the worlds of the mask by the result with other truth values at the
        branches."""
        depth, lines = len(self._other_branches), list[str]()
        known, path, self._known = self._known, self._path, self._known.new_child()
        self._other_branches.append((mask, lines))
        try:
            other = self._explored(function, arguments, answers)
        except LaneError:
            del self._other_branches[depth:]
            self._known, self._path = known, path
            self.place(self.level).append(
                f"ok &= ~({' & '.join([mask.name, *(m.name for m, _ in self._other_branches)])});"
            )
            return result
        self._other_branches.pop()
        if len(lines) <= SHORT:
            known.update(self._known.maps[0])
            self._known = known
            self.place(self.level).extend(lines)
            return _mapped(lambda a, b: a if _same(a, b) else _Library.where(mask, b, a), result, other)
        self._known = known
        names: list[str] = []

        def merged(a: Any, b: Any) -> Any:
            if _same(a, b):
                return a
            kind, (first, second) = _alike(a, b)
            name = f"n{next(self._names)}"
            names.append(f"{kind} {name} = {first};")
            lines.append(f"{name} = choose({mask.name}, {second}, {name});")
            return Lane(self, kind, name, a.example if isinstance(a, Lane) else a, self.level)

        result = _mapped(merged, result, other)
        if not self._other_branches and (bit := next(self._branch_numbers)) < REMEMBERED_BRANCHES:
            lines.append(f"branch_bits |= {mask.name} & all_i({1 << bit});")
        self.place(self.level).extend([*names, f"if (any({mask.name} & ok)) {{", *lines, "}"])
        return result


def _same(a: Any, b: Any) -> bool:
    return (
        a.name == b.name
        if isinstance(a, Lane) and isinstance(b, Lane)
        else a is b or _signature(a) == _signature(b)
    )


def _alike(a: Any, b: Any) -> tuple[str, list[str]]:
    """Return the common kind of two numbers, and their expressions in C++."""
    kind = next((x.kind for x in (a, b) if isinstance(x, Lane)), "")
    if not kind:
        kind = "M" if isinstance(a, bool) else "F" if isinstance(a, float) or isinstance(b, float) else "I"
    return kind, [x.name if isinstance(x, Lane) else _constant(kind, x) for x in (a, b)]


def _mapped(function: Callable[..., Any], first: Any, *others: Any) -> Any:
    """Return a result of the same structure, with a function applied to its numbers and those of the other results."""
    if isinstance(first, SimpleNamespace):
        rest = [vars(other) for other in others]
        return SimpleNamespace(
            **{k: _mapped(function, v, *(other[k] for other in rest)) for k, v in vars(first).items()}
        )
    if isinstance(first, LaneRow):
        columns = [first.numbers, *(other.numbers for other in others)]
        return first.like([function(*numbers) for numbers in zip(*columns, strict=True)])
    return function(first, *others) if isinstance(first, Lane | float | int) else first


def _row_sum(rows: Sequence[LaneRow]) -> LaneRow:
    return rows[0].like([_sum(numbers) for numbers in zip(*(row.numbers for row in rows), strict=True)])


def _signature(value: Any) -> Any:
    if isinstance(value, Lane):
        return value.name
    if isinstance(value, LaneRow):
        return (value.quaternion, *value.shape, *map(_signature, value.numbers))
    if isinstance(value, SimpleNamespace):
        return tuple(_signature(x) for x in vars(value).values())
    return (type(value), value) if isinstance(value, float | int) else id(value)


def _eight(elements: Sequence[str | None]) -> str:
    return "Eight{{" + ", ".join(map(str, elements)) + "}}"


def _word(number: Any) -> str:
    return number.name if isinstance(number, Lane) else _constant("F", number)


def _constant(kind: str, value: Any) -> str:
    if kind in "IM":
        return f"all_i({-int(value) if kind == 'M' else int(value)})"
    if kind == "D":
        return f"all_d({float(value)!r})"
    return f"all({float(value)!r}f)" if math.isfinite(value) else f"all({'-' if value < 0 else ''}INFINITY)"


def _each(form: str, function: Callable[..., Any], kind: str = "F") -> Callable[..., Any]:
    """Return a function that applies to numbers, or to rows number by number."""

    def apply(*arguments: Any) -> Any:
        first = next((a for a in arguments if isinstance(a, LaneRow)), None)
        if first is not None:
            columns = [a.numbers if isinstance(a, LaneRow) else [a] * len(first.numbers) for a in arguments]
            return first.like([apply(*numbers) for numbers in zip(*columns, strict=True)])
        lane = next((a for a in arguments if isinstance(a, Lane)), None)
        if lane is None:
            return function(*arguments)
        result_kind = "I" if kind == "F" and lane.kind == "I" else kind
        return lane.trace.apply(result_kind, form, function, *arguments)

    return apply


class _Library:
    """Warp's functions that traced code uses, for lane numbers, with Warp's formulas."""

    abs = staticmethod(_each("absolute({})", abs))
    sqrt = staticmethod(_each("root({})", lambda x: math.sqrt(max(x, 0.0))))
    sin = staticmethod(_each("sine({})", math.sin))
    cos = staticmethod(_each("cosine({})", math.cos))
    exp = staticmethod(_each("exponential({})", lambda x: math.exp(min(x, 80.0))))
    acos = staticmethod(_each("arccosine({})", lambda x: math.acos(min(max(x, -1.0), 1.0))))
    atan2 = staticmethod(_each("arctangent({}, {})", math.atan2))
    ceil = staticmethod(_each("ceiling({})", math.ceil))
    min = staticmethod(_each("least({}, {})", min))
    max = staticmethod(_each("most({}, {})", max))
    sign = staticmethod(_each("signum({})", lambda x: -1.0 if x < 0 else 1.0))
    isfinite = staticmethod(_each("finite({})", math.isfinite, "M"))
    cw_mul = staticmethod(lambda a, b: a.like([x * y for x, y in zip(a.numbers, b.numbers, strict=True)]))
    cw_div = staticmethod(lambda a, b: a.like([x / y for x, y in zip(a.numbers, b.numbers, strict=True)]))
    dot = staticmethod(lambda a, b: _sum([x * y for x, y in zip(a.numbers, b.numbers, strict=True)]))
    static = staticmethod(lambda value: value)

    @staticmethod
    def vec3(*numbers: Any) -> LaneRow:
        return LaneRow((3,), numbers if len(numbers) == 3 else (numbers or (0.0,)) * 3)

    @staticmethod
    def vec4(*numbers: Any) -> LaneRow:
        return LaneRow((4,), numbers if len(numbers) == 4 else (numbers or (0.0,)) * 4)

    @staticmethod
    def mat33(*numbers: Any) -> LaneRow:
        return LaneRow((3, 3), numbers if len(numbers) == 9 else (numbers or (0.0,)) * 9)

    @staticmethod
    def quat(*numbers: Any) -> LaneRow:
        return LaneRow((4,), numbers or (0.0,) * 4, quaternion=True)

    @staticmethod
    def quat_identity() -> LaneRow:
        return LaneRow((4,), (0.0, 0.0, 0.0, 1.0), quaternion=True)

    @classmethod
    def where(cls, truth: Any, a: Any, b: Any) -> Any:
        if isinstance(a, LaneRow):
            return a.like([cls.where(truth, x, y) for x, y in zip(a.numbers, b.numbers, strict=True)])
        if not isinstance(truth, Lane):
            return a if truth else b
        kind, operands = _alike(a, b)
        examples = [x.example if isinstance(x, Lane) else x for x in (a, b)]
        level = max(x.level for x in (truth, a, b) if isinstance(x, Lane))
        expression = f"choose({truth.name}, {operands[0]}, {operands[1]})"
        return truth.trace.line(kind, expression, examples[0 if truth.example else 1], level)

    @staticmethod
    def float64(x: Any) -> Any:
        return x.trace.apply("D", "to_double({})", float, x) if isinstance(x, Lane) else float(x)

    @staticmethod
    def float32(x: Any) -> Any:
        return _to_float(x)

    @staticmethod
    def transpose(M: LaneRow) -> LaneRow:
        rows, columns = M.shape
        return LaneRow((columns, rows), [M[i, j] for j in range(columns) for i in range(rows)])

    @staticmethod
    def skew(a: LaneRow) -> LaneRow:
        return LaneRow((3, 3), [0.0, -a[2], a[1], a[2], 0.0, -a[0], -a[1], a[0], 0.0])

    @staticmethod
    def quat_inverse(q: LaneRow) -> LaneRow:
        return q.like([-q[0], -q[1], -q[2], q[3]])

    @classmethod
    def clamp(cls, x: Any, low: Any, high: Any) -> Any:
        return cls.min(cls.max(low, x), high)

    @classmethod
    def length(cls, a: LaneRow) -> Any:
        return cls.sqrt(cls.dot(a, a))

    @classmethod
    def normalize(cls, a: LaneRow) -> LaneRow:
        return a / cls.length(a)

    @staticmethod
    def cross(a: LaneRow, b: LaneRow) -> LaneRow:
        return LaneRow(
            (3,), [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
        )

    @staticmethod
    def get_diag(M: LaneRow) -> LaneRow:
        return LaneRow((M.shape[0],), [M[i, i] for i in range(M.shape[0])])

    @classmethod
    def quat_rotate(cls, q: LaneRow, x: LaneRow) -> LaneRow:
        return cls._rotated(q, x, 1.0)

    @classmethod
    def quat_rotate_inv(cls, q: LaneRow, x: LaneRow) -> LaneRow:
        return cls._rotated(q, x, -1.0)

    @staticmethod
    def quat_to_matrix(q: LaneRow) -> LaneRow:
        x, y, z, w = q.numbers
        c = 2.0 * w * w - 1.0
        return LaneRow(
            (3, 3),
            [
                *(c + 2.0 * x * x, 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
                *(2.0 * (x * y + w * z), c + 2.0 * y * y, 2.0 * (y * z - w * x)),
                *(2.0 * (x * z - w * y), 2.0 * (y * z + w * x), c + 2.0 * z * z),
            ],
        )

    @classmethod
    def _rotated(cls, q: LaneRow, x: LaneRow, way: float) -> LaneRow:
        i, c = LaneRow((3,), q.numbers[:3]), 2.0 * q[3] * q[3] - 1.0
        return c * x + (2.0 * cls.dot(i, x)) * i + (way * 2.0 * q[3]) * cls.cross(i, x)


def zero_of(kind: Any) -> Any:
    """Return the zero of a scalar, vector or matrix type of Warp."""
    if kind in (float, wp.float32, wp.float64):
        return 0.0
    if kind in (int, wp.int32):
        return 0
    if kind in (bool, wp.bool):
        return False
    if not hasattr(kind, "_shape_"):
        raise LaneError(f"numbers of type {kind} are not available for several worlds together")
    shape = tuple(kind._shape_)
    return LaneRow(shape, [0.0] * math.prod(shape), quaternion=issubclass(kind, wp.quat))


class _Struct:
    """Struct type; a call creates a struct of zeros."""

    def __init__(self, struct: Any) -> None:
        self.fields = struct.cls.__annotations__

    def __call__(self) -> SimpleNamespace:
        return SimpleNamespace(**{name: zero_of(kind) for name, kind in self.fields.items()})


class _LaneType:
    """Vector or matrix type; a call creates a value."""

    def __init__(self, kind: Any) -> None:
        self.kind = kind

    def __call__(self, *numbers: Any) -> LaneRow:
        row: LaneRow = zero_of(self.kind)
        if len(numbers) == 1 and isinstance(numbers[0], LaneRow):
            return row.like(numbers[0].numbers)
        if numbers:
            row.numbers = list(numbers) if len(numbers) > 1 else list(numbers) * len(row.numbers)
        return row


def _to_float(x: Any = 0.0) -> Any:
    if isinstance(x, Lane):
        return x if x.kind == "F" else x.trace.apply("F", "to_float({})", float, x)
    return float(x)


def _to_int(x: Any = 0) -> Any:
    if isinstance(x, Lane):
        return x if x.kind == "I" else x.trace.apply("I", "to_int({})", int, x)
    return int(x)


def _range(*ends: Any) -> range:
    if len(ends) > 1 and any(isinstance(end, Lane) for end in ends):
        raise LaneError("a loop's ends differ between worlds")
    return range(*ends)


_FUNCTIONS: dict[Any, Callable[..., Any]] = {}


def sum_in_lanes(function: Any, term: Any, few: int = 0) -> None:
    """Declare that a Warp function is the sum of another function over an index, which is its additional first
    argument.

    Args:
        function: The sum; without `few`, its first two arguments are the first index and the end of the range.
        term: The function that is summed.
        few: Number of indices, from 0 on, for short sums that are needed in few worlds; else 0.
    """

    def traced(*arguments: Any) -> Any:
        trace, summand = Trace.active[-1], lane_function(term)
        if few:
            return trace.world_by_world(summand, few, arguments)
        return trace.sum_over(summand, arguments[0], arguments[1], arguments[2:])

    _FUNCTIONS[function] = traced


def lane_function(function: Any) -> Callable[..., Any]:
    """Return the Python of a Warp function, with Warp's functions and types replaced by those for lane numbers."""
    if function in _FUNCTIONS:
        return _FUNCTIONS[function]
    python = function.func
    names: dict[str, Any] = {"__builtins__": builtins, "float": _to_float, "int": _to_int, "range": _range}
    cells = tuple(CellType(_exchanged(cell.cell_contents)) for cell in python.__closure__ or ())
    plain = FunctionType(python.__code__, names, python.__name__, python.__defaults__, cells)

    def traced(*arguments: Any) -> Any:
        if Trace.active:
            return Trace.active[-1].call(plain, arguments)
        # Warp passes vectors by value: the caller does not see assignments to their elements.
        return plain(*(a.like(a.numbers) if isinstance(a, LaneRow) else a for a in arguments))

    _FUNCTIONS[function] = traced
    for name in python.__code__.co_names:
        if name in python.__globals__:
            names[name] = _exchanged(python.__globals__[name])
    return traced


def _exchanged(value: Any) -> Any:
    if value is wp:
        return _Library
    if isinstance(value, wp.Function):
        return lane_function(value)
    if hasattr(value, "numpy_dtype") and hasattr(value, "cls"):
        return _Struct(value)
    if isinstance(value, type) and hasattr(value, "_shape_"):
        return _LaneType(value)
    return value


class StructArray:
    """Array of structs by (world, vehicle): fields are loaded once, and assigned fields are stored at the end."""

    def __init__(
        self, trace: Trace, name: str, struct: Any, examples: Mapping[str, Any], shared: bool = False
    ) -> None:
        """Set the name in C++, the type, examples of fields (1 by default), and whether worlds may share the
        struct."""
        layout = np.dtype(struct.numpy_dtype())
        if layout.itemsize < 4 * LANES:
            raise LaneError(f"{name} has {layout.itemsize // 4} numbers, expected at least {LANES}")
        fields = {f: (kind, (layout.fields or {})[f][1]) for f, kind in struct.cls.__annotations__.items()}
        self.__dict__.update(
            _trace=trace,
            _name=name,
            _fields=fields,
            _examples=examples,
            _size=layout.itemsize // 4,
            _shared=shared,
            _assigned={},
        )

    def __getitem__(self, index: Any) -> StructArray:
        return self

    def __getattr__(self, field: str) -> Any:
        kind, offset = self._fields[field]
        value = zero_of(kind)
        row = value if isinstance(value, LaneRow) else LaneRow((1,), [value])
        example = self._examples.get(field, 1)
        examples = np.broadcast_to(np.asarray(example, float).reshape(-1), len(row.numbers)).tolist()
        for i, x in enumerate(examples):
            number = self._trace.line("F", self._place(offset // 4 + i), x, 0)
            row.numbers[i] = (
                self._trace.apply("I", "(I){}", int, number) if isinstance(value, int) else number
            )
        return row if isinstance(value, LaneRow) else row.numbers[0]

    def _place(self, index: int) -> str:
        """Return the C++ of the number at that index of the struct, which is read together with seven neighbours."""
        first = min(LANES * (index // LANES), self._size - LANES)
        name = f"{self._name}_{first}"
        statement = f"fetch({self._name}_at, {4 * first}, {name});"
        if self._shared and (f"F {name}[LANES];" in self._trace.outside or not self._trace.in_other_branch):
            # Data that all worlds share are read for the first block of a group.
            self._trace.outside[f"F {name}[LANES];"] = None
            self._trace.once(f"if (first == 0 || {self._name}_at.world != 0) {statement}", 0)
        else:
            self._trace.once(f"F {name}[LANES]; {statement}", 0)
        return f"{name}[{index - first}]"

    def __setattr__(self, field: str, value: Any) -> None:
        _, offset = self._fields[field]
        for i, number in enumerate(value.numbers if isinstance(value, LaneRow) else [value]):
            self._assigned[offset // 4 + i] = _word(number)

    def stores(self) -> list[str]:
        """Return the C++ that stores assigned numbers, in groups of eight neighbours where possible."""
        lines, assigned = [], dict(sorted(self._assigned.items()))
        while assigned:
            first = next(iter(assigned))
            piece = [assigned.pop(first + i, None) for i in range(LANES)]
            if None not in piece:
                lines.append(f"put({self._name}_at, {4 * first}, {_eight(piece)});")
                continue
            lines += [
                f"put_one({self._name}_at, {4 * (first + i)}, {word});"
                for i, word in enumerate(piece)
                if word
            ]
        return lines


class NumberArray(StructArray):
    """Array of numbers by world, vehicle and a constant index; its last axis has at least eight elements."""

    def __init__(self, trace: Trace, name: str, size: int) -> None:
        """Set the name in C++ and the size of the last axis."""
        self.__dict__.update(_trace=trace, _name=name, _size=size, _assigned={}, _shared=False)

    def __getitem__(self, index: Any) -> Any:
        return self._trace.line("F", self._place(index[2]), 1.0, 0)


class VectorArray:
    """Array of vectors by three indices: world, vehicle and a lane number."""

    def __init__(self, trace: Trace, name: str, kind: Any, slot: int) -> None:
        """Set the name in C++, the type, and the position of the lane number among the indices."""
        self._trace, self._name, self._size, self._slot = trace, name, math.prod(kind._shape_), slot
        self._written: list[tuple[Lane, LaneRow]] = []

    def __getitem__(self, index: Any) -> LaneRow:
        slot = index[self._slot]
        name = f"{self._name}_{slot.name}"
        self._trace.once(f"F {name}[LANES]; gather({self._name}_at, {slot.name}, {name});", slot.level)
        row = LaneRow(
            (self._size,), [self._trace.line("F", f"{name}[{i}]", 0.0, slot.level) for i in range(LANES)]
        )
        for written_slot, value in self._written:
            row = _Library.where(slot == written_slot, value, row)
        return row

    def __setitem__(self, index: Any, value: LaneRow) -> None:
        slot = index[self._slot]
        self._written.append((slot, value))

    def stores(self) -> list[str]:
        """Return the C++ that stores assigned vectors; groups of eight numbers may overlap."""
        starts = sorted({*range(0, self._size - LANES + 1, LANES), self._size - LANES})
        return [
            f"put_at({self._name}_at, {slot.name}, {4 * first}, "
            f"{_eight([_word(number) for number in value.numbers[first : first + LANES]])});"
            for slot, value in self._written
            for first in starts
        ]


class Untraced:
    """Object that functions for several worlds cannot use: a world that needs it leaves its block."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, field: str) -> Any:
        raise LaneError(f"{self._name}.{field} is not available for several worlds together")


class UniformStruct:
    """Struct that all worlds share."""

    def __init__(
        self, trace: Trace, name: str, struct: Any, examples: Mapping[str, Any], **known: Any
    ) -> None:
        """Set the name in C++, the type, examples of fields (1 by default), and known fields."""
        self._trace, self._name, self._fields, self._examples, self._known = (
            trace,
            name,
            struct.cls.__annotations__,
            examples,
            known,
        )

    def __getattr__(self, field: str) -> Any:
        if field in self._known:
            return self._known[field]
        value = zero_of(self._fields[field])
        if isinstance(value, LaneRow):
            raise LaneError(f"field {field} of {self._name} is not a number")
        kind, call = ("I", "all_i") if isinstance(value, int) else ("F", "all")
        return self._trace.line(kind, f"{call}({self._name}.{field})", self._examples.get(field, 1), 0)


class WorldStruct:
    """Struct of arrays whose first index is the world, and of numbers that all worlds share."""

    def __init__(self, trace: Trace, name: str, actual: Any, examples: Mapping[str, Any]) -> None:
        """Set the name in C++, an instance that provides the sizes, and examples of numbers (1 by default)."""
        self._trace, self._name, self._actual, self._examples = trace, name, actual, examples

    def __getattr__(self, field: str) -> Any:
        kind, name = self._actual._cls.vars[field].type, f"{self._name}.{field}"
        value = getattr(self._actual, field)
        if isinstance(kind, wp.array):
            return self._trace.arrays.setdefault(
                name, WorldArray(self._trace, name, kind.dtype, value, self._examples.get(field, 1))
            )
        if hasattr(value, "_cls"):
            return WorldStruct(self._trace, name, value, self._examples)
        if isinstance(value, int):
            return self._trace.size(name, int(value))
        row = zero_of(kind)
        if isinstance(row, LaneRow) and kind._wp_scalar_type_ is wp.float32:
            return row.like(
                [self._trace.line("F", f"all({name}[{i}])", 1.0, 0) for i in range(len(row.numbers))]
            )
        return self._trace.line("F", f"all({name})", self._examples.get(field, 1.0), 0)


class WorldArray:
    """Array by world; its other indices are constants."""

    def __init__(self, trace: Trace, name: str, kind: Any, actual: Any, example: float) -> None:
        """Set the name in C++, the type of the elements, an array that provides the shape, and an example of a
        number."""
        self._trace, self._name, self._kind, self._actual, self._example = trace, name, kind, actual, example
        self._now: dict[tuple[tuple[int, ...], int], Any] = {}
        if getattr(kind, "_wp_scalar_type_", kind) not in (float, int, wp.float32, wp.int32):
            raise LaneError(f"numbers of {name} are not available for several worlds together")
        if actual.ndim > 1 and not isinstance(zero_of(kind), LaneRow):
            trace.size(f"{name}.strides[{actual.ndim - 1}]", 4)

    @property
    def shape(self) -> dict[int, int]:
        """Return the sizes of the axes after the first, by axis."""
        return {
            i: self._trace.size(f"{self._name}.shape[{i}]", n) for i, n in enumerate(self._actual.shape) if i
        }

    def _row(self, index: Any) -> tuple[tuple[int, ...], int | None]:
        """Return the indices of a row of numbers, and the index within it; None means all numbers of a vector."""
        others = index[1:] if isinstance(index, tuple) else ()
        if not all(isinstance(i, int) for i in others):
            raise LaneError(f"an index of {self._name} differs between worlds")
        return (others, None) if isinstance(zero_of(self._kind), LaneRow) else (others[:-1], (0, *others)[-1])

    def _width(self) -> int:
        row = zero_of(self._kind)
        return len(row.numbers) if isinstance(row, LaneRow) else int((1, *self._actual.shape[1:])[-1])

    def _offset(self, row: Sequence[int]) -> str:
        return "".join(f"{i} * (int){self._name}.strides[{k}] + " for k, i in enumerate(row, 1) if i)

    def _read(self, row: tuple[int, ...], i: int) -> Any:
        if (row, i) in self._now:
            return self._now[row, i]
        kind = "I" if isinstance(zero_of(self._kind), int) else "F"
        if self._actual.ndim == 1 and self._width() == 1:
            return self._trace.line(kind, f"({kind})pick({self._name})", self._example, 0)
        first, count = max(0, min(LANES * (i // LANES), self._width() - LANES)), min(self._width(), LANES)
        name = "_".join(map(str, (self._name.replace(".", "_"), *row, first)))
        offset = f"{self._offset(row)}{4 * first}"
        self._trace.once(f"F {name}[LANES]; fetch_world({self._name}, {offset}, {count}, {name});", 0)
        return self._trace.line(kind, f"({kind}){name}[{i - first}]", self._example, 0)

    def __getitem__(self, index: Any) -> Any:
        row, i = self._row(index)
        if i is not None:
            return self._read(row, i)
        value = zero_of(self._kind)
        return value.like([self._read(row, k) for k in range(len(value.numbers))])

    def __setitem__(self, index: Any, value: Any) -> None:
        if self._trace._other_branches:
            raise LaneError(f"{self._name} is written by some worlds alone")
        self._trace.written += 1
        row, i = self._row(index)
        for k, number in enumerate(value.numbers) if i is None else [(i, value)]:
            self._now[row, k] = number

    def stores(self) -> list[str]:
        """Return the C++ that stores assigned numbers, neighbours together."""
        lines, kind = [], "I" if isinstance(zero_of(self._kind), int) else "F"
        words = {
            key: f"(F){x.name if isinstance(x, Lane) else _constant(kind, x)}"
            for key, x in sorted(self._now.items())
        }
        while words:
            row, first = next(iter(words))
            piece = [words.pop((row, first))]
            if self._actual.ndim == 1 and self._width() == 1:
                lines.append(f"keep({self._name}, {piece[0]});")
                continue
            while len(piece) < LANES and (row, first + len(piece)) in words:
                piece.append(words.pop((row, first + len(piece))))
            offset = f"{self._offset(row)}{4 * first}"
            lines.append(f"put_world({self._name}, {offset}, {len(piece)}, {_eight(piece)});")
        return lines


def _shared(index: Any) -> str:
    """Return the C++ of an index that all worlds of a block share; worlds with another index than the first leave."""
    if not isinstance(index, Lane):
        return str(index)
    if index.name != "all_i(index)":
        index.trace.require(
            index.trace.line("M", f"({index.name} == all_i({index.name}[0]))", True, index.level)
        )
    return f"{index.name}[0]"


class SharedStruct:
    """Struct of arrays that all worlds share, with one index."""

    def __init__(self, trace: Trace, name: str, struct: Any) -> None:
        """Set the name in C++ and the type."""
        self._trace, self._name, self._struct = trace, name, struct

    def __getattr__(self, field: str) -> Any:
        return _SharedArray(self._trace, f"{self._name}.{field}", self._struct.vars[field].type.dtype)


class _SharedArray:
    def __init__(self, trace: Trace, name: str, kind: Any) -> None:
        self._trace, self._name, self._kind = trace, name, kind

    def __getitem__(self, index: Any) -> Any:
        value, level = zero_of(self._kind), index.level if isinstance(index, Lane) else 0
        kind, call, number = ("I", "all_i", "int") if isinstance(value, int) else ("F", "all", "float")
        place = f"((const {number}*)((const char*){self._name}.data + {_shared(index)} * {self._name}.strides[0]))"
        numbers = [
            self._trace.line(kind, f"{call}({place}[{i}])", 1, level)
            for i in range(len(value.numbers) if isinstance(value, LaneRow) else 1)
        ]
        return value.like(numbers) if isinstance(value, LaneRow) else numbers[0]


class LaneLoop:
    """Struct of lane numbers that a C++ loop carries from one pass to the next."""

    def __init__(self, trace: Trace, name: str, start: SimpleNamespace) -> None:
        """Initialise the variables with values computed in section 0."""
        self._trace, self._name, self._start = trace, name, start
        for word, number in zip(self._operands(), _numbers(start), strict=True):
            trace.sections[0].append(f"F {word} = {_word(number)};")

    def _operands(self) -> list[str]:
        return [f"{self._name}_{i}" for i in range(len(_numbers(self._start)))]

    def value(self) -> SimpleNamespace:
        """Return the struct, in the section that is being written."""
        examples = [n.example if isinstance(n, Lane) else n for n in _numbers(self._start)]
        lanes = iter(
            [self._trace.symbol("F", word, x) for word, x in zip(self._operands(), examples, strict=True)]
        )
        return SimpleNamespace(
            **{
                field: value.like([next(lanes) for _ in value.numbers])
                if isinstance(value, LaneRow)
                else next(lanes)
                for field, value in vars(self._start).items()
            }
        )

    def carry(self, value: SimpleNamespace) -> None:
        """Set the values for the next pass of the loop."""
        for word, number in zip(self._operands(), _numbers(value), strict=True):
            if _word(number) != word:
                self._trace.sections[1].append(f"const F {word}_next = {_word(number)};")
        for word, number in zip(self._operands(), _numbers(value), strict=True):
            if _word(number) != word:
                self._trace.sections[1].append(f"{word} = {word}_next;")


def _numbers(struct: SimpleNamespace) -> list[Any]:
    return [
        number
        for value in vars(struct).values()
        for number in (value.numbers if isinstance(value, LaneRow) else [value])
    ]


def group_source(
    trace: Trace, arrays: Sequence[StructArray | VectorArray], declarations: str, loop: str, branches: str
) -> str:
    """Return the text of a native function that computes the trace for a group of `count` worlds from `w` on.

    Args:
        trace: Lines of the function.
        arrays: Arrays that it reads and writes.
        declarations: C++ of the symbols, and of the pointer NAME_at of each array.
        loop: Head of the C++ loop around section 1.
        branches: C++ of the number whose bits are the branches that `world` of the group took in the last step. The
            function updates it; -1 means that the world is not computed. It determines only which worlds share a block.
    """
    lines = [
        FLOATS,
        *trace.outside,
        GATHERING,
        PREAMBLE,
        declarations,
        *trace.sections[0],
        f"{loop} {{",
        *trace.sections[1],
        "}",
        *trace.sections[2],
        "for (int l = 0; l <= last; ++l) branches_of(at[l]) = ok[l] ? branch_bits[l] : -1;",
        *(line for array in arrays for line in array.stores()),
        "}",
    ]
    text = "\n".join(lines).replace("BRANCHES_OF", branches)
    kinds = str(1 << REMEMBERED_BRANCHES)
    return text.replace("LANES", str(LANES)).replace("GROUP", str(GROUP)).replace("KINDS", kinds)


def world_source(trace: Trace, truth: Any) -> str:
    """Return the text of a native function that computes a trace, which writes by world, for `count` worlds from `w`
    on.

    The low bits of the function's value are the worlds that are done; all other worlds are unchanged. The bits from
    LANES on are those of them for which a truth holds.
    """
    lines = [
        "const int last = count - 1; int at[LANES]; for (int l = 0; l < LANES; ++l) at[l] = l < last ? l : last;",
        FLOATS,
        PREAMBLE,
        *itertools.chain(*trace.sections),
        *(line for array in trace.arrays.values() for line in array.stores()),
        "unsigned bits = 0;",
        f"for (int l = 0; l <= last; ++l) bits |= (ok[l] & 1u) << l | (ok[l] & {_word(truth)}[l] & 1u) << (LANES + l);",
        "return bits;",
    ]
    return "\n".join(lines).replace("LANES", str(LANES))


GATHERING = """
const auto branches_of = [&](int world) -> int& { return BRANCHES_OF; };
int order[GROUP], kinds[KINDS + 1] = {};
for (int i = 0; i < count; ++i) ++kinds[branches_of(i) < 0 ? KINDS : branches_of(i) + 1];
for (int k = 1; k < KINDS; ++k) kinds[k] += kinds[k - 1];
for (int i = 0; i < count; ++i) order[kinds[branches_of(i) < 0 ? KINDS - 1 : branches_of(i)]++] = i;
for (int first = 0; first < count; first += LANES) {
const int last = (count - first < LANES ? count - first : LANES) - 1;
int at[LANES];
for (int l = 0; l < LANES; ++l) at[l] = order[first + (l < last ? l : last)];
"""
"""C++ that sorts the group by counting, and begins the loop over its blocks."""

FLOATS = "typedef float F __attribute__((vector_size(4 * LANES)));"
PREAMBLE = """
typedef int I __attribute__((vector_size(4 * LANES)));
typedef int M __attribute__((vector_size(4 * LANES)));
typedef double D __attribute__((vector_size(8 * LANES)));
struct At { char* p; long world; long slot; };
struct Eight { F y[LANES]; };
const auto all = [](float x) { F y; for (int l = 0; l < LANES; ++l) y[l] = x; return y; };
const auto all_i = [](int x) { I y; for (int l = 0; l < LANES; ++l) y[l] = x; return y; };
const auto all_d = [](double x) { D y; for (int l = 0; l < LANES; ++l) y[l] = x; return y; };
const auto any = [](M m) { return __builtin_reduce_or(m) != 0; };
const auto total = [](F x, int count) {
    for (int half = count / 2; half; half /= 2) for (int l = 0; l < half; ++l) x[l] += x[l + half];
    return x[0];
};
const auto choose = [](M m, auto a, auto b) { return m ? a : b; };
const auto least = [](auto a, auto b) { return a < b ? a : b; };
const auto most = [](auto a, auto b) { return a > b ? a : b; };
const auto absolute = [](F x) { return (F)((I)x & 0x7fffffff); };
const auto signum = [&](F x) { return x < 0.0f ? all(-1.0f) : all(1.0f); };
const auto finite = [&](F x) { return (M)(absolute(x) < all(INFINITY)); };
const auto nearest = [](F x) {
    const F half = (F)(((I)x & (int)0x80000000) | 0x3f000000);
    return __builtin_convertvector(__builtin_convertvector(x + half, I), F);
};
const auto root = [](F x) { return __builtin_elementwise_sqrt(x); };
const auto sine = [](F x) { F y; for (int l = 0; l < LANES; ++l) y[l] = ::sinf(x[l]); return y; };
const auto cosine = [](F x) { F y; for (int l = 0; l < LANES; ++l) y[l] = ::cosf(x[l]); return y; };
const auto exponential = [&](F x) {
    const F r = least(all(88.0f), most(all(-87.0f), x)), n = nearest(1.44269504f * r);
    const F z = r - n * 0.693359375f + n * 2.12194440e-4f;
    F y = 1.9875691500e-4f * z + 1.3981999507e-3f;
    y = ((y * z + 8.3334519073e-3f) * z + 4.1665795894e-2f) * z + 1.6666665459e-1f;
    y = (y * z + 5.0000001201e-1f) * z * z + z + 1.0f;
    return x > 88.0f ? all(INFINITY) : y * (F)((__builtin_convertvector(n, I) + 127) << 23);
};
const auto arctangent = [&](F y, F x) {
    const F a = absolute(y), b = absolute(x), greater = most(a, b);
    const F t = greater > 0.0f ? least(a, b) / greater : all(0.0f);
    const M far = t > 0.41421356f;
    const F s = far ? (t - 1.0f) / (t + 1.0f) : t, z = s * s;
    F r = ((8.05374449538e-2f * z - 1.38776856032e-1f) * z + 1.99777106478e-1f) * z - 3.33329491539e-1f;
    r = r * z * s + s + (far ? all(0.78539816f) : all(0.0f));
    r = a > b ? 1.57079633f - r : r;
    r = (I)x < 0 ? 3.14159265f - r : r;
    return (F)((I)r | ((I)y & (int)0x80000000));
};
const auto arccosine = [&](F x) {
    const F c = least(all(1.0f), most(all(-1.0f), x));
    return arctangent(root((1.0f - c) * (1.0f + c)), c);
};
const auto ceiling = [](F x) { return __builtin_elementwise_ceil(x); };
const auto to_double = [](F x) { return __builtin_convertvector(x, D); };
const auto to_float = [](auto x) { return __builtin_convertvector(x, F); };
const auto to_int = [](F x) { return __builtin_convertvector(x, I); };
M ok = all_i(-1), branch_bits = all_i(0);
const auto transpose = [](F* y) {
    F a[LANES], b[LANES];
    for (int i = 0; i < 8; i += 2) {
        a[i] = __builtin_shufflevector(y[i], y[i + 1], 0, 8, 2, 10, 4, 12, 6, 14);
        a[i + 1] = __builtin_shufflevector(y[i], y[i + 1], 1, 9, 3, 11, 5, 13, 7, 15);
    }
    for (int i = 0; i < 8; i += 4)
        for (int k = i; k < i + 2; ++k) {
            b[k] = __builtin_shufflevector(a[k], a[k + 2], 0, 1, 8, 9, 4, 5, 12, 13);
            b[k + 2] = __builtin_shufflevector(a[k], a[k + 2], 2, 3, 10, 11, 6, 7, 14, 15);
        }
    for (int k = 0; k < 4; ++k) {
        y[k] = __builtin_shufflevector(b[k], b[k + 4], 0, 1, 2, 3, 8, 9, 10, 11);
        y[k + 4] = __builtin_shufflevector(b[k], b[k + 4], 4, 5, 6, 7, 12, 13, 14, 15);
    }
};
const auto load = [&](const char* p, const I& from, long world, int count, F* y) {
    for (int l = 0; l < LANES; ++l) __builtin_memcpy(y + l, p + at[l] * world + from[l], 4 * count);
    transpose(y);
};
const auto save = [&](char* p, const I& from, long world, int count, const Eight& eight) {
    Eight e = eight;
    transpose(e.y);
    for (int l = 0; l <= last; ++l)
        if (ok[l]) __builtin_memcpy(p + at[l] * world + from[l], e.y + l, 4 * count);
};
const auto fetch = [&](const At& a, int offset, F* y) {
    if (a.world != 0) return load(a.p, all_i(offset), a.world, LANES, y);
    for (int i = 0; i < LANES; ++i) y[i] = all(*(const float*)(a.p + offset + 4 * i));
};
const auto gather = [&](const At& a, I slot, F* y) { load(a.p, slot * (int)a.slot, a.world, LANES, y); };
const auto put_at = [&](const At& a, I slot, int offset, const Eight& eight) {
    save(a.p, slot * (int)a.slot + offset, a.world, LANES, eight);
};
const auto put = [&](const At& a, int offset, const Eight& eight) { put_at(a, all_i(0), offset, eight); };
const auto put_one = [&](const At& a, int offset, F x) {
    for (int l = 0; l <= last; ++l) if (ok[l]) *(float*)(a.p + at[l] * a.world + offset) = x[l];
};
const auto fetch_world = [&](const auto& a, int offset, int count, F* y) {
    load((const char*)a.data + w * a.strides[0] + offset, all_i(0), a.strides[0], count, y);
};
const auto put_world = [&](const auto& a, int offset, int count, const Eight& eight) {
    save((char*)a.data + w * a.strides[0] + offset, all_i(0), a.strides[0], count, eight);
};
const auto pick = [&](const auto& a) {
    F y; const char* p = (const char*)a.data + w * a.strides[0];
    if (a.strides[0] == 4 && last == LANES - 1) __builtin_memcpy(&y, p, sizeof(F));
    else for (int l = 0; l < LANES; ++l) y[l] = *(const float*)(p + at[l] * a.strides[0]);
    return y;
};
const auto keep = [&](const auto& a, auto y) {
    char* p = (char*)a.data + w * a.strides[0];
    if (a.strides[0] == 4 && last == LANES - 1 && !any(~ok)) __builtin_memcpy(p, &y, sizeof(F));
    else for (int l = 0; l <= last; ++l) if (ok[l]) __builtin_memcpy(p + l * a.strides[0], (const char*)&y + 4 * l, 4);
};
"""
"""Types and functions of the traced lines, as lambdas, which are allowed inside the text of a native function."""
