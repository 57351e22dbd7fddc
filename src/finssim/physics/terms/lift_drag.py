"""Lift and drag of a slender hull, or of a wing, over its angle of attack in the plane of surge and heave."""

# mypy: disable-error-code="index,no-any-return,no-untyped-call,valid-type"

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.physics.types import linear, vec6
from finssim.vehicles.part import NonNegative, Part
from finssim.vehicles.terms import Term


class LiftDrag(Part):
    """Coefficients in a vehicle file under `lift_drag`, each multiplied by half the density and the area: half rho
    S times C."""

    drag: NonNegative
    """Drag coefficient without lift, from C_D0 [N s²/m²]."""
    lift: NonNegative
    """Slope of the lift, from dC_L/d(alpha) [N s²/(m² rad)]."""
    induced: NonNegative = 0.0
    """Increase of the drag, from d C_D/d(alpha²) [N s²/(m² rad²)]."""


@wp.func
def lift_drag_wrench(nu_r: vec6, drag: float, lift: float, induced: float) -> vec6:
    """Return the drag U V (d + k sin² a) and the lift U V l sin a cos a, with the angle of attack a.

    U is the speed, V its component in the plane of surge and heave. Drag acts against the flow, lift across it. For
    small angles sin a is a; the lift vanishes at 90°, and is the same for a hull that moves astern.

    Args:
        nu_r: Velocity of the reference point relative to the water, body frame [m/s, rad/s].
        drag: d [N s²/m²].
        lift: l [N s²/(m² rad)].
        induced: k [N s²/(m² rad²)].

    Returns:
        Wrench about the same point, body frame [N, N m].
    """
    u = nu_r[0]
    w = nu_r[2]
    speed = wp.length(linear(nu_r))
    s2 = w * w / wp.max(u * u + w * w, 1.0e-20)
    c2 = u * u / wp.max(u * u + w * w, 1.0e-20)
    X = -speed * u * (drag + (induced - lift) * s2)
    Z = -speed * w * (drag + induced * s2 + lift * c2)
    return vec6(X, 0.0, Z, 0.0, 0.0, 0.0)


@wp.func
def lift_drag_slope(nu_r: vec6, drag: float, lift: float, induced: float) -> vec6:
    """Return upper bounds of -dX/du and -dZ/dw, which are exact for motion straight ahead.

    Args:
        nu_r: Velocity of the reference point relative to the water, body frame [m/s, rad/s].
        drag: d [N s²/m²].
        lift: l [N s²/(m² rad)].
        induced: k [N s²/(m² rad²)].

    Returns:
        Slope on each axis, body frame [N s/m, N m s/rad].
    """
    u = nu_r[0]
    w = nu_r[2]
    speed = wp.length(linear(nu_r))
    s2 = w * w / wp.max(u * u + w * w, 1.0e-20)
    c2 = u * u / wp.max(u * u + w * w, 1.0e-20)
    X = 2.0 * speed * (drag + induced * s2 + lift * s2 * c2)
    Z = speed * ((1.0 + s2) * (drag + induced * s2 + lift * c2) + 2.0 * induced * s2 * c2)
    return vec6(X, 0.0, Z, 0.0, 0.0, 0.0)


def _quadratic(hull: LiftDrag) -> NDArray[np.float64]:
    return np.array([hull.drag, 0.0, hull.drag + hull.induced, 0.0, 0.0, 0.0])


def _check(hull: LiftDrag) -> tuple[bool, str]:
    # Greatest lift over drag, at alpha² = d / k; expected below that of a sailplane.
    best = hull.lift / max(2.0 * float(np.sqrt(hull.drag * hull.induced)), 1e-9)
    return best < 60.0 or not hull.lift, f"greatest lift over drag: {best:.3g}, expected below 60"


LIFT_DRAG = Term(
    name="lift_drag",
    schema=LiftDrag,
    units={"drag": "N s²/m²", "lift": "N s²/(m² rad)", "induced": "N s²/(m² rad²)"},
    wrench=lift_drag_wrench,
    slope=lift_drag_slope,
    quadratic=_quadratic,
    check=_check,
)
