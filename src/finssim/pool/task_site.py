"""Site of a task that the deployed software performs: start poses, scripted vehicles and scoring.

Every vehicle has its own plant, motor controller and robot software; all share the water. Start poses, the motion of
targets and the conditions of success come from the task's own code, on the true state, as in training.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.control import ControlError
from finssim.control.guidance import Guide, Measured, Reference, Track
from finssim.control.modes import action_mode
from finssim.control.path_following import PathGuide
from finssim.core.rotations import quat_from_yaw, quat_inverse_rotate, quat_yaw
from finssim.localization.overhead_camera import Pool
from finssim.pool.drawn_plant import positioning_of
from finssim.pool.fleet import Fleet, Medium
from finssim.pool.plant_spec import Basin, PlantSpec
from finssim.pool.virtual_pool import VirtualPool
from finssim.robot.bridge import Bridge, BridgeSettings
from finssim.robot.lockstep import run_together
from finssim.robot.perception import Perception
from finssim.robot.pilots import AgentPilot, Pilot
from finssim.robot.reading import Reading
from finssim.robot.recorder import Recorder
from finssim.robot.runtime import Runtime
from finssim.robot.team import Team, encode_track
from finssim.sim.launch import KernelSequence
from finssim.sim.site import described_world
from finssim.sim.state import State
from finssim.tasks.arrays import TaskArrays
from finssim.tasks.communication import Communication
from finssim.tasks.observer import fitted_task, one_world, unscored
from finssim.tasks.task import Batch, Task
from finssim.tasks.terms import Terms
from finssim.tasks.trajectory_tracking import fill_table
from finssim.vehicles import Vehicle

__all__ = ["Referee", "ScriptedPilot", "TaskSite", "TrueState"]


# A scripted vehicle of the task in the virtual site: it uses the true state and acts by the task's script.


Array = NDArray[np.float64]


class TrueState:
    """Replacement of a perception with the plant's own state, for vehicles that the site itself controls."""

    let_in = None
    """Start position; None, since no fix is needed."""

    def __init__(self, world: VirtualPool) -> None:
        """Set the pool whose vehicle's state is returned."""
        self.vehicle, self._world = world.vehicle, world

    def telemetry(self, now: float, telemetry: Any, time: float) -> None:
        """Ignore telemetry, as the state is known.

        Args:
            now: Time of arrival [s].
            telemetry: Not used.
            time: Time of measurement [s].
        """

    def picture(self, now: float, picture: Any) -> str:
        """Ignore a picture, as the state is known. `now` is the time [s]."""
        return "not used"

    def reading(self, now: float) -> Reading:
        """Return the plant's state. `now` is the time [s]."""
        plant = self._world.plant
        parts = (plant.position, plant.quaternion, plant.nu)
        position, quaternion, nu = (np.asarray(part, float).copy() for part in parts)
        return Reading(now, position, quaternion, nu, True, std=np.zeros(7))


class ScriptedPilot:
    """Pilot of the only scripted vehicle of a task, as in training: the task's `command` on the true state."""

    needs_state = True

    def __init__(
        self,
        task: str | Task,
        vehicles: Sequence[Vehicle],
        truth: Callable[[], Mapping[str, Measured]],
        *,
        action: str | None = None,
        seed: int = 0,
    ) -> None:
        """
        Args:
            task: A task with one vehicle among its `others`.
            vehicles: One vehicle for each role of the task.
            truth: Function that returns the true states of all vehicles, by role.
            action: Mode of the agents' actions; None for the task's own.
            seed: Seed of its random motion.

        Raises:
            ControlError: The vehicles are not suitable for the task.
        """
        self.task = task = fitted_task(task, vehicles, action)
        (self.name,) = task.others
        self.period, self._truth, self._seed = task.control_step, truth, seed
        mode = action or task.action
        self._mode = action_mode(mode, vehicles[-1])
        state, self._arrays = one_world(task, len(self._mode.labels))
        unscored(self._arrays)
        self._state = state
        self._pipeline = KernelSequence(1, wp.get_device("cpu"))
        task.add_command(self._pipeline, Batch(state, self._arrays, seed))

    def describe(self) -> dict[str, Any]:
        """Return name, kind, task and period of the pilot."""
        return {"name": self.name, "kind": "script", "task": self.task.name, "period_s": self.period}

    def reset(self) -> None:
        """Start a new episode."""
        self._state.steps.zero_()

    def act(self, reading: Measured, guide: Guide, t: float) -> Array:
        """Return the commanded thrusts in canonical order [N], (n,)."""
        everybody = self._truth()
        for v, name in enumerate(self.task.vehicles):
            track = everybody[name]
            for row, value in (
                ("position", track.position),
                ("quaternion", track.quaternion),
                ("velocity", track.nu),
            ):
                getattr(self._state, row).numpy()[0, v] = value
        self._state.steps.numpy()[0] = max(round(t / self.period), 0)
        self._pipeline.run()
        return self._mode.to_thrusters(np.clip(self._arrays.scripted.numpy()[0], -1.0, 1.0))


def truth_of(worlds: Mapping[str, VirtualPool]) -> dict[str, Track]:
    """Return the true state of every vehicle, by name."""
    out = {}
    for name, world in worlds.items():
        plant = world.plant
        parts = (plant.position, plant.quaternion, plant.nu)
        out[name] = Track(*(np.asarray(part, float).copy() for part in parts), world.time)
    return out


SITE = "site"
"""Sender name of the target's position, if the target is not a vehicle."""


@wp.func
def keep_given_start(state: State, arrays: TaskArrays, w: int):
    """Do nothing, in place of a task's draws: vehicle and goal are already at their given poses."""


@cache
def _with_given_start(kind: type[Task]) -> type[Task]:
    """Return a task class whose start and goal motion are given instead of drawn."""

    def terms(task: Task) -> Terms:
        declared = kind.terms(task)
        return replace(declared, start=keep_given_start, advance=None if task.moving else declared.advance)

    return type(kind.__name__, (kind,), {"terms": terms, "__module__": kind.__module__})


class Referee:
    """One episode of the task itself, evaluated on the true state.

    An episode recorded elsewhere can be scored too, for a task with one vehicle: `start` is its initial state, and the
    guide provides the goal. Contact forces are unknown there, as in a site without a dock, and count as zero.

    Attributes:
        task: Task, fitted to the vehicles.
        over: True if the episode has ended.
    """

    def __init__(
        self,
        task: str | Task,
        vehicles: Sequence[Vehicle],
        *,
        seed: int = 0,
        guide: Guide | None = None,
        start: Track | None = None,
        action_size: int | None = None,
    ) -> None:
        """Draw the start of all vehicles, or set the recorded start of the only vehicle.

        Args:
            task: A task, its name, or FILE.py:CLASS of a user's task.
            vehicles: One vehicle for each role of the task.
            seed: Seed of the episode.
            guide: The reference, for a task that follows one; None to draw it as in training.
            start: Initial state of the vehicle in an episode recorded elsewhere, with a guide that provides the goal;
                None to draw it.
            action_size: Numbers in the action of a vehicle; None for those of the task's own action mode.

        Raises:
            ControlError: For an episode recorded elsewhere: a task in plain torch whose initial memory is drawn, or a
                task with marks that are drawn with its world.
        """
        self.task = task = fitted_task(task, vehicles)
        if start is not None:
            task = _with_given_start(type(task))(
                **{field.name: getattr(task, field.name) for field in fields(task)}
            )
        size = action_size or len(action_mode(task.action, vehicles[0]).labels)
        self._state, self.arrays = one_world(task, size)
        drawn = ", ".join(task.marks) if self.arrays.seabed is None else "the seabed"
        if start is not None and drawn:
            raise ControlError(
                f"task '{task.name}' needs the places of {drawn}, which are drawn with its world and are in no record: "
                "python -m studies.stack scores it during the run"
            )
        device = self._state.steps.device
        follows = not task.world and (start is None or self.arrays.reference.position is not None)
        if guide is not None and follows:
            fill_table(self.arrays.reference, [guide])
        self._guide = guide if start is not None else None
        self.world: Any = None
        """World around a vehicle with exteroceptive sensors, drawn as in training."""
        if start is not None:
            self._put({task.vehicles[0]: start})
            self._aim(0.0)
        elif task.world:
            self.world = described_world(task.world).drawn_for(task, self.arrays, seed)
        batch, mask = Batch(self._state, self.arrays, seed), wp.ones(1, dtype=wp.int32, device=device)
        self._evaluate, opening = KernelSequence(1, device), KernelSequence(1, device)
        task.add_spawn(opening, batch, mask)
        task.add_observe(opening, batch, mask)
        opening.run()
        self.world = self.world or task.site(self.arrays, seed)
        task.add_evaluate(self._evaluate, batch)
        self.over = False
        begun = self.arrays.torch_results.begun
        if start is not None and begun is not None and begun.numpy().any():
            raise ControlError(
                f"task '{task.name}' begins with a memory that its reset draws, and only where it was drawn can it be "
                "scored: python -m studies.stack scores it during the run"
            )

    @property
    def time(self) -> float:
        """Return the time of the last control step that was scored, in the episode [s]."""
        return int(self._state.steps.numpy()[0]) * self.task.control_step

    def places(self) -> list[tuple[Array, Array]]:
        """Return start position and quaternion of every vehicle."""
        rows = (self._state.position.numpy()[0], self._state.quaternion.numpy()[0])
        return [(x.astype(float), q.astype(float)) for x, q in zip(*rows, strict=True)]

    def look(self, truth: Mapping[str, Track], actions: Mapping[str, Array]) -> None:
        """Score the control step that ends now.

        Args:
            truth: True states of all vehicles, by role.
            actions: Actions of the agents, in [-1, 1].
        """
        if self.over:
            return
        a, state = self.arrays, self._state
        self._put(truth)
        self._aim(self.time + self.task.control_step)
        for i, name in enumerate(self.task.agents):
            action = actions.get(name, np.zeros(0))
            a.action.numpy()[0, i * a.action_size : i * a.action_size + len(action)] = action
        state.steps.numpy()[0] += 1
        self._evaluate.run()
        self.over = bool(a.terminated.numpy()[0] or a.truncated.numpy()[0])

    def _put(self, truth: Mapping[str, Track]) -> None:
        """Write the states of all vehicles."""
        for v, name in enumerate(self.task.vehicles):
            track = truth[name]
            for row, value in (
                ("position", track.position),
                ("quaternion", track.quaternion),
                ("velocity", track.nu),
            ):
                getattr(self._state, row).numpy()[0, v] = value

    def _aim(self, t: float) -> None:
        """Set the goal from the guide, in an episode recorded elsewhere; t is the time in the episode [s]."""
        if self._guide is None:
            return
        a, now = self.arrays, self._guide.at(t)
        a.goal_position.numpy()[0] = now.position
        a.goal_quaternion.numpy()[0] = quat_from_yaw(float(now.yaw))
        if a.target.velocity is not None:
            a.target.velocity.numpy()[0] = now.velocity

    def metrics(self) -> dict[str, float]:
        """Return the measures of the episode; see `Task.metrics`."""
        return {name: float(values[0]) for name, values in self.task.metrics(self.arrays).items()}


class _Goal:
    """Current pose of the task's goal, as a guide without a preview of the future."""

    name, duration = "task", np.inf

    def __init__(self, referee: Referee) -> None:
        self._referee = referee

    def at(self, t: Any) -> Reference:
        """Return the goal's pose and velocity at a time [s], extrapolated from the last control step."""
        a, shape = self._referee.arrays, np.shape(t)
        moving = a.target.velocity is not None
        velocity = a.target.velocity.numpy()[0].astype(float) if moving else np.zeros(3)
        since = np.asarray(t, float) - self._referee.time
        position = a.goal_position.numpy()[0].astype(float) + since[..., None] * velocity
        yaw = float(quat_yaw(a.goal_quaternion.numpy()[0].astype(float)))
        rows = (np.broadcast_to(row, (*shape, 3)).copy() for row in (position, velocity))
        return Reference(*rows, np.full(shape, yaw), np.zeros(shape))


def _goal(referee: Referee) -> Guide:
    """Return the guide of an episode: its path, or its current goal."""
    points = referee.arrays.path.points
    return _Goal(referee) if points is None else PathGuide(points.numpy()[0].astype(float))


@dataclass(frozen=True, kw_only=True)
class PositionSources:
    """Sources of the robots' positions."""

    pool: Pool | None = None
    """Camera, water and frames, as the robots know them; None for no camera."""
    camera: Callable[[Vehicle], Any] | None = None
    """Function that creates the overhead camera of a vehicle; None for no camera."""
    positioning: str = "none"
    """Position fixes on every robot's link: none, motion-capture or usbl."""
    let_in: bool = False
    """True if robots know their start position, for dead reckoning."""


class TaskSite(Fleet):
    """One episode of a task in the virtual site, with vehicles by role.

    Attributes:
        referee: The task.
        runtimes: Software of the robots in this process.
        carrier: Medium of their messages, same as `medium`.
        scored: Number of control steps of the episode so far.
    """

    def __init__(
        self,
        task: str | Task,
        vehicles: Sequence[Vehicle],
        plants: Sequence[tuple[Vehicle, PlantSpec]],
        pilots: Callable[[str], Pilot] | None,
        positions: PositionSources = PositionSources(),
        *,
        seed: int = 0,
        guide: Guide | None = None,
        record: Path | None = None,
    ) -> None:
        """Put all vehicles at the start poses of the task.

        Args:
            task: A task, its name, or FILE.py:CLASS of a user's task.
            vehicles: One vehicle for each role, as its robot knows it.
            plants: True vehicle and its plant, for each role.
            pilots: Function that returns the pilot of an agent, by its role; None if agents are in other processes, so
                that `runtimes` contains only the other vehicles.
            positions: Sources of the robots' positions.
            seed: Seed of the episode, of instruments and of losses.
            guide: The reference, for a task that follows one; None to draw it as in training.
            record: Folder for ROLE.mcap and ROLE.truth of every agent; None for no records.

        Raises:
            ControlError, PlantSpecError: Task, vehicles and guide do not match, or the positioning does not exist.
        """
        steering = (
            {} if pilots is None else {name: pilots(name) for name in fitted_task(task, vehicles).agents}
        )
        modes = [pilot.mode for pilot in steering.values() if isinstance(pilot, AgentPilot)]
        size = len(modes[0].labels) if modes else None
        self.referee = referee = Referee(task, vehicles, seed=seed, guide=guide, action_size=size)
        if guide is None and referee.arrays.reference.position is not None and not referee.task.world:
            raise ControlError(
                f"task '{referee.task.name}' follows a reference that is known ahead: give a trajectory, in a pool "
                "without --task"
            )
        self.task, self._guide = referee.task, guide or _goal(referee)
        names, kept = self.task.vehicles, {name: record for name in self.task.agents if record is not None}
        places = list(zip(names, vehicles, plants, referee.places(), strict=True))
        worlds = {
            name: VirtualPool(
                body,
                _deep_enough(spec, referee.arrays),
                camera=positions.camera(vehicle) if positions.camera else self._eyes(vehicle, seed),
                positioning=positioning_of(positions.positioning, seed + i)
                if name in self.task.agents
                else None,
                start=start,
                seed=seed + i,
                truth=kept[name] / f"{name}.truth" if name in kept and name in steering else None,
                dock=self.task.dock(),
            )
            for i, (name, vehicle, (body, spec), start) in enumerate(places)
        }
        self._place_dock(worlds)
        self._goal_is_sent = pilots is None and self.task.moving and len(names) == 1
        super().__init__(worlds)
        communication: Communication | None = getattr(self.task, "communication", None)
        self.carrier = self.medium = Medium(self._positions, communication, seed)
        self.scored, self._since = 0, math.nan
        self._actions: dict[str, Array] = {}
        period = self.task.control_step if communication is None else communication.period
        target_names = ("target",) if self._target() is not None else ()
        for i, (name, vehicle, _, start) in enumerate(places):
            agent = name in self.task.agents
            if agent and name not in steering:
                continue
            others = (*(other for other in names if other != name), *target_names) if agent else ()
            self.runtimes[name] = self._runtime(
                name,
                vehicle,
                steering.get(name)
                or ScriptedPilot(self.task, vehicles, lambda: truth_of(self.worlds), seed=seed),
                Perception(vehicle, positions.pool, let_in=start[0][:2] if positions.let_in else None)
                if agent
                else TrueState(self.worlds[name]),
                team=Team(name, others, period=period, turn=period * i / len(names)) if names[1:] else None,
                record=kept.get(name),
            )

    def _place_dock(self, worlds: Mapping[str, VirtualPool]) -> None:
        """Put the dock of a task at its goal, for the contact forces."""
        for world in worlds.values() if self.task.dock() is not None else ():
            funnel = world.plant.simulator.funnel
            funnel.position.assign(self.referee.arrays.goal_position)
            funnel.quaternion.assign(self.referee.arrays.goal_quaternion)

    def _runtime(
        self,
        name: str,
        vehicle: Vehicle,
        pilot: Pilot,
        perception: Any,
        *,
        team: Team | None,
        record: Path | None,
    ) -> Runtime:
        """Return the software of the robot with a role."""
        about = {"command": "python -m studies.stack", "guide": self._guide.name, "armed": True}
        return Runtime(
            vehicle,
            perception,
            pilot,
            self._guide,
            arm=True,
            bridge=Bridge(vehicle, _limits(vehicle, self.worlds[name].spec.basin)),
            team=team,
            recorder=None
            if record is None
            else Recorder(record / f"{name}.mcap", vehicle, {"pilot": pilot.describe(), **about}),
        )

    def _eyes(self, vehicle: Vehicle, seed: int) -> Any:
        """Return the vehicle's own sensors that the task observes, in the world of its episode."""
        if self.referee.world is None:
            return None
        names = [*(picture.name for picture in self.task.pictures), *self.task.ranges]
        return self.referee.world.sensors(vehicle, names, seed)

    def run(self, duration: float | None = None) -> dict[str, float]:
        """Run until the task ends, or for a time from the start of the last robot [s]; None for the task's time limit.

        Returns:
            The task's metrics, in the units that `finssim tasks show` states.
        """
        step = self.task.control_step

        def look() -> None:
            self.score(min(runtime.t for runtime in self.runtimes.values()), since=0.0)

        self.send_target()
        longest = (duration or self.task.time_limit) + 10.0
        stacks = {name: (runtime, self.worlds[name]) for name, runtime in self.runtimes.items()}
        try:
            run_together(
                stacks,
                longest,
                carrier=self.carrier if len(stacks) > 1 else None,
                show=look,
                until=lambda: self.referee.over or (duration is not None and self.scored * step >= duration),
            )
        finally:
            self.close()
            for runtime in self.runtimes.values():
                if runtime.recorder is not None:
                    runtime.recorder.close()
        return self.referee.metrics()

    @property
    def over(self) -> bool:
        """Return whether the episode has ended."""
        return self.referee.over

    def evaluate(self, now: float, due: bool) -> None:
        """Score the true state; the episode begins when the thrusters of all agents are enabled."""
        if self.scored or all(self.worlds[name].firmware.driving for name in self.task.agents):
            self.score(now)
        elif due:
            self.send_target()

    def score(self, now: float, since: float | None = None) -> None:
        """Score the true state with the task, once per control step.

        Args:
            now: Time [s]; NaN before any robot has started.
            since: Start of the episode [s]; None for the time of the first call.
        """
        if math.isnan(self._since):
            self._since = now if since is None else since
            self.send_target()
        if now - self._since >= (self.scored + 1) * self.task.control_step - 1e-6:
            self.scored += 1
            self.referee.look(truth_of(self.worlds), self._actions)
            self.send_target()
        # A new action takes effect from now on: the step is scored with the previous one.
        self._actions = {
            name: getattr(runtime.pilot, "action", np.zeros(0)) for name, runtime in self.runtimes.items()
        }

    def _target(self) -> Track | None:
        """Return the drifting object of a task, if any; for a robot in another process also a moving goal."""
        a, net = self.referee.arrays, self.referee.arrays.net
        if self._goal_is_sent:
            q = a.goal_quaternion.numpy()[0].astype(float)
            v = quat_inverse_rotate(q, a.target.velocity.numpy()[0].astype(float))
            return Track(a.goal_position.numpy()[0].astype(float), q, np.array([*v, 0.0, 0.0, 0.0]))
        if net.target is None:
            return None
        level = np.array([0.0, 0.0, 0.0, 1.0])
        nu = np.array([*net.motion.numpy()[0].astype(float), 0.0, 0.0, 0.0])
        return Track(net.target.numpy()[0].astype(float), level, nu)

    def send_target(self) -> None:
        """Send the target's position from the site's own positioning to all vehicles."""
        target = self._target()
        if target is not None:
            now = max(world.time for world in self.worlds.values())
            self.carrier.send(now, SITE, encode_track("target", target, now), lossless=True)

    def _positions(self) -> dict[str, Array]:
        return {name: np.asarray(world.plant.position, float) for name, world in self.worlds.items()}


BELOW = 10.0
"""Smallest depth of the water below the deepest point of a path [m]."""


def _deep_enough(spec: PlantSpec, arrays: TaskArrays) -> PlantSpec:
    """Return the plant in water that is deep enough for the episode's path, if it has one."""
    if arrays.path.points is None:
        return spec
    depth = BELOW - float(arrays.path.points.numpy()[0, :, 2].min())
    basin = spec.basin.model_copy(update={"depth": max(spec.basin.depth, depth)})
    return spec.model_copy(update={"basin": basin})


def _limits(vehicle: Vehicle, basin: Basin) -> BridgeSettings:
    """Return the bridge's limits, with the basin as the workspace."""
    half = np.array([0.5 * basin.length, 0.5 * basin.width])
    return BridgeSettings.of(
        vehicle,
        workspace_lower=np.array([*-half, -basin.depth]),
        workspace_upper=np.array([*half, 0.0]),
    )
