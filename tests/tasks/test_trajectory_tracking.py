"""T2's observation, reward and ends are as specified, against NumPy, SciPy and the published observation."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from finssim.control.trajectories import TRAJECTORIES, load_trajectory
from finssim.sim import RectangularPool
from finssim.tasks import Environment, EnvironmentSetupError, StationKeeping, TrajectoryTracking, follow
from finssim.tasks.trajectory_tracking import LEVELS
from tests.reference.observed import published_t2

TASK = TrajectoryTracking()
GUIDES = tuple(TRAJECTORIES.values())
LARGE = RectangularPool(length=60.0, width=60.0, depth=30.0)
"""Pool whose walls are out of reach, so that references can be left."""


def following(guides=GUIDES, **changes):
    """Return an environment whose worlds follow these guides, and its first observations."""
    longest = max(guide.duration for guide in guides)
    task = replace(TASK, time_limit=longest + 1.0, knot_spacing=0.1)
    env = Environment(task, worlds=len(guides), auto_reset=False, **changes)
    return env, follow(env, guides)


def measured(env, w):
    a = env.arrays
    arrays = {"position": a.position, "quaternion": a.quaternion, "nu": a.velocity}
    return SimpleNamespace(**{key: array.numpy()[w, 0].astype(float) for key, array in arrays.items()})


def table(env):
    r = env.arrays.reference
    return r.position.numpy().astype(float), r.velocity.numpy().astype(float), r.duration.numpy()


def test_the_observation_is_the_published_one():
    """For every trajectory, at its start, midway, at its end and beyond: float32 on numbers of order one."""
    env, observation = following()
    rng = np.random.default_rng(0)
    for k in range(1375):
        if k:
            observation = env.step(0.3 * rng.uniform(-1.0, 1.0, (len(GUIDES), 6))).observation
        if k % 125 == 0 or k in (2, 298, 303, 902, 929):
            for w, guide in enumerate(GUIDES):
                expected = published_t2(measured(env, w), guide, 0.1 * k)
                np.testing.assert_allclose(observation[w], expected, atol=2e-5, err_msg=f"{guide.name} {k}")


def test_following_starts_at_rest_on_the_first_pose():
    guides = [load_trajectory(name, yaw=0.5) for name in ("straight", "helix")]
    env, _ = following(guides)
    state = env.simulator.state
    places = [guide.at(0.0).position for guide in guides]
    np.testing.assert_allclose(state.position.numpy()[:, 0], places, atol=1e-6)
    yaw = Rotation.from_quat(state.quaternion.numpy()[:, 0]).as_euler("ZYX")[:, 0]
    np.testing.assert_allclose(yaw, 0.5, atol=1e-6)
    assert not state.velocity.numpy().any()


def test_what_cannot_be_followed_is_refused():
    env = Environment(TASK, worlds=1)
    with pytest.raises(EnvironmentSetupError, match="longer than the task's time_limit"):
        follow(env, [TRAJECTORIES["circle"]])
    with pytest.raises(EnvironmentSetupError, match="2 guides for 1 worlds"):
        follow(env, [TRAJECTORIES["straight"]] * 2)
    with pytest.raises(EnvironmentSetupError, match="such as t2"):
        follow(Environment(StationKeeping(), worlds=1), [TRAJECTORIES["straight"]])
    with pytest.raises(ValueError, match="level is 4"):
        TrajectoryTracking(level=4)


def test_the_reward_is_the_sum_of_its_terms():
    """It uses the state after the step and the reference at that time."""
    r = TASK.reward
    env, _ = following()
    rng = np.random.default_rng(1)
    before, action = rng.uniform(-1.5, 1.5, (2, len(GUIDES), 6))
    env.step(before)
    step = env.step(action)
    places = np.stack([guide.at(0.2).position for guide in GUIDES])
    state = env.simulator.state
    e = np.linalg.norm(state.position.numpy()[:, 0] - places, axis=1)
    up = Rotation.from_quat(state.quaternion.numpy()[:, 0]).apply([0.0, 0.0, 1.0])[:, 2]
    tilt, spin = np.arccos(np.clip(up, -1.0, 1.0)), state.velocity.numpy()[:, 0, 5]
    pose = np.exp(-e / r.track_scale)
    posture = 0.5 / (1.0 + (tilt / r.tilt_scale) ** 2) + 0.5 / (1.0 + (spin / r.spin_scale) ** 4)
    a, previous = np.clip(action, -1.0, 1.0), np.clip(before, -1.0, 1.0)
    expected = pose * (r.track + r.posture * posture) - r.distance * e - r.spin * np.abs(spin)
    expected -= r.action * np.mean(a**2, axis=1) + r.change * np.mean((a - previous) ** 2, axis=1)
    np.testing.assert_allclose(step.reward, expected, atol=2e-4)


@pytest.mark.parametrize(
    ("position", "lost"),
    [
        ((-1.0, -0.4, -0.5), False),
        ((2.5, -0.4, -0.5), False),
        ((3.1, -0.4, -0.5), True),
        ((-1.0, -0.4, 0.6), True),
    ],
)
def test_getting_lost_terminates_with_a_loss(position, lost):
    """The published limits are 4 m off the reference, or 0.3 m above the water."""
    env, _ = following([TRAJECTORIES["straight"]], pool=LARGE)
    place = env.simulator.state.position
    place.assign(np.array([[position]], np.float32))
    step = env.step(np.zeros((1, 6)))
    assert (step.terminated[0], step.truncated[0]) == (lost, False)
    off = np.linalg.norm(place.numpy()[0, 0] - TRAJECTORIES["straight"].at(0.1).position)
    assert (step.reward[0] < -TASK.reward.loss) == (lost and off < 9.0)


def test_an_episode_lasts_thirty_seconds():
    env = Environment(replace(TASK, lost=1e3), worlds=4)
    ends = [env.step(np.zeros((4, 6))).truncated.all() for _ in range(300)]
    assert ends == [False] * 299 + [True]


@pytest.mark.parametrize("level", range(len(LEVELS)))
def test_references_are_drawn_as_published(level):
    """At most one turn in 30 s, no axis beyond its limit, within the drawn sizes about the depth, steady phase."""
    task = replace(TASK, level=level)
    env = Environment(task, worlds=512)
    position, velocity, duration = table(env)
    speed = np.abs(velocity).max(axis=1)
    assert np.all(speed <= np.array(task.speed_limit) * (1.0 + 1e-5))
    assert np.all(duration >= 30.0 * (1.0 - 1e-6)) and duration.max() <= 1000.0
    reach = np.abs(position - [0.0, 0.0, task.depth]).max(axis=1)
    assert np.all(reach[:, :2] <= np.array(task.scale_high[:2]) + 0.15 + 1e-6)
    assert np.all(reach[:, 2] <= 0.12 + 0.15 + 1e-6)
    flat = np.ptp(position[..., 1], axis=1) < 1e-6
    assert flat.any() == ("line" in LEVELS[level])


def test_the_knots_velocity_is_the_derivative_of_their_position():
    """Between two knots, the cubic's displacement is the mean of the end velocities up to h² x''' / 12."""
    env = Environment(TASK, worlds=256)
    position, velocity, _ = table(env)
    h = TASK.knot_spacing
    slope = (position[:, 1:] - position[:, :-1]) / h
    np.testing.assert_allclose(slope, 0.5 * (velocity[:, 1:] + velocity[:, :-1]), atol=h * h * 0.03)
    assert np.abs(velocity).max() > 0.1


def test_episodes_start_beside_the_reference_and_are_drawn_anew():
    env = Environment(TASK, worlds=256)
    first, _, _ = table(env)
    x = env.simulator.state.position.numpy()[:, 0]
    assert np.abs(x - first[:, 0]).max() <= 0.15 + 1e-6
    tilt = Rotation.from_quat(env.simulator.state.quaternion.numpy()[:, 0]).apply([0.0, 0.0, 1.0])[:, 2]
    assert np.all(np.arccos(np.clip(tilt, -1.0, 1.0)) <= math.radians(20.0) * math.sqrt(2.0) + 1e-3)
    env.reset()
    again, _, _ = table(env)
    assert np.abs(again - first).max(axis=(1, 2)).min() > 1e-3


def test_equal_seeds_draw_equal_references_whatever_the_number_of_worlds():
    few, many = Environment(TASK, worlds=3, seed=5), Environment(TASK, worlds=200, seed=5)
    np.testing.assert_array_equal(table(few)[0], table(many)[0][:3])
    assert np.abs(table(few)[0] - table(Environment(TASK, worlds=3, seed=6))[0]).max() > 1e-3


def test_time_within_the_tolerance_is_counted():
    """At rest at the start of the slow straight line, only the first two seconds are within 0.05 m."""
    env, _ = following([TRAJECTORIES["straight"]])
    held = []
    for _ in range(60):
        env.step(np.zeros((1, 6)))
        held.append(float(env.arrays.held.numpy()[0]))
    assert held[15] == pytest.approx(1.6, abs=1e-4) and held[-1] == 0.0
