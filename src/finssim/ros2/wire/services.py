"""Services as rmw_cyclonedds sends them: two topics whose samples begin with the client's number and the request's."""

from __future__ import annotations

import hashlib
import itertools
import struct
import time
from collections.abc import Callable

from finssim.ros2.codec import Message
from finssim.ros2.errors import Ros2Error
from finssim.ros2.wire.participant import Participant
from finssim.ros2.wire.quality import Quality

__all__ = ["ClientEnd", "ServerEnd"]

PREFIX = struct.Struct("<Qq")
"""Number of the client and of its request, right after the CDR header."""

REPLY_PATIENCE = 1.0
"""How long a reply waits for its client's reader to be discovered [s]."""

_count = itertools.count(1)


class ServerEnd:
    """The serving end of a service.

    Args:
        participant: Where it lives.
        service: Full name, e.g. `/finsrov/reset`.
        name: Its type, e.g. `std_srvs/srv/Trigger`.
        handler: Answers a request.
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
        """What answers the next request; None without one."""
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
        """Whether the client's reader is known: a reply sent before that would be lost."""
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
    """The asking end of a service; arguments as of `ServerEnd`."""

    def __init__(self, participant: Participant, service: str, name: str, quality: Quality) -> None:
        self._codec, self._name = participant.codec, name
        tag = _tag(participant, "clientid")
        self.reader = participant.service_reader(f"rr{service}Reply", f"{name}_Response", quality, tag)
        self.writer = participant.service_writer(f"rq{service}Request", f"{name}_Request", quality, tag)
        self._number = int.from_bytes(hashlib.blake2b(self.writer.gid, digest_size=8).digest(), "little")
        self._sequence = itertools.count(1)

    def ready(self) -> bool:
        """Whether a server is known to take requests and to answer."""
        return self.writer.matched() > 0 and self.reader.matched() > 0

    def send(self, request: Message) -> int:
        """Send a request; returns its number.

        Raises:
            Ros2Error: The server took none of the earlier ones.
        """
        sequence = next(self._sequence)
        buffer = self._codec.serialize(request)
        buffer[4:4] = PREFIX.pack(self._number, sequence)
        if not self.writer.write(buffer):
            raise Ros2Error(f"{self.writer.topic}: the server takes no requests: see whether it still spins")
        return sequence

    def take(self) -> tuple[int, Message] | None:
        """Number of an answered request, and the answer; None without one."""
        while (sample := self.reader.take()) is not None:
            data = sample[0]
            client, sequence = PREFIX.unpack_from(data, 4)
            if client == self._number:  # every client of a service hears all its answers
                return sequence, self._codec.deserialize(data[:4] + data[20:], f"{self._name}_Response")
        return None


def _tag(participant: Participant, key: str) -> bytes:
    """What marks both ends of one server or client as belonging together."""
    number = participant.gid[:12] + struct.pack(">I", next(_count))
    return (f"{key}=" + ".".join(f"{byte:02x}" for byte in number) + ";").encode()


def _client_id(peer: object) -> bytes:
    """The `clientid` in an endpoint's user data; empty without one."""
    for policy in getattr(peer, "qos", ()):
        data = getattr(policy, "data", None)
        if isinstance(data, bytes) and b"clientid=" in data:
            return data.split(b"clientid=", 1)[1].split(b";", 1)[0]
    return b""
