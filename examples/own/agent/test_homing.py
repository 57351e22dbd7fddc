"""Laws of the controller: zero action at the goal, actions within limits, independent worlds."""

import numpy as np
from homing import Homing

import finssim as fs
from finssim.control import Goal, Known
from finssim.tasks import task_named

AGENT = Homing(fs.load_vehicle("finsrov"), task_named("t1"))


def acted(position):
    """Return the actions for vehicles at rest and level at positions, (n, 3) [m], with the goal at the origin."""
    n = len(position)
    level = np.tile([0.0, 0.0, 0.0, 1.0], (n, 1))
    reading = Known(np.zeros((n, 1)), np.asarray(position, float), level, np.zeros((n, 6)))
    return AGENT.act(AGENT.reset(n), reading, Goal(np.zeros((n, 3)), level))[0]


def test_it_rests_at_the_goal_and_drives_towards_it():
    assert (acted([[0.0, 0.0, 0.0]]) == 0.0).all()
    assert acted([[-1.0, 0.0, 0.0]])[0, 0] > 0.0


def test_actions_are_parts_of_the_limits_world_by_world():
    places = np.random.default_rng(1).uniform(-50.0, 50.0, (16, 3))
    actions = acted(places)
    assert actions.shape == (16, 6) and np.abs(actions).max() <= 1.0
    np.testing.assert_array_equal(actions[3:4], acted(places[3:4]))
