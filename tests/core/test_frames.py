"""Every change of convention is invertible, and known motions have the signs of each convention."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from finssim.core.frames import (
    FROM_CONTROLLER,
    FROM_FOSSEN,
    FROM_OPTICAL,
    TO_CONTROLLER,
    TO_FOSSEN,
    TO_OPTICAL,
    camera_from_optical,
    optical_from_camera,
    wxyz_from_xyzw,
)
from finssim.core.rotations import quat_from_euler, quat_rotate, quat_to_matrix

X, Y, Z = np.eye(3)
PAIRS = [(TO_FOSSEN, FROM_FOSSEN), (TO_CONTROLLER, FROM_CONTROLLER), (TO_OPTICAL, FROM_OPTICAL)]
RNG = np.random.default_rng(0)
V = RNG.normal(size=(5, 3))
TWIST = RNG.normal(size=(5, 6))
Q = Rotation.random(5, random_state=0).as_quat()
R = Rotation.random(5, random_state=0).as_matrix()

NOSE_UP = -Y
"""Angular velocity of a nose-up pitch in our axes: right-handed rotation about left lowers the nose."""
LEFT_TURN = Z
RISING = Z


@pytest.mark.parametrize(("to", "back"), PAIRS, ids=["fossen", "controller", "optical"])
class TestEveryChange:
    def test_comes_back(self, to, back):
        for name, value in [
            ("vector", V),
            ("axial", V),
            ("twist", TWIST),
            ("rotation", R),
            ("quaternion", Q),
        ]:
            there = getattr(to, name)(value)
            np.testing.assert_allclose(getattr(back, name)(there), value, atol=1e-15)
        for S in (V[:3].T @ V[:3], TWIST.T @ TWIST):
            np.testing.assert_allclose(back.covariance(to.covariance(S)), S, atol=1e-13)

    def test_quaternion_and_matrix_tell_the_same_rotation(self, to, back):
        np.testing.assert_allclose(
            quat_to_matrix(to.quaternion(Q)), to.rotation(quat_to_matrix(Q)), atol=1e-14
        )

    def test_rotating_then_renaming_equals_renaming_then_rotating(self, to, back):
        renamed = np.einsum("nij,nj->ni", to.rotation(R), to.vector(V))
        np.testing.assert_allclose(renamed, to.vector(np.einsum("nij,nj->ni", R, V)), atol=1e-14)

    def test_power_does_not_depend_on_the_axes(self, to, back):
        """tau . nu is the same number in every frame, left-handed ones included."""
        wrench = TWIST[::-1]
        np.testing.assert_allclose(np.sum(to.twist(wrench) * to.twist(TWIST), -1), np.sum(wrench * TWIST, -1))

    def test_a_covariance_follows_its_samples(self, to, back):
        samples = RNG.normal(size=(50, 6)) @ RNG.normal(size=(6, 6))
        np.testing.assert_allclose(to.covariance(np.cov(samples.T)), np.cov(to.twist(samples).T), atol=1e-12)

    def test_polar_covariance_follows_its_samples(self, to, back):
        samples = RNG.normal(size=(50, 3)) @ RNG.normal(size=(3, 3))
        np.testing.assert_allclose(to.covariance(np.cov(samples.T)), np.cov(to.vector(samples).T), atol=1e-12)


def test_fossen_sees_known_motions_as_his_book_does():
    """Nose up: theta and q increase. Left turn: r and the heading decrease. Rising: w and the world z (depth)
    decrease."""
    np.testing.assert_array_equal(TO_FOSSEN.axial(NOSE_UP), Y)
    np.testing.assert_array_equal(TO_FOSSEN.axial(LEFT_TURN), -Z)
    np.testing.assert_array_equal(TO_FOSSEN.vector(RISING), -Z)
    assert TO_FOSSEN.yaw(0.5) == -0.5
    nose_up = TO_FOSSEN.quaternion(quat_from_euler(0.0, -0.2, 0.0))
    np.testing.assert_allclose(nose_up, quat_from_euler(0.0, 0.2, 0.0))
    assert quat_rotate(nose_up, X)[2] < 0.0  # the bow points up, against Fossen's z


def test_the_controller_sees_known_motions_in_left_handed_axes():
    """y is up and z left, so rising is +y; turning left is -y and nose up is +z, since the axes are left-handed."""
    np.testing.assert_array_equal(TO_CONTROLLER.vector(RISING), Y)
    np.testing.assert_array_equal(TO_CONTROLLER.vector(Y), Z)
    np.testing.assert_array_equal(TO_CONTROLLER.axial(LEFT_TURN), -Y)
    np.testing.assert_array_equal(TO_CONTROLLER.axial(NOSE_UP), Z)
    assert TO_CONTROLLER.yaw(0.5) == -0.5
    left = TO_CONTROLLER.rotation(quat_to_matrix(quat_from_euler(0.0, 0.0, 0.3)))
    np.testing.assert_allclose(left @ X, [np.cos(0.3), 0.0, np.sin(0.3)])  # the bow points to +z, left


def test_the_controller_map_is_the_published_one():
    """omega_c = [-omega_x, -omega_z, -omega_y]; p_c = [x, z, y]."""
    np.testing.assert_array_equal(TO_CONTROLLER.axial([1.0, 2.0, 3.0]), [-1.0, -3.0, -2.0])
    np.testing.assert_array_equal(TO_CONTROLLER.vector([1.0, 2.0, 3.0]), [1.0, 3.0, 2.0])


def test_a_left_vertical_thruster_rolls_as_published():
    """Pushing up on the left is +roll in our frame and the published -0.133 N m/N in the controller's, y up, z left."""
    lever, force = np.array([0.08312216, 0.13304673, 0.04907]), Z
    wrench = TO_CONTROLLER.twist(np.concatenate([force, np.cross(lever, force)]))
    np.testing.assert_allclose(wrench, [0, 1, 0, -0.133047, 0, 0.083122], atol=1e-6)


def test_a_camera_looks_along_its_optical_z():
    """Forward, right and down of the camera are its optical z, x and y."""
    np.testing.assert_array_equal(TO_OPTICAL.vector([X, -Y, -Z]), [Z, X, Y])
    attitude = quat_from_euler(0.1, np.pi / 2, 0.4)  # x forward points straight down into the water
    optical = optical_from_camera(attitude)
    np.testing.assert_allclose(quat_rotate(optical, Z), -Z, atol=1e-15)
    np.testing.assert_allclose(quat_rotate(optical, Z), quat_rotate(attitude, X), atol=1e-15)
    np.testing.assert_allclose(quat_rotate(optical, X), quat_rotate(attitude, -Y), atol=1e-15)
    np.testing.assert_allclose(
        quat_to_matrix(camera_from_optical(optical)), quat_to_matrix(attitude), atol=1e-15
    )


def test_wxyz_has_w_first():
    np.testing.assert_array_equal(wxyz_from_xyzw([1, 2, 3, 4]), [4, 1, 2, 3])
