"""`rclpy.executors`: run the callbacks of nodes, one at a time, in the thread that spins."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from finssim.ros2.shim.context import Context
from finssim.ros2.shim.task import Future
from finssim.ros2.wire.waiting import Waiter

__all__ = ["ExternalShutdownException", "ShutdownException", "SingleThreadedExecutor", "TimeoutException"]

LONGEST_WAIT = 0.1
"""The longest sleep [s]: Python hears of Ctrl-C only between sleeps."""

MISMATCH_PERIOD = 1.0
"""How often a busy executor looks for peers that do not fit [s]; one that wakes for nothing looks at once."""


class ExternalShutdownException(Exception):
    """The context was shut down by somebody else while an executor spun."""


class ShutdownException(Exception):
    """The executor was shut down."""


class TimeoutException(Exception):
    """Nothing came in time."""


class SingleThreadedExecutor:
    """Runs callbacks one at a time.

    Args:
        context: Whose nodes; that of `rclpy.init()` where none is given.
    """

    def __init__(self, *, context: Context | None = None) -> None:
        from finssim.ros2.shim.utilities import get_default_context

        self.context = context or get_default_context()
        self._waiter = Waiter(self.context.participant)
        self.context.add_waiter(self._waiter)
        self._nodes: list[Any] = []
        self._round: Iterator[Callable[[], Any]] = iter(())
        self._watching: tuple[int, tuple[int, ...]] = (-1, ())
        self._looked = 0.0
        self._stopped = self._spins = False

    def add_node(self, node: Any) -> bool:
        """Run a node's callbacks too; whether it is new."""
        if node in self._nodes:
            return False
        self._nodes.append(node)
        self.wake()
        return True

    def remove_node(self, node: Any) -> None:
        """Leave a node alone."""
        if node in self._nodes:
            self._nodes.remove(node)

    def get_nodes(self) -> list[Any]:
        """The nodes whose callbacks it runs."""
        return list(self._nodes)

    def wake(self) -> None:
        """End the current wait; from any thread."""
        self._waiter.wake()

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """Stop spinning."""
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
        """Run one callback, waiting for it if need be.

        Args:
            timeout_sec: Longest wait [s]; for ever where it is None or negative.

        Raises:
            ExternalShutdownException: The context was shut down while waiting.
            RuntimeError: It spins already, as within a callback.
        """
        with self._spinning():
            self._spin_once(timeout_sec)

    def spin_until_future_complete(self, future: Future, timeout_sec: float | None = None) -> None:
        """Run callbacks until an answer has come, or a time has passed [s]."""
        end = float("inf") if timeout_sec is None or timeout_sec < 0 else time.monotonic() + timeout_sec
        future.add_done_callback(lambda _: self.wake())
        with self._spinning():
            while self.context.ok() and not self._stopped and not future.done():
                left = end - time.monotonic()
                if left <= 0:
                    return
                self._spin_once(min(left, LONGEST_WAIT))

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
            left = end - time.monotonic()
            if left <= 0:
                return
            happened = self._wait(left)
            work = self._search()
            self._tell_mismatches(now=happened and work is None)
        if work is not None:
            work()

    def _search(self) -> Callable[[], Any] | None:
        """Begin a new round over everything that may have work; the first that has."""
        if not self.context.ok():
            raise ExternalShutdownException("the context was shut down while an executor spun")
        self._round = self._work()
        return next(self._round, None)

    def _work(self) -> Iterator[Callable[[], Any]]:
        """One piece of work from each that has some: timers first, as they were due."""
        for node in list(self._nodes):
            for source in (*sorted(node.timers, key=lambda t: t.time_until_next_call()), *node.takers()):
                # Between two pieces anything may have left: the node this executor, or the context the wire.
                if node not in self._nodes or not self.context.ok():
                    break
                work = source.take()
                if work is not None:
                    yield work

    def _wait(self, longest: float) -> bool:
        """Sleep until something happens, a timer is due or `longest` [s] has passed; whether anything happened."""
        key = (self.context.changes, tuple(id(node) for node in self._nodes))
        if key != self._watching:
            self._waiter.watch(wire for node in self._nodes for end in node.endpoints() for wire in end.wires)
            self._watching = key
        timers = [t for node in self._nodes for t in node.timers if t.clock.real and not t.is_canceled()]
        due = min((t.time_until_next_call() for t in timers), default=10**18) / 1e9
        return self._waiter.wait(max(min(longest, due, LONGEST_WAIT), 0.0))

    def _tell_mismatches(self, *, now: bool) -> None:
        if now or time.monotonic() - self._looked > MISMATCH_PERIOD:
            self._looked = time.monotonic()
            for node in self._nodes:
                for end in node.endpoints():
                    end.tell_mismatches()


def __getattr__(name: str) -> Any:
    if name in ("MultiThreadedExecutor", "Executor", "EventsExecutor"):
        raise ImportError(f"rclpy.executors.{name} needs a sourced ROS 2: use SingleThreadedExecutor")
    raise AttributeError(f"rclpy.executors has no '{name}'")
