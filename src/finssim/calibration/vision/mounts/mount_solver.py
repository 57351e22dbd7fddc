"""Least squares over mounts and moments, in those unknowns that are left free."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from finssim.calibration.vision.mounts.arrow import Block, arrow_step
from finssim.calibration.vision.mounts.mount_model import (
    HUBER,
    Moment,
    MountState,
    Noise,
    Rig,
    moment_blocks,
    moved,
    residuals,
)
from finssim.geometry.rotations import matrix_to_quat, quat_to_rotvec

__all__ = ["as_before", "change", "minimise", "restricted"]

Array = NDArray[np.float64]

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
