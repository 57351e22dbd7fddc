# ruff: noqa: E402 - rclpy can be imported once a backend is active
"""Two robots of one type in one graph, as a person starts them: namespaces, one tree of frames, no cross-talk."""

import socket
import time
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from finssim.extensions.ros2.backend import activate

activate(announce=False)

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from finssim.extensions.ros2.nodes.conversions import RosMessages, nanoseconds, ros_type
from finssim.extensions.ros2.shim.arguments import parse_arguments
from finssim.extensions.ros2.topics import TOPICS, quality_profile
from finssim.extensions.ros2.up import NODES, Options, plan_of
from finssim.vehicles import load_vehicle
from reference.sea import Sea

STEP = 1.0 / 60.0
"""Of simulated time, which goes on when every node has done its work of the last step [s]."""
LONGEST = 60.0
"""Simulated time in which something must have happened [s]."""
PATIENCE = 120.0
"""Real time for one step, however busy the machine is [s]."""
NAMES = ("robot_1", "robot_2")
STARTS = {"robot_1": (0.0, 0.0, -3.0), "robot_2": (5.0, 0.0, -4.0)}
GOALS = {"robot_1": (0.6, 0.0, -3.0), "robot_2": (5.0, 0.6, -4.0)}
HEARD = ("odometry", "estimator", "thrusters", "command", "positioning")
TOLD = ("arm", "acknowledge", "mode", "wrench")
DISARMED, ARMED, HOLD, FAULT = range(4)


def free_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


class Graph:
    """The nodes that `finssim ros2 up robot --namespace` starts, twice, in this process; the water of both; and a peer.

    All live by a /clock of ours. A step begins when estimator and bridge of both vehicles have spoken of the last one.
    """

    def __init__(self, folder):
        rclpy.init(args=[])
        self.executor, self.robots = SingleThreadedExecutor(), []
        self.now, self.seas = 0.0, {}
        self.node = Node("peer")
        self.clock = self.node.create_publisher(ros_type("rosgraph_msgs/msg/Clock"), "/clock", 10)
        self.make = RosMessages(load_vehicle("finsrov"))
        self.heard = {name: {key: [] for key in HEARD} for name in NAMES}
        self.frames = {}
        for key in ("transform", "fixed_transform"):
            self.listen(key, TOPICS[key].name, self.take)
        self.out = {(key, name): self.publisher(key, name) for key in TOLD for name in NAMES}
        for name in NAMES:
            for key in HEARD:
                self.listen(key, TOPICS[key].under(name), self.heard[name][key].append)
        for seed, name in enumerate(NAMES):
            end = free_port()
            self.seas[name] = Sea(STARTS[name], ("127.0.0.1", end), seed)
            here = f"udp://127.0.0.1:{self.seas[name].end.address[1]}"
            goal = f"{','.join(map(str, GOALS[name]))},0"
            self.start(
                folder / f"{name}.yaml",
                Options(namespace=name, site="open-water", robot=here, bind=f"127.0.0.1:{end}", goal=goal),
            )
        for node in (self.node, *self.robots):
            self.executor.add_node(node)

    def start(self, file, options):
        """As `finssim.extensions.ros2.up.Supervisor` starts each node, but with simulated time and no process."""
        plan = plan_of("robot", options, Path("pool.yaml"))
        plan.set("/**", use_sim_time=True)
        plan.write(file)
        context = rclpy.get_default_context()
        words = ["--ros-args", "-r", f"__ns:=/{plan.namespace}", "--params-file", str(file)]
        context.arguments = parse_arguments(words)
        for name in plan.nodes:
            module, _, kind = NODES[name].partition(":")
            self.robots.append(getattr(import_module(module), kind)())
        context.arguments = parse_arguments([])

    def step(self):
        """Let the water and everybody's clock go on, and wait for those who speak in each step."""
        self.now += STEP
        for sea in self.seas.values():
            sea.turn(self.now)
        stamp, end = round(self.now * 1e9), time.monotonic() + PATIENCE
        self.clock.publish(self.make.clock(stamp))
        while not self.done(stamp):
            assert time.monotonic() < end, f"a node says nothing of {self.now:.2f} s"
            self.executor.spin_once(0.05)

    def done(self, stamp):
        """Whether estimators and bridges have told of a time [ns]."""
        heard = [self.heard[name][key] for name in NAMES for key in ("estimator", "thrusters")]
        return all(kept and nanoseconds(kept[-1].header.stamp) >= stamp for kept in heard)

    def listen(self, key, topic, take):
        kind, quality = ros_type(TOPICS[key].type), quality_profile(TOPICS[key].quality)
        quality.depth = (
            100  # two publishers latch their fixed frames, and of one that is kept the other is lost
        )
        self.node.create_subscription(kind, topic, take, quality)

    def publisher(self, key, name):
        kind, quality = ros_type(TOPICS[key].type), quality_profile(TOPICS[key].quality)
        return self.node.create_publisher(kind, TOPICS[key].under(name), quality)

    def take(self, message):
        for one in message.transforms:
            self.frames.setdefault(one.child_frame_id, set()).add(one.header.frame_id)

    def until(self, condition, longest=LONGEST, each=lambda: None):
        """Step until a condition holds; whether it does in time."""
        end = self.now + longest
        while not condition() and self.now < end:
            each()
            self.step()
        return condition()

    def arm(self):
        """Ask those that are not armed, once a second."""
        if round(self.now / STEP) % 60 == 0:
            for name in NAMES:
                if self.state(name) == DISARMED:
                    self.out["arm", name].publish(ros_type(TOPICS["arm"].type)(data=True))

    def distance(self, name):
        """From its goal, by its odometry [m]."""
        if not self.heard[name]["odometry"]:
            return np.inf
        p = self.heard[name]["odometry"][-1].pose.pose.position
        return float(np.linalg.norm(np.array([p.x, p.y, p.z]) - GOALS[name]))

    def state(self, name):
        return self.heard[name]["thrusters"][-1].state if self.heard[name]["thrusters"] else None

    def end(self):
        for robot in self.robots:
            robot.close()
        for sea in self.seas.values():
            sea.close()
        rclpy.try_shutdown()


@pytest.fixture(scope="module")
def graph(tmp_path_factory):
    made = Graph(tmp_path_factory.mktemp("graph"))
    yield made
    made.end()


@pytest.mark.slow
def test_each_vehicle_goes_to_its_own_goal(graph):
    """Within 10 cm by its own odometry, and within 12 cm in truth: a command of the other would lead elsewhere."""
    assert graph.until(lambda: all(graph.distance(name) < 0.1 for name in NAMES), each=graph.arm)
    for name in NAMES:
        place = np.array(graph.seas[name].world.plant.position)
        assert np.linalg.norm(place - GOALS[name]) < 0.15
        frames = {m.header.frame_id for m in graph.heard[name]["command"]}
        assert frames == {f"{name}/base_link"}
        odometry = graph.heard[name]["odometry"][-1]
        assert (odometry.header.frame_id, odometry.child_frame_id) == ("map", f"{name}/base_link")
        assert graph.heard[name]["positioning"][-1].header.frame_id == "map"


@pytest.mark.slow
def test_the_frames_are_one_tree(graph):
    """Every frame has one parent, and the way up ends at the one map, through the vehicle's own frames alone."""
    mounted = {f"{name}/imu_link" for name in NAMES} | {f"{name}/dvl_link" for name in NAMES}
    assert graph.until(lambda: mounted <= set(graph.frames))
    assert all(len(parents) == 1 for parents in graph.frames.values()) and "map" not in graph.frames
    for frame in graph.frames:
        way = [frame]
        while way[-1] in graph.frames:
            (parent,) = graph.frames[way[-1]]
            way.append(parent)
        assert way[-1] == "map" and len({one.partition("/")[0] for one in way[:-1]}) == 1


@pytest.mark.slow
def test_nobody_hears_what_is_meant_for_the_other(graph):
    """A disarmed vehicle stops alone; a wrench in the other's frame moves nobody."""
    assert graph.until(lambda: all(graph.state(n) == ARMED for n in NAMES), each=graph.arm)
    arm, mode, wrench = (graph.out[key, "robot_1"] for key in ("arm", "mode", "wrench"))
    String, Bool = ros_type("std_msgs/msg/String"), ros_type("std_msgs/msg/Bool")
    mode.publish(String(data="teleop"))
    make = {name: RosMessages(load_vehicle("finsrov"), f"{name}/") for name in NAMES}
    tau = np.array([8.0, 0.0, 0.0, 0.0, 0.0, 0.0])

    def pushed(sender):
        heard = graph.heard["robot_1"]["command"]
        heard.clear()
        push = lambda: wrench.publish(make[sender].wrench(round(graph.now * 1e9), tau))  # noqa: E731
        graph.until(lambda: False, 1.5, push)
        return max(np.abs(m.force).max() for m in heard)

    assert graph.until(lambda: any("teleop" in m.source for m in graph.heard["robot_1"]["command"]))
    assert pushed("robot_2") == 0.0 and pushed("robot_1") > 1.0
    arm.publish(Bool(data=False))
    assert graph.until(lambda: graph.state("robot_1") == DISARMED)
    graph.heard["robot_2"]["thrusters"].clear()
    assert graph.until(lambda: len(graph.heard["robot_2"]["thrusters"]) > 30)
    assert {m.state for m in graph.heard["robot_2"]["thrusters"]} == {ARMED}
