"""Actuators other than thrusters: kinds by name, each from one file, and their sections in a vehicle file.

This layer reads the sections; `finssim.physics.actuators` has the kinds of FinsSim, and the engine evaluates them.
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
    """Keys that the section of every actuator has: its travel and how it follows a command.

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
    """Dead band and backlash: it does not move while its target is no farther than this, in the unit of the kind."""
    off: Number | None = None
    """Value to which it goes while the vehicle is disarmed or in a fault, in the unit of the kind; it stays where it
    is if None."""

    @model_validator(mode="after")
    def _neutral_within(self) -> Actuator:
        if not self.minimum <= 0.0 <= self.maximum or self.minimum == self.maximum:
            raise refuse_section(
                f"minimum {self.minimum:g} and maximum {self.maximum:g}: expected a travel that holds 0, the rest value"
            )
        if self.off is not None and not self.minimum <= self.off <= self.maximum:
            raise refuse_section(f"off is {self.off:g}, expected {self.minimum:g} to {self.maximum:g}")
        return self


@dataclass(frozen=True, kw_only=True, eq=False)
class ActuatorKind:
    """A kind of actuator, with everything that the package has to know of it.

    Where all parameters are zero, its functions have to give zero: so it is of vehicles that do not have the actuator,
    beside others that do.
    """

    name: str
    """Value of `kind` in a vehicle file."""
    schema: type[Actuator]
    """Keys of its section."""
    unit: str
    """Unit of its value and of the command."""
    units: Mapping[str, str]
    """Unit of each parameter of its functions by name."""
    wrench: Any = None
    """`wp.func` -> vec6: wrench about the body origin, body frame [N, N m], in proportion to the wet part of the
    vehicle; see `finssim.physics.terms` for its arguments, of which nu_r is here that of the body origin."""
    slope: Any = None
    """`wp.func` of such arguments -> vec6: how fast the wrench falls with the velocity on each axis of the body origin,
    0 or more [N s/m, N m s]. A stiff damping needs it, for the integrator takes that much implicitly."""
    shift: Any = None
    """`wp.func` -> vec9: change of the body's first moment of mass [kg m] and of its inertia about the body origin
    [kg m²] (xx, yy, zz, xy, xz, yz), body frame."""
    carry: Any = None
    """`wp.func` -> vec6: momentum about the body origin per rate of the value, times the value, of what moves within
    the body [kg m, kg m²], body frame; the body recoils from its changes."""
    numbers: Callable[[Any, Vehicle], Mapping[str, Any]] | None = None
    """Function from section and vehicle to the parameters that no key of the section gives."""

    further: tuple[str, ...] = ()
    """Parameters besides those of the schema that can be drawn and fitted."""

    @cached_property
    def scalars(self) -> tuple[str, ...]:
        """Names of the parameters that can be drawn and fitted: one number each."""
        fields = self.schema.model_fields
        own = (name for name in self.units if name in fields and fields[name].annotation is float)
        return (*own, *self.further)


@dataclass(frozen=True)
class InstalledActuator:
    """A kind of actuator in one channel of a vehicle, as an item of the row of parameters."""

    kind: ActuatorKind
    channel: int

    @property
    def name(self) -> str:
        """Name that no other item has."""
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
                f"actuator '{self.kind.name}': numbers gives '{unknown[0]}', expected of: {', '.join(self.kind.units)}"
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
        PydanticCustomError: A section is refused; one sentence.
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
    """Return the actuators of a vehicle with their sections, by kind and channel; thrusters come before the others.

    A thruster is among them where its thrust depends on the inflow.
    """
    out: dict[InstalledActuator, Any] = {}
    for channel, thruster in enumerate(vehicle.thrusters.values()):
        if thruster.inflow is not None:
            out[InstalledActuator(ACTUATORS["propeller"], channel)] = thruster
    for channel, section in enumerate(vehicle.actuators.values(), start=len(vehicle.thrusters)):
        out[InstalledActuator(ACTUATORS[section.kind], channel)] = section
    return out
