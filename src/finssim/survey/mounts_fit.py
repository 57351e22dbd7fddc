"""Fit of tag mounts on a vehicle, from measurements of a camera above the water, an IMU and a pressure sensor
while it moves.

One of the vehicle's tags is the reference tag r; the others are placed relative to it. Unknown are the pose
of every moment, and shared by all moments: the mount of the reference tag and the poses of the other tags
relative to it. The pixels of a corner follow from refraction (`finssim.core.optics.project`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from finssim.core.least_squares import Block, Step, arrow_step, block_of, descend, huber_loss, huber_weight
from finssim.core.optics import back_project, project, projection_jacobians
from finssim.core.rotations import (
    matrix_to_quat,
    nearest_rotation,
    quat_rotate,
    quat_to_matrix,
    quat_to_rotvec,
    skew,
)
from finssim.identification.uncertainty import Covariance, arrow_evidence, intervals, trial_covariance
from finssim.localization.detection.families import corners
from finssim.localization.overhead_camera import Pool
from finssim.survey.pose import Pose
from finssim.trials.findings import CalibrationError

Array = NDArray[np.float64]

AXES = ("turn_x", "turn_y", "turn_z", "x", "y", "z")
"""Components of a small motion of a tag: rotation about the outer axes [rad], and translation along them [m]."""

HUBER = 3.0
"""Residual of a corner in standard deviations beyond which the loss grows linearly."""


@dataclass(frozen=True, kw_only=True)
class Moment:
    """Measurements at the time of one picture."""

    time: float
    """Time of the picture [s]."""
    corners: Mapping[int, Array]
    """Tag -> pixels of its corners in printed order, (4, 2)."""
    up: Array | None = None
    """Unit direction of up from the IMU, in body axes according to its mount in the vehicle file, (3,)."""
    depth: float | None = None
    """Depth of the pressure port [m]."""


PIXEL_STD = 0.3
"""Standard deviation of a corner, per axis [px]."""

UP_STD = 0.009
"""Standard deviation of roll and pitch from the IMU [rad]."""

DEPTH_STD = 0.01
"""Standard deviation of a depth [m]."""


@dataclass(frozen=True, kw_only=True)
class Rig:
    """Known parameters of camera, water and vehicle."""

    pool: Pool
    edge: float
    """Edge of a tag [m]."""
    port: Array
    """Pressure port, body frame [m], (3,)."""
    reference: int
    """Id of the reference tag."""
    edges: Mapping[int, float] = field(default_factory=dict)
    """Edges of tags of a different size, by id [m]."""

    def corners_t(self, tag: int) -> Array:
        """Return the corners of a tag in its own frame [m], (4, 3)."""
        return corners(self.edges.get(tag, self.edge))


@dataclass(frozen=True, kw_only=True)
class MountState:
    """All unknowns."""

    reference: Pose
    """Pose of the reference tag in the body."""
    others: Mapping[int, Pose]
    """Poses of the other tags in the frame of the reference tag."""
    poses: Sequence[Pose]
    """Pose of the body in the pool at every moment."""

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the shared unknowns, in the order of a step."""
        return tuple(f"{tag}.{axis}" for tag in ("reference", *self.others) for axis in AXES)

    def mount(self, tag: int, reference: int) -> Pose:
        """Return the pose of a tag in the body."""
        return self.reference if tag == reference else self.reference.then(self.others[tag])


def moved(state: MountState, shared: Array, pose_steps: Sequence[Array]) -> MountState:
    """Return the state after a step of the shared unknowns, in the order of `names`, and of each moment's pose.

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
    """Return the corners of all tags of all moments in the pool, tags in each moment's order, (n, 4, 3) [m]."""
    mounts = {
        tag: state.mount(tag, rig.reference).at(rig.corners_t(tag)) for tag in (rig.reference, *state.others)
    }
    return np.array(
        [pose.at(mounts[tag]) for pose, m in zip(state.poses, moments, strict=True) for tag in m.corners]
    )


def residuals(
    rig: Rig, state: MountState, moments: Sequence[Moment]
) -> tuple[Array, NDArray[np.int64], list[Array]]:
    """Return measured minus predicted corners [px] (n, 4, 2), NaN if not visible, their moments (n,), and the
    whitened residuals of IMU and depth."""
    observed = np.array([pixels for m in moments for pixels in m.corners.values()])
    owner = np.repeat(np.arange(len(moments)), [len(m.corners) for m in moments])
    predicted = project(rig.pool.camera, rig.pool.interface, corner_points(rig, state, moments)).pixels
    rest = [
        np.concatenate([np.zeros(0), *(r for _, _, r in _others(rig, state, pose, m))])
        for pose, m in zip(state.poses, moments, strict=True)
    ]
    return observed - predicted, owner, rest


def moment_blocks(rig: Rig, state: MountState, moments: Sequence[Moment]) -> list[Block]:
    """Return the weighted normal equations of every moment, shared unknowns in the order of `MountState.names`."""
    pixels, _, _ = residuals(rig, state, moments)
    J = projection_jacobians(rig.pool.camera, rig.pool.interface, corner_points(rig, state, moments)).point
    size = np.linalg.norm(pixels, axis=-1)
    root = np.sqrt(huber_weight(size, HUBER * PIXEL_STD))[..., None] / PIXEL_STD
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
    """Return the derivatives of a tag's pixels by the shared unknowns (4, 2, P) and the pose (4, 2, 6), from those
    by its corners in the pool, J (4, 2, 3)."""
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
    """Return whitened rows of IMU and depth: derivatives by the shared unknowns and by the pose, and residual."""
    n, rows = rig.pool.interface.normal, []

    def add(std: float, turn: Array, shift: Array, residual: Array) -> None:
        A = np.zeros((len(residual), len(state.names)))
        rows.append((A, np.hstack([turn, shift]) / std, residual / std))

    if moment.up is not None:
        add(UP_STD, pose.R.T @ skew(n), np.zeros((3, 3)), moment.up - pose.R.T @ n)
    if moment.depth is not None:
        arm = pose.R @ rig.port
        off = moment.depth + (n @ (pose.t + arm) + rig.pool.interface.offset)
        add(DEPTH_STD, (n @ skew(arm))[None], -n[None], np.array([off]))
    return rows


# Initial poses of the vehicle, from one tag, the tilt and the mounts in the file, for the least-squares fit.

HALVINGS = 40
DEEPEST = 20.0
"""Greatest depth below the surface at which a tag is searched [m]."""


def rotation_between(a: Array, b: Array) -> Array:
    """Return the rotation q_ab with a = R_ab b in least squares; the smallest one if the vectors do not
    determine it (Kabsch 1976).

    Args:
        a: Vectors of any unit, (n, 3).
        b: The same vectors in other axes and the same unit, (n, 3).

    Returns:
        Quaternion, xyzw, (4,).
    """
    B = a.T @ b
    return matrix_to_quat(nearest_rotation(B + 1e-6 * np.linalg.norm(B) * np.eye(3)))


def start_state(
    rig: Rig, mounts: Mapping[int, Pose], moments: Sequence[Moment]
) -> tuple[MountState, list[int]]:
    """Return the initial state, and the moments in it: those with a tag of known mount whose corners' rays
    enter the water.

    A tag without a mount gets that of the first moment that shows it together with one with a mount, as if
    all were level.
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
    """Return the initial pose of the body: position and heading of a tag as if it were level, tilt from the IMU."""
    for tag in sorted(moment.corners, key=lambda tag: tag != rig.reference):
        level = level_tag(rig, tag, moment.corners[tag]) if tag in mounts else None
        if level is None:
            continue
        R = level.R @ mounts[tag].R.T  # as if the tag were level
        up_p, up_b = rig.pool.interface.normal, moment.up
        R = quat_to_matrix(rotation_between(up_p[None], (R @ up_b if up_b is not None else up_p)[None])) @ R
        return Pose(R, level.t - R @ mounts[tag].t)
    return None


def level_tag(rig: Rig, tag: int, pixels: Array) -> Pose | None:
    """Return the pose of a tag as if it were parallel to the surface, at the depth at which its edges have
    their length."""
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


# Least squares over mounts and moments, for the shared unknowns that are free.

STEPS = 60


def restricted(block: Block, state: MountState, free: Sequence[str]) -> Block:
    """Return a block reduced to the free unknowns."""
    index = [state.names.index(name) for name in free]
    return Block(block.aa[np.ix_(index, index)], block.ab[index], block.bb, block.a[index], block.b)


def minimise(
    rig: Rig, state: MountState, moments: Sequence[Moment], free: Sequence[str], steps: int = STEPS
) -> MountState:
    """Return the state that fits the moments best, near a state, over their poses and the shared unknowns `free`."""
    index = [state.names.index(name) for name in free]

    def cost(state: MountState) -> float:
        corner, _, rest = residuals(rig, state, moments)
        total = float(huber_loss(np.linalg.norm(corner, axis=-1) / PIXEL_STD, HUBER).sum())
        total += float(np.sum(np.concatenate(rest) ** 2))
        return total if math.isfinite(total) else math.inf

    def linearise(state: MountState) -> Step[MountState]:
        blocks = [restricted(block, state, free) for block in moment_blocks(rig, state, moments)]

        def stepped(damping: float) -> tuple[MountState, float]:
            shared = np.zeros(len(state.names))
            shared[index], local, promised = arrow_step(blocks, damping)
            return moved(state, shared, local), promised

        return stepped

    return descend(state, cost, linearise, steps=steps, tolerance=1e-19, relative_tolerance=1e-7).state


def as_before(state: MountState, origin: MountState, frozen: Sequence[str]) -> MountState:
    """Return the state with the frozen unknowns reset to their initial values."""
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
"""Greatest number of moments used, spread over the recording; more do not improve the fit."""

FEWEST_MOMENTS = 8
BLOCKS = 12
UNSURE_ANGLE = math.radians(3.0)
"""Half width of the 95 % interval of an angle above which it is not determined [rad]."""

UNSURE_LENGTH = 0.02
"""Half width of the 95 % interval of a length above which it is not determined [m]."""

TURNED = math.radians(25.0)
"""Disagreement about up beyond which a mount is treated as rotated rather than inaccurate [rad]."""

BETTER = 0.6
"""Largest ratio of the squared disagreement after such a rotation to that before: noise alone always allows
some reduction."""

FAR = 6.0
"""Ratio of a moment's residual to the usual one above which the moment is excluded."""


@dataclass(frozen=True, kw_only=True)
class MountFit:
    """Estimated mounts, and how well the motion determines them."""

    state: MountState
    rig: Rig
    moments: tuple[Moment, ...]
    """Moments that were used."""
    free: tuple[str, ...]
    """Shared unknowns that were estimated, a subset of `state.names`."""
    frozen: tuple[str, ...]
    """Unknowns that the motion does not determine, kept at their initial values."""
    covariance: Covariance
    """Covariance of `free`."""
    rms: float
    """Root mean square distance of corners [px]."""
    held_out_rms: float
    """Residual of held-out moments, of which only the pose is fitted, with mounts from the other moments [px]."""
    excluded: int
    """Number of moments excluded as outliers."""

    def half_width(self, name: str) -> float:
        """Return the half width of the 95 % interval of a shared unknown; infinite if it is not free.

        It has the unit of the unknown.
        """
        if name not in self.free:
            return math.inf
        return float(intervals(np.zeros(len(self.free)), self.covariance)[self.free.index(name), 1])

    @property
    def port_depths(self) -> Array:
        """Depth of the pressure port at every moment, from the poses [m], (n,)."""
        n, b = self.rig.pool.interface.normal, self.rig.pool.interface.offset
        return np.array([-(n @ pose.at(self.rig.port) + b) for pose in self.state.poses])


def reference_tag(moments: Sequence[Moment], mounts: Mapping[int, Pose]) -> int:
    """Return the tag of the vehicle file that is visible most often.

    Raises:
        CalibrationError: None of its tags is visible.
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
    """Fit mounts of all tags, from moments of a moving vehicle whose IMU and pressure port are mounted as in
    its file.

    The poses of tags relative to one another follow from pictures that show two. The mount of the reference
    tag in the body follows from the IMU's tilt (its complete orientation, once the vehicle tilts in two
    directions) and from the depth (its height over the pressure port, and its horizontal position from the
    change of depth with tilt). Unknowns that the motion does not determine keep their initial values.

    Args:
        rig: Camera, water, tags, port.
        mounts: Tags in the body according to the vehicle file; one is enough.
        moments: Moments in order of time.
        held_out: True to compute the error at held-out parts of the recording too.

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
    """Return the residual of held-out moments: two halves of alternate sixths of the recording, each tested
    with the other's mounts."""
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
    """Return the shared unknowns of the tags that are placed relative to the reference tag."""
    return tuple(name for name in state.names if name[0].isdigit())


def _without_far(
    rig: Rig, state: MountState, moments: Sequence[Moment]
) -> tuple[MountState, list[Moment], int]:
    """Exclude moments of which even the median corner is an outlier, such as with a misread tag; return the
    number excluded."""
    corner, owner, _ = residuals(rig, state, moments)
    distance = np.linalg.norm(corner, axis=-1)
    far = np.array([np.median(distance[owner == i]) for i in range(len(moments))])
    usual = float(np.nanmedian(far))
    keep = np.isfinite(far) & (far <= max(FAR * usual, 3.0 * PIXEL_STD))
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
    """Return the free unknowns without those that the geometry does not determine, along which least squares
    would drift."""
    blocks = moment_blocks(rig, state, moments)
    while True:
        some = [restricted(block, state, free) for block in blocks]
        local = trial_covariance(arrow_evidence(some, free, "blocks", 1)).local
        worst = _least_observable(free, 1.96 * np.sqrt(np.diagonal(local)))
        if worst is None:
            return free
        free = tuple(name for name in free if name != worst)


def _by_vision(rig: Rig, state: MountState, moments: Sequence[Moment]) -> MountState:
    """Fit poses to the pixels, and rotate the reference tag so that up from the IMU agrees with up from the pixels.

    A tag that is mounted a quarter turn away from the file's mount would otherwise start with tilts of the wrong
    sign. If the vehicle never tilts, the smallest rotation is used.
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
        # The body rotates about the reference tag, so that every tag stays at its observed position.
        mount = Pose(quat_to_matrix(q) @ state.reference.R, state.reference.t)
        back = state.reference.then(mount.inverse)
        state = replace(state, reference=mount, poses=[pose.then(back) for pose in state.poses])
    return minimise(rig, state, moments, ())
