"""Checks of an environment's vehicles, seeds and actions, and the result of a step."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from finssim.vehicles import Vehicle, load_vehicle

if TYPE_CHECKING:
    from finssim.tasks.task import Task


class EnvironmentSetupError(ValueError):
    """An environment that cannot be set up, or an action or saved state it cannot take."""


def crew(vehicle: Vehicle | str | Sequence[Vehicle | str], task: "Task", mode: str) -> list[Vehicle]:
    """The vehicles of a world: those that are given, or one of a kind for every place.

    Raises:
        EnvironmentSetupError: Another number than the task has places, a vehicle with too few controlled axes, or
            thrusters that do not fit the action mode.
    """
    stated = [vehicle] * len(task.vehicles) if isinstance(vehicle, Vehicle | str) else list(vehicle)
    if len(stated) != len(task.vehicles):
        names = ", ".join(task.vehicles)
        raise EnvironmentSetupError(
            f"{len(stated)} vehicles are given, expected {len(task.vehicles)} for task '{task.name}': {names}"
        )
    vehicles = [load_vehicle(vehicle_or_name) for vehicle_or_name in stated]
    for vehicle_or_name in vehicles:
        missing = [axis for axis in task.needs if axis not in vehicle_or_name.controlled_axes]
        if missing:
            raise EnvironmentSetupError(
                f"vehicle '{vehicle_or_name.name}' does not control {', '.join(missing)}, which task '{task.name}' "
                f"needs: its thrusters control {', '.join(vehicle_or_name.controlled_axes) or 'no axis'}; take another "
                "vehicle"
            )
        if not vehicle_or_name.thrusters and mode != "surfaces" and not mode.startswith("course"):
            raise EnvironmentSetupError(
                f"vehicle '{vehicle_or_name.name}' does not control any axis by thrusters, as action mode '{mode}' "
                "does: take mode surfaces, or another vehicle"
            )
    if mode not in ("wrench6", "wrench4", "pilot6") and task.others:
        raise EnvironmentSetupError(
            f"actions of task '{task.name}' are by {mode}, expected wrench4 or wrench6: {', '.join(task.others)} is "
            "commanded by wrench"
        )
    counts = {len(one.channel_names if mode == "surfaces" else one.thruster_names) for one in vehicles}
    if mode in ("thruster8", "surfaces") and len(counts) > 1:
        raise EnvironmentSetupError(
            f"vehicles have {', '.join(map(str, sorted(counts)))} thrusters, expected equal numbers for actions by "
            "thruster: take wrench6 or wrench4"
        )
    return vehicles
