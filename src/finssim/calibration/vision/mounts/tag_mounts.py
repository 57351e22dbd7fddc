"""Where tags sit on a vehicle, from pictures taken while it moves: what the motion tells, and what it cannot."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.uncertainty import Covariance, intervals, trial_covariance
from finssim.calibration.vision.mounts.arrow import arrow_evidence
from finssim.calibration.vision.mounts.imu_mounting import rotation_between
from finssim.calibration.vision.mounts.mount_model import (
    Moment,
    MountState,
    Noise,
    Pose,
    Rig,
    moment_blocks,
    residuals,
)
from finssim.calibration.vision.mounts.mount_solver import as_before, change, minimise, restricted
from finssim.calibration.vision.mounts.mount_start import start_state
from finssim.geometry.rotations import quat_rotate, quat_to_matrix

__all__ = ["MOST_MOMENTS", "MountFit", "fit_mounts", "reference_tag"]

Array = NDArray[np.float64]

MOST_MOMENTS = 150
"""Moments that are used, spread over the recording; more tell the same."""

FEWEST_MOMENTS = 8
BLOCKS = 12
UNSURE_ANGLE = math.radians(3.0)
"""Half width of the 95 % interval of an angle beyond which it does not count as told."""

UNSURE_LENGTH = 0.02
"""The same for a length [m]."""

TURNED = math.radians(25.0)
"""Disagreement about up beyond which a mount is taken as turned, and not as inexact."""

BETTER = 0.6
"""Share of the disagreement that such a turn must leave, at most: noise alone always finds some turn."""

FAR = 6.0
"""Times the usual residual for a moment to be left out."""


@dataclass(frozen=True, kw_only=True)
class MountFit:
    """Mounts, and how far the motion tells them."""

    state: MountState
    rig: Rig
    moments: tuple[Moment, ...]
    """Those used."""
    free: tuple[str, ...]
    """Shared unknowns that were estimated, of `state.names`."""
    frozen: tuple[str, ...]
    """Those that the motion does not tell, kept as they were."""
    theta: Array
    """Steps from the start: angles as rotation vectors about the outer axes [rad], lengths [m], (free,)."""
    covariance: Covariance
    """Of `free`."""
    rms: float
    """Root of the mean squared distance of corners [px]."""
    held_out_rms: float
    """The same for moments whose pose alone was fitted, to mounts from other moments [px]."""
    left_out: int
    """Moments left out as far off."""

    def interval(self, name: str) -> tuple[float, float]:
        """Half-width-centred 95 % interval about zero of an error of a shared unknown; infinite if it is not free."""
        if name not in self.free:
            return -math.inf, math.inf
        i = self.free.index(name)
        low, high = intervals(np.zeros(len(self.free)), self.covariance)[i]
        return float(low), float(high)

    def std(self, name: str) -> float:
        """Standard deviation of a shared unknown; infinite if it is not free."""
        return float(self.covariance.std[self.free.index(name)]) if name in self.free else math.inf


def reference_tag(moments: Sequence[Moment], mounts: Mapping[int, Pose]) -> int:
    """The tag of the vehicle file that is seen most.

    Raises:
        CalibrationError: None of its tags is seen.
    """
    counts = {tag: sum(tag in moment.corners for moment in moments) for tag in mounts}
    best = max(counts, key=lambda tag: (counts[tag], -tag), default=None)
    if best is None or not counts[best]:
        seen = sorted({tag for moment in moments for tag in moment.corners})
        raise CalibrationError(
            f"none of the vehicle file's tags {sorted(mounts)} is seen, only {seen}: give the file the right ids"
        )
    return best


def fit_mounts(
    rig: Rig,
    mounts: Mapping[int, Pose],
    moments: Sequence[Moment],
    *,
    estimate: str = "tags",
    noise: Noise | None = None,
) -> MountFit:
    """Mounts of all tags, or of the sensors, from moments of a moving vehicle.

    Tags relative to one another follow from pictures that show two. How the reference tag sits in the body follows from
    the IMU's tilt (its whole orientation, once the vehicle tilts two ways) and from the depth (its height over the
    pressure port, and sideways from it by how depth changes with tilt). What the motion does not tell keeps its start.

    Args:
        rig: Camera, water, tags, port.
        mounts: Tags in the body as the vehicle file has them; one of them may be all.
        moments: In order of time.
        estimate: `tags`: IMU and pressure port in the file are right. `sensors`: the reference tag in the file is
            right, and the IMU's turn and the depth's offset are estimated.
        noise: Standard deviations.

    Raises:
        CalibrationError: Too few moments show a tag in the water.
    """
    sigma = noise or Noise()
    some = _spread([moment for moment in moments if moment.corners])
    state, kept = start_state(rig, mounts, some)
    used = [some[i] for i in kept]
    if len(used) < FEWEST_MOMENTS:
        raise CalibrationError(
            f"{len(used)} pictures show a tag of the vehicle under water, expected at least {FEWEST_MOMENTS}: record a "
            "minute of moving, turning and rocking below the camera"
        )
    unknown = sorted({tag for m in used for tag in m.corners} - {rig.reference} - state.others.keys())
    used = [replace(m, corners={t: c for t, c in m.corners.items() if t not in unknown}) for m in used]
    origin = state
    state = _by_vision(rig, state, used, sigma, estimate)
    state, used, left_out = _without_far(rig, state, used, sigma)
    wanted = _wanted(rig, state, used, estimate)
    free = _hopeful(rig, state, used, sigma, wanted)
    state = as_before(state, origin, [name for name in wanted if name not in free])
    while True:
        state = minimise(rig, state, used, sigma, free)
        blocks = [restricted(block, state, free) for block in moment_blocks(rig, state, used, sigma)]
        covariance = trial_covariance(arrow_evidence(blocks, free, "blocks", BLOCKS))
        worst = _least_told(free, intervals(np.zeros(len(free)), covariance)[:, 1])
        if worst is None:
            break
        free = tuple(name for name in free if name != worst)
        state = as_before(state, origin, [name for name in wanted if name not in free])
    corner, _, _ = residuals(rig, state, used, sigma)
    return MountFit(
        state=state,
        rig=rig,
        moments=tuple(used),
        free=free,
        frozen=tuple(name for name in wanted if name not in free),
        theta=change(origin, state, free),
        covariance=covariance,
        rms=float(np.sqrt(np.nanmean(np.sum(corner**2, axis=-1)))),
        held_out_rms=_held_out(rig, state, used, sigma, free),
        left_out=left_out,
    )


def _held_out(
    rig: Rig, state: MountState, moments: Sequence[Moment], noise: Noise, free: tuple[str, ...]
) -> float:
    """Mounts from every other sixth of the recording, tried on the sixths between, and the other way round."""
    part = np.arange(len(moments)) * 6 // len(moments) % 2
    squares = []
    for fold in (0, 1):
        fitted, tried = np.flatnonzero(part == fold).tolist(), np.flatnonzero(part != fold).tolist()
        some = replace(state, poses=[state.poses[i] for i in fitted])
        mounts = minimise(rig, some, [moments[i] for i in fitted], noise, free, steps=10)
        rest = [moments[i] for i in tried]
        test = minimise(
            rig, replace(mounts, poses=[state.poses[i] for i in tried]), rest, noise, (), steps=10
        )
        squares.append(np.sum(residuals(rig, test, rest, noise)[0] ** 2, axis=-1).ravel())
    return float(np.sqrt(np.nanmean(np.concatenate(squares))))


def _spread(moments: Sequence[Moment]) -> list[Moment]:
    """At most `MOST_MOMENTS`, evenly over the recording."""
    if len(moments) <= MOST_MOMENTS:
        return list(moments)
    return [moments[i] for i in np.unique(np.linspace(0, len(moments) - 1, MOST_MOMENTS).astype(int))]


def _wanted(rig: Rig, state: MountState, moments: Sequence[Moment], estimate: str) -> tuple[str, ...]:
    """Shared unknowns that the sensors at hand could tell."""
    up, depth = any(m.up is not None for m in moments), any(m.depth is not None for m in moments)
    others = [name for name in state.names if name.partition(".")[0].isdigit()]
    angles, height, place = ["turn_x", "turn_y", "turn_z"], ["z"], ["x", "y"]
    if estimate == "sensors":
        own = [f"imu.{axis}" for axis in angles if up] + (["depth.offset"] if depth else [])
        return (*others, *own)
    wanted = [f"reference.{axis}" for axis in angles if up]
    wanted += [f"reference.{axis}" for axis in height if depth]
    wanted += [f"reference.{axis}" for axis in place if (depth and up) or rig.centre is not None]
    centre = ["centre.x", "centre.y"] if rig.centre is not None else []
    return (*wanted, *others, *centre)


def _without_far(
    rig: Rig, state: MountState, moments: Sequence[Moment], noise: Noise
) -> tuple[MountState, list[Moment], int]:
    """Moments whose best corner is far off even alone, as a wrongly read tag's, go."""
    corner, owner, _ = residuals(rig, state, moments, noise)
    distance = np.linalg.norm(corner, axis=-1)
    far = np.array([np.median(distance[owner == i]) for i in range(len(moments))])
    usual = float(np.nanmedian(far))
    keep = np.isfinite(far) & (far <= max(FAR * usual, 3.0 * noise.pixel))
    state = replace(state, poses=[pose for pose, ok in zip(state.poses, keep, strict=True) if ok])
    return state, [m for m, ok in zip(moments, keep, strict=True) if ok], int(np.sum(~keep))


def _least_told(free: Sequence[str], half: Array) -> str | None:
    """The unknown that is least told, by its half width in its own unit, if it is not told well enough."""
    limits = np.array([UNSURE_ANGLE if "turn" in name else UNSURE_LENGTH for name in free])
    ratio = np.where(np.isfinite(half), half, np.inf) / limits
    ratio[[name.startswith("centre.") for name in free]] = 0.0
    worst = int(np.argmax(ratio))
    return free[worst] if ratio[worst] > 1.0 else None


def _hopeful(
    rig: Rig, state: MountState, moments: Sequence[Moment], noise: Noise, free: tuple[str, ...]
) -> tuple[str, ...]:
    """Without what the geometry alone rules out: least squares would wander along it."""
    blocks = moment_blocks(rig, state, moments, noise)
    while True:
        some = [restricted(block, state, free) for block in blocks]
        local = trial_covariance(arrow_evidence(some, free, "blocks", 1)).local
        worst = _least_told(free, 1.96 * np.sqrt(np.diagonal(local)))
        if worst is None:
            return free
        free = tuple(name for name in free if name != worst)


def _by_vision(
    rig: Rig, state: MountState, moments: Sequence[Moment], noise: Noise, estimate: str
) -> MountState:
    """Poses from the pixels, and a reference tag or an IMU turned so that up by the IMU is up by the pixels.

    A tag or an IMU that is mounted a quarter turn away from what the file says would otherwise start with tilts of the
    wrong sign. Where the vehicle never tilts, the smallest turn is taken.
    """
    blind = [replace(moment, up=None) for moment in moments]
    others = tuple(name for name in state.names if name.partition(".")[0].isdigit())
    state = minimise(rig, state, blind, noise, others, steps=15)
    known = [i for i, moment in enumerate(moments) if moment.up is not None]
    if not known:
        return state
    seen = np.array([state.poses[i].R.T @ rig.pool.interface.normal for i in known])
    felt = np.array([moments[i].up for i in known])
    q = rotation_between(felt, seen, np.ones(len(known)), (0.0, 0.0, 0.0, 1.0))
    better = np.sum((felt - quat_rotate(q, seen)) ** 2) < BETTER * np.sum((felt - seen) ** 2)
    if 2.0 * math.acos(min(1.0, abs(float(q[3])))) < TURNED or not better:
        return minimise(rig, state, moments, noise, ())
    turn = Pose(quat_to_matrix(q), np.zeros(3))
    if estimate == "sensors":
        state = replace(state, imu_turn=turn.R.T.copy())
    else:  # the body turns about the reference tag, so that every tag stays where it is seen
        mount = Pose(turn.R @ state.reference.R, state.reference.t)
        back = state.reference.then(mount.inverse)
        state = replace(state, reference=mount, poses=[pose.then(back) for pose in state.poses])
    return minimise(rig, state, moments, noise, ())
