"""Python classes of messages, with the manners of real rclpy: defaults, checks on assignment, constants."""

from __future__ import annotations

import keyword
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from finssim.ros2.definitions import Definitions, Nodetype
from finssim.ros2.errors import MessageError
from finssim.ros2.field_checks import DTYPES, Numbers, Octet, check_of, spelled

__all__ = ["Message", "message_class"]


class Message:
    """A message: slots, keyword arguments, and a check of every value that is assigned."""

    __slots__ = ()
    TYPE: str
    """As `nav_msgs/msg/Odometry`."""
    _checks: Mapping[str, Callable[[Any], Any]]
    _zeros: Mapping[str, Callable[[], Any]]
    _spelled: Mapping[str, str]

    def __init__(self, **values: Any) -> None:
        for name, zero in self._zeros.items():
            if name in values:
                setattr(self, name, values.pop(name))
            else:
                object.__setattr__(self, name, zero())
        if values:
            raise MessageError(f"{self.TYPE} has no field '{min(values)}'; it has {', '.join(self._zeros)}")

    def __setattr__(self, name: str, value: Any) -> None:
        if name not in self._checks:
            raise AttributeError(f"{self.TYPE} has no field '{name}'; it has {', '.join(self._zeros)}")
        try:
            value = self._checks[name](value)
        except MessageError as error:
            raise MessageError(f"{self.TYPE}: {name}: {error}") from None
        object.__setattr__(self, name, value)

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        return all(np.array_equal(getattr(self, n), getattr(other, n)) for n in self._zeros)

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        package, kind, short = self.TYPE.split("/")
        shown = ", ".join(f"{n}={getattr(self, n)!r}" for n in self._zeros)
        return f"{package}.{kind}.{short}({shown})"

    @classmethod
    def get_fields_and_field_types(cls) -> dict[str, str]:
        """Field names and their types, spelled as ROS 2 does."""
        return dict(cls._spelled)


def message_class(
    name: str, definitions: Definitions, nested: Callable[[str], type[Message]]
) -> tuple[type[Message], Callable[..., Message]]:
    """The class of a type, and what makes one from checked field values in order, for deserialising.

    Args:
        name: As `nav_msgs/msg/Odometry`.
        definitions: Where its fields are found.
        nested: Gives the class of a type that is a field.

    Raises:
        Ros2Error: Unknown type.
    """
    described = {f"{n}_" if keyword.iskeyword(n) else n: d for n, d in definitions.fields(name)}
    defaults = definitions.defaults.get(name, {})
    body: dict[str, Any] = {
        "__slots__": tuple(described),
        "__module__": ".".join(name.split("/")[:2]),
        "TYPE": name,
        "_checks": {n: check_of(d, nested) for n, d in described.items()},
        "_zeros": {n: _zero(d, nested, defaults.get(n)) for n, d in described.items()},
        "_spelled": {n: spelled(d) for n, d in described.items()},
    }
    for constant, kind, value in definitions.constants(name):
        body[constant] = bytes([value]) if kind in ("byte", "octet") else value
    cls = type(Message)(name.rsplit("/", 1)[1], (Message,), body)
    return cls, _maker(cls, described)


def _maker(cls: type[Message], described: Mapping[str, Any]) -> Callable[..., Message]:
    """Make a message from values that need no check: the slots are set directly, which is several times faster."""
    names = list(described)
    lines = [f"def make({', '.join(f'v{i}' for i in range(len(names)))}):", "    m = new(cls)"]
    for i, (kind, what) in enumerate(described.values()):
        kept = f"v{i}"
        if kind == Nodetype.BASE and what[0] in ("byte", "octet"):
            kept = f"octet(v{i})"
        elif kind == Nodetype.SEQUENCE and what[0][0] == Nodetype.BASE and what[0][1][0] in DTYPES:
            kept = f"v{i}.view(numbers)"
        lines.append(f"    set{i}(m, {kept})")
    scope: dict[str, Any] = {f"set{i}": cls.__dict__[n].__set__ for i, n in enumerate(names)}
    scope |= {"new": object.__new__, "cls": cls, "octet": Octet.of, "numbers": Numbers}
    exec("\n".join([*lines, "    return m"]), scope)
    return scope["make"]  # type: ignore[no-any-return]


def _zero(described: Any, nested: Callable[[str], type[Message]], default: Any) -> Callable[[], Any]:
    """What makes a field's default: zero, empty, or as its definition says."""
    kind, what = described
    if default is not None:
        check = check_of(described, nested)
        return lambda: check(default)
    if kind == Nodetype.NAME:
        cls = nested(what)
        return lambda: cls()
    if kind == Nodetype.BASE:
        return _base_zero(what[0])
    (inner_kind, inner), length = what
    count = length if kind == Nodetype.ARRAY else 0
    if inner_kind == Nodetype.BASE and inner[0] in DTYPES:
        dtype = DTYPES[inner[0]]
        return lambda: np.zeros(count, dtype) if kind == Nodetype.ARRAY else np.zeros(0, dtype).view(Numbers)
    element = _zero((inner_kind, inner), nested, None)
    return lambda: [element() for _ in range(count)]


def _base_zero(base: str) -> Callable[[], Any]:
    """Zero of a base type."""
    if base == "string":
        return str
    if base == "bool":
        return bool
    if base in ("byte", "octet"):
        return lambda: Octet(b"\0")
    return float if base.startswith("float") else int
