"""The vehicle about the reference point of its coefficients, and what of its equation is known beforehand."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.core.registry import TERMS
from finssim.physics.terms.composed import parameter_row, term_wrenches
from finssim.sim.plant_arrays import twist_shift
from finssim.trials.findings import CalibrationError
from finssim.vehicles import HydrodynamicSet, Vehicle
from finssim.vehicles.terms import Term

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Matrices:
    """6x6 matrices and hydrostatics about one point of the body."""

    H: Array
    """Twist there from the twist at the body origin, (6, 6)."""
    M_RB: Array
    M_A: Array
    D1: Array
    D2: Array
    terms: tuple[Term, ...] = ()
    """Further terms of the wrench."""
    parameters: Mapping[str, Any] = field(default_factory=dict)
    """Of these, by path."""
    density: float
    """Of the water [kg/m³]."""
    excess: float
    """Buoyancy less weight, submerged [N]."""
    arm: Array
    """B r_b - W r_g from the reference point [N m], (3,): the hydrostatic moment is arm × up."""
    centre_of_buoyancy: Array
    """From the body origin [m], (3,)."""
    half_height: float
    """Of the layer in which buoyancy fades at the surface [m]."""

    def with_axis(self, axis: int, added_mass: float, d1: float, d2: float) -> Matrices:
        """With the diagonal entries of one axis replaced.

        Args:
            axis: 0 surge to 5 yaw.
            added_mass: [kg or kg m²]
            d1: Linear damping [N s/m or N m s].
            d2: Quadratic damping [N s²/m² or N m s²].
        """
        new = {name: getattr(self, name).copy() for name in ("M_A", "D1", "D2")}
        for name, value in zip(new, (added_mass, d1, d2), strict=True):
            new[name][axis, axis] = value
        return replace(self, **new)

    def submerged(self, position: Array, up: Array) -> NDArray[np.bool_]:
        """Where buoyancy is whole: the centre of buoyancy deeper than the fading layer, or depth unknown, (n,).

        Args:
            position: Body origin, world frame [m], (n, 3).
            up: World z in the body frame, (n, 3).
        """
        tilt = np.where(np.isfinite(up), up, [0.0, 0.0, 1.0])
        height = position[:, 2] + tilt @ self.centre_of_buoyancy
        return ~(height > -self.half_height)


def matrices(vehicle: Vehicle, density: float | None = None) -> Matrices:
    """Of a vehicle file.

    Args:
        vehicle: The vehicle.
        density: Of the water [kg/m³]; the file's where not given.

    Raises:
        CalibrationError: The set has no coefficients to calibrate.
    """
    chosen = vehicle.hydrodynamics.get("calibrated")
    if not isinstance(chosen, HydrodynamicSet):
        raise CalibrationError(
            f"{vehicle.name}: no coefficients in hydrodynamics.calibrated, expected a set with linear_damping and "
            "quadratic_damping: add one, zeros will do, for the fit to fill"
        )
    r = np.asarray(chosen.reference_point, float)
    H = twist_shift(r.tolist())
    back = np.linalg.inv(H)
    buoyancy = vehicle.buoyancy * (1.0 if density is None else density / vehicle.water.density)
    body = vehicle.body
    return Matrices(
        H=H,
        M_RB=back.T @ vehicle.rigid_body_mass_matrix() @ back,
        M_A=np.array(chosen.added_mass, float),
        D1=np.array(chosen.linear_damping, float),
        D2=np.array(chosen.quadratic_damping, float),
        terms=tuple(TERMS[name] for name in sorted(chosen.terms)),
        parameters=chosen.term_parameters,
        density=vehicle.water.density if density is None else density,
        excess=buoyancy - vehicle.weight,
        arm=buoyancy * (body.center_of_buoyancy - r) - vehicle.weight * (body.center_of_gravity - r),
        centre_of_buoyancy=np.asarray(body.center_of_buoyancy, float),
        half_height=body.surface_half_height,
    )


def known_wrench(nu: Array, up: Array, depth: Array, rate: float, plant: Matrices) -> Array:
    """What has to be taken off the applied wrench before an axis' own model is fitted.

    C(nu) nu + offdiag(M) nu_dot + offdiag(D1) nu + offdiag(D2) |nu| nu - (terms and hydrostatics that are not fitted)

    Fitted, hence not taken off, are the buoyancy excess in heave and the restoring moments of roll and pitch.

    Args:
        nu: About the reference point, body frame, zero where unknown [m/s, rad/s], (n, 6).
        up: World z in the body frame, (n, 3).
        depth: Of the body origin [m], zero where unknown, (n,).
        rate: [Hz]
        plant: The vehicle.

    Returns:
        (n, 6) [N, N m]
    """
    M = plant.M_RB + plant.M_A
    smooth = _smooth(nu)
    momentum = smooth @ M.T
    v, omega, p, h = smooth[:, :3], smooth[:, 3:], momentum[:, :3], momentum[:, 3:]
    known = np.concatenate([np.cross(omega, p), np.cross(v, p) + np.cross(omega, h)], axis=1)

    off = ~np.eye(6, dtype=bool)
    if (M * off).any() and len(nu) > 1:
        known += np.gradient(smooth, 1.0 / rate, axis=0) @ (M * off).T
    known += smooth @ (plant.D1 * off).T + (np.abs(smooth) * smooth) @ (plant.D2 * off).T
    if plant.terms:
        row = parameter_row(plant.terms, plant.parameters)
        known -= term_wrenches(plant.terms, [row], smooth, up, depth, plant.density)[:, 0]

    known[:, :2] -= plant.excess * up[:, :2]
    x, y, _ = plant.arm
    known[:, 3] -= y * up[:, 2]
    known[:, 4] += x * up[:, 2]
    known[:, 5] -= x * up[:, 1] - y * up[:, 0]
    return np.asarray(known)


def _smooth(nu: Array) -> Array:
    """Means of three samples with weights 1 2 1: products of two noisy velocities are formed from these."""
    if len(nu) < 3 or not nu.any():
        return nu
    padded = np.concatenate([nu[:1], nu, nu[-1:]])
    return np.asarray(0.25 * padded[:-2] + 0.5 * padded[1:-1] + 0.25 * padded[2:])
