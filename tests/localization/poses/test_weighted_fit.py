"""Corners, depth and tilt together: each is weighted by its uncertainty, and the covariance is valid."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from finssim.localization.detection.detections import Detection
from finssim.localization.poses.methods import METHODS, weighted_fit
from localization.poses.seen_vehicle import POOLS, TAGS, known, seen

POOL = POOLS["level water"]
POSITION, ANGLES = np.array([0.6, -0.3, 0.4]), np.array([0.03, -0.04, 0.7])


def noisy(random, std, shared=0.0):
    """Return the corners with independent noise and a common shift of the picture [px]."""
    shift = random.normal(0.0, shared, 2)
    return [
        Detection(d.tag, d.corners + random.normal(0.0, std, (4, 2)) + shift)
        for d in seen(POOL, POSITION, ANGLES)
    ]


def read(random, z_std, tilt_std, shared=0.0):
    """Return readings of depth and tilt, with their errors."""
    off = random.normal(0.0, [z_std, tilt_std, tilt_std])
    true = known(POSITION, ANGLES, z_std=z_std, tilt_std=tilt_std)
    return replace(
        true,
        z_b=true.z_b + off[0],
        roll=true.roll + off[1],
        pitch=true.pitch + off[2],
        shared_pixel_std=shared,
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pixel", "z", "tilt", "shared"),
    [(0.1, 0.01, 0.01, 0.0), (0.5, 0.01, 0.01, 0.0), (0.5, 0.002, 0.02, 0.0), (0.2, 0.01, 0.01, 1.0)],
)
def test_the_covariance_tells_the_errors(pixel, z, tilt, shared):
    """The mean normalised square of the error of all six lies in its 99.9 % band for 150 draws."""
    random, squares = np.random.default_rng(5), []
    true_R = METHODS["refractive"](
        seen(POOL, POSITION, ANGLES), POOL, TAGS, known(POSITION, ANGLES), 0.1
    ).rotation
    for _ in range(150):
        found = weighted_fit(noisy(random, pixel, shared), POOL, TAGS, read(random, z, tilt, shared), pixel)
        assert found.ok, found.reason
        turn = found.rotation @ true_R.T
        error = np.concatenate(
            [
                found.position - POSITION,
                0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]),
            ]
        )
        squares.append(error @ np.linalg.solve(found.pose_covariance, error))
    low, high = chi2.ppf([0.0005, 0.9995], 6 * 150) / 150
    assert low < np.mean(squares) < high


def test_sure_corners_correct_the_depth():
    """With corners to 0.05 px and a depth 3 cm off, the position error is a third of that by depth alone."""
    wrong = known(POSITION, ANGLES, z_std=0.03)
    wrong = replace(wrong, z_b=wrong.z_b + 0.03)
    corners = seen(POOL, POSITION, ANGLES)
    by = {m: METHODS[m](corners, POOL, TAGS, wrong, 0.05) for m in ("refractive", "refractive-weighted")}
    error = {m: np.linalg.norm(found.position[:2] - POSITION[:2]) for m, found in by.items()}
    assert 3.0 * error["refractive-weighted"] < error["refractive"]
    assert abs(by["refractive-weighted"].z - POSITION[2]) < 0.01


def test_unsure_corners_leave_the_depth_as_it_was_read():
    """With corner noise of 2 px, the height stays within a tenth of its standard deviation."""
    constraints = known(POSITION, ANGLES, z_std=0.002)
    found = weighted_fit(noisy(np.random.default_rng(1), 0.5), POOL, TAGS, constraints, 2.0)
    assert abs(found.z - POSITION[2]) < 0.0002


def test_without_depth_it_refuses():
    """The fit refuses without depth, as it needs every quantity that it weights."""
    found = weighted_fit(seen(POOL, POSITION, ANGLES), POOL, TAGS, None)
    assert not found.ok and "depth" in found.reason
