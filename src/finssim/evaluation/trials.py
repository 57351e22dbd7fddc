"""Trials: motion of a vehicle to a goal, evaluated equally wherever it was recorded, and trials in the simulator.

In the simulator there is one world for each trial, and all are stepped together: station keeping, tracking,
and episodes of any task from start to end.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from finssim.agents.agent import Agent, goals_in, rollout
from finssim.control.guidance import Goal, Guide, Station, Track, acceleration_at
from finssim.control.trajectories import load_trajectory
from finssim.core.files import atomic_write
from finssim.core.rotations import (
    quat_conjugate,
    quat_from_yaw,
    quat_inverse_rotate,
    quat_multiply,
    quat_to_rotvec,
    quat_yaw,
    wrap_angle,
)
from finssim.evaluation.metrics import (
    ERRORS,
    SITE_SIZES,
    T1_SETPOINTS,
    T1_START,
    effort_measures,
    in_room,
    measure_tracking,
    measure_trial,
)
from finssim.evaluation.plants import PlantChanges
from finssim.evaluation.statistics import with_interval
from finssim.tasks import Environment, Task, follow
from finssim.vehicles import Vehicle
from finssim.vehicles.defaults import room

Array = NDArray[np.float64]
Show = Callable[[float], None]

DURATION = 60.0
"""Duration of a trial of station keeping [s]."""
PERIOD = 0.1
"""Interval between the samples of a stored motion [s]."""
PHYSICS_STEP = 0.025
"""Longest physics step [s]."""
T2_TRAJECTORIES = ("straight", "broken", "ellipse", "lemniscate")
"""Trajectories of the paper's table."""


@dataclass(frozen=True, kw_only=True)
class VehicleMotion:
    """Samples of a vehicle's motion in chronological order; world frame, SI, NaN where unknown."""

    t: Array
    """Times since the guide's start [s], (T,)."""
    position: Array
    """Body origin [m], (T, 3)."""
    quaternion: Array
    """Body to world, xyzw, (T, 4)."""
    nu: Array | None = None
    """Velocity of the body origin, body frame [m/s, rad/s], (T, 6); None if it is not measured."""
    thrust: Array | None = None
    """Thrust of each thruster [N], (T, n); None if unknown."""
    action: Array | None = None
    """Action of the agent from each time on, in [-1, 1], (T, size); None if unknown."""
    heading_only: bool = False
    """True if roll and pitch are unknown."""

    @property
    def yaw(self) -> Array:
        """Heading [rad], (T,)."""
        return np.asarray(quat_yaw(self.quaternion))

    def between(self, rows: NDArray[Any]) -> VehicleMotion:
        """Return some of the samples, selected by a mask or indices of (T,)."""
        arrays = {
            field.name: getattr(self, field.name) for field in fields(self) if field.name != "heading_only"
        }
        return replace(self, **{name: None if x is None else x[rows] for name, x in arrays.items()})

    def at(self, t: float) -> Track:
        """Return the interpolated state of the vehicle at a time [s]; unmeasured velocities are finite
        differences over ± `PERIOD`."""
        position, quaternion = self._pose(t)
        if self.nu is not None:
            return Track(position, quaternion, interpolated(t, self.t, self.nu))
        first, last = max(t - PERIOD, float(self.t[0])), min(t + PERIOD, float(self.t[-1]))
        (from_position, from_attitude), (to_position, to_attitude) = self._pose(first), self._pose(last)
        turn = quat_to_rotvec(quat_multiply(quat_conjugate(from_attitude), to_attitude))
        linear = np.asarray(quat_inverse_rotate(quaternion, to_position - from_position))
        return Track(position, quaternion, np.concatenate([linear, turn]) / max(last - first, 1e-9))

    def action_at(self, t: float) -> Array:
        """Return the action at a time [s], from the last decision before it; empty if unknown."""
        if self.action is None or t < self.t[0] - 1e-3:
            return np.zeros(0)
        action: Array = self.action[int(np.searchsorted(self.t, t + 1e-3)) - 1]
        return action

    def _pose(self, t: float) -> tuple[Array, Array]:
        opposite = np.sum(self.quaternion[1:] * self.quaternion[:-1], axis=1) < 0.0
        signs = np.cumprod(np.where(np.concatenate([[False], opposite]), -1.0, 1.0))
        q = interpolated(t, self.t, self.quaternion * signs[:, None])
        return interpolated(t, self.t, self.position), q / np.linalg.norm(q)

    def write(self, path: Path) -> None:
        """Write the motion to PATH.npz."""
        arrays = {name: x for name, x in vars(self).items() if isinstance(x, np.ndarray)}
        with atomic_write(path.with_name(f"{path.name}.npz")) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, **arrays)  # type: ignore[arg-type]

    @classmethod
    def read(cls, path: Path) -> VehicleMotion:
        """Read PATH.npz, which a trial writes for figures, at 10 Hz."""
        with np.load(path.with_name(f"{path.name}.npz")) as file:
            return cls(**{field.name: file[field.name] for field in fields(cls) if field.name in file.files})


def interpolated(t: ArrayLike, times: Array, columns: Array) -> Array:
    """Return columns (T, n) interpolated between their times (T,), at one time (n,) or at several (k, n).

    The units of times and columns are unchanged.
    """
    return np.stack([np.interp(t, times, column) for column in columns.T], axis=-1)


def localization_errors(truth: VehicleMotion, estimate: VehicleMotion) -> dict[str, float] | None:
    """Return errors of an estimate at its own times: rms in 3-D and horizontally [m], and in heading [°];
    None if there are no common times."""
    t = estimate.t
    inside = (t >= truth.t[:1].max(initial=0.0)) & (t <= truth.t[-1:].max(initial=-1.0))
    inside &= np.isfinite(estimate.position).all(axis=1)
    if not inside.any():
        return None
    error = estimate.position[inside] - interpolated(t[inside], truth.t, truth.position)
    turn = wrap_angle(estimate.yaw[inside] - np.interp(t[inside], truth.t, np.unwrap(truth.yaw)))
    return {
        "position_m": float(np.sqrt(np.mean(np.sum(error**2, axis=1)))),
        "horizontal_m": float(np.sqrt(np.mean(np.sum(error[:, :2] ** 2, axis=1)))),
        "heading_deg": math.degrees(float(np.sqrt(np.mean(turn**2)))),
    }


@dataclass(frozen=True, kw_only=True)
class GoalTrial:
    """Motion of a vehicle to its goal, in the simulator, in the virtual pool, on a robot or in a record."""

    name: str
    """Name of its setpoint or trajectory."""
    guide: Guide
    motion: VehicleMotion
    """Motion that is evaluated, from the guide's start."""

    @property
    def goal(self) -> Array:
        """Return the start of the guide: x, y, z [m], yaw [rad], world frame, (4,)."""
        start = self.guide.at(0.0)
        return np.array([*start.position, float(start.yaw)])

    def measures(
        self, task: str, limits: tuple[ArrayLike, ArrayLike], *, stopped: bool = False
    ) -> dict[str, Any]:
        """Return the result of `measure_trial` for T1, with its goal, and `effort_measures` if thrusts are
        known; or that of `measure_tracking` for T2, with `success`.

        Args:
            task: t1 or t2.
            limits: Lower and upper limit of each thruster [N], (n,) each.
            stopped: True if it ended early: errors on part of a path are not representative of the complete path.
        """
        motion = self.motion
        if task == "t1":
            *position, yaw = self.goal.tolist()
            measures = measure_trial(motion.t, motion.position, motion.yaw, self.goal)
            if motion.thrust is not None and not stopped:
                valid = np.isfinite(motion.thrust).all(axis=1)
                if valid.sum() > 1:
                    measures |= effort_measures(motion.t[valid], motion.thrust[valid], limits)
            return {"goal": [*position, math.degrees(yaw)], **measures}
        attitude = None if motion.heading_only else motion.quaternion
        measures = measure_tracking(
            motion.t, motion.position, self.guide, quaternion=attitude, thrust=motion.thrust, limits=limits
        )
        if stopped:
            measures |= dict.fromkeys(ERRORS)
        return {"success": bool(measures["complete"]) and not stopped, **measures}


def follows(task: Task) -> bool:
    """Return whether the task follows a reference that is known in advance."""
    return hasattr(task, "knot_spacing")


def guide_of(
    target: str | Path, vehicle: Vehicle | None = None, *, size: float = 1.0, site: str = "pool"
) -> Guide:
    """Return a published setpoint by its name, or a trajectory by name or file.

    Args:
        target: Name of the setpoint or trajectory, or file of the trajectory.
        vehicle: Vehicle whose room determines the size; a vehicle that cannot follow the trajectory is refused.
        size: Factor on lengths, if no vehicle is given: 1 for FinsROV.
        site: Site that scales setpoints, if a vehicle is given.
    """
    if str(target) in T1_SETPOINTS:
        size = size if vehicle is None else room(vehicle.body.size) * SITE_SIZES[site]
        x, y, z, yaw = (T1_SETPOINTS[str(target)] * (size, size, size, 1.0)).tolist()
        return Station((x, y, z), yaw, name=str(target))
    if vehicle is None:
        return load_trajectory(target).scaled(size)
    return load_trajectory(target, vehicle=vehicle)


@dataclass(frozen=True, kw_only=True)
class TrialSettings:
    """Number of parallel trials, and their worlds."""

    trials: int | None = None
    """Number of trials; if None one for each guide, or `EPISODES`."""
    seed: int = 1
    """Seed of everything that the plant draws."""
    hydrodynamics: str = "calibrated"
    """Hydrodynamic model, unless the plant names one."""
    record: Path | None = None
    """New folder for all states, commands and thrusts; none if None."""
    crash_directory: Path = Path("finssim-frozen")
    """Directory for the last states of a world that diverged."""

    def environment(
        self, agent: Agent, task: Task, vehicle: Vehicle, plant: PlantChanges, worlds: int, **options: Any
    ) -> Environment:
        """Return a number of worlds of a plant; arguments as for `run_trials`, options of `Environment`."""
        return plant.environment(
            agent, task, vehicle, worlds=worlds, seed=self.seed, hydrodynamics=self.hydrodynamics,
            crash_directory=self.crash_directory, **options,
        )  # fmt: skip


ONCE = TrialSettings()
"""Each setpoint or trajectory once."""


def run_trials(
    agent: Agent,
    task: Task,
    vehicle: Vehicle,
    plant: PlantChanges,
    settings: TrialSettings = ONCE,
    *,
    guides: Sequence[Guide] | None = None,
    show: Show = lambda part: None,
) -> list[GoalTrial]:
    """Run trials of T1, each 60 s from the published start, level and at rest; or of T2, from rest at the first pose.

    Args:
        agent: Agent that acts.
        task: Task with the agent's observation.
        vehicle: Vehicle as in its file and in the agent's model; the plant modifies the simulated one.
        plant: Differences of the plant.
        settings: Number of trials, and their worlds.
        guides: Setpoints or trajectories, used in turn; the published ones if None.
        show: Function that is called with the completed fraction.

    Returns:
        The trials; after its world diverged, the numbers of a trial are NaN.
    """
    moving = follows(task)
    ways = guides or [guide_of(name, vehicle) for name in (T2_TRAJECTORIES if moving else T1_SETPOINTS)]
    chosen = [ways[i % len(ways)] for i in range(settings.trials or len(ways))]
    duration = max(guide.duration for guide in chosen) if moving else DURATION
    paced: Any = replace(
        task,
        control_step=agent.period,
        substeps=math.ceil(agent.period / PHYSICS_STEP - 1e-9),
        **({"time_limit": duration + 1.0, "knot_spacing": 0.1} if moving else {}),
    )
    environment = settings.environment(agent, paced, vehicle, plant, len(chosen), auto_reset=False)
    first = _goals(chosen, 0.0)
    if moving:
        follow(environment, chosen)
    else:
        start = in_room(T1_START, vehicle)
        environment.start(start[:3], quat_from_yaw(start[3]), first.position, first.quaternion)
    steps, state = round(duration / agent.period), environment.simulator.state
    widths = {"position": 3, "quaternion": 4, "thrust": len(environment.simulator.vehicles[0].thrusters)}
    columns = {name: np.full((steps + 1, environment.worlds, n), np.nan) for name, n in widths.items()}
    episode = state.episode.numpy().copy()
    goal: Callable[[float], Goal] = (lambda t: _goals(chosen, t)) if moving else (lambda t: first)
    for k, _ in rollout(agent, environment, steps, goal, record=settings.record):
        same = state.episode.numpy() == episode  # a world that diverged has restarted
        for name, column in columns.items():
            column[k, same] = getattr(state, name).numpy()[same, 0, : widths[name]]
        show(k / steps)
    t = np.arange(steps + 1, dtype=np.float64) * agent.period
    motions = (
        VehicleMotion(t=t, **{name: column[:, i] for name, column in columns.items()})
        for i in range(len(chosen))
    )
    return [
        GoalTrial(name=guide.name, guide=guide, motion=motion)
        for guide, motion in zip(chosen, motions, strict=True)
    ]


def _goals(guides: Sequence[Guide], t: float) -> Goal:
    """Return the goals of all trials at one time."""
    references = [guide.at(t) for guide in guides]
    position, velocity, yaw = (
        np.stack([getattr(reference, name) for reference in references])
        for name in ("position", "velocity", "yaw")
    )
    acceleration = np.stack([acceleration_at(guide, t) for guide in guides])
    return Goal(position, quat_from_yaw(yaw), velocity, acceleration)


EPISODES = 64
"""Default number of episodes: the interval of a rate is then about ±0.12."""
LABELS = ("trial", "record", "fault", "localization", "clock_offset_s")
"""Keys of a trial's row besides its metrics."""


class EpisodeError(ValueError):
    """Episodes that cannot be run."""


def run_episodes(
    agent: Agent,
    task: Task,
    vehicle: Vehicle,
    plant: PlantChanges,
    settings: TrialSettings = ONCE,
    *,
    show: Show = lambda part: None,
) -> list[dict[str, Any]]:
    """Run one episode in each world to its end; starts and goals are drawn as in training, with the seed.

    Arguments as for `run_trials`; several agents of a world share one agent, and all its vehicles are equal.

    Returns:
        `trial` and the `Task.metrics` of each episode; None if undefined, such as a time never reached, or
        for a world that diverged.

    Raises:
        EpisodeError: The agent acts at another rate than the task.
    """
    if abs(agent.period - task.control_step) > 1e-9:
        raise EpisodeError(
            f"the controller acts every {agent.period:g} s, expected {task.control_step:g} s: "
            f"episodes of '{task.name}' are measured at the rate of the task"
        )
    trials = EPISODES if settings.trials is None else settings.trials
    environment = settings.environment(agent, task, vehicle, plant, trials)
    running = np.ones(trials, dtype=np.bool_)
    metrics = {name: np.full(trials, np.nan) for name in task.metrics(environment.arrays)}
    longest = round(task.time_limit / task.control_step) + 1
    for k, step in rollout(
        agent, environment, longest, lambda t: goals_in(environment), record=settings.record
    ):
        if step is None:
            continue
        ended = running & (step.terminated | step.truncated)
        if ended.any():
            # A diverged world is terminated but not done; after its restart, it is not frozen any more.
            complete = ended & (environment.arrays.done.numpy() != 0)
            for name, values in task.metrics(environment.arrays).items():
                metrics[name][complete] = values[complete]
            running &= ~ended
        show(k / longest)
        if not running.any():
            break
    columns = {
        name: [x if math.isfinite(x) else None for x in values.tolist()] for name, values in metrics.items()
    }
    return [{"trial": i, **{name: values[i] for name, values in columns.items()}} for i in range(trials)]


def summarize_episodes(trials: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return one controller's row: means over the episodes, with their bootstrap intervals.

    Returns:
        `trials`, `valid` (episodes whose world did not diverge), `metrics` (name -> figure) and `per_trial`.
    """
    metrics: dict[str, Any] = {}
    for name in (name for name in trials[0] if name not in LABELS):
        values = [float(trial[name]) for trial in trials if trial[name] is not None]
        nothing = {"value": None, "ci95": [None, None], "count": 0}
        metrics[name] = with_interval({i: [x] for i, x in enumerate(values)}) or nothing
    return {
        "trials": len(trials),
        "valid": sum(trial["return"] is not None for trial in trials),
        "metrics": metrics,
        "per_trial": [dict(trial) for trial in trials],
    }
