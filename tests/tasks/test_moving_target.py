"""T3: motion of the target, observation, reward and scoring, against NumPy and SciPy."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from finssim.sim import RectangularPool
from finssim.tasks import Environment, make
from finssim.tasks.moving_target import MovingTarget

TASK = MovingTarget()
LARGE = RectangularPool(length=20.0, width=20.0, depth=10.0)
LEVEL = (0.0, 0.0, 0.0, 1.0)


def truth(env):
    """Return offset to the target, rotation, twist, and target velocity in the body, by world."""
    state, a = env.simulator.state, env.arrays
    R = Rotation.from_quat(state.quaternion.numpy()[:, 0])
    offset = R.inv().apply(a.goal_position.numpy() - state.position.numpy()[:, 0])
    return offset, R, state.velocity.numpy()[:, 0].astype(float), R.inv().apply(a.target.velocity.numpy())


def played(env, steps, seed=0):
    """Return the last step of random actions, and the positions and velocities of the targets by step."""
    rng, path, pace = np.random.default_rng(seed), [], []
    for _ in range(steps):
        step = env.step(rng.uniform(-1.0, 1.0, (env.worlds, 6)))
        path.append(env.arrays.goal_position.numpy().copy())
        pace.append(env.arrays.target.velocity.numpy().copy())
    return step, np.array(path), np.array(pace)


def test_the_observation_is_the_published_one():
    """Offset over 3 m, target velocity over 0.2 m/s, twist limited to 2, distance over 3 m: 13 numbers."""
    env = Environment(TASK, worlds=64)
    step, _, _ = played(env, 20)
    offset, _, nu, drift = truth(env)
    distance = np.linalg.norm(offset, axis=1, keepdims=True) / 3.0
    expected = [offset / 3.0, drift / 0.2, np.clip(nu, -2.0, 2.0), np.minimum(distance, 1.0)]
    assert step.observation.shape == (64, 13)
    np.testing.assert_allclose(step.observation, np.concatenate(expected, axis=1), atol=2e-6)


def test_the_target_moves_within_its_limits():
    """Speed, acceleration and box are as published; the motion is continuous and never stops for good."""
    env = Environment(replace(TASK, time_limit=60.0), worlds=256)
    start = env.arrays.goal_position.numpy().copy()
    _, path, velocity = played(env, 300)
    assert np.linalg.norm(velocity, axis=2).max() <= TASK.fastest * (1.0 + 1e-5)
    assert np.abs(velocity[..., 2]).max() <= TASK.fastest * TASK.vertical * (1.0 + 1e-5)
    assert np.linalg.norm(velocity, axis=2).max() > 0.9 * TASK.fastest
    change = np.linalg.norm(np.diff(velocity, axis=0), axis=2) / 0.1
    assert change.max() <= TASK.acceleration * (1.0 + 1e-3)
    np.testing.assert_allclose(
        np.diff(np.concatenate([start[None], path]), axis=0), 0.1 * velocity, atol=1e-6
    )
    # Stopping takes v²/2a plus one step of delay, and more if the course changes meanwhile.
    slack = 2.0 * TASK.fastest**2 / (2.0 * TASK.acceleration) + 0.1 * TASK.fastest
    assert np.all(path >= np.array(TASK.low) - slack) and np.all(path <= np.array(TASK.high) + slack)
    assert np.linalg.norm(path[-1] - path[0], axis=1).mean() > 0.1


def test_courses_last_as_long_as_published():
    """The desired velocity changes every 1.5 to 4 s, at different times in different worlds."""
    env = Environment(
        replace(TASK, low=(-9.0,) * 3, high=(9.0,) * 3, bounds=(99.0, 99.0)), worlds=64, pool=LARGE
    )
    wanted = []
    for _ in range(250):
        env.step(np.zeros((64, 6)))
        wanted.append(env.arrays.target.wanted.numpy().copy())
    changed = np.any(np.diff(wanted, axis=0) != 0.0, axis=2)
    lasts = np.concatenate([np.diff(np.flatnonzero(column)) for column in changed.T]) * 0.1
    assert lasts.min() >= 1.5 - 1e-6 and lasts.max() <= 4.0 + 0.1 + 1e-6
    # The mean of the range, and half a step of waiting for the next one; five standard errors.
    assert lasts.mean() == pytest.approx(2.8, abs=5.0 * 0.72 / np.sqrt(len(lasts)))
    assert len({tuple(column) for column in changed.T}) > 60


def test_the_reward_is_the_sum_of_its_terms():
    env, r = Environment(TASK, worlds=64), TASK.reward
    rng = np.random.default_rng(1)
    before, action = rng.uniform(-1.5, 1.5, (2, 64, 6))
    env.step(before)
    step = env.step(action)
    offset, _, nu, drift = truth(env)
    e, slip = np.linalg.norm(offset, axis=1), np.linalg.norm(nu[:, :3] - drift, axis=1)
    spin = np.linalg.norm(nu[:, 3:], axis=1)
    near = np.exp(-e / r.near_scale)
    a, previous = np.clip(action, -1.0, 1.0), np.clip(before, -1.0, 1.0)
    expected = near * (r.near + r.match * np.exp(-slip / r.match_scale)) - r.distance * e
    expected -= r.spin * np.minimum(spin, 2.0) + r.action * np.mean(a**2, axis=1)
    expected -= r.change * np.mean((a - previous) ** 2, axis=1)
    np.testing.assert_allclose(step.reward, expected, atol=1e-5)


def test_beside_a_resting_target_at_rest_there_is_most_to_earn():
    """The reward is near + match; nothing exceeds it."""
    env = Environment(replace(TASK, fastest=0.0), worlds=1)
    env.start((0.0, 0.0, -0.5), LEVEL, (0.0, 0.0, -0.5), LEVEL)
    reward = env.step(np.zeros((1, 6))).reward[0]
    assert reward == pytest.approx(TASK.reward.near + TASK.reward.match, abs=1e-2)
    assert reward <= TASK.reward.near + TASK.reward.match


@pytest.mark.parametrize(("off", "success"), [(0.2, 1.0), (0.3, 0.0)])
def test_success_is_ten_steps_in_tolerance(off, success):
    """0.25 m, 0.12 m/s and 0.3 rad/s for 10 steps; the error is counted after `settle`."""
    env = Environment(replace(TASK, fastest=0.0, time_limit=2.0, settle=1.0), worlds=2)
    env.start((off, 0.0, -0.5), LEVEL, (0.0, 0.0, -0.5), LEVEL)
    for _ in range(20):
        env.step(np.zeros((2, 6)))
    measured = env.task.metrics(env.arrays)
    assert measured["success"].tolist() == [success] * 2
    np.testing.assert_allclose(measured["success_time"], 1.0 if success else np.nan, atol=1e-6)
    np.testing.assert_allclose(measured["error"], off, atol=0.01)
    assert measured["length"].tolist() == [20.0] * 2


def test_success_is_counted_once_and_stays():
    """Leaving the target afterwards does not revoke success; its time is when it was first reached."""
    env = Environment(replace(TASK, fastest=0.0, time_limit=3.0), worlds=1)
    env.start((0.0, 0.0, -0.5), LEVEL, (0.0, 0.0, -0.5), LEVEL)
    for k in range(30):
        env.step(np.full((1, 6), 0.0 if k < 15 else 1.0))
    measured = env.task.metrics(env.arrays)
    assert (measured["success"][0], measured["held"][0]) == (1.0, 0.0)
    assert measured["success_time"][0] == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize(
    ("position", "left"),
    [((2.6, 0.0, -0.5), True), ((0.0, -1.6, -0.5), True), ((0.0, 0.0, 0.5), True), ((0.0, 0.0, -1.8), True),
     ((1.9, 0.9, -0.9), False)],
)  # fmt: skip
def test_leaving_the_pool_terminates_with_a_loss(position, left):
    env = Environment(TASK, worlds=1, auto_reset=False, pool=LARGE)
    env.start(position, LEVEL, position, LEVEL)
    step = env.step(np.zeros((1, 6)))
    assert (step.terminated[0], step.truncated[0]) == (left, False)
    assert (step.reward[0] < -TASK.reward.loss + 2.0) == left


def test_a_longer_vehicle_has_a_larger_pool_and_a_faster_target():
    """All lengths grow with the vehicle; FinsROV has the paper's pool."""
    small, large = make("t3"), make("t3", vehicle="rexrov")
    assert small.simulator.surroundings[1] == RectangularPool(stiffness=4000.0)
    size, pace = large.task.fit.size, large.task.fit.pace
    assert size == pytest.approx(2.6 / 0.6) and 1.0 < pace <= size
    assert large.simulator.surroundings[1].length == pytest.approx(4.0 * size)
    _, path, velocity = played(large, 50)
    assert 0.5 * pace * TASK.fastest < np.linalg.norm(velocity, axis=2).max() * 5.0
