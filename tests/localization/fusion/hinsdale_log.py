"""Real recordings of a BlueROV2, motion capture and IMU (tests/data/hinsdale), as logs for `finssim fuse`."""

import csv
import math
from pathlib import Path

import numpy as np

from finssim.core.rotations import quat_conjugate, quat_multiply, quat_to_euler, quat_to_rotvec

HINSDALE = Path(__file__).resolve().parents[2] / "data" / "hinsdale"
CLEAN = ("traj005-1", "traj026-0", "traj_alt_009-0")
"""Trials in which the markers are never lost for more than 0.13 s and the heading never jumps by 2.5 degrees."""


def write_table(path, names, rows):
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([names, *rows])
    return path


def hinsdale(folder, trial, every=1.0):
    """Write gyro and tilt of a trial as its IMU, mocap as truth, and mocap once in `every` seconds as the camera."""
    read = {
        n: np.genfromtxt(HINSDALE / f"{trial}_{n}.csv", delimiter=",", names=True) for n in ("imu", "mocap")
    }
    imu, mocap = read["imu"], read["mocap"]
    q = np.stack([imu[f"{c}_ori"] for c in "xyzw"], -1)
    roll, pitch, _ = quat_to_euler(q)
    rates = [imu[f"{c}_angvel"] for c in "xyz"]
    write_table(
        folder / "imu.csv",
        ("t", "p", "q", "r", "roll", "pitch", "arrival"),
        np.column_stack([imu["time_secs"], *rates, roll, pitch, imu["time_secs"]]).tolist(),
    )
    t, heading = mocap["time_secs"], quat_to_euler(np.stack([mocap[f"{c}_ori"] for c in "xyzw"], -1))[2]
    pose = np.column_stack([t, mocap["x_pose"], mocap["y_pose"], heading])
    write_table(folder / "truth.csv", ("t", "x", "y", "yaw"), pose.tolist())
    rows = np.searchsorted(t, np.arange(t[0], t[-1], every)) if every else np.arange(len(t))
    stds = np.tile([0.01, 0.01, math.radians(0.6)], (len(rows), 1))
    seen = np.column_stack([pose[rows], stds, t[rows]])
    write_table(
        folder / "vision.csv", ("t", "x", "y", "yaw", "std_x", "std_y", "std_yaw", "arrival"), seen.tolist()
    )
    return folder, t, heading


def clock_offset(trial, width=0.3):
    """Return the delay of the IMU's stamps [s], from roll and pitch rates of both streams over `width` seconds."""
    read = {
        n: np.genfromtxt(HINSDALE / f"{trial}_{n}.csv", delimiter=",", names=True) for n in ("imu", "mocap")
    }
    q = np.stack([read["mocap"][f"{c}_ori"] for c in "xyzw"], -1)
    q *= np.sign(np.cumprod(np.append(1.0, np.sign(np.sum(q[1:] * q[:-1], axis=1)))))[:, None]
    tm, ti = read["mocap"]["time_secs"], read["imu"]["time_secs"]
    gyro = np.stack([read["imu"][f"{c}_angvel"] for c in "xy"], -1)
    turned = np.vstack([np.zeros(2), np.cumsum(0.5 * (gyro[1:] + gyro[:-1]) * np.diff(ti)[:, None], axis=0)])
    grid = np.arange(max(ti[0], tm[0]) + 1.0, min(ti[-1], tm[-1]) - 1.0, 0.05)

    def at(t, times, values):
        return np.stack([np.interp(t, times, column) for column in values.T], -1)

    ends = [at(grid + side * width / 2, tm, q) for side in (-1, 1)]
    ends = [e / np.linalg.norm(e, axis=1, keepdims=True) for e in ends]
    seen = quat_to_rotvec(quat_multiply(quat_conjugate(ends[0]), ends[1]))[:, :2]
    offsets = np.arange(-0.3, 0.301, 0.01)
    misfit = []
    for offset in offsets:
        felt = [at(grid + offset + side * width / 2, ti, turned) for side in (-1, 1)]
        difference = seen - (felt[1] - felt[0])
        misfit.append(np.sum(np.var(difference, axis=0)))
    return float(offsets[np.argmin(misfit)])
