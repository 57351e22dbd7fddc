"""Perspective-n-point without water: agreement with OpenCV, both candidate attitudes, the apparent depth."""

from dataclasses import replace

import numpy as np
import pytest

from finssim.localization.poses.methods import pinhole, pinhole_depth
from finssim.localization.poses.refinement import tag_poses
from localization.poses.seen_vehicle import ABOVE, LENS, POOLS, TAGS, known, moved, rotation, seen

AIR = replace(POOLS["level water"], interface=replace(POOLS["level water"].interface, index_far=1.0003))


@pytest.mark.parametrize("seed", range(6))
def test_noisy_corners_give_what_opencv_gives(seed):
    """The minimum of the reprojection error of two tags equals that of cv2.solvePnP, refined, to 0.1 mm."""
    cv2 = pytest.importorskip("cv2")
    rng = np.random.default_rng(seed)
    position, angles = (
        rng.uniform([-0.6, -0.5, 0.3], [0.6, 0.3, 0.7]),
        np.array([0.1, -0.1, rng.uniform(-3, 3)]),
    )
    detections = moved(seen(AIR, position, angles), rng.normal(0.0, 0.1, (2, 4, 2)))
    found = pinhole(detections, AIR, TAGS, known(position, angles), 10.0)
    points, pixels = np.concatenate(list(TAGS.values())), np.concatenate([d.corners for d in detections])
    R_cb = ABOVE.R_pc.T @ found.rotation
    turn, t = cv2.Rodrigues(R_cb)[0], ABOVE.R_pc.T @ (found.position - ABOVE.position)
    distortion = np.array(LENS.distortion)
    again, t_cv = cv2.solvePnPRefineLM(points, pixels, LENS.K, distortion, turn + 0.01, t[:, None] + 0.01)
    np.testing.assert_allclose(t_cv[:, 0], t, atol=1e-4)
    np.testing.assert_allclose(again, turn, atol=1e-3)


def test_of_two_attitudes_the_known_tilt_takes_the_right_one():
    """For one small tag far off the axis with 1 px of noise, given roll and pitch prevent a mirrored attitude."""
    position, angles, one = np.array([1.0, 0.3, 0.1]), np.array([0.0, 0.0, 0.6]), {15: TAGS[15]}
    exact, rng, upright, known_upright = seen(AIR, position, angles, one), np.random.default_rng(0), 0, 0
    for _ in range(25):
        noisy = moved(exact, rng.normal(0.0, 0.7, (1, 4, 2)))
        lean = pinhole(noisy, AIR, one, None, 0.7).rotation[2, 2]
        known_lean = pinhole(noisy, AIR, one, known(position, angles), 0.7).rotation[2, 2]
        upright += lean > np.cos(np.radians(30.0))
        known_upright += known_lean > np.cos(np.radians(30.0))
    assert known_upright == 25
    assert upright < 25


def test_both_attitudes_of_a_tag_put_its_corners_nearly_there():
    """The mirrored start differs by twice the angle between the tag's normal and the line of sight."""
    position, angles = np.array([0.8, -0.4, 0.3]), np.array([0.05, 0.1, 0.6])
    detection = seen(AIR, position, angles)[0]
    rays, _ = LENS.rays(detection.corners)
    (t, R), (_, mirrored) = tag_poses(rays @ ABOVE.R_pc.T, ABOVE.position, TAGS[15])
    np.testing.assert_allclose(R, rotation(angles), atol=1e-6)
    np.testing.assert_allclose(t, position, atol=1e-6)
    sight = position + R @ TAGS[15].mean(axis=0) - ABOVE.position
    off = np.pi - np.arccos(R[:, 2] @ sight / np.linalg.norm(sight))
    assert np.arccos(R[:, 2] @ mirrored[:, 2]) == pytest.approx(2.0 * off, abs=1e-6)


def test_water_lifts_what_a_pinhole_sees():
    """Seen vertically from above, a tag at depth d appears at d n_air/n_water."""
    pool = POOLS["level water"]
    height = 0.96 - 0.1  # height of the body origin with its tags at the surface
    position = np.array([ABOVE.position[0], ABOVE.position[1], height - 0.5])
    found = pinhole(seen(pool, position, np.zeros(3)), pool, TAGS, known(position, np.zeros(3)), 0.5)
    assert height - found.z == pytest.approx(0.5 * 1.0003 / 1.333, abs=0.01)


def test_a_known_height_pushes_the_error_outwards():
    """With the height given, straight rays meet it too far out: dx = d (tan θ_air - tan θ_water)."""
    pool, level = POOLS["level water"], np.zeros(3)
    one = {15: TAGS[15] - TAGS[15].mean(axis=0)}
    position = ABOVE.position + [0.8, 0.0, -1.5]
    found = pinhole_depth(seen(pool, position, level, one), pool, one, known(position, level), 0.3)
    sine = np.sin(np.arctan2(0.8, 1.5))
    above, below = ABOVE.position[2] - 0.96, 0.96 - position[2]
    for _ in range(100):  # the angle at which the ray leaves the camera
        tan_air = np.tan(np.arcsin(sine))
        tan_water = np.tan(np.arcsin(sine * 1.0003 / 1.333))
        sine *= 0.8 / (above * tan_air + below * tan_water)
    assert found.x - position[0] == pytest.approx(below * (tan_air - tan_water), rel=0.02)
    assert abs(found.y - position[1]) < 0.002


def test_the_baseline_answers_where_refraction_is_strong():
    """At the rim, where ignoring the water costs 10 cm, the baseline gives a result with that error, not a refusal."""
    pool, level = POOLS["level water"], np.zeros(3)
    for position in ([1.0, -0.5, 0.4], [-1.1, 0.4, 0.2], [0.8, 0.3, 0.1]):
        found = pinhole_depth(seen(pool, np.array(position), level), pool, TAGS, known(position, level), 0.3)
        assert found.ok, found.reason
        assert 0.05 < np.hypot(*(found.position - position)[:2]) < 0.3
