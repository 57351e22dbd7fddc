"""The integral in front of a policy shifts what it is shown, no more than it may, and only near its goal."""

from types import SimpleNamespace

import numpy as np
import pytest
from tests.reference.observed import published_t2

from finssim.control import ControlError
from finssim.control.policy_description import ObservationEntry, ObservationSchema
from finssim.control.trajectories import TRAJECTORIES
from finssim.control.trim import Trim
from finssim.geometry.rotations import quat_from_euler
from finssim.tasks import TrajectoryTracking

TRIM = Trim(rate=0.5, limit=0.1, reach=0.2)
PLACE = np.array([0.1, -0.2, -0.5])
MEASURED = SimpleNamespace(position=PLACE, quaternion=quat_from_euler(0.1, -0.2, 2.0), nu=np.zeros(6))


def test_the_shown_observation_is_that_of_a_vehicle_shifted_the_other_way():
    """Only the offsets change: those to a reference moved by the shift."""
    shift, circle = np.array([0.02, -0.03, 0.01]), TRAJECTORIES["circle"]
    shown = TRIM.shown(published_t2(MEASURED, circle, 3.0), MEASURED, shift, TrajectoryTracking().schema)
    moved = SimpleNamespace(**{**vars(MEASURED), "position": PLACE - shift})
    np.testing.assert_allclose(shown, published_t2(moved, circle, 3.0), atol=1e-12)


def test_the_shift_is_the_integral_of_the_error():
    """A steady 0.05 m for one second at a rate of 0.5/s is 0.025 m, in a batch too."""
    goal, shift = PLACE + [0.05, 0.0, 0.0], TRIM.reset(2)
    both = SimpleNamespace(position=np.stack([PLACE, PLACE]))
    for _ in range(10):
        shift = TRIM.update(shift, both, goal, 0.1)
    np.testing.assert_allclose(shift, [[0.025, 0.0, 0.0]] * 2)


def test_it_is_bounded_and_collects_nothing_far_away():
    shift = TRIM.reset()
    for _ in range(1000):
        shift = TRIM.update(shift, MEASURED, PLACE + [0.0, 0.1, -0.1], 0.1)
    np.testing.assert_allclose(shift, [0.0, 0.1, -0.1])
    np.testing.assert_array_equal(TRIM.update(shift, MEASURED, PLACE + [1.0, 0.0, 0.0], 0.1), shift)


def test_what_it_cannot_do_is_refused():
    with pytest.raises(ControlError, match="rate is -1"):
        Trim(rate=-1.0)
    speeds = ObservationSchema(size=1, entries=(ObservationEntry(name="speed", indices=(0,), unit="m/s"),))
    with pytest.raises(ControlError, match="no offset"):
        TRIM.shown(np.zeros(1), MEASURED, TRIM.reset(), speeds)
