# ruff: noqa: E402 - rclpy can be imported once a backend is active
"""A node or a graph is not started while another of its name is alive."""

import sys

import pytest

from finssim.cli import boundary
from finssim.cli.commands import app
from finssim.extensions.ros2.backend import activate

activate(announce=False)

import rclpy
from rclpy.node import Node

from finssim.extensions.ros2.nodes import robot_node
from finssim.extensions.ros2.nodes.robot_node import RobotNode

LEASE = 10.0
"""Time after which the wire forgets a killed process [s], of Cyclone DDS and Fast DDS."""


@pytest.fixture
def other(monkeypatch):
    """Separate context in this process, as another process has one; nodes here wait only briefly."""
    monkeypatch.setattr(RobotNode, "urgent", False)
    monkeypatch.setattr(RobotNode, "listening", 0.0)
    assert robot_node.FORGOTTEN > LEASE
    monkeypatch.setattr(robot_node, "FORGOTTEN", 0.5)
    monkeypatch.setattr(sys, "argv", ["finssim"])
    context = rclpy.Context()
    context.init([])
    yield context
    context.try_shutdown()


def test_a_node_that_is_there_already_is_not_started_again(other, capfd):
    """A second node of the same name and namespace waits and ends with a sentence; after the first left, it
    starts."""
    first = Node("camera", namespace="twins", context=other)
    words = ["ros2", "node", "camera", "--ros-args", "-r", "__ns:=/twins", "-p", "pool_file:=/none.yaml"]
    assert boundary.run(app, words) == 2
    said = capfd.readouterr().err
    assert "another node /twins/camera is on ROS domain" in said and "waiting until it has gone" in said
    first.destroy_node()
    assert boundary.run(app, words) == 2
    said = capfd.readouterr().err
    assert "/none.yaml" in said and "another" not in said


def test_a_graph_is_not_started_where_one_of_its_nodes_lives(other, capfd):
    """The refusal comes before any process starts."""
    Node("controller", namespace="finsrov", context=other)
    assert boundary.run(app, ["ros2", "up", "sim", "--duration", "0.1"]) == 2
    out, said = capfd.readouterr()
    assert "another node /finsrov/controller" in said and "process" not in out
