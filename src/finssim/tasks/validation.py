"""Validation of an environment's vehicles."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from finssim.vehicles import Vehicle, load_vehicle

if TYPE_CHECKING:
    from finssim.tasks.task import Task


class EnvironmentSetupError(ValueError):
    """An environment cannot be set up, or an action or saved state does not fit it."""


def vehicles_of_task(
    vehicle: Vehicle | str | Sequence[Vehicle | str], task: "Task", mode: str
) -> list[Vehicle]:
    """Return the vehicles of a world: those given, or one vehicle repeated for every role of the task.

    Raises:
        EnvironmentSetupError: Their number differs from that of the task's roles, a vehicle lacks a controlled axis, or
            its thrusters do not fit the action mode.
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
                f"needs: its thrusters control {', '.join(vehicle_or_name.controlled_axes) or 'no axis'}; use another "
                "vehicle"
            )
        if not vehicle_or_name.thrusters and mode != "surfaces" and not mode.startswith("course"):
            raise EnvironmentSetupError(
                f"vehicle '{vehicle_or_name.name}' does not control any axis by thrusters, as action mode '{mode}' "
                "does: use mode surfaces, or another vehicle"
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
            "thruster: use wrench6 or wrench4"
        )
    return vehicles
