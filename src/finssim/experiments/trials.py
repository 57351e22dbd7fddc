"""Trials in the simulator, one world each, all stepped together: station keeping, tracking, and whole episodes."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.control.guidance import Goal, Guide, acceleration_at
from finssim.control.trajectories import load_trajectory
from finssim.experiments.metrics import T1_SETPOINTS, T1_START, in_room, measure_tracking, measure_trial
from finssim.experiments.plants import Plant
from finssim.experiments.statistics import with_interval
from finssim.geometry.rotations import quat_from_yaw, quat_yaw
from finssim.tasks import Environment, Task, TrajectoryTracking, follow
from finssim.tasks.agents import NOWHERE, Agent, rollout
from finssim.vehicles import Vehicle

__all__ = [
    "DURATION",
    "EPISODES",
    "T2_TRAJECTORIES",
    "EpisodeError",
    "TrackingTrials",
    "Trials",
    "run_episodes",
    "run_tracking",
    "run_trials",
    "summarize_episodes",
]

Array = NDArray[np.float64]
Show = Callable[[float], None]

DURATION = 60.0
"""Length of a trial [s]."""

PHYSICS_STEP = 0.025
"""Longest physics step [s]."""


@dataclass(frozen=True)
class Trials:
    """What happened, by trial; world frame, SI. From the moment a world broke its numbers are NaN."""

    setpoints: tuple[str, ...]
    """Name of each trial's setpoint, n."""
    goals: Array
    """[x, y, z [m], yaw [rad]], (n, 4)."""
    t: Array
    """Time since the start [s], (T,)."""
    position: Array
    """Body origin [m], (T, n, 3)."""
    yaw: Array
    """Heading [rad], (T, n)."""

    def measures(self) -> list[dict[str, Any]]:
        """What `measure_trial` says of each trial, with its number, setpoint and goal."""
        return [
            {
                "trial": i,
                "setpoint": name,
                "goal": [*self.goals[i, :3].tolist(), math.degrees(self.goals[i, 3])],
                **measure_trial(*self.series(i)),
            }
            for i, name in enumerate(self.setpoints)
        ]

    def series(self, i: int) -> tuple[Array, Array, Array, Array]:
        """t, position, yaw and goal of one trial, as the measures and the envelope take them."""
        return self.t, self.position[:, i], self.yaw[:, i], self.goals[i]

    def all_series(self) -> list[tuple[Array, Array, Array, Array]]:
        """The same of every trial."""
        return [self.series(i) for i in range(len(self.setpoints))]


def run_trials(
    agent: Agent,
    task: Task,
    vehicle: Vehicle,
    plant: Plant,
    *,
    trials: int = 8,
    seed: int = 42,
    record: Path | None = None,
    show: Show = lambda part: None,
    **world: Any,
) -> Trials:
    """Run trials of 60 s from the published start, level and at rest, towards the eight setpoints in turn.

    Args:
        agent: Who acts.
        task: Its observation is what the agent sees.
        vehicle: As its file has it and the agent knows it; the plant changes what it delivers.
        plant: What differs.
        trials: How many, all at once.
        seed: Of everything that the plant draws.
        record: New folder for every state, command and thrust; none if None.
        show: Called with the part done.
        world: Of `Environment`: hydrodynamics (unless the plant names one), crash_directory (where the last states of a
            world that broke are written).
    """
    names = tuple(list(T1_SETPOINTS)[i % len(T1_SETPOINTS)] for i in range(trials))
    goals = np.array([in_room(T1_SETPOINTS[name], vehicle) for name in names])
    start = in_room(T1_START, vehicle)
    environment = plant.environment(
        agent, _at_pace_of(agent, task), vehicle, worlds=trials, seed=seed, auto_reset=False, **world
    )
    environment.start(start[:3], quat_from_yaw(start[3]), goals[:, :3], quat_from_yaw(goals[:, 3]))
    goal = Goal(goals[:, :3], quat_from_yaw(goals[:, 3]))
    t, position, quaternion, _ = _played(agent, environment, DURATION, lambda t: goal, record, show)
    return Trials(names, goals, t, position, np.asarray(quat_yaw(quaternion)))


def _at_pace_of(agent: Agent, task: Any, **changes: Any) -> Any:
    """The task at the agent's rate, its physics steps short enough."""
    substeps = math.ceil(agent.period / PHYSICS_STEP - 1e-9)
    return replace(task, control_step=agent.period, substeps=substeps, **changes)


def _played(
    agent: Agent,
    environment: Environment,
    duration: float,
    goal: Callable[[float], Goal],
    record: Path | None,
    show: Show,
) -> tuple[Array, ...]:
    """Times (T,), positions (T, n, 3), quaternions (T, n, 4) and thrusts (T, n, thrusters) of the first vehicle."""
    steps, state = round(duration / agent.period), environment.simulator.state
    widths = {"position": 3, "quaternion": 4, "thrust": len(environment.simulator.vehicles[0].thrusters)}
    columns = {name: np.full((steps + 1, environment.worlds, n), np.nan) for name, n in widths.items()}
    episode = state.episode.numpy().copy()
    for k, _ in rollout(agent, environment, steps, goal, record=record):
        same = state.episode.numpy() == episode  # a world that broke has started over
        for name, column in columns.items():
            column[k, same] = getattr(state, name).numpy()[same, 0, : widths[name]]
        show(k / steps)
    return np.arange(steps + 1, dtype=np.float64) * agent.period, *columns.values()


T2_TRAJECTORIES = ("straight", "broken", "ellipse", "lemniscate")
"""The four of the paper's table."""


@dataclass(frozen=True)
class TrackingTrials:
    """What happened, by trial; world frame, SI. From the moment a world broke its numbers are NaN."""

    guides: tuple[Guide, ...]
    """What each trial followed, n."""
    t: Array
    """Time since the start [s], (T,)."""
    position: Array
    """Body origin [m], (T, n, 3)."""
    quaternion: Array
    """Body to world, xyzw, (T, n, 4)."""
    thrust: Array
    """Delivered by each thruster [N], (T, n, thrusters)."""
    limits: tuple[Array, Array]
    """Lower and upper limit of each thruster [N]."""

    def measures(self) -> list[dict[str, Any]]:
        """What `measure_tracking` says of each trial, with its number and trajectory."""
        return [
            {
                "trial": i,
                "trajectory": guide.name,
                **measure_tracking(
                    self.t,
                    self.position[:, i],
                    guide,
                    quaternion=self.quaternion[:, i],
                    thrust=self.thrust[:, i],
                    limits=self.limits,
                ),
            }
            for i, guide in enumerate(self.guides)
        ]


def run_tracking(
    agent: Agent,
    task: TrajectoryTracking,
    vehicle: Vehicle,
    plant: Plant,
    *,
    trials: int = len(T2_TRAJECTORIES),
    guides: Sequence[Guide] | None = None,
    seed: int = 42,
    record: Path | None = None,
    show: Show = lambda part: None,
    **world: Any,
) -> TrackingTrials:
    """Follow trajectories, each from rest on its first pose; arguments as `run_trials`.

    Args:
        guides: What is followed, in turn; the four published trajectories if None.
    """
    ways = guides or [load_trajectory(name, vehicle=vehicle) for name in T2_TRAJECTORIES]
    chosen = tuple(ways[i % len(ways)] for i in range(trials))
    longest = max(guide.duration for guide in chosen)
    paced = _at_pace_of(agent, task, time_limit=longest + 1.0, knot_spacing=0.1)
    environment = plant.environment(
        agent, paced, vehicle, worlds=trials, seed=seed, auto_reset=False, **world
    )
    follow(environment, chosen)
    played = _played(agent, environment, longest, lambda t: _goals(chosen, t), record, show)
    lower, upper = environment.simulator.vehicles[0].force_limits
    return TrackingTrials(chosen, *played, (np.asarray(lower, float), np.asarray(upper, float)))


def _goals(guides: Sequence[Guide], t: float) -> Goal:
    """The goals of all trials at one time."""
    references = [guide.at(t) for guide in guides]
    position, velocity, yaw = (
        np.stack([getattr(reference, name) for reference in references])
        for name in ("position", "velocity", "yaw")
    )
    return Goal(
        position, quat_from_yaw(yaw), velocity, np.stack([acceleration_at(guide, t) for guide in guides])
    )


EPISODES = 64
"""Unless told otherwise: an interval of a rate is then some ±0.12."""
LABELS = ("trial", "record", "fault", "localization", "clock_offset_s")
"""What a trial's row has besides its metrics."""


class EpisodeError(ValueError):
    """Episodes that cannot be run."""


@dataclass(frozen=True)
class Episodes:
    """How each episode went."""

    metrics: Mapping[str, NDArray[np.float64]]
    """`Task.metrics`, (n,) each; NaN where there is none, such as a time never reached, or a world that broke."""

    def measures(self) -> list[dict[str, Any]]:
        """The metrics of each episode with its number; None where there is none."""
        count = len(next(iter(self.metrics.values())))
        rows = ({name: float(values[i]) for name, values in self.metrics.items()} for i in range(count))
        return [
            {"trial": i, **{k: x if np.isfinite(x) else None for k, x in row.items()}}
            for i, row in enumerate(rows)
        ]


def run_episodes(
    agent: Agent,
    task: Task,
    vehicle: Vehicle,
    plant: Plant,
    *,
    trials: int = EPISODES,
    seed: int = 42,
    record: Path | None = None,
    show: Show = lambda part: None,
    **world: Any,
) -> Episodes:
    """Run one episode in each of `trials` worlds to its end; starts and goals are those of training, drawn with `seed`.

    Arguments as `run_trials`; several agents of a world share one agent, and every vehicle of it is the same.

    Raises:
        EpisodeError: The agent acts at another rate than the task.
    """
    if abs(agent.period - task.control_step) > 1e-9:
        raise EpisodeError(
            f"the controller acts every {agent.period:g} s, expected {task.control_step:g} s: "
            f"episodes of '{task.name}' are measured at the rate of the task"
        )
    environment = plant.environment(agent, task, vehicle, worlds=trials, seed=seed, **world)
    running = np.ones(trials, dtype=np.bool_)
    found = {name: np.full(trials, np.nan) for name in task.metrics(environment.arrays)}
    longest = round(task.time_limit / task.control_step) + 1
    for k, step in rollout(agent, environment, longest, lambda t: NOWHERE, record=record):
        if step is None:
            continue
        ended = running & (step.terminated | step.truncated)
        if ended.any():
            # A world that broke is terminated but not done; having begun anew, it is not frozen any more.
            whole = ended & (environment.arrays.done.numpy() != 0)
            for name, values in task.metrics(environment.arrays).items():
                found[name][whole] = values[whole]
            running &= ~ended
        show(k / longest)
        if not running.any():
            break
    return Episodes(found)


def summarize_episodes(trials: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """One controller's row: means over the episodes, and where a bootstrap over them puts each mean.

    Returns:
        `trials`, `valid` (episodes whose world did not break), `metrics` (name -> value, ci95) and `per_trial`.
    """
    metrics: dict[str, Any] = {}
    for name in (name for name in trials[0] if name not in LABELS):
        values = [float(trial[name]) for trial in trials if trial[name] is not None]
        found = with_interval({i: [x] for i, x in enumerate(values)})
        metrics[name] = {"value": found and found.value, "ci95": found and [found.low, found.high]}
    return {
        "trials": len(trials),
        "valid": sum(trial["return"] is not None for trial in trials),
        "metrics": metrics,
        "per_trial": [dict(trial) for trial in trials],
    }
