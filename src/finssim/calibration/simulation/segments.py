"""Stretches of trials that are simulated on their own: what pushed, where they begin, what was measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.motion.signals import Motion, motion
from finssim.calibration.trials.inputs import Drive, drive
from finssim.calibration.trials.trial import Trial
from finssim.geometry.rotations import quat_rotate, quat_to_euler
from finssim.vehicles import Vehicle

__all__ = ["CHANNELS", "Segment", "Streams", "segments", "streams"]

Array = NDArray[np.float64]

CHANNELS = ("u", "v", "w", "p", "q", "r", "roll", "pitch", "yaw", "x", "y", "z", "depth")
"""Measured columns that a simulation is compared with."""

MEMORY = 1.0
"""Commands before a segment that are kept, for delay and lag of the motors [s]."""

DEEP = -30.0
"""Added to the height of a vehicle that never came near the surface [m]: deep enough for its drift, not so deep that
single precision would lose slow motion. Where nobody measured the depth that does not matter, and it is much deeper."""

FLIES = 0.15
"""Height of the origin above the reach of a floating vehicle that is no height above the surface any more [m]."""


@dataclass(frozen=True, kw_only=True)
class Segment:
    """One stretch of a trial on a uniform grid of `steps` steps."""

    trial: str
    """Name of the trial."""
    index: int
    """Which of the trials of a fit it belongs to."""
    t0: float
    """Its start on the trial's clock [s]."""
    step: float
    """[s]"""
    force: Array
    """What the motors are told in each step [N, N m]: the mean of a held command; of an applied force, which is
    linear between samples, the value at the step's end. (steps, k)"""
    before: Array
    """The same in the steps before, the newest last; repeats the first value before the trial began. (m, k)"""
    B: Array
    """Wrench about the body origin per unit force, (6, k)."""
    commanded: bool
    """Whether delay, dead zone, lag, slew and limits lie between `force` and what acts."""
    thrusters: bool
    """Whether the k forces are the vehicle's thrusters in canonical order."""
    position: Array
    """At the start, world frame [m], (3,); 0 where unknown."""
    quaternion: Array
    """At the start, body to world, (4,); level and heading 0 where unknown."""
    nu: Array
    """At the start, of the body origin [m/s, rad/s], (6,); 0 where unknown."""
    known: NDArray[np.bool_]
    """Which of nu (6), roll, pitch, yaw, x, y, z at the start come from measurements, (12,)."""
    sink: float
    """Added to the height while simulating [m], so that a vehicle that stayed wholly submerged cannot surface."""
    density: float
    """Of the water [kg/m³]."""
    current: Array
    """World frame [m/s], (3,)."""
    measured: dict[str, tuple[Array, Array]]
    """Column of `CHANNELS` -> times since t0 [s] and values."""
    velocity_at: Array
    """Body point whose velocity u, v, w are [m]."""
    velocity_in_water: bool
    """Whether u, v, w are relative to the water."""
    position_at: Array
    """Body point whose position x, y, z are [m]."""
    depth_at: Array
    """Body point of the pressure sensor [m]."""
    held: Array | None = None
    """nu that is imposed at the start and after every step, (steps + 1, 6); NaN where the simulation is free."""

    @property
    def steps(self) -> int:
        """Length of the grid."""
        return len(self.force)

    @property
    def duration(self) -> float:
        """[s]"""
        return self.steps * self.step


@dataclass(frozen=True, kw_only=True)
class Streams:
    """A trial prepared for cutting: its drive, its motion and its comparable columns."""

    trial: Trial
    drive: Drive
    motion: Motion
    measured: dict[str, tuple[Array, Array]]
    """Column of `CHANNELS` -> times on the trial's clock [s] and values."""


def streams(trial: Trial, vehicle: Vehicle) -> Streams:
    """Prepare a trial once, to cut it in several ways."""
    measured = {c: trial.series(c) for c in CHANNELS}
    q = [trial.channels.get(f"q{c}") for c in "xyzw"]
    if all(part is not None for part in q):
        quaternion = np.stack([np.asarray(part) for part in q], axis=-1)
        good = np.isfinite(quaternion).all(axis=1)
        for name, angle in zip(("roll", "pitch", "yaw"), quat_to_euler(quaternion[good]), strict=True):
            if not len(measured[name][0]):
                measured[name] = (trial.t[good], angle)
    measured = {c: pair for c, pair in measured.items() if len(pair[0])}
    return Streams(trial=trial, drive=drive(trial, vehicle), motion=motion(trial, vehicle), measured=measured)


def segments(
    trial: Trial | Streams,
    vehicle: Vehicle,
    *,
    length: float | None = None,
    step: float = 0.02,
    start: float = 0.0,
    index: int = 0,
) -> list[Segment]:
    """Cut a trial into stretches of about equal length; a gap in the recording always ends one.

    Args:
        trial: The trial, or what `streams` made of it.
        vehicle: Whose it is.
        length: Of each [s]; the whole trial, up to its gaps, if None.
        step: Of the simulation [s].
        start: Left out at the beginning [s].
        index: Which of several trials this is.

    Returns:
        In order of time; none where nothing measured lies inside.

    Raises:
        CalibrationError: the step or length is not above zero.
    """
    if not step > 0.0 or (length is not None and not length > 0.0):
        raise CalibrationError(
            f"segments of {length} s in steps of {step} s, expected times above 0 s", _name(trial)
        )
    s = trial if isinstance(trial, Streams) else streams(trial, vehicle)
    out = []
    for a, b in _stretches(s, start):
        steps = int(round((b - a) / step - 1e-6))
        parts = 1 if length is None else max(1, round(steps * step / length))
        edges = [steps * i // parts for i in range(parts + 1)]
        for low, high in zip(edges, edges[1:], strict=False):
            if high - low >= 2:
                segment = _segment(s, vehicle, a + low * step, high - low, step, index)
                if segment.measured:
                    out.append(segment)
    return out


def _name(trial: Trial | Streams) -> str:
    return trial.name if isinstance(trial, Trial) else trial.trial.name


def _stretches(s: Streams, start: float) -> list[tuple[float, float]]:
    """Spans in which the inputs are known, inside the recording."""
    begin = float(s.trial.t[0]) + start
    spans = [(max(float(a), begin), float(b)) for a, b in s.drive.spans]
    return [(a, b) for a, b in spans if b > a]


def _segment(s: Streams, vehicle: Vehicle, t0: float, steps: int, step: float, index: int) -> Segment:
    header, d = s.trial.header, s.drive
    memory = max(1, int(round(MEMORY / step)))
    force = _told(d, np.asarray(t0 + step * np.arange(-memory, steps + 1)))
    position, quaternion, nu, known = _start(s.motion, t0)
    measured = {}
    for column, (t, values) in s.measured.items():
        # The first sample is where the segment begins, so that neighbours do not share it.
        inside = (t >= t0 - 1e-9) & (t < t0 + steps * step - 1e-9)
        if inside.any():
            measured[column] = (np.maximum(t[inside] - t0, 0.0), values[inside])
    water = header.water
    depth = vehicle.sensors.depth
    at = header.depth_at if header.depth_at is not None else (depth.position if depth else (0.0, 0.0, 0.0))
    return Segment(
        trial=s.trial.name,
        index=index,
        t0=t0,
        step=step,
        force=force[memory:],
        before=force[:memory],
        B=np.asarray(d.B, float),
        commanded=d.commanded,
        thrusters=d.thrusters,
        position=position,
        quaternion=quaternion,
        nu=nu,
        known=known,
        sink=_sink(s.motion, vehicle, t0, t0 + steps * step),
        density=water.density or vehicle.water.density,
        current=np.asarray(water.current or (0.0, 0.0, 0.0), float),
        measured=measured,
        velocity_at=np.asarray(header.velocity_at, float),
        velocity_in_water=header.velocity == "water",
        position_at=np.asarray(header.position_at, float),
        depth_at=np.asarray(at, float),
    )


def _told(d: Drive, edges: Array) -> Array:
    """What the motors are told in each step between `edges` [s], (steps, k); see `Segment.force`."""
    if d.commanded:
        return _means(d, edges)
    # An actuator without lag ramps from one value to the next: each is the value at its step's end, or the mean around
    # it where values jump or come faster than the steps.
    half = 0.5 * np.diff(edges)
    if not d.held and float(np.median(np.diff(d.t))) > 0.7 * float(edges[1] - edges[0]):
        return d.at(edges[1:])
    return _means(d, np.concatenate([edges[:1] + half[:1], edges[1:] + half]))


def _means(d: Drive, edges: Array) -> Array:
    """Mean force between successive times [s], (m + 1,) -> (m, k); before and after the recording the nearest value."""
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


def _start(m: Motion, t0: float) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """State at a time and which of its twelve numbers are known."""
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
    return np.nan_to_num(position), quaternion if attitude else level, np.nan_to_num(nu), known


def _sink(m: Motion, vehicle: Vehicle, a: float, b: float) -> float:
    """How far down to simulate [m]: not at all where the vehicle came near the surface.

    No vehicle flies: heights well above 0 have another zero than the surface, such as a motion capture's on the floor,
    and then the vehicle counts as submerged.
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
