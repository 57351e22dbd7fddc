"""Trials of station keeping: a controller, a vehicle and a plant, one world per trial, all stepped together."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.control.tracking import Goal
from finssim.experiments.metrics import measure_trial
from finssim.experiments.plants import Plant
from finssim.experiments.setpoints import T1_SETPOINTS, T1_START, in_room
from finssim.geometry.rotations import quat_from_yaw, quat_yaw
from finssim.tasks import Task
from finssim.tasks.agents import Agent
from finssim.tasks.rollout import rollout
from finssim.vehicles import Vehicle

__all__ = ["Trials", "run_trials"]

Array = NDArray[np.float64]

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


def run_trials(
    agent: Agent,
    task: Task,
    vehicle: Vehicle,
    plant: Plant,
    *,
    trials: int = 8,
    hydrodynamics: str = "calibrated",
    seed: int = 42,
    record: Path | None = None,
    crash_directory: Path = Path("finssim-frozen"),
    show: Callable[[float], None] = lambda part: None,
) -> Trials:
    """Run trials of 60 s from the published start, level and at rest, towards the eight setpoints in turn.

    Args:
        agent: Who acts.
        task: Its observation is what the agent sees.
        vehicle: As its file has it and the agent knows it; the plant changes what it delivers.
        plant: What differs.
        trials: How many, all at once.
        hydrodynamics: Model, unless the plant names one.
        seed: Of everything that the plant draws.
        record: New folder for every state, command and thrust; none if None.
        crash_directory: Where the last states of a world that broke are written.
        show: Called with the part done.
    """
    names = tuple(list(T1_SETPOINTS)[i % len(T1_SETPOINTS)] for i in range(trials))
    goals = np.array([in_room(T1_SETPOINTS[name], vehicle) for name in names])
    start = in_room(T1_START, vehicle)
    environment = plant.environment(
        agent,
        replace(task, control_step=agent.period, substeps=math.ceil(agent.period / PHYSICS_STEP - 1e-9)),
        vehicle,
        worlds=trials,
        hydrodynamics=hydrodynamics,
        seed=seed,
        auto_reset=False,
        crash_directory=crash_directory,
    )
    environment.start(start[:3], quat_from_yaw(start[3]), goals[:, :3], quat_from_yaw(goals[:, 3]))
    steps = round(DURATION / agent.period)
    position, yaw = np.full((steps + 1, trials, 3), np.nan), np.full((steps + 1, trials), np.nan)
    goal = Goal(goals[:, :3], quat_from_yaw(goals[:, 3]))
    state = environment.simulator.state
    episode = state.episode.numpy().copy()
    for k, _ in rollout(agent, environment, steps, lambda t: goal, record=record):
        same = state.episode.numpy() == episode  # a world that broke has started over
        position[k, same] = state.position.numpy()[same, 0]
        yaw[k, same] = quat_yaw(state.quaternion.numpy()[same, 0])
        show(k / steps)
    return Trials(names, goals, np.arange(steps + 1, dtype=np.float64) * agent.period, position, yaw)
