"""From a policy's action in [-1, 1] to thruster force commands, inside the batch: Thruster8, Wrench6, Wrench4."""

from collections.abc import Callable, Sequence

import numpy as np
import warp as wp

from finssim.control.allocation import AllocationData, allocate, allocation_data, axis_weights
from finssim.engine.packed import Packed
from finssim.physics.plant import VehicleCommand
from finssim.physics.types import MAX_THRUSTERS, vec6, vec8
from finssim.tasks.arrays import TaskArrays
from finssim.vehicles import Vehicle

WRENCH_AXES = {"wrench6": (0, 1, 2, 3, 4, 5), "wrench4": (0, 1, 2, 5)}
"""Axis of the wrench (surge sway heave roll pitch yaw) that each action component drives."""


ACTION_MODES = ("thruster8", *WRENCH_AXES)
"""Names of the action modes."""


@wp.func
def action_of(arrays: TaskArrays, w: int, v: int, agents: int, size: int, i: int) -> float:
    """Component i of the action of a vehicle, limited: an agent's own, or what the task says for one of the others."""
    a = float(0.0)
    if v < agents:
        a = arrays.action[w, v * size + i]
    else:
        a = arrays.scripted[w, (v - agents) * size + i]
    return wp.clamp(a, -1.0, 1.0)


@wp.kernel(enable_backward=False)
def thruster_action(
    arrays: TaskArrays,
    command: wp.array2d(dtype=VehicleCommand),
    lower: wp.array(dtype=vec8),
    upper: wp.array(dtype=vec8),
    agents: int,
    count: int,
    world_offset: int,
):
    """Each action component is a part of its thruster's force limit: a ≥ 0 of the upper one, a < 0 of the lower."""
    i, v = wp.tid()
    w = world_offset + i
    force = vec8()
    for k in range(MAX_THRUSTERS):
        if k < count:
            a = action_of(arrays, w, v, agents, count, k)
            force[k] = wp.where(a >= 0.0, a * upper[v][k], -a * lower[v][k])
    command[w, v].thrust = force


@wp.kernel(enable_backward=False)
def wrench_action(
    arrays: TaskArrays,
    command: wp.array2d(dtype=VehicleCommand),
    scale: wp.array2d(dtype=vec6),
    agents: int,
    count: int,
    data: AllocationData,
    world_offset: int,
):
    """Each action component is a part of one axis' wrench limit; the wrench is allocated to the thrusters exactly.

    `scale[v, i]` is the wrench [N, N m] of action component i of vehicle v at 1.
    """
    i, v = wp.tid()
    w = world_offset + i
    tau = vec6()
    for k in range(count):
        tau += action_of(arrays, w, v, agents, count, k) * scale[v, k]
    command[w, v].thrust = allocate(tau, v, data)


def action_size(mode: str, thrusters: int) -> int:
    """Components of an action of this mode."""
    return thrusters if mode == "thruster8" else len(WRENCH_AXES[mode])


def add_action(
    mode: str,
    vehicles: Sequence[Vehicle],
    command: Packed,
    arrays: TaskArrays,
    agents: int,
    wrench_scale: np.ndarray,
) -> Callable[..., None]:
    """The stage that turns actions into thruster commands.

    Args:
        mode: thruster8, wrench6 or wrench4.
        vehicles: As their controllers know them, for limits and allocation; what the simulated ones deliver may differ.
        command: Of the simulated ones.
        arrays: Holds the actions.
        agents: How many of the vehicles are agents: the first ones.
        wrench_scale: Part of each wrench limit that action 1 of an agent stands for [-], body axes, (6,).

    Returns:
        A function that appends the stage to a pipeline.
    """
    device = command.array.device
    limits = [vehicle.force_limits for vehicle in vehicles]
    if mode == "thruster8":
        count = len(vehicles[0].thrusters)
        bounds = [_padded([ends[k] for ends in limits], device) for k in range(2)]
        inputs = [arrays, command.array, *bounds, agents, count]
        return lambda pipeline: pipeline.add(thruster_action, inputs, vehicles=len(vehicles))
    reach = [vehicle.wrench_limits for vehicle in vehicles]
    data = allocation_data(
        [vehicle.control_matrix for vehicle in vehicles],
        [lower for lower, _ in limits],
        [upper for _, upper in limits],
        [axis_weights(most) for most in reach],
        device=device,
    )
    axes = WRENCH_AXES[mode]
    rows = np.zeros((len(vehicles), len(axes), 6), dtype=np.float32)
    for v, most in enumerate(reach):
        # What the task commands is in parts of the whole limits, however gently the agents are to act.
        whole = most * wrench_scale if v < agents else most
        rows[v, np.arange(len(axes)), axes] = whole[list(axes)]
    scale = wp.array(rows, dtype=vec6, device=device)
    inputs = [arrays, command.array, scale, agents, len(axes), data]
    return lambda pipeline: pipeline.add(wrench_action, inputs, vehicles=len(vehicles))


def _padded(forces: list[np.ndarray], device: wp.Device) -> wp.array:
    """Force limits of every vehicle, with zeros for the thrusters that it does not have."""
    table = np.zeros((len(forces), MAX_THRUSTERS), dtype=np.float32)
    for row, force in zip(table, forces, strict=True):
        row[: len(force)] = force
    return wp.array(table, dtype=vec8, device=device)
