"""Following a pipeline by camera: along it, at a set height above it, around unknown bends."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.extensions.perception.description import load_world
from finssim.extensions.perception.seeing import SeeingTask
from finssim.sim.state import State
from finssim.tasks.arrays import TaskArrays
from finssim.tasks.docking import HullNumbers
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

AHEAD = (0.0, 1.2, 2.5)
"""Distances ahead along the pipe at which the teacher observes it [m]."""


@wp.func
def beside(arrays: TaskArrays, w: int, x: wp.vec3) -> wp.vec4:
    """Return the position of a point relative to the pipe: along it, to the left of it, above its axis [m], and the
    pipe's heading [rad].

    In the axes of the pipeline, whose pose is the goal's.
    """
    local = wp.quat_rotate_inv(arrays.goal_quaternion[w], x - arrays.goal_position[w])
    best = float(1.0e9)
    before = float(0.0)
    found = wp.vec4(0.0)
    for k in range(arrays.reference.position.shape[1] - 1):
        a = arrays.reference.position[w, k]
        d = arrays.reference.position[w, k + 1] - a
        length = wp.length(d)
        t = wp.clamp(wp.dot(local - a, d) / (length * length), 0.0, 1.0)
        r = local - a - t * d
        distance = wp.length(wp.vec2(r[0], r[1]))
        if distance < best:
            best = distance
            left = (d[0] * r[1] - d[1] * r[0]) / length
            found = wp.vec4(
                before + t * length, wp.where(left < 0.0, -distance, distance), r[2], wp.atan2(d[1], d[0])
            )
        before += length
    return found


@wp.func
def along_pipe(arrays: TaskArrays, w: int, way: float) -> wp.vec3:
    """Return the point of the pipe's axis at a distance `way` along it [m], in the axes of the pipeline."""
    rest = float(way)
    last = arrays.reference.position.shape[1] - 1
    out = arrays.reference.position[w, last]
    for k in range(last):
        a = arrays.reference.position[w, k]
        d = arrays.reference.position[w, k + 1] - a
        length = wp.length(d)
        if rest >= 0.0 and rest < length:
            out = a + (rest / length) * d
        rest -= length
    return out


@wp.func
def way_ahead(arrays: TaskArrays, p: Any, w: int, k: int, place: wp.vec4) -> wp.vec3:
    """Return the vector to the point above the pipe that is `ahead[k]` farther along it than the vehicle,
    body frame [m]."""
    point = along_pipe(arrays, w, place[0] + p.ahead[k]) + wp.vec3(0.0, 0.0, p.height)
    world = arrays.goal_position[w] + wp.quat_rotate(arrays.goal_quaternion[w], point)
    return wp.quat_rotate_inv(arrays.quaternion[w, 0], world - arrays.position[w, 0])


@wp.func
def heading_off(state: State, arrays: TaskArrays, w: int, place: wp.vec4) -> float:
    """Return the angle between the vehicle and the pipe [rad], in [0, π]."""
    q = wp.quat_inverse(arrays.goal_quaternion[w]) * state.quaternion[w, 0]
    nose = wp.quat_rotate(q, wp.vec3(1.0, 0.0, 0.0))
    off = wp.atan2(nose[1], nose[0]) - place[3]
    return wp.abs(wp.atan2(wp.sin(off), wp.cos(off)))


@wp.func
def progress(state: State, arrays: TaskArrays, p: Any, w: int, place: wp.vec4) -> float:
    """Return the speed along the pipe as a fraction of `cruise`, at most 1."""
    v = wp.quat_rotate_inv(arrays.goal_quaternion[w], world_velocity(state, w, 0))
    return wp.clamp((v[0] * wp.cos(place[3]) + v[1] * wp.sin(place[3])) / p.cruise, -1.0, 1.0)


@wp.func
def from_line(p: Any, place: wp.vec4) -> float:
    """Return the distance from the line above the pipe [m].

    The position `place` is that of `beside`, in its units.
    """
    return wp.length(wp.vec2(place[1], place[2] - p.height))


@wp.func
def is_lost(p: Any, place: wp.vec4) -> bool:
    """Return whether the line is lost sideways or vertically; the position `place` is that of `beside`, in
    its units."""
    return wp.abs(place[1]) > p.lost[0] or wp.abs(place[2] - p.height) > p.lost[1]


@wp.func
def along_now(place: wp.vec4) -> float:
    """Return the vehicle's position along the pipe [m]."""
    return place[0]


@wp.func
def worst(was: float, e: float) -> float:
    """Return the greatest distance from the line so far [m]."""
    return wp.max(was, e)


@wp.func
def has_followed(p: Any, place: wp.vec4, begun: float) -> bool:
    """Return whether the vehicle is `distance` farther along the pipe than at the start of the episode [m]."""
    return place[0] - begun >= p.distance


@wp.func
def start(state: State, arrays: TaskArrays, p: Any, key: int, w: int):
    """Start at rest above the pipe, off the line and slightly turned; without a world the pipe's heading is drawn."""
    rng = wp.rand_init(key, w)
    yaw = wp.randf(rng, -3.14159265, 3.14159265)
    if not p.placed:
        arrays.goal_position[w] = wp.vec3(0.0, 0.0, p.bottom)
        arrays.goal_quaternion[w] = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), yaw)
    q = arrays.goal_quaternion[w]
    point = along_pipe(arrays, w, wp.randf(rng, p.begin[0], p.begin[1]))
    here = beside(arrays, w, arrays.goal_position[w] + wp.quat_rotate(q, point))
    off = wp.vec3(0.0, wp.randf(rng, -p.aside, p.aside), p.height + wp.randf(rng, -p.over, p.over))
    turn = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), here[3])
    x = arrays.goal_position[w] + wp.quat_rotate(q, point + wp.quat_rotate(turn, off))
    place_tilted(state, w, x, q * turn, rng, p.tilt, p.turn)


@dataclass(frozen=True, kw_only=True)
class PipelineReward:
    """Weights of the reward, with e the distance from the line above the pipe [m] and θ the heading error [rad].

    r = progress · min(speed along / cruise, 1) + near · exp(-e / near_scale) - distance · e - turn · θ
        - action · mean(a²) - change · mean(Δa²) - rate · min(|ω|², 4) - loss (once, if the pipe is lost)
    """

    progress: float = 1.0
    near: float = 0.5
    near_scale: float = 0.25
    distance: float = 0.5
    turn: float = 0.3
    action: float = 0.02
    change: float = 0.05
    rate: float = 0.02
    loss: float = 20.0


@dataclass(frozen=True, kw_only=True)
class Pipeline(SeeingTask):
    """Follow the pipeline of the site `pipeline`, whose position, appearance and light differ in each episode."""

    succeeds: ClassVar[str] = "once"
    fails: ClassVar[tuple[str, ...]] = ("lost",)
    title: ClassVar[str] = "follow a pipeline by camera"
    needs: ClassVar[tuple[str, ...]] = ("surge", "heave", "yaw")
    action: ClassVar[str] = "wrench4"
    landmark: ClassVar[str] = "line"
    teacher: ClassVar[tuple[ObservationPart, ...]] = (
        *(
            ObservationPart(
                f"way to the line above the pipe {x:g} m ahead, body frame",
                3,
                "m",
                scale=2.0,
                term=way_ahead,
                index=k,
            )
            for k, x in enumerate(AHEAD)
        ),
        ObservationPart("up, body frame", 3, "1", term=world_up),
        *own_velocity(clip=2.0),
    )
    baselines: ClassVar = {"line-follower": "finssim.extensions.perception.servos:LineFollower"}
    name: str = "pipeline"
    world: str = "pipeline"
    time_limit: float = 45.0
    """Length of an episode [s]."""
    hull: HullNumbers = HullNumbers()
    """Hull of the vehicle, set by the environment."""
    height: float = 0.9
    """Height of the body origin above the pipe's axis [m]."""
    distance: float = 8.0
    """Success: distance along the pipe from the start of the episode, without losing it [m]."""
    hold: float = 0.1
    """Duration for which the success condition must be met [s]."""
    lost: tuple[float, float] = (1.2, 0.7)
    """Horizontal and vertical distance from the line at which the pipe is lost [m]."""
    begin: tuple[float, float] = (2.0, 18.0)
    """Range of the start's position along the pipe [m]."""
    aside: float = 0.5
    """Largest lateral distance from the pipe at the start [m]."""
    over: float = 0.2
    """Largest vertical distance from the line at the start [m]."""
    turn: float = math.radians(20.0)
    """Largest heading error at the start [rad]."""
    ahead: tuple[float, float, float] = AHEAD
    """Distances ahead along the pipe at which the teacher observes it [m]."""
    reward: PipelineReward = field(default_factory=PipelineReward)

    def fitted(self, vehicles: Sequence[Vehicle]) -> "Pipeline":
        """Return the task with the speed of the vehicle."""
        return replace(self, hull=HullNumbers.of(vehicles[0]))

    @property
    def cruise(self) -> float:
        """Return the speed along the pipe at which the progress reward is full [m/s]."""
        return 0.6 * self.hull.speed

    @property
    def bottom(self) -> float:
        """Height z of the pipe without a world [m]."""
        return -11.86

    def allocate(self, arrays: TaskArrays, worlds: int, device: wp.Device) -> None:
        """Set the pipe's axis as a line of points, from the objects `pipe_...` of the site."""
        pipes = [item for name, item in load_world("pipeline").objects.items() if name.startswith("pipe_")]
        halves = [
            0.5 * (one.length or 0.0) * np.asarray(one.axis) / np.linalg.norm(one.axis) for one in pipes
        ]
        knots = [one.position - half for one, half in zip(pipes, halves, strict=True)]
        points = np.float32([*knots, pipes[-1].position + halves[-1]])
        arrays.reference.position = wp.array(np.tile(points, (worlds, 1, 1)), dtype=wp.vec3, device=device)

    def success_rule(self) -> str:
        """See `Task`."""
        return f"{self.distance:g} m along the pipe without losing it"

    def metrics(self, arrays: TaskArrays) -> dict[str, NDArray[np.float64]]:
        """Return the measures of every task; success, its time [s], worst (distance from the line [m]), lost
        as 0 or 1."""
        measured = super().metrics(arrays)
        del measured["begun"]
        return measured

    def terms(self) -> Terms:
        """See `PipelineReward`."""
        r = self.reward
        return Terms(
            start=start,
            shared={
                "place": place_now,
                "e": from_line,
                "theta": heading_off,
            },
            seen={"place": place_seen},
            meanings={
                "near": f"1 on the line above the pipe, 1/e at {r.near_scale:.3g} m from it.",
                "begun": "How far along the pipe the episode began [m].",
                "lost": f"More than {self.lost[0]:g} m to a side of the line, or {self.lost[1]:g} m above or below it.",
            },
            rewards=(
                RewardTerm("progress", progress, r.progress),
                RewardTerm("near", near_match, r.near),
                RewardTerm("distance", "e", -r.distance),
                RewardTerm("turn", "theta", -r.turn),
                *action_costs(r.action, r.change, r.rate),
            ),
            ends=(End("lost", is_lost, -r.loss),),
            inside=has_followed,
            totals=(Total("begun", "was", first=along_now), Total("worst", worst)),
        )


@wp.func
def place_now(state: State, arrays: TaskArrays, w: int) -> wp.vec4:
    """Return `beside` of the vehicle, in its units."""
    return beside(arrays, w, state.position[w, 0])


@wp.func
def place_seen(arrays: TaskArrays, w: int) -> wp.vec4:
    """Return `beside` of the vehicle, as measured, in its units."""
    return beside(arrays, w, arrays.position[w, 0])
