"""Pictures over UDP from one peer alone, received by a thread of its own so that none waits for the control loop."""

from __future__ import annotations

import logging
import socket
import threading
import time
from collections import Counter, deque
from dataclasses import replace

from finssim.robot.link.layout import LinkError
from finssim.robot.messages import Picture
from finssim.robot.picture_codec import decode_picture
from finssim.robot.picture_fragments import Assembler

__all__ = ["UdpPictures"]

Address = tuple[str, int]

_LOG = logging.getLogger("finssim.robot.pictures")
_WAITING = 4
"""Pictures that wait for the loop; the oldest is forgotten."""
_NAMED = 64
"""Refused senders that are told apart."""
_BUFFER = 4 * 2**20
"""Asked of the system for what has not been read yet [bytes]."""
_LATEST = 10.0
"""A picture cannot be later than this [s]."""


class UdpPictures:
    """The camera's end is one address; what others send is refused, counted and named once in the log.

    A picture's time is that of its reception, less what its sender says that sending was late.
    """

    def __init__(self, bind: Address, peer: Address) -> None:
        """
        Args:
            bind: Address and port of this end; port 0 takes a free one (see `address`).
            peer: Address and port of the camera's end.

        Raises:
            LinkError: An address cannot be found or bound.
        """
        self.refused: Counter[Address | None] = Counter()
        self.not_understood = 0
        self.assembler = Assembler()
        self._waiting: deque[tuple[float, Picture]] = deque(maxlen=_WAITING)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self.peer: Address = (socket.gethostbyname(peer[0]), peer[1])
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
            self._socket.bind(bind)
        except OSError as problem:
            self._socket.close()
            raise LinkError(
                f"pictures on {bind[0]}:{bind[1]} from {peer[0]}:{peer[1]}: {problem.strerror or problem}: "
                "end the program that has the port, or give another address"
            ) from None
        self.address: Address = self._socket.getsockname()
        self._socket.settimeout(0.2)
        self._open = True
        self._thread = threading.Thread(target=self._listen, name="pictures", daemon=True)
        self._thread.start()

    def receive(self, now: float) -> list[Picture]:
        """Pictures since the last call, oldest first, with times on the clock of `now` [s]."""
        found, later = [], time.monotonic() - now
        while self._waiting:
            came, picture = self._waiting.popleft()
            found.append(replace(picture, time=came - later))
        return found

    def close(self) -> None:
        """Let go of the socket."""
        self._open = False
        self._thread.join(timeout=2.0)
        self._socket.close()

    def describe(self) -> str:
        """Both ends, and what went wrong so far."""
        counts = self.assembler.counts
        text = f"udp {self.address[0]}:{self.address[1]} from {self.peer[0]}:{self.peer[1]}, "
        text += f"{counts['whole']} pictures"
        bad = counts["incomplete"] + counts["corrupt"] + counts["unknown"] + self.not_understood
        text += f", {bad} incomplete or corrupt" if bad else ""
        return text + (f", {sum(self.refused.values())} datagrams of others refused" if self.refused else "")

    def _listen(self) -> None:
        while self._open:
            try:
                data, sender = self._socket.recvfrom(65536)
            except (TimeoutError, ConnectionError):
                continue
            except OSError:
                return
            if sender != self.peer:
                self._refuse(sender)
                continue
            whole = self.assembler.add(data)
            if whole is not None:
                self._take(time.monotonic(), whole)

    def _take(self, came: float, whole: bytes) -> None:
        posted = decode_picture(whole)
        if posted is None or not 0.0 <= posted.late < _LATEST:
            self.not_understood += 1
            return
        self._waiting.append((came - posted.late, posted.picture))

    def _refuse(self, sender: Address) -> None:
        key = sender if sender in self.refused or len(self.refused) < _NAMED else None
        if key is not None and key not in self.refused:
            _LOG.warning("refused pictures from %s:%d: this end listens to %s:%d alone", *sender, *self.peer)
        self.refused[key] += 1
