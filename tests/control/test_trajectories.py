"""The published trajectories have their published properties, and each velocity is the derivative of the position."""

from dataclasses import replace

import numpy as np
import pytest

from finssim.control import ControlError
from finssim.control.guidance import goal_at
from finssim.control.trajectories import (
    TRAJECTORIES,
    Trajectory,
    check_vehicle,
    load_trajectory,
    polyline,
)
from finssim.core.rotations import quat_from_yaw
from finssim.vehicles import load_vehicle

FINSROV = load_vehicle("finsrov")
EVERY = pytest.mark.parametrize("name", TRAJECTORIES)
PUBLISHED = {
    "straight": (30.0, 2.0 * 1.5 * np.hypot(1.0, 0.4) / 30.0),
    "broken": (90.0, 1.5 * np.hypot(2.0, 0.8) / 32.0),
    "ellipse": (92.70, 0.1031),
    "lemniscate": (30.0, 2.0 * np.pi * np.hypot(0.4, 0.2) / 30.0),
    "circle": (137.142857, 2.0 * np.pi * 0.5 * 3.0 / 137.142857),
    "figure_eight": (117.0857, 2.0 * np.pi * np.hypot(1.0, 0.8) / 117.0857),
}
"""Duration [s] and greatest speed [m/s]."""
FASTEST_CHANGE = 0.08
"""Largest published acceleration [m/s²]."""


@EVERY
def test_the_velocity_is_the_derivative_of_the_position(name):
    """Central differences over 2 ms have an error of h² x''' / 6, and of h x'' / 2 at a corner."""
    trajectory, h = TRAJECTORIES[name], 1e-3
    t = np.linspace(h, trajectory.duration - h, 5001)
    slope = (trajectory.at(t + h).position - trajectory.at(t - h).position) / (2.0 * h)
    np.testing.assert_allclose(trajectory.at(t).velocity, slope, atol=0.5 * h * FASTEST_CHANGE)
    inner = np.abs(t[:, None] - np.array([0.0, 32.0, 45.0, 77.0, 90.0])).min(axis=1) > 2.0 * h
    np.testing.assert_allclose(trajectory.at(t).velocity[inner], slope[inner], atol=1e-7)


@pytest.mark.parametrize(("name", "duration", "peak"), [(n, *v) for n, v in PUBLISHED.items()])
def test_the_published_durations_and_peaks_are_met(name, duration, peak):
    """The ellipse's peak of 0.1031 m/s is published; the others follow from shape and duration."""
    trajectory = TRAJECTORIES[name]
    assert trajectory.duration == pytest.approx(duration, abs=1e-6)
    speed = np.linalg.norm(trajectory.at(np.linspace(0.0, duration, 50001)).velocity, axis=-1).max()
    assert speed == pytest.approx(peak, abs=5e-5)


@EVERY
def test_every_trajectory_keeps_to_the_published_limits_and_suits_the_vehicle(name):
    """Limits are 0.15 m/s, 0.08 m/s² and 1.2 m x 0.7 m around the middle, from 0.9 m to 0.25 m below the surface."""
    t = np.linspace(0.0, TRAJECTORIES[name].duration, 10001)
    reference = TRAJECTORIES[name].at(t)
    assert np.linalg.norm(reference.velocity, axis=-1).max() <= 0.15
    assert np.linalg.norm(np.gradient(reference.velocity, t, axis=0), axis=-1).max() <= FASTEST_CHANGE
    assert (np.abs(reference.position - (0.0, 0.0, -0.325)) <= (1.2, 0.7, 0.575)).all()
    check_vehicle(TRAJECTORIES[name], FINSROV)


def test_the_published_plane_is_ours_with_its_z_as_our_y():
    """The controller frame's (x, y up, z left) is our (x, y = its z left, z = its y up)."""
    np.testing.assert_allclose(TRAJECTORIES["straight"].at(0.0).position, [-1.0, -0.4, -0.5])
    corners = TRAJECTORIES["broken"].at(np.array([0.0, 32.0, 45.0, 77.0, 90.0])).position
    expected = [(-1, -0.4), (1, 0.4), (1, -0.4), (-1, 0.4), (-1, -0.4)]
    np.testing.assert_allclose(corners[:, :2], expected, atol=1e-12)
    assert np.all(corners[:, 2] == -0.5)


@EVERY
def test_beyond_its_ends_a_trajectory_is_held_at_rest(name):
    trajectory = TRAJECTORIES[name]
    early, late = trajectory.at(-3.0), trajectory.at(trajectory.duration + 3.0)
    np.testing.assert_allclose(early.position, trajectory.at(0.0).position)
    np.testing.assert_allclose(late.position, trajectory.at(trajectory.duration).position)
    assert not early.velocity.any() and not late.velocity.any()
    assert (early.progress, late.progress) == (0.0, 1.0)


@EVERY
def test_many_times_at_once_are_those_one_by_one(name):
    trajectory = TRAJECTORIES[name]
    t = np.linspace(-1.0, trajectory.duration + 1.0, 24).reshape(4, 6)
    many, one = trajectory.at(t), trajectory.at(t[2, 3])
    assert many.position.shape == (4, 6, 3) and many.yaw.shape == many.progress.shape == (4, 6)
    np.testing.assert_array_equal(many.position[2, 3], one.position)
    np.testing.assert_array_equal(many.velocity[2, 3], one.velocity)


def test_the_heading_is_kept_or_looks_along_the_way():
    """A fixed heading is the given angle; a tangent one is that of the velocity, also at the rests of a
    straight line."""
    assert np.all(load_trajectory("circle", yaw=0.7).at(np.linspace(0.0, 99.0, 9)).yaw == pytest.approx(0.7))
    tangent = load_trajectory("circle", heading="tangent")
    v = tangent.at(10.0).velocity
    assert tangent.at(10.0).yaw == pytest.approx(np.arctan2(v[1], v[0]), abs=1e-4)
    ends = load_trajectory("straight", heading="tangent", yaw=0.1).at(np.array([0.0, 15.0, 30.0])).yaw
    np.testing.assert_allclose(ends, np.arctan2(0.8, 2.0) + 0.1, atol=1e-9)


def test_a_trajectory_guides_a_pose_controller():
    """`goal_at` gives position, velocity and a level attitude with the required heading."""
    trajectory = load_trajectory("lemniscate", yaw=0.3)
    goal, reference = goal_at(trajectory, 4.0), trajectory.at(4.0)
    np.testing.assert_array_equal(goal.position, reference.position)
    np.testing.assert_array_equal(goal.velocity, reference.velocity)
    np.testing.assert_allclose(goal.quaternion, quat_from_yaw(0.3))


def test_the_published_name_of_the_broken_line_is_known():
    assert load_trajectory("straight_pro").name == "broken"


def test_a_vehicle_refuses_what_it_cannot_follow():
    """FinsROV refuses to exceed its 0.345 m/s sideways, and to leave its pool, which ends at y = 1 m."""

    def line(y, duration):
        _, motion = polyline([(0.0, 0.0, -0.5), (0.0, y, -0.5)], [duration])
        return Trajectory(name="line", duration=duration, motion=motion)

    check_vehicle(line(0.8, 4.0), FINSROV)
    with pytest.raises(ControlError, match=r"sway of .* goes 0\.34"):
        check_vehicle(line(0.8, 3.0), FINSROV)
    check_vehicle(replace(line(0.8, 3.0), heading="tangent"), FINSROV)  # it is fast enough forwards
    with pytest.raises(ControlError, match="y is 1"):
        check_vehicle(line(1.2, 20.0), FINSROV)


def test_what_is_no_trajectory_is_refused():
    with pytest.raises(ControlError, match="no trajectory 'elipse'.*ellipse"):
        load_trajectory("elipse")
    with pytest.raises(ControlError, match="heading is 'north'"):
        load_trajectory("circle", heading="north")
    for wrong in (0.0, 1e19, float("nan")):
        with pytest.raises(ControlError, match="duration is .* s, expected more than 0 and at most 86400"):
            replace(TRAJECTORIES["circle"], duration=wrong)


@EVERY
def test_a_published_trajectory_grows_with_the_vehicle(name):
    """Path and speed are scaled with the vehicle, the duration is not; FinsROV's trajectory is the published one."""
    published, own = TRAJECTORIES[name], load_trajectory(name, vehicle=load_vehicle("rexrov"))
    t = np.linspace(0.0, published.duration, 50)
    for part in ("position", "velocity"):
        np.testing.assert_allclose(getattr(own.at(t), part), 2.6 / 0.6 * getattr(published.at(t), part))
    assert load_trajectory(name, vehicle=FINSROV) is published
