# ruff: noqa: E402 - rclpy can be imported once a backend is active
"""Graph queries of a node give the results of rclpy."""

import time

import pytest

from finssim.extensions.ros2.backend import activate

activate(announce=False)

import rclpy
from rclpy.node import Node, NodeNameNonExistentError
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointTypeEnum
from std_msgs.msg import String
from std_srvs.srv import Trigger

LATCHED = QoSProfile(
    depth=3, durability=DurabilityPolicy.TRANSIENT_LOCAL, reliability=ReliabilityPolicy.BEST_EFFORT
)


@pytest.fixture(scope="module")
def nodes():
    """Two nodes: the first publishes; the second has a subscription, a service and a client."""
    rclpy.init(args=[])
    talker, listener = Node("talker", namespace="ns"), Node("listener")
    talker.create_publisher(String, "word", LATCHED)
    listener.create_subscription(String, "/ns/word", print, 10)
    listener.create_service(Trigger, "go", lambda request, response: response)
    talker.create_client(Trigger, "/go")
    yield talker, listener
    rclpy.try_shutdown()


def awaited(ask, number=1):
    """Return the result of a query once it has that many entries, as discovery takes time."""
    end = time.monotonic() + 10.0
    while len(ask()) < number and time.monotonic() < end:
        time.sleep(0.01)
    return ask()


def test_publishers_of_a_topic_tell_node_type_and_policies(nodes):
    """Relative names and remapping work as for `create_publisher`."""
    talker, listener = nodes
    (info,) = awaited(lambda: talker.get_publishers_info_by_topic("word"))
    assert (info.node_name, info.node_namespace) == ("talker", "/ns")
    assert info.topic_type == "std_msgs/msg/String" and info.topic_type_hash.version == 1
    assert str(info.topic_type_hash) == (
        "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
    )
    assert info.endpoint_type is TopicEndpointTypeEnum.PUBLISHER and len(info.endpoint_gid) == 16
    profile = info.qos_profile
    assert (profile.depth, profile.durability, profile.reliability) == (
        3,
        DurabilityPolicy.TRANSIENT_LOCAL,
        ReliabilityPolicy.BEST_EFFORT,
    )
    assert profile.deadline.nanoseconds == 2**63 - 1
    assert listener.get_publishers_info_by_topic("word") == []
    assert len(listener.get_publishers_info_by_topic("rt/ns/word", no_mangle=True)) == 1


def test_subscriptions_of_a_topic_tell_their_node(nodes):
    """Counts agree with the subscriptions."""
    talker, listener = nodes
    (info,) = awaited(lambda: listener.get_subscriptions_info_by_topic("/ns/word"))
    assert (info.node_name, info.node_namespace) == ("listener", "/")
    assert info.endpoint_type is TopicEndpointTypeEnum.SUBSCRIPTION
    assert (talker.count_publishers("word"), talker.count_subscribers("word")) == (1, 1)
    assert (listener.count_services("go"), listener.count_clients("go")) == (1, 1)
    assert listener.count_publishers("word") == 0


def test_names_come_with_their_types(nodes):
    """Names and types are listed for the whole graph and for one node."""
    talker, listener = nodes
    assert awaited(talker.get_node_names, 2) == ["listener", "talker"]
    assert ("/ns/word", ["std_msgs/msg/String"]) in talker.get_topic_names_and_types()
    assert ("rt/ns/word", ["std_msgs::msg::dds_::String_"]) in talker.get_topic_names_and_types(
        no_demangle=True
    )
    assert ("/go", ["std_srvs/srv/Trigger"]) in talker.get_service_names_and_types()
    word, go = ("/ns/word", ["std_msgs/msg/String"]), ("/go", ["std_srvs/srv/Trigger"])
    assert word in talker.get_publisher_names_and_types_by_node("talker", "/ns")
    assert word not in talker.get_publisher_names_and_types_by_node("listener", "/")
    assert word in talker.get_subscriber_names_and_types_by_node("listener", "/")
    assert go in talker.get_service_names_and_types_by_node("listener", "/")
    assert talker.get_client_names_and_types_by_node("talker", "/ns") == [go]
    with pytest.raises(NodeNameNonExistentError, match="nobody"):
        talker.get_publisher_names_and_types_by_node("nobody", "/")


def test_who_has_left_is_neither_found_nor_kept(nodes):
    """Any number of endpoints may come and go: each query reads only new ones."""
    talker, listener = nodes
    for _ in range(20):
        gone = listener.create_publisher(String, "fleeting", 1)
        assert len(awaited(lambda: talker.get_publishers_info_by_topic("/fleeting"))) == 1
        listener.destroy_publisher(gone)
    end = time.monotonic() + 10.0
    while talker.count_publishers("/fleeting") and time.monotonic() < end:
        time.sleep(0.01)
    assert talker.get_publishers_info_by_topic("/fleeting") == []
    reader, known = talker.context.participant._builtin["publications"]
    assert not reader.read(N=10_000)
    assert not [one for one in known.values() if "fleeting" in one.topic]  # other graphs have endpoints too
