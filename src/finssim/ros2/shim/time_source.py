"""Simulated time: the topic /clock drives a node's clock where its parameter `use_sim_time` is true."""

from __future__ import annotations

from typing import Any

from finssim.ros2.codec import codec_of
from finssim.ros2.shim.clock import ROSClock
from finssim.ros2.shim.qos import QoSProfile, ReliabilityPolicy
from finssim.ros2.shim.time import Time

__all__ = ["TimeSource"]


class TimeSource:
    """Declares `use_sim_time` on a node and feeds its clock."""

    def __init__(self, node: Any, clock: ROSClock) -> None:
        self._node, self._clock, self._subscription = node, clock, None
        if not node.has_parameter("use_sim_time"):
            node.declare_parameter("use_sim_time", False)
        self.use_simulated(bool(node.get_parameter("use_sim_time").value))

    def use_simulated(self, simulated: bool) -> None:
        """Follow /clock, or the system's time."""
        if simulated == self._clock.ros_time_is_active:
            return
        self._clock.ros_time_is_active = simulated
        for timer in self._node.timers:
            if timer.clock is self._clock and not timer.is_canceled():
                timer.reset()
        if simulated:
            newest = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
            clock = codec_of().message("rosgraph_msgs/msg/Clock")
            self._subscription = self._node.create_subscription(clock, "/clock", self._on_clock, newest)
        elif self._subscription is not None:
            self._node.destroy_subscription(self._subscription)

    def _on_clock(self, message: Any) -> None:
        self._clock.set_ros_time_override(Time.from_msg(message.clock))
