"""The pose controllers by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from finssim.agents.lqr import Lqr
from finssim.agents.pid import TRAJECTORY_PROFILE, PaperPid, Pid
from finssim.control import ControlError
from finssim.control.guidance import Controller
from finssim.vehicles import Vehicle


def _nmpc(vehicle: Vehicle, **options: Any) -> Controller:
    from finssim.agents.nmpc import Nmpc  # takes CasADi, an extra

    return Nmpc.from_vehicle(vehicle, **options)


CONTROLLERS: dict[str, Callable[..., Controller]] = {
    "pid": Pid.from_vehicle,
    "pid-paper": PaperPid.from_vehicle,
    "lqr": Lqr.from_vehicle,
    "nmpc": _nmpc,
}
"""Makers `(vehicle, hydrodynamics="calibrated", period=...) -> Controller` by name."""
COSTLY = ("nmpc",)
"""Controllers that need an extra and a second to start, which are made only when they are requested by name."""


def controller(name: str, vehicle: Vehicle, **options: Any) -> Controller:
    """The controller of that name for a vehicle; options are its maker's (`hydrodynamics`, `period`).

    Raises:
        ControlError: No such controller, or an option it refuses.
    """
    if name not in CONTROLLERS:
        raise ControlError(f"unknown controller '{name}'; available: {', '.join(CONTROLLERS)}")
    return CONTROLLERS[name](vehicle, **options)


def controller_for(task: str, name: str, vehicle: Vehicle, **options: Any) -> Controller:
    """Return the controller of a name as a baseline of a task; `pid-paper` has a separate published profile for t2.

    Raises:
        ControlError: As `controller`.
    """
    if (task, name) == ("t2", "pid-paper"):
        options = {"profile": TRAJECTORY_PROFILE, **options}
    return controller(name, vehicle, **options)
