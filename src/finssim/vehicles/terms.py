"""Hydrodynamic terms: contributions to the water's wrench beyond added mass and damping, one file per term.

This package reads their keys in a vehicle file; `finssim.physics.terms` registers terms and evaluates them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, create_model

from finssim.core.registry import TERMS
from finssim.vehicles.part import Part

__all__ = ["Term", "unit_of"]

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Term:
    """Term of the wrench that water exerts on a vehicle, with everything that the package needs to know about it.

    Its parameters are numbers, vectors of 3 or 6, or 6x6 matrices. If all of them are zero the wrench must be
    zero: vehicles without the term are simulated in the same batch with zero parameters.
    """

    name: str
    """Key in a hydrodynamic set of a vehicle file."""
    schema: Any
    """Schema of the key: a `Part` whose fields are the parameters, or the type of its only parameter."""
    units: Mapping[str, str]
    """Unit of each parameter by its name; an only parameter has the name of the term."""
    wrench: Any
    """`wp.func` -> vec6 [N, N m], body frame, about the reference point of the set; see `finssim.physics.terms`."""
    slope: Any = None
    """`wp.func` of the same arguments -> vec6: decrease of the wrench with the velocity on each axis, at
    least 0 [N s/m, N m s]. Required for stiff damping, which the integrator then treats implicitly; here nu_r
    is that of the point about which the inertia is nearly diagonal."""
    absent: Any = None
    """Value of the key if the file omits it."""
    quadratic: Callable[[Any], Array] = field(default=lambda value: np.zeros(6))
    """Function of the value of the key that returns its contribution to the drag d2 v|v| along each axis
    alone, (6,)."""
    check: Callable[[Any], tuple[bool, str]] | None = None
    """Function of the value of the key that returns whether it is plausible, and a sentence about it."""

    @cached_property
    def section(self) -> type[BaseModel]:
        """Model of a section of a vehicle file with only this key, which pydantic validates and writes."""
        fields: dict[str, Any] = {self.name: (self.schema, ...)}
        return create_model(self.name, __base__=Part, **fields)

    @cached_property
    def parameters(self) -> dict[str, str]:
        """Name of each parameter -> its path within a hydrodynamic set, `lift.coefficient`."""
        if isinstance(self.schema, type) and issubclass(self.schema, Part):
            return {name: f"{self.name}.{name}" for name in self.schema.model_fields}
        return {self.name: self.name}

    def read(self, value: Any) -> Any:
        """Return the validated value of the key; pydantic's error names the key."""
        return getattr(self.section.model_validate({self.name: value}), self.name)

    def plain(self, value: Any) -> Any:
        """Return the value as plain numbers, lists and dicts."""
        return self.section.model_construct({self.name}, **{self.name: value}).model_dump(exclude_unset=True)[
            self.name
        ]

    def numbers(self, value: Any) -> dict[str, Any]:
        """Return path of each parameter -> its number or array."""
        return {
            path: value if path == self.name else getattr(value, name)
            for name, path in self.parameters.items()
        }

    def scalars(self) -> dict[str, tuple[float, float]]:
        """Return path -> lowest and highest value allowed by the schema, for each scalar parameter.

        Values have the unit of the parameter.
        """
        if self.name in self.parameters:
            fields = self.section.model_fields
        else:
            fields = self.schema.model_fields
        out = {}
        for name, path in self.parameters.items():
            if fields[name].annotation is float:
                bounds = {
                    sign: getattr(m, sign)
                    for m in fields[name].metadata
                    for sign in ("gt", "ge", "lt", "le")
                    if getattr(m, sign, None) is not None
                }
                low, high = bounds.get("ge", bounds.get("gt")), bounds.get("le", bounds.get("lt"))
                out[path] = (-np.inf if low is None else low, np.inf if high is None else high)
        return out


def unit_of(path: str) -> str:
    """Return the unit of a term's parameter, by its path within a hydrodynamic set."""
    term, _, name = path.rpartition(".")
    return TERMS[term or name].units[name]
