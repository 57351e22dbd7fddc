"""The bridge and the estimator of another process, as the robot's own objects know them."""

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
from finssim.extensions.ros2.up import EVERYWHERE, GraphPlan
from finssim.robot.bridge import Event
from finssim.robot.messages import Telemetry, ThrusterCommand
from finssim.robot.reading import Reading
from finssim.robot.record_messages import STATES

Array = npt.NDArray[np.float64]

SILENT = 0.5
"""A bridge that has not been heard for so long does nothing that we know of [s]."""


class RemoteReadings:
    """Puts Odometry and EstimatorStatus of one stamp together; calls back with each reading."""

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
        else:  # nothing is known, so no odometry comes with it
            self._give(message, None)

    def _match(self) -> None:
        status, odometry = self._status, self._odometry
        if status is None or odometry is None:
            return
        if nanoseconds(status.header.stamp) == nanoseconds(odometry.header.stamp):
            self._give(status, odometry)

    def _give(self, status: Any, odometry: Any) -> None:
        self._status = None
        self._take(reading_of(status, odometry, self._node.seconds(status.header.stamp)))


class RemoteState:
    """The newest reading, in place of a `Perception`; one that is too old is not ready."""

    def __init__(self, node: RobotNode, oldest: float) -> None:
        """
        Args:
            node: That hears it.
            oldest: Age at which a reading may not be acted on any more [s].
        """
        # `robot.runtime.Intake` wants to know the frames of a motor controller; here none comes.
        self.vehicle, self.let_in = node.vehicle, None
        self._oldest = oldest
        nothing = np.full(3, math.nan), np.array([0.0, 0.0, 0.0, 1.0]), np.full(6, math.nan)
        self._newest = Reading(-math.inf, *nothing, False, "uninitialized", "the estimator is silent")
        RemoteReadings(node, self._take)

    def reading(self, now: float) -> Reading:
        """The state. `now` is the time [s]."""
        age = now - self._newest.time
        if age > self._oldest:
            return replace(self._newest, ready=False, reason=f"the estimator is silent for {age:.1f} s")
        return self._newest

    def telemetry(self, now: float, telemetry: Telemetry, time: float) -> None:
        """None comes here.

        Args:
            now: When it would have come [s].
            telemetry: Not used.
            time: When it would have been measured [s].
        """

    def _take(self, reading: Reading) -> None:
        self._newest = reading


class RemoteBridge:
    """The bridge of another process: commands travel as messages, its state returns as one."""

    getting_ready = False
    """True if arming waits for an autopilot, which a state does not report: request it again when it has armed."""

    def __init__(self, node: RobotNode, source: Callable[[], str] | None = None) -> None:
        """
        Args:
            node: That hears and sends.
            source: Tells what commands are signed with; by who gives them where there is none.
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
        """Return whether no message has come from it for too long."""
        return self._node.now() - self._at > SILENT

    def arm(self, now: float, source: str) -> str:
        """Ask for arming; whether it is granted shows in the state. `now` is the time [s]."""
        self._node.send("arm", ros_type("std_msgs/msg/Bool")(data=True))
        return ""

    def disarm(self, now: float) -> None:
        """Thrusters off. `now` is the time [s]."""
        self._node.send("arm", ros_type("std_msgs/msg/Bool")(data=False))

    def stop(self, now: float, reason: str) -> None:
        """Emergency stop. `now` is the time [s]."""
        self._node.send("stop", ros_type("std_msgs/msg/Empty")())
        self._node.event("stop", reason, now)

    def acknowledge(self, now: float) -> None:
        """End a fault. `now` is the time [s]."""
        self._node.send("acknowledge", ros_type("std_msgs/msg/Empty")())

    def command(self, now: float, force: npt.ArrayLike, source: str, stamp: float | None = None) -> Array:
        """Ask for thrusts along the thrusters' axes, canonical order [N], (n,), and for values of the other actuators
        that follow them; return the thrusts."""
        node, source = self._node, source if self._source is None else self._source()
        channels, stamp = np.asarray(force, float), node.ns(now)
        requested, others = np.split(channels, [len(node.make.names)])
        if others.size:
            node.send("setpoints", node.make.actuators(stamp, others))
        node.send("command", node.make.command(stamp, requested, source))
        return requested

    def reading(self, now: float, reading: Reading) -> None:
        """Ignore a reading: the bridge receives the estimator's directly. `now` is the time [s]."""

    def telemetry(self, now: float, telemetry: Telemetry) -> None:
        """None comes here. `now` is the time [s]."""

    def tick(self, now: float) -> ThrusterCommand:
        """Frames are the bridge's own affair. `now` is the time [s]."""
        return ThrusterCommand(False, (0.0,) * 8)

    def drain(self) -> list[Event]:
        """Events are published where they happen."""
        return []

    def _on_state(self, message: Any) -> None:
        if message.state < len(STATES):
            self._state, self.reason, self._at = (
                STATES[message.state],
                str(message.reason),
                self._node.now(),
            )


# The node of `finssim ros2 up`: it observes the state, and requests arming if that was demanded.


ASK_EVERY = 1.0
"""Between two requests for arming [s]."""


class Watcher(RobotNode):
    """Observes one vehicle. It arms only on demand, and only once."""

    listening = LISTENING

    def __init__(self, plan: GraphPlan, namespace: str, *, arm: bool) -> None:
        """
        Args:
            plan: Nodes that are to be started, of which there must be no others.
            namespace: Of the vehicle.
            arm: Ask for arming as soon as the state is ready and a controller is there, until it is granted once.

        Raises:
            TwinError: There are others.
        """
        nodes = [one for one in plan.nodes if one.namespace == namespace]
        alike = next((one for one in nodes if one.node == "controller"), nodes[-1])
        rename = ["-r", f"__ns:=/{namespace}"]
        super().__init__("ros2_up", [one.node for one in nodes], [*rename, *_words(alike.parameters)])
        self._arm, self._asked = arm, 0.0
        self.sends("event", "diagnostics", "done")
        self.bridge = RemoteBridge(self)
        self.state = self.bridge.state
        """Of the bridge, as it was seen last while nodes lived."""
        self.ready = False
        RemoteReadings(self, self._on_reading)

    def turn(self, timeout: float) -> None:
        """Process the received messages, waiting for them no longer than that [s]."""
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
    """Return arguments that give a node the parameters which every node has."""
    words = {name: parameters[name] for name in EVERYWHERE.split() if name in parameters}
    texts = (f"{name}:={json.dumps(value)}" for name, value in words.items())
    return [word for text in texts for word in ("-p", text)]
