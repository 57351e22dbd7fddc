# ruff: noqa: E402 - rclpy can be imported once a backend is active
"""The built-in rclpy behaves like the real one in every respect that node code can observe."""

import os
import subprocess
import sys
import threading
import time

import pytest

from finssim.extensions.ros2.backend import activate

activate(announce=False)

import rclpy
from builtin_interfaces.msg import Time as TimeMessage
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor, SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.exceptions import (
    InvalidParameterTypeException,
    InvalidParameterValueException,
    NameValidationException,
    NotInitializedException,
    ParameterAlreadyDeclaredException,
    ParameterNotDeclaredException,
    ParameterUninitializedException,
)
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.time import Time
from rclpy.timer import Timer
from rosgraph_msgs.msg import Clock as ClockMessage
from std_msgs.msg import Float64, String
from std_srvs.srv import Trigger

PATIENCE = 10.0


@pytest.fixture
def context():
    """Context on the wire for one test."""
    rclpy.init(args=[])
    yield rclpy.get_default_context()
    rclpy.try_shutdown()


def until(node, condition, each=lambda: None):
    """Spin until a condition is true; return whether it became true in time."""
    end = time.monotonic() + PATIENCE
    while not condition() and time.monotonic() < end:
        each()
        rclpy.spin_once(node, timeout_sec=0.05)
    return condition()


def test_nodes_need_init():
    """A node without init is refused as in rclpy."""
    with pytest.raises(NotInitializedException, match=r"rclpy.init\(\)"):
        Node("early")


def test_init_works_again_after_shutdown():
    """Test suites and notebooks call init again."""
    for name in ("first", "second"):
        rclpy.init(args=[])
        with pytest.raises(RuntimeError, match="only be called once"):
            rclpy.init(args=[])
        assert rclpy.ok() and Node(name).get_name() == name
        rclpy.shutdown()
        assert not rclpy.ok()


class Hand(Clock):
    """Clock with a time set by the test [ns]."""

    shown = 0

    def tick(self):
        return self.shown


def test_timers_keep_their_rhythm():
    """A slow callback omits the calls it overlaps, and no burst follows."""
    clock, calls = Hand(), []
    timer = Timer(lambda: calls.append(clock.shown), 50, clock)
    for clock.shown in range(0, 400, 10):
        if 60 <= clock.shown < 170:  # duration of the first callback
            continue
        work = timer.take()
        if work is not None:
            work()
    assert calls == [50, 170, 200, 250, 300, 350]


def test_a_cancelled_timer_rests_until_reset(context):
    """`cancel` stops a timer and `reset` restarts it."""
    node, calls = Node("a"), []
    timer = node.create_timer(0.01, lambda: calls.append(1))
    timer.cancel()
    rclpy.spin_once(node, timeout_sec=0.05)
    assert timer.is_canceled() and not calls
    timer.reset()
    assert until(node, lambda: bool(calls))


def test_spin_once_runs_one_callback(context):
    """When two timers are due, one runs."""
    node, calls = Node("a"), []
    for name in "ab":
        node.create_timer(0.01, lambda name=name: calls.append(name))
    time.sleep(0.03)
    rclpy.spin_once(node)
    assert len(calls) == 1
    rclpy.spin_once(node)
    assert sorted(calls) == ["a", "b"]


def test_an_exception_in_a_callback_leaves_spin(context):
    """The exception reaches the caller of spin."""
    node = Node("a")
    node.create_timer(0.0, lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        rclpy.spin_once(node)


def test_only_nodes_that_are_spun_run(context):
    """The other node's message waits."""
    spun, idle = Node("spun"), Node("idle")
    got, kept = [], []
    spun.create_subscription(String, "/word", got.append, 10)
    idle.create_subscription(String, "/word", kept.append, 10)
    publisher = spun.create_publisher(String, "/word", 10)
    assert until(spun, lambda: publisher.get_subscription_count() == 2)
    publisher.publish(String(data="x"))
    assert until(spun, lambda: bool(got)) and not kept
    rclpy.spin_once(idle, timeout_sec=PATIENCE)
    assert kept == got


def test_an_executor_runs_several_nodes(context):
    """They run until the executor is shut down from a callback."""
    executor, seen = SingleThreadedExecutor(), set()
    for name in ("a", "b"):
        node = Node(name)
        node.create_timer(0.01, lambda name=name: seen.add(name) or (len(seen) == 2 and executor.shutdown()))
        executor.add_node(node)
    executor.spin()
    assert seen == {"a", "b"}


def test_a_clock_on_the_wire_drives_timers(context):
    """With use_sim_time a timer waits until /clock has advanced by its period, regardless of real time."""
    node = Node("a", parameter_overrides=[Parameter("use_sim_time", value=True)])
    source, calls = node.create_publisher(ClockMessage, "/clock", 10), []
    node.create_timer(1.0, lambda: calls.append(node.get_clock().now().nanoseconds))
    assert node.get_clock().now().nanoseconds == 0

    def at(seconds):
        stamp = TimeMessage(sec=int(seconds), nanosec=int(seconds % 1 * 1e9))
        return lambda: source.publish(ClockMessage(clock=stamp))

    assert until(node, lambda: node.get_clock().now().nanoseconds == 900_000_000, each=at(0.9))
    assert not calls
    assert until(node, lambda: len(calls) == 1, each=at(1.0)) and calls == [1_000_000_000]
    assert until(node, lambda: len(calls) == 2, each=at(7.5)), "missed calls are left out"
    assert until(node, lambda: node.get_clock().now().nanoseconds == 10**8, each=at(0.1)), "a reset"
    assert until(node, lambda: len(calls) == 3, each=at(1.25)), "the rhythm begins anew after time went back"


def test_policies_that_do_not_fit_are_told(context, capfd, monkeypatch):
    """A best-effort publisher sends nothing to a reliable subscription, and both ends log it once."""
    monkeypatch.setattr("finssim.extensions.ros2.shim.executors.MISMATCH_PERIOD", 0.05)
    node = Node("a")
    node.create_subscription(String, "word", print, 10)
    node.create_publisher(String, "word", qos_profile_sensor_data)
    text = []
    assert until(node, lambda: text.append(capfd.readouterr().err) or "".join(text).count("RELIABILITY") >= 2)
    for _ in range(10):
        rclpy.spin_once(node, timeout_sec=0.03)
    assert "incompatible QoS" in "".join(text) and "RELIABILITY" not in capfd.readouterr().err


def test_a_volatile_publisher_does_not_serve_a_latched_subscription(context, capfd):
    """An incompatible durability is logged too."""
    node = Node("a")
    node.create_subscription(
        String, "word", print, QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    )
    node.create_publisher(String, "word", 1)
    text = []
    assert until(node, lambda: text.append(capfd.readouterr().err) or "DURABILITY" in "".join(text))


def test_a_publisher_takes_its_own_type_only(context):
    """A wrong message never reaches the wire."""
    publisher = Node("a").create_publisher(String, "word", 10)
    with pytest.raises(TypeError, match="/word carries std_msgs/msg/String, found Float64"):
        publisher.publish(Float64())


def test_ready_bytes_can_be_published_and_received(context):
    """Recorders and players use serialised messages."""
    from rclpy.serialization import deserialize_message, serialize_message

    node, got = Node("a"), []
    node.create_subscription(String, "word", got.append, 10, raw=True)
    publisher = node.create_publisher(String, "word", 10)
    assert until(node, lambda: bool(got), each=lambda: publisher.publish(serialize_message(String(data="x"))))
    assert deserialize_message(got[0], String).data == "x"


def test_destroyed_things_are_gone(context):
    """A destroyed subscription receives nothing, and a destroyed node is no longer listed."""
    node, other, got = Node("a"), Node("b"), []
    subscription = node.create_subscription(String, "word", got.append, 10)
    publisher = node.create_publisher(String, "word", 10)
    assert until(node, lambda: bool(got), each=lambda: publisher.publish(String()))
    assert node.destroy_subscription(subscription) and not node.destroy_subscription(subscription)
    count = len(got)
    publisher.publish(String())
    rclpy.spin_once(node, timeout_sec=0.1)
    assert len(got) == count and publisher.get_subscription_count() == 0
    other.destroy_node()
    assert until(node, lambda: node.get_node_names() == ["a"])


def test_parameters_are_declared_once_and_before_use(context):
    """A second declaration and an undeclared use are refused as in rclpy."""
    node = Node("a")
    assert node.declare_parameter("gain", 2.0).value == 2.0
    with pytest.raises(ParameterAlreadyDeclaredException):
        node.declare_parameter("gain", 1.0)
    with pytest.raises(ParameterNotDeclaredException):
        node.get_parameter("other")
    assert node.get_parameter_or("other", Parameter("other", value=3)).value == 3
    with pytest.raises(TypeError, match="needs a sourced ROS 2"):
        Node("b", allow_undeclared_parameters=True)


def test_values_from_outside_keep_the_type(context):
    """2 is not accepted for 2.0: the error comes at the start, as in ROS 2."""
    node = Node("a", cli_args="--ros-args -p gain:=2 -p name:=x".split())
    assert node.declare_parameter("name", "y").value == "x"
    with pytest.raises(InvalidParameterTypeException, match="gain.*DOUBLE.*such as 1.0"):
        node.declare_parameter("gain", 1.0)


def test_a_parameter_without_default_must_be_given(context):
    """Such a parameter is declared by its type only."""
    given = Node("a", cli_args="--ros-args -p file:=x".split())
    assert given.declare_parameter("file", Parameter.Type.STRING).value == "x"
    missing = Node("b")
    missing.declare_parameter("file", Parameter.Type.STRING)
    with pytest.raises(ParameterUninitializedException, match="has no value"):
        missing.get_parameter("file")


def test_setting_parameters_is_checked(context):
    """Type, range, read-only and the node's own callback are checked; an atomic set applies all values or
    none."""
    node = Node("a")
    limits = ParameterDescriptor(floating_point_range=[FloatingPointRange(from_value=0.0, to_value=2.0)])
    node.declare_parameter("gain", 1.0, limits)
    node.declare_parameter("fixed", 1, ParameterDescriptor(read_only=True))
    node.declare_parameter("word", "a")
    node.add_on_set_parameters_callback(
        lambda ps: SetParametersResult(successful=all(p.value != "bad" for p in ps), reason="a bad word")
    )
    refused = [("gain", 3.0), ("gain", "x"), ("fixed", 2), ("word", "bad")]
    results = node.set_parameters([Parameter(n, value=v) for n, v in refused])
    assert not any(r.successful for r in results) and all(r.reason for r in results)
    both = [Parameter("word", value="b"), Parameter("gain", value=5.0)]
    assert not node.set_parameters_atomically(both).successful and node.get_parameter("word").value == "a"
    assert node.set_parameters([Parameter("gain", value=1.5)])[0].successful
    assert node.get_parameter("gain").value == 1.5
    with pytest.raises(InvalidParameterValueException):
        node.declare_parameter("another", "bad")


def test_names_are_joined_and_renamed(context):
    """Names are resolved with namespaces, private names and rules for one node."""
    node = Node("a", namespace="ns", cli_args="--ros-args -r odom:=/z -r __ns:=/other".split())
    assert node.get_fully_qualified_name() == "/other/a"
    assert node.resolve_topic_name("odom") == "/z" and node.resolve_topic_name("~/x") == "/other/a/x"


@pytest.mark.parametrize(("name", "namespace"), [("1a", ""), ("a b", ""), ("a", "b c")])
def test_bad_node_names_are_refused(context, name, namespace):
    """The refusal comes before the name is published."""
    with pytest.raises(NameValidationException, match="letters, digits"):
        Node(name, namespace=namespace)


def test_log_lines_look_like_those_of_ros(context, capfd):
    """Lines contain level, time and name; levels, once and throttling work."""
    logger = Node("a", namespace="ns").get_logger()
    logger.debug("hidden")
    for _ in range(3):
        logger.info("shown", once=True)
        logger.warning("slow", throttle_duration_sec=60.0)
        logger.error("second", skip_first=True)
    text = capfd.readouterr().err
    assert "hidden" not in text and text.count("shown") == 1 and text.count("slow") == 1
    assert text.count("second") == 2 and "[WARN] [" in text and "[ns.a]: slow" in text
    logger.set_level(10)
    logger.debug("seen")
    assert "seen" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("calls", "sentence"),
    [
        ([{"severity": 20}, {"severity": 30}], "Logger severity cannot be changed between calls."),
        (
            [{"severity": 20}, {"severity": 20, "once": True}],
            "Requested logging filters cannot be changed between calls.",
        ),
        (
            [{"severity": 20, "throttle_duration_sec": x} for x in (1.0, 2.0)],
            "Logging filter parameters cannot be changed between calls.",
        ),
    ],
)
def test_a_call_that_logs_keeps_its_severity_and_its_conditions(context, calls, sentence):
    """The error has the exact text of rclpy's rcutils_logger; a hidden line counts as well."""
    logger = Node("hidden").get_logger()
    logger.set_level(50)
    with pytest.raises(ValueError) as refused:
        for call in calls:
            logger.log("text", **call)
    assert str(refused.value) == sentence


def test_two_calls_on_one_line_are_two(context, capfd):
    logger = Node("a").get_logger()
    for _ in range(2):
        logger.info("left"), logger.warning("right", once=True)
    assert capfd.readouterr().err.count("left") == 2


def test_times_add_up():
    """Arithmetic, comparison and conversion to messages are exact."""
    time_ = Time(seconds=1, nanoseconds=5) + Duration(seconds=0.5)
    assert time_.seconds_nanoseconds() == (1, 500_000_005)
    assert time_ - Time(seconds=1) == Duration(nanoseconds=500_000_005)
    assert Time.from_msg(time_.to_msg(), ClockType.SYSTEM_TIME) == time_
    with pytest.raises(TypeError, match="one clock"):
        Time.from_msg(time_.to_msg()) < time_  # noqa: B015


def test_another_thread_can_publish_and_wake(context):
    """A message from a thread reaches the thread that spins forever."""
    node, got = Node("a"), []
    node.create_subscription(String, "word", got.append, 10)
    publisher = node.create_publisher(String, "word", 10)
    thread = threading.Thread(target=lambda: (time.sleep(0.2), publisher.publish(String(data="x"))))
    thread.start()
    while not got:
        rclpy.spin_once(node)
    thread.join()
    assert got[0].data == "x"


@pytest.mark.parametrize(
    "module",
    [
        "rclpy.action",
        "rclpy.lifecycle",
        "rclpy.nonsense",
        "message_filters",
        "cv_bridge",
        "tf2_ros.buffer_client",
    ],
)
def test_what_is_missing_says_what_it_needs(module):
    """The error is one clear sentence."""
    with pytest.raises(ImportError, match="needs a sourced ROS 2"):
        __import__(module)


def test_several_threads_of_callbacks_need_ros():
    """The name exists in rclpy, so the refusal contains it."""
    with pytest.raises(ImportError, match="use SingleThreadedExecutor"):
        from rclpy.executors import MultiThreadedExecutor  # noqa: F401


LACKING = [
    (lambda node: node, "create_rate", "Node.create_rate needs a sourced ROS 2: use create_timer"),
    (lambda node: node, "get_parameters_by_prefix", "use list_parameters"),
    (lambda node: node.create_client(Trigger, "go"), "call", "Client.call needs .*: use call_async"),
    (lambda node: node.create_publisher(String, "a", 1), "wait_for_all_acked", "let the other side answer"),
    (lambda node: node.create_timer(1.0, print), "time_since_last_call", "take the time in the callback"),
    (lambda node: node.context, "on_shutdown", "in a finally clause"),
    (lambda node: node.get_clock(), "sleep_until", "Clock.sleep_until .*: use create_timer"),
    (lambda node: SingleThreadedExecutor(), "create_task", "use a timer"),
]


def test_what_a_class_lacks_says_what_to_do(context):
    """The error is a sentence for attributes of rclpy; `getattr` with a default still returns the default."""
    node = Node("a")
    for made, name, hint in LACKING:
        thing = made(node)
        with pytest.raises(AttributeError, match=hint):
            getattr(thing, name)
        assert getattr(thing, name, None) is None


def test_a_misspelt_name_is_none_of_rclpy(context):
    """The error is Python's usual message."""

    class Mine(Node):
        """Custom node."""

    with pytest.raises(AttributeError, match="'Mine' object has no attribute 'create_publishr'"):
        Mine("a").create_publishr  # noqa: B018


@pytest.mark.parametrize(
    ("module", "name", "hint"),
    [
        ("rclpy", "get_rmw_implementation_identifier", "rmw_cyclonedds_cpp"),
        ("rclpy.timer", "Rate", "use Node.create_timer"),
        ("rclpy.event_handler", "PublisherEventCallbacks", "leave event_callbacks out"),
        ("rclpy.node", "HIDDEN_NODE_PREFIX", "built-in rclpy has no such name"),
        ("tf2_ros", "BufferClient", "use Buffer and TransformListener"),
    ],
)
def test_what_a_module_lacks_says_what_to_do(module, name, hint):
    """The hint appears with `from module import name`."""
    with pytest.raises(ImportError, match=f"{name} needs a sourced ROS 2: .*{hint}"):
        exec(f"from {module} import {name}")


def test_parts_of_rclpy_come_with_it():
    """`import rclpy` alone provides its submodules, as in the real one."""
    assert rclpy.duration.Duration is Duration and rclpy.qos.QoSProfile is QoSProfile
    assert rclpy.time.Time is Time and rclpy.utilities.remove_ros_args(["a"]) == ["a"]


def test_every_name_that_is_refused_is_one_the_class_lacks():
    """The list is maintained by hand."""
    import tf2_ros  # noqa: F401 - its classes are among them

    from finssim.extensions.ros2.limits import MISSING, Limited

    classes = {kind.__name__: kind for kind in _below(Limited)}
    for name, lacking in MISSING.items():
        assert not [word for word in lacking if hasattr(classes[name], word)], name


def _below(kind):
    for one in kind.__subclasses__():
        yield from (one, *_below(one))


def test_coroutines_need_ros(context):
    """Coroutines would silently never run."""

    async def callback(message):
        raise AssertionError

    with pytest.raises(TypeError, match="needs a sourced ROS 2"):
        Node("a").create_subscription(String, "word", callback, 10)


# --- choice between the real rclpy and the built-in one ---------------------------------------------------------------

ACTIVATE = "from finssim.extensions.ros2.backend import activate; "
SCRIPT = ACTIVATE + "b = activate(); import rclpy; print(b.name, rclpy.__name__)"


def chosen(tmp_path, text, **environ):
    """Return the choice of a fresh process that finds a package `rclpy` with this text."""
    if text is not None:
        package = tmp_path / "rclpy"
        package.mkdir()
        (package / "__init__.py").write_text(text)
        (package / "node.py").write_text("")
    variables = {k: v for k, v in os.environ.items() if k != "PLATFORM_ROS"}
    variables |= {"PYTHONPATH": str(tmp_path), **environ}
    return subprocess.run([sys.executable, "-c", SCRIPT], env=variables, capture_output=True, text=True)


@pytest.mark.slow
def test_a_real_rclpy_is_never_shadowed(tmp_path):
    """A real rclpy that can be imported is used."""
    run = chosen(tmp_path, "")
    assert run.stdout.split() == ["native", "rclpy"] and "it can be imported" in run.stderr


@pytest.mark.slow
def test_a_half_sourced_ros_is_found_out_by_importing(tmp_path):
    """rclpy exists but its dependency does not: the built-in one is used, and the reason is reported."""
    run = chosen(tmp_path, "import a_module_that_ros_needs\n")
    assert (
        run.stdout.split() == ["dds", "finssim.extensions.ros2.shim"]
        and "a_module_that_ros_needs" in run.stderr
    )


@pytest.mark.slow
def test_ours_can_be_asked_for(tmp_path):
    """PLATFORM_ROS=dds selects the built-in rclpy even beside a real one."""
    run = chosen(tmp_path, "", PLATFORM_ROS="dds", ROS_DOMAIN_ID="7")
    assert run.stdout.split()[0] == "dds" and "domain 7, sends on the loopback alone" in run.stderr


@pytest.mark.slow
def test_the_real_one_can_be_insisted_on(tmp_path):
    """PLATFORM_ROS=native without a real rclpy is an error."""
    run = chosen(tmp_path, None, PLATFORM_ROS="native")
    assert run.returncode and "source a ROS 2 first" in run.stderr


@pytest.mark.slow
def test_without_cyclone_the_sentence_says_what_to_install():
    """The machine has neither ROS 2 nor Cyclone's wheel."""
    script = "import sys; sys.modules['cyclonedds'] = None; " + ACTIVATE + "activate()"
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert run.returncode and "source a ROS 2, or install finssim[ros2]" in run.stderr
