# ruff: noqa: E402 - rclpy can be imported once a backend is active
"""The controller node with a simulated bridge and estimator on the wire, and with a human operator."""

import json
import math
import time

import numpy as np
import pytest

from finssim.extensions.ros2.backend import activate

activate(announce=False)

import rclpy
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile

from finssim.agents.controllers import controller
from finssim.control.allocation import Allocator
from finssim.control.guidance import Station, goal_at
from finssim.extensions.ros2.nodes.controller import ControllerNode
from finssim.extensions.ros2.nodes.conversions import RosMessages, force_of, nanoseconds, ros_type
from finssim.extensions.ros2.nodes.teleop import Teleop
from finssim.extensions.ros2.topics import TOPICS, quality_profile
from finssim.robot.reading import Reading
from finssim.vehicles import load_vehicle

PATIENCE = 30.0  # [s] on a busy machine
HEARD = ("command", "policy", "event", "stop", "wrench", "arm", "mode", "acknowledge", "path")
SENT = ("odometry", "estimator", "thrusters", "goal", "trajectory", "follow", "mode", "wrench")
PLACE = np.array([0.2, 0.1, -0.5])


class Stage:
    """Node under test, and a peer that simulates everything around it."""

    def __init__(self, make):
        self.peer = Node("peer", namespace="finsrov")
        self.heard = {key: [] for key in HEARD}
        for key in HEARD:
            self.peer.create_subscription(
                ros_type(TOPICS[key].type),
                TOPICS[key].name,
                self.heard[key].append,
                quality_profile(TOPICS[key].quality),
            )
        self.node = make()
        self.make, self.state, self.place, self.silent = (
            RosMessages(self.node.vehicle),
            "disarmed",
            PLACE,
            False,
        )
        self.clock = None
        """Simulated time that the peer publishes [ns]; None for the system's time."""
        self._clock = self.peer.create_publisher(ros_type("rosgraph_msgs/msg/Clock"), "/clock", 10)
        self._out = {
            key: self.peer.create_publisher(
                ros_type(TOPICS[key].type), TOPICS[key].name, quality_profile(TOPICS[key].quality)
            )
            for key in SENT
        }

    def send(self, key, message=None, **fields):
        self._out[key].publish(message or ros_type(TOPICS[key].type)(**fields))

    def play(self):
        """Publish one turn of the node's inputs: a state and the bridge's messages."""
        if self.clock is not None:
            self.clock += 10_000_000
            self._clock.publish(self.make.clock(self.clock))
        stamp = time.time_ns() if self.clock is None else self.clock
        nothing = np.zeros(6), True, "fresh", "", np.full(7, 0.01)
        reading = Reading(0.0, self.place, np.array([0.0, 0.0, 0.0, 1.0]), *nothing)
        if not self.silent:
            self.send("odometry", self.make.odometry(stamp, reading))
            self.send("estimator", self.make.estimator(stamp, reading, {}))
        self.send("thrusters", self.make.thrusters(stamp, self.state, {}))
        for node in (self.node, self.peer):
            for _ in range(8):
                rclpy.spin_once(node, timeout_sec=0.001)

    def until(self, condition, each=lambda: None):
        """Play until a condition is true; return whether it became true in time."""
        end = time.monotonic() + PATIENCE
        while not condition() and time.monotonic() < end:
            each()
            self.play()
        return condition()

    def turns(self, n):
        for _ in range(n):
            self.play()

    def events(self, kind):
        return [e["text"] for m in self.heard["event"] if (e := json.loads(m.data))["kind"] == kind]

    def asked(self):
        """Return the thrusts of the newest command."""
        return force_of(self.heard["command"][-1], self.make.names)

    def close(self):
        self.node.close(), self.node.destroy_node(), self.peer.destroy_node()


@pytest.fixture
def wire():
    """Participant of this process, with the node's parameters as arguments."""
    stages = []

    def start(make, *arguments):
        rclpy.init(args=["--ros-args", "-r", "__ns:=/finsrov", *arguments])
        stages.append(Stage(make))
        return stages[-1]

    yield start
    for stage in stages:
        stage.close()
    rclpy.try_shutdown()


def pid_force(goal):
    """Return the force of the same PID at the stage's position on its first decision."""
    vehicle = load_vehicle("finsrov")
    pid = controller("pid", vehicle)
    at = Reading(0.0, PLACE, np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(6), True)
    tau, _ = pid.command(pid.reset(), at, goal_at(goal, 0.0))
    limits = np.asarray(vehicle.wrench_limits, float)
    return Allocator.from_vehicle(vehicle).allocate(np.clip(tau, -limits, limits))


def test_it_is_silent_until_the_bridge_is_armed(wire):
    """Armed, it requests the PID's forces towards the goal of its parameter; disarmed, it is silent again."""
    stage = wire(ControllerNode, "-p", "goal:='0.6,0.1,-0.5,0'", "-p", "use_sim_time:=true")
    stage.clock = 10 * 10**9  # at most one decision a turn, so that no message is overwritten unread
    assert stage.until(lambda: stage.node.state.reading(stage.node.now()).ready)
    stage.turns(20)
    assert not stage.heard["command"]
    stage.state = "armed"
    assert stage.until(lambda: stage.heard["command"])
    first = force_of(stage.heard["command"][0], stage.make.names)
    assert first == pytest.approx(pid_force(Station((0.6, 0.1, -0.5), 0.0)), abs=1e-6)
    assert stage.until(lambda: stage.heard["policy"]) and stage.heard["policy"][0].pilot == "pid"
    stage.state = "disarmed"
    stage.turns(20)
    stage.heard["command"].clear()
    stage.turns(20)
    assert not stage.heard["command"]


def test_without_a_goal_it_keeps_the_place_where_it_was_armed(wire):
    """A goal by topic moves the hold position; one outside the workspace or not level does not."""
    stage = wire(ControllerNode)
    stage.state = "armed"
    assert stage.until(lambda: stage.heard["command"])
    assert stage.node.runtime.guide.name == "here"
    assert stage.node.runtime.guide.position == pytest.approx(tuple(PLACE))
    stage.send("goal", stage.make.goal(0, (40.0, 0.0, -0.5), 0.0))
    assert stage.until(lambda: any("outside the workspace" in text for text in stage.events("refused")))
    stage.send("goal", stage.make.goal(0, (math.nan, 0.0, -0.5), 0.0))
    assert stage.until(lambda: any("not finite" in text for text in stage.events("refused")))
    stage.send("goal", stage.make.goal(0, (0.5, -0.3, -0.6), 0.7))
    assert stage.until(lambda: stage.node.runtime.guide.name == "station")
    assert stage.node.runtime.guide.at(0.0).position == pytest.approx([0.5, -0.3, -0.6])
    stage.send("trajectory", data="no such shape")
    assert stage.until(lambda: len(stage.events("refused")) == 3)


@pytest.mark.parametrize("durability", ["VOLATILE", "TRANSIENT_LOCAL"])
def test_a_goal_that_is_given_again_is_followed_again(wire, capfd, durability):
    """Publishers of either durability, such as RViz and `ros2 topic pub`, cause no warning of incompatible
    policies."""
    stage = wire(ControllerNode)
    policies = QoSProfile(depth=1, durability=DurabilityPolicy[durability])
    publisher = stage.peer.create_publisher(ros_type(TOPICS["goal"].type), "goal", policies)
    assert stage.until(lambda: publisher.get_subscription_count() == 1), "one subscription, not two"
    goal = stage.make.goal(0, (0.5, -0.3, -0.6), 0.7)
    for count in (1, 2):
        publisher.publish(goal)
        assert stage.until(lambda count=count: len(stage.events("goal")) == count)
    assert "incompatible" not in capfd.readouterr().err


def test_commands_say_who_asks_and_in_which_mode(wire):
    """The node is one commander in every mode."""
    stage = wire(ControllerNode)
    stage.state = "armed"
    assert stage.until(lambda: stage.heard["command"])
    assert stage.heard["command"][-1].source == "controller/pid"
    stage.send("mode", data="teleop")
    assert stage.until(lambda: stage.heard["command"][-1].source == "controller/teleop")


def test_a_path_with_times_is_followed_and_shown_with_times(wire):
    """Times count from the first pose; each pose of the displayed path is stamped with its due time."""
    stage = wire(ControllerNode)
    stage.state = "armed"
    assert stage.until(lambda: stage.heard["path"] and stage.heard["command"])
    rows = [(0.0, (0.2, 0.1, -0.5), 0.0), (4.0, (0.4, 0.1, -0.5), 0.5), (10.0, (0.4, -0.3, -0.6), 1.0)]
    times, places, yaws = zip(*[(7 * 10**9 + int(t * 1e9), p, yaw) for t, p, yaw in rows], strict=True)
    stage.send("follow", stage.make.path(0, times, places, yaws))
    assert stage.until(lambda: stage.heard["path"] and len(stage.heard["path"][-1].poses) == 200)
    guide, shown = stage.node.runtime.guide, stage.heard["path"][-1]
    assert (guide.name, guide.duration) == ("path", 10.0)
    for t, place, yaw in rows:
        at = guide.at(t)
        assert at.position == pytest.approx(place) and float(at.yaw) == pytest.approx(yaw)
    due = [nanoseconds(pose.header.stamp) * 1e-9 for pose in shown.poses]
    assert np.diff(due) == pytest.approx(10.0 / 199, abs=1e-6)
    assert due[0] == pytest.approx(stage.node.base * 1e-9 + stage.node.runtime.started, abs=1e-6)
    assert shown.poses[-1].pose.position.y == pytest.approx(-0.3)


def test_a_way_is_shown_again_when_it_begins(wire):
    """The time of a path begins at arming."""
    stage = wire(ControllerNode, "-p", "trajectory:=lemniscate")
    assert stage.until(lambda: stage.heard["path"])
    stage.turns(5)
    stage.state = "armed"
    assert stage.until(lambda: len(stage.heard["path"]) == 2 and stage.heard["command"])
    first, second = (nanoseconds(path.poses[0].header.stamp) * 1e-9 for path in stage.heard["path"])
    assert second > first and second == pytest.approx(
        stage.node.base * 1e-9 + stage.node.runtime.started, abs=1e-6
    )


def leap(path):
    """Change the path to a metre in a millisecond."""
    path.poses[1].pose.position.x = path.poses[0].pose.position.x + 1.0
    path.poses[1].header.stamp.sec, path.poses[1].header.stamp.nanosec = 0, 10**6


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda path: [setattr(pose.header.stamp, "sec", 0) for pose in path.poses],
            "not after the one before it",
        ),
        (lambda path: path.poses.clear(), "two or more rows"),
        (lambda path: setattr(path.header, "frame_id", "odom"), "frame 'odom', expected map"),
        (
            lambda path: setattr(path.poses[1].pose.position, "x", math.nan),
            "pose 2: a goal that is not finite",
        ),
        (lambda path: setattr(path.poses[1].pose.position, "x", 50.0), "outside the workspace"),
        (leap, "1500 m/s at"),
    ],
)
def test_a_path_that_cannot_be_followed_is_refused(wire, change, words):
    """The refusal is a sentence on `events`, and the previous path is kept."""
    stage = wire(ControllerNode, "-p", "goal:='0.6,0.1,-0.5,0'")
    path = stage.make.path(0, (0, 10**9), [(0.2, 0.1, -0.5), (0.3, 0.1, -0.5)], (0.0, 0.0))
    change(path)
    stage.send("follow", path)
    assert stage.until(lambda: stage.events("refused")) and words in stage.events("refused")[0]
    assert stage.node.guide.name == "station"


def test_parameters_of_a_running_node_stay_as_they_are(wire):
    """`ros2 param set` is refused rather than succeeding without effect."""
    stage = wire(ControllerNode, "-p", "policy:=pid-paper")
    (result,) = stage.node.set_parameters([Parameter("policy", value="pid")])
    assert not result.successful and "read-only: set it at the start" in result.reason


def test_a_node_keeps_its_clock(wire):
    """use_sim_time would change the time of an armed robot: it is refused with the reason and has no effect."""
    stage = wire(ControllerNode, "-p", "goal:='0.6,0.1,-0.5,0'")
    stage.state = "armed"
    assert stage.until(lambda: stage.heard["command"])
    (result,) = stage.node.set_parameters([Parameter("use_sim_time", value=True)])
    assert not result.successful and "start it again" in result.reason
    assert not stage.node.get_parameter("use_sim_time").value
    (result,) = stage.node.set_parameters([Parameter("use_sim_time", value=False)])
    assert result.successful
    stage.heard["command"].clear()
    assert stage.until(lambda: stage.heard["command"])


def test_a_silent_estimator_ends_commands(wire):
    """Commands end half a second after the last estimate."""
    stage = wire(ControllerNode, "-p", "goal:='0.6,0.1,-0.5,0'")
    stage.state = "armed"
    assert stage.until(lambda: stage.heard["command"])
    stage.silent = True
    assert stage.until(lambda: not stage.node.state.reading(stage.node.now()).ready)
    stage.turns(20)
    stage.heard["command"].clear()
    stage.turns(20)
    assert not stage.heard["command"]


def test_a_silent_bridge_ends_commands_but_begins_nothing_anew(wire):
    """A trajectory continues at its current time when the bridge returns; only disarming restarts it."""
    stage = wire(ControllerNode, "-p", "goal:='0.6,0.1,-0.5,0'")
    stage.state = "armed"
    assert stage.until(lambda: stage.heard["command"])
    began, publish = stage.node.runtime.started, stage.send
    stage.send = lambda key, *message, **fields: (
        None if key == "thrusters" else publish(key, *message, **fields)
    )
    assert stage.until(lambda: stage.node.bridge.silent)
    stage.turns(10)
    stage.heard["command"].clear()
    stage.turns(10)
    assert not stage.heard["command"]
    stage.send = publish
    assert stage.until(lambda: stage.heard["command"]) and stage.node.runtime.started == began
    stage.state = "disarmed"
    assert stage.until(lambda: not stage.node.armed)
    stage.state = "armed"
    assert stage.until(lambda: stage.node.runtime.started > began)


def test_a_person_takes_over_by_mode_and_wrench(wire):
    """A wrench becomes thrusts unless it is not finite or stale; unknown modes are refused."""
    stage = wire(ControllerNode)
    stage.state = "armed"
    stage.send("mode", data="autopilot")
    assert stage.until(lambda: any("autopilot" in text for text in stage.events("refused")))
    stage.send("mode", data="teleop")
    tau = np.array([3.0, 0.0, 0.0, 0.0, 0.0, 0.2])
    push = lambda: stage.send("wrench", stage.make.wrench(time.time_ns(), tau))  # noqa: E731
    wanted = Allocator.from_vehicle(stage.node.vehicle).allocate(tau)
    assert stage.until(lambda: stage.heard["command"] and np.allclose(stage.asked(), wanted), push)
    bad = lambda: stage.send("wrench", stage.make.wrench(0, [math.nan] * 6))  # noqa: E731
    assert stage.until(lambda: not np.any(stage.asked()), bad)
    assert not stage.heard["stop"]


def joy(**held):
    """Return the state of a pad at rest, except for the given controls."""
    axes, buttons = [0.0] * 8, [0] * 11
    axes[2] = axes[5] = 1.0
    for name, value in held.items():
        kind, index = name[0], int(name[1:])
        (axes if kind == "a" else buttons)[index] = value
    return ros_type("sensor_msgs/msg/Joy")(axes=axes, buttons=buttons)


@pytest.mark.parametrize("kind", ["fault", "refused", "error"])
def test_a_grave_event_may_follow_an_ordinary_one(wire, kind, capfd):
    """Either order, as after an emergency stop, is published and logged with its severity."""
    stage = wire(ControllerNode)
    for name in ("start", kind, "stop", kind):
        stage.node.event(name, "of the test")
    assert stage.until(lambda: len(stage.events(kind)) >= 2 and stage.events("stop"))
    lines = [line for line in capfd.readouterr().err.splitlines() if "of the test" in line]
    assert [line.split("]")[0] for line in lines] == ["[INFO", "[WARN", "[INFO", "[WARN"]


def test_a_clock_of_somebody_else_does_not_end_an_armed_controller(wire):
    """A leap of simulated time from 10 s to the wall clock is 1.7e10 missed decisions, more than the
    message's uint32."""
    stage = wire(ControllerNode, "-p", "use_sim_time:=true")
    stage.clock, stage.state = 10 * 10**9, "armed"
    assert stage.until(lambda: stage.heard["policy"])
    assert stage.heard["policy"][-1].missed < 2**32 - 1
    stage.clock = 1_760_000_000 * 10**9
    stage.heard["policy"].clear()
    assert stage.until(lambda: len(stage.heard["policy"]) > 2)
    assert stage.heard["policy"][-1].missed == 2**32 - 1
    stage.heard["command"].clear()
    assert stage.until(lambda: stage.heard["command"])


def test_hands_on_a_pad_become_wrench_arm_and_stop(wire):
    """Dead-man and stick: thrust. START: arm. B: stop. SELECT: the mode. A silent pad: no thrust."""
    stage = wire(Teleop)
    pad = stage.peer.create_publisher(ros_type("sensor_msgs/msg/Joy"), "joy", 5)
    rest, drive = joy(), joy(a1=1.0, b4=1)
    newest = lambda: stage.heard["wrench"][-1].wrench.force.x  # noqa: E731
    assert stage.until(lambda: stage.heard["wrench"], lambda: pad.publish(rest))
    stage.turns(20)
    assert newest() == 0.0
    assert stage.until(lambda: newest() == pytest.approx(6.0), lambda: pad.publish(drive))
    assert stage.until(lambda: newest() == 0.0)  # no operator at the pad
    for _ in range(2):
        stage.until(lambda: stage.node.operator.command.lost is False, lambda: pad.publish(rest))
    assert not [m for m in stage.heard["arm"] if m.data]

    def press(button):
        """Press and release a button, so that both states are received."""
        pad.publish(rest if int(time.monotonic() * 5) % 2 else joy(**{f"b{button}": 1}))

    assert stage.until(lambda: [m for m in stage.heard["arm"] if m.data], lambda: press(7))
    assert stage.until(lambda: stage.heard["mode"], lambda: press(6))
    assert stage.heard["mode"][0].data == "teleop"
    assert stage.until(lambda: stage.heard["stop"], lambda: press(1))
