"""Cross-flow drag of a slender hull: the sum of the drag of its transverse strips (strip theory)."""

# mypy: disable-error-code="index,no-any-return,no-untyped-call,valid-type"

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.physics.types import vec6
from finssim.vehicles.part import NonNegative, Number, Part
from finssim.vehicles.terms import Term


class CrossFlow(Part):
    """Hull as a row of equal strips, in a vehicle file under `cross_flow_drag`."""

    length: NonNegative
    """Length of the hull [m]."""
    center: Number = 0.0
    """Middle of the hull, forward of the reference point of the set [m]."""
    sway: NonNegative
    """Half density times height of the hull times drag coefficient of flow from the side [N s²/m³]."""
    heave: NonNegative = 0.0
    """Half density times width of the hull times drag coefficient of flow from above or below [N s²/m³]."""


@wp.func
def strips(first: float, last: float, length: float) -> wp.vec3:
    """Return the integrals over the length L of s|s|, of x s|s| about the middle, and the sum of |s| at both ends.

    s is the speed across the hull, linear in x, with the values a at the stern and b at the bow. With S = |a| + |b| the
    integrals are, exactly,

        L/3 (a + b) S (1 - |a b|/S²)  and  L²/12 (b - a) S (1 - 2 q - 2 q²),  q = (|a b| - a b) / (2 S²)

    Args:
        first: Speed at the stern [m/s].
        last: Speed at the bow [m/s].
        length: L [m].

    Returns:
        Both integrals and S [m³/s², m⁴/s², m/s].
    """
    total = wp.abs(first) + wp.abs(last)
    square = wp.max(total * total, 1.0e-20)
    product = first * last
    p = wp.abs(product) / square
    q = 0.5 * (p - product / square)
    force = length / 3.0 * (first + last) * total * (1.0 - p)
    moment = length * length / 12.0 * (last - first) * total * (1.0 - 2.0 * q - 2.0 * q * q)
    return wp.vec3(force, moment, total)


@wp.func
def cross_flow_wrench(nu_r: vec6, length: float, center: float, sway: float, heave: float) -> vec6:
    """Return the integrals of dY = -c_y |s| s dx, s = v + x r, and dZ = -c_z |s| s dx, s = w - x q, over the hull's
    length.

    Args:
        nu_r: Velocity of the reference point relative to the water, body frame [m/s, rad/s].
        length: Length of the hull [m].
        center: Middle of the hull [m].
        sway: c_y [N s²/m³].
        heave: c_z [N s²/m³].

    Returns:
        Wrench about the reference point, body frame [N, N m].
    """
    half = 0.5 * length
    v = nu_r[1] + center * nu_r[5]
    w = nu_r[2] - center * nu_r[4]
    side = strips(v - half * nu_r[5], v + half * nu_r[5], length)
    up = strips(w + half * nu_r[4], w - half * nu_r[4], length)
    Y = -sway * side[0]
    Z = -heave * up[0]
    return vec6(0.0, Y, Z, 0.0, heave * up[1] - center * Z, center * Y - sway * side[1])


@wp.func
def cross_flow_slope(nu_r: vec6, length: float, center: float, sway: float, heave: float) -> vec6:
    """Return c L S and c L S (L/2 + |center|)², upper bounds of the slopes 2 c ∫|s| dx and 2 c ∫|s| x² dx.

    S is the sum of |s| at both ends; |s| lies below the line between its values at the ends.

    Args:
        nu_r: Velocity of the reference point relative to the water, body frame [m/s, rad/s].
        length: L, length of the hull [m].
        center: Middle of the hull [m].
        sway: c of sway and yaw [N s²/m³].
        heave: c of heave and pitch [N s²/m³].

    Returns:
        Slope of the drag on each axis, body frame [N s/m, N m s/rad].
    """
    half = 0.5 * length
    v = nu_r[1] + center * nu_r[5]
    w = nu_r[2] - center * nu_r[4]
    Y = sway * length * strips(v - half * nu_r[5], v + half * nu_r[5], length)[2]
    Z = heave * length * strips(w + half * nu_r[4], w - half * nu_r[4], length)[2]
    arm = wp.abs(center) + half
    return vec6(0.0, Y, Z, 0.0, Z * arm * arm, Y * arm * arm)


def _quadratic(hull: CrossFlow) -> NDArray[np.float64]:
    ends = hull.center + hull.length * np.array([-0.5, 0.5])
    turning = float(np.diff(ends * np.abs(ends) ** 3)[0]) / 4.0
    across = np.array([0.0, hull.sway, hull.heave, 0.0, hull.heave, hull.sway])
    return across * [0.0, hull.length, hull.length, 0.0, turning, turning]


def _check(hull: CrossFlow) -> tuple[bool, str]:
    inside = abs(hull.center) <= hull.length / 2.0
    return inside, (
        f"a hull of {hull.length:g} m with its middle {hull.center:g} m ahead, expected the reference point within it"
    )


CROSS_FLOW_DRAG = Term(
    name="cross_flow_drag",
    schema=CrossFlow,
    units={"length": "m", "center": "m", "sway": "N s²/m³", "heave": "N s²/m³"},
    wrench=cross_flow_wrench,
    slope=cross_flow_slope,
    quadratic=_quadratic,
    check=_check,
)
