"""One DDS participant, as ROS 2 has one per context: its endpoints, and the nodes it tells its peers about."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication, BuiltinTopicDcpsSubscription
from cyclonedds.core import InstanceState
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import Publisher
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import Subscriber
from cyclonedds.topic import Topic

from finssim.ros2.codec import Codec, codec_of
from finssim.ros2.errors import Ros2Error
from finssim.ros2.wire.dds_types import DdsTypes, ros_type_name
from finssim.ros2.wire.endpoints import Reader, Writer
from finssim.ros2.wire.quality import LATCHED, Quality, dds_qos
from finssim.ros2.wire.settings import WireSettings

__all__ = ["NodeRecord", "Participant"]

NODE_LIST = "rmw_dds_common/msg/ParticipantEntitiesInfo"

_domains: dict[int, Domain] = {}
"""Domains of this process that were configured here: Cyclone reads a domain's configuration once."""


@dataclass
class NodeRecord:
    """A node as the node list has it."""

    name: str
    namespace: str
    readers: list[bytes] = field(default_factory=list)
    """Identifiers of its readers, 16 bytes each."""
    writers: list[bytes] = field(default_factory=list)


class Participant:
    """A process's presence on the wire.

    Args:
        settings: Domain, interface and release.
        enclave: Security enclave; "/" is none.
    """

    def __init__(self, settings: WireSettings, enclave: str = "/") -> None:
        self.settings = settings
        self.codec: Codec = codec_of(settings.distro.name)
        if settings.xml is not None and settings.domain not in _domains:
            _domains[settings.domain] = Domain(settings.domain, settings.xml)
        user_data = Qos(Policy.Userdata(f"enclave={enclave};".encode()))
        self.entity = DomainParticipant(settings.domain, qos=user_data)
        self.gid: bytes = self.entity.guid.bytes
        self._publisher, self._subscriber = Publisher(self.entity), Subscriber(self.entity)
        self._types = DdsTypes(self.codec)
        self._topics: dict[tuple[str, str], Topic] = {}
        self._builtin: dict[str, Any] = {}
        self._lock = threading.Lock()
        self._node_list = self.writer("ros_discovery_info", NODE_LIST, LATCHED)
        keep_all = Quality(depth=0, transient_local=True)
        self._others = self.reader("ros_discovery_info", NODE_LIST, keep_all)
        self._seen: dict[bytes, list[NodeRecord]] = {}

    def writer(self, topic: str, name: str, quality: Quality) -> Writer:
        """A writer of messages of type `name` on a topic with its prefix, e.g. `rt/odom`."""
        return Writer(self._publisher, self._topic(topic, name), dds_qos(quality, self._type_hash(name)))

    def reader(self, topic: str, name: str, quality: Quality) -> Reader:
        """A reader of messages of type `name` on a topic with its prefix."""
        return Reader(self._subscriber, self._topic(topic, name), dds_qos(quality, self._type_hash(name)))

    def service_writer(self, topic: str, name: str, quality: Quality, user_data: bytes) -> Writer:
        """A writer of one half of a service, its samples led by client and sequence number."""
        return Writer(self._publisher, self._topic(topic, name, service=True), dds_qos(quality, user_data))

    def service_reader(self, topic: str, name: str, quality: Quality, user_data: bytes) -> Reader:
        """A reader of one half of a service."""
        return Reader(self._subscriber, self._topic(topic, name, service=True), dds_qos(quality, user_data))

    def announce(self, nodes: Sequence[NodeRecord]) -> None:
        """Tell every peer, those that come later too, which nodes this participant holds."""
        with self._lock:
            message = self.codec.message(NODE_LIST)(
                gid=self._gid(self.gid), node_entities_info_seq=[self._node(n) for n in nodes]
            )
            self._node_list.write(self.codec.serialize(message))

    def nodes(self) -> list[NodeRecord]:
        """Every node that is known on the wire, those of this participant among them."""
        with self._lock:
            while (sample := self._others.take()) is not None:
                try:
                    message: Any = self.codec.deserialize(sample[0], NODE_LIST)
                except Ros2Error:
                    continue  # a participant of another release: its data flows, its nodes cannot be read
                self._seen[bytes(message.gid.data[:16])] = [
                    _record(n) for n in message.node_entities_info_seq
                ]
            alive = {peer.participant_key.bytes for peer in self._others.peers()}
            self._seen = {gid: nodes for gid, nodes in self._seen.items() if gid in alive}
            return [node for nodes in self._seen.values() for node in nodes]

    def endpoints(self, kind: str) -> list[tuple[str, str]]:
        """Topic with its prefix, and ROS type, of every endpoint on the wire.

        Args:
            kind: "publications" or "subscriptions".
        """
        topics = {"publications": BuiltinTopicDcpsPublication, "subscriptions": BuiltinTopicDcpsSubscription}
        if kind not in self._builtin:
            self._builtin[kind] = BuiltinDataReader(self.entity, topics[kind])
        samples = self._builtin[kind].read(N=10_000)
        alive = [
            s
            for s in samples
            if s.sample_info.instance_state == InstanceState.Alive and hasattr(s, "topic_name")
        ]
        return [(sample.topic_name, ros_type_name(sample.type_name)) for sample in alive]

    def close(self) -> None:
        """Leave the wire at once: peers are told, and wait for nothing."""
        self.entity.__del__()

    def _topic(self, topic: str, name: str, *, service: bool = False) -> Topic:
        self.codec.message(name)
        if (topic, name) not in self._topics:
            self._topics[topic, name] = Topic(self.entity, topic, self._types.type_of(name, service=service))
        return self._topics[topic, name]

    def _type_hash(self, name: str) -> bytes:
        if not self.settings.distro.type_hashes:
            return b""
        return f"typehash={self.codec.type_hash(name)};".encode()

    def _gid(self, gid: bytes) -> Any:
        data = gid.ljust(self.settings.distro.gid_length, b"\0")
        return self.codec.message("rmw_dds_common/msg/Gid")(data=data)

    def _node(self, node: NodeRecord) -> Any:
        return self.codec.message("rmw_dds_common/msg/NodeEntitiesInfo")(
            node_namespace=node.namespace,
            node_name=node.name,
            reader_gid_seq=[self._gid(g) for g in node.readers],
            writer_gid_seq=[self._gid(g) for g in node.writers],
        )


def _record(message: Any) -> NodeRecord:
    return NodeRecord(
        name=message.node_name,
        namespace=message.node_namespace,
        readers=[bytes(g.data[:16]) for g in message.reader_gid_seq],
        writers=[bytes(g.data[:16]) for g in message.writer_gid_seq],
    )
