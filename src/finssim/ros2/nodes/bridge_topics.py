"""A bridge as topics: commands, readings and the operator's word in, its state and events out. Of hardware and sim."""

from __future__ import annotations

from typing import Any

from finssim.robot.bridge import Bridge
from finssim.robot.robot import Reading
from finssim.ros2.nodes.conversions import force_of
from finssim.ros2.nodes.remote import Readings
from finssim.ros2.nodes.robot_node import RobotNode
from finssim.ros2.nodes.ros_messages import ros_type
from finssim.ros2.topics import SERVICES

__all__ = ["BridgeTopics"]

LOOK = 0.5
"""Between looks how many publish commands [s]."""


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
        self._rivals = 0
        node.sends("thrusters", "event", "diagnostics")
        self._commands = node.hears("command", self._on_command)
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
            "source": bridge.source,
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
        if self._rivals > 1:
            why = f"{self._rivals} publishers on {self._node.topic('command')}: leave one"
            self._bridge.log.repeat(now, "refused", f"topic may not arm: {why}")
            return why
        return self._bridge.arm(now, "topic")

    def _on_command(self, message: Any) -> None:
        now, source = self._node.now(), str(message.source) or "unnamed"
        force = force_of(message, self._node.make.names)
        if isinstance(force, str):
            self._bridge.log.repeat(now, "command refused", f"{source}: {force}")
        else:
            stamp = self._node.seconds(message.header.stamp)
            self._bridge.command(now, force, source, stamp=stamp)

    def _on_reading(self, reading: Reading) -> None:
        self._bridge.reading(self._node.now(), reading)

    def _count(self) -> None:
        """Two that publish commands are a fault, even under one name."""
        self._rivals = self._publishers()
        if self._rivals > 1 and self._bridge.state in ("armed", "hold"):
            why = f"two publishers command the thrusters: {self._rivals} on {self._node.topic('command')}"
            self._bridge.stop(self._node.now(), why)

    def _publishers(self) -> int:
        """How many are known; Humble's rclpy can only look through the whole graph for it."""
        count = getattr(self._commands, "get_publisher_count", None)
        return int(count() if count else self._node.count_publishers(self._node.topic("command")))

    def _on_service(self, request: Any, response: Any) -> Any:
        why = self._arm(bool(request.data))
        response.success, response.message = not why, why
        return response
