"""Estimates of mounts with their intervals, what goes into the vehicle file, and what is to be said."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.fit import Estimate
from finssim.calibration.vision.mounts.imu_mounting import ImuMounting
from finssim.calibration.vision.mounts.mount_model import Pose
from finssim.calibration.vision.mounts.tag_mounts import UNSURE_LENGTH, MountFit
from finssim.geometry.rotations import (
    matrix_to_quat,
    quat_conjugate,
    quat_from_rotvec,
    quat_multiply,
    quat_to_rotvec,
)
from finssim.vehicles import Vehicle

__all__ = ["distance_std", "imu_orientation", "of_frozen", "of_imu", "tag_estimates"]

Array = NDArray[np.float64]

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
