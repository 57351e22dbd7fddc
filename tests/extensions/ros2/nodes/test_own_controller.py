# ruff: noqa: E402 - rclpy can be imported once a backend is active
"""The example of a custom controller on a simulator in lock-step, and the single clock of a domain."""

import os
import runpy
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from finssim.extensions.ros2.backend import activate

activate(announce=False)

import rclpy
from nav_msgs.msg import Odometry

EXAMPLE = Path(__file__).resolve().parents[4] / "examples" / "ros2" / "own_controller.py"
TOPICS = EXAMPLE.with_name("topics.py")
PATIENCE = 120.0  # [s] for processes to start on a busy machine


def finssim(*words):
    """Start a process of the command."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    return subprocess.Popen([sys.executable, "-m", "finssim", *words], **pipes)


@pytest.fixture(scope="module")
def graph():
    """Graph that the example names."""
    line = next(line for line in EXAMPLE.read_text().splitlines() if line.startswith("finssim ros2 up"))
    process = finssim(*line.split()[1:])
    yield process
    if process.poll() is None:
        process.send_signal(signal.SIGINT)
    process.communicate(timeout=60.0)
    rclpy.try_shutdown()


@pytest.mark.slow
def test_a_controller_of_ones_own_holds_its_place(graph):
    """Armed on request, it is within 10 cm of the goal in 20 s of /clock and misses no step."""
    rclpy.init(args=[])
    node, stamps = runpy.run_path(str(EXAMPLE))["OwnController"](), []
    node.create_subscription(
        Odometry, "odom", lambda m: stamps.append(m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec), 10
    )
    end, node.error = time.monotonic() + PATIENCE, np.full(3, np.inf)
    while np.linalg.norm(node.error) > 0.1 and time.monotonic() < end and not (stamps and stamps[-1] > 20.0):
        rclpy.spin_once(node, timeout_sec=0.1)
    assert node.armed and np.linalg.norm(node.error) < 0.1
    taken = np.diff([stamp for stamp in stamps if stamp > 1.0])
    assert len(taken) > 60 and np.abs(taken - 1.0 / 60.0).max() < 1e-6


@pytest.mark.slow
def test_topics_are_listed_without_an_installed_ros(graph):
    """The example lists them with their types."""
    words = [sys.executable, str(TOPICS), "list"]
    listed = subprocess.run(words, capture_output=True, text=True, timeout=PATIENCE)
    assert "/bluerov2_heavy/arm std_msgs/msg/Bool" in listed.stdout.splitlines(), listed.stderr


def test_a_message_is_filled_from_nested_values():
    """Whole numbers become the fields' own types; an unknown field is refused."""
    example = runpy.run_path(str(TOPICS))
    pose = example["type_of"]("geometry_msgs/msg/PoseStamped")()
    example["fill"](pose, {"header": {"frame_id": "map"}, "pose": {"position": {"x": 1, "z": -0.6}}})
    assert pose.header.frame_id == "map" and pose.pose.position.x == 1.0 and pose.pose.position.z == -0.6
    with pytest.raises(AttributeError):
        example["fill"](pose, {"place": {"x": 1.0}})


@pytest.mark.slow
def test_a_domain_has_one_clock(graph):
    """A second world that would publish /clock does not start, and reports the reason."""
    words = "ros2 node virtual_pool --ros-args -r __ns:=/other -p lockstep:=true -p camera:=none"
    second = finssim(*words.split())
    said, _ = second.communicate(timeout=PATIENCE)
    assert second.returncode == 2, said
    assert f"publishes /clock on ROS domain {os.environ['ROS_DOMAIN_ID']}, and a domain has one clock" in said
