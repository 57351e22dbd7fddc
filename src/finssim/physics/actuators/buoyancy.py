"""Buoyancy engine: a volume of water that is displaced or taken in at one point."""

# mypy: disable-error-code="arg-type,no-any-return,valid-type"

from typing import Any

import warp as wp

from finssim.physics.types import join, vec6
from finssim.vehicles.actuators import Actuator, ActuatorKind
from finssim.vehicles.part import Vector3


class BuoyancyEngine(Actuator):
    """Section of a buoyancy engine, piston or ballast tank; its value is the volume in addition to the body's [m³]."""

    position: Vector3
    """Centre of the volume, from the body origin, body frame [m], (3,)."""


@wp.func
def volume_wrench(value: float, up: wp.vec3, density: float, position: wp.vec3, gravity: float) -> vec6:
    """Return the buoyancy [ρ g V k; r × ρ g V k] of a volume                                (Archimedes)

    Args:
        value: Volume V [m³].
        up: World's z axis k in the body frame [-].
        density: Density of the water [kg/m³].
        position: r, body frame [m].
        gravity: [m/s²].

    Returns:
        Wrench about the body origin, body frame [N, N m].
    """
    force = (density * gravity * value) * up
    return join(force, wp.cross(position, force))


def _numbers(engine: Any, vehicle: Any) -> dict[str, Any]:
    return {"gravity": vehicle.water.gravity}


BUOYANCY = ActuatorKind(
    name="buoyancy",
    schema=BuoyancyEngine,
    unit="m³",
    units={"position": "m", "gravity": "m/s²"},
    wrench=volume_wrench,
    numbers=_numbers,
)
