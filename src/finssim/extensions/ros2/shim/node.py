"""`rclpy.node`: nodes with names, endpoints, clock and parameters."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

from finssim.extensions.ros2.codec import codec_of
from finssim.extensions.ros2.limits import Limited
from finssim.extensions.ros2.shim.arguments import (
    check_node,
    full_node_name,
    overrides_for,
    parse_arguments,
    remapped,
)
from finssim.extensions.ros2.shim.context import Context, get_default_context
from finssim.extensions.ros2.shim.endpoint import (
    Client,
    Endpoint,
    Publisher,
    Service,
    Subscription,
    SubscriptionEventCallbacks,
)
from finssim.extensions.ros2.shim.exceptions import InvalidHandle
from finssim.extensions.ros2.shim.exceptions import NodeNameNonExistentError as NodeNameNonExistentError
from finssim.extensions.ros2.shim.executors import Timer
from finssim.extensions.ros2.shim.graph import NodeGraph
from finssim.extensions.ros2.shim.logging import RcutilsLogger, get_logger
from finssim.extensions.ros2.shim.parameter import NodeParameters, Parameter, ParameterService
from finssim.extensions.ros2.shim.qos import (
    QoSProfile,
    ReliabilityPolicy,
    qos_profile_parameter_events,
    qos_profile_services_default,
)
from finssim.extensions.ros2.shim.time import Clock, ROSClock, Time
from finssim.extensions.ros2.wire import NodeRecord

# Simulated time: the topic /clock drives a node's clock if its parameter `use_sim_time` is true.


class TimeSource:
    """Time source that declares `use_sim_time` on a node and sets its clock."""

    def __init__(self, node: Any, clock: ROSClock) -> None:
        self._node, self._clock, self._subscription = node, clock, None
        if not node.has_parameter("use_sim_time"):
            node.declare_parameter("use_sim_time", False)
        self.use_simulated(bool(node.get_parameter("use_sim_time").value))

    def use_simulated(self, simulated: bool) -> None:
        """Follow /clock, or the system time."""
        if simulated == self._clock.ros_time_is_active:
            return
        self._clock.ros_time_is_active = simulated
        for timer in self._node.timers:
            if timer.clock is self._clock and not timer.is_canceled():
                timer.reset()
        if simulated:
            newest = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
            clock = codec_of().message("rosgraph_msgs/msg/Clock")
            self._subscription = self._node.create_subscription(clock, "/clock", self._on_clock, newest)
        elif self._subscription is not None:
            self._node.destroy_subscription(self._subscription)

    def _on_clock(self, message: Any) -> None:
        self._clock.set_ros_time_override(Time.from_msg(message.clock))


# Node.


Made = TypeVar("Made", bound=Endpoint)


class Node(NodeParameters, NodeGraph, Limited):
    """Node.

    Args:
        node_name: Name, unless the command line renames it.
        context: Context; None: that of `rclpy.init()`.
        cli_args: Arguments for this node alone, with `--ros-args`.
        namespace: Namespace of relative names.
        use_global_arguments: True if the process's command line applies too.
        parameter_overrides: Values that override files and command line.
        start_parameter_services: True to offer the services that `ros2 param` uses.
        **services: `enable_rosout` and `enable_logger_service` are accepted but have no effect.
    """

    def __init__(
        self,
        node_name: str,
        *,
        context: Context | None = None,
        cli_args: Sequence[str] | None = None,
        namespace: str | None = None,
        use_global_arguments: bool = True,
        parameter_overrides: Sequence[Parameter] | None = None,
        start_parameter_services: bool = True,
        **services: bool,
    ) -> None:
        unknown = set(services) - {"enable_rosout", "enable_logger_service"}
        if unknown:
            raise TypeError(f"Node: '{min(unknown)}' is no argument, or needs a sourced ROS 2: omit it")
        self._context = context or get_default_context()
        local_arguments = parse_arguments(cli_args or ())
        sources = [self.context.arguments, local_arguments] if use_global_arguments else [local_arguments]
        self._rules = [rule for source in reversed(sources) for rule in source.remaps]
        self._name, self._namespace = self._named(node_name, namespace or "")
        self._logger = get_logger(self.get_fully_qualified_name().strip("/").replace("/", "."))
        self.context.participant.codec  # noqa: B018 - raises if the context is not initialized, before anything else
        self._timers: list[Timer] = []
        self._ends: list[Any] = []
        overrides: dict[str, Any] = {}
        for source in sources:
            overrides |= overrides_for(self.get_fully_qualified_name(), source.parameters)
        overrides |= {p.name: p.value for p in parameter_overrides or ()}
        NodeParameters.__init__(self, overrides)
        self._clock = ROSClock()
        self.context.nodes.append(self)
        event = self.context.participant.codec.message("rcl_interfaces/msg/ParameterEvent")
        self._parameter_events = self.create_publisher(
            event, "/parameter_events", qos_profile_parameter_events
        )
        self._time_source: TimeSource | None = None
        self._time_source = TimeSource(self, self._clock)
        if start_parameter_services:
            ParameterService(self)

    @property
    def context(self) -> Context:
        """Return its context."""
        return self._context

    @property
    def timers(self) -> Iterator[Timer]:
        """Yield its timers; this property and those below are read-only."""
        yield from self._timers

    @property
    def publishers(self) -> Iterator[Publisher]:
        """Yield its publishers."""
        yield from (end for end in self._ends if isinstance(end, Publisher))

    @property
    def subscriptions(self) -> Iterator[Subscription]:
        """Yield its subscriptions."""
        yield from (end for end in self._ends if isinstance(end, Subscription))

    @property
    def services(self) -> Iterator[Service]:
        """Yield its services."""
        yield from (end for end in self._ends if isinstance(end, Service))

    @property
    def clients(self) -> Iterator[Client]:
        """Yield its clients."""
        yield from (end for end in self._ends if isinstance(end, Client))

    def get_name(self) -> str:
        """Return its name."""
        return self._name

    def get_namespace(self) -> str:
        """Return its namespace, with a leading slash."""
        return self._namespace

    def get_fully_qualified_name(self) -> str:
        """Return namespace and name."""
        return full_node_name(self._name, self._namespace)

    def get_logger(self) -> RcutilsLogger:
        """Return its logger, named by namespace and name with dots."""
        return self._logger

    def get_clock(self) -> ROSClock:
        """Return its clock: system time, or that of /clock if the parameter `use_sim_time` is true."""
        return self._clock

    def resolve_topic_name(self, topic: str, *, only_expand: bool = False) -> str:
        """Return the full name of a topic, remapped unless `only_expand`."""
        return remapped(topic, self._name, self._namespace, () if only_expand else self._rules)

    resolve_service_name = resolve_topic_name

    def create_publisher(self, msg_type: Any, topic: str, qos_profile: Any, **options: Any) -> Publisher:
        """Create a publisher; `qos_profile` is a `QoSProfile` or a depth."""
        _check_options(options)
        return self._added(Publisher(self, msg_type, topic, qos_profile))

    def create_subscription(
        self,
        msg_type: Any,
        topic: str,
        callback: Callable[[Any], None],
        qos_profile: Any,
        *,
        raw: bool = False,
        event_callbacks: SubscriptionEventCallbacks | None = None,
        **options: Any,
    ) -> Subscription:
        """Create a subscription; with `raw` the callback gets CDR bytes."""
        _check_options(options)
        return self._added(Subscription(self, msg_type, topic, callback, qos_profile, raw, event_callbacks))

    def create_service(
        self,
        srv_type: Any,
        srv_name: str,
        callback: Callable[[Any, Any], Any],
        *,
        qos_profile: Any = qos_profile_services_default,
        **options: Any,
    ) -> Service:
        """Create a service; the callback fills in and returns the response object that it gets."""
        _check_options(options)
        return self._added(Service(self, srv_type, srv_name, callback, qos_profile))

    def create_client(
        self, srv_type: Any, srv_name: str, *, qos_profile: Any = qos_profile_services_default, **options: Any
    ) -> Client:
        """Create a client of a service."""
        _check_options(options)
        return self._added(Client(self, srv_type, srv_name, qos_profile))

    def create_timer(
        self,
        timer_period_sec: float,
        callback: Callable[[], Any],
        callback_group: Any = None,
        clock: Clock | None = None,
        autostart: bool = True,
    ) -> Timer:
        """Create a timer with a period [s] of the node's clock, or of another."""
        timer = Timer(callback, int(timer_period_sec * 1e9), clock or self._clock, autostart=autostart)
        self._timers.append(timer)
        self.context.wake()
        return timer

    def destroy_timer(self, timer: Timer) -> bool:
        """Destroy a timer; return whether it was the node's."""
        present = timer in self._timers
        timer.cancel()
        self._timers = [t for t in self._timers if t is not timer]
        return present

    def destroy_publisher(self, publisher: Publisher) -> bool:
        """Destroy a publisher; return whether it was the node's."""
        return self._removed(publisher)

    def destroy_subscription(self, subscription: Subscription) -> bool:
        """Destroy a subscription; return whether it was the node's."""
        return self._removed(subscription)

    def destroy_service(self, service: Service) -> bool:
        """Destroy a service; return whether it was the node's."""
        return self._removed(service)

    def destroy_client(self, client: Client) -> bool:
        """Destroy a client; return whether it was the node's."""
        return self._removed(client)

    def destroy_node(self) -> None:
        """Destroy the node with its timers and endpoints."""
        for timer in self._timers:
            timer.cancel()
        self._timers = []
        if self in self.context.nodes:
            self.context.nodes.remove(self)
            ends, self._ends = self._ends, []
            for end in ends:
                end.close()
            self.context.announce()

    def endpoints(self) -> list[Any]:
        """Return publishers, subscriptions, services and clients."""
        return list(self._ends)

    def takers(self) -> Iterator[Any]:
        """Yield the endpoints that may have work."""
        return (end for end in list(self._ends) if not isinstance(end, Publisher))

    def record(self) -> NodeRecord:
        """Return the node's entry in the node list."""
        wires = [wire for end in self._ends for wire in end.wires]
        return NodeRecord(
            self._name,
            self._namespace,
            readers=[wire.gid for wire in wires if hasattr(wire, "take")],
            writers=[wire.gid for wire in wires if hasattr(wire, "write")],
        )

    def _named(self, name: str, namespace: str) -> tuple[str, str]:
        """Return name and namespace after the remapping rules `__node` and `__ns`, checked."""
        rules = [rule for rule in self._rules if rule.node in ("", name)]
        namespace = next((r.target for r in rules if r.source == "__ns"), namespace)
        name = next((r.target for r in rules if r.source in ("__node", "__name")), name)
        return name, check_node(name, namespace)

    def _added(self, end: Made) -> Made:
        if self not in self.context.nodes:
            end.close()
            raise InvalidHandle(f"node {self._name} was destroyed: make another")
        self._ends.append(end)
        self.context.announce()
        return end

    def _removed(self, end: Endpoint) -> bool:
        if end not in self._ends:
            return False
        self._ends.remove(end)
        end.close()
        self.context.announce()
        return True

    def _parameters_changed(
        self, new: list[Parameter], changed: list[Parameter], removed: list[Parameter]
    ) -> None:
        """Publish on /parameter_events, and follow `use_sim_time`."""
        for parameter in (*new, *changed):
            if parameter.name == "use_sim_time" and self._time_source is not None:
                self._time_source.use_simulated(bool(parameter.value))
        self._parameter_events.publish(
            self._parameter_events.msg_type(
                stamp=self._clock.now().to_msg(),
                node=self.get_fully_qualified_name(),
                new_parameters=[p.to_parameter_msg() for p in new],
                changed_parameters=[p.to_parameter_msg() for p in changed],
                deleted_parameters=[p.to_parameter_msg() for p in removed],
            )
        )


def _check_options(options: dict[str, Any]) -> None:
    """Refuse options that would be ignored; callback groups are satisfied in any case."""
    unknown = set(options) - {"callback_group"}
    if unknown:
        raise TypeError(f"'{min(unknown)}' needs a sourced ROS 2: omit it")
