"""Excitation programmes: wrenches whose resulting motion identifies a vehicle's hydrodynamics."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.control.allocation import Allocator
from finssim.control.axis_model import axis_model
from finssim.core.files import atomic_write
from finssim.core.quiet import start_warp
from finssim.core.text_table import write_csv
from finssim.core.yaml_file import read_mapping, yaml_text
from finssim.trials.findings import CalibrationError
from finssim.trials.trial import TAU
from finssim.vehicles import AXES, Vehicle
from finssim.vehicles.capability import level_speed
from finssim.vehicles.vehicle import Axis

__all__ = ["Programme", "RATE", "programmes", "which_axes", "write_programme"]


Array = NDArray[np.float64]

# Multi-sines: all axes together, each with its own frequencies, for fits of coupled dynamics.

DRAWS = 30
"""Number of random phase sets that are tried; the one with the lowest peak is used."""


def multisine(
    peaks: Mapping[Axis, float],
    vehicle: Vehicle,
    *,
    index: int = 1,
    seed: int = 0,
    duration: float = 60.0,
    band: tuple[float, float] = (0.05, 1.0),
) -> Programme:
    """Return one programme that drives several axes with interleaved harmonics of 1/duration.

    tau_i(t) = a_i Σ_k k^(-1/2) cos(2π k t / duration + φ_k),   k = i-th, (i+n)-th, ... harmonic in the band

    No two axes share a frequency, so their responses can be separated; amplitudes decrease with the square
    root of frequency, so that both speeds (damping) and accelerations (mass) are excited. Phases are random;
    of several draws, the one with the lowest peak is used.

    Args:
        peaks: Axis -> largest wrench [N, N m]; all are scaled down by a common factor until the thrusters can
            produce the sum.
        vehicle: Vehicle with the thrusters and damping.
        index: Number in the name.
        seed: Seed of the phases.
        duration: Duration of the excitation [s].
        band: Lowest and highest frequency [Hz].

    Raises:
        CalibrationError: The band is too narrow for the number of axes and the duration, or too fast for the
            commands.
    """
    low, high = band
    if not (0.0 < low < high <= 0.2 * RATE):
        raise CalibrationError(
            f"band is {low:g} to {high:g} Hz, expected rising, above 0 and up to {0.2 * RATE:g} Hz"
        )
    if not 0.0 < duration <= LONGEST:
        raise CalibrationError(f"duration is {duration:g} s, expected above 0 and at most {LONGEST:g} s")
    harmonics = np.arange(math.ceil(low * duration - 1e-9), math.floor(high * duration + 1e-9) + 1)
    if len(harmonics) < 3 * len(peaks):
        raise CalibrationError(
            f"{len(harmonics)} frequencies between {low:g} and {high:g} Hz in {duration:g} s are too few for "
            f"{len(peaks)} axes: give a longer duration or a wider band"
        )
    rng = np.random.default_rng(seed)
    t = np.arange(round(duration * RATE)) / RATE
    tau = np.zeros((len(t), 6))
    for i, (axis, peak) in enumerate(peaks.items()):
        shape = _lowest_peak(harmonics[i :: len(peaks)], t / duration, rng)
        tau[:, AXES.index(axis)] = peak * shape / np.abs(shape).max()
    tau *= _feasible(tau, vehicle)
    parts = (("rest", 50), ("baseline", 50), ("excitation", len(t)), ("coast", 100), ("rest", 50))
    phase = np.concatenate([np.full(count, word) for word, count in parts])
    full = np.zeros((len(phase), 6))
    full[phase == "excitation"] = tau
    return Programme(name=f"multisine_{index}", axes=tuple(peaks), rate=RATE, tau_desired=full, phase=phase)


def _lowest_peak(harmonics: NDArray[np.int64], turns: Array, rng: np.random.Generator) -> Array:
    """Return the sum of cosines whose random phases result in the lowest peak."""
    draws = (rng.uniform(0.0, 2.0 * math.pi, len(harmonics)) for _ in range(DRAWS))
    waves = (
        np.cos(2.0 * math.pi * turns[:, None] * harmonics + phases) @ harmonics**-0.5 for phases in draws
    )
    return min(waves, key=lambda wave: float(np.abs(wave).max()))


def _feasible(tau: Array, vehicle: Vehicle) -> float:
    """Return the largest factor up to 1 at which the thrusters can produce the wrench at every time."""
    start_warp()
    allocator = Allocator.from_vehicle(vehicle)
    weights = np.where(vehicle.wrench_limits > 0.0, 1.0 / np.maximum(vehicle.wrench_limits, 1e-9), 0.0)

    low, high = 0.0, 1.0
    factor = high
    for _ in range(11):
        thrust = allocator.allocate(factor * tau)
        missing = np.abs(allocator.achieved(thrust) - factor * tau) * weights
        low, high = (factor, high) if missing.max() < 2e-3 else (low, factor)
        if low == 1.0:
            break
        factor = 0.5 * (low + high)
    return low


KINDS = ("published", "validation", "multisine")

RATE = 50.0
"""Rate of the commands [Hz]."""
LONGEST = 3600.0
"""Longest duration of a multi-sine [s]."""

PLANS = read_mapping(Path(__file__).with_name("programmes.yaml"), CalibrationError, such_as="steps: []")
"""Sequences of phases [s], levels by axis [N, N m] and the limits of the vehicle that they were designed for
[N, N m]."""

STEADY = 0.8
"""Largest surge and sway speed, relative to `level_speed` [-]."""


@dataclass(frozen=True, kw_only=True)
class Programme:
    """Commands over time. Row k is held over [t_k, t_k + 1/rate)."""

    name: str
    """Name, unique among the programmes that are generated together, and valid as the name of a folder."""
    axes: tuple[Axis, ...]
    """Axes that it excites."""
    rate: float
    """Rate of the commands [Hz]."""
    tau_desired: Array
    """Wrench about the vehicle's `wrench_reference`, body frame [N, N m], (n, 6)."""
    phase: NDArray[np.str_]
    """Word of `finssim.trials.trial.PHASES` for every row, (n,)."""
    ascent_speed: float | None = None
    """Speed above which the coast ends early if the vehicle has risen faster for `ascent_time` [m/s]."""
    ascent_time: float = 2.0
    """Duration of a rise above `ascent_speed` that ends the coast [s]."""

    def __repr__(self) -> str:
        return f"<Programme {self.name}: {self.duration:.1f} s at {self.rate:g} Hz, {' '.join(self.axes)}>"

    @property
    def t(self) -> Array:
        """Times of the rows from 0 [s], (n,)."""
        return np.arange(len(self.phase)) / self.rate

    @property
    def duration(self) -> float:
        """Duration [s]."""
        return len(self.phase) / self.rate

    @property
    def sha256(self) -> str:
        """Return the digest of its commands and times."""
        return hashlib.sha256(self.tau_desired.tobytes() + "".join(self.phase).encode()).hexdigest()


@dataclass(frozen=True)
class Leg:
    """Steps in both directions along one axis, each pair half as long as the previous one."""

    axis: Axis
    level: float
    """Magnitude of the steps [N, N m]."""
    hold: float
    """Duration of the first step [s]."""
    times: int = 1

    @property
    def duration(self) -> float:
        """Duration of one repetition, including the rest around it [s]."""
        return 1.0 + self.hold * (2.0 * sum(SHRINK) + 1.0)


SHRINK = (1.0, 0.5)
"""Durations of the pairs of steps of a `Leg`, relative to the first: shorter ones would fall between samples
of a log."""


def alternating(leg: Leg, number: int = 1) -> Programme:
    """Return the steps of a leg: long ones for drag, short ones for inertia, then a coast; it ends near its start.

    Args:
        leg: Axis, level and duration.
        number: Number in the name.
    """
    lengths = [round(leg.hold * part * RATE) for part in SHRINK for _ in range(2)]
    push = np.repeat(leg.level * np.resize([1.0, -1.0], len(lengths)), lengths)
    parts = (("rest", round(RATE)), ("excitation", len(push)), ("coast", round(leg.hold * RATE)))
    phase = np.repeat([word for word, _ in parts], [n for _, n in parts])
    tau = np.zeros((len(phase), 6))
    tau[phase == "excitation", AXES.index(leg.axis)] = push
    name = f"{leg.axis}_{leg.level:g}_{leg.hold:g}s_{number}"
    return Programme(name=name, axes=(leg.axis,), rate=RATE, tau_desired=tau, phase=phase)


def read_legs(path: Path) -> list[Leg]:
    """Return the steps of the next dive that the report of a fit recommends.

    Args:
        path: `fit.json` of the report, or the directory of the report.

    Raises:
        CalibrationError: There is no such file, or it recommends no dive.
    """
    path = path / "fit.json" if path.is_dir() else path
    expected = "expected the report of finssim calibrate hydrodynamics, or its fit.json"
    try:
        dive = json.loads(path.read_text(encoding="utf-8"))["next_dive"]
        legs = [Leg(**leg) for leg in dive["legs"]] if dive is not None else []
    except OSError as error:
        raise CalibrationError(f"cannot read {path} ({error.strerror}): {expected}") from None
    except (ValueError, KeyError, TypeError):
        raise CalibrationError(f"{path} recommends no next dive: {expected}") from None
    if not legs:
        raise CalibrationError(
            f"{path} recommends no next dive, because its trials drove no axis: omit --from"
        )
    return legs


def which_axes(names: str | Sequence[str], vehicle: Vehicle) -> tuple[Axis, ...]:
    """Return the axes for given names.

    Args:
        names: `all`, a comma-separated list such as `surge,yaw`, or a sequence of names.
        vehicle: Vehicle whose `controlled_axes` are used for `all`.

    Raises:
        CalibrationError: A word is not an axis, is given twice, or the vehicle cannot control the axis.
    """
    requested = [w.strip() for w in names.split(",")] if isinstance(names, str) else list(names)
    if requested == ["all"]:
        return vehicle.controlled_axes
    for word in requested:
        if word not in AXES:
            raise CalibrationError(f"unknown axis '{word}'; available: all, {', '.join(AXES)}")
        if word not in vehicle.controlled_axes:
            able = ", ".join(vehicle.controlled_axes)
            raise CalibrationError(f"{vehicle.name} cannot control {word}: its thrusters control {able}")
    if len(set(requested)) < len(requested) or not requested:
        raise CalibrationError(f"axes are '{','.join(requested)}', expected each axis once")
    return tuple(axis for axis in AXES if axis in requested)


def programmes(
    axes: str | Sequence[str],
    vehicle: Vehicle,
    *,
    levels: Mapping[str, Sequence[float]] | Sequence[float] | None = None,
    kind: str = "published",
    repeats: int = 1,
    seed: int = 0,
    coast: float = 30.0,
    duration: float = 60.0,
    band: tuple[float, float] = (0.05, 1.0),
    legs: Sequence[Leg] = (),
) -> list[Programme]:
    """Return programmes that excite some axes of a vehicle, in the order in which to run them.

    `published` follows FinsROV's identification procedure: on every axis and in both directions, steps of 9 s
    on surge, sway, heave and yaw, and pulses of 0.6 s with ring-down on roll and pitch. Downward heave steps
    are followed by a coast of up to `coast` seconds, which determines the buoyancy without thrust.
    `validation` contains the finer steps with which FinsROV was validated. `multisine` drives all axes
    together, for coupled fits; see `multisine`.

    Levels are FinsROV's, times the ratio of this vehicle's wrench limit to FinsROV's on that axis (two digits), and
    never above the limit; for a vehicle that hovers, steps on surge and sway stay below the level that tilts it.

    Args:
        axes: Axes as for `which_axes`.
        vehicle: Vehicle with the limits.
        levels: Magnitudes for every axis, or by axis [N, N m]; for a multi-sine the peak. Both directions are driven.
        kind: One of `KINDS`.
        repeats: Number of repetitions of every programme.
        seed: Seed of a multi-sine's phases.
        coast: Longest coast after a dive [s].
        duration: Duration of one multi-sine [s].
        band: Frequency band of a multi-sine [Hz].
        legs: Steps of the dive that a fit recommends; those of the axes are used instead.

    Raises:
        CalibrationError: An axis, level, kind or count is invalid.
    """
    chosen = which_axes(axes, vehicle)
    if legs:
        for leg in legs:
            _levels(*which_axes([leg.axis], vehicle), vehicle, [leg.level], kind)
        played = [leg for leg in legs if leg.axis in chosen]
        if not played:
            there = ", ".join(sorted({leg.axis for leg in legs}))
            raise CalibrationError(
                f"the recommended dive has no steps of {', '.join(chosen)}, but of {there}"
            )
        return [alternating(leg, n + 1) for leg in played for n in range(leg.times * repeats)]
    if kind not in KINDS:
        raise CalibrationError(f"unknown kind of programme '{kind}'; available: {', '.join(KINDS)}")
    if repeats < 1:
        raise CalibrationError(f"repeats is {repeats}, expected at least 1")
    by_axis = {axis: _levels(axis, vehicle, levels, kind) for axis in chosen}
    if kind == "multisine":
        peaks = {axis: values[-1] for axis, values in by_axis.items()}
        return [
            multisine(peaks, vehicle, index=r + 1, seed=seed + r, duration=duration, band=band)
            for r in range(repeats)
        ]
    if not (math.isfinite(coast) and coast > 0.0):
        raise CalibrationError(f"coast is {coast} s, expected a time above 0 s")
    out = []
    for axis in chosen:
        for level in by_axis[axis]:
            for sign in (1.0, -1.0):
                out += [_step(axis, sign * level, kind, coast, r, repeats) for r in range(repeats)]
    return out


def _level_limit(axis: Axis, vehicle: Vehicle) -> float:
    """Return the drag of surge or sway at `STEADY` times the speed at which a hovering vehicle starts to tilt [N]."""
    i = AXES.index(axis)
    if i > 1 or not min(vehicle.wrench_limits[:2]) > 0.0:
        return math.inf
    model, v = axis_model(vehicle), STEADY * level_speed(vehicle, axis=i)
    return float(model.linear_damping[i] * v + model.quadratic_damping[i] * v * v) if v < math.inf else v


def _levels(
    axis: Axis, vehicle: Vehicle, levels: Mapping[str, Sequence[float]] | Sequence[float] | None, kind: str
) -> tuple[float, ...]:
    """Return the magnitudes for one axis, ascending."""
    limit = float(vehicle.wrench_limits[AXES.index(axis)])
    unit = "N" if AXES.index(axis) < 3 else "N m"
    requested = levels.get(axis) if isinstance(levels, Mapping) else levels
    if requested is None:
        if kind == "multisine":
            return (0.5 * limit,)
        limit = min(limit, _level_limit(axis, vehicle))
        scale = limit / PLANS["limits"][axis]
        if abs(scale - 1.0) < 0.01:
            scale = 1.0
        return tuple(sorted({min(_two_digits(scale * x), limit) for x in PLANS[kind][axis]}))
    if not requested:
        raise CalibrationError(f"levels of {axis}: none given, expected at least one in {unit}")
    for value in requested:
        if not (math.isfinite(value) and value > 0.0):
            raise CalibrationError(
                f"levels of {axis}: {value:g} {unit} is not possible, expected magnitudes above 0 {unit} "
                "(both directions are driven)"
            )
        if value > limit * (1.0 + 1e-6):
            raise CalibrationError(
                f"levels of {axis}: {value:g} {unit} is beyond {vehicle.name}'s limit of {limit:.4g} {unit}"
            )
    return tuple(sorted({float(x) for x in requested}))


def _two_digits(x: float) -> float:
    """Return x rounded to two significant digits, three if it starts with 1."""
    digits = 2 if f"{x:e}"[0] == "1" else 1
    return float(f"{x:.{digits}e}")


def _step(axis: Axis, level: float, kind: str, coast: float, repeat: int, repeats: int) -> Programme:
    """Return a programme of one step or pulse."""
    pulse = kind == "published" and axis in ("roll", "pitch")
    dive = kind == "published" and axis == "heave" and level < 0.0
    sequence = [list(part) for part in PLANS["pulse" if pulse else "step"]]
    if dive:
        sequence[3][1] = coast
    counts = [round(seconds * RATE) for _, seconds in sequence]
    phase = np.repeat(np.array([word for word, _ in sequence]), counts)
    tau = np.zeros((len(phase), 6))
    tau[phase == "excitation", AXES.index(axis)] = level
    word = "dive" if dive else ("plus" if level > 0.0 else "minus")
    name = f"{axis}_{word}_{abs(level):.4g}" + (f"_{repeat + 1}" if repeats > 1 else "")
    return Programme(
        name=name, axes=(axis,), rate=RATE, tau_desired=tau, phase=phase, ascent_speed=0.01 if dive else None
    )


def write_programme(programme: Programme, vehicle: Vehicle, folder: Path) -> None:
    """Write the files that a robot needs to run one programme: `programme.csv` and `programme.yaml`.

    The table has `t` [s], the requested wrench about `wrench_reference` [N, N m], the thrust of every thruster that
    the exact allocator computes for it, `force_NAME` [N], and the phase. A row is held until the next.

    Args:
        programme: Programme to write.
        vehicle: Vehicle with the thrusters.
        folder: Folder to write to; created if missing.

    Raises:
        OutputError: The system refused to write.
    """
    thrust = Allocator.from_vehicle(vehicle).allocate(programme.tau_desired)
    numbers = np.column_stack([programme.t, programme.tau_desired, thrust]).round(6) + 0.0
    rows = ([*(f"{x:g}" for x in row), word] for row, word in zip(numbers, programme.phase, strict=True))
    names = ["t", *TAU, *(f"force_{name}" for name in vehicle.thruster_names), "phase"]
    write_csv(folder / "programme.csv", names, rows)
    peaks = np.abs(programme.tau_desired).max(axis=0).tolist()
    about: dict[str, Any] = {
        "name": programme.name,
        "vehicle": vehicle.name,
        "axis": list(programme.axes),
        "rate": programme.rate,
        "duration": programme.duration,
        "wrench_at": [float(x) for x in vehicle.wrench_reference],
        "peak": {axis: peak for axis, peak in zip(TAU, peaks, strict=True) if peak > 0.0},
    }
    if programme.ascent_speed is not None:
        about["end_coast_early"] = {"ascent_speed": programme.ascent_speed, "after": programme.ascent_time}
    with atomic_write(folder / "programme.yaml") as path:
        path.write_text(yaml_text(about), encoding="utf-8")
