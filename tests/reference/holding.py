"""Station keeping at the published setpoints in a plant of `tests/agents/conftest.py`, and its settling time."""

import math

import numpy as np

from finssim.control.guidance import Goal
from finssim.core.frames import FROM_CONTROLLER
from finssim.core.rotations import quat_from_yaw, quat_to_euler, quat_yaw, wrap_angle

SETPOINTS = np.array(
    [
        (1, -0.5, 0.3, 0), (1, -0.5, -0.3, -90), (-1, -0.5, -0.3, 90), (-1, -0.5, 0.3, 180),
        (1, -0.8, 0.3, 0), (1, -0.8, -0.3, 0), (-1, -0.8, -0.3, 90), (-1, -0.8, 0.3, 180),
    ]
)  # fmt: skip
"""Published station-keeping setpoints in the paper's controller frame: x, y (up), z (left), heading [deg]."""
T1 = Goal(
    FROM_CONTROLLER.vector(SETPOINTS[:, :3]), quat_from_yaw(FROM_CONTROLLER.yaw(np.radians(SETPOINTS[:, 3])))
)


def at_rest(position, quaternion, nu=None):
    return type(
        "State", (), {"position": position, "quaternion": quaternion, "nu": np.zeros(6) if nu is None else nu}
    )


def run(pid, plant, goal, seconds, noise=None):
    """Return errors over time and the memory.

    Errors are distance on each axis [m], heading [rad] and tilt [rad], (steps, worlds, 5).
    """
    memory, log = pid.reset(len(plant.p)), []
    for _ in range(round(seconds / pid.period)):
        measured = plant.measured if noise is None else noise(plant.measured)
        tau, memory = pid.command(memory, measured, goal)
        plant.advance(pid.allocator.allocate(tau), pid.period)
        true = plant.measured
        heading = wrap_angle(quat_yaw(true.quaternion) - quat_yaw(goal.quaternion))
        tilt = np.max(np.abs(quat_to_euler(true.quaternion)[:2]), axis=0)
        log.append(np.column_stack([true.position - goal.position, heading, tilt]))
    return np.array(log), memory


def settling_time(log, period, hold=10.0):
    """Return when each world first stays within 0.10 m per axis and 10 degrees for `hold` seconds; infinite
    if never."""
    inside = (np.abs(log[..., :3]) <= 0.10).all(-1) & (np.abs(log[..., 3]) <= math.radians(10.0))
    n = round(hold / period)
    held = np.lib.stride_tricks.sliding_window_view(inside, n, axis=0).all(-1)
    return np.where(held.any(0), held.argmax(0) * period, np.inf)
