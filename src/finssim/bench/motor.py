"""Response of a vehicle's motors, fitted to step logs.

First order plus dead time, K e^(-T_d s) / (τ s + 1), in the quantity to which the vehicle file applies the lag.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.bench.levels import LevelStep, find_steps
from finssim.bench.solve import Solution, solve
from finssim.identification.fit import Curve, Estimate, Fit
from finssim.identification.report import finish, refuse_places, usable_trials
from finssim.trials.findings import CalibrationError, Finding, finding
from finssim.trials.motion import without_spikes
from finssim.trials.trial import Trial
from finssim.vehicles import Vehicle, load_vehicle
from finssim.vehicles.thruster import Thruster

__all__ = ["cut_steps", "fit_motor", "fit_response"]

Array = NDArray[np.float64]

RPM = math.pi / 30.0

UNIT = {"force": "N", "speed": "rad/s"}
"""Domain of a thruster's lag -> unit of the response."""

OTHER = {"force": "speed", "speed": "force"}
"""Domain -> the other one."""

BEFORE = 0.3
"""Longest part of the level before a step that is included in its fit [s]."""

FEWEST = 5
"""Least number of samples after a step."""

SETTLED = 0.4
"""Final fraction of a level that counts as settled [-]."""


@dataclass(frozen=True, kw_only=True)
class StepRecord:
    """Samples around one step of the command."""

    trial: str
    t: Array
    """Times since the step [s], (n,)."""
    y: Array
    """Response, thrust [N] or shaft speed [rad/s], (n,)."""
    sample: float
    """Sampling period of the command, which limits the accuracy of the time of its change [s]."""


@dataclass(frozen=True, kw_only=True)
class MotorLog:
    """Steps and levels of one thruster in one trial, in thrust [N] or shaft speed [rad/s]."""

    records: list[StepRecord]
    levels: list[tuple[float, float]]
    """Held commands, in the unit of the command, and the response at the end of each."""
    measured: str
    """Column of the measured response."""
    same_unit: bool
    """True if command and response are the same quantity, unlike pulses without a speed controller law."""
    findings: tuple[Finding, ...]


def log_of(trial: Trial, name: str, thruster: Thruster) -> MotorLog | None:
    """Return command and response of a thruster in the domain of its lag; None if the trial lacks one of them.

    The command is the first of `rpm_command_NAME` [rpm], `command_NAME` [N] and `pwm_NAME` [µs] in the trial,
    or `force_NAME` if the header states that inputs are commanded and speeds are measured. The response is
    `rpm_NAME`, otherwise `force_NAME`. The thruster's curve converts between thrust and speed. An unsigned
    response gets the sign of the command.
    """
    columns = _columns(trial, name)
    if columns is None:
        return None
    column, measured = columns
    findings: list[Finding] = []
    times, raw = trial.series(column)
    same_unit, held = True, raw
    if column.startswith("pwm_") and thruster.esc is None:
        command, same_unit = raw - 1500.0, False
        findings.append(finding("pulses_raw"))
    elif column.startswith("pwm_"):
        voltage = np.interp(times, *trial.series("voltage")) if trial.has("voltage") else trial.header.voltage
        command = _converted(thruster.shaft_speed(raw, voltage), "speed", thruster)
    elif column.startswith("rpm_"):
        command = _converted(raw * RPM, "speed", thruster)
    else:
        # Steps are detected in the speed, in which small steps of a force are as visible as large ones.
        command, held = _converted(raw, "force", thruster), thruster.speed(raw)
    t, raw = trial.series(measured)
    good = without_spikes(t, raw[:, None])
    if not good.all():
        findings.append(finding("spikes", samples=np.count_nonzero(~good), column=measured))
    t, raw = t[good], raw[good]
    if np.min(command) < 0.0 < np.max(raw) and np.min(raw) > -0.02 * np.max(raw):
        latest = np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(times) - 1)
        raw = np.abs(raw) * _last_sign(command)[latest]
        findings.append(finding("sign_of_command", column=measured))
    unit, size = ("speed", RPM) if measured.startswith("rpm_") else ("force", 1.0)
    response = _converted(raw * size, unit, thruster)
    steps, levels = find_steps(times, held), []
    for step in steps:
        rows = (t >= step.end - SETTLED * (step.end - step.time)) & (t <= step.end)
        if rows.any():
            level = float(command[np.searchsorted(times, step.time)])
            levels.append((level, float(np.mean(response[rows]))))
    return MotorLog(
        records=cut_steps(trial.name, t, response, times, steps),
        levels=levels,
        measured=measured,
        same_unit=same_unit,
        findings=tuple(findings),
    )


def cut_steps(
    trial: str, t: Array, y: Array, command_times: Array, steps: Sequence[LevelStep]
) -> list[StepRecord]:
    """Return the samples of the response around every step with at least `FEWEST` samples after it.

    The level before a step is included if it has settled.

    Args:
        trial: Name of the trial.
        t: Times of the response's samples [s], (n,).
        y: Response, thrust [N] or shaft speed [rad/s], (n,).
        command_times: Times of the command's samples [s], (m,).
        steps: Steps of the command.
    """
    records = []
    previous = float(t[0]) if t.size else 0.0
    for start, time, end in steps:
        after = (t >= time) & (t <= end)
        before = (t < time) & (t >= max(previous, time - BEFORE))
        lately = y[(t < time) & (t >= previous + 0.5 * (time - previous))]
        scatter = float(np.ptp(lately)) if lately.size else np.inf
        moved = float(np.ptp(y[after])) if after.any() else 0.0
        rows = after | before if scatter < 0.25 * moved else after
        if np.count_nonzero(after) >= FEWEST:
            near = np.diff(command_times[(command_times >= previous) & (command_times <= end)])
            sample = float(np.median(near)) if near.size else time - start
            records.append(StepRecord(trial=trial, t=t[rows] - time, y=y[rows], sample=sample))
        previous = time
    return records


def _columns(trial: Trial, name: str) -> tuple[str, str] | None:
    """Return the columns of command and response, or None."""
    responses = [column for column in (f"rpm_{name}", f"force_{name}") if trial.has(column)]
    commands = [c for c in (f"rpm_command_{name}", f"command_{name}", f"pwm_{name}") if trial.has(c)]
    if not commands and trial.header.inputs == "commanded" and len(responses) == 2:
        commands = [responses.pop()]
    return (commands[0], responses[0]) if commands and responses else None


def _converted(values: Array, unit: str, thruster: Thruster) -> Array:
    """Return values of a thrust or speed in the domain of a thruster's lag."""
    if thruster.domain == unit:
        return values
    return thruster.thrust(values) if unit == "speed" else thruster.speed(values)


def _last_sign(command: Array) -> Array:
    """Return the sign of the latest command that was not zero, at every sample; before it, that of the first."""
    sign = np.sign(command)
    nonzero = np.flatnonzero(sign)
    index = np.maximum.accumulate(np.where(sign != 0.0, np.arange(len(sign)), nonzero[0]))
    return np.asarray(sign[index])


GRID = 21
"""Number of dead times, and of time constants, in the coarse search."""

LONGEST_DELAY, DELAY_SHARE = 0.8, 0.45
"""Bounds of the dead time: T_d <= min(0.8 s, 0.45 of the step's duration) (facts, §5)."""

OVERSHOOT, NRMSE = 0.10, 0.10
"""Greatest overshoot and normalized error of an accepted step (facts, §5)."""

FEWEST_TRIALS = 4
"""Least number of trials for intervals over trials; with fewer, intervals are over steps."""


@dataclass(frozen=True, kw_only=True)
class MotorResponse:
    """Response common to all steps."""

    delay: float
    """Dead time T_d [s]."""
    time_constant: float
    """Time constant τ [s]."""
    delay_interval: tuple[float, float]
    """95 % interval of the delay [s]."""
    time_constant_interval: tuple[float, float]
    """95 % interval of the time constant [s]."""
    sample: float
    """Median sampling period of the response [s]."""
    nrmse: Array
    """Error of every step relative to its height [-], (n,)."""
    overshoot: Array
    """Overshoot of every step beyond its final level relative to its height, minus noise [-], (n,)."""
    moved: NDArray[np.bool_]
    """True if the response follows a step, which it does not inside a dead zone, (n,)."""
    accepted: NDArray[np.bool_]
    """True if a step follows first order plus dead time, (n,)."""
    used: NDArray[np.bool_]
    """True if a step was fitted: the accepted steps, or all that moved if none is accepted, (n,)."""

    @property
    def hidden(self) -> bool:
        """True if the time constant is below half a sample, where the log does not distinguish it from 0."""
        return self.time_constant < 0.5 * self.sample

    @property
    def error(self) -> float:
        """Return the median error of the steps used, relative to their height [-]."""
        return float(np.median(self.nrmse[self.used]))


def fit_response(records: Sequence[StepRecord]) -> MotorResponse:
    """Fit one dead time and one time constant to all steps, with separate levels for every step.

    y = a + b (1 - e^(-(t - T_d) / τ)) from t = T_d on, with a and b of each step by least squares (variable
    projection), so that static nonlinearity (dead zone, thrust curve) does not affect the dynamics. A coarse grid of
    T_d and τ gives the first guess.

    Args:
        records: Steps, of which the response follows at least one.

    Returns:
        Estimates with 95 % intervals over the steps, or over the trials if there are four or more; the interval of T_d
        includes half the sampling period of the command.
    """
    sample = float(np.median(np.concatenate([np.diff(record.t) for record in records])))
    duration = float(np.median([record.t[-1] for record in records]))
    longest = min(LONGEST_DELAY, DELAY_SHARE * duration)
    low, high = np.array([0.0, math.log(0.1 * sample)]), np.array([longest, math.log(duration)])
    corners = np.stack(np.meshgrid(*np.linspace(low, high, GRID).T), axis=-1).reshape(-1, 2)
    power = np.array([float(np.var(record.y)) * len(record.y) for record in records])
    remainder = np.array(
        [[float(np.sum(_step_fit(record, x)[2] ** 2)) for record in records] for x in corners]
    )
    explained = 1.0 - remainder.min(axis=0) / np.maximum(power, 1e-300)
    moved = (explained > 0.5) & (power > 0.0)
    first = moved if moved.any() else np.arange(len(records)) == np.argmax(explained)
    spread = (remainder / np.maximum(power, 1e-300))[:, first].sum(axis=1)
    x = _solved(records, first, corners[np.argmin(spread)], low, high).x
    nrmse, overshoot = np.array([_figures(record, x) for record in records]).T
    accepted = moved & (nrmse <= NRMSE) & (overshoot <= OVERSHOOT)
    used = accepted if accepted.any() else first
    found = _solved(records, used, x, low, high)
    nrmse, overshoot = np.array([_figures(record, found.x) for record in records]).T
    blur = 0.5 * float(np.median([record.sample for record, on in zip(records, used, strict=True) if on]))
    (delay, log_tau), (late, slow) = found.x, found.half
    ends = np.exp(np.clip([log_tau - slow, log_tau + slow], -50.0, 50.0))
    return MotorResponse(
        delay=float(delay),
        time_constant=math.exp(log_tau),
        delay_interval=(max(float(delay - late) - blur, 0.0), float(delay + late) + blur),
        time_constant_interval=(float(ends[0]), float(ends[1])),
        sample=sample,
        nrmse=nrmse,
        overshoot=overshoot,
        moved=moved,
        accepted=accepted,
        used=used,
    )


def unit_response(t: Array, x: Array) -> Array:
    """Return 1 - e^(-(t - T_d) / τ) from T_d on, and 0 before, (n,).

    Times are in [s].

    Args:
        t: Time since the step [s], (n,).
        x: T_d [s] and ln τ, τ in s, (2,).
    """
    return np.asarray(-np.expm1(-np.maximum(t - x[0], 0.0) / math.exp(x[1])))


def _step_fit(record: StepRecord, x: Array) -> tuple[float, float, Array]:
    """Return the best level before a step and its height, in the unit of the response, and the residual, (n,)."""
    r, y = unit_response(record.t, x), record.y - record.y.mean()
    rise = r - r.mean()
    power = float(rise @ rise)
    height = float(rise @ y) / power if power > 1e-12 else 0.0
    return float(record.y.mean()) - height * float(r.mean()), height, np.asarray(y - rise * height)


def _solved(
    records: Sequence[StepRecord], which: NDArray[np.bool_], x: Array, low: Array, high: Array
) -> Solution:
    """Fit T_d and ln τ to some of the steps; intervals are over steps, or over trials if there are four or more."""
    chosen = [record for record, on in zip(records, which, strict=True) if on]
    scale = [max(float(np.std(record.y)), 1e-300) for record in chosen]
    trials = np.unique([record.trial for record in chosen], return_inverse=True)[1]
    group = trials if trials.max() + 1 >= FEWEST_TRIALS else np.arange(len(chosen))
    sizes = [len(record.y) for record in chosen]

    def residual(x: Array) -> Array:
        return np.concatenate([_step_fit(record, x)[2] / s for record, s in zip(chosen, scale, strict=True)])

    return solve(
        residual,
        np.clip(x, low + 1e-6, high - 1e-6),
        [np.repeat(group, sizes)],
        breaks=np.cumsum(sizes)[:-1].tolist(),
        bounds=(low, high),
        x_scale=(0.01, 0.1),
        diff_step=1e-5,
    )


def _figures(record: StepRecord, x: Array) -> tuple[float, float]:
    """Return the error of one step and its greatest overshoot, that of means of three samples minus twice
    their noise, both relative to its height."""
    start, _, residual = _step_fit(record, x)
    settled = record.y[record.t >= 0.75 * record.t[-1]]
    height = float(np.mean(settled)) - start
    error = float(np.sqrt(np.mean(residual**2))) / max(abs(height), 1e-300)
    beyond = (record.y[record.t > 0.0] - np.mean(settled)) * np.sign(height)
    if len(beyond) < FEWEST or height == 0.0:
        return error, 0.0
    smooth = np.convolve(beyond, np.full(3, 1.0 / 3.0), "valid")
    noise = 2.0 * float(np.std(settled)) / math.sqrt(3.0)
    return error, max(float(np.max(smooth)) - noise, 0.0) / abs(height)


STANDING = 0.02
"""Fraction of the greatest response below which a held level counts as standstill [-]."""

NARROW_DEAD_ZONE = 2.0
"""Greatest ratio of the smallest command that turns the shaft to the largest that does not, for a determined
dead zone."""


@dataclass(frozen=True)
class Study:
    """Data and fit of one thruster over all its trials."""

    name: str
    thruster: Thruster
    """The thruster of the vehicle file, whose curve converts between thrust and speed."""
    logs: tuple[MotorLog, ...]
    response: MotorResponse
    other_error: float
    """Error of the same fit in the other domain, relative to the steps' height; NaN if it is not possible [-]."""

    @property
    def same_unit(self) -> bool:
        """True if gains and dead zone compare the same quantity."""
        return all(log.same_unit for log in self.logs)

    @property
    def sure(self) -> bool:
        """True if a step follows first order plus dead time, so that the numbers are written."""
        return bool(self.response.accepted.any())

    @property
    def levels(self) -> tuple[list[tuple[float, float]], list[tuple[float, float]]]:
        """Return commands and responses of all levels, and of the levels at which the shaft turns, in the units of the
        log."""
        pairs = [pair for log in self.logs for pair in log.levels]
        largest = max((abs(y) for _, y in pairs), default=0.0)
        return pairs, [(u, y) for u, y in pairs if u != 0.0 and abs(y) > STANDING * largest]

    @property
    def gain(self) -> tuple[float, float]:
        """Return the steady response divided by the command, by least squares, and the half-width of its interval.

        Both are in the unit of the response divided by that of the command.
        """
        _, moving = self.levels
        if not moving:
            return math.nan, math.inf
        u, y = np.array(moving).T
        if len(u) < 3:
            return float(u @ y / (u @ u)), math.inf
        found = solve(lambda x: y - x[0] * u, [float(u @ y / (u @ u))], [np.arange(len(u))])
        return float(found.x[0]), float(found.half[0])


def study(name: str, trials: Sequence[Trial], thruster: Thruster) -> Study | None:
    """Fit one thruster over all trials that contain it; return None if its command has no steps.

    Args:
        name: Name of the thruster.
        trials: All trials.
        thruster: The thruster of the vehicle file.
    """
    swapped = thruster.model_copy(update={"domain": OTHER[thruster.domain]})
    logs, others = (
        [log for trial in trials if (log := log_of(trial, name, one)) is not None]
        for one in (thruster, swapped)
    )
    records, other = ([record for log in some for record in log.records] for some in (logs, others))
    if not records:
        return None
    other_error = fit_response(other).error if other else math.nan
    return Study(name, thruster, tuple(logs), fit_response(records), other_error)


def estimates_of(result: Study) -> list[Estimate]:
    """Return the estimates of K, T_d, τ and the dead zone of one thruster."""
    response, name, domain = result.response, result.name, result.thruster.domain
    count = int(response.used.sum())
    rests = f"{count} step{'s' if count != 1 else ''} sampled every {response.sample:.3g} s"
    if not result.sure:
        rests += ": no step follows first order plus dead time within 10 %"
    if response.hidden:
        rests += "; below half a sample it is indistinguishable from 0"
    late = "the command's change is known to one sample of its log; the interval includes this"
    if response.delay < response.sample:
        late = f"delay {response.delay:.3g} s is below one sample of {response.sample:.3g} s"
    gain, half = result.gain
    unit = "-" if result.same_unit else f"{UNIT[domain]}/µs"
    steady = f"steady {'thrust' if domain == 'force' else 'speed'} over its command"
    lag, ends = f"{name}.time_constant", response.time_constant_interval
    certain = result.sure and not response.hidden
    estimates = [
        Estimate(lag, response.time_constant, ends, "s", certain, rests, f"thrusters.{lag}"),
        Estimate(f"{name}.delay", response.delay, response.delay_interval, "s", result.sure, late),
        Estimate(
            f"{name}.gain",
            gain,
            (gain - half, gain + half),
            unit,
            math.isfinite(half) and half < abs(gain),
            steady,
        ),
    ]
    return estimates + (_dead_zones(result) if result.same_unit else [])


def _dead_zones(result: Study) -> list[Estimate]:
    """Return the slowest speed of each direction, between the last command without and the first with rotation."""
    (pairs, moving), thruster = result.levels, result.thruster
    estimates = []
    for side, sign in (("plus", 1.0), ("minus", -1.0)):
        turn = [sign * u for u, _ in moving if sign * u > 0.0]
        if not turn:
            continue
        stand = [sign * u for u, y in pairs if sign * u > 0.0 and (u, y) not in moving]
        low, high = max([u for u in stand if u < min(turn)], default=0.0), min(turn)
        if thruster.domain == "force":
            low, high = (abs(float(thruster.speed(sign * force))) for force in (low, high))
        bracketed = low > 0.0 and high <= NARROW_DEAD_ZONE * low
        note = "no commands were logged between the last without and the first with rotation"
        if bracketed:
            note = "between the last command without and the first with rotation"
        elif low == 0.0:
            note = f"the smallest command tried, {high / RPM:.0f} rpm, already turns the shaft"
        ends = sorted((sign * low / RPM + 0.0, sign * high / RPM + 0.0))
        rpm = sign * (0.5 * (low + high) if low > 0.0 else 0.0) / RPM + 0.0
        name = f"{result.name}.dead_rpm_{side}"
        estimates.append(Estimate(name, rpm, (ends[0], ends[1]), "rpm", bracketed, note, f"thrusters.{name}"))
    return estimates


def quality_of(result: Study) -> dict[str, float]:
    """Return figures of the fit: overshoot, steady error and normalized error of the steps.

    Each is a fraction.
    """
    response, (_, moving) = result.response, result.levels
    errors = [abs(y - u) / abs(u) for u, y in moving]
    return {
        "nrmse": response.error,
        "overshoot": float(response.overshoot[response.used].max(initial=0.0)),
        "steady_error": float(np.mean(errors)) if errors and result.same_unit else math.nan,
        "steps": float(len(response.nrmse)),
        "accepted": float(response.accepted.sum()),
        "sample": response.sample,
        "nrmse_other_domain": result.other_error,
    }


def findings_of(result: Study) -> list[Finding]:
    """Return the findings about one thruster."""
    response, (gain, half) = result.response, result.gain
    out = [item.about(log.records[0].trial) for log in result.logs for item in log.findings if log.records]
    accepted, moved = int(response.accepted.sum()), int(response.moved.sum())
    if moved == 0:
        out.append(finding("not_followed", result.name, column=result.logs[0].measured))
    elif accepted == 0:
        out.append(finding("steps_refused", result.name, limit=NRMSE, error=response.error))
    elif accepted < moved:
        out.append(finding("steps_left_out", result.name, steps=moved - accepted, total=moved, limit=NRMSE))
    if result.other_error < 0.5 * response.error and response.error > 0.02:
        other = OTHER[result.thruster.domain]
        out.append(
            finding("other_domain", result.name, domain=other, other=result.other_error, error=response.error)
        )
    if result.same_unit and abs(gain - 1.0) > 0.1 + half:
        out.append(finding("steady_gain", result.name, gain=gain))
    return out


def curve_of(result: Study) -> Curve:
    """Return the used steps in sequence, with the common response at each step's own levels."""
    response, parts = result.response, []
    records = np.array([record for log in result.logs for record in log.records], dtype=object)
    x = np.array([response.delay, math.log(response.time_constant)])
    for record in records[response.used]:
        parts.append((record.t, record.y, record.y - _step_fit(record, x)[2]))
    unit = "thrust [N]" if result.thruster.domain == "force" else "shaft speed [rad/s]"
    return Curve.joined(f"{result.name}: steps", unit, parts)


def fit_motor(trials: Iterable[Trial], vehicle: Vehicle) -> Fit:
    """Fit first order plus dead time to the steps of each thruster, in the vehicle file's domain.

    Thrusters without steps get the mean of their propeller group. All thrusters share one link, so the vehicle file
    gets one delay, the median over the thrusters.

    Args:
        trials: Trials with steps of a command and its response per thruster; see `log_of` for the columns.
        vehicle: Vehicle of the thrusters, whose curves convert thrust to speed.

    Returns:
        Estimates `THRUSTER.time_constant`, `.delay`, `.gain`, `.dead_rpm_plus`, ...; `delay` of all.

    Raises:
        CalibrationError: No trial contains steps of a command and its response.
    """
    trials = list(trials)
    studies, findings = [], list[Finding]()
    for name in _names(trials, vehicle):
        result = study(name, trials, vehicle.thrusters[name])
        if result is None:
            findings.append(finding("no_steps", name))
            continue
        studies.append(result)
        findings += findings_of(result)
    if not studies:
        raise CalibrationError(
            f"{', '.join(trial.name for trial in trials)}: no command holds a level and changes: log steps of at least "
            "0.5 s, such as those of 'finssim excite'"
        )
    estimates = [e for result in studies for e in estimates_of(result)]
    changes = {e.path: e.estimate for e in estimates if e.path is not None and e.identifiable}
    sure = [result for result in studies if result.sure]
    if sure:
        estimates.insert(0, _common_delay(sure))
        changes["thrusters.*.delay"] = estimates[0].estimate
        changes |= _untested(sure, vehicle, changes, findings)
    return Fit(
        kind="motor",
        method="first order plus dead time",
        before=vehicle,
        estimates={e.name: e for e in estimates},
        changes=changes,
        quality={result.name: quality_of(result) for result in studies},
        curves=tuple(curve_of(result) for result in studies),
        findings=tuple(dict.fromkeys(findings)),
        trials={trial.name: trial.sha256 for trial in trials},
    )


def _names(trials: Sequence[Trial], vehicle: Vehicle) -> list[str]:
    names = [name for name in vehicle.thrusters if any(_columns(trial, name) for trial in trials)]
    if not names:
        trial_names = ", ".join(trial.name for trial in trials) or "no trial"
        raise CalibrationError(
            f"{trial_names}: no thruster of {vehicle.name} has a command (rpm_command_NAME, command_NAME or pwm_NAME) "
            f"and a response (rpm_NAME or force_NAME); its thrusters are {', '.join(vehicle.thrusters)}"
        )
    return names


def _common_delay(studies: Sequence[Study]) -> Estimate:
    """Return the delay of the link that all thrusters share."""
    delays = [result.response.delay for result in studies]
    ends = [result.response.delay_interval for result in studies]
    middle = float(np.median(delays))
    note = f"median of {len(delays)} thrusters, which share one link"
    if any(high < middle or low > middle for low, high in ends):
        note += f"; they differ by {max(delays) - min(delays):.3g} s, more than their intervals"
    low, high = (float(end) for end in np.median(ends, axis=0))
    return Estimate("delay", middle, (low, high), "s", True, note, "thrusters.*.delay")


def _untested(
    studies: Sequence[Study], vehicle: Vehicle, changes: dict[str, Any], findings: list[Finding]
) -> dict[str, float]:
    """Return time constants of the thrusters without steps, from those of their group."""
    groups: dict[str, list[float]] = {}
    for result in studies:
        if f"thrusters.{result.name}.time_constant" in changes:
            group = vehicle.thrusters[result.name].group
            groups.setdefault(group, []).append(result.response.time_constant)
    tested = {result.name for result in studies}
    out = {}
    for name, thruster in vehicle.thrusters.items():
        if name not in tested and thruster.group in groups:
            out[f"thrusters.{name}.time_constant"] = float(np.mean(groups[thruster.group]))
            findings.append(finding("group_mean", name))
        elif name not in tested:
            findings.append(finding("file_response", name))
    return out


def calibrate_motor(
    trials: Sequence[Path], *, vehicle: str, out: Path, report: Path | None = None, as_json: bool = False
) -> Vehicle:
    """Fit the motors' response to steps: delay and lag [s], dead zone.

    Example: finssim calibrate motor steps --vehicle mine.yaml --out mine.yaml

    Args:
        trials (TRIAL): Trial folders, folders of them, or bare .csv or .parquet tables.
        vehicle (NAME|FILE): Vehicle in the catalogue, or path of a vehicle file.
        out (FILE): Vehicle file to write (.yaml).
        report (DIR): Directory for report.html, figures and fit.json.
        as_json: Print one JSON object instead of tables.
    """
    options = dict(locals())
    refuse_places(out, report, "vehicle")
    body = load_vehicle(vehicle)
    fit = fit_motor(usable_trials(trials)[0], body)
    return finish("motor", fit, options)
