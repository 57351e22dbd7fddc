"""Trials of trajectory tracking: a controller, a vehicle and a plant, one world per trial, all stepped together."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.control.guidance import Guide, acceleration_at
from finssim.control.tracking import Goal
from finssim.control.trajectories import load_trajectory
from finssim.experiments.plants import Plant
from finssim.experiments.t2_metrics import measure_tracking
from finssim.experiments.trials import PHYSICS_STEP
from finssim.geometry.rotations import quat_from_yaw
from finssim.tasks import TrajectoryTracking, follow
from finssim.tasks.agents import Agent
from finssim.tasks.rollout import rollout
from finssim.vehicles import Vehicle

__all__ = ["T2_TRAJECTORIES", "TrackingTrials", "run_tracking"]

Array = NDArray[np.float64]

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
    hydrodynamics: str = "calibrated",
    seed: int = 42,
    record: Path | None = None,
    crash_directory: Path = Path("finssim-frozen"),
    show: Callable[[float], None] = lambda part: None,
) -> TrackingTrials:
    """Follow trajectories, each from rest on its first pose.

    Args:
        agent: Who acts.
        task: Its observation is what the agent sees.
        vehicle: As its file has it and the agent knows it; the plant changes what it delivers.
        plant: What differs.
        trials: How many, all at once.
        guides: What is followed, in turn; the four published trajectories if None.
        hydrodynamics: Model, unless the plant names one.
        seed: Of everything that the plant draws.
        record: New folder for every state, command and thrust; none if None.
        crash_directory: Where the last states of a world that broke are written.
        show: Called with the part done.
    """
    ways = guides or [load_trajectory(name, vehicle=vehicle) for name in T2_TRAJECTORIES]
    chosen = tuple(ways[i % len(ways)] for i in range(trials))
    longest = max(guide.duration for guide in chosen)
    environment = plant.environment(
        agent,
        replace(
            task,
            control_step=agent.period,
            substeps=math.ceil(agent.period / PHYSICS_STEP - 1e-9),
            time_limit=longest + 1.0,
            knot_spacing=0.1,
        ),
        vehicle,
        worlds=trials,
        hydrodynamics=hydrodynamics,
        seed=seed,
        auto_reset=False,
        crash_directory=crash_directory,
    )
    follow(environment, chosen)
    steps = round(longest / agent.period)
    thrusters = len(environment.simulator.vehicles[0].thrusters)
    position, quaternion, thrust = (np.full((steps + 1, trials, n), np.nan) for n in (3, 4, thrusters))
    state = environment.simulator.state
    episode = state.episode.numpy().copy()
    for k, _ in rollout(agent, environment, steps, lambda t: _goals(chosen, t), record=record):
        same = state.episode.numpy() == episode  # a world that broke has started over
        position[k, same] = state.position.numpy()[same, 0]
        quaternion[k, same] = state.quaternion.numpy()[same, 0]
        thrust[k, same] = state.thrust.numpy()[same, 0, :thrusters]
        show(k / steps)
    t = np.arange(steps + 1, dtype=np.float64) * agent.period
    lower, upper = environment.simulator.vehicles[0].force_limits
    return TrackingTrials(
        chosen, t, position, quaternion, thrust, (np.asarray(lower, float), np.asarray(upper, float))
    )


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
