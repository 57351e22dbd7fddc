# ruff: noqa: E402 - rclpy can be imported once a backend is active
"""Fins in ROS 2: a simulated torpedo is steered by joints."""

import numpy as np
import pytest

from finssim.extensions.ros2.backend import activate

activate(announce=False)

import rclpy
from rclpy.node import Node

from extensions.ros2.worlds.test_sim import World
from finssim.extensions.ros2.nodes.conversions import ros_type
from finssim.extensions.ros2.topics import TOPICS
from finssim.extensions.ros2.worlds.sim import Sim
from reference.finned import torpedo_file


class Torpedo(World):
    """World of a torpedo; the peer receives its actuator states and sends commands."""

    def __init__(self, sim, peer):
        super().__init__(sim, peer)
        self.heard["actuators"] = []
        kind = ros_type(TOPICS["actuators"].type)
        peer.create_subscription(
            kind, self.name("actuators"), self.heard["actuators"].append, self.quality("actuators")
        )
        self.publisher("setpoints")

    def name(self, key):
        return TOPICS[key].under("torpedo")

    def steer(self, values):
        """Send values of the other actuators, and a thrust with which they take effect."""
        self.send("setpoints", self.make.actuators(self.sim.ns(self.sim.time), values))
        self.ask(np.full(self.count, 5.0))


@pytest.fixture
def world(tmp_path):
    rclpy.init(args=["--ros-args", "-p", f"vehicle:={torpedo_file(tmp_path)}"])
    sim, peer = Sim(), Node("peer")
    for timer in list(sim.timers):
        if timer.callback == sim._turn:
            sim.destroy_timer(timer)
    yield Torpedo(sim, peer)
    sim.destroy_node(), peer.destroy_node()
    rclpy.try_shutdown()


@pytest.mark.slow
def test_fins_follow_joints_while_armed_and_go_to_zero_afterwards(world):
    """The topic `actuator_cmd` acts with the next thrusts; `actuator_states` contains the fins' deflections."""

    def rudder():
        return world.heard["actuators"][-1].position[0] if world.heard["actuators"] else 0.0

    assert world.armed()
    assert world.until(
        lambda: rudder() == pytest.approx(0.196, abs=1e-3), lambda: world.steer([0.2, 0.0, 0.0, 0.0])
    )
    assert world.heard["actuators"][-1].name == ["rudder", "elevator", "engine", "battery"]
    np.testing.assert_allclose(world.sim.bridge.setpoints, [0.2, 0.0, 0.0, 0.0])
    world.send("arm", data=False)
    assert world.until(lambda: rudder() < 0.006)


def test_joints_of_other_names_are_refused(world):
    """An event reports the refusal, and the fins do not move."""
    assert world.armed()
    message = world.make.actuators(world.sim.ns(world.sim.time), [0.2, 0.0, 0.0, 0.0])
    message.name = ["a", "b", "c", "d"]
    world.send("setpoints", message)
    said = [m.data for m in world.heard["event"]]
    assert world.until(
        lambda: any("names the actuators a, b, c, d" in m.data for m in world.heard["event"])
    ), said
    assert not world.sim.bridge.setpoints.any()
