"""How much of a vehicle's steady drag its panels and its propellers make, by axis: so that damping keeps the rest."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.geometry.mesh import face_geometry
from finssim.pool.plant_spec import Propellers
from finssim.vehicles import Vehicle

__all__ = ["cruise", "hull_share", "less_share", "panel_drag", "steady_share"]

Array = NDArray[np.float64]

CRUISE = 0.4
"""Part of the largest wrench at which the shares are taken: between hovering and full speed [-]."""

LARGEST = 2.0 / 3.0
"""Largest part of a damping coefficient that is taken out [-]."""

SKIN = 0.02
"""Skin drag over form drag, as in the published mesh set [-]."""


def cruise(vehicle: Vehicle) -> tuple[Array, Array]:
    """Steady wrench and velocity of each axis alone at `CRUISE`, by the file's damping.

    Returns:
        Wrench [N, N m] and velocity [m/s, rad/s], (6,) each; zeros where an axis is not controlled or not damped.
    """
    hydro: Any = vehicle.hydrodynamics["calibrated"]
    d1, d2 = np.diag(hydro.linear_damping), np.diag(hydro.quadratic_damping)
    F = CRUISE * np.asarray(vehicle.wrench_limits)
    # d2 v² + d1 v = F, by the root that stays exact without d2.
    root = d1 + np.sqrt(d1 * d1 + 4.0 * d2 * F)
    v = np.divide(2.0 * F, root, out=np.zeros(6), where=root > 0.0)
    return F, v


def panel_drag(vehicle: Vehicle) -> Array:
    """Drag of the hull's panels when cruising along each axis, with C_form = 1 [N, N m], (6,); zeros without a hull."""
    if vehicle.hull is None:
        return np.zeros(6)
    _, v = cruise(vehicle)
    hydro: Any = vehicle.hydrodynamics["calibrated"]
    normal, area, middle = face_geometry(*vehicle.hull_mesh())
    half = 0.5 * vehicle.water.density
    drag = np.zeros(6)
    arm = middle - np.asarray(hydro.reference_point)
    for axis in range(6):
        if axis < 3:
            flow = np.zeros_like(middle)
            flow[:, axis] = -v[axis]
        else:
            flow = -np.cross(np.eye(3)[axis - 3] * v[axis], arm)
        across = np.sum(normal * flow, axis=1)
        v_t = flow - across[:, None] * normal
        skin = SKIN * np.linalg.norm(v_t, axis=1)[:, None] * v_t
        pull = half * area[:, None] * (np.maximum(-across, 0.0)[:, None] * flow + skin)
        total = pull.sum(axis=0) if axis < 3 else np.cross(arm, pull).sum(axis=0)
        drag[axis] = -total[axis % 3]
    return drag


def hull_share(vehicle: Vehicle, share: float, drag: Array) -> dict[str, float]:
    """Coefficients with which the panels make a share of the file's drag, on the driven axis where that is largest.

    Args:
        vehicle: Its file.
        share: Of the drag when cruising [-].
        drag: As from `panel_drag`.
    """
    F, _ = cruise(vehicle)
    largest = np.max(np.divide(drag, F, out=np.zeros(6), where=F > 0.0), initial=0.0)
    form = float(f"{share / largest:.6g}") if largest > 0.0 else 0.0
    return {"form_drag": form, "skin_drag": float(f"{SKIN * form:.6g}")}


def steady_share(vehicle: Vehicle, panels: Array, propellers: Mapping[str, float], deduction: float) -> Array:
    """What panels and propellers take when cruising, by axis [N, N m], (6,).

    The propellers' part is the thrust lost to their own motion through the water, T V / (J0 n D), see `losses`, and to
    the thrust deduction: a file's damping was fitted to thrusts measured on a bench, so it holds both.

    Args:
        vehicle: Its file.
        panels: Drag of the panels, by axis [N, N m], (6,).
        propellers: Keys of `Propellers`.
        deduction: Mean of the thrust deduction [-].
    """
    F, v = cruise(vehicle)
    p = Propellers.model_validate(propellers)
    thrusters = list(vehicle.thrusters.values())
    B = vehicle.thruster_matrix()
    axis = np.array([t.axis for t in thrusters])
    place = np.array([t.position for t in thrusters])
    taken = panels.copy()
    for i in np.flatnonzero(v > 0.0):
        T = np.linalg.pinv(B) @ (F[i] * np.eye(6)[i])
        speed = np.array([abs(t.speed(f)) for t, f in zip(thrusters, T, strict=True)])
        motion = np.eye(3)[i] if i < 3 else np.cross(np.eye(3)[i - 3], place)
        own = v[i] * np.sum(axis * motion, axis=1)
        stall = p.advance_at_zero_thrust * p.diameter / (2.0 * math.pi) * np.maximum(speed, 20.0)
        taken[i] += B[i] @ (np.abs(T) * p.own_share * own / stall)
    return np.where(v > 0.0, taken + deduction * F, 0.0)


def less_share(vehicle: Vehicle, D1: Array, D2: Array, taken: Array) -> tuple[Array, Array]:
    """Damping that is left when a part of the drag is made by something else; a third always stays.

    Args:
        vehicle: Its file.
        D1: Linear [N s/m, N m s], (6, 6).
        D2: Quadratic [N s²/m², N m s²], (6, 6).
        taken: Drag when cruising, by axis [N, N m], (6,): out of the linear part first.

    Returns:
        D1 and D2 with smaller diagonals.
    """
    _, v = cruise(vehicle)
    first = np.minimum(taken, LARGEST * np.diag(D1) * v)
    second = np.minimum(taken - first, LARGEST * np.diag(D2) * v * v)
    safe = np.where(v > 0.0, v, 1.0)
    return D1 - np.diag(first / safe), D2 - np.diag(second / safe**2)
