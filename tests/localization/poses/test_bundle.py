"""Six degrees of freedom through the water: true minima are found, ambiguous ones refused, the covariance is valid."""

import numpy as np
import pytest

from finssim.core.rotations import matrix_to_quat, quat_to_rotvec
from finssim.localization.poses import Constraints
from finssim.localization.poses.methods import refractive_bundle
from localization.poses.seen_vehicle import POOLS, TAGS, known, moved, pose, rotation, seen

POOL = POOLS["level water"]
FAR = {15: TAGS[15] + [0.1, 0.0, 0.0], 16: TAGS[16], 17: TAGS[15] + [0.0, 0.25, -0.1]}
"""Three tags that span a triangle, not all in one plane."""


def error(found, position, angles):
    """Return position error and rotation vector about pool axes from the true attitude, (6,)."""
    turn = quat_to_rotvec(matrix_to_quat(found.rotation @ rotation(angles).T))
    return np.concatenate([found.position - position, turn])


@pytest.mark.slow
@pytest.mark.parametrize("name", POOLS)
def test_large_tilts_are_found_too(name):
    """A vehicle that leans by 20 degrees is found from exact corners, without depth or IMU."""
    looked_at = 0
    for seed in (3, 4, 5, 6):
        position, angles = pose(name, seed)
        angles[:2] = [0.35, -0.25]
        detections = seen(POOLS[name], position, angles)
        if detections is None:
            continue
        looked_at += 1
        found = refractive_bundle(detections, POOLS[name], TAGS, None, 0.05)
        assert found.ok, found.reason
        assert np.abs(error(found, position, angles)).max() < 1e-4
    assert looked_at


@pytest.mark.slow
def test_the_covariance_is_that_of_the_errors():
    """NEES over 60 noisy pictures of three tags averages 6 for the pose and 3 for x, y, yaw, within 99.9 % bands."""
    position, angles = np.array([0.5, -0.3, 0.3]), np.array([0.1, -0.1, 2.0])
    exact, rng, whole, plane = seen(POOL, position, angles, FAR), np.random.default_rng(0), [], []
    for _ in range(60):
        noisy = moved(exact, rng.normal(0.0, 0.2, (3, 4, 2)))
        found = refractive_bundle(noisy, POOL, FAR, None, 0.2)
        assert found.ok, found.reason
        e = error(found, position, angles)
        whole.append(e @ np.linalg.solve(found.pose_covariance, e))
        e = e[[0, 1, 5]]
        plane.append(e @ np.linalg.solve(found.covariance, e))
    assert 6.0 - 1.5 < np.mean(whole) < 6.0 + 1.9
    assert 3.0 - 1.05 < np.mean(plane) < 3.0 + 1.3


def test_a_far_small_tag_is_ambiguous_until_tilt_decides():
    """One tag with corner noise of 1 px fits two attitudes: it is refused, and accepted with roll and pitch."""
    position, angles, one = np.array([0.9, 0.1, 0.1]), np.zeros(3), {15: TAGS[15]}
    exact = seen(POOL, position, angles, one)
    rng, refusals = np.random.default_rng(1), []
    for _ in range(12):
        noisy = moved(exact, rng.normal(0.0, 1.0, (1, 4, 2)))
        found = refractive_bundle(noisy, POOL, one, None, 1.0)
        refusals.append(found.reason)
        decided = refractive_bundle(noisy, POOL, one, known(position, angles), 1.0)
        if not decided.ok:
            assert "ambiguous" in decided.reason
            continue
        lean = np.degrees(np.arccos(decided.rotation[2, 2]))
        assert lean < 25.0
    assert sum("ambiguous" in reason for reason in refusals) >= 6


def test_tilt_alone_is_used_and_height_is_not():
    """A height that is wrong or unknown changes nothing."""
    position, angles = np.array([0.5, -0.3, 0.4]), np.array([0.0, 0.1, 1.0])
    detections = seen(POOL, position, angles)
    for z_b in (np.nan, 5.0):
        found = refractive_bundle(detections, POOL, TAGS, Constraints(z_b, roll=0.0, pitch=0.1), 0.3)
        assert np.abs(error(found, position, angles)).max() < 1e-4


def test_an_outlier_moves_it_little():
    """A corner 20 px off moves the position by less than 1 cm, thanks to Huber's rho."""
    position, angles = np.array([0.4, -0.2, 0.4]), np.array([0.0, 0.1, 1.0])
    change = np.zeros((3, 4, 2))
    change[1, 2] = [-12.0, 16.0]
    detections = moved(seen(POOL, position, angles, FAR), change)
    found = refractive_bundle(detections, POOL, FAR, None, 0.2)
    assert found.ok, found.reason
    assert np.abs(error(found, position, angles)[:3]).max() < 0.01


def test_a_vehicle_half_out_of_the_water_is_found():
    """Each corner on either side of the surface is projected in its own medium."""
    position, angles = np.array([0.4, -0.2, 0.86]), np.array([0.3, 0.05, 1.0])
    found = refractive_bundle(seen(POOL, position, angles), POOL, TAGS, None, 0.05)
    assert found.ok, found.reason
    assert np.abs(error(found, position, angles)).max() < 1e-4


def test_contradicting_tags_are_refused():
    """Two tags half a metre apart that should be 14 cm apart fit no pose."""
    position, angles = np.array([0.4, 0.1, 0.4]), np.zeros(3)
    here, there = seen(POOL, position, angles), seen(POOL, position - [0.5, 0.0, 0.0], angles)
    found = refractive_bundle([here[0], there[1]], POOL, TAGS, None, 0.3)
    assert not found.ok
    assert found.reason
