"""The node of `finssim ros2 up` itself: sees the state, and asks for arming where it was told to."""

from __future__ import annotations

import time
from collections.abc import Sequence

import rclpy

from finssim.robot.reading import Reading
from finssim.ros2.nodes.remote import Readings, RemoteBridge
from finssim.ros2.nodes.robot_node import LISTENING, RobotNode

__all__ = ["Watcher"]

ASK_EVERY = 1.0
"""Between two requests for arming [s]."""


class Watcher(RobotNode):
    """Looks at one vehicle. It arms only where it was told to, and only once."""

    listening = LISTENING

    def __init__(self, nodes: Sequence[str], *, arm: bool) -> None:
        """
        Args:
            nodes: Those that are to be started, of which there must be no others.
            arm: Ask for arming as soon as the state is ready and a controller is there, until it is granted once.

        Raises:
            TwinError: There are others.
        """
        super().__init__("ros2_up", nodes)
        self._arm, self._asked = arm, 0.0
        self.sends("event", "diagnostics")
        self.bridge = RemoteBridge(self)
        self.state = self.bridge.state
        """Of the bridge, as it was seen last while nodes lived."""
        self.ready = False
        Readings(self, self._on_reading)

    def turn(self, timeout: float) -> None:
        """Hear what has come, waiting for it no longer than that [s]."""
        end = time.monotonic() + timeout
        while (left := end - time.monotonic()) > 0.0:
            rclpy.spin_once(self, timeout_sec=left)
        self.state = self.bridge.state
        if self._arm and self.state != "disarmed":
            self._arm = False
        if self._arm and self.ready and end - self._asked >= ASK_EVERY:
            self._asked = end
            if self.count_publishers(self.topic("command")):
                self.bridge.arm(self.now(), "ros2 up")

    def _on_reading(self, reading: Reading) -> None:
        self.ready = reading.ready
