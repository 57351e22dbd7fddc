"""What a hull, its motion and the neighbouring jets take from a propeller's thrust."""
# mypy: disable-error-code="valid-type,misc,index,no-any-return,no-untyped-def,untyped-decorator,attr-defined"

import math
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.physics.motors import thrust_of_speed
from finssim.physics.types import angular, linear, vec6, vec8
from finssim.pool.plant_spec import PlantSpec
from finssim.vehicles import Vehicle

Array = NDArray[np.float64]

SLOWEST = 3.0
"""Below this propeller speed the loss of thrust is taken as at it [1/s]: there is hardly any thrust to lose."""


@wp.struct
class PropellerBank:
    """All propellers, in canonical order."""

    count: int
    axis: wp.array(dtype=wp.vec3)
    place: wp.array(dtype=wp.vec3)  # body frame [m]
    c_plus: wp.array(dtype=float)  # as built, less the thrust deduction [N s²/rad²]
    c_minus: wp.array(dtype=float)
    own_share: float
    share: wp.array2d(dtype=float)  # part of neighbour j's induced speed that enters propeller k
    stall: float  # J0 D / 2π: inflow at which a shaft speed gives no thrust, per shaft speed [m]
    disc: float  # 2 ρ times the disc's area [kg/m]


@wp.func
def delivered_thrust(propellers: PropellerBank, speed: wp.array(dtype=float), nu_r: vec6) -> vec8:
    """Thrust that reaches the vehicle, T = T_bollard (1 - V / (J0 n D)), by propeller [N].

    The inflow V is a share of the vehicle's own speed along the thrust, v·a sign T, and what the neighbours' jets add:
    their induced speed sqrt(|T| / 2 ρ A), by momentum theory, falling with distance.

    Args:
        propellers: All of them.
        speed: Shaft speeds [rad/s], (n,).
        nu_r: Velocity relative to the water, body frame [m/s, rad/s].
    """
    bollard = vec8()
    for k in range(propellers.count):
        bollard[k] = thrust_of_speed(speed[k], propellers.c_plus[k], propellers.c_minus[k])
    T = vec8()
    for k in range(propellers.count):
        V = float(0.0)
        for j in range(propellers.count):
            V += propellers.share[k, j] * wp.sqrt(wp.abs(bollard[j]) / propellers.disc)
        own = wp.dot(propellers.axis[k], linear(nu_r) + wp.cross(angular(nu_r), propellers.place[k]))
        V += propellers.own_share * wp.sign(bollard[k]) * own
        slowest = wp.static(2.0 * math.pi * SLOWEST)
        loss = V / (propellers.stall * wp.max(wp.abs(speed[k]), slowest))
        T[k] = bollard[k] * (1.0 - wp.clamp(loss, -1.0, 1.0))
    return T


def induced_shares(vehicle: Vehicle, spec: PlantSpec) -> Array:
    """Part of neighbour j's induced speed that enters propeller k, (n, n)."""
    p = spec.propellers
    place = np.array([t.position for t in vehicle.thrusters.values()])
    distance = np.linalg.norm(place[:, None] - place, axis=-1)
    return np.asarray(
        p.induced_share * np.exp(-distance / p.induced_reach) * (1.0 - np.eye(len(vehicle.thrusters)))
    )


def propeller_bank(vehicle: Vehicle, spec: PlantSpec, device: Any = "cpu") -> PropellerBank:
    """The propellers of a vehicle as one plant has them."""
    told = list(vehicle.thrusters.values())
    true = [spec.thrusters[name] for name in vehicle.thruster_names]
    bank = PropellerBank()
    bank.count = len(told)
    bank.axis = wp.array(np.array([t.axis for t in told]), dtype=wp.vec3, device=device)
    bank.place = wp.array(np.array([t.position for t in told]), dtype=wp.vec3, device=device)
    for name, gain in (("c_plus", "gain_plus"), ("c_minus", "gain_minus")):
        c = [
            getattr(a, name) * getattr(b, gain) * (1.0 - b.deduction) for a, b in zip(told, true, strict=True)
        ]
        setattr(bank, name, wp.array(c, dtype=float, device=device))
    bank.own_share = spec.propellers.own_share
    bank.share = wp.array(induced_shares(vehicle, spec), dtype=float, device=device)
    bank.stall = spec.propellers.advance_at_zero_thrust * spec.propellers.diameter / (2.0 * math.pi)
    bank.disc = 2.0 * vehicle.water.density * 0.25 * math.pi * spec.propellers.diameter**2
    return bank
