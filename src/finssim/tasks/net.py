"""Inspecting a net by sonar and altimeter: along it at a set distance and height, facing it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.engine.state import State
from finssim.tasks.arrays import TaskArrays
from finssim.tasks.seeing import SeeingTask, up
from finssim.tasks.sight import Picture
from finssim.tasks.terms import (
    End,
    ObservationPart,
    RewardTerm,
    Terms,
    Total,
    own_velocity,
    place_tilted,
    world_velocity,
)
from finssim.vehicles import Vehicle

FOOT = 6.9
"""Depth of the sinker tube along the net's foot, in the site `net` [m]."""
RANGE_SCALE = 0.5
"""The range below less the set height is divided by this in the observation [m]."""


@wp.func
def by_net(arrays: TaskArrays, w: int, x: wp.vec3) -> wp.vec3:
    """A point in the net's axes: x towards the net, in which it lies at 0, y along it to the left, z up [m]."""
    return wp.quat_rotate_inv(arrays.goal_quaternion[w], x - arrays.goal_position[w])


@wp.func
def place_now(state: State, arrays: TaskArrays, w: int) -> wp.vec3:
    """`by_net` of the vehicle."""
    return by_net(arrays, w, state.position[w, 0])


@wp.func
def way_to_line(arrays: TaskArrays, p: Any, w: int) -> wp.vec3:
    """To the line along the net at the set distance and height, beside the vehicle, body frame [m]."""
    place = by_net(arrays, w, arrays.position[w, 0])
    way = wp.vec3(-p.distance - place[0], 0.0, p.level - place[2])
    return wp.quat_rotate_inv(arrays.quaternion[w, 0], wp.quat_rotate(arrays.goal_quaternion[w], way))


@wp.func
def touches(state: State, arrays: TaskArrays, p: Any, w: int, place: wp.vec3) -> bool:
    """Whether the vehicle's envelope reaches what grows on the net."""
    R = wp.quat_to_matrix(wp.quat_inverse(arrays.goal_quaternion[w]) * state.quaternion[w, 0])
    reach = wp.abs(R[0, 0]) * p.half[0] + wp.abs(R[0, 1]) * p.half[1] + wp.abs(R[0, 2]) * p.half[2]
    return place[0] + reach + p.growth > 0.0


@wp.func
def pace(state: State, arrays: TaskArrays, p: Any, w: int) -> float:
    """1 at the set speed along the net, falling to 0 where it stands still, or is twice as fast."""
    v = wp.quat_rotate_inv(arrays.goal_quaternion[w], world_velocity(state, w, 0))
    return wp.max(1.0 - wp.abs(v[1] - p.speed) / p.speed, -1.0)


@wp.func
def start(state: State, arrays: TaskArrays, p: Any, key: int, w: int):
    """At rest before the net's right end, not quite on the line, turned a little; without a world it hangs anywhere."""
    rng = wp.rand_init(key, w)
    yaw = wp.randf(rng, -3.14159265, 3.14159265)
    if not p.placed:
        arrays.goal_position[w] = wp.vec3(0.0)
        arrays.goal_quaternion[w] = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), yaw)
    q = arrays.goal_quaternion[w]
    along = wp.randf(rng, p.begin[0], p.begin[1])
    off = wp.vec3(wp.randf(rng, -p.off, p.off) - p.distance, along, p.level + wp.randf(rng, -p.over, p.over))
    x = arrays.goal_position[w] + wp.quat_rotate(q, off)
    place_tilted(state, w, x, q, rng, p.tilt, p.turn)


@dataclass(frozen=True, kw_only=True)
class NetReward:
    """Weights of the reward, with e the distance from the line along the net [m] and θ the attitude error [rad].

    r = pace · max(1 - |speed along - speed| / speed, -1) + near · exp(-e / near_scale) - distance · e - turn · θ
        - action · mean(a²) - change · mean(Δa²) - rate · min(|ω|², 4) - loss, once, where it touches or is lost
    """

    pace: float = 1.0
    near: float = 0.5
    near_scale: float = 0.15
    distance: float = 1.0
    turn: float = 0.3
    action: float = 0.02
    change: float = 0.05
    rate: float = 0.02
    loss: float = 20.0


@dataclass(frozen=True, kw_only=True)
class Net(SeeingTask):
    """Inspect the net of the site `net`, which hangs otherwise in each episode, from right to left.

    The row of numbers holds attitude, velocity and the altimeter's range to what lies below, the tube at the net's
    foot; where the net is, the sonar's picture shows.
    """

    succeeds: ClassVar[str] = "once"
    fails: ClassVar[tuple[str, ...]] = ("touched", "lost")
    title: ClassVar[str] = "inspect a net by sonar"
    action: ClassVar[str] = "wrench4"
    landmark: ClassVar[str] = "cage"
    ranges: ClassVar[tuple[str, ...]] = ("altimeter",)
    teacher: ClassVar[tuple[ObservationPart, ...]] = (
        ObservationPart("way to the line along the net, body frame", 3, "m", term=way_to_line),
        ObservationPart("net rotation relative to the body, first two columns", 6, "1", term="goal_columns"),
        *own_velocity(clip=2.0),
    )
    name: str = "net"
    observation: tuple[ObservationPart, ...] = (
        ObservationPart("up, body frame", 3, "1", term=up),
        *own_velocity(clip=2.0),
        ObservationPart(
            "range below, less the set height",
            1,
            "m",
            scale=RANGE_SCALE,
            clip=4.0,
            term="arrays.ranges[w, 0] - p.height",
        ),
    )
    world: str = "net"
    pictures: tuple[Picture, ...] = (Picture("sonar", bins=48),)
    time_limit: float = 36.0
    half: tuple[float, float, float] = (0.28, 0.19, 0.15)
    """Half the extents of the vehicle's envelope [m]; the environment sets them."""
    distance: float = 1.5
    """Of the body origin from the net [m], ..."""
    height: float = 4.4
    """... and above its foot [m]."""
    speed: float = 0.2
    """Along it [m/s]."""
    way: float = 6.0
    """Success: so far along the net from where the episode began [m], ..."""
    tolerance: float = 0.1
    """... with a mean error of the distance of at most this [m], without touching or losing it."""
    hold: float = 0.1
    """For so long [s]."""
    growth: float = 0.12
    """How far what grows on the net stands out [m]."""
    lost: float = 0.8
    """The line is lost so far from it [m]."""
    begin: tuple[float, float] = (-3.6, -3.1)
    """Along the net from its middle at the start [m], ..."""
    off: float = 0.4
    """... nearer or farther, ..."""
    over: float = 0.3
    """... above or below the line [m] at most, ..."""
    turn: float = math.radians(15.0)
    """... turned from it by this at most [rad]."""
    reward: NetReward = field(default_factory=NetReward)

    def fitted(self, vehicles: Sequence[Vehicle]) -> "Net":
        """With the envelope of the vehicle."""
        length, width, height = (0.5 * float(x) for x in vehicles[0].body.size)
        return replace(self, half=(length, width, height))

    @property
    def level(self) -> float:
        """z of the line [m]."""
        return self.height - FOOT

    def success_rule(self) -> str:
        """See `Task`."""
        return (
            f"{self.way:g} m along the net, {self.distance:g} m from it to {self.tolerance:g} m in the mean,"
            " without touching or losing it"
        )

    def metrics(self, arrays: TaskArrays) -> dict[str, NDArray[np.float64]]:
        """As every task's; success, its time [s], mean error of the distance [m], touched and lost 0 or 1."""
        measured = super().metrics(arrays)
        del measured["begun"]
        measured["error"] /= self.control_step * np.maximum(measured["length"], 1.0)
        return measured

    def terms(self) -> Terms:
        """See `NetReward`."""
        r = self.reward
        return Terms(
            start=start,
            shared={
                "place": place_now,
                "e": "wp.length(wp.vec2(place[0] + p.distance, place[2] - p.level))",
                "theta": "attitude_error",
            },
            meanings={
                "near": f"1 on the line along the net, 1/e at {r.near_scale:.3g} m from it.",
                "distance": "From the line along the net [m].",
                "lost": f"More than {self.lost:g} m from the line along the net.",
                "begun": "How far along the net the episode began [m].",
                "error": "Error of the distance from the net, integrated over the episode [m s].",
            },
            rewards=(
                RewardTerm("pace", pace, r.pace),
                RewardTerm("near", "wp.exp(-e / p.reward.near_scale)", r.near),
                RewardTerm("distance", "e", -r.distance),
                RewardTerm("turn", "theta", -r.turn),
                RewardTerm("action", "action_effort", -r.action),
                RewardTerm("change", "action_change", -r.change),
                RewardTerm("rate", "turning", -r.rate),
            ),
            ends=(End("touched", touches, -r.loss), End("lost", "e > p.lost", -r.loss)),
            inside="place[1] - begun >= p.way and error <= p.tolerance * arrays.time[w]",
            totals=(
                Total("begun", "was", first="place[1]"),
                Total("error", "was + p.control_step * wp.abs(place[0] + p.distance)"),
            ),
        )
