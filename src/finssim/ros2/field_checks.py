"""What a field takes: as strict as real rclpy on Humble, so that code that runs here runs there."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from finssim.ros2.definitions import Nodetype
from finssim.ros2.errors import MessageError

__all__ = ["DTYPES", "Numbers", "Octet", "check_of", "spelled"]

INTEGERS = {
    **{f"int{b}": (-(2 ** (b - 1)), 2 ** (b - 1) - 1) for b in (8, 16, 32, 64)},
    **{f"uint{b}": (0, 2**b - 1) for b in (8, 16, 32, 64)},
}
DTYPES = {
    **{name: np.dtype(name) for name in INTEGERS},
    **dict.fromkeys(("byte", "octet"), np.dtype("uint8")),
    "float32": np.dtype("float32"),
    "float64": np.dtype("float64"),
    "bool": np.dtype("bool"),
}
"""Base types whose arrays are NumPy arrays."""

FLOAT32_MAX = float(np.finfo(np.float32).max)
Check = Callable[[Any], Any]


class Numbers(np.ndarray[Any, Any]):
    """A sequence of numbers as messages keep it: a NumPy array with the manners of rclpy's `array.array`.

    Its elements are Python's numbers, and what is computed from it is an ordinary NumPy array, which no field takes.
    """

    def __getitem__(self, index: Any) -> Any:
        part = super().__getitem__(index)
        return part.item() if isinstance(part, np.generic) else part

    def __iter__(self) -> Any:
        return iter(self.tolist())

    def __array_wrap__(self, array: Any, context: Any = None, return_scalar: bool = False) -> Any:
        return array[()] if return_scalar else np.asarray(array)


class Octet(bytes):
    """One byte: Python sees `bytes`, as in rclpy, and the serialiser its number."""

    def __index__(self) -> int:
        return self[0]

    @classmethod
    def of(cls, number: int) -> Octet:
        """From its number."""
        return cls((number,))


def check_of(described: Any, nested: Callable[[str], type]) -> Check:
    """What checks a value of a field and gives it back as the message keeps it.

    Args:
        described: The field, as rosbags has it.
        nested: Gives the class of a type that is a field.
    """
    kind, what = described
    if kind == Nodetype.NAME:
        return _instance(nested(what))
    if kind == Nodetype.BASE:
        return _base(*what)
    (inner_kind, inner), count = what
    fixed = kind == Nodetype.ARRAY
    if inner_kind == Nodetype.BASE and inner[0] in DTYPES:
        return _numbers(inner[0], count, fixed)
    return _objects(check_of((inner_kind, inner), nested), count, fixed)


def _instance(cls: type) -> Check:
    def check(value: Any) -> Any:
        if not isinstance(value, cls):
            raise MessageError(f"expected a {cls.__name__}, found {_shown(value)}")
        return value

    return check


def _base(base: str, bound: int) -> Check:
    if base in INTEGERS:
        return _integer(base)
    if base.startswith("float"):
        return _real(base)
    if base in ("byte", "octet"):
        return _octet
    wanted = bool if base == "bool" else str

    def check(value: Any) -> Any:
        if not isinstance(value, wanted) or (bound and len(value) > bound):
            limit = f" of at most {bound} characters" if bound else ""
            raise MessageError(f"expected a {wanted.__name__}{limit}, found {_shown(value)}")
        return value

    return check


def _integer(base: str) -> Check:
    low, high = INTEGERS[base]

    def check(value: Any) -> Any:
        if not isinstance(value, int) or not low <= value <= high:
            raise MessageError(f"expected an int from {low} to {high}, found {_shown(value)}")
        return value

    return check


def _real(base: str) -> Check:
    limit = FLOAT32_MAX if base == "float32" else math.inf

    def check(value: Any) -> Any:
        if not isinstance(value, float):
            raise MessageError(f"expected a float, found {_shown(value)}: write 1.0 or float(...)")
        if abs(value) > limit and not math.isinf(value):
            raise MessageError(f"expected a number that fits {base}, found {value}")
        return value

    return check


def _octet(value: Any) -> Octet:
    if not isinstance(value, bytes) or len(value) != 1:
        raise MessageError(f"expected one byte such as b'\\x01', found {_shown(value)}")
    return Octet(value)


def _numbers(base: str, count: int, fixed: bool) -> Check:
    """Arrays of numbers are kept as NumPy arrays; bytes and `array.array` are not copied.

    As the messages of rosidl_generator_py on Humble: arrays of a fixed length take NumPy arrays, sequences do not.
    """
    dtype, single = DTYPES[base], _integer("uint8") if base in ("byte", "octet") else _base(base, 0)

    def check(value: Any) -> Any:
        if isinstance(value, np.ndarray) and not fixed and not isinstance(value, Numbers):
            raise MessageError("expected a list, bytes or array.array, found a NumPy array: use .tolist()")
        if isinstance(value, (bytes, bytearray)) and base == "uint8":
            array = np.frombuffer(value, dtype)
        elif isinstance(value, (list, tuple)):
            array = np.array([single(v) for v in value], dtype)
        elif isinstance(value, np.ndarray) or hasattr(value, "typecode"):
            array = np.asarray(value)
        else:
            raise MessageError(f"expected a list or array of {dtype}, found {_shown(value)}")
        if array.dtype != dtype:
            raise MessageError(f"expected an array of {dtype}, found {array.dtype}: use .tolist()")
        if array.ndim != 1:
            raise MessageError(f"expected one axis, found {array.ndim}: use .ravel()")
        _check_count(len(array), count, fixed)
        return np.ascontiguousarray(array) if fixed else np.ascontiguousarray(array).view(Numbers)

    return check


def _objects(single: Check, count: int, fixed: bool) -> Check:
    def check(value: Any) -> list[Any]:
        if isinstance(value, (str, bytes)) or not isinstance(value, Sequence):
            raise MessageError(f"expected a list, found {_shown(value)}")
        _check_count(len(value), count, fixed)
        return [single(v) for v in value]

    return check


def _check_count(found: int, count: int, fixed: bool) -> None:
    if (found != count) if fixed else (count and found > count):
        raise MessageError(f"expected {'' if fixed else 'at most '}{count} elements, found {found}")


def _shown(value: Any) -> str:
    text = repr(value)
    return f"{text if len(text) <= 40 else text[:37] + '...'} ({type(value).__name__})"


def spelled(described: Any) -> str:
    """The field's type as ROS 2 spells it in `get_fields_and_field_types`."""
    kind, what = described
    if kind == Nodetype.NAME:
        package, _, short = what.split("/")
        return f"{package}/{short}"
    if kind == Nodetype.BASE:
        base, bound = what
        words = {"bool": "boolean", "float32": "float", "float64": "double", "byte": "octet"}
        return f"string<{bound}>" if base == "string" and bound else words.get(base, base)
    inner, count = what
    if kind == Nodetype.ARRAY:
        return f"{spelled(inner)}[{count}]"
    return f"sequence<{spelled(inner)}, {count}>" if count else f"sequence<{spelled(inner)}>"
