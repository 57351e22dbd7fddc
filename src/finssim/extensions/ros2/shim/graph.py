"""`rclpy.topic_endpoint_info`, `rclpy.type_hash`, and the graph queries of a node."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from finssim.extensions.ros2.shim.arguments import expanded
from finssim.extensions.ros2.shim.exceptions import NodeNameNonExistentError
from finssim.extensions.ros2.shim.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessPolicy,
    QoSProfile,
    ReliabilityPolicy,
)
from finssim.extensions.ros2.shim.time import Duration
from finssim.extensions.ros2.wire import EndpointRecord, NodeRecord, ros_type_name

UNKNOWN_NODE, UNKNOWN_NAMESPACE = "_NODE_NAME_UNKNOWN_", "_NODE_NAMESPACE_UNKNOWN_"
"""Names, as in rmw, for the node of an endpoint that is in no node list."""


@dataclass(frozen=True)
class TypeHash:
    """Hash of a type's definition."""

    version: int = -1
    """1 for RIHS01, -1 if the endpoint announces none."""
    value: bytes = bytes(32)

    def __str__(self) -> str:
        return f"RIHS{self.version:02d}_{self.value.hex()}" if self.version > 0 else "INVALID"


class TopicEndpointTypeEnum(IntEnum):
    """Direction of an endpoint."""

    INVALID = 0
    PUBLISHER = 1
    SUBSCRIPTION = 2


@dataclass(frozen=True)
class TopicEndpointInfo:
    """One publisher or subscription of a topic."""

    node_name: str
    node_namespace: str
    topic_type: str
    topic_type_hash: TypeHash
    endpoint_type: TopicEndpointTypeEnum
    endpoint_gid: list[int]
    qos_profile: QoSProfile


Named = list[tuple[str, list[str]]]
"""Names of topics or services, each with its types."""

KINDS = {
    TopicEndpointTypeEnum.PUBLISHER: "publications",
    TopicEndpointTypeEnum.SUBSCRIPTION: "subscriptions",
}


class NodeGraph:
    """Part of `Node` with the graph queries."""

    context: Any
    _name: str
    _namespace: str
    resolve_topic_name: Callable[..., str]

    def get_node_names_and_namespaces(self) -> list[tuple[str, str]]:
        """Return every node on the network, including this one."""
        return sorted((node.name, node.namespace) for node in self.context.participant.nodes())

    def get_node_names(self) -> list[str]:
        """Return the names of all nodes on the network."""
        return [name for name, _ in self.get_node_names_and_namespaces()]

    def count_publishers(self, topic_name: str) -> int:
        """Count the known publishers of a topic."""
        return self._count("publications", "rt", topic_name)

    def count_subscribers(self, topic_name: str) -> int:
        """Count the known subscriptions of a topic."""
        return self._count("subscriptions", "rt", topic_name)

    def count_services(self, service_name: str) -> int:
        """Count the known servers of a service."""
        return self._count("subscriptions", "rq", service_name, "Request")

    def count_clients(self, service_name: str) -> int:
        """Count the known clients of a service."""
        return self._count("publications", "rq", service_name, "Request")

    def get_topic_names_and_types(self, no_demangle: bool = False) -> Named:
        """Return every topic on the network with its types; with `no_demangle` under their DDS names."""
        return _named(self._every("publications", "subscriptions"), no_demangle)

    def get_service_names_and_types(self) -> Named:
        """Return every service on the network with its types."""
        return _services(self._every("subscriptions"))

    def get_publishers_info_by_topic(
        self, topic_name: str, no_mangle: bool = False
    ) -> list[TopicEndpointInfo]:
        """Return node, type and policies of each publisher on a topic."""
        return self._info(TopicEndpointTypeEnum.PUBLISHER, topic_name, no_mangle)

    def get_subscriptions_info_by_topic(
        self, topic_name: str, no_mangle: bool = False
    ) -> list[TopicEndpointInfo]:
        """Return node, type and policies of each subscription on a topic."""
        return self._info(TopicEndpointTypeEnum.SUBSCRIPTION, topic_name, no_mangle)

    def get_publisher_names_and_types_by_node(
        self, node_name: str, node_namespace: str, no_demangle: bool = False
    ) -> Named:
        """Return the topics that a node publishes, with their types."""
        return _named(self._of(node_name, node_namespace, "publications"), no_demangle)

    def get_subscriber_names_and_types_by_node(
        self, node_name: str, node_namespace: str, no_demangle: bool = False
    ) -> Named:
        """Return the topics that a node subscribes to, with their types."""
        return _named(self._of(node_name, node_namespace, "subscriptions"), no_demangle)

    def get_service_names_and_types_by_node(self, node_name: str, node_namespace: str) -> Named:
        """Return the services of a node with their types."""
        return _services(self._of(node_name, node_namespace, "subscriptions"))

    def get_client_names_and_types_by_node(self, node_name: str, node_namespace: str) -> Named:
        """Return the services that a node uses as a client, with their types."""
        return _services(self._of(node_name, node_namespace, "publications"))

    def _every(self, *kinds: str) -> Iterator[EndpointRecord]:
        return (end for kind in kinds for end in self.context.participant.endpoints(kind))

    def _count(self, kind: str, prefix: str, name: str, suffix: str = "") -> int:
        full = f"{prefix}{expanded(name, self._name, self._namespace)}{suffix}"
        return sum(end.topic == full for end in self._every(kind))

    def _of(self, name: str, namespace: str, kind: str) -> Iterator[EndpointRecord]:
        """Return the endpoints of one node."""
        nodes = [
            node
            for node in self.context.participant.nodes()
            if (node.name, node.namespace) == (name, namespace)
        ]
        if not nodes:
            raise NodeNameNonExistentError(f"no node '{name}' in '{namespace}' is on the wire")
        gids = {gid for node in nodes for gid in (*node.readers, *node.writers)}
        return (end for end in self._every(kind) if end.gid in gids)

    def _info(self, kind: TopicEndpointTypeEnum, topic: str, raw: bool) -> list[TopicEndpointInfo]:
        full = topic if raw else f"rt{self.resolve_topic_name(topic)}"
        owners = {gid: n for n in self.context.participant.nodes() for gid in (*n.readers, *n.writers)}
        unknown = NodeRecord(UNKNOWN_NODE, UNKNOWN_NAMESPACE)
        return [
            TopicEndpointInfo(
                owners.get(end.gid, unknown).name,
                owners.get(end.gid, unknown).namespace,
                ros_type_name(end.dds_type),
                _hash(end.user_data),
                kind,
                list(end.gid),
                _profile(end),
            )
            for end in self._every(KINDS[kind])
            if end.topic == full
        ]


def _named(ends: Iterable[EndpointRecord], raw: bool) -> Named:
    """Return topics and their types."""
    return _sorted(
        (end.topic, end.dds_type) if raw else (end.topic[2:], ros_type_name(end.dds_type))
        for end in ends
        if raw or end.topic.startswith("rt/")
    )


def _services(ends: Iterable[EndpointRecord]) -> Named:
    """Return services and their types, from the topics of requests."""
    return _sorted(
        (end.topic[2:].removesuffix("Request"), ros_type_name(end.dds_type).removesuffix("_Request"))
        for end in ends
        if end.topic.startswith("rq/")
    )


def _sorted(pairs: Iterable[tuple[str, str]]) -> Named:
    types_by_name: dict[str, set[str]] = {}
    for name, kind in pairs:
        types_by_name.setdefault(name, set()).add(kind)
    return sorted((name, sorted(kinds)) for name, kinds in types_by_name.items())


def _hash(user_data: bytes) -> TypeHash:
    """Return the hash in an endpoint's user data."""
    _, found, digits = user_data.partition(b"typehash=RIHS01_")
    return TypeHash(1, bytes.fromhex(digits[:64].decode())) if found else TypeHash()


def _profile(end: EndpointRecord) -> QoSProfile:
    """Return the policies of an endpoint in the form of rclpy."""
    quality = end.quality
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST if quality.depth else HistoryPolicy.KEEP_ALL,
        depth=quality.depth,
        reliability=ReliabilityPolicy.RELIABLE if quality.reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if quality.transient_local else DurabilityPolicy.VOLATILE,
        lifespan=_span(quality.lifespan),
        deadline=_span(quality.deadline),
        liveliness=LivelinessPolicy.AUTOMATIC,
    )


def _span(seconds: float) -> Duration:
    """Return the duration of a policy; no limit is `Infinite`."""
    return Duration(nanoseconds=round(seconds * 1e9) if seconds else 2**63 - 1)
