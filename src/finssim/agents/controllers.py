"""Pose controllers by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from finssim.agents.lqr import Lqr
from finssim.agents.pid import TRAJECTORY_PROFILE, PaperPid, Pid
from finssim.control import ControlError
from finssim.control.guidance import Controller
from finssim.vehicles import Vehicle


def _nmpc(vehicle: Vehicle, **options: Any) -> Controller:
    from finssim.agents.nmpc import Nmpc  # requires the extra with CasADi

    return Nmpc.from_vehicle(vehicle, **options)


CONTROLLERS: dict[str, Callable[..., Controller]] = {
    "pid": Pid.from_vehicle,
    "pid-paper": PaperPid.from_vehicle,
    "lqr": Lqr.from_vehicle,
    "nmpc": _nmpc,
}
"""Constructors `(vehicle, hydrodynamics="calibrated", period=...) -> Controller` by name."""
COSTLY = ("nmpc",)
"""Controllers that need an extra and a second to start, so that they are created only if requested by name."""


def controller(name: str, vehicle: Vehicle, **options: Any) -> Controller:
    """Return the controller with a name for a vehicle; options are those of its constructor (`hydrodynamics`,
    `period`).

    Raises:
        ControlError: The controller does not exist, or rejects an option.
    """
    if name not in CONTROLLERS:
        raise ControlError(f"unknown controller '{name}'; available: {', '.join(CONTROLLERS)}")
    return CONTROLLERS[name](vehicle, **options)


def controller_for(task: str, name: str, vehicle: Vehicle, **options: Any) -> Controller:
    """Return the controller with a name as a baseline of a task; `pid-paper` has a separate published profile for t2.

    Raises:
        ControlError: See `controller`.
    """
    if (task, name) == ("t2", "pid-paper"):
        options = {"profile": TRAJECTORY_PROFILE, **options}
    return controller(name, vehicle, **options)
