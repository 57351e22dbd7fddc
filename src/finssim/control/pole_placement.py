"""PID gains that put the poles of an identified axis where they are wanted, the actuators' lag included."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from finssim.control.errors import ControlError
from finssim.geometry.rotations import cross
from finssim.vehicles import HydrodynamicSet, Vehicle
from finssim.vehicles.body import moved_to_origin

__all__ = ["AxisModel", "Gains", "axis_model", "place_poles"]

Array = npt.NDArray[np.float64]

POLE_SHARE = 0.25
"""The two working poles, as a part of the sum of all four: a quarter each leaves the rest to the fourth."""

INTEGRAL_RATIO = 0.2
"""The integral's pole, as a part of the working poles: slow enough that it hardly overshoots."""


@dataclass(frozen=True)
class AxisModel:
    """Six uncoupled axes m x'' + (d1 + d2 |x'|) x' + k x = tau about the wrench reference, body frame."""

    inertia: Array
    """m, rigid body and added mass [kg, kg m^2], (6,)."""
    linear_damping: Array
    """d1 [N s/m, N m s], (6,)."""
    quadratic_damping: Array
    """d2 [N s^2/m^2, N m s^2], (6,)."""
    stiffness: Array
    """k of roll and pitch about level, zero elsewhere [N m/rad], (6,)."""

    def damping(self, nu: npt.ArrayLike) -> Array:
        """d1 + d2 |nu| [N s/m, N m s], (..., 6).

        Args:
            nu: Velocity of the wrench reference, body frame [m/s, rad/s], (..., 6).
        """
        return np.asarray(self.linear_damping + self.quadratic_damping * np.abs(np.asarray(nu, float)))

    def coriolis(self, nu: npt.ArrayLike) -> Array:
        """C(nu) nu of the diagonal inertia, Munk moment included [N, N m], (..., 6).

        omega x (m v), and omega x (I omega) + v x (m v)                                        (Fossen 2021, eq. 6.43)

        Args:
            nu: Velocity of the wrench reference, body frame [m/s, rad/s], (..., 6).
        """
        nu = np.asarray(nu, float)
        v, omega, momentum = nu[..., :3], nu[..., 3:], self.inertia * nu
        turning = cross(omega, momentum[..., 3:]) + cross(v, momentum[..., :3])
        return np.concatenate([cross(omega, momentum[..., :3]), turning], axis=-1)


@dataclass(frozen=True)
class Gains:
    """tau = kp e + integral - kd x', with integral' = rate (the force that the model says is left over), per axis."""

    kp: Array
    """[N/m, N m/rad], (6,)."""
    kd: Array
    """[N s/m, N m s/rad], (6,)."""
    rate: Array
    """Rate at which the integral takes over an unknown force [1/s], (6,)."""


def axis_model(vehicle: Vehicle, hydrodynamics: str = "calibrated") -> AxisModel:
    """The diagonal of a vehicle's model at its wrench reference.

    Raises:
        ControlError: The set has no coefficients (it is a mesh).
        VehicleError: The vehicle has no set of that name.
    """
    chosen = vehicle.hydrodynamic_set(hydrodynamics)
    if not isinstance(chosen, HydrodynamicSet):
        raise ControlError(
            f"hydrodynamic set '{hydrodynamics}' of {vehicle.name} has no damping coefficients to place poles with: "
            "name one that does"
        )
    reference = np.asarray(vehicle.wrench_reference, float)
    arm = np.asarray(chosen.reference_point, float) - reference
    above = np.array([vehicle.body.center_of_buoyancy, vehicle.body.center_of_gravity])[:, 2] - reference[2]
    tilt_stiffness = vehicle.buoyancy * above[0] - vehicle.weight * above[1]
    return AxisModel(
        inertia=np.diag(moved_to_origin(vehicle.mass_matrix(hydrodynamics), -reference)),
        linear_damping=np.diag(moved_to_origin(np.asarray(chosen.linear_damping), arm)),
        quadratic_damping=np.diag(np.asarray(chosen.quadratic_damping)),
        stiffness=np.array([0.0, 0.0, 0.0, tilt_stiffness, tilt_stiffness, 0.0]),
    )


def place_poles(model: AxisModel, lag: float | Array, speed: npt.ArrayLike = 0.0) -> Gains:
    """Gains for poles at -w, -w, -w/5 and -b of every axis behind a first-order lag.

        lag m s^4 + (m + d lag) s^3 + (d + k lag + kd) s^2 + (k + Kp) s + Ki = lag m (s + w)^2 (s + w/5) (s + b)

    The lag fixes the sum of the poles, 1/lag + d/m; w is a quarter of it. Kp and Ki are those of the textbook PID.
    Here the integral follows

        integral' = rate ((kp + k) e - (kd - m rate + d) x'),

    the sum of forces a disturbance would show up in, so that a manoeuvre the model explains leaves nothing in it.
    Both laws are the same feedback when kp + k = Ki / rate and

        m rate^3 - (kd + d) rate^2 + (Kp + k) rate - Ki = 0.

    Where the water's own stiffness is more than that, kp < 0 would soften it through the lag: such an axis gets a slow
    integral and nothing else.

    Args:
        model: The axes.
        lag: Of the actuators: time constant, delay and half a control period [s], one or (6,).
        speed: Operating speed about which d = d1 + 2 d2 |speed| is taken, body frame [m/s, rad/s], (6,).
    """
    m, k = model.inertia, model.stiffness
    d = model.linear_damping + 2.0 * model.quadratic_damping * np.abs(np.asarray(speed, float))
    total = 1.0 / lag + d / m
    w = POLE_SHARE * total
    a = INTEGRAL_RATIO * w
    b = total - 2.0 * w - a
    Kp = lag * m * (w**2 * (a + b) + 2.0 * w * a * b) - k
    Ki = lag * m * w**2 * a * b
    kd = lag * m * (w**2 + 2.0 * w * (a + b) + a * b) - d - k * lag
    rate = np.array([_slowest(*axis) for axis in zip(m, kd + d, Kp + k, Ki, strict=True)])

    kp = Ki / rate - k
    passive = kp <= 0.0
    # A tenth of the axis' own decay rate, so that the integral cannot ring with the pendulum.
    return Gains(
        kp=np.where(passive, 0.0, kp),
        kd=np.where(passive, 0.0, kd),
        rate=np.where(passive, np.minimum(a, 0.1 * d / m), rate),
    )


def _slowest(m: float, damping: float, stiffness: float, integral: float) -> float:
    """Smallest root of m r^3 - damping r^2 + stiffness r - integral = 0 [1/s]: the slow pole without the lag."""
    roots = np.roots([m, -damping, stiffness, -integral])
    return float(np.min(roots.real[np.abs(roots.imag) < 1e-9 * np.abs(roots)]))
