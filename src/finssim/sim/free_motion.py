"""Stability of a vehicle without control: its model, linearised about level motion at constant speed."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from finssim.sim.model import acceleration
from finssim.vehicles import HydrodynamicSet, Vehicle
from finssim.vehicles.capability import terminal_speeds

__all__ = ["MOTIONS", "FreeMotion", "stability"]

Array = NDArray[np.float64]

MOTIONS = {"surge": (0,), "course": (1, 5), "roll": (3, 6), "pitch": (2, 4, 7)}
"""Motion -> its states: surge; sway and yaw rate; roll rate and angle; heave, pitch rate and angle."""
STEP, DEPTH, USUAL = 1e-3, -100.0, 2.0
"""Step of the differences [m/s, rad/s, rad], depth [m], and top speed of a vehicle that has none [m/s]."""
SLOW = 5e-3
"""Rate below which a motion neither grows nor dies out [1/s]; differences over a step of v|v| are smaller."""


class FreeMotion(NamedTuple):
    """One motion without control: the eigenvalue with the greatest real part at rest and at top speed [1/s]."""

    at_rest: complex
    at_top_speed: complex
    unstable_above: float | None
    """Least speed at which it grows [m/s]; None if none up to top speed."""

    @staticmethod
    def words(rate: complex) -> str:
        """Return what an eigenvalue [1/s] does, in words."""
        swing = f", period {2.0 * math.pi / abs(rate.imag):.3g} s" if abs(rate.imag) > SLOW else ""
        if abs(rate.real) <= SLOW:
            return f"neutral{swing}"
        change = "dies out" if rate.real < 0.0 else "grows e-fold"
        return f"{change} in {1.0 / abs(rate.real):.3g} s{swing}"


def _system_matrices(vehicle: Vehicle, speeds: Array, hydrodynamics: str) -> Array:
    """Return A of x_dot = A x about level motion, for the state (nu, roll, pitch), in SI units, (n, 8, 8).

    The wrench that holds the motion, from thrusters and fins, stays constant.

    Args:
        vehicle: The vehicle.
        speeds: Surge [m/s], (n,).
        hydrodynamics: Its set.
    """
    eta, nu = np.zeros((len(speeds), 6)), np.zeros((len(speeds), 6))
    eta[:, 2], nu[:, 0] = DEPTH, speeds
    hold = -acceleration(vehicle, eta, nu, hydrodynamics=hydrodynamics) @ vehicle.mass_matrix(hydrodynamics).T
    A = np.zeros((len(speeds), 8, 8))
    for k in range(8):
        state = np.concatenate([nu, eta[:, 3:5]], axis=1)
        ends = []
        for sign in (1.0, -1.0):
            moved = state.copy()
            moved[:, k] += sign * STEP
            place = np.concatenate([eta[:, :3], moved[:, 6:], eta[:, 5:]], axis=1)
            ends.append(acceleration(vehicle, place, moved[:, :6], hold, hydrodynamics=hydrodynamics))
        A[:, :6, k] = (ends[0] - ends[1]) / (2.0 * STEP)
    A[:, 6, 3] = A[:, 7, 4] = 1.0
    return A


def stability(vehicle: Vehicle, hydrodynamics: str = "calibrated") -> tuple[float, dict[str, FreeMotion]]:
    """Return top speed [m/s] and what each motion of `MOTIONS` does without control up to it.

    An eigenvalue belongs to the motion whose states take the greatest part in it.

    Args:
        vehicle: The vehicle.
        hydrodynamics: Its set.
    """
    top = USUAL
    if isinstance(vehicle.hydrodynamics[hydrodynamics], HydrodynamicSet):
        reached = float(terminal_speeds(vehicle, hydrodynamics)[0])
        top = reached if 0.0 < reached < math.inf else USUAL
    speeds = np.linspace(0.0, top, 101)
    values, vectors = np.linalg.eig(_system_matrices(vehicle, speeds, hydrodynamics))
    part = np.abs(
        vectors * np.swapaxes(np.linalg.pinv(vectors), 1, 2)
    )  # of states in eigenvalues, without units
    share = np.stack([part[:, states].sum(axis=1) for states in MOTIONS.values()])
    motions = {}
    for k, name in enumerate(MOTIONS):
        own = np.where(share.argmax(axis=0) == k, values.real, -math.inf)
        first = np.take_along_axis(values, own.argmax(axis=1)[:, None], axis=1)[:, 0]
        growing = np.flatnonzero((first.real > SLOW) & np.isfinite(own.max(axis=1)))
        above = float(speeds[growing[0]]) if len(growing) else None
        motions[name] = FreeMotion(complex(first[0]), complex(first[-1]), above)
    return top, motions
