"""A dock's section as a polygon in (along the axis, away from it), and how deep points are in it; float64."""

import numpy as np

from reference.body import rotation


def section(dock):
    """Corners of the block's section, (7, 2), from the mouth's inner edge through the bore and around."""
    c, d, b = dock.cone_length, dock.tube_length, dock.rim
    outer = dock.mouth_radius + dock.rim
    return np.array(
        [
            (-c, dock.mouth_radius),
            (0.0, dock.throat_radius),
            (d, dock.throat_radius),
            (d, 0.0),
            (d + b, 0.0),
            (d + b, outer),
            (-c, outer),
        ]
    )


def depth_in(dock, points):
    """Distance of points, dock axes (..., 3), to the block's surface where they are inside, else 0, (...)."""
    corners = section(dock)
    p = np.stack([points[..., 0], np.hypot(points[..., 1], points[..., 2])], axis=-1)
    inside, nearest = np.zeros(p.shape[:-1], bool), np.full(p.shape[:-1], np.inf)
    for i, (a, b) in enumerate(zip(corners, np.roll(corners, -1, axis=0), strict=True)):
        # Even-odd rule along the ray of growing x.
        crosses = (a[1] > p[..., 1]) != (b[1] > p[..., 1])
        with np.errstate(divide="ignore", invalid="ignore"):
            at = a[0] + (p[..., 1] - a[1]) / (b[1] - a[1]) * (b[0] - a[0])
        inside ^= crosses & (at > p[..., 0])
        if i != 3:  # the piece on the axis is no surface
            t = np.clip(((p - a) @ (b - a)) / ((b - a) @ (b - a)), 0.0, 1.0)
            nearest = np.minimum(nearest, np.linalg.norm(p - a - t[..., None] * (b - a), axis=-1))
    return np.where(inside, nearest, 0.0)


def hull_points(half):
    """Nose and the corners of five sections, body frame, (21, 3)."""
    corners = [(a, sy, sz) for a in (1.0, 0.5, 0.0, -0.5, -1.0) for sy in (1, -1) for sz in (1, -1)]
    return np.array([(1.0, 0.0, 0.0), *corners]) * half


def deepest(dock, position, quaternion, half):
    """Depth of the deepest hull point of vehicles at poses in a dock at the world's origin, (n, 3), (n, 4) -> (n,)."""
    R = np.stack([rotation(q) for q in np.asarray(quaternion, float)])
    points = position[:, None] + np.einsum("nij,kj->nki", R, hull_points(half))
    return depth_in(dock, points).max(axis=1)
