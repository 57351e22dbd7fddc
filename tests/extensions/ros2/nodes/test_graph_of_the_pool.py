"""`finssim ros2 up pool` as a user starts it, in lock-step: processes on the loopback, and a killed process."""

import os
import re
import runpy
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from finssim.extensions.ros2.nodes.conversions import nanoseconds, ros_type
from finssim.extensions.ros2.topics import TOPICS, quality_profile
from finssim.pool.virtual_pool import read_truth

EXAMPLE = Path(__file__).resolve().parents[4] / "examples" / "ros2" / "drive_graph.py"
DISARMED, ARMED, HOLD, FAULT = range(4)


def free_ports():
    """Return two ports, each followed by a free one: for the pool and for the robot."""
    found = []
    while len(found) < 2:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
            one.bind(("127.0.0.1", 0))
            port = one.getsockname()[1]
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as next_one:
                try:
                    next_one.bind(("127.0.0.1", port + 1))
                    found.append(port)
                except OSError:
                    continue
    return found


class Graph:
    """Launcher, its output, and the example's node that drives the vehicle."""

    def __init__(self, folder):
        import rclpy

        pool, robot = free_ports()
        self.bag, self.truth = folder / "run.mcap", folder / "run.truth"
        words = (
            f"ros2 up pool --lockstep --camera corners --severity nominal --port {pool} --record {self.bag}"
        )
        words += f" --bind 127.0.0.1:{robot} --truth {self.truth}"
        self.process = subprocess.Popen(
            [sys.executable, "-m", "finssim", *words.split()],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self.said, self._rclpy = [], rclpy
        threading.Thread(target=lambda: self.said.extend(self.process.stdout), daemon=True).start()
        while not any(line.startswith("pool file:") for line in self.said):
            assert self.process.poll() is None, "".join(self.said)
            time.sleep(0.1)
        rclpy.init(args=[])
        self.example = runpy.run_path(str(EXAMPLE))
        self.driver = self.example["Driver"](["finsrov"])
        self.heard = {key: [] for key in ("thrusters", "command", "diagnostics")}
        for key, kept in self.heard.items():
            topic = TOPICS[key]
            self.driver.create_subscription(
                ros_type(topic.type), topic.under("finsrov"), kept.append, quality_profile(topic.quality)
            )

    def until(self, holds, each=lambda: None):
        """Step until a condition of the graph is true."""
        self.driver.until("", lambda vehicle: holds(), 20.0, lambda vehicle: each())

    def health(self):
        """Return the latest level and text of each part."""
        statuses = [status for m in self.heard["diagnostics"] for status in m.status]
        return {s.name: (int.from_bytes(s.level, "little"), s.message) for s in statuses}

    def pid(self, name):
        """Return the process of a node as reported by the launcher."""
        return next(int(m[1]) for line in self.said if (m := re.match(rf"{name}: process (\d+)", line)))

    def end(self):
        """Send Ctrl-C and return the exit status."""
        self.process.send_signal(signal.SIGINT)
        status = self.process.wait(60.0)
        self._rclpy.try_shutdown()
        return status


@pytest.fixture(scope="module")
def graph(alone, tmp_path_factory):
    """Running graph."""
    graph = Graph(tmp_path_factory.mktemp("graph"))
    yield graph
    if graph.process.poll() is None:
        graph.end()


@pytest.mark.slow
def test_a_vehicle_is_driven_through_topics_alone(graph):
    """It is armed, driven to a goal, along a path and by teleoperation; every node is listed and reports its health.

    The estimate at the reached goals is within 5 cm of the truth.
    """
    try:
        graph.example["drive"](graph.driver)
    except SystemExit as error:
        pytest.fail(f"{error}\n{''.join(graph.said)}")
    odometry = graph.driver.vehicles[0].odometry
    p, at = odometry.pose.pose.position, 1e-9 * nanoseconds(odometry.header.stamp)
    graph.until(lambda: graph.driver.now > at + 1.0)  # the truth is written to the file by then
    truth = read_truth(graph.truth)
    x, y, z = (np.interp(at, truth.time, truth.position[:, axis]) for axis in range(3))
    assert np.linalg.norm(np.subtract((p.x, p.y, p.z), (x, y, z))) < 0.05
    nodes = ("hardware_bridge", "camera", "localizer", "state_estimation", "controller", "recorder")
    parts = {
        "hardware_bridge: link", "hardware_bridge: watchdogs", "state_estimation: localization", "camera: pictures",
        "localizer: fixes", "controller: control", "recorder: record",
    }  # fmt: skip
    graph.until(lambda: {f"finsrov/{part}" for part in parts} <= graph.health().keys())
    assert {level for level, _ in graph.health().values()} == {0}
    assert {*nodes, "virtual_pool"} <= set(graph.driver.get_node_names())


@pytest.mark.slow
def test_a_killed_controller_leaves_no_thrust(graph):
    """After kill -9 the bridge reports zero from half a second after the last command.

    The launcher reports the death, and time continues without the dead process.
    """
    vehicle, Bool = graph.driver.vehicles[0], ros_type("std_msgs/msg/Bool")
    graph.heard["command"].clear()
    graph.until(
        lambda: vehicle.is_in(ARMED) and graph.heard["command"], lambda: vehicle.arm.publish(Bool(data=True))
    )
    os.kill(graph.pid("controller"), signal.SIGKILL)
    last = lambda: max(nanoseconds(m.header.stamp) for m in graph.heard["command"])  # noqa: E731
    age = lambda m: 1e-9 * (nanoseconds(m.header.stamp) - last())  # noqa: E731
    begun = time.monotonic()
    graph.until(lambda: age(graph.heard["thrusters"][-1]) > 1.5)
    assert time.monotonic() - begun < 60.0
    # Half a second of the bridge's own clock, plus the steps during which a command is in transit.
    later = [m for m in graph.heard["thrusters"] if age(m) > 0.55]
    assert later and not np.any([m.force for m in later]) and not np.any([m.normalised for m in later])
    assert all(m.state in (HOLD, FAULT) for m in later)
    graph.until(lambda: graph.health()["finsrov/hardware_bridge: watchdogs"][0] > 0)
    assert "command" in graph.health()["finsrov/hardware_bridge: watchdogs"][1]
    assert any("controller has died" in line for line in graph.said)


@pytest.mark.slow
def test_the_record_opens_and_no_process_is_left(graph):
    """rosbags reads every topic with its type; the launcher's status reports that a node died.

    Even on a busy machine, no estimate used inertial data older than two steps of /clock.
    """
    pids = [graph.pid(name) for name in ("virtual_pool", "hardware_bridge", "recorder")]
    assert graph.end() == 1, "".join(graph.said)
    for pid in pids:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)
    with AnyReader([graph.bag], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        kept = {connection.topic: connection.msgtype for connection in reader.connections}
        messages, ages = set(), []
        for connection, _, data in reader.messages():
            messages.add(connection.topic)
            if connection.topic == TOPICS["estimator"].under("finsrov"):
                ages.append(reader.deserialize(data, connection.msgtype).imu_age)
    assert len(ages) > 300 and np.nanmax(ages) < 2.0 / 60.0
    for key in ("odometry", "telemetry", "command", "thrusters", "estimator", "fix", "tags", "transform"):
        assert kept[TOPICS[key].under("finsrov")] == TOPICS[key].type
        assert TOPICS[key].under("finsrov") in messages
