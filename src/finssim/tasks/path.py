"""Path tasks in space, for vehicles that steer by moving: a winding path, and a tour of waypoints."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.control.course import course_speeds
from finssim.control.guidance import Reference
from finssim.control.path_following import Waypoints
from finssim.physics.types import vec6
from finssim.sim import RectangularPool
from finssim.sim.state import State
from finssim.tasks.arrays import PathTable, TaskArrays, allocated
from finssim.tasks.environment import Environment, EnvironmentSetupError
from finssim.tasks.task import Task
from finssim.tasks.terms import (
    End,
    ObservationPart,
    RewardTerm,
    Terms,
    Total,
    action_costs,
    tilted,
    turn_rates,
    world_up,
    world_velocity,
)
from finssim.vehicles import Vehicle

ERROR_SCALE = 3.0
"""Scale of cross-track errors in the observation, multiplied by the factor of the vehicle's speed [m]."""
AHEAD = (0.0, 1.0, 3.0)
"""Preview times at cruising speed of the observed path directions [s]."""
PACE = 1.5
"""Cruising speed of a vehicle for which lengths apply unscaled [m/s]."""


# Position of a vehicle relative to the legs of a path.


@wp.func
def leg_direction(path: PathTable, w: int, k: int) -> wp.vec3:
    """Return the unit vector along a leg, world frame."""
    return wp.normalize(path.points[w, k + 1] - path.points[w, k])


@wp.func
def beside_leg(path: PathTable, w: int, x: wp.vec3) -> wp.vec4:
    """Return the position of a point [m] relative to the current leg, as in `Waypoints.errors`.

    Returns:
        Along-track distance, distance to the left of the leg, distance above it, and remaining distance [m].
    """
    k = path.leg[w]
    e = leg_direction(path, w, k)
    left = wp.normalize(wp.vec3(-e[1], e[0], 0.0))
    off = x - path.points[w, k]
    along = wp.dot(off, e)
    whole = wp.length(path.points[w, k + 1] - path.points[w, k])
    return wp.vec4(along, wp.dot(off, left), wp.dot(off, wp.cross(e, left)), whole - along)


@wp.func
def leg_is_done(path: PathTable, w: int, x: wp.vec3, radius: float) -> bool:
    """Return whether a point [m] is within a radius [m] of the end of the leg, or beyond it."""
    end = path.points[w, path.leg[w] + 1]
    return wp.length(end - x) <= radius or beside_leg(path, w, x)[3] <= 0.0


@wp.func
def change_legs(state: State, arrays: TaskArrays, p: Any, w: int):
    """Switch to the first leg that is not yet done."""
    x = state.position[w, 0]
    for _i in range(4):
        if arrays.path.leg[w] < p.legs - 1 and leg_is_done(arrays.path, w, x, p.fit.size * p.radius):
            arrays.path.leg[w] = arrays.path.leg[w] + 1


# Observations, rewards and totals.


@wp.func
def measured_errors(arrays: TaskArrays, p: Any, w: int) -> wp.vec2:
    """Return the distances to the left of the leg and above it [m], scaled to a vehicle that cruises at `PACE`."""
    found = beside_leg(arrays.path, w, arrays.position[w, 0])
    return wp.vec2(found[1], found[2]) / p.fit.size


@wp.func
def path_direction(arrays: TaskArrays, p: Any, w: int, k: int) -> wp.vec3:
    """Return the direction of the path at the k-th preview time of `AHEAD` at cruising speed, body frame [-]."""
    leg = int(arrays.path.leg[w])
    way = float(p.fit.speed * p.ahead[k] - beside_leg(arrays.path, w, arrays.position[w, 0])[3])
    while way > 0.0 and leg < p.legs - 1:
        leg += 1
        way -= wp.length(arrays.path.points[w, leg + 1] - arrays.path.points[w, leg])
    return wp.quat_rotate_inv(arrays.quaternion[w, 0], leg_direction(arrays.path, w, leg))


@wp.func
def ground_velocity(arrays: TaskArrays, p: Any, w: int) -> wp.vec3:
    """Return the measured velocity as a fraction of cruising speed, body frame."""
    nu = arrays.velocity[w, 0]
    return wp.vec3(nu[0], nu[1], nu[2]) / p.fit.speed


@wp.func
def path_error(state: State, arrays: TaskArrays, p: Any, w: int) -> float:
    """Return the distance to the path [m]."""
    found = beside_leg(arrays.path, w, state.position[w, 0])
    return wp.sqrt(found[1] * found[1] + found[2] * found[2])


@wp.func
def on_path(p: Any, e: float) -> float:
    """Return 1 on the path, 1/e at an error `e` [m] of `reward.track_scale`, scaled to the vehicle's speed."""
    return wp.exp(-e / (p.fit.size * p.reward.track_scale))


@wp.func
def path_advance(state: State, arrays: TaskArrays, p: Any, w: int) -> float:
    """Return the speed along the path as a fraction of cruising speed."""
    e = leg_direction(arrays.path, w, arrays.path.leg[w])
    return wp.dot(world_velocity(state, w, 0), e) / p.fit.speed


@wp.func
def has_finished(state: State, arrays: TaskArrays, p: Any, w: int) -> bool:
    """Return True if the last leg is done."""
    last = arrays.path.leg[w] >= p.legs - 1
    return last and leg_is_done(arrays.path, w, state.position[w, 0], p.fit.size * p.radius)


@wp.func
def has_left(p: Any, e: float) -> bool:
    """Return True if the error `e` [m] exceeds `corridor`, scaled to the vehicle's speed."""
    return e > p.fit.size * p.corridor


@wp.func
def mean_square(arrays: TaskArrays, p: Any, e: float, w: int, was: float) -> float:
    """Return the mean of the squared distance to the path after `settle` [m²]."""
    k = wp.floor((arrays.time[w] - p.settle) / p.control_step + 0.5)
    return wp.where(k >= 1.0, was + (e * e - was) / wp.max(k, 1.0), was)


# The start of an episode.


@wp.func
def winding(arrays: TaskArrays, p: Any, rng: wp.uint32, w: int):
    """Write a path whose curvature and slope change smoothly, with random phases."""
    pi = 3.14159265
    course = float(wp.randf(rng, -pi, pi))
    first = wp.randf(rng, -pi, pi)
    second = wp.randf(rng, -pi, pi)
    third = wp.randf(rng, -pi, pi)
    wave = p.fit.size * wp.randf(rng, p.wave[0], p.wave[1])
    spacing = p.fit.size * p.spacing
    x = wp.vec3(0.0, 0.0, p.fit.size * p.depth)
    for k in range(p.legs + 1):
        arrays.path.points[w, k] = x
        s = 2.0 * pi * float(k) * spacing / wave
        bend = 0.5 * (wp.sin(s + first) + wp.sin(1.7 * s + second))
        course += bend * spacing / (p.fit.size * p.bend_radius)
        slope = p.slope * wp.sin(0.8 * s + third)
        x += spacing * wp.vec3(wp.cos(slope) * wp.cos(course), wp.cos(slope) * wp.sin(course), -wp.sin(slope))


@wp.func
def touring(arrays: TaskArrays, p: Any, rng: wp.uint32, w: int):
    """Write waypoints with random lengths, turns and slopes of the legs."""
    pi = 3.14159265
    course = float(wp.randf(rng, -pi, pi))
    x = wp.vec3(0.0, 0.0, p.fit.size * p.depth)
    for k in range(p.legs + 1):
        arrays.path.points[w, k] = x
        slope = wp.randf(rng, -p.slope, p.slope)
        # Back towards the starting depth, so that the surface is not reached.
        slope = wp.where((x[2] - p.fit.size * p.depth) * slope < 0.0, -slope, slope)
        way = p.fit.size * wp.randf(rng, p.leg[0], p.leg[1])
        x += way * wp.vec3(wp.cos(slope) * wp.cos(course), wp.cos(slope) * wp.sin(course), -wp.sin(slope))
        course += wp.randf(rng, -p.turn, p.turn)


@wp.func
def start_beside(state: State, arrays: TaskArrays, p: Any, rng: wp.uint32, w: int):
    """Place the vehicle near the start of the path, roughly along it, at cruising speed through the water."""
    arrays.path.leg[w] = 0
    e = leg_direction(arrays.path, w, 0)
    away = wp.vec3(wp.randf(rng, -1.0, 1.0), wp.randf(rng, -1.0, 1.0), wp.randf(rng, -1.0, 1.0))
    state.position[w, 0] = arrays.path.points[w, 0] + p.fit.size * p.offset * away
    yaw = wp.atan2(e[1], e[0]) + wp.randf(rng, -p.yaw, p.yaw)
    q = tilted(0.0, 0.0, yaw)
    v = wp.quat_rotate_inv(q, arrays.current[w]) + wp.vec3(p.fit.speed, 0.0, 0.0)
    state.quaternion[w, 0] = q
    state.velocity[w, 0] = vec6(v[0], v[1], v[2], 0.0, 0.0, 0.0)
    arrays.goal_position[w] = arrays.path.points[w, p.legs]
    arrays.goal_quaternion[w] = wp.quat_identity()


@wp.func
def start_path(state: State, arrays: TaskArrays, p: Any, key: int, w: int):
    """Start an episode beside a winding path, unless a path is given."""
    if arrays.path.given[w] == 0:
        winding(arrays, p, wp.rand_init(key, 4 * w), w)
    start_beside(state, arrays, p, wp.rand_init(key, 4 * w + 1), w)


@wp.func
def start_tour(state: State, arrays: TaskArrays, p: Any, key: int, w: int):
    """Start an episode beside the first leg of random waypoints, unless waypoints are given."""
    if arrays.path.given[w] == 0:
        touring(arrays, p, wp.rand_init(key, 4 * w), w)
    start_beside(state, arrays, p, wp.rand_init(key, 4 * w + 1), w)


OBSERVATION = (
    ObservationPart(
        "distances to the left of the path and above it",
        2,
        "m",
        ERROR_SCALE,
        3.0,
        measured_errors,
        errors=(0, 1),
    ),
    *(
        ObservationPart(f"direction of the path in {t:g} s, body frame", 3, "1", term=path_direction, index=k)
        for k, t in enumerate(AHEAD)
    ),
    ObservationPart(
        "velocity over ground by cruising speed, body frame", 3, "1", clip=3.0, term=ground_velocity
    ),
    ObservationPart("angular velocity, body frame", 3, "rad/s", clip=2.0, term=turn_rates),
    ObservationPart("world up, body frame", 3, "1", term=world_up),
)


@dataclass(frozen=True)
class Cruise:
    """Cruising speed of a vehicle, and the resulting scale of lengths."""

    speed: float = PACE
    """[m/s]"""
    size: float = 1.0

    @classmethod
    def of(cls, vehicle: Vehicle) -> "Cruise":
        """Return the middle of the autopilot's speed range, action 0 of mode `course`."""
        speeds = course_speeds(vehicle)
        speed = 0.5 * float(speeds[0] + speeds[-1])
        return cls(speed, speed / PACE)


@dataclass(frozen=True, kw_only=True)
class PathReward:
    """Weights of the reward; each term has one reason.

    r = track · exp(-e / track_scale)            on the path: centimetres count
      - distance · e                             a slope everywhere: return to a distant path
      + advance · (speed along the path)         do not stop: it costs more than an error
      - action · mean(a²) - change · mean(Δa²)   commands that a vehicle can follow, no chatter
      + finish, - loss                           once, at the end of the path, and on leaving it
    """

    track: float = 1.0
    track_scale: float = 0.4
    distance: float = 0.3
    advance: float = 0.5
    action: float = 0.01
    change: float = 0.1
    finish: float = 5.0
    loss: float = 20.0


@dataclass(frozen=True, kw_only=True)
class PathFollowing(Task):
    """Follow a winding path in space, in any current, by autopilot commands.

    Lengths in metres, angles in radians, times in seconds. Lengths apply to a vehicle that cruises at 1.5 m/s, and
    scale with the speed of others.
    """

    succeeds: ClassVar[str] = "finished"
    title: ClassVar[str] = "follow a path in space"
    action: ClassVar[str] = "course_pitch"
    pool: ClassVar[RectangularPool | None] = None
    baselines: ClassVar = {"line-of-sight": "finssim.agents.steering:PathPilot"}
    name: str = "path"
    observation: tuple[ObservationPart, ...] = OBSERVATION
    time_limit: float = 80.0
    fit: Cruise = Cruise()
    """Speed of the vehicle; the environment sets it."""
    ahead: tuple[float, float, float] = AHEAD
    """Preview times of the observed path directions [s]."""
    legs: int = 90
    """Number of legs."""
    spacing: float = 1.0
    """Length of a leg [m]."""
    radius: float = 0.01
    """Distance from the end of a leg at which the leg is done [m]; it is also done beyond its end."""
    wave: tuple[float, float] = (40.0, 80.0)
    """Range of the wavelength of the path's curvature and slope [m]."""
    bend_radius: float = 18.0
    """Least radius of the path's bends [m]."""
    slope: float = math.radians(12.0)
    """Steepest slope of the path [rad]."""
    depth: float = -15.0
    """Height of the start of the path [m]."""
    offset: float = 1.0
    """Largest offset of the vehicle from the start of the path, per axis [m]."""
    yaw: float = math.radians(20.0)
    """Largest angle between the heading and the path at the start [rad]."""
    corridor: float = 2.5
    """Distance from the path beyond which the episode ends [m]."""
    settle: float = 10.0
    """Time from which the error of an episode is measured [s]."""
    tolerance: float = 0.5
    """Greatest error of a success [m]."""
    reward: PathReward = field(default_factory=PathReward)

    begins: ClassVar[Any] = start_path
    """Term of the start."""

    def fitted(self, vehicles: Sequence[Vehicle]) -> "PathFollowing":
        """Return the task for the speed of the vehicle."""
        return replace(self, fit=Cruise.of(vehicles[0]))

    def allocate(self, arrays: TaskArrays, worlds: int, device: wp.Device) -> None:
        """Allocate the path of every world."""
        arrays.path = allocated(PathTable, worlds, device, points=self.legs + 1)

    def straight(self, here: NDArray[np.float64], goal: Reference) -> NDArray[np.float64]:
        """Return the straight path from a position to a goal [m], (2, 3), for a robot that is sent to a station."""
        return np.stack([here, np.asarray(goal.position, float)])

    def success_rule(self) -> str:
        """Return the rule of success; see `Task`."""
        lengths = (self.fit.size * length for length in (self.tolerance, self.corridor))
        return "the end of the path, {:.3g} m from it (RMS), never more than {:.3g} m".format(*lengths)

    def metrics(self, arrays: TaskArrays) -> dict[str, NDArray[np.float64]]:
        """Return the metrics of every task, and the error: RMS distance to the path after `settle` [m].

        The error is nan for an episode that is shorter than that.
        """
        measured = super().metrics(arrays)
        squared = measured.pop("squared_error")
        long = measured["length"] * self.control_step > self.settle + 0.5 * self.control_step
        error = np.where(long, np.sqrt(squared), np.nan)
        good = error <= self.fit.size * self.tolerance
        measured["success"] = np.where(good, measured["success"], 0.0)
        measured["success_time"] = np.where(good, measured["success_time"], np.nan)
        return {**measured, "error": error}

    def terms(self) -> Terms:
        """Return the terms; see `PathReward`."""
        r = self.reward
        return Terms(
            start=self.begins,
            advance=change_legs,
            shared={"e": path_error},
            meanings={"track": f"1 on the path, 1/e at {self.fit.size * r.track_scale:.3g} m from it."},
            rewards=(
                RewardTerm("track", on_path, r.track),
                RewardTerm("distance", "e", -r.distance / self.fit.size),
                RewardTerm("advance", path_advance, r.advance),
                *action_costs(r.action, r.change),
            ),
            ends=(End("finished", has_finished, r.finish), End("left", has_left, -r.loss)),
            totals=(Total("squared_error", mean_square),),
        )


@dataclass(frozen=True, kw_only=True)
class WaypointTour(PathFollowing):
    """Pass a number of waypoints, one after the other, each within the acceptance radius.

    Lengths as for `PathFollowing`.
    """

    title: ClassVar[str] = "pass waypoints one after the other"
    baselines: ClassVar = {"line-of-sight": "finssim.agents.steering:PathPilot"}
    name: str = "waypoints"
    time_limit: float = 100.0
    legs: int = 4
    radius: float = 2.0
    leg: tuple[float, float] = (20.0, 30.0)
    """Range of the length of a leg [m]."""
    turn: float = math.radians(100.0)
    """Largest turn between two legs [rad]."""
    offset: float = 3.0
    yaw: float = math.radians(90.0)
    corridor: float = 15.0
    tolerance: float = 15.0

    begins: ClassVar[Any] = start_tour

    def success_rule(self) -> str:
        """Return the rule of success; see `Task`."""
        return f"every waypoint passed within {self.fit.size * self.radius:.3g} m, or beside it beyond its leg's end"


def follow_path(environment: Environment, paths: Sequence[Waypoints]) -> NDArray[np.float32]:
    """Start an episode in every world beside the first leg of its path; world i follows paths[i] from then on.

    Args:
        environment: Environment of a task along a path, such as `WaypointTour`, with as many legs.
        paths: One per world; the acceptance radius is the task's.

    Returns:
        Observations [-], (worlds, size).

    Raises:
        EnvironmentSetupError: The number of paths, or of their legs, does not fit.
    """
    table = environment.arrays.path
    if len(paths) != environment.worlds or table.points is None:
        raise EnvironmentSetupError(
            f"{len(paths)} paths for {environment.worlds} worlds of task '{environment.task.name}': give one for "
            "each world of a task along a path, such as waypoints"
        )
    legs = environment.task.legs
    if any(path.legs != legs for path in paths):
        counts = ", ".join(map(str, sorted({path.legs for path in paths})))
        raise EnvironmentSetupError(
            f"paths have {counts} legs, expected {legs}: make the task with legs={counts}"
        )
    table.points.assign(np.stack([path.points for path in paths]).astype(np.float32))
    table.given.fill_(1)
    observation: NDArray[np.float32] = environment.reset()
    return observation
