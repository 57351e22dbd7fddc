"""Trajectories from files are followed as written, and an invalid file is refused in one sentence."""

import numpy as np
import pytest

from finssim.control import ControlError
from finssim.control.trajectories import TRAJECTORIES, load_trajectory, read_trajectory, through_points


def test_a_table_of_samples_follows_the_motion_they_were_taken_from(tmp_path):
    """A circle sampled at 10 Hz is recovered within a tenth of a millimetre and 2 mm/s, after its start from rest."""
    circle = TRAJECTORIES["circle"]
    t = np.arange(0.0, 60.0, 0.1)
    rows = np.column_stack([t, circle.at(t).position])
    path = tmp_path / "round.csv"
    np.savetxt(path, rows, delimiter=",", header="t,x,y,z", comments="", fmt="%.9g")
    again = load_trajectory(path)
    times = np.linspace(0.2, 59.0, 5001)
    np.testing.assert_allclose(again.at(times).position, circle.at(times).position, atol=1e-4)
    np.testing.assert_allclose(again.at(times).velocity, circle.at(times).velocity, atol=2e-3)
    assert (again.name, again.duration) == ("round", pytest.approx(59.9))


def test_the_way_passes_every_point_and_never_swings_beyond_two_neighbours():
    rng = np.random.default_rng(3)
    points = np.column_stack([np.arange(12.0), rng.uniform(-1.0, 1.0, (12, 3))])
    trajectory = through_points("random", points)
    np.testing.assert_allclose(trajectory.at(points[:, 0]).position, points[:, 1:], atol=1e-12)
    for a, b in zip(points[:-1], points[1:], strict=True):
        between = trajectory.at(np.linspace(a[0], b[0], 50)).position
        assert np.all(between >= np.minimum(a[1:], b[1:]) - 1e-12)
        assert np.all(between <= np.maximum(a[1:], b[1:]) + 1e-12)


def test_its_velocity_is_the_derivative_of_its_position():
    points = [(0.0, 0.0, 0.0, -0.5), (2.0, 0.5, 0.1, -0.5), (5.0, 0.7, 0.4, -0.4), (6.0, 0.7, 0.4, -0.4)]
    trajectory, h = through_points("some", points), 1e-4
    t = np.linspace(0.01, 5.99, 997)
    slope = (trajectory.at(t + h).position - trajectory.at(t - h).position) / (2.0 * h)
    np.testing.assert_allclose(trajectory.at(t).velocity, slope, atol=1e-6)
    assert not trajectory.at(np.array([0.0, 5.5, 6.0])).velocity.any()  # equal points are a rest


def test_a_heading_column_is_followed_the_short_way_round():
    points = [(0.0, 0, 0, -0.5, 3.0), (10.0, 1, 0, -0.5, -3.0)]
    yaw = through_points("turn", points).at(np.linspace(0.0, 10.0, 101)).yaw
    assert np.all(np.abs(yaw) >= 3.0 - 1e-12)
    np.testing.assert_allclose(yaw[[0, 100]], [3.0, -3.0])


def test_a_shape_with_its_measures_is_the_shape(tmp_path):
    path = tmp_path / "lap.yaml"
    path.write_text(
        "name: lap\nheading: tangent\nyaw: 0.2\n"
        "shape: {kind: circle, radius: 0.5, turns: 3, duration: 137.142857142857, depth: -0.4}\n"
    )
    lap, t = load_trajectory(path), np.linspace(0.0, 137.0, 50)
    np.testing.assert_allclose(
        lap.at(t).position[:, :2], TRAJECTORIES["circle"].at(t).position[:, :2], atol=1e-9
    )
    assert np.all(lap.at(t).position[:, 2] == -0.4)
    assert (lap.name, lap.heading, lap.yaw) == ("lap", "tangent", 0.2)


def test_corners_with_times_are_driven_from_rest_to_rest(tmp_path):
    path = tmp_path / "corners.yaml"
    path.write_text(
        "shape: {kind: polyline, points: [[0, 0, -0.5], [1, 0, -0.5], [1, 0.5, -0.6]], durations: [20, 10]}\n"
    )
    corners = read_trajectory(path)
    assert corners.duration == 30.0
    np.testing.assert_allclose(corners.at(np.array([20.0, 30.0])).position, [[1, 0, -0.5], [1, 0.5, -0.6]])
    np.testing.assert_allclose(corners.at(np.array([0.0, 20.0, 30.0])).velocity, 0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("a.csv", "x,y,z\n0,0,0\n", "header is 'x,y,z', expected t,x,y,z"),
        ("a.csv", "", "header is ''"),
        ("a.csv", "t,x,y,z\n0,0,0,0\n", "expected two or more rows"),
        ("a.csv", "t,x,y,z\n0,0,0,0\n1,a,0,0\n", "rows of 4 or 5 numbers"),
        ("a.csv", "t,x,y,z\n0,0,0,0\n1,nan,0,0\n", "point 2 is .*expected finite"),
        ("a.csv", "t,x,y,z\n0,0,0,0\n2,0,0,0\n2,1,0,0\n", "point 3 is at 2 s, not after"),
        ("a.csv", "t,x,y,z\n1,0,0,0\n2,0,0,0\n", "first time is 1 s"),
        ("a.yaml", "points: [[0, 0, 0, 0], [1, 0, 0]]\n", "rows of 4 or 5 numbers"),
        ("a.yaml", "name: x\n", "either 'points' or 'shape'"),
        ("a.yaml", "point: 1\n", "unknown key 'point'"),
        ("a.yaml", "shape: {kind: square}\n", "'kind' is one of polyline"),
        ("a.yaml", "shape: {kind: circle, radius: -1, turns: 1, duration: 9}\n", "radius is -1"),
        ("a.yaml", "shape: {kind: circle, radius: 1, duration: 9}\n", "turns"),
        ("a.yaml", "shape: {kind: circle, radius: 1, turns: 1}\n", "duration"),
        ("a.yaml", "yaw: north\npoints: [[0, 0, 0, 0], [1, 0, 0, 0]]\n", "yaw is 'north'"),
        ("a.yaml", "heading: up\npoints: [[0, 0, 0, 0], [1, 0, 0, 0]]\n", "heading is 'up'"),
    ],
)
def test_what_is_wrong_is_told_with_the_files_name(tmp_path, name, text, said):
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(ControlError, match=said) as told:
        load_trajectory(path)
    assert str(path) in str(told.value)
