"""T2, trajectory tracking: follow a moving reference, whatever the heading (paper, section IV)."""

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.tasks.arrays import TaskArrays
from finssim.tasks.measurement import MeasurementNoise
from finssim.tasks.reference import reference_table
from finssim.tasks.reference_shapes import SHAPE_NAMES
from finssim.tasks.task import ObservationPart, Task
from finssim.tasks.tracking_kernels import (
    DISTANCE_SCALE,
    LOOK_AHEAD,
    VELOCITY_CLIP,
    TrackingParameters,
    evaluate_tracking,
    observe_tracking,
    spawn_tracking,
)

LEVELS = (
    ("line", "circle"),
    ("circle", "lemniscate"),
    ("circle", "lemniscate", "helix"),
    ("line", "circle", "lemniscate", "helix"),
)
"""Shapes of the three published levels of difficulty, and of ours, which has them all at once."""

OBSERVATION = (
    *(
        ObservationPart(
            f"reference offset in {LOOK_AHEAD * i:.1f} s, body frame", 3, "m", scale=DISTANCE_SCALE
        )
        for i in range(4)
    ),
    ObservationPart("reference velocity, body frame", 3, "m/s"),
    ObservationPart("linear velocity, body frame", 3, "m/s", clip=VELOCITY_CLIP),
    ObservationPart("angular velocity, body frame", 3, "rad/s", clip=VELOCITY_CLIP),
    ObservationPart("world up, body frame", 3, "1"),
    ObservationPart("tangent heading in the body, sine and cosine", 2, "1"),
    ObservationPart("progress, sine and cosine of one and two turns", 4, "1"),
)


@dataclass(frozen=True, kw_only=True)
class TrackingReward:
    """Weights of the reward; each term has one reason.

    pose = exp(-e / track_scale)

    r = track · pose                             nearness to the reference; published with a scale of 0.6 m, on which
                                                 centimetres are nothing
      - distance · e                             a slope everywhere: a far reference is caught up with
      + posture · pose · (0.5 / (1 + (tilt / tilt_scale)²) + 0.5 / (1 + (r / spin_scale)⁴))
                                                 level, and not spinning: published with scales of one; only near the
                                                 reference, so that it is never worth staying away for
      - spin · |r|                               the heading is free, but turning all the time is not: without a slope
                                                 at every yaw rate r, a steady turn was learnt
      - action · mean(a²)                        the cheapest thrusts that do it
      - change · mean(Δa²)                       commands that a motor can follow, no chatter
      - loss                                     once, on getting lost: more than a bad episode costs
    """

    track: float = 1.0
    track_scale: float = 0.05
    distance: float = 2.0
    posture: float = 0.5
    tilt_scale: float = 0.2
    spin_scale: float = 0.3
    spin: float = 0.5
    action: float = 0.01
    change: float = 0.05
    loss: float = 10.0


@dataclass(frozen=True, kw_only=True)
class TrajectoryTracking(Task):
    """T2. Lengths in metres, angles in radians, world frame with z up and 0 on the water.

    The published generator, except that shapes are as large as the pool (published: half axes up to 2.5 and 1.25 m,
    beyond its walls) and that their speed is drawn, since what is to be followed is slow.
    """

    levels: ClassVar[int] = len(LEVELS)
    moving: ClassVar[bool] = True
    title: ClassVar[str] = "follow a moving reference, whatever the heading"
    name: str = "t2"
    observation: tuple[ObservationPart, ...] = OBSERVATION
    time_limit: float = 30.0
    level: int = 3
    """Which of `LEVELS` the shapes are drawn from: 0 to 2 as published, 3 all of them."""
    scale_low: tuple[float, float, float] = (0.3, 0.2, 0.04)
    """Half axes of a shape are drawn from here, along, across and up ..."""
    scale_high: tuple[float, float, float] = (1.2, 0.6, 0.12)
    """... to here."""
    speed_limit: tuple[float, float, float] = (0.30, 0.20, 0.10)
    """Greatest speed of a reference along, across and up [m/s]; never more than one turn in `time_limit` either."""
    slowest: float = 0.2
    """Smallest part of the greatest possible speed that is drawn; 1: always the greatest, as published."""
    lift: float = 0.6
    """Greatest part of the upward half axis by which a shape is tilted."""
    depth: float = -0.5
    """Height of the middle of a shape."""
    jitter: tuple[float, float, float] = (0.15, 0.15, 0.15)
    """Largest shift of a shape, and of the start from its first point."""
    tilt: float = math.radians(20.0)
    """Largest roll and pitch at the start; the heading is any."""
    speed: float = 0.1
    """Largest starting speed per axis [m/s]."""
    lost: float = 4.0
    """A greater distance to the reference ends the episode."""
    ceiling: float = 0.3
    """So does rising above this height."""
    range: float = 12.0
    """So does going this far from the world's origin."""
    tolerance: float = 0.05
    """The time within this distance is counted, without a break."""
    hold: float = 10.0
    """An episode counts as held when it ends with this long within the tolerance [s]."""
    knot_spacing: float = 0.25
    """Time between two knots of the reference's table [s]."""
    reward: TrackingReward = field(default_factory=TrackingReward)
    training_noise: MeasurementNoise = MeasurementNoise(
        position_std=0.01, yaw_std=math.radians(1.0), velocity_std=0.02, rate_std=0.02
    )
    """About what an estimate is off by: with exact states, gains are learnt that chatter on measured ones."""

    evaluate = staticmethod(evaluate_tracking)
    spawn = staticmethod(spawn_tracking)
    observe = staticmethod(observe_tracking)

    def __post_init__(self) -> None:
        if not 0 <= self.level < len(LEVELS):
            raise ValueError(f"level is {self.level}, expected 0 to {len(LEVELS) - 1}")

    def allocate(self, arrays: TaskArrays, worlds: int, device: wp.Device) -> None:
        """Room for every world's reference, from the start to what is seen at the end."""
        knots = math.ceil((self.time_limit + 3.0 * LOOK_AHEAD) / self.knot_spacing) + 2
        arrays.reference = reference_table(worlds, knots, self.knot_spacing, device)

    def success_rule(self) -> str:
        """See `Task`."""
        return f"{self.tolerance:g} m from the reference for {self.hold:g} s, at the end"

    def metrics(self, arrays: TaskArrays) -> dict[str, NDArray[np.float64]]:
        """As every task's, and success: held for `hold` seconds when the episode ended."""
        measured = super().metrics(arrays)
        enough = measured["held"] >= self.hold - 0.5 * self.control_step
        return {**measured, "success": np.where(enough, 1.0, 0.0)}

    def parameters(self) -> Any:
        """The struct that the kernels take."""
        p, r = TrackingParameters(), self.reward
        kinds = [SHAPE_NAMES.index(name) for name in LEVELS[self.level]]
        p.shape_of, p.shapes = wp.vec4i(*kinds, *[0] * (4 - len(kinds))), len(kinds)
        for name in ("scale_low", "scale_high", "speed_limit", "jitter"):
            setattr(p, name, wp.vec3(*getattr(self, name)))
        for name in (
            *("slowest", "lift", "depth", "tilt", "speed", "lost", "ceiling", "range", "tolerance"),
            *("time_limit", "control_step"),
        ):
            setattr(p, name, getattr(self, name))
        p.track_weight, p.track_scale, p.distance_weight = r.track, r.track_scale, r.distance
        p.posture_weight, p.tilt_scale, p.spin_scale = r.posture, r.tilt_scale, r.spin_scale
        p.spin_weight = r.spin
        p.action_weight, p.change_weight, p.loss = r.action, r.change, r.loss
        return p
