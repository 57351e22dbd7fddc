"""`rclpy.executors` and `rclpy.timer`: execution of callbacks, one at a time, in the thread that spins."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from finssim.extensions.ros2.limits import Limited
from finssim.extensions.ros2.shim.context import Context
from finssim.extensions.ros2.shim.endpoint import Future, check_callback
from finssim.extensions.ros2.shim.time import Clock
from finssim.extensions.ros2.wire import Waiter


class Timer(Limited):
    """Timer that calls back at a fixed period of a clock, created by `Node.create_timer`.

    Missed calls are skipped without a shift of phase.
    """

    def __init__(
        self, callback: Callable[[], Any], timer_period_ns: int, clock: Clock, *, autostart: bool = True
    ) -> None:
        check_callback(callback, takes=0)
        if timer_period_ns < 0:
            raise RuntimeError(f"timer period {timer_period_ns / 1e9} s: expected zero or more")
        self.callback, self.clock, self._period = callback, clock, timer_period_ns
        self._cancelled = not autostart
        self._last = clock.tick()
        self._next = self._last + timer_period_ns

    @property
    def timer_period_ns(self) -> int:
        """Period [ns]."""
        return self._period

    @timer_period_ns.setter
    def timer_period_ns(self, period: int) -> None:
        self._period = int(period)

    def take(self) -> Callable[[], Any] | None:
        """Return the callback if it is due, and schedule the next call; None if not."""
        if self._cancelled or self.time_until_next_call() > 0:
            return None
        now = self._last = self.clock.tick()
        self._next += self._period
        if self._next <= now and self._period:
            self._next = now + self._period - (now - self._next) % self._period
        return self.callback

    def time_until_next_call(self) -> int:
        """Return the time until it is due [ns]; it restarts if the clock went back."""
        now = self.clock.tick()
        if now < self._last:
            self._last, self._next = now, now + self._period
        return self._next - now

    def is_ready(self) -> bool:
        """Return whether it is due."""
        return not self._cancelled and self.time_until_next_call() <= 0

    def is_canceled(self) -> bool:
        """Return whether it is cancelled."""
        return self._cancelled

    def cancel(self) -> None:
        """Cancel the timer."""
        self._cancelled = True

    def reset(self) -> None:
        """Restart: the next call is one period from now."""
        self._cancelled = False
        self._last = self.clock.tick()
        self._next = self._last + self._period


# `rclpy.executors`: execution of callbacks in the thread that spins.


LONGEST_WAIT = 0.1
"""Longest sleep [s]: Python handles Ctrl-C only between sleeps."""

MISMATCH_PERIOD = 1.0
"""Period at which a busy executor checks for incompatible peers [s]; an idle one checks immediately."""


class ExternalShutdownException(Exception):
    """Shutdown of the context by another caller while an executor spins."""


class SingleThreadedExecutor(Limited):
    """Executor that runs callbacks one at a time.

    Args:
        context: Context of the nodes; None: that of `rclpy.init()`.
    """

    def __init__(self, *, context: Context | None = None) -> None:
        from finssim.extensions.ros2.shim.context import get_default_context

        self.context = context or get_default_context()
        self._waiter = Waiter(self.context.participant)
        self.context.add_waiter(self._waiter)
        self._nodes: list[Any] = []
        self._round: Iterator[Callable[[], Any]] = iter(())
        self._watching: tuple[int, tuple[int, ...]] = (-1, ())
        self._looked = 0.0
        self._stopped = self._spins = False

    def add_node(self, node: Any) -> bool:
        """Add a node whose callbacks are run; return whether it is new."""
        if node in self._nodes:
            return False
        self._nodes.append(node)
        self.wake()
        return True

    def remove_node(self, node: Any) -> None:
        """Remove a node."""
        if node in self._nodes:
            self._nodes.remove(node)

    def get_nodes(self) -> list[Any]:
        """Return the nodes whose callbacks are run."""
        return list(self._nodes)

    def wake(self) -> None:
        """End the current wait; may be called from any thread."""
        self._waiter.wake()

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """Stop spinning. The timeout [s] is ignored."""
        self._stopped = True
        self.wake()
        return True

    def spin(self) -> None:
        """Run callbacks until the context or this executor is shut down.

        Raises:
            ExternalShutdownException: The context was shut down from outside its callbacks.
        """
        with self._spinning():
            while self.context.ok() and not self._stopped:
                self._spin_once(None)
        if self.context.asked_to_leave:
            raise ExternalShutdownException("SIGTERM came while an executor spun")

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Run one callback, waiting for it if necessary.

        Args:
            timeout_sec: Longest wait [s]; infinite if None or negative.

        Raises:
            ExternalShutdownException: The context was shut down while waiting.
            RuntimeError: The executor is already spinning, as within a callback.
        """
        with self._spinning():
            self._spin_once(timeout_sec)

    def spin_until_future_complete(self, future: Future, timeout_sec: float | None = None) -> None:
        """Run callbacks until a future is done, or a time has passed [s]."""
        end = float("inf") if timeout_sec is None or timeout_sec < 0 else time.monotonic() + timeout_sec
        future.add_done_callback(lambda _: self.wake())
        with self._spinning():
            while self.context.ok() and not self._stopped and not future.done():
                remaining = end - time.monotonic()
                if remaining <= 0:
                    return
                self._spin_once(min(remaining, LONGEST_WAIT))

    @contextmanager
    def _spinning(self) -> Iterator[None]:
        if self._spins:
            raise RuntimeError("Executor is already spinning: wait for an answer by a callback of its future")
        self._spins = True
        try:
            yield
        finally:
            self._spins = False

    def _spin_once(self, timeout_sec: float | None) -> None:
        endless = timeout_sec is None or timeout_sec < 0
        end = float("inf") if endless else time.monotonic() + (timeout_sec or 0.0)
        work = next(self._round, None) or self._search()
        while work is None and not self._stopped:
            remaining = end - time.monotonic()
            if remaining <= 0:
                return
            happened = self._wait(remaining)
            work = self._search()
            self._log_mismatches(now=happened and work is None)
        if work is not None:
            work()

    def _search(self) -> Callable[[], Any] | None:
        """Begin a new round over everything that may have work; return the first work."""
        if not self.context.ok():
            raise ExternalShutdownException("the context was shut down while an executor spun")
        self._round = self._work()
        return next(self._round, None)

    def _work(self) -> Iterator[Callable[[], Any]]:
        """Yield one piece of work from each object that has some: timers first, in the order in which they
        were due."""
        for node in list(self._nodes):
            for source in (*sorted(node.timers, key=lambda t: t.time_until_next_call()), *node.takers()):
                # Between two pieces, a node may have left this executor, or the context the network.
                if node not in self._nodes or not self.context.ok():
                    break
                work = source.take()
                if work is not None:
                    yield work

    def _wait(self, longest: float) -> bool:
        """Sleep until an event, a due timer or for `longest` [s]; return whether there was an event."""
        key = (self.context.changes, tuple(id(node) for node in self._nodes))
        if key != self._watching:
            self._waiter.watch(wire for node in self._nodes for end in node.endpoints() for wire in end.wires)
            self._watching = key
        timers = [t for node in self._nodes for t in node.timers if t.clock.real and not t.is_canceled()]
        due = min((t.time_until_next_call() for t in timers), default=10**18) / 1e9
        return self._waiter.wait(max(min(longest, due, LONGEST_WAIT), 0.0))

    def _log_mismatches(self, *, now: bool) -> None:
        if now or time.monotonic() - self._looked > MISMATCH_PERIOD:
            self._looked = time.monotonic()
            for node in self._nodes:
                for end in node.endpoints():
                    end.log_mismatches()
