# ruff: noqa: E402 - rclpy can be imported once a backend is active
"""Position fixes, DVL and compass: from the motor controller to topics and odometry, without a camera."""

from types import SimpleNamespace

import numpy as np
import pytest

from finssim.extensions.ros2.backend import activate

activate(announce=False)

import rclpy
from rclpy.node import Node

from finssim.extensions.ros2.nodes.conversions import nanoseconds, ros_type
from finssim.extensions.ros2.nodes.hardware_bridge import HardwareBridge
from finssim.extensions.ros2.nodes.state_estimation import StateEstimation
from finssim.extensions.ros2.topics import TOPICS, quality_profile
from reference.ros_time import RosTime
from reference.sea import Sea

PATIENCE = 40.0  # [s] on a busy machine
HEARD = ("positioning", "dvl", "compass", "odometry", "estimator")


@pytest.fixture
def sea():
    """One vehicle with its bridge and its estimator."""
    made = Sea((3.0, -2.0, -4.0))
    address = f"robot:='udp://127.0.0.1:{made.end.address[1]}'"
    options = [
        "vehicle:='finsrov'",
        "site:='open-water'",
        "pool_file:='none'",
        address,
        "bind:='127.0.0.1:0'",
        "use_sim_time:=true",
    ]
    words = [word for option in options for word in ("-p", option)]
    rclpy.init(args=["--ros-args", "-r", "__ns:=/finsrov", *words])
    bridge, estimator, peer = HardwareBridge(), StateEstimation(), Node("peer")
    made.know(bridge.transport.address)
    heard = {key: [] for key in HEARD}
    for key in HEARD:
        topic = TOPICS[key]
        peer.create_subscription(
            ros_type(topic.type), topic.name, heard[key].append, quality_profile(topic.quality)
        )

    ros_time = RosTime(peer, (bridge, estimator))
    began = ros_time.now

    def until(condition):
        return ros_time.until(condition, lambda: made.turn(ros_time.now - began))

    yield SimpleNamespace(heard=heard, until=until, world=made.world, estimator=estimator)
    bridge.close()
    made.close()
    rclpy.shutdown()


@pytest.mark.slow
def test_instruments_become_topics_and_topics_a_place(sea):
    """With motion capture (50 Hz, 2 mm, 20 ms late) and a DVL at 8 Hz, odometry is within 2 cm of the truth."""
    heard = sea.heard
    assert sea.until(lambda: any(m.ready for m in heard["estimator"]) and len(heard["dvl"]) > 10)
    count = len(heard["odometry"])
    assert sea.until(lambda: len(heard["odometry"]) > count + 60)
    last, truth = heard["odometry"][-1].pose.pose.position, sea.world.plant.position
    assert np.linalg.norm(np.array([last.x, last.y, last.z]) - truth) < 0.02
    fix, log, compass = (heard[key][-1] for key in ("positioning", "dvl", "compass"))
    assert [m.header.frame_id for m in (fix, log, compass)] == ["map", "dvl_link", "base_link"]
    assert fix.pose.pose.position.x == pytest.approx(truth[0], abs=0.01)
    assert abs(log.twist.twist.linear.x) < 0.05 and compass.orientation.w == pytest.approx(1.0, abs=1e-3)
    ages = np.diff([nanoseconds(m.header.stamp) for m in heard["positioning"]]) * 1e-9
    assert np.median(ages) == pytest.approx(0.02, abs=0.004)
    assert "accepted" in sea.estimator.perception.health().counts["vision"]
