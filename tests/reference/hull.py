"""Drag and displacement of a triangle mesh cut by a plane: corners sorted by height, the dry tip removed."""

import numpy as np


def wet_triangles(corners, normal, height):
    """Return area and centroid of the part of each triangle below a plane.

    Args:
        corners: Corners (m, 3, 3), body frame.
        normal: Upward unit normal of the plane, body frame (n, 3).
        height: Height of the body origin above the plane (n,).

    Returns:
        Areas (n, m) and centroids (n, m, 3), body frame.
    """
    h = height[:, None, None] + np.einsum("mci,ni->nmc", corners, normal)
    order = np.argsort(h, axis=-1)
    h = np.take_along_axis(h, order, -1)
    P = np.take_along_axis(np.broadcast_to(corners, (*h.shape, 3)), order[..., None], -2)
    a, b, c = P[..., 0, :], P[..., 1, :], P[..., 2, :]  # lowest to highest
    h_a, h_b, h_c = h[..., 0], h[..., 1], h[..., 2]
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=-1)
    middle = P.mean(axis=-2)

    def tip(apex, p, q, h_apex, h_p, h_q):
        with np.errstate(divide="ignore", invalid="ignore"):
            s = np.where(h_p != h_apex, h_apex / (h_apex - h_p), 0.0)
            t = np.where(h_q != h_apex, h_apex / (h_apex - h_q), 0.0)
        edge_p, edge_q = apex + s[..., None] * (p - apex), apex + t[..., None] * (q - apex)
        return s * t * area, (apex + edge_p + edge_q) / 3.0

    low_area, low_middle = tip(a, b, c, h_a, h_b, h_c)
    top_area, top_middle = tip(c, b, a, h_c, h_b, h_a)
    rest = area - top_area
    with np.errstate(divide="ignore", invalid="ignore"):
        rest_middle = (area[..., None] * middle - top_area[..., None] * top_middle) / rest[..., None]
    wet = np.select([h_c <= 0.0, h_a >= 0.0, h_b >= 0.0], [area, 0.0 * area, low_area], rest)
    one = (h_b >= 0.0)[..., None]
    center = np.where((h_c <= 0.0)[..., None], middle, np.where(one, low_middle, rest_middle))
    return wet, np.where(wet[..., None] > 0.0, center, 0.0)


def unsigned_cross(a, b):
    """Return a × b with its differences made sums: a bound for the rounding of a cross product of magnitudes."""
    return a[..., [1, 2, 0]] * b[..., [2, 0, 1]] + a[..., [2, 0, 1]] * b[..., [1, 2, 0]]


def outward_normals(corners):
    """Return unit normals (m, 3) of counter-clockwise triangles."""
    n = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return n / np.linalg.norm(n, axis=-1, keepdims=True)


def displacement(corners, normal, height):
    """Return volume (n,) and its centroid (n, 3) below the plane, as pyramids over the wet parts of the faces.

    The apex is the plane's point nearest to the body origin: the lid in the plane has no height over it.
    """
    area, middle = wet_triangles(corners, normal, height)
    n = outward_normals(corners)
    apex = -height[:, None] * normal
    arm = middle - apex[:, None]
    pyramid = area * np.einsum("mi,nmi->nm", n, arm) / 3.0
    volume = pyramid.sum(axis=1)
    moment = 0.75 * np.einsum("nm,nmi->ni", pyramid, arm)
    with np.errstate(divide="ignore", invalid="ignore"):
        center = apex + moment / volume[:, None]
    return volume, np.where((volume > 0.0)[:, None], center, 0.0)


def drag(corners, normal, height, nu, water_b, gradient_b, density, form, skin):
    """Return form and skin drag of the wet parts about the body origin (n, 6), and the sum of magnitudes (n, 6).

    dF = ½ρ A (C_form [-cos]_+ |v|² v̂ + C_skin |v_t| v_t), v the water past the wet part's centroid      (paper, eq. 4)
    """
    area, c = wet_triangles(corners, normal, height)
    n = outward_normals(corners)
    turning = np.cross(np.broadcast_to(nu[:, None, 3:], c.shape), c)
    v = (water_b - nu[:, :3])[:, None] + np.einsum("nij,nmj->nmi", gradient_b, c) - turning
    speed = np.linalg.norm(v, axis=-1)
    across = np.einsum("mi,nmi->nm", n, v)
    with np.errstate(divide="ignore", invalid="ignore"):
        incidence = np.where(speed > 0.0, across / speed, 0.0)
    v_t = v - across[..., None] * n
    pressure = form * np.maximum(-incidence, 0.0) * speed
    rubbing = skin * np.linalg.norm(v_t, axis=-1)
    force = 0.5 * density * area[..., None] * (pressure[..., None] * v + rubbing[..., None] * v_t)
    wrench = np.concatenate([force, np.cross(c, force)], axis=-1)
    size = np.concatenate([np.abs(force), unsigned_cross(np.abs(c), np.abs(force))], axis=-1)
    return wrench.sum(axis=1), size.sum(axis=1)
