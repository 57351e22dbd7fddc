"""How fast a plant gets along each axis, and how soon: what coefficients come to, propellers and hull included."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finssim.control.allocator import Allocator
from finssim.pool.draw_plant import draw_plant
from finssim.pool.plant import Plant
from finssim.pool.plant_spec import Basin, PlantSpec
from finssim.pool.water_spec import BuoyancyDrift, Circulation
from finssim.quiet import start_warp
from finssim.vehicles import AXES, Vehicle

__all__ = ["StepResponse", "compare_steps", "step_responses"]

Array = NDArray[np.float64]

PUSH, REST = 6.0, 1.0
"""Lengths of a step and of the pause before the next one [s]."""
OPEN = Basin(length=60.0, width=60.0, depth=60.0)


@dataclass(frozen=True)
class StepResponse:
    """Of one axis to one level, the mean of both directions."""

    speed: float
    """Terminal [m/s, rad/s]."""
    time_constant: float
    """Until 63 % of it, motors included [s]."""


def step_responses(
    vehicle: Vehicle, spec: PlantSpec, levels: Mapping[str, Sequence[float]]
) -> dict[tuple[str, float], StepResponse]:
    """Steps of a plant on rails: it can move along one axis alone, in water at rest, far from everything.

    Args:
        vehicle: By whose file the wrench is allocated and becomes shaft speeds.
        spec: The plant; current, tether and drift of the buoyancy are left out.
        levels: Axis -> wrenches [N, N m].

    Returns:
        (axis, level) -> response.
    """
    start_warp()
    still = {"basin": OPEN, "circulation": Circulation(), "tether": None, "buoyancy": BuoyancyDrift()}
    plant = Plant(vehicle, spec.model_copy(update=still), position=(0.0, 0.0, -30.0))
    found = {}
    for axis, values in levels.items():
        for level in values:
            both = [_step(plant, vehicle, AXES.index(axis), sign * level) for sign in (1.0, -1.0)]
            speed, time = np.mean(both, axis=0)
            found[axis, level] = StepResponse(float(speed), float(time))
    return found


def compare_steps(
    identified: Vehicle, standing: Vehicle, spec: PlantSpec, levels: Mapping[str, Sequence[float]]
) -> list[dict[str, float | str]]:
    """Terminal speeds and time constants of an identified vehicle beside those of the plant that it was identified in.

    Args:
        identified: The vehicle; its plant is its file to the letter.
        standing: Around which the plant was drawn.
        spec: The plant.
        levels: Axis -> wrenches, by the file that robots have [N, N m].

    Returns:
        A row for each axis and level: axis, level, speed and time constant of `model` and `plant`.
    """
    model = step_responses(identified, draw_plant(identified, 0, "nominal"), levels)
    real = step_responses(standing, spec, levels)
    return [
        {
            "axis": axis,
            "level": level,
            "model_speed": model[axis, level].speed,
            "plant_speed": response.speed,
            "model_time_constant": model[axis, level].time_constant,
            "plant_time_constant": response.time_constant,
        }
        for (axis, level), response in real.items()
    ]


def _step(plant: Plant, vehicle: Vehicle, axis: int, level: float) -> tuple[float, float]:
    """Terminal speed and time constant."""
    tau = np.zeros(6)
    tau[axis] = level
    force, _ = Allocator.from_vehicle(vehicle).allocate(tau)
    speeds = [t.speed(f) for t, f in zip(vehicle.thrusters.values(), force, strict=True)]
    _ride(plant, axis, np.zeros(len(speeds)), REST)
    plant.nu[:] = 0.0
    nu = np.abs(_ride(plant, axis, np.array(speeds), PUSH))
    speed = float(nu[-round(0.5 / plant.step) :].mean())
    return speed, float(np.argmax(nu >= 0.632 * speed) * plant.step)


def _ride(plant: Plant, axis: int, target: Array, duration: float) -> Array:
    """Speed along the rail at every physics step."""
    out = np.empty(round(duration / plant.step))
    plant.target[:] = target
    for k in range(len(out)):
        plant.advance()
        out[k] = plant.nu[axis]
        plant.nu[:] = np.where(np.arange(6) == axis, plant.nu, 0.0)
        plant.position[:] = (0.0, 0.0, -30.0)
        plant.quaternion[:] = (0.0, 0.0, 0.0, 1.0)
    return out
