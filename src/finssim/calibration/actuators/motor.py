"""From step logs to the response of a vehicle's motors, and a speed loop tuned from it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from finssim.calibration.actuators.motor_report import (
    curve_of,
    estimates_of,
    is_sure,
    quality_of,
    warnings_of,
)
from finssim.calibration.actuators.motor_study import Study, study
from finssim.calibration.actuators.motor_trial import thrusters_of
from finssim.calibration.actuators.speed_report import LOOP_RATE, loop_of
from finssim.calibration.errors import CalibrationError
from finssim.calibration.fit import Estimate, Fit
from finssim.calibration.trials.trial import Trial
from finssim.vehicles import Vehicle

__all__ = ["fit_motor"]


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
    studies, warnings = [], []
    for name in names:
        found = study(name, trials, vehicle.thrusters[name])
        if found is None:
            warnings.append(f"{name}: its command holds no steps, nothing was fitted")
            continue
        studies.append(found)
        warnings += warnings_of(found)
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
        changes |= _untested(sure, vehicle, changes, warnings)
    quality = {found.name: quality_of(found) for found in studies}
    speeds = [_in_speed(found, trials, vehicle) for found in sure if not found.response.hidden]
    loop = loop_of([found for found in speeds if found is not None], vehicle, loop_rate=loop_rate)
    if loop is not None:
        estimates += loop.estimates
        quality["speed_loop"] = loop.quality
        warnings += loop.warnings
    return Fit(
        kind="motor",
        method="first order plus dead time",
        vehicle=vehicle,
        estimates={estimate.name: estimate for estimate in estimates},
        changes=changes,
        quality=quality,
        curves=tuple(curve_of(found) for found in studies),
        warnings=tuple(dict.fromkeys(warnings)),
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
    studies: Sequence[Study], vehicle: Vehicle, changes: dict[str, Any], warnings: list[str]
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
    if given:
        warnings.append(f"{', '.join(given)}: no steps; they get the mean time constant of their group")
    left = [name for name in vehicle.thrusters if name not in tested and name not in given]
    if left:
        warnings.append(f"{', '.join(left)}: no steps; they keep the vehicle file's time constant")
    return {f"thrusters.{name}.time_constant": value for name, value in given.items()}


def _in_speed(found: Study, trials: Sequence[Trial], vehicle: Vehicle) -> Study | None:
    """The same thruster's speeds, for the speed loop; None where no speed was measured."""
    if not all(motor.measured.startswith("rpm_") for motor in found.motors):
        return None
    if found.domain == "speed":
        return found
    return study(found.name, trials, vehicle.thrusters[found.name], domain="speed")
