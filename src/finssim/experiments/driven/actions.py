"""What was commanded, as an action: the inverse of an action mode."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from finssim.control.modes import AXES, Thruster8, Wrench6
from finssim.experiments.driven.drive import DriveError
from finssim.vehicles import Vehicle

__all__ = ["actions_of"]

Array = NDArray[np.float64]

NEAR = 0.05
"""A wrench counts as said by an action if it is off by less, per axis, in parts of the wrench limits."""
FEW = 0.05
"""Part of the decisions that may be off by more: those at the limits of the thrusters."""


def actions_of(force: ArrayLike, mode: Thruster8 | Wrench6, vehicle: Vehicle) -> NDArray[np.float32]:
    """Actions that ask for what was commanded, in [-1, 1], (N, size).

    Args:
        force: Commanded thrusts, canonical order [N], (N, n).
        mode: Action mode of that vehicle.
        vehicle: Its control matrix makes a wrench of thrusts.

    Raises:
        DriveError: More than a few of the commands are none that the mode can ask for.
    """
    f = np.asarray(force, float)
    if isinstance(mode, Thruster8):
        full = np.where(f >= 0.0, np.asarray(mode.upper), -np.asarray(mode.lower)) * np.asarray(mode.scale)
        wanted = f
    else:
        full = (np.asarray(mode.limits) * np.asarray(mode.scale))[list(mode.axes)]
        wanted = (f @ vehicle.control_matrix.T)[:, list(mode.axes)]
    action = np.divide(
        wanted, full, out=np.zeros_like(wanted), where=np.broadcast_to(full, wanted.shape) > 0.0
    )
    action = np.clip(action, -1.0, 1.0)
    _check(action, f, mode, vehicle)
    return action.astype(np.float32)


def _check(action: Array, force: Array, mode: Thruster8 | Wrench6, vehicle: Vehicle) -> None:
    """Compare the wrench that the actions would give with the one that was commanded."""
    limits = np.asarray(vehicle.wrench_limits, float)
    off = np.abs((mode.to_thrusters(action) - force) @ vehicle.control_matrix.T)
    off = np.divide(off, limits, out=np.zeros_like(off), where=limits > 0.0)
    wrong = float(np.mean(off.max(axis=1) > NEAR))
    if wrong > FEW:
        worst = int(np.argmax(off.max(axis=0)))
        raise DriveError(
            f"{mode.name} cannot ask for what was commanded in {100.0 * wrong:.0f} % of the decisions ({AXES[worst]} "
            f"is off by up to {off[:, worst].max():.2f} of its limit): give another --action"
        )
