"""A bridge as topics: commands, readings and the operator's word in, its state and events out. Of hardware and sim."""

from __future__ import annotations

from typing import Any

from finssim.robot.bridge import Bridge
from finssim.robot.reading import Reading
from finssim.ros2.nodes.conversions import force_of
from finssim.ros2.nodes.remote import Readings
from finssim.ros2.nodes.robot_node import RobotNode, matched_callbacks
from finssim.ros2.nodes.ros_messages import ros_type
from finssim.ros2.topics import SERVICES

__all__ = ["BridgeTopics"]

LOOK = 0.5
"""Between two counts of those who publish commands [s]."""


class BridgeTopics:
    """Arming, stops and acknowledgements are topics, so that they work with every middleware."""

    def __init__(self, node: RobotNode, bridge: Bridge, *, readings: bool = True) -> None:
        """
        Args:
            node: That hears and sends.
            bridge: It is for.
            readings: Whether to hear the estimator; False where the node knows the state itself.
        """
        self._node, self._bridge = node, bridge
        self._publishers = self._matched = 0
        self._label = ""
        node.sends("thrusters", "event", "diagnostics")
        matched = matched_callbacks(self._on_match)
        self._tells = matched is not None
        self._commands = node.hears("command", self._on_command, event_callbacks=matched)
        node.hears("arm", lambda message: self._arm(bool(message.data)))
        node.hears("stop", lambda message: bridge.stop(node.now(), "emergency stop by topic"))
        node.hears("acknowledge", lambda message: bridge.acknowledge(node.now()))
        if readings:
            Readings(node, self._on_reading)
        node.create_timer(LOOK, self._count)
        service = SERVICES["set_armed"]
        node.create_service(ros_type(service.type), node.below(service.name), self._on_service)

    def tell(self, now: float, **values: Any) -> None:
        """Publish state and events; `values` are further fields of ThrusterState."""
        bridge, node = self._bridge, self._node
        known = {
            "reason": bridge.reason,
            "source": self._label if bridge.source else "",
            "requested": bridge.requested,
            "force": bridge.force,
            "achieved": bridge.force,
        }
        node.send("thrusters", node.make.thrusters(node.ns(now), bridge.state, {**known, **values}))
        for event in bridge.drain():
            node.event(event.kind, event.text, event.time)

    def _arm(self, wanted: bool) -> str:
        """Arm or disarm; "" or why it is refused."""
        now = self._node.now()
        if not wanted:
            self._bridge.disarm(now)
            return ""
        self._count()
        if self._publishers > 1:
            why = f"{self._publishers} publishers on {self._node.topic('command')}: leave one"
            self._bridge.log.repeat(now, "refused", f"topic may not arm: {why}")
            return why
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
        # Who commands is a node; what it names after a slash, its mode, may change.
        self._bridge.command(now, force, source.partition("/")[0], stamp=stamp)
        self._label = source

    def _on_reading(self, reading: Reading) -> None:
        self._bridge.reading(self._node.now(), reading)

    def _on_match(self, info: Any) -> None:
        """Publishers came or went: two are a fault at once, even if one has left again before this is told."""
        most = self._matched + info.total_count_change
        self._matched = info.current_count
        self._judge(most)

    def _count(self) -> None:
        """The same, seen twice a second; all that Humble has, whose rclpy looks through the whole graph for it."""
        count = getattr(self._commands, "get_publisher_count", None)
        topic = self._node.topic("command")
        self._publishers = int(count() if count else self._node.count_publishers(topic))
        self._judge(self._publishers)

    def _judge(self, publishers: int) -> None:
        """Two that publish commands are a fault, even under one name."""
        if publishers > 1 and self._bridge.state in ("armed", "hold"):
            why = f"two publishers command the thrusters: {publishers} on {self._node.topic('command')}"
            self._bridge.stop(self._node.now(), why)

    def _on_service(self, request: Any, response: Any) -> Any:
        why = self._arm(bool(request.data))
        response.success, response.message = not why, why
        return response
