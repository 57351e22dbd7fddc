"""Mounts of tags and sensors from one recording, as a fit that goes into a vehicle file."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.fit import Estimate, Fit
from finssim.calibration.vision.imu_mounting import ImuMounting, fit_imu_mounting
from finssim.calibration.vision.mount_log import MountLog
from finssim.calibration.vision.mount_model import Moment, Pose, Rig
from finssim.calibration.vision.pressure_offset import DepthFit, fit_depth
from finssim.calibration.vision.tag_mounts import UNSURE_LENGTH, MountFit, fit_mounts, reference_tag
from finssim.calibration.vision.turns import Attitude
from finssim.geometry.rotations import (
    matrix_to_quat,
    quat_from_rotvec,
    quat_multiply,
    quat_to_matrix,
    quat_to_rotvec,
)
from finssim.localization.pool import Pool
from finssim.localization.tags import corners
from finssim.vehicles import Vehicle

__all__ = ["ESTIMATES", "calibrate_mounts"]

Array = NDArray[np.float64]

ESTIMATES = ("tags", "sensors")
EDGE_STD = 0.25e-3
"""Standard deviation of a tag's edge measured with a ruler [m]: it makes every distance wrong by the same share."""

AXES = "xyz"


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
    if vehicle.tags is None:
        raise CalibrationError(
            f"{vehicle.name} has no tags: give its file a section tags with edge and one mount"
        )
    if not pool.is_surface:
        raise CalibrationError(
            "the pool's plane is no water surface: mounts need the camera above level water"
        )
    mounts = {
        tag: Pose(quat_to_matrix(mount.orientation), np.asarray(mount.position, float))
        for tag, mount in vehicle.tags.mounts.items()
    }
    depth = vehicle.sensors.depth
    rig = Rig(
        pool=pool,
        corners_t=corners(vehicle.tags.edge),
        port=np.zeros(3) if depth is None else np.asarray(depth.position, float),
        reference=reference_tag(log.moments, mounts),
        centre=None if centre is None else np.asarray(centre, float),
    )
    found = fit_mounts(rig, mounts, log.moments, estimate=estimate)
    imu = _imu(found, log, vehicle)
    pressure = _pressure(rig, found, mounts) if estimate == "sensors" else None
    return _fit(found, imu, pressure, log, vehicle, mounts, {"estimate": estimate, "seed": seed}, name)


def _imu(found: MountFit, log: MountLog, vehicle: Vehicle) -> ImuMounting | CalibrationError | None:
    """The IMU from the attitudes that the pixels and the tilt give; the refusal itself where they say too little."""
    if log.gyro is None or vehicle.sensors.imu is None:
        return None
    times = np.array([moment.time for moment in found.moments])
    attitude = Attitude(t=times, quaternion=matrix_to_quat(np.array([pose.R for pose in found.state.poses])))
    try:
        return fit_imu_mounting(
            attitude,
            log.gyro,
            start=vehicle.sensors.imu.orientation,
            window=max(0.5, float(np.median(np.diff(times)))),
        )
    except CalibrationError as error:
        return error


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


def distance_std(found: MountFit) -> float:
    """Error of every depth from an edge that is measured a little wrong: its share of the apparent distance [m]."""
    camera, interface = found.rig.pool.camera, found.rig.pool.interface
    above = float(interface.normal @ camera.position) + interface.offset
    below = -float(np.median([interface.normal @ pose.t for pose in found.state.poses])) - interface.offset
    edge = float(np.linalg.norm(found.rig.corners_t[0] - found.rig.corners_t[1]))
    ratio = interface.index_far / interface.index_near
    return EDGE_STD / edge * (above * ratio + below)


def _fit(
    found: MountFit,
    imu: ImuMounting | CalibrationError | None,
    pressure: DepthFit | None,
    log: MountLog,
    vehicle: Vehicle,
    mounts: Mapping[int, Pose],
    settings: Mapping[str, Any],
    name: str,
) -> Fit:
    estimates: dict[str, Estimate] = {}
    changes: dict[str, Any] = {}
    warnings = list(log.notes)
    _tags(found, mounts, estimates, changes, vehicle)
    if settings["estimate"] == "sensors":
        _orientation(found, imu, vehicle, estimates, changes)
    warnings += _frozen(found) + _of_imu(imu, settings["estimate"])
    if isinstance(imu, ImuMounting):
        estimates |= {key: value for key, value in imu.estimates.items() if "turn" not in key}
    if pressure is not None:
        estimates |= pressure.estimates
        warnings += pressure.advice
        offset = pressure.estimates["depth.offset"]
        if offset.identifiable and vehicle.sensors.depth is not None:
            height = float(vehicle.sensors.depth.position[2]) - pressure.offset
            changes["sensors.depth.position.2"] = height
    quality = {
        "pictures": {
            "samples": float(len(found.moments)),
            "rejected": float(found.left_out),
            "rms_px": found.rms,
        }
    }
    if isinstance(imu, ImuMounting):
        quality["gyro"] = {"samples": float(imu.windows), "rejected": float(imu.rejected)}
        quality["gyro"]["residual_deg"] = math.degrees(imu.residual)
    if pressure is not None:
        quality["depth"] = {"rmse": pressure.rms, "rejected": float(pressure.rejected)}
    return Fit(
        kind="mounts",
        method="vision",
        vehicle=vehicle,
        estimates=estimates,
        changes=changes,
        quality=quality,
        warnings=tuple(warnings),
        trials={name: log.sha256},
        settings={**settings, "reference_tag": found.rig.reference},
    )


def _tags(
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
            estimates[f"tags.{tag}.turn_{axis}"] = _estimate(
                f"tags.{tag}.turn_{axis}", turn[i], np.degrees(half[i]), "deg", tag, reference
            )
        for i, axis in enumerate(AXES):
            estimates[f"tags.{tag}.{axis}"] = _estimate(
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


def _estimate(
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


def _orientation(
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
    std = np.array([found.std(f"imu.turn_{axis}") for axis in AXES])
    by_tilt = quat_to_rotvec(matrix_to_quat(found.state.imu_turn))
    turn, information = by_tilt, np.diag(np.where(np.isfinite(std), 1.0 / std**2, 0.0))
    if isinstance(imu, ImuMounting) and np.isfinite(imu.covariance).all():
        around = quat_multiply(imu.orientation, _conjugate(quat_multiply(quat_from_rotvec(by_tilt), start)))
        second = np.linalg.inv(imu.covariance)
        correction = np.linalg.pinv(information + second) @ second @ quat_to_rotvec(around)
        turn = quat_to_rotvec(quat_multiply(quat_from_rotvec(correction), quat_from_rotvec(by_tilt)))
        information = information + second
    known = np.diagonal(information) > 1e-6
    half = np.where(
        known, 2.2 * np.sqrt(np.diagonal(np.linalg.pinv(information))), np.inf
    )  # Student, 11 blocks
    for i, axis in enumerate(AXES):
        name = f"imu.turn_{axis}"
        sure = bool(half[i] < math.radians(5.0))
        low, high = np.degrees(turn[i] - half[i]), np.degrees(turn[i] + half[i])
        note = "" if sure else "the motion does not tell it: kept from the file"
        estimates[name] = Estimate(
            name=name,
            estimate=float(np.degrees(turn[i])),
            ci95=(float(low), float(high)),
            unit="deg",
            identifiable=sure,
            note=note,
        )
    if (half < math.radians(5.0)).any():
        q = quat_multiply(quat_from_rotvec(turn), start)
        changes["sensors.imu.orientation"] = (q / np.linalg.norm(q)).tolist()


def _conjugate(q: Array) -> Array:
    return np.asarray(q * np.array([-1.0, -1.0, -1.0, 1.0]))


def _frozen(found: MountFit) -> list[str]:
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


def _of_imu(imu: ImuMounting | CalibrationError | None, estimate: str) -> list[str]:
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
