"""`rclpy.timer`: calls back at a fixed period."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from finssim.ros2.shim.clock import Clock
from finssim.ros2.shim.endpoint import check_callback

__all__ = ["Timer"]


class Timer:
    """Calls back at a fixed period of a clock. Made by `Node.create_timer`.

    Calls that were missed are left out, and the rhythm is kept.
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
        """Between calls [ns]."""
        return self._period

    @timer_period_ns.setter
    def timer_period_ns(self, period: int) -> None:
        self._period = int(period)

    def take(self) -> Callable[[], Any] | None:
        """The callback if it is due, and then on to the next time; None if not."""
        if self._cancelled or self.time_until_next_call() > 0:
            return None
        now = self._last = self.clock.tick()
        self._next += self._period
        if self._next <= now and self._period:
            self._next = now + self._period - (now - self._next) % self._period
        return self.callback

    def time_until_next_call(self) -> int:
        """How long until it is due [ns]; begins anew where the clock went back."""
        now = self.clock.tick()
        if now < self._last:
            self._last, self._next = now, now + self._period
        return self._next - now

    def is_ready(self) -> bool:
        """Whether it is due."""
        return not self._cancelled and self.time_until_next_call() <= 0

    def is_canceled(self) -> bool:
        """Whether it rests."""
        return self._cancelled

    def cancel(self) -> None:
        """Rest."""
        self._cancelled = True

    def reset(self) -> None:
        """Begin anew: the next call comes one period from now."""
        self._cancelled = False
        self._last = self.clock.tick()
        self._next = self._last + self._period
