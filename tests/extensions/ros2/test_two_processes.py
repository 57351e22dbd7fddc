# ruff: noqa: E402 - rclpy can be imported once a backend is active
"""Two processes on the loopback receive each other's messages."""

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication, BuiltinTopicDcpsSubscription
from cyclonedds.qos import Policy

from finssim.extensions.ros2.backend import activate

activate(announce=False)

import rclpy
from finssim_msgs.msg import ThrusterCommand
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import Image
from std_srvs.srv import SetBool

pytestmark = pytest.mark.slow

PEER = Path(__file__).with_name("peer.py")
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
PATIENCE = 10.0  # [s] on a busy machine; every wait here needs less than a tenth of it


def start(*arguments, **environ):
    """Start a peer process."""
    command = [sys.executable, str(PEER), *arguments]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env={**os.environ, **environ})


def finish(process):
    """End a peer like a service manager; return its status and output."""
    process.terminate()
    _, text = process.communicate(timeout=PATIENCE)
    return process.returncode, text


@pytest.fixture(scope="module")
def node():
    """Node of this process."""
    rclpy.init(args=[])
    yield Node("tester", namespace="peer")
    rclpy.shutdown()


@pytest.fixture(scope="module")
def echo(node):
    """Peer that returns every message."""
    process = start("echo")
    yield process
    process.kill()
    process.communicate()


def until(node, condition, each=lambda: None):
    """Spin until a condition is true; return whether it became true in time."""
    end = time.monotonic() + PATIENCE
    while not condition() and time.monotonic() < end:
        each()
        rclpy.spin_once(node, timeout_sec=0.05)
    return condition()


def odometry():
    """Return a message with recognisable numbers."""
    message = Odometry(child_frame_id="base_link")
    message.pose.pose.position.z = -0.75
    message.pose.covariance[35] = 0.25
    return message


def image():
    """Return a picture of a megabyte."""
    return Image(height=1000, width=1000, data=np.arange(10**6).astype(np.uint8).tobytes())


@pytest.mark.parametrize(
    ("kind", "topic", "qos", "made"),
    [
        (Odometry, "odom", 10, odometry()),
        (Image, "image", qos_profile_sensor_data, image()),
        (ThrusterCommand, "thruster_cmd", 10, ThrusterCommand(source="pid", names=["a"], force=[2.5])),
    ],
)
def test_messages_come_back_as_they_were_sent(node, echo, kind, topic, qos, made):
    """Reliable messages, best-effort ones and FinsSim's own type return unchanged."""
    got = []
    subscription = node.create_subscription(kind, f"{topic}_back", got.append, qos)
    publisher = node.create_publisher(kind, topic, qos)
    assert until(node, lambda: bool(got), each=lambda: publisher.publish(made))
    assert got[0] == made
    node.destroy_publisher(publisher), node.destroy_subscription(subscription)


def test_who_comes_late_still_gets_what_was_latched(node, echo):
    """The message was published once, at the peer's start."""
    got = []
    subscription = node.create_subscription(PoseStamped, "goal", got.append, LATCHED)
    assert until(node, lambda: bool(got)) and got[0].pose.position.x == 1.5
    node.destroy_subscription(subscription)


def test_a_service_answers(node, echo):
    """Several calls each receive their own answer."""
    client = node.create_client(SetBool, "set_armed")
    assert client.wait_for_service(PATIENCE)
    futures = [client.call_async(SetBool.Request(data=value)) for value in (True, False)]
    for future in futures:
        rclpy.spin_until_future_complete(node, future, timeout_sec=PATIENCE)
    assert [f.result().message for f in futures] == ["armed True", "armed False"]
    node.destroy_client(client)


def test_the_node_list_shows_the_other_process(node, echo):
    """The list has names, namespaces, topics and types."""
    assert until(node, lambda: ("echo", "/peer") in node.get_node_names_and_namespaces())
    assert ("tester", "/peer") in node.get_node_names_and_namespaces()
    topics = dict(node.get_topic_names_and_types())
    assert topics["/peer/thruster_cmd"] == ["finssim_msgs/msg/ThrusterCommand"]
    assert node.count_subscribers("thruster_cmd") == 1


def test_every_endpoint_of_the_other_process_tells_its_hash(node, echo):
    """The node list has one too: without it each `ros2` command warns. Services instead announce which ends
    match."""
    participant = rclpy.get_default_context().participant
    told = {"rt": b"typehash=RIHS01_", "ro": b"typehash=RIHS01_", "rq": b"id=", "rr": b"id="}
    for topic in (BuiltinTopicDcpsPublication, BuiltinTopicDcpsSubscription):
        reader = BuiltinDataReader(participant.entity, topic)
        assert until(node, lambda reader=reader: any("odom" in s.topic_name for s in reader.read(N=1000)))
        for sample in reader.read(N=1000):
            data = next((p.data for p in sample.qos if isinstance(p, Policy.Userdata)), b"")
            assert told.get(sample.topic_name[:2], b"") in data, sample.topic_name


def test_a_parameter_file_and_a_new_name_reach_the_other_process(node, tmp_path):
    """Cases are --params-file, -p, and -r for a topic and for the node itself."""
    path = tmp_path / "p.yaml"
    path.write_text("/**/renamed:\n  ros__parameters: {gain: 2.5, names: [a]}\n")
    words = f"--params-file {path} -p names:=[b,c] -r settings:=/other -r __node:=renamed".split()
    process, got = start("settings", "--ros-args", *words), []
    subscription = node.create_subscription(ThrusterCommand, "/other", got.append, LATCHED)
    assert until(node, lambda: bool(got))
    assert (got[0].force.tolist(), got[0].names, got[0].source) == ([2.5], ["b", "c"], "/peer/renamed")
    node.destroy_subscription(subscription)
    status, text = finish(process)
    assert status == 0 and "sends on the loopback alone" in text


def test_data_flows_between_releases(node):
    """Messages of a Humble peer are received; only the node list of the other release cannot be read."""
    process, got = start("settings", "--ros-args", "-r", "settings:=/humble", ROS_DISTRO="humble"), []
    subscription = node.create_subscription(ThrusterCommand, "/humble", got.append, LATCHED)
    assert until(node, lambda: bool(got)) and got[0].source == "/peer/settings"
    assert "tester" in node.get_node_names()
    node.destroy_subscription(subscription)
    status, text = finish(process)
    assert status == 0 and "as humble" in text


def test_a_killed_peer_does_not_hold_up_the_others(node):
    """After kill -9 during transmission, a reliable publisher continues, and each call is bounded."""
    process, got = start("echo"), []
    subscription = node.create_subscription(Odometry, "odom_back", got.append, 10)
    publisher = node.create_publisher(Odometry, "odom", 10)
    assert until(node, lambda: bool(got), each=lambda: publisher.publish(odometry()))
    process.kill()
    process.communicate()
    longest = 0.0
    for _ in range(300):
        began = time.monotonic()
        publisher.publish(odometry())
        rclpy.spin_once(node, timeout_sec=0.0)
        longest = max(longest, time.monotonic() - began)
    assert longest < PATIENCE / 4  # a writer that waits forever would never reach this line
    node.destroy_publisher(publisher), node.destroy_subscription(subscription)
