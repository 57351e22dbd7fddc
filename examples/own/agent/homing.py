"""A controller of your own, evaluated beside a PID: `finssim evaluate own_agent.py:Homing --task t1`."""

from typing import Any

import numpy as np

import finssim as fs
from finssim.control import Goal, Known
from finssim.core import quat_inverse_rotate
from finssim.tasks import Task


class Homing:
    """Proportional and derivative control of position, in fractions of the wrench limits, without memory."""

    name, action, wrench_scale, period = "homing", "wrench6", 1.0, 0.1

    def __init__(self, vehicle: fs.Vehicle, task: Task) -> None:
        """Store the limits of the vehicle."""
        self.limits = np.asarray(vehicle.wrench_limits)[:3]

    def reset(self, n: int) -> Any:
        """Return the memory at the start of n episodes."""
        return None

    def act(self, memory: Any, reading: Known, goal: Goal) -> tuple[np.ndarray, Any]:
        """Return the actions, (n, 6), and the memory for the next call.

        Args:
            memory: Memory that the last call returned.
            reading: `position` [m], `quaternion` (xyzw) and `nu` [m/s, rad/s], a row for each world.
            goal: `position` [m] and `quaternion` of each world.
        """
        towards = quat_inverse_rotate(reading.quaternion, np.asarray(goal.position) - reading.position)
        action = np.zeros((len(towards), 6), np.float32)
        action[:, :3] = np.clip((60.0 * towards - 80.0 * reading.nu[:, :3]) / self.limits, -1.0, 1.0)
        return action, memory

    def describe(self) -> dict[str, Any]:
        """Return the description that results contain."""
        return {"name": self.name, "kind": "own", "action": self.action, "period_s": self.period}


if __name__ == "__main__":
    for controller in (f"{__file__}:Homing", "pid"):
        print(fs.evaluate(controller, "t1", trials=8).table)
