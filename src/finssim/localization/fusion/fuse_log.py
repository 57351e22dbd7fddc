"""Logs as samples in the order of their arrival: a folder with one table per stream, or one table of all streams."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from finssim.core.rotations import quat_inverse_rotate
from finssim.core.text_table import EMPTY, TextTable, read_text_table
from finssim.localization import LocalizationError
from finssim.localization.detection.detections import Frame, read_detections
from finssim.localization.fusion.attitude import in_body_axes, roll_pitch, up_of
from finssim.localization.fusion.streams import DepthSample, ImuSample, Sample, VisionSample
from finssim.vehicles import Vehicle
from finssim.vehicles.equipment import Imu

# Tables of a log: columns of numbers by name, empty cells as NaN.

Array = npt.NDArray[np.float64]

TIME = ("t", "time", "time_s", "timestamp", "stamp", "seconds")
TEXT_COLUMNS = ("image", "status", "reason")
"""Columns that contain text even if they look like numbers."""
QUATERNION = ("qx", "qy", "qz", "qw")
LONGEST_GAP = 2.0
"""Longest plausible interval between two angular rates [s]."""
TRUTH = {"true": 1.0, "yes": 1.0, "false": 0.0, "no": 0.0}


@dataclass
class StreamTable:
    """One table of a log."""

    name: str
    """Name in messages."""
    t: Array
    """Times as in the file [s], (n,)."""
    numbers: dict[str, Array]
    """Column name in lower case -> values in the unit of the table, (n,)."""
    words: dict[str, list[str]]
    """Column name -> text cells."""
    notes: list[str] = field(default_factory=list)

    def has(self, *names: str) -> bool:
        """Return whether each of these columns contains at least one number."""
        return all(name in self.numbers and np.isfinite(self.numbers[name]).any() for name in names)

    def columns(self, *names: str) -> Array:
        """Return columns side by side in the unit of the table, (n, len(names))."""
        return np.stack([self.numbers[name] for name in names], axis=-1)

    def angle(self, name: str) -> Array:
        """Return a column of angles in radians, converted if its name ends in `_deg` [rad]; NaN if it is missing."""
        if name in self.numbers:
            return self.numbers[name]
        if f"{name}_deg" in self.numbers:
            return np.asarray(np.radians(self.numbers[f"{name}_deg"]))
        return np.full(len(self.t), math.nan)

    def up(self) -> Array | None:
        """Return unit vectors upwards in the axes to which the table's attitude refers, (n, 3); None without
        an attitude.

        Raises:
            LocalizationError: Quaternions are not of unit length, or angles exceed a turn.
        """
        if self.has(*QUATERNION):
            q = self.columns(*QUATERNION)
            length = np.linalg.norm(q, axis=1, keepdims=True)
            near = np.abs(length - 1.0) < 0.05
            if not near.any():
                raise LocalizationError(
                    f"{self.name}: qx, qy, qz, qw are not of unit length: expected body to world"
                )
            return quat_inverse_rotate(np.where(near, q / length, np.nan), np.array([0.0, 0.0, 1.0]))
        roll, pitch = self.angle("roll"), self.angle("pitch")
        if not (np.isfinite(roll).any() and np.isfinite(pitch).any()):
            return None
        if np.nanmax(np.abs([roll, pitch])) > 2.0 * math.pi:
            raise LocalizationError(
                f"{self.name}: roll or pitch exceeds a turn: expected radians, or columns roll_deg, pitch_deg"
            )
        return up_of(roll, pitch)


# Time series that are interpolated between samples and not extrapolated.


@dataclass(frozen=True, eq=False)
class Series:
    """Samples in the order of their times."""

    what: str
    """Name of the quantity in messages, such as `depth`."""
    t: Array
    """Times, increasing [s], (n,)."""
    values: Array
    """Values in the unit of the quantity, (n, k)."""
    longest_gap: float
    """Longest gap between samples that is interpolated [s]."""

    def between(self, times: Array) -> tuple[Array, npt.NDArray[np.bool_]]:
        """Return the values at times [s], interpolated linearly, (m, k), and a mask of the times at which
        they are known."""
        k = np.clip(np.searchsorted(self.t, times), 1, max(len(self.t) - 1, 1))
        late = np.minimum(k, len(self.t) - 1)
        near = self.t[late] - self.t[k - 1] <= self.longest_gap
        columns = [np.interp(times, self.t, column) for column in self.values.T]
        return np.column_stack(columns), (times >= self.t[0]) & (times <= self.t[-1]) & near

    def at(self, time: float) -> Array | str:
        """Return the values at a time [s], interpolated linearly, (k,); or the reason why they are unknown."""
        if not np.isfinite(time):
            return f"no {self.what} at the exposure: the picture has no time stamp"
        first, last = float(self.t[0]), float(self.t[-1])
        if not first <= time <= last:
            return f"no {self.what} at the exposure: {time:.3f} s is outside the file's {first:.3f} to {last:.3f} s"
        k = int(np.searchsorted(self.t, time))
        if self.t[k] == time:
            return np.asarray(self.values[k])
        gap = float(self.t[k] - self.t[k - 1])
        if gap > self.longest_gap:
            return f"no {self.what} at the exposure: its samples around {time:.3f} s are {gap:.2f} s apart"
        share = (time - self.t[k - 1]) / gap
        return np.asarray((1.0 - share) * self.values[k - 1] + share * self.values[k])


def series(quantity: str, t: Array, values: Array, longest_gap: float, *, label: str) -> Series:
    """Sort samples by time and leave out those without any number; of equal times the last is used.

    Times are in [s], values in the unit of the quantity.

    Raises:
        LocalizationError: No sample remains.
    """
    order = np.argsort(t, kind="stable")
    t, values = t[order], values[order]
    good = np.isfinite(t) & np.isfinite(values).any(axis=1)
    t, values = t[good], values[good]
    if not len(t):
        raise LocalizationError(f"{label}: no row holds a time and a {quantity}: expected numbers")
    last = np.append(t[1:] > t[:-1], True)
    return Series(quantity, t[last], values[last], longest_gap)


def read_stream_table(path: str | Path) -> StreamTable:
    """Read a CSV file with a line of column names; cells are separated by commas, semicolons or tabs; #
    begins a comment.

    Rows of the wrong length, such as a last line that a crash cut short, are left out.

    Args:
        path: The file.

    Raises:
        LocalizationError: The file is unreadable, or lacks names, a time column or rows.
    """
    text = read_text_table(path, LocalizationError)
    names = [name.lower() for name in text.names]
    time = next((name for name in TIME if name in names), None)
    if time is None or len(set(names)) < len(names):
        raise LocalizationError(
            f"{path}: expected a line of different column names with t, such as t,depth; found "
            f"'{','.join(names)[:60]}'"
        )
    rows = text.rows
    complete = [row for row in rows if len(row) == len(names)]
    table = StreamTable(str(path), np.full(len(complete), np.nan), {}, {})
    if len(complete) < len(rows):
        table.notes.append(
            f"{Path(path).name}: {len(rows) - len(complete)} rows do not have {len(names)} cells and were left out"
        )
    if not complete:
        raise LocalizationError(f"{path}: holds no rows: give a table with samples")
    for name, cells in zip(names, zip(*complete, strict=True), strict=True):
        values = [_number(cell, text) for cell in cells]
        no_numbers = all(math.isnan(v) for v in values) and any(not EMPTY.fullmatch(c.lower()) for c in cells)
        if no_numbers or name in TEXT_COLUMNS:
            table.words[name] = list(cells)
        else:
            table.numbers[name] = np.array(values, float)
    if time not in table.numbers:
        raise LocalizationError(f"{path}: column '{time}' holds no numbers: write times in seconds")
    table.t = table.numbers.pop(time)
    return table


def _number(cell: str, text: TextTable) -> float:
    """Return the number in a cell; NaN if there is none. Infinities are kept: the estimator refuses and
    counts them."""
    value = text.number(cell)
    return TRUTH.get(cell.lower(), math.nan) if value is None else value


RATES, FORCE = ("p", "q", "r"), ("ax", "ay", "az")
SENSOR_RATES, SENSOR_FORCE = ("gyro_x", "gyro_y", "gyro_z"), ("accel_x", "accel_y", "accel_z")
"""Column names of vectors in the IMU's own axes."""
HELD = 0.5
"""Fraction of repeated rows above which a slower stream is assumed to have been logged in a faster table [-]."""


@dataclass(frozen=True)
class NoFix:
    """A picture in which the vehicle was not located."""

    time: float
    """Stamp of the picture [s]."""
    reason: str


@dataclass
class Log:
    """Content of a log."""

    samples: list[Sample] = field(default_factory=list)
    """Samples in the order of their arrival."""
    frames: list[Frame] = field(default_factory=list)
    """Pictures with tags, in the order of their stamps, if the log has no fixes."""
    missed: list[NoFix] = field(default_factory=list)
    """Pictures in which `finssim localize` did not locate the vehicle."""
    truth: StreamTable | None = None
    """True pose of the vehicle: t, x, y, z [m], yaw [rad], pool frame."""
    notes: list[str] = field(default_factory=list)
    """Remarks about repairs and excluded samples."""


def load_log(path: str | Path, vehicle: Vehicle, *, latency: float = 0.0) -> Log:
    """Read a log.

    Args:
        path: A folder with imu.csv, depth.csv, vision.csv or detections.csv, and optionally truth.csv; or one
            table.
        vehicle: Vehicle whose file gives the mount of the IMU and the latencies of the sensors.
        latency: Latency of the camera: stamp of a picture minus the middle of its exposure [s].

    Raises:
        LocalizationError: There is no table, or one lacks the columns of its stream.
    """
    path = Path(path)
    log = Log()
    if path.is_dir():
        tables = {n: read_stream_table(path / f"{n}.csv") for n in _STREAMS if (path / f"{n}.csv").is_file()}
        if "vision" not in tables and (path / "detections.csv").is_file():
            log.frames = sorted(read_detections(path / "detections.csv"), key=lambda frame: frame.time)
        if not tables and not log.frames:
            raise LocalizationError(f"{path}: holds no imu.csv, depth.csv, vision.csv or detections.csv")
        log.truth = tables.pop("truth", None)
    else:
        full_table = read_stream_table(path)
        tables = {name: full_table for name in ("imu", "depth", "vision") if _present(name, full_table)}
        if not tables:
            raise LocalizationError(
                f"{path}: no column p, q, r, depth, or x and y: see docs/reference/trial_format.md for the names"
            )
    readers = {"imu": _imu, "depth": _depth, "vision": _vision}
    for name, table in tables.items():
        if not _present(name, table):
            raise LocalizationError(f"{table.name}: expected the columns {_EXPECTED[name]}")
        log.samples += readers[name](table, vehicle, log, latency)
    log.notes += list(dict.fromkeys(note for table in tables.values() for note in table.notes))
    here = {sample.stream for sample in log.samples} | ({"vision"} if log.frames else set())
    log.notes += [note for stream, note in _MISSING.items() if stream not in here]
    log.samples.sort(key=lambda sample: sample.arrival if sample.arrival is not None else sample.time)
    return log


_STREAMS = ("imu", "depth", "vision", "truth")
_EXPECTED = {
    "imu": "t, p, q, r (body axes) or gyro_x, gyro_y, gyro_z (the sensor's)",
    "depth": "t, depth",
    "vision": "t or time, x, y and yaw",
}


_MISSING = {
    "imu": "no IMU samples: the heading is the camera's alone, the vehicle counts as level, and is never ready",
    "depth": "no depth samples: height stays unknown, and the vehicle is never ready",
    "vision": "no fixes and no detections: position and heading stay unknown",
}


def _present(name: str, table: StreamTable) -> bool:
    if name == "imu":
        return table.has(*RATES) or table.has(*SENSOR_RATES)
    return table.has("depth") if name == "depth" else table.has("x", "y")


class ImuColumns(NamedTuple):
    """Columns of an IMU in a table, in body axes; NaN in rows without a value."""

    omega: Array
    """Angular rate [rad/s], (n, 3)."""
    force: Array
    """Specific force [m/s²], (n, 3)."""
    up: Array | None
    """Unit vectors upwards, (n, 3); None without an attitude."""
    mount: Array
    """Quaternion from the axes of the columns to body axes, xyzw, (4,)."""


def imu_columns(table: StreamTable, sensor: Imu | None) -> ImuColumns:
    """Return the columns of an IMU in body axes.

    `gyro_x`, `accel_x`, ... are in the IMU's own axes and are rotated; `p`, `ax`, ... are in body axes already.

    Args:
        table: The table.
        sensor: IMU with its mount.

    Raises:
        LocalizationError: Columns are in the IMU's axes but its mount is unknown, or the attitude is invalid.
    """
    turned = table.has(*SENSOR_RATES) and not table.has(*RATES)
    if turned and sensor is None:
        raise LocalizationError(
            f"{table.name}: rates in the IMU's axes, but the vehicle file has no sensors.imu.orientation: add it"
        )
    mount = np.array(sensor.orientation if turned and sensor is not None else (0.0, 0.0, 0.0, 1.0), float)
    vectors = [np.full((len(table.t), 3), np.nan)] * 2
    forces = SENSOR_FORCE if table.has(*SENSOR_FORCE) else FORCE
    for i, names in enumerate((SENSOR_RATES if turned else RATES, forces)):
        if table.has(*names):
            vectors[i] = in_body_axes(table.columns(*names), mount)
    up = table.up()
    return ImuColumns(vectors[0], vectors[1], None if up is None else in_body_axes(up, mount), mount)


def _imu(table: StreamTable, vehicle: Vehicle, log: Log, latency: float) -> list[Sample]:
    sensor = vehicle.sensors.imu
    omega, force, up, _ = imu_columns(table, sensor)
    size = float(np.nanmedian(np.linalg.norm(force, axis=1))) if np.isfinite(force).any() else math.nan
    if size < 0.5 * vehicle.water.gravity:
        log.notes.append(f"accelerations of {size:.2g} m/s² hold no gravity and were left out")
        force = np.full(omega.shape, np.nan)
    tilt = np.full((len(omega), 2), np.nan) if up is None else np.stack(roll_pitch(up), axis=-1)
    rows = np.flatnonzero(~np.isnan(omega).any(axis=1))
    interval = float(np.median(np.diff(table.t[rows]))) if len(rows) > 2 else 0.0
    if interval > LONGEST_GAP:
        raise LocalizationError(
            f"{table.name}: rates of turn come every {interval:.3g} s, expected at most {LONGEST_GAP:g} s: are its "
            "times in seconds?"
        )
    if len(rows) > 1:  # if attitudes are logged in separate rows, each is held until the next rate
        tilt = _carried(table.t, tilt)
    arrival = _arrival(table, 0.0 if sensor is None else sensor.latency)
    return [
        ImuSample(
            time=float(table.t[k]),
            omega=_three(omega[k]),
            force=None if np.isnan(force[k]).any() else _three(force[k]),
            tilt=None if np.isnan(tilt[k]).any() else (float(tilt[k, 0]), float(tilt[k, 1])),
            arrival=float(arrival[k]),
        )
        for k in rows
    ]


def _carried(t: Array, values: Array) -> Array:
    """Return each row's values or, for at most 0.1 s, those of the latest complete row."""
    rows = np.where(np.isfinite(values).all(axis=1), np.arange(len(t)), -1)
    last = np.maximum.accumulate(rows)
    fresh = (last >= 0) & (t - t[np.maximum(last, 0)] <= 0.1)
    return np.where(fresh[:, None], values[np.maximum(last, 0)], np.nan)


def _depth(table: StreamTable, vehicle: Vehicle, log: Log, latency: float) -> list[Sample]:
    sensor, depth = vehicle.sensors.depth, table.numbers["depth"]
    arrival = _arrival(table, 0.0 if sensor is None else sensor.latency)
    rows = _thinned(np.flatnonzero(~np.isnan(depth)), depth[:, None], "depth", log)
    return [DepthSample(float(table.t[k]), float(depth[k]), float(arrival[k])) for k in rows]


def _vision(table: StreamTable, vehicle: Vehicle, log: Log, latency: float) -> list[Sample]:
    xy = table.columns("x", "y")
    yaw = table.angle("yaw")
    usable = ~np.isnan(xy).any(axis=1)
    if "status" in table.words:
        usable &= np.array([word.lower() == "ok" for word in table.words["status"]])
        reasons = table.words.get("reason", ["refused"] * len(usable))
        log.missed += [NoFix(float(table.t[k]), counted(reasons[k])) for k in np.flatnonzero(~usable)]
    rows = _thinned(np.flatnonzero(usable), np.column_stack([xy, yaw]), "vision", log)
    covariance = _covariance(table)
    arrival = _arrival(table, 0.0)
    time = table.numbers["exposure"] if table.has("exposure") else table.t - latency
    return [
        VisionSample(
            time=float(time[k]),
            position=(float(xy[k, 0]), float(xy[k, 1])),
            yaw=None if math.isnan(yaw[k]) else float(yaw[k]),
            covariance=None if np.isnan(covariance[k]).any() else rows_of(covariance[k]),
            arrival=float(arrival[k]),
        )
        for k in rows
    ]


def _covariance(table: StreamTable) -> Array:
    """Return the covariance of x, y and yaw in each row, (n, 3, 3); NaN in rows without standard deviations."""
    if not table.has("std_x", "std_y"):
        return np.full((len(table.t), 3, 3), np.nan)
    none = np.full(len(table.t), math.radians(180.0))  # a fix without yaw does not use its variance
    std_yaw = table.angle("std_yaw")
    std = np.column_stack([table.columns("std_x", "std_y"), np.where(np.isnan(std_yaw), none, std_yaw)])
    R: Array = (std * np.abs(std))[:, :, None] * np.eye(3)  # a negative deviation stays no covariance
    for i, j, name in ((0, 1, "cov_xy"), (0, 2, "cov_xyaw"), (1, 2, "cov_yyaw")):
        if table.has(name):
            R[:, i, j] = R[:, j, i] = table.numbers[name]
    return R


def counted(reason: str) -> str:
    """Return a reason without its details, for counting."""
    return re.split(r"[:(]", reason, maxsplit=1)[0].strip() or "refused"


def _arrival(table: StreamTable, latency: float) -> Array:
    """Return the arrival times of the rows: column `arrival`, or the time plus the sensor's latency."""
    return table.numbers["arrival"] if table.has("arrival") else table.t + latency


def _thinned(rows: npt.NDArray[np.intp], values: Array, stream: str, log: Log) -> npt.NDArray[np.intp]:
    """Return rows without those that repeat the previous one, if most do: a slow stream in a fast table."""
    if len(rows) < 3:
        return rows
    new = np.append(True, (values[rows[1:]] != values[rows[:-1]]).any(axis=1))
    if np.mean(~new) <= HELD:
        return rows
    log.notes.append(f"{stream}: {np.sum(~new)} of {len(rows)} rows repeat the one before and were left out")
    return np.asarray(rows[new])


def _three(values: Array) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z


def rows_of(R: Array) -> tuple[tuple[float, float, float], ...]:
    """Return the rows of a matrix (3, 3) as plain numbers, in its unit."""
    return tuple(_three(row) for row in R)
