"""What a policy of T2, trajectory tracking, is fed on the robot: the NumPy twin of the training observation."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from finssim.control.guidance import Guide
from finssim.control.policy_description import ObservationEntry, ObservationSchema
from finssim.control.tracking import Measured
from finssim.geometry.rotations import quat_inverse_rotate

__all__ = ["LOOK_AHEAD", "SCHEMA", "observe_t2"]

Array = npt.NDArray[np.float64]

DISTANCE_SCALE = 3.0
"""Distances are divided by this [m]."""
VELOCITY_CLIP = 2.0
"""Velocities are clipped here [m/s, rad/s]."""
LOOK_AHEAD = (0.0, 0.1, 0.2, 0.3)
"""The reference is seen at these times from now [s]."""
REST = 1.0e-6
"""A reference slower than this has no tangent: it is taken to lie ahead [m/s]."""

_CLIP = (-VELOCITY_CLIP, VELOCITY_CLIP)


def _entries() -> tuple[ObservationEntry, ...]:
    ahead = [
        ObservationEntry(
            name=f"reference offset in {time:.1f} s, body frame",
            indices=tuple(range(3 * i, 3 * i + 3)),
            unit="m",
            scale=DISTANCE_SCALE,
        )
        for i, time in enumerate(LOOK_AHEAD)
    ]
    return (
        *ahead,
        ObservationEntry(name="reference velocity, body frame", indices=(12, 13, 14), unit="m/s"),
        ObservationEntry(name="linear velocity, body frame", indices=(15, 16, 17), unit="m/s", clip=_CLIP),
        ObservationEntry(name="angular velocity, body frame", indices=(18, 19, 20), unit="rad/s", clip=_CLIP),
        ObservationEntry(name="world up, body frame", indices=(21, 22, 23), unit="1"),
        ObservationEntry(name="tangent heading in the body, sine and cosine", indices=(24, 25), unit="1"),
        ObservationEntry(
            name="progress, sine and cosine of one and two turns", indices=(26, 27, 28, 29), unit="1"
        ),
    )


SCHEMA = ObservationSchema(size=30, entries=_entries())
"""Layout of the observation, equal to that of `finssim.tasks.TrajectoryTracking`."""


def observe_t2(measured: Measured, guide: Guide, t: npt.ArrayLike) -> Array:
    """The 30 numbers of `SCHEMA`.

    [R_b' (p*(t + k) - p) / 3 for k = 0, 0.1, 0.2, 0.3 s; R_b' v*; clip(v, ±2); clip(ω, ±2); R_b' z;
     sin ψ, cos ψ of the tangent's heading ψ = atan2(v*_y, v*_x) in the body; sin, cos 2πs; sin, cos 4πs]

    Beyond the end the reference is held: v* = 0, and with it ψ = 0, and s = 1.

    Args:
        measured: The vehicle's state.
        guide: Where it should be.
        t: Time since the guide's start [s], one or (...).

    Returns:
        Observation, (..., 30), for a state of leading batch (...).
    """
    q, position = np.asarray(measured.quaternion, float), np.asarray(measured.position, float)
    time = np.asarray(t, float)
    places = [guide.at(time + ahead).position for ahead in LOOK_AHEAD]
    offsets = [quat_inverse_rotate(q, place - position) / DISTANCE_SCALE for place in places]
    reference = guide.at(time)
    drift = quat_inverse_rotate(q, reference.velocity)
    pace = np.hypot(drift[..., 0], drift[..., 1])
    moving = pace > REST
    tangent = [np.where(moving, drift[..., i] / np.where(moving, pace, 1.0), 1.0 - i) for i in (1, 0)]
    turns = 2.0 * math.pi * np.broadcast_to(reference.progress, pace.shape)
    angles = [*tangent, np.sin(turns), np.cos(turns)]
    angles += [np.sin(2.0 * turns), np.cos(2.0 * turns)]
    nu = np.clip(np.asarray(measured.nu, float), -VELOCITY_CLIP, VELOCITY_CLIP)
    up = quat_inverse_rotate(q, np.array([0.0, 0.0, 1.0]))
    return np.concatenate([*offsets, drift, nu, up, np.stack(angles, axis=-1)], axis=-1)
