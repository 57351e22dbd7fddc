"""Weight and buoyancy with separate centres, and a smooth free surface."""

# mypy: disable-error-code="arg-type"

import warp as wp

from finssim.physics.types import join, vec6


@wp.struct
class WaterWrench:
    """Result of a hydrodynamic model: its wrench, and the submerged part of the vehicle."""

    tau: vec6  # about the body origin, body frame [N, N m]
    displaced: float  # mass of water [kg]
    wet: float  # part of the displaced volume that is under water
    wet_rate: float  # its rate [1/s]


@wp.struct
class BodyMotion:
    """Pose and motion of a vehicle: the input of a hydrodynamic model."""

    position: wp.vec3  # body origin, world frame [m]
    q: wp.quat  # attitude, body to world
    up: wp.vec3  # world z axis in the body frame, unit
    nu: vec6  # twist, body frame [m/s, rad/s]
    nu_r: vec6  # the same relative to the water [m/s, rad/s]


@wp.func
def submerged_fraction(height: float, half_height: float) -> float:
    """Return the submerged fraction of the displaced volume.

    It is a cubic step from 1 (centre of buoyancy deeper than half_height) to 0 (higher than half_height). The step and
    its derivative are continuous and depend on height alone, so buoyancy is conservative.

    Args:
        height: Height of the centre of buoyancy above the local water surface [m].
        half_height: Half the height over which the vehicle emerges [m], positive.

    Returns:
        Fraction in [0, 1].
    """
    s = wp.clamp(0.5 - 0.5 * height / half_height, 0.0, 1.0)
    return s * s * (3.0 - 2.0 * s)


@wp.func
def submersion_rate(height: float, half_height: float, climb: float) -> float:
    """Return the rate of `submerged_fraction` [1/s] while the height grows at `climb` [m/s]."""
    s = wp.clamp(0.5 - 0.5 * height / half_height, 0.0, 1.0)
    return -3.0 * s * (1.0 - s) * climb / half_height


@wp.func
def hydrostatic_wrench(weight: float, buoyancy: float, r_g: wp.vec3, r_b: wp.vec3, up: wp.vec3) -> vec6:
    """Return the wrench of weight and buoyancy about the body origin.

    tau_H = [(B - W) k ;  (B r_b - W r_g) × k]                          (Fossen 2021, eq. 4.5, z up)

    Args:
        weight: m g [N].
        buoyancy: ρ g V of the submerged volume [N].
        r_g: Centre of gravity, body frame [m].
        r_b: Centre of buoyancy, body frame [m].
        up: World z axis in the body frame, unit length.

    Returns:
        Wrench, body frame [N, N m].
    """
    return join((buoyancy - weight) * up, wp.cross(buoyancy * r_b - weight * r_g, up))
