"""Time as in rclpy: durations, points in time, and clocks of the system or of the topic /clock."""

from __future__ import annotations

import time
from enum import IntEnum
from functools import total_ordering
from typing import Any

from finssim.extensions.ros2.codec import codec_of
from finssim.extensions.ros2.limits import Limited


class ClockType(IntEnum):
    """Kinds of clock."""

    UNINITIALIZED = 0
    ROS_TIME = 1
    """System time, or the time of the topic /clock if `use_sim_time` is set."""
    SYSTEM_TIME = 2
    STEADY_TIME = 3
    """Never jumps; its zero is arbitrary."""


# `rclpy.duration`: durations.


@total_ordering
class Duration:
    """Duration, stored in nanoseconds; `seconds` is in [s]."""

    def __init__(self, *, seconds: float = 0, nanoseconds: int = 0) -> None:
        self.nanoseconds = int(seconds * 10**9) + int(nanoseconds)
        if not -(2**63) <= self.nanoseconds < 2**63:
            raise OverflowError(f"a duration of {self.nanoseconds} ns: expected less than 2^63")

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Duration) and self.nanoseconds == other.nanoseconds

    def __lt__(self, other: Duration) -> bool:
        return self.nanoseconds < other.nanoseconds

    def __hash__(self) -> int:
        return hash(self.nanoseconds)

    def __repr__(self) -> str:
        return f"Duration(nanoseconds={self.nanoseconds})"

    def to_msg(self) -> Any:
        """Return it as builtin_interfaces/Duration."""
        seconds, nanoseconds = divmod(self.nanoseconds, 10**9)
        return codec_of().message("builtin_interfaces/msg/Duration")(sec=seconds, nanosec=nanoseconds)

    @classmethod
    def from_msg(cls, message: Any) -> Duration:
        """Return a duration from builtin_interfaces/Duration."""
        return cls(nanoseconds=message.sec * 10**9 + message.nanosec)


Infinite = Duration(nanoseconds=2**63 - 1)

# `rclpy.time`: points in time.


@total_ordering
class Time:
    """Point in time of one clock, stored in nanoseconds; times of different clocks cannot be compared.

    `seconds` is in [s].
    """

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
        """Return full seconds, and the nanoseconds beyond them."""
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
        """Return it as builtin_interfaces/Time."""
        seconds, nanoseconds = self.seconds_nanoseconds()
        return codec_of().message("builtin_interfaces/msg/Time")(sec=seconds, nanosec=nanoseconds)

    @classmethod
    def from_msg(cls, message: Any, clock_type: ClockType = ClockType.ROS_TIME) -> Time:
        """Return a time from builtin_interfaces/Time."""
        return cls(nanoseconds=message.sec * 10**9 + message.nanosec, clock_type=clock_type)

    def _same_clock(self, other: Time) -> int:
        if self.clock_type != other.clock_type:
            raise TypeError(
                f"times of {self.clock_type.name} and {other.clock_type.name}: compare times of one clock"
            )
        return other.nanoseconds


# `rclpy.clock`: the present time of the system or of the topic /clock.


class Clock(Limited):
    """A clock.

    Args:
        clock_type: Kind of clock.
    """

    def __new__(cls, *, clock_type: ClockType = ClockType.SYSTEM_TIME) -> Any:
        clock_class = ROSClock if clock_type == ClockType.ROS_TIME else cls
        return super().__new__(clock_class)

    def __init__(self, *, clock_type: ClockType = ClockType.SYSTEM_TIME) -> None:
        self.clock_type = clock_type

    def now(self) -> Time:
        """Return the present time."""
        steady = self.clock_type == ClockType.STEADY_TIME
        return Time(nanoseconds=time.monotonic_ns() if steady else time.time_ns(), clock_type=self.clock_type)

    def tick(self) -> int:
        """Return the time of timers [ns], which does not jump when the system's time of day is set."""
        return time.monotonic_ns()

    @property
    def real(self) -> bool:
        """Return whether it runs without messages."""
        return True

    def sleep_for(self, duration: Duration) -> bool:
        """Sleep by this clock, which must run without messages."""
        time.sleep(max(duration.nanoseconds, 0) / 1e9)
        return True


class ROSClock(Clock):
    """Clock of the system time, or of /clock while a node with `use_sim_time` updates it."""

    def __init__(self, *, clock_type: ClockType = ClockType.ROS_TIME) -> None:
        super().__init__(clock_type=ClockType.ROS_TIME)
        self.ros_time_is_active = False
        self._simulated = 0

    def now(self) -> Time:
        """Return the present time; 0 while simulated time is used and none was received yet."""
        nanoseconds = self._simulated if self.ros_time_is_active else time.time_ns()
        return Time(nanoseconds=nanoseconds, clock_type=ClockType.ROS_TIME)

    def tick(self) -> int:
        return self._simulated if self.ros_time_is_active else time.monotonic_ns()

    @property
    def real(self) -> bool:
        return not self.ros_time_is_active

    def set_ros_time_override(self, when: Time) -> None:
        """Set the simulated time."""
        self._simulated = when.nanoseconds

    def sleep_for(self, duration: Duration) -> bool:
        if self.ros_time_is_active:
            raise RuntimeError("sleeping by simulated time in the thread that spins never ends: use a timer")
        return super().sleep_for(duration)
