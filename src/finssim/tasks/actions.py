"""From a policy's action in [-1, 1] to thruster force commands, inside the batch: Thruster8, Wrench6, Wrench4."""

from collections.abc import Callable

import numpy as np
import warp as wp

from finssim.control.allocation import AllocationData, allocate, allocation_data
from finssim.control.allocator import axis_weights
from finssim.engine.simulator import Simulator
from finssim.physics.plant import VehicleCommand
from finssim.physics.types import MAX_THRUSTERS, vec6, vec8
from finssim.tasks.arrays import TaskArrays

WRENCH_AXES = {"wrench6": (0, 1, 2, 3, 4, 5), "wrench4": (0, 1, 2, 5)}
"""Axis of the wrench (surge sway heave roll pitch yaw) that each action component drives."""


ACTION_MODES = ("thruster8", *WRENCH_AXES)
"""Names of the action modes."""


@wp.kernel(enable_backward=False)
def thruster_action(
    arrays: TaskArrays,
    command: wp.array2d(dtype=VehicleCommand),
    lower: vec8,
    upper: vec8,
    count: int,
    world_offset: int,
):
    """Each action component is a part of its thruster's force limit: a ≥ 0 of the upper one, a < 0 of the lower."""
    w = world_offset + wp.tid()
    force = vec8()
    for i in range(MAX_THRUSTERS):
        if i < count:
            a = wp.clamp(arrays.action[w, i], -1.0, 1.0)
            force[i] = wp.where(a >= 0.0, a * upper[i], -a * lower[i])
    command[w, 0].thrust = force


@wp.kernel(enable_backward=False)
def wrench_action(
    arrays: TaskArrays,
    command: wp.array2d(dtype=VehicleCommand),
    scale: wp.array(dtype=vec6),
    count: int,
    data: AllocationData,
    world_offset: int,
):
    """Each action component is a part of one axis' wrench limit; the wrench is allocated to the thrusters exactly.

    `scale[i]` is the wrench [N, N m] of action component i at 1.
    """
    w = world_offset + wp.tid()
    tau = vec6()
    for i in range(count):
        tau += wp.clamp(arrays.action[w, i], -1.0, 1.0) * scale[i]
    command[w, 0].thrust = allocate(tau, 0, data)


def action_size(mode: str, thrusters: int) -> int:
    """Components of an action of this mode."""
    return thrusters if mode == "thruster8" else len(WRENCH_AXES[mode])


def add_action(
    mode: str, simulator: Simulator, arrays: TaskArrays, wrench_scale: np.ndarray
) -> Callable[..., None]:
    """The stage that turns actions into thruster commands.

    Args:
        mode: thruster8, wrench6 or wrench4.
        simulator: Whose vehicle 0 is commanded.
        arrays: Holds the action.
        wrench_scale: Part of each wrench limit that action 1 stands for, (6,).

    Returns:
        A function that appends the stage to a pipeline.
    """
    vehicle = simulator.vehicles[0]
    lower, upper = vehicle.force_limits
    n = len(vehicle.thrusters)
    if mode == "thruster8":
        pad = [0.0] * (MAX_THRUSTERS - n)
        bounds = [vec8(*lower, *pad), vec8(*upper, *pad)]
        return lambda pipeline: pipeline.add(thruster_action, [arrays, simulator.command.array, *bounds, n])
    limits = vehicle.wrench_limits
    data = allocation_data(
        [vehicle.control_matrix], [lower], [upper], [axis_weights(limits)], device=simulator.device
    )
    axes = WRENCH_AXES[mode]
    rows = np.zeros((len(axes), 6), dtype=np.float32)
    rows[np.arange(len(axes)), axes] = (limits * wrench_scale)[list(axes)]
    scale = wp.array(rows, dtype=vec6, device=simulator.device)
    return lambda pipeline: pipeline.add(
        wrench_action, [arrays, simulator.command.array, scale, len(axes), data]
    )
