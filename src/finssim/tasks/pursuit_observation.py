"""What a pursuer sees of itself and of its prey: 14 numbers, all in its body frame."""

import warp as wp

from finssim.tasks.arrays import TaskArrays
from finssim.tasks.communication import mate_position, mate_velocity, measured_velocity
from finssim.tasks.task import ObservationPart

DISTANCE_SCALE = 6.0
"""Distances are divided by this [m]."""
REACH = 4.0
"""Scaled distances are clipped here."""
VELOCITY_CLIP = 4.0
"""Velocities are clipped here [m/s, rad/s]."""
PI = 3.14159265

CHASE = (
    ObservationPart("linear velocity, body frame", 3, "m/s", clip=VELOCITY_CLIP),
    ObservationPart("angular velocity, body frame", 3, "rad/s", clip=VELOCITY_CLIP),
    ObservationPart("prey from here, body frame", 3, "m", scale=DISTANCE_SCALE, clip=REACH),
    ObservationPart("prey's velocity less one's own, body frame", 3, "m/s", clip=VELOCITY_CLIP),
    ObservationPart("distance to the prey", 1, "m", scale=DISTANCE_SCALE, clip=REACH),
    ObservationPart("bearing of the prey, positive to the left", 1, "rad", scale=PI, clip=1.0),
)
"""14 numbers of one pursuer."""

MATE = (
    ObservationPart("team-mate's role: herder, netter", 2, "1"),
    ObservationPart("team-mate from here, body frame", 3, "m", scale=DISTANCE_SCALE, clip=REACH),
    ObservationPart("team-mate's velocity less one's own, body frame", 3, "m/s", clip=VELOCITY_CLIP),
)
"""8 numbers of each team-mate."""


@wp.func
def write_scaled(arrays: TaskArrays, w: int, at: int, x: wp.vec3, scale: float, clip: float):
    """Three numbers of the observation from number `at` on."""
    for i in range(3):
        arrays.observation[w, at + i] = wp.clamp(x[i] / scale, -clip, clip)


@wp.func
def write_own_velocity(arrays: TaskArrays, w: int, a: int, at: int):
    """Six numbers: the measured velocity of agent a, body frame."""
    nu = arrays.velocity[w, a]
    for i in range(6):
        arrays.observation[w, at + i] = wp.clamp(nu[i], -VELOCITY_CLIP, VELOCITY_CLIP)


@wp.func
def write_chase(arrays: TaskArrays, w: int, a: int, prey: int, at: int):
    """The 14 numbers of `CHASE` for agent a, from number `at` of the row on."""
    q = arrays.quaternion[w, a]
    gap = wp.quat_rotate_inv(q, arrays.position[w, prey] - arrays.position[w, a])
    relative = wp.quat_rotate_inv(q, measured_velocity(arrays, w, prey) - measured_velocity(arrays, w, a))
    write_own_velocity(arrays, w, a, at)
    write_scaled(arrays, w, at + 6, gap, DISTANCE_SCALE, REACH)
    write_scaled(arrays, w, at + 9, relative, 1.0, VELOCITY_CLIP)
    arrays.observation[w, at + 12] = wp.min(wp.length(gap) / DISTANCE_SCALE, REACH)
    arrays.observation[w, at + 13] = wp.atan2(gap[1], gap[0]) / PI


@wp.func
def write_mate(arrays: TaskArrays, w: int, a: int, b: int, at: int):
    """Six numbers: where agent b is from agent a, and how it moves, as far as agent a has heard; body frame of a."""
    q = arrays.quaternion[w, a]
    gap = wp.quat_rotate_inv(q, mate_position(arrays, w, a, b) - arrays.position[w, a])
    relative = wp.quat_rotate_inv(q, mate_velocity(arrays, w, a, b) - measured_velocity(arrays, w, a))
    write_scaled(arrays, w, at, gap, DISTANCE_SCALE, REACH)
    write_scaled(arrays, w, at + 3, relative, 1.0, VELOCITY_CLIP)
