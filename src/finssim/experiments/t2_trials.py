"""Trials of trajectory tracking: a controller, a vehicle and a plant, one world per trial, all stepped together."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.control.guidance import Guide, acceleration_at
from finssim.control.tracking import Goal
from finssim.control.trajectories import load_trajectory
from finssim.engine import Recorder
from finssim.experiments.plants import Plant
from finssim.experiments.players import Player
from finssim.experiments.t2_metrics import measure_tracking
from finssim.experiments.trials import PHYSICS_STEP
from finssim.geometry.rotations import quat_from_yaw
from finssim.tasks import Environment, TrajectoryTracking, follow
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
    player: Player,
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
        player: Who acts.
        task: Its observation is what the player sees.
        vehicle: As its file has it and the player knows it; the plant changes what it delivers.
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
    environment = Environment(
        replace(
            task,
            control_step=player.period,
            substeps=math.ceil(player.period / PHYSICS_STEP - 1e-9),
            time_limit=longest + 1.0,
            knot_spacing=0.1,
        ),
        plant.changed(vehicle),
        nominal=vehicle,
        worlds=trials,
        hydrodynamics=plant.hydrodynamics or hydrodynamics,
        action=player.action,
        wrench_scale=player.wrench_scale,
        seed=seed,
        auto_reset=False,
        crash_directory=crash_directory,
        **plant.environment_arguments(),
    )
    follow(environment, chosen)
    steps = round(longest / player.period)
    with nullcontext() if record is None else Recorder(environment.simulator, record) as recorder:
        series = _play(player, environment, chosen, steps, recorder, show)
    t = np.arange(steps + 1, dtype=np.float64) * player.period
    lower, upper = environment.simulator.vehicles[0].force_limits
    return TrackingTrials(chosen, t, *series, (np.asarray(lower, float), np.asarray(upper, float)))


def _play(
    player: Player,
    environment: Environment,
    guides: Sequence[Guide],
    steps: int,
    recorder: Recorder | None,
    show: Callable[[float], None],
) -> tuple[Array, Array, Array]:
    n, thrusters = len(guides), len(environment.simulator.vehicles[0].thrusters)
    series = tuple(np.full((steps + 1, n, width), np.nan) for width in (3, 4, thrusters))
    state = environment.simulator.state
    episode = state.episode.numpy().copy()
    memory = player.reset(n)
    for k in range(steps + 1):
        same = state.episode.numpy() == episode  # a world that broke has started over
        for values, array in zip(series, (state.position, state.quaternion, state.thrust), strict=True):
            values[k, same] = array.numpy()[same, 0, : values.shape[-1]]
        if recorder is not None:
            recorder.record()
        if k < steps:
            action, memory = player.act(memory, environment.arrays, _goals(guides, k * player.period))
            environment.step(action)
        show(k / steps)
    return series  # type: ignore[return-value]


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
