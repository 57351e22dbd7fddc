"""Frames of REP-105: odom never jumps, and map, odom and base_link compose the estimate."""

import numpy as np
import pytest

from finssim.core.rotations import quat_from_euler, quat_rotate, quat_to_euler
from finssim.extensions.ros2.nodes.frames import OPTICAL, FramePose, Odometer
from finssim.robot.reading import Reading

DT = 1.0 / 60.0


def circle(t, *, yaw=0.0, shift=(0.0, 0.0, 0.0)):
    """Return a reading on a circle of 1 m at 0.5 m/s and 0.5 rad/s, tilted, with the map turned and shifted."""
    heading = 0.5 * t + yaw
    place = (
        quat_rotate(quat_from_euler(0.0, 0.0, yaw), [np.sin(0.5 * t), 1.0 - np.cos(0.5 * t), -0.5]) + shift
    )
    roll, pitch = 0.1, -0.2
    q = quat_from_euler(roll, pitch, heading)
    level = np.array([0.5 * np.cos(heading), 0.5 * np.sin(heading), 0.0])
    back = np.linalg.inv(np.column_stack([quat_rotate(q, e) for e in np.eye(3)]))
    rates = 0.5 * np.array([-np.sin(pitch), np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch)])
    return Reading(t, np.asarray(place), np.asarray(q), np.array([*(back @ level), *rates]), True)


def test_odom_follows_the_way_by_velocities_alone():
    """After a whole turn of the circle odom returns to its start, to a millimetre."""
    odometer = Odometer()
    poses = [odometer.take(circle(i * DT)) for i in range(round(4.0 * np.pi / DT) + 1)]
    assert poses[0].position == pytest.approx(circle(0.0).position)
    assert poses[-1].position == pytest.approx(circle(4.0 * np.pi).position, abs=2e-3)
    roll, pitch, _ = quat_to_euler(poses[-1].orientation)
    assert (roll, pitch) == pytest.approx((0.1, -0.2))


def test_odom_does_not_jump_when_a_fix_does():
    """The jump enters map to odom, which with odom to base_link gives the estimate at every moment."""
    odometer, before = Odometer(), None
    for i in range(120):
        moved = {"yaw": 0.4, "shift": (0.3, -0.2, 0.1)} if i >= 60 else {}
        reading = circle(i * DT, **moved)
        odom = odometer.take(reading)
        drift = FramePose(reading.position, reading.quaternion).times(odom.inverse())
        made = drift.times(odom)
        assert made.position == pytest.approx(reading.position)
        assert abs(made.orientation @ reading.quaternion) == pytest.approx(1.0)
        roll, pitch, yaw = quat_to_euler(drift.orientation)
        assert (roll, pitch) == pytest.approx((0.0, 0.0), abs=1e-9) and yaw == pytest.approx(
            0.4 * (i >= 60), abs=0.01
        )
        if before is not None:
            assert np.linalg.norm(odom.position - before) < 0.51 * DT * 1.05
        before = odom.position


def test_odom_stands_still_over_a_gap_and_over_bad_numbers():
    """Motion during a gap is unknown."""
    odometer = Odometer()
    first = odometer.take(circle(0.0)).position
    assert odometer.take(circle(3.0)).position == pytest.approx(first)
    bad = circle(3.1)
    bad.nu[0] = np.nan
    assert odometer.take(bad).position == pytest.approx(first)


def test_the_optical_frame_looks_along_x_of_its_body():
    """The optical frame has z forward, x right, y down (REP-103)."""
    assert np.column_stack([quat_rotate(OPTICAL, e) for e in np.eye(3)]) == pytest.approx(
        np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    )
