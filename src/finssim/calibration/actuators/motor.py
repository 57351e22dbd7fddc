"""From step logs to the response of a vehicle's motors, and a speed loop tuned from it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from finssim.calibration.actuators.motor_study import Study, study
from finssim.calibration.actuators.motor_trial import NRMSE, thrusters_of, unit_response
from finssim.calibration.actuators.speed_report import LOOP_RATE, loop_of
from finssim.calibration.errors import CalibrationError
from finssim.calibration.findings import Finding, finding
from finssim.calibration.fit import Curve, Estimate, Fit
from finssim.calibration.trials.trial import Trial
from finssim.vehicles import Vehicle
from finssim.vehicles.thruster import Thruster

__all__ = ["fit_motor"]

# Estimates, figures and curves of the motors' responses.

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


def findings_of(found: Study) -> list[Finding]:
    """What a reader of the numbers must know."""
    said = [one.about(motor.trial) for motor in found.motors for one in motor.findings]
    accepted = sum(step.accepted for step in found.response.steps)
    moved = sum(step.moved for step in found.response.steps)
    if moved == 0:
        said.append(finding("not_followed", found.name, column=found.motors[0].measured))
    elif accepted == 0:
        said.append(finding("steps_refused", found.name, limit=NRMSE, error=found.nrmse))
    elif accepted < moved:
        said.append(finding("steps_left_out", found.name, steps=moved - accepted, total=moved, limit=NRMSE))
    other = "speed" if found.domain == "force" else "force"
    if found.other_nrmse < 0.5 * found.nrmse and found.nrmse > 0.02:
        said.append(
            finding("other_domain", found.name, domain=other, other=found.other_nrmse, error=found.nrmse)
        )
    if found.same_unit and len(found.response.used) and abs(found.gain - 1.0) > 0.1 + found.gain_half:
        said.append(finding("steady_gain", found.name, gain=found.gain))
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


def fit_motor(
    trials: Iterable[Trial],
    vehicle: Vehicle,
    *,
    thrusters: Sequence[str] | None = None,
    loop_rate: float = LOOP_RATE,
    seed: int = 0,
) -> Fit:
    """Fit first order plus dead time to the steps of each thruster, in the vehicle file's domain.

    Thrusters that no trial steps get the mean of their propeller group's. All thrusters share one link, so the vehicle
    file gets one delay, the median of theirs.

    Args:
        trials: With a held and changed command and its response per thruster; see `motor_of` for the columns.
        vehicle: Whose thrusters they are; its curves turn thrust into speed.
        thrusters: The only ones to look at; all that the trials hold where not given.
        loop_rate: Of the motor controller's speed loop [Hz].
        seed: For the record; the intervals need no random numbers.

    Returns:
        Estimates `THRUSTER.time_constant`, `.delay`, `.gain`, `.dead_rpm_plus`, ...; `delay` of all; `speed_loop.*`.

    Raises:
        CalibrationError: No trial holds a command that steps and its response.
    """
    trials = list(trials)
    names = _names(trials, vehicle, thrusters)
    studies, findings = [], list[Finding]()
    for name in names:
        found = study(name, trials, vehicle.thrusters[name])
        if found is None:
            findings.append(finding("no_steps", name))
            continue
        studies.append(found)
        findings += findings_of(found)
    if not studies:
        raise CalibrationError(
            f"{', '.join(trial.name for trial in trials)}: no command holds a level and changes: log steps of at least "
            "0.5 s, such as those of 'finssim excite'"
        )
    estimates = [e for found in studies for e in estimates_of(found, vehicle.thrusters[found.name])]
    changes = {e.path: e.estimate for e in estimates if e.path is not None and e.identifiable}
    sure = [found for found in studies if is_sure(found)]
    if sure:
        estimates.insert(0, _common_delay(sure))
        changes["thrusters.*.delay"] = estimates[0].estimate
        changes |= _untested(sure, vehicle, changes, findings)
    quality = {found.name: quality_of(found) for found in studies}
    speeds = [_in_speed(found, trials, vehicle) for found in sure if not found.response.hidden]
    loop = loop_of([found for found in speeds if found is not None], vehicle, loop_rate=loop_rate)
    if loop is not None:
        estimates += loop.estimates
        quality["speed_loop"] = loop.quality
        findings += loop.findings
    return Fit(
        kind="motor",
        method="first order plus dead time",
        vehicle=vehicle,
        estimates={estimate.name: estimate for estimate in estimates},
        changes=changes,
        quality=quality,
        curves=tuple(curve_of(found) for found in studies),
        findings=tuple(dict.fromkeys(findings)),
        trials={trial.name: trial.sha256 for trial in trials},
        settings={"thrusters": thrusters, "loop_rate": loop_rate, "seed": seed},
    )


def _names(trials: Sequence[Trial], vehicle: Vehicle, thrusters: Sequence[str] | None) -> list[str]:
    held = list(dict.fromkeys(name for trial in trials for name in thrusters_of(trial)))
    unknown = [name for name in thrusters or () if name not in vehicle.thrusters]
    if unknown:
        raise CalibrationError(
            f"{vehicle.name} has no thruster '{unknown[0]}': it has {', '.join(vehicle.thrusters)}"
        )
    found = [name for name in vehicle.thrusters if name in held and (thrusters is None or name in thrusters)]
    if not found:
        shown = ", ".join(trial.name for trial in trials) or "no trial"
        raise CalibrationError(
            f"{shown}: no thruster of {vehicle.name} has a command (rpm_command_NAME, command_NAME or pwm_NAME) and a "
            f"response (rpm_NAME or force_NAME); its thrusters are {', '.join(vehicle.thrusters)}"
        )
    return found


def _common_delay(studies: Sequence[Study]) -> Estimate:
    """The delay of the link that all thrusters share."""
    delays = [found.response.delay for found in studies]
    ends = [found.response.delay_interval for found in studies]
    middle = float(np.median(delays))
    apart = max(delays) - min(delays)
    beyond = any(high < middle or low > middle for low, high in ends)
    note = f"median of {len(delays)} thrusters, which share one link"
    if beyond:
        note += f"; they differ by {apart:.3g} s, more than their intervals"
    return Estimate(
        name="delay",
        estimate=middle,
        ci95=(float(np.median([low for low, _ in ends])), float(np.median([high for _, high in ends]))),
        unit="s",
        identifiable=True,
        note=note,
        path="thrusters.*.delay",
    )


def _untested(
    studies: Sequence[Study], vehicle: Vehicle, changes: dict[str, Any], findings: list[Finding]
) -> dict[str, float]:
    """Time constants of the thrusters that no trial steps, from those of their group."""
    known: dict[str, list[float]] = {}
    for found in studies:
        if f"thrusters.{found.name}.time_constant" in changes:
            group = vehicle.thrusters[found.name].group
            known.setdefault(group, []).append(found.response.time_constant)
    tested = {found.name for found in studies}
    given = {
        name: float(np.mean(known[thruster.group]))
        for name, thruster in vehicle.thrusters.items()
        if name not in tested and thruster.group in known
    }
    findings += [finding("group_mean", name) for name in given]
    left = [name for name in vehicle.thrusters if name not in tested and name not in given]
    findings += [finding("file_response", name) for name in left]
    return {f"thrusters.{name}.time_constant": value for name, value in given.items()}


def _in_speed(found: Study, trials: Sequence[Trial], vehicle: Vehicle) -> Study | None:
    """The same thruster's speeds, for the speed loop; None where no speed was measured."""
    if not all(motor.measured.startswith("rpm_") for motor in found.motors):
        return None
    if found.domain == "speed":
        return found
    return study(found.name, trials, vehicle.thrusters[found.name], domain="speed")
