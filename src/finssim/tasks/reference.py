"""References to follow: a table of knots per world, filled with the shapes of T2 by a kernel, or from trajectories."""

from collections.abc import Sequence

import numpy as np
import warp as wp

from finssim.control.guidance import Guide, Reference
from finssim.geometry.rotations import quat_from_yaw
from finssim.tasks.arrays import ReferenceTable, allocated
from finssim.tasks.environment import Environment, EnvironmentSetupError

ENDLESS = 1.0e9
"""A guide that takes longer takes this long [s]."""


def reference_table(worlds: int, knots: int, spacing: float, device: wp.Device) -> ReferenceTable:
    """An empty table of `knots` knots, `spacing` apart [s]."""
    table: ReferenceTable = allocated(ReferenceTable, worlds, device, position=knots, velocity=knots)
    table.spacing = spacing
    table.duration.fill_(1.0)
    return table


@wp.func
def reference_knot(r: ReferenceTable, w: int, t: float) -> int:
    """The knot at or before a time."""
    return wp.clamp(int(wp.floor(t / r.spacing)), 0, r.position.shape[1] - 2)


@wp.func
def held_time(r: ReferenceTable, w: int, t: float) -> float:
    """The time, held at the end of the reference and of its table."""
    return wp.min(wp.min(t, r.duration[w]), float(r.position.shape[1] - 1) * r.spacing)


@wp.func
def reference_position(r: ReferenceTable, w: int, t: float) -> wp.vec3:
    """Where the vehicle should be at a time since the episode's start, world frame [m]."""
    now = held_time(r, w, t)
    k = reference_knot(r, w, now)
    u = now / r.spacing - float(k)
    way = r.position[w, k + 1] - r.position[w, k]
    a = r.spacing * r.velocity[w, k]
    b = r.spacing * r.velocity[w, k + 1]
    return r.position[w, k] + u * (a + u * (3.0 * way - 2.0 * a - b + u * (a + b - 2.0 * way)))


@wp.func
def reference_velocity(r: ReferenceTable, w: int, t: float) -> wp.vec3:
    """Velocity of `reference_position`, zero where it is held [m/s]."""
    now = held_time(r, w, t)
    if now < t:
        return wp.vec3()
    k = reference_knot(r, w, now)
    u = now / r.spacing - float(k)
    way = r.position[w, k + 1] - r.position[w, k]
    a = r.spacing * r.velocity[w, k]
    b = r.spacing * r.velocity[w, k + 1]
    return (a + u * (6.0 * way - 4.0 * a - 2.0 * b + 3.0 * u * (a + b - 2.0 * way))) / r.spacing


@wp.func
def reference_progress(r: ReferenceTable, w: int, t: float) -> float:
    """Part of the way, from `offset` to `offset + 1`."""
    return r.offset[w] + wp.min(t / r.duration[w], 1.0)


def follow(environment: Environment, guides: Sequence[Guide]) -> np.ndarray:
    """Start an episode in every world at rest on its guide's first pose; world i follows guides[i] from then on.

    Args:
        environment: Of a task that follows references, such as `TrajectoryTracking`.
        guides: One per world.

    Returns:
        Observations, (worlds, size).

    Raises:
        EnvironmentSetupError: Another number of guides, or one that is longer than the task's `time_limit`.
    """
    table = environment.arrays.reference
    if len(guides) != environment.worlds or table.position is None:
        raise EnvironmentSetupError(
            f"{len(guides)} guides for {environment.worlds} worlds of task '{environment.task.name}': "
            "give one for each world of a task that follows references, such as t2"
        )
    longest = max(guide.duration for guide in guides)
    if longest > environment.task.time_limit:
        raise EnvironmentSetupError(
            f"a guide takes {longest:g} s, longer than the task's time_limit of {environment.task.time_limit:g} s: "
            "make the task with a longer one"
        )
    places = fill_table(table, guides)
    position, yaw = (np.stack([getattr(place, name)[0] for place in places]) for name in ("position", "yaw"))
    q = quat_from_yaw(yaw)
    return environment.start(position, q, position, q)


def fill_table(table: ReferenceTable, guides: Sequence[Guide]) -> list[Reference]:
    """Give world i the motion of guides[i]; a station has no end, and no progress.

    Returns:
        Each guide at the times of the knots, held at its end.
    """
    t = table.spacing * np.arange(table.position.shape[1])
    ends = [np.minimum(t, guide.duration) for guide in guides]
    places = [guide.at(time) for guide, time in zip(guides, ends, strict=True)]
    velocity = np.stack([place.velocity for place in places])
    # Past its end a motion goes on in the table, so that the piece with the end in it is followed; none reads further.
    beyond = (t - np.stack(ends))[..., None] * velocity
    table.position.assign((np.stack([place.position for place in places]) + beyond).astype(np.float32))
    table.velocity.assign(velocity.astype(np.float32))
    table.duration.assign(np.array([min(guide.duration, ENDLESS) for guide in guides], np.float32))
    table.offset.zero_()
    table.given.fill_(1)
    return places


# The shapes that T2 trains on, drawn anew for every episode inside the kernels: line, circle, lemniscate, helix.


SHAPE_NAMES = ("line", "circle", "lemniscate", "helix")
"""By the number that the kernels use."""

SPEED_SAMPLES = 96
"""Phases at which the greatest slope of a shape is looked for, as published."""


@wp.func
def shape_point(kind: int, phase: float, lift: float) -> wp.vec3:
    """Point of a shape of unit scale at a phase; `lift` is the height of its tilt [1]."""
    s = wp.sin(phase)
    c = wp.cos(phase)
    d = 1.0 + s * s
    if kind == 0:
        return wp.vec3(s, 0.0, lift * s)
    if kind == 1:
        return wp.vec3(c, s, lift * s)
    if kind == 2:  # Bernoulli's
        return wp.vec3(c / d, s * c / d, lift * s)
    return wp.vec3(c, s, phase / 6.2831853)


@wp.func
def shape_slope(kind: int, phase: float, lift: float) -> wp.vec3:
    """Derivative of `shape_point` by the phase."""
    s = wp.sin(phase)
    c = wp.cos(phase)
    d = 1.0 + s * s
    if kind == 0:
        return wp.vec3(c, 0.0, lift * c)
    if kind == 1:
        return wp.vec3(-s, c, lift * c)
    if kind == 2:
        return wp.vec3(-s * (3.0 - s * s) / (d * d), (1.0 - 3.0 * s * s) / (d * d), lift * c)
    return wp.vec3(-s, c, 1.0 / 6.2831853)


@wp.func
def greatest_rate(kind: int, lift: float, scale: wp.vec3, limit: wp.vec3) -> float:
    """Phase rate at which the first axis reaches its speed limit [rad/s]."""
    steepest = wp.vec3()
    for i in range(SPEED_SAMPLES):
        slope = shape_slope(kind, 6.2831853 * float(i) / float(SPEED_SAMPLES), lift)
        steepest = wp.max(
            steepest, wp.cw_mul(scale, wp.vec3(wp.abs(slope[0]), wp.abs(slope[1]), wp.abs(slope[2])))
        )
    rate = float(1.0e6)
    for axis in range(3):
        if steepest[axis] > 0.0:
            rate = wp.min(rate, limit[axis] / steepest[axis])
    return rate


@wp.func
def fill_reference(
    r: ReferenceTable,
    w: int,
    kind: int,
    lift: float,
    scale: wp.vec3,
    origin: wp.vec3,
    phase: float,
    rate: float,
):
    """Write the knots of a shape that is run through at a constant phase rate [rad/s] from `phase` [rad] on."""
    for k in range(r.position.shape[1]):
        angle = rate * r.spacing * float(k)
        if kind == 3:  # its height counts from the start
            lifted = shape_point(kind, phase + angle, lift)
            lifted[2] = angle / 6.2831853
            r.position[w, k] = origin + wp.cw_mul(scale, lifted)
        else:
            r.position[w, k] = origin + wp.cw_mul(scale, shape_point(kind, phase + angle, lift))
        r.velocity[w, k] = rate * wp.cw_mul(scale, shape_slope(kind, phase + angle, lift))
    r.duration[w] = 6.2831853 / wp.abs(rate)
    r.offset[w] = phase / 6.2831853
    r.given[w] = 0
