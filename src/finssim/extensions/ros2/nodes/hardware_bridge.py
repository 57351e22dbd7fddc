"""Hardware bridge node: the only process that talks to motor controller or autopilot, with arming and all
watchdogs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from finssim.extensions.ros2.nodes.conversions import force_of, ros_type, setpoints_of
from finssim.extensions.ros2.nodes.remote import RemoteReadings
from finssim.extensions.ros2.nodes.robot_node import RobotNode, matched_callbacks
from finssim.extensions.ros2.topics import SERVICES
from finssim.robot.bridge import Bridge, BridgeSettings
from finssim.robot.links.transports import DEFAULT_BIND, open_transport
from finssim.robot.messages import CommandEcho, NavigationAid, Telemetry
from finssim.robot.perception import Unlocated
from finssim.robot.reading import Reading
from finssim.robot.runtime import Counters, Intake
from finssim.robot.wiring import POOL_ADDRESS, link_of

LOOK = 0.5
"""Interval of counting the publishers of commands [s]."""


class BridgeTopics:
    """Topics of a bridge: arming, stops and acknowledgements, which work with every middleware."""

    def __init__(self, node: RobotNode, bridge: Bridge, *, readings: bool = True) -> None:
        """
        Args:
            node: Node that subscribes and publishes.
            bridge: The bridge.
            readings: True to subscribe to the estimator; False if the node knows the state itself.
        """
        self._node, self._bridge = node, bridge
        self._publishers = self._matched = 0
        self._label = ""
        self._setpoints, self._set_at = np.zeros(0), -math.inf
        node.sends("thrusters", "event", "diagnostics")
        if node.vehicle.actuators:
            node.hears("setpoints", self._on_setpoints)
        matched = matched_callbacks(self._on_match)
        self._tells = matched is not None
        self._commands = node.hears("command", self._on_command, event_callbacks=matched)
        node.hears("arm", lambda message: self._arm(bool(message.data)))
        node.hears("stop", lambda message: bridge.stop(node.now(), "emergency stop by topic"))
        node.hears("acknowledge", lambda message: bridge.acknowledge(node.now()))
        if readings:
            RemoteReadings(node, self._on_reading)
        node.create_timer(LOOK, self._count)
        node.create_timer(1.0, self._diagnose)
        service = SERVICES["set_armed"]
        node.create_service(ros_type(service.type), node.below(service.name), self._on_service)

    def publish(self, now: float, **values: Any) -> None:
        """Publish state and events; `values` are further fields of ThrusterState. `now` is the time [s]."""
        bridge, node = self._bridge, self._node
        state_values = {
            "reason": bridge.reason,
            "source": self._label if bridge.source else "",
            "requested": bridge.requested,
            "force": bridge.force,
            "achieved": bridge.force,
        }
        node.send("thrusters", node.make.thrusters(node.ns(now), bridge.state, {**state_values, **values}))
        for event in bridge.drain():
            node.event(event.kind, event.text, event.time)

    def _diagnose(self) -> None:
        """Report the watchdogs: the bridge's state, and why it holds or has stopped."""
        state, reason = self._bridge.state, self._bridge.reason
        level = {"fault": "error", "hold": "warn"}.get(state, "ok")
        values = {"source": self._label, "publishers of commands": self._publishers}
        self._node.diagnose("watchdogs", level, f"{state}: {reason}" if reason else state, values)

    def _arm(self, requested: bool) -> str:
        """Arm or disarm; return the reason of a refusal, or ""."""
        now = self._node.now()
        if not requested:
            self._bridge.disarm(now)
            return ""
        self._count()
        if self._publishers > 1:
            reason = f"{self._publishers} publishers on {self._node.topic('command')}: leave one"
            self._bridge.log.repeat(now, "refused", f"topic may not arm: {reason}")
            return reason
        return self._bridge.arm(now, "topic")

    def _on_command(self, message: Any) -> None:
        if not self._tells:
            self._count()
        now, source = self._node.now(), str(message.source) or "unnamed"
        force = force_of(message, self._node.make.names)
        if isinstance(force, str):
            self._bridge.log.repeat(now, "command refused", f"{source}: {force}")
            return
        stamp = self._node.seconds(message.header.stamp)
        if now - self._set_at <= self._node.vehicle.safety.command_timeout:
            force = np.append(force, self._setpoints)
        # The source is a node; the mode that it appends after a slash may change.
        self._bridge.command(now, force, source.partition("/")[0], stamp=stamp)
        self._label = source

    def _on_setpoints(self, message: Any) -> None:
        values, now = setpoints_of(message, self._node.make.others), self._node.now()
        if isinstance(values, str):
            self._bridge.log.repeat(now, "command refused", f"{self._node.topic('setpoints')}: {values}")
            return
        self._setpoints, self._set_at = values, now

    def _on_reading(self, reading: Reading) -> None:
        self._bridge.reading(self._node.now(), reading)

    def _on_match(self, info: Any) -> None:
        """React to appearing or vanishing publishers: two are a fault at once, even if one has already vanished."""
        highest = self._matched + info.total_count_change
        self._matched = info.current_count
        self._judge(highest)

    def _count(self) -> None:
        """Count publishers twice a second; the only method on Humble, whose rclpy searches the complete graph
        for them."""
        count = getattr(self._commands, "get_publisher_count", None)
        topic = self._node.topic("command")
        self._publishers = int(count() if count else self._node.count_publishers(topic))
        self._judge(self._publishers)

    def _judge(self, publishers: int) -> None:
        """Stop if two publishers send commands, even under one name."""
        if publishers > 1 and self._bridge.state in ("armed", "hold"):
            reason = f"two publishers command the thrusters: {publishers} on {self._node.topic('command')}"
            self._bridge.stop(self._node.now(), reason)

    def _on_service(self, request: Any, response: Any) -> Any:
        reason = self._arm(bool(request.data))
        response.success, response.message = not reason, reason
        return response


# Node and its callbacks.


LAST_FRAMES = 3
"""Number of frames without thrust at the end."""
RPM = 2.0 * math.pi / 60.0


class HardwareBridge(RobotNode):
    """Node that exchanges frames with the motor controller; disarmed until the topic `arm` is true."""

    def __init__(self) -> None:
        super().__init__("hardware_bridge")
        located, bind = self.parameter("need_reading", True), self.parameter("bind", DEFAULT_BIND)
        address = POOL_ADDRESS if self.robot == "pool" else self.robot
        self.transport, link = open_transport(address, bind), link_of(address, self.vehicle)
        self.bridge = Bridge(self.vehicle, BridgeSettings.of(self.vehicle, need_reading=located))
        self.bridge.autopilot = link
        self.counters, self._counted, self.shafts = Counters(), 0, np.zeros(0)
        self.intake = Intake(Unlocated(self.vehicle), self.bridge, self.counters, self, link)
        self.sends("imu", "pressure", "telemetry", "shafts", "echo", "positioning", "dvl", "compass")
        self.sends(*["actuators"] * bool(self.vehicle.actuators))
        self.topics = BridgeTopics(self, self.bridge)
        self.create_timer(1.0 / self.parameter("rate", 60.0), self._turn)
        self.create_timer(1.0, self._publish_diagnostics)
        self.event("start", self.transport.describe())

    def telemetry(self, now: float, telemetry: Telemetry, time: float) -> None:
        """Publish a snapshot, called by `robot.runtime.Intake` as for a recorder; the stamps are measurement times.

        Args:
            now: Time of arrival [s].
            telemetry: The snapshot.
            time: Time of the measurement [s].
        """
        stamp, received = self.ns(time), self.ns(now)
        self.send("telemetry", self.make.telemetry(stamp, received, telemetry))
        if self.heard("imu"):
            self.send("imu", self.make.imu(stamp, telemetry))
        if self.heard("pressure"):
            self.send("pressure", self.make.pressure(stamp, telemetry))
        self.send("shafts", self._speeds(stamp, telemetry.motor_rpm))
        if telemetry.actuators:
            self.send("actuators", self.make.actuators(stamp, telemetry.actuators))

    def echo(self, now: float, echo: CommandEcho) -> None:
        """Publish a command as executed by the motor controller. `now` is the time [s]."""
        self.send("echo", self.make.echo(self.ns(now), echo))

    def aid(self, now: float, aid: NavigationAid) -> None:
        """Publish a measurement of a navigation instrument, stamped with its time. `now` is the time [s]."""
        message = self.make.aid(self.ns(now - aid.age), aid)
        if message is not None:
            self.send(*message)

    def _speeds(self, stamp: int, rpm: Sequence[float] | None) -> Any:
        message = None if rpm is None else self.make.shafts(stamp, rpm)
        if message is not None:
            self.shafts = np.asarray(message.velocity, float)
        return message

    def _turn(self) -> None:
        now = self.now()
        self.intake.take(now, [(now, data) for data in self.transport.receive()])
        for note in self.intake.link.notes:
            self.bridge.note(now, note)
        self.intake.link.notes.clear()
        command = self.bridge.tick(now)
        if self.now() - now < self.bridge.settings.command_timeout:
            # Otherwise the process was suspended in between.
            for data in self.intake.link.encode(now, command, self.bridge.state):
                self.transport.send(data)
        self.topics.publish(now, normalised=command.normalised, shaft_speed=self.shafts)

    def _publish_diagnostics(self) -> None:
        count, self._counted = self.counters.telemetry - self._counted, self.counters.telemetry
        level, text = ("ok", "telemetry") if count else ("error", "no telemetry in the last second")
        self.diagnose(
            "link", level, text, {"frames in the last second": count, "wire": self.transport.describe()}
        )

    def close(self) -> None:
        """Disarm, notify the motor controller, and close the connection."""
        self.bridge.disarm(self.now())
        for _ in range(LAST_FRAMES):
            for data in self.intake.link.encode(self.now(), self.bridge.tick(self.now()), self.bridge.state):
                self.transport.send(data)
        self.transport.close()
