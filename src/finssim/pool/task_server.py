"""`finssim pool --team` and `--task`: several vehicles in real time, with a motor controller for each on its port."""

from __future__ import annotations

import math
import socket
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace

from finssim.pool.fleet import Fleet, one_picture
from finssim.pool.medium import Medium
from finssim.pool.picture_wire import PictureSink
from finssim.robot.link.frames import LinkError
from finssim.robot.link.transports import Transport
from finssim.robot.messages import Picture
from finssim.robot.team import decode_track

__all__ = ["MediumServer", "serve_fleet"]

TICK = 0.003
"""Between looks at the wires [s]."""
MOST_BEHIND = 0.2
"""A site that is further behind gives up that time [s]."""
RATE = 60.0
"""Steps a second of the software of vehicles that the task commands [Hz]."""
LARGEST = 2048
"""Bytes taken of a datagram."""


class MediumServer:
    """A medium's end for robots in other processes: who sends under a name is answered under it."""

    def __init__(self, address: tuple[str, int], medium: Medium, names: tuple[str, ...]) -> None:
        """Listen.

        Args:
            address: Host and port; port 0 takes a free one (see `address`).
            medium: That carries the messages.
            names: Who may send.

        Raises:
            LinkError: It cannot be bound.
        """
        self._medium, self._names = medium, frozenset(names)
        self._robots: dict[str, tuple[str, int]] = {}
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            self._socket.bind(address)
        except OSError as problem:
            self._socket.close()
            raise LinkError(
                f"cannot bind {address[0]}:{address[1]} ({problem.strerror or problem}): "
                "end the program that has it, or give another port"
            ) from None
        self.address: tuple[str, int] = self._socket.getsockname()

    def poll(self, now: float) -> None:
        """Take what has come and send what has arrived, at the site's clock [s]."""
        with suppress(BlockingIOError, ConnectionError):
            while True:
                data, sender = self._socket.recvfrom(LARGEST)
                heard = decode_track(data, now)
                if heard is not None and heard[0] in self._names:
                    self._robots[heard[0]] = sender
                    self._medium.send(now, heard[0], data)
        for name in self._names:  # what reaches a robot that has not spoken yet is lost
            for data in self._medium.receive(now, name):
                if name in self._robots:
                    with suppress(OSError):
                        self._socket.sendto(data, self._robots[name])

    def close(self) -> None:
        """Stop listening."""
        self._socket.close()


def serve_fleet(
    site: Fleet,
    transports: Mapping[str, Transport],
    messages: MediumServer | None = None,
    *,
    sinks: Sequence[PictureSink] = (),
    duration: float = math.inf,
    until: Callable[[], bool] = lambda: False,
    over: Callable[[], None] = lambda: None,
    clock: Callable[[], float] = time.monotonic,
    wait: Callable[[float], None] = time.sleep,
) -> float:
    """Let the site live in real time until the time is over or `until` says so.

    Args:
        site: With robots in other processes.
        transports: To the robot of each of these vehicles, by name.
        messages: Between the robots; None: they tell each other nothing.
        sinks: Take the one camera's pictures, one for each robot.
        duration: How long [s].
        until: Asked at every tick.
        over: Called once, when the site says that it is over; it lives on.
        clock: This machine's clock [s].
        wait: Waits so long [s].

    Returns:
        Site's clock at the end [s].
    """
    start, now = clock(), 0.0
    sent: dict[str, list[bytes]] = {name: [] for name in site.runtimes}
    frames: dict[str, list[tuple[float, bytes]]] = {name: [] for name in site.runtimes}
    steps, told = 0, False
    while now < duration and not until():
        behind = clock() - start - now
        if behind > MOST_BEHIND:
            start += behind - TICK
        now = min(max(clock() - start, now), duration)
        pictures: list[Picture] = []
        for name, transport in transports.items():
            delivery = site.worlds[name].exchange(now, transport.receive())
            pictures += delivery.pictures
            for _, frame in delivery.frames:
                transport.send(frame)
        for picture in one_picture(pictures):
            for sink in sinks:
                sink.send(replace(picture, time=start + picture.time), clock())
        due = now * RATE >= steps + 1
        for name, runtime in site.runtimes.items():
            delivery = site.worlds[name].exchange(now, sent[name])
            sent[name], frames[name] = [], frames[name] + list(delivery.frames)
            if due and site.medium is not None:
                sent[name] = runtime.step(now, frames[name], (), site.medium.receive(now, name))
                frames[name] = []
                for datagram in runtime.told:
                    site.medium.send(now, name, datagram)
        steps = math.floor(now * RATE)
        if messages is not None:
            messages.poll(now)
        site.turn(now, due)
        if site.over and not told:
            told = True
            over()
        wait(max(TICK - (clock() - start - now), 0.0))
    return now
