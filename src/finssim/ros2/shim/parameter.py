"""`rclpy.parameter`: named values with a type."""

from __future__ import annotations

import array
from enum import Enum
from typing import Any

from finssim.ros2.codec import codec_of

__all__ = ["PARAMETER_SEPARATOR_STRING", "Parameter", "parameter_value_to_python"]

PARAMETER_SEPARATOR_STRING = "."


class _Type(Enum):
    """Types of parameters, numbered as in rcl_interfaces; no integers, as in rclpy."""

    NOT_SET = 0
    BOOL = 1
    INTEGER = 2
    DOUBLE = 3
    STRING = 4
    BYTE_ARRAY = 5
    BOOL_ARRAY = 6
    INTEGER_ARRAY = 7
    DOUBLE_ARRAY = 8
    STRING_ARRAY = 9

    @classmethod
    def from_parameter_value(cls, value: Any) -> _Type:
        """The type of a Python value; lists are of one type throughout, and an empty one is of bytes.

        Raises:
            TypeError: A value that no parameter can hold.
        """
        if value is None:
            return cls.NOT_SET
        for kind, single, _ in _KINDS:
            if single is not None and isinstance(value, kind):
                return single
        if isinstance(value, (list, tuple, array.array)):
            for kind, _, many in _KINDS:
                if all(isinstance(v, kind) for v in value):
                    return many
        raise TypeError(
            f"no parameter can hold {value!r}: use bool, int, float, str, or a list of one of them"
        )

    def check(self, value: Any) -> bool:
        """Whether a value is of this type."""
        if self is _Type.NOT_SET:
            return value is None
        for kind, single, many in _KINDS:
            if self is single:
                return isinstance(value, kind)
            if self is many:
                return isinstance(value, (list, tuple, array.array)) and all(
                    isinstance(v, kind) for v in value
                )
        return False


_KINDS = (
    (bytes, None, _Type.BYTE_ARRAY),
    (bool, _Type.BOOL, _Type.BOOL_ARRAY),
    (int, _Type.INTEGER, _Type.INTEGER_ARRAY),
    (float, _Type.DOUBLE, _Type.DOUBLE_ARRAY),
    (str, _Type.STRING, _Type.STRING_ARRAY),
)


class Parameter:
    """A name, a type and a value, none of which changes.

    Args:
        name: As declared.
        type_: That of the value where it is left out.
        value: What it holds.

    Raises:
        TypeError: A value that no parameter can hold, or `type_` is no `Parameter.Type`.
        ValueError: Value and type disagree.
    """

    Type = _Type

    def __init__(self, name: str, type_: _Type | None = None, value: Any = None) -> None:
        type_ = _Type.from_parameter_value(value) if type_ is None else type_
        if not isinstance(type_, _Type):
            raise TypeError(f"parameter '{name}': {type_!r} is no Parameter.Type")
        if not type_.check(value):
            raise ValueError(
                f"parameter '{name}' is {type_.name}, found {value!r}: give a value of that type"
            )
        self._name, self._type, self._value = name, type_, value

    @property
    def name(self) -> str:
        """As declared."""
        return self._name

    @property
    def type_(self) -> _Type:
        """Of the value."""
        return self._type

    @property
    def value(self) -> Any:
        """What it holds."""
        return self._value

    def __repr__(self) -> str:
        return f"Parameter(name={self.name!r}, type_={self.type_.name}, value={self.value!r})"

    def get_parameter_value(self) -> Any:
        """As rcl_interfaces/ParameterValue."""
        message = codec_of().message("rcl_interfaces/msg/ParameterValue")(type=self.type_.value)
        if self.type_ is not _Type.NOT_SET:
            setattr(message, f"{self.type_.name.lower()}_value", self.value)
        return message

    def to_parameter_msg(self) -> Any:
        """As rcl_interfaces/Parameter."""
        cls = codec_of().message("rcl_interfaces/msg/Parameter")
        return cls(name=self.name, value=self.get_parameter_value())

    @classmethod
    def from_parameter_msg(cls, message: Any) -> Parameter:
        """From rcl_interfaces/Parameter."""
        return cls(message.name, _Type(message.value.type), parameter_value_to_python(message.value))


def parameter_value_to_python(message: Any) -> Any:
    """What a rcl_interfaces/ParameterValue holds."""
    kind = _Type(message.type)
    if kind is _Type.NOT_SET:
        return None
    value = getattr(message, f"{kind.name.lower()}_value")
    if kind is _Type.BYTE_ARRAY:
        return [bytes([v]) for v in value]
    return value.tolist() if hasattr(value, "tolist") else value
