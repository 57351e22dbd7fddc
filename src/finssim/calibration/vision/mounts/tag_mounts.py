"""Where tags sit on a vehicle, from pictures taken while it moves: what the motion tells, and what it cannot."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.errors import CalibrationError
from finssim.calibration.uncertainty import Covariance, intervals, trial_covariance
from finssim.calibration.vision.mounts.arrow import Block, arrow_evidence, arrow_step
from finssim.calibration.vision.mounts.imu_mounting import rotation_between
from finssim.calibration.vision.mounts.mount_model import (
    HUBER,
    Moment,
    MountState,
    Noise,
    Pose,
    Rig,
    moment_blocks,
    moved,
    residuals,
)
from finssim.geometry.optics import back_project
from finssim.geometry.rotations import matrix_to_quat, quat_rotate, quat_to_matrix, quat_to_rotvec

__all__ = ["MOST_MOMENTS", "MountFit", "change", "fit_mounts", "reference_tag", "start_state"]

# Where a vehicle is, roughly, from one tag, its tilt and the file's mounts: enough for least squares to begin.

HALVINGS = 40
DEEPEST = 20.0
"""Distance below the surface up to which a tag is looked for [m]."""


def start_state(
    rig: Rig, mounts: Mapping[int, Pose], moments: Sequence[Moment]
) -> tuple[MountState, list[int]]:
    """First guess, and which moments it holds: those with a tag whose mount is known and whose corners meet the water.

    A tag without a mount gets that of the first moment that shows it beside one with a mount, as if all were level.
    """
    mounts = dict(mounts)
    _place_unknown(rig, mounts, moments)
    reference = mounts[rig.reference]
    poses, kept = [], []
    for i, moment in enumerate(moments):
        pose = start_pose(rig, mounts, moment)
        if pose is not None:
            poses.append(pose)
            kept.append(i)
    others = {tag: reference.inverse.then(mounts[tag]) for tag in sorted(mounts) if tag != rig.reference}
    return MountState(reference=reference, others=others, poses=poses), kept


def start_pose(rig: Rig, mounts: Mapping[int, Pose], moment: Moment) -> Pose | None:
    """Body in the pool: position and heading of a tag seen as if it were parallel to the surface, tilt by the IMU."""
    for tag in sorted(moment.corners, key=lambda tag: tag != rig.reference):
        level = level_tag(rig, moment.corners[tag]) if tag in mounts else None
        if level is None:
            continue
        R = level.R @ mounts[tag].R.T  # of a body whose tag is level
        up_p, up_b = rig.pool.interface.normal, moment.up
        R = _least_turn(R @ (R.T @ up_p if up_b is None else up_b), up_p) @ R
        return Pose(R, level.t - R @ mounts[tag].t)
    return None


def level_tag(rig: Rig, pixels: Array) -> Pose | None:
    """Tag in the pool as if it lay parallel to the surface, at the depth at which its edges have their length."""
    rays = back_project(rig.pool.camera, rig.pool.interface, pixels)
    if not np.isfinite(rays.direction).all():
        return None
    n, b = rig.pool.interface.normal, rig.pool.interface.offset
    edge = float(np.linalg.norm(rig.corners_t[0] - rig.corners_t[1]))

    def at(depth: float) -> Array:
        down = (-depth - b - rays.origin @ n) / (rays.direction @ n)
        return np.asarray(rays.origin + down[:, None] * rays.direction)

    def size(depth: float) -> float:
        points = at(depth)
        return float(np.mean(np.linalg.norm(points - np.roll(points, -1, axis=0), axis=1)))

    low, high = 0.0, DEEPEST
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if size(middle) < edge else (low, middle)
    points = at(0.5 * (low + high))
    right = points[1] + points[2] - points[0] - points[3]
    x = right - (right @ n) * n
    x /= np.linalg.norm(x)
    return Pose(np.column_stack([x, np.cross(n, x), n]), points.mean(axis=0))


def _place_unknown(rig: Rig, mounts: dict[int, Pose], moments: Sequence[Moment]) -> None:
    seen = {tag for moment in moments for tag in moment.corners}
    for tag in sorted(seen - mounts.keys()):
        for moment in moments:
            beside = [other for other in moment.corners if other in mounts]
            if tag not in moment.corners or not beside:
                continue
            known, new = level_tag(rig, moment.corners[beside[0]]), level_tag(rig, moment.corners[tag])
            if known is not None and new is not None:
                mounts[tag] = mounts[beside[0]].then(known.inverse.then(new))
                break


def _least_turn(a: Array, b: Array) -> Array:
    """Smallest rotation that takes unit vector a to b, (3, 3)."""
    v, c = np.cross(a, b), float(a @ b)
    if c < -0.999:  # opposite: about any axis across
        across = np.linalg.svd(a[None])[2][1]
        return np.asarray(2.0 * np.outer(across, across) - np.eye(3))
    S = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    return np.asarray(np.eye(3) + S + S @ S / (1.0 + c))


# Least squares over mounts and moments, in those unknowns that are left free.

STEPS = 60


def restricted(block: Block, state: MountState, free: Sequence[str]) -> Block:
    """A block in the free unknowns alone."""
    index = [state.names.index(name) for name in free]
    return Block(block.aa[np.ix_(index, index)], block.ab[index], block.bb, block.a[index], block.b)


def _cost(rig: Rig, state: MountState, moments: Sequence[Moment], noise: Noise) -> float:
    corner, _, rest = residuals(rig, state, moments, noise)
    r = np.linalg.norm(corner, axis=-1) / noise.pixel
    robust = np.where(r <= HUBER, r**2, HUBER * (2.0 * r - HUBER))
    total = float(np.sum(robust)) + sum(float(np.sum(part**2)) for part in rest)
    return total if math.isfinite(total) else math.inf


def minimise(
    rig: Rig,
    state: MountState,
    moments: Sequence[Moment],
    noise: Noise,
    free: Sequence[str],
    steps: int = STEPS,
) -> MountState:
    index = [state.names.index(name) for name in free]
    damping, cost, failures = 1e-3, _cost(rig, state, moments, noise), 0
    for _ in range(steps):
        blocks = [restricted(block, state, free) for block in moment_blocks(rig, state, moments, noise)]
        step, own = arrow_step(blocks, damping)
        shared = np.zeros(len(state.names))
        shared[index] = step
        candidate = moved(state, shared, own)
        after = _cost(rig, candidate, moments, noise)
        if after < cost:
            done = cost - after < 1e-7 * cost
            state, cost, failures, damping = candidate, after, 0, max(0.1 * damping, 1e-9)
            if done:
                break
        else:
            damping, failures = 10.0 * damping, failures + 1
            if failures > 8:
                break
    return state


def as_before(state: MountState, origin: MountState, frozen: Sequence[str]) -> MountState:
    """With unknowns of the start put back, those of the reference tag, the IMU and the depth."""
    back = np.zeros(len(state.names))
    for name, total in zip(frozen, change(origin, state, frozen), strict=True):
        back[state.names.index(name)] = -total
    return moved(state, back, [np.zeros(6)] * len(state.poses))


def change(before: MountState, after: MountState, free: Sequence[str]) -> Array:
    """Total step of each free unknown from one state to the other."""

    def turn(a: Array, b: Array) -> Array:
        return np.asarray(quat_to_rotvec(matrix_to_quat(b @ a.T)))

    total = [turn(before.reference.R, after.reference.R), after.reference.t - before.reference.t]
    for tag, pose in before.others.items():
        total += [turn(pose.R, after.others[tag].R), after.others[tag].t - pose.t]
    total += [turn(before.imu_turn, after.imu_turn), np.array([after.depth_offset - before.depth_offset])]
    total.append(after.centre - before.centre)
    every = np.concatenate(total)
    return every[[before.names.index(name) for name in free]]


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
