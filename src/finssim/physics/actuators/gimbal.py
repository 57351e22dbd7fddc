"""Gimbal that rotates the thrust of one thruster about an axis: vectored thrust."""

# mypy: disable-error-code="arg-type,no-any-return,no-untyped-call,operator,valid-type"

from typing import Any

import numpy as np
import warp as wp

from finssim.physics.types import MAX_THRUSTERS, join, vec6, vec8
from finssim.vehicles.actuators import Actuator, ActuatorKind
from finssim.vehicles.part import Axis, Number


class Gimbal(Actuator):
    """Section of a gimbal; its value is the angle [rad] about `axis` by the right-hand rule."""

    off: Number | None = 0.0
    """Angle while the vehicle is disarmed or in a fault [rad]; None leaves it unchanged."""
    thruster: str
    """Name of the thruster that the gimbal rotates, about the centre of its disc."""
    axis: Axis
    """Axis of the rotation, body frame, unit length, (3,)."""


@wp.func
def turned_wrench(
    value: float, thrust: vec8, axis: wp.vec3, turned: vec8, arm: wp.vec3, direction: wp.vec3, reaction: float
) -> vec6:
    """Return the difference between the thrust T along R(δ) a and along a: T [Ra - a; r × (Ra - a) + q (Ra - a)].

    R is the rotation about `axis` by δ (Rodrigues). The effect of inflow on a propeller is not rotated.

    Args:
        value: Angle δ [rad].
        thrust: Thrust of each thruster [N].
        axis: Axis of the rotation, body frame [-].
        turned: 1 for the rotated thruster, 0 for the others [-].
        arm: Position r of its disc, body frame [m].
        direction: Its axis a at angle 0, body frame [-].
        reaction: q, ratio of the moment about its axis to its thrust [m].

    Returns:
        Wrench about the body origin, body frame [N, N m].
    """
    T = wp.dot(turned, thrust)
    change = wp.sin(value) * wp.cross(axis, direction) + (1.0 - wp.cos(value)) * (
        wp.dot(axis, direction) * axis - direction
    )
    force = T * change
    return join(force, wp.cross(arm, force) + reaction * force)


def _numbers(gimbal: Any, vehicle: Any) -> dict[str, Any]:
    thruster = vehicle.thrusters[gimbal.thruster]
    turned = np.zeros(MAX_THRUSTERS)
    turned[vehicle.thruster_names.index(gimbal.thruster)] = 1.0
    return {
        "turned": turned,
        "arm": thruster.position,
        "direction": thruster.axis,
        "reaction": thruster.reaction,
    }


GIMBAL = ActuatorKind(
    name="gimbal",
    schema=Gimbal,
    unit="rad",
    units={"axis": "1", "turned": "1", "arm": "m", "direction": "1", "reaction": "m"},
    wrench=turned_wrench,
    numbers=_numbers,
)
