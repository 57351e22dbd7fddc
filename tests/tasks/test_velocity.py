"""Velocity control: commands, observations and scoring, against NumPy and SciPy."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from finssim.agents import baseline
from finssim.control.axis_model import axis_model
from finssim.control.trajectories import TRAJECTORIES
from finssim.tasks import Environment, EnvironmentSetupError, make
from finssim.tasks.observer import Observer
from finssim.tasks.velocity import VelocityControl
from finssim.vehicles import load_vehicle

TASK = VelocityControl()
FINSROV = load_vehicle("finsrov")


def truth(env):
    """Return attitude, commanded attitude, twist and commanded velocity in the world, by world."""
    state, a = env.simulator.state, env.arrays
    q, goal = (Rotation.from_quat(x.numpy().reshape(-1, 4)) for x in (state.quaternion, a.goal_quaternion))
    return q, goal, state.velocity.numpy()[:, 0].astype(float), a.target.velocity.numpy().astype(float)


def errors(env):
    """Return errors of velocity [m/s] and attitude [rad], by world."""
    q, goal, nu, wanted = truth(env)
    return np.linalg.norm(q.apply(nu[:, :3]) - wanted, axis=1), (q.inv() * goal).magnitude()


def test_it_sees_what_is_missing_its_own_motion_and_what_is_up():
    """18 numbers: velocity error over 0.2 m/s, two columns of the rotation to the goal, twist within 2, up."""
    env = Environment(TASK, worlds=32, seed=1)
    for _ in range(20):
        step = env.step(np.random.default_rng(0).uniform(-1.0, 1.0, (32, 6)))
    q, goal, nu, wanted = truth(env)
    columns = (q.inv() * goal).as_matrix()[:, :, :2].transpose(0, 2, 1).reshape(-1, 6)
    up = q.inv().apply([0.0, 0.0, 1.0])
    missing = (q.inv().apply(wanted) - nu[:, :3]) / 0.2
    np.testing.assert_allclose(
        step.observation, np.concatenate([missing, columns, np.clip(nu, -2.0, 2.0), up], axis=1), atol=1e-5
    )


def test_commands_keep_their_limits_and_their_time():
    """Speed, tilt and turn between commands are within their limits, with a new one every 5 s but not at the
    end."""
    env = Environment(TASK, worlds=256, seed=2, auto_reset=False)
    given, headings = [], []
    for _ in range(200):
        env.step(np.zeros((256, 6)))
        _, goal, _, wanted = truth(env)
        given.append(wanted)
        headings.append(goal.as_euler("ZYX"))
    changed = np.flatnonzero(np.abs(np.diff(given, axis=0)).max(axis=(1, 2)) > 0.0)
    np.testing.assert_array_equal(changed + 2, [50, 100, 150])  # row k is after step k + 1
    speeds = np.linalg.norm(given, axis=2)
    assert 0.95 * TASK.fastest < speeds.max() <= TASK.fastest * (1.0 + 1e-5)
    yaw, pitch, roll = np.moveaxis(headings, -1, 0)
    lean = env.task.lean + 1e-4
    assert 0.95 * lean < np.abs(pitch).max() <= lean and np.abs(roll).max() <= lean
    turns = np.abs(np.angle(np.exp(1j * np.diff(yaw[[0, 60, 110, 160]], axis=0))))
    assert 0.95 * TASK.turn < turns.max() <= TASK.turn + 1e-3


def test_tilts_are_those_that_half_of_the_moment_holds():
    """k sin(lean) = limit / 2 on FinsROV's weaker axis; a vehicle with a small righting moment has the
    published tilts."""
    lean = TASK.fitted([FINSROV]).lean
    stiffness = axis_model(FINSROV).stiffness[3:5]
    assert (stiffness * math.sin(lean) / FINSROV.wrench_limits[3:5]).max() == pytest.approx(0.5)
    assert TASK.fitted([load_vehicle("bluerov2_heavy")]).lean == TASK.lean
    with pytest.raises(EnvironmentSetupError, match="pitch"):
        make("velocity6", vehicle="bluerov2")


def test_the_errors_of_an_episode_are_rms():
    env = Environment(replace(TASK, time_limit=6.0), worlds=8, seed=3, auto_reset=False)
    seen = []
    for _ in range(60):
        env.step(np.full((8, 6), 0.1))
        seen.append(errors(env))
    velocity, attitude = np.sqrt(np.mean(np.square(seen), axis=0))
    measured = env.task.metrics(env.arrays)
    np.testing.assert_allclose(measured["velocity_error"], velocity, rtol=1e-4)
    np.testing.assert_allclose(measured["attitude_error"], attitude, rtol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("vehicle", "observe"), [("finsrov", "estimator"), ("bluerov2_heavy", "truth")])
def test_the_pid_holds_what_is_commanded(vehicle, observe):
    """It does so in at least 15 of 16 episodes, level or at 45°."""
    env = make("velocity6", worlds=16, vehicle=vehicle, seed=4, observe=observe)
    player = baseline(env.task, "pid", load_vehicle(vehicle))
    memory, observation = player.reset(16), env.reset()
    for _ in range(200):
        action, memory = player.act(memory, observation)
        observation = env.step(action).observation
    assert env.task.metrics(env.arrays)["success"].sum() >= 15


def test_on_a_robot_the_references_motion_is_the_command():
    """A policy follows a trajectory by the velocity and heading of the reference."""
    observer, guide = Observer("velocity6", FINSROV), TRAJECTORIES["circle"]

    class At:
        position, quaternion, nu = np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(6)

    now = guide.at(7.0)
    seen = observer.observe(At(), guide, 7.0)
    np.testing.assert_allclose(0.2 * seen[:3], now.velocity, atol=1e-6)
    np.testing.assert_allclose(seen[3:5], [math.cos(now.yaw), math.sin(now.yaw)], atol=1e-6)
