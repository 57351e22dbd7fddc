"""`finssim collect RECORD.mcap`: a data set of what was done with a vehicle, instead of in the simulator."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from finssim.control.modes import action_mode
from finssim.experiments.driven.drive import DriveError, read_drive
from finssim.experiments.driven.episodes import END, episodes_of
from finssim.learning.demonstrations import save
from finssim.provenance import provenance
from finssim.robot.goals import station_of
from finssim.tasks.observer import Observer
from finssim.vehicles import load_vehicle

__all__ = ["collect_records"]


def collect_records(
    records: Sequence[Path],
    task: str,
    *,
    out: Path,
    vehicle: str = "finsrov",
    action: str | None = None,
    goal: str | None = None,
) -> dict[str, Any]:
    """Make demonstrations of records and write them.

    Args:
        records: MCAP files of `finssim teleop` or `finssim run`.
        task: Its name, or FILE.py:CLASS of one's own.
        out: Folder of the data set; an earlier one there is replaced.
        vehicle: Name or file; the very one that was driven.
        action: Mode; the task's own if None.
        goal: Where the vehicle should have been, in place of what was recorded: "x,y,z,yaw_deg" or a file, "end" (where
            each stretch ended); of t2 the trajectory, by name or file.

    Returns:
        What the data set says of itself, with `episodes` and `steps`.

    Raises:
        DriveError: A record does not fit, or nothing in it can be learnt from.
        RecordError, ControlError, GoalError, VehicleError, OutputError: As they say.
    """
    body = load_vehicle(vehicle)
    watch = Observer(task, body)
    the_task = watch.task
    mode = action_mode(action or the_task.action, body)
    to = station_of(goal) if goal is not None and not the_task.moving and goal != END else goal
    found, sources = [], []
    for path in records:
        drive = read_drive(path, body)
        episodes = episodes_of(drive, watch, mode, body, goal=to)
        found += episodes
        steps = sum(len(e.action) for e in episodes)
        sources.append(
            {
                "file": path.name,
                "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
                "driver": drive.driver,
                "episodes": len(episodes),
                "steps": steps,
            }  # fmt: skip
        )
    if not found:
        names = ", ".join(str(path) for path in records)
        raise DriveError(
            f"{names}: nowhere was the robot armed, its estimate ready and its driver at the helm for two decisions "
            f"{the_task.control_step:g} s apart towards one goal: nothing to learn from"
        )
    described = {
        "task": the_task.name,
        "expert": " and ".join(dict.fromkeys(str(source["driver"]) for source in sources)),
        "observation": the_task.schema.model_dump(mode="json"),
        "action": mode.describe(),
        "vehicle": {"name": body.name, "sha256": body.sha256},
        "observe": "record",
        "goal": goal,
        "records": sources,
        "provenance": provenance(),
    }
    save(out, found, described)
    return {**described, "episodes": len(found), "steps": sum(len(e.action) for e in found)}
