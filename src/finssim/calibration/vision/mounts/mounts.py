"""Mounts of tags and sensors from one recording, as a fit that goes into a vehicle file."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.fit import Curve, Estimate, Fit
from finssim.calibration.vision.mounts.imu_clock import imu_clock
from finssim.calibration.vision.mounts.imu_mounting import ImuMounting, fit_imu_mounting, turn_residual
from finssim.calibration.vision.mounts.mount_estimates import (
    distance_std,
    imu_orientation,
    of_frozen,
    of_imu,
    tag_estimates,
)
from finssim.calibration.vision.mounts.mount_log import MountLog
from finssim.calibration.vision.mounts.mount_model import Moment, Noise, Pose, Rig, residuals
from finssim.calibration.vision.mounts.pressure_offset import DepthFit, fit_depth
from finssim.calibration.vision.mounts.tag_mounts import MountFit, fit_mounts, reference_tag
from finssim.calibration.vision.mounts.turns import Attitude
from finssim.geometry.rotations import (
    matrix_to_quat,
    quat_to_matrix,
)
from finssim.localization.detection.tags import corners
from finssim.localization.pool import Pool
from finssim.vehicles import Vehicle

__all__ = ["ESTIMATES", "calibrate_mounts"]

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
