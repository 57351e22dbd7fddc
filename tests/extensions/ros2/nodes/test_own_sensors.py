# ruff: noqa: E402 - rclpy can be imported once a backend is active
"""The vehicle's own cameras, sonars and altimeters as ROS 2 messages: numbers, frames, and the publishing
node."""

import math
import socket
import time
from dataclasses import replace

import numpy as np
import pytest

from finssim.extensions.ros2.backend import activate

activate(announce=False)

import rclpy
from rclpy.node import Node

from finssim.core.rotations import quat_conjugate, quat_rotate
from finssim.extensions.perception.rays import cones, fan
from finssim.extensions.ros2.nodes.camera import CameraNode
from finssim.extensions.ros2.nodes.controller import MOST_PICTURES, ControllerNode
from finssim.extensions.ros2.nodes.conversions import (
    RosMessages,
    image_of,
    nanoseconds,
    own_reading,
    ros_type,
    xyz,
)
from finssim.extensions.ros2.nodes.frames import mounts
from finssim.extensions.ros2.topics import own_topics, quality_profile
from finssim.pool.pictures import UdpSender
from finssim.robot.messages import Picture
from finssim.vehicles import load_vehicle
from finssim.vehicles.device_files import device_of, load_device
from finssim.vehicles.equipment import RaySensor
from reference.policies import seeing

VEHICLE = load_vehicle("finsrov")
LOG = RaySensor(device="dvl_a50", position=np.array([-0.1, 0.0, -0.1]), rate=5.0)
VEHICLE = VEHICLE.model_copy(update={"perception": {**VEHICLE.perception, "floor": LOG}})
MAKE = RosMessages(VEHICLE)
STAMP = 12_345_678_901
FRAMES = {name: (position, q) for name, position, q in mounts(VEHICLE)}
RANDOM = np.random.default_rng(1)
COLOURS = RANDOM.integers(0, 256, (36, 64, 3)).astype(np.uint8)
ECHOES = RANDOM.integers(0, 256, (128, 128)).astype(np.uint8)
READINGS = (
    Picture(0.0, 1, COLOURS, source="front_camera"),
    Picture(0.0, 1, ECHOES, source="sonar"),
    Picture(0.0, 1, source="altimeter", ranges=np.array([2.5], np.float32)),
    Picture(0.0, 1, source="floor", ranges=np.array([2.0, 3.0, np.inf, 4.0], np.float32)),
)


def made(reading):
    """Return the messages of a reading, by the last part of their keys."""
    return {key.split("/")[1]: make() for key, make in MAKE.of_own(STAMP, reading).items()}


def in_link(name, vector):
    """Return a direction of NAME_acoustic in NAME_link."""
    turned = quat_rotate(FRAMES[f"{name}_acoustic"][1], np.asarray(vector))
    return np.asarray(quat_rotate(quat_conjugate(FRAMES[f"{name}_link"][1]), turned))


def test_a_picture_and_its_lens_are_those_of_the_camera():
    """rgb8 is bit-identical; K has 64 pixels across 80 degrees; the optical frame looks along the nose, x to
    the right."""
    found = made(READINGS[0])
    image, info = found["image"], found["camera_info"]
    assert (image.encoding, image.step, image.header.frame_id) == ("rgb8", 192, "front_camera_optical")
    assert nanoseconds(image.header.stamp) == STAMP and np.array_equal(image_of(image, colour=True), COLOURS)
    assert (info.width, info.height, info.distortion_model) == (64, 36, "plumb_bob")
    assert info.k[0] == pytest.approx(32.0 / math.tan(math.radians(40.0)), rel=1e-4)
    assert (info.k[2], info.k[5]) == (31.5, 17.5) and not any(info.d)
    q = FRAMES["front_camera_optical"][1]
    assert np.asarray(quat_rotate(q, np.eye(3)[2])) == pytest.approx([1.0, 0.0, 0.0], abs=1e-9)
    assert np.asarray(quat_rotate(q, np.eye(3)[0])) == pytest.approx([0.0, -1.0, 0.0], abs=1e-9)


def test_a_ping_has_its_beams_where_the_sonar_has_them():
    """Directions in the sonar's frame are those of its rays at elevation 0; beams of one range are adjacent."""
    device, ping = device_of(VEHICLE, "sonar"), made(READINGS[1])["sonar"]
    level = device.model_copy(update={"elevations": 1})
    for direction, ray in zip(ping.beam_directions, fan(level)[0, :, 1], strict=True):
        assert in_link("sonar", xyz(direction)) == pytest.approx(ray, abs=1e-9)
    assert ping.image.beam_count == 128 and ping.image.dtype == 0
    assert np.array_equal(np.asarray(ping.image.data).reshape(128, 128), ECHOES.T)
    assert ping.ranges[0] == pytest.approx(0.5 * device.range / 128) and len(ping.ranges) == 128
    assert ping.ping_info.rx_beamwidths[5] == pytest.approx(device.beam_width)


def test_four_beams_are_those_of_the_log():
    """Unit vectors are those of its rays; the altitude is the mean of the returned ranges along the view."""
    device, message = load_device("dvl_a50"), made(READINGS[3])["beams"]
    for vector, ray in zip(message.beam_unit_vec, cones(device)[0][:, 0, 1], strict=True):
        assert in_link("floor", xyz(vector)) == pytest.approx(ray, abs=1e-9)
    assert list(message.range) == [2.0, 3.0, math.inf, 4.0] and message.num_good_beams == 3
    assert message.altitude == pytest.approx(3.0 * math.cos(device.beam_angle))
    assert not message.beam_velocities_valid and math.isnan(message.velocity.x)
    down = np.asarray(quat_rotate(FRAMES["floor_acoustic"][1], np.eye(3)[2]))
    assert down == pytest.approx([0.0, 0.0, -1.0], abs=1e-6)


def test_an_altimeter_tells_range_and_reach():
    """The range is infinite without an object in reach (REP 117)."""
    message = made(READINGS[2])["range"]
    assert (message.range, message.radiation_type, message.max_range) == (2.5, 0, 100.0)
    assert message.field_of_view == pytest.approx(math.radians(25.0), abs=1e-4)
    nothing = made(replace(READINGS[2], ranges=np.array([np.inf], np.float32)))["range"]
    assert nothing.range == math.inf
    assert MAKE.of_own(STAMP, Picture(0.0, 1, source="stranger")) == {}


def test_what_the_messages_of_own_sensors_tell_is_what_was_measured():
    """Pictures, echoes and ranges are bit-identical; an inconsistent ping and a NaN range give None."""
    for reading, key in zip(READINGS[:3], ("image", "sonar", "range"), strict=True):
        told = own_reading(made(reading)[key])
        for field in ("image", "ranges"):
            sent, heard = getattr(reading, field), getattr(told, field)
            assert (sent is None) == (heard is None) and (sent is None or np.array_equal(heard, sent))
    cut, nothing = made(READINGS[1])["sonar"], made(READINGS[2])["range"]
    cut.image.beam_count, nothing.range = 127, math.nan
    assert own_reading(cut) is None and own_reading(nothing) is None


@pytest.mark.slow
def test_the_camera_node_sends_what_comes_over_the_wire(tmp_path):
    """Without an overhead camera, each reading is published on its topic, stamped with its exposure."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        wire = free.getsockname()
    own = [f"pictures:='udp://127.0.0.1:{wire[1]}'", "pool_file:='none'", "pictures_bind:='127.0.0.1:0'"]
    words = [word for setting in own for word in ("-p", setting)]
    rclpy.init(args=["--ros-args", "-r", "__ns:=/finsrov", *words])
    try:
        camera, peer, heard = CameraNode(), Node("peer"), {}
        plain = load_vehicle("finsrov")
        for key, topic in own_topics(plain).items():
            heard[key] = []
            quality = quality_profile(topic.quality)
            peer.create_subscription(ros_type(topic.type), topic.name, heard[key].append, quality)
        sender, end = UdpSender(wire, camera.source.address), time.monotonic() + 30.0
        while not all(heard.values()) and time.monotonic() < end:
            now = time.monotonic()
            for reading in READINGS[:3]:
                sender.send(replace(reading, time=now), now)
            for _ in range(12):
                rclpy.spin_once(camera, timeout_sec=0.0)
                rclpy.spin_once(peer, timeout_sec=0.005)
        assert all(heard.values()), [key for key, found in heard.items() if not found]
        age = time.time_ns() - nanoseconds(heard["front_camera/image"][-1].header.stamp)
        assert 0.1 <= 1e-9 * age < 5.0
        assert np.array_equal(image_of(heard["front_camera/image"][-1], colour=True), COLOURS)
        sender.close(), camera.close()
    finally:
        rclpy.try_shutdown()


@pytest.mark.slow
def test_a_controller_hears_the_pictures_that_its_policy_sees(tmp_path):
    """Pictures come in colour with their exposure times; while disarmed only the latest few are kept."""
    rclpy.init(args=["--ros-args", "-r", "__ns:=/finsrov", "-p", f"policy:={seeing(tmp_path / 'policy')}"])
    try:
        controller, peer, end = ControllerNode(), Node("peer"), time.monotonic() + 30.0
        topic = own_topics(load_vehicle("finsrov"))["front_camera/image"]
        out = peer.create_publisher(ros_type(topic.type), topic.name, quality_profile(topic.quality))
        message = MAKE.image(controller.ns(1.5), COLOURS, topic.frame)
        while len(controller._seen) < MOST_PICTURES and time.monotonic() < end:
            out.publish(message)
            for _ in range(4):
                rclpy.spin_once(controller, timeout_sec=0.005)
        for _ in range(8):
            out.publish(message)
            rclpy.spin_once(controller, timeout_sec=0.05)
        assert len(controller._seen) == MOST_PICTURES
        seen = controller._seen[-1]
        assert seen.source == "front_camera" and np.array_equal(seen.image, COLOURS)
        assert seen.time == pytest.approx(1.5 + VEHICLE.perception["front_camera"].latency, abs=1e-6)
    finally:
        rclpy.try_shutdown()
