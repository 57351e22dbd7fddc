"""Passing a gate by camera: between its posts and below its bar, from the front, without touching them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import warp as wp

from finssim.extensions.perception.seeing import SeeingTask
from finssim.physics.solids import box_distance
from finssim.sim.state import State
from finssim.tasks.arrays import TaskArrays
from finssim.tasks.docking import HullNumbers
from finssim.tasks.terms import (
    End,
    ObservationPart,
    RewardTerm,
    Terms,
    action_costs,
    attitude_error,
    goal_columns,
    goal_offset,
    own_velocity,
    place_tilted,
    world_velocity,
)
from finssim.vehicles import Vehicle

HALF, BAR = wp.constant(0.75), wp.constant(0.045)
"""Half the width and height of the gates of the site `gate`, and the radius of their bars [m]."""


@wp.func
def in_gate(state: State, arrays: TaskArrays, w: int) -> wp.vec3:
    """Return the position of the body origin relative to the gate's middle, gate axes: x through it, z up [m]."""
    return wp.quat_rotate_inv(arrays.goal_quaternion[w], state.position[w, 0] - arrays.goal_position[w])


@wp.func
def from_bar(a: wp.vec3, b: wp.vec3, half: wp.vec3) -> float:
    """Return the distance between a box and a straight bar [m].

    The box's signed distance is convex along the bar: its minimum is found by ternary search.

    Args:
        a: One end of the bar, box axes [m].
        b: Other end of the bar, box axes [m].
        half: Half extents of the box [m].
    """
    low = float(0.0)
    high = float(1.0)
    best = float(1.0e9)
    for _ in range(20):
        s = low + (high - low) / 3.0
        t = high - (high - low) / 3.0
        near = box_distance(a + s * (b - a), half)[3]
        far = box_distance(a + t * (b - a), half)[3]
        best = wp.min(best, wp.min(near, far))
        if near < far:
            high = t
        else:
            low = s
    return best - BAR


@wp.func
def clearance(state: State, arrays: TaskArrays, p: Any, w: int, place: wp.vec3) -> float:
    """Return the distance between the vehicle's envelope and the nearest bar [m]; negative if it touches."""
    q = wp.quat_inverse(arrays.goal_quaternion[w]) * state.quaternion[w, 0]
    foot = wp.quat_rotate_inv(q, wp.vec3(0.0, HALF, -HALF) - place)
    port_top = wp.quat_rotate_inv(q, wp.vec3(0.0, HALF, HALF) - place)
    right = wp.quat_rotate_inv(q, wp.vec3(0.0, -HALF, HALF) - place)
    other = wp.quat_rotate_inv(q, wp.vec3(0.0, -HALF, -HALF) - place)
    posts = wp.min(from_bar(foot, port_top, p.half), from_bar(other, right, p.half))
    return wp.min(posts, from_bar(port_top, right, p.half))


@wp.func
def approach(state: State, arrays: TaskArrays, p: Any, w: int, place: wp.vec3) -> float:
    """Return the speed towards a point behind the gate's middle as a fraction of `cruise`, at most 1."""
    v = wp.quat_rotate_inv(arrays.goal_quaternion[w], world_velocity(state, w, 0))
    way = wp.normalize(wp.vec3(p.behind + 0.5, 0.0, 0.0) - place)
    return wp.clamp(wp.dot(v, way) / p.cruise, -1.0, 1.0)


@wp.func
def off_axis(p: Any, place: wp.vec3) -> float:
    """Return the distance of the vehicle outside the cone that leads to the gate's middle [m]."""
    return wp.max(wp.length(wp.vec2(place[1], place[2])) - 0.1 - 0.4 * wp.max(-place[0], 0.0), 0.0)


@wp.func
def near_bar(p: Any, room: float) -> float:
    """Return 1 if a bar is touched, falling to 0 at `near_scale` [m] from the nearest one."""
    return wp.max(1.0 - room / p.reward.near_scale, 0.0)


@wp.func
def touches(room: float) -> bool:
    """Return whether the vehicle's envelope touches a bar, from the clearance `room` [m]."""
    return room < 0.0


@wp.func
def misses(place: wp.vec3) -> bool:
    """Return whether the body origin, at `place` in gate axes [m], passed the gate's plane outside the gate."""
    return place[0] >= 0.0 and not wp.max(wp.abs(place[1]), wp.abs(place[2])) < HALF


@wp.func
def passes(p: Any, place: wp.vec3) -> bool:
    """Return whether the body origin is at least `behind` past the gate; `place` is in gate axes [m]."""
    return place[0] >= p.behind


@wp.func
def is_lost(state: State, arrays: TaskArrays, p: Any, w: int, place: wp.vec3) -> bool:
    """Return whether the vehicle is within half a length of surface or floor, or too far from the gate.

    `place` is in [m].
    """
    z = state.position[w, 0][2]
    margin = 0.5 * p.hull.length
    return z > -margin or z < margin - p.depth or wp.length(place) > p.begin[1] + 2.5


@wp.func
def start(state: State, arrays: TaskArrays, p: Any, key: int, w: int):
    """Start at rest in front of the gate, off its axis and slightly turned; without a world the gate's pose
    is drawn."""
    rng = wp.rand_init(key, w)
    yaw = wp.randf(rng, -3.14159265, 3.14159265)
    z = wp.randf(rng, -0.625 * p.depth, -0.4375 * p.depth)
    if not p.placed:
        arrays.goal_position[w] = wp.vec3(0.0, 0.0, z)
        arrays.goal_quaternion[w] = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), yaw)
    q = arrays.goal_quaternion[w]
    way = wp.randf(rng, p.begin[0], p.begin[1])
    off = wp.vec3(-way, way * wp.randf(rng, -p.aside, p.aside), wp.randf(rng, -p.over, p.over))
    x = arrays.goal_position[w] + wp.quat_rotate(q, off)
    place_tilted(state, w, x, q, rng, p.tilt, p.turn)


@dataclass(frozen=True, kw_only=True)
class GateReward:
    """Weights of the reward; d: distance outside the cone in front of the gate [m], θ: attitude error [rad].

    r = progress · min(speed towards a point behind the gate / cruise, 1) - corridor · d - turn · θ
        - near · max(1 - clearance / near_scale, 0) - action · mean(a²) - change · mean(Δa²) - rate · min(|ω|², 4)
        + passed (once, behind the gate) - loss (once, if a bar is touched, the gate missed or the vehicle lost)
    """

    progress: float = 1.0
    corridor: float = 1.0
    turn: float = 0.3
    near: float = 1.0
    near_scale: float = 0.2
    action: float = 0.02
    change: float = 0.05
    rate: float = 0.02
    passed: float = 10.0
    loss: float = 20.0


@dataclass(frozen=True, kw_only=True)
class Gate(SeeingTask):
    """Pass the nearer gate of the site `gate`, whose pose, appearance and light differ in each episode.

    Touching a bar with the vehicle's envelope ends the episode, so no contact force is computed.
    """

    succeeds: ClassVar[str] = "passed"
    title: ClassVar[str] = "pass a gate by camera"
    landmark: ClassVar[str] = "near"
    teacher: ClassVar[tuple[ObservationPart, ...]] = (
        ObservationPart("way to the gate's middle, body frame", 3, "m", scale=3.0, term=goal_offset),
        ObservationPart("gate rotation relative to the body, first two columns", 6, "1", term=goal_columns),
        *own_velocity(clip=2.0),
    )
    baselines: ClassVar = {"post-servo": "finssim.extensions.perception.servos:PostServo"}
    name: str = "gate"
    world: str = "gate"
    time_limit: float = 25.0
    """Length of an episode [s]."""
    hull: HullNumbers = HullNumbers()
    """Hull of the vehicle, set by the environment."""
    half: tuple[float, float, float] = (0.28, 0.19, 0.15)
    """Half extents of the vehicle's envelope about the body origin, as in contacts [m]."""
    depth: float = 3.2
    """Depth of the water [m]."""
    begin: tuple[float, float] = (2.0, 4.0)
    """Range of the distance in front of the gate at the start [m]."""
    aside: float = 0.3
    """Largest lateral offset from the gate's axis at the start, relative to the distance [-]."""
    over: float = 0.3
    """Largest vertical offset from the gate's axis at the start [m]."""
    turn: float = math.radians(15.0)
    """Largest heading error at the start [rad]."""
    reward: GateReward = field(default_factory=GateReward)

    def fitted(self, vehicles: Sequence[Vehicle]) -> "Gate":
        """Return the task with the envelope of the vehicle."""
        length, width, height = (0.5 * float(x) for x in vehicles[0].body.size)
        return replace(self, hull=HullNumbers.of(vehicles[0]), half=(length, width, height))

    @property
    def cruise(self) -> float:
        """Return the speed towards the gate at which the progress reward is full [m/s]."""
        return 0.6 * self.hull.speed

    @property
    def behind(self) -> float:
        """Distance of the body origin behind the gate at which it is passed [m]."""
        return 0.5 * self.hull.length

    def success_rule(self) -> str:
        """See `Task`."""
        return f"through the gate from the front within {self.time_limit:g} s, touching no bar"

    def terms(self) -> Terms:
        """See `GateReward`."""
        r = self.reward
        return Terms(
            start=start,
            shared={"place": in_gate, "room": clearance, "theta": attitude_error},
            meanings={
                "near": f"1 where a bar is touched, falling to 0 at {r.near_scale:g} m from the nearest one.",
                "passed": f"Through the gate: the body origin is {self.behind:.3g} m behind it.",
            },
            rewards=(
                RewardTerm("progress", approach, r.progress),
                RewardTerm("corridor", off_axis, -r.corridor),
                RewardTerm("turn", "theta", -r.turn),
                RewardTerm("near", near_bar, -r.near),
                *action_costs(r.action, r.change, r.rate),
            ),
            ends=(
                End("touched", touches, -r.loss),
                End("missed", misses, -r.loss),
                End("passed", passes, r.passed),
                End("lost", is_lost, -r.loss),
            ),
        )
