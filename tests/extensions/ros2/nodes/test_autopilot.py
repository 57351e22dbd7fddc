# ruff: noqa: E402 - rclpy can be imported once a backend is active
"""The hardware bridge in front of an autopilot: armed by its service, once the autopilot is."""

import pytest

from finssim.extensions.ros2.backend import activate

activate(announce=False)

import rclpy
from rclpy.node import Node

from finssim.extensions.ros2.nodes.conversions import ros_type
from finssim.extensions.ros2.nodes.hardware_bridge import HardwareBridge
from finssim.pool import VirtualPool, draw_plant
from finssim.pool.drawn_plant import site_of
from finssim.vehicles import load_vehicle
from finssim.vehicles.defaults import vehicle_at
from reference.ros_time import RosTime


class Wire:
    """To an emulated ArduSub in this process, whose time is that of /clock."""

    def __init__(self):
        body = vehicle_at("tank", load_vehicle("bluerov2_heavy"), navigation=True)
        self.pool = VirtualPool(body, site_of("tank", draw_plant(body, 1, "nominal")), firmware="ardusub")
        self.now, self.sent = lambda: 0.0, []

    def send(self, data):
        self.sent.append(data)

    def receive(self):
        sent, self.sent = self.sent, []
        return [frame for _, frame in self.pool.exchange(self.now(), sent).frames]

    def describe(self):
        return "in this process"

    def close(self):
        self.pool.close()


@pytest.mark.slow
def test_the_service_arms_once_the_autopilot_has_armed():
    """Until then it answers what is waited for; nobody who does not ask arms; disarming disarms the autopilot."""
    words = "vehicle:='bluerov2_heavy' site:='tank' robot:='mavlink://udpin:127.0.0.1:0' need_reading:=false"
    words += " use_sim_time:=true"
    rclpy.init(args=["--ros-args", *(word for option in words.split() for word in ("-p", option))])
    bridge, peer = HardwareBridge(), Node("peer", namespace="bluerov2_heavy")
    bridge.transport.close()
    bridge.transport = wire = Wire()
    set_armed = ros_type("std_srvs/srv/SetBool")
    client = peer.create_client(set_armed, "set_armed")

    ros_time = RosTime(peer, (bridge,))
    began = ros_time.now
    wire.now = lambda: ros_time.now - began

    def spin(condition):
        return ros_time.until(condition, lambda: None)

    def asked(wanted):
        future = client.call_async(set_armed.Request(data=wanted))
        assert spin(future.done)
        return future.result()

    try:
        assert spin(client.service_is_ready)
        spin(lambda: wire.pool.time > 4.0)
        assert not wire.pool.firmware.armed
        first = asked(True)
        assert not first.success and first.message.startswith("waiting for it to arm")
        assert spin(lambda: bridge.intake.link.armed) and wire.pool.firmware.armed
        assert asked(True).success and bridge.bridge.state == "armed"
        assert asked(False).success and spin(lambda: not wire.pool.firmware.armed)
    finally:
        bridge.close()
        rclpy.shutdown()
