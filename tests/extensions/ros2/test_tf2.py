# ruff: noqa: E402 - rclpy can be imported once a backend is active
"""Transforms over time: chains, interpolation and refusals as in tf2, and transport over /tf and /tf_static."""

import math
import time

import numpy as np
import pytest

from finssim.extensions.ros2.backend import activate

activate(announce=False)

import rclpy
import tf2_ros
from builtin_interfaces.msg import Time as TimeMessage
from geometry_msgs.msg import TransformStamped
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.time import Time
from tf2_ros import (
    ConnectivityException,
    ExtrapolationException,
    InvalidArgumentException,
    LookupException,
    TransformException,
)
from tf2_ros.buffer import Buffer

from finssim.core.rotations import quat_from_euler, quat_rotate


def moved(parent, child, seconds, place=(0.0, 0.0, 0.0), turn=(0.0, 0.0, 0.0)):
    """Return a TransformStamped with roll, pitch and yaw."""
    made = TransformStamped(child_frame_id=child)
    made.header.frame_id, made.header.stamp = parent, Time(seconds=seconds).to_msg()
    t, r = made.transform.translation, made.transform.rotation
    t.x, t.y, t.z = map(float, place)
    r.x, r.y, r.z, r.w = (float(v) for v in quat_from_euler(*turn))
    return made


def place_of(found):
    t = found.transform.translation
    return np.array([t.x, t.y, t.z])


def turn_of(found):
    r = found.transform.rotation
    return np.array([r.x, r.y, r.z, r.w])


@pytest.fixture
def tree():
    """map → odom → base_link, which turns and moves, with a camera on it, and another vehicle below the map."""
    buffer = Buffer()
    for t in (1.0, 2.0, 3.0):
        buffer.set_transform(moved("map", "odom", t, (0.5, 0.0, 0.0)), "test")
        buffer.set_transform(
            moved("odom", "base_link", t, (t, 0.0, -1.0), (0.0, 0.0, 0.5 * math.pi * t)), "test"
        )
    buffer.set_transform(moved("map", "other", 2.5, (0.0, 9.0, 0.0)), "test")
    buffer.set_transform_static(moved("base_link", "camera", 0.0, (0.2, 0.0, 0.1)), "test")
    return buffer


def test_a_chain_is_multiplied_up_and_down(tree):
    """By the closed form, at 2 s the vehicle looks backwards and its camera is behind its middle."""
    found = tree.lookup_transform("map", "camera", Time(seconds=2.0))
    assert place_of(found) == pytest.approx([0.5 + 2.0 - 0.2, 0.0, -0.9])
    assert abs(turn_of(found) @ quat_from_euler(0.0, 0.0, math.pi)) == pytest.approx(1.0)
    assert (found.header.frame_id, found.child_frame_id) == ("map", "camera")
    assert found.header.stamp == TimeMessage(sec=2)
    back = tree.lookup_transform("camera", "map", Time(seconds=2.0))
    assert place_of(found) + quat_rotate(turn_of(found), place_of(back)) == pytest.approx(np.zeros(3))
    same = tree.lookup_transform("camera", "camera", Time(seconds=2.0))
    assert np.array_equal(place_of(same), np.zeros(3)) and turn_of(same)[3] == 1.0


def test_between_two_samples_the_place_is_linear_and_the_turn_the_shortest(tree):
    """A quarter turn in a second is an eighth in half a second."""
    found = tree.lookup_transform("odom", "base_link", TimeMessage(sec=1, nanosec=250_000_000))
    assert place_of(found) == pytest.approx([1.25, 0.0, -1.0])
    wanted = np.asarray(quat_from_euler(0.0, 0.0, 0.5 * math.pi * 1.25))
    assert abs(turn_of(found) @ wanted) == pytest.approx(1.0)
    tree.set_transform(moved("odom", "base_link", 4.0, turn=(0.0, 0.0, math.radians(-170.0))), "test")
    tree.set_transform(moved("odom", "base_link", 5.0, turn=(0.0, 0.0, math.radians(170.0))), "test")
    found = tree.lookup_transform("odom", "base_link", Time(seconds=4.5))
    assert abs(turn_of(found) @ np.asarray(quat_from_euler(0.0, 0.0, math.pi))) == pytest.approx(1.0)


def test_time_zero_is_the_latest_that_the_whole_chain_knows(tree):
    """Links outside the chain are ignored; static ones are valid at any time."""
    assert tree.lookup_transform("map", "camera", Time()).header.stamp == TimeMessage(sec=3)
    with pytest.raises(ExtrapolationException):
        tree.lookup_transform("other", "camera", Time(seconds=3.0))
    assert tree.get_latest_common_time("other", "camera").nanoseconds == 2_500_000_000
    only_static = tree.lookup_transform("base_link", "camera", Time(seconds=77.0))
    assert place_of(only_static) == pytest.approx([0.2, 0.0, 0.1])


def test_two_times_meet_in_a_frame_that_stands_still(tree):
    """The vehicle's position at 1 s is found in its own frame at 3 s."""
    found = tree.lookup_transform_full(
        "base_link", Time(seconds=3.0), "base_link", Time(seconds=1.0), "map", Duration()
    )
    then, now = (tree.lookup_transform("map", "base_link", Time(seconds=t)) for t in (1.0, 3.0))
    place = place_of(now) + quat_rotate(turn_of(now), place_of(found))
    assert place == pytest.approx(place_of(then)) and found.header.stamp == TimeMessage(sec=3)


@pytest.mark.parametrize(
    ("target", "source", "seconds", "error", "words"),
    [
        ("map", "nowhere", 2.0, LookupException, '"nowhere".*source_frame does not exist'),
        ("nowhere", "map", 2.0, LookupException, '"nowhere".*target_frame does not exist'),
        ("map", "island", 2.0, ConnectivityException, "not part of the same tree"),
        ("map", "camera", 3.5, ExtrapolationException, "into the future.*3.500000.*latest.*3.000000"),
        (
            "map",
            "camera",
            0.5,
            ExtrapolationException,
            r"into the past.*from frame \[camera\] to frame \[map\]",
        ),
        ("/map", "camera", 2.0, InvalidArgumentException, "without a leading slash"),
        ("map", "", 2.0, InvalidArgumentException, "source_frame is ''"),
    ],
)
def test_what_is_not_known_is_refused_as_tf2_does(tree, target, source, seconds, error, words):
    """All errors are a TransformException; `can_transform` returns the reason."""
    tree.set_transform(moved("sea", "island", 2.0), "test")
    with pytest.raises(error, match=words) as refused:
        tree.lookup_transform(target, source, Time(seconds=seconds))
    assert isinstance(refused.value, TransformException)
    able, reason = tree.can_transform(target, source, Time(seconds=seconds), return_debug_tuple=True)
    assert not able and reason == str(refused.value)
    assert not tree.can_transform(target, source, Time(seconds=seconds))


def test_malformed_transforms_are_left_out(tree):
    """NaN, an invalid rotation and a frame that is its own parent are ignored."""
    bad = [moved("map", "x", 1.0, (math.nan, 0.0, 0.0)), moved("x", "x", 1.0), moved("map", "x", 1.0)]
    bad[-1].transform.rotation.w = 0.5
    for transform in bad:
        with pytest.raises(InvalidArgumentException):
            tree.set_transform(transform, "test")
    assert not tree.can_transform("map", "x", Time())
    tree.set_transform(moved("a", "b", 1.0), "test"), tree.set_transform(moved("b", "a", 1.0), "test")
    with pytest.raises(ConnectivityException, match="loop"):
        tree.lookup_transform("map", "a", Time(seconds=1.0))


def test_old_poses_are_forgotten():
    """Poses older than the cache time are dropped, late ones too; poses out of order are kept."""
    buffer = Buffer(Duration(seconds=2.0))
    for t in (1.0, 4.0, 3.0, 5.0, 0.5):
        buffer.set_transform(moved("map", "base_link", t, (t, 0.0, 0.0)), "test")
    assert place_of(buffer.lookup_transform("map", "base_link", Time(seconds=3.5)))[0] == pytest.approx(3.5)
    with pytest.raises(ExtrapolationException, match="earliest data is at time 3.0"):
        buffer.lookup_transform("map", "base_link", Time(seconds=2.0))
    buffer.clear()
    with pytest.raises(LookupException):
        buffer.lookup_transform("map", "base_link", Time())


@pytest.fixture
def nodes():
    rclpy.init(args=[])
    yield Node("talker"), Node("listener")
    rclpy.try_shutdown()


def test_broadcasters_reach_a_listener_that_comes_later(nodes):
    """Static transforms are latched, and a second one does not replace the first."""
    talker, node = nodes
    fixed, moving = tf2_ros.StaticTransformBroadcaster(talker), tf2_ros.TransformBroadcaster(talker)
    fixed.sendTransform(moved("base_link", "imu", 0.0, (1.0, 0.0, 0.0)))
    fixed.sendTransform([moved("base_link", "dvl", 0.0, (0.0, 1.0, 0.0))])
    buffer = tf2_ros.Buffer(node=node)
    listener = tf2_ros.TransformListener(buffer, node)
    end = time.monotonic() + 10.0
    while time.monotonic() < end and not all(
        buffer.can_transform("map", frame, Time()) for frame in ("imu", "dvl")
    ):
        moving.sendTransform(moved("map", "base_link", 7.0, (0.0, 0.0, -1.0)))
        rclpy.spin_once(node, timeout_sec=0.02)
    assert place_of(buffer.lookup_transform("imu", "dvl", Time())) == pytest.approx([-1.0, 1.0, 0.0])
    assert place_of(buffer.lookup_transform("map", "imu", Time(seconds=7.0))) == pytest.approx(
        [1.0, 0.0, -1.0]
    )
    assert talker.count_subscribers("/tf") == 1
    listener.unregister()
    with pytest.raises(TypeError, match="spin the node"):
        tf2_ros.TransformListener(buffer, node, spin_thread=True)


def test_a_lookup_waits_no_longer_than_asked(tree):
    """An available transform is returned at once."""
    began = time.monotonic()
    assert tree.can_transform("map", "camera", Time(), Duration(seconds=60.0))
    assert time.monotonic() - began < 30.0
    with pytest.raises(ExtrapolationException):
        tree.lookup_transform("map", "camera", Time(seconds=9.0), Duration(seconds=0.05))
