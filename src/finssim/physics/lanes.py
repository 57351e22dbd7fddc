"""Eight worlds in a register: C++ for a block of worlds, traced from the very functions that a kernel runs for one.

A compiler that sees one world at a time fills one place of eight in a processor's registers. So the Warp functions of
a step are called here once, from plain Python, with *lane numbers* in place of floats: each operation writes a line of
C++ that does it for eight worlds at once. There is one source of the equations, and no second one.

Where a function branches, the trace follows the branch that its example takes (a submerged vehicle in open water), and
notes the condition: a world for which it does not hold is left to the kernel for one world. So what happens in a world
depends on that world alone, whoever shares its block.
"""

# mypy: disable-error-code="no-any-return"

from __future__ import annotations

import builtins
import math
from collections.abc import Callable, Mapping, Sequence
from types import CellType, FunctionType, SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

LANES = 8
"""Worlds in a block."""


class LaneError(TypeError):
    """A function uses an operation that is not available for several worlds together."""


class Lane:
    """A number in each of a block's worlds, with an example of it that decides where branches go.

    Attributes:
        kind: F (float32), I (int32) or M (a truth).
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
        return self._with(other, "+", lambda a, b: a + b)

    def __radd__(self, other: Any) -> Any:
        return self._from(other, "+", lambda a, b: a + b)

    def __sub__(self, other: Any) -> Any:
        return self._with(other, "-", lambda a, b: a - b)

    def __rsub__(self, other: Any) -> Any:
        return self._from(other, "-", lambda a, b: a - b)

    def __mul__(self, other: Any) -> Any:
        return self._with(other, "*", lambda a, b: a * b)

    def __rmul__(self, other: Any) -> Any:
        return self._from(other, "*", lambda a, b: a * b)

    def __truediv__(self, other: Any) -> Any:
        return self._with(other, "/", _divide)

    def __rtruediv__(self, other: Any) -> Any:
        return self._from(other, "/", _divide)

    def __mod__(self, other: Any) -> Any:
        return self._with(other, "%", lambda a, b: a % b)

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
        """A branch: the example's way, which is the way of the worlds that stay in the block."""
        truth = self if self.kind == "M" else self != 0
        self.trace.require(truth)
        return bool(truth.example)


def _divide(a: Any, b: Any) -> Any:
    return a / b if b else math.copysign(math.inf, a)


class LaneRow:
    """A vector, quaternion or matrix of lane numbers and constants, row by row."""

    def __init__(self, shape: tuple[int, ...], numbers: Sequence[Any], quaternion: bool = False) -> None:
        self.shape, self.numbers, self.quaternion = shape, list(numbers), quaternion

    def like(self, numbers: Sequence[Any]) -> LaneRow:
        """Other numbers in the same shape."""
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


class Trace:
    """Lines of C++, as the functions that are called with its lane numbers write them.

    A line stands outside the loop over substeps if all that it needs does.
    """

    def __init__(self) -> None:
        self.sections: list[list[str]] = [[], [], []]
        """Before the loop, in it, after it."""
        self.level = 0
        """Section of the lines that need nothing."""
        self._known: dict[tuple[str, str, int], Lane] = {}

    def symbol(self, kind: str, name: str, example: Any) -> Lane:
        """A lane number that the C++ around the trace declares."""
        return Lane(self, kind, name, example, self.level)

    def line(self, kind: str, expression: str, example: Any, level: int | None = None) -> Lane:
        """A lane number by its C++ expression; the same one for the same expression in the same section."""
        level = self.level if level is None else level
        key = (kind, expression, level)
        if key not in self._known:
            name = f"n{len(self._known)}"
            self.sections[level].append(f"const {kind} {name} = {expression};")
            self._known[key] = Lane(self, kind, name, example, level)
        return self._known[key]

    def apply(self, kind: str, form: str, function: Callable[..., Any], *arguments: Any) -> Any:
        """An operation on lane numbers and constants; of constants alone, the constant that it gives."""
        lanes = [a for a in arguments if isinstance(a, Lane)]
        example = function(*(a.example if isinstance(a, Lane) else a for a in arguments))
        if not lanes:
            return example
        operand = next((a.kind for a in lanes if a.kind != "M"), "M")
        operands = [a.name if isinstance(a, Lane) else _constant(operand, a) for a in arguments]
        return self.line(kind, form.format(*operands), example, max(a.level for a in lanes))

    def require(self, truth: Lane) -> None:
        """Leave the worlds to the kernel for one in which this is not as in the example."""
        self.sections[truth.level].append(f"ok &= {'' if truth.example else '~'}{truth.name};")


def _eight(elements: Sequence[str | None]) -> str:
    return "Eight{{" + ", ".join(map(str, elements)) + "}}"


def _word(number: Any) -> str:
    return number.name if isinstance(number, Lane) else _constant("F", number)


def _constant(kind: str, value: Any) -> str:
    if kind == "I":
        return f"all_i({int(value)})"
    return f"all({float(value)!r}f)" if math.isfinite(value) else f"all({'-' if value < 0 else ''}INFINITY)"


def _each(form: str, function: Callable[..., Any], kind: str = "F") -> Callable[..., Any]:
    """A function of numbers, or of rows number by number."""

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
    """Functions of Warp that the traced code uses, on lane numbers, with Warp's formulas."""

    abs = staticmethod(_each("absolute({})", abs))
    sqrt = staticmethod(_each("root({})", lambda x: math.sqrt(max(x, 0.0))))
    sin = staticmethod(_each("sine({})", math.sin))
    cos = staticmethod(_each("cosine({})", math.cos))
    exp = staticmethod(_each("exponential({})", math.exp))
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
        kind = next((x.kind for x in (a, b) if isinstance(x, Lane)), "F" if isinstance(a, float) else "I")
        operands = [x.name if isinstance(x, Lane) else _constant(kind, x) for x in (a, b)]
        examples = [x.example if isinstance(x, Lane) else x for x in (a, b)]
        level = max(x.level for x in (truth, a, b) if isinstance(x, Lane))
        expression = f"choose({truth.name}, {operands[0]}, {operands[1]})"
        return truth.trace.line(kind, expression, examples[0 if truth.example else 1], level)

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
    """Zero of a scalar, vector or matrix type of Warp."""
    if kind in (float, wp.float32):
        return 0.0
    if kind in (int, wp.int32):
        return 0
    if kind in (bool, wp.bool):
        return False
    shape = tuple(kind._shape_)
    return LaneRow(shape, [0.0] * math.prod(shape), quaternion=issubclass(kind, wp.quat))


class _Struct:
    """A struct type, whose call makes one of zeros."""

    def __init__(self, struct: Any) -> None:
        self.fields = struct.cls.__annotations__

    def __call__(self) -> SimpleNamespace:
        return SimpleNamespace(**{name: zero_of(kind) for name, kind in self.fields.items()})


class _LaneType:
    """A vector or matrix type, whose call makes one."""

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


_FUNCTIONS: dict[Any, Callable[..., Any]] = {}


def lane_function(function: Any) -> Callable[..., Any]:
    """The Python of a Warp function, with Warp's own functions and types exchanged for those of lane numbers."""
    if function in _FUNCTIONS:
        return _FUNCTIONS[function]
    python = function.func
    names: dict[str, Any] = {"__builtins__": builtins, "float": _to_float, "int": _to_int}
    cells = tuple(CellType(_exchanged(cell.cell_contents)) for cell in python.__closure__ or ())
    plain = FunctionType(python.__code__, names, python.__name__, python.__defaults__, cells)

    def traced(*arguments: Any) -> Any:
        # Warp passes vectors by value: what a function writes into one, its caller does not see.
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
    """An array of structs by (world, vehicle): what is read is loaded once, what is assigned is stored in the end."""

    def __init__(self, trace: Trace, name: str, struct: Any, examples: Mapping[str, Any]) -> None:
        """Take its name in C++, its type, and examples of fields, which are 1 otherwise."""
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
            _pieces={},
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
        """C++ of the number at that index of the struct, read with its seven neighbours."""
        first = min(LANES * (index // LANES), self._size - LANES)
        name = f"{self._name}_{first}"
        if name not in self._pieces:
            self._pieces[name] = True
            self._trace.sections[0].append(f"F {name}[LANES]; fetch({self._name}_at, {4 * first}, {name});")
        return f"{name}[{index - first}]"

    def __setattr__(self, field: str, value: Any) -> None:
        _, offset = self._fields[field]
        for i, number in enumerate(value.numbers if isinstance(value, LaneRow) else [value]):
            self._assigned[offset // 4 + i] = _word(number)

    def stores(self) -> list[str]:
        """Return the C++ that stores assigned numbers, eight neighbours together where possible."""
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
    """An array of numbers by three indices, world, vehicle and a number that is known, of which at least eight."""

    def __init__(self, trace: Trace, name: str, size: int) -> None:
        """Take its name in C++ and the size of the last axis."""
        self.__dict__.update(_trace=trace, _name=name, _size=size, _pieces={}, _assigned={})

    def __getitem__(self, index: Any) -> Any:
        return self._trace.line("F", self._place(index[2]), 1.0, 0)


class VectorArray:
    """An array of vectors by three indices, two of which are world and vehicle, and the other a lane number."""

    def __init__(self, trace: Trace, name: str, kind: Any, slot: int) -> None:
        """Take its name in C++, its type, and which index the lane number is."""
        self._trace, self._name, self._size, self._slot = trace, name, math.prod(kind._shape_), slot
        self._written: list[tuple[Lane, LaneRow]] = []
        self._read: set[str] = set()

    def __getitem__(self, index: Any) -> LaneRow:
        slot = index[self._slot]
        name = f"{self._name}_{slot.name}"
        if name not in self._read:
            self._read.add(name)
            self._trace.sections[slot.level].append(
                f"F {name}[LANES]; gather({self._name}_at, {slot.name}, {name});"
            )
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
        """C++ that writes what was assigned; pieces of eight may overlap."""
        starts = sorted({*range(0, self._size - LANES + 1, LANES), self._size - LANES})
        return [
            f"put_at({self._name}_at, {slot.name}, {4 * first}, "
            f"{_eight([_word(number) for number in value.numbers[first : first + LANES]])});"
            for slot, value in self._written
            for first in starts
        ]


class UniformStruct:
    """A struct that all worlds share."""

    def __init__(self, trace: Trace, name: str, struct: Any, examples: Mapping[str, Any]) -> None:
        """Take its name in C++, its type, and examples of fields, which are 1 otherwise."""
        self._trace, self._name, self._fields, self._examples = (
            trace,
            name,
            struct.cls.__annotations__,
            examples,
        )

    def __getattr__(self, field: str) -> Any:
        value = zero_of(self._fields[field])
        if isinstance(value, LaneRow):
            raise LaneError(f"field {field} of {self._name} is not a number")
        kind, call = ("I", "all_i") if isinstance(value, int) else ("F", "all")
        return self._trace.line(kind, f"{call}({self._name}.{field})", self._examples.get(field, 1), 0)


class LaneLoop:
    """Variables that a C++ loop carries from one pass to the next: a struct of lane numbers."""

    def __init__(self, trace: Trace, name: str, start: SimpleNamespace) -> None:
        """Begin with what section 0 has computed."""
        self._trace, self._name, self._start = trace, name, start
        for word, number in zip(self._operands(), _numbers(start), strict=True):
            trace.sections[0].append(f"F {word} = {_word(number)};")

    def _operands(self) -> list[str]:
        return [f"{self._name}_{i}" for i in range(len(_numbers(self._start)))]

    def value(self) -> SimpleNamespace:
        """The struct, in the section that is being written."""
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
        """End the loop's pass with other numbers."""
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


def block_source(
    trace: Trace, arrays: Sequence[StructArray | VectorArray], declarations: str, loop: str
) -> str:
    """The text of a native function that takes a block of worlds from `w` on, `count` of them, through the trace.

    Args:
        trace: Its lines.
        arrays: What it reads and writes.
        declarations: C++ of the symbols, and of the place NAME_at of each array.
        loop: Head of the C++ loop around section 1.

    Returns:
        C++ whose value says by bit which worlds are done; the others are as they were.
    """
    lines = [
        PREAMBLE,
        declarations,
        *trace.sections[0],
        f"{loop} {{",
        *trace.sections[1],
        "}",
        *trace.sections[2],
        "int done = 0;",
        f"for (int l = 0; l < {LANES}; ++l) if (l < count && ok[l]) done |= 1 << l;",
        "STORES",
        *(line for array in arrays for line in array.stores()),
        "return done;",
    ]
    return "\n".join(lines).replace("STORES", STORES).replace("LANES", str(LANES))


PREAMBLE = """
typedef float F __attribute__((vector_size(4 * LANES)));
typedef int I __attribute__((vector_size(4 * LANES)));
typedef int M __attribute__((vector_size(4 * LANES)));
struct At { char* p; long world; long slot; };
struct Eight { F y[LANES]; };
const auto all = [](float x) { F y; for (int l = 0; l < LANES; ++l) y[l] = x; return y; };
const auto all_i = [](int x) { I y; for (int l = 0; l < LANES; ++l) y[l] = x; return y; };
const auto choose = [](M m, auto a, auto b) { return m ? a : b; };
const auto least = [](auto a, auto b) { return a < b ? a : b; };
const auto most = [](auto a, auto b) { return a > b ? a : b; };
const auto absolute = [](F x) { return (F)((I)x & 0x7fffffff); };
const auto signum = [&](F x) { return x < 0.0f ? all(-1.0f) : all(1.0f); };
const auto finite = [&](F x) { return (M)(absolute(x) < all(INFINITY)); };
const auto root = [](F x) { F y; for (int l = 0; l < LANES; ++l) y[l] = __builtin_sqrtf(x[l]); return y; };
const auto sine = [](F x) { F y; for (int l = 0; l < LANES; ++l) y[l] = ::sinf(x[l]); return y; };
const auto cosine = [](F x) { F y; for (int l = 0; l < LANES; ++l) y[l] = ::cosf(x[l]); return y; };
const auto exponential = [](F x) { F y; for (int l = 0; l < LANES; ++l) y[l] = ::expf(x[l]); return y; };
const auto arctangent = [](F y, F x) { F z; for (int l = 0; l < LANES; ++l) z[l] = ::atan2f(y[l], x[l]); return z; };
const auto ceiling = [](F x) { F y; for (int l = 0; l < LANES; ++l) y[l] = __builtin_ceilf(x[l]); return y; };
const auto to_float = [](I x) { return __builtin_convertvector(x, F); };
const auto to_int = [](F x) { return __builtin_convertvector(x, I); };
const long last = count - 1;
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
const auto fetch = [&](const At& a, int offset, F* y) {
    if (a.world == 0) {
        for (int i = 0; i < LANES; ++i) y[i] = all(*(const float*)(a.p + offset + 4 * i));
        return;
    }
    for (int l = 0; l < LANES; ++l) __builtin_memcpy(y + l, a.p + (l < last ? l : last) * a.world + offset, sizeof(F));
    transpose(y);
};
const auto gather = [&](const At& a, I slot, F* y) {
    for (int l = 0; l < LANES; ++l)
        __builtin_memcpy(y + l, a.p + (l < last ? l : last) * a.world + slot[l] * a.slot, sizeof(F));
    transpose(y);
};
M ok = all_i(-1);
"""
"""Types and functions of the traced lines; a lambda may occur within a function, as in a native function's text."""

STORES = """
const auto put_at = [&](const At& a, I slot, int offset, const Eight& eight) {
    Eight e = eight;
    F* y = e.y;
    transpose(y);
    for (int l = 0; l < LANES; ++l)
        if (done >> l & 1) __builtin_memcpy(a.p + l * a.world + slot[l] * a.slot + offset, y + l, sizeof(F));
};
const auto put = [&](const At& a, int offset, const Eight& eight) { put_at(a, all_i(0), offset, eight); };
const auto put_one = [&](const At& a, int offset, F x) {
    for (int l = 0; l < LANES; ++l) if (done >> l & 1) *(float*)(a.p + l * a.world + offset) = x[l];
};
"""
