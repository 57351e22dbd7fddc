"""The hydrodynamic sets of a vehicle file: coefficients, or drag of the hull's panels."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Discriminator, Tag

from finssim.vehicles.part import Matrix6, NonNegative, Part, Symmetric6, Vector3, zeros


class HydrodynamicSet(Part):
    """Coefficients of tau_D = -[D1 + D2 diag(|nu_r|) + Du |u_r|] nu_r and of the added mass  (paper, eq. 1-2).

    Body axes, order surge sway heave roll pitch yaw. Positive diagonal entries take energy out.
    The file gives 6 diagonal entries or 6 rows of 6.
    """

    added_mass: Symmetric6 = zeros(6, 6)
    """M_A [kg, kg m, kg m²], (6, 6)."""
    linear_damping: Matrix6
    """D1 [N s/m, N s, N m s], (6, 6)."""
    quadratic_damping: Matrix6
    """D2 [N s²/m², ..., N m s²], (6, 6)."""
    surge_damping: Matrix6 = zeros(6, 6)
    """Du, multiplied by the surge speed |u_r|, (6, 6)."""
    reference_point: Vector3 = zeros(3)
    """Body point at which velocity and wrench of these coefficients are taken [m], (3,)."""


class MeshSet(Part):
    """Drag coefficients of the hull mesh's panels (paper, eq. 3-4), plus an optional added mass."""

    form_drag: NonNegative
    """C_form [-]"""
    skin_drag: NonNegative
    """C_skin [-]"""
    added_mass: Symmetric6 = zeros(6, 6)
    """M_A at `reference_point` [kg, kg m, kg m²], (6, 6)."""
    reference_point: Vector3 = zeros(3)
    """Body point at which `added_mass` holds [m], (3,)."""


def _kind(value: Any) -> str:
    if isinstance(value, MeshSet) or (
        isinstance(value, dict) and ("form_drag" in value or "skin_drag" in value)
    ):
        return "<mesh>"
    return "<coefficients>"


AnyHydrodynamicSet = Annotated[
    Annotated[HydrodynamicSet, Tag("<coefficients>")] | Annotated[MeshSet, Tag("<mesh>")],
    Discriminator(_kind),
]
