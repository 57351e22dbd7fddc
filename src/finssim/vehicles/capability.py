"""Capability of a vehicle with its thrusters: wrenches, terminal speeds, time constants, natural frequencies, trim."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finssim.vehicles.hydrodynamics import HydrodynamicSet, MeshSet
from finssim.vehicles.part import VehicleError
from finssim.vehicles.vehicle import AXES, Vehicle, moved_to_origin

__all__ = [
    "Restoring",
    "Trim",
    "WrenchCapability",
    "coefficients_of",
    "level_speed",
    "panel_drag",
    "restoring",
    "terminal_speed",
    "terminal_speeds",
    "time_constants",
    "trim",
    "wrench_capability",
]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class WrenchCapability:
    """Largest pure wrenches about `wrench_reference`, order surge sway heave roll pitch yaw [N, N m]."""

    positive: Array
    """Greatest value in the positive direction [N, N m], (6,)."""
    negative: Array
    """Greatest value in the negative direction, as magnitudes [N, N m], (6,)."""

    @property
    def symmetric(self) -> Array:
        """Return the largest values that are reachable in both directions [N, N m], (6,)."""
        return np.minimum(self.positive, self.negative)


def wrench_capability(vehicle: Vehicle) -> WrenchCapability:
    """Return the largest wrench on each controlled axis while the other controlled components are zero.

    max t  subject to  (B f)_axis = t,  (B f)_j = 0 for the other controlled j,  f_min <= f <= f_max

    A component that the vehicle does not control is unconstrained; its own limit is zero.

    Returns:
        Limits about `wrench_reference`, body frame.
    """
    B = vehicle.control_matrix
    lower, upper = vehicle.force_limits
    controlled = [AXES.index(axis) for axis in vehicle.controlled_axes]
    limits = np.zeros((2, 6))
    for i in controlled:
        others = B[[j for j in controlled if j != i]]
        for row, sign in enumerate((1.0, -1.0)):
            limits[row, i] = max(0.0, sign * B[i] @ largest(sign * B[i], others, lower, upper))
    return WrenchCapability(positive=limits[0], negative=limits[1])


def largest(gain: Array, zero: Array, lower: Array, upper: Array) -> Array:
    """Return f that maximises gain · f subject to zero f = 0 and lower <= f <= upper, by an active set from f = 0.

    A step follows the gain, projected onto the null space of the constraints and the active bounds, to the next
    bound. Where no further gain is possible, a bound whose multiplier has the wrong sign is released; without such a
    bound, f is optimal (Karush, Kuhn and Tucker). The lowest index is chosen first, which prevents cycling (Bland).

    Args:
        gain: Wrench component per thrust [- or m], (n,).
        zero: Rows of the components that must be zero [- or m], (m, n).
        lower: Least thrusts [N], at most 0, (n,).
        upper: Greatest thrusts [N], at least 0, (n,).

    Raises:
        VehicleError: The numbers differ so much in magnitude that rounding hides the optimum.
    """
    n, f = len(gain), np.zeros(len(gain))
    side = np.zeros(n, int)  # -1 at the lower bound, 1 at the upper one, 0 free
    tiny = 1e-10 * max(float(np.abs(gain).max()), 1e-300)
    for _ in range(100 * n):
        held = np.flatnonzero(side)
        rows = np.vstack([zero, np.eye(n)[held]])
        multipliers = np.linalg.lstsq(rows.T, gain, rcond=None)[0] if len(rows) else np.zeros(0)
        direction = gain - rows.T @ multipliers
        direction[held] = 0.0
        if np.abs(direction).max() <= tiny:
            wrong = held[multipliers[len(zero) :] * side[held] < -tiny]
            if not len(wrong):
                return f
            side[wrong[0]] = 0
            continue
        with np.errstate(divide="ignore", invalid="ignore"):
            room = np.where(direction > 0.0, upper - f, f - lower) / np.abs(direction)
        room[np.abs(direction) <= tiny] = math.inf
        step = float(room.min())
        k = int(np.flatnonzero(room <= step * (1.0 + 1e-12))[0])
        side[k] = 1 if direction[k] > 0.0 else -1
        f = np.clip(f + step * direction, lower, upper)
    raise VehicleError(
        f"the largest wrench of {n} thrusters was not found: check their positions, axes and limits"
    )


def terminal_speed(d1: float, d2: float, tau: float) -> float:
    """Return the steady speed under a constant load: the positive root of d1 v + d2 v² = tau; inf without damping.

    Args:
        d1: Linear damping [N s/m or N m s].
        d2: Quadratic damping [N s²/m² or N m s²].
        tau: Load, >= 0 [N or N m].

    Returns:
        [m/s or rad/s]
    """
    if tau == 0.0:
        return 0.0
    drag = d1 + math.sqrt(d1 * d1 + 4.0 * d2 * tau)
    return 2.0 * tau / drag if drag > 0.0 else math.inf


def coefficients_of(vehicle: Vehicle) -> str:
    """Return the name of the hydrodynamic set that describes the vehicle: the calibrated one, if its file
    contains it."""
    sets = [name for name, model in vehicle.hydrodynamics.items() if isinstance(model, HydrodynamicSet)]
    return sets[0] if sets and "calibrated" not in sets else "calibrated"


def terminal_speeds(vehicle: Vehicle, hydrodynamics: str = "calibrated") -> Array:
    """Return the steady speed on each axis alone at its symmetric wrench limit, from d1, d2 and the terms of
    that axis.

    The loss of thrust in a flow is computed at the propeller speed of that limit.

    Returns:
        [m/s, rad/s], (6,)
    """
    chosen = _coefficients(vehicle, hydrodynamics)
    drag = np.diag(chosen.linear_damping) + _inflow_damping(vehicle)
    return np.array(
        [terminal_speed(*row) for row in zip(drag, chosen.axis_drag, vehicle.wrench_limits, strict=True)]
    )


def panel_drag(vehicle: Vehicle, hydrodynamics: str = "mesh") -> Array:
    """Return d2 of steady motion along surge, sway and heave from the panels of the hull, where drag is d2 v².

    d2 = ρ/2 Σ A [C_form max(μ, 0) + C_skin (1 - μ²)^(3/2)],  μ = n · axis                      (paper, eq. 3-4)

    Args:
        vehicle: Vehicle with a hull.
        hydrodynamics: Name of its set with `form_drag` and `skin_drag`.

    Returns:
        d2 [N s²/m²], (3,)
    """
    chosen = vehicle.hydrodynamics[hydrodynamics]
    assert isinstance(chosen, MeshSet)
    vertices, faces = vehicle.hull_mesh()
    a, b, c = np.swapaxes(vertices[faces], 0, 1)
    normals = np.cross(b - a, c - a) / 2.0  # times area
    areas = np.linalg.norm(normals, axis=1, keepdims=True)
    slip = np.clip(areas**2 - normals**2, 0.0, None) ** 1.5 / np.maximum(areas, 1e-300) ** 2
    panels = chosen.form_drag * np.maximum(normals, 0.0) + chosen.skin_drag * slip
    return np.asarray(0.5 * vehicle.water.density * panels.sum(axis=0))


def _inflow_damping(vehicle: Vehicle) -> Array:
    """Loss of thrust per speed on each axis at the axis' symmetric wrench limit [N s/m, N m s], (6,).

    a |ω| (1 - w) (B_i)² of each thruster, with the thrust f that the limit takes and ω = sqrt(|f| / c).
    """
    if all(thruster.inflow is None for thruster in vehicle.thrusters.values()):
        return np.zeros(6)
    B = vehicle.control_matrix
    loss = np.zeros(6)
    for i, limit in enumerate(vehicle.wrench_limits):
        forces = limit * np.linalg.pinv(B)[:, i]
        for column, force, thruster in zip(B[i], forces, vehicle.thrusters.values(), strict=True):
            if thruster.inflow is not None:
                share = thruster.inflow.thrust_loss * (1.0 - thruster.inflow.wake_fraction)
                loss[i] += share * abs(float(thruster.speed(force))) * column**2
    return loss


def time_constants(vehicle: Vehicle, hydrodynamics: str = "calibrated") -> Array:
    """Return m_eff / d1 on each axis, about the centre of gravity; inf where there is no linear damping.

    Returns:
        [s], (6,)
    """
    chosen = _coefficients(vehicle, hydrodynamics)
    mass = np.diag(_at_center_of_gravity(vehicle, vehicle.mass_matrix(hydrodynamics)))
    d1 = np.diag(
        _at_center_of_gravity(vehicle, moved_to_origin(chosen.linear_damping, chosen.reference_point))
    )
    return np.asarray(np.divide(mass, d1, out=np.full(6, math.inf), where=d1 > 0.0))


def level_speed(vehicle: Vehicle, hydrodynamics: str = "calibrated", axis: int = 0) -> float:
    """Return the speed along surge (or sway) at which a small pitch (or roll) angle θ starts to grow [m/s];
    inf if there is none.

    Stiffness k θ against the Munk moment (m_z - m_x) u² θ, masses including added mass: u² = k / (m_z - m_x).
    Damping in heave and pitch raises the speed somewhat; it is neglected.

    Args:
        vehicle: The vehicle.
        hydrodynamics: Name of its set.
        axis: 0 for surge, 1 for sway.
    """
    mass = np.diag(vehicle.mass_matrix(hydrodynamics))
    excess = float(mass[2] - mass[axis])
    stiffness = float(restoring(vehicle, hydrodynamics).stiffness[1 - axis])
    return math.sqrt(stiffness / excess) if excess > 0.0 and stiffness > 0.0 else math.inf


@dataclass(frozen=True)
class Restoring:
    """Static and dynamic response to small rotations of a submerged vehicle about its centre of gravity;
    arrays are (roll, pitch)."""

    stiffness: Array
    """Hydrostatic stiffness B (z_b - z_g) [N m/rad], (2,)."""
    natural_frequency: Array
    """Undamped natural frequency [Hz], (2,); zero where the stiffness is not positive."""
    damping_ratio: Array
    """Damping ratio d1 / (2 sqrt(k I_eff)) [-], (2,)."""
    static_tilt: Array
    """Steady angle under the symmetric roll or pitch moment, asin(tau / k) [rad], (2,); nan where tau > k."""


def restoring(vehicle: Vehicle, hydrodynamics: str = "calibrated") -> Restoring:
    """Return the hydrostatic stiffness in roll and pitch and the quantities derived from it.

    I_eff φ'' + d1 φ' + B (z_b - z_g) sin φ = tau            (uncoupled, fully submerged, weight nearly buoyancy)
    """
    chosen = _coefficients(vehicle, hydrodynamics)
    arm = vehicle.body.center_of_buoyancy[2] - vehicle.body.center_of_gravity[2]
    stiffness = np.full(2, vehicle.buoyancy * arm)
    inertia = np.diag(_at_center_of_gravity(vehicle, vehicle.mass_matrix(hydrodynamics)))[3:5]
    d1 = np.diag(
        _at_center_of_gravity(vehicle, moved_to_origin(chosen.linear_damping, chosen.reference_point))
    )[3:5]
    k = np.maximum(stiffness, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return Restoring(
            stiffness=stiffness,
            natural_frequency=np.sqrt(k / inertia) / (2.0 * math.pi),
            damping_ratio=d1 / (2.0 * np.sqrt(k * inertia)),
            static_tilt=np.arcsin(vehicle.wrench_limits[3:5] / k),
        )


@dataclass(frozen=True)
class Trim:
    """Wrench that holds a submerged vehicle level at rest."""

    wrench: Array
    """Wrench about `wrench_reference`, body frame [N, N m], (6,)."""
    forces: Array | None
    """Thrusts that produce its controlled components, canonical order [N]; None where they exceed the limits."""


def trim(vehicle: Vehicle) -> Trim:
    """Return the thrust that balances weight and buoyancy with the vehicle level.

    tau = -[(0, 0, B - W), (r_b - p) × (0, 0, B) + (r_g - p) × (0, 0, -W)],  p = wrench_reference

    Uncontrolled components are left to the passive stability of the vehicle.
    """
    from scipy.optimize import lsq_linear

    up = np.array([0.0, 0.0, 1.0])
    point = vehicle.wrench_reference
    force = (vehicle.buoyancy - vehicle.weight) * up
    moment = np.cross(vehicle.body.center_of_buoyancy - point, vehicle.buoyancy * up) + np.cross(
        vehicle.body.center_of_gravity - point, -vehicle.weight * up
    )
    wrench = -np.concatenate([force, moment])
    rows = [AXES.index(axis) for axis in vehicle.controlled_axes]
    lower, upper = vehicle.force_limits
    if not rows:
        return Trim(wrench=wrench, forces=np.zeros(len(lower)))
    result = lsq_linear(vehicle.control_matrix[rows], wrench[rows], bounds=(lower, upper), method="bvls")
    missing = np.abs(vehicle.control_matrix[rows] @ result.x - wrench[rows]).max()
    return Trim(wrench=wrench, forces=result.x if missing < 1e-6 * max(1.0, vehicle.weight) else None)


def _coefficients(vehicle: Vehicle, name: str) -> HydrodynamicSet:
    chosen = vehicle.hydrodynamic_set(name)
    if not isinstance(chosen, HydrodynamicSet):
        raise VehicleError(
            f"{vehicle.name}: hydrodynamic set '{name}' is a mesh, it has no damping coefficients"
        )
    return chosen


def _at_center_of_gravity(vehicle: Vehicle, matrix: Array) -> Array:
    return moved_to_origin(matrix, -vehicle.body.center_of_gravity)
