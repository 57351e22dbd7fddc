"""What a person wants to know of a run: how near the goal it was, what stopped it, and whether it was in time."""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from finssim.geometry.rotations import quat_yaw, wrap_angle
from finssim.robot.runtime import Runtime

__all__ = ["Summary"]

LAST = 20.0
"""Errors are those of this much of the end [s]."""
EVERY = 0.1
"""Between two errors [s]."""


class Summary:
    """Looks at a runtime after every step, and tells at the end.

    Note:
        Errors are those of the estimate, which is all that a robot knows.
    """

    def __init__(self) -> None:
        self._errors: deque[tuple[float, float]] = deque(maxlen=round(LAST / EVERY))
        self._next = -math.inf

    def look(self, runtime: Runtime) -> None:
        """Take down the distance to the goal [m] and the heading error [rad], where they are known."""
        reading = runtime.reading
        if reading is None or reading.time < self._next or math.isnan(runtime.started) or not reading.ready:
            return
        self._next = reading.time + EVERY - 1e-6
        goal = runtime.guide.at(runtime.t)
        turn = float(wrap_angle(quat_yaw(reading.quaternion) - goal.yaw))
        self._errors.append((float(np.linalg.norm(reading.position - goal.position)), turn))

    @property
    def newest(self) -> str:
        """The latest error in words."""
        if not self._errors:
            return "position not known"
        distance, turn = self._errors[-1]
        return f"{100.0 * distance:.1f} cm and {math.degrees(turn):+.1f} deg off"

    def tell(self, runtime: Runtime, duration: float, state: str) -> dict[str, Any]:
        """All of it as plain data.

        Args:
            runtime: After the run.
            duration: Of the run [s].
            state: Of the bridge before the run was ended.
        """
        rms = np.sqrt(np.mean(np.square(self._errors), axis=0)) if self._errors else (None, None)
        faults = [event.text for event in runtime.counters.events if event.kind == "fault"]
        return {
            "state": state,
            "reason": runtime.bridge.reason or runtime.refusal or _waiting(runtime),
            "duration_s": duration,
            "goal": runtime.guide.name,
            "pilot": runtime.pilot.describe(),
            "position_rms_m": None if rms[0] is None else float(rms[0]),
            "yaw_rms_deg": None if rms[1] is None else math.degrees(rms[1]),
            "faults": faults,
            "samples": runtime.perception.health().counts,
            **runtime.counters.summary(),
        }


def _waiting(runtime: Runtime) -> str:
    """What a run that never began was waiting for; empty for one that did."""
    began = not math.isnan(runtime.started)
    return "" if began or runtime.reading is None else runtime.reading.reason


def show(told: dict[str, Any], console: Console) -> None:
    """Print what `Summary.tell` told as a table."""
    table = Table(show_header=False, box=None)
    latency = told["latency_s"]
    position, yaw = told["position_rms_m"], told["yaw_rms_deg"]
    off = "position not known" if position is None else f"{100.0 * position:.1f} cm, {yaw:.2f} deg"
    rows = {
        "state": told["state"] + (f": {told['reason']}" if told["reason"] else ""),
        "time": f"{told['duration_s']:.1f} s",
        f"off the goal, rms of the last {LAST:g} s": off,
        "pictures used": f"{told['fixes']} of {told['pictures']}",
        "decisions missed": f"{told['missed']} of {told['decisions'] + told['missed']}",
        "late steps": f"{told['overruns']} of {told['steps']}",
        "picture to command": "no picture"
        if latency["p50"] is None
        else f"{1e3 * latency['p50']:.0f} ms, 99 % within {1e3 * latency['p99']:.0f} ms",
        "faults": "; ".join(told["faults"]) or "none",
    }
    for name, value in rows.items():
        table.add_row(name, value)
    console.print(table)
