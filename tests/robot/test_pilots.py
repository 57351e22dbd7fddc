"""Pilots decide exactly as the same controller does elsewhere, and refuse what does not fit."""

import hashlib
import math

import numpy as np
import pytest
import yaml
from onnx import TensorProto, helper, numpy_helper

from finssim.agents.controllers import controller
from finssim.control import ControlError
from finssim.control.allocation import Allocator
from finssim.control.course import CoursePilot
from finssim.control.guidance import Station, Track, goal_at
from finssim.control.modes import action_mode
from finssim.control.policy import PolicyError
from finssim.control.trajectories import through_points
from finssim.core.rotations import quat_from_euler
from finssim.robot.goals import GoalError, check_reachable, guide_of, station_of
from finssim.robot.pilots import HelmPilot, ModeSwitch, WrenchPilot, make_pilot
from finssim.robot.reading import Reading
from finssim.robot.runtime import Ticks
from finssim.sim import linear_model
from finssim.sim.model import acceleration
from finssim.tasks import StationKeeping
from finssim.tasks.observer import Observer
from finssim.vehicles import load_vehicle

VEHICLE = load_vehicle("finsrov")
STATION = Station((1.0, -0.3, -0.5), 0.6)
READING = Reading(
    5.0,
    np.array([0.2, 0.1, -0.4]),
    quat_from_euler(0.05, -0.03, 0.2),
    np.array([0.1, -0.05, 0.02, 0.01, 0.0, -0.1]),
    True,
)
LEVEL_ETA = np.array([0.0, 0.0, -10.0, 0.0, 0.0, 0.0])
LEVEL = Track(LEVEL_ETA[:3], np.array([0.0, 0.0, 0.0, 1.0]), np.array([1.8, 0.0, 0.0, 0.0, 0.0, 0.0]))
GAIN = np.random.default_rng(0).normal(0.0, 0.3, (4, 16)).astype(np.float32)


def network():
    """clip(GAIN x, -1, 1), as an ONNX file."""
    weights = [numpy_helper.from_array(GAIN, "gain")]
    weights += [numpy_helper.from_array(np.float32(v), n) for v, n in ((-1, "low"), (1, "high"))]
    nodes = [helper.make_node("Gemm", ["observation", "gain"], ["x"], transB=1)]
    nodes += [helper.make_node("Clip", ["x", "low", "high"], ["action"])]
    x = helper.make_tensor_value_info("observation", TensorProto.FLOAT, ["N", 16])
    y = helper.make_tensor_value_info("action", TensorProto.FLOAT, ["N", 4])
    graph = helper.make_graph(nodes, "policy", [x], [y], weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    return model.SerializeToString()


@pytest.fixture
def policy(tmp_path):
    """Return a function that writes a T1 policy directory for FinsROV, with changes to its description."""

    def write(**changes):
        content = network()
        description = {
            "format": 1,
            "task": "t1",
            "observation": StationKeeping().schema.model_dump(mode="json"),
            "action": action_mode("wrench4", VEHICLE, 0.5).describe(),
            "control_period": 0.1,
            "vehicle": {"name": VEHICLE.name, "sha256": VEHICLE.sha256},
            "hydrodynamics": "calibrated",
            "seed": 42,
            "files": {"policy.onnx": hashlib.sha256(content).hexdigest()},
            **changes,
        }
        folder = tmp_path / "hold"
        folder.mkdir(exist_ok=True)
        (folder / "policy.onnx").write_bytes(content)
        (folder / "policy.yaml").write_text(yaml.safe_dump(description))
        return folder

    return write


def test_a_policy_pilot_gives_the_thrusts_of_its_network(policy):
    """The pilot chains observation, network, action mode and allocation."""
    pilot = make_pilot(policy(), VEHICLE)
    action = np.clip(GAIN @ Observer("t1", VEHICLE).observe(READING, STATION, 0.0), -1.0, 1.0)
    expected = action_mode("wrench4", VEHICLE, 0.5).to_thrusters(action)
    np.testing.assert_allclose(pilot.act(READING, STATION, 0.0), expected, atol=1e-4)
    assert pilot.period == 0.1 and pilot.describe()["task"] == "t1"


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"vehicle": {"name": "finsrov", "sha256": "0" * 64}}, "trained for vehicle finsrov 000000000000"),
        ({"task": "t9"}, "unknown task 't9'"),
        ({"task": "t2"}, "observation schema does not match"),
        (
            {"action": {**action_mode("wrench4", VEHICLE).describe(), "limits": [1.0] * 6}},
            r"wrench4.limits\[0\] is 1.0 in the policy and",
        ),
        (
            {"action": {**action_mode("wrench4", VEHICLE).describe(), "mode": "jet"}},
            "unknown action mode 'jet'",
        ),
    ],
)
def test_a_policy_that_does_not_fit_is_refused(policy, changes, sentence):
    """A mismatch of vehicle, task, observation or limits is named in one sentence."""
    with pytest.raises((PolicyError, ControlError), match=sentence):
        make_pilot(policy(**changes), VEHICLE)


def test_a_policy_of_another_task_than_asked_is_refused(policy):
    """`--task t2` with a policy of T1 is refused."""
    with pytest.raises(PolicyError, match="trained for task 't1', but this is 't2'"):
        make_pilot(policy(), VEHICLE, task="t2")


def test_a_network_that_was_changed_is_refused(policy):
    """A network whose hash differs from the description is refused."""
    folder = policy()
    (folder / "policy.onnx").write_bytes(b"x")
    with pytest.raises(PolicyError, match="corrupt"):
        make_pilot(folder, VEHICLE)


@pytest.mark.parametrize("name", ["pid", "pid-paper"])
def test_a_pid_pilot_allocates_the_controllers_wrench(name):
    """Memory is kept between two consecutive decisions; reset clears it."""
    pilot, same = make_pilot(name, VEHICLE), controller(name, VEHICLE)
    memory, limits, first = same.reset(), VEHICLE.wrench_limits, None
    for _ in range(2):
        tau, memory = same.command(memory, READING, goal_at(STATION, 0.0))
        expected = Allocator.from_vehicle(VEHICLE).allocate(np.clip(tau, -limits, limits))
        given = pilot.act(READING, STATION, 0.0)
        first = given if first is None else first
        np.testing.assert_allclose(given, expected, atol=1e-6)
    pilot.reset()
    np.testing.assert_allclose(pilot.act(READING, STATION, 0.0), first)
    assert pilot.period == same.period


def test_a_wrench_pilot_gives_a_persons_wrench_within_the_limits():
    """A feasible surge is passed unchanged; a hundred times the limit is clipped to the limit."""
    wanted = np.array([5.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    pilot = WrenchPilot(lambda: wanted, VEHICLE)
    blind = Reading(0.0, np.full(3, np.nan), np.full(4, np.nan), np.full(6, np.nan), False)
    np.testing.assert_allclose(VEHICLE.control_matrix @ pilot.act(blind, STATION, 0.0), wanted, atol=2e-3)
    wanted = np.array([1e4, 0.0, 0.0, 0.0, 0.0, 0.0])
    reached = VEHICLE.control_matrix @ pilot.act(blind, STATION, 0.0)
    assert reached[0] == pytest.approx(VEHICLE.wrench_limits[0], rel=0.01) and not pilot.needs_state


def test_a_mode_switch_is_the_pilot_that_is_selected():
    """Period, need of a state and decisions are those of the selected pilot; a newly selected pilot starts
    without memory."""
    pilots = {"hold": make_pilot("pid", VEHICLE), "hand": WrenchPilot(lambda: np.zeros(6), VEHICLE)}
    switch = ModeSwitch(pilots)
    first = switch.act(READING, STATION, 0.0)
    assert switch.mode == "hold" and switch.needs_state and switch.period == pilots["hold"].period
    switch.select("hand")
    assert not switch.needs_state and not switch.act(READING, STATION, 0.0).any()
    assert switch.describe() == {"mode": "hand", **pilots["hand"].describe()}
    switch.select("hold")
    np.testing.assert_allclose(switch.act(READING, STATION, 0.0), first)
    with pytest.raises(ControlError, match="unknown mode 'x'; available: hold, hand"):
        switch.select("x")
    with pytest.raises(ControlError, match="at least one pilot"):
        ModeSwitch({})


def test_who_is_neither_pid_nor_policy_is_refused():
    """The refusal lists the available controllers."""
    with pytest.raises(
        PolicyError, match="neither pid nor pid-paper nor lqr nor nmpc nor a policy directory"
    ):
        make_pilot("runs/nothing", VEHICLE)


class Watched:
    """An agent that records its readings."""

    def __init__(self, agent):
        self.agent, self.seen = agent, []

    def __getattr__(self, name):
        return getattr(self.agent, name)

    def act(self, memory, known, goal):
        self.seen.append(np.concatenate([known.position[0], known.quaternion[0], known.nu[0]]))
        return self.agent.act(memory, known, goal)


def disturbed(**noise):
    """Return a PID with noise on its input."""
    pilot = make_pilot("pid", VEHICLE)
    pilot.agent = Watched(pilot.agent)
    pilot.disturb_input(**noise)
    return pilot


def test_noise_on_the_input_has_the_size_asked_for_and_touches_pose_alone():
    """Over 2000 decisions: 5 cm on each axis and 10 degrees of heading; tilt and velocity are unchanged."""
    pilot = disturbed(position_std=0.05, yaw_std=math.radians(10.0), seed=3)
    for _ in range(2000):
        pilot.act(READING, STATION, 0.0)
    seen = np.array(pilot.agent.seen)
    np.testing.assert_allclose(seen[:, :3].std(axis=0), 0.05, rtol=0.1)
    x, y, z, w = seen[:, 3:7].T
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    assert yaw.std() == pytest.approx(math.radians(10.0), rel=0.1)
    up = 1.0 - 2.0 * (x * x + y * y)
    np.testing.assert_allclose(up, up[0], atol=1e-12)
    assert (seen[:, 7:] == READING.nu).all()


def test_noise_on_the_input_repeats_from_its_seed():
    """The noise repeats after a reset and in another instance; another seed differs."""
    a, b, c = (disturbed(position_std=0.05, yaw_std=0.1, seed=s) for s in (1, 1, 2))
    for pilot in (a, b, c):
        pilot.act(READING, STATION, 0.0)
    a.reset()
    a.act(READING, STATION, 0.0)
    first, again = a.agent.seen
    assert np.array_equal(again, first) and np.array_equal(b.agent.seen[0], first)
    assert not np.array_equal(c.agent.seen[0], first)
    assert a.describe()["input_noise"]["seed"] == 1


def test_turns_stay_on_the_grid_of_their_start():
    """Late calls miss turns but shift none; a turn may come 2 ms early."""
    ticks = Ticks(10.0)
    due = [ticks.due(t, 0.1) for t in (10.0, 10.05, 10.099, 10.15, 10.23, 10.55, 10.6)]
    assert due == [(True, 0), (False, 0), (True, 0), (False, 0), (True, 0), (True, 2), (True, 0)]


def test_turns_go_on_after_the_clock_was_set_back():
    """After the clock is set back, turns continue at once on a new grid."""
    ticks = Ticks(10.0)
    assert ticks.due(10.0, 0.1) == (True, 0)
    assert [ticks.due(t, 0.1) for t in (3.0, 3.05, 3.1)] == [(True, 0), (False, 0), (True, 0)]


def test_goals_are_read_from_text_and_files(tmp_path):
    """Goals are x, y, z [m] and degrees."""
    assert station_of("1,-0.3,-0.5,90") == Station((1.0, -0.3, -0.5), math.radians(90.0))
    file = tmp_path / "goal.yaml"
    file.write_text("goal: [0.5, 0, -0.4, -45]\n")
    assert guide_of(str(file), None) == Station((0.5, 0.0, -0.4), math.radians(-45.0))
    assert guide_of(None, "ellipse").name == "ellipse"


@pytest.mark.parametrize("text", ["1,2,3", "1,2,3,x", "nan,0,0,0", ""])
def test_a_goal_that_is_none_is_refused(text):
    """The refusal states what was expected, with units."""
    with pytest.raises(GoalError, match="expected four numbers x,y,z,yaw_deg"):
        station_of(text)


def test_a_goal_file_without_a_goal_is_refused(tmp_path):
    """A file without a goal and a file that is not YAML are refused."""
    (tmp_path / "a.yaml").write_text("x: 1\n")
    (tmp_path / "b.yaml").write_text("goal: [1, 2\n")
    with pytest.raises(GoalError, match="no goal in it"):
        station_of(str(tmp_path / "a.yaml"))
    with pytest.raises(GoalError, match="not valid YAML"):
        station_of(str(tmp_path / "b.yaml"))


def test_one_of_goal_and_trajectory_must_be_given():
    """Giving both or neither is refused."""
    for both in (("0,0,-0.5,0", "ellipse"), (None, None)):
        with pytest.raises(GoalError, match="either a goal"):
            guide_of(*both)


def test_a_goal_outside_the_workspace_is_refused():
    """Goals above the water or beyond a wall are refused; the published trajectories lie inside."""
    check_reachable(guide_of(None, "ellipse"), VEHICLE)
    with pytest.raises(GoalError, match="outside the workspace"):
        check_reachable(station_of("2.5,0,-0.5,0"), VEHICLE)
    with pytest.raises(
        GoalError, match=r"leads to 0.20 m above the surface, which is z = 0 .*: give a z below 0"
    ):
        check_reachable(station_of("0,0,0.2,0"), VEHICLE)


def test_a_way_that_is_faster_than_the_vehicle_is_refused():
    """The speed is checked between any two points, however close; a vehicle that cannot sway still follows a
    curve."""
    way = [
        (0.0, 0.0, 0.0, -0.5),
        (500.0, 0.5, 0.0, -0.5),
        (500.001, 0.6, 0.0, -0.5),
        (1000.0, 0.6, 0.1, -0.5),
    ]
    with pytest.raises(GoalError, match="m/s at 500 s, but finsrov goes 0.6"):
        check_reachable(through_points("way", way), VEHICLE)
    check_reachable(through_points("way", way[:2] + way[3:]), VEHICLE)
    check_reachable(guide_of(None, "lemniscate"), load_vehicle("lauv"))


def test_the_published_pid_has_a_profile_for_each_task():
    """Station keeping uses one set of gains, trajectory following another."""
    t1, t2 = (make_pilot("pid-paper", VEHICLE, task=task).act(READING, STATION, 0.0) for task in ("t1", "t2"))
    assert np.abs(t1 - t2).max() > 0.1


@pytest.mark.parametrize(("left", "up"), [(1.0, 0.0), (-0.5, 0.0), (0.0, 1.0), (0.5, -0.5)])
def test_a_person_moves_fins_by_their_effect(left, up):
    """Left turns to port and up raises the bow; only the forward stick drives the propeller."""
    vehicle = load_vehicle("remus100")
    pilot = HelmPilot(lambda: (0.5, 0.0, up, left), vehicle)
    channels = pilot.act(LEVEL, Station((0.0, 0.0, 0.0), 0.0), 0.0)
    lower, upper = vehicle.channel_limits
    assert channels[0] == pytest.approx(0.5 * upper[0])
    nu = np.array([2.0, 0, 0, 0, 0, 0])
    straight = acceleration(vehicle, LEVEL_ETA, nu, np.zeros(6), actuators=channels * [1, 0, 0])
    turned = acceleration(vehicle, LEVEL_ETA, nu, np.zeros(6), actuators=channels) - straight
    yaw, pitch = turned[[5, 4]] / np.abs(turned[[5, 4]]).max()
    assert np.sign(np.round([yaw, pitch], 1)) == pytest.approx([np.sign(left), -np.sign(up)])
    assert np.abs(channels[1:]) == pytest.approx(np.array([abs(left), abs(up)]) * upper[1:], abs=1e-9)


def test_a_person_gives_orders_to_the_autopilot():
    """The channels equal the action of mode `course_pitch`; without forward everything stops."""
    vehicle, hands = load_vehicle("remus100"), [0.75, 0.0, 0.2, -0.4]
    pilot = HelmPilot(lambda: hands, vehicle, "course_pitch", period=0.1)
    assert pilot.needs_state
    autopilot = CoursePilot(linear_model(vehicle), vehicle.name, 0.1)
    expected, _ = autopilot.act(autopilot.reset(), LEVEL, [[0.5, -0.4, -0.2]], by_pitch=True)
    assert pilot.act(LEVEL, Station((0.0, 0.0, 0.0), 0.0), 0.0) == pytest.approx(expected[0])
    hands[0] = 0.0
    assert not pilot.act(LEVEL, Station((0.0, 0.0, 0.0), 0.0), 0.1).any()
    with pytest.raises(ControlError, match="unknown action 'wrench4' of a person"):
        HelmPilot(lambda: hands, vehicle, "wrench4")
