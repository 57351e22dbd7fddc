# ruff: noqa: E402 - rclpy can be imported once a backend is active
"""Two robots of one type in one graph, as a person starts them: namespaces, one tree of frames, no cross-talk."""

import signal
import socket
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from finssim.ros2.backend import activate

activate(announce=False)

import rclpy
from rclpy.node import Node

from finssim.ros2.nodes.conversions import RosMessages, ros_type
from finssim.ros2.topics import TOPICS, quality_profile
from finssim.vehicles import load_vehicle
from reference.sea import Sea

PATIENCE = 150.0  # [s] for six processes to start on a machine that does much else
NAMES = ("robot_1", "robot_2")
STARTS = {"robot_1": (0.0, 0.0, -3.0), "robot_2": (5.0, 0.0, -4.0)}
GOALS = {"robot_1": (0.6, 0.0, -3.0), "robot_2": (5.0, 0.6, -4.0)}
HEARD = ("odometry", "thrusters", "command", "positioning")
TOLD = ("arm", "acknowledge", "mode", "wrench")
DISARMED, ARMED, HOLD, FAULT = range(4)


def free_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


class Graph:
    """Two launchers, the water of both, and a node of ours that listens to everything."""

    def __init__(self):
        ends = {name: free_port() for name in NAMES}
        self.seas = {
            name: Sea(STARTS[name], ("127.0.0.1", ends[name]), seed) for seed, name in enumerate(NAMES)
        }
        self.running = True
        self.water = threading.Thread(target=self.swim, daemon=True)
        self.water.start()
        self.processes = {}
        for name in NAMES:
            words = f"ros2 up robot --namespace {name} --site open-water --arm"
            words += (
                f" --robot udp://127.0.0.1:{self.seas[name].end.address[1]} --bind 127.0.0.1:{ends[name]}"
            )
            words += f" --goal {','.join(map(str, GOALS[name]))},0"
            self.processes[name] = subprocess.Popen([sys.executable, "-m", "finssim", *words.split()])
        rclpy.init(args=[])
        self.node = Node("peer")
        self.heard = {name: {key: [] for key in HEARD} for name in NAMES}
        self.frames = {}
        for key in ("transform", "fixed_transform"):
            self.listen(key, TOPICS[key].name, self.take)
        self.operated = 0.0
        self.out = {(key, name): self.publisher(key, name) for key in TOLD for name in NAMES}
        for name in NAMES:
            for key in HEARD:
                self.listen(key, TOPICS[key].under(name), self.heard[name][key].append)

    def swim(self):
        while self.running:
            for sea in self.seas.values():
                sea.turn()
            time.sleep(0.003)

    def listen(self, key, topic, take):
        kind, quality = ros_type(TOPICS[key].type), quality_profile(TOPICS[key].quality)
        self.node.create_subscription(kind, topic, take, quality)

    def publisher(self, key, name):
        kind, quality = ros_type(TOPICS[key].type), quality_profile(TOPICS[key].quality)
        return self.node.create_publisher(kind, TOPICS[key].under(name), quality)

    def take(self, message):
        for one in message.transforms:
            self.frames.setdefault(one.child_frame_id, set()).add(one.header.frame_id)

    def until(self, condition, patience=PATIENCE, each=lambda: None):
        end = time.monotonic() + patience
        while not condition() and time.monotonic() < end:
            rclpy.spin_once(self.node, timeout_sec=0.05)
            each()
        return condition()

    def operate(self):
        """Begin again, once a second, where a busy machine kept an estimator waiting for too long."""
        if time.monotonic() - self.operated > 1.0:
            self.operated = time.monotonic()
            for name in NAMES:
                if self.state(name) == FAULT:
                    self.out["acknowledge", name].publish(ros_type(TOPICS["acknowledge"].type)())
                elif self.state(name) == DISARMED:
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
        for process in self.processes.values():
            process.send_signal(signal.SIGINT)
        for process in self.processes.values():
            process.wait(60.0)
        self.running = False
        self.water.join()
        for sea in self.seas.values():
            sea.close()
        rclpy.try_shutdown()


@pytest.fixture(scope="module")
def graph(alone):
    made = Graph()
    yield made
    made.end()


@pytest.mark.slow
def test_each_vehicle_goes_to_its_own_goal(graph):
    """Within 10 cm by its own odometry, and within 12 cm in truth: a command of the other would lead elsewhere."""
    assert graph.until(lambda: all(graph.distance(name) < 0.1 for name in NAMES), each=graph.operate)
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
    assert graph.until(lambda: all(graph.state(n) == ARMED for n in NAMES), each=graph.operate)
    arm, mode, wrench = (graph.out[key, "robot_1"] for key in ("arm", "mode", "wrench"))
    String, Bool = ros_type("std_msgs/msg/String"), ros_type("std_msgs/msg/Bool")
    mode.publish(String(data="teleop"))
    make = {name: RosMessages(load_vehicle("finsrov"), f"{name}/") for name in NAMES}
    tau = np.array([8.0, 0.0, 0.0, 0.0, 0.0, 0.0])

    def pushed(sender):
        heard = graph.heard["robot_1"]["command"]
        heard.clear()
        end = time.monotonic() + 1.5
        while time.monotonic() < end:
            wrench.publish(make[sender].wrench(time.time_ns(), tau))
            graph.until(lambda: False, patience=0.05)
        return max(np.abs(m.force).max() for m in heard)

    assert graph.until(lambda: any("teleop" in m.source for m in graph.heard["robot_1"]["command"]))
    assert pushed("robot_2") == 0.0 and pushed("robot_1") > 1.0
    arm.publish(Bool(data=False))
    assert graph.until(lambda: graph.state("robot_1") == DISARMED, patience=20.0)
    graph.heard["robot_2"]["thrusters"].clear()
    assert graph.until(lambda: len(graph.heard["robot_2"]["thrusters"]) > 30)
    assert {m.state for m in graph.heard["robot_2"]["thrusters"]} <= {
        ARMED,
        HOLD,
    }  # which a busy machine makes
