"""What a plant's file says of the water and of the forces on the hull."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from finssim.pool.coupled import PrincipalAxes, Section, Six, Three

__all__ = ["AddedMass", "BuoyancyDrift", "Circulation", "Damping", "Eddy", "HullDrag", "SlackTether"]

Array = NDArray[np.float64]
Rows = tuple[Six, Six, Six, Six, Six, Six]


class AddedMass(PrincipalAxes):
    """M_A = Tᵀ A T, with T from the body origin to these axes."""

    matrix: Rows
    """A, symmetric [kg, kg m, kg m²]."""

    @model_validator(mode="after")
    def _physical(self) -> AddedMass:
        A = np.array(self.matrix)
        if not np.allclose(A, A.T, rtol=0.0, atol=1e-9 * np.abs(A).max(initial=1.0)):
            raise ValueError("matrix is not symmetric: added mass is an energy, give a symmetric matrix")
        if np.linalg.eigvalsh(A)[0] < -1e-9:
            raise ValueError("matrix has a negative eigenvalue, expected positive semidefinite")
        return self

    def about_origin(self) -> Array:
        """M_A about the body origin, (6, 6)."""
        T = self.to_axes()
        return np.asarray(T.T @ np.array(self.matrix) @ T)


class Damping(PrincipalAxes):
    """tau_D = -Tᵀ [D1 x + D2 (|x| x)], x = T nu_r: dissipative for every velocity."""

    linear: Rows
    """D1 [N s/m, N s, N m s]."""
    quadratic: Rows
    """D2 [N s²/m², ..., N m s²]."""

    @model_validator(mode="after")
    def _dissipative(self) -> Damping:
        D1, D2 = np.array(self.linear), np.array(self.quadratic)
        if np.linalg.eigvalsh(D1 + D1.T)[0] < -1e-9:
            raise ValueError("linear adds energy: its symmetric part has a negative eigenvalue")
        # |x_i| x_j² <= (|x_i|³ + 2 |x_j|³) / 3, so these margins suffice for x · D2 (|x| x) >= 0.
        off = np.abs(D2 - np.diag(np.diag(D2)))
        if np.any(np.diag(D2) - off.sum(axis=1) / 3.0 - 2.0 * off.sum(axis=0) / 3.0 < -1e-9):
            raise ValueError("quadratic may add energy: an off-diagonal entry is too large for its diagonal")
        return self


class HullDrag(Section):
    """Drag of the hull mesh's panels (paper, eq. 4), besides the damping."""

    form_drag: float = Field(default=0.0, ge=0.0)
    skin_drag: float = Field(default=0.0, ge=0.0)


class BuoyancyDrift(Section):
    """Bubbles, warming air and soaking foam: slow changes of buoyancy, a sum of sines."""

    grams: tuple[float, ...] = ()
    """Amplitude of each [g]."""
    periods: tuple[float, ...] = ()
    """[s]"""
    phases: tuple[float, ...] = ()
    """[rad]"""

    @model_validator(mode="after")
    def _same_length(self) -> BuoyancyDrift:
        if not len(self.grams) == len(self.periods) == len(self.phases):
            raise ValueError("grams, periods and phases differ in length: give each sine all three")
        if any(period <= 0.0 for period in self.periods):
            raise ValueError("periods must exceed 0 s")
        return self


class SlackTether(Section):
    """A line that hangs slack and pulls only when it is nearly straight."""

    anchor: Three
    """Where it leaves the pool's edge, world frame [m]."""
    attachment: Three
    """On the vehicle, body frame [m]."""
    length: float = Field(gt=0.0)
    """[m]"""
    stiffness: float = Field(default=15.0, ge=0.0)
    """Of its last stretch before it is straight [N/m]."""
    slack_share: float = Field(default=0.08, gt=0.0, lt=1.0)
    """The pull sets in at (1 - slack_share) length [-]."""
    diameter: float = Field(default=0.004, gt=0.0)
    """[m]"""
    drag_coefficient: float = Field(default=0.5, ge=0.0)
    """Of a cylinder; less than 1.2, since a slack line follows only in part."""
    wet_weight: float = 0.0
    """[N/m]; negative floats."""


class Eddy(Section):
    """One mode of the pool's circulation: `cells` eddies side by side along x."""

    cells: int = Field(ge=1, le=4)
    speed: float = Field(ge=0.0, le=0.5)
    """Largest, at the surface [m/s]."""
    unsteadiness: float = Field(ge=0.0, le=1.0)
    """Part of the speed that comes and goes [-]."""
    period: float = Field(gt=0.0)
    """[s]"""
    phase: float
    """[rad]"""
    sense: Literal[-1, 1] = 1
    """1: anticlockwise from above."""


class Swell(Section):
    """One linear wave."""

    amplitude: float = Field(ge=0.0)
    """Half the height from trough to crest [m]."""
    wavelength: float = Field(gt=0.0)
    """[m]"""
    heading: float = 0.0
    """Direction of travel, from world x towards y [rad]."""
    phase: float = 0.0
    """[rad]"""


class Circulation(Section):
    """The current: eddies that vanish at the walls, and in open water a stream and waves."""

    stream: Three = (0.0, 0.0, 0.0)
    """The same everywhere, world frame [m/s]."""
    waves: tuple[Swell, ...] = ()
    eddies: tuple[Eddy, ...] = ()
    floor_share: float = Field(default=0.5, ge=0.0, le=1.0)
    """Speed at the floor over that at the surface [-]."""
