"""What `finssim calibrate mounts` runs: read a log, find the mounts, write the vehicle, report."""

from __future__ import annotations

import json
import math
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from finssim.calibration.errors import CalibrationError
from finssim.calibration.fit import Curve, Estimate, Fit
from finssim.calibration.output.calibrate import calibrated, doubts, kept
from finssim.calibration.output.fit_output import fit_json, print_fit
from finssim.calibration.output.report import FIT_FILE, write_report
from finssim.calibration.output.vehicle_file import check_vehicle_path, write_vehicle
from finssim.calibration.uncertainty import Evidence, intervals, trial_covariance
from finssim.calibration.vision.mounts.imu_mounting import ImuMounting, fit_imu_mounting, turn_residual
from finssim.calibration.vision.mounts.mount_log import MountLog, read_mount_log
from finssim.calibration.vision.mounts.mount_model import Moment, Noise, Pose, Rig, residuals
from finssim.calibration.vision.mounts.pressure_offset import DepthFit, fit_depth
from finssim.calibration.vision.mounts.tag_mounts import UNSURE_LENGTH, MountFit, fit_mounts, reference_tag
from finssim.calibration.vision.mounts.turns import Attitude
from finssim.files import atomic_directory, atomic_write, refuse_unwritable
from finssim.geometry.rotations import (
    matrix_to_quat,
    quat_conjugate,
    quat_from_rotvec,
    quat_multiply,
    quat_to_matrix,
    quat_to_rotvec,
)
from finssim.localization.detection.tags import corners
from finssim.localization.pool import Pool, load_pool
from finssim.vehicles import Vehicle, load_vehicle

__all__ = ["imu_clock", "run"]

# Mounts of tags and sensors from one recording, as a fit that goes into a vehicle file.

# Estimates of mounts with their intervals, what goes into the vehicle file, and what is to be said.

STUDENT = 2.2
"""95 % point of Student's distribution with the degrees of freedom of a dozen blocks."""

UNSURE_TURN = math.radians(5.0)
"""Half width beyond which an angle of the IMU does not count as told [rad]."""

EDGE_STD = 0.25e-3
"""Standard deviation of a tag's edge measured with a ruler [m]: it makes every distance wrong by the same share."""

AXES = "xyz"


def distance_std(found: MountFit) -> float:
    """Error of every depth from an edge that is measured a little wrong: its share of the apparent distance [m]."""
    camera, interface = found.rig.pool.camera, found.rig.pool.interface
    above = float(interface.normal @ camera.position) + interface.offset
    below = -float(np.median([interface.normal @ pose.t for pose in found.state.poses])) - interface.offset
    edge = float(np.linalg.norm(found.rig.corners_t[0] - found.rig.corners_t[1]))
    ratio = interface.index_far / interface.index_near
    return EDGE_STD / edge * (above * ratio + below)


def tag_estimates(
    found: MountFit,
    mounts: Mapping[int, Pose],
    estimates: dict[str, Estimate],
    changes: dict[str, Any],
    vehicle: Vehicle,
) -> None:
    """Estimates of every tag, and the mounts to write; a tag with nothing told keeps the file's."""
    reference = found.rig.reference
    told = {tag: _told(found, tag) for tag in (reference, *found.state.others)}
    whole = {}
    for tag, mount in vehicle.tags.mounts.items():  # type: ignore[union-attr]
        whole[tag] = {"position": list(mount.position), "orientation": list(mount.orientation)}
    for tag, half in told.items():
        pose = found.state.mount(tag, reference)
        if not np.isfinite(half).any():
            continue
        whole[tag] = {"position": pose.t.tolist(), "orientation": matrix_to_quat(pose.R).tolist()}
        before = mounts.get(tag, pose)
        turn = np.degrees(quat_to_rotvec(matrix_to_quat(pose.R @ before.R.T)))
        for i, axis in enumerate(AXES):
            estimates[f"tags.{tag}.turn_{axis}"] = _mount_estimate(
                f"tags.{tag}.turn_{axis}", turn[i], np.degrees(half[i]), "deg", tag, reference
            )
        for i, axis in enumerate(AXES):
            estimates[f"tags.{tag}.{axis}"] = _mount_estimate(
                f"tags.{tag}.{axis}",
                pose.t[i],
                half[3 + i],
                "m",
                tag,
                reference,
                f"tags.mounts.{tag}.position.{i}",
            )
    if any(np.isfinite(half).any() for half in told.values()):
        changes["tags.mounts"] = dict(sorted(whole.items()))


def _told(found: MountFit, tag: int) -> Array:
    """Half widths of a tag's 95 % intervals, turn about the body axes [rad] and position [m], (6,).

    What is kept from the file counts as exact for the other tags, which are told relative to it; for the reference tag
    itself it is infinite.
    """
    reference = found.rig.reference
    names = [f"reference.{axis}" for axis in ("turn_x", "turn_y", "turn_z", "x", "y", "z")]
    own = np.array([found.interval(name)[1] for name in names])
    if np.isfinite(own[5]):
        own[5] = np.hypot(own[5], 1.96 * distance_std(found))
    if tag == reference:
        return own
    R, arm = found.state.reference.R, found.state.reference.R @ found.state.others[tag].t
    shared = np.where(np.isfinite(own), own, 0.0)
    relative = np.array(
        [found.interval(f"{tag}.{axis}")[1] for axis in ("turn_x", "turn_y", "turn_z", "x", "y", "z")]
    )
    turn = np.sqrt(shared[:3] ** 2 + R**2 @ relative[:3] ** 2)
    lever = (
        np.array([[0.0, arm[2], arm[1]], [arm[2], 0.0, arm[0]], [arm[1], arm[0], 0.0]]) ** 2 @ shared[:3] ** 2
    )
    place = np.sqrt(shared[3:] ** 2 + lever + R**2 @ relative[3:] ** 2)
    return np.concatenate([turn, place])


def _mount_estimate(
    name: str, value: float, half: float, unit: str, tag: int, reference: int, path: str | None = None
) -> Estimate:
    sure = bool(np.isfinite(half))
    note = (
        ""
        if sure
        else "the motion does not tell it: kept from the file, and it defines the body's axes and origin"
    )
    if not sure and tag != reference:
        note = "too few pictures show this tag together with others"
    ci = (float(value - half), float(value + half)) if sure else (-math.inf, math.inf)
    return Estimate(
        name=name, estimate=float(value), ci95=ci, unit=unit, identifiable=sure, note=note, path=path
    )


def imu_orientation(
    found: MountFit,
    imu: ImuMounting | CalibrationError | None,
    vehicle: Vehicle,
    estimates: dict[str, Estimate],
    changes: dict[str, Any],
) -> None:
    """The IMU's orientation from its tilt and from its gyro, each by what it tells."""
    if vehicle.sensors.imu is None:
        return
    start = np.asarray(vehicle.sensors.imu.orientation)
    q, information = start, np.zeros((3, 3))
    std = np.array([found.std(f"imu.turn_{axis}") for axis in AXES])
    if np.isfinite(std).any():
        q = quat_multiply(matrix_to_quat(found.state.imu_turn), start)
        information = np.diag(np.where(np.isfinite(std), 1.0 / std**2, 0.0))
    if isinstance(imu, ImuMounting) and np.isfinite(imu.covariance).all():
        second = np.linalg.inv(imu.covariance)
        between = quat_to_rotvec(quat_multiply(imu.orientation, quat_conjugate(q)))
        q = quat_multiply(quat_from_rotvec(np.linalg.pinv(information + second) @ second @ between), q)
        information = information + second
    known = np.diagonal(information) > 1e-6
    half = np.where(known, STUDENT * np.sqrt(np.diagonal(np.linalg.pinv(information))), np.inf)
    turn = quat_to_rotvec(quat_multiply(q, quat_conjugate(start)))
    for i, axis in enumerate(AXES):
        name = f"imu.turn_{axis}"
        sure = bool(half[i] < UNSURE_TURN)
        low, high = np.degrees(turn[i] - half[i]), np.degrees(turn[i] + half[i])
        estimates[name] = Estimate(
            name=name,
            estimate=float(np.degrees(turn[i])),
            ci95=(float(low), float(high)),
            unit="deg",
            identifiable=sure,
            note="" if sure else "the motion does not tell it: kept from the file",
        )
    if (half < UNSURE_TURN).any():
        changes["sensors.imu.orientation"] = (q / np.linalg.norm(q)).tolist()


def of_frozen(found: MountFit) -> list[str]:
    """What the motion does not tell of the tags, one sentence each."""
    sentences = []
    frozen = [name for name in found.frozen if name.startswith("reference.")]
    turns = [name for name in frozen if "turn" in name]
    lengths = [name[-1] for name in frozen if "turn" not in name]
    tag = found.rig.reference
    if turns:
        axes = " and ".join(name[-1] for name in turns)
        sentences.append(
            f"the motion does not tell the turn of tag {tag} about body {axes}: it keeps the file's, which so "
            "defines the body's axes: rock the vehicle by 10 degrees and more about two axes to tell it from the IMU"
        )
    if lengths:
        sentences.append(
            f"the motion does not tell {' and '.join(lengths)} of tag {tag} to {100.0 * UNSURE_LENGTH:g} cm: it keeps "
            "the file's, which so defines the body's origin: measure one tag by hand, rock further, or turn on the "
            "spot about a known point (--turns-about)"
        )
    others = sorted({name.partition(".")[0] for name in found.frozen if name[0].isdigit()}, key=int)
    if others:
        sentences.append(
            f"tag {', '.join(others)}: too few pictures show it together with others to tell its place"
        )
    return sentences


def of_imu(imu: ImuMounting | CalibrationError | None, estimate: str) -> list[str]:
    """What is to be said of the gyro, one sentence each."""
    if isinstance(imu, CalibrationError):
        return [f"the gyro was not used: {imu}"]
    if imu is None:
        return []
    sentences = list(imu.advice)
    if estimate == "tags":
        for axis in AXES:
            turn = imu.estimates[f"imu.turn_{axis}"]
            if turn.identifiable and not turn.ci95[0] - 2.0 < 0.0 < turn.ci95[1] + 2.0:
                sentences.append(
                    f"the gyro says that the IMU is turned by {turn.estimate:.0f} deg about body {axis} against the "
                    "tags found: check sensors.imu.orientation, or estimate it (--estimate sensors)"
                )
    return sentences


# How an IMU's clock lies to the pictures', by turns about the vertical: they need neither mounting nor tilt.

LONGEST = 1.0
STEP = 0.02
FEWEST = 20
BLOCKS = 12
TUKEY = 4.685
ROUNDS = 8
UNSURE = 0.05
"""Half width of the 95 % interval beyond which the offset does not count as told [s]."""


def imu_clock(attitude: Attitude, up_p: Array, t: Array, vertical_rate: Array) -> Estimate | None:
    """What is to be added to the IMU's times, from turns between neighbouring pictures.

    n · log(R_2 R_1ᵀ) = ∫ ω · up dt over the same time, less a bias; ω and up in any one frame of the vehicle.

    Args:
        attitude: From the pixels; its tilt may be poor.
        up_p: n, upwards in the attitude's outer frame, (3,).
        t: Times of the IMU, increasing [s], (m,).
        vertical_rate: ω · up [rad/s], (m,).

    Returns:
        `imu.time_offset` [s], or None if there are too few pictures.
    """
    q = attitude.quaternion
    seen = quat_to_rotvec(quat_multiply(q[1:], quat_conjugate(q[:-1]))) @ up_p
    start, end = attitude.t[:-1], attitude.t[1:]
    known = (start > t[0] + LONGEST) & (end < t[-1] - LONGEST) & (end - start < 3.0)
    seen, start, end = seen[known], start[known], end[known]
    if len(seen) < FEWEST:
        return None
    heading = np.concatenate([[0.0], np.cumsum(0.5 * (vertical_rate[1:] + vertical_rate[:-1]) * np.diff(t))])

    def felt(offset: float) -> Array:
        return np.asarray(np.interp(end - offset, t, heading) - np.interp(start - offset, t, heading))

    trials = np.arange(-LONGEST, LONGEST + 1e-9, STEP)
    offset = float(min(trials, key=lambda x: np.sum(np.abs(seen - felt(x) - np.median(seen - felt(x))))))
    span, bias, A, residual, weight, sigma = end - start, 0.0, np.empty((0, 2)), seen, np.ones(len(seen)), 1.0
    for _ in range(ROUNDS):
        slope = (felt(offset + STEP / 4) - felt(offset - STEP / 4)) / (STEP / 2)
        A = np.column_stack([-span, slope])
        residual = seen - felt(offset) + bias * span
        sigma = max(1.4826 * float(np.median(np.abs(residual - np.median(residual)))), 1e-9)
        weight = np.clip(1.0 - (residual / (TUKEY * sigma)) ** 2, 0.0, None) ** 2
        root = np.sqrt(weight)
        step, *_ = np.linalg.lstsq(root[:, None] * A, root * residual, rcond=1e-9)
        bias, offset = bias + float(step[0]), offset + float(step[1])
    return _estimate(A, residual, weight / sigma**2, offset)


def _estimate(A: Array, residual: Array, weight: Array, offset: float) -> Estimate:
    parts = np.array_split(np.arange(len(A)), BLOCKS)
    evidence = Evidence(
        names=("bias", "offset"),
        normal=np.array([(A[p] * weight[p, None]).T @ A[p] for p in parts]),
        score=np.array([A[p].T @ (weight[p] * residual[p]) for p in parts]),
        unit="blocks",
    )
    half = float(intervals(np.zeros(2), trial_covariance(evidence))[1, 1])
    sure = math.isfinite(half) and half < UNSURE and abs(offset) <= LONGEST
    return Estimate(
        name="imu.time_offset",
        estimate=offset,
        ci95=(offset - half, offset + half),
        unit="s",
        identifiable=sure,
        note="" if sure else "the vehicle turns too evenly to tell the clocks apart: taken as 0",
    )


Array = NDArray[np.float64]

ESTIMATES = ("tags", "sensors")


def calibrate_mounts(
    log: MountLog,
    pool: Pool,
    vehicle: Vehicle,
    *,
    name: str,
    estimate: str = "tags",
    centre: Sequence[float] | None = None,
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
        centre: Body point that stays in place while the vehicle turns on the spot [m], if the recording is of that.
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
    blind = log.moments()
    rig = Rig(
        pool=pool,
        corners_t=corners(tags.edge),
        port=np.zeros(3) if depth is None else np.asarray(depth.position, float),
        reference=reference_tag(blind, mounts),
        centre=None if centre is None else np.asarray(centre, float),
    )
    clock = _clock(rig, mounts, blind, log)
    sure = clock is not None and clock.identifiable and not clock.ci95[0] <= 0.0 <= clock.ci95[1]
    offset = clock.estimate if clock is not None and sure else 0.0
    found = fit_mounts(rig, mounts, log.moments(offset), estimate=estimate)
    imu = _imu(found, log, vehicle, offset)
    pressure = _pressure(rig, found, mounts) if estimate == "sensors" else None
    told = {} if clock is None else {clock.name: clock}
    return _fit(found, imu, pressure, log, vehicle, mounts, {"estimate": estimate, "seed": seed}, name, told)


def _attitude(found: MountFit) -> Attitude:
    times = np.array([moment.time for moment in found.moments])
    return Attitude(t=times, quaternion=matrix_to_quat(np.array([pose.R for pose in found.state.poses])))


def _window(attitude: Attitude) -> float:
    return max(0.5, float(np.median(np.diff(attitude.t))))


def _clock(rig: Rig, mounts: Mapping[int, Pose], moments: Sequence[Moment], log: MountLog) -> Estimate | None:
    """What is to be added to the IMU's times, by turns that the pixels alone tell: tilts by the IMU agree with its gyro
    whatever its clock does."""
    if log.turning is None:
        return None
    alone = fit_mounts(rig, mounts, [replace(m, up=None, depth=None) for m in moments], estimate="sensors")
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


def _turns_held_out(found: MountFit, log: MountLog, imu: ImuMounting) -> float:
    """Disagreement of the second half's turns with the mounting of the first, robust rms [rad]; NaN if it is short."""
    whole = _attitude(found)
    half, window = len(whole.t) // 2, _window(whole)
    first = Attitude(t=whole.t[:half], quaternion=whole.quaternion[:half])
    second = Attitude(t=whole.t[half:], quaternion=whole.quaternion[half:])
    try:
        fit = fit_imu_mounting(
            first,
            log.gyro,
            start=imu.orientation,
            window=window,
            time_offset=imu.time_offset,  # type: ignore[arg-type]
        )
    except CalibrationError:
        return math.nan
    return turn_residual(fit, second, log.gyro, window=window)  # type: ignore[arg-type]


def _curves(found: MountFit) -> tuple[Curve, ...]:
    """For the report: first corners, tilt and depth as measured and as the fit has them, over time."""
    rig, state, moments = found.rig, found.state, found.moments
    t = np.array([moment.time for moment in moments])
    poses, n, b = state.poses, rig.pool.interface.normal, rig.pool.interface.offset
    pixels, owner, _ = residuals(rig, state, moments, Noise())
    tags = np.array([tag for moment in moments for tag in moment.corners])
    seen = np.array([corner for moment in moments for corner in moment.corners.values()])
    curves = []
    for tag in np.unique(tags):
        of = tags == tag
        for i, axis in enumerate("uv"):
            measured = seen[of, 0, i]
            title = f"tag {tag}, top-left corner"
            fitted = measured - pixels[of, 0, i]
            curves.append(_curve(title, f"{axis} [px]", t[owner[of]], measured, fitted))
    felt = np.array([np.full(3, math.nan) if m.up is None else state.imu_turn @ m.up for m in moments])
    up = np.array([pose.R.T @ n for pose in poses])
    for i, axis in enumerate("xy"):
        if np.isfinite(felt[:, i]).any():
            curves.append(_curve("tilt by the IMU", f"up along body {axis} [-]", t, felt[:, i], up[:, i]))
    depth = np.array([math.nan if m.depth is None else m.depth for m in moments])
    if np.isfinite(depth).any():
        known = np.array([-(n @ pose.at(rig.port) + b) + state.depth_offset for pose in poses])
        curves.append(_curve("pressure port", "depth [m]", t, depth, known))
    return tuple(curves)


def _curve(title: str, label: str, t: Array, measured: Array, fitted: Array) -> Curve:
    return Curve(title=title, x_label="time [s]", y_label=label, x=t, measured=measured, fitted=fitted)


def _pressure(rig: Rig, found: MountFit, mounts: Mapping[int, Pose]) -> DepthFit | None:
    """Depths by the pixels alone, with the mounts found, against what the sensor said."""
    if not any(moment.depth is not None for moment in found.moments):
        return None
    reading = [math.nan if moment.depth is None else moment.depth for moment in found.moments]
    turned = [_without_depth(moment, found) for moment in found.moments]
    known = {tag: found.state.mount(tag, rig.reference) for tag in (rig.reference, *found.state.others)}
    alone = fit_mounts(rig, {**mounts, **known}, turned, estimate="sensors")
    if len(alone.moments) != len(reading):
        times = {moment.time for moment in alone.moments}
        reading = [d for d, m in zip(reading, found.moments, strict=True) if m.time in times]
    n, b = rig.pool.interface.normal, rig.pool.interface.offset
    depths = np.array([-(n @ pose.at(rig.port) + b) for pose in alone.state.poses])
    return fit_depth(depths, reading, known_std=distance_std(found))


def _without_depth(moment: Moment, found: MountFit) -> Moment:
    up = None if moment.up is None else found.state.imu_turn @ moment.up
    return replace(moment, depth=None, up=up)


def _fit(
    found: MountFit,
    imu: ImuMounting | CalibrationError | None,
    pressure: DepthFit | None,
    log: MountLog,
    vehicle: Vehicle,
    mounts: Mapping[int, Pose],
    settings: Mapping[str, Any],
    name: str,
    told: Mapping[str, Estimate],
) -> Fit:
    estimates: dict[str, Estimate] = {}
    changes: dict[str, Any] = {}
    warnings = list(log.notes)
    tag_estimates(found, mounts, estimates, changes, vehicle)
    if settings["estimate"] == "sensors":
        imu_orientation(found, imu, vehicle, estimates, changes)
    warnings += of_frozen(found) + of_imu(imu, settings["estimate"])
    if isinstance(imu, ImuMounting):
        estimates |= {key: value for key, value in imu.estimates.items() if "turn" not in key}
    estimates |= told
    if pressure is not None:
        estimates |= pressure.estimates
        warnings += pressure.advice
        offset = pressure.estimates["depth.offset"]
        if offset.identifiable and vehicle.sensors.depth is not None:
            height = float(vehicle.sensors.depth.position[2]) - pressure.offset
            changes["sensors.depth.position.2"] = height
    quality = {
        "corners [px]": {
            "rmse": found.rms,
            "rmse_held_out": found.held_out_rms,
            "samples": float(len(found.moments)),
            "rejected": float(found.left_out),
        }
    }
    if isinstance(imu, ImuMounting):
        quality["turns of the gyro [deg]"] = {
            "rmse": math.degrees(imu.residual),
            "rmse_held_out": math.degrees(_turns_held_out(found, log, imu)),
            "samples": float(imu.windows),
            "rejected": float(imu.rejected),
        }
    if pressure is not None:
        quality["depth [m]"] = {"rmse": pressure.rms, "rejected": float(pressure.rejected)}
    return Fit(
        kind="mounts",
        method="vision",
        vehicle=vehicle,
        estimates=estimates,
        changes=changes,
        quality=quality,
        warnings=tuple(warnings),
        curves=_curves(found),
        trials={name: log.sha256},
        settings={**settings, "reference_tag": found.rig.reference},
    )


def _three(text: str) -> tuple[float, ...]:
    """A point from `x,y,z`."""
    try:
        numbers = tuple(float(word) for word in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != 3 or not all(map(math.isfinite, numbers)):
        raise CalibrationError(f"--turns-about is '{text}', expected three lengths such as 0,0,-0.08")
    return numbers


def run(
    log: Path,
    *,
    pool: Path,
    vehicle: str,
    out: Path,
    estimate: str = "tags",
    turns_about: str | Sequence[float] | None = None,
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
        turns_about (X,Y,Z): Body point that stays in place while the vehicle turns on the spot: x,y,z [m].
        report (DIR): Directory for the report and its pictures.
        seed: Seed of every random number; equal seeds give equal results.
        as_json: Print one JSON object instead of tables.

    Returns:
        The vehicle written.

    Raises:
        CalibrationError, LocalizationError, VehicleError, OutputError: As they say; nothing is written then.
    """
    if isinstance(turns_about, str):
        turns_about = _three(turns_about)
    refuse_unwritable(atomic_write(check_vehicle_path(out)))
    if report is not None:
        refuse_unwritable(atomic_directory(report, replaces=FIT_FILE))
    where, body = load_pool(pool), load_vehicle(vehicle)
    recording = read_mount_log(log, where, body)
    fit = calibrate_mounts(
        recording, where, body, name=Path(log).name, estimate=estimate, centre=turns_about, seed=seed
    )
    after = calibrated(fit)
    warnings = doubts(fit, after)
    write_vehicle(after, out)
    if report is not None:
        words = [
            "finssim",
            "calibrate",
            "mounts",
            str(log),
            "--pool",
            str(pool),
            "--vehicle",
            vehicle,
            "--out",
            str(out),
        ]
        words += ["--estimate", estimate, "--seed", str(seed)]
        words += [] if turns_about is None else ["--turns-about", ",".join(f"{x:g}" for x in turns_about)]
        write_report(fit, report, after, command=shlex.join(words), warnings=warnings, out=out)
    if as_json:
        print(json.dumps(fit_json(fit, after, out=out, warnings=warnings), allow_nan=False))
        return after
    console = Console() if sys.stdout.isatty() else Console(width=100)
    print_fit(fit, after, console, warnings)
    left = kept(fit, after)
    if left:
        console.print(f"kept from the file: {', '.join(left)}", highlight=False, markup=False)
    for place in filter(None, (out, report)):
        console.print(f"written: {place}", highlight=False, markup=False, soft_wrap=True)
    return after
