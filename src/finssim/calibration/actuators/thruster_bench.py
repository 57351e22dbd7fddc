"""What the tables of one thruster or group say: curve, dead zone, fastest speeds, speed controller, role of voltage."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.actuators.table_signs import STANDING
from finssim.calibration.actuators.thrust_curve import (
    DeadZone,
    Side,
    dead_zone,
    fit_side,
    jackknife,
    t_quantile,
)
from finssim.calibration.actuators.thrust_table import ThrustTable
from finssim.calibration.errors import CalibrationError
from finssim.vehicles import Esc
from finssim.vehicles.thruster import Thruster

__all__ = ["SIDES", "Bench", "bench", "fit_esc"]

# The law between pulse width, battery voltage and shaft speed, fitted to tables.

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


Array = NDArray[np.float64]

SIDES = (("plus", 1.0), ("minus", -1.0))
"""Name and sign of the two directions of rotation."""

SAME_VOLTAGE = 0.75
"""Voltages nearer than this are one level [V]; a battery's sag within a run is not another level."""
PULSE_RANGE = (1100.0, 1500.0, 1900.0)
"""Reverse, neutral and forward of hobby speed controllers [µs], where the vehicle file does not say."""


@dataclass(frozen=True, kw_only=True)
class Bench:
    """Findings from the tables of one target."""

    levels: tuple[tuple[float, ThrustTable], ...]
    """Tables by voltage [V], NaN where it is not known."""
    voltage: float
    """At which the numbers hold [V]; NaN where it is not known."""
    fitted: tuple[ThrustTable, ...]
    """The tables that were fitted; the others only check the prediction."""
    sides: dict[str, Side]
    """By `plus` and `minus`."""
    dead: dict[str, DeadZone]
    fastest: dict[str, tuple[float, bool, float]]
    """Fastest speed at the voltage [rad/s, > 0], whether the pulse was at its end there, and the distance to the row
    that is next in speed [rad/s]."""
    esc: EscFit | None
    speeds_measured: bool
    """Whether there are speeds; otherwise they follow from the forces by the vehicle file's curve."""
    warnings: tuple[str, ...]


def bench(
    tables: Sequence[ThrustTable],
    thruster: Thruster,
    shown: str,
    *,
    voltage: float | None,
    pool_voltages: bool,
) -> Bench:
    """Analyse tables of one thruster or of several alike.

    Args:
        tables: At least one.
        thruster: As the vehicle file has it.
        shown: How messages call the target.
        voltage: At which the numbers shall hold [V]; where not given, the only one of the tables, else that of the
            vehicle file's ESC, else the middle one.
        pool_voltages: Fit the speed controller to all voltages together, rather than to this one alone.

    Raises:
        CalibrationError: The tables hold no such voltage, or nothing to fit.
    """
    warnings: list[str] = []
    measured = any(np.isfinite(table.speed).any() for table in tables)
    if measured:
        tables = [table for table in tables if np.isfinite(table.speed).any()]
    else:
        tables = [_with_speeds(table, thruster) for table in tables]
        warnings.append(
            f"{shown}: the tables hold no shaft speeds: those of the vehicle file's curve were used, c± stay"
        )
    levels = [level for table in tables for level in split_by_voltage(table)]
    chosen = _reference([volts for volts, _ in levels], thruster, shown, voltage)
    at = [table for volts, table in levels if not abs(volts - chosen) > SAME_VOLTAGE]
    trend = _trend(levels, shown) if measured else ""
    others = sorted({round(volts, 1) for volts, table in levels if not any(table is t for t in at)})
    pooled = pool_voltages or not trend
    fitted = [table for _, table in levels] if pooled else at
    if trend:
        warnings.append(trend + ("" if pooled else f"; the curve is that of {chosen:g} V"))
    elif others and measured:
        warnings.append(
            f"{shown}: c± do not depend on the voltage as far as the tables tell; all voltages were used"
        )
    sides, dead, fastest = {}, {}, {}
    for name, sign in SIDES:
        side = fit_side([turning(table, sign) for table in fitted]) if measured else None
        if side is not None:
            sides[name] = side
        zones = [zone for zone in (dead_zone(sign * table.speed) for table in at) if zone is not None]
        if zones and measured:
            dead[name] = _together(zones)
        speeds = [_fastest(table, sign, _pulse_range(thruster, tables)) for table in at]
        fastest[name] = max(speeds, default=(0.0, False, 0.0))
    esc = None
    if any(np.isfinite(table.pulse).any() for table in tables):
        on = [table for _, table in levels] if pool_voltages else at
        esc = _esc(on, thruster, tables, shown, chosen, measured, warnings)
    if not sides and esc is None:
        said = "; ".join(warnings) or f"{shown}: no row turns the shaft"
        raise CalibrationError(f"{said}: nothing could be fitted")
    warnings += [f"{table.name}: {note}" for table in tables for note in table.notes]
    return Bench(
        levels=tuple(levels),
        voltage=chosen,
        fitted=tuple(fitted),
        sides=sides,
        dead=dead,
        fastest=fastest,
        esc=esc,
        speeds_measured=measured,
        warnings=tuple(dict.fromkeys(warnings)),
    )


def turning(table: ThrustTable, sign: float) -> tuple[Array, Array]:
    """Speed and thrust along one direction of the rows in which the shaft turns that way."""
    speed = sign * table.speed
    rows = speed > STANDING * float(np.max(np.abs(table.speed)))
    return speed[rows], sign * table.force[rows]


def split_by_voltage(table: ThrustTable) -> list[tuple[float, ThrustTable]]:
    """The rows of every voltage level with its mean; (NaN, table) where no voltage is known."""
    known = np.isfinite(table.voltage)
    if not known.any():
        return [(math.nan, table)]
    values = np.sort(table.voltage[known])
    cuts = values[:-1][np.diff(values) > SAME_VOLTAGE] + 0.5 * SAME_VOLTAGE
    label = np.searchsorted(cuts, table.voltage)
    parts = [table.at(known & (label == i)) for i in range(len(cuts) + 1)]
    return [(float(np.mean(part.voltage)), part) for part in parts]


def _reference(volts: Sequence[float], thruster: Thruster, shown: str, asked: float | None) -> float:
    known = sorted(v for v in volts if not math.isnan(v))
    if not known:
        return math.nan if asked is None else asked
    if asked is None:
        wanted = thruster.esc.voltage if thruster.esc else math.nan
        near = [v for v in known if abs(v - wanted) <= SAME_VOLTAGE]
        return near[0] if near else known[len(known) // 2]
    near = [v for v in known if abs(v - asked) <= SAME_VOLTAGE]
    if not near:
        listed = ", ".join(f"{v:g}" for v in dict.fromkeys(round(v, 2) for v in known))
        raise CalibrationError(f"{shown}: no table at {asked:g} V; there are {listed} V")
    return min(near, key=lambda v: abs(v - asked))


def _trend(levels: Sequence[tuple[float, ThrustTable]], shown: str) -> str:
    """A sentence if c± change with the voltage beyond chance and by more than 2 % over the tables, else ""."""
    found = []
    for name, sign in SIDES:
        pairs = [
            (volts, fit_side([turning(table, sign)])) for volts, table in levels if not math.isnan(volts)
        ]
        points = np.array([(volts, side.c) for volts, side in pairs if side is not None])
        if len(points) < 3 or np.ptp(points[:, 0]) < 2.0 * SAME_VOLTAGE:
            continue
        V = points[:, 0] - np.mean(points[:, 0])
        slope = float(V @ points[:, 1] / (V @ V))
        mean = float(np.mean(points[:, 1]))
        residual = points[:, 1] - mean - slope * V
        error = math.sqrt(float(residual @ residual) / (len(V) - 2) / float(V @ V))
        if abs(slope) > t_quantile(len(V) - 2) * error and abs(slope) * np.ptp(V) > 0.02 * mean:
            found.append(f"c_{name} changes by {100.0 * slope / mean:+.2g} % per volt")
    return f"{shown}: {' and '.join(found)} over the tables' voltages" if found else ""


def _together(zones: Sequence[DeadZone]) -> DeadZone:
    """One dead zone from those of several tables: their median, over all of their intervals."""
    known = [zone for zone in zones if zone.known]
    chosen = known or list(zones)
    ends = [end for zone in chosen for end in zone.interval]
    middle = float(np.median([zone.speed for zone in chosen]))
    return DeadZone(speed=middle, interval=(min(ends), max(ends)), known=bool(known), note=chosen[0].note)


def _pulse_range(thruster: Thruster, tables: Sequence[ThrustTable]) -> tuple[float, float, float]:
    """Reverse, neutral and forward [µs], wide enough for every pulse of the tables."""
    low, neutral, high = PULSE_RANGE
    if thruster.esc is not None:
        low, neutral, high = thruster.esc.pulse_min, thruster.esc.pulse_neutral, thruster.esc.pulse_max
    pulses = np.concatenate([table.pulse[np.isfinite(table.pulse) & (table.pulse > 0.0)] for table in tables])
    if pulses.size == 0:
        return low, neutral, high
    return min(low, float(pulses.min())), neutral, max(high, float(pulses.max()))


def _fastest(
    table: ThrustTable, sign: float, pulse_range: tuple[float, float, float]
) -> tuple[float, bool, float]:
    """Fastest steady speed along a direction, whether the pulse was at its end, and the distance to the next speed."""
    speeds = np.sort(np.maximum(sign * table.speed, 0.0))
    best, gap = float(speeds[-1]), float(speeds[-1] - speeds[-2])
    low, neutral, high = pulse_range
    end = (high - neutral) if sign > 0.0 else (neutral - low)
    throws = sign * (table.pulse - neutral)
    return best, bool(np.isfinite(throws).any() and np.nanmax(throws) >= 0.98 * end), gap


def _with_speeds(table: ThrustTable, thruster: Thruster) -> ThrustTable:
    """The same with the speeds that the vehicle file's curve gives to the forces."""
    force = np.where(np.abs(table.force) <= STANDING * np.max(np.abs(table.force)), 0.0, table.force)
    return replace(table, speed=thruster.speed(force))


def _esc(
    on: Sequence[ThrustTable],
    thruster: Thruster,
    tables: Sequence[ThrustTable],
    shown: str,
    volts: float,
    measured: bool,
    warnings: list[str],
) -> EscFit | None:
    """The speed controller, or None and a warning that says why not."""
    pulse, speed, voltage = (
        np.concatenate([getattr(t, key) for t in on]) for key in ("pulse", "speed", "voltage")
    )
    if math.isnan(volts):
        warnings.append(
            f"{shown}: the tables give no voltage, so the pulse's law was not fitted: say voltage="
        )
        return None
    voltage = np.where(np.isfinite(voltage), voltage, volts)
    good = np.isfinite(pulse) & np.isfinite(speed) & (pulse > 0.0)
    # Speeds that follow from forces are the surer the faster: dω = dT / (2 c ω).
    weight = None if measured else np.abs(speed[good]) / np.max(np.abs(speed[good]))
    try:
        return fit_esc(
            pulse[good],
            speed[good],
            voltage[good],
            pulse_range=_pulse_range(thruster, tables),
            weight=weight,
            at=volts,
        )
    except CalibrationError as error:
        warnings.append(f"{shown}: the pulse's law was not fitted: {error}")
        return None
