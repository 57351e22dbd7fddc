"""Rotations agree with SciPy, invert exactly, and have the signs of the conventions."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from finssim.core.rotations import (
    cross,
    matrix_to_quat,
    quat_conjugate,
    quat_from_euler,
    quat_from_rotvec,
    quat_from_yaw,
    quat_inverse_rotate,
    quat_multiply,
    quat_rotate,
    quat_to_euler,
    quat_to_matrix,
    quat_to_rotvec,
    quat_yaw,
    skew,
    wrap_angle,
)

X, Y, Z = np.eye(3)
RANDOM = Rotation.random(200, random_state=0)
Q = RANDOM.as_quat()
VECTORS = np.random.default_rng(0).normal(size=(200, 3))


def up_to_sign(q):
    return q * np.sign(q[..., 3:])


def test_products_and_matrices_agree_with_scipy():
    other = Rotation.random(200, random_state=1)
    np.testing.assert_allclose(quat_to_matrix(Q), RANDOM.as_matrix(), atol=1e-14)
    product = quat_multiply(Q, other.as_quat())
    np.testing.assert_allclose(up_to_sign(product), up_to_sign((RANDOM * other).as_quat()), atol=1e-14)
    np.testing.assert_allclose(quat_rotate(Q, VECTORS), RANDOM.apply(VECTORS), atol=1e-14)
    np.testing.assert_allclose(quat_inverse_rotate(Q, VECTORS), RANDOM.inv().apply(VECTORS), atol=1e-14)


def test_cross_is_numpys_to_the_last_digit():
    """The cross product equals NumPy's for one pair, for many, and for shapes that broadcast."""
    other = np.roll(VECTORS, 1, axis=0)
    assert np.array_equal(cross(VECTORS, other), np.cross(VECTORS, other))
    assert np.array_equal(cross(X, VECTORS[:5, None]), np.cross(X, VECTORS[:5, None]))
    assert np.array_equal(cross(X, Y), Z)


def test_euler_angles_agree_with_scipy():
    roll, pitch, yaw = quat_to_euler(Q)
    np.testing.assert_allclose(np.stack([yaw, pitch, roll], -1), RANDOM.as_euler("ZYX"), atol=1e-12)
    np.testing.assert_allclose(up_to_sign(quat_from_euler(roll, pitch, yaw)), up_to_sign(Q), atol=1e-12)


def test_matrices_come_back_as_the_same_quaternion():
    """A quaternion survives conversion to a matrix and back, half turns with w = 0 included."""
    half_turns = np.array([[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0], [0.6, 0.8, 0, 0], [0, 0, 0, 1.0]])
    np.testing.assert_allclose(matrix_to_quat(quat_to_matrix(half_turns)), half_turns, atol=1e-15)
    np.testing.assert_allclose(matrix_to_quat(RANDOM.as_matrix()), up_to_sign(Q), atol=1e-14)


def test_rotation_vectors_agree_with_scipy():
    np.testing.assert_allclose(quat_to_rotvec(Q), RANDOM.as_rotvec(), atol=1e-13)
    np.testing.assert_allclose(up_to_sign(quat_from_rotvec(RANDOM.as_rotvec())), up_to_sign(Q), atol=1e-14)


@given(arrays(float, 3, elements=st.floats(-1.8, 1.8)))
def test_rotation_vectors_shorter_than_half_a_turn_come_back(rotvec):
    np.testing.assert_allclose(quat_to_rotvec(quat_from_rotvec(rotvec)), rotvec, atol=1e-12)


def test_zero_rotation_is_exact():
    np.testing.assert_array_equal(quat_from_rotvec(np.zeros(3)), [0, 0, 0, 1])
    np.testing.assert_array_equal(quat_to_rotvec([0.0, 0, 0, 1]), np.zeros(3))


def test_a_quaternion_times_its_conjugate_is_no_rotation():
    np.testing.assert_allclose(
        quat_multiply(Q, quat_conjugate(Q)), np.tile([0, 0, 0, 1.0], (200, 1)), atol=1e-15
    )


def test_positive_yaw_turns_left_and_positive_pitch_lowers_the_nose():
    """With x forward, y left and z up, positive rotation about up turns left, about left lowers the nose, and about
    forward raises the left side."""
    quarter = np.pi / 2
    np.testing.assert_allclose(quat_rotate(quat_from_yaw(quarter), X), Y, atol=1e-15)
    np.testing.assert_allclose(quat_rotate(quat_from_euler(0, quarter, 0), X), -Z, atol=1e-15)
    np.testing.assert_allclose(quat_rotate(quat_from_euler(quarter, 0, 0), Y), Z, atol=1e-15)
    assert quat_yaw(quat_from_euler(0.2, -0.3, 1.1)) == pytest.approx(1.1)


@given(st.floats(-1e3, 1e3))
def test_wrapped_angles_lie_in_one_turn_and_point_the_same_way(angle):
    wrapped = wrap_angle(angle)
    assert -np.pi <= wrapped < np.pi
    np.testing.assert_allclose([np.cos(wrapped), np.sin(wrapped)], [np.cos(angle), np.sin(angle)], atol=1e-9)


def test_skew_is_the_cross_product():
    a, b = VECTORS, VECTORS[::-1]
    np.testing.assert_allclose(np.einsum("nij,nj->ni", skew(a), b), np.cross(a, b), atol=1e-15)


def test_batches_of_any_shape_equal_single_calls():
    grid = Q.reshape(10, 20, 4)
    for function in (quat_to_matrix, quat_to_rotvec, quat_yaw, quat_conjugate):
        np.testing.assert_array_equal(function(grid)[3, 7], function(grid[3, 7]))
    assert quat_from_euler(np.zeros((4, 1)), 0.1, np.zeros(5)).shape == (4, 5, 4)


@pytest.mark.parametrize("scale", [0.0, 1e-9, 1e-3, 1.0, 6.0])
def test_one_is_as_one_of_many(scale):
    """Plain numbers of one rotation and columns of a batch use the same formulas, so they agree to rounding."""
    v, w = scale * np.random.default_rng(11).standard_normal((2, 7, 3))
    q, r = quat_from_rotvec(v), quat_from_rotvec(w)
    for function, arguments in (
        (quat_from_rotvec, (v,)),
        (skew, (v,)),
        (cross, (v, w)),
        (quat_multiply, (q, r)),
        (quat_rotate, (q, v)),
        (quat_to_matrix, (q,)),
        (quat_from_yaw, (v[:, 0],)),
    ):
        many = function(*arguments)
        for i in range(7):
            np.testing.assert_allclose(function(*(a[i] for a in arguments)), many[i], rtol=1e-14, atol=1e-15)
