"""Command and response of a thruster in a trial, in the quantity on which its lag acts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.actuators.steps import Step, find_steps
from finssim.calibration.findings import Finding, finding
from finssim.calibration.motion.smoothing import without_spikes
from finssim.calibration.trials.trial import Trial
from finssim.vehicles.thruster import Thruster

__all__ = [
    "DOMAINS",
    "Motor",
    "levels_of",
    "motor_of",
    "steps_of",
    "thrusters_of",
    "StepFit",
    "StepRecord",
    "cut_steps",
    "step_fit",
    "unit_response",
]

Array = NDArray[np.float64]

# One step of a motor: its samples, and what they say by themselves.

OVERSHOOT, NRMSE = 0.10, 0.10
"""A step is accepted up to this overshoot and this error over its height (facts, §5)."""
BEFORE = 0.3
"""Longest part of the level before a step that is fitted with it [s]."""


@dataclass(frozen=True, kw_only=True)
class StepRecord:
    """Samples around one step of the command."""

    trial: str
    t: Array
    """Since the step [s], (n,)."""
    y: Array
    """Response, (n,)."""
    before: float
    """Command until the step."""
    after: float
    """Command from the step on."""
    sample: float
    """Time in which the command's change is not told apart [s]."""


@dataclass(frozen=True, kw_only=True)
class StepFit:
    """One step by itself."""

    height: float
    """Of the response, from level to level."""
    final: float
    """Level that the response ends on."""
    nrmse: float
    """Error of the common response, over the height."""
    overshoot: float
    """Beyond the final level, over the height; noise taken off."""
    rise: float
    """From 10 % to 90 % of the height [s]; NaN where the samples are too few."""
    moved: bool
    """Whether the response follows the command at all; it does not inside a dead zone."""
    accepted: bool


def cut_steps(
    trial: str, t: Array, y: Array, command_times: Array, steps: Sequence[Step], *, least: int = 5
) -> list[StepRecord]:
    """Samples of the response around every step; steps with fewer than `least` samples after them are left out.

    The level before a step is taken along where it has settled.

    Args:
        trial: Its name.
        t: Times of the response's samples [s], (n,).
        y: Response, (n,).
        command_times: Times of the command's samples [s], (m,).
        steps: Of the command; see `find_steps`.
        least: Samples.
    """
    records = []
    previous = float(t[0]) if t.size else 0.0
    for step in steps:
        after = (t >= step.time) & (t <= step.end)
        before = (t < step.time) & (t >= max(previous, step.time - BEFORE))
        lately = y[(t < step.time) & (t >= previous + 0.5 * (step.time - previous))]
        scatter = float(np.ptp(lately)) if lately.size else np.inf
        moved = float(np.ptp(y[after])) if after.any() else 0.0
        rows = after | before if scatter < 0.25 * moved else after
        if np.count_nonzero(after) >= least:
            near = np.diff(command_times[(command_times >= previous) & (command_times <= step.end)])
            records.append(
                StepRecord(
                    trial=trial,
                    t=t[rows] - step.time,
                    y=y[rows],
                    before=step.before,
                    after=step.after,
                    sample=float(np.median(near)) if near.size else step.time - step.start,
                )
            )
        previous = step.time
    return records


def unit_response(t: Array, delay: Array | float, time_constant: Array | float) -> Array:
    """Unit response of first order plus dead time, (n,).

    Args:
        t: Time since the step [s], (n,).
        delay: Dead time [s], a number or (n,).
        time_constant: Of the first order [s], a number or (n,).
    """
    since = np.maximum(t - delay, 0.0)
    return 1.0 - np.exp(-since / time_constant)


def step_fit(record: StepRecord, delay: float, time_constant: float, *, moved: bool) -> StepFit:
    """Levels, error, overshoot and rise of one step under the common response.

    Args:
        record: The step.
        delay: Dead time [s].
        time_constant: Of the first order [s].
        moved: Whether the response followed the command.
    """
    r = unit_response(record.t, delay, time_constant)
    rows = np.column_stack([np.ones_like(r), r])
    (a, b), *_ = np.linalg.lstsq(rows, record.y, rcond=None)
    error = record.y - rows @ np.array([a, b])
    final = float(np.mean(record.y[record.t >= 0.75 * record.t[-1]]))
    height = final - float(a)
    size = max(abs(height), 1e-300)
    nrmse = float(np.sqrt(np.mean(error**2))) / size
    overshoot = _overshoot(record, float(a), final)
    return StepFit(
        height=height,
        final=final,
        nrmse=nrmse,
        overshoot=overshoot,
        rise=_rise(record, float(a), final),
        moved=moved,
        accepted=bool(moved and nrmse <= NRMSE and overshoot <= OVERSHOOT and size > 1e-12),
    )


def _overshoot(record: StepRecord, start: float, final: float) -> float:
    """Largest excursion beyond the final level over the height, of means of three samples, less twice their noise."""
    beyond = (record.y[record.t > 0.0] - final) * np.sign(final - start)
    if beyond.size < 5 or final == start:
        return 0.0
    settled = record.y[record.t >= 0.75 * record.t[-1]]
    smooth = np.convolve(beyond, np.full(3, 1.0 / 3.0), "valid")
    noise = 2.0 * float(np.std(settled)) / math.sqrt(3.0)
    return max(float(np.max(smooth)) - noise, 0.0) / float(abs(final - start))


def _rise(record: StepRecord, start: float, final: float) -> float:
    """Time from 10 % to 90 % of the height, by the samples' first crossings."""
    after = record.t >= 0.0
    t, share = (
        record.t[after],
        (record.y[after] - start) / (final - start) if final != start else record.y[after],
    )
    crossings = []
    for level in (0.1, 0.9):
        above = np.flatnonzero(share >= level)
        if above.size == 0:
            return float("nan")
        k = int(above[0])
        crossings.append(
            float(t[k]) if k == 0 else float(np.interp(level, [share[k - 1], share[k]], [t[k - 1], t[k]]))
        )
    return crossings[1] - crossings[0]


DOMAINS = ("force", "speed")
"""Thrust [N] and shaft speed [rad/s]."""

RPM = math.pi / 30.0


@dataclass(frozen=True, kw_only=True)
class Motor:
    """One thruster of one trial: what was asked and what came, thrust [N] or shaft speed [rad/s]."""

    trial: str
    command_times: Array
    command: Array
    held: Array
    """The command as a speed (or pulse), in which small steps are as plain as large ones."""
    t: Array
    response: Array
    asked: str
    """Column of the command."""
    measured: str
    """Column of the response."""
    same_unit: bool
    """Whether command and response are the same quantity; pulses without an ESC's law are not."""
    findings: tuple[Finding, ...] = ()


def thrusters_of(trial: Trial) -> list[str]:
    """Names of the thrusters of which a trial has a command and a response."""
    names = {
        column[len(prefix) :]
        for column in trial.channels
        for prefix in ("rpm_", "force_")
        if column.startswith(prefix) and not column.startswith("rpm_command_")
    }
    return sorted(name for name in names if _columns(trial, name) is not None)


def motor_of(trial: Trial, name: str, thruster: Thruster, domain: str) -> Motor | None:
    """Command and response of a thruster.

    Commands, the first that is there: `rpm_command_NAME` [rpm], `command_NAME` [N], `pwm_NAME` [µs], and `force_NAME`
    where the header says that inputs are commanded and speeds are measured. Responses: `rpm_NAME`, else `force_NAME`.
    Thrust and speed turn into each other by the thruster's curve. A response without sign gets the command's.

    Returns:
        None where the trial has not both.
    """
    columns = _columns(trial, name)
    if columns is None:
        return None
    asked, measured = columns
    findings: list[Finding] = []
    command_times, raw = trial.series(asked)
    same_unit, held = True, raw
    if asked.startswith("pwm_") and thruster.esc is None:
        command, same_unit = raw - 1500.0, False
        findings.append(finding("pulses_raw"))
    elif asked.startswith("pwm_"):
        command = _as(domain, thruster.shaft_speed(raw, _voltage(trial, command_times)), thruster, "speed")
    elif asked.startswith("rpm_"):
        command = _as(domain, raw * RPM, thruster, "speed")
    else:
        command, held = _as(domain, raw, thruster, "force"), thruster.speed(raw)
    t, raw = _without_spikes(*trial.series(measured), findings, measured)
    if np.min(command) < 0.0 < np.max(raw) and np.min(raw) > -0.02 * np.max(raw):
        sign = _last_sign(command)
        latest = np.clip(np.searchsorted(command_times, t, side="right") - 1, 0, len(sign) - 1)
        raw = np.abs(raw) * sign[latest]
        findings.append(finding("sign_of_command", column=measured))
    from_unit = "speed" if measured.startswith("rpm_") else "force"
    response = _as(domain, raw * RPM if from_unit == "speed" else raw, thruster, from_unit)
    return Motor(
        trial=trial.name,
        command_times=command_times,
        command=command,
        held=held,
        t=t,
        response=response,
        asked=asked,
        measured=measured,
        same_unit=same_unit,
        findings=tuple(findings),
    )


def _columns(trial: Trial, name: str) -> tuple[str, str] | None:
    """Columns of command and response, or None."""
    responses = [column for column in (f"rpm_{name}", f"force_{name}") if trial.has(column)]
    commands = [c for c in (f"rpm_command_{name}", f"command_{name}", f"pwm_{name}") if trial.has(c)]
    if not commands and trial.header.inputs == "commanded" and len(responses) == 2:
        commands = [responses.pop()]
    return (commands[0], responses[0]) if commands and responses else None


def _without_spikes(t: Array, y: Array, findings: list[Finding], column: str) -> tuple[Array, Array]:
    """Samples far from their neighbours left out: a lost telegram, a zero in between."""
    good = without_spikes(t, y[:, None])
    if not good.all():
        findings.append(finding("spikes", samples=np.count_nonzero(~good), column=column))
    return t[good], y[good]


def _voltage(trial: Trial, times: Array) -> Array | float | None:
    if trial.has("voltage"):
        return np.interp(times, *trial.series("voltage"))
    return trial.header.voltage


def _as(domain: str, values: Array, thruster: Thruster, unit: str) -> Array:
    if domain == unit:
        return values
    return thruster.thrust(values) if domain == "force" else thruster.speed(values)


def _last_sign(command: Array) -> Array:
    """Sign of the last command that was not zero, at every sample; until the first one, the first's."""
    sign = np.sign(command)
    known = np.flatnonzero(sign)
    index = np.maximum.accumulate(np.where(sign != 0.0, np.arange(len(sign)), known[0]))
    return np.asarray(sign[index])


def steps_of(motor: Motor) -> list[Step]:
    """Steps of the command, with their levels in the motor's domain."""
    steps = []
    for step in find_steps(motor.command_times, motor.held):
        before = int(np.searchsorted(motor.command_times, step.start))
        after = int(np.searchsorted(motor.command_times, step.time))
        steps.append(step._replace(before=float(motor.command[before]), after=float(motor.command[after])))
    return steps


def levels_of(motor: Motor) -> list[tuple[float, float]]:
    """Held commands and the response at the end of each."""
    found = []
    for step in steps_of(motor):
        rows = (motor.t >= step.end - 0.4 * (step.end - step.time)) & (motor.t <= step.end)
        if np.any(rows):
            found.append((step.after, float(np.mean(motor.response[rows]))))
    return found
