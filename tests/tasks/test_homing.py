"""Docking by bearing: draws, observations, scoring, and the baseline in a current."""

import math

import numpy as np
import pytest

from finssim.agents import baseline, restarted
from finssim.control.guidance import Station, Track
from finssim.core.rotations import quat_from_euler, quat_inverse_rotate
from finssim.sim import Water
from finssim.tasks import make
from finssim.tasks.homing import Homing
from finssim.tasks.observer import Observer
from reference.tails import tailed

VEHICLE = tailed("cruciform")


def placed(env, position, q, velocity):
    """Return observation and metrics after a step from a state of the only world."""
    env.simulator.state.position.assign(np.asarray(position, np.float32)[None, None])
    env.simulator.state.quaternion.assign(np.asarray(q, np.float32)[None, None])
    env.simulator.state.velocity.assign(np.asarray([velocity], np.float32)[None])
    return env.step(np.zeros((1, 3)))


def axis_of(env):
    """Return mouth and axis of every world's dock."""
    points = env.arrays.path.points.numpy().astype(float)
    way = points[:, 1] - points[:, 0]
    return points[:, 1], way / np.linalg.norm(way, axis=1, keepdims=True)


def test_starts_are_before_the_mouth_and_about_towards_it():
    env = make("homing", worlds=200, vehicle=VEHICLE, seed=2)
    task, (mouth, axis) = env.task, axis_of(env)
    way = (mouth - env.simulator.state.position.numpy()[:, 0]) / task.fit.size
    far = np.hypot(way[:, 0], way[:, 1])
    assert task.far[0] - 1e-3 <= far.min() < far.max() <= task.far[1] + 1e-3
    assert np.abs(way[:, 2]).max() <= task.offset + 1e-3
    aspect = np.arccos((way[:, :2] * axis[:, :2]).sum(axis=1) / far)
    assert 0.9 * task.aspect < aspect.max() <= task.aspect + 1e-3
    assert len(set(np.round(np.arctan2(axis[:, 1], axis[:, 0]), 3))) > 150


def test_the_bearing_and_the_axis_are_seen_in_the_body():
    env = make("homing", worlds=1, vehicle=VEHICLE, seed=3, auto_reset=False)
    (mouth,), (axis,) = axis_of(env)
    q = quat_from_euler(0.1, -0.2, 1.3)
    o = placed(env, mouth - [9.0, -4.0, 2.0], q, np.zeros(6)).observation[0].astype(float)
    at = env.simulator.state.position.numpy()[0, 0].astype(float)
    turned = env.simulator.state.quaternion.numpy()[0, 0].astype(float)
    way = (mouth - at) / np.linalg.norm(mouth - at)
    assert o[:3] == pytest.approx(quat_inverse_rotate(turned, way), abs=1e-4)
    assert o[3:6] == pytest.approx(quat_inverse_rotate(turned, axis), abs=1e-4)


@pytest.mark.parametrize(
    ("beside", "slant", "end"),
    [(0.0, 0.0, "docked"), (0.4, 0.3, "docked"), (0.6, 0.0, "missed"), (0.0, 0.4, "missed")],
)
def test_what_counts_is_where_and_how_the_mouth_is_passed(beside, slant, end):
    """Within half a metre and 20°, both in proportion to nothing but the speed for the first."""
    env = make("homing", worlds=1, vehicle=VEHICLE, seed=3, auto_reset=False)
    (mouth,), (axis,) = axis_of(env)
    course = math.atan2(axis[1], axis[0])
    left, size = np.array([-axis[1], axis[0], 0.0]), env.task.fit.size
    speed = env.task.fit.speed
    start = mouth - 0.05 * speed * axis + size * beside * left - 0.05 * speed * math.sin(slant) * left
    step = placed(env, start, quat_from_euler(0.0, 0.0, course + slant), [speed, 0, 0, 0, 0, 0])
    assert step.terminated[0]
    measured = env.task.metrics(env.arrays)
    assert measured[end][0] == 1.0 and measured["success"][0] == (end == "docked")
    assert measured["error"][0] == pytest.approx(size * beside, abs=0.05)


def test_a_robot_that_is_sent_to_a_station_sees_its_yaw_as_the_axis():
    observer = Observer("homing", VEHICLE)
    me = Track(np.array([-20.0, 5.0, -10.0]), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(6))
    o = observer.observe(me, Station((0.0, 0.0, -10.0), 0.5), 0.0)
    assert o[:3] == pytest.approx(np.array([20.0, -5.0, 0.0]) / math.hypot(20.0, 5.0), abs=1e-5)
    assert o[3:6] == pytest.approx([math.cos(0.5), math.sin(0.5), 0.0], abs=1e-5)


@pytest.mark.slow
def test_the_baseline_docks_in_a_current():
    """Nearly all of 64 dock in 0.4 m/s, a quarter of their speed."""
    n, task = 64, Homing()
    env = make(task, worlds=n, vehicle=VEHICLE, seed=1, water=Water(current=(0.4, 0.0, 0.0), depth=60.0))
    player = baseline(task, "bearing", VEHICLE)
    memory, observation = player.reset(n), env.reset()
    success = np.full(n, np.nan)
    for _ in range(round(task.time_limit / task.control_step)):
        action, memory = player.act(memory, observation)
        step = env.step(action)
        ended = step.terminated | step.truncated
        first = ended & np.isnan(success)
        success[first] = env.task.metrics(env.arrays)["success"][first]
        memory, observation = restarted(memory, player.reset(n), ended), step.observation
    assert success.mean() > 0.95
