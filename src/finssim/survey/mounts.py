"""`finssim calibrate mounts`: read a log of pictures, IMU and depth, fit the tags' poses on the vehicle, report."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.core.rotations import (
    matrix_to_quat,
    quat_conjugate,
    quat_multiply,
    quat_to_matrix,
    quat_to_rotvec,
    skew,
)
from finssim.identification.fit import Curve, Estimate, Fit
from finssim.identification.report import finish, refuse_places
from finssim.localization.detection.detections import best_detections, read_detections
from finssim.localization.fusion.attitude import TiltGains, follow, tilt_from
from finssim.localization.fusion.fuse_log import Series, imu_columns, read_stream_table, series
from finssim.localization.overhead_camera import Pool, load_pool
from finssim.survey.mounts_fit import (
    AXES,
    UNSURE_LENGTH,
    Moment,
    MountFit,
    Rig,
    fit_mounts,
    reference_tag,
    residuals,
)
from finssim.survey.pose import Pose
from finssim.trials.findings import CalibrationError, Finding, finding
from finssim.trials.motion import RATE, offset, smooth
from finssim.vehicles import Vehicle, load_vehicle

Array = NDArray[np.float64]

DETECTIONS, IMU, DEPTH = "detections.csv", "imu.csv", "depth.csv"
LONGEST_AGE = 0.3
"""Longest gap between samples over which a sensor is interpolated to an exposure [s]."""

SETTLING = 5.0
"""Time until the tilt from gyro and accelerometer is independent of its start [s]."""


@dataclass(frozen=True, kw_only=True)
class MountLog:
    """Content of a log folder."""

    pictures: tuple[tuple[float, Mapping[int, Array]], ...]
    """Time of the exposure [s] and tag -> pixels of its corners (4, 2), in order of time."""
    up: Series | None
    """Direction of up in body axes."""
    turning: Series | None
    """Angular rate about the vertical, from gyro and `up` [rad/s]."""
    depth: Series | None
    """Depth of the pressure port [m]."""
    sha256: str
    """Digest of the read files."""
    findings: tuple[Finding, ...]
    """Findings on excluded or missing data."""

    def moments(self, imu_offset: float = 0.0) -> tuple[Moment, ...]:
        """Return the pictures with tilt and depth at their times.

        Args:
            imu_offset: Offset that is added to the IMU's times [s].
        """
        moments = []
        for time, corners in self.pictures:
            up, depth = _at(self.up, time - imu_offset), _at(self.depth, time)
            moments.append(
                Moment(
                    time=time,
                    corners=corners,
                    up=None if up is None else up / np.linalg.norm(up),
                    depth=None if depth is None else float(depth[0]),
                )
            )
        return tuple(moments)


def _at(sensor: Series | None, time: float) -> Array | None:
    """Return a sensor's values at a time, (k,); None if they are unknown."""
    values = None if sensor is None else sensor.at(time)
    return values if isinstance(values, np.ndarray) else None


def read_mount_log(folder: str | Path, pool: Pool, vehicle: Vehicle) -> MountLog:
    """Read `detections.csv`, and `imu.csv` and `depth.csv` if present.

    All times are of one clock; the time of a picture is its stamp minus the pool's latency. As for `finssim
    fuse`, the IMU's `p q r`, `ax ay az` and attitude are in body axes; `gyro_x ...`, `accel_x ...` and an
    attitude with them are in the IMU's own axes, whose mount is in the vehicle file. Without an attitude, the
    tilt is computed from both.

    Raises:
        CalibrationError: `detections.csv` or a column is missing.
        LocalizationError: A file cannot be read.
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
    up, turning = _read_imu(folder / IMU, vehicle, findings)
    pictures = tuple(
        (float(time[i]), {d.tag: np.asarray(d.corners, float) for d in best_detections(frames[i].detections)})
        for i in np.argsort(time, kind="stable")
    )
    depth = _read_depth(folder / DEPTH, findings)
    files = [folder / name for name in (DETECTIONS, IMU, DEPTH) if (folder / name).is_file()]
    sha256 = hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()
    return MountLog(
        pictures=pictures,
        up=up,
        turning=turning,
        depth=depth,
        sha256=sha256,
        findings=tuple(findings),
    )


def _read_imu(path: Path, vehicle: Vehicle, findings: list[Finding]) -> tuple[Series | None, Series | None]:
    """Return the up direction in body axes, and the angular rate about the vertical."""
    if not path.is_file():
        findings.append(finding("imu_missing", file=IMU))
        return None, None
    table = read_stream_table(path)
    findings += [finding("as_read", remark=note) for note in table.notes]
    omega, force, up, _ = imu_columns(table, vehicle.sensors.imu)
    rated = bool(np.isfinite(omega).all(axis=1).any())
    if up is None and rated and np.isfinite(force).any():
        up = _tilt(table.t, omega, force, vehicle.water.gravity)
        findings.append(finding("attitude_made", file=IMU))
    if up is None or not np.isfinite(up).any():
        findings.append(finding("tilt_unknown", file=IMU))
        return None, None
    tilt = series("attitude", table.t, up, LONGEST_AGE, label=str(path))
    if not rated or len(tilt.t) < 2:
        return tilt, None
    rate = series("rate", table.t, omega, math.inf, label=str(path))
    within = (rate.t >= tilt.t[0]) & (rate.t <= tilt.t[-1])
    t, about = rate.t[within], np.zeros(int(within.sum()))
    for i in range(3):
        about += rate.values[within, i] * np.interp(t, tilt.t, tilt.values[:, i])
    turning = series("turning", t, about[:, None], math.inf, label=str(path)) if len(t) > 2 else None
    return tilt, turning


def _tilt(t: Array, omega: Array, force: Array, gravity: float) -> Array:
    """Return the up direction from gyro and accelerometer, (m, 3); NaN until the filter has settled and after
    a gap.

    The filter runs twice: the first pass estimates the gyro's bias, with which the second starts.
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


def _read_depth(path: Path, findings: list[Finding]) -> Series | None:
    if not path.is_file():
        findings.append(finding("depth_missing", file=DEPTH))
        return None
    table = read_stream_table(path)
    findings += [finding("as_read", remark=note) for note in table.notes]
    if not table.has("depth"):
        raise CalibrationError(
            f"{path}: no column 'depth': add the depth of the pressure port [m], positive down"
        )
    return series("depth", table.t, table.columns("depth"), LONGEST_AGE, label=str(path))


# Mounts as estimates and as numbers of the vehicle file.

EDGE_STD = 0.25e-3
"""Standard deviation of a tag's edge measured with a ruler [m]; it scales every distance."""

RETAINED = "the motion does not determine it: kept from the file"


def distance_std(fit: MountFit) -> float:
    """Return the standard deviation of the depth due to the measured edge: its relative error times the
    apparent distance [m]."""
    interface = fit.rig.pool.interface
    above = float(interface.normal @ fit.rig.pool.camera.position) + interface.offset
    below = -float(np.median([interface.normal @ pose.t for pose in fit.state.poses])) - interface.offset
    return EDGE_STD / fit.rig.edge * (above * interface.index_far / interface.index_near + below)


def tag_estimates(
    fit: MountFit, mounts: Mapping[int, Pose], vehicle: Vehicle
) -> tuple[list[Estimate], dict[str, Any]]:
    """Return estimates of every tag, and the mounts to write; an undetermined tag keeps that of the file."""
    estimates, written, any_identified = [], {}, False
    for tag, mount in vehicle.tags.mounts.items():  # type: ignore[union-attr]
        written[tag] = {"position": list(mount.position), "orientation": list(mount.orientation)}
    for tag in (fit.rig.reference, *fit.state.others):
        pose, half = fit.state.mount(tag, fit.rig.reference), _half_widths(fit, tag)
        if not np.isfinite(half).any():
            continue
        any_identified = True
        written[tag] = {"position": pose.t.tolist(), "orientation": matrix_to_quat(pose.R).tolist()}
        turn = quat_to_rotvec(matrix_to_quat(pose.R @ mounts.get(tag, pose).R.T))
        note = f"{RETAINED}, and it defines the body's axes and origin"
        if tag != fit.rig.reference:
            note = "too few pictures show this tag together with others"
        for axis, value, width in zip(AXES, np.append(np.degrees(turn), pose.t), half, strict=True):
            unit, width = ("deg", math.degrees(width)) if "turn" in axis else ("m", width)
            name = f"tags.{tag}.{axis}"
            estimate = Estimate.within(name, value, width, unit, math.isfinite(width), note)
            if unit == "m":
                estimate = replace(estimate, path=f"tags.mounts.{tag}.position.{'xyz'.index(axis)}")
            estimates.append(estimate)
    return estimates, {"tags.mounts": dict(sorted(written.items()))} if any_identified else {}


def _half_widths(fit: MountFit, tag: int) -> Array:
    """Return half widths of a tag's 95 % intervals, rotation about the body axes [rad] and position [m], (6,).

    Values kept from the file count as exact for the other tags, which are estimated relative to them; for the
    reference tag itself they are infinite.
    """
    half = np.array([fit.half_width(f"reference.{axis}") for axis in AXES])
    half[5] = np.hypot(half[5], 1.96 * distance_std(fit))
    if tag == fit.rig.reference:
        return half
    R, arm = fit.state.reference.R, fit.state.reference.R @ fit.state.others[tag].t
    shared = np.where(np.isfinite(half), half, 0.0) ** 2
    relative = np.array([fit.half_width(f"{tag}.{axis}") for axis in AXES]) ** 2
    turn = shared[:3] + R**2 @ relative[:3]
    position = shared[3:] + skew(arm) ** 2 @ shared[:3] + R**2 @ relative[3:]
    return np.sqrt(np.concatenate([turn, position]))


def of_frozen(fit: MountFit) -> list[Finding]:
    """Return findings on unknowns of the tags that the motion does not determine."""
    findings, tag = [], fit.rig.reference
    frozen = [name.partition(".")[2] for name in fit.frozen if name.startswith("reference.")]
    turns = tuple(name[-1] for name in frozen if "turn" in name)
    lengths = tuple(name for name in frozen if "turn" not in name)
    if turns:
        findings.append(finding("tag_turn_unknown", tag=tag, axes=turns))
    if lengths:
        findings.append(finding("tag_place_unknown", tag=tag, axes=lengths, limit=UNSURE_LENGTH))
    others = sorted({name.partition(".")[0] for name in fit.frozen if name[0].isdigit()}, key=int)
    if others:
        findings.append(finding("tags_apart", tags=tuple(others)))
    return findings


def calibrate_mounts(log: MountLog, pool: Pool, vehicle: Vehicle, *, name: str, seed: int = 0) -> Fit:
    """Fit the tags' mounts in the body, as far as the motion determines them; IMU and pressure port are
    assumed to be mounted as in the file.

    Args:
        log: The recording.
        pool: Camera and water.
        vehicle: Vehicle with the tags' edge and initial mounts.
        name: Name of the recording.
        seed: Seed, which is only recorded; nothing here is random.

    Raises:
        CalibrationError: The vehicle has no tags, the pool's plane is not a water surface, or the recording
            contains too little.
    """
    tags = vehicle.file_tags
    if tags is None:
        raise CalibrationError(
            f"{vehicle.name} has no tags: give its file a section tags with edge and one mount"
        )
    if not pool.is_surface:
        raise CalibrationError(
            "the pool's plane is no water surface: mounts need the camera above level water"
        )
    mounts = {
        tag: Pose(quat_to_matrix(mount.orientation), np.asarray(mount.position, float))
        for tag, mount in tags.mounts.items()
    }
    depth = vehicle.sensors.depth
    rig = Rig(
        pool=pool,
        edge=tags.edge,
        edges={tag: mount.edge for tag, mount in tags.mounts.items() if mount.edge is not None},
        port=np.zeros(3) if depth is None else np.asarray(depth.position, float),
        reference=reference_tag(log.moments(), mounts),
    )
    clock = _clock(rig, mounts, log)
    late = clock is not None and clock.identifiable and not clock.ci95[0] <= 0.0 <= clock.ci95[1]
    mount_fit = fit_mounts(rig, mounts, log.moments(clock.estimate if clock is not None and late else 0.0))
    rows, changes = tag_estimates(mount_fit, mounts, vehicle)
    rows += [clock] if clock is not None else []
    figures = {
        "rmse": mount_fit.rms,
        "rmse_held_out": mount_fit.held_out_rms,
        "samples": float(len(mount_fit.moments)),
        "rejected": float(mount_fit.excluded),
    }
    return Fit(
        kind="mounts",
        method="vision",
        before=vehicle,
        estimates={row.name: row for row in rows},
        changes=changes,
        quality={"corners [px]": figures},
        findings=(*log.findings, *of_frozen(mount_fit)),
        curves=_curves(mount_fit),
        trials={name: log.sha256},
        settings={"seed": seed, "reference_tag": mount_fit.rig.reference},
    )


FEWEST = 20
"""Least number of samples for a clock offset."""

UNSURE_CLOCK = 0.05
"""Half width of the 95 % interval of the clock offset above which it is not identifiable [s]."""


def _clock(rig: Rig, mounts: Mapping[int, Pose], log: MountLog) -> Estimate | None:
    """Return the offset to add to the IMU's times, from rotations of the pixels-only fit: tilts by the IMU
    agree with its gyro whatever its clock."""
    if log.turning is None:
        return None
    alone = fit_mounts(rig, mounts, [replace(m, up=None, depth=None) for m in log.moments()], held_out=False)
    q = matrix_to_quat(np.array([pose.R for pose in alone.state.poses]))
    t = np.array([moment.time for moment in alone.moments])
    return imu_clock(t, q, rig.pool.interface.normal, log.turning.t, log.turning.values[:, 0])


def imu_clock(
    t_picture: Array, attitude: Array, up_p: Array, t_imu: Array, vertical_rate: Array
) -> Estimate | None:
    """Return the offset to add to the IMU's times, from rotations about the vertical between consecutive pictures.

    n · log(R_2 R_1ᵀ) is the rotation from one picture to the next; its rate is compared with ω · up, ω and up
    in any frame of the vehicle, so that neither the IMU's mount nor the tilt is needed.

    Args:
        t_picture: Times of the pictures, increasing [s], (n,).
        attitude: Attitudes from the pixels, body to pool, unit xyzw [-], (n, 4); their tilt may be inaccurate.
        up_p: Unit vector n, upwards in the pool, (3,).
        t_imu: Times of the IMU, increasing [s], (m,).
        vertical_rate: ω · up [rad/s], (m,).

    Returns:
        `imu.time_offset` [s], or None if there are too few pictures or the two motions do not match.
    """
    turn = quat_to_rotvec(quat_multiply(attitude[1:], quat_conjugate(attitude[:-1]))) @ up_p
    heading = np.concatenate([[0.0], np.cumsum(turn)])
    t = np.arange(max(t_picture[0], t_imu[0]), min(t_picture[-1], t_imu[-1]), 1.0 / RATE)
    if len(turn) < FEWEST or len(t) < FEWEST:
        return None
    turn_rate = smooth(t_picture, heading[:, None], t, order=3).slope
    lag = offset(turn_rate, smooth(t_imu, vertical_rate[:, None], t).value)
    if lag is None:
        return None
    half = 1.96 * lag.std
    note = "the vehicle turns too evenly to estimate the clock offset: assumed 0"
    return Estimate.within("imu.time_offset", lag.seconds, half, "s", half < UNSURE_CLOCK, note)


def _curves(fit: MountFit) -> tuple[Curve, ...]:
    """Return curves for the report: first corners, tilt and depth, measured and fitted, over time."""
    rig, state, moments = fit.rig, fit.state, fit.moments
    t = np.array([moment.time for moment in moments])
    pixels, owner, _ = residuals(rig, state, moments)
    tags = np.array([tag for moment in moments for tag in moment.corners])
    corners = np.array([corner for moment in moments for corner in moment.corners.values()])
    curves = []

    def add(title: str, label: str, t: Array, measured: Array, fitted: Array) -> None:
        if np.isfinite(measured).any():
            columns = {"x": t, "measured": measured, "fitted": fitted}
            curves.append(Curve(title=title, x_label="time [s]", y_label=label, **columns))

    for tag in np.unique(tags):
        of = tags == tag
        for i, axis in enumerate("uv"):
            measured = corners[of, 0, i]
            fitted = measured - pixels[of, 0, i]
            add(f"tag {tag}, top-left corner", f"{axis} [px]", t[owner[of]], measured, fitted)
    felt = np.array([np.full(3, math.nan) if m.up is None else m.up for m in moments])
    up = np.array([pose.R.T @ rig.pool.interface.normal for pose in state.poses])
    for i, axis in enumerate("xy"):
        add("tilt by the IMU", f"up along body {axis} [-]", t, felt[:, i], up[:, i])
    depth = np.array([math.nan if m.depth is None else m.depth for m in moments])
    add("pressure port", "depth [m]", t, depth, fit.port_depths)
    return tuple(curves)


def run(
    log: Path,
    *,
    pool: Path,
    vehicle: str,
    out: Path,
    report: Path | None = None,
    seed: int = 1,
    as_json: bool = False,
) -> Vehicle:
    """Estimate the mounts of tags on the vehicle from its motion, IMU and pressure port: poses [m, deg].

    Example: finssim calibrate mounts log --pool pool.yaml --vehicle mine.yaml --out mine.yaml

    Args:
        log (LOG): Folder with detections.csv, imu.csv and depth.csv.
        pool (FILE): Pool file: camera, water plane and frames (.yaml).
        vehicle (NAME|FILE): Vehicle in the catalogue, or path of a vehicle file.
        out (FILE): Vehicle file to write (.yaml).
        report (DIR): Directory for the report and its figures.
        seed: Seed of every random number; equal seeds give equal results.
        as_json: Print one JSON object instead of tables.

    Returns:
        The vehicle that was written.

    Raises:
        CalibrationError: The log cannot be used; nothing is written.
        LocalizationError: A file of the log or the pool file cannot be read; nothing is written.
        VehicleError: The vehicle file cannot be used; nothing is written.
        OutputError: A file cannot be written.
    """
    options = dict(locals())
    refuse_places(out, report, "vehicle")
    site, body = load_pool(pool), load_vehicle(vehicle)
    recording = read_mount_log(log, site, body)
    return finish("mounts", calibrate_mounts(recording, site, body, name=Path(log).name, seed=seed), options)
