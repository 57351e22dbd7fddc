"""Everything that the step logs say about one thruster."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.actuators.motor_trial import (
    DOMAINS,
    Motor,
    StepFit,
    StepRecord,
    cut_steps,
    levels_of,
    motor_of,
    step_fit,
    steps_of,
)
from finssim.calibration.actuators.thrust_curve import jackknife, t_quantile
from finssim.calibration.trials.trial import Trial
from finssim.vehicles.thruster import Thruster

__all__ = ["Study", "fit_response", "study"]

# First order plus dead time from steps: K e^(-T_d s) / (τ s + 1), with intervals over the steps.

GRID, FINE = 41, 25
"""Dead times and time constants of the search, each way (facts, §5), and of the finer ones around the best."""
LONGEST_DELAY, DELAY_SHARE = 0.8, 0.45
"""T_d <= min(0.8 s, 0.45 of the step's duration) (facts, §5)."""


@dataclass(frozen=True, kw_only=True)
class Response:
    """What all steps have in common."""

    delay: float
    """T_d [s]."""
    time_constant: float
    """τ [s]."""
    delay_interval: tuple[float, float]
    time_constant_interval: tuple[float, float]
    sample: float
    """Of the measurement, median [s]."""
    steps: tuple[StepFit, ...]
    used: tuple[int, ...]
    """Which steps the numbers rest on: the accepted ones, or all that moved where none is accepted."""

    @property
    def hidden(self) -> bool:
        """Whether the time constant is below half a sample, where the log cannot tell it from 0."""
        return self.time_constant < 0.5 * self.sample


def fit_response(records: Sequence[StepRecord]) -> Response:
    """One dead time and time constant for all steps; every step has levels of its own.

    y = a + b (1 - e^(-(t - T_d) / τ)) from t = T_d on, a and b by least squares in every step. Errors over T_d and τ
    are summed over the steps, each over its height, on a grid of 41 by 41 and then on finer ones around the best.
    Levels of each step keep static nonlinearity (dead zone, thrust curve) out of the dynamics.

    Args:
        records: At least one step in which the response moves.

    Returns:
        Estimates with 95 % intervals: the wider of a jackknife over the steps (over the trials where there are four or
        more) and of the curvature of the error, both with the time in which samples cannot tell apart added to T_d's.
    """
    gaps = np.concatenate([np.diff(record.t) for record in records])
    sample = float(np.median(gaps))
    duration = float(np.median([record.t[-1] for record in records]))
    delays = np.linspace(0.0, min(LONGEST_DELAY, DELAY_SHARE * duration), GRID)
    constants = np.geomspace(0.1 * sample, duration, GRID)
    rough = np.array([_errors(record, delays, constants) for record in records])
    power = np.array([float(np.sum((r.y - np.mean(r.y)) ** 2)) for r in records])
    explained = 1.0 - rough.min(axis=(1, 2)) / np.maximum(power, 1e-300)
    followed = [i for i, share in enumerate(explained) if share > 0.5 and power[i] > 0.0]
    moving = followed or [int(np.argmax(explained))]

    def solve(chosen: Sequence[int]) -> tuple[float, float, tuple[int, ...], list[StepFit]]:
        delay, tau = _search([records[i] for i in chosen], delays, constants)
        fits = [step_fit(record, delay, tau, moved=i in followed) for i, record in enumerate(records)]
        return delay, tau, tuple(i for i in chosen if fits[i].accepted), fits

    _, _, accepted, _ = solve(moving)
    used = accepted or tuple(moving)
    delay, tau, _, fits = solve(used)
    chosen = [records[i] for i in used]
    half = _half_widths(
        chosen, delay, tau, 2.0 * float(delays[1]), 2.0 * float(np.log(constants[1] / constants[0]))
    )
    ratio = math.exp(half[1]) if half[1] < 5.0 else math.inf
    blur = 0.5 * float(np.median([record.sample for record in chosen]))
    return Response(
        delay=delay,
        time_constant=tau,
        delay_interval=(max(delay - half[0] - blur, 0.0), delay + half[0] + blur),
        time_constant_interval=(tau / ratio, tau * ratio),
        sample=sample,
        steps=tuple(fits),
        used=used,
    )


def _errors(record: StepRecord, delays: Array, constants: Array) -> Array:
    """Sum of squares left by the best levels, for every pair, (len(delays), len(constants)).

    With e_k = e^(-(t_k - T_d) / τ) after the dead time, all that least squares needs are sums of e, e² and y e over the
    samples from the first one on. They are formed once behind the longest dead time and carried back sample by sample.
    """
    t, y = record.t, record.y - record.y.mean()
    n = len(t)
    first = np.searchsorted(t, delays, side="right")
    low, high = int(first.min()), int(first.max())
    tail = np.exp(-(t[high:, None] - t[min(high, n - 1)]) / constants)
    sums = np.zeros((3, high - low + 1, len(constants)))
    sums[:, -1] = tail.sum(axis=0), (tail**2).sum(axis=0), y[high:] @ tail
    for k in range(high - 1, low - 1, -1):
        fall = np.exp(-(t[k + 1] - t[k]) / constants) if k + 1 < n else np.zeros_like(constants)
        later = sums[:, k + 1 - low]
        sums[:, k - low] = 1.0 + fall * later[0], 1.0 + fall**2 * later[1], y[k] + fall * later[2]
    at_first = np.exp(-np.maximum(t[np.minimum(first, n - 1)] - delays, 0.0)[:, None] / constants)
    e = at_first * sums[0, first - low]
    ee, ye = at_first**2 * sums[1, first - low], at_first * sums[2, first - low]
    count = (n - first)[:, None]
    after = np.append(np.cumsum(y[::-1])[::-1], 0.0)[first][:, None]
    r, ry = count - e, after - ye
    rr = count - 2.0 * e + ee - r**2 / n
    return np.asarray(y @ y - np.divide(ry**2, rr, out=np.zeros_like(rr), where=rr > 1e-12 * n))


def _noise(record: StepRecord, delay: float, tau: float) -> float:
    """Mean square of what the response leaves of a step."""
    left = float(_errors(record, np.array([delay]), np.array([tau]))[0, 0])
    return max(left / max(len(record.t) - 4, 1), 1e-12 * float(np.var(record.y)) + 1e-300)


def _search(records: Sequence[StepRecord], delays: Array, constants: Array) -> tuple[float, float]:
    """Best pair: the grid, then ever finer grids around it."""
    scale = [max(float(np.var(record.y)), 1e-300) for record in records]
    delay = tau = 0.0
    for _ in range(5):
        maps = sum(_errors(record, delays, constants) / s for record, s in zip(records, scale, strict=True))
        i, j = np.unravel_index(int(np.argmin(maps)), np.shape(maps))
        delay, tau = float(delays[i]), float(constants[j])
        delays, constants = _around(delay, tau, delays, constants)
    return delay, tau


def _around(delay: float, tau: float, delays: Array, constants: Array) -> tuple[Array, Array]:
    """A finer grid over two cells each way."""
    cell, ratio = 2.0 * float(delays[1] - delays[0]), float(constants[1] / constants[0]) ** 2
    low = max(delay - cell, 0.0)
    return np.linspace(low, delay + cell, FINE), np.geomspace(tau / ratio, tau * ratio, FINE)


def _half_widths(
    records: Sequence[StepRecord], delay: float, tau: float, wide: float, wide_log: float
) -> Array:
    """Half-widths of T_d and ln τ, on a grid that is made about four times as wide as they are."""
    half = np.zeros(2)
    for _ in range(4):
        delays = np.linspace(max(delay - wide, 0.0), delay + wide, FINE)
        constants = tau * np.exp(np.linspace(-wide_log, wide_log, FINE))
        maps = np.array(
            [_errors(record, delays, constants) / _noise(record, delay, tau) for record in records]
        )
        half = np.maximum(_curvature(maps, delays, constants), _over_steps(records, maps, delays, constants))
        cell = np.array([delays[1] - delays[0], np.log(constants[1] / constants[0])])
        wide, wide_log = (float(x) for x in 4.0 * np.maximum(half, cell))
    return half


def _curvature(maps: Array, delays: Array, constants: Array) -> Array:
    """Half-widths of T_d and ln τ from where the summed error, in units of its noise, rises by 3.84 (χ², 95 %)."""
    total = np.sum(maps, axis=0)
    inside = total <= total.min() + 3.84
    spread_delay = np.ptp(delays[inside.any(axis=1)])
    spread_tau = np.ptp(np.log(constants[inside.any(axis=0)]))
    return 0.5 * np.array([spread_delay, spread_tau])


def _over_steps(records: Sequence[StepRecord], maps: Array, delays: Array, constants: Array) -> Array:
    """Jackknife half-widths of T_d and ln τ over trials, or over steps where there are fewer than four trials."""
    trials = [record.trial for record in records]
    labels = trials if len(set(trials)) >= 4 else list(range(len(records)))
    names = list(dict.fromkeys(labels))
    if len(names) < 2:
        return np.zeros(2)
    found = []
    for name in names:
        total = np.sum(maps[[label != name for label in labels]], axis=0)
        i, j = np.unravel_index(int(np.argmin(total)), total.shape)
        found.append((delays[i], np.log(constants[j])))
    deviation = np.array(found) - np.mean(found, axis=0)
    G = len(names)
    return np.asarray(t_quantile(G - 1) * np.sqrt((G - 1) / G * np.sum(deviation**2, axis=0)))


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
