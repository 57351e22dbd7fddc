"""Attitude and position kinematics against rotation matrices."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from finssim.physics.kinematics import point_velocity, position_rate, quaternion_rate, rotate_by, up_in_body
from finssim.physics.types import vec6
from reference.body import rotation

EPS = float(np.finfo(np.float32).eps)
numbers = st.floats(-5.0, 5.0, width=32)
quaternions = (
    arrays(np.float64, 4, elements=st.floats(-1.0, 1.0)).filter(lambda q: np.linalg.norm(q) > 0.1).map(
        lambda q: (q / np.linalg.norm(q)).astype(np.float32)
    )
)  # fmt: skip
rates = arrays(np.float32, 3, elements=numbers)


def wide(x):
    return np.array([float(a) for a in x])


@given(q=quaternions, omega=rates, h=st.floats(1e-4, 0.5))
def test_a_constant_rate_turns_about_its_axis_by_its_angle(q, omega, h):
    """rotate_by(q, ω, h) = R(q) exp(S(ω h)) for steps from 0 to more than half a turn."""
    found = wide(rotate_by(wp.quat(*q), wp.vec3(*omega), h))
    expected = rotation(q) @ Rotation.from_rotvec(omega.astype(float) * h).as_matrix()
    assert rotation(found) == pytest.approx(expected, abs=30.0 * EPS)
    assert np.linalg.norm(found) == pytest.approx(1.0, abs=8.0 * EPS)


@given(q=quaternions, omega=rates)
def test_quaternion_rate_is_the_derivative_of_the_turn(q, omega):
    """q_dot = d/dh rotate_by(q, ω, h) at h = 0: central difference with h = 1e-2, remainder h²|ω|³/48."""
    h = 1e-2
    ahead, behind = (wide(rotate_by(wp.quat(*q), wp.vec3(*omega), x)) for x in (h, -h))
    length = np.linalg.norm(omega.astype(float))
    tolerance = h**2 * length**3 / 48.0 + 8.0 * EPS / h
    assert wide(quaternion_rate(wp.quat(*q), wp.vec3(*omega))) == pytest.approx(
        (ahead - behind) / (2 * h), abs=tolerance
    )


@pytest.mark.slow
@given(q=quaternions, velocity=arrays(np.float32, 6, elements=numbers))
def test_position_rate_is_the_velocity_in_the_world_frame(q, velocity):
    """x_dot = R(q) v."""
    found = wide(position_rate(wp.quat(*q), vec6(*velocity)))
    assert found == pytest.approx(rotation(q) @ velocity[:3].astype(float), abs=20.0 * EPS * 5.0)


@given(q=quaternions)
def test_up_in_body_is_the_last_row_of_the_rotation_matrix(q):
    """R(q)ᵀ e_z."""
    assert wide(up_in_body(wp.quat(*q))) == pytest.approx(rotation(q)[2], abs=8.0 * EPS)


def test_turning_left_moves_the_nose_to_port():
    """ω = +z: a point 1 m ahead moves towards +y."""
    assert wide(point_velocity(vec6(0.0, 0.0, 0.0, 0.0, 0.0, 2.0), wp.vec3(1.0, 0.0, 0.0))) == pytest.approx(
        [0, 2, 0]
    )
