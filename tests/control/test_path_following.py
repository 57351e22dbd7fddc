"""Path following on points with perfect steering: legs, line of sight in a current, and the seabed."""

import math

import numpy as np
import pytest

from finssim.control import ControlError
from finssim.control.path_following import LineOfSight, SeabedFollower, Waypoints
from finssim.control.trajectories import TRAJECTORIES


def test_errors_beside_a_sloping_leg_in_closed_form():
    """For a leg along (3, 4, -5)/sqrt(50), across is level and to the left, above is perpendicular to the leg."""
    path = Waypoints([[1.0, 2.0, -3.0], [31.0, 42.0, -53.0]])
    e = np.array([3.0, 4.0, -5.0]) / math.sqrt(50.0)
    left = np.array([-0.8, 0.6, 0.0])
    up = np.cross(e, left)
    x = path.points[0] + 7.0 * e + 1.5 * left - 0.4 * up
    found, leg, done = path.errors(path.reset(), x)
    assert (leg[0], done[0]) == (0, False)
    assert found.course[0] == pytest.approx(math.atan2(4.0, 3.0))
    assert found.slope[0] == pytest.approx(math.radians(45.0))
    assert [found.along[0], found.across[0], found.above[0]] == pytest.approx([7.0, 1.5, -0.4])
    assert found.remaining[0] == pytest.approx(math.sqrt(5000.0) - 7.0)


def test_a_leg_is_left_within_the_radius_or_beyond_its_end():
    path = Waypoints([[0, 0, -5], [10, 0, -5], [10, 20, -5], [30, 20, -5]], radius=2.0)
    x = np.array([[7.9, 0, -5], [8.1, 0, -5], [10.1, 9.0, -5], [10.1, 30.0, -5], [0, 0, -5]])
    _, leg, done = path.errors(path.reset(5), x)
    assert leg.tolist() == [0, 1, 1, 2, 0] and not done.any()
    _, leg, done = path.errors(np.array([2, 2, 1]), np.array([[28.1, 20, -5], [27.0, 20, -5], [0, 0, -5]]))
    assert leg.tolist() == [2, 2, 1] and done.tolist() == [True, False, False]


def test_the_path_of_a_trajectory_has_its_points_and_length():
    path = Waypoints.along(TRAJECTORIES["circle"], spacing=0.05)
    assert np.hypot(*path.points[:, :2].T) == pytest.approx(0.5, abs=1e-3)
    assert np.linalg.norm(np.diff(path.points, axis=0), axis=1).sum() == pytest.approx(3 * math.pi, rel=1e-3)


@pytest.mark.parametrize(
    ("points", "radius", "words"),
    [
        ([[0, 0, 0]], 1.0, "two or more rows"),
        ([[0, 0, 0], [0, 0, 0]], 1.0, "waypoints 1 and 2 are the same point"),
        ([[0, 0, 0], [1, 0, math.nan]], 1.0, "finite"),
        ([[0, 0, 0], [1, 0, 0]], 0.0, "radius of acceptance is 0.0"),
    ],
)
def test_paths_that_are_none_are_refused(points, radius, words):
    with pytest.raises(ControlError, match=words):
        Waypoints(points, radius)


def followed(gain: float, seconds: float) -> np.ndarray:
    """Return the final cross-track and vertical error [m] of points that follow aimed angles in a current at
    1.5 m/s."""
    path, guide, h = Waypoints([[0, 0, -10], [2000, 0, -10]]), LineOfSight(6.0, gain), 0.1
    x, current = np.array([[0.0, 8.0, -13.0]]), np.array([0.1, -0.4, 0.15])
    leg, memory = path.reset(), guide.reset()
    for _ in range(round(seconds / h)):
        errors, leg, _ = path.errors(leg, x)
        (course, slope), memory = guide.aim(memory, errors, h)
        way = np.column_stack(
            [np.cos(slope) * np.cos(course), np.cos(slope) * np.sin(course), -np.sin(slope)]
        )
        x = x + h * (1.5 * way + current)
    errors = path.errors(leg, x)[0]
    return np.array([errors.across[0], errors.above[0]])


def test_the_integral_takes_a_current_out():
    """Without the integral the heading points at the look-ahead point, and the current leaves D tan(drift angle)."""
    drift = np.array([math.asin(0.4 / 1.5), math.asin(0.15 / 1.5)])
    assert np.abs(followed(0.0, 200.0)) == pytest.approx(6.0 * np.tan(drift), rel=0.02)
    assert np.abs(followed(0.2, 200.0)).max() < 0.01


def test_the_greatest_slope_is_kept():
    guide = LineOfSight(2.0, steepest=0.3)
    path = Waypoints([[0, 0, -10], [100, 0, -10]])
    errors = path.errors(path.reset(2), np.array([[5.0, 0, 0], [5.0, 0, -20]]))[0]
    assert guide.aim(guide.reset(2), errors, 0.1)[0][1].tolist() == [0.3, -0.3]


def test_a_sloping_seabed_is_followed_without_lag():
    """With a seabed depth of 20 m + 0.3 m/s, the reference depth is the altitude above the seabed one second ahead."""
    follower, h = SeabedFollower(altitude=3.0), 0.1
    memory = follower.reset(2)
    for k in range(400):
        bed, depth = 20.0 + 0.3 * k * h, 17.0
        seen = np.array([bed - depth, np.inf if 100 < k < 110 else bed - depth])
        wanted, rate, memory = follower.depth(memory, np.full(2, depth), seen, h)
        if k == 109:
            assert wanted[1] == pytest.approx(wanted[0], abs=0.01), "a gap is bridged"
    assert wanted == pytest.approx(bed + 0.3 - 3.0, abs=1e-6)
    assert rate == pytest.approx(0.3, abs=1e-6)


def test_the_depth_is_kept_until_the_seabed_is_seen():
    follower = SeabedFollower(altitude=3.0)
    wanted, rate, memory = follower.depth(follower.reset(), [7.0], [np.inf], 0.1)
    assert (wanted[0], rate[0]) == (7.0, 0.0)
    assert follower.depth(memory, [7.0], [5.0], 0.1)[0][0] == pytest.approx(9.0)
