"""What pushed the vehicle in a trial: the recorded inputs as forces, and the wrench that they applied."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.trials.columns import TAU
from finssim.calibration.trials.header import Header
from finssim.calibration.trials.input_columns import ORDER, first_complete, input_columns
from finssim.calibration.trials.motors import delivered, thruster_motors, wrench_motors
from finssim.calibration.trials.trial import Trial
from finssim.geometry.rotations import skew
from finssim.physics.types import MAX_THRUSTERS
from finssim.vehicles import Vehicle

__all__ = ["Drive", "applied_wrench", "drive", "widest_step"]

Array = NDArray[np.float64]

ACTED = ("rpm_", "force_", "tau")
"""Inputs that are what acted, unless the header says otherwise."""

RPM = 2.0 * np.pi / 60.0
"""rad/s of one turn a minute."""


@dataclass(frozen=True, kw_only=True)
class Drive:
    """The inputs of a trial as k forces."""

    t: Array
    """Times at which all of them are known [s], (n,)."""
    force: Array
    """[N; N m for the moments of a wrench], (n, k), k <= 8."""
    B: Array
    """Wrench about the body origin per unit force, body frame, (6, k)."""
    names: tuple[str, ...]
    """Thrusters, or `tau_x` ... `tau_n`."""
    commanded: bool
    """Whether these were asked for: limits, dead zone, delay, lag and slew of the motors lie before what acted."""
    thrusters: bool
    """Whether the channels are the vehicle's thrusters, in canonical order."""
    held: bool
    """Whether a value acts until the next, rather than in a straight line to it."""
    spans: Array
    """Beginnings and ends of the stretches in which the inputs are known [s], (s, 2)."""
    source: str
    """`rpm`, `force`, `tau`, `pwm`, `command`, or `passive`."""
    end: float | None = None
    """From here on the recording goes on and the inputs are unknown [s]; None where they last as long."""
    notes: tuple[str, ...] = ()
    """What was assumed, one sentence each."""

    def at(self, t: Array) -> Array:
        """Forces at given times [s], (m,) -> (m, k), before the motors; beyond the ends the nearest."""
        if self.held:
            return self.force[np.maximum(np.searchsorted(self.t, t, side="right") - 1, 0)]
        return np.stack([np.interp(t, self.t, column) for column in self.force.T], axis=-1)


def drive(trial: Trial, vehicle: Vehicle) -> Drive:
    """The inputs of a trial: shaft speeds before forces before a wrench before pulse widths before commanded forces.

    A kind that is there for some thrusters only is passed over for a complete one. Axes of a wrench that have no column
    are taken as zero, for that is how single-axis trials are logged; thrusters without a column are not.

    Raises:
        CalibrationError: No inputs, a thruster that the vehicle has not, some thrusters missing, or pulse widths
            without a speed controller in the vehicle file.
    """
    if trial.header.passive:
        return _undriven(trial)
    present = input_columns(trial, vehicle)
    kind = first_complete(present, trial, vehicle)
    columns = present[kind]
    commanded, held, stepped = _between(trial, kind, columns)
    t, values = _together(trial, columns, held)
    force, B, names = _channels(trial, vehicle, kind, columns, t, values)
    end = _end(trial, t, force) if held else None
    zero_after = end is not None and trial.header.inputs_after == "zero"
    if end is not None and zero_after:
        t, force, end = np.append(t, end), np.concatenate([force, np.zeros_like(force[:1])]), None
    if len(names) > MAX_THRUSTERS:
        if commanded:
            raise CalibrationError(
                f"{trial.name}: {len(names)} commanded thrusters are more than the {MAX_THRUSTERS} that are simulated; "
                "give the wrench that acted as tau_x ... tau_n"
            )
        force, B, names = force @ B.T, np.eye(6), TAU
    return Drive(
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
        notes=_notes(kind, present, stepped)
        + (("the inputs end before the recording: none from there on",) if zero_after else ()),
    )


def _undriven(trial: Trial) -> Drive:
    """No wrench at any time, as in a passive trial."""
    return Drive(
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
    """Whether inputs were commanded, hold from row to row, and are seen to hold though the header does not say."""
    header = trial.header
    commanded = header.inputs == "commanded" or (header.inputs is None and kind not in ACTED)
    if header.inputs_between is not None:
        return commanded, header.inputs_between == "held", False
    stepped = not commanded and _keeps_levels(trial, columns)
    return commanded, commanded or stepped, stepped


def _channels(
    trial: Trial, vehicle: Vehicle, kind: str, columns: list[str], t: Array, values: Array
) -> tuple[Array, Array, tuple[str, ...]]:
    """Forces (n, k), their map to the wrench about the body origin (6, k), and names."""
    if kind != "tau":
        force = _forces(kind, values, t, trial, vehicle)
        return force, vehicle.thruster_matrix(), vehicle.thruster_names
    wrench = np.zeros((len(t), 6))
    wrench[:, [TAU.index(name) for name in columns]] = values
    return wrench, _about_origin(trial.header, vehicle), TAU


def _notes(kind: str, present: dict[str, list[str]], stepped: bool) -> tuple[str, ...]:
    """What was assumed."""
    source = kind.rstrip("_")
    notes = [
        f"{k}* is there for some thrusters only; {source} was used"
        for k in ORDER[: ORDER.index(kind)]
        if present[k]
    ]
    if stepped:
        notes.append(
            f"{source} keeps its levels exactly and jumps from row to row: read as held from each row to the next; "
            "write 'inputs_between: linear' in trial.yaml if it was sampled while it changed"
        )
    missing = [name for name in TAU if name not in present[kind]] if kind == "tau" else []
    if missing:
        notes.append(f"no column {', '.join(missing)}: taken as zero")
    return tuple(notes)


def applied_wrench(drive: Drive, vehicle: Vehicle, t: Array) -> Array:
    """Wrench that acted, about the body origin, body frame [N, N m].

    Where the inputs are commands, the motors of the vehicle file lie between: limits, dead zone, delay, lag and slew,
    exact for a command that is held until the next.

    Args:
        drive: Of the trial.
        vehicle: Whose motors they are.
        t: Times [s], (m,).

    Returns:
        (m, 6); NaN outside the recorded inputs and inside their gaps.
    """
    if drive.commanded:
        motors = thruster_motors(vehicle) if drive.thrusters else wrench_motors(vehicle)
        force = delivered(motors, drive.t, drive.force, t)
    else:
        force = drive.at(t)
    tau = force @ drive.B.T
    slack = 0.5 * float(np.median(np.diff(drive.t)))
    known = np.any((t >= drive.spans[:, :1] - slack) & (t <= drive.spans[:, 1:] + slack), axis=0)
    tau[~known] = np.nan
    return np.asarray(tau)


def widest_step(t: Array) -> float:
    """Longest time between samples of a stream that is not yet a gap [s]: half a second, or four usual steps."""
    return max(0.5, 4.0 * float(np.median(np.diff(t)))) if len(t) > 1 else 0.5


def _spans(t: Array) -> Array:
    """Stretches without a gap, (s, 2)."""
    wide = np.diff(t) > widest_step(t)
    return np.stack([t[np.concatenate([[True], wide])], t[np.concatenate([wide, [True]])]], axis=-1)


def _held_spans(t: Array, recording: Array, end: float | None) -> Array:
    """A command holds until the next, but not through a gap of the whole recording, nor beyond its stream's end."""
    inside = recording[(recording >= t[0]) & (recording <= (np.inf if end is None else end))]
    return _spans(inside)


def _end(trial: Trial, t: Array, force: Array) -> float | None:
    """When a stream of commands ended well before the recording did, with thrust still asked for [s]; else None."""
    after = trial.header.inputs_after
    steps = np.diff(t)
    longest = max(widest_step(t), 1.5 * float(steps.max()))
    early = float(trial.t[-1] - t[-1]) > longest and after != "held"
    if not early or (after is None and not np.any(force[-1])):
        return None
    return float(t[-1] + np.median(steps))


def _keeps_levels(trial: Trial, columns: list[str]) -> bool:
    """Whether inputs stay exactly at levels and jump between them from row to row, as a program sets them.

    What motors delivered passes through the values between, and what a sensor measured never repeats.
    """
    jumps = alone = 0
    for column in columns:
        _, values = trial.series(column)
        change = np.concatenate([[False], values[1:] != values[:-1], [False]])
        jumps += int(change.sum())
        alone += int((change[1:-1] & ~change[:-2] & ~change[2:]).sum())
    return jumps >= 2 and alone >= 0.9 * jumps


def _together(trial: Trial, columns: list[str], held: bool) -> tuple[Array, Array]:
    """Columns at the times when all of them are known: the last value if held, else in a straight line.

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
            f"{trial.name}: {', '.join(columns[:8])} are never known together: expected inputs that overlap in time"
        )
    if held:
        return t, np.stack([v[np.searchsorted(s, t, side="right") - 1] for s, v in series], axis=-1)
    for s, _ in series:
        i = np.searchsorted(s, t, side="right") - 1
        after = np.minimum(i + 1, len(s) - 1)
        t = t[(s[i] == t) | (s[after] - s[i] <= widest_step(s))]
    return t, np.stack([np.interp(t, s, v) for s, v in series], axis=-1)


def _forces(kind: str, values: Array, t: Array, trial: Trial, vehicle: Vehicle) -> Array:
    """Thrust of each thruster [N], (n, k)."""
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
            f"{trial.name}: pwm_{bare[0]} needs an esc section for thruster {bare[0]} in vehicle {vehicle.name}: "
            "calibrate one with 'finssim calibrate thruster', or log rpm, force or wrench"
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
    """Map of a wrench about `wrench_at` to the body origin: M_O = M_P + r_P × F, (6, 6)."""
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
