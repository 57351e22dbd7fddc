"""Matrices and hydrostatics of the vehicle about the reference point of its coefficients."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finssim.sim.plant_arrays import twist_shift
from finssim.trials.findings import CalibrationError
from finssim.vehicles import HydrodynamicSet, Vehicle

Array = NDArray[np.float64]


SET = "hydrodynamics.calibrated"

UNITS = {
    "m_eff": ("kg", "kg m²"),
    "d1": ("N s/m", "N m s"),
    "d2": ("N s²/m²", "N m s²"),
    "bias": ("N", "N m"),
    "k": ("N m/rad", "N m/rad"),
}
"""Units of the numbers of an axis, for translation and rotation."""


@dataclass(frozen=True, kw_only=True)
class Matrices:
    """6x6 matrices and hydrostatics about one point of the body."""

    H: Array
    """Matrix from the twist at the body origin to that at the point [-, m], (6, 6)."""
    M_RB: Array
    """Rigid-body inertia [kg, kg m²]."""
    M_A: Array
    """Added mass [kg, kg m²]."""
    D1: Array
    """Linear damping [N s/m, N m s]."""
    D2: Array
    """Quadratic damping [N s²/m², N m s²]."""
    excess: float
    """Buoyancy minus weight, submerged [N]."""
    arm: Array
    """B r_b - W r_g from the reference point [N m], (3,): the hydrostatic moment is arm × up."""


def matrices(vehicle: Vehicle) -> Matrices:
    """Return the matrices of a vehicle file.

    Args:
        vehicle: The vehicle.

    Raises:
        CalibrationError: The set has no coefficients to calibrate.
    """
    chosen = vehicle.hydrodynamics.get("calibrated")
    if not isinstance(chosen, HydrodynamicSet):
        raise CalibrationError(
            f"{vehicle.name}: no coefficients in hydrodynamics.calibrated, expected a set with linear_damping and "
            "quadratic_damping: add one; zeros are sufficient, as the fit replaces them"
        )
    r = np.asarray(chosen.reference_point, float)
    H = twist_shift(r.tolist())
    back = np.linalg.inv(H)
    body = vehicle.body
    return Matrices(
        H=H,
        M_RB=back.T @ vehicle.rigid_body_mass_matrix() @ back,
        M_A=np.array(chosen.added_mass, float),
        D1=np.array(chosen.linear_damping, float),
        D2=np.array(chosen.quadratic_damping, float),
        excess=vehicle.buoyancy - vehicle.weight,
        arm=vehicle.buoyancy * (body.center_of_buoyancy - r) - vehicle.weight * (body.center_of_gravity - r),
    )


def with_diagonal(matrix: Array, diagonal: Array) -> Array:
    """Return a matrix of the vehicle file with another diagonal, and with couplings scaled accordingly.

    Entry (i, j) is multiplied by √(a_i a_j), where a_i is the factor on diagonal entry i. This keeps a matrix positive
    semidefinite. A matrix that is not positive semidefinite keeps its couplings.

    Args:
        matrix: Added mass [kg, kg m²] or damping [N s/m, N s²/m²], with the units of moments, (6, 6).
        diagonal: New diagonal in the units of the matrix, (..., 6).

    Returns:
        Matrix in the units of the given one, (..., 6, 6).
    """
    own = np.diag(matrix)
    out = np.broadcast_to(matrix, (*diagonal.shape, 6)).copy()
    if has_scalable_couplings(matrix):
        factor = np.divide(diagonal, own, out=np.ones_like(diagonal), where=own > 0.0)
        root = np.sqrt(np.maximum(factor, 0.0))
        out *= root[..., :, None] * root[..., None, :]
    out[..., range(6), range(6)] = diagonal
    return out


def has_scalable_couplings(matrix: Array) -> bool:
    """Return whether a matrix, of any unit, has couplings and is positive semidefinite (see `with_diagonal`)."""
    coupled = bool(np.any(matrix - np.diag(np.diag(matrix))))
    return coupled and bool(np.linalg.eigvalsh(0.5 * (matrix + matrix.T))[0] >= 0.0)
