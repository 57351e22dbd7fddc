"""What a policy of T1, station keeping, is fed on the robot: the NumPy twin of the training kernel's observation."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from finssim.control.guidance import Guide, goal_at
from finssim.control.policy_description import ObservationEntry, ObservationSchema
from finssim.control.tracking import Measured
from finssim.geometry.rotations import quat_conjugate, quat_inverse_rotate, quat_multiply, quat_to_matrix

__all__ = ["SCHEMA", "observe_t1"]

Array = npt.NDArray[np.float64]

DISTANCE_SCALE = 3.0
"""Distances are divided by this [m]."""
VELOCITY_CLIP = 2.0
"""Velocities are clipped here [m/s, rad/s]."""

_CLIP = (-VELOCITY_CLIP, VELOCITY_CLIP)
SCHEMA = ObservationSchema(
    size=16,
    entries=(
        ObservationEntry(name="goal offset, body frame", indices=(0, 1, 2), unit="m", scale=DISTANCE_SCALE),
        ObservationEntry(
            name="goal rotation relative to the body, first two columns",
            indices=tuple(range(3, 9)),
            unit="1",
        ),
        ObservationEntry(name="linear velocity, body frame", indices=(9, 10, 11), unit="m/s", clip=_CLIP),
        ObservationEntry(name="angular velocity, body frame", indices=(12, 13, 14), unit="rad/s", clip=_CLIP),
        ObservationEntry(
            name="distance to the goal", indices=(15,), unit="m", scale=DISTANCE_SCALE, clip=(-1.0, 1.0)
        ),
    ),
)
"""Layout of the observation, equal to that of `finssim.tasks.StationKeeping`."""


def observe_t1(measured: Measured, guide: Guide, t: float) -> Array:
    """The 16 numbers of `SCHEMA`.

    [R_b' (p* - p) / 3, first two columns of R_b' R*, clip(v, ±2), clip(ω, ±2), min(|p* - p| / 3, 1)]

    Args:
        measured: The vehicle's state.
        guide: Where it should be; its velocity does not enter.
        t: Time since the guide's start [s].

    Returns:
        Observation, (..., 16), for a state of leading batch (...).
    """
    goal, q = goal_at(guide, t), np.asarray(measured.quaternion, float)
    offset = quat_inverse_rotate(q, goal.position - np.asarray(measured.position, float))
    R = quat_to_matrix(quat_multiply(quat_conjugate(q), goal.quaternion))
    nu = np.clip(np.asarray(measured.nu, float), -VELOCITY_CLIP, VELOCITY_CLIP)
    distance = np.linalg.norm(offset, axis=-1, keepdims=True) / DISTANCE_SCALE
    return np.concatenate(
        [offset / DISTANCE_SCALE, R[..., :, 0], R[..., :, 1], nu, np.minimum(distance, 1.0)], axis=-1
    )
