"""Loss of thrust and torque of a propeller by inflow."""

# mypy: disable-error-code="arg-type,no-any-return,operator,valid-type"

from typing import Any

import warp as wp

from finssim.physics.types import angular, join, linear, vec6
from finssim.vehicles.actuators import Actuator, ActuatorKind


@wp.func
def inflow_wrench(
    value: float,
    nu_r: vec6,
    position: wp.vec3,
    axis: wp.vec3,
    c_plus: float,
    c_minus: float,
    thrust_loss: float,
    torque_loss: float,
    wake_fraction: float,
) -> vec6:
    """Return the difference between the wrench of a propeller in a flow and its static thrust c± ω|ω|.

    T = c ω|ω| - a |ω| V_a,  Q = k ω|ω| - b |ω| V_a,  V_a = (1 - w) a·(v + ω × r)     (Fossen 2021, eq. 9.8-9.13)

    Args:
        value: Static thrust c± ω|ω| [N].
        nu_r: Velocity of the body origin relative to the water, body frame [m/s, rad/s].
        position: Position of the disc, body frame [m].
        axis: Direction of positive thrust, body frame [-].
        c_plus: [N s²/rad²].
        c_minus: [N s²/rad²].
        thrust_loss: a [N s²/(m rad)].
        torque_loss: b [N s²/rad]; the torque on the water acts about `axis`, that on the vehicle is the opposite.
        wake_fraction: w [-].

    Returns:
        Wrench about the body origin, body frame [N, N m].
    """
    c = wp.max(wp.where(value >= 0.0, c_plus, c_minus), 1.0e-20)
    omega = wp.sqrt(wp.abs(value) / c)
    ahead = (1.0 - wake_fraction) * wp.dot(axis, linear(nu_r) + wp.cross(angular(nu_r), position))
    force = (-thrust_loss * omega * ahead) * axis
    return join(force, wp.cross(position, force) + (torque_loss * omega * ahead) * axis)


def _numbers(thruster: Any, vehicle: Any) -> dict[str, Any]:
    inflow = thruster.inflow
    return {
        "thrust_loss": inflow.thrust_loss,
        "torque_loss": inflow.torque_loss,
        "wake_fraction": inflow.wake_fraction,
    }


PROPELLER = ActuatorKind(
    name="propeller",
    schema=Actuator,
    unit="N",
    units={
        "position": "m",
        "axis": "1",
        "c_plus": "N s²/rad²",
        "c_minus": "N s²/rad²",
        "thrust_loss": "N s²/(m rad)",
        "torque_loss": "N s²/rad",
        "wake_fraction": "1",
    },
    wrench=inflow_wrench,
    further=("thrust_loss", "torque_loss"),
    numbers=_numbers,
)
