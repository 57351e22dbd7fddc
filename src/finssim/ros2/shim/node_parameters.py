"""The parameters of a node: declared with a default, overridden by file and command line, checked when set."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from finssim.ros2.codec import codec_of
from finssim.ros2.shim.exceptions import (
    InvalidParameterTypeException,
    InvalidParameterValueException,
    ParameterAlreadyDeclaredException,
    ParameterImmutableException,
    ParameterNotDeclaredException,
    ParameterUninitializedException,
)
from finssim.ros2.shim.parameter import Parameter

__all__ = ["NodeParameters"]

Kind = Parameter.Type
SetCallback = Callable[[list[Parameter]], Any]


class NodeParameters:
    """The part of `Node` that holds parameters.

    Args:
        overrides: Values given from outside, by name.
        undeclared: Whether parameters may be set and read without a declaration.
    """

    def __init__(self, overrides: Mapping[str, Any], undeclared: bool) -> None:
        self._overrides = dict(overrides)
        self._undeclared = undeclared
        self._values: dict[str, Parameter] = {}
        self._descriptors: dict[str, Any] = {}
        self._callbacks: list[SetCallback] = []

    def declare_parameter(
        self, name: str, value: Any = None, descriptor: Any = None, ignore_override: bool = False
    ) -> Parameter:
        """Declare a parameter.

        Args:
            name: Its name.
            value: Default, or a `Parameter.Type` where a value must come from outside.
            descriptor: rcl_interfaces/ParameterDescriptor: range, read-only, dynamic typing.
            ignore_override: Keep the default whatever is given from outside.

        Raises:
            ParameterAlreadyDeclaredException: It is declared.
            InvalidParameterTypeException: The value from outside is of another type.
            InvalidParameterValueException: The value from outside was refused.
        """
        if name in self._values:
            raise ParameterAlreadyDeclaredException(f"parameter '{name}' is declared twice")
        descriptor = descriptor or codec_of().message("rcl_interfaces/msg/ParameterDescriptor")()
        kind = value if isinstance(value, Kind) else None
        default = Parameter(name, Kind.NOT_SET) if kind is not None else Parameter(name, value=value)
        given = name in self._overrides and not ignore_override
        chosen = Parameter(name, value=self._overrides[name]) if given else default
        wanted = default.type_ if kind is None else kind
        if wanted == Kind.NOT_SET or descriptor.dynamic_typing:
            wanted = chosen.type_
        descriptor.name, descriptor.type = name, int(wanted)
        self._check(chosen, descriptor, initial=kind is not None and not given)
        self._ask([chosen])
        self._values[name], self._descriptors[name] = chosen, descriptor
        return chosen

    def declare_parameters(self, namespace: str, parameters: Sequence[tuple[Any, ...]]) -> list[Parameter]:
        """Declare several as (name, value, descriptor), their names below `namespace` if it is not empty."""
        prefix = f"{namespace}." if namespace else ""
        return [self.declare_parameter(prefix + name, *rest) for name, *rest in parameters]

    def undeclare_parameter(self, name: str) -> None:
        """Forget a parameter."""
        self.get_parameter(name)
        del self._values[name], self._descriptors[name]

    def has_parameter(self, name: str) -> bool:
        """Whether it is declared."""
        return name in self._values

    def get_parameter(self, name: str) -> Parameter:
        """A parameter.

        Raises:
            ParameterNotDeclaredException: It is not declared.
            ParameterUninitializedException: It has a type but no value.
        """
        if name not in self._values:
            if self._undeclared:
                return Parameter(name)
            raise ParameterNotDeclaredException(
                f"parameter '{name}' is not declared: declare it before it is used"
            )
        found, wanted = self._values[name], self._descriptors[name].type
        if found.type_ == Kind.NOT_SET and wanted != Kind.NOT_SET:
            raise ParameterUninitializedException(
                f"parameter '{name}' has no value: give one of type {Kind(wanted).name} in a file or with -p"
            )
        return found

    def get_parameters(self, names: Sequence[str]) -> list[Parameter]:
        """Several parameters."""
        return [self.get_parameter(name) for name in names]

    def get_parameter_or(self, name: str, alternative: Parameter | None = None) -> Parameter:
        """A parameter, or another where it is not declared or has no value."""
        value = self._values.get(name)
        if value is None or value.type_ == Kind.NOT_SET:
            return alternative or Parameter(name)
        return value

    def get_parameters_by_prefix(self, prefix: str) -> dict[str, Parameter]:
        """Parameters below a prefix, by the rest of their name."""
        start = f"{prefix}." if prefix else ""
        return {n[len(start) :]: p for n, p in self._values.items() if n.startswith(start)}

    def set_parameters(self, parameters: Sequence[Parameter]) -> list[Any]:
        """Set each on its own; gives a rcl_interfaces/SetParametersResult for each.

        Raises:
            ParameterNotDeclaredException: One is not declared; those before it are set.
        """
        return [self.set_parameters_atomically([parameter]) for parameter in parameters]

    def set_parameters_atomically(self, parameters: Sequence[Parameter]) -> Any:
        """Set all or none; gives a rcl_interfaces/SetParametersResult.

        Raises:
            ParameterNotDeclaredException: One is not declared.
        """
        result = codec_of().message("rcl_interfaces/msg/SetParametersResult")
        try:
            for parameter in parameters:
                if parameter.name in self._values:
                    self._check(parameter, self._descriptors[parameter.name])
                elif self._undeclared:
                    self.declare_parameter(parameter.name, parameter.value, ignore_override=True)
                else:
                    self.get_parameter(parameter.name)
            self._ask(list(parameters))
        except (
            ParameterImmutableException,
            InvalidParameterTypeException,
            InvalidParameterValueException,
        ) as error:
            return result(successful=False, reason=str(error))
        self._values.update({p.name: p for p in parameters})
        self._parameters_changed(parameters)
        return result(successful=True)

    def describe_parameter(self, name: str) -> Any:
        """Its rcl_interfaces/ParameterDescriptor."""
        self.get_parameter_or(name)
        if name not in self._descriptors:
            raise ParameterNotDeclaredException(
                f"parameter '{name}' is not declared: declare it before it is used"
            )
        return self._descriptors[name]

    def add_on_set_parameters_callback(self, callback: SetCallback) -> None:
        """Ask this before parameters are set; it gives a rcl_interfaces/SetParametersResult."""
        self._callbacks.insert(0, callback)

    def remove_on_set_parameters_callback(self, callback: SetCallback) -> None:
        """Ask no more."""
        self._callbacks.remove(callback)

    def _parameters_changed(self, parameters: Sequence[Parameter]) -> None:
        """Parameters have been set."""

    def _ask(self, parameters: list[Parameter]) -> None:
        for callback in self._callbacks:
            result = callback(parameters)
            if not result.successful:
                names = ", ".join(f"'{p.name}'" for p in parameters)
                raise InvalidParameterValueException(f"parameter {names} was refused: {result.reason}")

    def _check(self, parameter: Parameter, descriptor: Any, *, initial: bool = False) -> None:
        """Check type, range and whether it may be set at all."""
        name = parameter.name
        if name in self._values and descriptor.read_only:
            raise ParameterImmutableException(f"parameter '{name}' is read-only: set it at the start")
        wanted = Kind(descriptor.type)
        if not initial and not descriptor.dynamic_typing and parameter.type_ != wanted:
            raise InvalidParameterTypeException(
                f"parameter '{name}' is {wanted.name}, found {parameter.value!r} ({parameter.type_.name}): "
                f"give a value of that type{', such as 1.0' if wanted == Kind.DOUBLE else ''}"
            )
        for ranges in (descriptor.floating_point_range, descriptor.integer_range):
            for limits in ranges:
                number = isinstance(parameter.value, (int, float))
                if number and not limits.from_value <= parameter.value <= limits.to_value:
                    raise InvalidParameterValueException(
                        f"parameter '{name}' is {parameter.value}, expected {limits.from_value} to {limits.to_value}"
                    )
