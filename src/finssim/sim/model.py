"""The equation of motion of one vehicle as a function of arrays."""

# mypy: disable-error-code="no-untyped-call,no-untyped-def,untyped-decorator,valid-type"

from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from finssim.core.quiet import start_warp
from finssim.core.rotations import quat_from_euler
from finssim.physics.hydrodynamics import HYDRODYNAMICS
from finssim.physics.hydrodynamics.mesh import HullMesh, hull_mesh
from finssim.physics.plant import refresh_plant
from finssim.physics.tether import Tether
from finssim.physics.types import MAX_THRUSTERS, vec6, vec8
from finssim.sim.plant_arrays import SimulatorError, build_plant
from finssim.sim.simulator import checked_choice, find_device
from finssim.sim.step import Instant, SimSurroundings, Vehicles, motion_function
from finssim.sim.water import Water
from finssim.vehicles import Vehicle, load_vehicle

__all__ = ["acceleration"]


def acceleration(
    vehicle: Vehicle | str | Path,
    eta: ArrayLike,
    nu: ArrayLike,
    tau: ArrayLike = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    *,
    actuators: ArrayLike | None = None,
    hydrodynamics: str = "calibrated",
) -> NDArray[np.float64]:
    """Return the acceleration of a vehicle in still, open water.

    (M_RB + s M_A) nu_dot = tau - C_RB(nu) nu - s C_A(nu) nu - s D(nu) nu - g(eta)      (Fossen 2021, eq. 6.1)

    where s is the wet fraction of the vehicle's volume. It is the equation that `Simulator` integrates, in
    single precision.

    Args:
        vehicle: A vehicle, the name of one in the catalogue, or the path of a vehicle file.
        eta: Position of the body origin, world frame [m], and attitude, (..., 6) with roll, pitch and yaw [rad], or
            (..., 7) with a quaternion body to world, xyzw. The world's z is up, and 0 on the water surface.
        nu: Velocity of the body origin, body frame [m/s, rad/s], (..., 6).
        tau: Wrench of all other external loads, about the body origin, body frame [N, N m],
            (..., 6).
        actuators: Steady value of each actuator, (..., n) in the order of `Vehicle.channel_names`: static thrust [N]
            of a thruster, angle [rad], volume [m³] or position [m] of another; all 0 if None.
        hydrodynamics: Hydrodynamic model: calibrated, mesh or simplified.

    Returns:
        nu_dot, body frame [m/s², rad/s²], (..., 6), broadcast over the leading axes of the arguments.

    Raises:
        SimulatorError: A shape does not fit, a number is not finite, a quaternion has length 0, or the
            vehicle has no such model.
        VehicleError: There is no such vehicle.
    """
    start_warp()
    body = load_vehicle(vehicle)
    checked_choice(hydrodynamics, tuple(HYDRODYNAMICS), "hydrodynamic model")
    n = len(body.channel_names)
    arrays = {"eta": (eta, (6, 7)), "nu": (nu, (6,)), "tau": (tau, (6,))}
    arrays["actuators"] = (np.zeros(n) if actuators is None else actuators, (n,))
    checked = [_checked(name, value, lengths) for name, (value, lengths) in arrays.items()]
    try:
        shape = np.broadcast_shapes(*(array.shape[:-1] for array in checked))
    except ValueError:
        shapes = ", ".join(f"{name} {array.shape}" for name, array in zip(arrays, checked, strict=True))
        raise SimulatorError(f"the leading axes of {shapes} do not broadcast") from None
    pose, velocity, wrench, values = (
        np.broadcast_to(array, (*shape, array.shape[-1])).reshape(-1, array.shape[-1]) for array in checked
    )
    if pose.shape[1] == 6:
        quaternion = quat_from_euler(*pose[:, 3:].T)
    else:
        length = np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)
        if not (length > 0.0).all():
            raise SimulatorError("eta holds a quaternion of length 0, expected 1 (xyzw)")
        quaternion = pose[:, 3:] / length
    channels = np.zeros((len(values), MAX_THRUSTERS))
    channels[:, :n] = values
    columns = (
        (pose[:, :3], wp.vec3), (quaternion, wp.quat), (velocity, vec6), (wrench, vec6), (channels, vec8),
    )  # fmt: skip
    inputs = [wp.array(column.astype(np.float32), dtype=kind, device="cpu") for column, kind in columns]
    nu_dot = wp.zeros(len(pose), dtype=vec6, device="cpu")
    kernel, parameters = _model(body, hydrodynamics)
    wp.launch(kernel, len(pose), [*inputs, *parameters, nu_dot], device="cpu")
    return nu_dot.numpy().astype(np.float64).reshape(*shape, 6)


def _checked(name: str, value: ArrayLike, lengths: tuple[int, ...]) -> NDArray[np.float64]:
    """Return an argument as an array whose last axis has one of the given lengths."""
    array = np.asarray(value, dtype=np.float64)
    if array.ndim == 0 or array.shape[-1] not in lengths:
        expected = " or ".join(f"(..., {length})" for length in lengths)
        raise SimulatorError(f"{name} has shape {array.shape}, expected {expected}")
    if not np.isfinite(array).all():
        raise SimulatorError(f"{name} has a number that is not finite")
    return array


@lru_cache(maxsize=16)
def _model(vehicle: Vehicle, model: str) -> tuple[wp.Kernel, list[Any]]:
    """Return the kernel of a vehicle's model and its parameters that follow the states."""
    device = find_device("cpu")
    plant = build_plant([vehicle], model, 1, [0], device)
    everywhere = wp.ones(1, dtype=wp.int32, device=device)
    wp.launch(refresh_plant, (1, 1), [plant.array, 1.0, everywhere, 0], device=device)
    fluid = vehicle.water
    water = Water().arrays(1, fluid.density, fluid.gravity, device, 0)
    vehicles, around = Vehicles(), SimSurroundings()
    vehicles.plant, vehicles.extra = plant.array, plant.extra
    around.hull = hull_mesh([vehicle.hull_mesh()], device) if model == "mesh" else HullMesh()
    around.water, around.tether = water, wp.zeros((1, 1), dtype=Tether, device=device)
    return _acceleration_kernel(model, plant.terms), [vehicles, around]


@cache
def _acceleration_kernel(model: str, terms: tuple[Any, ...]) -> wp.Kernel:
    """Return the kernel that evaluates one hydrodynamic model with the given terms."""
    motion_at = motion_function(model, True, terms=terms)

    @wp.kernel(enable_backward=False, module="unique")
    def evaluate(
        position: wp.array(dtype=wp.vec3),
        quaternion: wp.array(dtype=wp.quat),
        nu: wp.array(dtype=vec6),
        tau: wp.array(dtype=vec6),
        values: wp.array(dtype=vec8),
        vehicles: Vehicles,
        around: SimSurroundings,
        nu_dot: wp.array(dtype=vec6),
    ):
        i = wp.tid()
        moment = Instant()
        moment.position = position[i]
        moment.quaternion = quaternion[i]
        moment.velocity = nu[i]
        moment.before = nu[i]
        moment.thrust = values[i]
        moment.pushed = vehicles.plant[0, 0].G * values[i]
        moment.other = tau[i]
        nu_dot[i] = motion_at(vehicles, around.hull, around.water, around.tether, 0, 0, moment).nu_dot

    return evaluate
