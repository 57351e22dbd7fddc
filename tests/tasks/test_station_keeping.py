"""T1's observation, reward and ends are as specified, against NumPy and SciPy, from the true state."""

import math
from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from finssim.sim import RectangularPool
from finssim.tasks import Environment, StationKeeping
from finssim.tasks.station_keeping import Reward
from finssim.tasks.task import kernels_of, settings_of

TASK = StationKeeping()
LARGE = RectangularPool(length=20.0, width=20.0, depth=10.0)
"""Pool whose walls are out of reach, so that the task's own bounds can be left."""
SINGLE = 2e-6  # float32, a few operations on numbers of order one


def environment(worlds=64, task=TASK, **options):
    return Environment(task, worlds=worlds, **options)


def truth(env):
    """Return position, rotation and velocity of vehicle 0, goal position and goal rotation, by world."""
    state, a = env.simulator.state, env.arrays
    return (
        state.position.numpy()[:, 0].astype(float),
        Rotation.from_quat(state.quaternion.numpy()[:, 0]),
        state.velocity.numpy()[:, 0].astype(float),
        a.goal_position.numpy().astype(float),
        Rotation.from_quat(a.goal_quaternion.numpy()),
    )


def observed(env):
    """Return the observation as the task specifies it."""
    p, R, nu, goal, R_goal = truth(env)
    offset = R.inv().apply(goal - p)
    relative = (R.inv() * R_goal).as_matrix()
    distance = np.linalg.norm(offset, axis=1, keepdims=True)
    return np.concatenate(
        [
            offset / 3.0,
            relative[:, :, 0],
            relative[:, :, 1],
            np.clip(nu, -2.0, 2.0),
            np.minimum(distance / 3.0, 1.0),
        ],
        axis=1,
    )


def test_the_observation_is_the_published_one():
    """Offset over 3 m, two columns of the relative rotation, velocities limited to 2, distance over 3 m."""
    env = environment()
    rng = np.random.default_rng(0)
    for _ in range(20):
        step = env.step(rng.uniform(-1.0, 1.0, (64, 6)))
    np.testing.assert_allclose(step.observation, observed(env), atol=SINGLE)


def test_fast_and_far_is_limited_in_the_observation():
    """Beyond 2 m/s, 2 rad/s and 3 m the numbers stop growing; the offset itself does not."""
    env = environment(2)
    env.start(
        (0.0, 0.0, -0.5), (0.0, 0.0, 0.0, 1.0), [(30.0, 0.0, -0.5), (-1.0, 0.0, -0.5)], (0.0, 0.0, 0.0, 1.0)
    )
    env.simulator.state.velocity.assign(np.full((2, 1, 6), -5.0, np.float32))
    mask = wp.ones(2, dtype=wp.int32, device="cpu")
    wp.launch(kernels_of(TASK).observe, 2, [env.arrays, settings_of(TASK), mask, 0], device="cpu")
    far = env.arrays.observation.numpy()[0]
    np.testing.assert_allclose(far, observed(env)[0], atol=SINGLE * 10.0)
    assert far[0] == pytest.approx(10.0) and far[15] == 1.0 and np.all(far[9:15] == -2.0)


@pytest.mark.parametrize("seed", [0, 1])
def test_the_reward_is_the_sum_of_its_terms(seed):
    """r = position + distance + heading + turn + leaning + action + change + rate, from the state after the step."""
    env, r = environment(seed=seed), TASK.reward
    rng = np.random.default_rng(seed)
    before = rng.uniform(-1.5, 1.5, (64, 6))
    env.step(before)
    action = rng.uniform(-1.5, 1.5, (64, 6))
    step = env.step(action)
    p, R, nu, goal, R_goal = truth(env)
    e = np.linalg.norm(goal - p, axis=1)
    theta = (R.inv() * R_goal).magnitude()
    tilt = np.arccos(np.clip(R.as_matrix()[:, 2, 2], -1.0, 1.0))
    a, previous = np.clip(action, -1.0, 1.0), np.clip(before, -1.0, 1.0)
    expected = (
        r.position * np.exp(-e / r.position_scale)
        - r.distance * e
        + r.heading * np.exp(-theta / r.heading_scale)
        - r.turn * theta
        - r.leaning * np.clip(tilt / np.radians(22.5) - 1.0, 0.0, 2.0)
        - r.action * np.mean(a**2, axis=1)
        - r.change * np.mean((a - previous) ** 2, axis=1)
        - r.rate * np.minimum(np.sum(nu[:, 3:] ** 2, axis=1), 4.0)
    )
    going_on = ~(step.terminated | step.truncated)
    np.testing.assert_allclose(step.reward[going_on], expected[going_on], atol=1e-5)


def test_resting_at_the_goal_earns_the_most_there_is():
    """The maximum is position + heading weight, at rest in the goal pose without thrust."""
    env = environment(1)
    pose = (0.0, 0.0, -0.5), (0.0, 0.0, 0.0, 1.0)
    env.start(*pose, *pose)
    step = env.step(np.zeros((1, 6)))
    most = TASK.reward.position + TASK.reward.heading
    # The vehicle is 8 g from neutral: in one step of 0.1 s it moves by micrometres.
    assert step.reward[0] == pytest.approx(most, abs=1e-3)
    assert step.reward[0] <= most


@pytest.mark.parametrize(
    ("position", "left"),
    [
        ((2.6, 0.0, -0.5), True),
        ((-2.6, 0.0, -0.5), True),
        ((0.0, 1.6, -0.5), True),
        ((0.0, -1.6, -0.5), True),
        ((0.0, 0.0, 0.6), True),
        ((0.0, 0.0, -1.8), True),
        ((1.0, 0.3, -0.5), False),
    ],
)
def test_leaving_the_pool_terminates_with_a_loss(position, left):
    """Beyond a bound the episode is terminated, not truncated, and costs the loss once."""
    env = environment(1, auto_reset=False, pool=LARGE)
    env.start(position, (0.0, 0.0, 0.0, 1.0), position, (0.0, 0.0, 0.0, 1.0))
    step = env.step(np.zeros((1, 6)))
    assert (step.terminated[0], step.truncated[0]) == (left, False)
    assert (step.reward[0] < -TASK.reward.loss + 2.0) == left


@pytest.mark.parametrize(
    ("roll", "low", "high"), [(20, 0, 0), (50, 0.8, 1), (-50, 0.8, 1), (60, 1.2, 1.4), (180, 2, 2)]
)
def test_leaning_is_charged_from_half_of_the_tilt_that_a_bridge_stops_at(roll, low, high):
    """The charge is 0 up to 22.5°, 1 at 45°, 2 from 67.5° on; the episode continues."""
    env = environment(1, auto_reset=False)
    pose = (0.0, 0.0, -0.5), Rotation.from_euler("x", roll, degrees=True).as_quat()
    env.start(*pose, *pose)
    step = env.step(np.zeros((1, 6)))
    expected = np.clip(np.degrees(truth(env)[1].magnitude())[0] / 22.5 - 1.0, 0.0, 2.0)
    earned = env.arrays.earned.numpy()[0, env.task.earnings.index("leaning")]
    assert earned == pytest.approx(-expected, abs=2e-3) and low <= expected <= high
    assert not step.terminated[0]


def test_the_time_limit_truncates_and_nothing_else_does():
    """It happens after exactly time_limit / control_step steps, as a truncation."""
    env = environment(4, replace(TASK, time_limit=1.5))
    pose = (0.0, 0.0, -0.5), (0.0, 0.0, 0.0, 1.0)
    env.start(*pose, *pose)
    ends = [env.step(np.zeros((4, 6))) for _ in range(15)]
    truncated = [bool(end.truncated.all()) for end in ends]
    assert truncated == [False] * 14 + [True]
    assert not any(end.terminated.any() for end in ends)
    assert env.arrays.final_length.numpy().tolist() == [15] * 4


def test_leaving_at_the_time_limit_is_a_termination():
    """Both at once count as a failure, so that nothing is bootstrapped."""
    env = environment(1, replace(TASK, time_limit=0.1), auto_reset=False, pool=LARGE)
    env.start((2.6, 0.0, -0.5), (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, -0.5), (0.0, 0.0, 0.0, 1.0))
    step = env.step(np.zeros((1, 6)))
    assert (step.terminated[0], step.truncated[0]) == (True, False)


def test_held_counts_time_inside_the_tolerance_without_a_break():
    """It grows by the control step inside 0.10 m and 10°, and falls to zero outside."""
    env = environment(3, auto_reset=False)
    goal = (0.0, 0.0, -0.5)
    turned = [Rotation.from_euler("z", angle, degrees=True).as_quat() for angle in (9.0, 11.0, 0.0)]
    env.start([(0.09, 0.0, -0.5), (0.0, 0.0, -0.5), (0.11, 0.0, -0.5)], turned, goal, (0.0, 0.0, 0.0, 1.0))
    for _ in range(5):
        env.step(np.zeros((3, 6)))
    np.testing.assert_allclose(env.arrays.held.numpy(), [0.5, 0.0, 0.0], atol=1e-6)
    position = env.simulator.state.position.numpy().copy()
    position[0, 0, 0] = 0.3
    env.simulator.state.position.assign(position)
    env.step(np.zeros((3, 6)))
    assert env.arrays.held.numpy()[0] == 0.0


def test_episodes_start_and_aim_all_over_the_pool():
    """Starts and goals fill their boxes uniformly; tilt, speed and turn rate stay inside their limits."""
    env = environment(8192, threads=1)
    state, a = env.simulator.state, env.arrays
    for sample, low, high in (
        (state.position.numpy()[:, 0], TASK.spawn_low, TASK.spawn_high),
        (a.goal_position.numpy(), TASK.goal_low, TASK.goal_high),
        (state.velocity.numpy()[:, 0, :3], (-TASK.speed,) * 3, (TASK.speed,) * 3),
        (state.velocity.numpy()[:, 0, 3:], (-TASK.rate,) * 3, (TASK.rate,) * 3),
    ):
        low, high = np.array(low), np.array(high)
        unit = (sample - low) / (high - low)
        assert unit.min() >= -1e-6 and unit.max() <= 1.0 + 1e-6
        # Mean and standard deviation of a uniform variable, five standard errors.
        np.testing.assert_allclose(unit.mean(axis=0), 0.5, atol=5.0 / math.sqrt(12.0 * 8192))
        np.testing.assert_allclose(unit.std(axis=0), 1.0 / math.sqrt(12.0), atol=0.01)
    yaw, pitch, roll = Rotation.from_quat(state.quaternion.numpy()[:, 0]).as_euler("ZYX").T
    assert max(np.abs(roll).max(), np.abs(pitch).max()) <= TASK.tilt + 1e-5
    assert np.abs(roll).max() > 0.98 * TASK.tilt
    goal_yaw, *tilt = Rotation.from_quat(a.goal_quaternion.numpy()).as_euler("ZYX").T
    assert np.abs(tilt).max() < 1e-5
    for angle in (yaw, goal_yaw):
        assert abs(np.exp(1j * angle).mean()) < 5.0 / math.sqrt(8192)


def test_a_reward_can_be_changed_without_touching_the_shared_one():
    """A variant is a new task."""
    variant = replace(TASK, reward=Reward(loss=99.0))
    assert TASK.reward.loss != 99.0 and variant.reward.loss == 99.0


def test_errors_are_zero_where_the_task_wants_the_vehicle():
    """In a rotated and shifted pose they are the components of the offset and the sine of the heading error."""
    env = environment(worlds=2)
    level = np.array([0.0, 0.0, 0.0, 1.0])
    turned = Rotation.from_euler("z", [[0.0], [0.3]]).as_quat()
    seen = env.start([[0.2, 0.1, -0.5], [0.0, 0.0, -0.5]], level, [0.2, 0.1, -0.5], turned)
    assert TASK.errors == (0, 1, 2, 4)
    errors = seen[:, TASK.errors]
    np.testing.assert_allclose(errors[0], 0.0, atol=SINGLE)
    np.testing.assert_allclose(errors[1], [0.2 / 3.0, 0.1 / 3.0, 0.0, math.sin(0.3)], atol=SINGLE)
