"""What a simulator is given, checked: names, devices, vehicles that share a world."""

import difflib
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.engine.plant_arrays import SimulatorError
from finssim.quiet import start_warp
from finssim.vehicles import Vehicle
from finssim.vehicles.body import Water as Fluid


def one_of(value: str, available: Sequence[str], what: str) -> str:
    """The value, if it is among the available ones; else a sentence that lists them."""
    if value not in available:
        close = difflib.get_close_matches(value, available, n=1)
        hint = f"; did you mean '{close[0]}'?" if close else ""
        raise SimulatorError(f"unknown {what} '{value}'; available: {', '.join(sorted(available))}{hint}")
    return value


def find_device(name: str) -> wp.Device:
    """The Warp device of that name, or a sentence that says which there are."""
    start_warp()
    if name.startswith("cuda") and not wp.is_cuda_available():
        raise SimulatorError(f"device '{name}' is not available here; available: cpu")
    try:
        return wp.get_device(name)
    except (ValueError, RuntimeError):
        have = ", ".join(str(d) for d in wp.get_devices())
        raise SimulatorError(f"device '{name}' is not available here; available: {have}") from None


def shared_water(vehicles: Sequence[Vehicle]) -> Fluid:
    """Density and gravity of the water that vehicles of one world swim in, which must agree in their files."""
    fluid = vehicles[0].water
    for other in vehicles[1:]:
        if other.water != fluid:
            raise SimulatorError(
                f"'{vehicles[0].name}' and '{other.name}' share a world but not their water "
                f"({fluid} and {other.water}): replace water.density and water.gravity of one"
            )
    return fluid


def broadcast(array: NDArray[Any], shape: tuple[int, int, int], what: str) -> NDArray[Any]:
    """The array for every world and vehicle."""
    try:
        return np.broadcast_to(array, shape)
    except ValueError:
        raise SimulatorError(
            f"{what} has shape {array.shape}, expected (worlds, vehicles, numbers) = {shape} or the last of these alone"
        ) from None
