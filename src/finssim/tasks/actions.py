"""From a policy's action in [-1, 1] to thruster force commands, inside the batch, as `finssim.control.modes` has it."""

from collections.abc import Callable, Sequence

import numpy as np
import warp as wp

from finssim.control.modes import MODES, ModeData, mode_data, thrusts_of
from finssim.engine.packed import Packed
from finssim.physics.plant import VehicleCommand
from finssim.physics.types import vec8
from finssim.tasks.arrays import TaskArrays
from finssim.vehicles import Vehicle


@wp.kernel(enable_backward=False)
def act(
    arrays: TaskArrays,
    command: wp.array2d(dtype=VehicleCommand),
    data: ModeData,
    agents: int,
    world_offset: int,
):
    """Thrusts of every vehicle: of an agent's own action, or of what the task says for one of the others."""
    i, v = wp.tid()
    w = world_offset + i
    size = data.columns.shape[1]
    a = vec8()
    for k in range(size):
        if v < agents:
            a[k] = arrays.action[w, v * size + k]
        else:
            a[k] = arrays.scripted[w, (v - agents) * size + k]
    command[w, v].thrust = thrusts_of(a, v, data)


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
        mode: A name of `finssim.control.modes.MODES`.
        vehicles: As their controllers know them, for limits and allocation; what the simulated ones deliver may differ.
        command: Of the simulated ones.
        arrays: Holds the actions.
        agents: How many of the vehicles are agents: the first ones.
        wrench_scale: Part of each wrench limit that action 1 of an agent stands for [-], body axes, (6,).

    Returns:
        A function that appends the stage to a pipeline.
    """
    # What the task commands is in parts of all of the limits, however gently the agents are to act.
    own = wrench_scale if MODES[mode].wrench else 1.0
    scales = [own if v < agents else 1.0 for v in range(len(vehicles))]
    inputs = [arrays, command.array, mode_data(mode, vehicles, scales, command.array.device), agents]
    return lambda pipeline: pipeline.add(act, inputs, vehicles=len(vehicles))
