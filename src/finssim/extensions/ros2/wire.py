"""ROS 2 network protocol in Python over Cyclone DDS: discovery, topics and services of a participant."""

from __future__ import annotations

import ctypes
import hashlib
import itertools
import os
import struct
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any, NamedTuple

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication, BuiltinTopicDcpsSubscription
from cyclonedds.core import (
    DDSException,
    DDSStatus,
    Entity,
    GuardCondition,
    InstanceState,
    ReadCondition,
    SampleState,
    ViewState,
    WaitSet,
)
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import make_idl_struct
from cyclonedds.idl import types as idl
from cyclonedds.internal import DDS
from cyclonedds.pub import DataWriter, Publisher
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader, Subscriber
from cyclonedds.topic import Topic

from finssim.extensions.ros2 import Ros2Error
from finssim.extensions.ros2.codec import Codec, Distro, Message, Nodetype, codec_of, distro_of

MAX_DOMAIN = 232
"""Largest ROS domain; a larger one has no UDP ports (7400 + 250 d + 2·index)."""

LOOPBACK = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='lo'/></Interfaces>"
    "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
    "<MaxAutoParticipantIndex>60</MaxAutoParticipantIndex><Peers><Peer address='127.0.0.1'/></Peers></Discovery>"
    "</Domain></CycloneDDS>"
)
"""Configuration of Cyclone for this machine only: the loopback interface has no multicast, so peers are contacted
directly."""

LOOPBACK_WORDS = "sends on the loopback alone, listens on every address"
"""Description of the interface: Cyclone receives on all addresses, whatever interface it is given."""


@dataclass(frozen=True)
class WireSettings:
    """Settings of a participant: domain, network interface and release."""

    domain: int
    """ROS domain, 0 to 232."""
    xml: str | None
    """Configuration of Cyclone; None uses that of the environment, or Cyclone's default."""
    interface: str
    """Description of the interface, which is printed at the start."""
    distro: Distro


def wire_settings(environ: Mapping[str, str] = os.environ, domain: int | None = None) -> WireSettings:
    """Return the settings of the environment: only this machine, unless it states otherwise.

    `CYCLONEDDS_URI` has priority. Without it, the network is used only with `ROS_LOCALHOST_ONLY=0`, or with
    `ROS_AUTOMATIC_DISCOVERY_RANGE` SUBNET or SYSTEM_DEFAULT.

    Args:
        environ: Environment variables.
        domain: Domain to use instead of `ROS_DOMAIN_ID` (0 if that is not set either).

    Raises:
        Ros2Error: A variable has an invalid value.
    """
    number = _domain(environ.get("ROS_DOMAIN_ID") or "0") if domain is None else _domain(str(domain))
    if environ.get("CYCLONEDDS_URI"):
        return WireSettings(number, None, "as given by CYCLONEDDS_URI", distro_of(environ))
    if _network_wanted(environ):
        return WireSettings(
            number, None, "the network interface that Cyclone DDS chooses", distro_of(environ)
        )
    return WireSettings(number, LOOPBACK, LOOPBACK_WORDS, distro_of(environ))


def _domain(text: str) -> int:
    if not (text.isdecimal() and int(text) <= MAX_DOMAIN):
        raise Ros2Error(f"ROS domain '{text}': expected an integer from 0 to {MAX_DOMAIN} in ROS_DOMAIN_ID")
    return int(text)


def _network_wanted(environ: Mapping[str, str]) -> bool:
    reach = environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper()
    if reach not in ("", "SUBNET", "LOCALHOST", "SYSTEM_DEFAULT"):
        raise Ros2Error(
            f"ROS_AUTOMATIC_DISCOVERY_RANGE is '{reach}': expected LOCALHOST, SUBNET or SYSTEM_DEFAULT"
        )
    local = environ.get("ROS_LOCALHOST_ONLY", "")
    if local not in ("", "0", "1"):
        raise Ros2Error(f"ROS_LOCALHOST_ONLY is '{local}': expected 0 or 1")
    return local == "0" if local else reach in ("SUBNET", "SYSTEM_DEFAULT")


# Quality of service: ROS 2's policies as values, and in the form of Cyclone DDS.


BLOCKING_NS = 100_000_000
"""Longest wait of a reliable writer for its readers [ns]; ROS 2 would wait without limit and block the
control loop."""

POLICY_NAMES = {2: "DURABILITY", 4: "DEADLINE", 8: "LIVELINESS", 11: "RELIABILITY", 12: "DESTINATION_ORDER"}
"""Numbers in DDS of the policies that can make two endpoints incompatible."""


@dataclass(frozen=True)
class Quality:
    """Policies that a writer offers or a reader requests; the defaults are those of ROS 2."""

    depth: int = 10
    """Number of samples that are kept; 0 keeps all."""
    reliable: bool = True
    transient_local: bool = False
    """True if the last samples are kept for readers that are discovered later."""
    deadline: float = 0.0
    """Longest time between samples [s]; 0: no limit."""
    lifespan: float = 0.0
    """Age at which a sample expires [s]; 0: never."""


LATCHED = Quality(depth=1, transient_local=True)


def dds_qos(quality: Quality, user_data: bytes = b"") -> Qos:
    """Return policies in the form of Cyclone DDS.

    Args:
        quality: Policies.
        user_data: Data of the endpoint that its peers receive, e.g. the hash of its type.
    """
    history = Policy.History.KeepLast(quality.depth) if quality.depth else Policy.History.KeepAll
    policies = [
        history,
        Policy.Reliability.Reliable(BLOCKING_NS) if quality.reliable else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if quality.transient_local else Policy.Durability.Volatile,
        Policy.DataRepresentation(use_cdrv0_representation=True),
    ]
    if quality.transient_local:
        policies.append(Policy.DurabilityService(0, history, -1, -1, -1))
    if quality.deadline:
        policies.append(Policy.Deadline(round(quality.deadline * 1e9)))
    if quality.lifespan:
        policies.append(Policy.Lifespan(round(quality.lifespan * 1e9)))
    if user_data:
        policies.append(Policy.Userdata(user_data))
    return Qos(*policies)


# DDS types of ROS messages: they contain the type's name and let Cyclone check the bounds of received samples.


PRIMITIVES: dict[str, Any] = {
    **{
        f"{sign}int{bits}": getattr(idl, f"{sign}int{bits}") for sign in ("", "u") for bits in (8, 16, 32, 64)
    },
    **dict.fromkeys(("byte", "octet"), idl.uint8),
    "float32": idl.float32,
    "float64": idl.float64,
    "bool": bool,
    "string": str,
}


def dds_type_name(name: str) -> str:
    """Return the DDS form of a ROS type name: `nav_msgs::msg::dds_::Odometry_` of `nav_msgs/msg/Odometry`."""
    package, kind, short = name.split("/")
    return f"{package}::{kind}::dds_::{short}_"


def ros_type_name(name: str) -> str:
    """Return the ROS form of a DDS type name, the reverse of `dds_type_name`; a name of another form is unchanged."""
    parts = name.split("::")
    if len(parts) != 4 or parts[2] != "dds_":
        return name
    return f"{parts[0]}/{parts[1]}/{parts[3].removesuffix('_')}"


# Functions of Cyclone's library that its Python binding lacks. Those of `_c` release the interpreter's lock,
# because a reliable writer may wait for its readers. Those of `_quick` do not wait and keep the lock.
# writer waits for its readers. Those of `_quick` wait for nothing and keep the interpreter's lock.


_c = DDS._dll_handle
_quick = ctypes.PyDLL(_c._name, handle=_c._handle)


def _function(library: Any, name: str, result: Any, *arguments: Any) -> Any:
    function = library[name]
    function.restype, function.argtypes = result, arguments
    return function


_Handle, _Pointer, _Size = ctypes.c_int32, ctypes.c_void_p, ctypes.c_size_t
_create_domain = _function(_c, "dds_create_domain", _Handle, ctypes.c_uint32, ctypes.c_char_p)
_create_topic = _function(
    _c, "dds_create_topic", _Handle, _Handle, _Pointer, ctypes.c_char_p, _Pointer, _Pointer
)
_get_typeinfo = _function(_c, "dds_get_typeinfo", _Handle, _Handle, _Pointer)
_free_typeinfo = _function(_c, "dds_free_typeinfo", _Handle, _Pointer)
_describe = _function(
    _c, "dds_create_topic_descriptor", _Handle, ctypes.c_int, _Handle, _Pointer, ctypes.c_int64, _Pointer
)
_get_sertype = _function(_quick, "dds_get_entity_sertype", _Handle, _Handle, _Pointer)
_keep_sertype = _function(_quick, "ddsi_sertype_ref", _Pointer, _Pointer)
_sample_of = _function(
    _quick, "ddsi_serdata_from_ser_iov", _Pointer, _Pointer, ctypes.c_int, _Size, _Pointer, _Size
)
_send = _function(_c, "dds_writecdr", _Handle, _Handle, _Pointer)
_take = _function(
    _quick, "dds_takecdr", _Handle, _Handle, _Pointer, ctypes.c_uint32, _Pointer, ctypes.c_uint32
)
_size_of = _function(_quick, "ddsi_serdata_size", ctypes.c_uint32, _Pointer)
_lend = _function(_quick, "ddsi_serdata_to_ser_ref", _Pointer, _Pointer, _Size, _Size, _Pointer)
_give_back = _function(_quick, "ddsi_serdata_to_ser_unref", None, _Pointer, _Pointer)
_release = _function(_quick, "ddsi_serdata_unref", None, _Pointer)
_matched_readers = _function(_c, "dds_get_matched_subscriptions", _Handle, _Handle, _Pointer, _Size)
_matched_writers = _function(_c, "dds_get_matched_publications", _Handle, _Handle, _Pointer, _Size)

LOCAL_DOMAIN = 1
"""Constant of Cyclone for types that are defined in this process."""

DATA = 2
"""Constant of Cyclone for a complete sample."""


def _checked(code: int, what: str) -> int:
    if code < 0:
        raise DDSException(code, f"Occurred while {what}")
    return code


def _domain_of(number: int, xml: str) -> Domain:
    domain = Domain.__new__(Domain)  # its own __init__ accepts only ASCII
    Entity.__init__(domain, _create_domain(number, os.fsencode(xml)))
    return domain


SILENT = "<CycloneDDS><Domain><General><Transport>none</Transport></General></Domain></CycloneDDS>"
"""Configuration of a domain without a network."""

SILENT_DOMAIN = MAX_DOMAIN + 1
"""Number of the domain without a network; no ROS domain has it."""

_making = threading.Lock()
"""Lock for creating a domain or a type."""


class DdsTypes:
    """Cyclone's types of a codec's messages, created on first use and kept until the process ends."""

    def __init__(self, codec: Codec) -> None:
        self._codec = codec
        self._made: dict[tuple[str, bool], Any] = {}
        self._described: dict[tuple[str, bool], ctypes.c_void_p] = {}

    def descriptor_of(self, name: str, *, service: bool = False) -> ctypes.c_void_p:
        """Return the descriptor with which Cyclone's library creates a topic; arguments as of `type_of`.

        While Cyclone 11.0.1 translates a type, it reads its list of types without a lock, and crashes if
        another of its threads changes that list, for example when a participant leaves or is discovered. The
        types are therefore translated in a domain without participants and discovery.
        """
        with _making:
            if (name, service) not in self._described:
                self._described[name, service] = _translate(self.type_of(name, service=service))
            return self._described[name, service]

    def type_of(self, name: str, *, service: bool = False) -> Any:
        """Return the type of a message; that of a service message begins with the numbers of the client and
        of the request."""
        if (name, service) not in self._made:
            fields = {"header_client_": idl.uint64, "header_sequence_": idl.int64} if service else {}
            fields |= {f"{n}_": self._field(*described) for n, described in self._codec.fields(name)}
            self._made[name, service] = make_idl_struct(
                name.replace("/", "_"), dds_type_name(name), fields, dataclassify=False
            )
        return self._made[name, service]

    def _field(self, kind: Any, detail: Any) -> Any:
        if kind == Nodetype.NAME:
            return self.type_of(detail)
        if kind == Nodetype.BASE:
            base, bound = detail
            return idl.bounded_str[bound] if base == "string" and bound else PRIMITIVES[base]
        inner, count = detail
        if kind == Nodetype.ARRAY:
            return idl.array[self._field(*inner), count]
        return idl.sequence[self._field(*inner), count] if count else idl.sequence[self._field(*inner)]


@cache
def types_of(codec: Codec) -> DdsTypes:
    """Return the types of a codec."""
    return DdsTypes(codec)


def _translate(dds_type: Any) -> ctypes.c_void_p:
    domain = _domain_of(SILENT_DOMAIN, SILENT)
    try:
        participant = DomainParticipant(SILENT_DOMAIN)
        topic = Topic(participant, "type", dds_type)
        info, descriptor = ctypes.c_void_p(), ctypes.c_void_p()
        _checked(_get_typeinfo(topic._ref, ctypes.byref(info)), "describing a type")
        code = _describe(LOCAL_DOMAIN, participant._ref, info, 0, ctypes.byref(descriptor))
        _free_typeinfo(info)
        _checked(code, "translating a type")
        return descriptor
    finally:
        domain.__del__()


class _Topic(Topic):
    """Topic with a type of Cyclone's library, which its threads use without the interpreter."""

    def __init__(self, participant: DomainParticipant, name: str, descriptor: ctypes.c_void_p) -> None:
        Entity.__init__(self, _create_topic(participant._ref, descriptor, name.encode(), None, None))
        self.data_type, self._keepalive_entities = None, [participant]


# Writers and readers of bytes on one DDS topic.


ANY = SampleState.Any | ViewState.Any | InstanceState.Any


class _Blob(ctypes.Structure):
    _fields_ = [("data", ctypes.c_void_p), ("size", ctypes.c_size_t)]
    if os.name == "nt":
        _fields_ = [("size", ctypes.c_ulong), ("data", ctypes.c_void_p)]


class SampleInfo(ctypes.Structure):
    """Information of DDS about a sample."""

    _fields_ = [
        *((f"{name}_state", ctypes.c_int) for name in ("sample", "view", "instance")),
        ("valid_data", ctypes.c_bool),
        ("source_timestamp", ctypes.c_int64),
        ("instance_handle", ctypes.c_uint64),
        ("publication_handle", ctypes.c_uint64),
        *((f"{name}_generation_count", ctypes.c_uint32) for name in ("disposed", "no_writers")),
        *((f"{name}_rank", ctypes.c_uint32) for name in ("sample", "generation", "absolute_generation")),
    ]


def _bytes_of(sample: ctypes.c_void_p) -> bytes:
    blob, size = _Blob(), _size_of(sample)
    lent = _lend(sample, 0, size, ctypes.byref(blob))
    data = ctypes.string_at(blob.data, size)
    _give_back(lent, ctypes.byref(blob))
    return data


_kept: set[int] = set()
"""Types of writers, kept until the process ends: a thread may still write while another closes the writer."""


def _type_of(writer: DataWriter) -> ctypes.c_void_p:
    sertype = ctypes.c_void_p()
    _checked(_get_sertype(writer._ref, ctypes.byref(sertype)), "reading the type of a writer")
    if sertype.value is not None and sertype.value not in _kept:
        _kept.add(sertype.value)
        _keep_sertype(sertype)
    return sertype


def _handles(matched: Callable[[int, Any, int], int], endpoint: int) -> list[int]:
    """Return handles of the peers of an endpoint. A peer may appear during the count, for which the binding fails."""
    room, handles = 0, None
    while (count := _checked(matched(endpoint, handles, room), "counting peers")) > room:
        room, handles = count, (ctypes.c_uint64 * count)()
    return list(handles or ())[:count]


class DdsEndpoint:
    """Common part of writers and readers."""

    entity: Any
    topic: str
    """Topic with its prefix, e.g. `rt/finsrov/odom`."""
    gid: bytes
    """The endpoint's globally unique identifier, 16 bytes."""
    closed = False

    def close(self) -> None:
        """Destroy the endpoint."""
        self.closed = True
        self.entity.__del__()

    def _incompatible(self, status: Any) -> str:
        """Return the name of the policy that last prevented a match; empty if nothing changed."""
        if not status.total_count_change:
            return ""
        return POLICY_NAMES.get(status.last_policy_id, f"policy {status.last_policy_id}")


class Writer(DdsEndpoint):
    """Writer of serialized samples (CDR)."""

    def __init__(self, publisher: Publisher, topic: Topic, qos: Qos) -> None:
        self._keeps = Policy.Durability.TransientLocal in qos
        self.entity = DataWriter(publisher, topic, qos)
        self.entity.set_status_mask(DDSStatus.OfferedIncompatibleQos)
        self.topic, self.gid = topic.name, self.entity.guid.bytes
        self._type = _type_of(self.entity)

    def write(self, buffer: bytearray) -> bool:
        """Send a sample, whose length is a multiple of four bytes; False if slow readers left no room for it
        in 100 ms.

        Raises:
            DDSException: Cyclone rejected it for another reason.
        """
        if not self._keeps and self.matched() == 0:
            return True  # without a reader; Cyclone would copy the sample nevertheless
        view = (ctypes.c_char * 0).from_buffer(buffer)
        blob = _Blob(ctypes.addressof(view), len(buffer))
        sample = _sample_of(self._type, DATA, 1, ctypes.byref(blob), len(buffer))
        if not sample:
            raise DDSException(DDSException.DDS_RETCODE_BAD_PARAMETER, f"while encoding for {self.topic}")
        code = _send(self.entity._ref, sample)
        if code == DDSException.DDS_RETCODE_TIMEOUT:
            return False
        if code:
            raise DDSException(code, f"while writing to {self.topic}")
        return True

    def matched(self) -> int:
        """Return the number of known readers."""
        return int(_matched_readers(self.entity._ref, None, 0))

    def peers(self) -> list[Any]:
        """Return the known readers."""
        handles = _handles(_matched_readers, self.entity._ref)
        matched = (self.entity.get_matched_subscription_data(h) for h in handles)
        return [peer for peer in matched if peer is not None]

    def incompatible(self) -> str:
        """Return the name of the policy for which a reader was newly found incompatible; empty if none was."""
        return self._incompatible(self.entity.get_offered_incompatible_qos_status())


class Reader(DdsEndpoint):
    """Reader of serialized samples (CDR)."""

    def __init__(self, subscriber: Subscriber, topic: Topic, qos: Qos) -> None:
        self.entity = DataReader(subscriber, topic, qos)
        self.entity.set_status_mask(DDSStatus.RequestedIncompatibleQos)
        self.topic, self.gid = topic.name, self.entity.guid.bytes
        self.condition = ReadCondition(self.entity, ANY)
        """True while a sample waits."""

    def take(self) -> tuple[bytes, Any] | None:
        """Return the oldest waiting sample and DDS's information about it; None if none waits."""
        while True:
            sample, info = ctypes.c_void_p(), SampleInfo()
            if _take(self.entity._ref, ctypes.byref(sample), 1, ctypes.byref(info), ANY) <= 0:
                return None
            data = _bytes_of(sample) if info.valid_data else None
            _release(sample)
            if data is not None:  # else only the notification that a writer left
                return data, info

    def close(self) -> None:
        self.condition.__del__()
        super().close()

    def watch_matches(self) -> None:
        """Let changes of `matches` end a wait."""
        self.entity.set_status_mask(DDSStatus.RequestedIncompatibleQos | DDSStatus.SubscriptionMatched)

    def matches(self) -> tuple[int, int, int, int]:
        """Return the numbers of writers matched in total, newly since the last call, and now, and the change
        of the last."""
        status = self.entity.get_subscription_matched_status()
        return (
            status.total_count,
            status.total_count_change,
            status.current_count,
            status.current_count_change,
        )

    def matched(self) -> int:
        """Return the number of known writers."""
        return _checked(_matched_writers(self.entity._ref, None, 0), "counting peers")

    def peers(self) -> list[Any]:
        """Return the known writers."""
        handles = _handles(_matched_writers, self.entity._ref)
        matched = (self.entity.get_matched_publication_data(h) for h in handles)
        return [peer for peer in matched if peer is not None]

    def incompatible(self) -> str:
        """Return the name of the policy for which a writer was newly found incompatible; empty if none was."""
        return self._incompatible(self.entity.get_requested_incompatible_qos_status())


# A DDS participant, one per ROS 2 context: its endpoints, and the nodes that it announces to its peers.


FOREVER = 2**63 - 1
"""Duration without limit in DDS [ns]."""

NODE_LIST = "rmw_dds_common/msg/ParticipantEntitiesInfo"

_domains: dict[int, Domain] = {}
"""Domains of this process, kept until its end: Cyclone reads a domain's configuration once, and samples and
types in use are in its memory."""


@dataclass
class NodeRecord:
    """A node in the announced node list."""

    name: str
    namespace: str
    readers: list[bytes] = field(default_factory=list)
    """Identifiers of its readers, 16 bytes each."""
    writers: list[bytes] = field(default_factory=list)


class EndpointRecord(NamedTuple):
    """A writer or reader that was discovered."""

    topic: str
    """Topic with its prefix."""
    dds_type: str
    gid: bytes
    """Identifier of 16 bytes."""
    qos: Qos

    @property
    def user_data(self) -> bytes:
        """Return the data that the endpoint sends to its peers."""
        return next((bytes(p.data) for p in self.qos if isinstance(p, Policy.Userdata)), b"")

    @property
    def quality(self) -> Quality:
        """Return its policies; the depth of an endpoint of another DDS implementation is not known."""
        spans = {
            kind: getattr(policy, key)
            for policy in self.qos
            for kind, key in ((Policy.Deadline, "deadline"), (Policy.Lifespan, "lifespan"))
            if isinstance(policy, kind) and getattr(policy, key) < FOREVER
        }
        depths = [p.depth for p in self.qos if isinstance(p, Policy.History.KeepLast)]
        return Quality(
            depth=depths[0] if depths else 0,
            reliable=Policy.Reliability.BestEffort not in self.qos,
            transient_local=Policy.Durability.TransientLocal in self.qos,
            deadline=1e-9 * spans.get(Policy.Deadline, 0),
            lifespan=1e-9 * spans.get(Policy.Lifespan, 0),
        )


class Participant:
    """DDS participant of a process.

    Args:
        settings: Domain, interface and release.
        enclave: Security enclave; "/" is none.
    """

    def __init__(self, settings: WireSettings, enclave: str = "/") -> None:
        self.settings = settings
        self.codec: Codec = codec_of(settings.distro.name)
        with _making:
            if settings.domain not in _domains:
                xml = os.environ.get("CYCLONEDDS_URI", "") if settings.xml is None else settings.xml
                _domains[settings.domain] = _domain_of(settings.domain, xml)
        user_data = Qos(Policy.Userdata(f"enclave={enclave};".encode()))
        self.entity = DomainParticipant(settings.domain, qos=user_data)
        self.gid: bytes = self.entity.guid.bytes
        self._publisher, self._subscriber = Publisher(self.entity), Subscriber(self.entity)
        self._types = types_of(self.codec)
        self._topics: dict[tuple[str, str], Topic] = {}
        self._builtin: dict[str, Any] = {}
        self._lock = threading.Lock()
        self._node_list = self.writer("ros_discovery_info", NODE_LIST, LATCHED)
        keep_all = Quality(depth=0, transient_local=True)
        self._others = self.reader("ros_discovery_info", NODE_LIST, keep_all)
        self._seen: dict[bytes, list[NodeRecord]] = {}

    def writer(self, topic: str, name: str, quality: Quality) -> Writer:
        """Create a writer of messages of type `name` on a topic with its prefix, e.g. `rt/odom`."""
        return Writer(self._publisher, self._topic(topic, name), dds_qos(quality, self._type_hash(name)))

    def reader(self, topic: str, name: str, quality: Quality) -> Reader:
        """Create a reader of messages of type `name` on a topic with its prefix."""
        return Reader(self._subscriber, self._topic(topic, name), dds_qos(quality, self._type_hash(name)))

    def service_writer(self, topic: str, name: str, quality: Quality, user_data: bytes) -> Writer:
        """Create a writer of requests or replies of a service; its samples begin with client and sequence number."""
        return Writer(self._publisher, self._topic(topic, name, service=True), dds_qos(quality, user_data))

    def service_reader(self, topic: str, name: str, quality: Quality, user_data: bytes) -> Reader:
        """Create a reader of requests or replies of a service."""
        return Reader(self._subscriber, self._topic(topic, name, service=True), dds_qos(quality, user_data))

    def announce(self, nodes: Sequence[NodeRecord]) -> None:
        """Announce the nodes of this participant to every peer, also to peers that are discovered later."""
        with self._lock:
            message = self.codec.message(NODE_LIST)(
                gid=self._gid(self.gid), node_entities_info_seq=[self._node(n) for n in nodes]
            )
            self._node_list.write(self.codec.serialize(message))

    def nodes(self) -> list[NodeRecord]:
        """Return all known nodes, including those of this participant."""
        with self._lock:
            while (sample := self._others.take()) is not None:
                try:
                    message: Any = self.codec.deserialize(sample[0], NODE_LIST)
                except Ros2Error:
                    continue  # a participant of another release: its data can be received, but its nodes cannot be read
                self._seen[bytes(message.gid.data[:16])] = [
                    _record(n) for n in message.node_entities_info_seq
                ]
            alive = {peer.participant_key.bytes for peer in self._others.peers()}
            self._seen = {gid: nodes for gid, nodes in self._seen.items() if gid in alive}
            return [node for nodes in self._seen.values() for node in nodes]

    def endpoints(self, kind: str) -> list[EndpointRecord]:
        """Return every discovered endpoint.

        Args:
            kind: "publications" or "subscriptions".
        """
        topics = {"publications": BuiltinTopicDcpsPublication, "subscriptions": BuiltinTopicDcpsSubscription}
        with self._lock:
            if kind not in self._builtin:
                self._builtin[kind] = BuiltinDataReader(self.entity, topics[kind]), {}
            reader, known = self._builtin[kind]
            for sample in reader.take(N=10_000):
                # Only changes: those that have left would be read again and again.
                if sample.sample_info.instance_state == InstanceState.Alive:
                    record = EndpointRecord(sample.topic_name, sample.type_name, sample.key.bytes, sample.qos)
                    known[sample.key.bytes] = record
                else:
                    known.pop(sample.key.bytes, None)
            return list(known.values())

    def close(self) -> None:
        """Destroy the participant immediately: peers are notified, and nothing waits."""
        self.entity.__del__()

    def _topic(self, topic: str, name: str, *, service: bool = False) -> Topic:
        self.codec.message(name)
        if (topic, name) not in self._topics:
            descriptor = self._types.descriptor_of(name, service=service)
            self._topics[topic, name] = _Topic(self.entity, topic, descriptor)
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


# Services as in rmw_cyclonedds: two topics whose samples begin with the numbers of the client and of the request.


PREFIX = struct.Struct("<Qq")
"""Numbers of the client and of its request, directly after the CDR header."""

REPLY_PATIENCE = 1.0
"""Longest time for which a reply waits until its client's reader is discovered [s]."""

_count = itertools.count(1)


class ServerEnd:
    """Server of a service.

    Args:
        participant: Participant that owns it.
        service: Full name, e.g. `/finsrov/reset`.
        name: Type of the service, e.g. `std_srvs/srv/Trigger`.
        handler: Returns the reply to a request.
        quality: Policies of both topics.
    """

    def __init__(
        self,
        participant: Participant,
        service: str,
        name: str,
        handler: Callable[[Message], Message],
        quality: Quality,
    ) -> None:
        self._codec, self._name, self._handler = participant.codec, name, handler
        tag = _tag(participant, "serviceid")
        self.writer = participant.service_writer(f"rr{service}Reply", f"{name}_Response", quality, tag)
        self.reader = participant.service_reader(f"rq{service}Request", f"{name}_Request", quality, tag)
        self._clients: set[bytes] = set()
        self._late: list[tuple[float, bytes, bytearray]] = []

    def take(self) -> Callable[[], None] | None:
        """Return a function that answers the next request; None if none waits."""
        self._send_late()
        sample = self.reader.take()
        if sample is None:
            return None
        data, info = sample
        peer = self.reader.entity.get_matched_publication_data(info.publication_handle)
        client = _client_id(peer) if peer is not None else b""
        return lambda: self._answer(data, client)

    def _answer(self, data: bytes, client: bytes) -> None:
        request = self._codec.deserialize(data[:4] + data[20:], f"{self._name}_Request")
        reply = self._codec.serialize(self._handler(request))
        reply[4:4] = data[4:20]
        if self._reachable(client):
            self.writer.write(reply)
        else:
            self._late.append((time.monotonic() + REPLY_PATIENCE, client, reply))

    def _reachable(self, client: bytes) -> bool:
        """Return whether the client's reader is known; a reply sent before would be lost."""
        if client and client not in self._clients:
            self._clients = {_client_id(peer) for peer in self.writer.peers()}
        return not client or client in self._clients

    def _send_late(self) -> None:
        now, waiting = time.monotonic(), self._late
        self._late = []
        for until, client, reply in waiting:
            if self._reachable(client) or now >= until:
                self.writer.write(reply)
            else:
                self._late.append((until, client, reply))


class ClientEnd:
    """Client of a service; arguments as of `ServerEnd`."""

    def __init__(self, participant: Participant, service: str, name: str, quality: Quality) -> None:
        self._codec, self._name = participant.codec, name
        tag = _tag(participant, "clientid")
        self.reader = participant.service_reader(f"rr{service}Reply", f"{name}_Response", quality, tag)
        self.writer = participant.service_writer(f"rq{service}Request", f"{name}_Request", quality, tag)
        self._number = int.from_bytes(hashlib.blake2b(self.writer.gid, digest_size=8).digest(), "little")
        self._sequence = itertools.count(1)

    def ready(self) -> bool:
        """Return whether a server is known to receive requests and to reply."""
        return self.writer.matched() > 0 and self.reader.matched() > 0

    def send(self, request: Message) -> int:
        """Send a request and return its number.

        Raises:
            Ros2Error: The server received none of the earlier requests.
        """
        sequence = next(self._sequence)
        buffer = self._codec.serialize(request)
        buffer[4:4] = PREFIX.pack(self._number, sequence)
        if not self.writer.write(buffer):
            raise Ros2Error(f"{self.writer.topic}: the server takes no requests: check that it still spins")
        return sequence

    def take(self) -> tuple[int, Message] | None:
        """Return the number of an answered request and the reply; None if none waits."""
        while (sample := self.reader.take()) is not None:
            data = sample[0]
            client, sequence = PREFIX.unpack_from(data, 4)
            if client == self._number:  # every client of a service receives all its replies
                return sequence, self._codec.deserialize(data[:4] + data[20:], f"{self._name}_Response")
        return None


def _tag(participant: Participant, key: str) -> bytes:
    """Return the identifier of both endpoints of one server or client."""
    number = participant.gid[:12] + struct.pack(">I", next(_count))
    return (f"{key}=" + ".".join(f"{byte:02x}" for byte in number) + ";").encode()


def _client_id(peer: object) -> bytes:
    """Return the `clientid` in an endpoint's user data; empty without one."""
    for policy in getattr(peer, "qos", ()):
        data = getattr(policy, "data", None)
        if isinstance(data, bytes) and b"clientid=" in data:
            return data.split(b"clientid=", 1)[1].split(b";", 1)[0]
    return b""


# Waiting for any of several endpoints.


class Waiter:
    """Waits until a watched reader has a sample, a watched endpoint meets an incompatible peer, or `wake` is
    called."""

    def __init__(self, participant: Participant) -> None:
        self._set = WaitSet(participant.entity)
        self._guard = GuardCondition(participant.entity)
        self._set.attach(self._guard)
        self._closed = False
        self._watched: set[DdsEndpoint] = set()

    def watch(self, endpoints: Iterable[DdsEndpoint]) -> None:
        """Watch only these endpoints from now on."""
        required = set(endpoints)
        for endpoint in self._watched - required:
            if not endpoint.closed:  # DDS itself detaches a closed one
                self._each(endpoint, self._set.detach)
        for endpoint in required - self._watched:
            self._each(endpoint, self._set.attach)
        self._watched = required

    def wait(self, timeout: float) -> bool:
        """Wait at most `timeout` [s]; return whether anything happened."""
        try:
            happened = self._set.wait(int(timeout * 1e9)) > 0
            if happened:
                self._guard.set(False)
        except DDSException:
            if not self._closed:
                raise
            return False  # another thread has closed it
        return happened

    def wake(self) -> None:
        """End the current or the next `wait`; can be called from any thread."""
        if not self._closed:
            self._guard.set(True)

    def close(self) -> None:
        """Detach all endpoints and destroy the waiter."""
        self._closed = True
        self._set.attached = []
        self._set.__del__()
        self._guard.__del__()

    @staticmethod
    def _each(endpoint: DdsEndpoint, act: Callable[[Any], None]) -> None:
        act(endpoint.entity)
        if isinstance(endpoint, Reader):
            act(endpoint.condition)
