"""Actuators other than thrusters: kinds by name, one file per kind, and their sections in a vehicle file.

This package reads the sections; `finssim.physics.actuators` defines FinsSim's kinds, and the engine evaluates them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError, model_validator

from finssim.core.registry import ACTUATORS, RegistryError
from finssim.vehicles.part import (
    NonNegative,
    Number,
    Part,
    Positive,
    did_you_mean,
    refuse_section,
    refuse_value,
    sentence_of,
)

if TYPE_CHECKING:
    from finssim.vehicles.vehicle import Vehicle

__all__ = ["Actuator", "ActuatorKind", "InstalledActuator", "installed", "read_actuators"]


class Actuator(Part):
    """Common keys of the section of every actuator: its range and its response to a command.

    Its value is an angle, a volume or a position, in the unit of its kind.
    """

    kind: str
    """A name of `finssim.core.registry.ACTUATORS`."""
    minimum: Number
    """Least value, at most 0, in the unit of the kind."""
    maximum: Number
    """Greatest value, at least 0, in the unit of the kind."""
    time_constant: NonNegative = 0.0
    """Time constant of the first-order lag [s]."""
    rate_limit: Positive = math.inf
    """Fastest change, in the unit of the kind per second."""
    play: NonNegative = 0.0
    """Dead band and backlash: the actuator does not move while its target is within this distance, in the
    unit of the kind."""
    off: Number | None = None
    """Value that the actuator moves to while the vehicle is disarmed or in a fault, in the unit of the kind;
    if None it keeps its value."""

    @model_validator(mode="after")
    def _neutral_within(self) -> Actuator:
        if not self.minimum <= 0.0 <= self.maximum or self.minimum == self.maximum:
            raise refuse_section(
                f"minimum {self.minimum:g}, maximum {self.maximum:g}: expected a range that contains 0, the rest value"
            )
        if self.off is not None and not self.minimum <= self.off <= self.maximum:
            raise refuse_section(f"off is {self.off:g}, expected {self.minimum:g} to {self.maximum:g}")
        return self


@dataclass(frozen=True, kw_only=True, eq=False)
class ActuatorKind:
    """Kind of actuator, with everything that the package needs to know about it.

    Where all parameters are zero, its functions must return zero: vehicles without the actuator are simulated
    in the same batch with zero parameters.
    """

    name: str
    """Value of `kind` in a vehicle file."""
    schema: type[Actuator]
    """Keys of its section."""
    unit: str
    """Unit of its value and of its command."""
    units: Mapping[str, str]
    """Unit of each parameter of its functions by name."""
    wrench: Any = None
    """`wp.func` -> vec6: wrench about the body origin, body frame [N, N m], scaled by the submerged fraction
    of the vehicle; see `finssim.physics.terms` for its arguments; here nu_r is that of the body origin."""
    slope: Any = None
    """`wp.func` of the same arguments -> vec6: decrease of the wrench with the velocity of the body origin on each
    axis, at least 0 [N s/m, N m s]. Required for stiff damping, which the integrator then treats implicitly."""
    shift: Any = None
    """`wp.func` -> vec9: change of the body's first moment of mass [kg m] and of its inertia about the body origin
    [kg m²] (xx, yy, zz, xy, xz, yz), body frame."""
    carry: Any = None
    """`wp.func` -> vec6: momentum about the body origin per rate of the value, times the value, of masses
    moving within the body [kg m, kg m²], body frame; the body recoils when it changes."""
    numbers: Callable[[Any, Vehicle], Mapping[str, Any]] | None = None
    """Function of section and vehicle that returns the parameters that the section does not contain."""

    further: tuple[str, ...] = ()
    """Additional parameters, not in the schema, that can be drawn and fitted."""

    @cached_property
    def scalars(self) -> tuple[str, ...]:
        """Names of the scalar parameters, which can be drawn and fitted."""
        fields = self.schema.model_fields
        own = (name for name in self.units if name in fields and fields[name].annotation is float)
        return (*own, *self.further)


@dataclass(frozen=True)
class InstalledActuator:
    """Kind of actuator in one channel of a vehicle."""

    kind: ActuatorKind
    channel: int

    @property
    def name(self) -> str:
        """Unique name of the item."""
        return f"{self.kind.name}_{self.channel}"

    @property
    def parameters(self) -> dict[str, str]:
        """Name of each parameter -> its path among the parameters of a simulation."""
        return {name: f"actuators.{self.name}.{name}" for name in self.kind.units}

    def numbers(self, section: Any, vehicle: Vehicle) -> dict[str, Any]:
        """Path of each parameter -> its number or array, in the unit of the kind."""
        further = {} if self.kind.numbers is None else self.kind.numbers(section, vehicle)
        unknown = [name for name in further if name not in self.kind.units]
        if unknown:
            raise RegistryError(
                f"actuator '{self.kind.name}': numbers returns '{unknown[0]}', expected {', '.join(self.kind.units)}"
            )
        return {
            path: further[name] if name in further else getattr(section, name)
            for name, path in self.parameters.items()
        }


def read_actuators(value: Any) -> dict[str, Actuator]:
    """Return the checked sections of actuators by name.

    Args:
        value: Content of `actuators` in a vehicle file.

    Raises:
        PydanticCustomError: A section is invalid; the message is one sentence.
    """
    if not isinstance(value, Mapping):
        raise refuse_value(f"is {value!r}, expected a section of actuators by name")
    out = {}
    for name, section in value.items():
        if isinstance(section, Actuator):
            out[name] = section
            continue
        kind = section.get("kind") if isinstance(section, Mapping) else None
        if not isinstance(kind, str) or kind not in ACTUATORS:
            raise refuse_section(
                f"{name}: kind is {kind!r}{did_you_mean(str(kind), list(ACTUATORS))} expected one of "
                f"{', '.join(ACTUATORS)}"
            )
        try:
            out[name] = ACTUATORS[kind].schema.model_validate(dict(section))
        except RegistryError as error:
            raise refuse_section(str(error)) from error
        except ValidationError as error:
            raise refuse_section("; ".join(sentence_of(d, str(name)) for d in error.errors())) from None
    return out


def installed(vehicle: Vehicle) -> dict[InstalledActuator, Any]:
    """Return the actuators of a vehicle with their sections, by kind and channel; thrusters come first.

    A thruster is included only if its thrust depends on the inflow.
    """
    out: dict[InstalledActuator, Any] = {}
    for channel, thruster in enumerate(vehicle.thrusters.values()):
        if thruster.inflow is not None:
            out[InstalledActuator(ACTUATORS["propeller"], channel)] = thruster
    for channel, section in enumerate(vehicle.actuators.values(), start=len(vehicle.thrusters)):
        out[InstalledActuator(ACTUATORS[section.kind], channel)] = section
    return out
