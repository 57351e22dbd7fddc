"""Simulation of many candidate plants over many segments, as parallel worlds of one simulator."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from finssim.core.rotations import quat_conjugate, quat_from_euler, quat_rotate
from finssim.physics.types import MAX_THRUSTERS
from finssim.sim.plant_arrays import NO_LIMIT, vehicle_parameters
from finssim.sim.simulator import Simulator
from finssim.sim.water import Water
from finssim.trials.findings import CalibrationError
from finssim.trials.free_motion import DETERMINED_BY, compared_columns, free_motion
from finssim.trials.inputs import InputForces, drive
from finssim.trials.motion import Motion, depth_place, motion
from finssim.trials.trial import Trial
from finssim.vehicles import AXES, Vehicle

Array = NDArray[np.float64]

STATES = ("u", "v", "w", "p", "q", "r", "roll", "pitch", "yaw", "x", "y", "z")
"""Components of an initial state: nu, a small rotation about the body axes [rad], a world displacement [m]."""

MEMORY, SETTLED = 1.0, 10.0
"""Duration of the commands before a segment that are kept, for delay and lag of the motors [s]; number of
time constants after which an older command has no effect."""

DEEP = -30.0
"""Offset of the height of a vehicle that never came near the surface [m]: deep enough for its drift, but not
so deep that single precision would lose slow motions. If the depth was not measured this is irrelevant, and
the offset is larger."""

SLOW = 0.09
"""Interval between commands from which on the times of their changes are considered unknown [s]."""

CHANGES = 6
"""Number of changes of a command within a segment whose times can be fitted: the largest ones."""

FLIES = 0.15
"""Height of the origin above that of a floating vehicle from which it cannot be relative to the surface [m]."""


class Changes(NamedTuple):
    """Changes of a command between two of its samples, at unknown times."""

    change: Array
    """Change in whose sample interval each step lies, in the unit of the command, (steps, k)."""
    which: NDArray[np.int64]
    """Index of that change, -1 outside all changes, (steps,)."""
    place: Array
    """Start and end of each step as fractions of that interval [-], (steps, 2)."""


@dataclass(frozen=True, kw_only=True)
class Drive:
    """Commands of the motors in a segment."""

    force: Array
    """Command in each step [N, N m]: the mean of a held command, which within a change is the previous value;
    for an applied force, which is interpolated linearly, the value at the step's end. (steps, k)"""
    before: Array
    """Command in its unit in the previous steps, the newest last; before the start of the trial the first
    value is repeated. (m, k)"""
    B: Array
    """Wrench about the body origin per unit force, (6, k)."""
    commanded: bool
    """True if delay, dead zone, lag, slew and limits determine the applied force from `force`."""
    thrusters: bool
    """True if the k forces are the vehicle's channels: thrusters in canonical order, then its other actuators."""
    changes: Changes | None = None
    """Changes at unknown times; None if there are none."""


@dataclass(frozen=True, kw_only=True)
class InitialState:
    """State at the start of a segment."""

    position: Array
    """Position in the world frame [m], (3,); 0 if unknown."""
    quaternion: Array
    """Body to world, (4,); level and heading 0 if unknown."""
    nu: Array
    """Velocity of the body origin [m/s, rad/s], (6,); 0 if unknown."""
    known: NDArray[np.bool_]
    """Mask of the components nu (6), roll, pitch, yaw, x, y, z that were measured, (12,)."""


@dataclass(frozen=True, kw_only=True)
class SensorPlaces:
    """Mounting positions of a trial's sensors."""

    velocity_at: Array
    """Body point to which the velocity u, v, w refers [m]."""
    velocity_in_water: bool
    """True if u, v, w are relative to the water."""
    position_at: Array
    """Body point to which the position x, y, z refers [m]."""
    depth_at: Array
    """Body point of the pressure sensor [m]."""


@dataclass(frozen=True, kw_only=True)
class Segment:
    """Segment of a trial on a uniform grid of `steps` steps."""

    trial: str
    """Name of the trial."""
    index: int
    """Index of its trial in the fit."""
    t0: float
    """Start of the segment on the trial's clock [s]."""
    step: float
    """Time step [s]."""
    drive: Drive
    start: InitialState
    sink: float
    """Offset of the height during simulation [m], so that a vehicle that stayed submerged cannot surface."""
    density: float
    """Density of the water [kg/m³]."""
    current: Array
    """Current in the world frame [m/s], (3,)."""
    sensors: SensorPlaces
    measured: dict[str, tuple[Array, Array]]
    """Column of `CHANNELS` -> times since t0 [s] and values."""
    held: Array | None = None
    """Imposed nu [m/s, rad/s] at the start and after every step, (steps + 1, 6); NaN where the simulation is free."""
    aside: frozenset[str] = frozenset()
    """Columns of axes that the trial does not drive: their other disturbances require a separate noise level."""

    @property
    def steps(self) -> int:
        """Number of steps."""
        return len(self.drive.force)

    @property
    def duration(self) -> float:
        """Duration [s]."""
        return self.steps * self.step


@dataclass(frozen=True, kw_only=True)
class Streams:
    """Trial prepared for cutting: its inputs, its motion and its comparable columns."""

    trial: Trial
    drive: InputForces
    motion: Motion
    measured: dict[str, tuple[Array, Array]]
    """Column of `CHANNELS` -> times on the trial's clock [s] and values."""
    released: frozenset[str] = frozenset()
    """Axes that move freely, for a trial without thrust that was cut to its free motions."""


def streams(trial: Trial, vehicle: Vehicle) -> Streams:
    """Prepare a trial once, so that it can be cut in several ways."""
    return Streams(
        trial=trial,
        drive=drive(trial, vehicle),
        motion=motion(trial, vehicle),
        measured=compared_columns(trial),
    )


def released(s: Streams, axes: Sequence[str]) -> Streams:
    """Return a trial without thrust, cut to its free motions.

    Each axis is compared only within its own free motion.

    Args:
        s: Trial that is passive according to its header.
        axes: Axes to evaluate.

    Raises:
        CalibrationError: No axis moves freely; the message states the reason for each measured axis.
    """
    windows, reasons = dict[str, tuple[float, float]](), list[str]()
    for axis in axes:
        try:
            windows[axis] = free_motion(s.motion, s.measured, axis)
        except CalibrationError as error:
            reasons.append(error.reason)
    if not windows:
        raise CalibrationError("; ".join(reasons), s.trial.name)
    begin, end = min(a for a, _ in windows.values()), max(b for _, b in windows.values())
    spans = [(max(a, begin), min(b, end)) for a, b in s.drive.spans]
    spans = np.array([span for span in spans if span[1] > span[0]])
    nu, t = s.motion.nu.copy(), s.motion.t
    measured = dict(s.measured)
    for axis, (a, b) in windows.items():
        i, inside = AXES.index(axis), (t >= a) & (t <= b)
        nu[~inside, i] = np.nan
        if (own := s.measured.get(DETERMINED_BY[axis][0])) and len(own[0]):
            # Smoothing removes the first samples, which are the fastest.
            rows = inside & np.isnan(nu[:, i])
            nu[rows, i] = np.interp(t[rows], *own)
    for column, (at, values) in s.measured.items():
        own = [windows[axis] for axis in windows if column in DETERMINED_BY[axis]]
        if own:
            inside = np.any([(at >= a) & (at <= b) for a, b in own], axis=0)
            measured[column] = (at[inside], values[inside])
    return replace(
        s,
        drive=replace(s.drive, spans=spans),
        motion=replace(s.motion, nu=nu),
        measured={column: pair for column, pair in measured.items() if len(pair[0])},
        released=frozenset(windows),
    )


def segments(
    s: Streams,
    vehicle: Vehicle,
    *,
    length: float | None = None,
    step: float = 0.02,
    start: float = 0.0,
    index: int = 0,
    changes: bool = False,
) -> list[Segment]:
    """Cut a trial into segments of about equal length; a gap in the recording always ends one.

    Args:
        s: The trial.
        vehicle: Vehicle of the trial.
        length: Length of each segment [s]; if None the complete trial, up to its gaps.
        step: Time step of the simulation [s].
        start: Duration that is omitted at the beginning [s].
        index: Index of the trial.
        changes: True if a slowly logged command that is not stated to be held may have changed at any time since the
            previous sample: it then changes in the middle, and the times of the largest changes are free.

    Returns:
        Segments in chronological order; empty if they contain no measurements.

    Raises:
        CalibrationError: The step or length is not positive.
    """
    if not step > 0.0 or (length is not None and not length > 0.0):
        raise CalibrationError(
            f"segments of {length} s in steps of {step} s, expected times above 0 s", s.trial.name
        )
    out, begin = list[Segment](), float(s.trial.t[0]) + start
    sampled = changes and is_sampled(s)
    for a, b in ((max(float(a), begin), float(b)) for a, b in s.drive.spans):
        steps = int(round((b - a) / step - 1e-6))
        parts = 1 if length is None else max(1, round(steps * step / length))
        edges = [steps * i // parts for i in range(parts + 1)]
        for low, high in zip(edges, edges[1:], strict=False):
            if high - low >= 2:
                segment = _segment(s, vehicle, a + low * step, high - low, step, index, sampled)
                if segment.measured:
                    out.append(segment)
    return out


def without(s: Streams, gaps: Sequence[tuple[float, float]]) -> Streams:
    """Return a trial without some time intervals [s]."""
    spans = [(float(a), float(b)) for a, b in s.drive.spans]
    for begin, end in gaps:
        spans = [
            part for a, b in spans for part in ((a, min(b, begin)), (max(a, end), b)) if part[1] > part[0]
        ]
    return replace(s, drive=replace(s.drive, spans=np.array(spans).reshape(-1, 2)))


def is_sampled(s: Streams) -> bool:
    """Return whether a command was sampled so slowly that the times of its changes are unknown."""
    d, between = s.drive, np.diff(s.drive.t)
    if not (d.commanded and d.held) or s.trial.header.inputs_between is not None or len(between) < 3:
        return False
    usual = float(np.median(between))
    return SLOW <= usual and float(np.percentile(between, 90.0)) <= 1.5 * usual


def _changes(d: InputForces, t0: float, steps: int, step: float) -> Changes | None:
    """Return the changes of a command within a segment; None if there are none."""
    begin = t0 + step * np.arange(steps)
    row = np.searchsorted(d.t, begin + 0.5 * step, side="right")  # first sample after each step
    change = np.diff(d.force, axis=0)
    size = np.abs(change / np.maximum(np.ptp(d.force, axis=0), 1e-12)).sum(axis=1)
    inside = np.unique(row[(row > 0) & (row < len(d.t))]) - 1
    largest = np.sort(inside[np.argsort(-size[inside])[:CHANGES]])
    largest = largest[size[largest] > 0.0]
    if not len(largest):
        return None
    which = np.where(np.isin(row - 1, largest), np.searchsorted(largest, row - 1), -1)
    own = largest[which]
    place = (np.stack([begin, begin + step], axis=-1) - d.t[own, None]) / (d.t[own + 1] - d.t[own])[:, None]
    return Changes(np.where(which[:, None] < 0, 0.0, change[own]), which, place)


def _segment(
    s: Streams, vehicle: Vehicle, t0: float, steps: int, step: float, index: int, sampled: bool
) -> Segment:
    header, d, changes = s.trial.header, s.drive, None
    memory = max(1, int(round(MEMORY / step)))
    if sampled:
        changes = _changes(d, t0, steps, step)
        d = replace(d, t=np.concatenate([d.t[:1], 0.5 * (d.t[1:] + d.t[:-1])]))
    force = _commanded_force(d, np.asarray(t0 + step * np.arange(-memory, steps + 1)))
    if changes:
        inside = changes.which >= 0
        force[memory:][inside] = s.drive.at(t0 + step * (np.flatnonzero(inside) + 0.5))
    measured = {}
    for column, (t, values) in s.measured.items():
        # The first sample is where the segment starts, so that neighbours do not share it.
        inside = (t >= t0 - 1e-9) & (t < t0 + steps * step - 1e-9)
        if inside.any():
            measured[column] = (np.maximum(t[inside] - t0, 0.0), values[inside])
    water = header.water
    return Segment(
        trial=s.trial.name,
        index=index,
        t0=t0,
        step=step,
        drive=Drive(
            force=force[memory:],
            before=force[:memory],
            B=np.asarray(d.B, float),
            commanded=d.commanded,
            thrusters=d.thrusters,
            changes=changes,
        ),
        start=_start(s, t0),
        sink=_sink(s.motion, vehicle, t0, t0 + steps * step),
        density=water.density or vehicle.water.density,
        current=np.asarray(water.current or (0.0, 0.0, 0.0), float),
        sensors=SensorPlaces(
            velocity_at=np.asarray(header.velocity_at, float),
            velocity_in_water=header.velocity == "water",
            position_at=np.asarray(header.position_at, float),
            depth_at=depth_place(s.trial, vehicle),
        ),
        measured=measured,
    )


def _commanded_force(d: InputForces, edges: Array) -> Array:
    """Return the command of the motors in each step between `edges` [s], (steps, k); see `Drive.force`."""
    if d.commanded:
        return _means(d, edges)
    # An actuator without lag ramps from one value to the next: each value is that at its step's end, or the mean around
    # it where values jump or are sampled faster than the steps.
    half = 0.5 * np.diff(edges)
    if not d.held and float(np.median(np.diff(d.t))) > 0.7 * float(edges[1] - edges[0]):
        return d.at(edges[1:])
    return _means(d, np.concatenate([edges[:1] + half[:1], edges[1:] + half]))


def _means(d: InputForces, edges: Array) -> Array:
    """Return the mean force between successive times [s], (m + 1,) -> (m, k); outside the recording the
    nearest value."""
    span = np.diff(d.t)[:, None]
    area = span * (d.force[:-1] if d.held else 0.5 * (d.force[:-1] + d.force[1:]))
    total = np.concatenate([np.zeros((1, d.force.shape[1])), np.cumsum(area, axis=0)])
    i = np.clip(np.searchsorted(d.t, edges, side="right") - 1, 0, len(d.t) - 1)
    inside = np.clip(edges, d.t[0], d.t[-1])
    now = d.force[i] if d.held else 0.5 * (d.force[i] + d.at(inside))
    integral = total[i] + (inside - d.t[i])[:, None] * now
    integral += np.minimum(edges - d.t[0], 0.0)[:, None] * d.force[0]
    integral += np.maximum(edges - d.t[-1], 0.0)[:, None] * d.force[-1]
    return np.asarray(np.diff(integral, axis=0) / np.diff(edges)[:, None])


def _start(s: Streams, t0: float) -> InitialState:
    """Return the state at a given time."""
    m = s.motion
    i = int(np.argmin(np.abs(m.t - t0)))
    near = slice(max(i - 3, 0), i + 4)

    def nearest(values: Array) -> Array:
        rows = np.flatnonzero(np.isfinite(values[near]))
        if not len(rows):
            return np.asarray(np.nan)
        return np.asarray(values[near][rows[np.argmin(np.abs(m.t[near][rows] - t0))]])

    nu = np.array([nearest(column) for column in m.nu.T])
    position = np.array([nearest(column) for column in m.position.T])
    quaternion = np.array([nearest(column) for column in m.quaternion.T])
    attitude = bool(np.isfinite(quaternion).all())
    known = np.concatenate([np.isfinite(nu), np.full(3, attitude), np.isfinite(position)])
    level = np.array([0.0, 0.0, 0.0, 1.0])
    if not attitude and "yaw" in s.measured:
        t, heading = s.measured["yaw"]
        level = quat_from_euler(0.0, 0.0, np.interp(t0, t, np.unwrap(heading)))
        known[STATES.index("yaw")] = True
    return InitialState(
        position=np.nan_to_num(position),
        quaternion=quaternion if attitude else level,
        nu=np.nan_to_num(nu),
        known=known,
    )


def _sink(m: Motion, vehicle: Vehicle, a: float, b: float) -> float:
    """Return the vertical offset of the simulation [m]: zero if the vehicle came near the surface.

    Vehicles do not fly: heights well above 0 are relative to another zero than the surface, such as a motion
    capture system's floor, and the vehicle is then treated as submerged.
    """
    reach = max(vehicle.body.surface_half_height, 0.5 * float(vehicle.body.size[2]))
    height = m.position[np.isfinite(m.position[:, 2]), 2]
    if len(height) and np.percentile(height, 99.0) > reach + FLIES:
        return DEEP - float(height.max())
    rows = (m.t >= a - 1e-9) & (m.t <= b + 1e-9) & np.isfinite(m.position[:, 2])
    if not rows.any():
        return 50.0 * DEEP
    level = np.isfinite(m.quaternion[rows]).all(axis=1, keepdims=True)
    q = np.where(level, m.quaternion[rows], [0.0, 0.0, 0.0, 1.0])
    center = m.position[rows, 2] + quat_rotate(q, vehicle.body.center_of_buoyancy)[:, 2]
    return DEEP if float(center.max()) < -reach else 0.0


# Simulation of many candidate plants over many segments.

Single = NDArray[np.float32]

BUDGET = 300e6
"""Memory for the worlds and responses of one pass [bytes]; more candidates require several passes."""

WORLD = 6000.0
"""Memory of one world [bytes]: plant, state, history, delay line."""

LONGEST_STEP = 0.025
"""Physics step above which a simulation step is subdivided [s]."""

MOTION = ("nu", "position", "quaternion", "tau", "pull", "earlier")
"""Arguments of a rollout that are not fields of the plant."""

OPEN = 1.0e6
"""Force limit of an unlimited actuator [N]."""


@dataclass(frozen=True)
class Response:
    """Response of every candidate on every segment; rows after a world's end or divergence are NaN."""

    t: NDArray[np.float64]
    """Times since the segment's start [s], (n + 1,)."""
    nu: Single
    """Velocity of the body origin, body frame [m/s, rad/s], (n + 1, C, S, 6)."""
    position: Single
    """Position of the body origin, world frame [m], (n + 1, C, S, 3)."""
    quaternion: Single
    """Body to world, (n + 1, C, S, 4)."""
    finite: NDArray[np.bool_]
    """True if a world reached its segment's end, (C, S)."""


class Rollouts:
    """Simulator of segments under candidate plants."""

    def __init__(
        self,
        vehicle: Vehicle,
        segments: Sequence[Segment],
        *,
        hydrodynamics: str = "calibrated",
        max_delay: float = 0.5,
    ) -> None:
        """Set up the simulator.

        Args:
            vehicle: Vehicle with every number that a candidate does not define.
            segments: Segments with one common step; their lengths and inputs may differ.
            hydrodynamics: Key of the vehicle's hydrodynamic sets.
            max_delay: Longest delay of a candidate [s].

        Raises:
            CalibrationError: There are no segments, steps differ, or there are more than eight input channels.
        """
        steps = {round(s.step, 9) for s in segments}
        if not steps:
            raise CalibrationError("nothing to simulate: no trial has a usable interval")
        if len(steps) > 1:
            raise CalibrationError(f"segments have steps of {sorted(steps)} s, expected one step for all")
        wide = [s.trial for s in segments if s.drive.B.shape[1] > MAX_THRUSTERS]
        if wide:
            raise CalibrationError(f"{wide[0]}: more than {MAX_THRUSTERS} input channels cannot be simulated")
        self.vehicle, self.segments, self.hydrodynamics = vehicle, tuple(segments), hydrodynamics
        self.step = segments[0].step
        self.nominal = vehicle_parameters(vehicle, hydrodynamics)
        self._current = np.stack([s.current for s in segments])[None]
        self._options: dict[str, Any] = {
            "hydrodynamics": hydrodynamics,
            "control_step": self.step,
            "substeps": max(1, math.ceil(self.step / LONGEST_STEP - 1e-9)),
            "integrator": "rk4",
            "max_delay": max(max_delay, float(self.nominal["delay"])),
            "water_moves": bool(self._current.any()),
        }
        self._simulators: dict[int, Simulator] = {}
        self._lengths = np.array([s.steps for s in segments])
        n = int(self._lengths.max())
        self._force = np.zeros((n, len(segments), MAX_THRUSTERS), np.float32)
        memory = max(len(s.drive.before) for s in segments)
        self._before = np.zeros((memory, len(segments), MAX_THRUSTERS), np.float32)
        self._change, self._which = np.zeros_like(self._force), np.full(self._force.shape[:2], -1)
        self._interval = np.zeros((*self._force.shape[:2], 2))
        self.changes = np.zeros(len(segments), np.int64)
        for i, s in enumerate(segments):
            force, before = s.drive.force, s.drive.before
            k = force.shape[1]
            self._force[: s.steps, i, :k] = force
            self._force[s.steps :, i, :k] = force[-1]
            self._before[:, i, :k] = before[:1]
            self._before[memory - len(before) :, i, :k] = before
            if s.drive.changes is not None:
                change, which, place = s.drive.changes
                self._change[: s.steps, i, :k] = change
                self._which[: s.steps, i], self._interval[: s.steps, i] = which, place
                self.changes[i] = which.max() + 1
        self.own = self._own_fields()
        self._held = self._imposed()

    def _imposed(self) -> list[tuple[NDArray[np.int64], NDArray[np.int64], Single]]:
        """Return the imposed axes that occur together, the segments with them, and their values by (n + 1,
        segments, axes)."""
        patterns: dict[tuple[int, ...], list[int]] = {}
        for i, s in enumerate(self.segments):
            axes = () if s.held is None else tuple(np.flatnonzero(np.isfinite(s.held).all(axis=0)).tolist())
            if axes:
                patterns.setdefault(axes, []).append(i)
        n, out = int(self._lengths.max()), []
        for axes, those in patterns.items():
            columns = [np.asarray(self.segments[i].held)[:, axes] for i in those]
            values = [np.pad(c, ((0, n + 1 - len(c)), (0, 0)), mode="edge") for c in columns]
            out.append((np.array(axes), np.array(those), np.stack(values, axis=1).astype(np.float32)))
        return out

    def _own_fields(self) -> dict[str, NDArray[np.float64]]:
        """Return plant fields that differ between segments: force allocation, and the water's density. (S, ...)"""
        out: dict[str, list[Any]] = {}
        for d in (s.drive for s in self.segments):
            B = np.zeros((6, MAX_THRUSTERS))
            B[:, : d.B.shape[1]] = d.B
            field: dict[str, Any] = {"B": B}
            names = ("force_min", "force_max", "dead_minus", "dead_plus", "time_constant", "slew", "play")
            if d.commanded and d.thrusters:
                field |= {name: self.nominal[name] for name in (*names, "delay", "speed_lag")}
            else:
                # Commanded wrenches also pass through the motors, as through six equal ones.
                n = len(self.vehicle.thrusters)
                tc = float(np.mean(self.nominal["time_constant"][:n])) if d.commanded else 0.0
                values = (-OPEN, OPEN, 0.0, 0.0, tc, NO_LIMIT, 0.0)
                field |= {
                    name: np.full(MAX_THRUSTERS, value) for name, value in zip(names, values, strict=True)
                }
                field |= {"delay": self.nominal["delay"] if d.commanded else 0.0, "speed_lag": 0}
            for name, value in field.items():
                out.setdefault(name, []).append(np.asarray(value, float))
        return {name: np.stack(values) for name, values in out.items()}

    def run(
        self,
        plant: Mapping[str, ArrayLike] | None = None,
        *,
        initial: Mapping[str, ArrayLike] | None = None,
        disturbance: ArrayLike | None = None,
        pull: Array | None = None,
        earlier: Array | None = None,
        candidates: int | None = None,
    ) -> Response:
        """Simulate every candidate over every segment.

        Args:
            plant: Field of `VehicleParameters` -> values by (C, S, ...); either axis may be 1. Volume and
                mesh drag are those in the vehicle file's water: a trial's own density scales them.
            initial: `nu`, `quaternion`, `position` at the start, if they differ from the segments' own, (C, S, ...).
            disturbance: Additional wrench about the body origin, body frame [N, N m], (C, S, 6).
            pull: Additional force at the body origin [N], (C, S, 3): along the body's axes at the segment's
                start, and from then on constant in the world frame.
            earlier: Lead of each change of a sampled command relative to the middle between its samples, as a
                fraction of the sample interval [-], (C, S, `changes.max()`).
            candidates: C; the longest first axis among the arrays if None.

        Returns:
            Responses of all candidates.
        """
        given = {**(plant or {}), **(initial or {}), "tau": disturbance, "earlier": earlier}
        if pull is not None and pull.any():
            given["pull"] = pull
        arrays = {name: np.asarray(values) for name, values in given.items() if values is not None}
        C = candidates or max([1, *(a.shape[0] for a in arrays.values())])
        n, S = self._force.shape[:2]
        out = {
            name: np.empty((n + 1, C, S, width), np.float32)
            for name, width in (("nu", 6), ("position", 3), ("quaternion", 4))
        }
        finite = np.ones((C, S), bool)
        for low, high in self._passes(C):
            part = {k: a if a.shape[0] == 1 else a[low:high] for k, a in arrays.items()}
            finite[low:high] = self._pass(high - low, part, {k: v[:, low:high] for k, v in out.items()})
        return Response(t=np.asarray(self.step * np.arange(n + 1)), finite=finite, **out)

    def _passes(self, candidates: int) -> Iterator[tuple[int, int]]:
        n, S = self._force.shape[:2]
        most = max(1, int(BUDGET / (S * (WORLD + 52.0 * (n + 1)))))
        size = math.ceil(candidates / math.ceil(candidates / most))
        for low in range(0, candidates, size):
            yield low, min(low + size, candidates)

    def _simulator(self, candidates: int) -> Simulator:
        if candidates not in self._simulators:
            if len(self._simulators) > 3:
                self._simulators.clear()
            worlds = candidates * len(self.segments)
            self._simulators[candidates] = Simulator(
                self.vehicle, worlds=worlds, water=Water(), **self._options
            )
        return self._simulators[candidates]

    def _pass(self, C: int, given: dict[str, NDArray[Any]], out: dict[str, Single]) -> NDArray[np.bool_]:
        """Simulate candidates that fit in memory; store their responses and return which worlds reached the end."""
        sim, S = self._simulator(C), len(self.segments)
        shape = (C, S)

        def write(target: Any, values: NDArray[Any]) -> None:
            view = target.numpy().reshape(*shape, *target.numpy().shape[target.ndim :])
            view[...] = values

        fields = {k: np.asarray(v)[None, None] for k, v in self.nominal.items()}
        fields |= {k: v[None] for k, v in self.own.items()}
        fields |= {k: v for k, v in given.items() if k not in MOTION}
        density = np.array([s.density for s in self.segments]) / self.vehicle.water.density
        for name in ("volume", "form_drag", "skin_drag"):
            fields[name] = fields[name] * density
        if self._current.any():
            write(sim.water.current, self._current)
        write(sim.command.disturbance, given.get("tau", np.zeros((1, 1, 6))))
        self._place(sim, write, {})
        sim.reset()
        # Without lag, motors reach the first command in one step; afterwards they follow the commands with their lag.
        longest = float(np.max(fields["delay"])) + SETTLED * float(np.max(fields["time_constant"]))
        limited = (fields["slew"] > 0.0) & (fields["slew"] < NO_LIMIT)
        needed = len(self._before) if limited.any() else math.ceil(longest / self.step)
        past = self._before[max(len(self._before) - needed - 1, 0) :]
        swift = fields | {"time_constant": 0.0, "delay": 0.0, "slew": NO_LIMIT}
        for own, commands in ((swift, past[:1]), (fields, past[1:])):
            for name, values in own.items():
                write(sim.plant.fields[name], values)
            sim.refresh()
            for command in commands:
                self._command(sim, C)[...] = command
                sim.step()
            if own is swift:
                ring = sim.state.commands.numpy().reshape(C, S, -1, MAX_THRUSTERS)
                ring[...] = sim.state.actuator.numpy().reshape(C, S, 1, MAX_THRUSTERS)
        self._place(sim, write, given)
        return self._march(sim, C, out, given)

    def _place(
        self, sim: Simulator, write: Callable[[Any, NDArray[Any]], None], start: dict[str, NDArray[Any]]
    ) -> None:
        """Set every world to the state `start`, if given, otherwise to its segment's own."""
        for name, own in (("nu", "velocity"), ("quaternion", "quaternion"), ("position", "position")):
            values = start.get(name, np.stack([getattr(s.start, name) for s in self.segments])[None])
            if name == "position":
                values = values + np.array([s.sink for s in self.segments])[:, None] * [0.0, 0.0, 1.0]
            write(getattr(sim.state, own), values)

    def _command(self, sim: Simulator, C: int) -> Single:
        return np.asarray(sim.command.thrust.numpy().reshape(C, len(self.segments), MAX_THRUSTERS))

    def _impulses(self, sim: Simulator, C: int) -> list[Single]:
        """Return the change of nu for a unit change of the imposed axes by an impulse on these alone, (C,
        segments, 6, axes)."""
        inverse = sim.plant.M_inv.numpy().reshape(C, len(self.segments), 6, 6)
        out = []
        for axes, those, _ in self._held:
            columns = inverse[:, those][..., axes]
            out.append(columns @ np.linalg.inv(columns[..., axes, :]))
        return out

    def _impose(self, nu: Single, impulses: list[Single], row: int) -> None:
        """Set imposed axes to their given motion, including its inertial effect on the other axes."""
        for (axes, those, values), impulse in zip(self._held, impulses, strict=True):
            now = nu[:, those]
            now += (impulse @ (values[row] - now[..., axes])[..., None])[..., 0]
            nu[:, those] = now

    def _march(
        self, sim: Simulator, C: int, out: dict[str, Single], given: dict[str, NDArray[Any]]
    ) -> NDArray[np.bool_]:
        """Simulate the segments; store the response of every world and return which worlds reached the end.

        From `given`, pulls and earlier changes of commands are used here; see `run`.
        """
        n, S = self._force.shape[:2]
        command, begin = self._command(sim, C), sim.state.steps.numpy().reshape(C, S).copy()
        views = {
            name: getattr(sim.state, own).numpy().reshape(C, S, -1)
            for name, own in (("nu", "velocity"), ("position", "position"), ("quaternion", "quaternion"))
        }
        earlier = given.get("earlier", np.zeros((C, S, int(self.changes.max()))))
        tau = sim.command.disturbance.numpy().reshape(C, S, 6)[..., :3]
        constant, pull = tau.copy(), None
        if "pull" in given:
            pull = quat_rotate(views["quaternion"], given["pull"].astype(np.float32))
        impulses = self._impulses(sim, C)
        for axes, those, values in self._held:
            views["nu"][:, those[:, None], axes] = values[0]
        for name, view in views.items():
            out[name][0] = view
        for k in range(n):
            command[...] = self._force[k]
            if len(those := np.flatnonzero(self._which[k] >= 0)):
                low, high = self._interval[k, those].T
                after = high - 0.5 + earlier[:, those, self._which[k, those]]
                command[:, those] += (
                    np.clip(after / (high - low), 0.0, 1.0)[..., None] * self._change[k, those]
                )
            if pull is not None:
                tau[...] = constant + quat_rotate(quat_conjugate(views["quaternion"]), pull)
            sim.step()
            self._impose(views["nu"], impulses, k + 1)
            for name, view in views.items():
                out[name][k + 1] = view
        out["position"][..., 2] -= np.array([s.sink for s in self.segments], np.float32)
        # A frozen world has counted the step in which it diverged.
        frozen = sim.state.frozen.numpy().reshape(C, S) != 0
        reached = np.where(frozen, sim.state.steps.numpy().reshape(C, S) - 1 - begin, n)
        last = np.minimum(reached, self._lengths)
        late = np.arange(n + 1)[:, None, None] > last
        for values in out.values():
            values[late] = np.nan
        return np.asarray(reached >= self._lengths)
