"""What one axis would have done: its model driven by the recorded input, for instruments and for comparison.

Measured velocities on the right side of a regression carry noise, which biases least squares towards zero. Velocities
simulated from the recorded input alone are close to the true ones and know nothing of that noise: as instruments they
remove the bias (Young 1981; Janot, Vandanjon and Gautier 2014, IDIM-IV).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

__all__ = ["simulate_axis"]

Array = NDArray[np.float64]


def simulate_axis(
    theta: Array,
    wrench: Sequence[Array],
    step: float,
    restart: Sequence[Sequence[tuple[int, float, float]]],
) -> tuple[list[Array], list[Array]]:
    """Velocities and angles of several trials at once.

    m nu_dot = tau - d1 nu - d2 |nu| nu - k s,  s_dot = nu          (paper, eq. 6 and its form for roll and pitch)

    The step is implicit in the damping and central in s: of second order, stable for any stiffness.

    Args:
        theta: m, d1, d2, k for all trials (4,), or for each (4, G); m > 0.
        wrench: tau of every trial, bias and known terms already taken off, one (n_g,) each.
        step: [s]
        restart: For every trial, where velocity and s, the sine of the angle, are set anew: (index, nu, s) at the
            begin of each stretch; both are 0 before the first.

    Returns:
        nu and s of every trial at the samples of its wrench; NaN from where a run leaves all bounds.
    """
    m, d1, d2, k = (np.asarray(x, float) for x in theta)
    G, n = len(wrench), max(len(w) for w in wrench)
    tau = np.zeros((n, G))
    for g, w in enumerate(wrench):
        tau[: len(w), g] = w
    middle = 0.5 * (tau[:-1] + tau[1:]) * (step / m)
    nu, s = np.empty((n, G)), np.empty((n, G))
    v, x = np.zeros(G), np.zeros(G)
    anew: dict[int, list[tuple[int, float, float]]] = {}
    for g, entries in enumerate(restart):
        for index, velocity, angle in entries:
            anew.setdefault(index, []).append((g, velocity, angle))
    half = step / (2.0 * m)
    previous = v
    with np.errstate(over="ignore", invalid="ignore"):
        for i in range(n):
            for g, velocity, angle in anew.get(i, ()):
                v[g], x[g], previous = velocity, angle, np.where(np.arange(G) == g, velocity, previous)
            nu[i], s[i] = v, x
            if i == n - 1:
                break
            a = half * (d1 + d2 * np.abs(1.5 * v - 0.5 * previous))  # speed at mid-step, extrapolated
            push = middle[i] - 2.0 * half * k * (x + 0.5 * step * v) if k.any() else middle[i]
            previous, v = v, (v * (1.0 - a) + push) / (1.0 + a)
            x = x + 0.5 * step * (previous + v)
    return [nu[: len(w), g] for g, w in enumerate(wrench)], [s[: len(w), g] for g, w in enumerate(wrench)]
