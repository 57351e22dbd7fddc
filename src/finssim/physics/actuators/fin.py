"""Fin: a deflected surface with lift and drag by its angle of attack in the local flow."""

# mypy: disable-error-code="arg-type,no-any-return,no-untyped-call,operator,valid-type"

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from pydantic import Field, model_validator

from finssim.physics.types import MAX_THRUSTERS, angular, join, linear, vec6, vec8
from finssim.vehicles.actuators import Actuator, ActuatorKind
from finssim.vehicles.part import (
    Axis,
    NonNegative,
    Number,
    Positive,
    Probability,
    Vector3,
    refuse_section,
    zeros,
)

QUARTER = 0.5 * np.pi
DRAG_MAX = 2.0
"""Greatest drag coefficient: that of a flat plate across the flow [-]."""


class Fin(Actuator):
    """Section of a fin; its value is the deflection [rad], about `span` by the right-hand rule."""

    off: Number | None = 0.0
    """Deflection while the vehicle is disarmed or in a fault [rad]; None leaves it unchanged."""
    position: Vector3
    """Centre of pressure, from the body origin, body frame [m], (3,)."""
    span: Axis
    """Axis of the deflection, body frame, unit length, (3,)."""
    chord: Axis = Field(default_factory=lambda: np.array([1.0, 0.0, 0.0]))
    """Direction of the leading edge at deflection 0, body frame, unit length, perpendicular to `span`, (3,)."""
    area: Positive
    """Planform area of the surface, or of all surfaces that are deflected together [m²]."""
    lift_slope: Positive
    """Slope of the lift coefficient over the angle of attack, below stall [1/rad]."""
    stall: Positive
    """Angle of attack beyond which the lift decreases, to 0 at 90° [rad]."""
    drag: Vector3 = zeros(3)
    """Drag coefficient d0 + d1 |α| + d2 α² over the angle of attack α: [-], [1/rad], [1/rad²], (3,); at most 2."""
    incidence: Probability = 1.0
    """Weight of the flow angle in the angle of attack: 1 for a fin in the flow; 0 if the hull's coefficients contain
    the lift of the undeflected fins, so that only the deflection counts."""
    wake: dict[str, NonNegative] = Field(default_factory=dict)
    """Name of a thruster whose wake reaches the fin -> fraction of the wake's momentum at the fin, up to 1 at the exit
    of the disc [-]; the thruster needs a `diameter`."""

    @property
    def sides(self) -> tuple[float, float]:
        """Return the lengths along chord and span of a plate of this area, twice as wide as long, for drawings [m]."""
        length = float(np.sqrt(0.5 * self.area))
        return length, 2.0 * length

    @model_validator(mode="after")
    def _possible(self) -> Fin:
        if abs(float(self.span @ self.chord)) > 1e-6:
            raise refuse_section("chord is not perpendicular to span: give the direction of the leading edge")
        if self.stall >= QUARTER:
            raise refuse_section(f"stall is {self.stall:g} rad, expected less than a right angle (1.5708)")
        if self.drag.min() < 0.0:
            raise refuse_section(f"drag is {self.drag.tolist()}, expected 3 numbers >= 0")
        return self


@wp.func
def fin_wrench(
    value: float,
    nu_r: vec6,
    thrust: vec8,
    density: float,
    position: wp.vec3,
    span: wp.vec3,
    chord: wp.vec3,
    area: float,
    lift_slope: float,
    stall: float,
    drag: wp.vec3,
    incidence: float,
    wake: vec8,
) -> vec6:
    """Return the lift ½ρ A C_L(α) V² across the flow and the drag ½ρ A C_D(α) V² along it.

    α = δ - β,  β = incidence · atan2(v·n, v·c),  n = span × c          (Fossen 2021, sec. 9.7; thin aerofoil)

    V is the speed of the flow in the plane perpendicular to the span; a propeller's wake increases V² by 2 T / (ρ
    A_disc) (momentum theory). Beyond stall, lift decreases linearly to 0 at 90°; a fin in reverse flow is treated as
    rotated by 180°.

    Args:
        value: Deflection δ [rad].
        nu_r: Velocity of the body origin relative to the water, body frame [m/s, rad/s].
        thrust: Thrust of each thruster [N].
        density: Density of the water [kg/m³].
        position: Centre of pressure, body frame [m].
        span: Axis of the deflection, body frame [-].
        chord: c, direction of the leading edge at deflection 0, body frame [-].
        area: A [m²].
        lift_slope: [1/rad].
        stall: [rad].
        drag: Coefficients of C_D over |α|, [-], [1/rad] and [1/rad²].
        incidence: Weight of the flow angle [-].
        wake: 2 k / A_disc of each thruster, with the fraction k of its wake that reaches the fin [1/m²].

    Returns:
        Wrench about the body origin, body frame [N, N m].
    """
    normal = wp.cross(span, chord)
    velocity = linear(nu_r) + wp.cross(angular(nu_r), position)
    u = wp.dot(velocity, chord)
    w = wp.dot(velocity, normal)
    square = u * wp.abs(u)
    for k in range(MAX_THRUSTERS):
        square += wake[k] * wp.max(thrust[k], 0.0) / density
    u = wp.where(square >= 0.0, 1.0, -1.0) * wp.sqrt(wp.abs(square))
    beta = incidence * wp.atan2(w, u)
    alpha = value - beta
    alpha = wp.where(alpha > wp.static(QUARTER), alpha - wp.static(2.0 * QUARTER), alpha)
    alpha = wp.where(alpha < wp.static(-QUARTER), alpha + wp.static(2.0 * QUARTER), alpha)
    size = wp.abs(alpha)
    beyond = wp.max(wp.static(QUARTER) - size, 0.0) * stall / (wp.static(QUARTER) - stall)
    lift = wp.where(alpha >= 0.0, 1.0, -1.0) * lift_slope * wp.min(size, beyond)
    resistance = wp.min(drag[0] + size * (drag[1] + size * drag[2]), wp.static(DRAG_MAX))
    along = wp.cos(beta) * chord + wp.sin(beta) * normal
    across = wp.cos(beta) * normal - wp.sin(beta) * chord
    pressure = 0.5 * density * area * (u * u + w * w)
    force = (pressure * lift) * across - (pressure * resistance) * along
    return join(force, wp.cross(position, force))


@wp.func
def fin_slope(
    nu_r: vec6,
    density: float,
    position: wp.vec3,
    span: wp.vec3,
    chord: wp.vec3,
    area: float,
    lift_slope: float,
    drag: wp.vec3,
    incidence: float,
) -> vec6:
    """Return twice ½ρ A V (incidence C_Lα + d0) along the normal, and this times the square of the lever arm.

    This is the slope of the force of a fin in straight flow, doubled because a fin couples sway and yaw.

    Args:
        nu_r: Velocity of the body origin relative to the water, body frame [m/s, rad/s].
        density: Density of the water [kg/m³].
        position: Centre of pressure, body frame [m].
        span: Axis of the deflection, body frame [-].
        chord: Direction of the leading edge at deflection 0, body frame [-].
        area: A [m²].
        lift_slope: C_Lα [1/rad].
        drag: Coefficients of C_D over |α|, [-], [1/rad] and [1/rad²].
        incidence: Weight of the flow angle [-].

    Returns:
        Slope of the wrench on each axis, body frame [N s/m, N m s/rad].
    """
    normal = wp.cross(span, chord)
    velocity = linear(nu_r) + wp.cross(angular(nu_r), position)
    u = wp.dot(velocity, chord)
    w = wp.dot(velocity, normal)
    size = density * area * wp.sqrt(u * u + w * w) * (incidence * lift_slope + drag[0])
    lever = wp.cross(position, normal)
    return size * join(wp.cw_mul(normal, normal), wp.cw_mul(lever, lever))


def _numbers(fin: Any, vehicle: Any) -> dict[str, Any]:
    wake = np.zeros(MAX_THRUSTERS)
    for name, part in fin.wake.items():
        wake[vehicle.thruster_names.index(name)] = (
            8.0 * part / (np.pi * vehicle.thrusters[name].diameter ** 2)
        )
    return {"wake": wake}


FIN = ActuatorKind(
    name="fin",
    schema=Fin,
    unit="rad",
    units={
        "position": "m",
        "span": "1",
        "chord": "1",
        "area": "m²",
        "lift_slope": "1/rad",
        "stall": "rad",
        "drag": "1, 1/rad, 1/rad²",
        "incidence": "1",
        "wake": "1/m²",
    },
    wrench=fin_wrench,
    slope=fin_slope,
    numbers=_numbers,
)
