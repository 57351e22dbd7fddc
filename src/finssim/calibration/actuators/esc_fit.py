"""The law between pulse width, battery voltage and shaft speed, fitted to tables."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.actuators.table_signs import STANDING
from finssim.calibration.actuators.thrust_curve import jackknife
from finssim.calibration.errors import CalibrationError
from finssim.vehicles import Esc

__all__ = ["EscFit", "fit_esc"]

Array = NDArray[np.float64]

BLOCKS = 8
"""Parts that the pulses of a direction are cut into for intervals."""
LEAST_ROWS = 5
"""Turning rows per direction from which the law is fitted."""


@dataclass(frozen=True, kw_only=True)
class EscFit:
    """A fitted speed controller."""

    esc: Esc
    intervals: dict[str, tuple[float, float]]
    """95 %, of every fitted field of `esc`."""
    rmse: float
    """Of the speed [rad/s]."""
    fastest: float
    """Fastest speed among the rows [rad/s]."""
    unsure: dict[str, str]
    """Field -> why the data do not determine it."""


def fit_esc(
    pulse: Array,
    speed: Array,
    voltage: Array,
    *,
    pulse_range: tuple[float, float, float],
    weight: Array | None = None,
    at: float | None = None,
) -> EscFit:
    """Fit `finssim.vehicles.Esc` by least squares of the shaft speed, each direction by itself.

    Args:
        pulse: [µs], (n,).
        speed: Steady shaft speed [rad/s], of the sign of pulse - neutral, 0 where the shaft stands, (n,).
        voltage: Of the battery [V], (n,).
        pulse_range: Full reverse, neutral, full forward [µs].
        weight: Of the rows' speeds, (n,); 1 where not given.
        at: Voltage for which the dead band is told [V]; the mean where not given.

    Raises:
        CalibrationError: A direction has too few turning rows, or the shaft turns against the pulse.
    """
    low, neutral, high = pulse_range
    volts = float(np.mean(voltage)) if at is None else at
    weight = np.ones_like(speed) if weight is None else weight
    numbers: dict[str, float] = {}
    intervals: dict[str, tuple[float, float]] = {}
    unsure: dict[str, str] = {}
    for name, sign, span in (("minus", -1, neutral - low), ("plus", 1, high - neutral)):
        side = sign * (pulse - neutral) > 0.0
        throw, omega = sign * (pulse[side] - neutral), sign * speed[side]
        turning = np.abs(omega) > STANDING * np.max(np.abs(omega), initial=0.0)
        _check(omega[turning], name)
        near = np.abs(voltage[side] - volts) <= 0.05 * volts
        edge, edge_interval, note = _edge(throw, turning, near if np.any(near & turning) else near | True)
        if note:
            unsure[f"dead_{name}"] = note
        law = (throw[turning] / span, voltage[side][turning], omega[turning], weight[side][turning])
        zero, emf, load = _law(*law, edge / span)
        label = np.argsort(np.argsort(law[0], kind="stable")) * BLOCKS // len(law[0])
        left_out = [_law(*_others(law, label != i), edge / span) for i in range(BLOCKS) if np.any(label == i)]
        half = jackknife(np.array(left_out))
        numbers |= {f"dead_{name}": neutral + sign * edge, f"zero_{name}": neutral + sign * span * zero}
        numbers |= {f"emf_{name}": emf, f"load_{name}": load}
        ends = sorted(neutral + sign * x for x in edge_interval)
        intervals[f"dead_{name}"] = (ends[0], ends[1])
        intervals[f"zero_{name}"] = _around(numbers[f"zero_{name}"], span * half[0])
        intervals[f"emf_{name}"] = _around(emf, half[1])
        intervals[f"load_{name}"] = _around(load, half[2])
        for key, value, ceiling in (
            ("zero", zero, edge / span),
            ("emf", emf, np.inf),
            ("load", load, np.inf),
        ):
            if value <= 1e-9 or value >= ceiling * (1.0 - 1e-9):
                unsure[f"{key}_{name}"] = "rests on a bound of the law"
    esc = Esc(pulse_neutral=neutral, pulse_min=low, pulse_max=high, voltage=volts, **numbers)
    error = esc.shaft_speed(pulse, voltage) - speed
    both = (speed != 0.0) & (esc.shaft_speed(pulse, voltage) != 0.0)
    return EscFit(
        esc=esc,
        intervals=intervals,
        rmse=float(np.sqrt(np.mean(error[both] ** 2))),
        fastest=float(np.max(np.abs(speed))),
        unsure=unsure,
    )


def _check(omega: Array, name: str) -> None:
    direction = {"minus": "below", "plus": "above"}[name]
    if omega.size < LEAST_ROWS:
        raise CalibrationError(
            f"{omega.size} rows turn the shaft at pulses {direction} neutral, expected at least {LEAST_ROWS}: "
            "add rows, or leave the pulse column out to fit the thrust curve alone"
        )
    if np.count_nonzero(omega < 0.0) > 0.5 * omega.size:
        raise CalibrationError(
            f"the shaft turns backwards at pulses {direction} neutral: turn the sign of the pulse's thruster or of "
            "speed and force in the table"
        )


def _edge(
    throw: Array, turning: NDArray[np.bool_], near: NDArray[np.bool_]
) -> tuple[float, tuple[float, float], str]:
    """Pulse from neutral at which the shaft starts [µs], its interval, and why it is not known."""

    first = float(np.min(throw[turning & near]))
    standing = throw[~turning & near & (throw < first)]
    if standing.size == 0:
        return first, (0.0, first), "the table holds no pulse that leaves the shaft standing"
    last = float(np.max(standing))
    return 0.5 * (last + first), (last, first), ""


def _law(duty: Array, volts: Array, omega: Array, weight: Array, edge: float) -> tuple[float, float, float]:
    """zero, emf and load of (duty - zero) V = emf ω + load ω² with 0 <= zero <= edge."""
    from scipy.optimize import least_squares, nnls  # SciPy is slow to import

    # Linear in the parameters where the balance of voltages is the residual: the start of the search in speed.
    rows = np.column_stack([omega, omega**2, volts])
    start, _ = nnls(rows, duty * volts)
    scale = np.array([max(edge, 1e-3), float(np.median(volts / omega)), float(np.median(volts / omega**2))])
    first = np.clip(
        [min(start[2], 0.9 * edge), start[0], start[1]], 1e-3 * scale, [max(edge, 1e-3), np.inf, np.inf]
    )
    found = least_squares(
        partial(_residual, duty=duty, volts=volts, omega=omega, weight=weight),
        first,
        bounds=([0.0, 0.0, 0.0], [max(edge, 2e-3), np.inf, np.inf]),
        x_scale=scale,
    )
    zero, emf, load = (float(x) for x in found.x)
    return min(zero, edge), emf, load


def _residual(parameters: Array, duty: Array, volts: Array, omega: Array, weight: Array) -> Array:
    zero, emf, load = parameters
    share = np.maximum((duty - zero) * volts, 0.0)
    denominator = np.maximum(emf + np.sqrt(emf**2 + 4.0 * load * share), 1e-12)
    return weight * (2.0 * share / denominator - omega)


def _others(
    law: tuple[Array, Array, Array, Array], rows: NDArray[np.bool_]
) -> tuple[Array, Array, Array, Array]:
    duty, volts, omega, weight = law
    return duty[rows], volts[rows], omega[rows], weight[rows]


def _around(value: float, half: float) -> tuple[float, float]:
    return (float(value - half), float(value + half))
