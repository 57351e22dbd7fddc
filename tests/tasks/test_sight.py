"""Tasks that see: worlds drawn by episode, pictures at their rate, and docking by camera."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("newton")

from finssim.experiments.plants import PlantError, load_plant
from finssim.tasks import Environment, EnvironmentSetupError, make
from finssim.tasks.agents import LightServo, LineFollower, agent_for
from finssim.tasks.camera_docking import CameraDocking
from finssim.tasks.check import check_task
from finssim.tasks.pipeline import Pipeline
from finssim.vehicles import load_vehicle
from finssim.worlds import load_world

pytestmark = pytest.mark.slow

SHORT = CameraDocking(time_limit=0.6)


def test_pictures_come_with_the_row_and_the_goal_is_the_dock_of_the_world():
    env = make("camera-docking", worlds=3, seed=4)
    observation = env.reset()
    assert observation["state"].shape == (3, 10) and observation["front_camera"].shape == (3, 27, 48, 3)
    assert observation["front_camera"].dtype == np.uint8 and observation["front_camera"].std() > 10.0
    dock = env.sight.batch.poses("dock")
    np.testing.assert_allclose(env.arrays.goal_position.numpy(), dock[:, :3], atol=1e-6)
    np.testing.assert_allclose(env.arrays.goal_quaternion.numpy(), dock[:, 3:], atol=1e-6)
    assert np.ptp(dock[:, 0]) > 0.05  # each world has a dock of its own


def test_the_row_tells_attitude_velocity_and_depth_and_the_teacher_where_the_dock_is():
    env = make("camera-docking", worlds=5, seed=1)
    random = np.random.default_rng(0)
    for _ in range(5):
        step = env.step(random.uniform(-1.0, 1.0, (5, 6)))
    state, q = env.simulator.state, Rotation.from_quat(env.simulator.state.quaternion.numpy()[:, 0])
    x, dock = state.position.numpy()[:, 0], Rotation.from_quat(env.arrays.goal_quaternion.numpy())
    up = q.inv().apply([0.0, 0.0, 1.0])
    own = np.column_stack([up, state.velocity.numpy()[:, 0], -x[:, 2] / 5.0])
    np.testing.assert_allclose(step.observation["state"], own, atol=1e-5)
    nose = dock.inv().apply(x + q.apply([0.28, 0.0, 0.0]) - env.arrays.goal_position.numpy())
    np.testing.assert_allclose(env.arrays.taught.numpy()[:, 15:18], nose / 3.0, atol=1e-5)


def test_a_world_is_drawn_anew_where_an_episode_ends_and_its_last_picture_is_kept():
    env = Environment(SHORT, worlds=4, seed=2)
    env.simulator.state.steps.assign(np.array([0, 3, 0, 3], np.int32))  # two end sooner
    before, action = env.sight.batch.drawn.copy(), np.zeros((4, 6))
    for _ in range(3):
        seen = env.step(action)
        last = seen.observation["front_camera"].copy()
    ended = seen.truncated
    np.testing.assert_array_equal(ended, [False, True, False, True])
    changed = np.any(env.sight.batch.drawn != before, axis=1)
    np.testing.assert_array_equal(changed, ended)
    final = seen.final_observation["front_camera"]
    assert all(np.any(final[w] != last[w]) for w in (1, 3)) and final[1].any()


def test_equal_seeds_give_equal_pictures_whatever_stands_beside_them():
    action, runs = np.zeros((6, 6)), []
    for worlds in (6, 2):
        env = Environment(SHORT, worlds=worlds, seed=9)
        for _ in range(8):
            step = env.step(action[:worlds])
        runs.append(step.observation["front_camera"][:2].copy())
    np.testing.assert_array_equal(*runs)
    env.reset(seed=9)
    for _ in range(8):
        step = env.step(action[:2])
    np.testing.assert_array_equal(step.observation["front_camera"], runs[1])
    env.reset(seed=10)
    assert np.any(env.reset(seed=10)["front_camera"] != runs[1])


def test_a_run_goes_on_from_a_saved_state_with_the_same_pictures():
    one, other = (Environment(SHORT, worlds=3, seed=5) for _ in range(2))
    action = np.full((3, 6), 0.2)
    for _ in range(4):
        one.step(action)
    other.load_state(one.state())
    for _ in range(5):  # over the end of an episode
        a, b = one.step(action), other.step(action)
        for name in ("state", "front_camera"):
            np.testing.assert_array_equal(a.observation[name], b.observation[name])


def test_a_slow_camera_holds_its_picture():
    changes = {"rate": 5.0, "latency": 0.0, "dropout": 0.0}
    slow = load_vehicle("finsrov").replace(
        {f"perception.front_camera.{key}": value for key, value in changes.items()}
    )
    env = Environment(CameraDocking(), slow, worlds=1, seed=1)
    pictures = [env.step(np.full((1, 6), 0.3)).observation["front_camera"].copy() for _ in range(7)]
    changed = [bool(np.any(a != b)) for a, b in zip(pictures, pictures[1:], strict=False)]
    assert changed in ([True, False] * 3, [False, True] * 3)


def test_looks_that_are_held_out_are_drawn_only_there():
    names = [None, *load_world("dock").looks]
    drawn = {}
    for held_out in (False, True):
        env = Environment(CameraDocking(held_out=held_out), worlds=40, seed=3)
        drawn[held_out] = {names[int(k)] for k in env.sight.batch.drawn[:, -1]}
    assert drawn == {False: {None, "coastal", "silty"}, True: {"algae", "peat"}}


def test_what_cannot_be_is_refused():
    with pytest.raises(EnvironmentSetupError, match="takes 0.61 m"):
        make("camera-docking", vehicle="bluerov2_heavy")
    blind = load_vehicle("finsrov").replace({"perception": {}})
    with pytest.raises(ValueError, match="has no sensor 'front_camera'"):
        make("camera-docking", vehicle=blind)


def test_the_teachers_task_is_a_task_of_numbers():
    task = CameraDocking().for_teacher()
    check_task(task)
    env = Environment(task, worlds=256, seed=2)
    step = env.step(np.zeros((256, 6)))
    assert step.observation.shape == (256, 19)
    assert np.abs(env.simulator.state.velocity.numpy()).max() < 0.5  # nobody starts in a wall


def test_the_scripted_way_measures_the_dock_by_its_lights():
    """Where the baseline sees all four lights, their middle is right to 8 % of the distance and the heading to 12°."""
    env = Environment(replace(CameraDocking(), turn=0.1, start=(3.0, 4.5)), worlds=32, seed=6)
    observation = env.reset()
    servo = LightServo.for_vehicle(env.nominal[0])
    middle, heading, visible = servo.measure(observation["front_camera"], observation["state"][:, :3])
    q, x = (
        Rotation.from_quat(env.simulator.state.quaternion.numpy()[:, 0]),
        env.simulator.state.position.numpy(),
    )
    dock = Rotation.from_quat(env.arrays.goal_quaternion.numpy())
    lights = env.arrays.goal_position.numpy() + dock.apply([-servo.before, 0.0, 0.0])
    truth = q.inv().apply(lights - x[:, 0]) - servo.eye
    distance = np.linalg.norm(truth, axis=1)
    error = np.linalg.norm(middle - truth, axis=1) / distance
    turned = (q.inv() * dock).as_euler("ZYX")[:, 0] - heading
    assert visible.mean() > 0.6
    assert np.median(error[visible]) < 0.08 and np.degrees(np.median(np.abs(turned[visible]))) < 12.0


def test_the_plant_of_held_out_looks_is_for_tasks_that_see():
    plant, vehicle = load_plant("held_out"), load_vehicle("finsrov")
    servo = agent_for("light-servo", vehicle, CameraDocking())
    env = plant.environment(servo, CameraDocking(), vehicle, worlds=8, seed=1)
    assert set(env.sight.batch.drawn[:, -1]) <= {3.0, 4.0}
    with pytest.raises(PlantError, match="task 't1' sees none"):
        plant.environment(agent_for("pid", vehicle, make("t1").task), make("t1").task, vehicle)


def test_the_line_of_the_pipeline_is_where_its_pipes_are():
    """At the start a vehicle is over a pipe of the world, as its own objects say, and the teacher's way ends there."""
    env = make("pipeline", worlds=16, seed=4)
    world, x = env.sight.batch.world, env.simulator.state.position.numpy()[:, 0]
    line = env.sight.batch.poses("line")
    local = Rotation.from_quat(line[:, 3:]).inv().apply(x - line[:, :3])
    knots = np.array([world.objects[f"pipe_{i}"].position for i in range(12)])
    distance = np.abs(np.interp(local[:, 0], knots[:, 0], knots[:, 1]) - local[:, 1])
    assert distance.max() < 0.65 and distance.max() > 0.2
    np.testing.assert_allclose(local[:, 2], 0.9, atol=0.21)
    way = 2.0 * env.arrays.taught.numpy()[:, :3]  # to the line above the pipe, beside the vehicle
    body = Rotation.from_quat(env.simulator.state.quaternion.numpy()[:, 0]).apply(way)
    end = Rotation.from_quat(line[:, 3:]).inv().apply(x + body - line[:, :3])
    np.testing.assert_allclose(np.interp(end[:, 0], knots[:, 0], knots[:, 1]), end[:, 1], atol=0.12)
    np.testing.assert_allclose(end[:, 2], 0.9, atol=1e-4)


def test_who_stays_behind_has_not_followed_the_pipeline_and_who_drifts_off_has_lost_it():
    check_task(Pipeline().for_teacher())
    env = Environment(Pipeline(time_limit=20.0).for_teacher(), worlds=8, seed=4, auto_reset=False)
    action = np.zeros((8, 4))
    action[4:, 1] = 1.0  # to the left
    for _ in range(200):
        step = env.step(action)
    measured = env.task.metrics(env.arrays)
    assert not measured["success"].any() and step.truncated[:4].all()
    np.testing.assert_array_equal(measured["lost"], [0, 0, 0, 0, 1, 1, 1, 1])


def test_the_line_follower_finds_the_pipe_in_the_picture():
    """In the file's own water the pipe's side and slope are right to 0.4 m and 12° in the median."""
    env = Environment(Pipeline(), worlds=24, seed=5)
    observation = env.reset()
    follower = LineFollower.for_vehicle(env.nominal[0])
    row = observation["state"]
    line, enough = follower.line(observation["front_camera"], row[:, :3], follower.charted - 5.0 * row[:, 9])
    way = 2.0 * env.arrays.taught.numpy()[:, :9].reshape(-1, 3, 3)  # beside, 1.2 and 2.5 m ahead
    slope = (way[:, 2, 1] - way[:, 0, 1]) / (way[:, 2, 0] - way[:, 0, 0])
    aside = way[:, 0, 1] - slope * way[:, 0, 0]
    plain = enough & (env.sight.batch.drawn[:, -1] == 0)
    assert plain.sum() > 3
    assert np.median(np.abs(line[plain, 0] - aside[plain])) < 0.4
    assert np.degrees(np.median(np.abs(np.arctan(line[plain, 1]) - np.arctan(slope[plain])))) < 12.0
