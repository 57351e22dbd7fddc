"""Damping that grows with the surge speed, -Du |u_r| nu_r: lift of body and fins, drag of a hull with forward
speed."""

# mypy: disable-error-code="index,no-any-return,no-untyped-call,valid-type"

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from finssim.physics.types import linear, mat66, vec6
from finssim.vehicles.part import Matrix6, zeros
from finssim.vehicles.terms import Term


@wp.func
def surge_coupled_wrench(nu_r: vec6, surge_damping: mat66) -> vec6:
    """Return the damping wrench tau = -Du |u_r| nu_r                                       (paper, eq. 2)

    Args:
        nu_r: Velocity of the reference point relative to the water, body frame [m/s, rad/s].
        surge_damping: Du; the units of its diagonal are [N s²/m², N s²/rad].

    Returns:
        Wrench about the same point, body frame [N, N m].
    """
    return -wp.abs(nu_r[0]) * (surge_damping * nu_r)


@wp.func
def surge_coupled_slope(nu_r: vec6, surge_damping: mat66) -> vec6:
    """Return the diagonal of Du times the sum of the linear speeds, which is never less than |u_r|; doubled in surge.

    Args:
        nu_r: Velocity of the reference point relative to the water, body frame [m/s, rad/s].
        surge_damping: Du; the units of its diagonal are [N s²/m², N s²/rad].

    Returns:
        Slope of the damping on each axis, body frame [N s/m, N m s/rad].
    """
    d = wp.get_diag(surge_damping)
    d[0] = 2.0 * d[0]
    speeds = wp.abs(linear(nu_r))
    return (speeds[0] + speeds[1] + speeds[2]) * d


def _quadratic(Du: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.array([Du[0, 0], 0.0, 0.0, 0.0, 0.0, 0.0])


def _check(Du: Any) -> tuple[bool, str]:
    smallest = float(np.linalg.eigvalsh((Du + Du.T) / 2.0)[0])
    sentence = f"smallest eigenvalue of the symmetric part of Du: {smallest:.3g}, expected >= 0"
    return smallest >= -1e-9 * float(np.abs(Du).max()), sentence


SURGE_DAMPING = Term(
    name="surge_damping",
    schema=Matrix6,
    units={"surge_damping": "N s²/m², N s²/rad"},
    wrench=surge_coupled_wrench,
    slope=surge_coupled_slope,
    absent=zeros(6, 6),
    quadratic=_quadratic,
    check=_check,
)
