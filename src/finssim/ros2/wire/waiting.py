"""Waiting for any of many endpoints at once."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from cyclonedds.core import DDSException, GuardCondition, WaitSet

from finssim.ros2.wire.endpoints import Endpoint, Reader
from finssim.ros2.wire.participant import Participant

__all__ = ["Waiter"]


class Waiter:
    """Sleeps until a watched reader has a sample, a watched endpoint meets a peer that does not fit, or `wake`."""

    def __init__(self, participant: Participant) -> None:
        self._set = WaitSet(participant.entity)
        self._guard = GuardCondition(participant.entity)
        self._set.attach(self._guard)
        self._closed = False
        self._watched: set[Endpoint] = set()

    def watch(self, endpoints: Iterable[Endpoint]) -> None:
        """Watch exactly these from now on."""
        wanted = set(endpoints)
        for endpoint in self._watched - wanted:
            if not endpoint.closed:  # DDS itself lets go of a closed one
                self._each(endpoint, self._set.detach)
        for endpoint in wanted - self._watched:
            self._each(endpoint, self._set.attach)
        self._watched = wanted

    def wait(self, timeout: float) -> bool:
        """Sleep at most `timeout` [s]; whether anything happened."""
        try:
            happened = self._set.wait(int(timeout * 1e9)) > 0
            if happened:
                self._guard.set(False)
        except DDSException:
            if not self._closed:
                raise
            return False  # another thread closed it meanwhile
        return happened

    def wake(self) -> None:
        """End the current or the next `wait`; from any thread."""
        if not self._closed:
            self._guard.set(True)

    def close(self) -> None:
        """Let everything go."""
        self._closed = True
        self._set.attached = []
        self._set.__del__()
        self._guard.__del__()

    @staticmethod
    def _each(endpoint: Endpoint, act: Callable[[Any], None]) -> None:
        act(endpoint.entity)
        if isinstance(endpoint, Reader):
            act(endpoint.condition)
