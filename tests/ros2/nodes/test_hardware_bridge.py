# ruff: noqa: E402 - rclpy can be imported once a backend is active
"""The hardware bridge: who else commands the thrusters."""

import time
from types import SimpleNamespace

import pytest

from finssim.ros2.backend import activate

activate(announce=False)

import rclpy
from rclpy.node import Node

from finssim.ros2.nodes.conversions import ros_type
from finssim.ros2.nodes.hardware_bridge import BridgeTopics
from finssim.ros2.nodes.robot_node import RobotNode

COMMAND = ros_type("finssim_msgs/msg/ThrusterCommand")


@pytest.mark.slow
@pytest.mark.parametrize("lives", [0.0, 0.1])
def test_a_second_publisher_stops_the_vehicle_however_short_it_lives(lives):
    """One of the same name that is gone before anybody counts is a fault too; the first alone is none."""
    rclpy.init(args=[])
    node, controller = RobotNode("hardware_bridge"), Node("controller", namespace="finsrov")
    stops = []
    bridge = SimpleNamespace(state="armed", stop=lambda now, why: stops.append(why))
    BridgeTopics(node, bridge, readings=False)

    def spin(seconds):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            rclpy.spin_once(node, timeout_sec=0.01)

    try:
        controller.create_publisher(COMMAND, "thruster_cmd", 1)
        spin(0.7)
        assert not stops
        second = controller.create_publisher(COMMAND, "thruster_cmd", 1)
        spin(lives)
        controller.destroy_publisher(second)
        spin(0.5)
        assert set(stops) == {"two publishers command the thrusters: 2 on finsrov/thruster_cmd"}
    finally:
        rclpy.shutdown()
