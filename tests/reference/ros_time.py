# ruff: noqa: E402 - rclpy can be imported once a backend is active
"""Simulated time for nodes in the test's own process: it advances when every node has received the last step."""

import time

from finssim.extensions.ros2.backend import activate

activate(announce=False)

import rclpy

from finssim.extensions.ros2.nodes.conversions import ros_type

PATIENCE = 120.0
"""Time limit for one step on a busy machine [s]."""
WORK = 8
"""Maximum number of callbacks of a node in one round."""


class RosTime:
    """A /clock, with `use_sim_time` as a parameter of the nodes; nothing depends on the speed of the machine."""

    def __init__(self, peer, nodes, step=0.01, start=100.0):
        """Publish time by `peer` for `nodes` that use it; times in seconds."""
        self.peer, self.nodes, self.step, self.now = peer, nodes, step, start
        self._kind = ros_type("rosgraph_msgs/msg/Clock")
        self._clock = peer.create_publisher(self._kind, "/clock", 1)

    @property
    def ns(self):
        """Time as a stamp [ns]."""
        return round(self.now * 1e9)

    def turn(self):
        """Advance by one step, and run all pending callbacks."""
        self.now += self.step
        message = self._kind()
        message.clock.sec, message.clock.nanosec = divmod(self.ns, 10**9)
        self._clock.publish(message)
        end = time.monotonic() + PATIENCE
        while True:
            for node in (*self.nodes, self.peer):
                for _ in range(WORK):
                    rclpy.spin_once(node, timeout_sec=0.0)
            if all(node.get_clock().now().nanoseconds == self.ns for node in self.nodes):
                return
            assert time.monotonic() < end, f"a node has not seen {self.now:.2f} s"

    def until(self, condition, each, longest=30.0):
        """Turn until a condition is true, calling `each` before each step; return whether it became true in
        time [s]."""
        end = self.now + longest
        while not condition() and self.now < end:
            each()
            self.turn()
        return condition()
