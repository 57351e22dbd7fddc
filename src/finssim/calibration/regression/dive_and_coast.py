"""Heave: the buoyancy excess, separated from the damping by dives and the coasts that follow (paper, section III-B)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.fit import Estimate
from finssim.calibration.regression.axis_fit import TERMS, AxisData
from finssim.calibration.regression.selection import Selection
from finssim.vehicles import Vehicle

__all__ = ["Coast", "buoyancy_estimate", "coasts"]

Array = NDArray[np.float64]

RISING = 0.01
"""Vertical speed from which a vehicle rises or sinks by itself [m/s] (published procedure)."""

STEADY = 1.0
"""How long it has to last [s]: the published 2 s, less half the width of a row's bump at each end."""

LEVEL = 0.9
"""Last over largest speed in that time; less is the end of a push, not buoyancy."""

HANDS_OFF = 0.05
"""Part of the largest wrench below which thrust does not count."""

USEFUL = 0.5
"""Half width of the interval, as a part of the excess, up to which it is written to the vehicle file."""

FAINT = 0.002
"""The same as a part of the weight: what a thousandth of the volume does matters little."""


@dataclass(frozen=True, kw_only=True)
class Coast:
    """A stretch in which buoyancy and weight alone move a vehicle up or down."""

    trial: str
    begin: float
    """On the trial's clock [s]."""
    end: float
    speed: float
    """Mean over the last `STEADY` seconds, positive up [m/s]."""


def coasts(data: AxisData) -> list[Coast]:
    """Stretches without thrust at whose end the vehicle rises or sinks steadily.

    Args:
        data: Of heave.
    """
    largest = max(float(np.abs(s.tau[np.isfinite(s.tau[:, 2]), 2]).max(initial=0.0)) for s in data.signals)
    found = []
    for s, rows in zip(data.signals, data.rows, strict=True):
        speed, push = rows.X[:, 1], np.interp(s.t[rows.at], s.t, np.nan_to_num(s.tau[:, 2]))
        free = (np.abs(push) < HANDS_OFF * largest) & (np.abs(speed) > RISING)
        edges = np.flatnonzero(np.diff(np.concatenate([[False], free, [False]]).astype(np.int8)))
        for b, e in edges.reshape(-1, 2):
            t = s.t[rows.at[b:e]]
            last = t > t[-1] - STEADY
            fading = abs(speed[e - 1]) < LEVEL * np.abs(speed[b:e][last]).max()
            same = np.sign(speed[b:e][last]) == np.sign(speed[e - 1])
            if t[-1] - t[0] >= STEADY and same.all() and not fading:
                found.append(
                    Coast(
                        trial=s.name,
                        begin=float(t[0]),
                        end=float(t[-1]),
                        speed=float(np.mean(speed[b:e][last])),
                    )
                )
    return found


def buoyancy_estimate(data: AxisData, chosen: Selection, vehicle: Vehicle) -> tuple[Estimate, list[str]]:
    """B - W from the bias of heave: m w_dot + d1 w + d2 |w| w + b = tau_z, b = -(B - W).

    Args:
        data: Of heave.
        chosen: Its model.
        vehicle: For its weight, which is taken as exact.

    Returns:
        The estimate, and what to know about it.
    """
    bias = TERMS.index("bias")
    low, high = (float(x) for x in chosen.interval[bias])
    value = -float(chosen.fit.theta[bias])
    free = coasts(data)
    speeds = np.concatenate([r.X[u, 1] for r, u in zip(data.rows, chosen.fit.used, strict=True)])
    both = bool((speeds > RISING).any() and (speeds < -RISING).any())
    warnings = []
    if free:
        fastest = max(free, key=lambda c: abs(c.speed))
        note = (
            f"{len(free)} coast{'s' if len(free) > 1 else ''} without thrust, up to {fastest.speed:+.3f} m/s"
        )
    elif both:
        note = "from driven motion up and down; no coast without thrust reached 0.01 m/s"
    else:
        note = "no coast and one direction only: the excess trades off with the damping"
        warnings.append(
            "heave: the trials go one way only and never coast, so that the buoyancy excess trades off with the "
            "damping: add a dive followed by a coast"
        )
    known = bool(np.isfinite([low, high]).all())
    known = known and 0.5 * (high - low) <= max(USEFUL * abs(value), FAINT * vehicle.weight)
    if not known:
        note += "; not known to half its size"
    sure = known and (bool(free) or both)
    volume = (vehicle.weight + value) / (vehicle.water.density * vehicle.water.gravity)
    return (
        Estimate(
            name="buoyancy_excess",
            estimate=value,
            ci95=(-high, -low),
            unit="N",
            identifiable=sure,
            note=f"{note}; with the file's weight a displaced volume of {volume:.6g} m³",
            path="body.displaced_volume",
        ),
        warnings,
    )
