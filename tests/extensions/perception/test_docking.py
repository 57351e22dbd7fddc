"""Docking: observations, rewards, ends and counts, compared with NumPy and SciPy."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from finssim.tasks import Environment, make
from finssim.tasks.docking import Docking, HullNumbers
from finssim.vehicles import load_vehicle
from reference.cases import THRUSTED

TASK = Docking()
LEVEL = (0.0, 0.0, 0.0, 1.0)
DEEP = (0.0, 0.0, -1.4)


def truth(env):
    """Return the nose in dock axes, the rotation of the dock in the body, body to world, and the twist."""
    state, a = env.simulator.state, env.arrays
    R = Rotation.from_quat(state.quaternion.numpy()[:, 0])
    R_dock = Rotation.from_quat(a.goal_quaternion.numpy())
    tip = state.position.numpy()[:, 0] + R.apply([0.5 * env.task.hull.length, 0.0, 0.0])
    nose = R_dock.inv().apply(tip - a.goal_position.numpy())
    return nose, R.inv() * R_dock, R, state.velocity.numpy()[:, 0].astype(float)


def at(env, nose, **options):
    """Place vehicles at rest with their noses at points in dock axes, the dock pointing along world x."""
    nose = np.atleast_2d(np.asarray(nose, float))
    env.start(nose - [0.5 * env.task.hull.length, 0.0, 0.0] + np.array(DEEP), LEVEL, DEEP, LEVEL)


def berth(env):
    return env.task.berth * env.task.dock().tube_length


def test_the_observation_says_where_the_berth_is_and_how_the_dock_stands():
    env = make("docking", worlds=64)
    rng = np.random.default_rng(0)
    for _ in range(10):
        step = env.step(rng.uniform(-1.0, 1.0, (64, 6)))
    nose, relative, _, nu = truth(env)
    offset = relative.apply([berth(env), 0.0, 0.0] - nose)
    M = relative.as_matrix()
    expected = [
        offset / 3.0, M[:, :, 0], M[:, :, 1], np.clip(nu, -2.0, 2.0), nose / 3.0,
        np.minimum(np.linalg.norm(offset, axis=1, keepdims=True) / 3.0, 1.0),
    ]  # fmt: skip
    np.testing.assert_allclose(step.observation, np.concatenate(expected, axis=1), atol=3e-6)


def test_the_reward_is_the_sum_of_its_terms():
    """The reward is the sum of its terms with and without contact: some worlds press against the tube's end."""
    env, r = make("docking", worlds=32), TASK.reward
    length, dock = env.task.hull.length, env.task.dock()
    places = np.zeros((32, 3))
    places[:, 0] = np.linspace(-1.0, dock.tube_length, 32)
    places[:, 1] = np.linspace(-1.0, 0.0, 32)
    at(env, places)
    rng = np.random.default_rng(2)
    before, action = rng.uniform(0.0, 1.5, (2, 32, 6))
    crashed = env.step(before).terminated
    step = env.step(action)
    nose, relative, _, nu = truth(env)
    push = env.simulator.funnel.force.numpy()[:, 0]
    assert (push > 0.0).any() and (push == 0.0).any()
    e = np.linalg.norm([berth(env), 0.0, 0.0] - nose, axis=1) / length
    allowed = dock.throat_radius - env.task.hull.girth + math.tan(TASK.cone) * np.maximum(-nose[:, 0], 0.0)
    off = np.maximum(np.hypot(nose[:, 1], nose[:, 2]) - allowed, 0.0) / length
    theta = relative.magnitude()
    a, previous = np.clip(action, -1.0, 1.0), np.clip(before, -1.0, 1.0)
    expected = r.position * np.exp(-e / r.position_scale) - r.distance * e - r.corridor * off
    expected += r.heading * np.exp(-theta / r.heading_scale) - r.turn * theta
    expected -= r.contact * np.minimum(push / env.task.force_limit, 1.0)
    expected -= r.action * np.mean(a**2, axis=1) + r.change * np.mean((a - previous) ** 2, axis=1)
    expected -= r.rate * np.minimum(np.sum(nu[:, 3:] ** 2, axis=1), 4.0)
    going_on = ~step.terminated & ~crashed
    assert going_on.sum() > 16 and (push > 0.0)[going_on].any()
    np.testing.assert_allclose(step.reward[going_on], expected[going_on], atol=2e-5)


def test_resting_in_the_berth_earns_the_most_there_is():
    env = make("docking")
    at(env, [berth(env), 0.0, 0.0])
    reward = env.step(np.zeros((1, 6))).reward[0]
    most = TASK.reward.position + TASK.reward.heading
    assert reward == pytest.approx(most, abs=0.01) and reward <= most


@pytest.mark.parametrize(("part", "success"), [(0.55, 1.0), (0.4, 0.0)])
def test_success_is_a_nose_in_the_tube_for_a_while(part, success):
    """Success is a nose beyond half of the tube, at rest, for two seconds; its time is the end of these two
    seconds."""
    env = Environment(replace(TASK, time_limit=3.0), worlds=2)
    at(env, [part * env.task.dock().tube_length, 0.0, 0.0])
    for _ in range(30):
        env.step(np.zeros((2, 6)))
    measured = env.task.metrics(env.arrays)
    assert measured["success"].tolist() == [success] * 2
    np.testing.assert_allclose(measured["success_time"], 2.0 if success else np.nan, atol=1e-6)
    assert measured["contact_impulse"].tolist() == [0.0] * 2 and measured["crash"].tolist() == [0.0] * 2


def test_a_press_is_counted_and_allowed():
    """Full thrust against the end adds an impulse of thrust times time, and the episode continues."""
    env = Environment(replace(TASK, time_limit=4.0), worlds=1)
    at(env, [env.task.dock().tube_length - 0.002, 0.0, 0.0])
    action = np.array([[1.0, 0.0, 0.0, 0.0, 0.0, 0.0]])
    steps = [env.step(action) for _ in range(40)]
    assert not any(step.terminated[0] for step in steps)
    measured = env.task.metrics(env.arrays)
    thrust = load_vehicle("finsrov").wrench_limits[0]
    assert measured["peak_force"][0] >= thrust * 0.98
    assert measured["contact_impulse"][0] == pytest.approx(thrust * 4.0, rel=0.15)
    assert measured["success"][0] == 1.0


def test_a_hard_hit_ends_the_episode_as_a_crash():
    """A hit of the tube's end at the dock's design speed terminates the episode with the loss and without
    success."""
    env = make("docking", auto_reset=False)
    at(env, [env.task.dock().tube_length - 0.02, 0.0, 0.0])
    nu = np.zeros((1, 1, 6), np.float32)
    nu[..., 0] = env.task.hull.speed
    env.simulator.state.velocity.assign(nu)
    step = env.step(np.zeros((1, 6)))
    assert (step.terminated[0], step.truncated[0]) == (True, False)
    assert step.reward[0] < -TASK.reward.loss + 2.0
    measured = env.task.metrics(env.arrays)
    assert measured["crash"][0] == 1.0 and measured["success"][0] == 0.0
    assert measured["peak_force"][0] > env.task.force_limit


def test_episodes_start_before_the_mouth_of_docks_anywhere():
    """Noses start in their box in dock axes with headings within `turn`.

    Docks lie in their box with any heading, and nothing is in contact.
    """
    env = make("docking", worlds=2048, threads=1)
    nose, relative, R, nu = truth(env)
    dock, length = env.task.dock(), env.task.hull.length
    ahead = -(nose[:, 0] + dock.cone_length) / length
    assert ahead.min() >= TASK.start[0] - 1e-4 and ahead.max() <= TASK.start[1] + 1e-4
    assert np.abs(nose[:, 1]).max() <= TASK.start_aside[0] * length + 1e-4
    assert np.abs(nose[:, 2]).max() <= TASK.start_aside[1] * length + 1e-4
    turn = relative.inv().as_euler("ZYX")[:, 0]
    assert 0.95 * TASK.turn < np.abs(turn).max() <= TASK.turn + 1e-3
    place = env.arrays.goal_position.numpy() - [0.0, 0.0, -0.5 * TASK.tank[1] * length]
    assert np.all(np.abs(place) <= np.array(TASK.dock_spread) * length + 1e-4)
    assert not nu.any()
    yaw = Rotation.from_quat(env.arrays.goal_quaternion.numpy()).as_euler("ZYX")[:, 0]
    assert abs(np.exp(1j * yaw).mean()) < 5.0 / math.sqrt(2048)
    env.step(np.zeros((2048, 6)))
    assert not env.simulator.funnel.impulse.numpy().any()


@pytest.mark.parametrize("name", THRUSTED)
def test_every_vehicle_gets_a_dock_it_fits_in(name):
    """The tube is wider than the envelope, the block stands in the tank, and a gentle press is not a crash."""
    task = TASK.fitted([load_vehicle(name)])
    dock, hull, pool = task.dock(), task.hull, task.arena()
    half = 0.5 * np.array(load_vehicle(name).body.size)
    assert hull == HullNumbers.of(load_vehicle(name))
    assert dock.throat_radius > 1.1 * math.hypot(half[1], half[2])
    lowest = (0.5 * TASK.tank[1] + TASK.dock_spread[2]) * hull.length + dock.mouth_radius + dock.rim
    assert lowest < pool.depth
    far = math.hypot(TASK.dock_spread[0], TASK.dock_spread[1]) * hull.length + dock.cone_length
    far += math.hypot(TASK.start[1], TASK.start_aside[0]) * hull.length + hull.length
    assert far < 0.5 * pool.length
    assert task.force_limit > load_vehicle(name).wrench_limits[0]


def test_the_hull_that_stands_for_none_is_finsrovs():
    """A task that is read before it is fitted uses the values of FinsROV."""
    own = HullNumbers.of(load_vehicle("finsrov"))
    assert TASK.hull.length == own.length and TASK.hull.speed == pytest.approx(own.speed, rel=0.01)
    assert TASK.hull.girth == pytest.approx(own.girth, rel=0.01)
    assert TASK.hull.inertia == pytest.approx(own.inertia, rel=0.01)
