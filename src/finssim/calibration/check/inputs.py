"""Inputs of a trial against the limits of its vehicle."""

from __future__ import annotations

import numpy as np

from finssim.calibration.findings import Finding, finding
from finssim.calibration.trials.inputs import Drive
from finssim.calibration.trials.trial import Array, Trial
from finssim.vehicles import AXES, Vehicle

__all__ = ["input_findings"]

OFTEN = 0.05
"""Part of the driven time at a limit above which care is needed."""


def input_findings(trial: Trial, vehicle: Vehicle, inputs: Drive) -> list[Finding]:
    """What was assumed of the inputs, time at the limits, in the dead zones and beyond what the thrusters can give."""
    found = list(inputs.findings)
    if inputs.source == "passive":
        return found
    if not np.any(inputs.force):
        return [*found, finding("pulses_dead") if inputs.source == "pwm" else finding("inputs_zero")]
    found += _wrench_beyond(vehicle, inputs) if not inputs.thrusters else _thrusters(trial, vehicle, inputs)
    if inputs.end is not None:
        rest = trial.t[-1] - inputs.end
        found.append(finding("inputs_end", rest=rest, end=inputs.end - trial.t[0]))
    if inputs.source == "pwm" and not trial.has("voltage") and trial.header.voltage is None:
        found.append(finding("voltage_missing"))
    return found


def _wrench_beyond(vehicle: Vehicle, inputs: Drive) -> list[Finding]:
    found = []
    for i, (axis, limit) in enumerate(zip(AXES, vehicle.wrench_limits, strict=True)):
        tau = np.abs(inputs.force[:, i])
        if not tau.any() or limit == 0.0:
            continue
        beyond = float((tau > 1.05 * limit).sum() / (tau > 0.0).sum())
        if beyond > OFTEN:
            fields = {
                "column": inputs.names[i],
                "limit": float(limit),
                "unit": "N" if i < 3 else "N m",
                "vehicle": vehicle.name,
                "share": beyond,
                "axis": str(axis),
            }
            found.append(
                finding("command_beyond", **fields)
                if inputs.commanded
                else finding("wrench_beyond", **fields)
            )
    return found


def _thrusters(trial: Trial, vehicle: Vehicle, inputs: Drive) -> list[Finding]:
    found = []
    at_limit: list[str] = []
    slow: list[str] = []
    still: list[str] = []
    asked = inputs.commanded and inputs.source != "pwm"
    for name, force in zip(inputs.names, inputs.force.T, strict=True):
        thruster = vehicle.thrusters[name]
        driven = np.abs(force) > 0.0
        if not driven.any():
            still.append(name)
            continue
        beyond = (force > 0.99 * thruster.force_max) | (force < 0.99 * thruster.force_min)
        if inputs.source == "rpm":
            _, rpm = trial.series(f"rpm_{name}")
            beyond = (rpm > 0.99 * thruster.rpm_max) | (rpm < 0.99 * thruster.rpm_min)
        if beyond.mean() > OFTEN * driven.mean():
            at_limit.append(name)
        # Of measured speeds and of pulses the thrust is known down to nothing.
        rpm = thruster.speed(force) * 30.0 / np.pi
        if asked and _in_dead_zone(rpm, thruster.dead_rpm_minus, thruster.dead_rpm_plus) > 0.2:
            slow.append(name)
    if at_limit:
        found.append(finding("saturated", thrusters=tuple(at_limit), share=OFTEN))
    if slow:
        found.append(finding("in_dead_zone", thrusters=tuple(slow)))
    if still:
        found.append(finding("never_pushed", thrusters=tuple(still)))
    return found


def _in_dead_zone(rpm: Array, lowest: float, highest: float) -> float:
    """Part of the driven time in which a shaft would stand still."""
    driven = np.abs(rpm) > 1.0
    inside = (rpm > 0.95 * lowest) & (rpm < 0.95 * highest) & driven
    return float(inside.sum() / max(1, driven.sum()))
