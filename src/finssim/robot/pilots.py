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
from finssim.control.modes import Wrench6, action_mode, mode_from_dict
from finssim.control.policy import Policy
from finssim.control.policy_description import PolicyError, read_description
from finssim.control.tracking import Measured
from finssim.control.trim import Trim
from finssim.vehicles import Vehicle

__all__ = ["ModeSwitch", "ObservingPilot", "PidPilot", "Pilot", "WrenchPilot", "make_pilot"]

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


class ObservingPilot:
    """Who acts on a task's observation: a policy directory, run with onnxruntime, or one of the task's baselines.

    Attributes:
        mode: What its actions mean.
        decide: Memory and observations (n, size) -> actions (n, size) and the memory after.
        period: Time between two decisions [s].
    """

    needs_state = True

    def __init__(
        self,
        who: str | Path,
        vehicle: Vehicle,
        *,
        task: str | None = None,
        agent: str | None = None,
        period: float | None = None,
        trim: Trim | None = None,
    ) -> None:
        """Load a policy and check that it fits, or make a baseline.

        Args:
            who: A policy's directory, or the name of a baseline of the task.
            vehicle: It must be the very one that a policy was trained for.
            task: Its name, or FILE.py:CLASS of one's own; a policy must have been trained for it; None: whatever a
                policy was trained for.
            agent: Its place in a task of several; the first if None.
            period: Time between two decisions at which it would be asked [s]; None: its own.
            trim: An integral in front of it, for a steady current or weight; none if None.

        Raises:
            PolicyError, ControlError, BaselineError: Another vehicle, task, observation, rate or other limits, in one
                sentence.
        """
        from finssim.tasks.baselines import BASELINES, baseline
        from finssim.tasks.observer import Observer

        self.name = Path(who).resolve().name
        self._trim = trim
        if task is not None and str(who) in BASELINES.get(task, {}):
            self._observer = Observer(task, vehicle, agent=agent)
            self.mode = action_mode(self._observer.task.action, vehicle)
            self._who: Any = baseline(task, str(who), vehicle)
            self.period, self.decide = self._who.period, self._who.act
            self._about: dict[str, Any] = {"kind": "baseline", "task": task, "trim": None}
            self.reset()
            return
        trained = read_description(Path(who))
        self.mode = mode_from_dict(trained.action, vehicle)
        self._observer = Observer(
            task or trained.task, vehicle, agent=agent, action=str(trained.action["mode"])
        )
        self._who = policy = Policy.load(
            who, vehicle=vehicle, task=self._observer.describe(), control_period=period
        )
        self.decide = policy.step
        self.period = trained.control_period
        self._about = {
            "kind": "policy",
            "task": trained.task,
            "trim": asdict(trim) if trim else None,
            "hydrodynamics": trained.hydrodynamics,
            "seed": trained.seed,
            "files": dict(trained.files),
        }
        self.reset()

    def describe(self) -> dict[str, Any]:
        """Name, network, and what it was trained in."""
        about = {"name": self.name, **self._about, "action": self.mode.name, "period_s": self.period}
        several = len(self._observer.task.agents) > 1
        return {**about, "agent": self._observer.agent} if several else about

    def fresh(self, n: int) -> Any:
        """What `decide` is to remember before the first of n rows."""
        return self._who.reset(n)

    def reset(self) -> None:
        """Forget what was seen, and the trim's shift."""
        self._memory = self.fresh(1)
        self._shift = np.zeros(3)
        self.observation, self.action = np.zeros(0, np.float32), np.zeros(0, np.float32)
        """What was seen, and done in [-1, 1], at the last decision; empty before the first."""
        self._observer.restart()

    def act(self, reading: Measured, guide: Guide, t: float) -> Array:
        """Wanted thrusts in canonical order [N], (n,)."""
        observation: Any = self._observer.observe(
            reading, guide, t, self.action if self.action.size else None
        )
        if self._trim is not None:
            self._shift = self._trim.update(self._shift, reading, guide.at(t).position, self.period)
            observation = self._trim.shown(observation, reading, self._shift, self._observer.schema)
        action, self._memory = self.decide(self._memory, observation[None])
        self.observation, self.action = np.asarray(observation), np.clip(action[0], -1.0, 1.0)
        return self.mode.to_thrusters(action[0])


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
    name_or_directory: str | Path,
    vehicle: Vehicle,
    *,
    task: str | None = None,
    agent: str | None = None,
    trim: Trim | None = None,
) -> PidPilot | ObservingPilot:
    """A PID by its name, the policy of a directory, or a baseline of the task; only a policy takes a trim.

    Raises:
        PolicyError, ControlError: It does not fit the vehicle or the task.
    """
    if str(name_or_directory) in CONTROLLERS and task in (None, "t1", "t2"):
        return PidPilot(str(name_or_directory), vehicle, task or "t1")
    if Path(name_or_directory).exists():
        return ObservingPilot(name_or_directory, vehicle, task=task, agent=agent, trim=trim)
    from finssim.tasks.baselines import BASELINES

    known = BASELINES.get(task or "", {})
    if str(name_or_directory) not in known:
        names = dict.fromkeys([*(CONTROLLERS if task in (None, "t1", "t2") else ()), *known])
        raise PolicyError(
            f"{name_or_directory}: neither {' nor '.join(names)} nor a policy directory: give one of these"
        )
    return ObservingPilot(name_or_directory, vehicle, task=task, agent=agent)
