"""A log folder of pictures, IMU and depth, laid out as moments of a moving vehicle."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.findings import Finding, finding
from finssim.calibration.vision.sensor_mounts import Gyro
from finssim.calibration.vision.tag_mounts import Moment
from finssim.geometry.rotations import quat_inverse_rotate
from finssim.localization.detection.detections import most_certain, read_detections
from finssim.localization.fusion.attitude import TiltGains, follow, in_body_axes, tilt_from, up_of
from finssim.localization.fusion.fuse_log import StreamTable, read_stream_table
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
        """Linear between samples, (c,); None where there is none or the next two are too far apart.

        Args:
            time: On the clock of `t` [s].
        """
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
    findings: tuple[Finding, ...]
    """What was left out or is missing."""

    def moments(self, imu_offset: float = 0.0) -> tuple[Moment, ...]:
        """The pictures with tilt and depth at their time.

        Args:
            imu_offset: To be added to the IMU's times [s].
        """
        found = []
        for time, corners in self.pictures:
            up = None if self.up is None else self.up.at(time - imu_offset)
            up = None if up is None else up / np.linalg.norm(up)
            depth = None if self.depth is None else self.depth.at(time)
            depth = None if depth is None else float(depth[0])
            found.append(Moment(time=time, corners=corners, up=up, depth=depth))
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
    remarks: list[str] = []
    frames = read_detections(folder / DETECTIONS, remarks)
    findings = [finding("as_read", remark=remark) for remark in remarks]
    time = np.array([frame.time for frame in frames]) - pool.latency
    if not np.isfinite(time).all():
        raise CalibrationError(f"{folder / DETECTIONS}: pictures without a time: add a column 'time' [s]")
    up, gyro, turning = _imu(folder / IMU, vehicle, findings)
    pictures = tuple(
        (float(time[i]), {d.tag: np.asarray(d.corners, float) for d in most_certain(frames[i].detections)})
        for i in np.argsort(time, kind="stable")
    )
    depth = _depth(folder / DEPTH, findings)
    files = [folder / name for name in (DETECTIONS, IMU, DEPTH) if (folder / name).is_file()]
    sha256 = hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()
    return MountLog(
        pictures=pictures,
        up=up,
        gyro=gyro,
        turning=turning,
        depth=depth,
        sha256=sha256,
        findings=tuple(findings),
    )


def _imu(
    path: Path, vehicle: Vehicle, findings: list[Finding]
) -> tuple[Stream | None, Gyro | None, Stream | None]:
    """Up in body axes, the gyro in its own, and the angular rate about the vertical."""
    if not path.is_file():
        findings.append(finding("imu_missing", file=IMU))
        return None, None, None
    table = read_stream_table(path)
    findings += [finding("as_read", remark=note) for note in table.notes]
    imu = vehicle.sensors.imu
    mount = np.array([0.0, 0.0, 0.0, 1.0] if imu is None else imu.orientation)
    own = table.has(*SENSOR_RATE) and not table.has(*RATE)

    def columns(names: tuple[str, ...]) -> Array | None:
        """In body axes."""
        if not table.has(*names):
            return None
        return in_body_axes(table.columns(*names), mount) if own else table.columns(*names)

    rate, force = columns(SENSOR_RATE if own else RATE), columns(SENSOR_FORCE if own else FORCE)
    clean = None if rate is None else _stream(table.t, rate)
    gyro = None
    if clean is not None and len(clean.t) > 2:
        gyro = Gyro(t=clean.t, rate=quat_inverse_rotate(mount, clean.values))
    up = _up(table)
    if up is not None:
        up = in_body_axes(up, mount) if own else up
    elif rate is not None and force is not None:
        up = _tilt(table.t, rate, force, vehicle.water.gravity)
        findings.append(finding("attitude_made", file=IMU))
    else:
        findings.append(finding("tilt_unknown", file=IMU))
        return None, gyro, None
    tilt = _stream(table.t, up)
    if gyro is None or clean is None or len(tilt.t) < 2:
        return tilt, gyro, None
    within = (clean.t >= tilt.t[0]) & (clean.t <= tilt.t[-1])
    t, omega = clean.t[within], clean.values[within]
    about = sum(omega[:, i] * np.interp(t, tilt.t, tilt.values[:, i]) for i in range(3))
    return tilt, gyro, Stream(t=t, values=np.asarray(about)[:, None]) if len(t) > 2 else None


def _up(table: StreamTable) -> Array | None:
    """Up in the axes whose attitude the table holds, (m, 3)."""
    if table.has(*QUATERNION):
        q = table.columns(*QUATERNION)
        length = np.linalg.norm(q, axis=1, keepdims=True)
        return quat_inverse_rotate(q / np.where(length > 0.5, length, np.nan), np.array([0.0, 0.0, 1.0]))
    if table.has("roll", "pitch"):
        return up_of(table.numbers["roll"], table.numbers["pitch"])
    return None


def _tilt(t: Array, omega: Array, force: Array, gravity: float) -> Array:
    """Up from gyro and accelerometer, (m, 3); NaN until the filter has settled and after a gap.

    It runs twice: the first time learns the gyro's bias, with which the second starts.
    """
    gains, bias = TiltGains(gravity=gravity), np.zeros(3)
    up = np.full((len(t), 3), np.nan)
    for _ in range(2):
        tilt, since, last = None, 0.0, 0.0
        for i in np.flatnonzero(np.isfinite(omega).all(axis=1)):
            if tilt is None or t[i] - last > gains.longest_gap:
                if not np.isfinite(force[i]).all():
                    continue
                tilt, since = replace(tilt_from(force[i]), bias=bias), t[i]
            else:
                tilt = follow(tilt, omega[i], force[i], t[i] - last, gains)
            last = t[i]
            up[i] = tilt.up if t[i] - since >= SETTLING else np.nan
        bias = bias if tilt is None else tilt.bias
    return up


def _depth(path: Path, findings: list[Finding]) -> Stream | None:
    if not path.is_file():
        findings.append(finding("depth_missing", file=DEPTH))
        return None
    table = read_stream_table(path)
    findings += [finding("as_read", remark=note) for note in table.notes]
    if not table.has("depth"):
        raise CalibrationError(
            f"{path}: no column 'depth': add the depth of the pressure port [m], positive down"
        )
    return _stream(table.t, table.columns("depth"))


def _stream(t: Array, values: Array) -> Stream:
    """In order of time, once each, without rows that hold no number."""
    good = np.isfinite(values).all(axis=1)
    times, first = np.unique(t[good], return_index=True)
    return Stream(t=times, values=values[good][first])
