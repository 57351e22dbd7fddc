"""Velocity control in six degrees of freedom: hold a velocity and an attitude that change every few seconds."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.control.axis_model import axis_model
from finssim.sim.state import State
from finssim.tasks.arrays import TargetMotion, TaskArrays, allocated
from finssim.tasks.fitting import FittedTask, fit
from finssim.tasks.measurement import MeasurementNoise
from finssim.tasks.moving_target import slip
from finssim.tasks.station_keeping import StationKeeping, heading
from finssim.tasks.terms import (
    ObservationPart,
    RewardTerm,
    Terms,
    Total,
    action_costs,
    attitude_error,
    goal_columns,
    heading_match,
    own_velocity,
    start_upright,
    tilted,
    world_up,
)
from finssim.vehicles import AXES, Vehicle
from finssim.vehicles.capability import coefficients_of

VELOCITY_SCALE = 0.2
"""Scale of the velocity error in the observation [m/s]."""


@wp.func
def velocity_to_gain(arrays: TaskArrays, w: int) -> wp.vec3:
    """Return the commanded minus the measured velocity, body frame [m/s]."""
    nu = arrays.velocity[w, 0]
    wanted = wp.quat_rotate_inv(arrays.quaternion[w, 0], arrays.target.velocity[w])
    return wanted - wp.vec3(nu[0], nu[1], nu[2])


OBSERVATION = (
    ObservationPart(
        "velocity to gain, body frame", 3, "m/s", VELOCITY_SCALE, term=velocity_to_gain, errors=(0, 1, 2)
    ),
    ObservationPart(
        "goal rotation relative to the body, first two columns", 6, "1", term=goal_columns, errors=(1,)
    ),
    *own_velocity(clip=2.0),
    ObservationPart("world up, body frame", 3, "1", term=world_up),
)


@dataclass(frozen=True, kw_only=True)
class VelocityReward:
    """Weights of the reward; u is the error of the velocity, θ that of the attitude.

    r = match · exp(-u / match_scale)            a slope that does not vanish at the command: cm/s count
      - slip · u                                 a slope everywhere
      + heading · exp(-θ / heading_scale) - turn · θ     the same for the attitude, roll and pitch included
      - action · mean(a²)                        the cheapest thrusts that suffice
      - change · mean(Δa²)                       commands that a motor can follow, no chatter
    """

    match: float = 1.0
    match_scale: float = 0.03
    slip: float = 2.0
    heading: float = 0.6
    heading_scale: float = 0.15
    turn: float = 0.3
    action: float = 0.01
    change: float = 0.05


@wp.func
def new_command(arrays: TaskArrays, p: Any, w: int, t: float):
    """Draw an attitude, a velocity in its axes, and the time at which they end; `t` is the time [s]."""
    rng = arrays.target.rng[w]
    z = wp.randf(rng, -1.0, 1.0)
    angle = wp.randf(rng, -3.14159265, 3.14159265)
    pace = wp.randf(rng, 0.0, p.fit.pace * p.fastest)
    level = wp.sqrt(1.0 - z * z)
    yaw = heading(arrays.goal_quaternion[w]) + wp.randf(rng, -p.turn, p.turn)
    roll = wp.randf(rng, -p.lean, p.lean)
    q = tilted(roll, wp.randf(rng, -p.lean, p.lean), yaw)
    arrays.goal_quaternion[w] = q
    arrays.target.velocity[w] = wp.quat_rotate(
        q, pace * wp.vec3(level * wp.cos(angle), level * wp.sin(angle), z)
    )
    arrays.target.until[w] = t + p.period
    arrays.target.rng[w] = rng


@wp.func
def change_command(arrays: TaskArrays, p: Any, w: int):
    """Draw a new command once the last one has lasted `period`, unless the episode ends now."""
    t = arrays.time[w] + 0.5 * p.control_step
    if t >= arrays.target.until[w] and t < p.time_limit:
        new_command(arrays, p, w, arrays.time[w])


@wp.func
def matching(p: Any, u: float) -> float:
    """Return 1 at the commanded velocity, 1/e at an error `u` of `match_scale` [m/s], scaled to the vehicle."""
    return wp.exp(-u / (p.fit.pace * p.reward.match_scale))


@wp.func
def within_tolerance(p: Any, u: float, theta: float) -> bool:
    """Return True if velocity [m/s] and attitude [rad] are within their tolerances."""
    return u <= p.fit.pace * p.tolerance and theta <= p.attitude_tolerance


@wp.func
def mean_square(arrays: TaskArrays, p: Any, w: int, x: float, was: float) -> float:
    """Return the mean of x² over the episode so far, in the squared unit of `x`, from the mean before this step."""
    return was + (x * x - was) / wp.max(1.0, wp.floor(arrays.time[w] / p.control_step + 0.5))


@wp.func
def squared_slip(arrays: TaskArrays, p: Any, w: int, u: float, was: float) -> float:
    """Return the mean of u² over the episode [m²/s²]."""
    return mean_square(arrays, p, w, u, was)


@wp.func
def squared_turn(arrays: TaskArrays, p: Any, w: int, theta: float, was: float) -> float:
    """Return the mean of θ² over the episode [rad²]."""
    return mean_square(arrays, p, w, theta, was)


@wp.func
def start(state: State, arrays: TaskArrays, p: Any, key: int, w: int):
    """Start an episode deep in open water, at any heading, with a random command."""
    here = wp.vec3(0.0, 0.0, -p.fit.size * p.depth)
    state.position[w, 0] = here
    start_upright(state, w, wp.rand_init(key, 4 * w), p.tilt, p.fit.pace * p.speed)
    arrays.goal_position[w] = here
    arrays.goal_quaternion[w] = state.quaternion[w, 0]
    arrays.target.rng[w] = wp.rand_init(key, 4 * w + 1)
    new_command(arrays, p, w, 0.0)


@dataclass(frozen=True, kw_only=True)
class VelocityControl(FittedTask):
    """Hold a velocity over ground and an attitude, as in *Learning to Swim* (arXiv:2410.00120) and *Sim2Swim*
    (arXiv:2512.08656).

    A command is a velocity in the axes of the commanded attitude, and lasts for `period`. Speeds are scaled by
    `fit.pace` for other vehicles. On a robot the reference's velocity and heading are the command.
    """

    succeeds: ClassVar[str] = "held"
    moving: ClassVar[bool] = True
    title: ClassVar[str] = "hold a commanded velocity and attitude"
    needs: ClassVar[tuple[str, ...]] = AXES
    baselines: ClassVar = {"pid": "finssim.agents.baselines:VelocityPid"}
    name: str = "velocity6"
    observation: tuple[ObservationPart, ...] = OBSERVATION
    fastest: float = 0.15
    """Greatest commanded speed [m/s]."""
    turn: float = math.radians(60.0)
    """Largest heading change between two commands [rad]."""
    lean: float = math.radians(45.0)
    """Largest commanded roll and pitch [rad]; limited to the tilt that half of the thrusters' moment can hold."""
    period: float = 5.0
    """Time from one command to the next [s]."""
    speed: float = 0.1
    """Largest starting speed per axis [m/s]."""
    depth: float = 30.0
    """Depth of the start [m]."""
    tolerance: float = 0.03
    """Greatest velocity error for success [m/s]."""
    attitude_tolerance: float = math.radians(10.0)
    """Greatest attitude error for success [rad]."""
    hold: float = 1.0
    """Time within these tolerances for success [s]."""
    reward: VelocityReward = field(default_factory=VelocityReward)
    training_noise: MeasurementNoise = replace(StationKeeping().training_noise, position_std=0.0)
    """As for T1: without a delay, policies learn gains that oscillate on slower motors."""

    def fitted(self, vehicles: Sequence[Vehicle]) -> "VelocityControl":
        """Return the task with speeds and tilt scaled to the vehicle."""
        (vehicle, *_) = vehicles
        stiffness = axis_model(vehicle, coefficients_of(vehicle)).stiffness[3:5]
        moment = 0.5 * np.asarray(vehicle.wrench_limits)[3:5]
        share = float((moment / np.maximum(stiffness, 1e-9)).min())
        return replace(self, fit=fit(vehicle), lean=min(self.lean, math.asin(min(share, 1.0))))

    def arena(self) -> None:
        """Return no walls: the task is in open water."""
        return

    def allocate(self, arrays: TaskArrays, worlds: int, device: wp.Device) -> None:
        """Allocate the command of every world."""
        arrays.target = allocated(TargetMotion, worlds, device)

    def success_rule(self) -> str:
        """Return the rule of success; see `Task`."""
        speed, angle = self.fit.pace * self.tolerance, math.degrees(self.attitude_tolerance)
        return f"{speed:.3g} m/s and {angle:g}° for {self.hold:g} s, at the end"

    def metrics(self, arrays: TaskArrays) -> dict[str, NDArray[np.float64]]:
        """Return the metrics of every task, and the RMS errors over the episode: velocity [m/s], attitude [rad]."""
        measured = super().metrics(arrays)
        return {
            **{name: x for name, x in measured.items() if not name.startswith("squared")},
            "velocity_error": np.sqrt(measured["squared_velocity"]),
            "attitude_error": np.sqrt(measured["squared_attitude"]),
        }

    def terms(self) -> Terms:
        """Return the terms; see `VelocityReward`."""
        r = self.reward
        return Terms(
            start=start,
            advance=change_command,
            shared={"u": slip, "theta": attitude_error},
            meanings={
                "match": f"1 at the commanded velocity, 1/e at {self.fit.pace * r.match_scale:.3g} m/s from it.",
                "heading": f"1 in the commanded attitude, 1/e at {r.heading_scale:.3g} rad from it.",
            },
            rewards=(
                RewardTerm("match", matching, r.match),
                RewardTerm("slip", "u", -r.slip / self.fit.pace),
                RewardTerm("heading", heading_match, r.heading),
                RewardTerm("turn", "theta", -r.turn),
                *action_costs(r.action, r.change),
            ),
            inside=within_tolerance,
            totals=(Total("squared_velocity", squared_slip), Total("squared_attitude", squared_turn)),
        )
