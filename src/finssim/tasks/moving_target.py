"""T3, moving target: stay with something that changes its course every few seconds."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.engine import Pool
from finssim.tasks.arrays import TargetMotion, TaskArrays
from finssim.tasks.fitting import Fit, fit
from finssim.tasks.measurement import MeasurementNoise
from finssim.tasks.moving_target_kernels import (
    DISTANCE_SCALE,
    TARGET_SCALE,
    VELOCITY_CLIP,
    TargetParameters,
    evaluate_target,
    observe_target,
    spawn_target,
)
from finssim.tasks.task import ObservationPart, Task
from finssim.vehicles import Vehicle

OBSERVATION = (
    ObservationPart("target offset, body frame", 3, "m", scale=DISTANCE_SCALE),
    ObservationPart("target velocity, body frame", 3, "m/s", scale=TARGET_SCALE),
    ObservationPart("linear velocity, body frame", 3, "m/s", clip=VELOCITY_CLIP),
    ObservationPart("angular velocity, body frame", 3, "rad/s", clip=VELOCITY_CLIP),
    ObservationPart("distance to the target", 1, "m", scale=DISTANCE_SCALE, clip=1.0),
)


@dataclass(frozen=True, kw_only=True)
class TargetReward:
    """Weights of the reward; each term has one reason.

    near = exp(-e / near_scale), e the distance to the target, u the speed relative to it

    r = near_weight · near                       a slope that does not vanish at the target: centimetres count
      - distance · e                             a slope everywhere: a far target is caught up with
      + match · near · exp(-u / match_scale)     go as it goes, but only beside it: elsewhere it is to be reached
      - spin · min(|ω|, 2)                       the attitude is not observed and free; turning all the time is not
      - action · mean(a²)                        the cheapest thrusts that do it
      - change · mean(Δa²)                       commands that a motor can follow, no chatter
      - loss                                     once, on leaving the pool: more than a bad episode costs
    """

    near: float = 1.0
    near_scale: float = 0.10
    distance: float = 1.0
    match: float = 0.5
    match_scale: float = 0.05
    spin: float = 0.2
    action: float = 0.02
    change: float = 0.05
    loss: float = 10.0


@dataclass(frozen=True, kw_only=True)
class MovingTarget(Task):
    """T3. Lengths in metres, world frame with z up and 0 on the water, as for FinsROV.

    A longer vehicle has everything `fit.size` times as large, and `fit.pace` times as fast. The target's speed, courses
    and tolerances are the published ones; across the pool its box is what the walls leave (published: 2.5 m).
    """

    moving: ClassVar[bool] = True
    title: ClassVar[str] = "stay with a target that changes its course"
    name: str = "t3"
    totals: ClassVar[tuple[str, ...]] = ("success", "success_time", "squared_error")
    observation: tuple[ObservationPart, ...] = OBSERVATION
    time_limit: float = 30.0
    fit: Fit = Fit()
    """Factors of the vehicle; the environment sets them."""
    low: tuple[float, float, float] = (-1.25, -0.50, -0.675)
    """The target starts in this box, and turns back where it leaves it; with 0.08 m/s² it needs 0.06 m for that."""
    high: tuple[float, float, float] = (1.25, 0.50, -0.325)
    fastest: float = 0.10
    """Its speed is drawn up to this [m/s] ..."""
    acceleration: float = 0.08
    """... and changes by this at most [m/s²]."""
    vertical: float = 0.4
    """Part of the drawn speed that is left upwards and downwards."""
    retarget: tuple[float, float] = (1.5, 4.0)
    """Another velocity is drawn after a time from this range [s]."""
    spawn_low: tuple[float, float, float] = (-1.4, -0.6, -0.80)
    """The vehicle starts in this box, with any heading."""
    spawn_high: tuple[float, float, float] = (1.4, 0.6, -0.20)
    tilt: float = math.radians(20.0)
    """Largest roll and pitch at the start [rad]."""
    speed: float = 0.1
    """Largest starting speed per axis [m/s]."""
    bounds: tuple[float, float] = (2.5, 1.5)
    """Leaving |x|, |y| beyond these ends the episode."""
    ceiling: float = 0.3
    """So does rising above this height."""
    depth: float = 1.5
    """So does sinking below this depth."""
    tolerance: float = 0.25
    """Success: within this distance, ..."""
    slip_tolerance: float = 0.12
    """... with at most this speed relative to the target [m/s] ..."""
    rate_tolerance: float = 0.3
    """... and at most this turn rate [rad/s], ..."""
    hold: float = 1.0
    """... for this long: 10 steps [s]."""
    settle: float = 10.0
    """The error of an episode is counted from here [s]."""
    reward: TargetReward = field(default_factory=TargetReward)
    training_noise: MeasurementNoise = MeasurementNoise(
        position_std=0.01, yaw_std=math.radians(1.0), velocity_std=0.02, rate_std=0.02
    )

    evaluate = staticmethod(evaluate_target)
    spawn = staticmethod(spawn_target)
    observe = staticmethod(observe_target)

    def fitted(self, vehicles: Sequence[Vehicle]) -> "MovingTarget":
        """As large and fast as suits the vehicle."""
        return replace(self, fit=fit(vehicles[0]))

    def arena(self) -> Pool:
        """The paper's pool, in proportion, with walls as stiff for the vehicle as they are for FinsROV."""
        size, weight = self.fit.size, self.fit.weight
        return Pool(
            length=4.0 * size, width=2.0 * size, depth=size, stiffness=4000.0 * weight, damping=100.0 * weight
        )

    def allocate(self, arrays: TaskArrays, worlds: int, device: wp.Device) -> None:
        """Room for every target's motion."""
        motion = TargetMotion()
        motion.velocity = wp.zeros(worlds, dtype=wp.vec3, device=device)
        motion.wanted = wp.zeros(worlds, dtype=wp.vec3, device=device)
        motion.until = wp.zeros(worlds, dtype=wp.float32, device=device)
        motion.rng = wp.zeros(worlds, dtype=wp.uint32, device=device)
        arrays.target = motion

    def success_rule(self) -> str:
        """See `Task`."""
        return (
            f"{self.tolerance:g} m, {self.slip_tolerance:g} m/s and {self.rate_tolerance:g} rad/s from the target for "
            f"{self.hold:g} s"
        )

    def metrics(self, arrays: TaskArrays) -> dict[str, NDArray[np.float64]]:
        """As every task's; success (10 steps in tolerance at any time), its time [s], error after `settle` (RMS) [m].

        `success_time` is not a number where there was none, nor `error` where the episode was shorter.
        """
        measured = super().metrics(arrays)
        squared = measured.pop("squared_error")
        long = measured["length"] * self.control_step > self.settle + 0.5 * self.control_step
        measured["success_time"][measured["success"] == 0.0] = np.nan
        return {**measured, "error": np.where(long, np.sqrt(squared), np.nan)}

    def parameters(self) -> Any:
        """The struct that the kernels take."""
        p, r = TargetParameters(), self.reward
        size, pace = self.fit.size, self.fit.pace
        for name in ("low", "high", "spawn_low", "spawn_high"):
            setattr(p, name, size * wp.vec3(*getattr(self, name)))
        p.bounds = size * wp.vec3(*self.bounds, 0.0)
        for name in ("ceiling", "depth", "tolerance"):
            setattr(p, name, size * getattr(self, name))
        for name in ("fastest", "acceleration", "speed", "slip_tolerance"):
            setattr(p, name, pace * getattr(self, name))
        for name in ("vertical", "tilt", "rate_tolerance", "hold", "settle", "time_limit", "control_step"):
            setattr(p, name, getattr(self, name))
        p.soonest, p.latest = self.retarget
        p.near_weight, p.near_scale, p.distance_weight = r.near, size * r.near_scale, r.distance / size
        p.match_weight, p.match_scale = r.match, pace * r.match_scale
        p.spin_weight, p.action_weight, p.change_weight, p.loss = r.spin, r.action, r.change, r.loss
        return p
