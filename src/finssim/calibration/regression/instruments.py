"""What one axis would have done: its model driven by the recorded input, for instruments and for comparison.

Measured velocities on the right side of a regression carry noise, which biases least squares towards zero. Velocities
simulated from the recorded input alone are close to the true ones and know nothing of that noise: as instruments they
remove the bias (Young 1981; Janot, Vandanjon and Gautier 2014, IDIM-IV).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Piece", "Run", "cut", "joined", "simulate_axis"]

Array = NDArray[np.float64]

RATE = 25.0
"""Steps per second that are enough for time constants of 0.3 s and swings of 1 s [Hz]; slower logs keep their own."""

BLOCK = 20.0
"""Longest run from one measured state [s]."""

LEAD = 2.0
"""Before each further block, for the noise of the state that it starts from to fade [s]."""


@dataclass(frozen=True)
class Run:
    """From one measured state."""

    push: Array
    """Mean of tau over every step, (n,)."""
    step: float
    """[s]"""
    nu: float
    s: float
    """At the begin."""


@dataclass(frozen=True)
class Piece:
    """Where a run goes in its trial, and the measured state that it starts from."""

    start: int
    first: int
    last: int
    """The run begins at `start`; samples from `first` to before `last` are taken from it."""
    every: int
    """Samples in a step."""
    rate: float
    """Of the samples [Hz]"""
    nu: float
    s: float

    def run(self, wrench: Array) -> Run:
        """The run under the trial's force or moment on the axis.

        Args:
            wrench: Without bias and known terms, body axes [N or N m], (n,).
        """
        q = self.every
        steps = -(-(self.last - 1 - self.start) // q)
        inside = wrench[self.start : self.start + steps * q + 1]
        inside = np.pad(inside, (0, steps * q + 1 - len(inside)), mode="edge")
        push = inside[:-1].reshape(steps, q).mean(axis=1) + np.diff(inside[::q]) / (2 * q)  # trapezoids
        return Run(push, q / self.rate, self.nu, self.s)


def cut(rate: float, spans: Sequence[tuple[int, int]], nu: Array, sine: Array | None) -> list[Piece]:
    """Pieces of one trial: each starts from the measured state and is no longer than `BLOCK`, after a `LEAD`.

    Args:
        rate: [Hz]
        spans: Stretches of consecutive good samples, [begin, end).
        nu: Measured velocity of the axis, body frame [m/s or rad/s], (n,); the state is the median of a tenth of a
            second.
        sine: Of the angle, (n,); None without stiffness.
    """
    q = max(1, int(rate / RATE + 1e-9))
    few, lead = max(1, round(0.1 * rate)), round(LEAD * rate)
    pieces = []
    for begin, end in spans:
        count = max(1, int(np.ceil((end - begin) / (BLOCK * rate))))
        edges = (begin + (end - begin) * np.arange(count + 1) // count).tolist()
        for first, last in zip(edges[:-1], edges[1:], strict=True):
            start = max(begin, first - lead)
            v = float(np.median(nu[start : start + few]))
            s = 0.0 if sine is None else float(np.median(sine[start : start + few]))
            pieces.append(Piece(start, first, last, q, rate, v, s))
    return pieces


def joined(lines: Sequence[Array], pieces: Sequence[Piece], n: int) -> Array:
    """A signal of the runs of a trial on its n samples, zero where there is none, (n,)."""
    out = np.zeros(n)
    for line, piece in zip(lines, pieces, strict=True):
        at = np.arange(piece.first, piece.last)
        knots = piece.start + piece.every * np.arange(len(line))
        out[piece.first : piece.last] = np.interp(at, knots, line)
    return out


def simulate_axis(theta: Array, runs: Sequence[Run]) -> tuple[list[Array], list[Array]]:
    """Velocities and angles of several runs at once.

    m nu_dot = tau - d1 nu - d2 |nu| nu - k s,  s_dot = nu          (paper, eq. 6 and its form for roll and pitch)

    The step is implicit in the damping and central in s: of second order, stable for any stiffness.

    Args:
        theta: m, d1, d2, k of all runs (4,), or of each (4, G); m > 0.
        runs: Inputs and initial states.

    Returns:
        nu and s of every run, the sine of the angle, (n_g + 1,) each; not finite from where a run leaves all bounds.
    """
    m, d1, d2, k = (np.broadcast_to(x, len(runs)) for x in np.asarray(theta, float))
    n = max((len(run.push) for run in runs), default=0)
    step = np.array([run.step for run in runs])
    push = np.zeros((n, len(runs)))
    for g, run in enumerate(runs):
        push[: len(run.push), g] = run.push * (run.step / m[g])
    nu, s = np.empty((n + 1, len(runs))), np.zeros((n + 1, len(runs)))
    nu[0], s[0] = [run.nu for run in runs], [run.s for run in runs]
    linear, quadratic, spring, half = d1 * step / (2.0 * m), d2 * step / (2.0 * m), k * step / m, 0.5 * step
    v, x = nu[0], s[0]
    previous, drag, swings = v, bool(d2.any()), bool(k.any())
    with np.errstate(over="ignore", invalid="ignore"):
        for i in range(n):
            force = push[i]
            a = linear
            if drag:
                a = a + quadratic * np.abs(1.5 * v - 0.5 * previous)  # speed at mid-step, extrapolated
            if swings:
                force = force - spring * (x + half * v)
            previous, v = v, (v * (1.0 - a) + force) / (1.0 + a)
            nu[i + 1] = v
            x = x + half * (previous + v)
            s[i + 1] = x
    ends = [len(run.push) + 1 for run in runs]
    return [nu[:end, g] for g, end in enumerate(ends)], [s[:end, g] for g, end in enumerate(ends)]
