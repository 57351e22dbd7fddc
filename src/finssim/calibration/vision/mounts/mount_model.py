"""What a camera above the water, an IMU and a pressure sensor say together about where things sit on a vehicle.

A vehicle carries tags; one is the reference tag r, the others are placed relative to it. Unknown are the pose of every
moment, and shared by all moments: the mount of the reference tag, the other tags relative to it, a turn of the IMU, and
an offset of the depth. The pixels of a corner follow from refraction (`finssim.geometry.optics.project`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.vision.mounts.arrow import Block, block_of
from finssim.geometry.optics import project, projection_jacobians
from finssim.geometry.rotations import quat_from_rotvec, quat_to_matrix, skew
from finssim.localization.pool import Pool

__all__ = [
    "Moment",
    "MountState",
    "Noise",
    "Pose",
    "Rig",
    "corner_points",
    "moment_blocks",
    "moved",
    "residuals",
]

Array = NDArray[np.float64]

HUBER = 3.0
"""Corners further off than this many standard deviations count linearly."""


class Pose(NamedTuple):
    """A frame in another one."""

    R: Array
    """(3, 3)"""
    t: Array
    """[m], (3,)"""

    def at(self, points: Array) -> Array:
        """Points of the inner frame in the outer one, (..., 3)."""
        return np.asarray(points @ self.R.T + self.t)

    def then(self, inner: Pose) -> Pose:
        """The pose of what lies in this frame at `inner`."""
        return Pose(self.R @ inner.R, self.R @ inner.t + self.t)

    @property
    def inverse(self) -> Pose:
        """The outer frame in the inner one."""
        return Pose(self.R.T.copy(), -self.R.T @ self.t)

    def stepped(self, step: Array) -> Pose:
        """After a small turn about the outer axes (3) and a shift (3)."""
        return Pose(quat_to_matrix(quat_from_rotvec(step[:3])) @ self.R, self.t + step[3:])


@dataclass(frozen=True, kw_only=True)
class Moment:
    """What was measured when one picture was taken."""

    time: float
    """[s]"""
    corners: Mapping[int, Array]
    """Tag -> pixels of its corners as printed, (4, 2)."""
    up: Array | None = None
    """Direction of up by the IMU, in body axes as its mount in the vehicle file has them, (3,)."""
    depth: float | None = None
    """Of the pressure port [m]."""


@dataclass(frozen=True, kw_only=True)
class Rig:
    """What is taken as known."""

    pool: Pool
    corners_t: Array
    """Corners of a tag in its own frame [m], (4, 3)."""
    port: Array
    """Pressure port, body frame [m], (3,)."""
    reference: int
    """The reference tag."""
    centre: Array | None = None
    """Body point that stays where it is while the vehicle turns on the spot [m], (3,); None if it does not."""


@dataclass(frozen=True, kw_only=True)
class Noise:
    """Standard deviations."""

    pixel: float = 0.3
    """Of a coordinate of a corner [px]."""
    up: float = 0.009
    """Of roll and pitch [rad]."""
    depth: float = 0.01
    """[m]"""
    centre: float = 0.02
    """Of the place of the centre while turning on the spot [m]."""


@dataclass(frozen=True, kw_only=True)
class MountState:
    """Everything that is estimated."""

    reference: Pose
    """Reference tag in the body."""
    others: Mapping[int, Pose]
    """Other tags in the frame of the reference tag."""
    poses: Sequence[Pose]
    """Body in the pool at every moment."""
    imu_turn: Array = field(default_factory=lambda: np.eye(3))
    """Turn of the IMU's body axes into the body, (3, 3)."""
    depth_offset: float = 0.0
    """Reading less true depth [m]."""
    centre: Array = field(default_factory=lambda: np.zeros(2))
    """Where the centre stays, pool x and y [m], (2,)."""

    @property
    def names(self) -> tuple[str, ...]:
        """Of the shared unknowns, in the order of a step."""
        axes = ("turn_x", "turn_y", "turn_z", "x", "y", "z")
        names = [f"reference.{axis}" for axis in axes]
        names += [f"{tag}.{axis}" for tag in self.others for axis in axes]
        return (*names, "imu.turn_x", "imu.turn_y", "imu.turn_z", "depth.offset", "centre.x", "centre.y")

    def mount(self, tag: int, reference: int) -> Pose:
        """A tag in the body."""
        return self.reference if tag == reference else self.reference.then(self.others[tag])


def moved(state: MountState, shared: Array, own: Sequence[Array]) -> MountState:
    """After a step of the shared unknowns, in the order of `names`, and of each moment's pose."""
    tail = 6 + 6 * len(state.others)
    return replace(
        state,
        reference=state.reference.stepped(shared[:6]),
        others={
            tag: pose.stepped(shared[6 + 6 * i : 12 + 6 * i])
            for i, (tag, pose) in enumerate(state.others.items())
        },
        poses=[pose.stepped(step) for pose, step in zip(state.poses, own, strict=True)],
        imu_turn=quat_to_matrix(quat_from_rotvec(shared[tail : tail + 3])) @ state.imu_turn,
        depth_offset=state.depth_offset + float(shared[tail + 3]),
        centre=state.centre + shared[tail + 4 :],
    )


def corner_points(rig: Rig, state: MountState, moments: Sequence[Moment]) -> Array:
    """Corners of all tags of all moments in the pool, tags in each moment's order, (n, 4, 3)."""
    mounts = {
        tag: state.mount(tag, rig.reference).at(rig.corners_t) for tag in (rig.reference, *state.others)
    }
    return np.array(
        [pose.at(mounts[tag]) for pose, m in zip(state.poses, moments, strict=True) for tag in m.corners]
    )


def residuals(
    rig: Rig, state: MountState, moments: Sequence[Moment], noise: Noise
) -> tuple[Array, NDArray[np.int64], list[Array]]:
    """Measured less predicted corners [px] (n, 4, 2), NaN out of sight, their moments (n,), and the whitened rest."""
    seen = np.array([pixels for m in moments for pixels in m.corners.values()])
    owner = np.repeat(np.arange(len(moments)), [len(m.corners) for m in moments])
    predicted = project(rig.pool.camera, rig.pool.interface, corner_points(rig, state, moments)).pixels
    rest = [
        np.concatenate([*(r for _, _, r in _others(rig, state, pose, m, noise)), np.zeros(0)])
        for pose, m in zip(state.poses, moments, strict=True)
    ]
    return seen - predicted, owner, rest


def moment_blocks(rig: Rig, state: MountState, moments: Sequence[Moment], noise: Noise) -> list[Block]:
    """Weighted normal equations of every moment, shared unknowns in the order of `MountState.names`."""
    pixels, _, _ = residuals(rig, state, moments, noise)
    J = projection_jacobians(rig.pool.camera, rig.pool.interface, corner_points(rig, state, moments)).point
    distance = np.linalg.norm(pixels, axis=-1) / noise.pixel
    root = np.sqrt(np.minimum(1.0, HUBER / np.maximum(distance, 1e-9)))[..., None] / noise.pixel
    keys, count, k, blocks = list(state.others), len(state.names), 0, []
    for pose, moment in zip(state.poses, moments, strict=True):
        shared, own, residual = [], [], []
        for tag in moment.corners:
            A, B = _corner_rows(rig, state, pose, tag, keys, J[k])
            shared.append((root[k][..., None] * A).reshape(-1, count))
            own.append((root[k][..., None] * B).reshape(-1, 6))
            residual.append((root[k] * pixels[k]).ravel())
            k += 1
        for A, B, r in _others(rig, state, pose, moment, noise):
            shared.append(A)
            own.append(B)
            residual.append(r)
        blocks.append(block_of(np.concatenate(shared), np.concatenate(own), np.concatenate(residual)))
    return blocks


def _corner_rows(
    rig: Rig, state: MountState, pose: Pose, tag: int, keys: Sequence[int], J: Array
) -> tuple[Array, Array]:
    """Derivatives of a tag's pixels with respect to the shared unknowns (4, 2, P) and the pose (4, 2, 6), from those
    with respect to its corners in the pool, J (4, 2, 3)."""
    in_reference = rig.corners_t if tag == rig.reference else state.others[tag].at(rig.corners_t)
    in_body = state.reference.at(in_reference)
    own = np.concatenate([-J @ skew(in_body @ pose.R.T), J], axis=-1)
    A = np.zeros((4, 2, len(state.names)))
    J_b = J @ pose.R
    A[..., 0:3] = -J_b @ skew(in_reference @ state.reference.R.T)
    A[..., 3:6] = J_b
    if tag != rig.reference:
        J_r, start = J_b @ state.reference.R, 6 + 6 * keys.index(tag)
        A[..., start : start + 3] = -J_r @ skew(rig.corners_t @ state.others[tag].R.T)
        A[..., start + 3 : start + 6] = J_r
    return A, own


def _others(
    rig: Rig, state: MountState, pose: Pose, moment: Moment, noise: Noise
) -> list[tuple[Array, Array, Array]]:
    """Whitened rows of IMU, depth and centre: shared, own, residual."""
    up_p = rig.pool.interface.normal
    tail, count = 6 + 6 * len(state.others), len(state.names)
    rows = []
    if moment.up is not None:
        felt = state.imu_turn @ moment.up
        A, B = np.zeros((3, count)), np.zeros((3, 6))
        A[:, tail : tail + 3] = skew(felt)
        B[:, :3] = pose.R.T @ skew(up_p)
        rows.append((A / noise.up, B / noise.up, (felt - pose.R.T @ up_p) / noise.up))
    if moment.depth is not None:
        arm = pose.R @ rig.port
        predicted = -(up_p @ (pose.t + arm) + rig.pool.interface.offset) + state.depth_offset
        A, B = np.zeros((1, count)), np.zeros((1, 6))
        A[0, tail + 3] = 1.0
        B[0, :3], B[0, 3:] = up_p @ skew(arm), -up_p
        rows.append((A / noise.depth, B / noise.depth, np.array([moment.depth - predicted]) / noise.depth))
    if rig.centre is not None:
        arm = pose.R @ rig.centre
        A, B = np.zeros((2, count)), np.zeros((2, 6))
        A[:, tail + 4 :] = -np.eye(2)
        B[:, :3], B[:, 3:] = -skew(arm)[:2], np.eye(3)[:2]
        rows.append((A / noise.centre, B / noise.centre, (state.centre - (pose.t + arm)[:2]) / noise.centre))
    return rows
