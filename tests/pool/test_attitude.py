"""The attitude filter finds tilt and follows turns; yaw drifts."""

import math

import numpy as np

from finssim.core.rotations import quat_from_euler, quat_inverse_rotate, quat_to_euler
from finssim.pool.firmware import AttitudeFilter

UP = (0.0, 0.0, 9.81)


def angles(attitude):
    return np.array(quat_to_euler(np.array(attitude.quaternion)))


def test_it_starts_at_the_tilt_that_gravity_shows():
    """The first sample gives roll and pitch; yaw is 0."""
    attitude = AttitudeFilter(0.5, 0.01, 9.81)
    true = quat_from_euler(0.2, -0.3, 0.0)
    attitude.update((0.0, 0.0, 0.0), tuple(quat_inverse_rotate(true, UP)), 0.01)
    np.testing.assert_allclose(angles(attitude), [0.2, -0.3, 0.0], atol=1e-9)


def test_it_follows_a_turn():
    """A quarter turn of yaw at 1 rad/s is right to second order in the step."""
    attitude = AttitudeFilter(0.5, 0.01, 9.81)
    attitude.update((0.0, 0.0, 1.0), UP, 0.01)
    for _ in range(157):
        attitude.update((0.0, 0.0, 1.0), UP, 0.01)
    assert abs(angles(attitude)[2] - 1.57) < 1e-3


def test_tilt_is_held_against_a_gyro_bias_and_yaw_is_not():
    """After ten minutes with 5 mrad/s on every axis tilt is right to a tenth of a degree; yaw is off by 3
    rad."""
    attitude = AttitudeFilter(0.5, 0.02, 9.81)
    for _ in range(60000):
        attitude.update((0.005, -0.005, 0.005), UP, 0.01)
    roll, pitch, yaw = angles(attitude)
    assert max(abs(roll), abs(pitch)) < math.radians(0.1)
    assert abs(yaw - 3.0) < 0.05
    np.testing.assert_allclose(attitude.bias[:2], (0.005, -0.005), atol=2e-4)


def test_a_knock_is_not_taken_for_gravity():
    """Specific forces of more than 1.3 g do not change the tilt."""
    attitude = AttitudeFilter(5.0, 0.0, 9.81)
    attitude.update((0.0, 0.0, 0.0), UP, 0.01)
    for _ in range(100):
        attitude.update((0.0, 0.0, 0.0), (20.0, 0.0, 9.81), 0.01)
    np.testing.assert_allclose(angles(attitude), 0.0, atol=1e-12)
