"""`rclpy.clock_type`: the kinds of clock."""

from enum import IntEnum

__all__ = ["ClockType"]


class ClockType(IntEnum):
    """What a clock counts."""

    UNINITIALIZED = 0
    ROS_TIME = 1
    """System time, or that of the topic /clock where `use_sim_time` is set."""
    SYSTEM_TIME = 2
    STEADY_TIME = 3
    """Never jumps; begins anywhere."""
