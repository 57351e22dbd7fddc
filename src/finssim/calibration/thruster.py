"""From tables of a bench to the thrust curve, dead zone, limits and speed controller of a vehicle's thrusters."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.findings import CalibrationError, Finding, finding, sentences
from finssim.calibration.fit import Curve, Estimate, Fit
from finssim.calibration.report import finish, refuse_places
from finssim.calibration.thrust_table import QUANTITIES, STANDING, ThrustTable, read_table, tables_of_trial
from finssim.calibration.trials.trial import Trial
from finssim.calibration.trials.trial_files import load_trial
from finssim.calibration.uncertainty import Evidence, correlated_samples, intervals, trial_covariance
from finssim.vehicles import Esc, Vehicle, load_vehicle
from finssim.vehicles.thruster import Thruster

__all__ = ["dead_zone", "fit_esc", "fit_side", "fit_thruster", "jackknife"]


Array = NDArray[np.float64]

BLOCKS = 10
"""Parts of equal weight that a table is cut into for intervals."""
OUTLIER = 6.0
"""Scaled median deviations beyond which a row is left out, if it is also off by `COARSE` of the largest force."""
COARSE = 0.05


@dataclass(frozen=True, kw_only=True)
class Side:
    """c of one direction of rotation."""

    c: float
    """T = c ω², [N s²/rad²]."""
    half_width: float
    """Of the 95 % interval; infinite from a single row."""
    r2: float
    """Share of the variance of the forces of this direction that the curve explains."""
    rmse: float
    """[N]"""
    samples: int
    rejected: int


def fit_side(tables: Sequence[tuple[Array, Array]]) -> Side | None:
    """Least squares of |T| = c ω² (paper, eq. 16) over one direction of rotation.

    The residuals of real tables are not noise but the curve's own misfit, alike in neighbouring rows. The interval is
    the widest of three (`finssim.calibration.uncertainty`): from the disagreement of blocks of neighbouring speeds,
    from that of several tables, and from the rows that count as independent.

    Args:
        tables: Speed |ω| [rad/s] and thrust along this direction [N] of the turning rows, (n,) each, per table.

    Returns:
        None where there is no row.
    """
    tables = [(w, f) for w, f in tables if len(w)]
    if not tables:
        return None
    square, force = np.concatenate([w**2 for w, _ in tables]), np.concatenate([f for _, f in tables])
    keep = np.ones(len(square), bool)
    for _ in range(5):
        c = _slope(square[keep], force[keep])
        error = np.abs(force - c * square)
        limit = max(OUTLIER * 1.4826 * float(np.median(error)), COARSE * float(np.max(np.abs(force))))
        if np.array_equal(keep, error <= limit):
            break
        keep = error <= limit
    owner = np.concatenate([np.full(len(w), i) for i, (w, _) in enumerate(tables)])
    rows = [keep & (owner == i) for i in range(len(tables))]
    half_width = _half_width([(square[row], force[row] - c * square[row]) for row in rows if row.any()])
    error = force[keep] - c * square[keep]
    total = float(np.sum((force[keep] - np.mean(force[keep])) ** 2))
    return Side(
        c=c,
        half_width=float(half_width),
        r2=1.0 - float(error @ error) / total if total > 0.0 else float("nan"),
        rmse=float(np.sqrt(np.mean(error**2))),
        samples=int(np.count_nonzero(keep)),
        rejected=int(np.count_nonzero(~keep)),
    )


def jackknife(estimates: Array) -> Array:
    """Half-widths of 95 % intervals from estimates that each leave one of G blocks out, (G, P) -> (P,)."""
    G = len(estimates)
    deviation = estimates - np.mean(estimates, axis=0)
    return t_quantile(G - 1) * np.sqrt((G - 1) / G * np.sum(deviation**2, axis=0))


def t_quantile(dof: int) -> float:
    """97.5 % point of Student's t."""
    from scipy.stats import t  # SciPy is slow to import

    return float(t.ppf(0.975, dof))


def _slope(square: Array, force: Array) -> float:
    return float(square @ force / (square @ square))


def _blocks(square: Array, force: Array) -> list[tuple[Array, Array]]:
    """Neighbouring speeds in at most `BLOCKS` parts of about equal Σ ω⁴; of a short table every row."""
    if square.size == 0:
        return []
    order = np.argsort(square)
    square, force = square[order], force[order]
    if len(square) < 2 * BLOCKS:
        return [(square[i : i + 1], force[i : i + 1]) for i in range(len(square))]
    share = (np.cumsum(square**2) - 0.5 * square**2) / np.sum(square**2)
    label = np.minimum(share * BLOCKS, BLOCKS - 1).astype(int)
    return [(square[label == i], force[label == i]) for i in np.unique(label)]


def _half_width(tables: Sequence[tuple[Array, Array]]) -> float:
    """Of the 95 % interval of c, from ω² and residuals of each table; infinite for a single row."""
    ordered = [(x[np.argsort(x)], error[np.argsort(x)]) for x, error in tables]
    errors = [error for _, error in ordered]
    rows = sum(map(len, errors))
    if rows < 2:
        return math.inf
    breaks = np.cumsum([len(error) for error in errors])[:-1].tolist()
    correlated = correlated_samples(np.concatenate(errors), breaks)
    least = 1e-26 * float(sum(x @ x for x, _ in ordered)) / rows  # of an exact curve
    variance = float(sum(error @ error for error in errors)) / (rows - 1) * correlated + least
    widths = []
    for groups in ([part for table in ordered for part in _blocks(*table)], ordered):
        evidence = Evidence(
            names=("c",),
            normal=np.array([[[x @ x / variance]] for x, _ in groups]),
            score=np.array([[x @ error / variance] for x, error in groups]),
            unit="blocks",
        )
        covariance = trial_covariance(evidence)
        widths.append(float(intervals(np.zeros(1), covariance)[0, 1]))
    independent = t_quantile(max(int(rows / correlated) - 1, 1)) * math.sqrt(float(covariance.local[0, 0]))
    return max(*widths, independent)


@dataclass(frozen=True, kw_only=True)
class DeadZone:
    """The slowest speed of one direction that turns the shaft [rad/s, >= 0]."""

    speed: float
    interval: tuple[float, float]
    measured: bool
    """Whether the table shows a gap; otherwise `speed` is 0 and the interval ends at the slowest speed seen."""
    note: str = ""


def dead_zone(speed: Array) -> DeadZone | None:
    """The gap between standstill and the slowest turning shaft.

    It shows only where the table goes down to standstill and the gap is more than three times the distance between the
    speeds above it; otherwise the speeds in between were not tried.

    Args:
        speed: Along one direction [rad/s]; standing rows near 0, (n,).

    Returns:
        None where nothing turns.
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


# The law between pulse width, battery voltage and shaft speed, fitted to tables.

PULSE_BLOCKS = 8
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
        label = np.argsort(np.argsort(law[0], kind="stable")) * PULSE_BLOCKS // len(law[0])
        jackknifed = [
            _law(*(column[label != i] for column in law), edge / span)
            for i in range(PULSE_BLOCKS)
            if np.any(label == i)
        ]
        half = jackknife(np.array(jackknifed))
        numbers |= {f"dead_{name}": neutral + sign * edge, f"zero_{name}": neutral + sign * span * zero}
        numbers |= {f"emf_{name}": emf, f"load_{name}": load}
        ends = sorted(neutral + sign * x for x in edge_interval)
        intervals[f"dead_{name}"] = (ends[0], ends[1])
        for key, value, width, ceiling in (
            ("zero", zero, span * half[0], edge / span),
            ("emf", emf, half[1], np.inf),
            ("load", load, half[2], np.inf),
        ):
            intervals[f"{key}_{name}"] = _around(numbers[f"{key}_{name}"], width)
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
    solution = least_squares(
        partial(_residual, duty=duty, volts=volts, omega=omega, weight=weight),
        first,
        bounds=([0.0, 0.0, 0.0], [max(edge, 2e-3), np.inf, np.inf]),
        x_scale=scale,
    )
    zero, emf, load = (float(x) for x in solution.x)
    return min(zero, edge), emf, load


def _residual(parameters: Array, duty: Array, volts: Array, omega: Array, weight: Array) -> Array:
    zero, emf, load = parameters
    share = np.maximum((duty - zero) * volts, 0.0)
    denominator = np.maximum(emf + np.sqrt(emf**2 + 4.0 * load * share), 1e-12)
    return weight * (2.0 * share / denominator - omega)


def _around(value: float, half: float) -> tuple[float, float]:
    return (float(value - half), float(value + half))


SIDES = (("plus", 1.0), ("minus", -1.0))
"""Name and sign of the two directions of rotation."""

SAME_VOLTAGE = 0.75
"""Voltages nearer than this are one level [V]; a battery's sag within a run is not another level."""
PULSE_RANGE = (1100.0, 1500.0, 1900.0)
"""Reverse, neutral and forward of hobby speed controllers [µs], where the vehicle file does not say."""


@dataclass(frozen=True, kw_only=True)
class Bench:
    """What the tables of one target say."""

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
    findings: tuple[Finding, ...]


def bench(
    tables: Sequence[ThrustTable],
    thruster: Thruster,
    label: str,
    *,
    voltage: float | None,
    pool_voltages: bool,
) -> Bench:
    """Analyse tables of one thruster or of several alike.

    Args:
        tables: At least one.
        thruster: As the vehicle file has it.
        label: How messages call the target.
        voltage: At which the numbers shall hold [V]; where not given, the only one of the tables, else that of the
            vehicle file's ESC, else the middle one.
        pool_voltages: Fit all voltages together, rather than this one alone.

    Raises:
        CalibrationError: The tables hold no such voltage, or nothing to fit.
    """
    findings: list[Finding] = []
    measured = any(np.isfinite(table.speed).any() for table in tables)
    if measured:
        tables = [table for table in tables if np.isfinite(table.speed).any()]
    else:
        tables = [_with_speeds(table, thruster) for table in tables]
        findings.append(finding("no_shaft_speeds", label))
    levels = [level for table in tables for level in split_by_voltage(table)]
    chosen = _reference([volts for volts, _ in levels], thruster, label, voltage)
    at = [table for volts, table in levels if not abs(volts - chosen) > SAME_VOLTAGE]
    others = sorted({round(volts, 1) for volts, table in levels if not any(table is t for t in at)})
    fitted = [table for _, table in levels] if pool_voltages else at
    if others and not pool_voltages:
        findings.append(
            finding("voltage_chosen", label, voltage=chosen, others=tuple(f"{v:g}" for v in others))
        )
    sides, dead, fastest = {}, {}, {}
    for name, sign in SIDES:
        side = fit_side([turning(table, sign) for table in fitted]) if measured else None
        if side is not None:
            sides[name] = side
        zones = [zone for zone in (dead_zone(sign * table.speed) for table in at) if zone is not None]
        if zones and measured:
            dead[name] = _joint_dead_zone(zones)
        speeds = [_fastest(table, sign, _pulse_range(thruster, tables)) for table in at]
        fastest[name] = max(speeds, default=(0.0, False, 0.0))
    esc = None
    if any(np.isfinite(table.pulse).any() for table in tables):
        esc = _esc(fitted, thruster, tables, label, chosen, measured, findings)
    if not sides and esc is None:
        reasons = "; ".join(sentences(findings)) or f"{label}: no row turns the shaft"
        raise CalibrationError(f"{reasons}: nothing could be fitted")
    findings += [item.about(table.name) for table in tables for item in table.findings]
    return Bench(
        levels=tuple(levels),
        voltage=chosen,
        fitted=tuple(fitted),
        sides=sides,
        dead=dead,
        fastest=fastest,
        esc=esc,
        speeds_measured=measured,
        findings=tuple(dict.fromkeys(findings)),
    )


def turning(table: ThrustTable, sign: float) -> tuple[Array, Array]:
    """Speed and thrust along one direction of the rows in which the shaft turns that way."""
    speed = sign * table.speed
    rows = speed > STANDING * float(np.max(np.abs(table.speed)))
    return speed[rows], sign * table.force[rows]


def split_by_voltage(table: ThrustTable) -> list[tuple[float, ThrustTable]]:
    """The rows of every voltage level with its mean; (NaN, table) where no voltage is known."""
    valid = np.isfinite(table.voltage)
    if not valid.any():
        return [(math.nan, table)]
    values = np.sort(table.voltage[valid])
    cuts = values[:-1][np.diff(values) > SAME_VOLTAGE] + 0.5 * SAME_VOLTAGE
    label = np.searchsorted(cuts, table.voltage)
    parts = [table.at(valid & (label == i)) for i in range(len(cuts) + 1)]
    return [(float(np.mean(part.voltage)), part) for part in parts]


def _reference(volts: Sequence[float], thruster: Thruster, label: str, requested: float | None) -> float:
    available = sorted(v for v in volts if not math.isnan(v))
    if not available:
        return math.nan if requested is None else requested
    if requested is None:
        preferred = thruster.esc.voltage if thruster.esc else math.nan
        near = [v for v in available if abs(v - preferred) <= SAME_VOLTAGE]
        return near[0] if near else available[len(available) // 2]
    near = [v for v in available if abs(v - requested) <= SAME_VOLTAGE]
    if not near:
        listed = ", ".join(f"{v:g}" for v in dict.fromkeys(round(v, 2) for v in available))
        raise CalibrationError(f"{label}: no table at {requested:g} V; there are {listed} V")
    return min(near, key=lambda v: abs(v - requested))


def _joint_dead_zone(zones: Sequence[DeadZone]) -> DeadZone:
    """One dead zone from those of several tables: their median, over all of their intervals."""
    measured = [zone for zone in zones if zone.measured]
    chosen = measured or list(zones)
    ends = [end for zone in chosen for end in zone.interval]
    middle = float(np.median([zone.speed for zone in chosen]))
    return DeadZone(
        speed=middle, interval=(min(ends), max(ends)), measured=bool(measured), note=chosen[0].note
    )


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
    label: str,
    volts: float,
    measured: bool,
    findings: list[Finding],
) -> EscFit | None:
    """The speed controller, or None and a finding that says why not."""
    pulse, speed, voltage = (
        np.concatenate([getattr(t, key) for t in on]) for key in ("pulse", "speed", "voltage")
    )
    if math.isnan(volts):
        findings.append(finding("law_without_voltage", label))
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
        findings.append(finding("law_refused", label, reason=str(error)))
        return None


# Which tables speak about which thrusters of a vehicle.


class Target(NamedTuple):
    """Thrusters that get the same numbers."""

    name: str
    """Of the propeller group or the thruster, or `all`."""
    thrusters: tuple[str, ...]
    tables: tuple[ThrustTable, ...]


def find_targets(
    tables: Sequence[ThrustTable], vehicle: Vehicle, group: str | None
) -> tuple[list[Target], list[Finding]]:
    """Targets with their tables, and findings.

    A group that the caller names comes first. Otherwise a table speaks about the thruster that its columns name; or
    about the thruster or group whose name is a word of its file's name (`H_LF.csv`, `run2-CCW.csv`); or about all.

    Raises:
        CalibrationError: Unknown names.
    """
    groups = {thruster.group for thruster in vehicle.thrusters.values()} - {""}
    if group is not None:
        if group not in groups:
            raise CalibrationError(
                f"{vehicle.name} has no propeller group '{group}': it has {', '.join(sorted(groups)) or 'none'}"
            )
        return [Target(group, _members(vehicle, group), tuple(tables))], []
    by_name: dict[str, list[ThrustTable]] = {}
    for table in tables:
        by_name.setdefault(_spoken_of(table, vehicle, groups), []).append(table)
    if "" in by_name and len(by_name) > 1:
        names = ", ".join(table.name for table in by_name[""])
        raise CalibrationError(
            f"{names}: no thruster or group of {vehicle.name} is named, but other tables name theirs: put the name "
            "into the file's name, or fit these by themselves"
        )
    if "" in by_name:
        unnamed = []
        if len(groups) > 1:
            unnamed.append(finding("groups_unnamed", vehicle=vehicle.name, groups=tuple(sorted(groups))))
        name = groups.pop() if len(groups) == 1 else "all"
        return [Target(name, vehicle.thruster_names, tuple(tables))], unnamed
    return [
        Target(name, _members(vehicle, name) if name in groups else (name,), tuple(of_name))
        for name, of_name in by_name.items()
    ], []


def _members(vehicle: Vehicle, group: str) -> tuple[str, ...]:
    return tuple(name for name, thruster in vehicle.thrusters.items() if thruster.group == group)


def _spoken_of(table: ThrustTable, vehicle: Vehicle, groups: set[str]) -> str:
    """Name of the thruster or group that a table names, or ""."""
    if table.thruster is not None and table.thruster in vehicle.thrusters:
        return table.thruster
    if table.thruster is not None and len(vehicle.thrusters) > 1:
        raise CalibrationError(
            f"{table.name}: {vehicle.name} has no thruster '{table.thruster}': its thrusters are "
            f"{', '.join(vehicle.thrusters)}: rename the columns"
        )
    for candidates in (list(vehicle.thrusters), sorted(groups)):
        mentioned = [
            name
            for name in candidates
            if re.search(rf"(?<![A-Za-z0-9]){re.escape(name)}(?![A-Za-z0-9])", table.name)
        ]
        if mentioned:
            return max(mentioned, key=len)
    return ""


# How well a thruster's curve and speed controller describe the tables, also those they were not fitted to.


def predicted_thrust(result: Bench, before: Thruster, speed: Array) -> Array:
    """T = c± ω|ω| with the fitted c±, those of the vehicle file where there is none [N], (n,).

    Args:
        result: The fit.
        before: The thruster of the vehicle file.
        speed: Of the shaft, positive for positive thrust [rad/s], (n,).
    """
    c = {
        name: result.sides[name].c if name in result.sides else getattr(before, f"c_{name}")
        for name, _ in SIDES
    }
    return np.where(speed >= 0.0, c["plus"], c["minus"]) * speed * np.abs(speed)


def quality_of(name: str, result: Bench, before: Thruster) -> dict[str, dict[str, float]]:
    """Figures of the fitted tables, and `NAME at V V` for every voltage when there are several.

    `rmse` are in N or rad/s, `nrmse` are rmse over the largest magnitude in the rows compared.
    """
    rows = _stack(result.fitted)
    figures: dict[str, float] = {}
    if result.speeds_measured:
        error = predicted_thrust(result, before, rows.speed) - rows.force
        turning = rows.speed != 0.0
        figures |= {"r2": _r2(rows.force[turning], error[turning]), "rmse": _rms(error[turning])}
        figures["samples"] = float(np.count_nonzero(turning))
        figures["rejected"] = float(sum(side.rejected for side in result.sides.values()))
        for side, word in (("plus", "forward"), ("minus", "reverse")):
            if side in result.sides:
                figures[f"r2_{word}"] = result.sides[side].r2
    if result.esc is not None:
        figures["esc_rmse"] = result.esc.rmse
        figures["esc_nrmse"] = result.esc.rmse / result.esc.fastest
    figures_by_name = {name: figures}
    volts = sorted({round(v, 1) for v, _ in result.levels if not math.isnan(v)})
    for volt in volts if len(volts) > 1 else []:
        level = _stack([table for v, table in result.levels if round(v, 1) == volt])
        figures_by_name[f"{name} at {volt:g} V"] = _at_voltage(result, before, level)
    return figures_by_name


def _at_voltage(result: Bench, before: Thruster, table: ThrustTable) -> dict[str, float]:
    """Errors of the thrust told from the speed, and of speed and thrust told from pulse and voltage."""
    figures: dict[str, float] = {}
    largest = float(np.max(np.abs(table.force)))
    if result.speeds_measured:
        error = predicted_thrust(result, before, table.speed) - table.force
        turning = np.abs(table.speed) > STANDING * np.max(np.abs(table.speed))
        figures |= {
            "r2_thrust_from_speed": _r2(table.force[turning], error[turning]),
            "rmse_thrust_from_speed": _rms(error[turning]),
            "nrmse_thrust_from_speed": _rms(error[turning]) / largest,
        }
    if result.esc is not None:
        speed = result.esc.esc.shaft_speed(table.pulse, table.voltage)
        error = predicted_thrust(result, before, speed) - table.force
        figures |= {"rmse_thrust_from_pulse": _rms(error), "nrmse_thrust_from_pulse": _rms(error) / largest}
        if result.speeds_measured:
            error = speed - table.speed
            fastest = float(np.max(np.abs(table.speed)))
            figures |= {"rmse_speed_from_pulse": _rms(error), "nrmse_speed_from_pulse": _rms(error) / fastest}
    return figures


def curves_of(name: str, result: Bench, before: Thruster) -> list[Curve]:
    """For the report: thrust against speed; speed and thrust against pulse at every voltage."""
    rows = _stack(result.fitted)
    order = np.argsort(rows.speed)
    rpm = rows.speed[order] * TO_RPM
    fitted = predicted_thrust(result, before, rows.speed[order])
    curves = list[Curve]()

    def add(title: str, x_label: str, y_label: str, x: Array, measured: Array, fitted: Array) -> None:
        labels = {"title": f"{name}: {title}", "x_label": x_label, "y_label": y_label, "kind": "scatter"}
        curves.append(Curve(x=x, measured=measured, fitted=fitted, **labels))

    if result.speeds_measured:
        add("thrust", "shaft speed [rpm]", "thrust [N]", rpm, rows.force[order], fitted)
    if result.esc is None:
        return curves
    for volt in sorted({round(v, 1) for v, _ in result.levels if not math.isnan(v)}) or [math.nan]:
        level = _stack([table for v, table in result.levels if math.isnan(volt) or round(v, 1) == volt])
        order = np.argsort(level.pulse)
        pulse, label = level.pulse[order], "" if math.isnan(volt) else f" at {volt:g} V"
        speed = result.esc.esc.shaft_speed(pulse, level.voltage[order] if label else None)
        thrust = predicted_thrust(result, before, speed)
        if result.speeds_measured:
            measured, axes = level.speed[order] * TO_RPM, ("pulse [µs]", "shaft speed [rpm]")
            add(f"speed from pulse{label}", *axes, pulse, measured, speed * TO_RPM)
        add(f"thrust from pulse{label}", "pulse [µs]", "thrust [N]", pulse, level.force[order], thrust)
    return curves


def _stack(tables: list[ThrustTable] | tuple[ThrustTable, ...]) -> ThrustTable:
    """All rows of several tables as one."""
    columns: dict[str, Any] = {
        key: np.concatenate([getattr(table, key) for table in tables]) for key in QUANTITIES
    }
    return ThrustTable(name=tables[0].name, **columns)


def _rms(error: Array) -> float:
    good = error[np.isfinite(error)]
    return float(np.sqrt(np.mean(good**2))) if good.size else math.nan


def _r2(measured: Array, error: Array) -> float:
    total = float(np.sum((measured - np.mean(measured)) ** 2))
    return 1.0 - float(error @ error) / total if total > 0.0 else math.nan


# The numbers that a bench gives a vehicle file, with their intervals and what they rest on.

TO_RPM = 30.0 / math.pi
CHOSEN_LIMIT = 0.02
"""A force limit this far below the curve at the speed limit was chosen, not measured: it stays."""


def estimates_of(target: Target, result: Bench, vehicle: Vehicle) -> list[Estimate]:
    """Everything found about a target, named `TARGET.c_plus` and so on.

    A speed limit moves where the table reached the end of the pulse, or went beyond the limit of the vehicle file. The
    force limit is the curve at the speed limit, unless the vehicle file chose a lower one.
    """
    before, rows = vehicle.thrusters[target.thrusters[0]], list[Estimate]()
    volts = f"{result.voltage:g} V" if math.isfinite(result.voltage) else ""

    def add(key: str, value: float, ends: tuple[float, float], unit: str, sure: bool, note: str = "") -> None:
        rows.append(
            Estimate(
                name=f"{target.name}.{key}", estimate=float(value), ci95=ends, unit=unit, identifiable=sure, note=note,
                path=None if key == "reverse_ratio" else _path(target, key),
            )
        )  # fmt: skip

    for name, sign in SIDES:
        side, zone = result.sides.get(name), result.dead.get(name)
        if side is None:
            continue
        sure = math.isfinite(side.half_width) and side.c > side.half_width
        note = f"{side.samples} rows, R² {side.r2:.4f}, rms {side.rmse:.2g} N{volts and ', '}{volts}"
        note += "" if sure else ": too few or too scattered"
        add(f"c_{name}", side.c, _around(side.c, side.half_width), "N s²/rad²", sure, note)
        if zone is not None:
            low, high = sorted(sign * TO_RPM * end for end in zone.interval)
            note = zone.note or f"slowest speed that turns; {side.c * zone.speed**2:.2g} N there"
            add(f"dead_rpm_{name}", sign * TO_RPM * zone.speed + 0.0, (low, high), "rpm", zone.measured, note)
    if len(result.sides) == 2:
        plus, minus = result.sides["plus"], result.sides["minus"]
        ratio = minus.c / plus.c
        half = ratio * math.hypot(plus.half_width / plus.c, minus.half_width / minus.c)
        add("reverse_ratio", ratio, _around(ratio, half), "-", math.isfinite(half))
    for name, sign in SIDES:
        end, side = "max" if sign > 0.0 else "min", result.sides.get(name)
        c, old_c = side.c if side else getattr(before, f"c_{name}"), getattr(before, f"c_{name}")
        old_speed, old_force = (
            sign * getattr(before, f"rpm_{end}") / TO_RPM,
            sign * getattr(before, f"force_{end}"),
        )
        speed, at_end, scatter = result.fastest[name]
        if speed <= 0.0:
            continue
        moves = at_end or speed > old_speed
        note = "beyond the vehicle file's" if moves else "the table ends here; the vehicle file's stays"
        note = f"full pulse{volts and ' at '}{volts}" if at_end else note
        rpm = sign * speed * TO_RPM
        add(f"rpm_{end}", rpm, _around(rpm, scatter * TO_RPM), "rpm", moves, note)
        force = c * (speed if moves else old_speed) ** 2
        half = force * side.half_width / side.c if side else 0.0
        if old_force < (1.0 - CHOSEN_LIMIT) * old_c * old_speed**2 and old_force < force:
            force, half, sure, note = old_force, 0.0, False, "the vehicle file's own, below the curve"
        else:
            sure, note = math.isfinite(half), f"c_{name} at the speed limit"
        add(f"force_{end}", sign * force, _around(sign * force, half), "N", sure, note)
    units = {"dead": "µs", "zero": "µs", "emf": "V s/rad", "load": "V s²/rad²"}
    caution = "zero, emf and load of a direction vary together: the speed they give is surer than each"
    for key, ends in result.esc.intervals.items() if result.esc is not None else ():
        note = result.esc.unsure.get(key, "" if key.startswith("dead") else caution)
        value, sure = float(getattr(result.esc.esc, key)), key not in result.esc.unsure
        add(f"esc.{key}", value, ends, units[key.partition("_")[0]], sure, note)
    return rows


def _path(target: Target, key: str) -> str:
    """Where the number stands in the vehicle file; that of a group in `thruster_groups`."""
    if target.name in target.thrusters:
        return f"thrusters.{target.name}.{key}"
    return f"thrusters.*.{key}" if target.name == "all" else f"thruster_groups.{target.name}.{key}"


def fit_thruster(
    tables: Iterable[ThrustTable | Trial | str | os.PathLike[str]],
    vehicle: Vehicle,
    *,
    group: str | None = None,
    voltage: float | None = None,
    pool_voltages: bool = False,
    seed: int = 0,
) -> Fit:
    """Fit T = c± ω|ω| (paper, eq. 16) and, where there are pulses, the speed controller's law.

    Args:
        tables: CSV files (see `read_table`), folders of bench trials, or what was read from them.
        vehicle: Whose thrusters they are.
        group: Propeller group of all tables.
        voltage: At which the numbers shall hold [V], and for tables without a voltage column the voltage they were
            taken at; where not given, the tables' only one, else that of the vehicle file's ESC, else the middle one.
        pool_voltages: Fit all voltages together; otherwise the others only check the prediction.
        seed: For the record; the intervals need no random numbers.

    Returns:
        Estimates named `GROUP.c_plus`, `THRUSTER.c_plus` or `all.c_plus` and so on; changes for every thruster.

    Raises:
        CalibrationError: A table that cannot be read, names that the vehicle does not have, too few rows.
    """
    read = _distinct_names([(item, table) for item in tables for table in _read(item, vehicle)])
    if not read:
        raise CalibrationError("no table given: name at least one CSV file of speeds and thrusts")
    _refuse_duplicates(read)
    targets, findings = find_targets(read, vehicle, group)
    estimates: dict[str, Estimate] = {}
    changes: dict[str, Any] = {}
    quality: dict[str, dict[str, float]] = {}
    curves: list[Curve] = []
    for target in targets:
        first = vehicle.thrusters[target.thrusters[0]]
        result = bench(target.tables, first, target.name, voltage=voltage, pool_voltages=pool_voltages)
        estimates_of_target = estimates_of(target, result, vehicle)
        estimates |= {estimate.name: estimate for estimate in estimates_of_target}
        for estimate in estimates_of_target:
            key = estimate.name.rpartition(".")[2]
            if estimate.identifiable and key.startswith(WRITTEN):
                changes |= {f"thrusters.{name}.{key}": estimate.estimate for name in target.thrusters}
        if result.esc is not None:
            changes |= {f"thrusters.{name}.esc": result.esc.esc.values() for name in target.thrusters}
        quality |= quality_of(target.name, result, first)
        curves += curves_of(target.name, result, first)
        findings += result.findings
    return Fit(
        kind="thruster",
        method="least squares of T = c± ω|ω|",
        vehicle=vehicle,
        estimates=estimates,
        changes=changes,
        quality=quality,
        curves=tuple(curves),
        findings=tuple(dict.fromkeys(findings)),
        trials={table.name: table.sha256 for table in read},
        settings={
            "voltage": voltage,
            "pool_voltages": pool_voltages,
            "group": group,
            "seed": seed,
        },
    )


WRITTEN = ("c_", "dead_rpm_", "rpm_", "force_")
"""Beginnings of the keys of a thruster that an estimate goes to."""


def _read(item: ThrustTable | Trial | str | os.PathLike[str], vehicle: Vehicle) -> list[ThrustTable]:
    if isinstance(item, ThrustTable):
        return [item]
    neutrals = [thruster.esc.pulse_neutral for thruster in vehicle.thrusters.values() if thruster.esc]
    neutral = neutrals[0] if neutrals else 1500.0
    if (
        isinstance(item, Trial)
        or Path(item).is_dir()
        or Path(item).suffix == ".parquet"
        or _is_trial(Path(item))
    ):
        trial = item if isinstance(item, Trial) else load_trial(item)
        turned = [name for name, thruster in vehicle.thrusters.items() if thruster.motor_sign == -1]
        return tables_of_trial(trial, neutral=neutral, reversed_wiring=turned)
    return [read_table(item, neutral=neutral)]


def _is_trial(path: Path) -> bool:
    """Whether a CSV file's header names a thruster's force and what drove it, as trials do."""
    if not path.is_file():
        return False
    with path.open(encoding="utf-8", errors="replace") as lines:
        header = {word.strip() for word in next(lines, "").split(",")}
    names = {word.removeprefix("force_") for word in header if word.startswith("force_")}
    return any({f"rpm_{name}", f"pwm_{name}"} & header for name in names)


def _distinct_names(read: Sequence[tuple[Any, ThrustTable]]) -> list[ThrustTable]:
    """Tables of files with the same name are called by their folder too: `H_LF/sweep`."""
    names = [table.name for _, table in read]
    return [
        replace(table, name=f"{Path(item).parent.name}/{table.name}")
        if isinstance(item, str | os.PathLike) and table.thruster is None and names.count(table.name) > 1
        else table
        for item, table in read
    ]


def _refuse_duplicates(tables: Sequence[ThrustTable]) -> None:
    first_names: dict[tuple[str, str | None], str] = {}
    for table in tables:
        first = first_names.setdefault((table.sha256, table.thruster), table.name)
        if sum((t.sha256, t.thruster) == (table.sha256, table.thruster) for t in tables) > 1:
            names = table.name if first == table.name else f"{first} and {table.name}"
            raise CalibrationError(f"{names}: the same numbers are given twice: give every table once")


def calibrate_thruster(
    tables: Sequence[Path],
    *,
    vehicle: str,
    out: Path,
    group: str | None = None,
    voltage: float | None = None,
    pool_voltages: bool = False,
    report: Path | None = None,
    seed: int = 0,
    as_json: bool = False,
) -> Vehicle:
    """Fit thrust curves: c+ and c- [N s²/rad²], dead zones [rpm], limits [N], pulse width to speed.

    Example: finssim calibrate thruster T200-16V.csv --vehicle bluerov2 --out mine.yaml

    Args:
        tables (TABLE): Tables of force against rpm or pulse width (.csv), or trials.
        vehicle (NAME|FILE): Vehicle in the catalogue, or path of a vehicle file.
        out (FILE): Vehicle file to write (.yaml).
        group (NAME): Propeller group of all tables.
        voltage: Battery voltage of the fit [V], if the tables have several.
        pool_voltages: Fit all voltages jointly instead of validating one fit on the others.
        report (DIR): Directory for report.html, report.md, figures and fit.json.
        seed: Seed of every random number; equal seeds give equal results.
        as_json: Print one JSON object instead of tables.
    """
    options = dict(locals())
    refuse_places(out, report, "vehicle")
    body = load_vehicle(vehicle)
    fit = fit_thruster(
        list(tables), body, group=group, voltage=voltage, pool_voltages=pool_voltages, seed=seed
    )
    return finish("thruster", fit, options)
