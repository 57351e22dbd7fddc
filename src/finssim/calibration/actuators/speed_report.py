"""A speed loop for the identified motors: one set of gains, tried on every motor and on the ends of the intervals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.actuators.motor_study import Study
from finssim.calibration.actuators.motor_trial import OVERSHOOT
from finssim.calibration.findings import Finding, finding
from finssim.calibration.fit import Estimate
from finssim.vehicles import Vehicle

__all__ = ["Loop", "LoopPlant", "loop_of", "simulate_step", "tune", "LOOP_RATE"]

# A motor controller's speed loop, feed-forward plus PID, tuned from an identified response and tried on it.
#
# With r the asked speed and T_d, τ, K of the response (paper, §III: first order, dead time and an input dead zone):
#
#     ṙ_f = (r - r_f) / λ_r                                   the speed that the loop makes the shaft follow
#     u   = (r_f + τ ṙ_f) / K + PID(r_f(t - T_d) - ω)         clipped to the limits, out of the dead zone
#
# so that an exact model leaves the PID nothing to do. Its gains are those of the improved SIMC rule (Grimholt and
# Skogestad 2018, J. Process Control 70: 36-46), in series form K_c = τ / (K (λ + θ)), τ_I = min(τ, 4 (λ + θ)) and
# τ_D = θ / 3 with θ = T_d and one and a half periods of the loop, and λ = θ but at least τ / 5, which keeps the gain
# below 5 / K.

Array = NDArray[np.float64]

LEAST_CLOSED = 0.2
DERIVATIVE_FILTER = 0.5
"""Time constant of the derivative's low-pass, of τ_D."""


@dataclass(frozen=True, kw_only=True)
class LoopPlant:
    """A motor: speed [rad/s] against command, in units of the command that makes a speed of K times its value."""

    gain: float
    """K, steady speed over command."""
    delay: float
    """T_d [s]."""
    time_constant: float
    """τ [s]."""
    dead_minus: float = 0.0
    """Commands between `dead_minus` (<= 0) and `dead_plus` (>= 0) leave the shaft standing."""
    dead_plus: float = 0.0
    limit: float = math.inf
    """Largest command, either sign."""


@dataclass(frozen=True, kw_only=True)
class Gains:
    """What the motor controller is told."""

    feedforward: float
    """1 / K, command per rad/s."""
    kp: float
    """Command per rad/s."""
    ki: float
    """Command per rad."""
    kd: float
    """Command per rad/s²."""
    derivative_filter: float
    """Time constant of the derivative's low-pass [s]."""
    lead: float
    """τ of the feed-forward [s]."""
    reference_time: float
    """λ_r of the asked speed's low-pass [s]."""
    reference_delay: float
    """T_d by which the PID's reference is delayed [s]."""
    loop_rate: float
    """[Hz]"""


@dataclass(frozen=True, kw_only=True)
class LoopStep:
    """One simulated step from standstill."""

    amplitude: float
    """Asked speed [rad/s]."""
    rise: float
    """10 % to 90 % of the asked speed [s]; NaN if it is not reached."""
    overshoot: float
    """Beyond the asked speed, over it."""
    steady_error: float
    """Asked less mean of the last quarter, over asked."""
    t: Array
    """[s], (n,)"""
    speed: Array
    """[rad/s], (n,)"""


def tune(plant: LoopPlant, *, loop_rate: float, slower: float = 1.0) -> Gains:
    """Gains for a response, see the module.

    Args:
        plant: As identified.
        loop_rate: Of the motor controller [Hz].
        slower: Factor on λ.
    """
    theta = plant.delay + 1.5 / loop_rate
    closed = slower * max(theta, LEAST_CLOSED * plant.time_constant)
    tau = max(plant.time_constant, 1e-9)
    series_gain = tau / (plant.gain * (closed + theta))
    integral, derivative = min(tau, 4.0 * (closed + theta)), theta / 3.0
    series = 1.0 + derivative / integral  # from series to parallel form
    return Gains(
        feedforward=1.0 / plant.gain,
        kp=series_gain * series,
        ki=series_gain / integral,
        kd=series_gain * derivative,
        derivative_filter=max(DERIVATIVE_FILTER * derivative, 1.0 / loop_rate),
        lead=tau,
        reference_time=max(closed, 0.5 * tau),  # the lead then asks for at most twice the steady command
        reference_delay=plant.delay,
        loop_rate=loop_rate,
    )


def simulate_step(
    plant: LoopPlant,
    gains: Gains,
    amplitude: float,
    *,
    duration: float = 3.0,
    noise: float = 0.0,
    seed: int = 0,
) -> LoopStep:
    """Ask for a speed from standstill and see what the loop makes of it.

    Args:
        plant: The motor that is there, which need not be the one that the gains were tuned for.
        gains: As told.
        amplitude: Asked speed [rad/s]; the direction is its sign.
        duration: [s]
        noise: Standard deviation of the measured speed [rad/s].
        seed: Of the noise.
    """
    period = 1.0 / gains.loop_rate
    inner = max(math.ceil(20.0 * period / max(plant.time_constant, period / 50.0)), 4)
    h = period / inner
    share = 1.0 - math.exp(-h / max(plant.time_constant, 1e-9))
    waiting = [0.0] * round(plant.delay / h)
    references = [0.0] * (round(gains.reference_delay * gains.loop_rate) + 1)
    rng = np.random.default_rng(seed)
    count = max(round(duration * gains.loop_rate), 8)
    speeds, speed = np.zeros(count), 0.0
    filtered = integral = slope = 0.0
    before: float | None = None
    blend = 1.0 - math.exp(-period / gains.reference_time)
    for k in range(count):
        speeds[k] = speed
        measured = speed + noise * rng.standard_normal()
        rate = (amplitude - filtered) / gains.reference_time
        references.append(filtered)
        error = references.pop(0) - measured
        change = 0.0 if before is None else (measured - before) / period
        slope += (change - slope) * period / (gains.derivative_filter + period)
        before = measured
        free = gains.feedforward * (filtered + gains.lead * rate) + gains.kp * error + integral
        # The derivative acts on the error of the followed speed, whose own slope is known.
        free += gains.kd * (_slope_of(references, period) - slope)
        command = _admissible(free, plant, amplitude)
        if command == free or error * free < 0.0:  # the integral waits while the command is clipped
            integral += gains.ki * error * period
        filtered += blend * (amplitude - filtered)
        for _ in range(inner):
            waiting.append(command)
            acting = waiting.pop(0)
            moving = acting if acting <= plant.dead_minus or acting >= plant.dead_plus else 0.0
            speed += share * (plant.gain * moving - speed)
    return _measures(amplitude, np.arange(count, dtype=np.float64) * period, speeds)


def _slope_of(references: Sequence[float], period: float) -> float:
    """Slope of the delayed reference that was just used [rad/s²]."""
    return (references[1] - references[0]) / period if len(references) > 1 else 0.0


def _admissible(command: float, plant: LoopPlant, asked: float) -> float:
    """The command within its limits, lifted to the edge of the dead zone on the side that is asked for."""
    if asked == 0.0:
        return 0.0
    clipped = min(max(command, -plant.limit), plant.limit)
    if asked > 0.0:
        return max(clipped, plant.dead_plus) if clipped > plant.dead_minus else clipped
    return min(clipped, plant.dead_minus) if clipped < plant.dead_plus else clipped


def _measures(amplitude: float, t: Array, speeds: Array) -> LoopStep:
    share = speeds / amplitude
    crossings = [
        float(t[np.argmax(share >= level)]) if np.any(share >= level) else math.nan for level in (0.1, 0.9)
    ]
    return LoopStep(
        amplitude=amplitude,
        rise=crossings[1] - crossings[0],
        overshoot=max(float(np.max(share)) - 1.0, 0.0),
        steady_error=1.0 - float(np.mean(share[-len(share) // 4 :])),
        t=t,
        speed=speeds,
    )


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
    findings: list[Finding]


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
    findings = []
    if quality["loop_overshoot_at_ends"] > OVERSHOOT:
        findings.append(finding("loop_overshoots", overshoot=quality["loop_overshoot_at_ends"]))
    return Loop(
        gains=gains, estimates=_estimates(gains), quality=quality, steps=tuple(steps), findings=findings
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
