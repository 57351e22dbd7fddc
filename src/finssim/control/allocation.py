"""Wrench allocation: the thrusts closest to a requested wrench within the thrusters' limits, solved exactly.

    min_f ||W (B f - tau)||^2 + lambda ||f||^2   with   f- <= f <= f+                  (paper, eq. 18)

With H = B' W^2 B + lambda I and the unconstrained optimum f0 = H^-1 B' W^2 tau, the problem is min (f - f0)'
H (f - f0) within the limits. Once the set C of thrusters at a limit is known, displaced to it by d = f_C -
f0_C, all other quantities are linear in d:

    thrust of the others   f_F = f0_F - H_FF^-1 H_FC d
    multipliers at limits  mu  = (H_CC - H_CF H_FF^-1 H_FC) d

For eight thrusters there are 256 such sets, and one 8x8 table per set (`tables`) contains both maps. The
correct set is found by principal pivoting: change all thrusters that violate their optimality condition
together (Judice and Pires, 1994), and one at a time (Murty's rule, which cannot cycle) when that no longer
makes progress. The entries of the tables are of order one for any lambda, so that float32 suffices.
"""
# mypy: disable-error-code="no-untyped-def,no-untyped-call,no-any-return,valid-type,misc,untyped-decorator"

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import warp as wp

from finssim.control import ControlError
from finssim.core.quiet import start_warp
from finssim.physics.types import MAX_THRUSTERS, vec6, vec8

# The lookup tables of the allocation, computed once per vehicle in float64.


Array = npt.NDArray[np.float64]

REGULARISATION = 1e-4
"""Default lambda, relative to the mean non-zero eigenvalue of B' W^2 B: feasible wrenches are met to 1e-4."""


def regularisation_weight(
    B: npt.ArrayLike, weights: npt.ArrayLike, regularisation: float = REGULARISATION
) -> float:
    """Return lambda [1/N^2] of the objective: `regularisation` times the mean non-zero eigenvalue of B' W^2 B."""
    WB = np.asarray(weights, float)[:, None] * np.asarray(B, float)
    return regularisation * float(np.sum(WB**2)) / float(np.linalg.matrix_rank(WB))


class Tables(NamedTuple):
    """Fields of `allocation.AllocationData` for one vehicle type, padded with missing thrusters (no gain, no
    thrust)."""

    gain: npt.NDArray[np.float32]
    """Columns of H^-1 B' W^2 [N per N or N m], (6, 8)."""

    clamped: npt.NDArray[np.float32]
    """Columns of the map d -> (f_F - f0_F, mu) for each set of thrusters at a limit, (256, 8, 8) [-]."""

    lower: npt.NDArray[np.float32]
    """Least thrust [N], (8,)."""

    upper: npt.NDArray[np.float32]
    """Greatest thrust [N], (8,)."""


def tables(
    B: npt.ArrayLike,
    lower: npt.ArrayLike,
    upper: npt.ArrayLike,
    weights: npt.ArrayLike,
    regularisation: float = REGULARISATION,
) -> Tables:
    """Return the tables of one vehicle type; arguments as one entry of `allocation.allocation_data`.

    Raises:
        ControlError: Shapes are wrong, limits exclude zero, or the problem is singular.
    """
    B, W = np.asarray(B, float), np.asarray(weights, float)
    low, high = np.asarray(lower, float), np.asarray(upper, float)
    n = B.shape[-1]
    if B.shape != (6, n) or n > MAX_THRUSTERS or low.shape != (n,) or high.shape != (n,) or W.shape != (6,):
        raise ControlError(
            f"allocation got B {B.shape}, limits {low.shape} and {high.shape}, weights {W.shape}: "
            f"expected (6, n), (n,), (n,), (6,) with n <= {MAX_THRUSTERS}"
        )
    if not (np.isfinite([*B.ravel(), *low, *high, *W]).all() and (low <= 0.0).all() and (high >= 0.0).all()):
        raise ControlError("allocation needs finite numbers and limits with lower <= 0 <= upper")
    if not ((W >= 0.0).all() and np.any(W[:, None] * B) and 1e-8 <= regularisation <= 1.0):
        raise ControlError(
            "allocation needs weights >= 0, one of them on an axis with thrust, and regularisation in 1e-8 to 1"
        )

    WB = W[:, None] * B
    H = WB.T @ WB + regularisation_weight(B, W, regularisation) * np.eye(n)
    h = np.trace(H) / n
    gain = np.zeros((6, MAX_THRUSTERS))
    gain[:, :n] = np.linalg.solve(H, WB.T * W).T

    # One system of n equations for each set of clamped thrusters C: H_FF X = -H_FC for free ones, X = 0 for the others.
    C = (np.arange(1 << n)[:, None] >> np.arange(n)) & 1 == 1
    F, I = ~C, np.eye(n)
    right = np.where(F[:, :, None] & C[:, None, :], -H, 0.0)
    response = np.linalg.solve(np.where(F[:, :, None] & F[:, None, :], H, I), right)
    clamped = np.zeros((1 << MAX_THRUSTERS, MAX_THRUSTERS, MAX_THRUSTERS))
    inside = np.where(C[:, :, None] & C[:, None, :], (H + H @ response) / h, 0.0)
    clamped[: 1 << n, :n, :n] = response.swapaxes(1, 2) + inside
    return Tables(gain.astype(np.float32), clamped.astype(np.float32), _toward_zero(low), _toward_zero(high))


def _toward_zero(limits: npt.NDArray[np.float64]) -> npt.NDArray[np.float32]:
    """Return limits as eight float32 values, rounded such that none is outside its float64 value."""
    rounded = np.zeros(MAX_THRUSTERS, np.float32)
    nearest = limits.astype(np.float32)
    beyond = np.abs(nearest.astype(float)) > np.abs(limits)
    rounded[: len(limits)] = np.where(beyond, np.nextafter(nearest, np.float32(0.0)), nearest)
    return rounded


BLOCK_PATIENCE = wp.constant(3)
"""Number of block pivots without progress after which single pivots are used."""

MAX_PIVOTS = wp.constant(512)
"""Bound on the pivots of one allocation. Among two million wrenches on vehicles' layouts none needed more
than 7, among twenty million on random thruster matrices none more than 103."""

TOLERANCE = wp.constant(2.0e-6)
"""Rounding tolerance of a free thruster's limit, relative to the unlimited thrusts (float32 has 6e-8).

The multipliers need none: a thruster clamped for exceeding its limit by this much has a multiplier of the
correct sign.
"""


@wp.struct
class AllocationData:
    """Tables of each vehicle type for `allocate`, built by `allocation_data`, with the type as first index."""

    gain: wp.array2d(dtype=vec8)
    """Columns of H^-1 B' W^2: thrust per unit of requested wrench [N/N, N/(N m)], (vehicles, 6)."""

    clamped: wp.array3d(dtype=vec8)
    """Columns of the map d -> (f_F - f0_F, mu) for every set C (bit i: thruster i at a limit), (vehicles, 256, 8)
    [-]."""

    lower: wp.array(dtype=vec8)
    """Least thrust [N], (vehicles,)."""

    upper: wp.array(dtype=vec8)
    """Greatest thrust [N], (vehicles,)."""


@wp.func
def clip(f: vec8, lower: vec8, upper: vec8) -> vec8:
    """Return `f` with exceeded bounds replaced by the exact bounds, all in one unit; NaN stays NaN."""
    g = f
    for i in range(MAX_THRUSTERS):
        g[i] = wp.where(f[i] < lower[i], lower[i], wp.where(f[i] > upper[i], upper[i], f[i]))
    return g


@wp.func
def unconstrained(tau: vec6, vehicle: int, data: AllocationData) -> vec8:
    """Return the optimum without limits, f0 = H^-1 B' W^2 tau [N].

    Args:
        tau: Requested wrench about the reference point of B, body frame [N, N m].
        vehicle: Vehicle type, first index into `data`.
        data: Tables from `allocation_data`.
    """
    f0 = vec8()
    for j in range(6):
        f0 += data.gain[vehicle, j] * tau[j]
    return f0


@wp.func
def bounded(f0: vec8, vehicle: int, data: AllocationData) -> vec8:
    """Return the minimiser of (f - f0)' H (f - f0) within the limits, by principal pivoting [N]."""
    lower = data.lower[vehicle]
    upper = data.upper[vehicle]
    size = float(0.0)
    at_lower = int(0)
    at_upper = int(0)
    for i in range(MAX_THRUSTERS):
        size = wp.max(size, wp.abs(f0[i]))
        at_upper += wp.where(f0[i] > upper[i], 1 << i, 0)
        at_lower += wp.where(f0[i] < lower[i], 1 << i, 0)
    tolerance = TOLERANCE * size

    f = f0
    fewest = int(MAX_THRUSTERS + 1)
    patience = int(BLOCK_PATIENCE)
    for _pivot in range(MAX_PIVOTS):
        clamped = at_lower | at_upper
        y = vec8()
        for j in range(MAX_THRUSTERS):
            if (clamped >> j) & 1 != 0:
                bound = wp.where((at_upper >> j) & 1 != 0, upper[j], lower[j])
                f[j] = bound
                y += data.clamped[vehicle, clamped, j] * (bound - f0[j])

        # A free thruster must be within its limits; one at a limit presses against it (mu <= 0 at the upper limit).
        want_lower = int(0)
        want_upper = int(0)
        broken = int(0)
        for i in range(MAX_THRUSTERS):
            bit = 1 << i
            if clamped & bit == 0:
                f[i] = f0[i] + y[i]
                if f[i] > upper[i] + tolerance:
                    want_upper += bit
                    broken += 1
                elif f[i] < lower[i] - tolerance:
                    want_lower += bit
                    broken += 1
            elif at_upper & bit != 0:
                if y[i] > 0.0:
                    broken += 1
                else:
                    want_upper += bit
            else:
                if y[i] < 0.0:
                    broken += 1
                else:
                    want_lower += bit
        if broken == 0:
            break

        change = (at_lower ^ want_lower) | (at_upper ^ want_upper)
        if broken < fewest:
            fewest = broken
            patience = int(BLOCK_PATIENCE)
        elif patience > 0:
            patience -= 1
        if patience == 0:
            change = highest_bit(change)
        at_lower = (at_lower & ~change) | (want_lower & change)
        at_upper = (at_upper & ~change) | (want_upper & change)
    return clip(f, lower, upper)


@wp.func
def highest_bit(mask: int) -> int:
    """Return the highest bit that is set in an 8-bit mask."""
    bit = int(128)
    while bit & mask == 0 and bit > 1:
        bit >>= 1
    return bit


@wp.func
def allocate(tau: vec6, vehicle: int, data: AllocationData) -> vec8:
    """Return the thrusts closest to a requested wrench within the limits (paper, eq. 18), for one vehicle.

    Args:
        tau: Requested wrench about the reference point of B, body frame [N, N m].
        vehicle: Vehicle type, first index into `data`.
        data: Tables from `allocation_data`.

    Returns:
        Thrusts in the canonical order [N], never outside the limits. A wrench with NaN results in NaN.
    """
    f0 = unconstrained(tau, vehicle, data)
    excess = wp.max(wp.max(f0 - data.upper[vehicle]), wp.max(data.lower[vehicle] - f0))
    if excess > 0.0:
        return bounded(f0, vehicle, data)
    return f0


@wp.kernel(enable_backward=False)
def allocate_row(tau: wp.array(dtype=vec6), data: AllocationData, f: wp.array(dtype=vec8)):
    """Run `allocate` for the first vehicle type.

    Args:
        tau: Requested wrenches, body frame [N, N m], (N,).
        data: Tables from `allocation_data`.
        f: Resulting thrusts, canonical order [N], (N,).
    """
    i = wp.tid()
    f[i] = allocate(tau[i], 0, data)


def allocation_data(
    B: Sequence[npt.ArrayLike],
    lower: Sequence[npt.ArrayLike],
    upper: Sequence[npt.ArrayLike],
    weights: Sequence[npt.ArrayLike],
    regularisation: float = REGULARISATION,
    device: Any = "cpu",
) -> AllocationData:
    """Return the tables of one or more vehicle types for `allocate`; every sequence has one entry per type.

    Args:
        B: Thruster matrices, wrench = B f about the reference point in the body frame [-, m], (6, n) with n
            <= 8 each.
        lower: Least thrusts f- [N], (n,) each, at most zero.
        upper: Greatest thrusts f+ [N], (n,) each, at least zero.
        weights: Diagonals of W [1/N, 1/(N m)], (6,) each: 1/wrench limit, and zero for an irrelevant axis.
        regularisation: lambda relative to the mean non-zero eigenvalue of B' W^2 B (dimensionless).
        device: Warp device of the tables.

    Raises:
        ControlError: Shapes are wrong, limits exclude zero, or the problem is singular.
    """
    if not len(B) == len(lower) == len(upper) == len(weights) > 0:
        raise ControlError(
            f"allocation has {len(B)} matrices, {len(lower)} lower and {len(upper)} upper limits, "
            f"{len(weights)} weights: give one of each per vehicle type"
        )
    start_warp()  # without its banner
    types = [tables(*arguments, regularisation) for arguments in zip(B, lower, upper, weights, strict=True)]
    data = AllocationData()
    for name in Tables._fields:
        stacked = np.stack([getattr(arguments, name) for arguments in types])
        setattr(data, name, wp.array(stacked, dtype=vec8, device=device))
    return data


# Wrench allocation from NumPy: the code of the training kernels, called on the robot with one wrench at a time.


class Allocator:
    """Allocator of wrenches to thrusts within the limits of one vehicle's thrusters (paper, eq. 18).

    Note:
        It runs on the CPU and reuses its launch buffers, so each instance must be used by one thread only.
    """

    def __init__(
        self,
        B: npt.ArrayLike,
        lower: npt.ArrayLike,
        upper: npt.ArrayLike,
        weights: npt.ArrayLike,
        regularisation: float = REGULARISATION,
    ) -> None:
        """Precompute the tables of one vehicle; arguments as one entry of `allocation_data`.

        Raises:
            ControlError: Shapes are wrong, limits exclude zero, or the problem is singular.
        """
        self.data = allocation_data([B], [lower], [upper], [weights], regularisation)
        self.B: Array = np.array(B, float)
        self.lower: Array = np.array(lower, float)
        self.upper: Array = np.array(upper, float)
        self.weights: Array = np.array(weights, float)
        self._launch = RowLaunch(allocate_row, vec6, self.data)

    @classmethod
    def from_vehicle(cls, vehicle: Any, regularisation: float = REGULARISATION) -> Allocator:
        """Return the allocator about `vehicle.wrench_reference`, with each axis weighted by its wrench limit.

        `regularisation` is a weight.

        Raises:
            ControlError: The vehicle has no thrusters.
        """
        if not vehicle.thrusters:
            raise ControlError(f"{vehicle.name} has no thrusters: command its actuators instead of a wrench")
        lower, upper = vehicle.force_limits
        return cls(vehicle.control_matrix, lower, upper, axis_weights(vehicle.wrench_limits), regularisation)

    @property
    def thrusters(self) -> int:
        """Number of thrusters n."""
        return int(self.B.shape[1])

    def allocate(self, tau: npt.ArrayLike) -> Array:
        """Return the thrusts [N], (..., n), never outside the limits, for requested wrenches.

        Args:
            tau: Wrenches about the reference point of B, body frame [N, N m], (..., 6).

        Raises:
            ControlError: The last axis does not have length 6, or a number is not finite.
        """
        requested = np.asarray(tau, float)
        if requested.shape[-1:] != (6,):
            raise ControlError(f"wrench has shape {requested.shape}, expected (..., 6)")
        if not np.isfinite(requested).all():
            raise ControlError("wrench is not finite: find where the NaN or infinity came from")
        return self._launch(requested)[..., : self.thrusters]

    def achieved(self, f: npt.ArrayLike) -> Array:
        """Return the wrench B f of thrusts, about the reference point of B, body frame [N, N m], (..., n) ->
        (..., 6)."""
        return np.asarray(f, float) @ self.B.T


class RowLaunch:
    """Kernel (rows, data, thrusts) over rows of numbers, on the CPU: one row for each vehicle or time.

    A call writes the rows, launches the kernel, and reads the thrusts. The launch for the latest number of
    rows is recorded.
    """

    def __init__(self, kernel: Any, dtype: Any, data: Any) -> None:
        """
        Args:
            kernel: Kernel with an array of vectors, `data` and an array of vec8 as arguments.
            dtype: Warp type of the vectors.
            data: Warp struct on the CPU.
        """
        self._kernel, self._dtype, self._data = kernel, dtype, data
        self._record(1)  # a robot's first decision must not wait for the compiler

    def __call__(self, rows: npt.ArrayLike) -> Array:
        """Return thrusts [N], (..., 8), for rows (..., m); components of a vector beyond m are zero."""
        rows = np.asarray(rows, float)
        flat = rows.reshape(-1, rows.shape[-1])
        if len(flat) != self._count:
            self._record(len(flat))
        self._given[:, : flat.shape[1]] = flat
        self._command.launch()
        return self._thrusts.astype(float).reshape(*rows.shape[:-1], MAX_THRUSTERS)

    def _record(self, count: int) -> None:
        """Create arrays and launch for a number of rows; compile the kernel if necessary."""
        self._count = count
        self._arrays = [wp.zeros(count, dtype=kind, device="cpu") for kind in (self._dtype, vec8)]
        inputs = [self._arrays[0], self._data, self._arrays[1]]
        self._command = wp.launch(self._kernel, count, inputs, device="cpu", record_cmd=True)
        self._given, self._thrusts = (array.numpy() for array in self._arrays)


def axis_weights(wrench_limits: npt.ArrayLike) -> Array:
    """Return the diagonal of W [1/N, 1/(N m)], (6,): the inverse of each wrench limit, and zero on an axis
    without authority.

    If thrusters saturate, W determines the errors of the axes: an error is weighted relative to the limit of
    its axis, and no axis has priority.

    Args:
        wrench_limits: Largest wrench on each axis alone, body axes [N, N m], (6,).
    """
    limits = np.asarray(wrench_limits, float)
    weights: Array = np.divide(1.0, limits, out=np.zeros_like(limits), where=limits > 0.0)
    return weights
