"""Writers and readers of bytes on one DDS topic."""

from __future__ import annotations

import ctypes
from typing import Any

from cyclonedds._clayer import ddspy_take
from cyclonedds.core import DDSException, DDSStatus, InstanceState, ReadCondition, SampleState, ViewState
from cyclonedds.internal import DDS
from cyclonedds.pub import DataWriter, Publisher
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader, Subscriber
from cyclonedds.topic import Topic

from finssim.ros2.wire.quality import POLICY_NAMES

__all__ = ["Endpoint", "Reader", "Writer"]

ANY = SampleState.Any | ViewState.Any | InstanceState.Any


class _Blob(ctypes.Structure):
    _fields_ = [("data", ctypes.c_void_p), ("size", ctypes.c_size_t)]


# Through ctypes, which gives up the interpreter's lock while a reliable writer waits for its readers; the binding's
# own write would hold it and stop every thread.
_dds_write = DDS._dll_handle.dds_write
_dds_write.argtypes, _dds_write.restype = [ctypes.c_int32, ctypes.c_void_p], ctypes.c_int32

_count_readers = DDS._dll_handle.dds_get_matched_subscriptions
_count_readers.argtypes = [ctypes.c_int32, ctypes.c_void_p, ctypes.c_size_t]
_count_readers.restype = ctypes.c_int32


class Endpoint:
    """What writers and readers share."""

    entity: Any
    topic: str
    """With its prefix, e.g. `rt/finsrov/odom`."""
    gid: bytes
    """The endpoint's globally unique identifier, 16 bytes."""
    closed = False

    def close(self) -> None:
        """Leave the wire."""
        self.closed = True
        self.entity.__del__()

    def _incompatible(self, status: Any) -> str:
        """Name of the policy that last kept a peer away; empty without news."""
        if not status.total_count_change:
            return ""
        return POLICY_NAMES.get(status.last_policy_id, f"policy {status.last_policy_id}")


class Writer(Endpoint):
    """Sends ready CDR bytes."""

    def __init__(self, publisher: Publisher, topic: Topic, qos: Qos) -> None:
        self._keeps = Policy.Durability.TransientLocal in qos
        self.entity = DataWriter(publisher, topic, qos)
        self.entity.set_status_mask(DDSStatus.OfferedIncompatibleQos)
        self.topic, self.gid = topic.name, self.entity.guid.bytes

    def write(self, buffer: bytearray) -> bool:
        """Send one sample, a multiple of four bytes; False if slow readers left no room for it within 100 ms.

        Raises:
            DDSException: The wire refused it for another reason.
        """
        if not self._keeps and self.matched() == 0:
            return True  # nobody would ever see it, and Cyclone copies even then
        view = (ctypes.c_char * 0).from_buffer(buffer)
        blob = _Blob(ctypes.addressof(view), len(buffer))
        code = _dds_write(self.entity._ref, ctypes.byref(blob))
        if code == DDSException.DDS_RETCODE_TIMEOUT:
            return False
        if code:
            raise DDSException(code, f"while writing to {self.topic}")
        return True

    def matched(self) -> int:
        """How many readers are known to get it."""
        return int(_count_readers(self.entity._ref, None, 0))

    def peers(self) -> list[Any]:
        """What is known of those readers."""
        found = (
            self.entity.get_matched_subscription_data(h) for h in self.entity.get_matched_subscriptions()
        )
        return [peer for peer in found if peer is not None]

    def incompatible(self) -> str:
        """Name of the policy by which a reader newly turned out not to fit; empty if none did."""
        return self._incompatible(self.entity.get_offered_incompatible_qos_status())


class Reader(Endpoint):
    """Receives CDR bytes."""

    def __init__(self, subscriber: Subscriber, topic: Topic, qos: Qos) -> None:
        self.entity = DataReader(subscriber, topic, qos)
        self.entity.set_status_mask(DDSStatus.RequestedIncompatibleQos)
        self.topic, self.gid = topic.name, self.entity.guid.bytes
        self.condition = ReadCondition(self.entity, ANY)
        """True while a sample waits."""

    def take(self) -> tuple[bytes, Any] | None:
        """The oldest waiting sample, and what DDS says of it; None without one."""
        while True:
            taken = ddspy_take(self.entity._ref, ANY, 1)
            if isinstance(taken, int) or not taken:
                return None
            data, info = taken[0]
            if info.valid_data:  # else only the news that a writer left
                return data, info

    def close(self) -> None:
        self.condition.__del__()
        super().close()

    def watch_matches(self) -> None:
        """Let `matches` wake who waits."""
        self.entity.set_status_mask(DDSStatus.RequestedIncompatibleQos | DDSStatus.SubscriptionMatched)

    def matches(self) -> tuple[int, int, int, int]:
        """Writers ever matched, those newly so since last asked, those matched now, and that number's change."""
        status = self.entity.get_subscription_matched_status()
        return (
            status.total_count,
            status.total_count_change,
            status.current_count,
            status.current_count_change,
        )

    def matched(self) -> int:
        """How many writers are known."""
        return len(self.entity.get_matched_publications())

    def peers(self) -> list[Any]:
        """What is known of those writers."""
        found = (self.entity.get_matched_publication_data(h) for h in self.entity.get_matched_publications())
        return [peer for peer in found if peer is not None]

    def incompatible(self) -> str:
        """Name of the policy by which a writer newly turned out not to fit; empty if none did."""
        return self._incompatible(self.entity.get_requested_incompatible_qos_status())
