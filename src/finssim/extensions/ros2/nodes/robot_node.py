"""Base of the robot's nodes: vehicle, clock in seconds, topics of the table, and orderly shutdown."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from typing import Any

import rclpy
from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

from finssim.core.system import follow_parent
from finssim.extensions.ros2 import Ros2Error
from finssim.extensions.ros2.nodes.conversions import RosMessages, nanoseconds, ros_type
from finssim.extensions.ros2.topics import TOPICS, own_topics, quality_profile
from finssim.vehicles import load_vehicle
from finssim.vehicles.defaults import numbered, vehicle_at

URGENCY = -10
"""Niceness of a node on which others wait; it needs a privileged user and is skipped otherwise."""
LISTENING = 1.0
"""Time for which a starting node listens for another of its name [s]."""
FORGOTTEN = 11.0
"""Time after which a killed node has disappeared from the graph [s]: its lease of ten seconds, and a margin of one."""
REFUSED = 2
"""Exit status of a node that refuses its arguments."""
STEP = 1.0 / 60.0
"""Interval of /clock ticks, and of commands and states of a simulator [s]."""
QUIET = 0.001
"""Time without messages after which the work for a tick of /clock is done [s]."""
AGAIN = 0.5
"""Interval of repeated reports of the same tick in lock-step [s], since one may be lost."""
LEFT = 2**31 - 1
"""Stamp in a report of a node that has left [s]."""
WRITING = 180.0
"""Longest time in which a virtual pool writes its pool file [s]; the first rendering on a machine compiles kernels."""


class TwinError(ValueError):
    """Another node with the same name exists on the network."""


class RobotNode(Node):
    """Node of one vehicle.

    Topics are below the node's namespace, or below the vehicle's name without a namespace. The robot's clock counts
    seconds of the node's ROS clock from its start, so that no digits are lost; simulated time counts from 0.
    """

    listening = 0.0
    """Time for which a new node listens for another of its name before it publishes [s]; `run` sets it."""
    urgent = True
    """True for nodes between sensor and thrusters, which get a higher process priority if permitted."""

    def __init__(self, name: str, others: Sequence[str] = (), arguments: Sequence[str] = ()) -> None:
        """
        Args:
            name: Name of the node.
            others: Names of nodes that must not exist yet, besides its own.
            arguments: Further arguments for this node, as after --ros-args.

        Raises:
            VehicleError: The parameter `vehicle` or `site` is invalid.
            TwinError: One of those nodes exists.
        """
        super().__init__(name, cli_args=["--ros-args", *arguments] if arguments else None)
        self.filed = load_vehicle(self.parameter("vehicle", "finsrov"))
        """Vehicle as in its file, for which policies are trained."""
        self.robot = self.parameter("robot", "pool")
        """Address of the motor controller, or of an autopilot, whose vehicle has a Doppler log and a compass."""
        equipped = vehicle_at(
            self.parameter("site", "pool"), self.filed, navigation=self.robot.startswith("mavlink")
        )
        self.vehicle = numbered(equipped, self.parameter("number", 0))
        """Vehicle as equipped for the site, with the tags of its number in a team."""
        self.table = TOPICS | own_topics(self.vehicle)
        """Topics of every robot, and of this vehicle's own cameras, sonars and altimeters."""
        self.make = RosMessages(self.vehicle, self.parameter("frame_prefix", ""))
        self._below = "" if self.get_namespace() != "/" else f"{self.vehicle.name.replace('-', '_')}/"
        simulated = self.get_parameter("use_sim_time").value
        self.base = 0 if simulated else self.get_clock().now().nanoseconds // 10**9 * 10**9
        """ROS time at which the robot's clock is 0 [ns]."""
        self.lockstep = self.parameter("lockstep", False)
        """True if /clock waits for the nodes that use it."""
        self._taken = self._noted = 0
        self._newer = self.parameter("pool_since", 0.0)
        self.add_on_set_parameters_callback(partial(_keep_clock, bool(simulated)))
        self._out: dict[str, Any] = {}
        self._listen_for({self.get_name(), *others})

    def _listen_for(self, names: set[str]) -> None:
        """Wait until there are no other nodes with these names in the namespace; killed ones disappear after
        a while."""
        begun, here, warned = time.monotonic(), self.get_namespace(), False
        while self.listening:
            there, passed = self.get_node_names_and_namespaces(), time.monotonic() - begun
            twins = sorted(n for n in names if there.count((n, here)) > (n == self.get_name()))
            if not twins and (warned or passed > self.listening):
                return
            if twins and passed > FORGOTTEN:
                raise TwinError(
                    f"another node {here.rstrip('/')}/{twins[0]} is on ROS domain {self.context.get_domain_id()}: "
                    "set ROS_DOMAIN_ID or another namespace, for two graphs in one command one vehicle"
                )
            if twins and not warned:
                self.get_logger().warning(f"there is another {twins[0]} in {here}: waiting until it has gone")
                warned = True
            time.sleep(0.05)

    # -- parameters and time ------------------------------------------------------------------------------------

    def parameter(self, name: str, default: Any) -> Any:
        """Declare a parameter that can be set only at the start, since it is read once, and return its value."""
        return self.declare_parameter(name, default, ParameterDescriptor(read_only=True)).value

    def now(self) -> float:
        """Return the time on the robot's clock [s]."""
        return (self.get_clock().now().nanoseconds - self.base) * 1e-9

    def seconds(self, stamp: Any) -> float:
        """Return a message's stamp on the robot's clock [s]."""
        return (nanoseconds(stamp) - self.base) * 1e-9

    def ns(self, seconds: float) -> int:
        """Return a time of the robot's clock as a stamp [ns]; times before 1970 give 0."""
        return max(self.base + round(seconds * 1e9), 0)

    # -- topics -------------------------------------------------------------------------------------------------

    def topic(self, key: str) -> str:
        """Return the name of a topic."""
        return self.below(self.table[key].name)

    def below(self, name: str) -> str:
        """Return a name below the vehicle's, unless it begins with a slash."""
        return name if name.startswith("/") else self._below + name

    def sends(self, *keys: str) -> None:
        """Create publishers in advance: peers need time to discover them."""
        for key in keys:
            kind, quality = ros_type(self.table[key].type), quality_profile(self.table[key].quality)
            self._out[key] = self.create_publisher(kind, self.topic(key), quality)

    def withdraw(self, key: str) -> None:
        """Remove a publisher, if there is one."""
        if key in self._out:
            self.destroy_publisher(self._out.pop(key))

    def send(self, key: str, message: Any) -> None:
        """Publish a message; None is ignored."""
        if message is not None:
            self._out[key].publish(message)

    def heard(self, key: str) -> bool:
        """Return whether a topic that this node publishes has a subscriber."""
        return key in self._out and bool(self._out[key].get_subscription_count())

    def hears(self, key: str, take: Callable[[Any], None], **options: Any) -> Any:
        """Subscribe to a topic and return the subscription. Publishers of any durability are accepted."""
        kind, quality = ros_type(self.table[key].type), quality_profile(self.table[key].quality)

        def counted(message: Any) -> None:
            self._taken += 1
            take(message)

        return self.create_subscription(kind, self.topic(key), counted, quality, **options)

    # -- reports of every node --------------------------------------------------------------------------------------

    def event(self, kind: str, text: str, at: float | None = None) -> None:
        """Report an event on the topic `events` and in the log. `at` is a time [s]."""
        now = self.now() if at is None else at
        values = {"stamp_ns": self.ns(now), "time": now, "kind": kind, "text": text, "node": self.get_name()}
        self.send("event", self.make.words(values))
        # Two lines: rclpy raises if one line of code logs with varying severity.
        if kind in ("fault", "refused", "error"):
            self.get_logger().warning(f"{kind}: {text}")
        else:
            self.get_logger().info(f"{kind}: {text}")

    def diagnose(self, part: str, level: str, text: str, values: dict[str, Any]) -> None:
        """Report the health of a part on the topic `/diagnostics`; level is ok, warn, error or stale."""
        name = f"{self.get_fully_qualified_name().strip('/')}: {part}"
        self.send("diagnostics", self.make.diagnostics(self.ns(self.now()), name, level, text, values))

    # -- process ----------------------------------------------------------------------------------------------------

    @classmethod
    def run(cls) -> int:
        """Run the node until SIGINT, SIGTERM, or the end of the launcher.

        Returns:
            Exit status: 0, or `REFUSED` with a sentence on standard error.
        """
        follow_parent()
        if cls.urgent:
            with suppress(PermissionError):
                os.nice(URGENCY)
        try:
            rclpy.init()
        except (RuntimeError, ValueError) as error:  # an invalid command line or network setting
            return _refused(error)
        RobotNode.listening = LISTENING
        node: RobotNode | None = None
        try:
            node = cls()
            node.spin()
        except (KeyboardInterrupt, ExternalShutdownException):
            pass
        except (ValueError, ParameterException) as error:
            return _refused(error)
        except Exception:
            if rclpy.ok():  # otherwise a signal shut the context down during a call, as in real rclpy
                raise
        finally:
            if node is not None:
                node.close()
            rclpy.try_shutdown()
        return 0

    def spin(self) -> None:
        """Run callbacks."""
        self.report()
        rclpy.spin(self)

    def report(self) -> None:
        """Start reporting, in lock-step, the finished work for each tick of /clock."""
        if self.lockstep and self.get_parameter("use_sim_time").value:
            self.sends("done")
            self._done = self.make.done(self.ns(self.now()), self.get_fully_qualified_name())
            steady = Clock(clock_type=ClockType.STEADY_TIME)
            self._quiet = self.create_timer(QUIET, self._tell_done, clock=steady)
            self._quiet.cancel()
            # Created last: others that are due at the same time run first.
            self.create_timer(STEP, self._quiet.reset)
            self.create_timer(AGAIN, lambda: self.send("done", self._done), clock=steady)

    def _tell_done(self) -> None:
        """Report, unless a message was just received: more may be waiting, and unread ones would become stale."""
        if self._noted != self._taken:
            self._noted = self._taken
            return
        self._quiet.cancel()
        self._done = self.make.done(self.ns(self.now()), self.get_fully_qualified_name())
        self.send("done", self._done)

    def await_file(self, path: str) -> str:
        """Return the path of a pool file, once it is newer than the parameter `pool_since` requires.

        Raises:
            Ros2Error: The file was not written in time.
        """
        end = time.monotonic() + WRITING
        while self._newer and self.context.ok():
            with suppress(OSError):
                if os.stat(path).st_mtime >= self._newer:
                    break
            if time.monotonic() > end:
                raise Ros2Error(f"{path}: the virtual pool did not write it: see its output above")
            time.sleep(0.05)
        return path

    def close(self) -> None:
        """Release resources outside the middleware; called once at the end, whatever its reason."""


def matched_callbacks(matched: Callable[[Any], None]) -> Any:
    """Return event callbacks that report publishers of a subscription; None on Humble, which lacks them."""
    try:
        from rclpy.event_handler import SubscriptionEventCallbacks
    except ImportError:
        return None
    return SubscriptionEventCallbacks(matched=matched)


def _keep_clock(simulated: bool, parameters: Sequence[Any]) -> SetParametersResult:
    """Refuse a change of `use_sim_time` after the start, since the node counts its seconds from the start."""
    changed = any(p.name == "use_sim_time" and p.value != simulated for p in parameters)
    return SetParametersResult(
        successful=not changed,
        reason="its clock counts from the start of the node: start it again with this value"
        if changed
        else "",
    )


def _refused(error: Exception) -> int:
    """Print the reason of a refusal in one sentence, and return its exit status."""
    print(f"finssim: {' '.join(str(error).split())}", file=sys.stderr)
    return REFUSED
