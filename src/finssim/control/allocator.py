"""Wrench allocation from NumPy: the code of the training kernels, called on the robot with one wrench at a time."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from finssim.control.allocation import allocate_kernel, allocation_data, residual_kernel
from finssim.control.allocation_tables import REGULARISATION
from finssim.control.errors import ControlError
from finssim.physics.types import vec6, vec8

__all__ = ["Allocator", "axis_weights"]

Array = npt.NDArray[np.float64]


class Allocator:
    """Thrusts nearest to wanted wrenches within the limits of one vehicle's thrusters (paper, eq. 18).

    Note:
        Runs on the CPU and reuses its launch buffers, so one instance belongs to one thread.
    """

    def __init__(
        self,
        B: npt.ArrayLike,
        lower: npt.ArrayLike,
        upper: npt.ArrayLike,
        weights: npt.ArrayLike,
        regularisation: float = REGULARISATION,
    ) -> None:
        """Precomputes the tables of one vehicle; arguments as one entry of `allocation_data`.

        Raises:
            ControlError: Wrong shapes, limits that exclude zero, or numbers that make the problem singular.
        """
        self.data = allocation_data([B], [lower], [upper], [weights], regularisation)
        self.B: Array = np.array(B, float)
        self.lower: Array = np.array(lower, float)
        self.upper: Array = np.array(upper, float)
        self.weights: Array = np.array(weights, float)
        self._launch = _Launch(1, self.data)

    @classmethod
    def from_vehicle(cls, vehicle: Any, regularisation: float = REGULARISATION) -> Allocator:
        """Allocator about `vehicle.wrench_reference`, weighing each axis by its wrench limit."""
        lower, upper = vehicle.force_limits
        return cls(vehicle.control_matrix, lower, upper, axis_weights(vehicle.wrench_limits), regularisation)

    @property
    def thrusters(self) -> int:
        """Number of thrusters n."""
        return int(self.B.shape[1])

    def allocate(self, tau: npt.ArrayLike) -> tuple[Array, Array]:
        """Thrusts for wanted wrenches.

        Args:
            tau: Wrenches about the point of B, body frame [N, N m], (..., 6).

        Returns:
            Thrusts [N], (..., n), never outside the limits; and how far each is from the optimum [N], (...), which is
            rounding (about 1e-6 of the thrusts an unlimited vehicle would need).

        Raises:
            ControlError: The last axis is not 6 long, or a number is not finite.
        """
        wanted = np.asarray(tau, float)
        if wanted.shape[-1:] != (6,):
            raise ControlError(f"wrench has shape {wanted.shape}, expected (..., 6)")
        if not np.isfinite(wanted).all():
            raise ControlError("wrench is not finite: find where the NaN or infinity came from")
        worlds = wanted.size // 6
        if worlds == 0:
            return np.zeros((*wanted.shape[:-1], self.thrusters)), np.zeros(wanted.shape[:-1])
        if worlds != self._launch.worlds:
            self._launch = _Launch(worlds, self.data)
        f, residual = self._launch.run(wanted.reshape(worlds, 6))
        return f[:, : self.thrusters].reshape(*wanted.shape[:-1], -1), residual.reshape(wanted.shape[:-1])

    def achieved(self, f: npt.ArrayLike) -> Array:
        """Wrench B f that thrusts produce, about the point of B, body frame [N, N m], (..., n) -> (..., 6)."""
        return np.asarray(f, float) @ self.B.T


class _Launch:
    """Recorded launches for one batch size: a call writes the wrenches, launches, and reads the thrusts."""

    def __init__(self, worlds: int, data: Any) -> None:
        tau = wp.zeros(worlds, dtype=vec6, device="cpu")
        f = wp.zeros(worlds, dtype=vec8, device="cpu")
        vehicle = wp.zeros(worlds, dtype=wp.int32, device="cpu")
        residual = wp.zeros(worlds, dtype=wp.float32, device="cpu")
        self.worlds = worlds
        self._commands = [
            wp.launch(allocate_kernel, worlds, [tau, vehicle, data, f], device="cpu", record_cmd=True),
            wp.launch(
                residual_kernel, worlds, [f, tau, vehicle, data, residual], device="cpu", record_cmd=True
            ),
        ]
        self._arrays = (tau, f, residual, vehicle)
        views: list[npt.NDArray[np.float32]] = [np.asarray(array) for array in self._arrays[:3]]
        self._tau, self._f, self._residual = views

    def run(self, tau: Array) -> tuple[Array, Array]:
        """Thrusts (worlds, 8) and residuals (worlds,) for wrenches (worlds, 6)."""
        self._tau[:] = tau
        for command in self._commands:
            command.launch()
        return self._f.astype(float), self._residual.astype(float)


def axis_weights(wrench_limits: npt.ArrayLike) -> Array:
    """Diagonal of W [1/N, 1/(N m)], (6,): one over each wrench limit, and zero on an axis with no authority.

    Args:
        wrench_limits: Largest wrench on each axis alone, body axes [N, N m], (6,).
    """
    limits = np.asarray(wrench_limits, float)
    weights: Array = np.divide(1.0, limits, out=np.zeros_like(limits), where=limits > 0.0)
    return weights
