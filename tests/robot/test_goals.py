"""A goal received by messages is extrapolated along its last motion."""

import numpy as np

from finssim.control.guidance import Track
from finssim.core.rotations import quat_from_yaw
from finssim.robot.goals import HeardGoal


def test_a_goal_goes_on_as_it_was_last_heard_to_go():
    """Heard at 12 s of a guide begun at 10 s, the goal continues straight along its own surge, also at
    several times."""
    tracks = {}
    goal = HeardGoal(tracks)
    np.testing.assert_array_equal(goal.at(0.0).position, np.zeros(3))  # nothing received yet
    goal.started = 10.0
    surge = np.array([0.2, 0.0, 0.0, 0.0, 0.0, 0.0])
    tracks["target"] = Track(np.array([1.0, 2.0, -3.0]), quat_from_yaw(np.pi / 2), surge, 12.0)
    now = goal.at(2.0)
    np.testing.assert_allclose(now.position, [1.0, 2.0, -3.0])
    np.testing.assert_allclose(now.velocity, [0.0, 0.2, 0.0], atol=1e-12)
    np.testing.assert_allclose(now.yaw, np.pi / 2)
    later = goal.at(np.array([2.0, 3.5]))
    np.testing.assert_allclose(later.position, [[1.0, 2.0, -3.0], [1.0, 2.3, -3.0]], atol=1e-12)


def test_a_goal_that_is_no_longer_heard_of_stands_still():
    """After 2 s without a message the goal stops, so that a lost message leads no vehicle astray."""
    surge = np.array([0.2, 0.0, 0.0, 0.0, 0.0, 0.0])
    goal = HeardGoal({"target": Track(np.zeros(3), quat_from_yaw(0.0), surge, 12.0)})
    goal.started = 10.0
    np.testing.assert_allclose(goal.at(60.0).position, [2.0 * 0.2, 0.0, 0.0])
