"""Topic /clock: one publisher in a domain, a real-time factor, and lock-step with the nodes that use its time."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import rclpy
from rclpy.clock import Clock, ClockType

from finssim.extensions.ros2 import Ros2Error
from finssim.extensions.ros2.nodes.conversions import nanoseconds, ros_type
from finssim.extensions.ros2.nodes.robot_node import AGAIN, LEFT, STEP, RobotNode, TwinError
from finssim.extensions.ros2.topics import quality_profile

__all__ = ["Barrier", "PacedClock", "SharedClock"]

CLAIMING = 1.0
"""Time in which simulators that started together discover each other [s]."""
LOOK = 0.5
"""Time between two checks which node publishes /clock [s]."""


class SharedClock:
    """Topic /clock of a domain: one simulator publishes it, all others follow it, and a virtual pool stops.

    A simulator that discovers another publisher follows it. Of simulators that began to publish within
    `CLAIMING` of each other, the first by name continues. A simulator that follows becomes the publisher,
    without a jump, when the publisher has left.
    """

    def __init__(
        self, node: RobotNode, follow: Callable[[float], None] | None, lead: Callable[[], None]
    ) -> None:
        """
        Args:
            node: Node of the simulator.
            follow: Receives each time of the other publisher's clock [s]; None if the node cannot follow.
            lead: Called when the node becomes the publisher.

        Raises:
            TwinError: Another node publishes /clock, and this one cannot follow.
        """
        self._node, self._follow, self._lead = node, follow, lead
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.ours = False
        self._claimed = 0.0
        self._heard: Any = None
        self.look()
        node.create_timer(LOOK, self.look, clock=self._steady)

    def look(self) -> None:
        """Publish /clock, or follow another publisher."""
        node, now = self._node, 1e-9 * self._steady.now().nanoseconds
        own = node.get_fully_qualified_name()
        infos = node.get_publishers_info_by_topic(node.topic("clock"))
        others = sorted({f"{i.node_namespace.rstrip('/')}/{i.node_name}" for i in infos} - {own})
        if self.ours:
            if others and others[0] < own and now - self._claimed < CLAIMING:
                self._give_way(others[0])
        elif not others:
            self._claim(now)
        elif self._heard is None:
            self._give_way(others[0])

    def _claim(self, now: float) -> None:
        self.ours, self._claimed = True, now
        if self._heard is not None:
            self._node.destroy_subscription(self._heard)
            self._node.event("clock", "no other node publishes /clock any more: this simulator does")
        self._node.sends("clock")
        self._lead()

    def _give_way(self, other: str) -> None:
        node, follow, self.ours = self._node, self._follow, False
        if follow is None:
            raise TwinError(
                f"{other} publishes /clock on ROS domain {node.context.get_domain_id()}, and a domain has one clock: "
                "set another ROS_DOMAIN_ID, or leave the clock in real time"
            )
        node.withdraw("clock")
        self._heard = node.hears("clock", lambda message: follow(node.seconds(message.clock)))
        node.event("clock", f"{other} publishes /clock: this simulator follows it, at its pace")


STARTING = 180.0
"""Longest time for all nodes of a graph to start [s]; the first rendering on a machine compiles."""
PATIENCE = 10.0
"""Time between two messages about nodes that delay the others [s]."""
DEPTH = 200
"""Number of reports of nodes that can wait in the queue."""


class Barrier:
    """Lock-step: determines which nodes have not finished their work of a time, by their reports on `/clock_done`.

    Every node that reports is waited for, until it leaves.
    """

    def __init__(self, node: RobotNode, names: Sequence[str], again: Callable[[], None]) -> None:
        """
        Args:
            node: Node of the world.
            names: Full names of the nodes without which time does not start.
            again: Publishes the present time again, in case the message was lost.
        """
        self._node, self._again = node, again
        self._done: dict[str, float] = dict.fromkeys(names, -1.0)
        self._time, self._since, self._reported = -1.0, time.monotonic(), 0.0
        quality: Any = quality_profile(node.table["done"].quality)
        quality.depth = DEPTH
        node.create_subscription(ros_type(node.table["done"].type), node.topic("done"), self._take, quality)
        node.create_timer(AGAIN, self._look, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def missing(self, now: float) -> list[str]:
        """Return the names of the nodes that have not finished their work of a time [s]."""
        if now != self._time:
            self._time, self._since = now, time.monotonic()
        return [name for name, done in self._done.items() if done < now - 0.5 * STEP]

    def _take(self, message: Any) -> None:
        if message.stamp.sec >= LEFT:
            self._done.pop(message.frame_id, None)
        else:
            self._done[message.frame_id] = 1e-9 * nanoseconds(message.stamp)

    def _look(self) -> None:
        """Publish the time again if nodes are missing, and remove nodes that have left."""
        missing, waited = self.missing(self._time), time.monotonic() - self._since
        if not missing or waited < AGAIN:
            return
        self._again()
        node = self._node
        infos = node.get_publishers_info_by_topic(node.topic("done"))
        there = {f"{info.node_namespace.rstrip('/')}/{info.node_name}" for info in infos}
        for name in missing:
            if name not in there and self._done[name] >= 0.0:
                del self._done[name]
                node.event("error", f"{name} has left: time continues without it")
            elif name not in there and waited > STARTING:
                raise Ros2Error(f"{name} did not start: see its output above")
        if waited > PATIENCE and time.monotonic() - self._reported > PATIENCE:
            self._reported = time.monotonic()
            node.event("clock", f"time waits for {', '.join(missing)}")


class PacedClock:
    """Clock of a virtual pool: steps on /clock, limited by a real-time factor and, in lock-step, by the nodes."""

    def __init__(self, node: RobotNode, factor: float, names: Sequence[str]) -> None:
        """
        Args:
            node: Node of the pool.
            factor: Simulated time per real time [-]; 0: without limit.
            names: As of `Barrier`.

        Raises:
            TwinError: Another node publishes /clock.
        """
        self.time, self._count, self._factor, self._node = 0.0, 0, factor, node
        self.shared = SharedClock(node, None, lambda: None)
        self._barrier = Barrier(node, names, self._publish_time) if node.lockstep else None
        self._due = 0.0
        self.spin: Callable[..., None] = partial(rclpy.spin_once, node)
        """Runs a callback; waits for one at most `timeout_sec` [s]."""

    def wait(self, until: Callable[[], bool]) -> None:
        """Publish the time, and return when the next step may begin, or when `until` returns true."""
        self._publish_time()
        while self._barrier is not None and self._barrier.missing(self.time) and not until():
            self.spin(timeout_sec=0.1)
        # A delay is not made up for.
        now = time.monotonic()
        self._due = max(self._due + STEP / self._factor, now) if self._factor > 0.0 and self._count else now
        while True:
            rest = self._due - time.monotonic()
            self.spin(timeout_sec=max(rest, 0.0))
            if rest <= 0.0:
                break
        self._count += 1
        self.time = self._count * STEP

    def _publish_time(self) -> None:
        self._node.send("clock", self._node.make.clock(self._node.ns(self.time)))
