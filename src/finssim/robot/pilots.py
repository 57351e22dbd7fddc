"""Pilots with one interface: a PID, a policy or a human, and a switch between them."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt

from finssim.agents.controllers import CONTROLLERS
from finssim.control import ControlError
from finssim.control.allocation import Allocator
from finssim.control.course import CoursePilot
from finssim.control.guidance import Goal, Guide, Known, Measured, Track, goal_at
from finssim.control.modes import MODES, action_mode, mode_from_dict
from finssim.control.policy import PolicyError, read_description
from finssim.core.rotations import quat_from_yaw, quat_multiply
from finssim.robot.pictures import resized
from finssim.vehicles import Vehicle

if TYPE_CHECKING:
    from finssim.agents.agent import Agent
    from finssim.tasks.observer import Observer


Array = npt.NDArray[np.float64]

BY_AXES, TURN = 2.0 / 3.0, 1.0
"""Fraction of a task's observed goal distance, and greatest observed heading difference [rad], for a vehicle that is
steered by ArduSub's axes: it is located by a DVL, which loses the floor at large tilts."""


class Pilot(Protocol):
    """Controller that computes thrusts every `period` seconds."""

    @property
    def name(self) -> str:
        """Name of the command source for the bridge."""

    @property
    def period(self) -> float:
        """Time between two decisions [s]."""

    @property
    def needs_state(self) -> bool:
        """True if it requires a reading that is ready."""

    def describe(self) -> dict[str, Any]:
        """Return its description as plain data."""

    def reset(self) -> None:
        """Reset the memory."""

    def act(self, reading: Measured, guide: Guide, t: float) -> Array:
        """Return the requested thrusts in canonical order [N], (n,); or one number per channel of the vehicle, in the
        order of `Vehicle.channel_names`: thrusts, then the values of the other actuators [rad, m³ or m].

        Args:
            reading: The vehicle's state.
            guide: Motion to follow.
            t: Time since the guide's start [s].
        """


class AgentPilot:
    """An agent as pilot: a PID, a policy or a baseline of a task, applied to the reading of one vehicle.

    Attributes:
        agent: The agent, as in a batch.
        observer: Observation of the reading; None for a controller that uses state and goal alone.
        mode: Action mode.
        period: Time between two decisions [s].
        observation: Observation of the last decision; empty before the first.
        action: Action of the last decision, in [-1, 1]; empty before the first.
        pictures: Shape of the agent's pictures, by name of the vehicle's sensor; () for a range in the observation.
        took: Computation time of the last decision [s]; NaN before the first.
    """

    needs_state = True

    def __init__(
        self,
        agent: Agent,
        vehicle: Vehicle,
        observer: Observer | None = None,
        pictures: Mapping[str, Sequence[int]] | None = None,
    ) -> None:
        """Set up the pilot.

        Args:
            agent: Agent for the vehicle.
            vehicle: Vehicle whose thrusters are commanded.
            observer: Observer of the agent's task; None if the agent has no observation.
            pictures: Shape of the agent's pictures, by the name of the vehicle's sensor: (height, width, 3), for a
                sonar (beams, range cells, 1).

        Raises:
            ControlError: The vehicle has no such sensor.
        """
        task = None if observer is None else observer.task
        self.pictures = {name: tuple(shape) for name, shape in (pictures or {}).items()}
        self._ranges = () if task is None else task.ranges
        self.pictures |= dict.fromkeys(self._ranges, ())
        for name in self.pictures:
            if name not in vehicle.perception:
                raise ControlError(
                    f"{agent.name} sees {name}, which {vehicle.name} does not have: its perception has "
                    f"{', '.join(vehicle.perception) or 'nothing'}"
                )
        self.agent, self.observer, self.period, self.name = agent, observer, agent.period, agent.name
        self.mode = action_mode(agent.action, vehicle, agent.wrench_scale)
        self._course = MODES[self.mode.name].course
        self._steersman: CoursePilot | None = None
        if self._course:
            from finssim.sim.free_motion import linear_model

            self._steersman = CoursePilot(linear_model(vehicle), vehicle.name, self.period)
        reach = task.approach * task.fit.size if hasattr(task, "approach") else math.inf
        self.reach = reach * (BY_AXES if self.mode.pilot else 1.0)
        """Greatest observed distance to a goal; farther goals are moved to this distance in their direction [m]."""
        self.turn = TURN if self.mode.pilot and math.isfinite(reach) else math.inf
        """Greatest observed heading difference; larger ones are limited to it [rad]."""
        self._input_noise: dict[str, float] = {}
        self.took = math.nan
        self.reset()

    def describe(self) -> dict[str, Any]:
        """Return its description as plain data."""
        about = self.agent.describe() | ({"input_noise": self._input_noise} if self._input_noise else {})
        if self.observer is None:
            return about
        task = self.observer.task
        return {
            **about,
            "task": task.name,
            **({"agent": self.observer.agent} if len(task.agents) > 1 else {}),
        }

    def reset(self) -> None:
        """Reset memory, observation and action."""
        self._memory = self.agent.reset(1)
        self._steering = None if self._steersman is None else self._steersman.reset()
        self.observation = self.action = np.zeros(0, np.float32)
        self._random = np.random.default_rng(round(self._input_noise.get("seed", 0)))
        if self.observer is not None:
            self.observer.restart()

    def disturb_input(self, *, position_std: float, yaw_std: float, seed: int = 0) -> None:
        """Add independent errors to position and heading, drawn for every decision.

        The published ablation "+ localization noise" has 5 cm per axis and 10 degrees; it affects only the controller's
        input.

        Args:
            position_std: Standard deviation of each coordinate [m].
            yaw_std: Standard deviation of the heading [rad].
            seed: Seed of the errors; `reset` restarts them.
        """
        self._input_noise = {"position_std_m": position_std, "yaw_std_rad": yaw_std, "seed": seed}
        self.reset()

    def act(self, reading: Measured, guide: Guide, t: float) -> Array:
        """Return the requested thrusts in canonical order [N], (n,), or values of all channels, as `Pilot.act`."""
        pictures = {
            name: resized(reading.pictures[name].image, shape)[None]  # type: ignore[attr-defined]
            for name, shape in self.pictures.items()
            if shape
        }
        ranges = [reading.pictures[name].ranges[0] for name in self._ranges]  # type: ignore[attr-defined]
        if self._input_noise:
            moved = reading.position + self._random.normal(0.0, self._input_noise["position_std_m"], 3)
            turn = quat_from_yaw(self._random.normal(0.0, self._input_noise["yaw_std_rad"]))
            reading = Track(moved, quat_multiply(turn, reading.quaternion), np.asarray(reading.nu, float))
        if self.observer is not None:
            previous = self.action if self.action.size else None
            self.observation = self.observer.observe(
                reading, guide, t, previous, self.reach, self.turn, ranges
            )
        rows = [self.observation[None], *(np.asarray(x, float)[None] for x in _state(reading))]
        knowledge = Known(*rows, pictures=pictures or None)
        goal = goal_at(guide, t)
        aims = (goal.position, goal.quaternion, goal.velocity, goal.acceleration)
        began = time.perf_counter()
        action, self._memory = self.agent.act(
            self._memory, knowledge, Goal(*(np.asarray(x, float)[None] for x in aims))
        )
        self.took = time.perf_counter() - began
        self.action = np.clip(action[0], -1.0, 1.0)
        if self._steersman is None:
            return self.mode.to_thrusters(self.action)
        channels, self._steering = self._steersman.act(
            self._steering, reading, self.action, by_pitch=self._course == "pitch"
        )
        return channels[0]


class WrenchPilot:
    """A human's wrench command, allocated to the thrusters; it needs no estimate of the state."""

    needs_state = False

    def __init__(
        self,
        wrench: Callable[[], npt.ArrayLike],
        vehicle: Vehicle,
        *,
        name: str = "teleop",
        period: float = 0.05,
    ) -> None:
        """Set up the pilot.

        Args:
            wrench: Returns the requested wrench about `vehicle.wrench_reference`, body frame [N, N m], (6,).
            vehicle: Vehicle whose limits bound the wrench, axis by axis.
            name: Name of the command source for the bridge.
            period: Time between two decisions [s].
        """
        self.name, self.period = name, period
        self._wrench, self._allocator = wrench, Allocator.from_vehicle(vehicle)
        self._limits = np.asarray(vehicle.wrench_limits, float)

    def describe(self) -> dict[str, Any]:
        """Return name and rate."""
        return {"name": self.name, "kind": "teleop", "action": "wrench6", "period_s": self.period}

    def reset(self) -> None:
        """Nothing to reset: a human pilots."""

    def act(self, reading: Measured, guide: Guide, t: float) -> Array:
        """Return the requested thrusts in canonical order [N], (n,)."""
        tau = np.asarray(self._wrench(), float)
        return self._allocator.allocate(np.clip(tau, -self._limits, self._limits))


class HelmPilot:
    """A human pilot of a vehicle with fins: commands to its autopilot, or directly to its propellers and fins.

    Forward deflection sets speed or thrust; without it the propellers stop. Left and up steer.
    """

    def __init__(
        self,
        deflection: Callable[[], npt.ArrayLike],
        vehicle: Vehicle,
        action: str = "surfaces",
        *,
        name: str = "teleop",
        period: float = 0.05,
    ) -> None:
        """Set up the pilot.

        Args:
            deflection: Returns surge, sway, heave and yaw, each in [-1, 1], (4,).
            vehicle: Vehicle whose channels are commanded.
            action: `course_pitch`: speed, change of course and pitch, by the autopilot; `surfaces`: each fin by its
                effect on yaw and pitch.
            name: Name of the command source for the bridge.
            period: Time between two decisions [s].

        Raises:
            ControlError: There is no such action, or the autopilot cannot steer the vehicle.
        """
        from finssim.sim.free_motion import linear_model

        if action not in HELM:
            raise ControlError(f"unknown action '{action}' of a person; available: {', '.join(HELM)}")
        self.name, self.period, self.action, self._deflection = name, period, action, deflection
        model = linear_model(vehicle)
        self._pilot = CoursePilot(model, vehicle.name, period)
        self.needs_state = action == "course_pitch"
        self._thrusters, self._limits = len(vehicle.thrusters), np.asarray(vehicle.channel_limits, float)
        effect = model.B[len(model.speeds) // 2][[4, 5]] * model.travel  # effect on pitch and yaw
        effect[:, : self._thrusters] = 0.0
        self._share = effect / np.maximum(np.abs(effect).max(axis=1, keepdims=True), 1e-12)
        self.reset()

    def describe(self) -> dict[str, Any]:
        """Return name, action and rate."""
        return {"name": self.name, "kind": "teleop", "action": self.action, "period_s": self.period}

    def reset(self) -> None:
        """Reset the autopilot's integrals."""
        self._memory = self._pilot.reset()

    def act(self, reading: Measured, guide: Guide, t: float) -> Array:
        """Return the requested values of all channels, as `Pilot.act`."""
        surge, _, heave, yaw = np.asarray(self._deflection(), float)
        if self.needs_state and surge > 0.0:
            action = [[2.0 * surge - 1.0, yaw, -heave]]
            channels, self._memory = self._pilot.act(self._memory, reading, action, by_pitch=True)
            return channels[0]
        self.reset()
        part = np.clip(np.array([-heave, yaw]) @ self._share, -1.0, 1.0) * (not self.needs_state)
        part[: self._thrusters] = max(surge, 0.0) * (not self.needs_state)
        lower, upper = self._limits
        return np.where(part < 0.0, -part * lower, part * upper)


HELM = ("surfaces", "course_pitch")
"""Actions of a human pilot of a vehicle with fins."""


class ModeSwitch:
    """A pilot that delegates to one of several pilots."""

    def __init__(self, pilots: Mapping[str, Pilot], selected: str | None = None) -> None:
        """Select a pilot.

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
        """Switch to another pilot, which starts without memory.

        Raises:
            ControlError: No such mode.
        """
        if mode not in self._pilots:
            raise ControlError(f"unknown mode '{mode}'; available: {', '.join(self._pilots)}")
        self.mode = mode
        self._pilots[mode].reset()

    @property
    def pilot(self) -> Pilot:
        """Active pilot."""
        return self._pilots[self.mode]

    name = "mode-switch"
    """One name for all pilots: for the bridge they are one command source, so that a switch is not a second
    publisher."""

    @property
    def period(self) -> float:
        """Time between two decisions of the active pilot [s]."""
        return self.pilot.period

    @property
    def needs_state(self) -> bool:
        """True if the active pilot requires a reading that is ready."""
        return self.pilot.needs_state

    @property
    def pictures(self) -> Mapping[str, Sequence[int]]:
        """Pictures that the active pilot observes."""
        return getattr(self.pilot, "pictures", {})

    def describe(self) -> dict[str, Any]:
        """Return the mode and the description of its pilot."""
        return {"mode": self.mode, **self.pilot.describe()}

    def reset(self) -> None:
        """Reset the memory of the active pilot."""
        self.pilot.reset()

    def act(self, reading: Measured, guide: Guide, t: float) -> Array:
        """Return the requested thrusts of the active pilot in canonical order [N], (n,)."""
        return self.pilot.act(reading, guide, t)


def make_pilot(
    name_or_directory: str | Path,
    vehicle: Vehicle,
    *,
    task: str | None = None,
    agent: str | None = None,
) -> AgentPilot:
    """Return a PID by its name, the policy of a directory, or a baseline of the task.

    Args:
        name_or_directory: Name or policy directory.
        vehicle: The same vehicle for which a policy was trained.
        task: Name of the task for which a policy was trained, or FILE.py:CLASS of a user-defined one; None: the task in
            the policy directory, and T1 for a PID.
        agent: Role in a task with several agents; the first if None.

    Raises:
        PolicyError, ControlError: It does not fit the vehicle or the task.
    """
    from finssim.agents.agent import TASKS_OF_PIDS, BaselineAgent, PidAgent, PolicyAgent
    from finssim.agents.catalogue import baselines_of
    from finssim.tasks.observer import Observer

    controller = str(name_or_directory)
    if controller in CONTROLLERS and task in (None, *TASKS_OF_PIDS):
        return AgentPilot(PidAgent(controller, vehicle, task or "t1"), vehicle)
    if not Path(controller).exists():
        baselines = {} if task is None else baselines_of(task)
        if controller not in baselines:
            names = dict.fromkeys([*(CONTROLLERS if task in (None, *TASKS_OF_PIDS) else ()), *baselines])
            raise PolicyError(
                f"{controller}: neither {' nor '.join(names)} nor a policy directory: give one of these"
            )
        observed = Observer(str(task), vehicle, agent=agent)
        shapes = {picture.name: picture.shape(vehicle) for picture in observed.task.pictures}
        return AgentPilot(BaselineAgent(controller, vehicle, observed.task), vehicle, observed, shapes)
    trained = read_description(Path(controller))
    mode = mode_from_dict(trained.action, vehicle)
    observed = Observer(task or trained.task, vehicle, agent=agent, action=mode.name)
    shapes = {name: about["shape"] for name, about in trained.pictures.items()}
    return AgentPilot(PolicyAgent(controller, vehicle, observed.task), vehicle, observed, shapes)


def _state(reading: Measured) -> tuple[Any, Any, Any]:
    return reading.position, reading.quaternion, reading.nu
