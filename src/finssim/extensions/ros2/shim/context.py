"""`rclpy.context`, `rclpy.signals`, `rclpy.utilities`: participant and nodes of a process from `init` to
`shutdown`."""

from __future__ import annotations

import signal
import sys
import threading
import weakref
from collections.abc import Sequence
from enum import Enum
from typing import Any

from finssim.extensions.ros2.limits import Limited
from finssim.extensions.ros2.shim.arguments import RosArguments, parse_arguments
from finssim.extensions.ros2.shim.exceptions import NotInitializedException
from finssim.extensions.ros2.shim.logging import set_logger_level
from finssim.extensions.ros2.wire import Participant, wire_settings


class SignalHandlerOptions(Enum):
    """Signals that end `spin`; SIGINT always raises KeyboardInterrupt here."""

    NO = 0
    SIGINT = 1
    SIGTERM = 2
    ALL = 3


class Context(Limited):
    """One participant of the network, which the nodes of a process share."""

    def __init__(self) -> None:
        self.arguments = RosArguments()
        self.nodes: list[Any] = []
        self.changes = 0
        """Number of endpoints that were created or destroyed."""
        self.executor: Any = None
        """Executor of `rclpy.spin`, once it was used."""
        self.asked_to_leave = False
        """True if SIGTERM was received."""
        self._participant: Participant | None = None
        self._waiters: weakref.WeakSet[Any] = weakref.WeakSet()
        self._lock = threading.RLock()

    def init(self, args: Sequence[str] | None = None, *, domain_id: int | None = None) -> None:
        """Join the network.

        Args:
            args: Command line; None: that of the process.
            domain_id: ROS domain instead of that of the environment.

        Raises:
            RuntimeError: The context has already joined.
            Ros2Error: An argument or environment variable is malformed.
        """
        if self._participant is not None:
            raise RuntimeError("Context.init() must only be called once")
        self.arguments = parse_arguments(sys.argv if args is None else args)
        for logger, level in self.arguments.levels:
            set_logger_level(logger, level)
        self._participant = Participant(wire_settings(domain=domain_id), self.arguments.enclave)

    @property
    def participant(self) -> Participant:
        """Return the participant on the network.

        Raises:
            NotInitializedException: The context has not joined, or has left.
        """
        if self._participant is None:
            raise NotInitializedException("ROS 2 is not initialized: call rclpy.init() first")
        return self._participant

    def ok(self) -> bool:
        """Return whether the context has joined, and no signal has requested its shutdown."""
        return self._participant is not None and not self.asked_to_leave

    def get_domain_id(self) -> int:
        """Return the ROS domain."""
        return self.participant.settings.domain

    def announce(self) -> None:
        """Notify peers and executors of created or destroyed nodes and endpoints."""
        with self._lock:
            self.changes += 1
            self.participant.announce([node.record() for node in self.nodes])
            self.wake()

    def add_waiter(self, waiter: Any) -> None:
        """Register an object to wake when something changes."""
        self._waiters.add(waiter)

    def wake(self) -> None:
        """End every executor's wait."""
        for waiter in list(self._waiters):
            waiter.wake()

    def shutdown(self) -> None:
        """Leave the network.

        Raises:
            RuntimeError: The context has not joined.
        """
        if self._participant is None:
            raise RuntimeError("Context.shutdown() was called on a context that is not initialized")
        self.try_shutdown()

    def try_shutdown(self) -> None:
        """Leave the network if joined."""
        with self._lock:
            participant, self._participant = self._participant, None
            if participant is None:
                return
            for waiter in list(self._waiters):
                waiter.close()
            self.nodes.clear()
            participant.close()

    def leave_on_sigterm(self) -> None:
        """Make SIGTERM end `spin` as in rclpy, unless the program handles that signal or this is not the main
        thread."""
        main = threading.current_thread() is threading.main_thread()
        if main and signal.getsignal(signal.SIGTERM) in (signal.SIG_DFL, _on_sigterm):
            _leaving[:] = [self]
            signal.signal(signal.SIGTERM, _on_sigterm)


_leaving: list[Context] = []
"""Context whose shutdown SIGTERM requests."""


def _on_sigterm(*_: Any) -> None:
    """Only set a flag: the network is left where no call on it is in progress."""
    for context in _leaving:
        context.asked_to_leave = True


# `rclpy.utilities`: the process's context, and arguments without those for ROS.


_default: list[Context] = []


def get_default_context() -> Context:
    """Return the context of `rclpy.init()`."""
    if not _default:
        _default.append(Context())
    return _default[0]


def renew_default_context() -> Context:
    """Replace the context after a shutdown, so that `rclpy.init()` can be called again."""
    _default.clear()
    return get_default_context()


def ok(*, context: Context | None = None) -> bool:
    """Return whether the context has joined."""
    return (context or get_default_context()).ok()


def shutdown(*, context: Context | None = None) -> None:
    """Leave the network."""
    (context or get_default_context()).shutdown()


def try_shutdown(*, context: Context | None = None) -> None:
    """Leave the network if joined."""
    (context or get_default_context()).try_shutdown()


def remove_ros_args(args: Sequence[str] | None = None) -> list[str]:
    """Return a command line without the arguments for ROS."""
    return parse_arguments(sys.argv if args is None else args).rest
