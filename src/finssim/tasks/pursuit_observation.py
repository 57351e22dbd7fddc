"""What a pursuer sees of itself, of its prey and of its team-mates, all in its body frame."""

from typing import Any

import warp as wp

from finssim.tasks.arrays import TaskArrays
from finssim.tasks.communication import mate_position, mate_velocity
from finssim.tasks.task import ObservationPart
from finssim.tasks.terms import linear_velocity, measured_velocity, turn_rates

DISTANCE_SCALE = 6.0
"""Distances are divided by this [m]."""
REACH = 4.0
"""Scaled distances are clipped here."""
VELOCITY_CLIP = 4.0
"""Velocities are clipped here [m/s, rad/s]."""
PI = 3.14159265


@wp.func
def prey_gap(arrays: TaskArrays, w: int, a: int) -> wp.vec3:
    """From agent a to the vehicle after the agents, body frame [m]."""
    prey = arrays.agent_reward.shape[1]
    return wp.quat_rotate_inv(arrays.quaternion[w, a], arrays.position[w, prey] - arrays.position[w, a])


@wp.func
def prey_motion(arrays: TaskArrays, w: int, a: int) -> wp.vec3:
    """Its velocity less the agent's own, body frame [m/s]."""
    relative = measured_velocity(arrays, w, arrays.agent_reward.shape[1]) - measured_velocity(arrays, w, a)
    return wp.quat_rotate_inv(arrays.quaternion[w, a], relative)


@wp.func
def prey_distance(gap: wp.vec3) -> float:
    """From the agent to the vehicle after the agents [m]."""
    return wp.length(gap)


@wp.func
def prey_bearing(gap: wp.vec3) -> float:
    """Positive to the left [rad]."""
    return wp.atan2(gap[1], gap[0])


@wp.func
def gap_to(arrays: TaskArrays, w: int, a: int, b: int) -> wp.vec3:
    """From agent a to agent b, as far as a has heard, body frame of a [m]."""
    return wp.quat_rotate_inv(arrays.quaternion[w, a], mate_position(arrays, w, a, b) - arrays.position[w, a])


@wp.func
def motion_of(arrays: TaskArrays, w: int, a: int, b: int) -> wp.vec3:
    """Velocity of agent b less that of agent a, as far as a has heard, body frame of a [m/s]."""
    relative = mate_velocity(arrays, w, a, b) - measured_velocity(arrays, w, a)
    return wp.quat_rotate_inv(arrays.quaternion[w, a], relative)


OWN = (
    ObservationPart("linear velocity, body frame", 3, "m/s", clip=VELOCITY_CLIP, term=linear_velocity),
    ObservationPart("angular velocity, body frame", 3, "rad/s", clip=VELOCITY_CLIP, term=turn_rates),
)
"""6 numbers of oneself."""

CHASE = (
    *OWN,
    ObservationPart("prey from here, body frame", 3, "m", DISTANCE_SCALE, REACH, term="gap"),
    ObservationPart(
        "prey's velocity less one's own, body frame", 3, "m/s", clip=VELOCITY_CLIP, term=prey_motion
    ),
    ObservationPart("distance to the prey", 1, "m", DISTANCE_SCALE, REACH, term=prey_distance),
    ObservationPart("bearing of the prey, positive to the left", 1, "rad", PI, 1.0, term=prey_bearing),
)
"""14 numbers of one pursuer, for a task that shares `prey_gap` as `gap`."""


def mate(k: int, gap: Any, motion: Any) -> tuple[ObservationPart, ...]:
    """6 numbers of the k-th team-mate, by the terms that tell where it is and how it moves."""
    moves = "team-mate's velocity less one's own, body frame"
    return (
        ObservationPart("team-mate from here, body frame", 3, "m", DISTANCE_SCALE, REACH, gap, k),
        ObservationPart(moves, 3, "m/s", clip=VELOCITY_CLIP, term=motion, index=k),
    )
