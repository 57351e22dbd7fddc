"""Part of the added mass's coupling, mainly the Munk moment, that the wake of a hull cancels.

In ideal flow the added mass turns a slender hull across its path. Behind a real hull the flow separates, and models
such as Fossen's for torpedo-shaped vehicles omit those products of velocities.
"""

# mypy: disable-error-code="index,no-any-return,no-untyped-call,valid-type"

from typing import Any

import warp as wp

from finssim.physics.types import vec6
from finssim.vehicles.part import Vector3, zeros
from finssim.vehicles.terms import Term


@wp.func
def munk_relief_wrench(nu_r: vec6, munk_relief: wp.vec3) -> vec6:
    """Return C_A(nu_r) nu_r of an added mass A in surge, sway and heave, without the products with roll.

    X = A_3 w q - A_2 v r,  Y = A_1 u r,  Z = -A_1 u q,  M = (A_1 - A_3) u w,  N = (A_2 - A_1) u v

    It is the opposite of these parts of the wrench of the added mass, and dissipates no energy.

    Args:
        nu_r: Velocity of the reference point relative to the water, body frame [m/s, rad/s].
        munk_relief: A [kg].

    Returns:
        Wrench about the same point, body frame [N, N m].
    """
    a = wp.cw_mul(munk_relief, wp.vec3(nu_r[0], nu_r[1], nu_r[2]))
    q = nu_r[4]
    r = nu_r[5]
    return vec6(
        a[2] * q - a[1] * r,
        a[0] * r,
        -a[0] * q,
        0.0,
        a[0] * nu_r[2] - a[2] * nu_r[0],
        a[1] * nu_r[0] - a[0] * nu_r[1],
    )


def _check(A: Any) -> tuple[bool, str]:
    return bool((A >= 0.0).all()), f"smallest mass: {A.min():.3g} kg, expected >= 0"


MUNK_RELIEF = Term(
    name="munk_relief",
    schema=Vector3,
    units={"munk_relief": "kg"},
    wrench=munk_relief_wrench,
    absent=zeros(3),
    check=_check,
)
