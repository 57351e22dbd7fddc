"""Free parameters of a fit by simulation error: initial values, bounds and priors, and the resulting plants."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.core.registry import TERMS
from finssim.identification.plant_terms import UNITS, has_scalable_couplings, matrices, with_diagonal
from finssim.identification.vehicle_file import number_in
from finssim.physics.terms.composed import parameter_row, term_wrenches
from finssim.physics.types import MAX_THRUSTERS
from finssim.vehicles import AXES, HydrodynamicSet, Vehicle, VehicleError
from finssim.vehicles.actuators import installed
from finssim.vehicles.terms import unit_of

Array = NDArray[np.float64]


EXTRAS = ("thrust_scale", "thrust_lag", "thrust_delay", "buoyancy_excess", "k")
"""Parameters that can be estimated besides the axes' own numbers and the parameters of the vehicle's terms."""

MARGIN = 0.95
"""Fraction of the rigid-body inertia that a negative added mass may cancel."""

FELT, USUAL_SPEED = 0.02, 0.5
"""Fraction of the weight that a large change of a term's parameter amounts to, and speed on each axis [m/s,
rad/s]."""

LONGEST_DELAY = 1.0
"""Upper bound of a delay [s]."""

SHORTEST_LAG = 0.005
"""Time constant below which a time step of the simulation cannot resolve the lag [s]."""


@dataclass(frozen=True)
class Coordinate:
    """Number that is adjusted in a fit."""

    name: str
    unit: str
    start: float
    """Initial value, in the unit of the coordinate."""
    low: float
    """Lower bound, in the unit of the coordinate."""
    high: float
    """Upper bound, in the unit of the coordinate."""
    scale: float
    """Size of a large change; the step of finite differences is a small fraction of it."""
    std: float | None = None
    """Standard deviation of the prior about `start`; `VAGUE` times the scale if None, infinite without prior."""
    rigid: float | None = None
    """Rigid-body inertia of the axis; if given, the prior is that of ln(rigid + coordinate), and `std` is
    dimensionless."""


@dataclass(frozen=True)
class Plants:
    """Simulator's parameters for W vectors."""

    fields: dict[str, Array]
    """Fields of `VehicleParameters` in their units, (W, 1, ...)."""
    bias: Array
    """Constant wrench, about the body origin, body frame [N, N m], (W, 1, 6)."""
    lag: Array | None
    """Time constant of the motors [s], (W,)."""
    delay: Array | None
    """Delay of the motors [s], (W,)."""
    lower: Array | None = None
    """Heights of the horizontal thrusters relative to those of the file [m], (W,)."""
    gains: Array | None = None
    """Thrust of each thruster relative to the vehicle file's, times the common scale [-], (W, MAX_THRUSTERS)."""


def term_coordinate(chosen: HydrodynamicSet, vehicle: Vehicle, path: str) -> Coordinate:
    """Return a coordinate for a parameter of a term; a large change causes a force of `FELT` of the weight at
    `USUAL_SPEED`."""
    terms = tuple(TERMS[name] for name in sorted(chosen.terms))
    numbers = chosen.term_parameters
    start = float(numbers[path])
    rows = [parameter_row(terms, numbers | {path: x}) for x in (start, start + 1.0)]
    nu = USUAL_SPEED * np.array([[1.0, 1.0, 1.0, 1.0, 1.0, 1.0]])
    tau = term_wrenches(terms, rows, nu, [[0.0, 0.0, 1.0]], 1.0, vehicle.water.density)[0]
    change = float(np.abs(tau[1] - tau[0]).max())
    scale = max(abs(start), FELT * vehicle.weight / change if change > 0.0 else 1.0)
    return Coordinate(path, unit_of(path), start, *chosen.term_scalars[path], scale)


def actuator_fields(vehicle: Vehicle) -> dict[str, dict[str, float]]:
    """Return parameter of a kind of actuator, `fin.lift_slope` -> field of the plant and number of each
    actuator of that kind.

    A fit adjusts one factor for all of them. Each number has the unit of its kind.
    """
    out: dict[str, dict[str, float]] = {}
    for item, section in installed(vehicle).items():
        numbers = item.numbers(section, vehicle)
        for name in item.kind.scalars:
            path = item.parameters[name]
            out.setdefault(f"{item.kind.name}.{name}", {})[path] = float(numbers[path])
    return out


def scaled_actuators(vehicle: Vehicle, name: str, factor: float) -> dict[str, float]:
    """Return the changes of the vehicle file that multiply a parameter of all actuators of a kind, `fin.lift_slope`.

    Args:
        vehicle: The vehicle.
        name: Kind and parameter.
        factor: Factor on the number of each actuator [-].

    Returns:
        Path of each number -> its new value, in the unit of the parameter.
    """
    kind, _, key = name.partition(".")
    if kind == "propeller":
        return {
            f"thrusters.{n}.inflow.{key}": factor * float(getattr(t.inflow, key))
            for n, t in vehicle.thrusters.items()
            if t.inflow is not None
        }
    return {
        f"actuators.{n}.{key}": factor * float(getattr(a, key))
        for n, a in vehicle.actuators.items()
        if a.kind == kind
    }


LIKELY_SCALE, SCALE_STD = 0.88, 0.17
"""Thrust of a battery between full and empty, relative to that at the voltage of the thruster's table, and
the standard deviation of its logarithm: thrust is proportional to the square of a voltage of 3.3 to 4.2 V per
cell, 0.68 to 1.10 of that in the table at 16 V (0.14), and propellers of one model differ by a tenth."""

ADDED_MASS_STD, RIGID_STD, INERTIA_STD = 0.7, 0.35, 0.5
"""Standard deviation of an added mass, relative to the larger of the vehicle file's value and its rigid-body mass,
and of the logarithm of an effective moment of inertia: published sets of one vehicle differ by this much."""

PLACE_STD = {"measured": 0.005, "derived": 0.03, "published": 0.03, "guessed": 0.05}
"""Standard deviation of a height or centre in the vehicle file by its origin [m]."""

GAINS, GAIN_STD, COMMON_STD = "thruster_gains", 0.05, 1e-3
"""Name of the option for individual thruster gains relative to the file, each a coordinate `gain.NAME`; their
standard deviation; and that of their mean, since their common factor is the scale of thrust."""

DETERMINED = 0.8
"""Standard deviation of a position, relative to that of its prior, up to which it is written to the vehicle file."""

PUBLISHED_STD = 0.1
"""Standard deviation of a published top speed or bollard pull, relative to the largest thrust."""

CENTRES = ("gravity_x", "gravity_y", "gravity_z")
PLACES = ("thruster_height", *CENTRES)
"""Positions that are free if roll or pitch is fitted: the common height of the horizontal thrusters, and the
centre of gravity. The centre of buoyancy follows from the latter, the stiffness and the constant moments."""


def places(vehicle: Vehicle) -> dict[str, str]:
    """Return the paths of `PLACES` in the file; for the common height, that of the first of the thrusters."""
    paths = [f"thrusters.{name}.position.2" for name in horizontal(vehicle)[:1]]
    return dict(zip(PLACES, paths, strict=False)) | {
        n: f"body.center_of_gravity.{j}" for j, n in enumerate(CENTRES)
    }


def origin(vehicle: Vehicle, path: str) -> str:
    """Return the origin of a number in the file; `guessed` if the file states none."""
    try:
        return str(vehicle.origin_of(path).origin)
    except VehicleError:
        return "guessed"


def horizontal(vehicle: Vehicle) -> list[str]:
    """Return the names of the thrusters that push horizontally."""
    return [name for name, t in vehicle.thrusters.items() if abs(t.axis[2]) < SIDEWAYS]


SIDEWAYS = 0.5
"""Magnitude of the vertical component of a thruster's axis below which it pushes horizontally [-]."""


class Parameters:
    """Free parameters of a fit.

    Every coordinate is bounded, and every vector within the bounds yields a plant with positive definite M_RB
    + M_A and dissipative damping: the bounds of a diagonal fit are d1, d2 >= 0 and an added mass that keeps
    M_RB + M_A positive definite even if all axes are at their bounds. Bounds are used because damping may be
    exactly zero: a logarithm never reaches zero and would yield a misleading interval.

    Attributes:
        coordinates: Coordinates in the order of a vector.
        expected: Numbers of the vehicle file, (P,).
    """

    def __init__(
        self,
        vehicle: Vehicle,
        *,
        axes: Sequence[str],
        damping: dict[str, str],
        extras: Sequence[str] = (),
        biases: Sequence[str] = (),
        start: Mapping[str, float] | None = None,
        imposed: Sequence[str] = (),
        unseen: Sequence[str] = (),
        held: Mapping[str, float] | None = None,
        likely: bool = False,
        published: Mapping[str, float] | None = None,
    ) -> None:
        """Select the free parameters.

        Args:
            vehicle: Vehicle with the initial values and everything that is not free.
            axes: Axes whose added mass and damping are free.
            damping: `linear`, `quadratic` or `both` by axis; the omitted term is zero.
            extras: Names from `EXTRAS`, `GAINS`, the parameters of the vehicle's terms, such as
                `lift.coefficient`, and of its actuators.
            biases: Axes with a constant wrench b, about the set's reference point and on the side of the
                damping: M nu_dot + D nu + b = tau.
            start: Coordinate -> initial value, in its unit, instead of the vehicle file's number.
            imposed: Axes that are not fitted: only their added mass is free, since its momentum rotates and
                pushes the other axes. Their coordinates come last.
            unseen: Axes of `imposed` without measurements, which are therefore simulated: their drag is free.
            held: Effective inertias M_RB + M_A that are not free, by axis [kg, kg m²].
            likely: True if the scale of thrust has the prior of usual batteries.
            published: Known values of `top_speed` [m/s] and `bollard_pull` [N], both ahead.

        Raises:
            CalibrationError: The calibrated set contains no coefficients.
        """
        plant, chosen = matrices(vehicle), vehicle.hydrodynamics["calibrated"]
        assert isinstance(chosen, HydrodynamicSet)
        self.vehicle, self.set = vehicle, chosen
        self.axes = tuple(a for a in AXES if a in axes)
        self.imposed = tuple(a for a in AXES if a in imposed)
        self.unseen = tuple(a for a in self.imposed if a in unseen)
        self.index = np.array([AXES.index(a) for a in self.axes], int)
        self.damping, self.extras = damping, tuple(extras)
        self.likely, self.published = likely, dict(published or {})
        self.terms = tuple(path for path in self.set.term_scalars if path in extras)
        self.actuators = {name: fields for name, fields in actuator_fields(vehicle).items() if name in extras}
        self.gains = tuple(f"gain.{name}" for name in vehicle.thrusters if GAINS in extras)
        self.biases = tuple(a for a in AXES if a in biases)
        self.r_h = np.asarray(self.set.reference_point, float)
        self.H, self.M_RB, self.M_A = plant.H, plant.M_RB, plant.M_A
        self.D1, self.D2 = plant.D1, plant.D2
        self.held = dict(held or {})
        added = np.diag(self.M_A).copy()
        for a, m in self.held.items():
            i = AXES.index(a)
            added[i] = m - self.M_RB[i, i]
        self.M_A = with_diagonal(self.M_A, added)
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
        kinds = {"linear": ("d1",), "quadratic": ("d2",), "both": ("d1", "d2")}
        out = []
        for axis, floor in zip(self.axes, self.mass_floor().tolist(), strict=True):
            out += [self._of_axis(axis, "added_mass", floor)] if axis not in self.held else []
            out += [self._of_axis(axis, kind) for kind in kinds[self.damping[axis]]]
        w, inf = self.vehicle, np.inf
        weight, B = w.weight, w.buoyancy
        k = float(matrices(w).arm[2])
        tc = float(np.mean([t.time_constant for t in w.thrusters.values()] or [0.0]))  # a glider has none
        late = float(np.mean([t.delay for t in w.thrusters.values()] or [0.0]))
        scale = (
            (LIKELY_SCALE, 0.05, 20.0, 1.0, SCALE_STD, 0.0) if self.likely else (1.0, 0.05, 20.0, 1.0, inf)
        )
        table = {
            "thrust_scale": ("-", *scale),
            "thrust_lag": ("s", max(tc, 0.02), SHORTEST_LAG, 5.0, 2.0),
            "thrust_delay": ("s", late, 0.0, LONGEST_DELAY, 0.2),
            "buoyancy_excess": ("N", B - weight, -0.9 * weight, 10.0 * weight, 0.02 * weight),
            "k": ("N m/rad", max(k, 1e-3), 0.0, inf, max(k, 0.02 * B)),
        }
        for name, path in places(w).items():
            table[name] = ("m", float(number_in(w, path) or 0.0), -inf, inf, 0.2, PLACE_STD[origin(w, path)])
        out += [Coordinate(name, *numbers) for name, numbers in table.items() if name in self.extras]
        out += [term_coordinate(self.set, w, path) for path in self.terms]
        out += [Coordinate(name, "-", 1.0, 0.02, 50.0, 1.0) for name in self.actuators]
        out += [Coordinate(name, "-", 1.0, 0.0, 2.0, 1.0, GAIN_STD) for name in self.gains]
        out += [self._of_axis(axis, "bias", -inf) for axis in self.biases]
        for axis in self.imposed:
            i = AXES.index(axis)
            out.append(self._of_axis(axis, "added_mass", min(float(self.M_A[i, i]), 0.0)))
        return out + [self._of_axis(axis, kind) for axis in self.unseen for kind in ("d1", "d2")]

    def _of_axis(self, axis: str, kind: str, low: float = 0.0) -> Coordinate:
        """Return an axis' own added mass, d1, d2 or bias, initialised with the vehicle file's number."""
        i = AXES.index(axis)
        m, bias = float((self.M_RB + self.M_A)[i, i]), np.zeros((6, 6))
        own, size = {
            "added_mass": (self.M_A, m),
            "d1": (self.D1, m),
            "d2": (self.D2, 3.0 * m),
            "bias": (bias, max(0.5 * m, 1e-3)),
        }[kind]
        unit = UNITS["m_eff" if kind == "added_mass" else kind][i > 2]
        std = rigid = None
        if kind == "added_mass":
            rigid = float(self.M_RB[i, i])
            std = max(ADDED_MASS_STD * float(own[i, i]), RIGID_STD * rigid) / m if i < 3 else INERTIA_STD
        return Coordinate(f"{axis}.{kind}", unit, float(own[i, i]), low, np.inf, size, std, rigid)

    def prior_rows(self) -> tuple[Array, Array]:
        """Return rows (R, P) and targets (R,) of the priors of linear combinations of coordinates, over their
        standard deviations.

        Drag at the top speed equals the largest thrust, and so does a bollard pull; the scale is 1 if it is
        not free. The mean of the gains of individual thrusters is 1.
        """
        largest = float(self.vehicle.wrench_limits[0]) if self.published else 1.0
        rows, target = np.zeros((len(self.published), len(self.names))), np.zeros(len(self.published))
        scale = self._at.get("thrust_scale")
        for row, (name, value), k in zip(rows, self.published.items(), range(len(target)), strict=True):
            if name == "top_speed":
                for key, power in (("surge.d1", 1), ("surge.d2", 2)):
                    row[self._at[key] if key in self._at else []] = value**power
                target[k] = largest if scale is None else 0.0
            else:
                target[k] = -value
            row[[] if scale is None else scale] = -largest
        rows, target = rows / (PUBLISHED_STD * largest), target / (PUBLISHED_STD * largest)
        if self.gains:
            mean = np.isin(self.names, self.gains) / len(self.gains)
            rows, target = np.vstack([rows, mean / COMMON_STD]), np.append(target, 1.0 / COMMON_STD)
        return rows, target

    @property
    def nuisances(self) -> int:
        """Return the number of nuisance coordinates, which come last."""
        return len(self.imposed) + 2 * len(self.unseen)

    def mass_floor(self) -> Array:
        """Return the lowest added mass of each free axis, (n,), for which M is positive definite if all are
        at it [kg, kg m²].

        It is zero if the couplings of the file's M_A are scaled with its diagonal. Otherwise M_RB (or, if the
        file couples axes, all of M) minus κ diag(c), c = 1/diag(M⁻¹), is positive definite for κ below the
        smallest eigenvalue of M scaled by c.
        """
        couplings = self.M_A - np.diag(np.diag(self.M_A))
        if has_scalable_couplings(self.M_A):
            return np.zeros(len(self.axes))
        M, base = (
            (self.M_RB, np.zeros(6)) if not couplings.any() else (self.M_RB + self.M_A, np.diag(self.M_A))
        )
        c = 1.0 / np.diag(np.linalg.inv(M))
        kappa = MARGIN * float(np.linalg.eigvalsh(M / np.sqrt(np.outer(c, c)))[0])
        return np.asarray((base - kappa * c)[self.index])

    # -- plants -------------------------------------------------------------------------------------------------

    def value(self, x: Array, name: str, default: float | None = None) -> Any:
        """Return the column of a coordinate in vectors (W, P), or a default. The unit is that of the coordinate."""
        return x[:, self._at[name]] if name in self._at else default

    def matrices(self, x: Array) -> tuple[Array, Array, Array]:
        """Return M_A, D1 and D2 at the set's reference point, (W, 6, 6) each.

        Couplings are scaled with the diagonals (`with_diagonal`).

        Units: [kg], [N s/m] and [N s²/m²], with the corresponding ones of moments.
        """
        x = np.clip(np.atleast_2d(x), self.low, self.high)
        out = []
        for kind, matrix in (("added_mass", self.M_A), ("d1", self.D1), ("d2", self.D2)):
            diagonal = np.tile(np.diag(matrix), (len(x), 1))
            for i, axis in enumerate(AXES):
                diagonal[:, i] = self.value(x, f"{axis}.{kind}", diagonal[:, i])
            out.append(with_diagonal(matrix, diagonal))
        return out[0], out[1], out[2]

    def centre_of_gravity(self, x: Array) -> Array:
        """Return the centre of gravity of vectors (W, P) [m], (W, 3)."""
        file = np.tile(np.asarray(self.vehicle.body.center_of_gravity, float), (len(x), 1))
        return np.stack([self.value(x, name, file[:, j]) for j, name in enumerate(CENTRES)], axis=-1)

    def moved(self, x: Array) -> Vehicle:
        """Return the vehicle with the centres of a vector (P,); the moment of weight and buoyancy is unchanged."""
        if not set(CENTRES) & set(self.names):
            return self.vehicle
        body, r_g = self.vehicle.body, self.centre_of_gravity(x[None])[0]
        shift = self.vehicle.weight / self.vehicle.buoyancy * (r_g - body.center_of_gravity)
        r_b = body.center_of_buoyancy + shift
        return self.vehicle.replace(
            {"body.center_of_gravity": r_g.tolist(), "body.center_of_buoyancy": r_b.tolist()}
        )

    def plants(self, x: Array) -> Plants:
        """Return the simulator's parameters.

        Args:
            x: Vectors in the units of the coordinates, (W, P); numbers outside the bounds are clipped.
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
        free_centre, tilted = bool(set(CENTRES) & set(self.names)), {"roll", "pitch"} & set(self.biases)
        if "k" in self._at or free_centre or tilted:
            r_g, file, B = (
                self.centre_of_gravity(x),
                body.center_of_gravity,
                water.density * water.gravity * volume,
            )
            r_b = body.center_of_buoyancy + (self.vehicle.weight / B)[:, None] * (r_g - file)
            if "k" in self._at:
                z = self.r_h[2]
                r_b[:, 2] = z + (self.value(x, "k") + self.vehicle.weight * (r_g[:, 2] - z)) / B
            # A weight that tilts a vehicle at rest is off its centre of gravity, and acts when it rolls or pitches.
            r_b[:, 0] += self.value(x, "pitch.bias", 0.0) / B
            r_b[:, 1] -= self.value(x, "roll.bias", 0.0) / B
            fields["r_b"] = r_b[:, None]
        if free_centre:
            outer = np.einsum("wi,wj->wij", r_g, r_g)
            trace = np.trace(outer, axis1=1, axis2=2)[:, None, None]
            inertia = np.asarray(body.inertia, float) + body.mass * (trace * np.eye(3) - outer)
            fields |= {"r_g": r_g[:, None], "inertia": inertia[:, None]}
        for path in self.terms:
            fields[path] = self.value(x, path)[:, None]
        for name, numbers in self.actuators.items():
            factor = self.value(x, name)[:, None]
            fields |= {field: factor * number for field, number in numbers.items()}
        if "thrust_scale" in self._at:
            n, others = len(self.vehicle.thrusters), len(self.vehicle.actuators)
            gain = np.repeat(self.value(x, "thrust_scale")[:, None, None], MAX_THRUSTERS, axis=-1)
            gain[..., n : n + others] = 1.0
            fields["gain"] = gain
        gains = np.ones((W, MAX_THRUSTERS))
        for j, name in enumerate(self.gains):
            gains[:, j] = self.value(x, name)
        bias = np.zeros((W, 1, 6))
        for axis in set(self.biases) - tilted:
            bias[:, 0, AXES.index(axis)] = -self.value(x, f"{axis}.bias")
        return Plants(
            fields=fields,
            bias=bias @ self.H,
            lag=self.value(x, "thrust_lag"),
            delay=self.value(x, "thrust_delay"),
            lower=None if (z := self.value(x, PLACES[0])) is None else z - self.expected[self._at[PLACES[0]]],
            gains=gains if self.gains else None,
        )
