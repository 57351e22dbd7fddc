"""Walls push, never pull, and dissipate energy."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from finssim.physics.contact import contact_wrench, wall_force
from finssim.physics.types import vec6
from finssim.sim import RectangularPool, SurroundingsError
from reference.body import rotation
from reference.cases import random_attitudes

WALLS = RectangularPool(length=4.0, width=2.0, depth=1.0).walls()
HALF = np.array([0.28, 0.21, 0.125])
velocities = arrays(np.float32, 3, elements=st.floats(-2.0, 2.0, width=32))
normals = st.sampled_from([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1)])


def wide(x):
    return np.array([float(a) for a in x])


@given(penetration=st.floats(1e-6, 0.05), v=velocities, n=normals)
def test_a_wall_pushes_and_damps(penetration, v, n):
    """The normal force is at least the spring's, the remainder dissipates power; friction is at most μ N."""
    force = wide(wall_force(penetration, wp.vec3(*v), wp.vec3(*map(float, n)), WALLS))
    normal = force @ n
    assert normal >= WALLS.stiffness * penetration * (1 - 1e-6)
    rest = force - WALLS.stiffness * penetration * np.array(n)
    assert rest @ v <= 1e-5 * normal
    assert np.linalg.norm(force - normal * np.array(n)) <= WALLS.friction * normal * (1 + 1e-5)


@given(v=velocities, n=normals, gap=st.floats(0.0, 1.0))
def test_no_wall_acts_at_a_distance(v, n, gap):
    """Without penetration there is no force."""
    assert wide(wall_force(-gap, wp.vec3(*v), wp.vec3(*map(float, n)), WALLS)).tolist() == [0.0, 0.0, 0.0]


def corner_wrench(position, q, nu):
    """Return the sum over corners and walls, written out in the world frame in float64."""
    R = rotation(q)
    total = np.zeros(6)
    planes = [((0, 0, 1), -1.0), ((-1, 0, 0), -2.0), ((1, 0, 0), -2.0), ((0, -1, 0), -1.0), ((0, 1, 0), -1.0)]
    for signs in np.array(np.meshgrid([1, -1], [1, -1], [1, -1])).T.reshape(-1, 3):
        r = signs * HALF
        x, v = position + R @ r, R @ (nu[:3] + np.cross(nu[3:], r))
        for normal, offset in planes:
            penetration = offset - np.dot(normal, x)
            if penetration > 0.0:
                v_n = v @ normal
                N = WALLS.stiffness * penetration + WALLS.damping * max(-v_n, 0.0)
                v_t = v - v_n * np.array(normal)
                force = N * np.array(normal) - WALLS.friction * N * v_t / max(np.linalg.norm(v_t), 0.01)
                total += np.r_[R.T @ force, np.cross(r, R.T @ force)]
    return total


def test_contact_is_the_sum_over_corners_and_walls():
    """Random poses at every wall, in two walls and on the floor: as written out, to float32 penetrations."""
    rng = np.random.default_rng(4)
    touched = 0
    for q in random_attitudes(rng, 60):
        position = rng.uniform([-2.1, -1.1, -1.1], [2.1, 1.1, 0.0]).astype(np.float32)
        nu = rng.normal(size=6).astype(np.float32)
        found = wide(contact_wrench(WALLS, wp.vec3(*position), wp.quat(*q), vec6(*nu), wp.vec3(*HALF)))
        expected = corner_wrench(position.astype(float), q.astype(float), nu.astype(float))
        touched += bool(expected.any())
        assert found == pytest.approx(expected, abs=4000.0 * 5e-7 * 30 + 1e-5 * np.abs(expected).max())
    assert touched > 20


def test_pools_that_cannot_be_are_refused():
    """A pool without size and walls that pull are refused."""
    with pytest.raises(SurroundingsError, match="pool: length, width and depth must exceed 0 m"):
        RectangularPool(depth=0.0)
    with pytest.raises(SurroundingsError, match="pool: wall coefficients must not be negative"):
        RectangularPool(stiffness=-1.0)
