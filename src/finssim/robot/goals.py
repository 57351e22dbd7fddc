"""Goals of a vehicle as text, a file or a name: a station to keep or a trajectory to follow."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt

from finssim.control import ControlError
from finssim.control.guidance import Guide, Reference, Station, Track
from finssim.core.rotations import quat_rotate, quat_yaw
from finssim.core.yaml_file import read_mapping
from finssim.vehicles import Vehicle


class GoalError(ValueError):
    """A goal cannot be read, or the vehicle may not go there."""


AHEAD = 2.0
"""Longest time for which a goal continues its motion without messages before it stops [s]."""


class HeardGoal:
    """A moving goal from messages; between them it continues its motion, for at most `AHEAD`.

    Attributes:
        started: Start of the guide's time, on the clock of the tracks [s].
    """

    name, duration = "target", math.inf

    def __init__(self, tracks: Mapping[str, Track]) -> None:
        """Follow the track of the target.

        Args:
            tracks: Received tracks of other vehicles; `target` is among them once it has been received.
        """
        self._tracks, self.started = tracks, math.nan

    def at(self, t: npt.ArrayLike) -> Reference:
        """Return the goal at times since the start [s], (...); at the world's origin before the first message."""
        track = self._tracks.get(self.name) or Track(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(6))
        velocity = quat_rotate(track.quaternion, track.nu[:3])
        since = np.asarray(t, float) + self.started - track.time
        since = np.clip(np.where(np.isfinite(since), since, 0.0), 0.0, AHEAD)
        shape = since.shape
        return Reference(
            track.position + since[..., None] * velocity,
            np.broadcast_to(velocity, (*shape, 3)).copy(),
            np.full(shape, float(quat_yaw(track.quaternion))),
            np.zeros(shape),
        )


def station_of(text: str) -> Station:
    """Return a station from "x,y,z,yaw_deg" (world frame [m], left positive [deg]), or from a file (.yaml) with a
    `goal`.

    Raises:
        GoalError: The text is neither four finite numbers nor a file that contains them.
    """
    if text.endswith((".yaml", ".yml")):
        return _numbers(text, _goal_in(Path(text)))
    return _numbers(f"goal '{text}'", text.split(","))


def place_of(text: str) -> tuple[float, float]:
    """Return a horizontal position from "x,y", world frame [m].

    Raises:
        GoalError: The text is not two finite numbers.
    """
    try:
        x, y = map(float, text.split(","))
    except ValueError:
        x = y = math.nan
    if not (math.isfinite(x) and math.isfinite(y)):
        raise GoalError(f"place '{text}': expected two numbers x,y: metres in the world frame")
    return x, y


def guide_of(goal: str | None, trajectory: str | None) -> Guide:
    """Return the guide of a command line: either a goal or a trajectory.

    Raises:
        GoalError: Both or neither are given, or the goal cannot be read.
        ControlError: The trajectory is invalid.
    """
    if (goal is None) == (trajectory is None):
        raise GoalError(
            "give either a goal x,y,z,yaw_deg or a trajectory: "
            + ("both are given" if goal else "neither is given")
        )
    if goal is not None:
        return station_of(goal)
    from finssim.control.trajectories import load_trajectory

    return load_trajectory(str(trajectory))


def highest(guide: Guide) -> float:
    """Return the greatest z along a guide, world frame [m]."""
    return float(_places(guide)[:, 2].max())


def _places(guide: Guide) -> npt.NDArray[np.float64]:
    """Return positions along a guide, world frame [m], (k, 3)."""
    end = guide.duration if math.isfinite(guide.duration) else 0.0
    return guide.at(np.linspace(0.0, end, 401 if end else 1)).position


def check_reachable(guide: Guide, vehicle: Vehicle) -> None:
    """Refuse a motion that leaves the vehicle's workspace, or that is faster than the vehicle.

    Raises:
        GoalError: The motion is refused; the message states where or when.
    """
    places, end = _places(guide), guide.duration if math.isfinite(guide.duration) else 0.0
    lower, upper = vehicle.safety.workspace_lower, vehicle.safety.workspace_upper
    if places[:, 2].max() > max(float(upper[2]), 0.0):
        raise GoalError(
            f"{guide.name} leads to {places[:, 2].max():.2f} m above the surface, which is z = 0 (with an autopilot "
            "where its barometer was calibrated; --calibrate-depth does it again): give a z below 0"
        )
    outside = np.any((places < lower) | (places > upper), axis=1)
    if outside.any():
        point = np.round(places[outside][0], 3).tolist()
        raise GoalError(
            f"{guide.name} leads to {point}, outside the workspace {lower.tolist()} to {upper.tolist()} of "
            f"{vehicle.name} (world frame, z = 0 on the water): choose another, or change safety in the vehicle file"
        )
    if end:
        from finssim.control.trajectories import Trajectory, check_speed

        if isinstance(guide, Trajectory):
            try:
                check_speed(guide, vehicle)
            except ControlError as error:
                raise GoalError(str(error)) from None


def _goal_in(path: Path) -> list[object]:
    tree = read_mapping(path, GoalError, such_as="goal: [x, y, z, yaw_deg]")
    goal = tree.pop("goal", None)
    if not isinstance(goal, list):
        raise GoalError(f"{path}: no goal in it: write goal: [x, y, z, yaw_deg]")
    if tree:
        raise GoalError(f"{path}: unknown key '{next(iter(tree))}', expected goal: [x, y, z, yaw_deg] alone")
    return goal


def _numbers(label: str, values: list[object] | list[str]) -> Station:
    try:
        x, y, z, yaw_deg = (float(str(v)) for v in values)
    except ValueError:
        x = y = z = yaw_deg = math.nan
    if not all(map(math.isfinite, (x, y, z, yaw_deg))):
        raise GoalError(
            f"{label}: expected four numbers x,y,z,yaw_deg: metres in the world frame (z = 0 on the water, negative "
            "below) and degrees"
        )
    return Station((x, y, z), math.radians(yaw_deg))
