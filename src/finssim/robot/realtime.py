"""The outermost loop of a robot in real time: the only place that reads a clock and waits."""

from __future__ import annotations

import gc
import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from finssim.robot.interrupt import interruptible
from finssim.robot.link.transports import Transport
from finssim.robot.runtime import Runtime

if TYPE_CHECKING:
    from finssim.robot.picture_source import PictureSource

__all__ = ["run_realtime"]

LAST_FRAMES = 3
"""Frames without thrust that a run ends with."""
COLLECT_EVERY = 1.0
"""Time between two rounds of the garbage collector, which are made where there is time to spare [s]."""
ENOUGH_SLACK = 0.004
"""Time to spare for one [s]."""
SWITCH = 0.001
"""The longest that another thread keeps Python to itself [s]."""


def run_realtime(
    runtime: Runtime,
    transport: Transport,
    pictures: PictureSource | None = None,
    *,
    mates: Transport | None = None,
    rate: float = 60.0,
    duration: float = math.inf,
    until: Callable[[Runtime], bool] | None = None,
    show: Callable[[Runtime], None] | None = None,
    clock: Callable[[], float] = time.monotonic,
    wait: Callable[[float], None] = time.sleep,
) -> float:
    """Run a robot on its wires until the time is over, `until` says so, or Ctrl-C; then stop its thrusters.

    Deadlines are multiples of the period since the start, so that nothing drifts. A step that is late is counted as an
    overrun; the deadlines that it missed are left out.

    Args:
        runtime: The robot.
        transport: To the motor controller.
        pictures: From the camera; None: there is none.
        mates: To what carries messages between vehicles; None: this one is alone.
        rate: Steps a second [Hz].
        duration: How long [s].
        until: Ends the run where it says so; asked after every step.
        show: Called after every step.
        clock: The robot's clock [s].
        wait: Waits so long [s].

    Returns:
        How long it ran [s].
    """
    period, turn = 1.0 / rate, 0
    with _calm(), interruptible() as interrupted:
        now = start = collected = clock()  # after the garbage of the start, which takes its time
        try:
            while not interrupted() and (now := clock()) - start < duration:
                frames = [(now, data) for data in transport.receive()]
                heard = mates.receive() if mates is not None else ()
                for data in runtime.step(now, frames, pictures.receive(now) if pictures else (), heard):
                    transport.send(data)
                for data in runtime.told if mates is not None else ():
                    mates.send(data)
                runtime.sent(clock())
                if show is not None:
                    show(runtime)
                if until is not None and until(runtime):
                    break
                turn += 1
                slack = start + turn * period - clock()
                if slack > ENOUGH_SLACK and now - collected > COLLECT_EVERY:
                    gc.collect(1)
                    collected, slack = now, start + turn * period - clock()
                if slack < 0.0:
                    runtime.counters.overruns += 1
                    turn += math.floor(-slack / period)
                else:
                    wait(slack)
        finally:
            for data in runtime.stop(clock(), LAST_FRAMES):
                transport.send(data)
                wait(period)
        return now - start


@contextmanager
def _calm() -> Iterator[None]:
    """Keep the garbage collector and other threads from holding up the loop."""
    enabled, interval = gc.isenabled(), sys.getswitchinterval()
    gc.collect()
    gc.freeze()
    gc.disable()
    sys.setswitchinterval(SWITCH)
    try:
        yield
    finally:
        sys.setswitchinterval(interval)
        gc.unfreeze()
        if enabled:
            gc.enable()
