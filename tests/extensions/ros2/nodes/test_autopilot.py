# ruff: noqa: E402 - rclpy can be imported once a backend is active
"""The hardware bridge with an autopilot: arming by service waits for the autopilot; a whole graph drives it."""

import socket
import subprocess
import sys
from contextlib import ExitStack

import numpy as np
import pytest

from finssim.extensions.ros2.backend import activate

activate(announce=False)

import rclpy
from rclpy.node import Node

from finssim.extensions.ros2.nodes.conversions import ros_type
from finssim.extensions.ros2.nodes.hardware_bridge import HardwareBridge
from finssim.pool import VirtualPool, draw_plant, read_truth
from finssim.pool.drawn_plant import site_of
from finssim.vehicles import load_vehicle
from finssim.vehicles.defaults import vehicle_at
from reference.ros_time import RosTime


class Wire:
    """Link to an emulated ArduSub in this process, on the time of /clock."""

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
    """Until then the service reports what it waits for; only a request arms; disarming disarms the autopilot."""
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


def three_ports():
    """Return a UDP port whose next two TCP ports are free."""
    while True:
        with ExitStack() as stack:
            try:
                udp = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
                udp.bind(("127.0.0.1", 0))
                port = udp.getsockname()[1]
                for after in (1, 2):
                    tcp = stack.enter_context(socket.socket())
                    tcp.bind(("127.0.0.1", port + after))
                return port
            except (OSError, OverflowError):
                continue


@pytest.mark.slow
def test_a_whole_graph_drives_an_autopilot_to_its_goal(alone, tmp_path):
    """In lock-step, one command arms the autopilot and drives the true vehicle to within 10 cm of the goal."""
    goal, truth = (0.6, 0.0, -2.0), tmp_path / "run.truth"
    words = "ros2 up pool --firmware ardusub --vehicle bluerov2_heavy --site tank --severity nominal --let-in 0,0 "
    words += f"--start 0,0,-2,0 --goal 0.6,0,-2,0 --arm --lockstep --duration 25 --port {three_ports()} --truth {truth}"
    command = [sys.executable, "-m", "finssim", *words.split()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300.0)
    assert done.returncode == 0, done.stdout + done.stderr
    true = read_truth(truth)
    before = true.position[true.time < true.time[-1] - 1.0]  # the vehicle is disarmed at the end
    assert np.linalg.norm(before[-1] - goal) < 0.1 and abs(before[0] - goal).max() > 0.5
