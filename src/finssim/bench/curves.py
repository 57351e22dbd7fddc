"""Thrust curve, dead zone and speed controller law, fitted to tables."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finssim.bench.solve import Solution, blocks, solve
from finssim.bench.tables import STANDING
from finssim.trials.findings import CalibrationError
from finssim.vehicles import Esc

__all__ = ["DeadZone", "EscFit", "DirectionCurve", "dead_zone", "fit_esc", "fit_side"]

Array = NDArray[np.float64]

BLOCKS = 10
"""Number of parts of equal weight into which a table is divided for intervals."""
PULSE_BLOCKS = 8
"""Number of parts into which the pulses of one direction are divided for intervals."""
OUTLIER = 6.0
"""Scaled median deviations above which a row is excluded, if it also deviates by `COARSE` of the greatest force."""
COARSE = 0.05
LEAST_ROWS = 5
"""Turning rows per direction from which the law of a speed controller is fitted."""


@dataclass(frozen=True, kw_only=True)
class DirectionCurve:
    """Thrust curve of one direction of rotation."""

    c: float
    """Coefficient of T = c ω² [N s²/rad²]."""
    half_width: float
    """Half-width of its 95 % interval [N s²/rad²]; infinite from a single row."""
    r2: float
    """Fraction of the variance of the forces that the curve explains [-]."""
    rmse: float
    """Root mean square of the residual [N]."""
    samples: int
    rejected: int


def fit_side(tables: Sequence[tuple[Array, Array]]) -> DirectionCurve | None:
    """Fit |T| = c ω² (paper, eq. 16) to one direction of rotation by least squares.

    The residuals of real tables are mostly misfit of the curve and correlated between neighbouring rows, so
    the interval is the widest of those from the scatter of blocks of neighbouring speeds, of tables, and of
    the effective number of rows.

    Args:
        tables: Speed |ω| [rad/s] and thrust along this direction [N] of the turning rows, (n,) each, per table.

    Returns:
        The curve; None if there is no row.
    """
    tables = [(w, f) for w, f in tables if len(w)]
    if not tables:
        return None
    rows = [np.lexsort((f, w)) for w, f in tables]
    square = np.concatenate([w[row] ** 2 for (w, _), row in zip(tables, rows, strict=True)])
    force = np.concatenate([f[row] for (_, f), row in zip(tables, rows, strict=True)])
    table = np.concatenate([np.full(len(row), i) for i, row in enumerate(rows)])
    keep = np.ones(len(square), bool)
    for _ in range(5):
        c = float(square[keep] @ force[keep] / (square[keep] @ square[keep]))
        error = np.abs(force - c * square)
        limit = max(OUTLIER * 1.4826 * float(np.median(error)), COARSE * float(np.max(np.abs(force))))
        if np.array_equal(keep, error <= limit):
            break
        keep = error <= limit
    x, f, owner = square[keep], force[keep], table[keep]
    block = np.empty(len(x), dtype=np.int64)
    for i in np.unique(owner):
        block[owner == i] = BLOCKS * len(x) * i + blocks(x[owner == i], BLOCKS, x[owner == i] ** 2)
    found = solve(
        lambda p: f - p[0] * x,
        [c],
        [block, owner],
        breaks=(np.flatnonzero(np.diff(owner)) + 1).tolist(),
        rows_too=True,
        x_scale=[abs(c) or 1.0],
    )
    error, spread = f - found.x[0] * x, f - np.mean(f)
    total = float(spread @ spread)
    return DirectionCurve(
        c=float(found.x[0]),
        half_width=float(found.half[0]),
        r2=1.0 - float(error @ error) / total if total > 0.0 else math.nan,
        rmse=float(np.sqrt(np.mean(error**2))),
        samples=len(x),
        rejected=int(np.count_nonzero(~keep)),
    )


@dataclass(frozen=True, kw_only=True)
class DeadZone:
    """Slowest speed of one direction at which the shaft turns."""

    speed: float
    """Speed, at least 0 [rad/s]."""
    interval: tuple[float, float]
    """95 % interval of the speed [rad/s]."""
    measured: bool
    """True if the table shows a gap; otherwise `speed` is 0 and the interval ends at the slowest speed of the table."""
    note: str = ""


def dead_zone(speed: Array) -> DeadZone | None:
    """Determine the gap between standstill and the slowest turning shaft.

    The gap counts only if the table includes standstill and the gap is more than three times the spacing of
    the speeds above it; otherwise the speeds in between were not tested.

    Args:
        speed: Speeds along one direction [rad/s], near 0 in rows at standstill, (n,).

    Returns:
        The dead zone; None if the shaft never turns.
    """
    fastest = float(np.max(speed, initial=0.0))
    turning = np.sort(speed[speed > STANDING * fastest])
    if fastest <= 0.0 or turning.size < 2:
        return None
    slowest = float(turning[0])
    standing = speed[np.abs(speed) <= STANDING * fastest]
    if standing.size == 0:
        note = "the table holds no standstill: its slowest speed is an upper limit"
        return DeadZone(speed=0.0, interval=(0.0, slowest), measured=False, note=note)
    gap, spacing = slowest - float(np.max(standing)), float(np.median(np.diff(turning[:8])))
    if gap <= 3.0 * spacing:
        note = "speeds between standstill and the slowest were not tried"
        return DeadZone(speed=0.0, interval=(0.0, slowest), measured=False, note=note)
    return DeadZone(speed=slowest, interval=(max(slowest - 2.0 * spacing, 0.0), slowest), measured=True)


@dataclass(frozen=True, kw_only=True)
class EscFit:
    """Fitted speed controller."""

    esc: Esc
    intervals: dict[str, tuple[float, float]]
    """95 % interval of every fitted field of `esc`, in the unit of the field."""
    rmse: float
    """Root mean square error of the speed [rad/s]."""
    fastest: float
    """Greatest speed among the rows [rad/s]."""
    unsure: dict[str, str]
    """Field -> reason why the data do not determine it."""


def fit_esc(
    pulse: Array,
    speed: Array,
    voltage: Array,
    *,
    pulse_range: tuple[float, float, float],
    weight: Array | None = None,
    at: float | None = None,
) -> EscFit:
    """Fit `finssim.vehicles.Esc` by least squares of the shaft speed, each direction separately.

    Args:
        pulse: Pulse widths [µs], (n,).
        speed: Steady shaft speed [rad/s], with the sign of pulse - neutral, 0 at standstill, (n,).
        voltage: Voltage of the battery [V], (n,).
        pulse_range: Full reverse, neutral, full forward [µs].
        weight: Weights of the rows' speeds, (n,); 1 if None.
        at: Voltage to which the dead band refers [V]; the mean if None.

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
        law = _law(
            throw[turning] / span, voltage[side][turning], omega[turning], weight[side][turning], edge / span
        )
        zero, emf, load = (float(x) for x in law.x)
        numbers |= {f"dead_{name}": neutral + sign * edge, f"zero_{name}": neutral + sign * span * zero}
        numbers |= {f"emf_{name}": emf, f"load_{name}": load}
        ends = sorted(neutral + sign * x for x in edge_interval)
        intervals[f"dead_{name}"] = (ends[0], ends[1])
        for key, value, width, ceiling in (
            ("zero", zero, span * law.half[0], edge / span),
            ("emf", emf, law.half[1], np.inf),
            ("load", load, law.half[2], np.inf),
        ):
            centre = numbers[f"{key}_{name}"]
            intervals[f"{key}_{name}"] = (float(centre - width), float(centre + width))
            if value <= 1e-9 or value >= ceiling * (1.0 - 1e-9):
                unsure[f"{key}_{name}"] = "rests on a bound of the law"
    esc = Esc(pulse_neutral=neutral, pulse_min=low, pulse_max=high, voltage=volts, **numbers)
    predicted = esc.shaft_speed(pulse, voltage)
    both = (speed != 0.0) & (predicted != 0.0)
    return EscFit(
        esc=esc,
        intervals=intervals,
        rmse=float(np.sqrt(np.mean((predicted - speed)[both] ** 2))),
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
    """Return the pulse from neutral at which the shaft starts [µs], its interval, and the reason if it is not
    known."""
    first = float(np.min(throw[turning & near]))
    standing = throw[~turning & near & (throw < first)]
    if standing.size == 0:
        return first, (0.0, first), "the table holds no pulse that leaves the shaft standing"
    last = float(np.max(standing))
    return 0.5 * (last + first), (last, first), ""


def _law(duty: Array, volts: Array, omega: Array, weight: Array, edge: float) -> Solution:
    """Fit zero, emf and load of (duty - zero) V = emf ω + load ω² with 0 <= zero <= edge, to the speed."""
    from scipy.optimize import nnls

    order = np.argsort(duty, kind="stable")
    duty, volts, omega, weight = (column[order] for column in (duty, volts, omega, weight))
    # The balance of voltages is linear in the parameters, which gives the first guess.
    rows = np.column_stack([omega, omega**2, volts])
    first, _ = nnls(rows, duty * volts)
    top = max(edge, 1e-3)
    scale = np.array([top, float(np.median(volts / omega)), float(np.median(volts / omega**2))])
    start = np.clip([min(first[2], 0.9 * edge), first[0], first[1]], 1e-3 * scale, [top, np.inf, np.inf])

    def residual(x: Array) -> Array:
        zero, emf, load = x
        share = np.maximum((duty - zero) * volts, 0.0)
        root = np.sqrt(emf**2 + 4.0 * load * share)
        return np.asarray(weight * (2.0 * share / np.maximum(emf + root, 1e-12) - omega))

    law = solve(
        residual,
        start,
        [blocks(duty, PULSE_BLOCKS)],
        refit=True,
        bounds=([0.0, 0.0, 0.0], [max(edge, 2e-3), np.inf, np.inf]),
        x_scale=scale,
    )
    return Solution(np.minimum(law.x, [edge, np.inf, np.inf]), law.half)
