"""The clock offset between IMU and pictures is recovered from turns about the vertical."""

import numpy as np
import pytest

from finssim.core.rotations import quat_conjugate, quat_from_rotvec, quat_multiply, quat_to_rotvec
from finssim.survey.mounts import imu_clock
from survey.moving_vehicle import motion

UP = np.array([0.0, 0.0, 1.0])


def recording(rng, late, *, spin=0.3, tilt_noise=0.1, yaw_noise=0.003, uneven=1.0):
    """Return pictures with poor tilt and good heading, and the rate about the vertical."""

    def at(t):
        moved = motion(spin=spin).at(t)
        turn = np.stack([0 * t, 0 * t, uneven * 0.5 * np.sin(1.1 * t)], axis=-1)
        return quat_multiply(quat_from_rotvec(turn), moved.quaternion)

    t = np.arange(0.0, 60.0, 0.2)
    wobble = rng.standard_normal((len(t), 3)) * np.array([tilt_noise, tilt_noise, yaw_noise])
    seen = quat_multiply(quat_from_rotvec(wobble), at(t))
    fine = np.arange(0.0, 60.0, 0.02)
    rate = quat_to_rotvec(quat_multiply(at(fine + 0.005), quat_conjugate(at(fine - 0.005))))[:, 2] / 0.01
    return t, seen, fine - late, rate + 0.01 + 0.003 * rng.standard_normal(len(fine))


@pytest.mark.parametrize("late", [-0.3, 0.0, 0.08])
def test_the_offset_comes_back_within_its_interval(late):
    """The tilt from pixels is off by 6 degrees, and the gyro has a bias."""
    t, seen, t_imu, rate = recording(np.random.default_rng(0), late)
    found = imu_clock(t, seen, UP, t_imu, rate)
    assert found.identifiable
    assert found.ci95[0] < late < found.ci95[1]
    assert found.estimate == pytest.approx(late, abs=0.02)


def test_few_pictures_say_nothing():
    t, seen, t_imu, rate = recording(np.random.default_rng(0), 0.0)
    assert imu_clock(t[:10], seen[:10], UP, t_imu, rate) is None
