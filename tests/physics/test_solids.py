"""Distances of solids against closed forms, numerical gradients, and each other."""

import numpy as np
import pytest
import warp as wp

from finssim.physics.solids import (
    Solids,
    ball_distance,
    box_distance,
    cylinder_distance,
    heightfield_depth,
    hull_sphere,
    spheres_along,
)

HALF = np.array([0.5, 0.3, 0.2])


def wide(x):
    return np.array([float(a) for a in x])


def box(x):
    return wide(box_distance(wp.vec3(*x), wp.vec3(*HALF)))


def post(x):
    return wide(cylinder_distance(wp.vec3(*x), 0.4, 0.7))


def ball(x):
    return wide(ball_distance(wp.vec3(*x), 0.4))


def points(n=60):
    """Return points inside and around, away from the faces where gradients jump."""
    return np.random.default_rng(0).uniform(-1.2, 1.2, (n, 3))


def nearest_on_box(x):
    """Return the distance to the nearest of six faces inside, or of a clamped point outside; float64."""
    if (np.abs(x) < HALF).all():
        return -(HALF - np.abs(x)).min()
    return np.linalg.norm(x - np.clip(x, -HALF, HALF))


def nearest_on_post(x):
    r = np.hypot(x[0], x[1])
    inside = min(0.4 - r, 0.7 - abs(x[2]))
    return -inside if inside > 0.0 else np.hypot(max(r - 0.4, 0.0), max(abs(x[2]) - 0.7, 0.0))


@pytest.mark.parametrize(
    ("distance", "closed_form"),
    [(box, nearest_on_box), (post, nearest_on_post), (ball, lambda x: np.linalg.norm(x) - 0.4)],
)
def test_distances_are_the_closed_forms_and_normals_their_gradients(distance, closed_form):
    h = 1e-4
    for x in points():
        face = distance(x)
        assert face[3] == pytest.approx(closed_form(x), abs=2e-6)
        slopes = [(closed_form(x + h * e) - closed_form(x - h * e)) / (2.0 * h) for e in np.eye(3)]
        if abs(np.linalg.norm(slopes) - 1.0) < 1e-4:  # elsewhere a ridge lies between the two
            np.testing.assert_allclose(face[:3], slopes, atol=2e-3)


def test_a_heightfield_pushes_with_the_gradient_of_its_spring():
    """depth · normal is the gradient of half the square of h - z, and h is the ray caster's: two triangles a cell."""
    heights = np.random.default_rng(1).uniform(-0.2, 0.2, (4, 5)).astype(np.float32)
    field = Solids()
    field.heights, field.gentle = wp.array(heights, dtype=float), 0.5
    size, found = np.array([2.0, 1.5, 0.0]), []

    @wp.kernel(enable_backward=False, module="unique")
    def depths(field: Solids, x: wp.array(dtype=wp.vec3), out: wp.array(dtype=wp.vec4)):
        i = wp.tid()
        out[i] = heightfield_depth(field, wp.vec3(2.0, 1.5, 0.0), x[i], 0.1)

    def surface(x, y):
        u, v = (x + 2.0) / 1.0, (y + 1.5) / 1.0
        i, j = int(u), int(v)
        fx, fy = u - i, v - j
        low, high = heights[j, i], heights[j + 1, i + 1]
        if fx >= fy:
            return low + fx * (heights[j, i + 1] - low) + fy * (high - heights[j, i + 1])
        return low + fy * (heights[j + 1, i] - low) + fx * (high - heights[j + 1, i])

    where = np.random.default_rng(2).uniform(-0.95, 0.95, (50, 3)) * [size[0], size[1], 0.5]
    out = wp.zeros(50, dtype=wp.vec4)
    wp.launch(depths, 50, [field, wp.array(np.float32(where), dtype=wp.vec3), out])
    for x, face in zip(where, out.numpy().astype(float), strict=True):

        def deep(p):
            return surface(p[0], p[1]) + 0.1 - p[2]

        assert np.linalg.norm(face[:3]) == pytest.approx(1.0, abs=1e-5)
        if deep(x) <= 0.0:
            assert face[3] <= 0.0 and face[3] == pytest.approx(0.5 * deep(x), abs=1e-5)
            continue
        h = 1e-5
        spring = [-(deep(x + h * e) ** 2 - deep(x - h * e) ** 2) / (4.0 * h) for e in np.eye(3)]
        found.append(np.abs(face[3] * face[:3] - spring).max())
    # A diagonal may lie between the two points of a difference.
    assert len(found) > 20 and np.median(found) < 1e-4


@pytest.mark.parametrize("half", [(0.28, 0.21, 0.125), (1.1, 0.1, 0.1), (1.3, 0.75, 0.8), (0.2, 0.2, 0.2)])
def test_spheres_of_a_hull_lie_within_it_and_leave_no_room_between(half):
    """Inside by a tenth of the least half extent; at most 8 in a row, fewer if they are less than 1.5 radii apart."""
    least, size = min(half), wp.vec3(*half)
    counts = [spheres_along(float(h), least) for h in half]
    spheres = np.array([wide(hull_sphere(8 + i, size)) for i in range(int(np.prod(counts)))])
    centre, radius = spheres[:, :3], spheres[:, 3]
    np.testing.assert_allclose(radius, 0.9 * least, rtol=1e-6)
    inset = np.array(half) - np.abs(centre).max(axis=0) - radius[0]
    np.testing.assert_allclose(inset, np.full(3, 0.1 * least), atol=1e-6)
    for axis, n in enumerate(counts):
        places = np.unique(np.round(centre[:, axis], 5))
        assert len(places) == n and (n in (1, 8) or np.diff(places).max() < 1.5 * radius[0])
    corners = np.array([wide(hull_sphere(i, size)) for i in range(8)])
    np.testing.assert_allclose(np.sort(np.abs(corners[:, :3]), axis=0), np.tile(half, (8, 1)), rtol=1e-6)
