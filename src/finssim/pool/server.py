"""A virtual pool for a robot in another process: in real time on its wires, or in lock-step over TCP."""

from __future__ import annotations

import math
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Protocol

from finssim.pool.picture_wire import PictureSink
from finssim.pool.virtual_pool import PoolClockError, VirtualPool
from finssim.robot.link.frames import LinkError
from finssim.robot.link.transports import Transport
from finssim.robot.lockstep import (
    LockstepError,
    decode_request,
    encode_delivery,
    encode_refusal,
    receive,
)

__all__ = ["LockstepServer", "Pace", "serve_realtime"]

TICK = 0.003
"""Between looks at the wire [s]."""
MOST_BEHIND = 0.2
"""A pool that is further behind gives up that time [s]: its clock stands still instead, as on a stopped computer."""


class Clocked(Protocol):
    """A camera that must know when the pool's clock began."""

    start: float


@dataclass
class Pace:
    """How well a pool kept real time."""

    duration: float = 0.0
    """Of the pool's clock [s]."""
    late: float = 0.0
    """The most that the pool was behind at a tick [s]."""
    given_up: float = 0.0
    """Time that the pool stood still because it was too far behind [s]."""
    received: int = 0
    """Frames from the robot."""
    sent: int = 0
    """Frames to it."""
    pictures: int = 0
    """That were sent from this process."""

    @property
    def sentence(self) -> str:
        """What a person wants to know."""
        kept = f"gave up {self.given_up:.2f} s" if self.given_up else "kept real time"
        return (
            f"{self.duration:.1f} s, {kept}, at most {1e3 * self.late:.0f} ms late; "
            f"{self.received} frames in, {self.sent} out"
        )


def serve_realtime(
    world: VirtualPool,
    transport: Transport,
    *,
    sink: PictureSink | None = None,
    camera: Clocked | None = None,
    duration: float = math.inf,
    until: Callable[[Pace], bool] | None = None,
    clock: Callable[[], float] = time.monotonic,
    wait: Callable[[float], None] = time.sleep,
) -> Pace:
    """Let a pool live in real time until the time is over or `until` says so.

    Args:
        world: The pool, at time 0.
        transport: To the robot, from the motor controller's end.
        sink: Takes the pictures that the world's own camera makes.
        camera: One that sends its pictures itself.
        duration: How long [s].
        until: Ends it where it says so; asked at every tick.
        clock: This machine's clock [s].
        wait: Waits so long [s].
    """
    pace, start = Pace(), clock()
    while world.time < duration and not (until is not None and until(pace)):
        now = clock()
        behind = now - start - world.time
        if behind > MOST_BEHIND:
            pace.given_up += behind - TICK
            start += behind - TICK
        if camera is not None:
            camera.start = start
        sent = transport.receive()
        delivery = world.exchange(min(now - start, duration), sent)
        for _, frame in delivery.frames:
            transport.send(frame)
        for picture in delivery.pictures if sink is not None else ():
            sink.send(replace(picture, time=start + picture.time), clock())
            pace.pictures += 1
        pace.received, pace.sent = pace.received + len(sent), pace.sent + len(delivery.frames)
        pace.duration = world.time
        done = clock() - start
        pace.late = max(pace.late, done - world.time) if pace.duration > 1.0 else pace.late
        wait(max(TICK - (done - world.time), 0.0))
    return pace


class LockstepServer:
    """A pool whose clock goes on as far as its one robot asks, and ends when the robot leaves."""

    def __init__(self, address: tuple[str, int]) -> None:
        """Listen.

        Args:
            address: Host and port; port 0 takes a free one (see `address`).

        Raises:
            LinkError: It cannot be bound.
        """
        self._listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            self._listener.bind(address)
        except OSError as problem:
            self._listener.close()
            raise LinkError(
                f"cannot bind {address[0]}:{address[1]} ({problem.strerror or problem}): "
                "end the program that has it, or give another port"
            ) from None
        self._listener.listen(1)
        self.address: tuple[str, int] = self._listener.getsockname()

    def serve(self, world: VirtualPool, *, duration: float = math.inf) -> str:
        """Wait for a robot and serve it; nobody else is let in.

        Args:
            world: The pool.
            duration: Longest time of the pool's clock [s]; a request beyond it is refused.

        Returns:
            Why it ended, in a few words.
        """
        connection, robot = self._listener.accept()
        self.close()
        with connection:
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            try:
                while (message := receive(connection)) is not None:
                    until, sent = decode_request(*message)
                    if until > duration + 1e-9:
                        connection.sendall(encode_refusal(f"the pool ends at {duration:g} s, as it was told"))
                        return "the time is over"
                    connection.sendall(encode_delivery(world.exchange(until, sent)))
            except (LockstepError, PoolClockError) as problem:
                with suppress(OSError):  # it may not wait for the answer
                    connection.sendall(encode_refusal(str(problem)))
                return f"{robot[0]}:{robot[1]} was refused: {problem}"
            except OSError as problem:
                return f"the robot has gone: {problem.strerror or problem}"
        return "the robot has left"

    def close(self) -> None:
        """Stop listening."""
        self._listener.close()
