"""`rclpy.clock`: what time it is, by the system or by the topic /clock."""

from __future__ import annotations

import time
from typing import Any

from finssim.ros2.shim.clock_type import ClockType
from finssim.ros2.shim.duration import Duration
from finssim.ros2.shim.time import Time

__all__ = ["Clock", "ClockType", "ROSClock"]


class Clock:
    """A clock.

    Args:
        clock_type: What it counts.
    """

    def __new__(cls, *, clock_type: ClockType = ClockType.SYSTEM_TIME) -> Any:
        wanted = ROSClock if clock_type == ClockType.ROS_TIME else cls
        return super().__new__(wanted)

    def __init__(self, *, clock_type: ClockType = ClockType.SYSTEM_TIME) -> None:
        self.clock_type = clock_type

    def now(self) -> Time:
        """The present."""
        steady = self.clock_type == ClockType.STEADY_TIME
        return Time(nanoseconds=time.monotonic_ns() if steady else time.time_ns(), clock_type=self.clock_type)

    def tick(self) -> int:
        """What timers count [ns]: never jumps with the system's time of day."""
        return time.monotonic_ns()

    @property
    def real(self) -> bool:
        """Whether it runs by itself."""
        return True

    def sleep_for(self, duration: Duration) -> bool:
        """Sleep by this clock; only for one that runs by itself."""
        time.sleep(max(duration.nanoseconds, 0) / 1e9)
        return True


class ROSClock(Clock):
    """System time, until a node with `use_sim_time` feeds it from /clock."""

    def __init__(self, *, clock_type: ClockType = ClockType.ROS_TIME) -> None:
        super().__init__(clock_type=ClockType.ROS_TIME)
        self.ros_time_is_active = False
        self._simulated = 0

    def now(self) -> Time:
        """The present; 0 while simulated time is used and none has come."""
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
