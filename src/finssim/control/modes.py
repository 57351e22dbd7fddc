"""Action modes: what a policy's numbers in [-1, 1] mean; limits and scale are part of the definition."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from finssim.control import ControlError
from finssim.control.allocation import Allocator

__all__ = ["MODES", "Thruster8", "Wrench4", "Wrench6", "action_mode", "mode_from_dict"]

Array = npt.NDArray[np.float64]

AXES = ("surge", "sway", "heave", "roll", "pitch", "yaw")


@dataclass(frozen=True, kw_only=True)
class Thruster8:
    """Each component is a part of its thruster's limit: a >= 0 of the forward one, a < 0 of the reverse one."""

    name: ClassVar[str] = "thruster8"

    labels: tuple[str, ...]
    """Thruster names in canonical order, (n,)."""
    lower: tuple[float, ...]
    """Least thrust [N], (n,), all <= 0."""
    upper: tuple[float, ...]
    """Greatest thrust [N], (n,), all >= 0."""
    scale: tuple[float, ...]
    """Part of the limit that action 1 stands for, (n,)."""

    def __post_init__(self) -> None:
        if not len(self.labels) == len(self.lower) == len(self.upper) == len(self.scale) > 0:
            raise ControlError("thruster8 needs one name, lower limit, upper limit and scale per thruster")
        if not (np.less_equal(self.lower, 0.0).all() and np.greater_equal(self.upper, 0.0).all()):
            raise ControlError("thruster8 needs thrust limits with lower <= 0 <= upper")
        _check_scale(self.name, self.scale)

    @classmethod
    def from_vehicle(cls, vehicle: Any, scale: float | Sequence[float] = 1.0) -> Thruster8:
        """The mode of a vehicle's thrusters and limits."""
        names = tuple(vehicle.thruster_names)
        lower, upper = (tuple(map(float, limits)) for limits in vehicle.force_limits)
        return cls(labels=names, lower=lower, upper=upper, scale=_spread(cls.name, scale, len(names)))

    @property
    def size(self) -> int:
        """Components of an action."""
        return len(self.labels)

    def to_thrusters(self, action: npt.ArrayLike) -> Array:
        """Thrusts in canonical order [N], (..., n), for actions (..., n); components beyond +-1 saturate.

        Raises:
            ControlError: The action has another length, or holds NaN.
        """
        a = _checked(self.name, self.size, action) * np.array(self.scale)
        return np.asarray(np.where(a >= 0.0, a * np.array(self.upper), -a * np.array(self.lower)))

    def describe(self) -> dict[str, Any]:
        """Everything that defines the mode, as plain data."""
        return {
            "mode": self.name,
            "size": self.size,
            "labels": list(self.labels),
            "lower": list(self.lower),
            "upper": list(self.upper),
            "scale": list(self.scale),
        }


@dataclass(frozen=True, kw_only=True)
class Wrench6:
    """Each component is a part of one axis' wrench limit; the wrench is allocated to the thrusters."""

    name: ClassVar[str] = "wrench6"
    axes: ClassVar[tuple[int, ...]] = (0, 1, 2, 3, 4, 5)
    """Axis of the wrench that each component drives; the others are asked to be zero."""

    limits: tuple[float, ...]
    """Wrench at action 1 and scale 1, about `reference`, body frame [N, N m], (6,)."""
    scale: tuple[float, ...]
    """Part of the limit that action 1 stands for, (6,)."""
    reference: tuple[float, ...]
    """Body point about which the wrench is meant [m], (3,)."""
    allocator: Allocator = field(repr=False, compare=False)
    """Of the vehicle, about `reference`."""

    def __post_init__(self) -> None:
        if len(self.limits) != 6 or not np.greater_equal(self.limits, 0.0).all():
            raise ControlError(f"{self.name} needs 6 wrench limits, none negative")
        _check_scale(self.name, self.scale)

    @classmethod
    def from_vehicle(cls, vehicle: Any, scale: float | Sequence[float] = 1.0) -> Wrench6:
        """The mode of a vehicle's wrench limits, with its allocator."""
        return cls(
            limits=tuple(map(float, vehicle.wrench_limits)),
            scale=_spread(cls.name, scale, 6),
            reference=tuple(map(float, vehicle.wrench_reference)),
            allocator=Allocator.from_vehicle(vehicle),
        )

    @property
    def size(self) -> int:
        """Components of an action."""
        return len(self.axes)

    @property
    def labels(self) -> tuple[str, ...]:
        """Axis names."""
        return tuple(AXES[axis] for axis in self.axes)

    def to_wrench(self, action: npt.ArrayLike) -> Array:
        """Wanted wrench about `reference`, body frame [N, N m], (..., 6), for actions (..., size).

        Raises:
            ControlError: The action has another length, or holds NaN.
        """
        a = _checked(self.name, self.size, action)
        tau = np.zeros((*a.shape[:-1], 6))
        tau[..., list(self.axes)] = a
        return np.asarray(tau * np.array(self.scale) * np.array(self.limits))

    def to_thrusters(self, action: npt.ArrayLike) -> Array:
        """Thrusts in canonical order [N], (..., n), for actions (..., size); components beyond +-1 saturate.

        Raises:
            ControlError: The action has another length, or holds NaN.
        """
        return self.allocator.allocate(self.to_wrench(action))[0]

    def describe(self) -> dict[str, Any]:
        """Everything that defines the mode, as plain data."""
        return {
            "mode": self.name,
            "size": self.size,
            "labels": list(self.labels),
            "limits": list(self.limits),
            "scale": list(self.scale),
            "reference": list(self.reference),
        }


@dataclass(frozen=True, kw_only=True)
class Wrench4(Wrench6):
    """Surge, sway, heave and yaw as in `Wrench6`; the roll and pitch moments are asked to be zero."""

    name: ClassVar[str] = "wrench4"
    axes: ClassVar[tuple[int, ...]] = (0, 1, 2, 5)


MODES: dict[str, type[Thruster8] | type[Wrench6]] = {
    mode.name: mode for mode in (Thruster8, Wrench6, Wrench4)
}
"""Action modes by name."""


def action_mode(name: str, vehicle: Any, scale: float | Sequence[float] = 1.0) -> Thruster8 | Wrench6:
    """The mode of that name for a vehicle.

    Raises:
        ControlError: No such mode, or a scale it cannot have.
    """
    if name not in MODES:
        raise ControlError(f"unknown action mode '{name}'; available: {', '.join(MODES)}")
    return MODES[name].from_vehicle(vehicle, scale)


def mode_from_dict(description: Mapping[str, Any], vehicle: Any) -> Thruster8 | Wrench6:
    """The mode that `describe()` recorded, for the vehicle it is to drive now.

    Raises:
        ControlError: The vehicle's limits, names or reference are not those of the description: its actions would mean
            something else.
    """
    mode = action_mode(str(description.get("mode")), vehicle, description.get("scale", 1.0))
    for key, here in mode.describe().items():
        if not _same(description.get(key), here):
            raise ControlError(
                f"{mode.name}: {key} was {description.get(key)} and is {here} on {vehicle.name}: "
                "use the vehicle file that the policy was trained with"
            )
    return mode


def _same(recorded: Any, here: Any) -> bool:
    if isinstance(here, list) and here and isinstance(here[0], float):
        numbers = isinstance(recorded, list) and all(isinstance(value, int | float) for value in recorded)
        return (
            numbers
            and len(recorded) == len(here)
            and bool(np.allclose(recorded, here, rtol=1e-6, atol=1e-12))
        )
    return bool(recorded == here)


def _checked(name: str, size: int, action: npt.ArrayLike) -> Array:
    a = np.asarray(action, float)
    if a.shape[-1:] != (size,):
        raise ControlError(f"{name} action has shape {a.shape}, expected (..., {size})")
    if np.isnan(a).any():
        raise ControlError(f"{name} action holds NaN: the policy or its observation is broken")
    return np.asarray(np.clip(a, -1.0, 1.0))


def _spread(name: str, scale: float | Sequence[float], size: int) -> tuple[float, ...]:
    try:
        return tuple(np.broadcast_to(np.asarray(scale, float), (size,)).tolist())
    except ValueError:
        raise ControlError(
            f"{name} scale has shape {np.shape(scale)}, expected one number or {size}"
        ) from None


def _check_scale(name: str, scale: Sequence[float]) -> None:
    if not (np.greater_equal(scale, 0.0).all() and np.less_equal(scale, 1.0).all()):
        raise ControlError(f"{name} scale is {tuple(scale)}, expected numbers in 0 to 1")
