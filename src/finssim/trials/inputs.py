"""Inputs of a trial: the recorded inputs as forces, and the applied wrench."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finssim.core.rotations import skew
from finssim.physics.types import MAX_THRUSTERS
from finssim.trials.findings import CalibrationError, Finding, finding
from finssim.trials.trial import INPUT_PREFIXES, NU, TAU, Header, Trial
from finssim.vehicles import AXES, Vehicle
from finssim.vehicles.capability import terminal_speeds
from finssim.vehicles.hydrodynamics import HydrodynamicSet
from finssim.vehicles.part import did_you_mean

Array = NDArray[np.float64]

# Requirements of every fit for its trials and axes.


FASTEST = 20.0
"""Speed that no vehicle exceeds [m/s]."""
FASTEST_TURN = 15.0
"""Angular rate that no vehicle exceeds [rad/s]."""
LIMITS = dict.fromkeys("uvw", FASTEST) | dict.fromkeys("pqr", FASTEST_TURN)
"""Column -> its limit [m/s, rad/s]."""
BEYOND = 5.0
"""Factor on the vehicle file's speed at full thrust, or on the work of the thrust, above which errors of that
file cannot explain a log."""
FEW = 97.0
"""Percentile of a speed that is evaluated: a wrong unit affects all samples; outliers are handled by the fit."""
PULSES = (500.0, 2500.0)
"""Least and greatest pulse width of any speed controller [µs]; 0 means no pulse."""
ADRIFT = 1.0
"""Speed that a vehicle may have due to water, waves or handling [m/s]."""


def require_fittable(trials: Sequence[Trial], vehicle: Vehicle) -> None:
    """Refuse trials that no fit may use.

    Args:
        trials: All trials that were given.
        vehicle: Vehicle of the trials.

    Raises:
        CalibrationError: There are no trials, two have the same name, one is held out, or a motion is impossible.
    """
    if not trials:
        raise CalibrationError("no trials were given, expected at least one to fit")
    names = [trial.name for trial in trials]
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise CalibrationError(f"two trials are called '{min(twice)}', expected unique names: rename one")
    for trial in trials:
        if trial.header.role == "held-out":
            raise CalibrationError(
                f"{trial.name}: it is marked as held out: fit on other trials and replay this one"
            )
        for item in implausible(trial, vehicle):
            raise CalibrationError(f"{trial.name}: {item}")


def implausible(trial: Trial, vehicle: Vehicle | None = None) -> list[Finding]:
    """Return findings about impossible speeds and pulses, and about motion that the thrust cannot explain.

    Args:
        trial: Trial as read.
        vehicle: Vehicle of the trial; if None, only general limits are checked.
    """
    fastest = {name: _fastest(trial, name) for name in NU}
    findings = [
        finding("speed_unit", column=name, value=speed)
        if name in "uvw"
        else finding("degrees", column=name, value=speed, unit="rad/s")
        for name, speed in fastest.items()
        if speed > LIMITS[name]
    ]
    pulses = {name: trial.series(name)[1] for name in trial.channels if name.startswith("pwm_")}
    values = np.concatenate([*pulses.values(), np.empty(0)])
    if np.any(values != 0.0) and not np.any((values >= PULSES[0]) & (values <= PULSES[1])):
        ends = {"least": float(values.min()), "greatest": float(values.max())}
        findings.append(finding("pulse_unit", columns=tuple(pulses), **ends))
    if findings or vehicle is None or trial.header.passive:
        return findings
    if isinstance(vehicle.hydrodynamics.get("calibrated"), HydrodynamicSet):
        for name, reach in zip("uvw", terminal_speeds(vehicle)[:3].tolist(), strict=True):
            if 0.0 < reach and BEYOND * reach + ADRIFT < fastest[name]:
                findings.append(finding("speed_beyond", column=name, value=fastest[name], reach=reach))
    return findings or _unearned(trial, vehicle)


def within_reach(column: str, values: Array) -> NDArray[np.bool_]:
    """Return a mask of the values, (n,), that are physically plausible for a column; all if the column is no
    velocity.

    Values have the unit of the column.
    """
    return np.abs(values) <= LIMITS.get(column, np.inf)


def _fastest(trial: Trial, name: str) -> float:
    """Return the speed that few samples exceed, see `FEW`; 0 if there are no samples."""
    values = np.abs(trial.series(name)[1])
    return float(np.percentile(values, FEW)) if len(values) else 0.0


def _unearned(trial: Trial, vehicle: Vehicle) -> list[Finding]:
    """Return a finding if the kinetic energy of the mass alone, E = m |v|² / 2, exceeds the work of the
    inputs, ∫ |τ · v| dt."""
    if not trial.has("u", "v", "w"):
        return []
    try:
        inputs = drive(trial, vehicle)
    except CalibrationError:
        return []  # functions that need the inputs report what is missing
    v = np.column_stack([np.interp(inputs.t, *trial.series(name)) for name in "uvw"])
    tau = np.nan_to_num(applied_wrench(inputs, vehicle, inputs.t)[:, :3])
    power = np.abs(np.sum(tau * v, axis=1))
    work = float(np.sum(power[:-1] * np.diff(inputs.t)))
    square = np.percentile(np.sum(v * v, axis=1), FEW)
    energy, free = (0.5 * vehicle.body.mass * float(s) for s in (square, np.sum(v[0] ** 2) + ADRIFT**2))
    return [finding("energy", energy=energy, work=work)] if energy > BEYOND * (work + free) else []


def require_axes(axes: Sequence[str] | None) -> None:
    """Refuse unknown names of axes.

    Raises:
        CalibrationError: An axis is unknown; the message lists the axes.
    """
    for axis in axes or ():
        if axis not in AXES:
            raise CalibrationError(f"unknown axis '{axis}'; available: {', '.join(AXES)}")


# Response of a vehicle's motors to commanded forces: the engine's actuation in NumPy, exact in time.

NO_LIMIT = 1.0e9
"""Force and slew rate of a motor without limit."""
SHORT = 1.0e-6
"""Time constant of an actuator without lag [s]."""


@dataclass(frozen=True, kw_only=True)
class Motors:
    """Limits, dead zone, delay, lag and slew of k channels, (k,) each."""

    lower: Array
    """Lower limit [N]."""
    upper: Array
    """Upper limit [N]."""
    dead_minus: Array
    """Lower edge of the dead zone: commands between this and `dead_plus` produce no force [N]."""
    dead_plus: Array
    """Upper edge of the dead zone [N]."""
    delay: Array
    """Pure delay [s]."""
    time_constant: Array
    """Time constant of the lag [s]."""
    slew: Array
    """Slew limit [N/s], or [rad/s²] if `speed`."""
    speed: NDArray[np.bool_]
    """True if lag and slew act on shaft speed rather than on thrust."""
    c_plus: Array
    """Coefficient of T = c± ω|ω| for ω > 0 [N s²/rad²]."""
    c_minus: Array
    """Coefficient of T = c± ω|ω| for ω < 0 [N s²/rad²]."""


def channel_motors(vehicle: Vehicle) -> Motors:
    """Return the motors of the vehicle's thrusters and other actuators, in the order of `Vehicle.channel_names`."""
    thrusters, others = list(vehicle.thrusters.values()), list(vehicle.actuators.values())
    speed = np.array([t.domain == "speed" for t in thrusters] + [False] * len(others))

    def column(name: str, of_others: Sequence[float]) -> Array:
        return np.array([*(getattr(t, name) for t in thrusters), *of_others], dtype=float)

    def force_at(name: str) -> Array:
        at = [t.thrust(getattr(t, name) * 2.0 * np.pi / 60.0) for t in thrusters] + [0.0] * len(others)
        return np.where(speed, at, 0.0)  # in the engine, a motor with lag in force has no dead zone

    one = [1.0] * len(others)
    delays = [t.delay for t in thrusters]
    return Motors(
        lower=column("force_min", [a.minimum for a in others]),
        upper=column("force_max", [a.maximum for a in others]),
        dead_minus=force_at("dead_rpm_minus"),
        dead_plus=force_at("dead_rpm_plus"),
        delay=column("delay", [max(delays, default=0.0)] * len(others)),
        time_constant=column("time_constant", [max(a.time_constant, SHORT) for a in others]),
        slew=np.minimum(column("slew", [a.rate_limit for a in others]), NO_LIMIT),
        speed=speed,
        c_plus=column("c_plus", one),
        c_minus=column("c_minus", one),
    )


def wrench_motors(vehicle: Vehicle) -> Motors:
    """Return six equal motors for the axes of a commanded wrench: the mean delay and lag of the vehicle's thrusters.

    This is exact if all thrusters are equal, lag in force and stay within their limits; the log does not
    contain the allocation of the wrench.
    """
    thrusters = list(vehicle.thrusters.values())
    six = np.ones(6)
    return Motors(
        lower=-NO_LIMIT * six,
        upper=NO_LIMIT * six,
        dead_minus=0.0 * six,
        dead_plus=0.0 * six,
        delay=float(np.mean([t.delay for t in thrusters])) * six,
        time_constant=float(np.mean([t.time_constant for t in thrusters])) * six,
        slew=NO_LIMIT * six,
        speed=np.zeros(6, bool),
        c_plus=six,
        c_minus=six,
    )


def delivered(motors: Motors, t: Array, command: Array, at: Array) -> Array:
    """Return the thrust at given times for commands that are held until the next.

    u(t) = admissible(command(t - delay)),   x_dot = clip((u - x) / time_constant, ±slew),   T = x or c± x|x|

    The equations are solved exactly between the changes of u. The first command is assumed to have been held
    for a long time before.

    Args:
        motors: Motors of the k channels.
        t: Times of the commands, increasing [s], (n,).
        command: Commanded forces [N], (n, k).
        at: Times of the result [s], (m,).

    Returns:
        Thrust [N], (m, k).
    """
    f = np.clip(command, motors.lower, motors.upper)
    f = np.where((f > motors.dead_minus) & (f < motors.dead_plus), 0.0, f)
    c = np.where(f >= 0.0, motors.c_plus, motors.c_minus)
    target = np.where(motors.speed, np.sign(f) * np.sqrt(np.abs(f) / c), f)
    x = np.stack(
        [
            _followed(
                *_changes(t + motors.delay[k], target[:, k]), at, motors.time_constant[k], motors.slew[k]
            )
            for k in range(command.shape[1])
        ],
        axis=-1,
    )
    c = np.where(x >= 0.0, motors.c_plus, motors.c_minus)
    return np.where(motors.speed, c * x * np.abs(x), x)


def _changes(t: Array, u: Array) -> tuple[Array, Array]:
    """Return the rows at which a held value changes."""
    rows = np.concatenate([[True], np.diff(u) != 0.0])
    return t[rows], u[rows]


def _followed(t: Array, u: Array, at: Array, time_constant: float, slew: float) -> Array:
    """Return x(at) of x_dot = clip((u - x) / time_constant, ±slew), steady at u[0] before t[0]; u is held
    from t on."""
    x = np.empty(len(t))
    x[0] = now = float(u[0])
    for j, (goal, dt) in enumerate(zip(u.tolist(), np.diff(t).tolist(), strict=False)):
        way = goal - now
        ramp = max(abs(way) - slew * time_constant, 0.0) / slew
        if ramp > 0.0:
            now += math.copysign(slew * min(ramp, dt), way)
            dt = max(dt - ramp, 0.0)
        x[j + 1] = now = goal + (now - goal) * math.exp(-dt / time_constant)
    last = np.maximum(np.searchsorted(t, at, side="right") - 1, 0)
    since = np.maximum(at - t[last], 0.0)
    ways = u[last] - x[last]
    ramps = np.minimum(np.maximum(np.abs(ways) - slew * time_constant, 0.0) / slew, since)
    remaining = ways - np.sign(ways) * slew * ramps
    return np.asarray(u[last] - remaining * np.exp(-(since - ramps) / time_constant))


# Columns of a trial that describe its inputs.

ORDER = ("rpm_", "force_", "tau", "pwm_", "command_")
"""Kinds of input, from the most to the least direct measure of the applied force."""


def _columns(trial: Trial, vehicle: Vehicle, kind: str) -> list[str]:
    """Return the input columns of a kind that contain numbers, in canonical order.

    Raises:
        CalibrationError: A column names an unknown thruster.
    """
    if kind == "tau":
        return [name for name in TAU if trial.has(name)]
    names = {c.removeprefix(kind): c for c in trial.channels if c.startswith(kind)}
    for name, column in names.items():
        if name not in vehicle.thrusters:
            meant = next(
                (thruster for thruster in vehicle.thrusters if thruster.lower() == name.lower()), name
            )
            raise CalibrationError(
                f"{column}: {vehicle.name} has no thruster '{name}'"
                f"{did_you_mean(meant, list(vehicle.thrusters))} it has {', '.join(vehicle.thrusters)}",
                trial.name,
            )
    return [names[name] for name in vehicle.thrusters if name in names and trial.has(names[name])]


def _missing_inputs(present: dict[str, list[str]], vehicle: Vehicle) -> str:
    for kind in ORDER:
        if present[kind]:
            missing = [f"{kind}{n}" for n in vehicle.thrusters if f"{kind}{n}" not in present[kind]]
            return (
                f"{', '.join(missing)} {'is' if len(missing) == 1 else 'are'} missing, expected a column for each of "
                f"the {len(vehicle.thrusters)} thrusters of {vehicle.name}: give zeros for a thruster that never ran"
            )
    prefixes = ", ".join(f"{prefix}NAME" for prefix in INPUT_PREFIXES)
    return (
        f"no input columns, expected tau_x ... tau_n or one of {prefixes} for each thruster: log what drove the "
        "vehicle, or write 'passive: true' in trial.yaml if the thrusters were off"
    )


ACTED = ("rpm_", "force_", "tau")
"""Kinds of input that were applied, unless the header states otherwise."""

RPM = 2.0 * np.pi / 60.0
"""Angular velocity of one revolution per minute [rad/s]."""


@dataclass(frozen=True, kw_only=True)
class InputForces:
    """Inputs of a trial as k forces."""

    t: Array
    """Times at which all inputs are known [s], (n,)."""
    force: Array
    """Inputs [N; N m for the moments of a wrench; of other actuators their unit], (n, k), k <= 8."""
    B: Array
    """Wrench about the body origin per unit force, body frame, (6, k); zero for actuators other than thrusters."""
    names: tuple[str, ...]
    """Channels of the vehicle, or `tau_x` ... `tau_n`."""
    commanded: bool
    """True if the inputs are commands: limits, dead zone, delay, lag and slew of the motors determine the
    applied force."""
    thrusters: bool
    """True if the channels are those of the vehicle: thrusters in canonical order, then its other actuators."""
    held: bool
    """True if a value is held until the next; otherwise inputs are interpolated linearly."""
    spans: Array
    """Starts and ends of the segments in which the inputs are known [s], (s, 2)."""
    source: str
    """`rpm`, `force`, `tau`, `pwm`, `command`, or `passive`."""
    end: float | None = None
    """Time after which the recording continues but the inputs are unknown [s]; None if they last as long."""
    findings: tuple[Finding, ...] = ()
    """Assumptions."""

    def at(self, t: Array) -> Array:
        """Return forces at given times [s], (m,) -> (m, k), before the motors; beyond the ends the nearest value."""
        if self.held:
            return self.force[np.maximum(np.searchsorted(self.t, t, side="right") - 1, 0)]
        return np.stack([np.interp(t, self.t, column) for column in self.force.T], axis=-1)


def drive(trial: Trial, vehicle: Vehicle) -> InputForces:
    """Return the inputs of a trial: shaft speeds, otherwise forces, a wrench, pulse widths, or commanded forces.

    A kind that is incomplete is skipped in favour of a complete one. Missing axes of a wrench are zero, since
    single-axis trials are logged in this form; missing thrusters are not.

    Raises:
        CalibrationError: There are no inputs, a thruster is unknown or missing, or there are pulse widths
            without a speed controller in the vehicle file.
    """
    if trial.header.passive:
        return _undriven(trial)
    present = {kind: _columns(trial, vehicle, kind) for kind in ORDER}
    # For a wrench any axis suffices, for thrusters all are required.
    complete = [k for k in ORDER if present[k] and (k == "tau" or len(present[k]) == len(vehicle.thrusters))]
    if not complete:
        raise CalibrationError(_missing_inputs(present, vehicle), trial.name)
    kind = complete[0]
    columns = present[kind]
    others = _other_columns(trial, vehicle, kind)
    commanded, held, stepped = _between(trial, kind, columns)
    t, values = _common_times(trial, [*columns, *others], held)
    force, B, names = _channels(trial, vehicle, kind, columns, t, values[:, : len(columns)])
    if others:
        force = np.concatenate([force, values[:, len(columns) :]], axis=1)
        B, names = np.pad(B, ((0, 0), (0, len(others)))), vehicle.channel_names
    end = _end(trial, t, force) if held else None
    zero_after = end is not None and trial.header.inputs_after == "zero"
    if end is not None and zero_after:
        t, force, end = np.append(t, end), np.concatenate([force, np.zeros_like(force[:1])]), None
    if len(names) > MAX_THRUSTERS:
        if commanded:
            raise CalibrationError(
                f"{len(names)} commanded thrusters are more than the {MAX_THRUSTERS} that are simulated; "
                "give the wrench that acted as tau_x ... tau_n",
                trial.name,
            )
        force, B, names = force @ B.T, np.eye(6), TAU
    return InputForces(
        t=t,
        force=force,
        B=B,
        names=names,
        commanded=commanded,
        thrusters=names is not TAU,
        held=held,
        spans=_held_spans(t, trial.t, end) if held else _spans(t),
        end=end,
        source=kind.rstrip("_"),
        findings=(*_assumed(kind, present, stepped), *([finding("inputs_zero_after")] if zero_after else [])),
    )


def no_input(inputs: InputForces) -> list[Finding]:
    """Return a finding if inputs were recorded but produce no force at any time: no fit may use such a trial."""
    if inputs.source == "passive" or np.any(inputs.force):
        return []
    return [finding("pulses_dead" if inputs.source == "pwm" else "inputs_zero")]


def _other_columns(trial: Trial, vehicle: Vehicle, kind: str) -> list[str]:
    """Return the columns of the vehicle's actuators other than thrusters, in the order of its channels.

    Raises:
        CalibrationError: A column is missing or unknown, or a wrench is given instead of the thrusters' inputs.
    """
    expected = [f"actuator_{name}" for name in vehicle.actuators]
    for column in trial.channels:
        if column.startswith("actuator_") and column not in expected:
            raise CalibrationError(
                f"{column}: {vehicle.name} has no such actuator{did_you_mean(column, expected)} it has "
                f"{', '.join(vehicle.actuators) or 'thrusters alone'}",
                trial.name,
            )
    missing = [column for column in expected if not trial.has(column)]
    if missing:
        raise CalibrationError(
            f"{', '.join(missing)} {'is' if len(missing) == 1 else 'are'} missing, expected a column for each of the "
            f"{len(expected)} actuators of {vehicle.name} besides its thrusters: give zeros for one that never moved",
            trial.name,
        )
    if expected and kind == "tau":
        raise CalibrationError(
            f"the inputs are a wrench, and {vehicle.name} has {', '.join(vehicle.actuators)}, whose forces depend on "
            "the flow: give rpm_, force_, pwm_ or command_ of each thruster",
            trial.name,
        )
    return expected


def _undriven(trial: Trial) -> InputForces:
    """Return a zero wrench at all times, as in a passive trial."""
    return InputForces(
        t=trial.t,
        force=np.zeros((len(trial.t), 6)),
        B=np.eye(6),
        names=TAU,
        commanded=False,
        thrusters=False,
        held=False,
        spans=_spans(trial.t),
        source="passive",
    )


def _between(trial: Trial, kind: str, columns: list[str]) -> tuple[bool, bool, bool]:
    """Return whether inputs were commanded, are held from row to row, and are held according to the data
    although the header does not state it."""
    header = trial.header
    commanded = header.inputs == "commanded" or (header.inputs is None and kind not in ACTED)
    if header.inputs_between is not None:
        return commanded, header.inputs_between == "held", False
    stepped = not commanded and _keeps_levels(trial, columns)
    return commanded, commanded or stepped, stepped


def _channels(
    trial: Trial, vehicle: Vehicle, kind: str, columns: list[str], t: Array, values: Array
) -> tuple[Array, Array, tuple[str, ...]]:
    """Return forces (n, k), their map to the wrench about the body origin (6, k), and names."""
    if kind != "tau":
        force = _forces(kind, values, t, trial, vehicle)
        return force, vehicle.thruster_matrix(), vehicle.thruster_names
    wrench = np.zeros((len(t), 6))
    wrench[:, [TAU.index(name) for name in columns]] = values
    return wrench, _about_origin(trial.header, vehicle), TAU


def _assumed(kind: str, present: dict[str, list[str]], stepped: bool) -> list[Finding]:
    """Return findings about the assumptions made."""
    source = kind.rstrip("_")
    findings = [
        finding("inputs_incomplete", kind=k, used=source) for k in ORDER[: ORDER.index(kind)] if present[k]
    ]
    if stepped:
        findings.append(finding("inputs_held", kind=source))
    missing = [name for name in TAU if name not in present[kind]] if kind == "tau" else []
    if missing:
        findings.append(finding("wrench_zero", columns=tuple(missing)))
    return findings


def acting(drive: InputForces, vehicle: Vehicle, t: Array) -> Array:
    """Return the applied inputs at given times [s], (m,) -> (m, k), after the motors if the inputs are commands."""
    if drive.commanded:
        motors = channel_motors(vehicle) if drive.thrusters else wrench_motors(vehicle)
        return delivered(motors, drive.t, drive.force, t)
    return drive.at(t)


def applied_wrench(drive: InputForces, vehicle: Vehicle, t: Array) -> Array:
    """Return the applied wrench, about the body origin, body frame [N, N m].

    If the inputs are commands, the motors of the vehicle file are simulated: limits, dead zone, delay, lag
    and slew, exactly for a command that is held until the next.

    Args:
        drive: Inputs of the trial.
        vehicle: Vehicle with the motors.
        t: Times [s], (m,).

    Returns:
        Wrench [N, N m], (m, 6); NaN outside the recorded inputs and inside their gaps.
    """
    tau = acting(drive, vehicle, t) @ drive.B.T
    slack = 0.5 * float(np.median(np.diff(drive.t)))
    covered = np.any((t >= drive.spans[:, :1] - slack) & (t <= drive.spans[:, 1:] + slack), axis=0)
    tau[~covered] = np.nan
    return np.asarray(tau)


def widest_step(t: Array) -> float:
    """Return the longest interval between samples that is not a gap [s]: half a second, or four median intervals."""
    return max(0.5, 4.0 * float(np.median(np.diff(t)))) if len(t) > 1 else 0.5


def _spans(t: Array) -> Array:
    """Return the segments without a gap, (s, 2)."""
    wide = np.diff(t) > widest_step(t)
    return np.stack([t[np.concatenate([[True], wide])], t[np.concatenate([wide, [True]])]], axis=-1)


def _held_spans(t: Array, recording: Array, end: float | None) -> Array:
    """Return the segments in which a command is held until the next, but not through a gap of the complete
    recording, nor beyond the end of its stream."""
    inside = recording[(recording >= t[0]) & (recording <= (np.inf if end is None else end))]
    return _spans(inside)


def _end(trial: Trial, t: Array, force: Array) -> float | None:
    """Return the time at which commands end well before the recording, with a nonzero last command [s];
    otherwise None."""
    after = trial.header.inputs_after
    steps = np.diff(t)
    longest = max(widest_step(t), 1.5 * float(steps.max()))
    early = float(trial.t[-1] - t[-1]) > longest and after != "held"
    if not early or (after is None and not np.any(force[-1])):
        return None
    return float(t[-1] + np.median(steps))


def _keeps_levels(trial: Trial, columns: list[str]) -> bool:
    """Return whether inputs stay exactly at levels and jump between them from row to row, as
    program-generated ones do.

    The output of motors passes through intermediate values, and measured values never repeat exactly.
    """
    jumps = alone = 0
    for column in columns:
        _, values = trial.series(column)
        change = np.concatenate([[False], values[1:] != values[:-1], [False]])
        jumps += int(change.sum())
        alone += int((change[1:-1] & ~change[:-2] & ~change[2:]).sum())
    return jumps >= 2 and alone >= 0.9 * jumps


def _common_times(trial: Trial, columns: list[str], held: bool) -> tuple[Array, Array]:
    """Return columns at the times when all of them are known: the last value if held, otherwise interpolated
    linearly.

    Raises:
        CalibrationError: There is no such time.
    """
    series = [trial.series(column) for column in columns]
    first, last = max(t[0] for t, _ in series), min(t[-1] for t, _ in series)
    end = max(t[-1] for t, _ in series) if held else last
    t = np.unique(np.concatenate([s for s, _ in series]))
    t = t[(t >= first) & (t <= end)]
    if len(t) < 2:
        raise CalibrationError(
            f"{', '.join(columns[:8])} are never known at the same time: expected inputs that overlap in time",
            trial.name,
        )
    if held:
        return t, np.stack([v[np.searchsorted(s, t, side="right") - 1] for s, v in series], axis=-1)
    for s, _ in series:
        i = np.searchsorted(s, t, side="right") - 1
        after = np.minimum(i + 1, len(s) - 1)
        t = t[(s[i] == t) | (s[after] - s[i] <= widest_step(s))]
    return t, np.stack([np.interp(t, s, v) for s, v in series], axis=-1)


def _forces(kind: str, values: Array, t: Array, trial: Trial, vehicle: Vehicle) -> Array:
    """Return the thrust of each thruster [N], (n, k)."""
    thrusters = vehicle.thrusters.items()
    if kind == "rpm_":
        return np.stack(
            [thruster.thrust(RPM * v) for (_, thruster), v in zip(thrusters, values.T, strict=True)], axis=-1
        )
    if kind != "pwm_":
        return values
    bare = [name for name, thruster in thrusters if thruster.esc is None]
    if bare:
        raise CalibrationError(
            f"pwm_{bare[0]} needs an esc section for thruster {bare[0]} in vehicle {vehicle.name}: "
            "calibrate one with 'finssim calibrate thruster', or log rpm, force or wrench",
            trial.name,
        )
    voltage: Array | float | None = trial.header.voltage
    if trial.has("voltage"):
        voltage = np.interp(t, *trial.series("voltage"))
    return np.stack(
        [
            thruster.thrust(thruster.shaft_speed(v, voltage))
            for (_, thruster), v in zip(thrusters, values.T, strict=True)
        ],
        axis=-1,
    )


def _about_origin(header: Header, vehicle: Vehicle) -> Array:
    """Return the map of a wrench about `wrench_at` to the body origin: M_O = M_P + r_P × F, (6, 6)."""
    at = header.wrench_at
    if at is None:
        point = vehicle.wrench_reference
    elif at == "origin":
        point = np.zeros(3)
    else:
        point = vehicle.body.center_of_gravity if at == "center_of_gravity" else np.asarray(at, float)
    B = np.eye(6)
    B[3:, :3] = skew(point)
    return B
