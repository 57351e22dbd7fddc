"""Verdicts follow from numbers: every kind of failure fails."""

import numpy as np
import pytest

from studies.faults import STOP_WITHIN, Course, inset, measured, passed

BOX = np.array([-1.0, -1.0, -1.0]), np.array([1.0, 1.0, 0.0])
BEGAN = 2.0


def course(stops=np.inf, speed=0.0):
    """Return 6 s of driving at a speed [m/s], with thrust and frames until `stops` [s] after the fault at 2
    s."""
    t = np.arange(0.0, 6.0, 0.01)
    driving = t <= BEGAN + stops + 1e-9
    position = np.column_stack([speed * (t - BEGAN), 0.0 * t, 0.0 * t - 0.5])
    return Course(t, position, np.outer(driving, [2.0, -1.0]), driving.astype(float))


def told(found, **changes):
    return passed({**found, "raised": "", "record_lost_s": 0.0, "record_problem": "", **changes})


def test_times_and_margins_are_those_of_the_truth():
    """Thrust that ends 0.3 s after the fault at 0.1 m/s gives 0.3 s, and 1 m minus 0.4 m to the face."""
    found = measured(course(0.3, 0.1), BEGAN, 6.0, BOX)
    assert found["thrust_gone_s"] == pytest.approx(0.3, abs=0.011)
    assert found["frames_off_s"] == pytest.approx(0.3, abs=0.011)
    assert found["margin_m"] == pytest.approx(0.5)  # of the height: 0.5 m below the surface
    assert measured(course(0.3, 0.2), BEGAN, 6.0, BOX)["margin_m"] == pytest.approx(1.0 - 0.2 * 3.99)
    assert found["speed_m_s"] == pytest.approx(0.1) and found["thrust_n"] == pytest.approx(3.0)


def test_a_pause_at_the_end_is_not_a_stop():
    """Thrust that ended 0.5 s before the end may resume, so it does not count as stopped."""
    assert measured(course(3.5), BEGAN, 6.0, BOX)["thrust_gone_s"] is None
    assert measured(course(2.5), BEGAN, 6.0, BOX)["thrust_gone_s"] == pytest.approx(2.5, abs=0.011)


@pytest.mark.parametrize(
    ("stops", "speed", "good"),
    [
        (STOP_WITHIN - 0.1, 2.0, True),  # in time, though it drifts out
        (STOP_WITHIN + 0.1, 0.1, True),  # late, but inside
        (STOP_WITHIN + 0.1, 2.0, False),  # late and out
        (np.inf, 0.0, True),  # drives on inside
        (np.inf, 2.0, False),  # drives on and out
    ],
)
def test_a_vehicle_stops_in_time_or_stays_inside(stops, speed, good):
    """Either is enough; neither fails."""
    assert told(measured(course(stops, speed), BEGAN, 6.0, BOX)) is good


def test_neither_an_exception_nor_a_lost_record_passes():
    """They fail however well the vehicle did."""
    found = measured(course(0.2), BEGAN, 6.0, BOX)
    assert told(found)
    assert not told(found, raised="ValueError: 1")
    assert not told(found, record_problem="RecordError: cut", record_lost_s=None)
    assert not told(found, record_lost_s=1.5) and told(found, record_lost_s=0.9)


def test_a_vehicle_that_nobody_sees_must_stop():
    """Without a known position in the workspace only the time counts."""
    assert told(measured(course(0.3), BEGAN, 6.0, None))
    assert not told(measured(course(0.7), BEGAN, 6.0, None))


def test_the_workspace_of_the_trials_can_be_left():
    """It is more than a vehicle's radius inside the walls of the pool."""
    lower, upper = inset([-2.0, -1.0, -1.0], [2.0, 1.0, 0.0])
    np.testing.assert_allclose([lower, upper], [[-1.6, -0.6, -0.8], [1.6, 0.6, -0.2]])
