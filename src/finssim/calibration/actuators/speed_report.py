"""A speed loop for the identified motors: one set of gains, tried on every motor and on the ends of the intervals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from finssim.calibration.actuators.motor_steps import OVERSHOOT
from finssim.calibration.actuators.motor_study import Study
from finssim.calibration.actuators.speed_loop import Gains, LoopPlant, LoopStep, simulate_step, tune
from finssim.calibration.fit import Estimate
from finssim.vehicles import Vehicle

__all__ = ["Loop", "loop_of"]

AMPLITUDES = (0.1, 0.2, 0.4, 0.6)
"""Steps of the trial, of the fastest speed (facts, §5)."""
SLOWER = (1.0, 1.5, 2.0, 3.0)
"""Factors on λ that are tried until the loop bears the ends of the intervals."""
LOOP_RATE = 200.0
"""Of the motor controller where the caller does not say [Hz]."""


@dataclass(frozen=True, kw_only=True)
class Loop:
    """Gains and what they did in simulation."""

    gains: Gains
    estimates: list[Estimate]
    quality: dict[str, float]
    """`rise`, `overshoot`, `steady_error` of the identified motors; `overshoot_at_ends` with gain, delay and lag at the
    ends of their intervals, the worst of them; a loop that overshoots there by more than 10 % is made slower."""
    steps: tuple[LoopStep, ...]
    warnings: list[str]


def loop_of(studies: Sequence[Study], vehicle: Vehicle, *, loop_rate: float = LOOP_RATE) -> Loop | None:
    """Tune one speed loop for all motors and try it.

    Args:
        studies: Of the thrusters in the `speed` domain, accepted ones.
        vehicle: Whose speed limits and dead zones hold.
        loop_rate: Of the motor controller [Hz].

    Returns:
        None where there is no study of speeds against speeds.
    """
    usable = [
        found for found in studies if found.same_unit and math.isfinite(found.gain) and found.gain > 0.0
    ]
    if not usable:
        return None
    plants = [_plant(found, vehicle) for found in usable]
    middle = LoopPlant(
        gain=float(np.median([plant.gain for plant in plants])),
        delay=float(np.median([plant.delay for plant in plants])),
        time_constant=float(np.median([plant.time_constant for plant in plants])),
    )
    for slower in SLOWER:
        gains = tune(middle, loop_rate=loop_rate, slower=slower)
        ends = [
            step
            for found, plant in zip(usable, plants, strict=True)
            for corner in _corners(found, plant)
            for step in _tries(found, corner, gains, vehicle, AMPLITUDES[-2:])
        ]
        if max((step.overshoot for step in ends), default=0.0) <= OVERSHOOT:
            break
    steps = [
        step
        for found, plant in zip(usable, plants, strict=True)
        for step in _tries(found, plant, gains, vehicle)
    ]
    quality = {
        "loop_rise": float(np.median([step.rise for step in steps])) if steps else math.nan,
        "loop_overshoot": max((step.overshoot for step in steps), default=math.nan),
        "loop_steady_error": max((abs(step.steady_error) for step in steps), default=math.nan),
        "loop_overshoot_at_ends": max((step.overshoot for step in ends), default=math.nan),
    }
    warnings = []
    if quality["loop_overshoot_at_ends"] > OVERSHOOT:
        warnings.append(
            f"the speed loop overshoots by {100 * quality['loop_overshoot_at_ends']:.0f} % if gain, delay and lag are "
            "at the ends of their intervals: log more steps"
        )
    return Loop(
        gains=gains, estimates=_estimates(gains), quality=quality, steps=tuple(steps), warnings=warnings
    )


def _plant(found: Study, vehicle: Vehicle) -> LoopPlant:
    thruster = vehicle.thrusters[found.name]
    rpm = math.pi / 30.0
    return LoopPlant(
        gain=found.gain,
        delay=found.response.delay,
        time_constant=found.response.time_constant,
        dead_minus=thruster.dead_rpm_minus * rpm,
        dead_plus=thruster.dead_rpm_plus * rpm,
        limit=max(thruster.rpm_max, -thruster.rpm_min) * rpm,
    )


def _corners(found: Study, plant: LoopPlant) -> list[LoopPlant]:
    """The motor with faster and slower, stronger and weaker responses than the best estimate."""
    half = found.gain_half if math.isfinite(found.gain_half) else 0.1 * plant.gain
    low, high = found.response.delay_interval
    fast, slow = found.response.time_constant_interval
    return [
        replace(plant, gain=gain, delay=delay, time_constant=tau)
        for gain in (max(plant.gain - half, 0.5 * plant.gain), plant.gain + half)
        for delay in (low, high)
        for tau in (fast, slow)
    ]


def _tries(
    found: Study, plant: LoopPlant, gains: Gains, vehicle: Vehicle, shares: Sequence[float] = AMPLITUDES
) -> list[LoopStep]:
    """Steps both ways that the motor can reach and hold: above its dead zone, below its limit."""
    thruster = vehicle.thrusters[found.name]
    rpm = math.pi / 30.0
    asked = [share * limit * rpm for share in shares for limit in (thruster.rpm_max, thruster.rpm_min)]
    duration = max(1.0, 8.0 * (plant.delay + plant.time_constant))
    return [
        simulate_step(plant, gains, speed, duration=duration)
        for speed in asked
        if not plant.gain * plant.dead_minus < 0.99 * speed < plant.gain * plant.dead_plus
        and abs(speed) < 0.95 * plant.gain * plant.limit
    ]


def _estimates(gains: Gains) -> list[Estimate]:
    units = {
        "feedforward": "-",
        "kp": "-",
        "ki": "1/s",
        "kd": "s",
        "derivative_filter": "s",
        "lead": "s",
        "reference_time": "s",
        "reference_delay": "s",
    }
    note = f"speed over speed, loop at {gains.loop_rate:g} Hz; follows from gain, delay and time constant"
    return [
        Estimate(
            name=f"speed_loop.{key}",
            estimate=float(getattr(gains, key)),
            ci95=(math.nan, math.nan),
            unit=unit,
            identifiable=True,
            note=note,
        )
        for key, unit in units.items()
    ]
