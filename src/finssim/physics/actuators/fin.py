"""A fin: a deflected surface with lift and drag by its angle of attack, in the flow at its place."""

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
    """Deflection while the vehicle is disarmed or in a fault [rad]; it stays where it is if None."""
    position: Vector3
    """Centre of pressure, from the body origin, body frame [m], (3,)."""
    span: Axis
    """Axis about which the fin turns, body frame, unit length, (3,)."""
    chord: Axis = Field(default_factory=lambda: np.array([1.0, 0.0, 0.0]))
    """Direction of the leading edge at deflection 0, body frame, unit length, perpendicular to `span`, (3,)."""
    area: Positive
    """Planform area of the surface, or of all surfaces that turn together [m²]."""
    lift_slope: Positive
    """Slope of the lift coefficient over the angle of attack, below stall [1/rad]."""
    stall: Positive
    """Angle of attack beyond which lift falls, to 0 at 90° [rad]."""
    drag: Vector3 = zeros(3)
    """Drag coefficient d0 + d1 |α| + d2 α² over the angle of attack α: [-], [1/rad], [1/rad²], (3,); at most 2."""
    incidence: Probability = 1.0
    """Part of the flow's own angle that counts: 1 for a fin in the flow, 0 where the hull's coefficients hold the lift
    of the fixed fins and the deflection alone counts."""
    wake: dict[str, NonNegative] = Field(default_factory=dict)
    """Name of a thruster in whose wake the fin is -> part of the wake's momentum that reaches it, up to 1 at the disc's
    exit [-]; the thruster needs a `diameter`."""

    @property
    def sides(self) -> tuple[float, float]:
        """Return length along the chord and along the span of a plate of this area, twice as wide as long, to be drawn
        [m]."""
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
    """Lift ½ρ A C_L(α) V² across the flow and drag ½ρ A C_D(α) V² along it.

    α = δ - β,  β = incidence · atan2(v·n, v·c),  n = span × c          (Fossen 2021, sec. 9.7; thin aerofoil)

    V² is that of the flow in the plane across the span, and in a propeller's wake it is greater by 2 T / (ρ A_disc)
    (momentum theory). Beyond the stall lift falls linearly to 0 at 90°; a fin that moves backwards is one turned by
    180°.

    Args:
        value: Deflection δ [rad].
        nu_r: Velocity of the body origin relative to the water, body frame [m/s, rad/s].
        thrust: Of each thruster [N].
        density: Of the water [kg/m³].
        position: Centre of pressure, body frame [m].
        span: Axis of the deflection, body frame [-].
        chord: c, direction of the leading edge at deflection 0, body frame [-].
        area: A [m²].
        lift_slope: [1/rad].
        stall: [rad].
        drag: Coefficients of C_D over |α|, [-], [1/rad] and [1/rad²].
        incidence: Part of the flow's angle that counts [-].
        wake: 2 k / A_disc of each thruster, with the part k of its wake that reaches the fin [1/m²].

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
    """Return twice ½ρ A V (incidence C_Lα + d0) along the normal, and that times the square of its lever.

    That is the slope of a fin straight ahead; twice, since a fin couples sway and yaw, each of which takes its part.

    Args:
        nu_r: Velocity of the body origin relative to the water, body frame [m/s, rad/s].
        density: Of the water [kg/m³].
        position: Centre of pressure, body frame [m].
        span: Axis of the deflection, body frame [-].
        chord: Direction of the leading edge at deflection 0, body frame [-].
        area: A [m²].
        lift_slope: C_Lα [1/rad].
        drag: Coefficients of C_D over |α|, [-], [1/rad] and [1/rad²].
        incidence: Part of the flow's angle that counts [-].

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
