"""A log folder of pictures, IMU and depth, laid out as moments of a moving vehicle."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.trials.table_file import read_table
from finssim.calibration.vision.mount_model import Moment
from finssim.calibration.vision.turns import Gyro
from finssim.geometry.rotations import quat_inverse_rotate
from finssim.localization.attitude import TiltGains, follow, in_body_axes, tilt_from, up_of
from finssim.localization.detections import most_certain, read_detections
from finssim.localization.pool import Pool
from finssim.vehicles import Vehicle

__all__ = ["MountLog", "read_mount_log"]

Array = NDArray[np.float64]

DETECTIONS, IMU, DEPTH = "detections.csv", "imu.csv", "depth.csv"
TIMES = ("t", "time", "time_s", "timestamp")
RATE, FORCE = ("p", "q", "r"), ("ax", "ay", "az")
QUATERNION = ("qx", "qy", "qz", "qw")
LONGEST_AGE = 0.3
"""A sensor is asked at an exposure only between two samples that are no further apart [s]."""

SETTLING = 5.0
"""Until the tilt of gyro and accelerometer has forgotten its start [s]."""


@dataclass(frozen=True, kw_only=True)
class MountLog:
    """What a folder holds."""

    moments: tuple[Moment, ...]
    gyro: Gyro | None
    """In the sensor's own axes."""
    sha256: str
    """Of the files read."""
    notes: tuple[str, ...]
    """What was left out or is missing, one sentence each."""


def read_mount_log(folder: str | Path, pool: Pool, vehicle: Vehicle) -> MountLog:
    """Read `detections.csv`, and of `imu.csv` and `depth.csv` what is there.

    Times are of one clock; a picture's is its stamp, from which the pool's latency is taken. The IMU's rates and forces
    are in its own axes and are turned into the body by `sensors.imu.orientation`; roll and pitch, or a quaternion, are
    the body's. Where the unit reports no attitude, the tilt is made from gyro and accelerometer.

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
    up, gyro = _imu(folder / IMU, vehicle, time, notes)
    depth = _depth(folder / DEPTH, time, notes)
    order = np.argsort(time, kind="stable")
    moments = tuple(
        Moment(
            time=float(time[i]),
            corners={
                found.tag: np.asarray(found.corners, float) for found in most_certain(frames[i].detections)
            },
            up=up[i] if np.isfinite(up[i]).all() else None,
            depth=float(depth[i]) if np.isfinite(depth[i]) else None,
        )
        for i in order
    )
    return MountLog(moments=moments, gyro=gyro, sha256=_digest(folder), notes=tuple(notes))


def _imu(path: Path, vehicle: Vehicle, time: Array, notes: list[str]) -> tuple[Array, Gyro | None]:
    """Up in body axes at the pictures (n, 3), NaN where unknown, and the gyro."""
    unknown = np.full((len(time), 3), np.nan)
    if not path.is_file():
        notes.append(f"no {IMU}: how tags sit in the body is not told, only how they sit to one another")
        return unknown, None
    t, columns = _columns(path, notes)
    mount = vehicle.sensors.imu
    orientation = np.array([0.0, 0.0, 0.0, 1.0]) if mount is None else np.asarray(mount.orientation)
    rate, force = _stack(columns, RATE), _stack(columns, FORCE)
    gyro = None
    if rate is not None:
        good = np.isfinite(rate).all(axis=1)
        gyro = Gyro(t=t[good], rate=rate[good]) if good.sum() > 2 else None
    if "roll" in columns and "pitch" in columns:
        up = up_of(columns["roll"], columns["pitch"])
    elif (quaternion := _stack(columns, QUATERNION)) is not None:
        length = np.linalg.norm(quaternion, axis=1, keepdims=True)
        up = quat_inverse_rotate(
            quaternion / np.where(length > 0.5, length, np.nan), np.array([0.0, 0.0, 1.0])
        )
    elif rate is not None and force is not None:
        up = _tilt(
            t, in_body_axes(rate, orientation), in_body_axes(force, orientation), vehicle.water.gravity
        )
        notes.append(f"{IMU} holds no attitude: roll and pitch are made from gyro and accelerometer")
    else:
        notes.append(
            f"{IMU} holds neither roll and pitch, a quaternion, nor p q r with ax ay az: no tilt is known"
        )
        return unknown, gyro
    good = np.isfinite(up).all(axis=1)
    return _at(time, t[good], up[good]), gyro


def _tilt(t: Array, omega: Array, force: Array, gravity: float) -> Array:
    """Up from gyro and accelerometer, (m, 3); NaN until the filter has settled and after a gap."""
    up = np.full((len(t), 3), np.nan)
    gains = TiltGains(gravity=gravity)
    tilt, since, last = None, 0.0, 0.0
    for i in range(len(t)):
        if not np.isfinite(omega[i]).all():
            continue
        if tilt is None or t[i] - last > gains.longest_gap:
            if not np.isfinite(force[i]).all():
                continue
            tilt, since = tilt_from(force[i]), t[i]
        else:
            tilt = follow(tilt, omega[i], force[i], t[i] - last, gains)
        last = t[i]
        if t[i] - since >= SETTLING:
            up[i] = tilt.up
    return up


def _depth(path: Path, time: Array, notes: list[str]) -> Array:
    if not path.is_file():
        notes.append(f"no {DEPTH}: heights over the pressure port are not told")
        return np.full(len(time), np.nan)
    t, columns = _columns(path, notes)
    if "depth" not in columns:
        raise CalibrationError(
            f"{path}: no column 'depth': add the depth of the pressure port [m], positive down"
        )
    good = np.isfinite(columns["depth"])
    return _at(time, t[good], columns["depth"][good][:, None])[:, 0]


def _columns(path: Path, notes: list[str]) -> tuple[Array, Mapping[str, Array]]:
    """Times in order, once each, and the columns by lower-case name."""
    table = read_table(path)
    notes.extend(f"{path.name}: {note}" for note in table.notes)
    columns = {name.strip().lower(): values for name, values in table.numbers.items()}
    name = next((name for name in TIMES if name in columns), None)
    if name is None:
        raise CalibrationError(f"{path}: no column of times: call it t [s]")
    t = columns[name]
    order = np.argsort(t, kind="stable")
    order = order[np.isfinite(t[order])]
    keep = order[np.concatenate([np.diff(t[order]) > 0.0, [True]])] if len(order) else order
    return t[keep], {key: values[keep] for key, values in columns.items()}


def _stack(columns: Mapping[str, Array], names: tuple[str, ...]) -> Array | None:
    return np.stack([columns[name] for name in names], axis=-1) if all(n in columns for n in names) else None


def _at(time: Array, t: Array, values: Array) -> Array:
    """Linear between samples, NaN where the next two are too far apart, (n, c)."""
    found = np.full((len(time), values.shape[1]), np.nan)
    if len(t) < 2:
        return found
    k = np.clip(np.searchsorted(t, time, side="right"), 1, len(t) - 1)
    near = (time >= t[0]) & (time <= t[-1]) & (t[k] - t[k - 1] <= LONGEST_AGE)
    part = ((time - t[k - 1]) / (t[k] - t[k - 1]))[:, None]
    found[near] = ((1.0 - part) * values[k - 1] + part * values[k])[near]
    return found


def _digest(folder: Path) -> str:
    digest = hashlib.sha256()
    for name in (DETECTIONS, IMU, DEPTH):
        if (folder / name).is_file():
            digest.update((folder / name).read_bytes())
    return digest.hexdigest()
