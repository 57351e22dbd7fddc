"""`rclpy.time`: points in time."""

from __future__ import annotations

from functools import total_ordering
from typing import Any

from finssim.ros2.codec import codec_of
from finssim.ros2.shim.clock_type import ClockType
from finssim.ros2.shim.duration import Duration

__all__ = ["Time"]


@total_ordering
class Time:
    """A point in time of one clock, kept in nanoseconds; those of different clocks do not compare."""

    def __init__(
        self, *, seconds: float = 0, nanoseconds: int = 0, clock_type: ClockType = ClockType.SYSTEM_TIME
    ) -> None:
        if not isinstance(clock_type, ClockType):
            raise TypeError(f"a clock type of {clock_type!r}: expected a ClockType")
        if seconds < 0 or nanoseconds < 0:
            raise ValueError(f"a time of {seconds} s and {nanoseconds} ns: expected zero or more of both")
        self.nanoseconds = int(seconds * 10**9) + int(nanoseconds)
        self.clock_type = clock_type
        if self.nanoseconds >= 2**63:
            raise OverflowError(f"a time of {self.nanoseconds} ns: expected less than 2^63")

    def seconds_nanoseconds(self) -> tuple[int, int]:
        """Whole seconds, and the nanoseconds beyond them."""
        return divmod(self.nanoseconds, 10**9)

    def __add__(self, other: Duration) -> Time:
        if not isinstance(other, Duration):
            return NotImplemented
        return Time(nanoseconds=self.nanoseconds + other.nanoseconds, clock_type=self.clock_type)

    __radd__ = __add__

    def __sub__(self, other: Any) -> Any:
        if isinstance(other, Time):
            return Duration(nanoseconds=self.nanoseconds - self._same_clock(other))
        if isinstance(other, Duration):
            return Time(nanoseconds=self.nanoseconds - other.nanoseconds, clock_type=self.clock_type)
        return NotImplemented

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Time) and self.nanoseconds == self._same_clock(other)

    def __lt__(self, other: Time) -> bool:
        return self.nanoseconds < self._same_clock(other)

    def __hash__(self) -> int:
        return hash((self.nanoseconds, self.clock_type))

    def __repr__(self) -> str:
        return f"Time(nanoseconds={self.nanoseconds}, clock_type={self.clock_type.name})"

    def to_msg(self) -> Any:
        """As builtin_interfaces/Time."""
        seconds, nanoseconds = self.seconds_nanoseconds()
        return codec_of().message("builtin_interfaces/msg/Time")(sec=seconds, nanosec=nanoseconds)

    @classmethod
    def from_msg(cls, message: Any, clock_type: ClockType = ClockType.ROS_TIME) -> Time:
        """From builtin_interfaces/Time."""
        return cls(nanoseconds=message.sec * 10**9 + message.nanosec, clock_type=clock_type)

    def _same_clock(self, other: Time) -> int:
        if self.clock_type != other.clock_type:
            raise TypeError(
                f"times of {self.clock_type.name} and {other.clock_type.name}: compare times of one clock"
            )
        return other.nanoseconds
