"""Coupled added mass and damping of several axes, such that every vector of the box is physical."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from finssim.vehicles import AXES

if TYPE_CHECKING:
    from finssim.calibration.simulation.parameters import Coordinate, Parameters

__all__ = ["Coupled"]

Array = NDArray[np.float64]

LARGEST = 2.0
"""Of the entries of U off the diagonal."""

LEAST_MASS = 0.05
"""Smallest entry of Δ of the mass matrix: part of the vehicle file's inertia."""


class Coupled:
    """Full matrices over the n free axes E; the rest R and its couplings stay as the vehicle file has them.

    M_EE - M_ER M_RR⁻¹ M_RE = S U Δ Uᵀ S       so M = M_RB + M_A is positive definite where Δ > 0 is diagonal
    (D1)_EE = T (U Δ Uᵀ + Ω) T + file's part   so its symmetric part is positive semidefinite for Δ >= 0
    (D2)_ij = c_ij d_i^⅓ d_j^⅔, |c_ij| <= 1/(n-1)

    The last takes energy out for every nu: with y_i = d_i^⅓ |nu_i|, the power is at least
    Σ y_i³ - Σ_ij |c_ij| y_i y_j², and y_i y_j² <= y_i³/3 + 2 y_j³/3, so each y_i³ keeps at least
    1 - Σ_j (|c_ij|/3 + 2 |c_ji|/3) >= 0 of itself.

    U is unit lower triangular and Ω antisymmetric, of their own in each; S and T are the sizes in the vehicle file, so
    that all entries are of order one. Bounds on U keep M as well conditioned as single precision needs.
    """

    def __init__(self, parameters: Parameters) -> None:
        """Couple the free axes of `parameters`."""
        p, E = parameters, parameters.index
        self.axes, self.E, self.n = p.axes, E, len(E)
        R = np.array([i for i in range(6) if i not in E], int)
        M = p.M_RB + p.M_A
        # What the free block owes to its couplings with the rest, and to the rigid body.
        rest = M[np.ix_(E, R)] @ np.linalg.solve(M[np.ix_(R, R)], M[np.ix_(R, E)]) if len(R) else 0.0
        self.mass_offset = rest - p.M_RB[np.ix_(E, E)]
        C = M[np.ix_(E, E)] - rest
        self.S = np.sqrt(np.diag(C))
        self.mass_start = _factors(C / np.outer(self.S, self.S))
        D1 = p.D1[np.ix_(E, E)]
        sym = 0.5 * (p.D1 + p.D1.T)
        self.damping_offset = np.zeros((self.n, self.n))
        if len(R):
            across = sym[np.ix_(E, R)]
            self.damping_offset = across @ np.linalg.pinv(sym[np.ix_(R, R)]) @ across.T
        typical = 0.1 * np.diag(M)[E]
        has_linear = np.array([p.damping[a] != "quadratic" for a in p.axes])
        has_quadratic = np.array([p.damping[a] != "linear" for a in p.axes])
        self.linear: list[int] = np.flatnonzero(has_linear).tolist()
        self.T = np.sqrt(np.maximum(np.diag(D1), typical))
        block = (0.5 * (D1 + D1.T) - self.damping_offset) / np.outer(self.T, self.T)
        values, vectors = np.linalg.eigh(block)
        # Away from the singular edge, where no derivative would lead back.
        block = (vectors * np.maximum(values, 0.05)) @ vectors.T
        self.damping_start = _factors(block)
        self.skew_start = 0.5 * (D1 - D1.T) / np.outer(self.T, self.T)
        self.quadratic: list[int] = np.flatnonzero(has_quadratic).tolist()
        self.d2_start = np.maximum(np.diag(p.D2)[E], typical)
        self.d2_low = 1e-4 * typical
        self.bound = 1.0 / max(len(self.quadratic) - 1, 1)
        cube = np.cbrt(self.d2_start)
        self.c_start = np.clip(p.D2[np.ix_(E, E)] / np.outer(cube, cube**2), -self.bound, self.bound)

    def _slots(self) -> Iterator[tuple[str, str, int, int, float, float, float]]:
        """Kind, name, row, column, start, low and high of every coordinate, in the vector's order."""
        inf = np.inf
        for i in range(self.n):
            for j in range(i + 1):
                low, high = (LEAST_MASS, inf) if i == j else (-LARGEST, LARGEST)
                yield "M", f"M.{self._pair(i, j)}", i, j, self.mass_start[i, j], low, high
        for a, i in enumerate(self.linear):
            for j in self.linear[: a + 1]:
                low, high = (0.0, inf) if i == j else (-LARGEST, LARGEST)
                yield "L", f"D1.{self._pair(i, j)}", i, j, self.damping_start[i, j], low, high
                if i != j:
                    yield "W", f"D1a.{self._pair(i, j)}", i, j, self.skew_start[i, j], -inf, inf
        for i in self.quadratic:
            for j in self.quadratic:
                if i == j:
                    yield "d", f"D2.{self.axes[i]}", i, i, self.d2_start[i], self.d2_low[i], inf
                else:
                    yield "c", f"D2.{self._pair(i, j)}", i, j, self.c_start[i, j], -self.bound, self.bound

    def _pair(self, i: int, j: int) -> str:
        return f"{self.axes[i]}.{self.axes[j]}"

    def coordinates(self) -> Iterator[Coordinate]:
        """The coordinates, of order one but for the diagonal of D2."""
        from finssim.calibration.simulation.parameters import Coordinate

        for kind, name, i, _, start, low, high in self._slots():
            scale = 3.0 * float(self.S[i] ** 2) if kind == "d" else 0.5 if kind == "c" else 1.0
            yield Coordinate(name, "-", float(start), float(low), float(high), scale)

    def write(self, x: Array, M_A: Array, D1: Array, D2: Array) -> None:
        """Replace the free blocks of matrices (W, 6, 6) by those of vectors x, (W, P)."""
        W, n = len(x), self.n
        parts = {kind: np.zeros((W, n, n)) for kind in "MLWdc"}
        for column, (kind, _, i, j, *_) in enumerate(self._slots()):
            parts[kind][:, i, j] = x[:, column]
        block = np.ix_(np.arange(W), self.E, self.E)
        M_A[block] = _product(parts["M"]) * np.outer(self.S, self.S) + self.mass_offset
        skew = parts["W"] - np.swapaxes(parts["W"], 1, 2)
        D1[block] = (_product(parts["L"]) + skew) * np.outer(self.T, self.T) + self.damping_offset
        d = np.einsum("wii->wi", parts["d"])
        cube = np.cbrt(d)
        D2[block] = parts["c"] * cube[:, :, None] * cube[:, None, :] ** 2
        D2[:, self.E, self.E] = d

    def entries(self) -> list[tuple[str, str, int, int]]:
        """Reported off-diagonal entries: name, matrix, row and column of the 6x6 matrix."""
        E, out = self.E, []
        for i in range(self.n):
            for j in range(i):
                out.append((f"added_mass.{AXES[E[j]]}.{AXES[E[i]]}", "added_mass", int(E[j]), int(E[i])))
        for word, matrix, rows in (
            ("d1", "linear_damping", self.linear),
            ("d2", "quadratic_damping", self.quadratic),
        ):
            out += [
                (f"{word}.{AXES[E[i]]}.{AXES[E[j]]}", matrix, int(E[i]), int(E[j]))
                for i in rows
                for j in rows
                if i != j
            ]
        return out


def _factors(A: Array) -> Array:
    """Δ on the diagonal and U below it, of A = U Δ Uᵀ, (n, n)."""
    L = np.linalg.cholesky(A)
    out = L / np.diag(L)
    np.fill_diagonal(out, np.diag(L) ** 2)
    return np.asarray(out)


def _product(factors: Array) -> Array:
    """U Δ Uᵀ of many such factors, (W, n, n)."""
    delta = np.einsum("wii->wi", factors).copy()
    U = factors.copy()
    np.einsum("wii->wi", U)[...] = 1.0
    return np.asarray((U * delta[:, None, :]) @ np.swapaxes(U, 1, 2))
