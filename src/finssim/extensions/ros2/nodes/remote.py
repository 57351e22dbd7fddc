"""Bridge and estimator in another process, with the interfaces of the robot's own objects."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import rclpy

from finssim.extensions.ros2.nodes.conversions import nanoseconds, reading_of, ros_type
from finssim.extensions.ros2.nodes.robot_node import LEFT, LISTENING, RobotNode
from finssim.extensions.ros2.up import COMMON_PARAMETERS, GraphPlan
from finssim.robot.bridge import Event
from finssim.robot.messages import Telemetry, ThrusterCommand
from finssim.robot.reading import Reading
from finssim.robot.record_messages import STATES

Array = npt.NDArray[np.float64]

SILENT = 0.5
"""Time without messages after which the bridge counts as disarmed [s]."""


class RemoteReadings:
    """Matcher of Odometry and EstimatorStatus with equal stamps, which calls back with each reading."""

    def __init__(self, node: RobotNode, take: Any) -> None:
        self._node, self._take = node, take
        self._odometry: Any = None
        self._status: Any = None
        node.hears("odometry", self._on_odometry)
        node.hears("estimator", self._on_status)

    def _on_odometry(self, message: Any) -> None:
        self._odometry = message
        self._match()

    def _on_status(self, message: Any) -> None:
        self._status = message
        if all(map(math.isfinite, message.position_std)):
            self._match()
        else:  # the position is unknown, so there is no odometry with it
            self._update(message, None)

    def _match(self) -> None:
        status, odometry = self._status, self._odometry
        if status is None or odometry is None:
            return
        if nanoseconds(status.header.stamp) == nanoseconds(odometry.header.stamp):
            self._update(status, odometry)

    def _update(self, status: Any, odometry: Any) -> None:
        self._status = None
        self._take(reading_of(status, odometry, self._node.seconds(status.header.stamp)))


class RemoteState:
    """Newest reading, in place of a `Perception`; a reading that is too old is not ready."""

    def __init__(self, node: RobotNode, oldest: float) -> None:
        """
        Args:
            node: Node that receives it.
            oldest: Age above which a reading must not be used [s].
        """
        # `robot.runtime.Intake` reads the format of a motor controller's frames, of which there are none here.
        self.vehicle, self.let_in = node.vehicle, None
        self._oldest = oldest
        nothing = np.full(3, math.nan), np.array([0.0, 0.0, 0.0, 1.0]), np.full(6, math.nan)
        self._newest = Reading(-math.inf, *nothing, False, "uninitialized", "the estimator is silent")
        RemoteReadings(node, self._take)

    def reading(self, now: float) -> Reading:
        """Return the state. `now` is the time [s]."""
        age = now - self._newest.time
        if age > self._oldest:
            return replace(self._newest, ready=False, reason=f"the estimator is silent for {age:.1f} s")
        return self._newest

    def telemetry(self, now: float, telemetry: Telemetry, time: float) -> None:
        """Do nothing: there is no telemetry here.

        Args:
            now: Not used [s].
            telemetry: Not used.
            time: Not used [s].
        """

    def _take(self, reading: Reading) -> None:
        self._newest = reading


class RemoteBridge:
    """Bridge in another process: commands are sent and its state is received as messages."""

    getting_ready = False
    """True while arming waits for an autopilot; always False, since the state message does not contain it."""

    def __init__(self, node: RobotNode, source: Callable[[], str] | None = None) -> None:
        """
        Args:
            node: Node that subscribes and publishes.
            source: Function that returns the signature of commands; None: the source passed with each command.
        """
        self._node, self._source = node, source
        self._state, self.reason, self._at = "disarmed", "", -math.inf
        node.sends("arm", "stop", "acknowledge")
        node.hears("thrusters", self._on_state)

    @property
    def state(self) -> str:
        """Return the latest state of the bridge; disarmed while it is silent."""
        return "disarmed" if self.silent else self._state

    @property
    def silent(self) -> bool:
        """Return whether no message has arrived from the bridge for too long."""
        return self._node.now() - self._at > SILENT

    def arm(self, now: float, source: str) -> str:
        """Request arming; the state shows whether it is granted. `now` is the time [s]."""
        self._node.send("arm", ros_type("std_msgs/msg/Bool")(data=True))
        return ""

    def disarm(self, now: float) -> None:
        """Disarm the thrusters. `now` is the time [s]."""
        self._node.send("arm", ros_type("std_msgs/msg/Bool")(data=False))

    def stop(self, now: float, reason: str) -> None:
        """Request an emergency stop. `now` is the time [s]."""
        self._node.send("stop", ros_type("std_msgs/msg/Empty")())
        self._node.event("stop", reason, now)

    def acknowledge(self, now: float) -> None:
        """Acknowledge a fault. `now` is the time [s]."""
        self._node.send("acknowledge", ros_type("std_msgs/msg/Empty")())

    def command(self, now: float, force: npt.ArrayLike, source: str, stamp: float | None = None) -> Array:
        """Request thrusts along the thrusters' axes, canonical order [N], (n,), followed by values of the
        other actuators; return the thrusts."""
        node, source = self._node, source if self._source is None else self._source()
        channels, stamp = np.asarray(force, float), node.ns(now)
        requested, others = np.split(channels, [len(node.make.names)])
        if others.size:
            node.send("setpoints", node.make.actuators(stamp, others))
        node.send("command", node.make.command(stamp, requested, source))
        return requested

    def reading(self, now: float, reading: Reading) -> None:
        """Ignore a reading: the bridge receives those of the estimator directly. `now` is the time [s]."""

    def telemetry(self, now: float, telemetry: Telemetry) -> None:
        """Do nothing: there is no telemetry here. `now` is the time [s]."""

    def tick(self, now: float) -> ThrusterCommand:
        """Return a disabled command: the bridge itself sends the frames. `now` is the time [s]."""
        return ThrusterCommand(False, (0.0,) * 8)

    def drain(self) -> list[Event]:
        """Return no events: they are published where they occur."""
        return []

    def _on_state(self, message: Any) -> None:
        if message.state < len(STATES):
            self._state, self.reason, self._at = (
                STATES[message.state],
                str(message.reason),
                self._node.now(),
            )


# Node of `finssim ros2 up`: observes the state, and requests arming if the user demands it.


ASK_EVERY = 1.0
"""Interval of requests for arming [s]."""


class Watcher(RobotNode):
    """Node that observes one vehicle, and requests arming only on demand and only until it is armed once."""

    listening = LISTENING

    def __init__(self, plan: GraphPlan, namespace: str, *, arm: bool) -> None:
        """
        Args:
            plan: Nodes that will be started, of which no others may exist.
            namespace: Namespace of the vehicle.
            arm: True to request arming when the state is ready and a controller exists, until it is granted once.

        Raises:
            TwinError: Other nodes with these names exist.
        """
        nodes = [one for one in plan.nodes if one.namespace == namespace]
        alike = next((one for one in nodes if one.node == "controller"), nodes[-1])
        rename = ["-r", f"__ns:=/{namespace}"]
        super().__init__("ros2_up", [one.node for one in nodes], [*rename, *_words(alike.parameters)])
        self._arm, self._asked = arm, 0.0
        self.sends("event", "diagnostics", "done")
        self.bridge = RemoteBridge(self)
        self.state = self.bridge.state
        """Last observed state of the bridge while the nodes ran."""
        self.ready = False
        RemoteReadings(self, self._on_reading)

    def turn(self, timeout: float) -> None:
        """Process received messages for a duration [s]."""
        end = time.monotonic() + timeout
        while (remaining := end - time.monotonic()) > 0.0:
            rclpy.spin_once(self, timeout_sec=remaining)
        self.state = self.bridge.state
        if self._arm and self.state != "disarmed":
            self._arm = False
        if self._arm and self.ready and end - self._asked >= ASK_EVERY:
            self._asked = end
            if self.count_publishers(self.topic("command")):
                self.bridge.arm(self.now(), "ros2 up")

    def left(self, name: str) -> None:
        """Report that a node has ended, so that time in lock-step does not wait for it."""
        self.send("done", self.make.done(LEFT * 10**9, name))

    def _on_reading(self, reading: Reading) -> None:
        self.ready = reading.ready


def _words(parameters: Mapping[str, Any]) -> list[str]:
    """Return the arguments with the parameters that are common to all nodes."""
    words = {name: parameters[name] for name in COMMON_PARAMETERS.split() if name in parameters}
    texts = (f"{name}:={json.dumps(value)}" for name, value in words.items())
    return [word for text in texts for word in ("-p", text)]
