"""What `finssim calibrate mounts` runs: read a log, find the mounts, write the vehicle, report."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.findings import Finding, finding
from finssim.calibration.fit import Curve, Estimate, Fit
from finssim.calibration.output.calibrate import all_findings, calibrated
from finssim.calibration.output.report import (
    command_line,
    fit_json,
    fit_report,
    publish,
    refuse_places,
    write_report,
)
from finssim.calibration.output.vehicle_file import write_vehicle
from finssim.calibration.uncertainty import Evidence, intervals, trial_covariance
from finssim.calibration.vision.least_squares import Pose, huber_weight
from finssim.calibration.vision.tag_mounts import (
    AXES,
    UNSURE_LENGTH,
    Moment,
    MountFit,
    Rig,
    fit_mounts,
    reference_tag,
    residuals,
)
from finssim.geometry.rotations import (
    matrix_to_quat,
    quat_conjugate,
    quat_multiply,
    quat_to_matrix,
    quat_to_rotvec,
    skew,
)
from finssim.localization.detection.detections import most_certain, read_detections
from finssim.localization.detection.families import corners
from finssim.localization.fusion.attitude import TiltGains, follow, tilt_from
from finssim.localization.fusion.fuse_log import Series, imu_columns, read_stream_table, series
from finssim.localization.pool import Pool, load_pool
from finssim.vehicles import Vehicle, load_vehicle

__all__ = ["imu_clock", "read_mount_log", "run"]

Array = NDArray[np.float64]

# A log folder of pictures, IMU and depth, laid out as moments of a moving vehicle.

DETECTIONS, IMU, DEPTH = "detections.csv", "imu.csv", "depth.csv"
LONGEST_AGE = 0.3
"""A sensor is asked at an exposure only between two samples that are no further apart [s]."""

SETTLING = 5.0
"""Until the tilt of gyro and accelerometer has forgotten its start [s]."""


@dataclass(frozen=True, kw_only=True)
class MountLog:
    """What a folder holds."""

    pictures: tuple[tuple[float, Mapping[int, Array]], ...]
    """Time of the exposure [s] and tag -> pixels of its corners (4, 2), in order of time."""
    up: Series | None
    """Direction of up in body axes."""
    turning: Series | None
    """Angular rate about the vertical, by gyro and `up` [rad/s]."""
    depth: Series | None
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
        return tuple(
            Moment(
                time=time,
                corners=corners,
                up=_up_at(self.up, time - imu_offset),
                depth=_depth_at(self.depth, time),
            )
            for time, corners in self.pictures
        )


def _up_at(up: Series | None, time: float) -> Array | None:
    found = None if up is None else up.at(time)
    return found / np.linalg.norm(found) if isinstance(found, np.ndarray) else None


def _depth_at(depth: Series | None, time: float) -> float | None:
    found = None if depth is None else depth.at(time)
    return float(found[0]) if isinstance(found, np.ndarray) else None


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
    up, turning = _read_imu(folder / IMU, vehicle, findings)
    pictures = tuple(
        (float(time[i]), {d.tag: np.asarray(d.corners, float) for d in most_certain(frames[i].detections)})
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
    """Up in body axes, and the angular rate about the vertical."""
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
    tilt = series("attitude", table.t, up, LONGEST_AGE, where=str(path))
    if not rated or len(tilt.t) < 2:
        return tilt, None
    rate = series("rate", table.t, omega, math.inf, where=str(path))
    within = (rate.t >= tilt.t[0]) & (rate.t <= tilt.t[-1])
    t, about = rate.t[within], np.zeros(int(within.sum()))
    for i in range(3):
        about += rate.values[within, i] * np.interp(t, tilt.t, tilt.values[:, i])
    turning = series("turning", t, about[:, None], math.inf, where=str(path)) if len(t) > 2 else None
    return tilt, turning


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
    return series("depth", table.t, table.columns("depth"), LONGEST_AGE, where=str(path))


# The mounts, as estimates and as numbers of the vehicle file.

EDGE_STD = 0.25e-3
"""Standard deviation of a tag's edge measured with a ruler [m]: it makes every distance wrong by the same share."""

KEPT = "the motion does not tell it: kept from the file"


def distance_std(found: MountFit) -> float:
    """Error of every depth from an edge that is measured a little wrong: its share of the apparent distance [m]."""
    interface = found.rig.pool.interface
    above = float(interface.normal @ found.rig.pool.camera.position) + interface.offset
    below = -float(np.median([interface.normal @ pose.t for pose in found.state.poses])) - interface.offset
    return EDGE_STD / found.rig.edge * (above * interface.index_far / interface.index_near + below)


def tag_estimates(
    found: MountFit, mounts: Mapping[int, Pose], vehicle: Vehicle
) -> tuple[list[Estimate], dict[str, Any]]:
    """Estimates of every tag, and the mounts to write; a tag of which nothing is told keeps the file's."""
    estimates, written, told = [], {}, False
    for tag, mount in vehicle.tags.mounts.items():  # type: ignore[union-attr]
        written[tag] = {"position": list(mount.position), "orientation": list(mount.orientation)}
    for tag in (found.rig.reference, *found.state.others):
        pose, half = found.state.mount(tag, found.rig.reference), _half_widths(found, tag)
        if not np.isfinite(half).any():
            continue
        told = True
        written[tag] = {"position": pose.t.tolist(), "orientation": matrix_to_quat(pose.R).tolist()}
        turn = quat_to_rotvec(matrix_to_quat(pose.R @ mounts.get(tag, pose).R.T))
        note = f"{KEPT}, and it defines the body's axes and origin"
        if tag != found.rig.reference:
            note = "too few pictures show this tag together with others"
        for axis, value, width in zip(AXES, np.append(np.degrees(turn), pose.t), half, strict=True):
            unit, width = ("deg", math.degrees(width)) if "turn" in axis else ("m", width)
            name = f"tags.{tag}.{axis}"
            estimate = Estimate.within(name, value, width, unit, math.isfinite(width), note)
            if unit == "m":
                estimate = replace(estimate, path=f"tags.mounts.{tag}.position.{'xyz'.index(axis)}")
            estimates.append(estimate)
    return estimates, {"tags.mounts": dict(sorted(written.items()))} if told else {}


def _half_widths(found: MountFit, tag: int) -> Array:
    """Half widths of a tag's 95 % intervals, turn about the body axes [rad] and position [m], (6,).

    What is kept from the file counts as exact for the other tags, which are told relative to it; for the reference tag
    itself it is infinite.
    """
    own = np.array([found.half_width(f"reference.{axis}") for axis in AXES])
    own[5] = np.hypot(own[5], 1.96 * distance_std(found))
    if tag == found.rig.reference:
        return own
    R, arm = found.state.reference.R, found.state.reference.R @ found.state.others[tag].t
    shared = np.where(np.isfinite(own), own, 0.0) ** 2
    relative = np.array([found.half_width(f"{tag}.{axis}") for axis in AXES]) ** 2
    turn = shared[:3] + R**2 @ relative[:3]
    position = shared[3:] + skew(arm) ** 2 @ shared[:3] + R**2 @ relative[3:]
    return np.sqrt(np.concatenate([turn, position]))


def of_frozen(found: MountFit) -> list[Finding]:
    """What the motion does not tell of the tags."""
    findings, tag = [], found.rig.reference
    frozen = [name.partition(".")[2] for name in found.frozen if name.startswith("reference.")]
    turns = tuple(name[-1] for name in frozen if "turn" in name)
    lengths = tuple(name for name in frozen if "turn" not in name)
    if turns:
        findings.append(finding("tag_turn_unknown", tag=tag, axes=turns))
    if lengths:
        findings.append(finding("tag_place_unknown", tag=tag, axes=lengths, limit=UNSURE_LENGTH))
    others = sorted({name.partition(".")[0] for name in found.frozen if name[0].isdigit()}, key=int)
    if others:
        findings.append(finding("tags_apart", tags=tuple(others)))
    return findings


def calibrate_mounts(log: MountLog, pool: Pool, vehicle: Vehicle, *, name: str, seed: int = 0) -> Fit:
    """Where tags sit in the body, with everything that the motion shows; IMU and pressure port are right in the file.

    Args:
        log: The recording.
        pool: Camera and water.
        vehicle: Gives the tags' edge and the mounts so far.
        name: Of the recording.
        seed: Recorded; nothing here is random.

    Raises:
        CalibrationError: A vehicle without tags, a pool whose plane is no water surface, or a recording with too little
            in it.
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
        corners_t=corners(tags.edge),
        port=np.zeros(3) if depth is None else np.asarray(depth.position, float),
        reference=reference_tag(log.moments(), mounts),
    )
    clock = _clock(rig, mounts, log)
    late = clock is not None and clock.identifiable and not clock.ci95[0] <= 0.0 <= clock.ci95[1]
    found = fit_mounts(rig, mounts, log.moments(clock.estimate if clock is not None and late else 0.0))
    rows, changes = tag_estimates(found, mounts, vehicle)
    rows += [clock] if clock is not None else []
    figures = {
        "rmse": found.rms,
        "rmse_held_out": found.held_out_rms,
        "samples": float(len(found.moments)),
        "rejected": float(found.left_out),
    }
    return Fit(
        kind="mounts",
        method="vision",
        vehicle=vehicle,
        estimates={row.name: row for row in rows},
        changes=changes,
        quality={"corners [px]": figures},
        findings=(*log.findings, *of_frozen(found)),
        curves=_curves(found),
        trials={name: log.sha256},
        settings={"seed": seed, "reference_tag": found.rig.reference},
    )


LONGEST_OFFSET, OFFSET_STEP = 1.0, 0.02
"""Offsets of the clock that are tried: up to [s], every [s]."""

NUDGE = 0.005
"""Step of the derivative with respect to the offset [s]."""

FEWEST = 20
"""Turns without which no offset is fitted."""

CLOCK_BLOCKS = 12

UNSURE_CLOCK = 0.05
"""Half width of the 95 % interval of the offset beyond which it does not count as identified [s]."""


def _clock(rig: Rig, mounts: Mapping[int, Pose], log: MountLog) -> Estimate | None:
    """What is to be added to the IMU's times, by turns that the pixels alone show: tilts by the IMU agree with its gyro
    whatever its clock does."""
    if log.turning is None:
        return None
    alone = fit_mounts(rig, mounts, [replace(m, up=None, depth=None) for m in log.moments()], held_out=False)
    q = matrix_to_quat(np.array([pose.R for pose in alone.state.poses]))
    t = np.array([moment.time for moment in alone.moments])
    return imu_clock(t, q, rig.pool.interface.normal, log.turning.t, log.turning.values[:, 0])


def imu_clock(
    t_picture: Array, attitude: Array, up_p: Array, t_imu: Array, vertical_rate: Array
) -> Estimate | None:
    """What is to be added to the IMU's times, from turns about the vertical between neighbouring pictures.

    n · log(R_2 R_1ᵀ) = ∫ ω · up dt over the same time, less a bias; ω and up in any one frame of the vehicle, so that
    neither the IMU's mounting nor the tilt is needed.

    Args:
        t_picture: Times of the pictures, increasing [s], (n,).
        attitude: From the pixels, body to pool, unit xyzw [-], (n, 4); its tilt may be poor.
        up_p: n, upwards in the pool, (3,).
        t_imu: Times of the IMU, increasing [s], (m,).
        vertical_rate: ω · up [rad/s], (m,).

    Returns:
        `imu.time_offset` [s], or None if there are too few pictures.
    """
    from scipy.optimize import least_squares

    turn = quat_to_rotvec(quat_multiply(attitude[1:], quat_conjugate(attitude[:-1]))) @ up_p
    start, end = t_picture[:-1], t_picture[1:]
    inside = (start > t_imu[0] + LONGEST_OFFSET) & (end < t_imu[-1] - LONGEST_OFFSET) & (end - start < 3.0)
    turn, start, end = turn[inside], start[inside], end[inside]
    if len(turn) < FEWEST:
        return None
    steps = 0.5 * (vertical_rate[1:] + vertical_rate[:-1]) * np.diff(t_imu)
    heading = np.concatenate([[0.0], np.cumsum(steps)])

    def error(x: Array) -> Array:
        """Of the turns, with bias [rad/s] and offset [s]."""
        later, earlier = (np.interp(t - x[1], t_imu, heading) for t in (end, start))
        return np.asarray(turn - later + earlier + x[0] * (end - start))

    def slopes(x: Array) -> Array:
        return np.stack([end - start, (error(x + [0.0, NUDGE]) - error(x - [0.0, NUDGE])) / (2.0 * NUDGE)], 1)

    def spread(offset: float) -> float:
        off = error(np.array([0.0, offset]))
        return float(np.median(np.abs(off - np.median(off))))

    first = min(np.arange(-LONGEST_OFFSET, LONGEST_OFFSET + 1e-9, OFFSET_STEP), key=spread)
    bias = -float(np.median(error(np.array([0.0, first])) / (end - start)))
    sigma = 1.4826 * max(spread(first), 1e-9)
    x = least_squares(error, [bias, first], slopes, loss="huber", f_scale=1.345 * sigma, x_scale="jac").x
    J, r = slopes(x), error(x)
    w = huber_weight(np.abs(r), 1.345 * sigma) / sigma**2
    parts = np.array_split(np.arange(len(r)), max(2, min(CLOCK_BLOCKS, len(r) // 4)))
    evidence = Evidence(
        names=("bias", "offset"),
        normal=np.array([(w[p, None] * J[p]).T @ J[p] for p in parts]),
        score=np.array([-(w[p] * r[p]) @ J[p] for p in parts]),
        unit="blocks",
    )
    half = float(intervals(x, trial_covariance(evidence))[1, 1] - x[1])
    note = "the vehicle turns too evenly to tell the clocks apart: taken as 0"
    sure = half < UNSURE_CLOCK and abs(x[1]) <= LONGEST_OFFSET
    return Estimate.within("imu.time_offset", x[1], half, "s", sure, note)


def _curves(found: MountFit) -> tuple[Curve, ...]:
    """For the report: first corners, tilt and depth as measured and as the fit has them, over time."""
    rig, state, moments = found.rig, found.state, found.moments
    t = np.array([moment.time for moment in moments])
    pixels, owner, _ = residuals(rig, state, moments)
    tags = np.array([tag for moment in moments for tag in moment.corners])
    seen = np.array([corner for moment in moments for corner in moment.corners.values()])
    curves = []

    def add(title: str, label: str, t: Array, measured: Array, fitted: Array) -> None:
        if np.isfinite(measured).any():
            columns = {"x": t, "measured": measured, "fitted": fitted}
            curves.append(Curve(title=title, x_label="time [s]", y_label=label, **columns))

    for tag in np.unique(tags):
        of = tags == tag
        for i, axis in enumerate("uv"):
            measured = seen[of, 0, i]
            fitted = measured - pixels[of, 0, i]
            add(f"tag {tag}, top-left corner", f"{axis} [px]", t[owner[of]], measured, fitted)
    felt = np.array([np.full(3, math.nan) if m.up is None else m.up for m in moments])
    up = np.array([pose.R.T @ rig.pool.interface.normal for pose in state.poses])
    for i, axis in enumerate("xy"):
        add("tilt by the IMU", f"up along body {axis} [-]", t, felt[:, i], up[:, i])
    depth = np.array([math.nan if m.depth is None else m.depth for m in moments])
    add("pressure port", "depth [m]", t, depth, found.port_depths)
    return tuple(curves)


def run(
    log: Path,
    *,
    pool: Path,
    vehicle: str,
    out: Path,
    report: Path | None = None,
    seed: int = 0,
    as_json: bool = False,
) -> Vehicle:
    """Find where tags sit on the vehicle, from its motion, its IMU and its pressure port: poses [m, deg].

    Example: finssim calibrate mounts log --pool pool.yaml --vehicle mine.yaml --out mine.yaml

    Args:
        log (LOG): Folder with detections.csv, imu.csv and depth.csv.
        pool (FILE): Pool file: camera, water plane and frames (.yaml).
        vehicle (NAME|FILE): Vehicle of the catalogue, or the path of a vehicle file.
        out (FILE): Vehicle file to write (.yaml).
        report (DIR): Directory for the report and its pictures.
        seed: Seed of every random number; equal seeds give equal results.
        as_json: Print one JSON object instead of tables.

    Returns:
        The vehicle written.

    Raises:
        CalibrationError, LocalizationError, VehicleError, OutputError: As they say; nothing is written then.
    """
    refuse_places(out, report, "vehicle")
    where, body = load_pool(pool), load_vehicle(vehicle)
    recording = read_mount_log(log, where, body)
    fit = calibrate_mounts(recording, where, body, name=Path(log).name, seed=seed)
    after = calibrated(fit)
    findings = all_findings(fit, after)
    write_vehicle(after, out)
    if report is not None:
        options = {"pool": pool, "vehicle": vehicle, "out": out, "seed": seed}
        command = command_line("mounts", [log], options)
        write_report(fit, report, after, command=command, findings=findings, out=out)

    record = fit_json(fit, after, out=out, findings=findings) if as_json else None
    publish(record, fit_report(fit, after, findings).show, (out, report))
    return after
