"""A log folder of pictures, IMU and depth, laid out as moments of a moving vehicle."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.vision.sensor_mounts import Gyro
from finssim.calibration.vision.tag_mounts import Moment
from finssim.geometry.rotations import quat_inverse_rotate
from finssim.localization.detection.detections import most_certain, read_detections
from finssim.localization.fusion.attitude import TiltGains, follow, in_body_axes, tilt_from, up_of
from finssim.localization.fusion.fuse_table import StreamTable, read_stream_table
from finssim.localization.pool import Pool
from finssim.vehicles import Vehicle

__all__ = ["MountLog", "read_mount_log"]

Array = NDArray[np.float64]

DETECTIONS, IMU, DEPTH = "detections.csv", "imu.csv", "depth.csv"
RATE, FORCE = ("p", "q", "r"), ("ax", "ay", "az")
SENSOR_RATE, SENSOR_FORCE = ("gyro_x", "gyro_y", "gyro_z"), ("accel_x", "accel_y", "accel_z")
QUATERNION = ("qx", "qy", "qz", "qw")
LONGEST_AGE = 0.3
"""A sensor is asked at an exposure only between two samples that are no further apart [s]."""

SETTLING = 5.0
"""Until the tilt of gyro and accelerometer has forgotten its start [s]."""


@dataclass(frozen=True, kw_only=True)
class Stream:
    """Samples of one sensor."""

    t: Array
    """Increasing [s], (m,)."""
    values: Array
    """(m, c)"""

    def at(self, time: float) -> Array | None:
        """Linear between samples, (c,); None where there is none or the next two are too far apart."""
        k = int(np.searchsorted(self.t, time, side="right"))
        if not 0 < k < len(self.t) or self.t[k] - self.t[k - 1] > LONGEST_AGE:
            return None
        part = (time - self.t[k - 1]) / (self.t[k] - self.t[k - 1])
        return np.asarray((1.0 - part) * self.values[k - 1] + part * self.values[k])


@dataclass(frozen=True, kw_only=True)
class MountLog:
    """What a folder holds."""

    pictures: tuple[tuple[float, Mapping[int, Array]], ...]
    """Time of the exposure [s] and tag -> pixels of its corners (4, 2), in order of time."""
    up: Stream | None
    """Direction of up in body axes."""
    gyro: Gyro | None
    """In the sensor's own axes."""
    turning: Stream | None
    """Angular rate about the vertical, by gyro and `up` [rad/s]."""
    depth: Stream | None
    """[m]"""
    sha256: str
    """Of the files read."""
    notes: tuple[str, ...]
    """What was left out or is missing, one sentence each."""

    def moments(self, imu_offset: float = 0.0) -> tuple[Moment, ...]:
        """The pictures with tilt and depth at their time.

        Args:
            imu_offset: To be added to the IMU's times [s].
        """
        found = []
        for time, corners in self.pictures:
            up = None if self.up is None else self.up.at(time - imu_offset)
            depth = None if self.depth is None else self.depth.at(time)
            found.append(
                Moment(
                    time=time,
                    corners=corners,
                    up=None if up is None else up / np.linalg.norm(up),
                    depth=None if depth is None else float(depth[0]),
                )
            )
        return tuple(found)


def read_mount_log(folder: str | Path, pool: Pool, vehicle: Vehicle) -> MountLog:
    """Read `detections.csv`, and of `imu.csv` and `depth.csv` what is there.

    Times are of one clock; a picture's is its stamp, from which the pool's latency is taken. As for `finssim fuse`, the
    IMU's `p q r`, `ax ay az` and attitude are the body's, with its mount in the vehicle file; `gyro_x ...` and
    `accel_x ...` are in its own axes, and so is then the attitude. Without an attitude the tilt is made from both.

    Raises:
        CalibrationError, LocalizationError: A file is missing or cannot be used.
    """
    folder = Path(folder)
    if not (folder / DETECTIONS).is_file():
        raise CalibrationError(
            f"{folder}: no {DETECTIONS} in it: give a folder with {DETECTIONS}, {IMU}, {DEPTH}"
        )
    notes: list[str] = []
    frames = read_detections(folder / DETECTIONS, notes)
    time = np.array([frame.time for frame in frames]) - pool.latency
    if not np.isfinite(time).all():
        raise CalibrationError(f"{folder / DETECTIONS}: pictures without a time: add a column 'time' [s]")
    up, gyro = _imu(folder / IMU, vehicle, notes)
    pictures = tuple(
        (float(time[i]), {d.tag: np.asarray(d.corners, float) for d in most_certain(frames[i].detections)})
        for i in np.argsort(time, kind="stable")
    )
    return MountLog(
        pictures=pictures,
        up=up,
        gyro=gyro,
        turning=_turning(up, gyro, vehicle),
        depth=_depth(folder / DEPTH, notes),
        sha256=_digest(folder),
        notes=tuple(notes),
    )


def _imu(path: Path, vehicle: Vehicle, notes: list[str]) -> tuple[Stream | None, Gyro | None]:
    """Up in body axes, and the gyro in its own."""
    if not path.is_file():
        notes.append(f"no {IMU}: how tags sit in the body is not told, only how they sit to one another")
        return None, None
    table = read_stream_table(path)
    notes.extend(table.notes)
    mount = np.array([0.0, 0.0, 0.0, 1.0])
    if vehicle.sensors.imu is not None:
        mount = np.asarray(vehicle.sensors.imu.orientation)
    own = table.has(*SENSOR_RATE) and not table.has(*RATE)
    rate = _columns(table, SENSOR_RATE if own else RATE)
    force = _columns(table, SENSOR_FORCE if own else FORCE)
    gyro = None
    if rate is not None and np.isfinite(rate).all(axis=1).sum() > 2:
        good = np.isfinite(rate).all(axis=1)
        clean = _stream(table.t[good], rate[good] if own else quat_inverse_rotate(mount, rate[good]))
        gyro = Gyro(t=clean.t, rate=clean.values)
    up = _up(table)
    if up is not None:
        up = in_body_axes(up, mount) if own else up
    elif rate is not None and force is not None:
        omega, felt = (in_body_axes(x, mount) if own else x for x in (rate, force))
        up = _tilt(table.t, omega, felt, vehicle.water.gravity)
        notes.append(f"{IMU} holds no attitude: roll and pitch are made from gyro and accelerometer")
    else:
        notes.append(f"{IMU} holds neither an attitude nor rates with accelerations: no tilt is known")
        return None, gyro
    good = np.isfinite(up).all(axis=1)
    return _stream(table.t[good], up[good]), gyro


def _turning(up: Stream | None, gyro: Gyro | None, vehicle: Vehicle) -> Stream | None:
    if up is None or gyro is None or len(up.t) < 2:
        return None
    mount = np.array([0.0, 0.0, 0.0, 1.0])
    if vehicle.sensors.imu is not None:
        mount = np.asarray(vehicle.sensors.imu.orientation)
    within = (gyro.t >= up.t[0]) & (gyro.t <= up.t[-1])
    t = gyro.t[within]
    up_s = quat_inverse_rotate(mount, up.values)
    rate = sum(gyro.rate[within, i] * np.interp(t, up.t, up_s[:, i]) for i in range(3))
    return Stream(t=t, values=np.asarray(rate)[:, None]) if len(t) > 2 else None


def _up(table: StreamTable) -> Array | None:
    """Up in the axes whose attitude the table holds, (m, 3)."""
    if table.has(*QUATERNION):
        q = table.columns(*QUATERNION)
        length = np.linalg.norm(q, axis=1, keepdims=True)
        return quat_inverse_rotate(q / np.where(length > 0.5, length, np.nan), np.array([0.0, 0.0, 1.0]))
    if table.has("roll", "pitch"):
        return up_of(table.numbers["roll"], table.numbers["pitch"])
    return None


def _columns(table: StreamTable, names: tuple[str, ...]) -> Array | None:
    return table.columns(*names) if table.has(*names) else None


def _tilt(t: Array, omega: Array, force: Array, gravity: float) -> Array:
    """Up from gyro and accelerometer, (m, 3); NaN until the filter has settled and after a gap.

    It runs twice: the first time learns the gyro's bias, with which the second starts.
    """
    gains = TiltGains(gravity=gravity)
    _, learnt = _filtered(t, omega, force, gains, np.zeros(3))
    return _filtered(t, omega, force, gains, learnt)[0]


def _filtered(t: Array, omega: Array, force: Array, gains: TiltGains, bias: Array) -> tuple[Array, Array]:
    """Up (m, 3), and the bias at the end."""
    up = np.full((len(t), 3), np.nan)
    tilt, since, last = None, 0.0, 0.0
    for i in np.flatnonzero(np.isfinite(omega).all(axis=1)):
        if tilt is None or t[i] - last > gains.longest_gap:
            if not np.isfinite(force[i]).all():
                continue
            tilt, since = replace(tilt_from(force[i]), bias=bias), t[i]
        else:
            tilt = follow(tilt, omega[i], force[i], t[i] - last, gains)
        last = t[i]
        if t[i] - since >= SETTLING:
            up[i] = tilt.up
    return up, bias if tilt is None else tilt.bias


def _depth(path: Path, notes: list[str]) -> Stream | None:
    if not path.is_file():
        notes.append(f"no {DEPTH}: heights over the pressure port are not told")
        return None
    table = read_stream_table(path)
    notes.extend(table.notes)
    if not table.has("depth"):
        raise CalibrationError(
            f"{path}: no column 'depth': add the depth of the pressure port [m], positive down"
        )
    depth = table.numbers["depth"]
    good = np.isfinite(depth)
    return _stream(table.t[good], depth[good][:, None])


def _stream(t: Array, values: Array) -> Stream:
    """In order of time, once each."""
    times, first = np.unique(t, return_index=True)
    return Stream(t=times, values=values[first])


def _digest(folder: Path) -> str:
    digest = hashlib.sha256()
    for name in (DETECTIONS, IMU, DEPTH):
        if (folder / name).is_file():
            digest.update((folder / name).read_bytes())
    return digest.hexdigest()
