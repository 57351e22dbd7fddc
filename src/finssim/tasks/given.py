"""What an environment is given and gives: its vehicles, seeds and actions, checked; the result of a step."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from finssim.vehicles import Vehicle, load_vehicle

if TYPE_CHECKING:
    from finssim.tasks.task import Task

GREATEST_SEED = 2**31 - 1
"""Kernels take seeds as 32-bit integers."""


class EnvironmentSetupError(ValueError):
    """An environment that cannot be set up, or an action or saved state it cannot take."""


@dataclass(frozen=True)
class Step:
    """What one step gave; NumPy views of the environment's own arrays, valid until the next step."""

    observation: Any
    """(worlds, size), or (worlds, agents, size) of several agents; the first of the new episode where one ended. Of a
    task that sees a dictionary: `state`, which is that, and by each picture's name uint8 (worlds, height, width, 3),
    or of a sonar (worlds, beams, range cells, 1)."""
    reward: NDArray[np.float32]
    """(worlds,), or (worlds, agents)."""
    terminated: NDArray[np.bool_]
    """Ended by the task, (worlds,)."""
    truncated: NDArray[np.bool_]
    """Ended by the time limit, (worlds,)."""
    final_observation: Any
    """Last observation of the episodes that ended in this step; older rows elsewhere."""


def crew(vehicle: Vehicle | str | Sequence[Vehicle | str], task: "Task", mode: str) -> list[Vehicle]:
    """The vehicles of a world: those that are given, or one of a kind for every place.

    Raises:
        EnvironmentSetupError: Another number than the task has places, a vehicle with too few controlled axes, or
            thrusters that do not fit the action mode.
    """
    given = [vehicle] * len(task.vehicles) if isinstance(vehicle, Vehicle | str) else list(vehicle)
    if len(given) != len(task.vehicles):
        names = ", ".join(task.vehicles)
        raise EnvironmentSetupError(
            f"{len(given)} vehicles are given, expected {len(task.vehicles)} for task '{task.name}': {names}"
        )
    vehicles = [one if isinstance(one, Vehicle) else load_vehicle(one) for one in given]
    for one in vehicles:
        missing = [axis for axis in task.needs if axis not in one.controlled_axes]
        if missing:
            raise EnvironmentSetupError(
                f"vehicle '{one.name}' does not control {', '.join(missing)}, which task '{task.name}' needs: its "
                f"thrusters control {', '.join(one.controlled_axes)}; take another vehicle"
            )
    if mode == "thruster8" and task.others:
        raise EnvironmentSetupError(
            f"actions of task '{task.name}' are by thruster, expected wrench4 or wrench6: {', '.join(task.others)} is "
            "commanded by wrench"
        )
    counts = {len(one.thrusters) for one in vehicles}
    if mode == "thruster8" and len(counts) > 1:
        raise EnvironmentSetupError(
            f"vehicles have {', '.join(map(str, sorted(counts)))} thrusters, expected equal numbers for actions by "
            "thruster: take wrench6 or wrench4"
        )
    return vehicles


def refuse_other_thrusters(vehicles: Sequence[Vehicle], nominal: Sequence[Vehicle]) -> None:
    """Refuse vehicles whose thrusters are not those that their controllers command.

    Raises:
        EnvironmentSetupError: They differ in number, name or order.
    """
    for one, known in zip(vehicles, nominal, strict=True):
        if one.thruster_names != known.thruster_names:
            raise EnvironmentSetupError(
                f"{one.name} has thrusters {', '.join(one.thruster_names)}, "
                f"expected those that its controller commands: {', '.join(known.thruster_names)}"
            )


def checked_seed(seed: int) -> int:
    """The seed, if the kernels can take it.

    Raises:
        EnvironmentSetupError: They cannot.
    """
    if not 0 <= seed <= GREATEST_SEED:
        raise EnvironmentSetupError(f"seed is {seed}, expected 0 to {GREATEST_SEED}")
    return int(seed)


def checked_action(action: ArrayLike, worlds: int, agents: int, size: int) -> NDArray[np.float32]:
    """Actions as rows of worlds, (worlds, agents * size).

    Raises:
        EnvironmentSetupError: The shape is wrong or a number is not finite.
    """
    a = np.asarray(action, dtype=np.float32)
    expected = (worlds, size) if agents == 1 else (worlds, agents, size)
    if a.shape != expected:
        who = "world" if agents == 1 else "agent"
        raise EnvironmentSetupError(f"action has shape {a.shape}, expected {expected}: one row per {who}")
    a = a.reshape(worlds, -1)
    if not np.isfinite(a).all():
        world = int(np.flatnonzero(~np.isfinite(a).all(axis=1))[0])
        raise EnvironmentSetupError(
            f"action of world {world} has a number that is not finite: {a[world].tolist()}"
        )
    return a
