"""Whether a record can be read, and how much of its end is missing."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from finssim.robot.record_reader import open_record

__all__ = ["check_record", "first_stop", "newest_message"]


def check_record(path: Path, steps: int, rate: float) -> dict[str, Any]:
    """Read a record of a run in lock-step through.

    Args:
        path: The record.
        steps: How many the robot had made when it should end; each leaves one state in it.
        rate: Steps a second [Hz].

    Returns:
        `record_lost_s`: what is missing, None where it cannot be read; `record_problem`: why, or empty.
    """
    try:
        with open_record(path) as record:
            states = sum(1 for _ in record.messages(("estimator_status",)))
    except Exception as error:  # whatever keeps a reader from reading is the finding
        return {"record_lost_s": None, "record_problem": f"{type(error).__name__}: {error}"}
    return {"record_lost_s": max(steps - states, 0) / rate, "record_problem": ""}


def newest_message(path: Path) -> tuple[float | None, str]:
    """Time of the last message of a record that was cut, infinite of one that is whole [s], and why there is none."""
    try:
        with open_record(path) as record:
            newest = max(time for time, _, _ in record.sizes())
            return newest if record.cut else math.inf, ""
    except Exception as error:  # as above
        return None, f"{type(error).__name__}: {error}"


def first_stop(path: Path, since: float) -> float | None:
    """When the bridge first stopped enabling the motors after a time, by the record's events, robot's clock [s]."""
    with open_record(path) as record:
        for entry in record.messages(("events",)):
            if entry.time >= since and json.loads(entry.message.data)["kind"] in (
                "hold",
                "fault",
                "disarmed",
            ):
                return entry.time
    return None
