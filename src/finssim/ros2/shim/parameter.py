"""`rclpy.parameter`: named values with a type."""

from __future__ import annotations

from enum import IntEnum
from typing import Any

from finssim.ros2.codec import codec_of
from finssim.ros2.shim.exceptions import InvalidParameterTypeException

__all__ = ["Parameter", "parameter_value"]


class _Type(IntEnum):
    """Types of parameters, numbered as in rcl_interfaces."""

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
        """The type of a Python value; lists are of one type throughout.

        Raises:
            TypeError: A value that no parameter can hold.
        """
        if value is None:
            return cls.NOT_SET
        for kind, single, many in _KINDS:
            if isinstance(value, kind):
                return cls[single]
            # An empty list could be of any type; rclpy calls it a byte array.
            if isinstance(value, (list, tuple)) and value and all(type(v) is kind for v in value):
                return cls[many]
        if isinstance(value, (list, tuple)) and (not value or all(isinstance(v, bytes) for v in value)):
            return cls.BYTE_ARRAY
        raise TypeError(
            f"no parameter can hold {value!r}: use bool, int, float, str, or a list of one of them"
        )


_KINDS = (
    (bool, "BOOL", "BOOL_ARRAY"),
    (int, "INTEGER", "INTEGER_ARRAY"),
    (float, "DOUBLE", "DOUBLE_ARRAY"),
    (str, "STRING", "STRING_ARRAY"),
)


class Parameter:
    """A name, a type and a value.

    Args:
        name: As declared.
        type_: That of the value where it is left out.
        value: What it holds.

    Raises:
        InvalidParameterTypeException: Value and type disagree.
    """

    Type = _Type

    def __init__(self, name: str, type_: _Type | None = None, value: Any = None) -> None:
        try:
            found = _Type.from_parameter_value(value)
        except TypeError as error:
            raise InvalidParameterTypeException(f"parameter '{name}': {error}") from None
        empty = (
            isinstance(value, (list, tuple)) and not value and type_ is not None and type_ >= _Type.BYTE_ARRAY
        )
        if type_ is not None and type_ != found and not empty:
            raise InvalidParameterTypeException(
                f"parameter '{name}' is {type_.name}, found {value!r} ({found.name}): give a value of that type"
            )
        self.name, self.value = name, value
        self.type_ = found if type_ is None else type_

    def __repr__(self) -> str:
        return f"Parameter(name={self.name!r}, type_={self.type_.name}, value={self.value!r})"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Parameter) and vars(self) == vars(other)

    __hash__ = None  # type: ignore[assignment]

    def get_parameter_value(self) -> Any:
        """As rcl_interfaces/ParameterValue."""
        message = codec_of().message("rcl_interfaces/msg/ParameterValue")(type=int(self.type_))
        if self.type_ != _Type.NOT_SET:
            setattr(message, f"{self.type_.name.lower()}_value", self.value)
        return message

    def to_parameter_msg(self) -> Any:
        """As rcl_interfaces/Parameter."""
        cls = codec_of().message("rcl_interfaces/msg/Parameter")
        return cls(name=self.name, value=self.get_parameter_value())

    @classmethod
    def from_parameter_msg(cls, message: Any) -> Parameter:
        """From rcl_interfaces/Parameter."""
        return cls(message.name, _Type(message.value.type), parameter_value(message.value))


def parameter_value(message: Any) -> Any:
    """What a rcl_interfaces/ParameterValue holds."""
    kind = _Type(message.type)
    if kind == _Type.NOT_SET:
        return None
    value = getattr(message, f"{kind.name.lower()}_value")
    return list(value) if kind >= _Type.BYTE_ARRAY else value
