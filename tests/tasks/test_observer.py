"""A policy on the robot receives the same observation as in training, bit for bit, for every task."""

from pathlib import Path

import numpy as np
import pytest

from finssim.control import ControlError
from finssim.control.guidance import Reference, Station, Track
from finssim.control.path_following import PathGuide
from finssim.control.trajectories import TRAJECTORIES
from finssim.core.rotations import quat_from_yaw, quat_rotate, quat_yaw
from finssim.tasks import Environment, follow, numeric_tasks, task_named
from finssim.tasks.observer import Observer
from finssim.tasks.task import Batch
from finssim.vehicles import load_vehicle

FINSROV = load_vehicle("finsrov")
EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
OWN = [f"{EXAMPLES / 'own_task.py'}:KeepDepth", f"{EXAMPLES / 'own/task/keep_depth.py'}:KeepDepth"]


class Moment:
    """A guide with one position at one time."""

    name, duration = "moment", np.inf

    def __init__(self, position, velocity, yaw):
        self.now = Reference(position, velocity, yaw, np.zeros(()))

    def at(self, t):
        return self.now


def track(env, w, v):
    rows = (env.arrays.position, env.arrays.quaternion, env.arrays.velocity)
    return Track(*(row.numpy()[w, v].astype(float) for row in rows))


def world(env, w, yaw):
    """Return a robot's inputs that correspond to a world of the batch: its guide, and tracks of the others by
    name."""
    a = env.arrays
    velocity = np.zeros(3) if a.target.velocity is None else a.target.velocity.numpy()[w]
    guide = Moment(a.goal_position.numpy()[w].astype(float), velocity.astype(float), yaw[w])
    tracks = {name: track(env, w, v) for v, name in enumerate(env.task.vehicles)}
    if a.net.target is not None:
        level = np.array([0.0, 0.0, 0.0, 1.0])
        nu = np.array([*a.net.motion.numpy()[w].astype(float), 0.0, 0.0, 0.0])
        tracks["target"] = Track(a.net.target.numpy()[w].astype(float), level, nu)
    return guide, tracks


def with_tracks(reading, tracks):
    class Known(Track):
        pass

    known = Known(reading.position, reading.quaternion, reading.nu)
    object.__setattr__(known, "tracks", tracks)
    return known


@pytest.mark.parametrize("name", [*numeric_tasks(), *OWN])
def test_the_robot_sees_what_the_batch_sees_bit_for_bit(name):
    """Tested with random actions, measurement noise and every agent; goals are exact poses on both sides."""
    task = task_named(name, time_limit=200.0) if name == "t2" else task_named(name)
    env = Environment(task, worlds=4, seed=3, noise=task.training_noise)
    if name == "t2":
        follow(env, [TRAJECTORIES["circle"], TRAJECTORIES["helix"], *[TRAJECTORIES["lemniscate"]] * 2])
    rng = np.random.default_rng(0)
    observers = [Observer(name, FINSROV, agent=agent) for agent in env.task.agents]
    for _ in range(3):
        for _ in range(4):
            env.step(
                rng.uniform(-1.0, 1.0, (env.worlds, env.agents, env.action_size)).squeeze(
                    1 if env.agents == 1 else ()
                )
            )
        yaw = quat_yaw(env.arrays.goal_quaternion.numpy().astype(float))
        env.arrays.goal_quaternion.assign(quat_from_yaw(yaw).astype(np.float32))
        again = env.simulator.pipeline()
        env._mask.fill_(1)
        env.task.add_observe(again, Batch(env.simulator.state, env.arrays, env.seed), env._mask)
        again.run()
        seen = env.arrays.observation.numpy().reshape(env.worlds, env.agents, -1)
        steps = env.simulator.state.steps.numpy()
        for w in range(env.worlds):
            guide, tracks = world(env, w, yaw)
            if name == "t2":
                guide = TRAJECTORIES[("circle", "helix", "lemniscate", "lemniscate")[w]]
            if env.arrays.path.points is not None:
                guide = PathGuide(env.arrays.path.points.numpy()[w].astype(float))
            for a, observer in enumerate(observers):
                reading = with_tracks(track(env, w, a), tracks)
                t, ranges = float(np.float32(steps[w]) * np.float32(0.1)), env.arrays.ranges.numpy()[w]
                given = observer.observe(reading, guide, t, ranges=ranges)
                np.testing.assert_array_equal(given, seen[w, a])


def test_the_prey_of_a_pursuit_without_a_track_is_where_the_guide_is():
    observer = Observer("pursuit", FINSROV)
    circle = TRAJECTORIES["circle"]
    me = Track(np.array([0.1, 0.2, -0.5]), quat_from_yaw(0.4), np.zeros(6))
    now = circle.at(3.0)
    seen = observer.observe(me, circle, 3.0)
    np.testing.assert_allclose(
        quat_rotate(me.quaternion, seen[6:9].astype(float)) * 6.0, now.position - me.position, atol=1e-6
    )
    np.testing.assert_allclose(quat_rotate(me.quaternion, seen[9:12].astype(float)), now.velocity, atol=1e-6)


def test_a_team_mate_that_nobody_tells_of_is_named():
    me = Track(np.zeros(3), quat_from_yaw(0.0), np.zeros(6))
    with pytest.raises(
        ControlError, match="'team-pursuit' needs the position of 'left_netter', which no source provides"
    ):
        Observer("team-pursuit", FINSROV).observe(me, Station((1.0, 0.0, -1.0), 0.0), 0.0)


def test_what_is_no_task_or_no_place_in_it_is_refused():
    with pytest.raises(ControlError, match="unknown task 't9'; available: t1"):
        Observer("t9", FINSROV)
    with pytest.raises(ControlError, match="task 't1' has no 'herder'; its agents: vehicle"):
        Observer("t1", FINSROV, agent="herder")


def test_a_trajectory_longer_than_an_episode_is_seen_to_its_end():
    """The table of knots grows with the guide."""
    circle = TRAJECTORIES["circle"]
    assert circle.duration > task_named("t2").time_limit
    observer = Observer("t2", FINSROV)
    t = circle.duration - 1.0
    me = Track(circle.at(t).position, quat_from_yaw(0.0), np.zeros(6))
    seen = observer.observe(me, circle, t)
    np.testing.assert_allclose(seen[:3], 0.0, atol=1e-4)
    np.testing.assert_allclose(seen[12:15], circle.at(t).velocity, atol=1e-3)


TORCH = (EXAMPLES / "own/task/keep_depth.py").read_text().split("if __name__")[0]


def in_torch(folder, heave, more=""):
    """Return a task in torch with a different second part of the observation."""
    text = TORCH.replace("w.velocity[:, 2]\n", f"{heave}\n")
    text = text.replace("class KeepDepth(TorchTask):", f"class KeepDepth(TorchTask):\n    {more}\n")
    assert heave in text
    (folder / "task.py").write_text(text)
    return f"{folder / 'task.py'}:KeepDepth"


@pytest.mark.parametrize("heave", ["w.memory['last'][:, 0]", "w.held"])
def test_what_no_robot_knows_is_refused_before_it_runs(tmp_path, heave):
    """A memory that the reward writes, and the time within tolerance, exist only in simulation."""
    name = in_torch(tmp_path, heave, "memory = {'last': 1}")
    assert np.isfinite(Environment(task_named(name), FINSROV, worlds=2, seed=1).reset()).all()
    with pytest.raises(ControlError, match="'keep-depth' cannot be observed on a robot: it reads w") as error:
        Observer(name, FINSROV)
    assert heave.partition("[:")[0] in str(error.value)


def test_a_memory_that_is_not_observed_is_no_hindrance(tmp_path):
    assert Observer(in_torch(tmp_path, "w.velocity[:, 2].abs()", "memory = {'last': 1}"), FINSROV)


@pytest.mark.parametrize("action", ["w.action[:, 0]", "w.previous_action[:, 0]"])
def test_a_task_in_torch_sees_its_last_actions_on_a_robot(tmp_path, action):
    """The last action and the one before agree with the batch; there are none after a restart."""
    name = in_torch(tmp_path, action)
    env, observer = Environment(task_named(name), FINSROV, worlds=1, seed=1), Observer(name, FINSROV)
    me, goal = Track(np.zeros(3), quat_from_yaw(0.0), np.zeros(6)), Station((0.0, 0.0, -0.5), 0.0)
    env.reset()
    observer.observe(me, goal, 0.0)
    for k in range(1, 5):
        done = np.full((1, 6), 0.1 * k)
        seen = env.step(done).observation[0, 1]
        assert observer.observe(me, goal, 0.1 * k, done[0])[1] == seen
    observer.restart()
    assert observer.observe(me, goal, 0.0)[1] == 0.0
    assert env.reset()[0, 1] == 0.0


def test_a_goal_out_of_reach_is_seen_on_the_way_to_it():
    """A goal three metres ahead looks like one at the reach; a goal within reach is shown at its position."""
    me, observer = Track(np.array([0.1, 0.0, -0.5]), quat_from_yaw(0.0), np.zeros(6)), Observer("t1", FINSROV)
    far, edge, near = (
        observer.observe(me, Station((0.1 + ahead, 0.0, -0.5), 0.0), 0.0, reach=1.2)
        for ahead in (3.0, 1.2, 1.1)
    )
    np.testing.assert_allclose(far, edge, atol=1e-6)
    assert near[0] < 0.99 * edge[0]


def test_a_heading_out_of_reach_is_seen_on_the_way_to_it():
    """A half turn looks like the largest shown turn, along the shorter direction."""
    me, observer = Track(np.array([0.1, 0.0, -0.5]), quat_from_yaw(3.0), np.zeros(6)), Observer("t1", FINSROV)
    half, edge, near = (
        observer.observe(me, Station((0.1, 0.0, -0.5), yaw), 0.0, turn=1.0) for yaw in (-0.3, 4.0, 3.9)
    )
    np.testing.assert_allclose(half, edge, atol=1e-6)
    assert not np.allclose(near, edge, atol=1e-3)
