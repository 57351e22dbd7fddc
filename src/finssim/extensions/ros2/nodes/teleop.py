"""Teleoperation node: converts a gamepad, the keyboard or the topic `joy` to wrenches, arming and stops."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from typing import Any

from finssim.extensions.ros2.nodes.conversions import ros_type
from finssim.extensions.ros2.nodes.remote import RemoteBridge
from finssim.extensions.ros2.nodes.robot_node import RobotNode
from finssim.extensions.ros2.topics import SENSOR, quality_profile
from finssim.robot.teleop import (
    AXIS_COUNT,
    BUTTON_COUNT,
    KEYBOARD_HELP,
    Device,
    Gamepad,
    Hands,
    Keyboard,
    Operator,
    Pad,
    TeleopError,
)

LAST_WRENCHES = 3
"""Number of zero wrenches at the end."""


class Teleop(RobotNode):
    """Node that publishes the operator's wrench; the mode button switches between `teleop` and the controller
    `other`."""

    def __init__(self) -> None:
        super().__init__("teleop")
        self.sends("wrench", "mode", "event", "diagnostics")
        self._other, self._mine = self.parameter("other", "pid"), False
        self._stack = ExitStack()
        device = self._device(self.parameter("device", "joy"))
        self.bridge, self.operator = RemoteBridge(self), Operator(device, swap=self._swap)
        self._message = ""
        self.create_timer(1.0 / self.parameter("rate", 30.0), self._turn)

    def _device(self, name: str) -> Device:
        if name == "joy":
            device = JoyDevice()
            self.create_subscription(
                ros_type("sensor_msgs/msg/Joy"), "joy", device.take, quality_profile(SENSOR)
            )
            return device
        if name == "gamepad":
            return self._stack.enter_context(Gamepad())
        if name == "keyboard":
            print(KEYBOARD_HELP, file=sys.stderr)
            return self._stack.enter_context(Keyboard())
        raise TeleopError(f"unknown device '{name}': expected joy, gamepad or keyboard")

    def _turn(self) -> None:
        now = self.now()
        self.operator.turn(now, self.bridge)
        self.send("wrench", self.make.wrench(self.ns(now), self.operator.wrench()))
        if self.operator.message and self.operator.message != self._message:
            self.event("teleop", self.operator.message)
        self._message = self.operator.message

    def _swap(self) -> None:
        self._mine = not self._mine
        self.send("mode", ros_type("std_msgs/msg/String")(data="teleop" if self._mine else self._other))

    def close(self) -> None:
        """Release the device, and send zero wrenches if the network is still up."""
        self._stack.close()
        if self.context.ok():
            for _ in range(LAST_WRENCHES):
                self.send("wrench", self.make.wrench(self.ns(self.now()), (0.0,) * 6))


class JoyDevice:
    """Device of the topic `joy` from ROS' joy_node, for pads of the Xbox family: left and up are positive there."""

    def __init__(self) -> None:
        self._newest: Any = None
        self._pad = Pad()

    def take(self, message: Any) -> None:
        """Store the newest message."""
        self._newest = message

    def read(self, now: float) -> Hands | None:
        """Return the content of the newest message; None without a new one since the last call, or if it is
        too short.

        The argument `now` is the time [s].
        """
        message, self._newest = self._newest, None
        if message is None or len(message.axes) < AXIS_COUNT or len(message.buttons) < BUTTON_COUNT:
            return None
        return self._pad.hands([-float(x) for x in message.axes], message.buttons)
