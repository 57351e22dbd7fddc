"""From a vector of numbers to the plants of parallel worlds, such that every vector gives a plant that can be."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.engine.plant_arrays import twist_shift, vehicle_parameters
from finssim.physics.terms.composed import parameter_row, term_wrenches
from finssim.vehicles import AXES, Vehicle
from finssim.vehicles.hydrodynamics import HydrodynamicSet
from finssim.vehicles.terms import TERMS, unit_of

__all__ = ["EXTRAS", "Parameters", "LONGEST_DELAY"]

Array = NDArray[np.float64]


EXTRAS = ("thrust_scale", "thrust_lag", "thrust_delay", "current", "buoyancy_excess", "k")
"""What can be estimated besides the axes' own numbers and the parameters of the vehicle's terms."""

MARGIN = 0.95
"""Part of the rigid-body inertia that a negative added mass may take away."""

FELT, USUAL_SPEED = 0.02, 0.5
"""Part of the weight, and speed on each axis [m/s, rad/s]."""

LONGEST_DELAY = 1.0
"""[s]"""

SHORTEST_LAG = 0.005
"""Time constant below which a step of the simulation shows no lag [s]."""


@dataclass(frozen=True)
class Coordinate:
    """One number that a fit moves."""

    name: str
    unit: str
    start: float
    low: float
    high: float
    scale: float
    """What counts as a large change; finite differences step a small part of it."""


@dataclass(frozen=True)
class Plants:
    """What W vectors mean to the simulator."""

    fields: dict[str, Array]
    """Fields of `VehicleParameters`, (W, 1, ...)."""
    bias: Array
    """Constant wrench that acts, about the body origin, body frame [N, N m], (W, 1, 6)."""
    current: Array | None
    """World frame [m/s], to be added to the segments' own, (W, 1, 3)."""
    lag: Array | None
    """Time constant of the motors [s], (W,)."""
    delay: Array | None
    """[s], (W,)"""


def term_coordinate(chosen: HydrodynamicSet, vehicle: Vehicle, path: str) -> Coordinate:
    """A parameter of a term; a large change of it makes a force of `FELT` of the weight at `USUAL_SPEED`."""
    terms = tuple(TERMS[name] for name in sorted(chosen.terms))
    numbers = chosen.term_parameters
    start = float(numbers[path])
    rows = [parameter_row(terms, numbers | {path: x}) for x in (start, start + 1.0)]
    nu = USUAL_SPEED * np.array([[1.0, 1.0, 1.0, 1.0, 1.0, 1.0]])
    tau = term_wrenches(terms, rows, nu, [[0.0, 0.0, 1.0]], 1.0, vehicle.water.density)[0]
    change = float(np.abs(tau[1] - tau[0]).max())
    scale = max(abs(start), FELT * vehicle.weight / change if change > 0.0 else 1.0)
    return Coordinate(path, unit_of(path), start, *chosen.term_scalars[path], scale)


class Parameters:
    """The free numbers of a fit.

    Every coordinate lies in a box, and every vector of the box gives a plant with positive definite M_RB + M_A and
    damping that takes energy out: the bounds of a diagonal fit are d1, d2 >= 0 and an added mass that leaves M_RB
    positive definite even if all axes are at their bounds. A box, because damping
    may well be exactly zero: a logarithm never reaches it and would make its interval look like an estimate's.

    Attributes:
        coordinates: In the order of a vector.
        expected: The vehicle file's numbers, (P,).
    """

    def __init__(
        self,
        vehicle: Vehicle,
        *,
        axes: Sequence[str],
        damping: dict[str, str],
        extras: Sequence[str] = (),
        biases: Sequence[str] = (),
        hydrodynamics: str = "calibrated",
        start: Mapping[str, float] | None = None,
        imposed: Sequence[str] = (),
        unseen: Sequence[str] = (),
    ) -> None:
        """Choose what is free.

        Args:
            vehicle: Gives the start and everything that is not free.
            axes: Whose added mass and damping are free.
            damping: `linear`, `quadratic` or `both` by axis; what is left out is zero.
            extras: Of `EXTRAS`, and parameters of the vehicle's terms, such as `lift.coefficient`.
            biases: Axes with a constant wrench b, about the set's reference point and on the side of the damping:
                M nu_dot + D nu + b = tau.
            hydrodynamics: Which set of coefficients.
            start: Coordinate -> where it starts, in place of the vehicle file's number.
            imposed: Axes that are not fitted: their added mass alone is free, for its momentum turns and pushes the
                others. Their coordinates come last.
            unseen: Those of `imposed` that no trial measured, and that therefore are simulated: their drag is free too.

        Raises:
            CalibrationError: the set holds no coefficients, or an extra is not known.
        """
        chosen = vehicle.hydrodynamic_set(hydrodynamics)
        if not isinstance(chosen, HydrodynamicSet):
            raise CalibrationError(
                f"{vehicle.name}: hydrodynamics.{hydrodynamics} has no damping coefficients to fit: give another set"
            )
        own = chosen.term_scalars
        unknown = sorted(set(extras) - {*EXTRAS, *own})
        if unknown:
            raise CalibrationError(
                f"cannot estimate '{unknown[0]}'; available: {', '.join([*EXTRAS, *own])} and the numbers of every axis"
            )
        self.vehicle, self.hydrodynamics, self.set = vehicle, hydrodynamics, chosen
        self.axes = tuple(a for a in AXES if a in axes)
        self.imposed = tuple(a for a in AXES if a in imposed)
        self.unseen = tuple(a for a in self.imposed if a in unseen)
        self.index = np.array([AXES.index(a) for a in self.axes], int)
        self.damping, self.extras = damping, tuple(extras)
        self.terms = tuple(path for path in own if path in extras)
        self.biases = tuple(a for a in AXES if a in biases)
        self.r_h = np.asarray(chosen.reference_point, float)
        self.H = twist_shift(self.r_h.tolist())
        self.M_RB = np.linalg.inv(self.H).T @ vehicle.rigid_body_mass_matrix() @ np.linalg.inv(self.H)
        self.nominal = vehicle_parameters(vehicle, hydrodynamics)
        self.M_A = np.asarray(chosen.added_mass, float)
        self.D1 = np.asarray(chosen.linear_damping, float).copy()
        self.D2 = np.asarray(chosen.quadratic_damping, float).copy()
        for a, i in zip(self.axes, self.index, strict=True):
            if damping[a] == "linear":
                self.D2[i, :] = self.D2[:, i] = 0.0
            elif damping[a] == "quadratic":
                self.D1[i, :] = self.D1[:, i] = 0.0
        self.coordinates = tuple(self._coordinates())
        self.names = tuple(c.name for c in self.coordinates)
        self.start, self.low, self.high, self.scale = (
            np.array([getattr(c, name) for c in self.coordinates], float)
            for name in ("start", "low", "high", "scale")
        )
        self.expected = np.clip(self.start, self.low, self.high)
        self._at = {name: i for i, name in enumerate(self.names)}
        for name, value in (start or {}).items():
            if name in self._at:
                self.start[self._at[name]] = value
        self.start = np.clip(self.start, self.low, self.high)

    # -- coordinates --------------------------------------------------------------------------------------------

    def _coordinates(self) -> list[Coordinate]:
        out = self._diagonal()
        w, inf = self.vehicle, np.inf
        weight, B = w.weight, w.buoyancy
        z = self.r_h[2]
        k = B * (w.body.center_of_buoyancy[2] - z) - weight * (w.body.center_of_gravity[2] - z)
        tc = float(np.mean([t.time_constant for t in w.thrusters.values()]))
        late = float(np.mean([t.delay for t in w.thrusters.values()]))
        table = {
            "k": [Coordinate("k", "N m/rad", max(float(k), 1e-3), 0.0, inf, max(float(k), 0.02 * B))],
            "buoyancy_excess": [
                Coordinate("buoyancy_excess", "N", B - weight, -0.9 * weight, 10.0 * weight, 0.02 * weight)
            ],
            "thrust_scale": [Coordinate("thrust_scale", "-", 1.0, 0.05, 20.0, 1.0)],
            "thrust_lag": [Coordinate("thrust_lag", "s", max(tc, 0.02), SHORTEST_LAG, 5.0, 2.0)],
            "thrust_delay": [Coordinate("thrust_delay", "s", late, 0.0, LONGEST_DELAY, 0.2)],
            "current": [Coordinate(f"current.{a}", "m/s", 0.0, -5.0, 5.0, 0.2) for a in "xy"],
        }
        for extra in EXTRAS:
            if extra in self.extras:
                out += table[extra]
        out += [term_coordinate(self.set, w, path) for path in self.terms]
        for axis in self.biases:
            i = AXES.index(axis)
            size = 0.5 * float((self.M_RB + self.M_A)[i, i])
            out.append(Coordinate(f"{axis}.bias", "N" if i < 3 else "N m", 0.0, -inf, inf, max(size, 1e-3)))
        for axis in self.imposed:
            i = AXES.index(axis)
            m, own = float((self.M_RB + self.M_A)[i, i]), float(self.M_A[i, i])
            out.append(
                Coordinate(f"{axis}.added_mass", "kg" if i < 3 else "kg m²", own, min(own, 0.0), inf, m)
            )
        for axis in self.unseen:
            i = AXES.index(axis)
            m = float((self.M_RB + self.M_A)[i, i])
            for name, matrix, size in (("d1", self.D1, m), ("d2", self.D2, 3.0 * m)):
                unit = ("N s/m", "N s²/m²")[name == "d2"] if i < 3 else ("N m s", "N m s²")[name == "d2"]
                out.append(Coordinate(f"{axis}.{name}", unit, float(matrix[i, i]), 0.0, inf, size))
        return out

    @property
    def nuisances(self) -> int:
        """How many coordinates, the last ones, are there for the sake of the others."""
        return len(self.imposed) + 2 * len(self.unseen)

    def mass_floor(self) -> Array:
        """Lowest added mass of each free axis, (n,): M stays positive definite with all of them there.

        M_RB (or, where the file couples axes, all of M) less κ diag(c), c = 1/diag(M⁻¹), is positive definite for κ
        below the smallest eigenvalue of M scaled by c.
        """
        couplings = self.M_A - np.diag(np.diag(self.M_A))
        M, base = (
            (self.M_RB, np.zeros(6)) if not couplings.any() else (self.M_RB + self.M_A, np.diag(self.M_A))
        )
        c = 1.0 / np.diag(np.linalg.inv(M))
        kappa = MARGIN * float(np.linalg.eigvalsh(M / np.sqrt(np.outer(c, c)))[0])
        return np.asarray((base - kappa * c)[self.index])

    def _diagonal(self) -> list[Coordinate]:
        out = []
        for axis, i, floor in zip(self.axes, self.index, self.mass_floor(), strict=True):
            linear = i < 3
            m = float((self.M_RB + self.M_A)[i, i])
            out.append(
                Coordinate(
                    f"{axis}.added_mass", "kg" if linear else "kg m²", float(self.M_A[i, i]), floor, np.inf, m
                )
            )
            kind = self.damping[axis]
            if kind in ("linear", "both"):
                unit = "N s/m" if linear else "N m s"
                out.append(Coordinate(f"{axis}.d1", unit, float(self.D1[i, i]), 0.0, np.inf, m))
            if kind in ("quadratic", "both"):
                unit = "N s²/m²" if linear else "N m s²"
                out.append(Coordinate(f"{axis}.d2", unit, float(self.D2[i, i]), 0.0, np.inf, 3.0 * m))
        return out

    # -- plants -------------------------------------------------------------------------------------------------

    def value(self, x: Array, name: str, default: float | None = None) -> Any:
        """Column of a coordinate in vectors (W, P), or a default."""
        return x[:, self._at[name]] if name in self._at else default

    def matrices(self, x: Array) -> tuple[Array, Array, Array]:
        """M_A, D1 and D2 at the set's reference point, (W, 6, 6) each."""
        x = np.clip(np.atleast_2d(x), self.low, self.high)
        M_A, D1, D2 = (np.repeat(m[None], len(x), axis=0) for m in (self.M_A, self.D1, self.D2))
        for axis in self.imposed:
            i = AXES.index(axis)
            M_A[:, i, i] = self.value(x, f"{axis}.added_mass")
        for axis in self.unseen:
            i = AXES.index(axis)
            D1[:, i, i], D2[:, i, i] = self.value(x, f"{axis}.d1"), self.value(x, f"{axis}.d2")
        for axis, i in zip(self.axes, self.index, strict=True):
            for matrix, word in ((M_A, "added_mass"), (D1, "d1"), (D2, "d2")):
                if f"{axis}.{word}" in self._at:
                    matrix[:, i, i] = self.value(x, f"{axis}.{word}")
        return M_A, D1, D2

    def buoyancy_height(self, k: Any, volume: Any) -> Any:
        """z of the centre of buoyancy [m] that gives a stiffness k about the set's reference point [N m/rad]."""
        water, z = self.vehicle.water, self.r_h[2]
        gravity_part = self.vehicle.weight * (self.vehicle.body.center_of_gravity[2] - z)
        return z + (k + gravity_part) / (water.density * water.gravity * volume)

    def plants(self, x: Array) -> Plants:
        """What the simulator needs.

        Args:
            x: Vectors, (W, P); numbers outside the box count as on its edge.
        """
        x = np.clip(np.atleast_2d(x), self.low, self.high)
        W = len(x)
        M_A, D1, D2 = self.matrices(x)
        fields: dict[str, Array] = {}
        if self.axes or self.imposed:
            M_A = self.H.T @ M_A @ self.H
            fields |= {"M_A": M_A[:, None], "D1": D1[:, None], "D2": D2[:, None]}
        water, body = self.vehicle.water, self.vehicle.body
        volume = np.full(W, body.displaced_volume)
        if "buoyancy_excess" in self._at:
            weight = self.vehicle.weight
            volume = (weight + self.value(x, "buoyancy_excess")) / (water.density * water.gravity)
            fields["volume"] = volume[:, None]
        if "k" in self._at:
            r_b = np.tile(np.asarray(body.center_of_buoyancy, float), (W, 1, 1))
            r_b[:, 0, 2] = self.buoyancy_height(self.value(x, "k"), volume)
            fields["r_b"] = r_b
        for path in self.terms:
            fields[path] = self.value(x, path)[:, None]
        if "thrust_scale" in self._at:
            fields["gain"] = np.repeat(self.value(x, "thrust_scale")[:, None, None], 8, axis=-1)
        bias = np.zeros((W, 1, 6))
        for axis in self.biases:
            bias[:, 0, AXES.index(axis)] = -self.value(x, f"{axis}.bias")
        current = None
        if "current.x" in self._at:
            current = np.zeros((W, 1, 3))
            current[:, 0, 0], current[:, 0, 1] = self.value(x, "current.x"), self.value(x, "current.y")
        return Plants(
            fields=fields,
            bias=bias @ self.H,
            current=current,
            lag=self.value(x, "thrust_lag"),
            delay=self.value(x, "thrust_delay"),
        )
