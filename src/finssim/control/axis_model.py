"""Model of a vehicle as six uncoupled axes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from finssim.control import ControlError
from finssim.core.rotations import cross
from finssim.vehicles import HydrodynamicSet, Vehicle
from finssim.vehicles.vehicle import moved_to_origin

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class AxisModel:
    """Six uncoupled axes m x'' + (d1 + d2 |x'|) x' + k x = tau about the wrench reference, body frame."""

    inertia: Array
    """Inertia m, rigid body and added mass [kg, kg m^2], (6,)."""
    linear_damping: Array
    """Linear damping d1 [N s/m, N m s], (6,)."""
    quadratic_damping: Array
    """Quadratic damping d2 [N s^2/m^2, N m s^2], (6,)."""
    stiffness: Array
    """Stiffness k of roll and pitch about level attitude, zero elsewhere [N m/rad], (6,)."""

    def damping(self, nu: npt.ArrayLike) -> Array:
        """Return d1 + d2 |nu| [N s/m, N m s], (..., 6).

        Args:
            nu: Velocity of the wrench reference, body frame [m/s, rad/s], (..., 6).
        """
        return np.asarray(self.linear_damping + self.quadratic_damping * np.abs(np.asarray(nu, float)))

    def terminal_speed(self, tau: Array) -> Array:
        """Return the positive root of d1 v + d2 v^2 = tau, infinite without damping [m/s, rad/s], (6,).

        Args:
            tau: Magnitude of the wrench on every axis, body frame [N, N m], (6,).
        """
        d1, d2 = self.linear_damping, self.quadratic_damping
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(
                np.where(d1 + d2 > 0.0, 2.0 * tau / (d1 + np.sqrt(d1**2 + 4.0 * d2 * tau)), np.inf)
            )

    def coriolis(self, nu: npt.ArrayLike) -> Array:
        """Return C(nu) nu of the diagonal inertia, including the Munk moment [N, N m], (..., 6).

        omega x (m v), and omega x (I omega) + v x (m v)                                        (Fossen 2021, eq. 6.43)

        Args:
            nu: Velocity of the wrench reference, body frame [m/s, rad/s], (..., 6).
        """
        nu = np.asarray(nu, float)
        v, omega, momentum = nu[..., :3], nu[..., 3:], self.inertia * nu
        turning = cross(omega, momentum[..., 3:]) + cross(v, momentum[..., :3])
        return np.concatenate([cross(omega, momentum[..., :3]), turning], axis=-1)


def axis_model(vehicle: Vehicle, hydrodynamics: str = "calibrated") -> AxisModel:
    """Return the diagonal of a vehicle's model at its wrench reference.

    Raises:
        ControlError: The set has no coefficients (it is a mesh), or the vehicle has no thrusters.
        VehicleError: The vehicle has no set of that name.
    """
    chosen = vehicle.hydrodynamic_set(hydrodynamics)
    if not vehicle.thrusters:
        raise ControlError(
            f"{vehicle.name} has no thrusters to control its axes: command its other actuators, or use a "
            "vehicle with thrusters"
        )
    if not isinstance(chosen, HydrodynamicSet):
        raise ControlError(
            f"hydrodynamic set '{hydrodynamics}' of {vehicle.name} has no damping coefficients for the placement of "
            "poles: name one with coefficients"
        )
    reference = np.asarray(vehicle.wrench_reference, float)
    arm = np.asarray(chosen.reference_point, float) - reference
    above = np.array([vehicle.body.center_of_buoyancy, vehicle.body.center_of_gravity])[:, 2] - reference[2]
    tilt_stiffness = vehicle.buoyancy * above[0] - vehicle.weight * above[1]
    return AxisModel(
        inertia=np.diag(moved_to_origin(vehicle.mass_matrix(hydrodynamics), -reference)),
        linear_damping=np.diag(moved_to_origin(np.asarray(chosen.linear_damping), arm)),
        quadratic_damping=chosen.axis_drag,
        stiffness=np.array([0.0, 0.0, 0.0, tilt_stiffness, tilt_stiffness, 0.0]),
    )
