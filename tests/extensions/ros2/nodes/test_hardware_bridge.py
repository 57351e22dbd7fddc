# ruff: noqa: E402 - rclpy can be imported once a backend is active
"""The hardware bridge refuses a second commander of the thrusters."""

import time
from types import SimpleNamespace

import pytest

from finssim.extensions.ros2.backend import activate

activate(announce=False)

import rclpy
from rclpy.node import Node

from finssim.extensions.ros2.nodes.conversions import ros_type
from finssim.extensions.ros2.nodes.hardware_bridge import BridgeTopics
from finssim.extensions.ros2.nodes.robot_node import RobotNode

PATIENCE = 60.0  # [s] on a busy machine
COMMAND = ros_type("finssim_msgs/msg/ThrusterCommand")


@pytest.mark.parametrize("lives", [False, True])
def test_a_second_publisher_stops_the_vehicle_however_short_it_lives(lives):
    """A publisher of the same name that leaves before a count is a fault too; the first one alone is not."""
    rclpy.init(
        args=["--ros-args", "-r", "__ns:=/alone"]
    )  # a killed graph of another test lingers on the wire
    node, controller = RobotNode("hardware_bridge"), Node("controller")
    stops = []
    bridge = SimpleNamespace(state="armed", stop=lambda now, why: stops.append(why))
    topics = BridgeTopics(node, bridge, readings=False)

    def until(condition):
        end = time.monotonic() + PATIENCE
        while not condition() and time.monotonic() < end:
            rclpy.spin_once(node, timeout_sec=0.05)
        return condition()

    try:
        controller.create_publisher(COMMAND, "thruster_cmd", 1)
        assert until(lambda: topics._publishers == 1 and topics._matched == 1) and not stops
        second = controller.create_publisher(COMMAND, "thruster_cmd", 1)
        if lives:
            assert until(lambda: topics._matched == 2)
        controller.destroy_publisher(second)
        assert until(lambda: bool(stops))
        assert set(stops) == {"two publishers command the thrusters: 2 on thruster_cmd"}
    finally:
        rclpy.shutdown()
