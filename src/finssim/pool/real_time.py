"""Virtual pool in real time, with open links to robots in other processes."""

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
"""Period at which the links are polled [s]."""
MOST_BEHIND = 0.2
"""Delay beyond which a pool skips the lost time [s]: its clock stops instead, as on a stopped computer."""


class Clocked(Protocol):
    """Camera that needs the start time of the pool's clock."""

    start: float
    """Time at which the pool's clock started, on the clock of the process [s]."""


@dataclass
class Pace:
    """Measure of a pool's real-time performance."""

    duration: float = 0.0
    """Duration by the pool's clock [s]."""
    late: float = 0.0
    """Largest delay of a tick [s]."""
    given_up: float = 0.0
    """Total time for which the pool's clock stopped because it was too late [s]."""
    received: int = 0
    """Number of frames from the robot."""
    sent: int = 0
    """Number of frames to the robot."""
    pictures: int = 0
    """Number of pictures sent from this process."""

    @property
    def sentence(self) -> str:
        """Return the summary for a person."""
        pace_text = f"gave up {self.given_up:.2f} s" if self.given_up else "kept real time"
        return (
            f"{self.duration:.1f} s, {pace_text}, at most {1e3 * self.late:.0f} ms late; "
            f"{self.received} frames in, {self.sent} out"
        )


RATE = 60.0
"""Step rate of the software of the vehicles that the site controls [Hz]."""


class MessageEnd(Protocol):
    """End of the medium for robots in other processes."""

    def poll(self, now: float) -> None:
        """Receive new messages and deliver arrived ones, at a time of the site's clock [s]."""


class PoolTiming:
    """Clock of a pool and medium of a team, here those of this machine; a program with its own clock derives a
    class."""

    paced = False
    """True if the clock waits for the pool; the cameras then render in the pool's process."""

    def now(self) -> float:
        """Return the time [s]."""
        return realtime.now()

    def wait(self, duration: float, until: Callable[[], bool]) -> None:
        """Wait for a duration [s], or until a function returns true."""
        realtime.wait(duration)

    def messages(self, fleet: Fleet) -> MessageEnd | None:
        """Return the medium's end for the robots of a team; None means no messages."""
        return None


@dataclass(frozen=True)
class SiteWires:
    """Open links of a site to robots in other processes."""

    transports: Mapping[str, Transport]
    """Vehicle -> link to its robot, at the motor controller's end."""
    messages: MessageEnd | None = None
    """Messages between the robots; None means no messages."""
    sinks: Sequence[UdpSender] = ()
    """Senders of the overhead camera's pictures, one for each robot."""
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
    """Run a site in real time for a duration, or until `until` returns true.

    Args:
        site: Site with robots in other processes, at time 0.
        wires: Its open links.
        duration: Duration [s].
        until: Function that ends the run by returning true; called at every tick.
        over: Function that is called once, when the site's task is over; the run continues.
        clock: This machine's clock [s].
        wait: Function that waits for a time [s].
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
                for datagram in runtime.team_datagrams:
                    site.medium.send(now, name, datagram)
        steps = math.floor(now * RATE)
        if wires.messages is not None:
            wires.messages.poll(now)
        site.evaluate(now, due)
        if site.over and not announced:
            announced = True
            over()
        pace.duration, done = now, clock() - start
        pace.late = max(pace.late, done - now) if now > 1.0 else pace.late
        wait(max(TICK - (done - now), 0.0))
    return pace
