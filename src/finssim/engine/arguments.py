"""What a simulator is given, checked: names, devices, vehicles that share a world."""

import difflib
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from finssim.engine.plant_arrays import SimulatorError
from finssim.physics.types import MAX_THRUSTERS
from finssim.quiet import start_warp
from finssim.vehicles import Vehicle
from finssim.vehicles.vehicle import Water as Fluid


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


def placed_at(name: str, value: ArrayLike, shape: tuple[int, int]) -> NDArray[np.float32]:
    """A position, quaternion or velocity to place vehicles at, for every world and vehicle; quaternions of length 1."""
    array = np.asarray(value, dtype=np.float32)
    if not np.isfinite(array).all():
        raise SimulatorError(f"{name} to place a vehicle at has a number that is not finite")
    if name == "quaternion":
        length = np.linalg.norm(array, axis=-1, keepdims=True)
        if not (length > 0.0).all():
            raise SimulatorError("quaternion to place a vehicle at has length 0, expected 1 (xyzw)")
        array = array / length
    full = broadcast(array, (*shape, {"position": 3, "quaternion": 4, "velocity": 6}[name]), name)
    return np.ascontiguousarray(full, dtype=np.float32)


def thrust_table(force: ArrayLike, vehicles: Sequence[Vehicle], worlds: int) -> NDArray[np.float32]:
    """Thruster forces for every world and vehicle, zero for the thrusters that a vehicle does not have.

    Args:
        force: Along the thrusters' axes [N], shape broadcastable to (worlds, vehicles, n), n thrusters of the
            vehicle that has most.
        vehicles: In their order.
        worlds: How many.

    Returns:
        [N], (worlds, vehicles, `MAX_THRUSTERS`).

    Raises:
        SimulatorError: The shape is wrong or a number is not finite.
    """
    f = np.asarray(force, dtype=np.float32)
    n = max(len(v.thrusters) for v in vehicles)
    if f.ndim == 0 or f.shape[-1] != n:
        got = f.shape[-1] if f.ndim else 0
        most = " of the vehicle that has most" if len(vehicles) > 1 else ""
        raise SimulatorError(f"thrust command has {got} numbers, expected {n}: one per thruster{most}")
    if not np.isfinite(f).all():
        raise SimulatorError(
            "thrust command has a number that is not finite: send a force in N for every thruster"
        )
    full = np.zeros((worlds, len(vehicles), MAX_THRUSTERS), dtype=np.float32)
    full[..., :n] = broadcast(f, (*full.shape[:2], n), "thrust command")
    return full
