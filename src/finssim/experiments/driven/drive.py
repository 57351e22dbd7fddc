"""What a record tells of a drive: every decision, what was known at it, and whether it may be learnt from."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.robot.record_messages import STATES
from finssim.robot.record_reader import Record, open_record
from finssim.vehicles import Vehicle

__all__ = ["Drive", "DriveError", "read_drive"]

Array = NDArray[np.float64]

TOPICS = ("thruster_cmd", "policy_info", "goal", "odom", "estimator_status", "thruster_state")
"""What a demonstration is made of; `events` are read where there are any."""
TELEOP = "finssim teleop"
PERSON = "person"
"""Mode of a teleoperated vehicle in which its operator steers, and the one it begins in."""
NO_GOAL = (0.0, 0.0, 0.0, 0.0)
"""Stands in the record of a drive by hand without a goal."""


class DriveError(ValueError):
    """A record that cannot be made into demonstrations."""


@dataclass(frozen=True)
class Drive:
    """The N decisions of a record at which there was an estimate, in their order."""

    path: Path
    driver: str
    """teleop, or the pilot's name."""
    period: float
    """Of the decisions [s]."""
    time: Array
    """Robot's clock [s], (N,)."""
    since: Array
    """Time since the guide's start [s], (N,); NaN where the record does not tell it."""
    guide: str
    """Name of the station or trajectory; empty where the record does not tell it."""
    position: Array
    """Estimate of the body origin, world frame [m], (N, 3)."""
    quaternion: Array
    """Estimate of body to world, xyzw, (N, 4)."""
    nu: Array
    """Estimate of the velocity, body frame [m/s, rad/s], (N, 6)."""
    goal: Array
    """Where the vehicle should be: x, y, z [m], yaw [rad], world frame, (N, 4)."""
    force: Array
    """Thrusts that were asked for, canonical order [N], (N, n)."""
    action: Array
    """What the pilot did, in [-1, 1], (N, size); of size 0 where the record does not tell it, as of a person."""
    stretch: NDArray[np.int64]
    """Number of the stretch a decision belongs to, (N,): all through it the robot was armed, the estimate ready and
    the driver at the helm. Negative: in none."""

    @property
    def has_goal(self) -> bool:
        """Whether anybody said where to."""
        return self.driver != "teleop" or bool(np.any(self.goal != NO_GOAL))


def read_drive(path: Path, vehicle: Vehicle) -> Drive:
    """Read a record of `finssim teleop` or `finssim run`; one that was cut is read up to the cut.

    Args:
        path: MCAP file.
        vehicle: It must be the very one that was driven.

    Raises:
        RecordError: Not a record.
        DriveError: Of another vehicle, without an estimate, or nobody commanded.
    """
    with open_record(path) as record:
        _check(record, vehicle)
        teleop = record.metadata.get("command") == TELEOP
        columns = {name: {e.time: e.message for e in record.messages((name,))} for name in TOPICS}
        told = [
            (e.time, json.loads(e.message.data))
            for e in (record.messages(("events",)) if record.topic("events") in record.topics else ())
        ]
    steps = np.array(sorted(columns["thruster_state"]))
    numbers = dict(zip(steps.tolist(), _stretches(steps, columns, _helm(steps, told, teleop)), strict=True))
    whole = [t for t in sorted(columns["thruster_cmd"]) if all(t in columns[name] for name in TOPICS)]
    if not whole:
        raise DriveError(f"{path}: no decision at which there was an estimate: nothing to learn from")
    rows = [{name: columns[name][t] for name in TOPICS} for t in whole]
    stretch = np.array([numbers[t] for t in whole])
    first = rows[int(np.argmax(stretch >= 0))]["policy_info"]
    began, guide = _start(told)
    return Drive(
        path=path,
        driver="teleop" if teleop else str(first.pilot),
        period=float(first.period),
        time=np.array(whole),
        since=np.array(whole) - began,
        guide=guide,
        stretch=stretch,
        **_numbers(rows),
    )


def _check(record: Record, vehicle: Vehicle) -> None:
    about = record.metadata
    if "vehicle_sha256" not in about:
        raise DriveError(f"{record.path}: does not say of which vehicle it is: not a record of FinsSim")
    if about["vehicle_sha256"] != vehicle.sha256:
        raise DriveError(
            f"{record.path}: is of the vehicle {about['vehicle']} {about['vehicle_sha256'][:12]}, expected "
            f"{vehicle.name} {vehicle.sha256[:12]}: name the file that was driven with --vehicle"
        )
    for name, lacks in (
        ("thruster_cmd", "nobody commanded"),
        ("odom", "it holds no estimate of where it was"),
    ):
        if record.topic(name) not in record.topics:
            raise DriveError(f"{record.path}: {lacks}: record a drive with --pool-file and pictures")
    for name in TOPICS:
        if record.topic(name) not in record.topics:
            raise DriveError(f"{record.path}: has no topic {name}: not a record of finssim teleop or run")


def _helm(steps: Array, told: list[tuple[float, Any]], teleop: bool) -> NDArray[np.bool_]:
    """Whether the one who is to be learnt from steers at each step: of a drive by hand the person."""
    if not teleop:
        return np.ones(len(steps), dtype=np.bool_)
    changes = [(t, event["text"] == PERSON) for t, event in told if event.get("kind") == "mode"]
    times = np.array([-math.inf, *(t for t, _ in changes)])
    # A press changes who decides from the next step on.
    index = np.searchsorted(times, steps, side="left") - 1
    return np.array([True, *(person for _, person in changes)])[np.maximum(index, 0)]


def _stretches(
    steps: Array, columns: Mapping[str, Mapping[float, Any]], helm: NDArray[np.bool_]
) -> list[int]:
    """Number of each step's stretch, which every step that may not be learnt from ends; negative there."""
    states, ready, known = columns["thruster_state"], columns["estimator_status"], columns["odom"]
    armed = STATES.index("armed")
    fit = helm & np.array(
        [
            states[t].state == armed and t in known and t in ready and bool(ready[t].ready)
            for t in steps.tolist()
        ],
        dtype=np.bool_,
    )
    return [int(n) for n in np.where(fit, np.cumsum(~fit), -1)]


def _start(told: list[tuple[float, Any]]) -> tuple[float, str]:
    """When the guide's time began, and the guide's name."""
    return next(
        ((t, str(event["text"])) for t, event in told if event.get("kind") == "trial_start"), (math.nan, "")
    )


def _numbers(rows: list[dict[str, Any]]) -> dict[str, Array]:
    poses = [row["odom"].pose.pose for row in rows]
    twists = [row["odom"].twist.twist for row in rows]
    goals = [row["goal"].pose for row in rows]
    # The goal is level: its quaternion turns about z alone.
    yaw = [2.0 * math.atan2(g.orientation.z, g.orientation.w) for g in goals]
    actions = [np.asarray(row["policy_info"].action, dtype=float) for row in rows]
    alike = len({len(action) for action in actions}) == 1
    return {
        "action": np.array(actions) if alike else np.zeros((len(rows), 0)),
        "position": np.array([_xyz(p.position) for p in poses]),
        "quaternion": np.array([(*_xyz(p.orientation), p.orientation.w) for p in poses]),
        "nu": np.array([(*_xyz(t.linear), *_xyz(t.angular)) for t in twists]),
        "goal": np.array([(*_xyz(g.position), a) for g, a in zip(goals, yaw, strict=True)]),
        "force": np.array([row["thruster_cmd"].force for row in rows], dtype=float),
    }


def _xyz(v: Any) -> tuple[float, float, float]:
    return float(v.x), float(v.y), float(v.z)
