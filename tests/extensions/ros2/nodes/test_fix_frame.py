"""Fixes are sent in the map frame and return in the pool's frame, with their covariances."""

from dataclasses import replace

import numpy as np
import pytest

from finssim.core.rotations import quat_from_euler
from finssim.extensions.ros2.nodes.conversions import RosMessages
from finssim.extensions.ros2.nodes.frames import FixFrame
from finssim.localization.fusion.estimator import Estimator
from finssim.localization.fusion.fuse_settings import settings_of, site_of
from finssim.localization.fusion.streams import DepthSample, ImuSample, VisionSample
from finssim.pool.camera import true_site
from finssim.vehicles import load_vehicle

VEHICLE = load_vehicle("finsrov")
SPREAD = np.array([[4e-4, 1e-4, 2e-5], [1e-4, 9e-4, -3e-5], [2e-5, -3e-5, 1e-3]])


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.0, 0.0, 2.2), (0.02, -0.03, 0.7)])
def test_a_fix_comes_back_as_it_was(turn):
    """Position, heading and covariance survive for a map that is turned, moved and tilted in the survey's
    frame."""
    q = tuple(float(v) for v in quat_from_euler(*turn))
    pool = replace(true_site(), world_position=(0.3, -0.2, 1.0), world_orientation=q)
    estimator = Estimator(settings_of(VEHICLE), site_of(pool, VEHICLE))
    for k in range(20):
        estimator.add(ImuSample(0.01 * k, (0.0, 0.0, 0.0), (0.0, 0.0, 9.81), (0.05, -0.04)))
        estimator.add(DepthSample(0.01 * k, 0.4))
    rows = tuple(map(tuple, SPREAD.tolist()))
    fix, frame = VisionSample(0.15, (0.5, -0.4), 1.2, rows, 0.2), FixFrame(pool, estimator)
    position, quaternion, covariance = frame.to_map(fix, estimator)
    message = RosMessages(VEHICLE).fix(150_000_000, position, quaternion, covariance)
    back = frame.from_map(message, 0.15, 0.2)
    assert back.position == pytest.approx(fix.position, abs=1e-12)
    assert back.yaw == pytest.approx(fix.yaw, abs=1e-12)
    assert np.array(back.covariance) == pytest.approx(SPREAD, abs=1e-15)
    assert (back.time, back.arrival) == (0.15, 0.2)


def test_the_map_is_the_world_of_the_pool_file():
    """After a quarter turn the pool's y axis is the map's x axis, and headings turn with it."""
    q = tuple(float(v) for v in quat_from_euler(0.0, 0.0, np.pi / 2))
    pool = replace(true_site(), world_position=(0.0, 0.0, 1.0), world_orientation=q)
    estimator = Estimator(settings_of(VEHICLE), site_of(pool, VEHICLE))
    fix = VisionSample(0.0, (0.0, 2.0), np.pi / 2, tuple(map(tuple, SPREAD.tolist())))
    position, quaternion, covariance = FixFrame(pool, estimator).to_map(fix, estimator)
    assert position[:2] == pytest.approx([2.0, 0.0], abs=1e-12)
    assert np.abs(quaternion) == pytest.approx([0.0, 0.0, 0.0, 1.0], abs=1e-12)
    assert covariance[0, 0] == pytest.approx(SPREAD[1, 1]) and covariance[1, 1] == pytest.approx(SPREAD[0, 0])
    assert covariance[2, 2] > 1e5, "without a depth sensor's word the height is not known"
