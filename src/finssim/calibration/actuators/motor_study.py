"""Everything that the step logs say about one thruster."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.actuators.motor_response import Response, fit_response
from finssim.calibration.actuators.motor_steps import StepRecord, cut_steps
from finssim.calibration.actuators.motor_trial import DOMAINS, Motor, levels_of, motor_of, steps_of
from finssim.calibration.actuators.thrust_curve import jackknife
from finssim.calibration.trials.trial import Trial
from finssim.vehicles.thruster import Thruster

__all__ = ["Study", "study"]

Array = NDArray[np.float64]

STANDING = 0.02
"""Share of the largest response below which a held level counts as standing."""


@dataclass(frozen=True, kw_only=True)
class Study:
    """One thruster, in the domain on which the vehicle file lets its lag act."""

    name: str
    domain: str
    motors: tuple[Motor, ...]
    """One per trial."""
    records: tuple[StepRecord, ...]
    response: Response
    gain: float
    """Steady response over command; NaN where no level moves."""
    gain_half: float
    dead: dict[str, tuple[float, float]]
    """`plus` and `minus` -> largest command that leaves the shaft standing and smallest that turns it (magnitudes)."""
    steady_error: float
    """Mean of |response - command| / |command| over the levels that move."""
    other_nrmse: float
    """Error of the same fit in the other domain, over the steps' height; NaN where it could not be made."""

    @property
    def nrmse(self) -> float:
        """Median over the steps used."""
        return float(np.median([self.response.steps[i].nrmse for i in self.response.used]))

    @property
    def same_unit(self) -> bool:
        """Whether gains and dead zone compare equal quantities."""
        return all(motor.same_unit for motor in self.motors)


def study(name: str, trials: Sequence[Trial], thruster: Thruster, domain: str | None = None) -> Study | None:
    """Fit one thruster over all trials that hold it; None where no command of it holds and changes.

    Args:
        name: Of the thruster.
        trials: All of them.
        thruster: As the vehicle file has it; its curve turns thrust and speed into each other.
        domain: `force` or `speed`; the vehicle file's where not given.
    """
    chosen = domain or thruster.domain
    motors = [
        motor for motor in (motor_of(trial, name, thruster, chosen) for trial in trials) if motor is not None
    ]
    records = [record for motor in motors for record in _records(motor)]
    if not records:
        return None
    response = fit_response(records)
    pairs = [pair for motor in motors for pair in levels_of(motor)]
    gain, gain_half, error = _gain(pairs)
    other = DOMAINS[1 - DOMAINS.index(chosen)]
    other_motors = [m for m in (motor_of(trial, name, thruster, other) for trial in trials) if m is not None]
    other_records = [record for motor in other_motors for record in _records(motor)]
    other_fit = fit_response(other_records) if other_records else None
    return Study(
        name=name,
        domain=chosen,
        motors=tuple(motors),
        records=tuple(records),
        response=response,
        gain=gain,
        gain_half=gain_half,
        dead=_dead(pairs),
        steady_error=error,
        other_nrmse=float(np.median([other_fit.steps[i].nrmse for i in other_fit.used]))
        if other_fit
        else math.nan,
    )


def _records(motor: Motor) -> list[StepRecord]:
    return cut_steps(motor.trial, motor.t, motor.response, motor.command_times, steps_of(motor))


def _gain(pairs: Sequence[tuple[float, float]]) -> tuple[float, float, float]:
    """Steady response over command by least squares through zero, its half-width, and the mean relative error."""
    moving = _moving(pairs)
    if not moving:
        return math.nan, math.inf, math.nan
    u, y = np.array(moving).T
    gain = float(u @ y / (u @ u))
    error = float(np.mean(np.abs(y - u) / np.abs(u)))
    if len(moving) < 3:
        return gain, math.inf, error
    others = [np.arange(len(u)) != i for i in range(len(u))]
    left_out = np.array([[u[rows] @ y[rows] / (u[rows] @ u[rows])] for rows in others])
    return gain, float(jackknife(left_out)[0]), error


def _moving(pairs: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    largest = max((abs(y) for _, y in pairs), default=0.0)
    return [(u, y) for u, y in pairs if u != 0.0 and abs(y) > STANDING * largest]


def _dead(pairs: Sequence[tuple[float, float]]) -> dict[str, tuple[float, float]]:
    """Commands between which the shaft starts, per direction that was tried."""
    moving = _moving(pairs)
    edges = {}
    for side, sign in (("plus", 1.0), ("minus", -1.0)):
        turn = [sign * u for u, _ in moving if sign * u > 0.0]
        stand = [sign * u for u, y in pairs if sign * u > 0.0 and (u, y) not in moving]
        if turn:
            below = [u for u in stand if u < min(turn)]
            edges[side] = (max(below, default=0.0), min(turn))
    return edges
