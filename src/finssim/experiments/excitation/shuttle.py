"""To and fro in a small pool: square waves, which show mass by many reversals and both directions in one trial."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from finssim.calibration.excitation.programmes import RATE, Programme, which_axes
from finssim.vehicles import AXES, Vehicle

__all__ = ["shuttles"]

PERIODS = {"surge": 4.0, "sway": 4.0, "heave": 2.4, "roll": 2.0, "pitch": 2.0, "yaw": 4.0}
"""Of the wave, some five time constants of a small vehicle [s]."""
WAVES = 2.5
"""The first and the last half of a half wave, so that the middle of the way is where it began."""


def shuttles(levels: Mapping[str, Sequence[float]], vehicle: Vehicle) -> list[Programme]:
    """Square waves, two and a half periods each, which begin with half of a push.

    Steps tell the drag, for most of a step is steady; mass is told by what is not, and the propellers of the two
    directions, which differ, average out within a trial.

    Args:
        levels: Axis -> magnitudes [N, N m].
        vehicle: Must control the axes.

    Raises:
        CalibrationError: An axis that the vehicle does not control.
    """
    return [
        _shuttle(axis, level, PERIODS[axis])
        for axis in which_axes(list(levels), vehicle)
        for level in levels[axis]
    ]


def _shuttle(axis: str, level: float, period: float) -> Programme:
    counts = [round(s * RATE) for s in (1.0, 1.0, WAVES * period, 2.0, 1.0)]
    phase = np.repeat(np.array(["rest", "baseline", "excitation", "coast", "rest"]), counts)
    t = np.arange(counts[2]) / RATE
    tau = np.zeros((len(phase), 6))
    # A cosine's sign: a quarter of the period forward, half of it back, and so on.
    tau[phase == "excitation", AXES.index(axis)] = level * np.sign(
        np.cos(2.0 * math.pi * (t + 1e-6) / period)
    )
    return Programme(
        name=f"{axis}_shuttle_{level:.4g}",
        axes=(axis,),  # type: ignore[arg-type]
        rate=RATE,
        tau_desired=tau,
        phase=phase,
    )
