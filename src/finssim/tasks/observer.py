"""Observation of a policy on a robot: computed by the training kernels of its task, for one world on the CPU."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from finssim.control import ControlError
from finssim.control.guidance import Guide, Measured, Reference, Track
from finssim.control.modes import MODES
from finssim.control.path_following import PathGuide, Waypoints
from finssim.control.policy import ObservationSchema
from finssim.core.rotations import quat_from_yaw, quat_inverse_rotate, quat_rotate, quat_yaw
from finssim.physics.types import vec6
from finssim.sim.launch import KernelSequence
from finssim.sim.state import State
from finssim.tasks.arrays import TaskArrays
from finssim.tasks.catalogue import task_named
from finssim.tasks.path import WaypointTour
from finssim.tasks.task import Batch, Task
from finssim.tasks.trajectory_tracking import fill_table
from finssim.tasks.validation import EnvironmentSetupError, vehicles_of_task
from finssim.vehicles import Vehicle

Array = NDArray[np.float64]


def fitted_task(
    task: str | Task, vehicle: Vehicle | Sequence[Vehicle | str], action: str | None = None
) -> Task:
    """Return a task scaled to these vehicles.

    Args:
        task: A task, its name, or FILE.py:CLASS of a user-defined one.
        vehicle: One for all roles of the task, or one for each.
        action: Action mode; the task's own if None.

    Raises:
        ControlError: There is no such task, or it does not fit the vehicle.
    """
    try:
        named = task_named(task)
        return named.fitted(vehicles_of_task(vehicle, named, action or named.action))
    except EnvironmentSetupError as error:
        raise ControlError(str(error)) from None


class Observer:
    """The task's own `observe`, applied to a reading instead of a simulator's state.

    The reading supplies the vehicle's own measurements. The guide supplies the goal: the pose to hold, the reference to
    follow, the target or the dock. Other vehicles are the reading's `tracks`, by the name of their role in the task; a
    vehicle that the task commands itself, such as a prey, is at the guide's position if it has no track.

    Attributes:
        task: The task, scaled to the vehicle.
        agent: Role of this vehicle in the task.
        schema: Quantities of the observation with their indices, units and scales.
        beside: Distance to the path that is followed [m] and its course [rad] at the last observation; None for a task
            without a path.
    """

    def __init__(
        self,
        task: str | Task,
        vehicle: Vehicle | Sequence[Vehicle | str],
        *,
        agent: str | None = None,
        action: str | None = None,
    ) -> None:
        """Build the observation of one world.

        Args:
            task: A task, its name, or FILE.py:CLASS of a user-defined one.
            vehicle: This vehicle, or one for each role of the task.
            agent: Role of this vehicle, if there are several; the first if None.
            action: Action mode; the task's own if None.

        Raises:
            ControlError: There is no such task or role, it does not fit the vehicle, or its observation is not
                available on a robot.
        """
        self.task = task = fitted_task(task, vehicle, action)
        self.agent = agent or task.agents[0]
        if self.agent not in task.agents:
            raise ControlError(f"task '{task.name}' has no '{agent}'; its agents: {', '.join(task.agents)}")
        self.schema: ObservationSchema = task.schema
        self._place = task.vehicles.index(self.agent)
        mode = action or task.action
        self._action_size = len(MODES[mode].labels(vehicles_of_task(vehicle, task, mode)[0]))
        self._guide: Guide | None = None
        self._path: Waypoints | None = None
        self.beside: tuple[float, float] | None = None
        self._leg = np.zeros(1, dtype=np.int64)
        self._build(task)

    @property
    def targets(self) -> tuple[str, ...]:
        """Names of tracks that are required besides those of vehicles."""
        return () if self._arrays.net.target is None else ("target",)

    def describe(self) -> dict[str, Any]:
        """Return the description of the task that `Policy.load` compares."""
        return {"name": self.task.name, "observation": self.schema.model_dump(mode="json")}

    def restart(self) -> None:
        """Discard the guide: the next observation is the first of an episode."""
        self._guide = None

    def observe(
        self,
        reading: Measured,
        guide: Guide,
        t: float,
        previous: ArrayLike | None = None,
        reach: float = math.inf,
        turn: float = math.inf,
        ranges: Sequence[float] = (),
    ) -> NDArray[np.float32]:
        """Return the observation, (schema.size,).

        Args:
            reading: The vehicle's state, and those of others as its `tracks`, if any.
            guide: Motion to follow.
            t: Time since the guide's start [s].
            previous: The previous action, in [-1, 1], (size,), for tasks that observe it; zeros if None.
            reach: Greatest observed distance to the goal; a farther goal is moved to this distance in its direction
                [m].
            turn: Greatest observed heading difference; a larger one is limited to this angle [rad].
            ranges: Ranges of the sensors in the task's `ranges` [m].

        Raises:
            ControlError: The position of a vehicle that the task needs is unknown.
        """
        if guide is not self._guide:
            self._guide = guide
            self._arrays.action.zero_()
            self._aim(guide)
            self._follow(guide, np.asarray(reading.position, float))
        if self._path is not None:
            errors, self._leg, _ = self._path.errors(self._leg, reading.position)
            self.beside = math.hypot(errors.across[0], errors.above[0]), float(errors.course[0])
            self._arrays.path.leg.numpy()[0] = self._leg[0]
        a, now = self._arrays, guide.at(t)
        self._remember(np.zeros(self._action_size) if previous is None else np.asarray(previous, float))
        a.time.numpy()[0] = t
        self._steps[0] = max(round(t / self.task.control_step), 0)
        way = np.asarray(now.position, float) - reading.position
        far = float(np.linalg.norm(way)) / reach
        a.goal_position.numpy()[0] = now.position if not far > 1.0 else reading.position + way / far
        yaw = now.yaw
        if math.isfinite(turn):
            here = float(quat_yaw(np.asarray(reading.quaternion, float)))
            yaw = here + np.clip(math.remainder(float(now.yaw) - here, math.tau), -turn, turn)
        a.goal_quaternion.numpy()[0] = quat_from_yaw(yaw)
        if a.target.velocity is not None:
            a.target.velocity.numpy()[0] = now.velocity
        self._put(self._place, reading.position, reading.quaternion, reading.nu)
        self._put_others(getattr(reading, "tracks", {}), now)
        a.ranges.numpy()[0, : len(ranges)] = ranges
        self._pipeline.run()
        rows: NDArray[np.float32] = a.observation.numpy()[0].reshape(len(self.task.agents), -1)
        return rows[self._place].copy()

    def _remember(self, action: Array) -> None:
        """Store the last action as the observation expects it: torch tasks are evaluated before the step is stored."""
        columns = slice(self._place * self._action_size, (self._place + 1) * self._action_size)
        a = self._arrays
        done = a.action.numpy()[0, columns].copy()
        a.action.numpy()[0, columns] = action
        a.previous_action.numpy()[0, columns] = done if self._in_torch else action

    def _build(self, task: Task) -> None:
        """Create the arrays of one world and the pipeline that observes it, without scoring."""
        state, self._arrays = one_world(task, self._action_size)
        self._in_torch = unscored(self._arrays)
        self._steps = state.steps.numpy()
        self._pipeline = KernelSequence(1, state.steps.device)
        everywhere = wp.ones(1, dtype=wp.int32, device=state.steps.device)
        # In the first observation of an episode, received messages are the only information about the others.
        task.add_observe(self._pipeline, Batch(state, self._arrays, 0), everywhere)
        try:
            self._pipeline.run()  # a robot's first decision must not wait for the compiler
        except EnvironmentSetupError as error:
            raise ControlError(f"task '{task.name}' cannot be observed on a robot: {error}") from None

    def _aim(self, guide: Guide) -> None:
        """Write the part of a guide that is observed ahead of time."""
        if self._arrays.reference.position is None or self.task.world:
            return
        if math.isfinite(guide.duration) and guide.duration > self.task.time_limit:
            self.task = replace(self.task, time_limit=guide.duration)
            self._build(self.task)
        fill_table(self._arrays.reference, [guide])

    def _follow(self, guide: Guide, here: Array) -> None:
        """Set the task's path to that of a guide: its path, its waypoints, or a straight line to a station."""
        if self._arrays.path.points is None:
            return
        task: Any = self.task
        knots = getattr(guide, "knots", None) if isinstance(task, WaypointTour) else None
        if isinstance(guide, PathGuide):
            path = Waypoints(guide.points)
        elif knots is not None:
            path = Waypoints(np.asarray(guide.at(knots).position, float))
        elif math.isfinite(guide.duration):
            path = Waypoints.along(guide, task.fit.size)
        else:
            path = Waypoints(task.straight(here, guide.at(0.0)))
        self._path = path = replace(path, radius=task.fit.size * task.radius)
        self._leg = path.reset()
        self.task = replace(task, legs=path.legs)
        self._build(self.task)
        self._arrays.path.points.numpy()[0] = path.points

    def _put(self, v: int, position: ArrayLike, quaternion: ArrayLike, nu: ArrayLike) -> None:
        """Write the measurements of a vehicle."""
        a = self._arrays
        a.position.numpy()[0, v] = position
        a.quaternion.numpy()[0, v] = quaternion
        a.velocity.numpy()[0, v] = nu

    def _put_others(self, tracks: Mapping[str, Measured], now: Reference) -> None:
        """Write the measurements of everything other than this vehicle."""
        a = self._arrays
        for v, name in enumerate(self.task.vehicles):
            if v == self._place:
                continue
            track = self._track(name, tracks, now if name in self.task.others else None)
            self._put(v, track.position, track.quaternion, track.nu)
        if a.net.target is not None:
            target = self._track("target", tracks, None)
            a.net.target.numpy()[0] = target.position
            a.net.motion.numpy()[0] = _velocity(target)

    def _track(self, name: str, tracks: Mapping[str, Measured], otherwise: Reference | None) -> Measured:
        """Return the track with that name; if there is none, the guide's motion, if given."""
        if name in tracks:
            return tracks[name]
        if otherwise is None:
            raise ControlError(
                f"task '{self.task.name}' needs the position of '{name}', which no source provides; available: "
                f"{', '.join(tracks) or 'none'}"
            )
        q = quat_from_yaw(otherwise.yaw)
        nu = np.array([*quat_inverse_rotate(q, otherwise.velocity), 0.0, 0.0, 0.0])
        return Track(np.asarray(otherwise.position), q, nu)


def _velocity(track: Measured) -> Array:
    """Return the velocity of a track, world frame [m/s], (3,)."""
    return quat_rotate(np.asarray(track.quaternion), np.asarray(track.nu)[:3])


def unscored(arrays: TaskArrays) -> bool:
    """Remove the buffers that only a scored episode provides, so that reading them is refused. Return whether there
    were any."""
    if arrays.torch_results.memory is None:
        return False
    arrays.torch_results.memory = None
    return True


def one_world(task: Task, action_size: int) -> tuple[State, TaskArrays]:
    """Return state and arrays of one world of a task on the CPU, without a simulator: true and measured state are
    equal.

    Args:
        task: Task scaled to its vehicles.
        action_size: Numbers in the action of a vehicle.
    """
    device, vehicles = wp.get_device("cpu"), len(task.vehicles)
    arrays = task.arrays(1, action_size, device)
    dock = task.dock()
    if dock is not None:
        arrays.funnel = funnel = dock.struct(1, vehicles, device)
        arrays.goal_position, arrays.goal_quaternion = funnel.position, funnel.quaternion
    state = State()
    for name, dtype in (("position", wp.vec3), ("quaternion", wp.quat), ("velocity", vec6)):
        rows = wp.zeros((1, vehicles), dtype=dtype, device=device)
        setattr(arrays, name, rows)
        setattr(state, name, rows)
    arrays.quaternion.fill_(wp.quat(0.0, 0.0, 0.0, 1.0))
    for name in ("steps", "episode", "frozen"):
        setattr(state, name, wp.zeros(1, dtype=wp.int32, device=device))
    return state, arrays
