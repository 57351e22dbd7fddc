"""Hydrodynamics by simulation error: numbers with which the simulator, driven as the vehicle was, moves as it did."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finssim.core.least_squares import Block, arrow_reduced, block_of, boxed, huber_cost, huber_weight
from finssim.core.registry import TERMS
from finssim.core.rotations import (
    quat_conjugate,
    quat_from_rotvec,
    quat_multiply,
    quat_rotate,
    wrap_angle,
)
from finssim.identification.axis_result import (
    CERTAIN,
    SET,
    UNITS,
    AxisResult,
    Number,
    hydrostatics,
)
from finssim.identification.fit import Curve, Estimate, Fit
from finssim.identification.plant_terms import matrices
from finssim.identification.release import released
from finssim.identification.rollout import (
    CHANNELS,
    DETERMINED_BY,
    Response,
    Rollouts,
    Segment,
    Streams,
    segments,
    streams,
    without,
)
from finssim.identification.uncertainty import (
    Covariance,
    Evidence,
    correlated_samples,
    degeneracy,
    intervals,
    trial_covariance,
)
from finssim.identification.vehicle_file import number_in, scaled_thrust
from finssim.identification.weak_form import weak_form
from finssim.physics.terms.composed import parameter_row, term_wrenches
from finssim.physics.types import MAX_THRUSTERS
from finssim.sim.plant_arrays import twist_shift
from finssim.trials.conversion import EULER
from finssim.trials.findings import CalibrationError, Finding, finding
from finssim.trials.inputs import require_axes, require_fittable
from finssim.trials.motion import Motion, gyroscope_bias
from finssim.trials.trial import COLUMNS, Trial
from finssim.vehicles import AXES, HydrodynamicSet, Vehicle, VehicleError
from finssim.vehicles.actuators import installed
from finssim.vehicles.terms import unit_of

__all__ = ["EXTRAS", "fit_by_simulation"]

Array = NDArray[np.float64]


# The fit of simulations to segments; finite differences are worlds.

EXTRAS = ("thrust_scale", "thrust_lag", "thrust_delay", "buoyancy_excess", "k")
"""Parameters that can be estimated besides the axes' own numbers and the parameters of the vehicle's terms."""

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
    """First value, in the unit of the coordinate."""
    low: float
    """Lower bound, in the unit of the coordinate."""
    high: float
    """Upper bound, in the unit of the coordinate."""
    scale: float
    """Size of a large change; finite differences take a small share of it as step."""
    std: float | None = None
    """Prior standard deviation about `start`; `VAGUE` times the scale if None, infinite where nothing is known."""
    rigid: float | None = None
    """Rigid inertia of the axis; if given, the prior is that of ln(rigid + coordinate), and `std` has no unit."""


@dataclass(frozen=True)
class Plants:
    """Simulator's parameters for W vectors."""

    fields: dict[str, Array]
    """Fields of `VehicleParameters` in their units, (W, 1, ...)."""
    bias: Array
    """Constant wrench that acts, about the body origin, body frame [N, N m], (W, 1, 6)."""
    lag: Array | None
    """Time constant of the motors [s], (W,)."""
    delay: Array | None
    """[s], (W,)"""
    lower: Array | None = None
    """Heights of the horizontal thrusters above those of the file [m], (W,)."""


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


def actuator_fields(vehicle: Vehicle) -> dict[str, dict[str, float]]:
    """Parameter of a kind of actuator, `fin.lift_slope` -> field of the plant and number of each actuator of that kind.

    A fit moves one factor on all of them. Each number has the unit of its kind.
    """
    out: dict[str, dict[str, float]] = {}
    for item, section in installed(vehicle).items():
        numbers = item.numbers(section, vehicle)
        for name in item.kind.scalars:
            path = item.parameters[name]
            out.setdefault(f"{item.kind.name}.{name}", {})[path] = float(numbers[path])
    return out


def scaled_actuators(vehicle: Vehicle, name: str, factor: float) -> dict[str, float]:
    """Changes of the vehicle file that multiply a parameter of all actuators of a kind, `fin.lift_slope`.

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
"""Thrust of a battery on its way from full to empty, over that at the voltage of the thruster's table, and the standard
deviation of its logarithm: thrust goes with the square of a voltage of 3.3 to 4.2 V a cell (0.14), and propellers of
one make differ by a tenth."""

ADDED_MASS_STD, RIGID_STD, INERTIA_STD = 0.7, 0.35, 0.5
"""Standard deviation of an added mass, as parts of the vehicle file's and of its rigid mass, whichever is more, and of
the logarithm of an effective moment of inertia: published sets of one vehicle differ by as much."""

PLACE_STD = {"measured": 0.005, "derived": 0.03, "published": 0.03, "guessed": 0.05}
"""Standard deviation of a height or centre of the vehicle file by its origin [m]."""

DETERMINED = 0.8
"""Standard deviation of a place, as a part of that of its prior, up to which it goes to the vehicle file."""

PUBLISHED_STD = 0.1
"""Standard deviation of a published top speed or bollard pull, as a part of the largest thrust."""

CENTRES = ("gravity_x", "gravity_y", "gravity_z")
PLACES = ("thruster_height", *CENTRES)
"""Places that are free where roll or pitch is fitted: the common height of the thrusters that push sideways, and the
centre of gravity. The centre of buoyancy follows from it, the stiffness and the constant moments."""


def places(vehicle: Vehicle) -> dict[str, str]:
    """Return the paths of `PLACES` in the file, that of the height of the first of the thrusters that share it."""
    paths = [f"thrusters.{name}.position.2" for name in horizontal(vehicle)[:1]]
    return dict(zip(PLACES, paths, strict=False)) | {
        n: f"body.center_of_gravity.{j}" for j, n in enumerate(CENTRES)
    }


def origin(vehicle: Vehicle, path: str) -> str:
    """Return the origin of a number of the file; `guessed` where it states none."""
    try:
        return str(vehicle.origin_of(path).origin)
    except VehicleError:
        return "guessed"


def horizontal(vehicle: Vehicle) -> list[str]:
    """Return the names of the thrusters that push sideways."""
    return [name for name, t in vehicle.thrusters.items() if abs(t.axis[2]) < SIDEWAYS]


SIDEWAYS = 0.5
"""Vertical part of the axis of a thruster below which it pushes sideways [-]."""


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
        start: Mapping[str, float] | None = None,
        imposed: Sequence[str] = (),
        unseen: Sequence[str] = (),
        held: Mapping[str, float] | None = None,
        likely: bool = False,
        published: Mapping[str, float] | None = None,
    ) -> None:
        """Choose what is free.

        Args:
            vehicle: Gives the start and everything that is not free.
            axes: Whose added mass and damping are free.
            damping: `linear`, `quadratic` or `both` by axis; what is left out is zero.
            extras: Of `EXTRAS`, parameters of the vehicle's terms, such as `lift.coefficient`, and of its actuators.
            biases: Axes with a constant wrench b, about the set's reference point and on the side of the damping:
                M nu_dot + D nu + b = tau.
            start: Coordinate -> where it starts, in its unit, in place of the vehicle file's number.
            imposed: Axes that are not fitted: their added mass alone is free, for its momentum turns and pushes the
                others. Their coordinates come last.
            unseen: Those of `imposed` that no trial shows moving, and that therefore are simulated: their drag is free.
            held: Effective inertias M_RB + M_A that are not free, by axis [kg, kg m²].
            likely: Whether the scale of thrust is what batteries give.
            published: `top_speed` [m/s] and `bollard_pull` [N], both ahead, as far as they are known.

        Raises:
            CalibrationError: The calibrated set holds no coefficients.
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
        self.biases = tuple(a for a in AXES if a in biases)
        self.r_h = np.asarray(self.set.reference_point, float)
        self.H, self.M_RB, self.M_A = plant.H, plant.M_RB, plant.M_A
        self.D1, self.D2 = plant.D1, plant.D2
        self.held = dict(held or {})
        for a, m in self.held.items():
            i = AXES.index(a)
            self.M_A[i, i] = m - self.M_RB[i, i]
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
        z = self.r_h[2]
        k = B * (w.body.center_of_buoyancy[2] - z) - weight * (w.body.center_of_gravity[2] - z)
        tc = float(np.mean([t.time_constant for t in w.thrusters.values()]))
        late = float(np.mean([t.delay for t in w.thrusters.values()]))
        table = {
            "thrust_scale": (
                "-",
                *(
                    (LIKELY_SCALE, 0.05, 20.0, 1.0, SCALE_STD, 0.0)
                    if self.likely
                    else (1.0, 0.05, 20.0, 1.0, inf)
                ),
            ),
            "thrust_lag": ("s", max(tc, 0.02), SHORTEST_LAG, 5.0, 2.0),
            "thrust_delay": ("s", late, 0.0, LONGEST_DELAY, 0.2),
            "buoyancy_excess": ("N", B - weight, -0.9 * weight, 10.0 * weight, 0.02 * weight),
            "k": ("N m/rad", max(float(k), 1e-3), 0.0, inf, max(float(k), 0.02 * B)),
        }
        for name, path in places(w).items():
            table[name] = ("m", float(number_in(w, path) or 0.0), -inf, inf, 0.2, PLACE_STD[origin(w, path)])
        out += [Coordinate(name, *numbers) for name, numbers in table.items() if name in self.extras]
        out += [term_coordinate(self.set, w, path) for path in self.terms]
        out += [Coordinate(name, "-", 1.0, 0.02, 50.0, 1.0) for name in self.actuators]
        out += [self._of_axis(axis, "bias", -inf) for axis in self.biases]
        for axis in self.imposed:
            i = AXES.index(axis)
            out.append(self._of_axis(axis, "added_mass", min(float(self.M_A[i, i]), 0.0)))
        return out + [self._of_axis(axis, kind) for axis in self.unseen for kind in ("d1", "d2")]

    def _of_axis(self, axis: str, kind: str, low: float = 0.0) -> Coordinate:
        """An axis' own added mass, d1, d2 or bias, from the vehicle file's number on."""
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

    def published_rows(self) -> tuple[Array, Array]:
        """Return rows (R, P) and targets (R,) of what is published of the vehicle, each over its standard deviation.

        Drag at the top speed equals the largest thrust, and so does a bollard pull; scale 1 where it is not free.
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
        return rows / (PUBLISHED_STD * largest), target / (PUBLISHED_STD * largest)

    @property
    def nuisances(self) -> int:
        """Return the number of nuisance coordinates, which are the last ones."""
        return len(self.imposed) + 2 * len(self.unseen)

    def mass_floor(self) -> Array:
        """Lowest added mass of each free axis, (n,): M stays positive definite with all of them there [kg, kg m²].

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

    # -- plants -------------------------------------------------------------------------------------------------

    def value(self, x: Array, name: str, default: float | None = None) -> Any:
        """Column of a coordinate in vectors (W, P), or a default. The unit is that of the coordinate."""
        return x[:, self._at[name]] if name in self._at else default

    def matrices(self, x: Array) -> tuple[Array, Array, Array]:
        """M_A, D1 and D2 at the set's reference point, (W, 6, 6) each.

        Units: [kg], [N s/m] and [N s²/m²], with the corresponding ones of moments.
        """
        x = np.clip(np.atleast_2d(x), self.low, self.high)
        M_A, D1, D2 = (np.repeat(m[None], len(x), axis=0) for m in (self.M_A, self.D1, self.D2))
        for name, c in self._at.items():
            axis, _, kind = name.partition(".")
            if axis in AXES and kind != "bias":
                i = AXES.index(axis)
                {"added_mass": M_A, "d1": D1, "d2": D2}[kind][:, i, i] = x[:, c]
        return M_A, D1, D2

    def centre_of_gravity(self, x: Array) -> Array:
        """Return the centre of gravity of vectors (W, P) [m], (W, 3)."""
        file = np.tile(np.asarray(self.vehicle.body.center_of_gravity, float), (len(x), 1))
        return np.stack([self.value(x, name, file[:, j]) for j, name in enumerate(CENTRES)], axis=-1)

    def moved(self, x: Array) -> Vehicle:
        """Return the vehicle with the centres of a vector (P,); the moment of weight and buoyancy stays as it is."""
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
        free_centre = bool(set(CENTRES) & set(self.names))
        if "k" in self._at or free_centre:
            r_g, file, B = (
                self.centre_of_gravity(x),
                body.center_of_gravity,
                water.density * water.gravity * volume,
            )
            r_b = body.center_of_buoyancy + (self.vehicle.weight / B)[:, None] * (r_g - file)
            if "k" in self._at:
                z = self.r_h[2]
                r_b[:, 2] = z + (self.value(x, "k") + self.vehicle.weight * (r_g[:, 2] - z)) / B
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
        bias = np.zeros((W, 1, 6))
        for axis in self.biases:
            bias[:, 0, AXES.index(axis)] = -self.value(x, f"{axis}.bias")
        return Plants(
            fields=fields,
            bias=bias @ self.H,
            lag=self.value(x, "thrust_lag"),
            delay=self.value(x, "thrust_delay"),
            lower=None if (z := self.value(x, PLACES[0])) is None else z - self.expected[self._at[PLACES[0]]],
        )


CUT = 2.5
"""Whitened residual above which Huber's loss grows linearly."""

CLOSE = 0.25
"""Part of a standard error (of independent noise) that a converged estimate may still be off."""

DAMPINGS = np.array([1e-2, 1e-1, 1.0, 1e1, 1e2, 1e4])
"""Factors on the damping that are tried together."""

SMALL = 0.05
"""Decrease of half the sum of losses below which iteration ends: an error of a third of a standard error."""


class Point(NamedTuple):
    """Values of all unknowns; with a leading axis of candidates where several are evaluated together."""

    theta: Array
    """Coordinates shared by all segments in their units, (P,)."""
    z: Array
    """Coordinates of each segment in their units, as deviations from the prior's mean, (S, q)."""


class Linearization(NamedTuple):
    """Residuals at a point, sorted by segment, and derivatives of the predictions."""

    residual: Array
    """Measured minus predicted in the unit of the channel, (N,)."""
    shared: Array
    """d predicted / d theta in the units of both, (N, P)."""
    own: Array
    """d predicted / d z of the sample's own segment, in the units of both, (N, q)."""


@dataclass(frozen=True)
class FitSolution:
    """End of a fit."""

    point: Point
    std: Array
    """Standard deviation of every sample in the unit of its channel, (N,)."""
    cost: float
    """Half the sum of the losses [-]."""
    linear: Linearization
    iterations: int
    converged: bool
    """True if the last step is negligible relative to the error that independent noise would leave."""
    step: Array
    """Change of theta, in its units, by an undamped step, (P,)."""
    interrupted: bool = False


def weights_of(residual: Array, std: Array, cut: float = CUT) -> Array:
    """Huber's weights over the variance of the samples, (N,)."""
    return huber_weight(np.abs(residual / std), cut) / std**2


def blocks_of(
    problem: Shooting, linear: Linearization, std: Array, point: Point, cut: float = CUT
) -> list[Block]:
    """Weighted normal equations of every segment with the prior of z; that of theta is in the first.

    `std` has the unit of each sample; `cut` is in standard deviations [-].
    """
    root = np.sqrt(weights_of(linear.residual, std, cut))
    shared, own, residual = linear.shared * root[:, None], linear.own * root[:, None], linear.residual * root
    blocks = []
    for s, (a, b) in enumerate(zip(problem.edges, problem.edges[1:], strict=False)):
        block, stiff = block_of(shared[a:b], own[a:b], residual[a:b]), problem.prior_std[s] ** -2.0
        blocks.append(block._replace(bb=block.bb + np.diag(stiff), b=block.b - stiff * point.z[s]))
    (off, slope), first = problem.prior(point.theta), blocks[0]
    blocks[0] = first._replace(aa=first.aa + slope.T @ slope, a=first.a - slope.T @ off)
    return blocks


def step_of(
    problem: Shooting, reduced: tuple[Array, Array, list[Array]], point: Point, damping: float
) -> tuple[Array, Array, Array]:
    """Steps of theta (P,) inside the box and of z (S, q), and standard errors of theta, (P,).

    They have the units of the coordinates.

    Args:
        problem: For its box.
        reduced: Normal equations of theta alone at the point, per unit of theta, and how z follows; of `arrow_reduced`.
        point: Where the step begins.
        damping: What the diagonal of theta's grows by, as a part of itself [-].
    """
    total, right, inners = reduced
    scale = np.sqrt(np.maximum(np.diagonal(total), 1e-30 + 1e-12 * np.diagonal(total).max()))
    A = total / np.outer(scale, scale) + (damping + 1e-9) * np.eye(len(scale))
    low, high = problem.low - point.theta, problem.high - point.theta
    step = boxed(A, right / scale, np.minimum(low * scale, -1e-12), np.maximum(high * scale, 1e-12)) / scale
    z = np.array([inner[:, -1] - inner[:, :-1] @ step for inner in inners])
    return step, z, np.sqrt(np.diagonal(np.linalg.inv(A))) / scale


def costs_of(problem: Shooting, residual: Array, std: Array, points: Point, cut: float = CUT) -> Array:
    """Half the losses of several points with residuals (N, C), (C,); infinite where one has no answer.

    Residuals and `std` have the unit of each sample; losses have none [-].
    """
    prior = np.square(points.z / problem.prior_std).sum(axis=(1, 2))
    prior = prior + np.square(problem.prior(points.theta)[0]).sum(axis=-1)
    loss = np.array([huber_cost(np.abs(column / std), cut) for column in residual.T])
    return np.asarray(np.where(np.isfinite(loss), 0.5 * (loss + prior), np.inf))


def solve(
    problem: Shooting,
    start: Point,
    *,
    iterations: int = 30,
    std: Array | None = None,
    rough: bool = False,
    report: Callable[[int, float], None] | None = None,
) -> FitSolution:
    """Fit; noise and robust weights are estimated along the way.

    Converged where the undamped step moves no judged parameter by more than `CLOSE` of its standard error and grain
    together, and the noise no longer changes.

    Args:
        problem: What to fit.
        start: Where to begin.
        iterations: At most.
        std: Standard deviation of every sample at the start, in the unit of its channel, (N,); from the residuals there
            if None.
        rough: Far from a solution: keep `std`, and let no residual count as an outlier, for that is what a wrong
            parameter looks like too. Ends as soon as an iteration gains less than a hundredth.
        report: Called with each iteration and the root mean square of the whitened residuals.

    Returns:
        The best point; after Ctrl-C the best until then, with `interrupted`.
    """
    point, damping, done = start, 1e-2, 0
    linear = problem.linearise(point)
    if not np.isfinite(linear.residual).all():
        return FitSolution(
            point, np.ones(len(linear.residual)), np.inf, linear, 0, False, np.full(len(point.theta), np.inf)
        )
    std = problem.noise(linear.residual) if std is None else std
    converged, interrupted, settled, cut = False, False, rough, np.inf if rough else CUT
    step = np.full(len(point.theta), np.inf)

    def cost_at(std: Array) -> float:
        one = Point(point.theta[None], point.z[None])
        return float(costs_of(problem, linear.residual[:, None], std, one, cut)[0])

    cost = cost_at(std)
    try:
        for done in range(1, iterations + 1):
            if report:
                report(done, float(np.sqrt(2.0 * cost / max(len(std), 1))))
            reduced = arrow_reduced(blocks_of(problem, linear, std, point, cut), 0.0)
            step, _, error = step_of(problem, reduced, point, 0.0)
            near = error + problem.grain(point.theta)
            remaining = float(np.max(np.abs(step / near)[: problem.judged], initial=0.0))
            if settled and remaining < CLOSE:
                converged = True
                break
            steps = [step_of(problem, reduced, point, damping * factor) for factor in DAMPINGS]
            points = Point(
                np.clip(point.theta + np.array([theta for theta, _, _ in steps]), problem.low, problem.high),
                point.z + np.array([z for _, z, _ in steps]),
            )
            costs = costs_of(problem, problem.residuals(points), std, points, cut)
            best = int(np.argmin(costs))
            if costs[best] < cost:
                damping = float(np.clip(damping * DAMPINGS[best], 1e-9, 1e9))
                stuck = cost - costs[best] < (1e-2 * cost if rough else SMALL)
                point = Point(points.theta[best], points.z[best])
                linear = problem.linearise(point)
            else:
                damping = min(damping * 1e5, 1e12)
                stuck = damping >= 1e12
            new = std if rough else problem.noise(linear.residual)
            settled = rough or bool(np.all(np.abs(np.log(new / std)) < 0.01)) or done > 12
            if stuck and settled:
                converged = remaining < 1.0
                break
            if not settled:
                std, damping = new, min(damping, 1e-2)
            cost = cost_at(std)
    except KeyboardInterrupt:
        interrupted = True
    return FitSolution(point, std, cost, linear, done, converged, step, interrupted)


# What a simulation would have measured, against what was measured.


class Residuals:
    """Samples of all segments in one list, sorted by segment, then by channel.

    Attributes:
        names: Channels in use.
        channel: Index into `names` of each sample, (N,).
        segment: Index of its segment, (N,).
        edges: First sample of each segment, and N, (S + 1,).
        value: Measured, (N,).
        time: Since the segment's start [s], (N,).
    """

    def __init__(self, segments: Sequence[Segment], channels: Sequence[str]) -> None:
        """Collect the samples of some channels."""
        self.segments = tuple(segments)
        self.names = tuple(c for c in CHANNELS if c in channels and any(c in s.measured for s in segments))
        rows: dict[str, list[Array]] = {k: [] for k in ("segment", "channel", "time", "value")}
        for i, s in enumerate(segments):
            for j, name in enumerate(self.names):
                t, values = s.measured.get(name, (np.empty(0), np.empty(0)))
                rows["segment"].append(np.full(len(t), i))
                rows["channel"].append(np.full(len(t), j))
                rows["time"].append(t / s.step)
                rows["value"].append(values)
        joined = {k: np.concatenate(v) if v else np.empty(0) for k, v in rows.items()}
        self.segment, self.channel = joined["segment"].astype(int), joined["channel"].astype(int)
        self.value, time = joined["value"], joined["time"]
        self.time = time * segments[0].step
        self._steps = np.array([s.steps for s in segments])[self.segment]
        self.edges = np.searchsorted(self.segment, np.arange(len(segments) + 1))

    def __len__(self) -> int:
        return len(self.value)

    def predicted(self, response: Response, late: Array) -> tuple[Array, Array]:
        """Return the readings of every candidate's sensors at the samples' times, and their rate of change.

        Args:
            response: Of the candidates.
            late: By how much each sample lags what it shows [s], (N, C) or (N, 1).

        Returns:
            (N, C) each [unit of the channel, and the same per second]; NaN where a candidate diverged. Before a
            segment's start it is extrapolated in a straight line.
        """
        step = self.segments[0].step
        candidates = response.nu.shape[1]
        value, rate = (np.empty((len(self), candidates)) for _ in range(2))
        for j, name in enumerate(self.names):
            which = np.flatnonzero(self.channel == j)
            grid = channel(name, response, self.segments)
            for c in range(late.shape[1]):
                those = slice(None) if late.shape[1] == 1 else slice(c, c + 1)
                at = (self.time[which] - late[which, c]) / step
                row = np.clip(np.floor(at).astype(int), 0, self._steps[which] - 1)
                segment = self.segment[which]
                a = grid[row, those, segment].astype(float)
                rise = grid[row + 1, those, segment].astype(float) - a
                if name in EULER:
                    rise = wrap_angle(rise)
                value[which, those] = a + (at - row)[:, None] * rise
                rate[which, those] = rise / step
        return value, rate

    def difference(self, predicted: Array) -> Array:
        """Measured minus predicted, angles the short way round, (N, C). The unit is that of the channel."""
        out = self.value[:, None] - predicted
        for j, name in enumerate(self.names):
            if name in EULER:
                which = self.channel == j
                out[which] = wrap_angle(out[which])
        return np.asarray(out)

    def noise(self, residual: Array, floor: Array) -> Array:
        """Standard deviation of each channel from clipped residuals, (channels,).

        It has the unit of the channel.

        Args:
            residual: Measured minus predicted in the unit of the channel, (N,).
            floor: Smallest per channel, in its unit, (channels,).
        """
        out = np.array(floor, float)
        for j in range(len(self.names)):
            r = residual[self.channel == j]
            r = np.abs(r[np.isfinite(r)])
            sigma = 1.4826 * float(np.median(r)) if len(r) else 0.0
            sigma = sigma or float(np.sqrt(np.mean(r**2))) if len(r) else floor[j]
            for _ in range(10):
                # The factor undoes the clipping for a normal distribution at 2.5 standard deviations.
                sigma = (
                    1.011 * float(np.sqrt(np.mean(np.minimum(r, CUT * sigma) ** 2))) if sigma > 0.0 else 0.0
                )
            out[j] = max(sigma, floor[j])
        return out

    def spread(self) -> Array:
        """Range from the 2nd to the 98th percentile of each channel, the largest of the segments, (channels,).

        It has the unit of the channel.
        """
        out = np.zeros(len(self.names))
        for a, b in zip(self.edges, self.edges[1:], strict=False):
            for j in np.unique(self.channel[a:b]):
                values = self.value[a:b][self.channel[a:b] == j]
                out[j] = max(out[j], float(np.ptp(np.percentile(values, [2.0, 98.0]))))
        return out

    def roughness(self) -> Array:
        """Noise of each channel from third differences of successive samples, robust, (channels,).

        It has the unit of the channel.
        """
        out = np.zeros(len(self.names))
        for j in range(len(self.names)):
            parts = [
                np.diff(self.value[a:b][self.channel[a:b] == j], 3)
                for a, b in zip(self.edges, self.edges[1:], strict=False)
            ]
            d = np.abs(np.concatenate(parts)) if parts else np.empty(0)
            out[j] = (
                float(np.sqrt(np.mean(np.minimum(d, 3.0 * 1.4826 * np.median(d) + 1e-12) ** 2) / 20.0))
                if len(d)
                else 0.0
            )
        return out


def channel(name: str, response: Response, segments: Sequence[Segment]) -> NDArray[np.float32]:
    """A measured column on the simulation's grid.

    Args:
        name: Of `CHANNELS`.
        response: Of every candidate over these segments.
        segments: Give the sensors' places.

    Returns:
        Values in the unit of the response, (n + 1, C, S).
    """
    nu, q = response.nu, response.quaternion
    if name in ("p", "q", "r"):
        return nu[..., 3 + "pqr".index(name)]
    if name in ("u", "v", "w"):
        i = "uvw".index(name)
        at = np.stack([s.velocity_at for s in segments]).astype(np.float32)
        j, k = (i + 1) % 3, (i + 2) % 3
        out = nu[..., i] + (nu[..., 3 + j] * at[:, k] - nu[..., 3 + k] * at[:, j] if at.any() else 0.0)
        in_water = np.array([s.velocity_in_water for s in segments])
        if in_water.any():
            flow = np.stack([s.current for s in segments])
            body = quat_rotate(quat_conjugate(q), np.broadcast_to(flow, (*q.shape[1:3], 3)))[..., i]
            out = out - np.where(in_water, body, 0.0)
        return np.asarray(out, np.float32)
    if name in EULER:
        return euler_angle(name, q)
    sensor = "depth_at" if name == "depth" else "position_at"
    at = np.stack([getattr(s, sensor) for s in segments])
    i = 2 if name == "depth" else "xyz".index(name)
    out = response.position[..., i] + (quat_rotate(q, at)[..., i] if at.any() else 0.0)
    return np.asarray(-out if name == "depth" else out, np.float32)


def euler_angle(name: str, q: NDArray[np.float32]) -> NDArray[np.float32]:
    """Roll, pitch or yaw of unit quaternions, in their own precision, (..., 4) -> (...)."""
    x, y, z, w = (q[..., i] for i in range(4))
    if name == "roll":
        return np.asarray(np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)))
    if name == "yaw":
        return np.asarray(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))
    return np.asarray(np.arcsin(np.clip(2.0 * (w * y - x * z), -1.0, 1.0)))


# Errors of sensors that a fit allows for: offsets of a stretch, and streams that come late.

STREAMS = {
    "velocity": ("u", "v", "w"),
    "rates": ("p", "q", "r"),
    "attitude": ("roll", "pitch", "yaw"),
    "position": ("x", "y", "z"),
    "depth": ("depth",),
}
"""Channels that share a clock."""

OFFSETS = {"p": 0.02, "q": 0.02, "r": 0.02, "roll": 0.03, "pitch": 0.03, "depth": 0.1}
"""Channels with an offset that is constant over a segment, and its standard deviation: biases of gyroscopes [rad/s],
levels that were mounted askew [rad], pressure at the surface [m]."""

DRIFTING_REST = {"roll drift": ("roll", "p"), "pitch drift": ("pitch", "q")}
"""Angle and rate of an equilibrium that moves at a constant speed within a segment, as while a manipulator moves."""

REST_STD, DRIFT_STD = 0.3, 0.02
"""Standard deviations of the equilibrium of a free swing [rad] and of its speed [rad/s]."""

LATEST = 0.3
"""Greatest lag or lead of a stream relative to the inputs [s]."""

LATE_STD = 0.05
"""Prior standard deviation of the lag of streams [s]: noisy data do not distinguish a lag from inertia."""


# Where each segment begins: what was measured there, and how far a fit may move it.

UNKNOWN = np.array([0.5, 0.5, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3, 1e-6, 1e-6, 1e-6, 1e-6])
"""Standard deviation of unmeasured values; heading and place do not matter then."""

UNMOVED = np.array([0.05] * 6 + [0.3, 0.3, *UNKNOWN[8:]])
"""Standard deviation of unmeasured values in a free motion, where nothing drives the other axes."""

LOOSE = np.array([0.2, 0.2, 0.2, 0.3, 0.3, 0.3, 0.1, 0.1, 0.1, 0.2, 0.2, 0.2])
"""Standard deviation of measured and compared values: wide, for the same measurements count as residuals."""

TIGHT = np.array([0.03, 0.03, 0.03, 0.03, 0.03, 0.03, 0.02, 0.02, 0.02, 0.03, 0.03, 0.03])
"""Standard deviation of measured values that are not compared."""

SHOWN_BY = (
    *(("u", "x", "y"), ("v", "x", "y"), ("w", "z", "depth"), ("p", "roll"), ("q", "pitch"), ("r", "yaw")),
    *(("roll",), ("pitch",), ("yaw",), ("x",), ("y",), ("z", "depth")),
)
"""Channels that show a state, in the order of `STATES`."""

STEPS = np.array([0.002] * 9 + [0.005] * 3)
"""Steps of the finite differences: small, for instability multiplies them."""


RELATIVE_STEP = 0.006
"""Step of the finite differences, relative to a coordinate's size: single precision leaves them three digits."""

FORCE_STEP = 0.15
"""Relative step of damping and excess of a rise, which nearly trade off: the rounding of small steps would look like
knowledge."""

GRAIN = 0.004
"""Share of a number that is negligible."""

COARSE = 0.05
"""Size of residuals relative to a channel's range that counts as small while the parameters are far off."""

VAGUE = 8.0
"""Prior standard deviation of a fitted number: the file's value within so many times its scale."""

EXACT_CLOCK = 1e-3
"""Greatest lag of the stream that serves as the clock [s]."""

CONSTANT = 1e-3
"""Noise of a channel that never changes, as where a sensor was missing [m, rad, m/s, rad/s]: single precision shows no
less."""

FEWEST_CORRELATED = 20
"""Samples of a channel from which their correlation is estimated."""

FLOOR = 1e-4
"""Smallest noise of a channel, against the range it covers: below it are the simulation's own errors."""


class Shooting:
    """Residuals of segments under parameters and initial states.

    Attributes:
        streams: Names of the streams in use; each may lag the inputs.
        offsets: Names of the channels with an offset of their own in every segment, then of `DRIFTING_REST`.
        free: Which of `STATES` a fit moves from the measured ones, indices (q,): velocities and tilt everywhere,
            heading and place where some segment knows them and they matter.
        edges: First sample of each segment, and N, (S + 1,).
        low: Least theta, (P,).
        high: Largest theta, (P,).
        prior_std: Of z around zero, (S, q).
        prior_mean: What is known of theta beforehand, (P,).
        judged: How many of theta, from the first, have to be accurate; the rest are there for their sake.
        repeats: Samples per independent one.
    """

    def __init__(
        self,
        segments: Sequence[Segment],
        parameters: Parameters,
        channels: Sequence[str],
        *,
        lagged: NDArray[np.bool_] | None = None,
        swinging: NDArray[np.bool_] | None = None,
        few: bool = False,
        correlated: bool = True,
    ) -> None:
        """Set up.

        Args:
            segments: What to fit.
            parameters: What is free.
            channels: Measured columns to compare.
            lagged: Which segments' inputs an estimated lag or delay acts on, (S,); the commanded ones if None.
            swinging: Segments of a free motion, in which the equilibrium of roll and pitch may move, (S,).
            few: Whether some axis is excited by too few trials to show how trials differ.
            correlated: Whether samples count as fewer against what is known beforehand where their errors correlate.
        """
        self.segments, self.parameters = tuple(segments), parameters
        self.measured = Residuals(segments, channels)
        names = self.measured.names
        known = np.stack([s.known for s in segments])
        # Heading and place are free where something that is compared depends on them.
        flat, deep = {"x", "y"} & set(names), all(s.sink for s in segments)
        turned = flat or "yaw" in names or any(s.current.any() for s in segments)
        felt = [turned, "x" in names, "y" in names, {"z", "depth"} & set(names) or not deep]
        self.free = np.concatenate(
            [np.arange(8), 8 + np.flatnonzero(known[:, 8:].any(axis=0) & [bool(x) for x in felt])]
        )
        seen = np.array([[any(c in s.measured for c in columns) for columns in SHOWN_BY] for s in segments])
        unknown = UNKNOWN if swinging is None else np.where(swinging[:, None], UNMOVED, UNKNOWN)
        states_std = np.where(known, np.where(seen, LOOSE, TIGHT), unknown)[:, self.free]
        self.streams = tuple(stream for stream, of in STREAMS.items() if set(of) & set(names))
        # The initial height already takes up an offset of the depth, unless z is measured too.
        self.offsets = tuple(c for c in names if c in OFFSETS and (c != "depth" or "z" in names))
        stream_of = {c: i for i, stream in enumerate(self.streams) for c in STREAMS[stream]}
        self._stream = np.array([stream_of[c] for c in names], int)[self.measured.channel]
        rows = [names.index(name) for name in self.offsets]
        self._offset = (self.measured.channel[:, None] == np.array(rows, int)).astype(float)
        offsets_std = np.tile([OFFSETS[c] for c in self.offsets], (len(segments), 1))
        for name, (angle, rate) in DRIFTING_REST.items() if swinging is not None and swinging.any() else ():
            if angle in names:
                channel = np.array(names)[self.measured.channel]
                column = np.where(channel == angle, self.measured.time, channel == rate)
                self.offsets += (name,)
                self._offset = np.column_stack([self._offset, column])
                offsets_std = np.column_stack([offsets_std, np.where(swinging, DRIFT_STD, 1e-9)])
                offsets_std[swinging, self.offsets.index(angle)] = REST_STD
        self.rollouts = Rollouts(
            parameters.vehicle,
            segments,
            max_delay=LONGEST_DELAY if "thrust_delay" in parameters.names else 0.5,
        )
        # A thruster that is higher by 1 m pushes with the moment e_z × axis more.
        vehicle, self._leverage = parameters.vehicle, np.zeros((len(segments), 6, MAX_THRUSTERS))
        by_thruster, sideways = np.array([s.thrusters for s in segments]), horizontal(vehicle)
        for j, (name, thruster) in enumerate(vehicle.thrusters.items()):
            if name in sideways:
                self._leverage[by_thruster, 3, j] = -thruster.axis[1]
                self._leverage[by_thruster, 4, j] = thruster.axis[0]
        self.edges = self.measured.edges
        self.groups = np.array([s.index for s in segments])
        self.few = few
        self.judged = len(parameters.names) - parameters.nuisances
        far = np.full(len(self.streams), LATEST)
        self.low = np.concatenate([parameters.low, -far])
        self.high = np.concatenate([parameters.high, far])
        # Imposed axes have the file's inertia within a factor, the others within an order of magnitude: far from a
        # solution, over short segments, nothing else keeps them finite. Streams agree on the time to hundredths
        # of a second.
        self.prior_mean = np.concatenate([parameters.expected, 0.0 * far])
        size = np.array([VAGUE * c.scale if c.std is None else c.std for c in parameters.coordinates])
        size[self.judged :] = parameters.scale[self.judged :]
        known = size**-1.0
        rigid = [np.nan if c.rigid is None else c.rigid for c in parameters.coordinates[: self.judged]]
        self._rigid = np.concatenate([rigid, np.full(parameters.nuisances + len(far), np.nan)])
        self._known = np.concatenate([known, 0.0 * far + LATE_STD**-1.0])
        free = bool(swinging is not None and swinging.all())
        forces = [name in ("heave.d1", "heave.d2", "buoyancy_excess") for name in parameters.names]
        self._relative_step = np.where(np.array(forces) & free, FORCE_STEP, RELATIVE_STEP)
        if "thrust_delay" in parameters.names or free:
            # A common lag of all streams equals a delay of the thrust: the first stream is the clock then.
            self._known[len(parameters.names)] = EXACT_CLOCK**-1.0
        self.prior_std = np.concatenate([states_std, offsets_std], axis=1)
        self.lagged = np.array([s.commanded for s in segments]) if lagged is None else lagged
        noise = self.measured.roughness()
        self._floor = np.where(noise > 0.0, FLOOR * self.measured.spread() + 1e-12, CONSTANT)
        self.first_noise = np.maximum(noise, self._floor)
        self._latest: tuple[Point, Linearization] | None = None
        self.repeats, self._correlated = 1.0, correlated
        rows, target = parameters.published_rows()
        self._published = np.pad(rows, ((0, 0), (0, len(self.streams)))), target

    def prior(self, theta: Array) -> tuple[Array, Array]:
        """Return the whitened differences of vectors (..., P) from what is known beforehand, (..., R), and the slopes
        of one vector, (R, P).

        Samples count as independent in a cost, so that what is known counts `repeats` times.
        """
        whole, mean = theta + self._rigid, self.prior_mean + self._rigid
        logarithmic = np.isfinite(self._rigid)
        whole = np.where(logarithmic, np.maximum(whole, 1e-3 * np.abs(mean)), 1.0)
        off = np.where(logarithmic, np.log(whole / np.where(logarithmic, mean, 1.0)), theta - self.prior_mean)
        rows, target = self._published
        weight = np.sqrt(self.repeats)
        off = weight * np.concatenate([off * self._known, theta @ rows.T - target], axis=-1)
        return off, weight * np.concatenate([np.diag(np.atleast_2d(self._known / whole)[0]), rows])

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of theta: the parameters, then the lags of the streams [s]."""
        return self.parameters.names + tuple(f"{stream}.late" for stream in self.streams)

    def start(self) -> Point:
        """The vehicle file's numbers, the measured initial states, no errors of sensors."""
        rest = np.zeros(len(self.low) - len(self.parameters.names))
        return Point(np.concatenate([self.parameters.start, rest]), np.zeros(self.prior_std.shape))

    def cost(self, point: Point) -> float:
        """Half the loss of one point, with what counts as large residuals far from a solution; clocks agree."""
        one = Point(point.theta[None], point.z[None])
        return float(costs_of(self, self.residuals(one), self.size(), one)[0])

    def residuals(self, points: Point) -> Array:
        """Measured minus predicted of several points, (N, C). They have the unit of the channel."""
        return self._residual(points, self._predicted(points)[0])

    def _residual(self, points: Point, value: Array) -> Array:
        offset, out = points.z[..., len(self.free) :], np.zeros((len(self.measured), len(points.z)))
        for k in range(offset.shape[2]):
            out += self._offset[:, k : k + 1] * offset[:, self.measured.segment, k].T
        return self.measured.difference(value + out)

    def _predicted(self, points: Point) -> tuple[Array, Array]:
        """Return the readings of sensors without offsets and their rate of change, (N, C) each."""
        P, C = len(self.parameters.names), len(points.theta)
        p = self.parameters.plants(points.theta[:, :P])
        fields = dict(p.fields)
        own = self.rollouts.own
        for name, values in (("time_constant", p.lag), ("delay", p.delay)):
            if values is not None:
                tail = (1,) * (own[name].ndim - 1)
                mask = self.lagged.reshape(-1, *tail)
                fields[name] = np.where(mask, values.reshape(-1, 1, *tail), own[name])
        if p.lower is not None:
            fields["B"] = own["B"] + p.lower[:, None, None, None] * self._leverage
        full = np.zeros((*points.z.shape[:2], 12))
        full[..., self.free] = points.z[..., : len(self.free)]
        nu, quaternion, position = (
            np.stack([getattr(s, name) for s in self.segments]) for name in ("nu", "quaternion", "position")
        )
        initial = {
            "nu": nu + full[..., :6],
            "quaternion": quat_multiply(quaternion, quat_from_rotvec(full[..., 6:9])),
            "position": position + full[..., 9:],
        }
        response = self.rollouts.run(fields, initial=initial, disturbance=p.bias, candidates=C)
        late = points.theta[:, P:]
        same = bool((late == late[:1]).all())
        return self.measured.predicted(response, (late[:1] if same else late).T[self._stream])

    def linearise(self, point: Point) -> Linearization:
        """Residuals and derivatives: central differences for what moves the vehicle, exact for what sensors add.

        Those of the latest point are kept, because one solution often begins where another ended.
        """
        if self._latest is None or not all(map(np.array_equal, self._latest[0], point)):
            self._latest = point, self._linearised(point)
        return self._latest[1]

    def _linearised(self, point: Point) -> Linearization:
        points, wide = self._neighbours(point)
        value, rate = self._predicted(points)
        rise = value[:, 1::2] - value[:, 2::2]
        for j, name in enumerate(self.measured.names):
            if name in EULER:
                which = self.measured.channel == j
                rise[which] = wrap_angle(rise[which])
        slopes = np.nan_to_num(rise / np.where(wide > 0.0, wide, np.inf))
        rate = np.nan_to_num(rate[:, :1])
        late = np.where(self._stream[:, None] == np.arange(len(self.streams)), -rate, 0.0)
        P = len(self.parameters.names)
        one = Point(*(part[:1] for part in points))
        return Linearization(
            self._residual(one, value[:, :1])[:, 0],
            np.concatenate([slopes[:, :P], late], axis=1),
            np.concatenate([slopes[:, P:], self._offset], axis=1),
        )

    def _neighbours(self, point: Point) -> tuple[Point, Array]:
        """The point, one on either side of it for every unknown that moves the vehicle, and their distances."""
        P = len(self.parameters.names)
        count, steps = P + len(self.free), STEPS[self.free]
        theta, z = (np.repeat(part[None], 1 + 2 * count, axis=0) for part in point)
        up, down = 1 + 2 * np.arange(count), 2 + 2 * np.arange(count)
        i = np.arange(P)
        step = self._relative_step * np.maximum(np.abs(point.theta[:P]), 0.25 * self.parameters.scale)
        theta[up[:P], i] = np.minimum(point.theta[:P] + step, self.high[:P])
        theta[down[:P], i] = np.maximum(point.theta[:P] - step, self.low[:P])
        wide = theta[up[:P], i] - theta[down[:P], i]
        for k, step_k in enumerate(steps):
            z[up[P + k], :, k] += step_k
            z[down[P + k], :, k] -= step_k
        return Point(theta, z), np.concatenate([wide, 2.0 * steps])

    def growth(self, point: Point) -> Array:
        """Return the largest factor by which a small change of the initial velocity grows within each segment, (S,).

        It is infinite where the simulation diverges.
        """
        linear = self.linearise(point)
        own = np.abs(linear.own[:, :6])
        speeds = [
            i for i, name in enumerate(self.measured.names) if name in STREAMS["velocity"] + STREAMS["rates"]
        ]
        own[~np.isin(self.measured.channel, speeds)] = 0.0
        own[~np.isfinite(linear.residual)] = np.inf
        return np.asarray(np.maximum.reduceat(own.max(axis=1), self.edges[:-1]))

    def grain(self, theta: Array) -> Array:
        """Return negligible differences of theta, (P,). They have the units of theta."""
        P = len(self.parameters.names)
        size = np.maximum(np.abs(theta[:P]), 0.1 * self.parameters.scale)
        return GRAIN * np.append(size, np.full(len(theta) - P, 1.0))

    def hold_clocks(self, hold: bool) -> None:
        """Keep the lags of all streams at zero, or let them go: far from a solution they imitate inertia."""
        late, far = slice(len(self.parameters.names), None), 0.0 if hold else LATEST
        self.low[late], self.high[late] = -far, far

    def size(self) -> Array:
        """Return the size of a large residual of every sample far from a solution, (N,).

        It has the unit of the channel.
        """
        size = np.maximum(3.0 * self.first_noise, COARSE * self.measured.spread())
        return np.asarray(size[self.measured.channel])

    def noise(self, residual: Array) -> Array:
        """Standard deviation of every sample: that of its channel. It has the unit of the channel.

        The samples per independent one follow from the same residuals.
        """
        m, found = self.measured, []
        for j in range(len(m.names) if self._correlated else 0):
            rows = np.flatnonzero((m.channel == j) & np.isfinite(residual))
            if len(rows) > FEWEST_CORRELATED:
                found.append(correlated_samples(residual[rows], np.flatnonzero(np.diff(m.segment[rows])) + 1))
        self.repeats = float(np.mean(found)) if found else 1.0
        return np.asarray(self.measured.noise(residual, self._floor)[self.measured.channel])


# The fit of a vehicle with them: first, the evidence of each trial, or block of a few trials, on its parameters.

FEWEST_TRIALS = 4
"""Trials below which they are cut into blocks to estimate the spread."""

BLOCKS = 24
"""Number of blocks of all trials together."""


class Confidence(NamedTuple):
    """Uncertainty of theta at a solution."""

    evidence: Evidence
    covariance: Covariance
    free: Array
    """Result of the last step without bounds, in the units of theta, (P,)."""
    interval: Array
    """95 % interval in the units of theta, around `free` and containing theta, (P, 2)."""

    def variance(self, slope: Array, at: Sequence[int]) -> float:
        """Return the variance of a sum of some parameters.

        It has the unit of the sum squared.

        Args:
            slope: Factor of each, (n,).
            at: Their places in theta, (n,).
        """
        C = self.covariance
        matrix = (C.local if C.alone[at].any() else C.trials)[np.ix_(at, at)]
        with np.errstate(invalid="ignore"):
            return float(slope @ matrix @ slope) if len(slope) else 0.0


def confidence(problem: Shooting, solution: FitSolution) -> Confidence:
    """Evidence of theta, after initial states and offsets are eliminated, and what follows from it."""
    evidence = evidence_of(problem, solution)
    covariance = trial_covariance(evidence)
    theta, low, high = solution.point.theta, problem.low, problem.high
    free = theta
    if ((theta <= low) | (theta >= high)).any():
        off, slope = problem.prior(theta)
        normal, score = evidence.information, evidence.score.sum(axis=0) - slope.T @ off / problem.repeats
        scale = np.sqrt(np.maximum(np.diagonal(normal), 1e-300))
        free = theta + np.linalg.lstsq(normal / np.outer(scale, scale), score / scale, rcond=1e-10)[0] / scale
    ends = intervals(free, covariance)
    ends[:, 0], ends[:, 1] = np.minimum(ends[:, 0], theta), np.maximum(ends[:, 1], theta)
    ends = np.clip(ends, low[:, None], high[:, None])
    if np.isfinite(solution.step).all():  # the truth may be where one step more would go
        goes = np.clip(theta + solution.step, low, high)
        ends[:, 0], ends[:, 1] = np.minimum(ends[:, 0], goes), np.maximum(ends[:, 1], goes)
    unknown = ~np.isfinite(np.diagonal(covariance.local))
    ends[unknown] = [-np.inf, np.inf]
    return Confidence(evidence, covariance, free, ends)


def evidence_of(problem: Shooting, solution: FitSolution, group: NDArray[np.int64] | None = None) -> Evidence:
    """Normal matrices and scores by groups of rows.

    Args:
        problem: What was fitted.
        solution: Where the fit ended.
        group: Of every row, (N,); trials if None, or blocks where fewer than `FEWEST_TRIALS` excite an axis.
    """
    linear = solution.linear
    weight = weights_of(linear.residual, solution.std)
    # Derivatives without what each segment's own unknowns take up of every sample.
    slopes = linear.shared.copy()
    for s, (a, b) in enumerate(zip(problem.edges, problem.edges[1:], strict=False)):
        own, weighted = linear.own[a:b], linear.own[a:b].T * weight[a:b]
        normal = weighted @ own + np.diag(problem.prior_std[s] ** -2.0)
        slopes[a:b] -= own @ np.linalg.solve(normal, weighted @ slopes[a:b])
    trial = problem.groups[problem.measured.segment]
    unit = "blocks" if problem.few or len(np.unique(trial)) < FEWEST_TRIALS else "trials"
    if group is None:
        group = trial if unit == "trials" else _blocks(problem, trial)
    parts = [np.flatnonzero(group == label) for label in np.unique(group)]
    known = problem.prior(solution.point.theta)[1]
    normal = [(slopes[rows].T * weight[rows]) @ slopes[rows] for rows in parts]
    score = [(slopes[rows].T * weight[rows]) @ linear.residual[rows] for rows in parts]
    return Evidence(
        names=problem.names,
        normal=np.array(normal) / problem.repeats,
        score=np.array(score) / problem.repeats,
        unit=unit,
        prior=known.T @ known / problem.repeats,
    )


def _blocks(problem: Shooting, trial: NDArray[np.int64]) -> NDArray[np.int64]:
    """Block of every sample: each trial in equal spans of time, the longer the trial the more of them."""
    start = np.array([s.t0 for s in problem.segments])[problem.measured.segment]
    t = start + problem.measured.time
    present = np.unique(trial)
    span = {g: (float(t[trial == g].min()), float(np.ptp(t[trial == g]))) for g in present}
    total = sum(length for _, length in span.values())
    out = np.zeros(len(t), int)
    for g in present:
        begin, length = span[g]
        pieces = max(2, round(BLOCKS * length / max(total, 1e-9)))
        rows = trial == g
        part = (t[rows] - begin) / max(length, 1e-9)
        out[rows] = 1000 * g + np.minimum((part * pieces).astype(int), pieces - 1)
    return out


LAG_CERTAIN = 0.05
"""Half width of the interval of a delay up to which it counts as identifiable [s]."""

EXCESS_CERTAIN = 0.02
"""Half width of the interval of buoyancy less weight, as a part of the weight, up to which it is identifiable."""

PATHS = {
    "buoyancy_excess": "body.displaced_volume",
    "thrust_scale": None,
    "thrust_lag": "thrusters.*.time_constant",
    "thrust_delay": "thrusters.*.delay",
}
"""Reported coordinates besides those of the axes, and their places in the vehicle file."""


LEVER = 1.0
"""Size that the simulation's own error counts against in a place [m]: a lever of some centimetres shows in the small
difference of large accelerations."""


def numbers_of(p: Parameters, x: Array, found: Confidence, own_error: float) -> dict[str, Number]:
    """Every coordinate with its 95 % interval, by name.

    Args:
        p: What was free.
        x: Where the fit ended, in the units of the coordinates, (P,).
        found: Evidence there.
        own_error: Of the simulation itself, as a part of an estimate; intervals hold it too.
    """
    local, out, M_RB = np.diagonal(found.covariance.local), {}, matrices(p.moved(x)).M_RB
    half = intervals(np.zeros(len(local)), found.covariance)[:, 1]
    for c, name in enumerate(p.names):
        low, high, value = -np.inf, np.inf, float(x[c])
        if np.isfinite(local[c]):
            free = value + float(np.clip(found.free[c] - value, -1e6, 1e6))
            axis, _, kind = name.partition(".")
            rigid = M_RB[AXES.index(axis), AXES.index(axis)] if kind == "added_mass" else 0.0
            size = LEVER if name in PLACES else abs(value + rigid)
            width = float(np.hypot(half[c], own_error * size))
            low = max(min(free - width, value), p.low[c])
            high = free + width if free + width > value else value + width
            # Where a fit ended early, the truth may be where one step more would go.
            low, high = min(low, float(found.interval[c, 0])), max(high, float(found.interval[c, 1]))
        out[name] = Number(value, (low, high), float(found.free[c]) if value <= p.low[c] else None)
    return out


def axis_result(
    p: Parameters, x: Array, numbers: Mapping[str, Number], axis: str, **known: Any
) -> AxisResult:
    """The result of one axis.

    Args:
        p: What was free.
        x: Where the fit ended, in the units of the coordinates, (P,).
        numbers: Of `numbers_of`.
        axis: Which.
        known: Further fields of `AxisResult`.
    """
    own, file, i = dict[str, Number](), matrices(p.moved(x)), AXES.index(axis)
    if f"{axis}.added_mass" in numbers:
        mass, rigid = numbers[f"{axis}.added_mass"], float(file.M_RB[i, i])
        free = None if mass.free is None else mass.free + rigid
        own["m_eff"] = Number(mass.value + rigid, (mass.ends[0] + rigid, mass.ends[1] + rigid), free)
    own |= {n: numbers[f"{axis}.{n}"] for n in ("d1", "d2", "bias") if f"{axis}.{n}" in numbers}
    if "k" in numbers and axis in ("roll", "pitch"):
        own["k"] = numbers["k"]
    return AxisResult(axis=axis, numbers=own, file=file, **known)


def other_estimates(
    p: Parameters, numbers: Mapping[str, Number]
) -> tuple[dict[str, Estimate], list[Finding]]:
    """Return the estimates that belong to no axis, and findings on those that rest on a bound."""
    out, bounds = dict[str, Estimate](), list[Finding]()
    reported = {*PATHS, *PLACES, *p.terms, *p.actuators}
    paths = PATHS | places(p.vehicle)
    units = {c.name: c.unit for c in p.coordinates if c.name in reported}
    for name, unit in units.items():
        value, (low, high), free = numbers[name]
        half, note = 0.5 * (high - low), ""
        # Delay and excess may well be zero, so that their uncertainty is not judged as a part of them.
        limits = {"thrust_delay": LAG_CERTAIN, "buoyancy_excess": EXCESS_CERTAIN * p.vehicle.weight}
        limit = limits.get(name, CERTAIN * abs(value))
        if free is not None:
            note = f"held at its bound; free, it would be {free:.3g} {unit}"
            bounds.append(finding("at_bound", name, free=free, unit=unit))
        elif not np.isfinite(half):
            note = "the trials do not determine it"
        elif name in PLACES:
            coordinate = p.coordinates[p.names.index(name)]
            known, std = half / 1.96, float(coordinate.std or np.inf)
            if known > DETERMINED * std:
                note = "the trials determine it no better than the vehicle file"
            else:  # what the trials alone say, without the file
                variance = 1.0 / (known**-2.0 - std**-2.0)
                alone = variance * (value / known**2.0 - coordinate.start / std**2.0)
                span = 1.96 * float(np.sqrt(variance))
                if abs(alone - coordinate.start) > span:
                    what = (
                        ", ".join(horizontal(p.vehicle))
                        if name == PLACES[0]
                        else f"{name[-1]} of the centre of gravity"
                    )
                    bounds.append(
                        finding("place_contradicted", what, value=alone, half=span, file=coordinate.start)
                    )
        elif half > limit:
            note = f"uncertain by ±{half:.2g} {unit}"
        path = f"{SET}.{name}" if name in p.terms else paths.get(name)
        out[name] = Estimate(
            name=name,
            estimate=value,
            ci95=(low, high),
            unit=unit,
            identifiable=not note,
            note=note,
            path=path,
        )
    return out, bounds


# Content of the trials: excited axes, measurements of each axis, response time of the vehicle.

DRIFTING = {"x": "u", "y": "v", "z": "w", "depth": "w", "yaw": "r"}
"""Integrals without a restoring force: where the rate is measured they add drift, not knowledge."""

SEEN = 0.9
"""Part of a segment for which a velocity has to be known to be imposed."""

PUSH = 0.03
"""Range of a wrench, as part of the vehicle's limit, below which an axis is not driven."""

ANSWER = (0.02, 0.02, 0.02, 0.04, 0.04, 0.04)
"""Range of a velocity below which an axis does not answer [m/s, rad/s]."""


def compared(segment: Segment, motion: Motion, axes: Sequence[str], *, free: bool = False) -> Segment:
    """The segment as a fit of some axes uses it.

    Axes that are not fitted move as they were seen to, where they were seen: their numbers in the vehicle file may be
    wrong, and couplings would carry that into the others. They are not compared, nor are integrals that add drift. An
    axis whose motion does not stand out of its noise is simulated instead, for the noise would shake the others; but
    not in a free motion, where nothing drives it. Rates move it without the bias of the gyroscope: what they add up to
    is an attitude.
    """
    held = np.full((segment.steps + 1, 6), np.nan)
    t = segment.t0 + segment.step * np.arange(segment.steps + 1)
    drop = {column for column, rate in DRIFTING.items() if rate in segment.measured}
    inside = (motion.t >= t[0] - 0.1) & (motion.t <= t[-1] + 0.1)
    bias = np.concatenate([np.zeros(3), gyroscope_bias(motion)])
    for i, axis in enumerate(AXES):
        good = inside & np.isfinite(motion.nu[:, i])
        if axis not in axes and good.sum() >= max(2.0, SEEN * inside.sum()):
            if free or axis in SWINGING or answers(motion, i):
                held[:, i] = np.interp(t, motion.t[good], motion.nu[good, i]) - bias[i]
            drop |= {DETERMINED_BY[axis][0]}
    if not np.isnan(held[:, 3:5]).any():
        drop |= {"roll", "pitch"}
    measured = {c: pair for c, pair in segment.measured.items() if c not in drop}
    return replace(segment, measured=measured, held=held)


def observable(trials: Sequence[Streams]) -> tuple[str, ...]:
    """Axes that some trial measures anything of."""
    columns = {c for s in trials for c in s.measured}
    return tuple(a for a in AXES if columns & set(DETERMINED_BY[a]))


def excited(trials: Sequence[Streams], vehicle: Vehicle) -> tuple[str, ...]:
    """Return the axes that the trials excite, of those that some trial measures."""
    found = {axis for s in trials for axis in excites(s, vehicle)}
    return tuple(a for a in AXES if a in found and a in observable(trials))


def telling(trials: Sequence[Streams], vehicle: Vehicle, axes: Sequence[str]) -> list[Streams]:
    """Trials that excite one of some axes; all of them where none does.

    In the others the vehicle moves on axes that are not fitted, maybe not even measured, and couplings carry that over.
    """
    return [s for s in trials if set(excites(s, vehicle)) & set(axes)] or list(trials)


def excites(s: Streams, vehicle: Vehicle) -> set[str]:
    """Return the axes that one trial excites: without thrust those that move freely, else those its header names, else
    those that were driven, or swing."""
    if s.drive.source == "passive":
        return set(s.released)
    return set(s.trial.header.axis) or _moved(s, vehicle)


def _moved(s: Streams, vehicle: Vehicle) -> set[str]:
    try:
        limits = vehicle.wrench_limits
    except VehicleError:
        limits = np.zeros(6)
    tau = s.motion.tau @ np.linalg.inv(twist_shift(list(vehicle.wrench_reference)))
    out: set[str] = set()
    for i, axis in enumerate(AXES):
        pushed = limits[i] > 0.0 and _range(tau[:, i]) > PUSH * limits[i]
        # Weight rights roll and pitch: a small swing determines them, whatever started it. If they were not
        # fitted, the file's stiffness, which may be a guess, would determine the later course of surge and sway.
        swings = i in (3, 4)
        if answers(s.motion, i) and (pushed or swings):
            out.add(axis)
    return out


def answers(motion: Motion, i: int) -> bool:
    """Return whether the velocity of an axis, 0 surge to 5 yaw, exceeds its noise."""
    noise = motion.noise_std[i]
    return _range(motion.nu[:, i]) > max(ANSWER[i], 4.0 * noise if np.isfinite(noise) else 0.0)


def _range(values: Array) -> float:
    finite = values[np.isfinite(values)]
    return float(np.ptp(np.percentile(finite, [2.0, 98.0]))) if len(finite) else 0.0


def speeds(motions: Sequence[Motion], axis: str) -> tuple[float, float]:
    """Range of speeds at which an axis was seen moving, from the 20th to the 99th percentile [m/s or rad/s]."""
    i = AXES.index(axis)
    values = np.concatenate([np.abs(m.nu[:, i]) for m in motions] or [np.empty(0)])
    values = values[np.isfinite(values)]
    moving = values[values > max(0.02 * values.max(initial=0.0), 1e-9)]
    return (
        (float(np.percentile(moving, 20.0)), float(np.percentile(moving, 99.0)))
        if len(moving)
        else (0.0, 0.0)
    )


def horizon(vehicle: Vehicle, trials: Sequence[Streams], axes: Sequence[str]) -> float:
    """Length of segments that shows steady motion and yet forgets what no model knows [s]: five of the slowest time
    constant, at least forty samples, between 5 and 12 s."""
    chosen = vehicle.hydrodynamic_set("calibrated")
    M = np.diag(vehicle.mass_matrix("calibrated"))
    slowest = 0.5
    if isinstance(chosen, HydrodynamicSet):
        for axis in axes:
            i = AXES.index(axis)
            top = speeds([s.motion for s in trials], axis)[1]
            drag = chosen.linear_damping[i, i] + chosen.quadratic_damping[i, i] * top
            slowest = max(slowest, float(M[i] / drag) if drag > 0.0 else 3.0)
    return float(np.clip(max(5.0 * slowest, 40.0 * sampling(trials)), 5.0, 12.0))


def sampling(trials: Sequence[Streams]) -> float:
    """Usual time between the samples of a channel [s]."""
    steps = [float(np.median(np.diff(t))) for s in trials for t, _ in s.measured.values() if len(t) > 2]
    return float(np.median(steps or [0.02]))


# What a simulation-error fit shows besides its estimates: figures by axis, curves, findings.

LATE = 0.03
"""Lag of a stream that leads to a warning [s]."""

SHOWN = 4
"""Trials in the curve of an axis."""


def _shown_by(
    problem: Shooting, axis: str
) -> tuple[str, NDArray[np.int64], NDArray[np.int64], dict[int, float]]:
    """Return the most direct used channel that determines an axis, its samples (n,), their trials (n,), and the range
    of the channel in each trial, from the 5th to the 95th percentile; no samples without such a channel."""
    m = problem.measured
    name = next((c for c in DETERMINED_BY[axis] if c in m.names), "")
    rows = np.flatnonzero(m.channel == m.names.index(name)) if name else np.empty(0, int)
    trial = problem.groups[m.segment][rows]
    spans = {
        int(g): float(np.ptp(np.percentile(m.value[rows][trial == g], [5.0, 95.0]))) for g in np.unique(trial)
    }
    return name, rows, trial, spans


def quality(
    problem: Shooting, solution: FitSolution, axes: Sequence[str], used: Sequence[Streams]
) -> dict[str, dict[str, float]]:
    """Figures of each axis over the trials that move it: the simulated against the measured channel.

    Units are those of the channel; R² and NRMSE have none.
    """
    out = {}
    for axis in axes:
        name, rows, trial, spans = _shown_by(problem, axis)
        if not name:
            continue
        moving = [g for g, span in spans.items() if span > 0.2 * max(spans.values())]
        inside = np.isin(trial, moving)
        rows, trial = rows[inside], trial[inside]
        residual, value = solution.linear.residual[rows], problem.measured.value[rows]
        rms = {g: float(np.sqrt(np.mean(residual[trial == g] ** 2))) for g in moving}
        low, high = speeds([s.motion for s in used], axis)
        out[axis] = {
            "r2": 1.0 - float(np.mean(residual**2)) / max(float(np.var(value)), 1e-300),
            "rmse": float(np.sqrt(np.mean(residual**2))),
            "nrmse": float(np.mean([rms[g] / max(spans[g], 1e-12) for g in moving])),
            "samples": float(len(rows)),
            "rejected": float(np.sum(np.abs(residual) > 2.0 * CUT * solution.std[rows])),
            "trials": float(len(moving)),
            "speed_low": low,
            "speed_high": high,
            "noise": float(np.median(solution.std[rows])),
        }
    return out


AXES_BIAS = ("surge.bias", "sway.bias", "yaw.bias")
"""Biases that no vehicle file has a place for."""


def held_out(
    stage: Stage, file: Shooting, axes: Sequence[str], by_trial: bool
) -> dict[str, tuple[float, float]]:
    """Return the NRMSE of each axis over stretches that the numbers do not rest on, and that of the vehicle file [-].

    Each trial, or stretch of one, is predicted by the numbers that one Gauss-Newton step from the end of the fit gives
    without it, each from the initial state and the offsets of its sensors that suit it best.

    Args:
        stage: The finished fit.
        file: The same problem with every number of the vehicle file free.
        axes: Fitted axes.
        by_trial: Whether whole trials are left out.
    """
    problem, point = stage.problem, stage.solution.point
    trial = problem.groups[problem.measured.segment]
    group = np.unique(trial if by_trial else _blocks(problem, trial), return_inverse=True)[1]
    evidence = evidence_of(problem, stage.solution, group)
    total = evidence.information
    scale = np.sqrt(np.maximum(np.diagonal(total), 1e-300))
    unwritten = [
        problem.parameters.names.index(name) for name in AXES_BIAS if name in problem.parameters.names
    ]

    low, high = (problem.low - point.theta) * scale - 1e-12, (problem.high - point.theta) * scale + 1e-12

    def without(k: int) -> Array:
        rest = (total - evidence.normal[k]) / np.outer(scale, scale) + 1e-9 * np.eye(len(scale))
        step = boxed(rest, -evidence.score[k] / scale, low, high) / scale
        theta = np.clip(point.theta + step, problem.low, problem.high)
        theta[unwritten] = 0.0
        return theta

    known = dict(zip(problem.names, point.theta, strict=True)) | dict(
        zip(file.parameters.names, file.parameters.expected, strict=True)
    )
    known |= dict.fromkeys(AXES_BIAS, 0.0) | ({"thrust_scale": 1.0} if problem.parameters.likely else {})
    plain = np.array([known[name] for name in file.names])
    after = _predicted_error(
        problem, np.array([without(k) for k in range(len(evidence.normal))]), stage.solution
    )
    after = after[np.arange(len(group)), group]
    before = _predicted_error(file, plain[None], stage.solution)[:, 0]
    out = {}
    for axis in axes:
        _, rows, trial, spans = _shown_by(problem, axis)
        moving = [g for g, span in spans.items() if 0.2 * max(spans.values()) < span]
        rms = [
            [float(np.sqrt(np.mean(error[rows[trial == g]] ** 2))) / max(spans[g], 1e-12) for g in moving]
            for error in (after, before)
        ]
        if moving:
            after_mean, before_mean = np.nan_to_num(np.mean(rms, axis=1), nan=np.inf).tolist()
            out[axis] = after_mean, before_mean
    return out


def _predicted_error(problem: Shooting, theta: Array, solution: FitSolution) -> Array:
    """Return the errors of vectors (C, P) after the initial state and offsets of each segment are fitted to it, (N, C).

    The unit is that of the channel.
    """
    z, linear = solution.point.z, solution.linear
    error = problem.residuals(Point(theta, np.repeat(z[None], len(theta), axis=0)))
    weight = solution.std**-2.0
    for s, (a, b) in enumerate(zip(problem.edges, problem.edges[1:], strict=False)):
        own, stiff = linear.own[a:b], problem.prior_std[s] ** -2.0
        normal = (own.T * weight[a:b]) @ own + np.diag(stiff)
        right = (own.T * weight[a:b]) @ error[a:b] - (stiff * z[s])[:, None]
        error[a:b] -= own @ np.linalg.solve(normal, np.nan_to_num(right))
    return error


def unexplained(
    problem: Shooting, solution: FitSolution, axis: str, used: Sequence[Streams]
) -> tuple[str, float]:
    """Return the trial of a free motion that the fit explains least, and its R²; infinite without any.

    R² has no unit.
    """
    _, rows, trial, _ = _shown_by(problem, axis)
    worst, least = "", np.inf
    for g, one in enumerate(used):
        those = rows[trial == g]
        if axis in one.released and len(those):
            residual, value = solution.linear.residual[those], problem.measured.value[those]
            r2 = 1.0 - float(np.mean(residual**2)) / max(float(np.var(value)), 1e-300)
            worst, least = min((worst, least), (one.trial.name, r2), key=lambda pair: pair[1])
    return worst, least


def pictures(problem: Shooting, solution: FitSolution, axes: Sequence[str]) -> tuple[Curve, ...]:
    """Measured and simulated channel of each axis, over the trials that move it most."""
    m, out = problem.measured, []
    clock = m.time + np.array([s.t0 for s in problem.segments])[m.segment]
    for axis in axes:
        name, rows, trial, spans = _shown_by(problem, axis)
        parts = []
        for g in sorted(sorted(spans, key=lambda g: -spans[g])[:SHOWN]):
            those = rows[trial == g]
            those = those[np.argsort(clock[those], kind="stable")]
            value = m.value[those]
            parts.append((clock[those], value, value - solution.linear.residual[those]))
        if name:
            title = f"{axis}: {name}, simulated from the inputs alone"
            out.append(Curve.joined(title, f"{name} [{COLUMNS[name].unit}]", parts))
    return tuple(out)


def fit_findings(
    problem: Shooting,
    solution: FitSolution,
    found: Confidence,
    used: Sequence[Streams],
) -> list[Finding]:
    """Return findings that a reader needs before using the numbers."""
    out = []
    if solution.interrupted:
        out.append(finding("interrupted"))
    elif not (solution.converged or _close(solution, found, problem.judged)):
        out.append(finding("not_converged", iterations=solution.iterations))
    P = len(problem.parameters.names)
    for stream, late, (low, high) in zip(
        problem.streams, solution.point.theta[P:], found.interval[P:], strict=True
    ):
        if abs(late) > LATE and (low > 0.0 or high < 0.0):
            sense = "lags" if late > 0.0 else "leads"
            given = {"sense": sense, "lag": abs(late), "low": low, "high": high}
            if all(one.released for one in used):
                out.append(finding("streams_apart", stream, other=problem.streams[0], **given))
            else:
                out.append(finding("motion_late", stream, **given))
    if found.evidence.unit == "blocks":
        out.append(finding("block_intervals", trials=len(used)))
    return out


def _close(solution: FitSolution, found: Confidence, judged: int) -> bool:
    """Return whether one step more would keep every parameter within its 95 % interval.

    Trials differ by more than independent noise, so that a step far above the error that such noise leaves may still be
    far below what can be known.
    """
    low, high = intervals(solution.point.theta, found.covariance).T
    return bool(np.all(np.abs(solution.step[:judged]) <= 0.5 * (high - low)[:judged]))


class FitProgress:
    """Progress over several stages: iteration, cost, rate and remaining time."""

    def __init__(self, progress: Callable[[float, str], None] | None) -> None:
        self.progress, self.begin, self.part = progress, time.perf_counter(), 0.0

    def __call__(self, words: str, toward: float = 1.0) -> None:
        # The number of remaining iterations is unknown; each takes a share of the rest.
        self.part += 0.2 * max(toward - self.part, 0.0)
        spent = time.perf_counter() - self.begin
        if self.progress:
            self.progress(self.part, f"{words}, {spent:.0f} s")


# From a simulation-error fit to changes of the vehicle file: only what the trials determine.


def changes(
    p: Parameters,
    x: Array,
    found: Mapping[str, Estimate],
    axes: dict[str, Any],
    *,
    unmeasured: Sequence[str],
    scaled: bool,
) -> dict[str, Any]:
    """Changes of the vehicle file.

    Args:
        p: What was free.
        x: Where the fit ended, in the units of the coordinates, (P,).
        found: All estimates.
        axes: Changes of the axes' own numbers.
        unmeasured: Axes that were simulated because no trial measured them: the others hold with their numbers.
        scaled: Whether a thrust scale belongs to the thrusters' curves.
    """
    out = dict(axes)
    for path, matrix in _matrices(p, x).items():
        old = np.asarray(getattr(p.set, path.rpartition(".")[2]), float)
        for i, axis in enumerate(AXES):
            if f"{path}.{i}.{i}" in axes or axis in unmeasured:
                for j in range(6):
                    # Couplings are written where the fit did away with them.
                    if i == j or matrix[i, j] != old[i, j]:
                        out[f"{path}.{i}.{j}"] = float(matrix[i, j])
    written = x.copy()
    for c, name in enumerate(p.names):
        written[c] = p.expected[c] if name in PLACES and not found[name].identifiable else x[c]
    moved = p.moved(written)
    at = [f"thrusters.{name}.position.2" for name in horizontal(p.vehicle)]
    if PLACES[0] in found:
        c = p.names.index(PLACES[0])
        lower = float(written[c] - p.expected[c])
        out |= {path: p.vehicle.thrusters[path.split(".")[1]].position[2] + lower for path in at if lower}
    if moved is not p.vehicle:
        for name in ("center_of_gravity", "center_of_buoyancy"):
            out |= {f"body.{name}.{j}": float(c) for j, c in enumerate(getattr(moved.body, name))}
    out |= hydrostatics(found, moved)[0]
    for name, path in (("thrust_lag", "time_constant"), ("thrust_delay", "delay")):
        if name in found and found[name].identifiable:
            out[f"thrusters.*.{path}"] = max(found[name].estimate, 1e-4 if path == "time_constant" else 0.0)
    for path in p.terms:
        if found[path].identifiable:
            out[str(found[path].path)] = found[path].estimate
    for name in p.actuators:
        if found[name].identifiable:
            out |= scaled_actuators(p.vehicle, name, found[name].estimate)
    if "thrust_scale" in found and (found["thrust_scale"].identifiable or p.likely) and scaled:
        out |= scaled_thrust(p.vehicle, found["thrust_scale"].estimate)
    return out


USEFUL_DRAG = 0.5
"""Half width of the interval of a damping force, as a part of it, up to which it is written: better than a guess."""


def _drag_known(
    p: Parameters, x: Array, found: Confidence, axis: str, speed: float, shape: DragShape | None
) -> bool:
    """Return whether the drag at one speed is known to `USEFUL_DRAG`, or excludes that of the vehicle file."""
    i, names = AXES.index(axis), [f"{axis}.{name}" for name in ("d1", "d2")]
    at = [p.names.index(name) for name in names if name in p.names]
    powers = np.array([speed, speed**2])
    slope = powers[np.isin(names, p.names)]
    before = np.array([p.set.linear_damping[i][i], p.set.quadratic_damping[i][i]], float)
    force = float(slope @ x[at])
    if p.likely:  # in terms of the thrust, whose scale goes to the file too
        scale = p.names.index("thrust_scale")
        at, slope = [*at, scale], np.append(slope, -force / x[scale])
    half = 2.0 * (np.sqrt(np.maximum(found.variance(slope, at), 0.0)) if shape is None else shape.spread)
    known = half < USEFUL_DRAG * force or abs(powers @ before - force) > half
    return bool(np.isfinite(half) and force > 0.0 and known)


STEP = 0.02
"""Step of the simulation [s]."""

SHORT = 2.5
"""Initial length of the segments [s]: over so short a time every problem is nearly linear."""

OWN_ERROR, BETWEEN = 0.003, 0.05
"""Error of the simulation itself, as a part of an estimate; and how it grows with the time between samples of the
inputs [1/s], for nobody recorded what happened in between."""

GROWTH = 12.0
"""Growth of a disturbance of the initial velocity over a segment above which its trial is cut into shorter ones.

A fast vehicle without fins turns broadside by itself, and derivatives over a long run of that mean little."""

HALVINGS = 2


@dataclass
class Stage:
    """One fit of one set of parameters."""

    problem: Shooting
    solution: FitSolution
    found: Confidence

    @property
    def x(self) -> Array:
        """Return the final parameters, (P,). They have the units of the coordinates."""
        return self.solution.point.theta[: len(self.problem.parameters.names)]


SHAPES = {"linear": 0.1, "quadratic": 0.45, "both": 0.45}
"""Prior probability of the shapes of drag: at the Reynolds numbers of vehicles, above 10⁴, it is hardly ever linear."""

SIZE_STD = 1.5
"""Standard deviation of quadratic drag, as a part of that of a box of the vehicle's size (drag coefficient 1)."""

NARROW = 2.0
"""Ratio of the speeds of stretches below which they show one drag, but not its shape."""

WIDER = 2.5
"""Factor on the standard deviations for the intervals then."""

WHITE = np.linspace(-5.0, 5.0, 61)
"""Grid of the densities, in standard deviations."""


class DragShape(NamedTuple):
    """Drag of an axis as the average over its shapes."""

    value: Array
    """d1 and d2 in their units, (2,)."""
    ends: list[tuple[float, float]]
    """Their 95 % intervals in the same units."""
    weights: dict[str, float]
    """Probability of each shape [-]."""
    spread: float = np.inf
    """Standard deviation of the drag at the top speed, for the thrust that was found [N, N m]."""


def drag_of_size(vehicle: Vehicle, axis: str) -> float:
    """Return the quadratic drag of a bluff box of the vehicle's size, in the unit of d2."""
    i, size = AXES.index(axis), np.asarray(vehicle.body.size, float)
    others = np.delete(size, i % 3)
    area = np.prod(others) if i < 3 else size[i - 3] * np.sum(others**4) / 32.0
    return 0.5 * vehicle.water.density * float(area)


def levels_of(problem: Shooting, axis: str) -> list[float]:
    """Return the speeds that stretches of the trials reach on an axis, of those that move it [m/s, rad/s]."""
    i, tops = AXES.index(axis), []
    for s in problem.segments:
        own = s.measured.get(DETERMINED_BY[axis][0])
        values = np.abs(s.held[:, i]) if s.held is not None and np.isfinite(s.held[:, i]).all() else None
        values = np.abs(own[1]) if own is not None and values is None else values
        if values is not None and len(values):
            tops.append(float(np.percentile(values, 95.0)))
    return [top for top in tops if top > 0.2 * max(tops)]


def drag_shape(stage: Stage, axis: str, size: float, levels: Sequence[float]) -> DragShape:
    """Return the average over linear and quadratic drag and both, by their evidence, for the thrust that was found.

    Args:
        stage: The fit of both.
        axis: Which.
        size: Quadratic drag that the size of the vehicle lets expect, in the unit of d2.
        levels: Speeds of the stretches [m/s, rad/s]; their range widens the intervals if it is below `NARROW`.
    """
    from scipy.stats import norm, t

    C, names = stage.found.covariance, stage.problem.parameters.names
    at, common = (
        [names.index(n) for n in some if n in names] for some in ((f"{axis}.d1", f"{axis}.d2"), COMMON)
    )
    S, whole = (matrix[np.ix_(at, at)] for matrix in (_given(C, at, common), _given(C, at, [])))
    if not np.isfinite(S).all() or np.linalg.det(S) <= 0.0:
        return DragShape(stage.x[at], [(-np.inf, np.inf)] * 2, dict(SHAPES))
    factor = float(t.ppf(0.975, min(float(np.min(C.dof[at])), 1e6)) / norm.ppf(0.975))
    x, mean = stage.x[at], stage.x[at].copy()
    for j in np.flatnonzero(x <= stage.problem.low[at]):
        # Without the bound the term would be lower, and the other one with it as they are correlated.
        lower = np.clip(stage.found.free[at][j] - x[j], -4.0 * np.sqrt(S[j, j]), 0.0)
        mean += S[:, j] / S[j, j] * lower
    top = max(levels, default=1.0)
    value, _, weights, spread = _average(mean, S * factor**2, size, top)
    known = float(np.sqrt(S[1, 1])) < DETERMINED * SIZE_STD * size
    file = float(stage.problem.parameters.expected[at[1]])
    # What slow trials leave open stays as the file has it, with the d1 that goes with it.
    if not (known or stage.problem.parameters.likely) and file > 0.0:
        value = np.array([max(mean[0] + S[0, 1] / S[1, 1] * (file - mean[1]), 0.0), file])
    if known and x[0] <= stage.problem.low[at[0]]:
        value = x  # the trials show a quadratic drag alone; the intervals allow for a linear one
    wide = factor * (WIDER if top < NARROW * min(levels, default=top) else 1.0)
    ends = _average(mean, S * wide**2, size, top)[1]
    # What the thrust and its lever add to the spread of both together.
    more = 1.96 * factor * np.sqrt(np.maximum(np.diagonal(whole - S), 0.0))
    pairs = [
        (max(v - np.hypot(v - a, m), 0.0), v + np.hypot(b - v, m))
        for v, (a, b), m in zip(value, ends, more, strict=True)
    ]
    return DragShape(value, [(float(a), float(b)) for a, b in pairs], weights, spread)


COMMON = ("thrust_scale", *PLACES)
"""Coordinates that scale all drag together."""


def _given(C: Covariance, at: Sequence[int], known: Sequence[int]) -> Array:
    """Return the covariance (P, P) given some coordinates, in the units of theta."""
    local, trials = (float(np.linalg.det(matrix[np.ix_(at, at)])) for matrix in (C.local, C.trials))
    matrix = C.trials if trials > local and not C.alone[at].any() else C.local
    if not known or not np.isfinite(matrix[np.ix_(known, known)]).all():
        return matrix
    scale = np.sqrt(np.diagonal(matrix)[known])
    inner = matrix[np.ix_(known, known)] / np.outer(scale, scale)
    side = matrix[:, known] / scale
    return np.asarray(matrix - side @ np.linalg.pinv(inner, rcond=1e-8) @ side.T)


def _average(
    mean: Array, S: Array, size: float, top: float
) -> tuple[Array, list[tuple[float, float]], dict[str, float], float]:
    """Return mean and 95 % intervals of d1 and d2 over the shapes, the probability of each shape, and the standard
    deviation of the drag at the top speed.

    Args:
        mean: Of the likelihood of d1 and d2, in their units, (2,).
        S: Its covariance, (2, 2).
        size: Quadratic drag that the size of the vehicle lets expect, in the unit of d2.
        top: Speed at which linear drag is expected to be no larger [m/s, rad/s].
    """
    from scipy.stats import norm

    prior = norm(0.0, size * max(top, 2.0 * USUAL_SPEED)), norm(size, SIZE_STD * size)
    share = 2.0, 1.0 / norm.cdf(1.0 / SIZE_STD)  # of densities that are not negative
    root = np.linalg.cholesky(S)
    white = np.stack(np.meshgrid(WHITE, WHITE, indexing="ij"), axis=-1).reshape(-1, 2)
    parts = {"both": (mean + white @ root.T, np.abs(np.linalg.det(root)) * (WHITE[1] - WHITE[0]) ** 2)}
    for j, name in enumerate(("linear", "quadratic")):
        k = 1 - j
        centre, std = mean[j] - S[j, k] / S[k, k] * mean[k], float(np.sqrt(S[j, j] - S[j, k] ** 2 / S[k, k]))
        grid = np.zeros((len(WHITE), 2))
        grid[:, j] = centre + std * WHITE
        parts[name] = grid, std * (WHITE[1] - WHITE[0])
    inverse, logs = np.linalg.inv(S), {}
    for name, (grid, cell) in parts.items():
        off = grid - mean
        log = np.log(SHAPES[name] * cell) - 0.5 * np.einsum("ni,ij,nj->n", off, inverse, off)
        for j, absent in enumerate(("quadratic", "linear")):
            if name != absent:
                log = log + np.where(
                    grid[:, j] >= 0.0, prior[j].logpdf(grid[:, j]) + np.log(share[j]), -np.inf
                )
        logs[name] = log
    highest = max(float(log.max()) for log in logs.values())
    density = {name: np.exp(log - highest) for name, log in logs.items()}
    weights = {name: float(w.sum()) for name, w in density.items()}
    total = sum(weights.values())
    grid, density_of = (
        np.concatenate([g for g, _ in parts.values()]),
        np.concatenate([density[n] for n in parts]) / total,
    )
    ends = []
    for j in range(2):  # no one knows that a term is absent: the intervals of both terms are in them too
        some = [_quantiles(grid[:, j], density_of)]
        if weights["both"] > 0.0:
            some.append(_quantiles(parts["both"][0][:, j], density["both"] / weights["both"]))
        ends.append((min(low for low, _ in some), max(high for _, high in some)))
    drag, value = grid @ [1.0, top] * top, density_of @ grid
    spread = float(np.sqrt(density_of @ (drag - density_of @ drag) ** 2))
    return value, ends, {name: w / total for name, w in weights.items()}, spread


def _quantiles(values: Array, weight: Array) -> tuple[float, float]:
    """Return the 2.5 % and 97.5 % points of weighted values in their unit; weights add up to 1."""
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weight[order])
    low, high = np.searchsorted(total, (0.025, 0.975 - 1e-12))
    return float(values[order[low]]), float(values[order[min(high, len(order) - 1)]])


def averaged(stage: Stage, shapes: Mapping[str, DragShape]) -> Stage:
    """Return a fit with its drag at the average over shapes, and the other numbers where they then are best."""
    if not shapes:
        return stage
    problem, solution = stage.problem, stage.solution
    value = {
        f"{axis}.{n}": v
        for axis, shape in shapes.items()
        for n, v in zip(("d1", "d2"), shape.value, strict=True)
    }
    at, theta = [problem.names.index(name) for name in value], solution.point.theta.copy()
    theta[at] = list(value.values())
    kept = problem.low, problem.high
    problem.low, problem.high = kept[0].copy(), kept[1].copy()
    problem.low[at] = problem.high[at] = theta[at]
    end = solve(problem, solution.point._replace(theta=theta), iterations=POLISH, std=solution.std)
    problem.low, problem.high = kept
    if not np.isfinite(end.cost):
        return stage
    shift = end.point.theta - solution.point.theta
    found = stage.found._replace(
        free=stage.found.free + shift, interval=stage.found.interval + shift[:, None]
    )
    return Stage(problem, replace(end, converged=solution.converged, step=solution.step), found)


POLISH = 3
"""Iterations with which the other numbers follow the drag."""


class Stages:
    """The stages of one fit: they share trials and segments."""

    def __init__(
        self,
        prepared: Sequence[Streams],
        vehicle: Vehicle,
        axes: tuple[str, ...],
        estimate: tuple[str, ...],
        known: Mapping[str, float],
        length: float | None,
        say: FitProgress,
        likely: bool = False,
        published: Mapping[str, float] | None = None,
    ) -> None:
        self.published = dict(published or {})
        self.prepared, self.vehicle, self.axes, self.say = prepared, vehicle, axes, say
        self.given, self.known, self.likely = length, dict(known), likely
        self.excites = [excites(s, vehicle) for s in prepared]
        self.fitted = self._fitted_axes()
        # The added mass of axes that are not fitted pushes and turns the others; roll's and pitch's hardly does, and
        # without thrust nothing does.
        driven = any(one.drive.source != "passive" for one in prepared)
        self.imposed = tuple(a for a in ("surge", "sway", "heave", "yaw") if a not in axes and driven)
        self.unseen = tuple(
            a for a in self.imposed if not any(answers(one.motion, AXES.index(a)) for one in prepared)
        )
        apart = [float(np.median(np.diff(s.drive.t))) for s in prepared if not s.drive.held]
        self.own_error = OWN_ERROR + BETWEEN * max([0.0, *(dt - STEP for dt in apart)])
        self.shorter: dict[str, float] = {}
        self.used: list[Streams] = []
        self.segments: list[Segment] = []
        self.extras = set(estimate)
        if "heave" in axes:
            self.extras.add("buoyancy_excess")
        self.free = self._free_axes()
        swinging = [a for a in axes if a in SWINGING]
        self.held, self.notes = self._assumed(swinging)
        if any(a not in self.free or a in self.held for a in swinging):
            self.extras.add("k")
        driven = {a for a in swinging if a not in self.free and a not in self.held}
        if driven and any(s.drive.thrusters for s in prepared):
            self.extras |= set(places(vehicle))
        self.biases = [a for a in axes if a != "heave" and (a not in self.free or a in SWINGING)]
        self.remarks: list[Finding] = []
        self.weak_start = self._weak_start()

    def require_shown(self) -> None:
        """Refuse a published number that is not of what is fitted.

        Raises:
            CalibrationError: Surge is not fitted, or the thrust is known.
        """
        if "top_speed" in self.published and ("surge" not in self.axes or "surge" in self.free):
            raise CalibrationError(
                "a top speed shows the drag of surge, which no trial here drives: leave it out"
            )
        if "bollard_pull" in self.published and "thrust_scale" not in self.extras:
            raise CalibrationError(
                "a bollard pull shows the thrust, which is taken as known here: leave it out, or give --estimate "
                "thrust_scale"
            )

    def _fitted_axes(self) -> list[list[str]]:
        """Return the axes of each trial whose motion is simulated and compared; the others move as they were seen to.

        A surge, sway or yaw that a trial does not excite comes from couplings and disturbances, which the model lacks:
        compared, it would determine the added mass of other axes through their Coriolis moments. Where it is only noise
        it stays, for it keeps the initial state in place. So do heave, roll and pitch: weight acts on them in every
        trial.
        """
        out, nowhere = list[list[str]](), set(self.axes).difference(*self.excites)
        for one, moved in zip(self.prepared, self.excites, strict=True):
            own = moved if one.released else moved | nowhere | {"heave", *SWINGING}
            still = [a for a in AXES if not (one.released or answers(one.motion, AXES.index(a)))]
            out.append([a for a in self.axes if a in own or a in still])
        return out

    def _free_axes(self) -> tuple[str, ...]:
        """Return the axes that move only in trials without thrust, which show ratios alone."""
        driven = {
            axis
            for one, moved in zip(self.prepared, self.excites, strict=True)
            if one.drive.source != "passive"
            for axis in moved
        }
        moving = {axis for one in self.prepared for axis in one.released}
        return tuple(a for a in self.axes if a in moving - driven)

    def _assumed(self, swinging: Sequence[str]) -> tuple[dict[str, float], dict[str, str]]:
        """Return effective inertias that are not fitted [kg, kg m²], and what the numbers of an axis rest on.

        Where the weight rights the vehicle, the file's stiffness gives the scale of a free motion, elsewhere the file's
        inertia does, unless an inertia is given.
        """
        plant = matrices(self.vehicle)
        k = float(plant.arm[2])
        stiff = k > 0.0 and not any(a in self.known or a not in self.free for a in swinging)
        held, notes = dict(self.known), dict[str, str]()
        for axis in self.free:
            i, unit = AXES.index(axis), "kg" if AXES.index(axis) < 3 else "kg m²"
            if axis in held:
                notes[axis] = f"with the given inertia {held[axis]:.4g} {unit}"
            elif axis in SWINGING and stiff:
                notes[axis] = f"with the file's k = {k:.4g} N m/rad"
            elif axis not in SWINGING or not any(a in self.known or a not in self.free for a in swinging):
                held[axis] = float((plant.M_RB + plant.M_A)[i, i])
                notes[axis] = f"with the file's inertia {held[axis]:.4g} {unit}"
        return held, notes

    def _weak_start(self) -> dict[str, float]:
        """Return the numbers of the weak form, and cut the trials where it finds a jolt."""
        plant, start = matrices(self.vehicle), dict[str, float]()
        gaps: dict[int, list[tuple[float, float]]] = {}
        for axis in self.axes:
            known = {"m_eff": self.held[axis]} if axis in self.held else {}
            known |= {"k": float(plant.arm[2])} if axis in SWINGING and "k" not in self.extras else {}
            those = [g for g, moved in enumerate(self.excites) if axis in moved]
            found, jolts = weak_form([self.prepared[g] for g in those], axis, self.vehicle, known)
            for k, begin, end in jolts:
                gaps.setdefault(those[k], []).append((begin, end))
                name = self.prepared[those[k]].trial.name
                self.remarks.append(finding("jolt", name, axis=axis, begin=begin, end=end))
            found = {name: (LIKELY_SCALE if self.likely else 1.0) * value for name, value in found.items()}
            start |= {f"{axis}.{name}": value for name, value in found.items()}
            if found:
                start[f"{axis}.added_mass"] = found["m_eff"] - float(
                    plant.M_RB[AXES.index(axis), AXES.index(axis)]
                )
            if found and axis == "heave":
                start["buoyancy_excess"] = -found["bias"]
            if found and axis in SWINGING:
                start["k"] = found["k"]
        self.prepared = [without(s, gaps.get(g, [])) for g, s in enumerate(self.prepared)]
        return start

    def rough(self, kinds: dict[str, str], starts: Sequence[Mapping[str, float]]) -> Stage:
        """Fit short segments from the best of several starts, without regard to outliers and clocks.

        Starts have the units of the coordinates.
        """
        short = max(SHORT, 15.0 * sampling(self.prepared))
        self.cut(min(short, self.given or short))
        problem = min((self.problem(kinds, start) for start in starts), key=lambda one: one.cost(one.start()))
        point = problem.start()
        problem.hold_clocks(True)
        rough = solve(
            problem, point, iterations=12, std=problem.size(), rough=True, report=self.report("start", 0.3)
        )
        self.refuse_divergence(rough)
        problem.hold_clocks(False)
        return Stage(problem, rough, confidence(problem, rough))

    def refuse_divergence(self, solution: FitSolution) -> None:
        """Raise a `CalibrationError` if the simulation has no finite answer."""
        if not np.isfinite(solution.cost):
            raise CalibrationError(
                f"the simulation diverges within segments of {self.length:.3g} s: give a vehicle file with better "
                "numbers, or a shorter --horizon"
            )

    def first(self, kinds: dict[str, str], start: Mapping[str, float]) -> Stage:
        """Fit segments of the length that the numbers of a start call for.

        If the simulation with them diverges, the fit begins with the vehicle file's numbers instead.
        """
        p = self.parameters(kinds, start)
        self.cut(self.given or horizon(self.vehicle.replace(_matrices(p, p.start)), self.prepared, self.axes))
        problem = self.problem(kinds, start)
        for _ in range(0 if self.given else HALVINGS):
            growth = problem.growth(problem.start())
            wild = {self.used[g].trial.name for g in np.unique(problem.groups[growth > GROWTH])}
            if not wild:
                break
            for name in wild:
                self.shorter[name] = 0.5 * self.shorter.get(name, 1.0)
            self.cut(self.length)
            problem = self.problem(kinds, start)
        if start and not np.isfinite(problem.cost(problem.start())):
            self.shorter.clear()
            return self.first(kinds, {})
        stage = self.finish(problem, problem.start(), 0.6)
        least = 0.5**HALVINGS
        long = [one.trial.name for one in self.used if self._part(one) > least]
        if (
            stage.solution.converged
            or stage.solution.interrupted
            or self.given
            or not self.shorter
            or not long
        ):
            return stage
        # Where some trials grow so fast that they were cut shorter, the others may do so on the way to the solution.
        self.shorter |= dict.fromkeys(long, least)
        self.cut(self.length)
        problem = self.problem(kinds, start)
        return self.finish(problem, problem.start(), 0.6)

    def finish(self, problem: Shooting, point: Point, toward: float, std: Array | None = None) -> Stage:
        """Fit with robust weights and clocks let go, after a first approach without."""
        if std is None:
            problem.hold_clocks(True)
            rough = solve(
                problem,
                point,
                iterations=6,
                std=problem.size(),
                rough=True,
                report=self.report("fit", toward),
            )
            problem.hold_clocks(False)
            point = rough.point
            if rough.interrupted:
                return Stage(problem, rough, confidence(problem, rough))
            self.refuse_divergence(rough)
        solution = solve(problem, point, std=std, report=self.report("fit", toward))
        return Stage(problem, solution, confidence(problem, solution))

    def shapes(self, stage: Stage) -> dict[str, DragShape]:
        """Return what the trials show of the drag of each axis, over its shapes."""
        return {
            axis: drag_shape(stage, axis, drag_of_size(self.vehicle, axis), levels_of(stage.problem, axis))
            for axis in self.axes
        }

    def report(self, words: str, toward: float) -> Callable[[int, float], None]:
        """Return a function that reports an iteration and its residual; `toward` is the share of the work done then."""
        return lambda i, rms: self.say(f"{words}: iteration {i}, residual {rms:.4g} σ", toward)

    def cut(self, length: float) -> None:
        """Cut the trials into segments of about a length [s]."""
        shown = {column for axis in self.axes for column in DETERMINED_BY[axis]}
        cut = [
            [
                compared(s, one.motion, axes, free=bool(one.released))
                for s in segments(one, self.vehicle, length=length * self._part(one), step=STEP)
            ]
            for one, axes in zip(self.prepared, self.fitted, strict=True)
        ]
        kept = [[s for s in stretch if shown & set(s.measured)] for stretch in cut]
        self.length = length
        self.used = [one for one, stretch in zip(self.prepared, kept, strict=True) if stretch]
        self.segments = [replace(s, index=g) for g, stretch in enumerate(filter(None, kept)) for s in stretch]
        if not self.segments:
            raise CalibrationError(
                f"no interval of these trials has both inputs and measurements of {', '.join(self.axes)}"
            )
        commanded = np.array([s.commanded for s in self.segments])
        # If every input is stated to have acted, a request for a lag doubts that.
        self.lagged = commanded if commanded.any() else np.ones_like(commanded)

    def _part(self, one: Streams) -> float:
        return self.shorter.get(one.trial.name, 1.0)

    def parameters(self, kinds: dict[str, str], start: Mapping[str, float]) -> Parameters:
        """Return the free parameters for a choice of damping, from a start.

        The start has the units of the coordinates.
        """
        return Parameters(
            self.vehicle,
            axes=self.axes,
            damping=kinds,
            extras=tuple(self.extras),
            biases=self.biases,
            start=start,
            imposed=self.imposed,
            unseen=self.unseen,
            held=self.held,
            likely=self.likely,
            published=self.published,
        )

    def problem(self, kinds: dict[str, str], start: Mapping[str, float]) -> Shooting:
        """Return the problem of the free parameters, over the segments.

        The start has the units of the coordinates.
        """
        return Shooting(
            self.segments,
            self.parameters(kinds, start),
            sorted({c for s in self.segments for c in s.measured}),
            lagged=self.lagged,
            swinging=np.array([bool(self.used[s.index].released) for s in self.segments]),
            few=min(sum(axis in one for one in self.excites) for axis in self.axes) < FEWEST_TRIALS,
        )

    def result(
        self,
        stage: Stage,
        shapes: Mapping[str, DragShape],
        remarks: list[Finding],
        *,
        damping: str,
        kinds: Mapping[str, str],
    ) -> Fit:
        """Return the finished fit, with the drag of `shapes`."""
        p, x = stage.problem.parameters, stage.x
        numbers = numbers_of(p, x, stage.found, self.own_error)
        for axis, shape in shapes.items():
            numbers |= {
                f"{axis}.{n}": Number(v, ends)
                for n, v, ends in zip(("d1", "d2"), shape.value, shape.ends, strict=True)
            }
        figures = quality(stage.problem, stage.solution, self.axes, self.used)
        if not stage.solution.interrupted:
            several = stage.found.evidence.unit == "trials" and not stage.found.covariance.alone.any()
            file = self.problem(dict.fromkeys(self.axes, "both"), {})
            for axis, (after, before) in held_out(stage, file, self.axes, several).items():
                figures[axis] |= {"held_out": after, "file": before}
        found, axes, bounds = dict[str, Estimate](), dict[str, Any](), list[Finding]()
        others, held = other_estimates(p, numbers)
        for axis in self.axes:
            own = speeds([s.motion for s in self.used], axis)
            known = _drag_known(p, x, stage.found, axis, own[1], shapes.get(axis))
            result = axis_result(
                p, x, numbers, axis, speeds=own, drag_known=known, given=self.known.get(axis)
            )
            reason = ""
            worst, r2 = unexplained(stage.problem, stage.solution, axis, self.used)
            if figures.get(axis, {}).get("r2", 1.0) < EXPLAINED:
                reason = f"the model explains nothing of this axis' motion: R² {figures[axis]['r2']:.2f}"
            elif r2 < EXPLAINED:
                reason = (
                    f"the model explains nothing of how {worst} moves, R² {r2:.2f}: fit its releases apart"
                )
            if reason:
                result.believe_nothing(reason)
            if axis == "heave":
                others["buoyancy_excess"], said = self.buoyancy(others["buoyancy_excess"], reason)
                result.findings += said
            found |= result.estimates
            if axis in self.free:
                found |= result.estimates if reason else self.free_estimates(stage, result)
            axes |= result.changes
            bounds += result.findings
        found |= others
        sources = {s.drive.source for s in self.used}
        unmeasured = [axis for axis in p.unseen if axis not in observable(self.prepared)]
        new = changes(p, x, found, axes, unmeasured=unmeasured, scaled=sources <= {"rpm", "pwm"})
        P, local = stage.problem.judged, stage.found.covariance.local
        correlation, traded = degeneracy(p.names[:P], local[:P, :P], stage.found.free[:P])
        left_out = [one.trial.name for one in self.prepared if one not in self.used]
        remarks = [
            *remarks,
            *self.remarks,
            *(finding("trial_left_out", name) for name in left_out),
            *fit_findings(stage.problem, stage.solution, stage.found, self.used),
            *bounds,
            *held,
            *traded,
        ]
        settings: dict[str, Any] = {
            "axes": list(self.axes),
            "damping": damping,
            "drag": dict(kinds) | {axis: shape.weights for axis, shape in shapes.items()},
            "estimate": sorted(self.extras),
            "fix": {f"{axis}.m": m for axis, m in self.known.items()},
            "published": self.published,
            "speeds": {axis: round(figures[axis]["speed_high"], 4) for axis in self.axes if axis in figures},
            "horizon": round(self.length, 3),
            "step": STEP,
            "segments": len(self.segments),
            "iterations": stage.solution.iterations,
        }
        self.say("done")
        return Fit(
            kind="hydrodynamics",
            method="simulation",
            before=self.vehicle,
            estimates=found,
            changes=new,
            quality=figures,
            correlation=correlation,
            findings=tuple(dict.fromkeys(remarks)),
            curves=pictures(stage.problem, stage.solution, self.axes),
            trials={one.trial.name: one.trial.sha256 for one in self.used},
            settings=settings,
            interrupted=stage.solution.interrupted,
        )

    def buoyancy(self, excess: Estimate, reason: str) -> tuple[Estimate, list[Finding]]:
        """Return the excess of buoyancy, not identifiable where it rests on an assumed mass, and what contradicts it.

        Args:
            excess: Estimate from the simulation.
            reason: Why the axis cannot be believed; empty where it can.
        """
        file = matrices(self.vehicle).excess
        assumed = "heave" in self.free and "heave" not in self.known
        if not (assumed or reason):
            return excess, []
        note = reason or f"from the acceleration, {self.notes['heave']}"
        low, high = excess.ci95
        said = [] if reason or low <= file <= high else [
            finding("buoyancy_contradicted", "heave", file=file, low=low, high=high)
        ]  # fmt: skip
        return replace(excess, identifiable=False, note=note), said

    def free_estimates(self, stage: Stage, result: AxisResult) -> dict[str, Estimate]:
        """Return the estimates of an axis that moved without thrust: ratios, and the others with their assumption."""
        axis, (_, top) = result.axis, result.speeds
        p, i, out = stage.problem.parameters, AXES.index(result.axis), dict[str, Estimate]()
        for name, e in result.estimates.items():
            # The equilibrium of a swing may be that of a sensor that was mounted askew.
            sure = e.identifiable and not name.endswith(".bias")
            out[name] = replace(
                e, identifiable=sure, note="; ".join(filter(None, [e.note, self.notes.get(axis)]))
            )

        def plant(x: Array) -> tuple[float, float, float, float, float]:
            """Return m, d1, d2, k and the excess of buoyancy of a vector."""
            M_A, D1, D2 = (matrix[0, i, i] for matrix in p.matrices(x))
            file = matrices(self.vehicle)
            k = p.value(x[None], "k", float(file.arm[2]))
            excess = p.value(x[None], "buoyancy_excess", file.excess)
            return float(p.M_RB[i, i] + M_A), float(D1), float(D2), float(np.max(k)), float(np.max(excess))

        def add(
            name: str, of: Callable[..., float], unit: str, note: str = "", positive: bool = True
        ) -> None:
            value, (low, high) = derived(stage, lambda x: of(*plant(x)), self.own_error, positive)
            sure = bool(value > 0.0 and 0.5 * (high - low) <= CERTAIN * value)
            note = note or ("" if sure else "uncertain by more than a fifth of its value")
            out[f"{axis}.{name}"] = Estimate(
                name=f"{axis}.{name}",
                estimate=value,
                ci95=(low, high),
                unit=unit,
                identifiable=sure,
                note=note,
            )

        if axis in SWINGING:
            rubbed = 8.0 / (3.0 * np.pi) * top
            add("natural_frequency", lambda m, d1, d2, k, e: float(np.sqrt(k / m)), "rad/s")
            # A quadratic term counts as the linear one that takes as much energy out of the largest swing.
            add(
                "damping_ratio", lambda m, d1, d2, k, e: (d1 + rubbed * d2) / (2.0 * float(np.sqrt(k * m))), "-",
                f"at a swing of {top:.2g} rad/s",
            )  # fmt: skip
        if axis == "heave":
            add("terminal_speed", lambda m, d1, d2, k, e: terminal_speed(d1, d2, e), "m/s", "of a rise")
            return out
        for name, unit in (("d1", "1/s"), ("d2", "1/m" if i < 3 else "1/rad")):
            drag = result.estimates.get(f"{axis}.{name}")
            if drag is None:
                continue
            of = (lambda m, d1, d2, k, e: d1 / m) if name == "d1" else (lambda m, d1, d2, k, e: d2 / m)
            add(f"{name}/m_eff", of, unit, positive=False)
        return out


EXPLAINED = 0.2
"""R² below which the model of an axis explains nothing: at 0 the mean of the measurements does as well."""

SWINGING = ("roll", "pitch")
"""Axes that the weight rights."""


def terminal_speed(d1: float, d2: float, excess: float) -> float:
    """Return the speed at which drag equals an excess of buoyancy [m/s].

    Args:
        d1: Linear damping of heave [N s/m].
        d2: Quadratic damping of heave [N s²/m²].
        excess: Buoyancy less weight [N].
    """
    e = max(excess, 0.0)
    return 2.0 * e / max(d1 + float(np.sqrt(d1**2 + 4.0 * d2 * e)), 1e-12)


def derived(
    stage: Stage, of: Callable[[Array], float], own_error: float, positive: bool
) -> tuple[float, tuple[float, float]]:
    """Return a function of the parameters and its 95 % interval, to first order.

    It has the unit of the function.

    Args:
        stage: A finished fit.
        of: Vector of parameters (P,) -> the number.
        own_error: Of the simulation itself, as a part of the number.
        positive: Whether the interval is that of the logarithm.
    """
    from scipy.stats import t

    p, x, C = stage.problem.parameters, stage.x, stage.found.covariance
    h = 1e-4 * np.maximum(np.abs(x), 1e-2 * p.scale)
    value, steps = of(x), np.diag(h)
    slope = np.array([(of(x + s) - of(np.maximum(x - s, p.low))) for s in steps])
    slope /= x + h - np.maximum(x - h, p.low)
    at = np.flatnonzero(slope).tolist()
    dof = float(np.min(C.dof[at], initial=np.inf))
    half = float(t.ppf(0.975, min(dof, 1e6))) * float(np.sqrt(stage.found.variance(slope[at], at)))
    half = float(np.hypot(half, own_error * value))
    if positive and value > 0.0:
        factor = float(np.exp(min(half / value, 50.0)))
        return value, (value / factor, value * factor)
    return value, (max(value - half, 0.0), value + half)


def _matrices(p: Parameters, x: Array) -> dict[str, Any]:
    """Changes of the vehicle file to the matrices of a vector."""
    names = ("added_mass", "linear_damping", "quadratic_damping")
    return {f"{SET}.{name}": m[0] for name, m in zip(names, p.matrices(x), strict=True)}


Progress = Callable[[float, str], None]


def fit_by_simulation(
    trials: Sequence[Trial],
    vehicle: Vehicle,
    *,
    axes: Sequence[str] | None = None,
    estimate: Sequence[str] = (),
    damping: str | Mapping[str, str] = "auto",
    known: Mapping[str, float] | None = None,
    horizon: float | None = None,
    likely: bool = False,
    published: Mapping[str, float] | None = None,
    progress: Progress | None = None,
) -> Fit:
    """Fit by simulation error over all trials together.

    Trials are cut into segments with an initial state each; Levenberg-Marquardt moves the parameters, the initial
    states, offsets of the sensors and lags of their streams, with derivatives from parallel worlds. All numbers hold at
    the reference point of the vehicle's calibrated set.

    Args:
        trials: Of any inputs, rates and measured columns.
        vehicle: Gives the rigid body, the motors and everything that is not fitted.
        axes: Axes to fit; those that the trials excite if None.
        estimate: Of `EXTRAS`, parameters of the vehicle's terms, such as `lift.coefficient`, and of its actuators, such
            as `fin.lift_slope`, of which a factor is fitted. Buoyancy comes
            with heave, stiffness with roll and pitch, a bias with the others.
        damping: `auto`, `linear`, `quadratic` or `both`; or one of the last three by axis.
        known: Effective inertias M_RB + M_A that are known, by axis [kg, kg m²].
        horizon: Length of the segments [s]; from the data if None.
        likely: Whether the thrust is known no better than by the voltages that batteries have; its scale is then fitted
            with that as its prior, and goes to the file with the rest.
        published: `top_speed` [m/s] and `bollard_pull` [N], both ahead: data on drag and thrust.
        progress: Called with the part done and a few words.

    Returns:
        After Ctrl-C the best until then, with `interrupted`.

    Raises:
        CalibrationError: No trial can be used, one is held out, or a word is unknown.
    """
    _check(trials, vehicle, axes, damping, estimate, horizon)
    prepared, remarks = prepare(trials, vehicle, axes)
    chosen, more = _axes(prepared, vehicle, axes)
    strange = [axis for axis in known or {} if axis not in chosen]
    if strange:
        raise CalibrationError(
            f"the inertia of {', '.join(strange)} was given, but the fitted axes are {', '.join(chosen)}"
        )
    remarks, say = [*remarks, *more], FitProgress(progress)
    say("preparing")
    estimate = [*estimate, "thrust_scale"] if likely else estimate
    fit = Stages(
        telling(prepared, vehicle, chosen),
        vehicle,
        chosen,
        tuple(estimate),
        known or {},
        horizon,
        say,
        likely,
        published,
    )
    fit.require_shown()
    if isinstance(damping, str):
        kinds = dict.fromkeys(chosen, "both" if damping == "auto" else damping)
    else:
        kinds = {axis: damping.get(axis, "both") for axis in chosen}
    stage = fit.rough(kinds, [{}, fit.weak_start])
    start = dict(zip(stage.problem.parameters.names, stage.x.tolist(), strict=True))
    if not stage.solution.interrupted:
        stage = fit.first(kinds, start)
    shapes = fit.shapes(stage) if damping == "auto" and not stage.solution.interrupted else {}
    return fit.result(averaged(stage, shapes), shapes, remarks, damping=str(damping), kinds=kinds)


def prepare(
    trials: Sequence[Trial], vehicle: Vehicle, axes: Sequence[str] | None = None
) -> tuple[list[Streams], list[Finding]]:
    """Return the trials that can be used, and findings on what was assumed of them and on those that cannot.

    A trial without thrust is cut to the free motions of its axes.

    Raises:
        CalibrationError: No trial can be used.
    """
    prepared, remarks, reasons = list[Streams](), list[Finding](), list[str]()
    for trial in trials:
        try:
            one = streams(trial, vehicle)
            if trial.header.passive:
                named = trial.header.axis or AXES
                one = released(one, [a for a in AXES if a in named and (axes is None or a in axes)])
        except CalibrationError as error:
            remarks.append(finding("unusable", trial.name, severity="care", reason=error.reason))
            reasons.append(str(error))
            continue
        prepared.append(one)
        remarks += [item.about(trial.name) for item in one.motion.findings]
    if not prepared:
        others = f"; and {len(reasons) - 1} trials more" if len(reasons) > 1 else ""
        raise CalibrationError(f"no trial can be used: {reasons[0]}{others}")
    return prepared, remarks


DAMPING = ("auto", "linear", "quadratic", "both")

HORIZONS = (0.5, 60.0)
"""Shortest and longest segments that can be asked for [s]."""


def _check(
    trials: Sequence[Trial],
    vehicle: Vehicle,
    axes: Sequence[str] | None,
    damping: str | Mapping[str, str],
    estimate: Sequence[str],
    horizon: float | None,
) -> None:
    require_fittable(trials, vehicle)
    require_axes(axes)
    if horizon is not None and not HORIZONS[0] <= horizon <= HORIZONS[1]:
        raise CalibrationError(f"horizon is {horizon:g} s, expected {HORIZONS[0]:g} to {HORIZONS[1]:g} s")
    if isinstance(damping, str) and damping not in DAMPING:
        raise CalibrationError(f"unknown damping '{damping}'; available: {', '.join(DAMPING)}")
    chosen = vehicle.hydrodynamics.get("calibrated")
    known = [*EXTRAS, *(chosen.term_scalars if isinstance(chosen, HydrodynamicSet) else ())]
    known += actuator_fields(vehicle)
    for word in estimate:
        if word not in known:
            raise CalibrationError(
                f"cannot estimate '{word}'; available: {', '.join(known)}"
                + ("; a term's parameter only where the vehicle file has the term" if "." in word else "")
            )


def _axes(
    prepared: Sequence[Streams], vehicle: Vehicle, axes: Sequence[str] | None
) -> tuple[tuple[str, ...], list[Finding]]:
    """Axes to fit, and why some that were asked for are not."""
    moved, seen = excited(prepared, vehicle), observable(prepared)
    if axes is None:
        if not moved:
            raise CalibrationError(
                f"no trial excites an axis of {vehicle.name}: name the axes, or give trials with larger inputs"
            )
        named = {axis for s in prepared for axis in s.trial.header.axis}
        return moved, [finding("axis_untold", axis) for axis in AXES if axis in named and axis not in seen]
    driven = any(s.drive.source != "passive" for s in prepared)
    remarks = [finding("axis_untold", axis) for axis in axes if axis not in seen]
    unmoved = [axis for axis in axes if axis in seen and axis not in moved]
    remarks += [
        finding("axis_doubtful", axis) if driven else finding("axis_not_free", axis) for axis in unmoved
    ]
    chosen = tuple(a for a in AXES if a in axes and a in seen and (driven or a in moved))
    if not chosen:
        raise CalibrationError(f"no measurement that determines {', '.join(axes)} is in these trials")
    return chosen, remarks
