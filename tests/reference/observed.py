"""Observations of T1 and T2, as published, implemented a second time with SciPy's rotations."""

import numpy as np
from scipy.spatial.transform import Rotation

from finssim.core.rotations import quat_from_yaw


def published_t1(measured, guide, t=0.0):
    """Return the 16 numbers of T1."""
    R, goal = Rotation.from_quat(measured.quaternion).inv(), guide.at(t)
    offset = R.apply(goal.position - measured.position) / 3.0
    turned = (R * Rotation.from_quat(quat_from_yaw(goal.yaw))).as_matrix()
    nu = np.clip(measured.nu, -2.0, 2.0)
    return np.array([*offset, *turned[:, 0], *turned[:, 1], *nu, min(np.linalg.norm(offset), 1.0)])


def published_t2(measured, guide, t):
    """Return the 30 numbers of T2."""
    R = Rotation.from_quat(measured.quaternion).inv()
    offsets = [R.apply(guide.at(t + k).position - measured.position) / 3.0 for k in (0.0, 0.1, 0.2, 0.3)]
    now = guide.at(t)
    v = R.apply(now.velocity)
    psi = np.arctan2(v[1], v[0]) if np.hypot(v[0], v[1]) > 1e-6 else 0.0
    s = 2 * np.pi * now.progress
    turns = [np.sin(s), np.cos(s), np.sin(2 * s), np.cos(2 * s)]
    nu = np.clip(measured.nu, -2.0, 2.0)
    return np.array([*np.ravel(offsets), *v, *nu, *R.apply([0, 0, 1]), np.sin(psi), np.cos(psi), *turns])
