"""The funnel's surface, against the polygon of its section."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from finssim.physics.funnel import HULL_POINTS, Funnel, funnel_depth, hull_point
from finssim.sim import Dock, SurroundingsError
from reference.dock import depth_in, hull_points, section

DOCK = Dock(
    mouth_radius=0.5,
    throat_radius=0.3,
    cone_length=0.28,
    tube_length=0.3,
    rim=0.12,
    stiffness=5000.0,
    damping=100.0,
)
OUTER, BACK = DOCK.mouth_radius + DOCK.rim, DOCK.rim


@wp.kernel
def depths(funnel: Funnel, x: wp.array(dtype=wp.vec3), out: wp.array(dtype=wp.vec4)):
    out[wp.tid()] = funnel_depth(funnel, x[wp.tid()])


def found(points):
    """Return normals and depths of points in dock axes, (n, 3) and (n,)."""
    x = wp.array(np.asarray(points, np.float32), dtype=wp.vec3, device="cpu")
    out = wp.zeros(len(points), dtype=wp.vec4, device="cpu")
    wp.launch(depths, len(points), [DOCK.struct(1, 1, wp.get_device("cpu")), x, out], device="cpu")
    return out.numpy()[:, :3].astype(float), out.numpy()[:, 3].astype(float)


def sample(n=20000):
    return np.random.default_rng(0).uniform([-0.5, -0.8, -0.8], [0.6, 0.8, 0.8], (n, 3)).astype(np.float32)


def test_a_point_is_as_deep_as_it_is_far_from_the_surface():
    """Inside the block depth is the distance to the nearest face; outside and in the bore it is zero."""
    points = sample()
    expected = depth_in(DOCK, points.astype(float))
    assert 0.2 < np.mean(expected > 0.0) < 0.8
    np.testing.assert_allclose(found(points)[1], expected, atol=2e-6)


def test_the_normal_leads_out():
    """It is a unit vector, and the surface lies along it at the depth."""
    points = sample()
    n, depth = found(points)
    inside = depth > 1e-4
    np.testing.assert_allclose(np.linalg.norm(n[inside], axis=1), 1.0, atol=1e-5)
    moved = points[inside] + (depth[inside] * 1.0001)[:, None] * n[inside]
    assert depth_in(DOCK, moved).max() < 1e-5
    assert not n[depth == 0.0].any()


@pytest.mark.parametrize("turn", [0.3, 1.7, 4.0])
def test_the_surface_is_one_of_revolution(turn):
    """Rotating a point about the axis keeps its depth and rotates its normal."""
    points = sample(500)
    c, s = np.cos(turn), np.sin(turn)
    R = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    n, depth = found(points)
    turned_n, turned_depth = found(points @ R.T)
    np.testing.assert_allclose(turned_depth, depth, atol=1e-6)
    np.testing.assert_allclose(turned_n, n @ R.T, atol=2e-3)


def test_the_hull_has_a_nose_and_twenty_corners():
    half = np.array([0.28, 0.21, 0.125])
    points = np.array([list(hull_point(i, wp.vec3(*half))) for i in range(HULL_POINTS)])
    np.testing.assert_allclose(
        points[np.lexsort(points.T)], hull_points(half)[np.lexsort(hull_points(half).T)], atol=1e-7
    )


def test_the_section_is_the_one_described():
    """Its corners are those of the reference: mouth, throat, end, and a rim around them."""
    assert section(DOCK)[:, 0].max() == DOCK.tube_length + BACK and section(DOCK)[:, 1].max() == OUTER


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"mouth_radius": 0.2}, "mouth_radius 0.2 m, expected more than throat_radius 0.3 m"),
        ({"stiffness": 0.0}, "stiffness is 0.0, expected a finite number above 0"),
        ({"damping": -1.0}, "damping is -1.0, expected a finite number of 0 or more"),
        ({"tube_length": float("nan")}, "tube_length is nan"),
    ],
)
def test_a_dock_that_cannot_be_is_refused(change, sentence):
    with pytest.raises(SurroundingsError, match=sentence):
        replace(DOCK, **change)
