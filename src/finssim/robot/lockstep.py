"""Lock-step: the robot's software and a world take turns, so that time goes as fast as both can compute."""

from __future__ import annotations

import itertools
import socket
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from typing import Protocol

from finssim.robot.interrupt import interruptible
from finssim.robot.lockstep_codec import (
    LockstepError,
    decode_delivery,
    encode_request,
    receive,
)
from finssim.robot.messages import Delivery
from finssim.robot.runtime import Runtime

__all__ = ["DEFAULT_PORT", "Carrier", "Exchange", "LockstepClient", "run_lockstep", "run_together"]

DEFAULT_PORT = 58768
"""Where a pool listens for a robot in lock-step, on this machine."""
LAST_FRAMES = 3
"""Frames without thrust that a run ends with."""


class Exchange(Protocol):
    """A world that stands still until it is asked to go on."""

    def exchange(self, until: float, sent: Sequence[bytes]) -> Delivery:
        """Let the world go on.

        Args:
            until: To this time, robot's clock [s].
            sent: Datagrams to the motor controller, sent at the time of the last call.

        Returns:
            What has reached the robot's computer meanwhile.
        """


class Carrier(Protocol):
    """Brings datagrams from one robot to the others."""

    def send(self, now: float, sender: str, datagram: bytes) -> None:
        """Take one at a time [s]."""

    def receive(self, now: float, name: str) -> Sequence[bytes]:
        """What has reached a robot by a time [s]."""


class LockstepClient:
    """A world in another process, over TCP."""

    def __init__(self, address: str = f"127.0.0.1:{DEFAULT_PORT}", *, timeout: float = 60.0) -> None:
        """Connect.

        Args:
            address: HOST:PORT of `finssim pool --lockstep`.
            timeout: Longest silence [s].

        Raises:
            LockstepError: Nobody answers there.
        """
        host, _, port = address.rpartition(":")
        self.address = address
        try:
            self._connection = socket.create_connection((host or "127.0.0.1", int(port)), timeout=timeout)
        except (OSError, ValueError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            raise LockstepError(
                f"no world in lock-step at {address} ({reason}): start one with finssim pool --lockstep"
            ) from None
        self._connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def exchange(self, until: float, sent: Sequence[bytes]) -> Delivery:
        """Let the world go on; see `Exchange`.

        Raises:
            LockstepError: It refused, fell silent or has gone.
        """
        try:
            self._connection.sendall(encode_request(until, sent))
            message = receive(self._connection)
        except OSError as error:
            reason = "silent for too long" if isinstance(error, TimeoutError) else error.strerror or error
            raise LockstepError(
                f"the world at {self.address} does not answer ({reason}): look at what its process says"
            ) from None
        if message is None:
            raise LockstepError(f"the world at {self.address} has gone: look at what its process says")
        return decode_delivery(*message)

    def close(self) -> None:
        """Let go of the world."""
        self._connection.close()

    def __enter__(self) -> LockstepClient:
        return self

    def __exit__(self, *problem: object) -> None:
        self.close()


def run_lockstep(
    runtime: Runtime,
    world: Exchange,
    duration: float,
    *,
    rate: float = 60.0,
    start: float = 0.0,
    gentle: bool = False,
    show: Callable[[Runtime], None] | None = None,
    until: Callable[[Runtime], bool] | None = None,
) -> float:
    """Run a robot against a world until the time is over or `until` says so; then stop its thrusters.

    Args:
        runtime: The robot.
        world: Its world, which stands at `start`.
        duration: How long [s].
        rate: Steps a second [Hz].
        start: Robot's clock at the beginning [s].
        gentle: Ctrl-C and SIGTERM end the run as its time does. Else they interrupt it, so that a trial that was
            cut short is not taken for a whole one.
        show: Called after every step.
        until: Ends the run early where it says so; asked after every step.

    Returns:
        Robot's clock at the end [s].
    """
    return run_together(
        {"": (runtime, world)},
        duration,
        rate=rate,
        start=start,
        gentle=gentle,
        show=None if show is None else lambda: show(runtime),
        until=None if until is None else lambda: until(runtime),
    )


def run_together(
    stacks: Mapping[str, tuple[Runtime, Exchange]],
    duration: float,
    *,
    carrier: Carrier | None = None,
    rate: float = 60.0,
    start: float = 0.0,
    gentle: bool = False,
    show: Callable[[], None] | None = None,
    until: Callable[[], bool] | None = None,
) -> float:
    """Run several robots, each against its world, on one clock; as `run_lockstep`.

    Args:
        stacks: Robot and world by name.
        duration: How long [s].
        carrier: Of what the robots tell each other; None: they tell nothing.
        rate: Steps a second [Hz].
        start: Robots' clock at the beginning [s].
        gentle: As of `run_lockstep`.
        show: Called after every step of all.
        until: Ends the run early where it says so; asked after every step of all.

    Returns:
        Robots' clock at the end [s].
    """
    now: float = start
    sent: dict[str, list[bytes]] = {name: [] for name in stacks}
    with interruptible() if gentle else nullcontext(_never) as interrupted:
        for k in itertools.count(1):
            if interrupted() or k > duration * rate + 1e-6:
                break
            deliveries = {
                name: world.exchange(start + k / rate, sent[name]) for name, (_, world) in stacks.items()
            }
            for name, (runtime, _) in stacks.items():
                delivery = deliveries[name]
                now = delivery.time
                heard = carrier.receive(now, name) if carrier is not None else ()
                sent[name] = runtime.step(now, delivery.frames, delivery.pictures, heard)
                runtime.sent(now)
            for name, (runtime, _) in stacks.items() if carrier is not None else ():
                for datagram in runtime.told:
                    carrier.send(now, name, datagram)
            if show is not None:
                show()
            if until is not None and until():
                break
    # A world that broke off above stands still: only one that goes on needs to hear of the end.
    last = [
        world.exchange(now + 1.0 / rate, runtime.stop(now, LAST_FRAMES)).time
        for runtime, world in stacks.values()
    ]
    return last[0]


def _never() -> bool:
    return False
