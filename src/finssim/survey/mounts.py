"""`finssim calibrate mounts`: where tags sit on a vehicle, from what a camera above the water, an IMU and a pressure
sensor measure while it moves.

A vehicle carries tags; one is the reference tag r, the others are placed relative to it. Unknown are the pose of every
moment, and shared by all moments: the mount of the reference tag and the other tags relative to it. The pixels of a
corner follow from refraction (`finssim.core.optics.project`).
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from finssim.core.least_squares import Block, Step, arrow_step, block_of, descend, huber_loss, huber_weight
from finssim.core.optics import back_project, project, projection_jacobians
from finssim.core.rotations import (
    matrix_to_quat,
    quat_conjugate,
    quat_multiply,
    quat_rotate,
    quat_to_matrix,
    quat_to_rotvec,
    skew,
)
from finssim.identification.fit import Curve, Estimate, Fit
from finssim.identification.report import finish, refuse_places
from finssim.identification.uncertainty import Covariance, arrow_evidence, intervals, trial_covariance
from finssim.localization.detection.detections import best_detections, read_detections
from finssim.localization.detection.families import corners
from finssim.localization.fusion.attitude import TiltGains, follow, tilt_from
from finssim.localization.fusion.fuse_log import Series, imu_columns, read_stream_table, series
from finssim.localization.overhead_camera import Pool, load_pool
from finssim.survey.pose import Pose
from finssim.trials.findings import CalibrationError, Finding, finding
from finssim.trials.motion import RATE, offset, smooth
from finssim.vehicles import Vehicle, load_vehicle

Array = NDArray[np.float64]

AXES = ("turn_x", "turn_y", "turn_z", "x", "y", "z")
"""Axes of a small motion of a tag: about the outer axes [rad], and along them [m]."""

HUBER = 3.0
"""Corners further off than this many standard deviations count linearly."""


@dataclass(frozen=True, kw_only=True)
class Moment:
    """Measurements when one picture was taken."""

    time: float
    """[s]"""
    corners: Mapping[int, Array]
    """Tag -> pixels of its corners as printed, (4, 2)."""
    up: Array | None = None
    """Unit direction of up by the IMU, in body axes as its mount in the vehicle file has them, (3,)."""
    depth: float | None = None
    """Depth of the pressure port [m]."""


@dataclass(frozen=True, kw_only=True)
class MountNoise:
    """Standard deviations."""

    pixel: float = 0.3
    """Standard deviation of a coordinate of a corner [px]."""
    up: float = 0.009
    """Standard deviation of roll and pitch [rad]."""
    depth: float = 0.01
    """[m]"""


@dataclass(frozen=True, kw_only=True)
class Rig:
    """Known values."""

    pool: Pool
    edge: float
    """Edge of a tag [m]."""
    port: Array
    """Pressure port, body frame [m], (3,)."""
    reference: int
    """The reference tag."""
    noise: MountNoise = field(default_factory=MountNoise)
    edges: Mapping[int, float] = field(default_factory=dict)
    """Edges of tags of another size, by id [m]."""

    def corners_t(self, tag: int) -> Array:
        """Return the corners of a tag in its own frame [m], (4, 3)."""
        return corners(self.edges.get(tag, self.edge))


@dataclass(frozen=True, kw_only=True)
class MountState:
    """Everything that is estimated."""

    reference: Pose
    """Reference tag in the body."""
    others: Mapping[int, Pose]
    """Other tags in the frame of the reference tag."""
    poses: Sequence[Pose]
    """Body in the pool at every moment."""

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the shared unknowns, in the order of a step."""
        return tuple(f"{tag}.{axis}" for tag in ("reference", *self.others) for axis in AXES)

    def mount(self, tag: int, reference: int) -> Pose:
        """A tag in the body."""
        return self.reference if tag == reference else self.reference.then(self.others[tag])


def moved(state: MountState, shared: Array, pose_steps: Sequence[Array]) -> MountState:
    """After a step of the shared unknowns, in the order of `names`, and of each moment's pose.

    Steps are in [m] and [rad].
    """
    return replace(
        state,
        reference=state.reference.stepped(shared[:6]),
        others={
            tag: pose.stepped(shared[6 + 6 * i : 12 + 6 * i])
            for i, (tag, pose) in enumerate(state.others.items())
        },
        poses=[pose.stepped(step) for pose, step in zip(state.poses, pose_steps, strict=True)],
    )


def corner_points(rig: Rig, state: MountState, moments: Sequence[Moment]) -> Array:
    """Corners of all tags of all moments in the pool, tags in each moment's order, (n, 4, 3) [m]."""
    mounts = {
        tag: state.mount(tag, rig.reference).at(rig.corners_t(tag)) for tag in (rig.reference, *state.others)
    }
    return np.array(
        [pose.at(mounts[tag]) for pose, m in zip(state.poses, moments, strict=True) for tag in m.corners]
    )


def residuals(
    rig: Rig, state: MountState, moments: Sequence[Moment]
) -> tuple[Array, NDArray[np.int64], list[Array]]:
    """Measured less predicted corners [px] (n, 4, 2), NaN out of sight, their moments (n,), and the whitened rest."""
    observed = np.array([pixels for m in moments for pixels in m.corners.values()])
    owner = np.repeat(np.arange(len(moments)), [len(m.corners) for m in moments])
    predicted = project(rig.pool.camera, rig.pool.interface, corner_points(rig, state, moments)).pixels
    rest = [
        np.concatenate([np.zeros(0), *(r for _, _, r in _others(rig, state, pose, m))])
        for pose, m in zip(state.poses, moments, strict=True)
    ]
    return observed - predicted, owner, rest


def moment_blocks(rig: Rig, state: MountState, moments: Sequence[Moment]) -> list[Block]:
    """Weighted normal equations of every moment, shared unknowns in the order of `MountState.names`."""
    pixels, _, _ = residuals(rig, state, moments)
    J = projection_jacobians(rig.pool.camera, rig.pool.interface, corner_points(rig, state, moments)).point
    pixel = rig.noise.pixel
    root = np.sqrt(huber_weight(np.linalg.norm(pixels, axis=-1), HUBER * pixel))[..., None] / pixel
    k, blocks = 0, []
    for pose, moment in zip(state.poses, moments, strict=True):
        rows = _others(rig, state, pose, moment)
        for tag in moment.corners:
            A, B = _corner_rows(rig, state, pose, tag, J[k])
            weighted = (root[k][..., None] * A, root[k][..., None] * B, root[k] * pixels[k])
            rows.append(tuple(x.reshape(8, *x.shape[2:]) for x in weighted))
            k += 1
        blocks.append(block_of(*map(np.concatenate, zip(*rows, strict=True))))
    return blocks


def _corner_rows(rig: Rig, state: MountState, pose: Pose, tag: int, J: Array) -> tuple[Array, Array]:
    """Derivatives of a tag's pixels with respect to the shared unknowns (4, 2, P) and the pose (4, 2, 6), from those
    with respect to its corners in the pool, J (4, 2, 3)."""
    corners_t = rig.corners_t(tag)
    in_reference = corners_t if tag == rig.reference else state.others[tag].at(corners_t)
    in_body = state.reference.at(in_reference)
    of_pose = np.concatenate([-J @ skew(in_body @ pose.R.T), J], axis=-1)
    A = np.zeros((4, 2, len(state.names)))
    J_b = J @ pose.R
    A[..., 0:3] = -J_b @ skew(in_reference @ state.reference.R.T)
    A[..., 3:6] = J_b
    if tag != rig.reference:
        J_r, start = J_b @ state.reference.R, 6 + 6 * list(state.others).index(tag)
        A[..., start : start + 3] = -J_r @ skew(corners_t @ state.others[tag].R.T)
        A[..., start + 3 : start + 6] = J_r
    return A, of_pose


def _others(rig: Rig, state: MountState, pose: Pose, moment: Moment) -> list[tuple[Array, Array, Array]]:
    """Whitened rows of IMU and depth: shared, own, residual."""
    n, noise, rows = rig.pool.interface.normal, rig.noise, []

    def add(std: float, turn: Array, shift: Array, residual: Array) -> None:
        A = np.zeros((len(residual), len(state.names)))
        rows.append((A, np.hstack([turn, shift]) / std, residual / std))

    if moment.up is not None:
        add(noise.up, pose.R.T @ skew(n), np.zeros((3, 3)), moment.up - pose.R.T @ n)
    if moment.depth is not None:
        arm = pose.R @ rig.port
        off = moment.depth + (n @ (pose.t + arm) + rig.pool.interface.offset)
        add(noise.depth, (n @ skew(arm))[None], -n[None], np.array([off]))
    return rows


# Where a vehicle is, roughly, from one tag, its tilt and the file's mounts: enough for least squares to begin.

HALVINGS = 40
DEEPEST = 20.0
"""Distance below the surface up to which a tag is looked for [m]."""


def rotation_between(a: Array, b: Array) -> Array:
    """Rotation q_ab with a = R_ab b in least squares; where the vectors leave it open, the smallest  (Kabsch 1976).

    Args:
        a: Vectors of any unit, (n, 3).
        b: The same vectors in other axes and the same unit, (n, 3).

    Returns:
        Quaternion, xyzw, (4,).
    """
    B = a.T @ b
    U, _, right = np.linalg.svd(B + 1e-6 * np.linalg.norm(B) * np.eye(3))
    return matrix_to_quat(U @ np.diag([1.0, 1.0, np.linalg.det(U @ right)]) @ right)


def start_state(
    rig: Rig, mounts: Mapping[int, Pose], moments: Sequence[Moment]
) -> tuple[MountState, list[int]]:
    """First guess, and which moments it holds: those with a tag whose mount is known and whose corners meet the water.

    A tag without a mount gets that of the first moment that shows it beside one with a mount, as if all were level.
    """
    mounts = dict(mounts)
    _locate_unknown(rig, mounts, moments)
    reference = mounts[rig.reference]
    poses, selected = [], []
    for i, moment in enumerate(moments):
        pose = start_pose(rig, mounts, moment)
        if pose is not None:
            poses.append(pose)
            selected.append(i)
    others = {tag: reference.inverse.then(mounts[tag]) for tag in sorted(mounts) if tag != rig.reference}
    return MountState(reference=reference, others=others, poses=poses), selected


def start_pose(rig: Rig, mounts: Mapping[int, Pose], moment: Moment) -> Pose | None:
    """Body in the pool: position and heading of a tag seen as if it were parallel to the surface, tilt by the IMU."""
    for tag in sorted(moment.corners, key=lambda tag: tag != rig.reference):
        level = level_tag(rig, tag, moment.corners[tag]) if tag in mounts else None
        if level is None:
            continue
        R = level.R @ mounts[tag].R.T  # of a body whose tag is level
        up_p, up_b = rig.pool.interface.normal, moment.up
        R = quat_to_matrix(rotation_between(up_p[None], (R @ up_b if up_b is not None else up_p)[None])) @ R
        return Pose(R, level.t - R @ mounts[tag].t)
    return None


def level_tag(rig: Rig, tag: int, pixels: Array) -> Pose | None:
    """Tag in the pool as if it lay parallel to the surface, at the depth at which its edges have their length."""
    rays = back_project(rig.pool.camera, rig.pool.interface, pixels)
    if not np.isfinite(rays.direction).all():
        return None
    n, b = rig.pool.interface.normal, rig.pool.interface.offset

    def at(depth: float) -> Array:
        down = (-depth - b - rays.origin @ n) / (rays.direction @ n)
        return np.asarray(rays.origin + down[:, None] * rays.direction)

    def size(depth: float) -> float:
        points = at(depth)
        return float(np.mean(np.linalg.norm(points - np.roll(points, -1, axis=0), axis=1)))

    low, high, edge = 0.0, DEEPEST, rig.edges.get(tag, rig.edge)
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if size(middle) < edge else (low, middle)
    points = at(0.5 * (low + high))
    right = points[1] + points[2] - points[0] - points[3]
    x = right - (right @ n) * n
    x /= np.linalg.norm(x)
    return Pose(np.column_stack([x, np.cross(n, x), n]), points.mean(axis=0))


def _locate_unknown(rig: Rig, mounts: dict[int, Pose], moments: Sequence[Moment]) -> None:
    visible = {tag for moment in moments for tag in moment.corners}
    for tag in sorted(visible - mounts.keys()):
        for moment in moments:
            beside = [other for other in moment.corners if other in mounts]
            if tag not in moment.corners or not beside:
                continue
            reference, new = (level_tag(rig, one, moment.corners[one]) for one in (beside[0], tag))
            if reference is not None and new is not None:
                mounts[tag] = mounts[beside[0]].then(reference.inverse.then(new))
                break


# Least squares over mounts and moments, in those unknowns that are left free.

STEPS = 60


def restricted(block: Block, state: MountState, free: Sequence[str]) -> Block:
    """A block in the free unknowns alone."""
    index = [state.names.index(name) for name in free]
    return Block(block.aa[np.ix_(index, index)], block.ab[index], block.bb, block.a[index], block.b)


def minimise(
    rig: Rig, state: MountState, moments: Sequence[Moment], free: Sequence[str], steps: int = STEPS
) -> MountState:
    """The state that suits the moments best, nearby, over their poses and the shared unknowns `free`."""
    index = [state.names.index(name) for name in free]

    def cost(state: MountState) -> float:
        corner, _, rest = residuals(rig, state, moments)
        total = float(huber_loss(np.linalg.norm(corner, axis=-1) / rig.noise.pixel, HUBER).sum())
        total += float(np.sum(np.concatenate(rest) ** 2))
        return total if math.isfinite(total) else math.inf

    def linearise(state: MountState) -> Step[MountState]:
        blocks = [restricted(block, state, free) for block in moment_blocks(rig, state, moments)]

        def stepped(damping: float) -> tuple[MountState, float]:
            shared = np.zeros(len(state.names))
            shared[index], local, promised = arrow_step(blocks, damping)
            return moved(state, shared, local), promised

        return stepped

    return descend(state, cost, linearise, steps=steps, still=1e-19, share=1e-7).state


def as_before(state: MountState, origin: MountState, frozen: Sequence[str]) -> MountState:
    """Return the state with unknowns of the start restored."""
    back = np.zeros(len(state.names))
    for name, total in zip(frozen, change(origin, state, frozen), strict=True):
        back[state.names.index(name)] = -total
    return moved(state, back, [np.zeros(6)] * len(state.poses))


def change(before: MountState, after: MountState, free: Sequence[str]) -> Array:
    """Return the total step of each free unknown from one state to the other [m, rad, s]."""

    def turn(a: Array, b: Array) -> Array:
        return np.asarray(quat_to_rotvec(matrix_to_quat(b @ a.T)))

    total = [turn(before.reference.R, after.reference.R), after.reference.t - before.reference.t]
    for tag, pose in before.others.items():
        total += [turn(pose.R, after.others[tag].R), after.others[tag].t - pose.t]
    every = np.concatenate(total)
    return every[[before.names.index(name) for name in free]]


MAX_MOMENTS = 150
"""Greatest number of used moments, spread over the recording; more add nothing."""

FEWEST_MOMENTS = 8
BLOCKS = 12
UNSURE_ANGLE = math.radians(3.0)
"""Half width of the 95 % interval of an angle beyond which it does not count as determined."""

UNSURE_LENGTH = 0.02
"""Half width of the 95 % interval of a length beyond which it does not count as determined [m]."""

TURNED = math.radians(25.0)
"""Disagreement about up beyond which a mount is taken as turned, and not as inexact."""

BETTER = 0.6
"""Share of the disagreement that such a turn must leave, at most: noise alone always finds some turn."""

FAR = 6.0
"""Times the usual residual for a moment to be left out."""


@dataclass(frozen=True, kw_only=True)
class MountFit:
    """Mounts, and how well the motion determines them."""

    state: MountState
    rig: Rig
    moments: tuple[Moment, ...]
    """Used moments."""
    free: tuple[str, ...]
    """Shared unknowns that were estimated, of `state.names`."""
    frozen: tuple[str, ...]
    """Unknowns that the motion does not determine, kept as they were."""
    covariance: Covariance
    """Covariance of `free`."""
    rms: float
    """Root of the mean squared distance of corners [px]."""
    held_out_rms: float
    """Residual of moments whose pose alone was fitted, to mounts from other moments [px]."""
    excluded: int
    """Moments left out as far off."""

    def half_width(self, name: str) -> float:
        """Return the half width of the 95 % interval of a shared unknown; infinite if it is not free.

        It has the unit of the unknown.
        """
        if name not in self.free:
            return math.inf
        return float(intervals(np.zeros(len(self.free)), self.covariance)[self.free.index(name), 1])

    @property
    def port_depths(self) -> Array:
        """Depth of the pressure port at every moment by the poses [m], (n,)."""
        n, b = self.rig.pool.interface.normal, self.rig.pool.interface.offset
        return np.array([-(n @ pose.at(self.rig.port) + b) for pose in self.state.poses])


def reference_tag(moments: Sequence[Moment], mounts: Mapping[int, Pose]) -> int:
    """The tag of the vehicle file that is seen most.

    Raises:
        CalibrationError: None of its tags is seen.
    """
    counts = {tag: sum(tag in moment.corners for moment in moments) for tag in mounts}
    best = max(counts, key=lambda tag: (counts[tag], -tag), default=None)
    if best is None or not counts[best]:
        visible = sorted({tag for moment in moments for tag in moment.corners})
        raise CalibrationError(
            f"none of the vehicle file's tags {sorted(mounts)} is seen, only {visible}: correct the ids in the file"
        )
    return best


def fit_mounts(
    rig: Rig,
    mounts: Mapping[int, Pose],
    moments: Sequence[Moment],
    *,
    held_out: bool = True,
) -> MountFit:
    """Fit mounts of all tags, from moments of a moving vehicle whose IMU and pressure port are mounted as its file
    states.

    Tags relative to one another follow from pictures that show two. How the reference tag sits in the body follows from
    the IMU's tilt (its whole orientation, once the vehicle tilts two ways) and from the depth (its height over the
    pressure port, and sideways from it by how depth changes with tilt). What the motion does not tell keeps its start.

    Args:
        rig: Camera, water, tags, port.
        mounts: Tags in the body as the vehicle file has them; one of them may be all.
        moments: In order of time.
        held_out: Fit parts of the recording too, for the error at the others.

    Raises:
        CalibrationError: Too few moments show a tag in the water.
    """
    some = _spread([moment for moment in moments if moment.corners])
    state, selected = start_state(rig, mounts, some)
    used = [some[i] for i in selected]
    if len(used) < FEWEST_MOMENTS:
        raise CalibrationError(
            f"{len(used)} pictures show a tag of the vehicle under water, expected at least {FEWEST_MOMENTS}: record a "
            "minute of moving, turning and rocking below the camera"
        )
    unknown = sorted({tag for m in used for tag in m.corners} - {rig.reference} - state.others.keys())
    used = [replace(m, corners={t: c for t, c in m.corners.items() if t not in unknown}) for m in used]
    origin = state
    state = _by_vision(rig, state, used)
    state, used, excluded = _without_far(rig, state, used)
    candidates = _candidates(state, used)
    free = _hopeful(rig, state, used, candidates)
    state = as_before(state, origin, [name for name in candidates if name not in free])
    while True:
        state = minimise(rig, state, used, free)
        blocks = [restricted(block, state, free) for block in moment_blocks(rig, state, used)]
        covariance = trial_covariance(arrow_evidence(blocks, free, "blocks", BLOCKS))
        worst = _least_observable(free, intervals(np.zeros(len(free)), covariance)[:, 1])
        if worst is None:
            break
        free = tuple(name for name in free if name != worst)
        state = as_before(state, origin, [name for name in candidates if name not in free])
    corner, _, _ = residuals(rig, state, used)
    return MountFit(
        state=state,
        rig=rig,
        moments=tuple(used),
        free=free,
        frozen=tuple(name for name in candidates if name not in free),
        covariance=covariance,
        rms=float(np.sqrt(np.nanmean(np.sum(corner**2, axis=-1)))),
        held_out_rms=_held_out(rig, state, used, free) if held_out else math.nan,
        excluded=excluded,
    )


def _held_out(rig: Rig, state: MountState, moments: Sequence[Moment], free: tuple[str, ...]) -> float:
    """Mounts from every other sixth of the recording, tried on the sixths between, and the other way round."""
    fold = np.arange(len(moments)) * 6 // len(moments) % 2

    def fitted(state: MountState, k: int, free: tuple[str, ...]) -> tuple[MountState, list[Moment]]:
        index = np.flatnonzero(fold == k).tolist()
        some, state = [moments[i] for i in index], replace(state, poses=[poses[i] for i in index])
        return minimise(rig, state, some, free, steps=10), some

    poses, corners = state.poses, []
    for k in (0, 1):
        test, others = fitted(fitted(state, k, free)[0], 1 - k, ())
        corners.append(np.sum(residuals(rig, test, others)[0] ** 2, axis=-1).ravel())
    return float(np.sqrt(np.nanmean(np.concatenate(corners))))


def _spread(moments: Sequence[Moment]) -> list[Moment]:
    """Return at most `MAX_MOMENTS`, evenly over the recording."""
    if len(moments) <= MAX_MOMENTS:
        return list(moments)
    return [moments[i] for i in np.unique(np.linspace(0, len(moments) - 1, MAX_MOMENTS).astype(int))]


def _candidates(state: MountState, moments: Sequence[Moment]) -> tuple[str, ...]:
    """Return the shared unknowns that the available sensors can determine."""
    up, depth = any(m.up is not None for m in moments), any(m.depth is not None for m in moments)
    observable = {"turn_x": up, "turn_y": up, "turn_z": up, "z": depth, "x": depth and up, "y": depth and up}
    candidates = [f"reference.{axis}" for axis, available in observable.items() if available]
    return (*candidates, *_of_others(state))


def _of_others(state: MountState) -> tuple[str, ...]:
    """Shared unknowns of the tags that are placed relative to the reference tag."""
    return tuple(name for name in state.names if name[0].isdigit())


def _without_far(
    rig: Rig, state: MountState, moments: Sequence[Moment]
) -> tuple[MountState, list[Moment], int]:
    """Moments whose best corner is far off even alone, as a wrongly read tag's, go."""
    corner, owner, _ = residuals(rig, state, moments)
    distance = np.linalg.norm(corner, axis=-1)
    far = np.array([np.median(distance[owner == i]) for i in range(len(moments))])
    usual = float(np.nanmedian(far))
    keep = np.isfinite(far) & (far <= max(FAR * usual, 3.0 * rig.noise.pixel))
    state = replace(state, poses=[pose for pose, ok in zip(state.poses, keep, strict=True) if ok])
    return state, [m for m, ok in zip(moments, keep, strict=True) if ok], int(np.sum(~keep))


def _least_observable(free: Sequence[str], half: Array) -> str | None:
    """Return the least determined unknown, by its half width in its own unit, if it is not determined well enough."""
    limits = np.array([UNSURE_ANGLE if "turn" in name else UNSURE_LENGTH for name in free])
    ratio = np.where(np.isfinite(half), half, np.inf) / limits
    worst = int(np.argmax(ratio))
    return free[worst] if ratio[worst] > 1.0 else None


def _hopeful(
    rig: Rig, state: MountState, moments: Sequence[Moment], free: tuple[str, ...]
) -> tuple[str, ...]:
    """Without what the geometry alone rules out: least squares would wander along it."""
    blocks = moment_blocks(rig, state, moments)
    while True:
        some = [restricted(block, state, free) for block in blocks]
        local = trial_covariance(arrow_evidence(some, free, "blocks", 1)).local
        worst = _least_observable(free, 1.96 * np.sqrt(np.diagonal(local)))
        if worst is None:
            return free
        free = tuple(name for name in free if name != worst)


def _by_vision(rig: Rig, state: MountState, moments: Sequence[Moment]) -> MountState:
    """Poses from the pixels, and a reference tag turned so that up by the IMU is up by the pixels.

    A tag that is mounted a quarter turn away from what the file says would otherwise start with tilts of the wrong
    sign. Where the vehicle never tilts, the smallest turn is taken.
    """
    blind = [replace(moment, up=None) for moment in moments]
    state = minimise(rig, state, blind, _of_others(state), steps=15)
    with_up = [i for i, moment in enumerate(moments) if moment.up is not None]
    if not with_up:
        return state
    observed = np.array([state.poses[i].R.T @ rig.pool.interface.normal for i in with_up])
    felt = np.array([moments[i].up for i in with_up])
    q = rotation_between(felt, observed)
    better = np.sum((felt - quat_rotate(q, observed)) ** 2) < BETTER * np.sum((felt - observed) ** 2)
    if 2.0 * math.acos(min(1.0, abs(float(q[3])))) >= TURNED and better:
        # The body turns about the reference tag, so that every tag stays where it is seen.
        mount = Pose(quat_to_matrix(q) @ state.reference.R, state.reference.t)
        back = state.reference.then(mount.inverse)
        state = replace(state, reference=mount, poses=[pose.then(back) for pose in state.poses])
    return minimise(rig, state, moments, ())


# A log folder of pictures, IMU and depth, laid out as moments of a moving vehicle.

DETECTIONS, IMU, DEPTH = "detections.csv", "imu.csv", "depth.csv"
LONGEST_AGE = 0.3
"""Greatest distance between the samples around an exposure at which a sensor is read [s]."""

SETTLING = 5.0
"""Until the tilt of gyro and accelerometer has forgotten its start [s]."""


@dataclass(frozen=True, kw_only=True)
class MountLog:
    """Content of a folder."""

    pictures: tuple[tuple[float, Mapping[int, Array]], ...]
    """Time of the exposure [s] and tag -> pixels of its corners (4, 2), in order of time."""
    up: Series | None
    """Direction of up in body axes."""
    turning: Series | None
    """Angular rate about the vertical, by gyro and `up` [rad/s]."""
    depth: Series | None
    """[m]"""
    sha256: str
    """Digest of the read files."""
    findings: tuple[Finding, ...]
    """Data that was left out or is missing."""

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
    vector = None if up is None else up.at(time)
    return vector / np.linalg.norm(vector) if isinstance(vector, np.ndarray) else None


def _depth_at(depth: Series | None, time: float) -> float | None:
    value = None if depth is None else depth.at(time)
    return float(value[0]) if isinstance(value, np.ndarray) else None


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
    return series("depth", table.t, table.columns("depth"), LONGEST_AGE, label=str(path))


# The mounts, as estimates and as numbers of the vehicle file.

EDGE_STD = 0.25e-3
"""Standard deviation of a tag's edge measured with a ruler [m]: it makes every distance wrong by the same share."""

RETAINED = "the motion does not determine it: kept from the file"


def distance_std(fit: MountFit) -> float:
    """Error of every depth from an edge that is measured a little wrong: its share of the apparent distance [m]."""
    interface = fit.rig.pool.interface
    above = float(interface.normal @ fit.rig.pool.camera.position) + interface.offset
    below = -float(np.median([interface.normal @ pose.t for pose in fit.state.poses])) - interface.offset
    return EDGE_STD / fit.rig.edge * (above * interface.index_far / interface.index_near + below)


def tag_estimates(
    fit: MountFit, mounts: Mapping[int, Pose], vehicle: Vehicle
) -> tuple[list[Estimate], dict[str, Any]]:
    """Return estimates of every tag, and the mounts to write; an undetermined tag keeps the file's."""
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
    """Half widths of a tag's 95 % intervals, turn about the body axes [rad] and position [m], (6,).

    What is kept from the file counts as exact for the other tags, which are told relative to it; for the reference tag
    itself it is infinite.
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
    """Return findings on what the motion does not determine of the tags."""
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
    """Fit the tags' mounts in the body, with everything that the motion determines; IMU and pressure port are right in
    the file.

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
"""Turns without which no offset is fitted."""

UNSURE_CLOCK = 0.05
"""Half width of the 95 % interval of the offset beyond which it does not count as identified [s]."""


def _clock(rig: Rig, mounts: Mapping[int, Pose], log: MountLog) -> Estimate | None:
    """Return the time to add to the IMU's times, by turns that the pixels alone show: tilts by the IMU agree with its
    gyro whatever its clock does."""
    if log.turning is None:
        return None
    alone = fit_mounts(rig, mounts, [replace(m, up=None, depth=None) for m in log.moments()], held_out=False)
    q = matrix_to_quat(np.array([pose.R for pose in alone.state.poses]))
    t = np.array([moment.time for moment in alone.moments])
    return imu_clock(t, q, rig.pool.interface.normal, log.turning.t, log.turning.values[:, 0])


def imu_clock(
    t_picture: Array, attitude: Array, up_p: Array, t_imu: Array, vertical_rate: Array
) -> Estimate | None:
    """Return the time to add to the IMU's times, from turns about the vertical between neighbouring pictures.

    n · log(R_2 R_1ᵀ) is the turn from one picture to the next; its rate is compared with ω · up, ω and up in any one
    frame of the vehicle, so that neither the IMU's mounting nor the tilt is needed.

    Args:
        t_picture: Times of the pictures, increasing [s], (n,).
        attitude: From the pixels, body to pool, unit xyzw [-], (n, 4); its tilt may be poor.
        up_p: Unit vector n, upwards in the pool, (3,).
        t_imu: Times of the IMU, increasing [s], (m,).
        vertical_rate: ω · up [rad/s], (m,).

    Returns:
        `imu.time_offset` [s], or None if there are too few pictures or both do not show one motion.
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
    """For the report: first corners, tilt and depth as measured and as the fit has them, over time."""
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
        The vehicle written.

    Raises:
        CalibrationError, LocalizationError, VehicleError, OutputError: As they say; nothing is written then.
    """
    options = dict(locals())
    refuse_places(out, report, "vehicle")
    site, body = load_pool(pool), load_vehicle(vehicle)
    recording = read_mount_log(log, site, body)
    return finish("mounts", calibrate_mounts(recording, site, body, name=Path(log).name, seed=seed), options)
