"""Who steers: a PID, a policy or a person, behind one interface; a switch between them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from finssim.control.controllers import CONTROLLERS, controller_for
from finssim.control.errors import ControlError
from finssim.control.guidance import Guide, goal_at
from finssim.control.modes import Wrench6, mode_from_dict
from finssim.control.observations import observer
from finssim.control.policy import Policy
from finssim.control.policy_description import PolicyError, read_description
from finssim.control.tracking import Measured
from finssim.control.trim import Trim
from finssim.vehicles import Vehicle

__all__ = ["ModeSwitch", "PidPilot", "Pilot", "PolicyPilot", "WrenchPilot", "make_pilot"]

Array = npt.NDArray[np.float64]


class Pilot(Protocol):
    """Decides thrusts, every `period` seconds."""

    @property
    def name(self) -> str:
        """By which the bridge knows who commands."""

    @property
    def period(self) -> float:
        """Time between two decisions [s]."""

    @property
    def needs_state(self) -> bool:
        """Whether it may only decide on a reading that is ready."""

    def describe(self) -> dict[str, Any]:
        """Who it is, as plain data."""

    def reset(self) -> None:
        """Forget what was before."""

    def act(self, reading: Measured, guide: Guide, t: float) -> Array:
        """Wanted thrusts in canonical order [N], (n,).

        Args:
            reading: The vehicle's state.
            guide: Where it should be.
            t: Time since the guide's start [s].
        """


class PidPilot:
    """A PID by name; its wrench goes through the same limits and allocation as a policy's."""

    needs_state = True

    def __init__(self, name: str, vehicle: Vehicle, task: str = "t1") -> None:
        """
        Args:
            name: pid or pid-paper.
            vehicle: Its model gives the gains.
            task: What it is for: pid-paper has a published profile of its own for t2.

        Raises:
            ControlError: Unknown name.
        """
        self.name = name
        self._controller = controller_for(task, name, vehicle)
        self._mode = Wrench6.from_vehicle(vehicle)
        self._limits = np.asarray(vehicle.wrench_limits, float)
        self._memory: Any = self._controller.reset()

    @property
    def period(self) -> float:
        """Time between two decisions [s]."""
        return self._controller.period

    def describe(self) -> dict[str, Any]:
        """Name and rate."""
        return {"name": self.name, "kind": "pid", "action": self._mode.name, "period_s": self.period}

    def reset(self) -> None:
        """Empty the integrals."""
        self._memory = self._controller.reset()

    def act(self, reading: Measured, guide: Guide, t: float) -> Array:
        """Wanted thrusts in canonical order [N], (n,)."""
        tau, self._memory = self._controller.command(self._memory, reading, goal_at(guide, t))
        return self._mode.allocator.allocate(np.clip(tau, -self._limits, self._limits))[0]


class PolicyPilot:
    """A policy directory, run with onnxruntime, on the observation of the task that it was trained for."""

    needs_state = True

    def __init__(
        self,
        directory: str | Path,
        vehicle: Vehicle,
        *,
        task: str | None = None,
        period: float | None = None,
        trim: Trim | None = None,
    ) -> None:
        """Load a policy and check that it fits.

        Args:
            directory: Of the policy.
            vehicle: It must be the very one that the policy was trained for.
            task: It must have been trained for; None: whatever it was trained for.
            period: Time between two decisions at which it would be asked [s]; None: its own.
            trim: An integral in front of it, for a steady current or weight; none if None.

        Raises:
            PolicyError, ControlError: Another vehicle, task, observation, rate or other limits, in one sentence.
        """
        trained_for = read_description(Path(directory)).task
        self._observer = observer(task or trained_for)
        self.policy = Policy.load(
            directory,
            vehicle=vehicle,
            task=self._observer.describe(task or trained_for),
            control_period=period,
        )
        self._mode = mode_from_dict(self.policy.description.action, vehicle)
        self.name = Path(directory).resolve().name
        self._trim = trim
        self.reset()

    @property
    def period(self) -> float:
        """Time between two decisions [s]: that of training."""
        return self.policy.description.control_period

    def describe(self) -> dict[str, Any]:
        """Name, network, and what it was trained in."""
        d = self.policy.description
        return {
            "name": self.name,
            "kind": "policy",
            "task": d.task,
            "action": self._mode.name,
            "period_s": self.period,
            "trim": asdict(self._trim) if self._trim else None,
            "hydrodynamics": d.hydrodynamics,
            "seed": d.seed,
            "files": dict(d.files),
        }

    def reset(self) -> None:
        """Forget what a policy with memory has seen, and the trim's shift."""
        self._memory = self.policy.reset(1)
        self._shift = np.zeros(3)

    def act(self, reading: Measured, guide: Guide, t: float) -> Array:
        """Wanted thrusts in canonical order [N], (n,)."""
        observation = self._observer.observe(reading, guide, t)
        if self._trim is not None:
            self._shift = self._trim.update(self._shift, reading, guide.at(t).position, self.period)
            schema = self.policy.description.observation
            observation = self._trim.shown(observation, reading, self._shift, schema)
        action, self._memory = self.policy.step(self._memory, observation)
        return self._mode.to_thrusters(action)


class WrenchPilot:
    """A person's wrench, allocated to the thrusters; it needs to know nothing of where the vehicle is."""

    needs_state = False

    def __init__(
        self,
        wrench: Callable[[], npt.ArrayLike],
        vehicle: Vehicle,
        *,
        name: str = "teleop",
        period: float = 0.05,
    ) -> None:
        """
        Args:
            wrench: Gives the wanted wrench about `vehicle.wrench_reference`, body frame [N, N m], (6,).
            vehicle: Its limits bound the wrench, axis by axis.
            name: By which the bridge knows who commands.
            period: Time between two decisions [s].
        """
        self.name, self.period = name, period
        self._wrench, self._mode = wrench, Wrench6.from_vehicle(vehicle)
        self._limits = np.asarray(vehicle.wrench_limits, float)

    def describe(self) -> dict[str, Any]:
        """Name and rate."""
        return {"name": self.name, "kind": "teleop", "action": self._mode.name, "period_s": self.period}

    def reset(self) -> None:
        """A person remembers."""

    def act(self, reading: Measured, guide: Guide, t: float) -> Array:
        """Wanted thrusts in canonical order [N], (n,)."""
        tau = np.asarray(self._wrench(), float)
        return self._mode.allocator.allocate(np.clip(tau, -self._limits, self._limits))[0]


class ModeSwitch:
    """Several pilots of which one steers; itself a pilot."""

    def __init__(self, pilots: Mapping[str, Pilot], selected: str | None = None) -> None:
        """
        Args:
            pilots: Mode -> pilot, at least one.
            selected: Mode at the start; the first if None.

        Raises:
            ControlError: No pilot, or an unknown mode.
        """
        if not pilots:
            raise ControlError("a mode switch needs at least one pilot")
        self._pilots = dict(pilots)
        self.mode = next(iter(pilots))
        self.select(selected or self.mode)

    def select(self, mode: str) -> None:
        """Hand over to another pilot, which starts without memory.

        Raises:
            ControlError: No such mode.
        """
        if mode not in self._pilots:
            raise ControlError(f"unknown mode '{mode}'; available: {', '.join(self._pilots)}")
        self.mode = mode
        self._pilots[mode].reset()

    @property
    def pilot(self) -> Pilot:
        """Who steers."""
        return self._pilots[self.mode]

    name = "mode-switch"
    """One for all pilots: to the bridge they are one commander, and no second publisher when they change."""

    @property
    def period(self) -> float:
        """Time between two decisions of the pilot that steers [s]."""
        return self.pilot.period

    @property
    def needs_state(self) -> bool:
        """Whether the pilot that steers may only decide on a reading that is ready."""
        return self.pilot.needs_state

    def describe(self) -> dict[str, Any]:
        """The mode and its pilot."""
        return {"mode": self.mode, **self.pilot.describe()}

    def reset(self) -> None:
        """Forget what was before."""
        self.pilot.reset()

    def act(self, reading: Measured, guide: Guide, t: float) -> Array:
        """Wanted thrusts in canonical order [N], (n,)."""
        return self.pilot.act(reading, guide, t)


def make_pilot(
    name_or_directory: str | Path, vehicle: Vehicle, *, task: str | None = None, trim: Trim | None = None
) -> PidPilot | PolicyPilot:
    """A PID by its name, or the policy of a directory; a PID has an integral of its own and takes no trim.

    Raises:
        PolicyError, ControlError: It does not fit the vehicle or the task.
    """
    if str(name_or_directory) in CONTROLLERS:
        return PidPilot(str(name_or_directory), vehicle, task or "t1")
    if not Path(name_or_directory).exists():
        raise PolicyError(
            f"{name_or_directory}: neither {' nor '.join(CONTROLLERS)} nor a policy directory: give one of these"
        )
    return PolicyPilot(name_or_directory, vehicle, task=task, trim=trim)
