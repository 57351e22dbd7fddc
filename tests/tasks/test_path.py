"""Tasks along a path in space: draws, observations, and the baseline in a current."""

import math

import numpy as np
import pytest

from finssim.agents import baseline, restarted
from finssim.control.course import course_speeds
from finssim.control.path_following import Waypoints
from finssim.core.rotations import quat_from_euler
from finssim.sim import Water
from finssim.tasks import EnvironmentSetupError, make
from finssim.tasks.path import ERROR_SCALE, PathFollowing, WaypointTour, follow_path
from reference.tails import tailed

VEHICLE = tailed("cruciform")
TASKS = pytest.mark.parametrize("kind", [PathFollowing, WaypointTour])


def paths_of(env):
    return env.arrays.path.points.numpy().astype(float)


def test_drawn_paths_keep_their_bounds():
    """Legs have equal length, bends at least the radius, slopes at most the limit, all under water."""
    env = make("path", worlds=200, vehicle=VEHICLE, seed=2)
    task, x = env.task, paths_of(env)
    way = np.diff(x, axis=1)
    length = np.linalg.norm(way, axis=2)
    assert length == pytest.approx(np.full(length.shape, task.fit.size * task.spacing), rel=1e-3)
    slope = np.abs(way[..., 2]) / length
    assert math.sin(0.9 * task.slope) < slope.max() <= math.sin(task.slope) + 1e-5
    turn = np.diff(np.unwrap(np.arctan2(way[..., 1], way[..., 0]), axis=1), axis=1)
    radius = task.fit.size * task.spacing / np.abs(turn).max()
    assert task.fit.size * task.bend_radius * 0.99 < radius < task.fit.size * task.bend_radius * 1.2
    assert x[..., 2].max() < -3.0 and len({points.tobytes() for points in x}) == 200


def test_drawn_waypoints_keep_their_bounds():
    env = make("waypoints", worlds=200, vehicle=VEHICLE, seed=2)
    task, x = env.task, paths_of(env)
    length = np.linalg.norm(np.diff(x, axis=1), axis=2) / task.fit.size
    assert task.leg[0] <= length.min() < length.max() <= task.leg[1] + 1e-3
    assert x[..., 2].max() < -3.0


def test_the_cruise_is_what_action_zero_asks_for():
    speeds = course_speeds(VEHICLE)
    task = PathFollowing().fitted([VEHICLE])
    assert task.fit.speed == pytest.approx(0.5 * (speeds[0] + speeds[-1]))
    assert task.fit.size == pytest.approx(task.fit.speed / 1.5)


def test_the_errors_that_are_seen_are_those_of_the_path():
    """Distances and directions of the kernels equal those of `Waypoints`, for tilted vehicles."""
    path = Waypoints([[0, 0, -10], [20, 5, -12], [25, 30, -8], [60, 30, -8], [60, 60, -9]], radius=2.0)
    env = make("waypoints", worlds=3, vehicle=VEHICLE, seed=3, auto_reset=False)
    follow_path(env, [path] * 3)
    x = np.array([[10.0, 1.0, -10.0], [3.0, 2.0, -11.0], [19.5, 4.0, -12.0]])
    q = quat_from_euler(np.array([0.1, 0.0, -0.2]), np.array([0.2, -0.1, 0.0]), np.array([0.3, 1.0, -2.0]))
    env.simulator.state.position.assign(x[:, None].astype(np.float32))
    env.simulator.state.quaternion.assign(q[:, None].astype(np.float32))
    env.simulator.state.velocity.zero_()
    o = env.step(np.zeros((3, 3))).observation.astype(float)
    at = env.simulator.state.position.numpy()[:, 0].astype(float)  # it moved on for a control step
    errors, leg, done = path.errors(path.reset(3), at)
    assert leg.tolist() == env.arrays.path.leg.numpy().tolist() == [0, 0, 1] and not done.any()
    seen = ERROR_SCALE * env.task.fit.size * o[:, :2]
    assert seen == pytest.approx(np.clip(np.column_stack([errors.across, errors.above]), -9.4, 9.4), abs=2e-3)
    slope = -np.arcsin((o[:, 2:5] * o[:, 17:20]).sum(axis=1))
    assert slope == pytest.approx(errors.slope, abs=1e-4)


@TASKS
def test_paths_that_do_not_fit_are_refused(kind):
    env = make(kind(), worlds=2, vehicle=VEHICLE)
    short = Waypoints([[0, 0, -5], [9, 0, -5]])
    with pytest.raises(EnvironmentSetupError, match="1 paths for 2 worlds"):
        follow_path(env, [short])
    with pytest.raises(EnvironmentSetupError, match=f"paths have 1 legs, expected {kind().legs}"):
        follow_path(env, [short, short])
    with pytest.raises(EnvironmentSetupError, match="give one for each world of a task along a path"):
        follow_path(make("t1", worlds=2), [short, short])


def played(task, vehicle, n=64, current=0.4):
    """Return success, error and arrival at the end in the first episode of n worlds, by the baseline."""
    env = make(task, worlds=n, vehicle=vehicle, seed=1, water=Water(current=(current, 0.0, 0.0), depth=60.0))
    player = baseline(task, "line-of-sight", vehicle)
    memory, observation = player.reset(n), env.reset()
    found = {name: np.full(n, np.nan) for name in ("success", "error", "finished")}
    for _ in range(round(env.task.time_limit / env.task.control_step)):
        action, memory = player.act(memory, observation)
        step = env.step(action)
        ended = step.terminated | step.truncated
        measured = env.task.metrics(env.arrays)
        for name, values in found.items():
            first = ended & np.isnan(values)
            values[first] = measured[name][first]
        memory, observation = restarted(memory, player.reset(n), ended), step.observation
    return found


@pytest.mark.slow
@TASKS
@pytest.mark.parametrize("tail", ["cruciform", "x"])
def test_the_baseline_follows_in_a_current(kind, tail):
    """Nearly all of 64 reach the end in 0.4 m/s, a quarter of their speed."""
    found = played(kind(), tailed(tail))
    assert found["success"].mean() > 0.95
    assert found["error"].mean() < (0.25 if kind is PathFollowing else 1.2)


@pytest.mark.slow
def test_an_end_that_is_reached_beside_the_path_is_no_success():
    found = played(PathFollowing(tolerance=0.02), VEHICLE, n=16)
    assert found["finished"].min() == 1.0 and found["success"].max() == 0.0
