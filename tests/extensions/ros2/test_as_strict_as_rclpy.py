# ruff: noqa: E402 - rclpy can be imported once a backend is active
"""The built-in rclpy refuses what rclpy refuses: docs/reference/rclpy.md lists each rule with its test."""

import array
import ast
import importlib.util
import re
from pathlib import Path

import numpy as np
import pytest

from finssim.extensions.ros2.backend import activate

activate(announce=False)

import rclpy
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    ParameterEvent,
    SetParametersResult,
)
from rcl_interfaces.srv import GetParameters, ListParameters, SetParameters
from rclpy.duration import Duration
from rclpy.exceptions import (
    InvalidHandle,
    InvalidParameterException,
    InvalidParameterTypeException,
    InvalidParameterValueException,
    NotInitializedException,
    ParameterException,
    ParameterImmutableException,
    ParameterNotDeclaredException,
    ParameterUninitializedException,
)
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import InvalidQoSProfileException, QoSProfile
from rclpy.task import Future
from rclpy.time import Time
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import Float64, String
from std_srvs.srv import Trigger

from finssim.extensions.ros2.up import NODES

PAGE = Path(__file__).resolve().parents[3] / "docs" / "reference" / "rclpy.md"
FREE = ParameterDescriptor(dynamic_typing=True)


@pytest.fixture
def node():
    """One node, on the wire for one test."""
    rclpy.init(args=[])
    yield Node("a")
    rclpy.try_shutdown()


def refused(node, name, value):
    """Return the reason why a value is refused; "" if it is set."""
    (result,) = node.set_parameters([Parameter(name, value=value)])
    assert result.successful == (not result.reason)
    return result.reason


def test_every_rule_on_the_page_has_its_test_and_every_test_here_its_rule():
    rows = re.findall(r"^\| .* \| `(test_\w+\.py)::(\w+)` \|$", PAGE.read_text(), flags=re.MULTILINE)
    assert len(rows) > 25
    for file, test in rows:
        assert f"\ndef {test}(" in (Path(__file__).parent / file).read_text(), test
    here = set(re.findall(r"^def (test_\w+)\(", Path(__file__).read_text(), flags=re.MULTILINE))
    assert here - {test for _, test in rows} == {
        "test_every_rule_on_the_page_has_its_test_and_every_test_here_its_rule"
    }


# --- parameters -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "error",
    [
        NotInitializedException,
        ParameterException,
        ParameterNotDeclaredException,
        InvalidParameterValueException,
    ],
)
def test_errors_are_no_value_errors(error):
    """`except ValueError` around node code catches none of them."""
    assert not issubclass(error, (ValueError, RuntimeError)) and issubclass(error, Exception)


def test_a_default_has_a_type(node):
    """A default may be None with dynamic typing, or without a descriptor; a Parameter.Type needs no default."""
    with pytest.raises(ValueError, match="give a default"):
        node.declare_parameter("a", None, ParameterDescriptor())
    with pytest.raises(ValueError, match="NOT_SET"):
        node.declare_parameter("a", Parameter.Type.NOT_SET)
    with pytest.raises(ValueError, match="not both"):
        node.declare_parameter("a", Parameter.Type.STRING, ParameterDescriptor(dynamic_typing=True))
    assert node.declare_parameter("a").value is None and node.get_parameter("a").value is None


@pytest.mark.parametrize("value", [{}, {1}, object(), [1, 2.0], [1, "a"], np.float32(1.0), [[1]]])
def test_only_some_values_are_parameters(node, value):
    with pytest.raises(TypeError, match="no parameter can hold"):
        node.declare_parameter("a", value)
    with pytest.raises(TypeError, match="no parameter can hold"):
        Parameter("a", value=value)


def test_a_parameter_has_a_name(node):
    with pytest.raises(InvalidParameterException):
        node.declare_parameter("", 1)
    with pytest.raises(TypeError):
        node.declare_parameter(1, 1)


def test_a_value_and_its_type_agree():
    """A mismatch raises a ValueError, an invalid type a TypeError."""
    assert Parameter("a", Parameter.Type.STRING_ARRAY, []).value == []
    with pytest.raises(ValueError, match="is DOUBLE, found 1"):
        Parameter("a", Parameter.Type.DOUBLE, 1)
    with pytest.raises(TypeError, match="no Parameter.Type"):
        Parameter("a", 3, 1.0)


def test_an_empty_list_is_of_bytes(node):
    """An empty list therefore fits no list of another type."""
    node.declare_parameter("words", ["a"])
    assert "BYTE_ARRAY" in refused(node, "words", [])


def test_parameters_do_not_change_by_assignment():
    parameter = Parameter("a", value=1)
    with pytest.raises(AttributeError):
        parameter.value = 2
    assert parameter != Parameter("a", value=1), "compare their values"


def test_types_of_parameters_are_no_integers():
    with pytest.raises(TypeError):
        int(Parameter.Type.DOUBLE)
    assert Parameter.Type.DOUBLE != 3 and Parameter.Type(3) is Parameter.Type.DOUBLE


@pytest.mark.parametrize(
    ("value", "words"), [(2, "DOUBLE, found 2"), ("2.0", "STRING"), (True, "BOOL"), ([2.0], "ARRAY")]
)
def test_a_type_once_declared_stays(node, value, words):
    """A value of another type is refused without dynamic typing."""
    node.declare_parameter("gain", 1.0)
    assert words in refused(node, "gain", value)
    node.declare_parameter("free", 1.0, FREE)
    assert not refused(node, "free", value)


@pytest.mark.parametrize(
    ("value", "fits"), [(0, True), (2, True), (10, True), (3, False), (12, False), (-2, False)]
)
def test_integers_keep_their_range_and_steps(node, value, fits):
    """The ends of a range always fit."""
    limits = ParameterDescriptor(integer_range=[IntegerRange(from_value=0, to_value=10, step=2)])
    node.declare_parameter("count", 4, limits)
    assert (not refused(node, "count", value)) == fits


@pytest.mark.parametrize(
    ("value", "fits"),
    [(0.0, True), (0.3, True), (1.0, True), (0.35, False), (1.1, False), (float("nan"), False)],
)
def test_floats_keep_their_range_and_steps(node, value, fits):
    """Range and steps are met within a millionth."""
    limits = ParameterDescriptor(
        floating_point_range=[FloatingPointRange(from_value=0.0, to_value=1.0, step=0.1)]
    )
    node.declare_parameter("gain", 0.5, limits)
    assert (not refused(node, "gain", value)) == fits


def test_a_default_keeps_its_range_too(node):
    limits = ParameterDescriptor(integer_range=[IntegerRange(from_value=0, to_value=10)])
    with pytest.raises(InvalidParameterValueException, match="is 11, expected 0 to 10"):
        node.declare_parameter("count", 11, limits)


def test_a_range_of_integers_says_nothing_of_floats(node):
    """Each range applies to its own type."""
    limits = ParameterDescriptor(integer_range=[IntegerRange(from_value=0, to_value=1)], dynamic_typing=True)
    assert node.declare_parameter("a", 5.0, limits).value == 5.0


def test_read_only_parameters_stay(node):
    """They can neither be set nor undeclared."""
    node.declare_parameter("fixed", 1, ParameterDescriptor(read_only=True))
    assert "read-only" in refused(node, "fixed", 2) and node.get_parameter("fixed").value == 1
    with pytest.raises(ParameterImmutableException):
        node.undeclare_parameter("fixed")


def test_undeclared_parameters_are_refused(node):
    """They cannot be read, set, described, typed or undeclared; an atomic set with one of them sets nothing."""
    node.declare_parameter("known", 1)
    for act in (
        node.get_parameter,
        node.describe_parameter,
        node.get_parameter_type,
        node.undeclare_parameter,
    ):
        with pytest.raises(ParameterNotDeclaredException):
            act("unknown")
    with pytest.raises(ParameterNotDeclaredException):
        node.set_parameters_atomically([Parameter("known", value=2), Parameter("unknown", value=1)])
    assert node.get_parameter("known").value == 1


def test_a_static_parameter_cannot_be_undeclared_by_setting_it(node):
    node.declare_parameter("gain", 1.0)
    node.declare_parameter("free", 1.0, FREE)
    assert "cannot be undeclared" in refused(node, "gain", None)
    assert not refused(node, "free", None) and not node.has_parameter("free")


def test_an_empty_list_from_outside_gives_no_value(node):
    """Its type is unknown, so reading it is refused."""
    given = Node("b", cli_args="--ros-args -p words:=[]".split())
    assert given.declare_parameter("words", ["a"]).value is None
    with pytest.raises(ParameterUninitializedException):
        given.get_parameter("words")


def test_arguments_of_the_node_win_over_those_of_the_process():
    """Values in the program win over both."""
    rclpy.init(args="--ros-args -p a:=1 -p b:=1 -p c:=1".split())
    given = Node(
        "b", cli_args="--ros-args -p a:=2 -p b:=2".split(), parameter_overrides=[Parameter("a", value=3)]
    )
    assert [given.declare_parameter(name, 0).value for name in "abc"] == [3, 2, 1]
    rclpy.shutdown()


def test_a_wrong_type_of_use_sim_time_ends_the_node(node):
    with pytest.raises(InvalidParameterTypeException):
        Node("b", cli_args="--ros-args -p use_sim_time:=1".split())


def test_ros2_param_reaches_every_node(node):
    """List, get and set work by services with the node's own answers; changes are on /parameter_events."""
    other, events = Node("b"), []
    other.create_subscription(ParameterEvent, "/parameter_events", events.append, 10)
    node.declare_parameter("limits.low", -1)
    node.declare_parameter("fixed", "x", ParameterDescriptor(read_only=True))
    executor = rclpy.get_global_executor()
    executor.add_node(node)

    def ask(kind, name, **fields):
        client = other.create_client(kind, f"/a/{name}")
        assert client.wait_for_service(10.0)
        future = client.call_async(kind.Request(**fields))
        rclpy.spin_until_future_complete(other, future, timeout_sec=10.0)
        return future.result()

    listed = ask(ListParameters, "list_parameters", prefixes=["limits"]).result
    assert listed.names == ["limits.low"] and listed.prefixes == ["limits"]
    changes = [Parameter("limits.low", value=-2), Parameter("fixed", value="y"), Parameter("none", value=1)]
    results = ask(SetParameters, "set_parameters", parameters=[p.to_parameter_msg() for p in changes]).results
    assert [r.successful for r in results] == [True, False, False]
    assert "read-only" in results[1].reason and "not declared" in results[2].reason
    (value,) = ask(GetParameters, "get_parameters", names=["limits.low"]).values
    assert value.integer_value == -2 and not ask(GetParameters, "get_parameters", names=["none"]).values
    for _ in range(100):
        if any(event.changed_parameters for event in events):
            break
        rclpy.spin_once(other, timeout_sec=0.1)
    changed = [(event.node, p.name) for event in events for p in event.changed_parameters]
    assert changed == [("/a", "limits.low")]


def test_a_callback_can_refuse_what_is_set(node):
    """A callback can refuse a declaration, too."""
    node.add_on_set_parameters_callback(lambda ps: SetParametersResult(successful=False, reason="no"))
    with pytest.raises(InvalidParameterValueException, match="refused: no"):
        node.declare_parameter("a", 1)


# --- messages ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [1, "1.0", np.float32(1.0), None, True])
def test_a_float_field_takes_floats(value):
    with pytest.raises(AssertionError):
        Float64(data=value)


@pytest.mark.parametrize("value", [1.0, -1, 2**32, "1", np.int64(1)])
def test_an_integer_field_takes_its_range_of_int(value):
    with pytest.raises(AssertionError):
        Image(height=value)


@pytest.mark.parametrize(
    "value", [np.zeros(2), array.array("f", [1.0]), [1], (1.0, 2), b"ab", "ab", np.zeros((2, 2)), 1.0]
)
def test_a_sequence_of_floats_takes_lists_and_its_own_arrays(value):
    """NumPy arrays are refused as on Humble; a field of one message can be assigned to another."""
    with pytest.raises(AssertionError):
        JointState(position=value)
    first = JointState(position=array.array("d", [1.0, 2.0]))
    assert list(JointState(position=first.position).position) == [1.0, 2.0]
    assert type(first.position[0]) is float and first.position[:1].tolist() == [1.0]
    with pytest.raises(AssertionError):
        JointState(position=first.position * 2.0)


@pytest.mark.parametrize("value", [[0.0] * 35, np.zeros(37), np.zeros(36, np.float32), [0] * 36])
def test_an_array_of_a_length_takes_that_length_and_type(value):
    message = Odometry()
    with pytest.raises(AssertionError):
        message.pose.covariance = value
    message.pose.covariance = np.zeros(36)


def test_a_message_has_its_fields_only():
    with pytest.raises(AssertionError):
        String(text="a")
    with pytest.raises(AttributeError):
        String().text = "a"


# --- endpoints --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("qos", "error"),
    [(-1, ValueError), ("10", TypeError), (None, TypeError), (1.0, TypeError)],
)
def test_a_profile_or_a_depth_is_needed(node, qos, error):
    with pytest.raises(error):
        node.create_publisher(String, "word", qos)


def test_profiles_are_checked():
    """A profile needs a depth or a history, and policies of the right types; no others are accepted."""
    with pytest.raises(InvalidQoSProfileException):
        QoSProfile()
    for wrong in (
        {"depth": 1.0},
        {"depth": 1, "deadline": 1.0},
        {"depth": 1, "nonsense": 1},
        {"depth": 1, "lifespan": 1},
    ):
        with pytest.raises(AssertionError):
            QoSProfile(**wrong)
    assert QoSProfile(depth=1, lifespan=Duration(seconds=1)).reliability.name == "RELIABLE"


def test_callbacks_take_as_many_arguments_as_they_get(node):
    """A wrong signature is refused at creation, not at the first message."""
    with pytest.raises(RuntimeError, match="expected 1 arguments"):
        node.create_subscription(String, "word", lambda: None, 10)
    with pytest.raises(TypeError):
        node.create_subscription(String, "word", None, 10)
    node.create_subscription(String, "word", lambda message, more=None: None, 10)


def test_types_of_topics_are_message_classes(node):
    for wrong in (String(), "std_msgs/msg/String", Trigger):
        with pytest.raises(TypeError, match="no message type"):
            node.create_publisher(wrong, "word", 10)


def test_requests_are_of_their_service(node):
    client = node.create_client(Trigger, "go")
    with pytest.raises(TypeError, match="takes std_srvs/srv/Trigger_Request"):
        client.call_async(String())


@pytest.mark.parametrize("name", ["timers", "publishers", "subscriptions", "services", "clients", "context"])
def test_what_a_node_has_is_not_assigned_to(node, name):
    """Subclasses must not assign to attributes of a node."""
    with pytest.raises(AttributeError):
        setattr(node, name, [])


OF_RCLPY = (
    "_parameters _publishers _subscriptions _clients _services _timers _guards _descriptors _logger _clock _context "
    "_default_callback_group _rate_group _allow_undeclared_parameters _parameter_overrides _time_source "
    "_parameter_event_publisher _pre_set_parameters_callbacks _on_set_parameters_callbacks _parameter_service "
    "_post_set_parameters_callbacks _type_description_service timers publishers subscriptions services clients guards "
    "waitables executor context handle default_callback_group"
).split()
"""Attributes of rclpy's Node (node.py): a FinsSim attribute of the same name would break the node only there."""


@pytest.mark.parametrize("name", NODES)
def test_our_nodes_take_no_name_of_rclpys_node(name):
    """The nodes of FinsSim neither assign nor define these names."""
    module, _, cls = NODES[name].partition(":")
    tree = ast.parse(Path(importlib.util.find_spec(module).origin).read_text())
    shared = ast.parse(
        Path(importlib.util.find_spec("finssim.extensions.ros2.nodes.robot_node").origin).read_text()
    )
    for part in (tree, shared):
        for made in (c for c in part.body if isinstance(c, ast.ClassDef) and c.name in (cls, "RobotNode")):
            names = {
                n.attr
                for n in ast.walk(made)
                if isinstance(n, ast.Attribute) and isinstance(n.ctx, ast.Store)
            }
            names |= {f.name for f in made.body if isinstance(f, ast.FunctionDef)}
            assert names and not names & set(OF_RCLPY)


def test_timers_do_not_run_backwards(node):
    with pytest.raises(RuntimeError, match="expected zero or more"):
        node.create_timer(-1.0, lambda: None)


def test_what_was_destroyed_is_not_used(node):
    """Use after destruction is a RuntimeError and sends nothing."""
    publisher, other = node.create_publisher(String, "word", 10), Node("b")
    node.destroy_publisher(publisher)
    with pytest.raises(InvalidHandle, match="was destroyed"):
        publisher.publish(String())
    other.destroy_node()
    with pytest.raises(RuntimeError, match="was destroyed"):
        other.create_publisher(String, "word", 10)


def test_a_callback_does_not_spin(node):
    """A callback may spin neither its own executor nor for an answer."""
    found = []

    def callback():
        for spin in (lambda: rclpy.spin_once(node), lambda: rclpy.spin_until_future_complete(node, Future())):
            with pytest.raises(RuntimeError, match="already spinning") as error:
                spin()
            found.append(error)

    node.create_timer(0.0, callback)
    rclpy.spin_once(node, timeout_sec=10.0)
    assert len(found) == 2
    rclpy.spin_once(node, timeout_sec=10.0)
    assert len(found) == 4, "and goes on afterwards"


def test_a_log_line_is_a_str(node):
    for message in (1, ValueError("a"), None):
        with pytest.raises(TypeError, match="give a str"):
            node.get_logger().info(message)
    with pytest.raises(ValueError, match="no name"):
        node.get_logger().get_child("")


@pytest.mark.parametrize(
    ("make", "error"),
    [
        (lambda: Time(seconds=-1), ValueError),
        (lambda: Time(seconds=1, nanoseconds=-1), ValueError),
        (lambda: Time(nanoseconds=2**63), OverflowError),
        (lambda: Time(clock_type=1), TypeError),
        (lambda: Duration(seconds=1e10), OverflowError),
        (lambda: Time() - Duration(seconds=1), ValueError),
    ],
)
def test_times_and_durations_fit_their_64_bits(make, error):
    with pytest.raises(error):
        make()


@pytest.mark.parametrize("namespace", ["a/", "/a/", "//a", "a//b", "1a", "a b", "a" * 250])
def test_namespaces_are_names_between_slashes(node, namespace):
    with pytest.raises(Exception, match="use names of letters") as error:
        Node("b", namespace=namespace)
    assert type(error.value).__name__ == "InvalidNamespaceException"


def test_names_of_topics_have_a_longest_length(node):
    with pytest.raises(Exception, match="longer than 247") as error:
        node.create_publisher(String, "a" * 247, 10)
    assert type(error.value).__name__ == "InvalidTopicNameException"


def test_init_refuses_bad_arguments():
    """The error is a RuntimeError, like rclpy's."""
    with pytest.raises(RuntimeError, match="NAME:=VALUE"):
        rclpy.init(args=["--ros-args", "-p", "gain"])
