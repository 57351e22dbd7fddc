"""Trajectories to follow: the published ones by name, and anyone's own from a file."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from finssim.control.errors import ControlError
from finssim.control.guidance import Reference
from finssim.control.trajectory_shapes import DEPTH, Motion, circle, ellipse, gerono, helix, polyline
from finssim.geometry.rotations import quat_from_yaw, quat_inverse_rotate, wrap_angle
from finssim.vehicles import Vehicle
from finssim.vehicles.defaults import room

__all__ = [
    "PUBLISHED_LIMITS",
    "TRAJECTORIES",
    "Limits",
    "Trajectory",
    "check_limits",
    "check_vehicle",
    "load_trajectory",
]

Array = npt.NDArray[np.float64]

TANGENT_SPAN = 0.1
"""The tangent is taken across this much time on either side [s], so that it is known at rests and corners too."""

CHECK_STEP = 0.02
"""Limits are checked at times this far apart [s]."""


@dataclass(frozen=True, kw_only=True)
class Trajectory:
    """A wanted motion from 0 to `duration`, held still at its ends before and after."""

    name: str
    duration: float
    """[s]"""
    motion: Motion = field(repr=False)
    """Position and velocity at times within the duration."""
    heading: Literal["fixed", "tangent"] = "fixed"
    """Keep the heading `yaw`, or look along the way (plus `yaw`)."""
    yaw: float = 0.0
    """[rad]"""
    turning: Callable[[Array], Array] | None = field(default=None, repr=False)
    """A heading of its own at times within the duration [rad], in place of a fixed one; `yaw` is added."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.duration) and self.duration > 0.0):
            raise ControlError(
                f"trajectory {self.name}: duration is {self.duration}, expected a positive time"
            )
        if self.heading not in ("fixed", "tangent"):
            raise ControlError(
                f"trajectory {self.name}: heading is '{self.heading}', expected fixed or tangent"
            )

    def at(self, t: npt.ArrayLike) -> Reference:
        """The reference at times since the start [s], (...).

        The velocity is the exact derivative of the position, and zero where the trajectory is held.
        """
        time = np.asarray(t, float)
        inside = np.clip(time, 0.0, self.duration)
        position, velocity = self.motion(inside)
        moving = (time >= 0.0) & (time <= self.duration)
        velocity = np.where(moving[..., None], velocity, 0.0)
        return Reference(position, velocity, self._yaw(inside), inside / self.duration)

    def scaled(self, factor: float) -> Trajectory:
        """The same way in the same time, with lengths, depth and speeds times a factor."""

        def motion(t: Array) -> tuple[Array, Array]:
            position, velocity = self.motion(t)
            return factor * position, factor * velocity

        return self if factor == 1.0 else replace(self, motion=motion)

    def _yaw(self, t: Array) -> Array:
        if self.heading == "fixed":
            turned = 0.0 if self.turning is None else self.turning(t)
            return wrap_angle(np.broadcast_to(turned + self.yaw, np.shape(t)))
        before, after = (
            self.motion(np.clip(t + span, 0.0, self.duration))[0] for span in (-TANGENT_SPAN, TANGENT_SPAN)
        )
        way = after - before
        return wrap_angle(np.arctan2(way[..., 1], way[..., 0]) + self.yaw)


def _catalogue() -> dict[str, Trajectory]:
    left, right = (-1.0, -0.4, DEPTH), (1.0, 0.4, DEPTH)
    corners = [left, right, (1.0, -0.4, DEPTH), (-1.0, 0.4, DEPTH), left]
    motions: dict[str, tuple[float, Motion]] = {
        "straight": (30.0, polyline([left, right], [30.0])),
        "broken": (90.0, polyline(corners, [32.0, 13.0, 32.0, 13.0])),
        "ellipse": (92.70, ellipse(1.0, 0.4, 92.70)),
        "lemniscate": (30.0, gerono(0.4, 0.2, 30.0)),
        "circle": (960.0 / 7.0, circle(0.5, 3.0, 960.0 / 7.0)),
        "figure_eight": (117.0857, gerono(1.0, 0.8, 117.0857)),
        "helix": (80.0, helix(0.4, 2.0, 80.0, -0.6, -0.4)),
    }
    return {
        name: Trajectory(name=name, duration=time, motion=motion) for name, (time, motion) in motions.items()
    }


TRAJECTORIES = _catalogue()
"""The published trajectories, and a helix of ours, by name. Heading 0 throughout: the paper states none."""

PUBLISHED_NAMES = {"straight_pro": "broken"}
"""What the published configuration calls ours."""


def load_trajectory(
    name_or_file: str | Path,
    *,
    heading: Literal["fixed", "tangent"] | None = None,
    yaw: float | None = None,
    vehicle: Vehicle | None = None,
) -> Trajectory:
    """A trajectory by name or from a YAML or CSV file.

    Args:
        name_or_file: Key of `TRAJECTORIES`, or a file as `control.trajectory_file` reads it.
        heading: Keep one heading, or look along the way; as the trajectory has it if None.
        yaw: That heading, or the angle to the way [rad]; as the trajectory has it if None.
        vehicle: Scales a published trajectory by the room that the vehicle needs (1 for FinsROV); one that it cannot
            follow or that leaves its workspace is refused.

    Raises:
        ControlError: No such trajectory, a file that is wrong, or a vehicle that cannot.
    """
    name = PUBLISHED_NAMES.get(str(name_or_file), str(name_or_file))
    if name in TRAJECTORIES:
        trajectory = TRAJECTORIES[name].scaled(1.0 if vehicle is None else room(vehicle.body.size))
    elif Path(name_or_file).is_file():
        from finssim.control.trajectory_file import read_trajectory

        trajectory = read_trajectory(Path(name_or_file))
    else:
        known = ", ".join(TRAJECTORIES)
        raise ControlError(f"no trajectory '{name_or_file}': give a YAML or CSV file or one of {known}")
    if heading is not None:
        trajectory = replace(trajectory, heading=heading)
    if yaw is not None:
        trajectory = replace(trajectory, yaw=yaw)
    if vehicle is not None:
        check_vehicle(trajectory, vehicle)
    return trajectory


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What a trajectory must keep to."""

    speed: float = math.inf
    """[m/s]"""
    acceleration: float = math.inf
    """[m/s²]"""
    lower: tuple[float, float, float] = (-math.inf, -math.inf, -math.inf)
    """Corner of the workspace, world frame [m]."""
    upper: tuple[float, float, float] = (math.inf, math.inf, math.inf)


PUBLISHED_LIMITS = Limits(speed=0.15, acceleration=0.08, lower=(-1.2, -0.7, -0.9), upper=(1.2, 0.7, 0.25))
"""What the published trajectories keep to, on the paper's vehicle."""


def check_limits(trajectory: Trajectory, limits: Limits) -> None:
    """Refuse a trajectory that exceeds limits.

    Raises:
        ControlError: Names the limit, the value and the time at which it is exceeded.
    """
    t, reference = _samples(trajectory)
    speed = np.linalg.norm(reference.velocity, axis=-1)
    change = np.linalg.norm(np.gradient(reference.velocity, t, axis=0), axis=-1)
    for what, values, limit, unit in (
        ("speed", speed, limits.speed, "m/s"),
        ("acceleration", change, limits.acceleration, "m/s²"),
    ):
        i = int(np.argmax(values))
        if values[i] > limit:
            raise ControlError(
                f"trajectory {trajectory.name}: {what} reaches {values[i]:.4g} {unit} at {t[i]:.2f} s, "
                f"expected at most {limit:g}: make it longer or smaller"
            )
    outside = (reference.position < limits.lower) | (reference.position > limits.upper)
    if outside.any():
        i, axis = np.argwhere(outside)[0]
        raise ControlError(
            f"trajectory {trajectory.name}: {'xyz'[axis]} is {reference.position[i, axis]:.4g} m at {t[i]:.2f} s, "
            f"expected {limits.lower[axis]:g} to {limits.upper[axis]:g}: move it into the workspace"
        )


def check_vehicle(trajectory: Trajectory, vehicle: Vehicle) -> None:
    """Refuse a trajectory that leaves a vehicle's workspace or is faster than it can go, axis by axis.

    Raises:
        ControlError: Names what is exceeded and when.
    """
    from finssim.vehicles.capability import terminal_speeds

    safety = vehicle.safety
    lower, upper = (tuple(map(float, x)) for x in (safety.workspace_lower, safety.workspace_upper))
    check_limits(trajectory, Limits(lower=lower, upper=upper))  # type: ignore[arg-type]
    t, reference = _samples(trajectory)
    speed = np.abs(quat_inverse_rotate(quat_from_yaw(reference.yaw), reference.velocity))
    able = terminal_speeds(vehicle)[:3]
    if np.any(speed > able):
        i, axis = np.argwhere(speed > able)[0]
        raise ControlError(
            f"trajectory {trajectory.name}: {('surge', 'sway', 'heave')[axis]} of {speed[i, axis]:.4g} m/s at "
            f"{t[i]:.2f} s, but {vehicle.name} goes {able[axis]:.4g} m/s at most: make it longer or smaller"
        )


def _samples(trajectory: Trajectory) -> tuple[Array, Reference]:
    t = np.linspace(0.0, trajectory.duration, max(3, math.ceil(trajectory.duration / CHECK_STEP) + 1))
    return t, trajectory.at(t)
