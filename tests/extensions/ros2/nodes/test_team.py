# ruff: noqa: E402 - rclpy can be imported once a backend is active
"""A team of three in one virtual pool, in lock-step: separate paths, and messages that are late or lost."""

import runpy
import socket
import threading
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from finssim.extensions.ros2.backend import activate

activate(announce=False)

import rclpy
from rclpy.executors import SingleThreadedExecutor

from finssim.extensions.ros2.nodes.conversions import RosMessages, nanoseconds, ros_type
from finssim.extensions.ros2.nodes.robot_node import STEP
from finssim.extensions.ros2.shim.arguments import parse_arguments
from finssim.extensions.ros2.topics import TOPICS, quality_profile
from finssim.extensions.ros2.up import (
    NODES,
    GraphPace,
    GraphWiring,
    Options,
    SimulatedWorld,
    TeamMessages,
    VehicleNames,
    plan_of,
)
from finssim.pool.virtual_pool import read_truth
from finssim.vehicles import load_vehicle

EXAMPLE = Path(__file__).resolve().parents[4] / "examples" / "ros2" / "drive_graph.py"
NAMES = ("robot_1", "robot_2", "robot_3")
DISARMED, ARMED, HOLD, FAULT = range(4)
LOSS, DELAY = 0.3, 0.2


def free_port():
    """Return a UDP port that is free with those of three vehicles, ten apart."""
    while True:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as first:
            first.bind(("127.0.0.1", 0))
            port = first.getsockname()[1]
        try:
            for further in (0, 10, 20):
                with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
                    one.bind(("127.0.0.1", port + further))
        except (OSError, OverflowError):
            continue
        return port


class Ended(Exception):
    """Request to end the graph."""


class Team:
    """Nodes of `finssim ros2 up pool --team` in a thread of this process, and the example's driver."""

    def __init__(self, folder):
        self.truth = folder / "truth"
        options = Options(
            names=VehicleNames(team="finsrov,finsrov,finsrov"),
            site="open-water",
            wiring=GraphWiring(bind=f"127.0.0.1:{free_port()}"),
            simulated=SimulatedWorld(
                positioning="motion-capture", severity="nominal", port=free_port(), truth=self.truth
            ),
            pace=GraphPace(lockstep=True),
            messages=TeamMessages(message_loss=LOSS, message_delay=DELAY),
        )
        plan = plan_of("pool", options, folder / "pool.yaml")
        plan.write(folder / "parameters.yaml")
        rclpy.init(args=[])
        self.executor, self.nodes = SingleThreadedExecutor(), []
        context, words = rclpy.get_default_context(), ["--params-file", str(folder / "parameters.yaml")]
        for one in plan.nodes:
            context.arguments = parse_arguments(["--ros-args", "-r", f"__ns:=/{one.namespace}", *words])
            module, _, kind = NODES[one.node].partition(":")
            node = getattr(import_module(module), kind)()
            node.report()
            self.executor.add_node(node)
            self.nodes.append(node)
        context.arguments = parse_arguments([])
        self.nodes[0].clock.spin, self.over = self.spin, False
        self.thread = threading.Thread(target=self.run, daemon=True)
        self.thread.start()
        self.context = rclpy.Context()
        rclpy.init(args=[], context=self.context)
        self.example = runpy.run_path(str(EXAMPLE))
        self.driver = self.example["Driver"](NAMES, self.context)
        self.places = {}
        self.frames, self.commands = {}, {name: [] for name in NAMES}
        for name in NAMES:
            self.listen("command", TOPICS["command"].under(name), self.commands[name].append)
        for key in ("transform", "fixed_transform"):
            self.listen(key, TOPICS[key].name, self.take)

    def spin(self, timeout_sec):
        if self.over:
            raise Ended
        self.executor.spin_once(timeout_sec)

    def run(self):
        try:
            self.nodes[0].spin()
        except Ended:
            pass

    def listen(self, key, topic, take):
        quality = quality_profile(TOPICS[key].quality)
        quality.depth = 100  # several publishers latch their fixed frames, and only one message would be kept
        self.driver.create_subscription(ros_type(TOPICS[key].type), topic, take, quality)

    def take(self, message):
        for one in message.transforms:
            self.frames.setdefault(one.child_frame_id, set()).add(one.header.frame_id)

    def steps(self, n):
        for _ in range(n):
            self.driver.step()

    def end(self):
        self.over = True
        self.thread.join(30.0)
        for node in self.nodes:
            node.close()
        self.context.try_shutdown()
        rclpy.try_shutdown()


@pytest.fixture(scope="module")
def team(tmp_path_factory):
    made = Team(tmp_path_factory.mktemp("team"))
    yield made
    made.end()


@pytest.mark.slow
def test_each_vehicle_is_driven_on_its_own(team, capsys):
    """The example arms three vehicles and drives them by goal, path and teleoperation, each to its own
    target."""
    team.late = team.example["drive"](team.driver)
    assert "heard" in capsys.readouterr().out
    for vehicle in team.driver.vehicles:
        frames = {m.header.frame_id for m in team.commands[vehicle.name]}
        assert frames == {f"{vehicle.name}/base_link"}
        odometry = vehicle.odometry
        assert (odometry.header.frame_id, odometry.child_frame_id) == ("map", f"{vehicle.name}/base_link")
        team.places[vehicle.name] = 1e-9 * nanoseconds(odometry.header.stamp), vehicle.place


@pytest.mark.slow
def test_messages_come_late_and_some_are_lost(team):
    """Delay is processing plus travel at 1500 m/s, in steps of the clock; a third is lost, differently by
    receiver."""
    late = team.late
    for vehicle in team.driver.vehicles:
        delays = late[vehicle.name]
        ways = {v.name: np.linalg.norm(v.place - vehicle.place) / 1500.0 for v in team.driver.vehicles}
        for (sender, _), delay in delays.items():
            assert sender != vehicle.name
            # The message comes just before the time of /clock at which it has arrived.
            assert DELAY + ways[sender] - STEP - 1e-6 <= delay <= DELAY + ways[sender] + 4.0 * STEP
        assert abs(len(delays) / 40.0 - (1.0 - LOSS)) < 0.29  # four standard deviations
    numbers = [{key for key in late[name] if key[0] == "robot_1"} for name in ("robot_2", "robot_3")]
    assert numbers[0] != numbers[1]


@pytest.mark.slow
def test_the_frames_are_one_tree(team):
    """Every frame has one parent, and parents lead to the one map through the vehicle's own frames only."""
    mounted = {f"{name}/{frame}" for name in NAMES for frame in ("imu_link", "dvl_link")}
    assert mounted <= set(team.frames)
    assert all(len(parents) == 1 for parents in team.frames.values()) and "map" not in team.frames
    for frame in team.frames:
        way = [frame]
        while way[-1] in team.frames:
            (parent,) = team.frames[way[-1]]
            way.append(parent)
        assert way[-1] == "map" and len({one.partition("/")[0] for one in way[:-1]}) == 1


@pytest.mark.slow
def test_nobody_hears_what_is_meant_for_the_other(team):
    """Disarming stops one vehicle only; a wrench in another vehicle's frame moves none; estimates matched the
    truth."""
    first, second, _ = team.driver.vehicles
    Bool, String = ros_type("std_msgs/msg/Bool"), ros_type("std_msgs/msg/String")
    arm = lambda v: v.arm.publish(Bool(data=True)) if not v.is_in(ARMED) else None  # noqa: E731
    team.driver.until("armed", lambda v: v.is_in(ARMED), 10.0, arm)
    first.mode.publish(String(data="teleop"))
    make = {name: RosMessages(load_vehicle("finsrov"), f"{name}/") for name in NAMES[:2]}
    tau = np.array([8.0, 0.0, 0.0, 0.0, 0.0, 0.0])

    def pushed(sender):
        team.steps(35)  # until the last wrench is stale
        team.commands["robot_1"].clear()
        for _ in range(15):
            first.wrench.publish(make[sender].wrench(round(team.driver.now * 1e9), tau))
            team.driver.step()
        return max(np.abs(m.force).max() for m in team.commands["robot_1"])

    assert pushed("robot_2") == 0.0 and pushed("robot_1") > 1.0
    first.arm.publish(Bool(data=False))
    team.steps(15)
    assert first.is_in(DISARMED) and second.is_in(ARMED)
    for name, (at, place) in team.places.items():  # the truth of that time is written by now
        truth = read_truth(team.truth / f"{name}.truth")
        true = [np.interp(at, truth.time, truth.position[:, axis]) for axis in range(3)]
        assert truth.time[-1] > at and np.linalg.norm(place - true) < 0.15
