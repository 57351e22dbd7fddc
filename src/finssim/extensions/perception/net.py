"""Inspecting a net by sonar and altimeter: along it at a set distance and height, facing it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.extensions.perception.seeing import SeeingTask
from finssim.physics.types import vec6
from finssim.sim.state import State
from finssim.tasks.arrays import TaskArrays
from finssim.tasks.picture import ObservedPicture
from finssim.tasks.terms import (
    End,
    ObservationPart,
    RewardTerm,
    Terms,
    Total,
    action_costs,
    near_match,
    own_velocity,
    place_tilted,
    world_up,
    world_velocity,
)
from finssim.vehicles import Vehicle

FOOT = 6.9
"""Depth of the sinker tube along the net's lower edge, in the site `net` [m]."""
RANGE_SCALE = 0.5
"""Scale of the range below minus the set height in the observation [m]."""
BLEND = wp.constant(0.05)
"""Length scale of the blend between two sides of the net with similar distances [m]."""
AHEAD = (0.0, 0.5, 1.0)
"""Distances along the net, to the left, at which the teacher observes the line [m]."""


@wp.func
def by_net(arrays: TaskArrays, w: int, x: wp.vec3) -> wp.vec4:
    """Return the position of a point relative to the net: vector to its nearest point along x and y of the
    goal's axes, height z [m], and the heading that faces the net there [rad].

    The net hangs vertically along the line through `reference`; its first and last side are extended without
    end. If two sides have similar distances, the heading is between those that face the two.
    """
    place = wp.quat_rotate_inv(arrays.goal_quaternion[w], x - arrays.goal_position[w])
    last = arrays.reference.position.shape[1] - 2
    way = wp.vec2(1.0e9, 0.0)
    for k in range(last + 1):
        r = to_side(arrays, w, k, last, place)
        if wp.length(r) < wp.length(way):
            way = r
    facing = wp.vec2(0.0)
    for k in range(last + 1):
        r = to_side(arrays, w, k, last, place)
        facing += wp.exp((wp.length(way) - wp.length(r)) / BLEND) * wp.normalize(r)
    return wp.vec4(way[0], way[1], place[2], wp.atan2(facing[1], facing[0]))


@wp.func
def to_side(arrays: TaskArrays, w: int, k: int, last: int, place: wp.vec3) -> wp.vec2:
    """Return the vector from a point to the nearest point of one of the net's sides, along x and y of the
    goal's axes [m]."""
    a = arrays.reference.position[w, k]
    d = arrays.reference.position[w, k + 1] - a
    side = wp.vec2(d[0], d[1])
    r = wp.vec2(place[0] - a[0], place[1] - a[1])
    t = wp.dot(r, side) / wp.dot(side, side)
    if k > 0:
        t = wp.max(t, 0.0)
    if k < last:
        t = wp.min(t, 1.0)
    return t * side - r


@wp.func
def place_now(state: State, arrays: TaskArrays, w: int) -> wp.vec4:
    """Return `by_net` of the vehicle, in its units."""
    return by_net(arrays, w, state.position[w, 0])


@wp.func
def distance_now(place: wp.vec4) -> float:
    """Return the distance from the net [m]."""
    return wp.length(wp.vec2(place[0], place[1]))


@wp.func
def facing(arrays: TaskArrays, w: int, place: wp.vec4) -> wp.quat:
    """Return the attitude that faces the net, to world."""
    return arrays.goal_quaternion[w] * wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), place[3])


@wp.func
def ahead(arrays: TaskArrays, p: Any, w: int, k: int) -> vec6:
    """Return the point of the line along the net that is `ahead[k]` to the left of the vehicle: the vector to
    it [m] and the direction that faces the net there, body frame."""
    x = arrays.position[w, 0]
    left = wp.quat_rotate(facing(arrays, w, by_net(arrays, w, x)), wp.vec3(0.0, 1.0, 0.0))
    x += p.ahead[k] * left
    place = by_net(arrays, w, x)
    short = 1.0 - p.distance / distance_now(place)
    rest = wp.vec3(short * place[0], short * place[1], p.level - place[2])
    way = x + wp.quat_rotate(arrays.goal_quaternion[w], rest) - arrays.position[w, 0]
    nose = wp.quat_rotate(facing(arrays, w, place), wp.vec3(1.0, 0.0, 0.0))
    r = wp.quat_rotate_inv(arrays.quaternion[w, 0], way)
    n = wp.quat_rotate_inv(arrays.quaternion[w, 0], nose)
    return vec6(r[0], r[1], r[2], n[0], n[1], n[2])


@wp.func
def misfacing(state: State, arrays: TaskArrays, w: int, place: wp.vec4) -> float:
    """Return the angle of the rotation from the vehicle's attitude to the one that faces the net [rad], in [0, π]."""
    d = wp.quat_inverse(state.quaternion[w, 0]) * facing(arrays, w, place)
    return 2.0 * wp.atan2(wp.length(wp.vec3(d[0], d[1], d[2])), wp.abs(d[3]))


@wp.func
def touches(state: State, arrays: TaskArrays, p: Any, w: int) -> bool:
    """Return whether the vehicle's envelope, seen from above, is within the thickness of the growth from a
    side of the net.

    By the separating axis test: it is not if the gap between the two is larger along one of these directions:
    from the vehicle's middle to the nearest point of the side, the side's normal, or the edges of the
    envelope.
    """
    place = wp.quat_rotate_inv(arrays.goal_quaternion[w], state.position[w, 0] - arrays.goal_position[w])
    R = wp.quat_to_matrix(wp.quat_inverse(arrays.goal_quaternion[w]) * state.quaternion[w, 0])
    last = arrays.reference.position.shape[1] - 2
    touched = bool(False)
    for k in range(last + 1):
        a = arrays.reference.position[w, k]
        d = arrays.reference.position[w, k + 1] - a
        apart = float(-1.0e9)
        for i in range(5):
            u = to_side(arrays, w, k, last, place)
            if i == 1:
                u = wp.vec2(d[1], -d[0])
            elif i > 1:
                u = wp.vec2(R[1, i - 2], -R[0, i - 2])
            size = wp.length(u)
            if size > 1.0e-6:
                u /= size
                near = u[0] * (a[0] - place[0]) + u[1] * (a[1] - place[1])
                far = near + u[0] * d[0] + u[1] * d[1]
                reach = float(0.0)
                for j in range(3):
                    reach += wp.abs(u[0] * R[0, j] + u[1] * R[1, j]) * p.half[j]
                apart = wp.max(apart, wp.max(wp.min(near, far), -wp.max(near, far)) - reach)
        touched = touched or apart < p.growth
    return touched


@wp.func
def along_speed(state: State, arrays: TaskArrays, w: int, place: wp.vec4) -> float:
    """Return the speed to the left along the net [m/s]."""
    v = wp.quat_rotate_inv(facing(arrays, w, place), world_velocity(state, w, 0))
    return v[1]


@wp.func
def from_line(p: Any, place: wp.vec4, d: float) -> float:
    """Return the distance from the line along the net [m].

    The position `place` is that of `by_net`, at a distance `d` from the net [m].
    """
    return wp.length(wp.vec2(d - p.distance, place[2] - p.level))


@wp.func
def pace(p: Any, along: float) -> float:
    """Return 1 at the set speed along the net, falling to 0 at rest and at twice the speed.

    The speed along the net is in [m/s].
    """
    return wp.max(1.0 - wp.abs(along - p.speed) / p.speed, -1.0)


@wp.func
def is_lost(p: Any, e: float) -> bool:
    """Return whether the distance `e` from the line along the net is above `lost` [m]."""
    return e > p.lost


@wp.func
def way_along(p: Any, was: float, along: float) -> float:
    """Return the distance travelled along the net [m].

    The speed along it is in [m/s].
    """
    return was + p.control_step * along


@wp.func
def distance_error(p: Any, was: float, d: float) -> float:
    """Return the error of the distance from the net, integrated over the episode [m s].

    The distance `d` is in [m].
    """
    return was + p.control_step * wp.abs(d - p.distance)


@wp.func
def has_inspected(arrays: TaskArrays, p: Any, w: int, way: float, error: float) -> bool:
    """Return whether the distance `way` [m] is long enough and the mean of `error` [m s] small enough."""
    return way >= p.way and error <= p.tolerance * arrays.time[w]


@wp.func
def range_off(arrays: TaskArrays, p: Any, w: int) -> float:
    """Return the measured range below minus the set height [m]."""
    return arrays.ranges[w, 0] - p.height


@wp.func
def start(state: State, arrays: TaskArrays, p: Any, key: int, w: int):
    """Start at rest in front of the net's right side, near the line and slightly turned.

    Without a world the net is drawn: it has any heading, and its sides meet at angles like those of the site.
    """
    rng = wp.rand_init(key, w)
    yaw = wp.randf(rng, -3.14159265, 3.14159265)
    if not p.placed:
        arrays.goal_position[w] = wp.vec3(0.0)
        arrays.goal_quaternion[w] = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), yaw)
        corner = wp.vec3(0.0, -p.sides[0], 0.0)
        bend = float(0.0)
        for k in range(4):
            arrays.reference.position[w, k] = corner
            if k < 3:
                corner += p.sides[k] * wp.vec3(-wp.sin(bend), wp.cos(bend), 0.0)
                bend += wp.randf(rng, -p.bend, p.bend)
    q = arrays.goal_quaternion[w]
    along = wp.randf(rng, p.begin[0], p.begin[1])
    off = wp.vec3(wp.randf(rng, -p.off, p.off) - p.distance, along, p.level + wp.randf(rng, -p.over, p.over))
    x = arrays.goal_position[w] + wp.quat_rotate(q, off)
    place_tilted(state, w, x, q, rng, p.tilt, p.turn)


@dataclass(frozen=True, kw_only=True)
class NetReward:
    """Weights of the reward, with e the distance from the line along the net [m] and θ the attitude error [rad].

    r = pace · max(1 - |speed along - speed| / speed, -1) + near · exp(-e / near_scale) - distance · e - turn · θ
        - action · mean(a²) - change · mean(Δa²) - rate · min(|ω|², 4) - loss (once, if it touches the net or
            loses the line)
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
    """Inspect the net of the site `net`, whose shape differs in each episode, from right to left around its
    corners.

    The observed numbers are attitude, velocity and the altimeter's range to the tube at the net's lower edge;
    the net's position must be inferred from the sonar's picture.
    """

    succeeds: ClassVar[str] = "once"
    fails: ClassVar[tuple[str, ...]] = ("touched", "lost")
    title: ClassVar[str] = "inspect a net by sonar"
    action: ClassVar[str] = "wrench4"
    landmark: ClassVar[str] = "cage"
    marks: ClassVar[tuple[str, ...]] = ("rope_0", "rope_1", "rope_2", "rope_3")
    ranges: ClassVar[tuple[str, ...]] = ("altimeter",)
    teacher: ClassVar[tuple[ObservationPart, ...]] = (
        *(
            ObservationPart(
                f"way to the line {x:g} m along the net, and where it faces, body frame",
                6,
                "m, 1",
                term=ahead,
                index=k,
            )
            for k, x in enumerate(AHEAD)
        ),
        ObservationPart("up, body frame", 3, "1", term=world_up),
        *own_velocity(clip=2.0),
    )
    baselines: ClassVar = {"wall-follower": "finssim.extensions.perception.servos:WallFollower"}
    name: str = "net"
    observation: tuple[ObservationPart, ...] = (
        ObservationPart("up, body frame", 3, "1", term=world_up),
        *own_velocity(clip=2.0),
        ObservationPart(
            "range below, less the set height",
            1,
            "m",
            scale=RANGE_SCALE,
            clip=4.0,
            term=range_off,
        ),
    )
    world: str = "net"
    pictures: tuple[ObservedPicture, ...] = (ObservedPicture("sonar", bins=48),)
    time_limit: float = 36.0
    half: tuple[float, float, float] = (0.28, 0.19, 0.15)
    """Half extents of the vehicle's envelope, set by the environment [m]."""
    distance: float = 1.5
    """Set distance of the body origin from the net [m]."""
    height: float = 4.4
    """Set height above the net's lower edge [m]."""
    speed: float = 0.2
    """Set speed along the net [m/s]."""
    way: float = 6.0
    """Success: distance along the net from the start of the episode [m]."""
    tolerance: float = 0.1
    """Success: largest mean error of the distance from the net [m]."""
    hold: float = 0.1
    """Duration for which the success condition must be met [s]."""
    growth: float = 0.12
    """Thickness of the growth on the net [m]."""
    lost: float = 0.8
    """Distance from the line at which it is lost [m]."""
    begin: tuple[float, float] = (-2.6, -2.1)
    """Range of the start's position along the net from its first corner [m]."""
    off: float = 0.4
    """Largest error of the distance from the net at the start [m]."""
    over: float = 0.3
    """Largest vertical distance from the line at the start [m]."""
    turn: float = math.radians(15.0)
    """Largest heading error at the start [rad]."""
    sides: tuple[float, float, float] = (3.0, 2.6, 3.6)
    """Lengths of the net's sides from right to left, in the site `net` [m]."""
    bend: float = math.radians(30.0)
    """Largest angle between neighbouring sides, in either direction [rad]."""
    ahead: tuple[float, float, float] = AHEAD
    reward: NetReward = field(default_factory=NetReward)

    def fitted(self, vehicles: Sequence[Vehicle]) -> "Net":
        """Return the task with the envelope of the vehicle."""
        length, width, height = (0.5 * float(x) for x in vehicles[0].body.size)
        return replace(self, half=(length, width, height))

    @property
    def level(self) -> float:
        """Height z of the line [m]."""
        return self.height - FOOT

    def allocate(self, arrays: TaskArrays, worlds: int, device: wp.Device) -> None:
        """Allocate the net's ends and corners, goal axes: a flat net, until a world or `start` sets them."""
        corners = np.zeros((worlds, len(self.marks), 3), np.float32)
        corners[:, :, 1] = np.cumsum([-self.sides[0], *self.sides])
        arrays.reference.position = wp.array(corners, dtype=wp.vec3, device=device)

    def success_rule(self) -> str:
        """See `Task`."""
        return (
            f"{self.way:g} m along the net, {self.distance:g} m from it to {self.tolerance:g} m in the mean,"
            " without touching or losing it"
        )

    def metrics(self, arrays: TaskArrays) -> dict[str, NDArray[np.float64]]:
        """Return the measures of every task; success, its time [s], distance along the net and mean error of
        the distance from it [m], touched and lost as 0 or 1."""
        measured = super().metrics(arrays)
        measured["error"] /= self.control_step * np.maximum(measured["length"], 1.0)
        return measured

    def terms(self) -> Terms:
        """See `NetReward`."""
        r = self.reward
        return Terms(
            start=start,
            shared={
                "place": place_now,
                "d": distance_now,
                "along": along_speed,
                "e": from_line,
                "theta": misfacing,
            },
            meanings={
                "near": f"1 on the line along the net, 1/e at {r.near_scale:.3g} m from it.",
                "lost": f"More than {self.lost:g} m from the line along the net.",
            },
            rewards=(
                RewardTerm("pace", pace, r.pace),
                RewardTerm("near", near_match, r.near),
                RewardTerm("distance", "e", -r.distance),
                RewardTerm("turn", "theta", -r.turn),
                *action_costs(r.action, r.change, r.rate),
            ),
            ends=(End("touched", touches, -r.loss), End("lost", is_lost, -r.loss)),
            inside=has_inspected,
            totals=(
                Total("way", way_along),
                Total("error", distance_error),
            ),
        )
