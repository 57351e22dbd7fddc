"""Hydrodynamic sets of a vehicle file: coefficients, or drag of the hull's panels."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Discriminator, Tag, model_serializer, model_validator

from finssim.core.registry import TERMS, RegistryError
from finssim.vehicles.part import (
    Matrix6,
    NonNegative,
    Part,
    Symmetric6,
    Vector3,
    did_you_mean,
    refuse_section,
    zeros,
)


class HydrodynamicSet(Part):
    """Coefficients of tau_D = -[D1 + D2 diag(|nu_r|)] nu_r and of the added mass (paper, eq. 1-2), and
    additional terms.

    Body axes, order surge sway heave roll pitch yaw. Positive diagonal entries dissipate energy.
    The file contains 6 diagonal entries or 6 rows of 6. Each additional term is a further key (see `Term`);
    as an attribute, a term that the file omits has the term's `absent` value.
    """

    model_config = ConfigDict(frozen=True, extra="allow", arbitrary_types_allowed=True)

    added_mass: Symmetric6 = zeros(6, 6)
    """M_A [kg, kg m, kg m²], (6, 6)."""
    linear_damping: Matrix6
    """D1 [N s/m, N s, N m s], (6, 6)."""
    quadratic_damping: Matrix6
    """D2 [N s²/m², ..., N m s²], (6, 6)."""
    reference_point: Vector3 = zeros(3)
    """Body point to which velocity and wrench of these coefficients refer [m], (3,)."""

    @model_validator(mode="before")
    @classmethod
    def _known_keys_only(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            return data
        out = dict(data)
        for key in [key for key in data if key not in cls.model_fields]:
            try:
                term = TERMS.get(str(key))
            except RegistryError as error:
                raise refuse_section(str(error)) from error
            if term is None:
                allowed = [*cls.model_fields, *TERMS]
                raise refuse_section(
                    f"unknown key '{key}'{did_you_mean(str(key), allowed)} known keys: {', '.join(allowed)}"
                )
            out[key] = term.read(data[key])
        return out

    @model_serializer(mode="wrap")
    def _plain(self, handler: Any) -> dict[str, Any]:
        of_terms = {key: TERMS[key].plain(value) for key, value in self.terms.items()}
        return {key: of_terms.get(key, value) for key, value in handler(self).items()}

    def __getattr__(self, name: str) -> Any:
        try:
            return super().__getattr__(name)  # type: ignore[misc]
        except AttributeError:
            if name not in TERMS:
                raise
        return TERMS[name].absent

    @property
    def terms(self) -> dict[str, Any]:
        """Key -> value of the terms in the file."""
        return dict(sorted((self.model_extra or {}).items()))

    @property
    def term_parameters(self) -> dict[str, Any]:
        """Path -> number or array of every parameter of its terms, such as `lift.coefficient`."""
        items = self.terms.items()
        return {path: x for name, value in items for path, x in TERMS[name].numbers(value).items()}

    @property
    def term_scalars(self) -> dict[str, tuple[float, float]]:
        """Path -> least and greatest value of the scalar parameters of its terms, which fits may change.

        Values have the unit of the parameter.
        """
        return {path: ends for name in self.terms for path, ends in TERMS[name].scalars().items()}

    @property
    def axis_drag(self) -> NDArray[np.float64]:
        """Return d2 [N s²/m², N m s²] of steady motion along each axis alone, where drag is d1 v + d2 v|v|, (6,)."""
        shares = (TERMS[name].quadratic(value) for name, value in self.terms.items())
        return np.asarray(sum(shares, start=np.diag(self.quadratic_damping)))


class MeshSet(Part):
    """Drag coefficients of the hull mesh's panels (paper, eq. 3-4), plus an optional added mass."""

    form_drag: NonNegative
    """Form-drag coefficient C_form [-]."""
    skin_drag: NonNegative
    """Skin-friction coefficient C_skin [-]."""
    added_mass: Symmetric6 = zeros(6, 6)
    """M_A at `reference_point` [kg, kg m, kg m²], (6, 6)."""
    reference_point: Vector3 = zeros(3)
    """Body point to which `added_mass` refers [m], (3,)."""


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
