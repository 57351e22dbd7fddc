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
from finssim.calibration.vision.least_squares import Pose
from finssim.calibration.vision.sensor_mounts import (
    UNSURE_TURN,
    Attitude,
    DepthFit,
    Gyro,
    ImuMounting,
    fit_depth,
    fit_imu_mounting,
    imu_clock,
)
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
    quat_from_rotvec,
    quat_inverse_rotate,
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

__all__ = ["read_mount_log", "run"]

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
    gyro: Gyro | None
    """In the sensor's own axes."""
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
    up, gyro, turning = _read_imu(folder / IMU, vehicle, findings)
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
        gyro=gyro,
        turning=turning,
        depth=depth,
        sha256=sha256,
        findings=tuple(findings),
    )


def _read_imu(
    path: Path, vehicle: Vehicle, findings: list[Finding]
) -> tuple[Series | None, Gyro | None, Series | None]:
    """Up in body axes, the gyro in its own, and the angular rate about the vertical."""
    if not path.is_file():
        findings.append(finding("imu_missing", file=IMU))
        return None, None, None
    table = read_stream_table(path)
    findings += [finding("as_read", remark=note) for note in table.notes]
    sensor = vehicle.sensors.imu
    mount = np.array([0.0, 0.0, 0.0, 1.0] if sensor is None else sensor.orientation)
    omega, force, up, _ = imu_columns(table, sensor)
    rated = bool(np.isfinite(omega).all(axis=1).any())
    rate = series("rate", table.t, omega, math.inf, where=str(path)) if rated else None
    gyro = None
    if rate is not None and len(rate.t) > 2:
        gyro = Gyro(t=rate.t, rate=quat_inverse_rotate(mount, rate.values))
    if up is None and rated and np.isfinite(force).any():
        up = _tilt(table.t, omega, force, vehicle.water.gravity)
        findings.append(finding("attitude_made", file=IMU))
    if up is None or not np.isfinite(up).any():
        findings.append(finding("tilt_unknown", file=IMU))
        return None, gyro, None
    tilt = series("attitude", table.t, up, LONGEST_AGE, where=str(path))
    if gyro is None or rate is None or len(tilt.t) < 2:
        return tilt, gyro, None
    within = (rate.t >= tilt.t[0]) & (rate.t <= tilt.t[-1])
    t, about = rate.t[within], np.zeros(int(within.sum()))
    for i in range(3):
        about += rate.values[within, i] * np.interp(t, tilt.t, tilt.values[:, i])
    turning = series("turning", t, about[:, None], math.inf, where=str(path)) if len(t) > 2 else None
    return tilt, gyro, turning


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

ESTIMATES = ("tags", "sensors")

STUDENT = 2.2
"""95 % point of Student's distribution with the degrees of freedom of a dozen blocks."""

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


def imu_orientation(
    found: MountFit, imu: ImuMounting | CalibrationError | None, vehicle: Vehicle
) -> tuple[list[Estimate], dict[str, Any]]:
    """The IMU's orientation from its tilt and from its gyro, each by what it tells."""
    if vehicle.sensors.imu is None:
        return [], {}
    start = np.asarray(vehicle.sensors.imu.orientation)
    std = np.array([found.std(f"imu.turn_{axis}") for axis in "xyz"])
    q, information = quat_multiply(matrix_to_quat(found.state.imu_turn), start), np.diag(1.0 / std**2)
    if isinstance(imu, ImuMounting) and np.isfinite(imu.covariance).all():
        second = np.linalg.inv(imu.covariance)
        between = quat_to_rotvec(quat_multiply(imu.orientation, quat_conjugate(q)))
        q = quat_multiply(quat_from_rotvec(np.linalg.pinv(information + second) @ second @ between), q)
        information = information + second
    known = np.diagonal(information) > 1e-6
    half = np.where(known, STUDENT * np.sqrt(np.diagonal(np.linalg.pinv(information))), np.inf)
    turn = np.degrees(quat_to_rotvec(quat_multiply(q, quat_conjugate(start))))
    estimates = [
        Estimate.within(
            f"imu.turn_{axis}", turn[i], math.degrees(half[i]), "deg", half[i] < UNSURE_TURN, KEPT
        )
        for i, axis in enumerate("xyz")
    ]
    orientation = {"sensors.imu.orientation": (q / np.linalg.norm(q)).tolist()}
    return estimates, orientation if (half < UNSURE_TURN).any() else {}


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


def of_imu(imu: ImuMounting | CalibrationError | None, estimate: str) -> list[Finding]:
    """What is to be said of the gyro."""
    if isinstance(imu, CalibrationError):
        return [finding("gyro_unused", reason=str(imu))]
    if imu is None:
        return []
    turns = {axis: imu.estimates[f"imu.turn_{axis}"] for axis in "xyz"}
    return [
        *imu.findings,
        *(
            finding("imu_turned", angle=turn.estimate, axis=axis)
            for axis, turn in turns.items()
            if estimate == "tags" and turn.identifiable and not turn.ci95[0] - 2.0 < 0.0 < turn.ci95[1] + 2.0
        ),
    ]


def calibrate_mounts(
    log: MountLog,
    pool: Pool,
    vehicle: Vehicle,
    *,
    name: str,
    estimate: str = "tags",
    seed: int = 0,
) -> Fit:
    """Where tags sit in the body, or how IMU and pressure port do, with everything that the motion tells.

    Args:
        log: The recording.
        pool: Camera and water.
        vehicle: Gives the tags' edge and the mounts so far.
        name: Of the recording.
        estimate: `tags`: IMU and pressure port are right in the file, tags are written. `sensors`: the tag that is seen
            most is right in the file; the IMU's orientation, the port's height and the other tags are written.
        seed: Recorded; nothing here is random.

    Raises:
        CalibrationError: Unknown `estimate`, a vehicle without tags, a pool whose plane is no water surface, or a
            recording with too little in it.
    """
    if estimate not in ESTIMATES:
        raise CalibrationError(f"unknown estimate '{estimate}'; available: {', '.join(ESTIMATES)}")
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
    sure = clock is not None and clock.identifiable and not clock.ci95[0] <= 0.0 <= clock.ci95[1]
    offset = clock.estimate if clock is not None and sure else 0.0
    found = fit_mounts(rig, mounts, log.moments(offset), estimate=estimate)
    imu = _imu(found, log, vehicle, offset)
    rows, changes = tag_estimates(found, mounts, vehicle)
    findings = [*log.findings, *of_frozen(found), *of_imu(imu, estimate)]
    quality = {"corners [px]": _figures(found.rms, found.left_out, len(found.moments), found.held_out_rms)}
    if estimate == "sensors":
        of_tilt, written = imu_orientation(found, imu, vehicle)
        rows, changes = rows + of_tilt, changes | written
    if isinstance(imu, ImuMounting):
        rows += [row for row in imu.estimates.values() if "turn" not in row.name]
        quality["turns of the gyro [deg]"] = _figures(math.degrees(imu.residual), imu.rejected)
    rows += [clock] if clock is not None else []
    pressure = _pressure(rig, found, mounts) if estimate == "sensors" else None
    if pressure is not None:
        rows += pressure.estimates.values()
        findings += pressure.findings
        if pressure.estimates["depth.offset"].identifiable and depth is not None:
            changes["sensors.depth.position.2"] = float(depth.position[2]) - pressure.offset
        quality["depth [m]"] = _figures(pressure.rms, pressure.rejected)
    return Fit(
        kind="mounts",
        method="vision",
        vehicle=vehicle,
        estimates={row.name: row for row in rows},
        changes=changes,
        quality=quality,
        findings=tuple(findings),
        curves=_curves(found),
        trials={name: log.sha256},
        settings={"estimate": estimate, "seed": seed, "reference_tag": found.rig.reference},
    )


def _figures(
    rmse: float, rejected: int, samples: int | None = None, held_out: float = math.nan
) -> dict[str, float]:
    """Figures of a part of the fit; without samples nothing was held out."""
    if samples is None:
        return {"rmse": rmse, "rejected": float(rejected)}
    figures = {"rmse": rmse, "rmse_held_out": held_out, "samples": float(samples)}
    return {**figures, "rejected": float(rejected)}


def _attitude(found: MountFit) -> Attitude:
    times = np.array([moment.time for moment in found.moments])
    return Attitude(t=times, quaternion=matrix_to_quat(np.array([pose.R for pose in found.state.poses])))


def _window(attitude: Attitude) -> float:
    return max(0.5, float(np.median(np.diff(attitude.t))))


def _clock(rig: Rig, mounts: Mapping[int, Pose], log: MountLog) -> Estimate | None:
    """What is to be added to the IMU's times, by turns that the pixels alone tell: tilts by the IMU agree with its gyro
    whatever its clock does."""
    if log.turning is None:
        return None
    blind = [replace(moment, up=None, depth=None) for moment in log.moments()]
    alone = fit_mounts(rig, mounts, blind, estimate="sensors", held_out=False)
    return imu_clock(_attitude(alone), rig.pool.interface.normal, log.turning.t, log.turning.values[:, 0])


def _imu(
    found: MountFit, log: MountLog, vehicle: Vehicle, offset: float
) -> ImuMounting | CalibrationError | None:
    """The IMU from the attitudes that the pixels and the tilt give; the refusal itself where they say too little."""
    if log.gyro is None or vehicle.sensors.imu is None:
        return None
    attitude, start = _attitude(found), vehicle.sensors.imu.orientation
    try:
        return fit_imu_mounting(attitude, log.gyro, start=start, window=_window(attitude), time_offset=offset)
    except CalibrationError as error:
        return error


def _pressure(rig: Rig, found: MountFit, mounts: Mapping[int, Pose]) -> DepthFit | None:
    """Depths by the pixels alone, with the mounts found, against what the sensor said."""
    reading = {moment.time: moment.depth for moment in found.moments if moment.depth is not None}
    if not reading:
        return None
    turned = [
        replace(moment, depth=None, up=None if moment.up is None else found.state.imu_turn @ moment.up)
        for moment in found.moments
    ]
    known = {tag: found.state.mount(tag, rig.reference) for tag in (rig.reference, *found.state.others)}
    alone = fit_mounts(rig, {**mounts, **known}, turned, estimate="sensors", held_out=False)
    readings = [reading.get(moment.time, math.nan) for moment in alone.moments]
    return fit_depth(alone.port_depths, readings, known_std=distance_std(found))


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
    felt = np.array([np.full(3, math.nan) if m.up is None else state.imu_turn @ m.up for m in moments])
    up = np.array([pose.R.T @ rig.pool.interface.normal for pose in state.poses])
    for i, axis in enumerate("xy"):
        add("tilt by the IMU", f"up along body {axis} [-]", t, felt[:, i], up[:, i])
    depth = np.array([math.nan if m.depth is None else m.depth for m in moments])
    add("pressure port", "depth [m]", t, depth, found.port_depths + state.depth_offset)
    return tuple(curves)


def run(
    log: Path,
    *,
    pool: Path,
    vehicle: str,
    out: Path,
    estimate: str = "tags",
    report: Path | None = None,
    seed: int = 0,
    as_json: bool = False,
) -> Vehicle:
    """Find where tags, IMU and pressure port sit on the vehicle, from its motion: poses [m, deg], depth offset [m].

    Example: finssim calibrate mounts log --pool pool.yaml --vehicle mine.yaml --out mine.yaml

    Args:
        log (LOG): Folder with detections.csv, imu.csv and depth.csv.
        pool (FILE): Pool file: camera, water plane and frames (.yaml).
        vehicle (NAME|FILE): Vehicle of the catalogue, or the path of a vehicle file.
        out (FILE): Vehicle file to write (.yaml).
        estimate (WHAT): tags: the sensors are right in the vehicle file; sensors: the tag seen most is.
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
    fit = calibrate_mounts(recording, where, body, name=Path(log).name, estimate=estimate, seed=seed)
    after = calibrated(fit)
    findings = all_findings(fit, after)
    write_vehicle(after, out)
    if report is not None:
        options = {"pool": pool, "vehicle": vehicle, "out": out, "estimate": estimate, "seed": seed}
        command = command_line("mounts", [log], options)
        write_report(fit, report, after, command=command, findings=findings, out=out)

    record = fit_json(fit, after, out=out, findings=findings) if as_json else None
    publish(record, fit_report(fit, after, findings).show, (out, report))
    return after
