"""Tasks with cameras: worlds drawn by episode, pictures at their rate, and docking by camera."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

pytest.importorskip("newton")

from finssim.agents.agent import agent_for
from finssim.evaluation.plants import PlantError, load_plant
from finssim.extensions.perception import load_world
from finssim.extensions.perception.camera_docking import CameraDocking
from finssim.extensions.perception.gate import Gate, from_bar
from finssim.extensions.perception.net import Net
from finssim.extensions.perception.pipeline import Pipeline
from finssim.extensions.perception.servos import LightServo, LineFollower, PostServo, WallFollower
from finssim.tasks import TASKS, Environment, EnvironmentSetupError, environment, make, measurement
from finssim.tasks.check import check_task
from finssim.tasks.picture import ObservedPicture
from finssim.tasks.task import kernels_of
from finssim.vehicles import load_vehicle

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
    assert np.ptp(dock[:, 0]) > 0.05  # each world has its own dock


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
    env.simulator.state.steps.assign(np.array([0, 3, 0, 3], np.int32))  # two episodes end earlier
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
    for _ in range(5):  # past the end of an episode
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
    with pytest.raises(
        EnvironmentSetupError, match="perception.altimeter measures ranges, expected a camera or"
    ):
        Environment(Pipeline(pictures=(ObservedPicture("altimeter"),)), worlds=1)
    four = load_vehicle("finsrov").replace({"perception.altimeter.device": "dvl_a50"})
    with pytest.raises(
        EnvironmentSetupError, match="perception.altimeter has no single beam, which task 'net'"
    ):
        make("net", vehicle=four)
    blind = load_vehicle("finsrov").replace({"perception": {}})
    with pytest.raises(ValueError, match="has no sensor 'front_camera'"):
        make("camera-docking", vehicle=blind)


def test_the_teachers_task_is_a_task_of_numbers():
    task = CameraDocking().for_teacher()
    check_task(task)
    env = Environment(task, worlds=256, seed=2)
    step = env.step(np.zeros((256, 6)))
    assert step.observation.shape == (256, 19)
    assert np.abs(env.simulator.state.velocity.numpy()).max() < 0.5  # no vehicle starts in a wall


SERVOS = {
    "lights of the dock": (replace(CameraDocking(), turn=0.1, start=(3.0, 4.5)), LightServo, 0.6, 0.08, 12.0),
    "posts of the gate": (Gate(), PostServo, 0.5, 0.1, 15.0),
}
"""Task, baseline, share of pictures, and median errors of relative position and heading [deg]."""


@pytest.mark.parametrize("name", SERVOS)
def test_a_baseline_finds_lights_or_posts_in_the_picture(name):
    """In pictures that show all of them, the median errors of their middle and heading are within the table's
    limits."""
    task, kind, share, far, turn = SERVOS[name]
    env = Environment(task, worlds=32, seed=6)
    observation, servo = env.reset(), kind.for_vehicle(env.nominal[0])
    middle, heading, visible = servo.measure(observation["front_camera"], observation["state"][:, :3])
    state, goal = env.simulator.state, Rotation.from_quat(env.arrays.goal_quaternion.numpy())
    body = Rotation.from_quat(state.quaternion.numpy()[:, 0])
    square = env.arrays.goal_position.numpy() + goal.apply([-servo.before, 0.0, 0.0])
    truth = body.inv().apply(square - state.position.numpy()[:, 0]) - servo.eye
    error = np.linalg.norm(middle - truth, axis=1) / np.linalg.norm(truth, axis=1)
    turned = (body.inv() * goal).as_euler("ZYX")[:, 0] - heading
    assert visible.mean() > share
    assert np.median(error[visible]) < far and np.degrees(np.median(np.abs(turned[visible]))) < turn


def test_the_plant_of_held_out_looks_is_for_tasks_that_see():
    plant, vehicle = load_plant("held_out"), load_vehicle("finsrov")
    servo = agent_for("light-servo", vehicle, CameraDocking())
    env = plant.environment(servo, CameraDocking(), vehicle, worlds=8, seed=1)
    assert set(env.sight.batch.drawn[:, -1]) <= {3.0, 4.0}
    with pytest.raises(PlantError, match="task 't1' lacks"):
        plant.environment(agent_for("pid", vehicle, make("t1").task), make("t1").task, vehicle)


def test_the_line_of_the_pipeline_is_where_its_pipes_are():
    """A vehicle starts over a pipe of the world's objects, and the teacher's path ends on it."""
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
    """In the file's own water the median errors of the pipe's side and slope are within 0.4 m and 12°."""
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


def stepped(task, position, yaw=0.0):
    """Return metrics and steps after one control step from rest at positions in the goal's axes [m], (worlds,
    3)."""
    worlds = len(position)
    env = Environment(task, worlds=worlds, seed=1, auto_reset=False)
    goal, q = env.arrays.goal_position.numpy().copy(), env.arrays.goal_quaternion.numpy().copy()
    world = Rotation.from_quat(q)
    turned = (world * Rotation.from_euler("z", yaw)).as_quat()
    env.start(goal + world.apply(position), turned, goal, q)
    step = env.step(np.zeros((worlds, env.action_size)))
    return env.task.metrics(env.arrays), step


def test_a_gate_is_passed_between_its_posts_and_a_bar_is_touched_where_the_envelope_meets_it():
    """Cases: behind it in the middle, beside a post, at a post, turned into one, in front of it, below the
    posts' ends."""
    task = Gate().for_teacher()
    check_task(task)
    half = 0.5 * load_vehicle("finsrov").body.size
    reach = 0.75 - 0.045 - half[1]  # positions of the origin beside the axis, level and square to the gate
    places = [
        [0.3, 0, 0],
        [0.02, 1.5, 0],
        [0, reach + 0.01, 0],
        [0, reach - 0.02, 0],
        [-2, 0, 0],
        [0.01, 0, -1.2],
    ]
    measured, step = stepped(task, places)
    for name, ends in (
        ("passed", [1, 0, 0, 0, 0, 0]),
        ("missed", [0, 1, 0, 0, 0, 1]),
        ("touched", [0, 0, 1, 0, 0, 0]),
    ):
        np.testing.assert_array_equal(np.where(step.terminated, measured[name], 0.0), ends, err_msg=name)
    np.testing.assert_array_equal(step.terminated, [True, True, True, False, False, True])
    turned, step = stepped(task, [[0, reach - 0.02, 0]], yaw=np.pi / 4)
    assert turned["touched"][0] == 1.0  # its corners protrude farther


def test_the_distance_of_a_bar_from_a_box_is_the_least_of_its_points():
    """The distance equals the least over ten thousand points of each of 50 bars, to the resolution of their
    radius."""
    random, half = np.random.default_rng(2), np.array([0.28, 0.19, 0.15])
    for a, b in random.uniform(-1.0, 1.0, (50, 2, 3)):
        points = a + np.linspace(0.0, 1.0, 10_000)[:, None] * (b - a)
        beyond = np.abs(points) - half
        distance = np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0)
        found = from_bar(wp.vec3(*a), wp.vec3(*b), wp.vec3(*half))
        assert found == pytest.approx(distance.min() - 0.045, abs=1e-3)


def corners(env):
    """Return ends and corners of each world's net, world frame, (worlds, 4, 3)."""
    net = Rotation.from_quat(np.repeat(env.arrays.goal_quaternion.numpy(), 4, axis=0))
    places = net.apply(env.arrays.reference.position.numpy().reshape(-1, 3)).reshape(-1, 4, 3)
    return places + env.arrays.goal_position.numpy()[:, None]


def way_to_net(points, corners):
    """Return horizontal vectors from points to the nearest point of a net, (n, 2), with corners (4, 2)."""
    ways = []
    for a, b in zip(corners, corners[1:], strict=False):
        t = np.clip((points - a) @ (b - a) / np.sum((b - a) ** 2), 0.0, 1.0)
        ways.append(a + t[:, None] * (b - a) - points)
    nearest = np.linalg.norm(ways, axis=2).argmin(0)
    return np.array(ways)[nearest, np.arange(len(points))]


def test_along_a_net_the_row_has_the_range_below_and_the_picture_the_echoes_of_the_net():
    """The range is the slant distance to the tube at the net's foot, to 0.3 m; the baseline finds a point of the net.

    Both are current values of a sensor without latency, at the start of an episode and after steps; the last row of an
    episode is kept with its range.
    """
    now = load_vehicle("finsrov").replace({"perception.altimeter.latency": 0.0})
    env = Environment(Net(time_limit=0.5), now, worlds=12, seed=6)
    follower = WallFollower.for_vehicle(env.nominal[0])
    observation = env.reset()
    for k in range(6):
        x, net = env.simulator.state.position.numpy()[:, 0], corners(env)
        away = [np.linalg.norm(way_to_net(x[w : w + 1, :2], net[w, :, :2])) for w in range(12)]
        assert observation["sonar"].shape == (12, 128, 48, 1) and observation["sonar"].dtype == np.uint8
        below = 4.4 + 0.5 * observation["state"][:, 9]
        assert np.median(np.abs(below - np.hypot(x[:, 2] + 6.9, away) + 0.14)) < 0.3
        np.testing.assert_allclose(below, np.minimum(env.arrays.ranges.numpy()[:, 0], 6.4), rtol=1e-5)
        point, enough = follower.nearest(observation["sonar"], np.full(12, 1.5))
        assert enough.all() and np.median(np.abs(np.linalg.norm(point, axis=1) - away)) < 0.05
        step = env.step(np.zeros((12, 4)))
        observation = step.observation
        if k == 4:
            assert step.truncated.all() and step.final_observation["sonar"].any()
            assert np.all(step.final_observation["state"][:, 9] != observation["state"][:, 9])


def test_the_sides_of_a_net_meet_as_those_of_its_site_do_with_a_world_and_without():
    """Sides have equal lengths and meet at up to 30° to either side; the ropes stand at the corners."""
    bends = {}
    for task in (Net(), Net().for_teacher()):
        env = Environment(task, worlds=200, seed=3)
        sides = np.diff(env.arrays.reference.position.numpy()[:, :, :2], axis=1)
        np.testing.assert_allclose(np.linalg.norm(sides, axis=2), np.tile(task.sides, (200, 1)), atol=1e-5)
        bends[task.world] = np.diff(np.degrees(np.arctan2(-sides[..., 0], sides[..., 1])), axis=1)
        assert np.all(np.abs(bends[task.world]) < 30.001)
        np.testing.assert_allclose(bends[task.world].std(axis=0), 60.0 / np.sqrt(12.0), rtol=0.1)
        if env.sight is not None:
            rope = env.sight.batch.poses("rope_2")[:, :2]
            np.testing.assert_allclose(corners(env)[:, 2, :2], rope, atol=1e-5)
            assert load_world("net").objects["middle"].vary.yaw == pytest.approx(task.bend, abs=1e-4)


def test_the_teacher_of_the_net_sees_the_line_round_the_corner():
    """Now and 0.5 m ahead, the target lies 1.5 m from the net, and the heading points at the net."""
    env, random = Environment(Net().for_teacher(), worlds=200, seed=4), np.random.default_rng(1)
    goal, net_q = env.arrays.goal_position.numpy().copy(), env.arrays.goal_quaternion.numpy().copy()
    off = random.uniform([-1.8, -1.0, -2.8], [-1.2, 3.0, -2.2], (200, 3))
    x = goal + Rotation.from_quat(net_q).apply(off)
    q = Rotation.from_euler("z", random.uniform(-np.pi, np.pi, (200, 1)))
    env.start(x, q.as_quat(), goal, net_q)
    taught, net = env.arrays.taught.numpy(), corners(env)
    for first in (0, 6):
        line, nose = x + q.apply(taught[:, first : first + 3]), q.apply(taught[:, first + 3 : first + 6])
        way = np.array([way_to_net(line[w : w + 1, :2], net[w, :, :2])[0] for w in range(200)])
        error = np.abs(np.linalg.norm(way, axis=1) - 1.5)
        assert np.median(error) < 1e-3 and np.percentile(error, 90) < 0.1
        off_nose = np.degrees(
            np.arctan2(nose[:, 0] * way[:, 1] - nose[:, 1] * way[:, 0], np.sum(nose[:, :2] * way, axis=1))
        )
        assert np.median(np.abs(off_nose)) < 1.5 and np.percentile(np.abs(off_nose), 95) < 16.0
        np.testing.assert_allclose(line[:, 2], env.task.level, atol=1e-4)


def test_a_net_is_touched_with_the_nose_and_lost_beside_the_line():
    """0.12 m before the net, within its growth, is a touch; 0.8 m off the line is a loss; on the line it is
    neither."""
    task = Net().for_teacher()
    check_task(task)
    nose, level = 0.5 * load_vehicle("finsrov").body.size[0], task.level
    places = [
        [-nose - 0.13, -1.6, level],
        [-nose - 0.11, -1.6, level],
        [-1.5, -1.6, level],
        [-2.32, -1.6, level],
        [-1.5, -1.6, level + 0.82],
    ]
    measured, step = stepped(replace(task, lost=1.5), places[:3])
    np.testing.assert_array_equal(step.terminated, [False, True, False])
    assert measured["touched"][1] == 1.0
    measured, step = stepped(task, places[2:])
    np.testing.assert_array_equal(step.terminated, [False, True, True])
    np.testing.assert_array_equal(measured["lost"][1:], 1.0)


def test_a_net_is_touched_wherever_the_envelope_meets_it_round_its_corners_too():
    """Level vehicles near both corners, at any heading, are compared by the distance of their points from the sides.

    Where two corners meet, the task may report a touch 5 cm early.
    """
    worlds, random = 400, np.random.default_rng(7)
    env = Environment(
        replace(Net().for_teacher(), lost=9.0, tilt=0.0), worlds=worlds, seed=5, auto_reset=False
    )
    goal, q = env.arrays.goal_position.numpy().copy(), env.arrays.goal_quaternion.numpy().copy()
    places = random.uniform([-0.8, -0.8, env.task.level], [0.8, 3.4, env.task.level], (worlds, 3))
    x, yaw = goal + Rotation.from_quat(q).apply(places), random.uniform(-np.pi, np.pi, worlds)
    env.start(x, Rotation.from_euler("z", yaw[:, None]).as_quat(), goal, q)
    net = corners(env)
    env.step(np.zeros((worlds, env.action_size)))
    touched = env.task.metrics(env.arrays)["touched"]
    half, side = 0.5 * load_vehicle("finsrov").body.size[:2], np.linspace(-1.0, 1.0, 41)
    inside = half * np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    apart = np.zeros(worlds)
    for w in range(worlds):
        c, s = np.cos(yaw[w]), np.sin(yaw[w])
        points = x[w, :2] + inside @ np.array([[c, s], [-s, c]])
        apart[w] = np.linalg.norm(way_to_net(points, net[w, :, :2]), axis=1).min()
    growth = env.task.growth
    assert np.all(touched[apart < growth - 0.005] == 1.0)
    assert np.all(touched[apart > growth + 0.05] == 0.0)
    assert np.mean(touched != (apart < growth)) < 0.03 and 0.2 < touched.mean() < 0.9


def test_who_follows_the_net_at_the_wrong_distance_has_not_inspected_it():
    """The baseline at 1.5 m succeeds; the same baseline at 1.8 m covers the path and does not succeed."""
    for distance, success in ((1.5, 1.0), (1.8, 0.0)):
        env = Environment(Net(), worlds=4, seed=3, auto_reset=False)
        follower = replace(WallFollower.for_vehicle(env.nominal[0]), distance=distance)
        memory, observation = follower.reset(4), env.reset()
        for _ in range(360):
            action, memory = follower.act(memory, observation["state"], {"sonar": observation["sonar"]})
            observation = env.step(action).observation
        measured = env.task.metrics(env.arrays)
        assert (measured["success"] == success).all() and not measured["lost"].any()
        assert (measured["error"] < 0.1).all() == (success == 1.0)


@pytest.mark.parametrize("name", [name for name in TASKS if TASKS[name]().pictures])
def test_the_kernels_of_tasks_that_see_compile_for_cuda(name, tmp_path):
    """NVRTC, which needs no device, compiles the kernels to PTX for compute capability 7.5.

    These are the kernels of the task, of its teacher, and of running and measuring tasks; `test_cuda` covers the
    sensors.
    """
    wp.init()
    if wp.get_cuda_toolkit_version() is None:
        pytest.skip("this Warp has no CUDA compiler")
    kind = TASKS[name]
    made = [kernels_of(task).evaluate.module for task in (kind(), kind().for_teacher())]
    common = [wp.get_module(module.__name__) for module in (environment, measurement)]
    for i, module in enumerate([*made, *(common if kind is Net else [])]):
        assert module.kernels
        wp.compile_aot_module(module, arch=75, module_dir=tmp_path / str(i), use_ptx=True)
        assert [file.stat().st_size > 0 for file in (tmp_path / str(i)).glob("*.ptx")] == [True]
