"""`rclpy.parameter`, the parameters of a node, and the services that `ros2 param` uses to list, read and set them."""

from __future__ import annotations

import array
import math
from collections.abc import Callable, Mapping, Sequence
from enum import Enum
from typing import Any

from finssim.extensions.ros2.codec import codec_of
from finssim.extensions.ros2.shim.exceptions import (
    InvalidParameterException,
    InvalidParameterTypeException,
    InvalidParameterValueException,
    ParameterAlreadyDeclaredException,
    ParameterImmutableException,
    ParameterNotDeclaredException,
    ParameterUninitializedException,
)
from finssim.extensions.ros2.shim.qos import qos_profile_parameters

PARAMETER_SEPARATOR_STRING = DOT = "."


class _ParameterType(Enum):
    """Types of parameters, numbered as in rcl_interfaces; not integers, as in rclpy."""

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
    def from_parameter_value(cls, value: Any) -> _ParameterType:
        """Return the type of a Python value; lists have elements of one type, and an empty list is of bytes.

        Raises:
            TypeError: The value cannot be a parameter.
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
        """Return whether a value is of this type."""
        if self is _ParameterType.NOT_SET:
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
    (bytes, None, _ParameterType.BYTE_ARRAY),
    (bool, _ParameterType.BOOL, _ParameterType.BOOL_ARRAY),
    (int, _ParameterType.INTEGER, _ParameterType.INTEGER_ARRAY),
    (float, _ParameterType.DOUBLE, _ParameterType.DOUBLE_ARRAY),
    (str, _ParameterType.STRING, _ParameterType.STRING_ARRAY),
)


class Parameter:
    """Parameter with name, type and value; immutable.

    Args:
        name: Declared name.
        type_: Type; None: that of the value.
        value: Value.

    Raises:
        TypeError: The value cannot be a parameter, or `type_` is not a `Parameter.Type`.
        ValueError: Value and type disagree.
    """

    Type = _ParameterType

    def __init__(self, name: str, type_: _ParameterType | None = None, value: Any = None) -> None:
        type_ = _ParameterType.from_parameter_value(value) if type_ is None else type_
        if not isinstance(type_, _ParameterType):
            raise TypeError(f"parameter '{name}': {type_!r} is no Parameter.Type")
        if not type_.check(value):
            raise ValueError(
                f"parameter '{name}' is {type_.name}, found {value!r}: give a value of that type"
            )
        self._name, self._type, self._value = name, type_, value

    @property
    def name(self) -> str:
        """Return the declared name."""
        return self._name

    @property
    def type_(self) -> _ParameterType:
        """Return the type of the value."""
        return self._type

    @property
    def value(self) -> Any:
        """Return its value."""
        return self._value

    def __repr__(self) -> str:
        return f"Parameter(name={self.name!r}, type_={self.type_.name}, value={self.value!r})"

    def get_parameter_value(self) -> Any:
        """Return the value as rcl_interfaces/ParameterValue."""
        message = codec_of().message("rcl_interfaces/msg/ParameterValue")(type=self.type_.value)
        if self.type_ is not _ParameterType.NOT_SET:
            setattr(message, f"{self.type_.name.lower()}_value", self.value)
        return message

    def to_parameter_msg(self) -> Any:
        """Return the parameter as rcl_interfaces/Parameter."""
        cls = codec_of().message("rcl_interfaces/msg/Parameter")
        return cls(name=self.name, value=self.get_parameter_value())

    @classmethod
    def from_parameter_msg(cls, message: Any) -> Parameter:
        """Return a parameter from rcl_interfaces/Parameter."""
        return cls(message.name, _ParameterType(message.value.type), parameter_value_to_python(message.value))


def parameter_value_to_python(message: Any) -> Any:
    """Return the value of a rcl_interfaces/ParameterValue."""
    kind = _ParameterType(message.type)
    if kind is _ParameterType.NOT_SET:
        return None
    value = getattr(message, f"{kind.name.lower()}_value")
    if kind is _ParameterType.BYTE_ARRAY:
        return [bytes([v]) for v in value]
    return value.tolist() if hasattr(value, "tolist") else value


# `rclpy.parameter_service`: services that `ros2 param` uses to list, read and set a node's parameters.


NAMES = (
    "DescribeParameters",
    "GetParameters",
    "GetParameterTypes",
    "ListParameters",
    "SetParameters",
    "SetParametersAtomically",
)


class ParameterService:
    """Six parameter services of one node; refusals are part of the response, as in rclpy."""

    def __init__(self, node: Any) -> None:
        self._node = node
        for name in NAMES:
            short = "".join(f"_{c.lower()}" if c.isupper() else c for c in name)[1:]
            node.create_service(
                codec_of().service(f"rcl_interfaces/srv/{name}"),
                f"{node.get_name()}/{short}",
                getattr(self, f"_{short}"),
                qos_profile=qos_profile_parameters,
            )

    def _describe_parameters(self, request: Any, response: Any) -> Any:
        try:
            response.descriptors = self._node.describe_parameters(request.names)
        except ParameterNotDeclaredException:
            pass  # an empty response, as in rclpy
        return response

    def _get_parameters(self, request: Any, response: Any) -> Any:
        try:
            response.values = [p.get_parameter_value() for p in self._node.get_parameters(request.names)]
        except (ParameterNotDeclaredException, ParameterUninitializedException):
            pass
        return response

    def _get_parameter_types(self, request: Any, response: Any) -> Any:
        try:
            response.types = self._node.get_parameter_types(request.names)
        except ParameterNotDeclaredException:
            pass
        return response

    def _list_parameters(self, request: Any, response: Any) -> Any:
        response.result = self._node.list_parameters(request.prefixes, request.depth)
        return response

    def _set_parameters(self, request: Any, response: Any) -> Any:
        response.results = [self._set([parameter]) for parameter in request.parameters]
        return response

    def _set_parameters_atomically(self, request: Any, response: Any) -> Any:
        response.result = self._set(request.parameters)
        return response

    def _set(self, parameters: Any) -> Any:
        try:
            return self._node.set_parameters_atomically([Parameter.from_parameter_msg(p) for p in parameters])
        except ParameterNotDeclaredException as error:
            result = codec_of().message("rcl_interfaces/msg/SetParametersResult")
            return result(successful=False, reason=str(error))


# Parameters of a node: declared with a default, overridden by file and command line, checked when set.


Kind = Parameter.Type
SetCallback = Callable[[list[Parameter]], Any]

CLOSE = 1e-6
"""Relative tolerance at the ends and steps of a range, as in rclpy."""


class NodeParameters:
    """Part of `Node` with the parameters.

    Args:
        overrides: Values from files and command line, by name.
    """

    def __init__(self, overrides: Mapping[str, Any]) -> None:
        self._overrides = dict(overrides)
        self._values: dict[str, Parameter] = {}
        self._descriptors: dict[str, Any] = {}
        self._callbacks: list[SetCallback] = []

    def declare_parameter(
        self, name: str, value: Any = None, descriptor: Any = None, ignore_override: bool = False
    ) -> Parameter:
        """Declare a parameter.

        Args:
            name: Its name.
            value: Default, or a `Parameter.Type` if a file or the command line must set a value.
            descriptor: rcl_interfaces/ParameterDescriptor: range, read-only, dynamic typing.
            ignore_override: True to ignore values of files and command line.

        Raises:
            InvalidParameterException: The name is empty.
            ParameterAlreadyDeclaredException: The parameter is already declared.
            InvalidParameterTypeException: The override is of another type.
            InvalidParameterValueException: The value is out of range or was refused.
            TypeError: The default cannot be a parameter, or the descriptor is not a ParameterDescriptor.
            ValueError: There is no default although the type is fixed, or the type is given twice.
        """
        described = codec_of().message("rcl_interfaces/msg/ParameterDescriptor")
        if not isinstance(name, str):
            raise TypeError(f"a parameter's name is {name!r}, expected a str")
        if not name:
            raise InvalidParameterException("a parameter has no name")
        if value is None and descriptor is None:  # deprecated in rclpy, with a warning
            descriptor = described(dynamic_typing=True)
        descriptor = described() if descriptor is None else descriptor
        if not isinstance(descriptor, described):
            raise TypeError(f"parameter '{name}': {descriptor!r} is no ParameterDescriptor")
        if isinstance(value, Kind):
            if value is Kind.NOT_SET or descriptor.dynamic_typing:
                raise ValueError(
                    f"parameter '{name}': give a type other than NOT_SET, or dynamic_typing, not both"
                )
            descriptor.type, value = value.value, None
        elif not descriptor.dynamic_typing:
            descriptor.type = Kind.from_parameter_value(value).value
            if value is None:
                raise ValueError(
                    f"parameter '{name}': give a default, a Parameter.Type, or dynamic_typing=True"
                )
        if name in self._overrides and not ignore_override:
            value = self._overrides[name]
        if name in self._values:
            raise ParameterAlreadyDeclaredException(f"parameter '{name}' is declared twice")
        parameter = Parameter(name, value=value)
        reason = self._set([parameter], {name: descriptor})
        if reason:
            wrong = (
                not descriptor.dynamic_typing
                and value is not None
                and parameter.type_.value != descriptor.type
            )
            raise (InvalidParameterTypeException if wrong else InvalidParameterValueException)(reason)
        return self._values[name]

    def declare_parameters(
        self, namespace: str, parameters: Sequence[tuple[Any, ...]], ignore_override: bool = False
    ) -> list[Parameter]:
        """Declare several parameters as (name, value, descriptor), with names below `namespace` if it is not empty."""
        prefix = f"{namespace}{DOT}" if namespace else ""
        if not all(1 <= len(entry) <= 3 for entry in parameters):
            raise TypeError("each parameter is (name,), (name, value) or (name, value, descriptor)")
        return [
            self.declare_parameter(prefix + name, *rest, ignore_override=ignore_override)
            for name, *rest in parameters
        ]

    def undeclare_parameter(self, name: str) -> None:
        """Remove a parameter.

        Raises:
            ParameterNotDeclaredException: The parameter is not declared.
            ParameterImmutableException: The parameter is read-only.
        """
        if self._declared(name).read_only:
            raise ParameterImmutableException(f"parameter '{name}' is read-only: it stays")
        del self._values[name], self._descriptors[name]

    def has_parameter(self, name: str) -> bool:
        """Return whether a parameter is declared."""
        return name in self._values

    def get_parameter(self, name: str) -> Parameter:
        """Return a parameter.

        Raises:
            ParameterNotDeclaredException: The parameter is not declared.
            ParameterUninitializedException: The parameter has a type but no value.
        """
        dynamic = self._declared(name).dynamic_typing
        parameter = self._values[name]
        if parameter.type_ is Kind.NOT_SET and not dynamic:
            raise ParameterUninitializedException(
                f"parameter '{name}' has no value: give one in a file or with -p"
            )
        return parameter

    def get_parameters(self, names: Sequence[str]) -> list[Parameter]:
        """Return several parameters."""
        return [self.get_parameter(name) for name in names]

    def get_parameter_or(self, name: str, alternative: Parameter | None = None) -> Parameter:
        """Return a parameter, or an alternative if it is not declared or has no value."""
        value = self._values.get(name)
        if value is None or value.type_ is Kind.NOT_SET:
            return alternative or Parameter(name)
        return value

    def get_parameter_type(self, name: str) -> Any:
        """Return the number of a parameter's type."""
        self._declared(name)
        return self._values[name].type_.value

    def get_parameter_types(self, names: Sequence[str]) -> list[Any]:
        """Return the numbers of several parameters' types."""
        return [self.get_parameter_type(name) for name in names]

    def list_parameters(self, prefixes: list[str], depth: int) -> Any:
        """Return names down to a depth (0: all) below prefixes (none: all), as rcl_interfaces/ListParametersResult.

        Raises:
            TypeError: The prefixes are not a list of str, or the depth is not an int.
            ValueError: The depth is negative.
        """
        if not isinstance(prefixes, list) or not all(isinstance(p, str) for p in prefixes):
            raise TypeError("the prefixes must be a list of str")
        if not isinstance(depth, int):
            raise TypeError("the depth must be an int")
        if depth < 0:
            raise ValueError("the depth must not be negative")

        def listed(name: str) -> bool:
            if not prefixes:
                return depth == 0 or name.count(DOT) < depth
            below = [name[len(p) + 1 :] for p in prefixes if name.startswith(p + DOT)]
            return name in prefixes or any(depth == 0 or rest.count(DOT) < depth for rest in below)

        names = [name for name in self._values if listed(name)]
        above = dict.fromkeys(name.rpartition(DOT)[0] for name in names if DOT in name)
        return codec_of().message("rcl_interfaces/msg/ListParametersResult")(
            names=names, prefixes=list(above)
        )

    def set_parameters(self, parameters: Sequence[Parameter]) -> list[Any]:
        """Set each parameter separately; return a rcl_interfaces/SetParametersResult for each.

        Raises:
            ParameterNotDeclaredException: A parameter is not declared; those before it are set.
        """
        return [self.set_parameters_atomically([parameter]) for parameter in parameters]

    def set_parameters_atomically(self, parameters: Sequence[Parameter]) -> Any:
        """Set all or none; return a rcl_interfaces/SetParametersResult. A value of None undeclares.

        Raises:
            ParameterNotDeclaredException: A parameter is not declared.
        """
        if not all(isinstance(parameter, Parameter) for parameter in parameters):
            raise TypeError("only a Parameter can be set")
        for parameter in parameters:
            self._declared(parameter.name)
        reason = self._set(list(parameters))
        return codec_of().message("rcl_interfaces/msg/SetParametersResult")(
            successful=not reason, reason=reason
        )

    def describe_parameter(self, name: str) -> Any:
        """Return a parameter's rcl_interfaces/ParameterDescriptor."""
        return self._declared(name)

    def describe_parameters(self, names: Sequence[str]) -> list[Any]:
        """Return several descriptors."""
        return [self.describe_parameter(name) for name in names]

    def add_on_set_parameters_callback(self, callback: SetCallback) -> None:
        """Register a callback that checks new values and returns a rcl_interfaces/SetParametersResult."""
        self._callbacks.insert(0, callback)

    def remove_on_set_parameters_callback(self, callback: SetCallback) -> None:
        """Remove a callback."""
        self._callbacks.remove(callback)

    def _parameters_changed(
        self, new: list[Parameter], changed: list[Parameter], removed: list[Parameter]
    ) -> None:
        """React to parameters that were declared, set or undeclared."""

    def _declared(self, name: str) -> Any:
        """Return the descriptor of a declared parameter."""
        if name not in self._values:
            raise ParameterNotDeclaredException(
                f"parameter '{name}' is not declared: declare it before it is used"
            )
        return self._descriptors[name]

    def _set(self, parameters: list[Parameter], descriptors: Mapping[str, Any] | None = None) -> str:
        """Set all parameters, or none and return the reason; with descriptors, declare them."""
        for parameter in parameters:
            name = parameter.name
            descriptor = (self._descriptors if descriptors is None else descriptors).get(name)
            reason = (
                ""
                if descriptor is None
                else self._refusal(parameter, descriptor, declaring=descriptors is not None)
            )
            if reason:
                return f"parameter '{name}' {reason}"
        for callback in self._callbacks:
            result = callback(parameters)
            if not result.successful:
                return f"parameter '{', '.join(p.name for p in parameters)}' was refused: {result.reason}"
        new: list[Parameter] = []
        changed: list[Parameter] = []
        removed: list[Parameter] = []
        for parameter in parameters:
            name = parameter.name
            if descriptors is None and parameter.type_ is Kind.NOT_SET:
                self._values.pop(name, None), self._descriptors.pop(name, None)
                removed.append(parameter)
                continue
            (changed if self.get_parameter_or(name).type_ is not Kind.NOT_SET else new).append(parameter)
            if descriptors is not None:
                self._descriptors[name] = descriptors[name]
            self._values[name] = parameter
        self._parameters_changed(new, changed, removed)
        return ""

    def _refusal(self, parameter: Parameter, descriptor: Any, *, declaring: bool) -> str:
        """Return why a value cannot be set; "" if it can."""
        descriptor.name, kind = parameter.name, parameter.type_
        if descriptor.read_only and not declaring:
            return "is read-only: set it at the start"
        if descriptor.dynamic_typing:
            descriptor.type = kind.value
        elif kind is Kind.NOT_SET:
            return "" if declaring else "has a fixed type and cannot be undeclared"
        elif kind.value != descriptor.type:
            expected = Kind(descriptor.type)
            such = ", such as 1.0" if expected is Kind.DOUBLE else ""
            return f"is {expected.name}, found {parameter.value!r} ({kind.name}): give a value of that type{such}"
        if kind is Kind.INTEGER and descriptor.integer_range:
            return _outside(parameter.value, descriptor.integer_range[0], close=0.0)
        if kind is Kind.DOUBLE and descriptor.floating_point_range:
            return _outside(parameter.value, descriptor.floating_point_range[0], close=CLOSE)
        return ""


def _outside(value: float, limits: Any, close: float) -> str:
    """Return the reason why a number is outside a range; its ends always count as inside."""
    low, high = sorted((limits.from_value, limits.to_value))
    if any(math.isclose(value, end, rel_tol=close, abs_tol=0.0) for end in (low, high)):
        return ""
    if not low < value < high:
        return f"is {value}, expected {low} to {high}"
    if limits.step:
        nearest = low + round((value - low) / limits.step) * limits.step
        if not math.isclose(nearest, value, rel_tol=close, abs_tol=0.0):
            return f"is {value}, expected steps of {limits.step} from {low} to {high}"
    return ""
