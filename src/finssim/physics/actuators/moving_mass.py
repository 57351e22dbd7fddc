"""Mass that moves along an axis within the vehicle, such as batteries on a spindle."""

# mypy: disable-error-code="arg-type,call-overload,index,no-any-return,no-untyped-call,valid-type"

import warp as wp

from finssim.physics.types import join, vec6, vec9
from finssim.vehicles.actuators import Actuator, ActuatorKind
from finssim.vehicles.part import Axis, Positive, Vector3


class MovingMass(Actuator):
    """Section of a moving mass; its value is the displacement from `position` along `axis` [m].

    `body` includes the mass, at `position`. A displacement Δδ of the mass moves the body by the recoil -M⁻¹ m Δδ [a; p
    × a], where M includes the added mass; the reported velocity of the body is that without the mass's own motion.
    """

    mass: Positive
    """[kg]"""
    position: Vector3
    """Position at value 0, from the body origin, body frame [m], (3,)."""
    axis: Axis
    """Direction of the displacement, body frame, unit length, (3,)."""


@wp.func
def moved_mass(value: float, mass: float, position: wp.vec3, axis: wp.vec3) -> vec9:
    """Return the change of the first moment, m δ, and of the inertia, m [(r·r) 1 - r rᵀ] from r = p to r = p + δ.

    Args:
        value: Displacement δ along the axis [m].
        mass: m [kg].
        position: p, body frame [m].
        axis: Direction of δ, body frame [-].

    Returns:
        First moment [kg m], 3 numbers, and inertia about the body origin [kg m²]: xx, yy, zz, xy, xz, yz.
    """
    r = position + value * axis
    m = mass * (wp.cw_mul(r, r) - wp.cw_mul(position, position))
    return vec9(
        mass * value * axis[0],
        mass * value * axis[1],
        mass * value * axis[2],
        m[1] + m[2],
        m[0] + m[2],
        m[0] + m[1],
        mass * (position[0] * position[1] - r[0] * r[1]),
        mass * (position[0] * position[2] - r[0] * r[2]),
        mass * (position[1] * position[2] - r[1] * r[2]),
    )


@wp.func
def carried_mass(value: float, mass: float, position: wp.vec3, axis: wp.vec3) -> vec6:
    """Return m δ [a; p × a]: its rate is the momentum of the mass relative to the body.

    Args:
        value: Displacement δ along the axis [m].
        mass: m [kg].
        position: p, body frame [m].
        axis: a, body frame [-].

    Returns:
        Linear and angular part about the body origin [kg m, kg m²].
    """
    moved = mass * value * axis
    return join(moved, wp.cross(position, moved))


MOVING_MASS = ActuatorKind(
    name="moving_mass",
    schema=MovingMass,
    unit="m",
    units={"mass": "kg", "position": "m", "axis": "1"},
    shift=moved_mass,
    carry=carried_mass,
)
