"""The wire as UDP datagrams, to and from one peer alone."""

from __future__ import annotations

import logging
import socket
from collections import Counter

from finssim.robot.link.layout import LinkError

__all__ = ["UdpTransport"]

Address = tuple[str, int]

_LOG = logging.getLogger("finssim.robot.link")
_DATAGRAM = 2048
"""Bytes taken of a datagram; a longer one is cut, and its CRC no longer fits."""
_AT_ONCE = 1024
"""Datagrams taken by one call, so that a flood cannot hold the loop up."""
_NAMED = 64
"""Refused senders that are told apart; those beyond are counted together."""


class UdpTransport:
    """Datagrams with one peer; those of any other address or port are refused, counted and named once in the log.

    Note:
        `refused` counts by sender, `send_errors` the frames that could not leave (nobody listens, network down).
    """

    def __init__(self, bind: Address, peer: Address) -> None:
        """Args:
            bind: Address and port of this end; port 0 takes a free one (see `address`).
            peer: Host and port of the motor controller; the name is looked up once.

        Raises:
            LinkError: An address cannot be found, bound, or reached from `bind`.
        """
        self.peer = _resolved(peer)
        if self.peer[0] == "0.0.0.0" or not self.peer[1]:
            raise LinkError(
                f"peer {peer[0]}:{peer[1]} is not one address and port: give those of the vehicle"
            )
        here = _resolved(bind)
        if here[0].startswith("127.") and not self.peer[0].startswith("127."):
            raise LinkError(
                f"{peer[0]}:{peer[1]} is on another machine and this end is bound to {here[0]}, which only this "
                "machine reaches: bind the address that this machine has on the vehicle's network"
            )
        self.refused: Counter[Address | None] = Counter()
        self.send_errors = 0
        self._send_problem = ""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            self._socket.bind(here)
        except OSError as problem:
            self._socket.close()
            raise LinkError(
                f"cannot bind {here[0]}:{here[1]} ({problem.strerror}): end the program that has it, or bind another"
            ) from None
        self.address: Address = self._socket.getsockname()

    def send(self, data: bytes) -> None:
        """Send one datagram to the peer; one that cannot leave is counted."""
        try:
            self._socket.sendto(data, self.peer)
            self._send_problem = ""
        except OSError as problem:
            self.send_errors += 1
            if str(problem) != self._send_problem:
                self._send_problem = str(problem)
                _LOG.warning("nothing leaves for %s: %s", _name(self.peer), problem)

    def receive(self) -> list[bytes]:
        """Datagrams of the peer, oldest first; at most 1024 are looked at in one call."""
        found: list[bytes] = []
        for _ in range(_AT_ONCE):
            try:
                data, sender = self._socket.recvfrom(_DATAGRAM)
            except BlockingIOError:
                break
            except ConnectionError:  # how some systems tell that an earlier datagram found nobody
                continue
            except OSError:  # closed
                break
            if sender == self.peer:
                found.append(data)
            else:
                self._refuse(sender)
        return found

    def _refuse(self, sender: Address) -> None:
        key = sender if sender in self.refused or len(self.refused) < _NAMED else None
        if key not in self.refused:
            _LOG.warning(
                "refused a datagram from %s: this end listens to %s alone",
                _name(key) if key else "yet another sender, the last one named",
                _name(self.peer),
            )
        self.refused[key] += 1

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def describe(self) -> str:
        """Both ends, and what went wrong so far."""
        text = f"udp {_name(self.address)} to {_name(self.peer)}"
        text += f", {self.send_errors} frames could not leave" if self.send_errors else ""
        return text + (f", {sum(self.refused.values())} datagrams of others refused" if self.refused else "")


def _resolved(address: Address) -> Address:
    """IPv4 address of a host name."""
    try:
        (*_, found), *_ = socket.getaddrinfo(*address, family=socket.AF_INET, type=socket.SOCK_DGRAM)
    except OSError as problem:
        raise LinkError(
            f"{address[0]}: no such host ({problem.strerror}): give a name or an IPv4 address"
        ) from None
    return str(found[0]), int(found[1])


def _name(address: Address) -> str:
    return f"{address[0]}:{address[1]}"
