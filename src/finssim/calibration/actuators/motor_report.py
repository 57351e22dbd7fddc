"""Estimates, figures and curves of the motors' responses."""

from __future__ import annotations

import math

import numpy as np

from finssim.calibration.actuators.motor_steps import NRMSE, unit_response
from finssim.calibration.actuators.motor_study import Study
from finssim.calibration.fit import Curve, Estimate
from finssim.vehicles.thruster import Thruster

__all__ = ["curve_of", "estimates_of", "is_sure", "quality_of", "warnings_of"]

TO_RPM = 30.0 / math.pi
UNIT = {"force": "N", "speed": "rad/s"}
NARROW_DEAD_ZONE = 2.0
"""A dead zone is told where the smallest command that turns is at most this times the largest that does not."""


def is_sure(found: Study) -> bool:
    """Whether the steps follow first order plus dead time well enough to be written into a vehicle file."""
    return any(found.response.steps[i].accepted for i in found.response.used)


def estimates_of(found: Study, thruster: Thruster) -> list[Estimate]:
    """K, T_d, τ and the dead zone of one thruster."""
    response, name = found.response, found.name
    count = len(response.used)
    sure = is_sure(found)
    rests = f"{count} step{'s' if count != 1 else ''} sampled every {response.sample:.3g} s"
    if not sure:
        rests += ": no step follows first order plus dead time within 10 %"
    low, high = response.time_constant_interval
    fast = response.hidden
    estimates = [
        Estimate(
            name=f"{name}.time_constant",
            estimate=response.time_constant,
            ci95=(low, high),
            unit="s",
            identifiable=sure and not fast,
            note=f"{rests}; below half a sample, the log cannot tell it from 0" if fast else rests,
            path=f"thrusters.{name}.time_constant",
        ),
        Estimate(
            name=f"{name}.delay",
            estimate=response.delay,
            ci95=response.delay_interval,
            unit="s",
            identifiable=sure,
            note=_delay_note(found),
        ),
        Estimate(
            name=f"{name}.gain",
            estimate=found.gain,
            ci95=(found.gain - found.gain_half, found.gain + found.gain_half),
            unit="-" if found.same_unit else f"{UNIT[found.domain]}/µs",
            identifiable=math.isfinite(found.gain_half) and found.gain_half < abs(found.gain),
            note=f"steady {'thrust' if found.domain == 'force' else 'speed'} over what was asked",
        ),
    ]
    for side, sign in (("plus", 1.0), ("minus", -1.0)):
        if side in found.dead and found.same_unit:
            estimates.append(_dead_zone(found, thruster, side, sign))
    return estimates


def _delay_note(found: Study) -> str:
    response = found.response
    if response.delay < response.sample:
        return f"delay {response.delay:.3g} s is below one sample of {response.sample:.3g} s"
    return "the command's change is known to one sample of its log, which is in the interval"


def _dead_zone(found: Study, thruster: Thruster, side: str, sign: float) -> Estimate:
    """The slowest speed that turns the shaft, between two commands that were tried."""
    low, high = found.dead[side]
    if found.domain == "force":
        low, high = (abs(float(thruster.speed(sign * force))) for force in (low, high))
    known = low > 0.0 and high <= NARROW_DEAD_ZONE * low
    ends = sorted((sign * low * TO_RPM, sign * high * TO_RPM))
    return Estimate(
        name=f"{found.name}.dead_rpm_{side}",
        estimate=sign * TO_RPM * (0.5 * (low + high) if low > 0.0 else 0.0) + 0.0,
        ci95=(ends[0] + 0.0, ends[1] + 0.0),
        unit="rpm",
        identifiable=known,
        note="between the last command that leaves the shaft standing and the first that turns it"
        if known
        else f"the smallest command tried, {high * TO_RPM:.0f} rpm, already turns the shaft"
        if low == 0.0
        else "no commands were tried between the last that stands and the first that turns",
        path=f"thrusters.{found.name}.dead_rpm_{side}",
    )


def quality_of(found: Study) -> dict[str, float]:
    """Figures of the fit: rise, overshoot and steady error of the steps, error over their height."""
    steps = [found.response.steps[i] for i in found.response.used]
    rises = [step.rise for step in steps if math.isfinite(step.rise)]
    return {
        "nrmse": found.nrmse,
        "rise": float(np.median(rises)) if rises else math.nan,
        "overshoot": max(step.overshoot for step in steps),
        "steady_error": found.steady_error if found.same_unit else math.nan,
        "steps": float(len(found.response.steps)),
        "accepted": float(sum(step.accepted for step in found.response.steps)),
        "sample": found.response.sample,
        "nrmse_other_domain": found.other_nrmse,
    }


def warnings_of(found: Study) -> list[str]:
    """What a reader of the numbers must know."""
    said = [f"{motor.trial}: {note}" for motor in found.motors for note in motor.notes]
    accepted = sum(step.accepted for step in found.response.steps)
    moved = sum(step.moved for step in found.response.steps)
    if moved == 0:
        said.append(
            f"{found.name}: {found.motors[0].measured} does not follow the command, the vehicle file stays"
        )
    elif accepted == 0:
        said.append(
            f"{found.name}: no step is within {100 * NRMSE:g} % error and overshoot of first order plus dead time "
            f"(error {100 * found.nrmse:.0f} %), the vehicle file keeps its response"
        )
    elif accepted < moved:
        said.append(
            f"{found.name}: {moved - accepted} of {moved} steps left out: error or overshoot beyond 10 %"
        )
    other = "speed" if found.domain == "force" else "force"
    if found.other_nrmse < 0.5 * found.nrmse and found.nrmse > 0.02:
        said.append(
            f"{found.name}: a first order of the {other} fits better ({100 * found.other_nrmse:.1f} % against "
            f"{100 * found.nrmse:.1f} %): consider domain: {other} in the vehicle file"
        )
    if found.same_unit and len(found.response.used) and abs(found.gain - 1.0) > 0.1 + found.gain_half:
        said.append(
            f"{found.name}: the steady response is {found.gain:.2f} of what was asked: the thrust curve or the speed "
            "loop behind it is off"
        )
    return said


def curve_of(found: Study) -> Curve:
    """Steps used, one after the other, with the common response at each step's own levels."""
    x, measured, fitted, start = [], [], [], 0.0
    response = found.response
    for i in response.used:
        record = found.records[i]
        r = unit_response(record.t, response.delay, response.time_constant)
        rows = np.column_stack([np.ones_like(r), r])
        level, *_ = np.linalg.lstsq(rows, record.y, rcond=None)
        x.append(start + record.t - record.t[0])
        measured.append(record.y)
        fitted.append(rows @ level)
        start = float(x[-1][-1]) + response.sample
    unit = "thrust [N]" if found.domain == "force" else "shaft speed [rad/s]"
    return Curve(
        title=f"{found.name}: steps",
        x_label="time, steps one after the other [s]",
        y_label=unit,
        x=np.concatenate(x),
        measured=np.concatenate(measured),
        fitted=np.concatenate(fitted),
    )
