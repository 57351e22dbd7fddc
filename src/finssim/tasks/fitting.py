"""How large and how fast a task is for a vehicle: lengths and speeds that are the published ones for the paper's."""

from __future__ import annotations

from dataclasses import dataclass

from finssim.engine import Pool
from finssim.vehicles import HydrodynamicSet, Vehicle
from finssim.vehicles.capability import terminal_speeds
from finssim.vehicles.defaults import POOL, room

__all__ = ["Fit", "coefficients_of", "driven_axes", "fit"]

SLOWEST_SPEED = 0.22
"""Terminal speed of FinsROV's slowest direction, heave [m/s]: the published speeds are a part of it."""

MASS = 12.11
"""FinsROV's [kg]."""


@dataclass(frozen=True)
class Fit:
    """Factors on what a task is for FinsROV."""

    size: float = 1.0
    """On lengths."""
    pace: float = 1.0
    """On speeds and accelerations."""
    weight: float = 1.0
    """On masses and stiffnesses."""

    def pool(self) -> Pool:
        """The paper's pool, in proportion, with walls as stiff for the vehicle as they are for FinsROV."""
        length, width, depth = (self.size * side for side in POOL)
        return Pool(
            length=length,
            width=width,
            depth=depth,
            stiffness=4000.0 * self.weight,
            damping=100.0 * self.weight,
        )


def driven_axes(vehicle: Vehicle) -> tuple[int, ...]:
    """Which of surge, sway and heave the thrusters control."""
    names = ("surge", "sway", "heave")
    limits = vehicle.wrench_limits
    return tuple(i for i, name in enumerate(names) if limits[i] > 0.0 and name in vehicle.controlled_axes)


def coefficients_of(vehicle: Vehicle) -> str:
    """Name of the hydrodynamic set whose coefficients stand for the vehicle: the calibrated one, if its file has it."""
    sets = [name for name, one in vehicle.hydrodynamics.items() if isinstance(one, HydrodynamicSet)]
    return sets[0] if sets and "calibrated" not in sets else "calibrated"


def fit(vehicle: Vehicle) -> Fit:
    """Room in proportion to the vehicle's length, speeds in proportion to the room or to what it can do, the lesser."""
    size = room(vehicle.body.size)
    speeds = terminal_speeds(vehicle, coefficients_of(vehicle))[list(driven_axes(vehicle))]
    slowest = float(speeds.min()) if len(speeds) else 0.0
    return Fit(size, min(size, slowest / SLOWEST_SPEED), max(1.0, float(vehicle.body.mass) / MASS))
