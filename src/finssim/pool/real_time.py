"""A virtual pool in real time, on open wires to robots in other processes."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

from finssim.core import realtime
from finssim.pool.fleet import Fleet, one_picture
from finssim.pool.pictures import UdpSender
from finssim.robot.links.transports import Transport
from finssim.robot.messages import Picture

TICK = 0.003
"""Between looks at the wire [s]."""
MOST_BEHIND = 0.2
"""Delay beyond which a pool gives up that time [s]: its clock stops instead, as on a stopped computer."""


class Clocked(Protocol):
    """A camera that must know when the pool's clock began."""

    start: float
    """Time at which the pool's clock began, on the clock of the process [s]."""


@dataclass
class Pace:
    """Measure of a pool's real-time performance."""

    duration: float = 0.0
    """Duration by the pool's clock [s]."""
    late: float = 0.0
    """The most that the pool was behind at a tick [s]."""
    given_up: float = 0.0
    """Time that the pool stood still because it was too far behind [s]."""
    received: int = 0
    """Frames from the robot."""
    sent: int = 0
    """Frames to it."""
    pictures: int = 0
    """Number of pictures that were sent from this process."""

    @property
    def sentence(self) -> str:
        """Return the summary for a person."""
        pace_text = f"gave up {self.given_up:.2f} s" if self.given_up else "kept real time"
        return (
            f"{self.duration:.1f} s, {pace_text}, at most {1e3 * self.late:.0f} ms late; "
            f"{self.received} frames in, {self.sent} out"
        )


RATE = 60.0
"""Steps a second of the software of vehicles that the task commands [Hz]."""


class MessageEnd(Protocol):
    """The medium's end for robots in other processes."""

    def poll(self, now: float) -> None:
        """Take what was sent and deliver what has arrived, at the site's clock [s]."""


class PoolTiming:
    """Clock of a pool, and the medium of a team: those of this machine. A program that has its own derives a class."""

    paced = False
    """True if time waits for the pool, so that its cameras draw within a step."""

    def now(self) -> float:
        """Return the time [s]."""
        return realtime.now()

    def wait(self, duration: float, until: Callable[[], bool]) -> None:
        """Wait for a duration [s], or until a function returns true."""
        realtime.wait(duration)

    def messages(self, fleet: Fleet) -> MessageEnd | None:
        """Return the medium's end for the robots of a team; None: they exchange nothing."""
        return None


@dataclass(frozen=True)
class SiteWires:
    """Open wires of a site, to robots in other processes."""

    transports: Mapping[str, Transport]
    """Vehicle -> wire to its robot, from the motor controller's end."""
    messages: MessageEnd | None = None
    """Messages between the robots; None: they tell each other nothing."""
    sinks: Sequence[UdpSender] = ()
    """Take the one camera's pictures, one for each robot."""
    camera: Clocked | None = None
    """Camera that sends its pictures itself."""


def serve_realtime(
    site: Fleet,
    wires: SiteWires,
    *,
    duration: float = math.inf,
    until: Callable[[], bool] = lambda: False,
    over: Callable[[], None] = lambda: None,
    clock: Callable[[], float] = realtime.now,
    wait: Callable[[float], None] = realtime.wait,
) -> Pace:
    """Run a site in real time until the time is over or `until` returns true.

    Args:
        site: With robots in other processes, at time 0.
        wires: Its open wires.
        duration: How long [s].
        until: Ends it where it says so; asked at every tick.
        over: Called once, when the site says that it is over; it lives on.
        clock: This machine's clock [s].
        wait: Waits so long [s].
    """
    pace, start, now = Pace(), clock(), 0.0
    sent: dict[str, list[bytes]] = {name: [] for name in site.runtimes}
    frames: dict[str, list[tuple[float, bytes]]] = {name: [] for name in site.runtimes}
    steps, announced = 0, False
    while now < duration and not until():
        behind = clock() - start - now
        if behind > MOST_BEHIND:
            pace.given_up += behind - TICK
            start += behind - TICK
        if wires.camera is not None:
            wires.camera.start = start
        now = min(max(clock() - start, now), duration)
        pictures: list[Picture] = []
        for name, transport in wires.transports.items():
            received = transport.receive()
            delivery = site.worlds[name].exchange(now, received)
            pictures += delivery.pictures
            for _, frame in delivery.frames:
                transport.send(frame)
            pace.received, pace.sent = pace.received + len(received), pace.sent + len(delivery.frames)
        for picture in one_picture(pictures):
            for sink in wires.sinks:
                sink.send(replace(picture, time=start + picture.time), clock())
                pace.pictures += 1
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
        if wires.messages is not None:
            wires.messages.poll(now)
        site.turn(now, due)
        if site.over and not announced:
            announced = True
            over()
        pace.duration, done = now, clock() - start
        pace.late = max(pace.late, done - now) if now > 1.0 else pace.late
        wait(max(TICK - (done - now), 0.0))
    return pace
