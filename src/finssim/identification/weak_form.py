"""Weak form: initial estimates of the parameters of every axis by least squares, for the simulation-error fit.

    m nu_dot + d1 nu + d2 |nu| nu + b (+ k sin eta) = tau - c tau_dot

is valid about the reference point of the coefficients; c is the time by which the motion was recorded late. Both
sides are averaged with smooth bump functions, and integration by parts moves the derivatives to these (the weak
form), so that no noise is differentiated. Couplings between axes are neglected: the simulation includes them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from finssim.core.least_squares import boxed, huber_weight
from finssim.identification.plant_terms import matrices
from finssim.identification.rollout import Streams
from finssim.trials.free_motion import DETERMINED_BY
from finssim.trials.motion import spans_of, up_in_body
from finssim.vehicles import AXES, Vehicle

Array = NDArray[np.float64]

TERMS = ("m_eff", "d1", "d2", "bias", "late", "k")

HALF_WIDTH = (0.5, 0.25)
"""Half width of a bump [s]: large for axes that do not swing, smaller for roll and pitch."""

LATE_STD = 0.15
"""Prior standard deviation of the lag of the motion behind the input [s]."""

ROUNDS, CUT = 8, 1.345
"""Number of rounds of reweighting, and number of standard deviations beyond which a residual loses weight (Huber)."""

JOLT, PART, WIDER = 8.0, 0.4, 0.25
"""An unexplained force is a jolt if it exceeds this number of robust standard deviations and this fraction of
the range of the recorded input; and the margin around the bumps' centres that is left out with it [s]."""

SHARED = 6.0
"""Number of bumps that share most of their samples, and therefore most of their noise."""


class Found(NamedTuple):
    """Result of the weak form for one axis."""

    values: dict[str, float]
    """Numbers by name, from `TERMS`, in their units; empty if the trials do not determine a positive inertia."""
    jolts: list[tuple[int, float, float]]
    """Index of a trial, start and end [s] of an interval with a force that nothing in the log explains, such
    as an impact."""


def weak_form(trials: Sequence[Streams], axis: str, vehicle: Vehicle, known: Mapping[str, float]) -> Found:
    """Estimate the numbers of one axis.

    Args:
        trials: Trials that excite the axis.
        axis: One of six.
        vehicle: Vehicle with the reference point.
        known: Numbers of `TERMS` that are known already and are not estimated.
    """
    i = AXES.index(axis)
    H = matrices(vehicle).H
    parts = [(g, *part) for g, s in enumerate(trials) for part in _rows(s, i, H)]
    if not parts:
        return Found({}, [])
    X, y = (np.concatenate([part[column] for part in parts]) for column in (1, 2))
    names = [n for n in TERMS if n not in known and (n != "k" or i in (3, 4))]
    pushed = float(np.ptp(np.percentile(y, [5.0, 95.0])))
    if not np.abs(y).max() > 0.0:
        names.remove("late")
    y = y - sum((value * X[:, TERMS.index(n)] for n, value in known.items()), np.zeros(len(y)))
    X = X[:, [TERMS.index(n) for n in names]]
    scale = np.maximum(np.sqrt(np.mean(X**2, axis=0)), 1e-12)
    low = np.array([0.0 if n in ("m_eff", "d1", "d2", "k") else -np.inf for n in names])
    prior, theta, weight, variance = np.zeros(len(names)), np.zeros(len(names)), np.ones(len(y)), 1.0
    for _ in range(ROUNDS):
        Z = X / scale * weight[:, None]
        normal = Z.T @ (X / scale) + np.diag(variance * prior / scale**2 + 1e-8 * len(y))
        theta = boxed(normal, Z.T @ y, low, np.full(len(low), np.inf)) / scale
        size = np.abs(y - X @ theta)
        std = max(1.4826 * float(np.median(size)), 1e-12)
        weight = huber_weight(size / std, CUT)
        variance = SHARED * float(np.mean(weight * size**2))
        prior = np.array([LATE_STD**-2 if n == "late" else 0.0 for n in names])
    values = {**dict(zip(names, theta.tolist(), strict=True)), **known}
    # Roll and pitch also depend on the other axes, and fast motion couples all axes: this form neglects that.
    known_force = pushed > 0.0 and i not in (3, 4) and values["m_eff"] > 0.0 and not vehicle.actuators
    loud = size > max(JOLT * std, PART * pushed) if known_force else np.zeros(len(y), bool)
    jolts, row = list[tuple[int, float, float]](), 0
    for g, matrix, _, at in parts:
        # A velocity that was derived from positions may jump without any force.
        seen = loud[row : row + len(matrix)] & (DETERMINED_BY[axis][0] in trials[g].measured)
        jolts += [(g, float(at[a]) - WIDER, float(at[b - 1]) + WIDER) for a, b in spans_of(seen)]
        row += len(matrix)
    return Found(values if values["m_eff"] > 0.0 else {}, jolts)


def _rows(s: Streams, i: int, H: Array) -> list[tuple[Array, Array, Array]]:
    """Return columns of `TERMS`, (n, 6), force or moment [N, N m], (n,), and time [s], (n,), of each segment
    without a gap."""
    m = s.motion
    nu = np.nan_to_num(m.nu) @ H.T
    tau = m.tau @ np.linalg.inv(H)
    up = up_in_body(m.quaternion)
    sine = {3: up[:, 1], 4: -up[:, 0]}.get(i, np.zeros(len(m.t)))
    sine = np.where(np.isfinite(sine), sine, 0.0)
    good = np.isfinite(m.nu[:, i]) & np.isfinite(tau).all(axis=1)
    n = max(2, round(HALF_WIDTH[i in (3, 4)] * m.rate))
    x = np.arange(-n, n + 1) / (n + 1)
    phi = (1.0 - x**2) ** 3
    phi /= phi.sum()
    # Differentiator, exact for parabolas.
    slope = x * (1.0 - x**2) ** 2
    slope /= slope @ np.arange(-n, n + 1) / m.rate
    out = []
    for begin, end in spans_of(good):
        if end - begin < len(phi) + 2:
            continue
        signals = np.stack([nu[:, i], np.abs(nu[:, i]) * nu[:, i], tau[:, i], sine], axis=1)[begin:end]
        every = max(1, len(phi) // 6)
        windows = np.lib.stride_tricks.sliding_window_view(signals, len(phi), axis=0)[::every]
        mean, rate = windows @ phi, windows @ slope
        one = np.ones(len(mean))
        columns = np.stack([rate[:, 0], mean[:, 0], mean[:, 1], one, rate[:, 2], mean[:, 3]], axis=1)
        out.append((columns, mean[:, 2], m.t[begin + n + every * np.arange(len(mean))]))
    return out
