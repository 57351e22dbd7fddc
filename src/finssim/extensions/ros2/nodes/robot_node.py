"""Common parts of a robot's nodes: a vehicle, a clock in seconds, the topics of the table, and an orderly end."""

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
"""Niceness of a node that others wait for; only a privileged user may have it, others do without."""
LISTENING = 1.0
"""Time for which a started node listens for another of its name [s]."""
FORGOTTEN = 11.0
"""When the wire has forgotten a node that was killed [s]: its lease of ten, and one to spare."""
REFUSED = 2
"""Exit status of a node that refuses its arguments."""
STEP = 1.0 / 60.0
"""Between ticks of /clock, and between commands and states of a simulator [s]."""
QUIET = 0.001
"""Time without messages after which the work of a time of /clock is done [s]."""
AGAIN = 0.5
"""Between two reports of the same work in lock-step [s], as one may be lost."""
LEFT = 2**31 - 1
"""Stamp in a report for a node that has left [s]."""
WRITING = 180.0
"""Time for a virtual pool to write its pool file [s]; the first rendering on a machine compiles."""


class TwinError(ValueError):
    """Another node of the same name is on the wire."""


class RobotNode(Node):
    """A node of one vehicle.

    Topics stand below the node's namespace, or below the vehicle's name where it has none. The robot's clock counts
    seconds of the node's ROS clock from its start, so that no digits are lost; simulated time counts from 0.
    """

    listening = 0.0
    """Time for which a new node listens for another of its name before it publishes [s]; `run` sets it."""
    urgent = True
    """True for nodes between a sensor and a thruster, which have priority over other programs if permitted."""

    def __init__(self, name: str, others: Sequence[str] = (), arguments: Sequence[str] = ()) -> None:
        """
        Args:
            name: Of the node.
            others: Of nodes that there must not be yet, besides one of its own name.
            arguments: Of this node alone, after --ros-args, besides those of the process.

        Raises:
            VehicleError: The parameters `vehicle` or `site` name none.
            TwinError: There is one of those nodes.
        """
        super().__init__(name, cli_args=["--ros-args", *arguments] if arguments else None)
        self.filed = load_vehicle(self.parameter("vehicle", "finsrov"))
        """The vehicle as its file has it, which policies are trained for."""
        self.robot = self.parameter("robot", "pool")
        """Address of the motor controller, or of an autopilot, whose vehicle has a Doppler log and a compass."""
        equipped = vehicle_at(
            self.parameter("site", "pool"), self.filed, navigation=self.robot.startswith("mavlink")
        )
        self.vehicle = numbered(equipped, self.parameter("number", 0))
        """The same as it is equipped for the site, with the tags of its number among several."""
        self.table = TOPICS | own_topics(self.vehicle)
        """Those of every robot, and of this vehicle's own cameras, sonars and altimeters."""
        self.make = RosMessages(self.vehicle, self.parameter("frame_prefix", ""))
        self._below = "" if self.get_namespace() != "/" else f"{self.vehicle.name.replace('-', '_')}/"
        simulated = self.get_parameter("use_sim_time").value
        self.base = 0 if simulated else self.get_clock().now().nanoseconds // 10**9 * 10**9
        """What the ROS clock shows when the robot's shows 0 [ns]."""
        self.lockstep = self.parameter("lockstep", False)
        """True where /clock waits for the nodes that live by it."""
        self._taken = self._noted = 0
        self._newer = self.parameter("pool_since", 0.0)
        self.add_on_set_parameters_callback(partial(_keep_clock, bool(simulated)))
        self._out: dict[str, Any] = {}
        self._listen_for({self.get_name(), *others})

    def _listen_for(self, names: set[str]) -> None:
        """Listen whether there are other nodes of these names in the namespace; ones that were killed fade out."""
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
        """Declare a parameter that is set at the start only, for nothing looks at it again; its value."""
        return self.declare_parameter(name, default, ParameterDescriptor(read_only=True)).value

    def now(self) -> float:
        """The robot's clock [s]."""
        return (self.get_clock().now().nanoseconds - self.base) * 1e-9

    def seconds(self, stamp: Any) -> float:
        """A message's stamp on the robot's clock [s]."""
        return (nanoseconds(stamp) - self.base) * 1e-9

    def ns(self, seconds: float) -> int:
        """A time of the robot's clock as a stamp [ns]; times before 1970 are no stamps."""
        return max(self.base + round(seconds * 1e9), 0)

    # -- topics -------------------------------------------------------------------------------------------------

    def topic(self, key: str) -> str:
        """Name of a topic."""
        return self.below(self.table[key].name)

    def below(self, name: str) -> str:
        """A name below the vehicle's, unless it begins with a slash."""
        return name if name.startswith("/") else self._below + name

    def sends(self, *keys: str) -> None:
        """Make publishers, before there is something to say: peers need time to find them."""
        for key in keys:
            kind, quality = ros_type(self.table[key].type), quality_profile(self.table[key].quality)
            self._out[key] = self.create_publisher(kind, self.topic(key), quality)

    def withdraw(self, key: str) -> None:
        """Remove a publisher, if there is one."""
        if key in self._out:
            self.destroy_publisher(self._out.pop(key))

    def send(self, key: str, message: Any) -> None:
        """Publish; None is nothing to say."""
        if message is not None:
            self._out[key].publish(message)

    def heard(self, key: str) -> bool:
        """Return whether our topic has a subscriber."""
        return key in self._out and bool(self._out[key].get_subscription_count())

    def hears(self, key: str, take: Callable[[Any], None], **options: Any) -> Any:
        """Listen to a topic; the subscription. Commands are taken from publishers of any durability, as they come."""
        kind, quality = ros_type(self.table[key].type), quality_profile(self.table[key].quality)

        def counted(message: Any) -> None:
            self._taken += 1
            take(message)

        return self.create_subscription(kind, self.topic(key), counted, quality, **options)

    # -- what every node says of itself ---------------------------------------------------------------------------

    def event(self, kind: str, text: str, at: float | None = None) -> None:
        """Something that happened, on the topic `events` and in the log. `at` is a time [s]."""
        now = self.now() if at is None else at
        values = {"stamp_ns": self.ns(now), "time": now, "kind": kind, "text": text, "node": self.get_name()}
        self.send("event", self.make.words(values))
        # Two lines: rclpy raises where one line of code logs now with this severity and now with that.
        if kind in ("fault", "refused", "error"):
            self.get_logger().warning(f"{kind}: {text}")
        else:
            self.get_logger().info(f"{kind}: {text}")

    def diagnose(self, part: str, level: str, text: str, values: dict[str, Any]) -> None:
        """Health of a part, on the topic `/diagnostics`; level is ok, warn, error or stale."""
        name = f"{self.get_fully_qualified_name().strip('/')}: {part}"
        self.send("diagnostics", self.make.diagnostics(self.ns(self.now()), name, level, text, values))

    # -- a process of its own -------------------------------------------------------------------------------------

    @classmethod
    def run(cls) -> int:
        """Be this node until SIGINT, SIGTERM, or the end of the launcher.

        Returns:
            Exit status: 0, or `REFUSED` with a sentence on standard error.
        """
        follow_parent()
        if cls.urgent:
            with suppress(PermissionError):
                os.nice(URGENCY)
        try:
            rclpy.init()
        except (RuntimeError, ValueError) as error:  # the command line, or a setting of the wire
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
            if rclpy.ok():  # else a signal shut the context down during a call, as the real rclpy does
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
        """Report, in lock-step, the finished work of each time of /clock from now on."""
        if self.lockstep and self.get_parameter("use_sim_time").value:
            self.sends("done")
            self._done = self.make.done(self.ns(self.now()), self.get_fully_qualified_name())
            steady = Clock(clock_type=ClockType.STEADY_TIME)
            self._quiet = self.create_timer(QUIET, self._tell_done, clock=steady)
            self._quiet.cancel()
            self.create_timer(STEP, self._quiet.reset)  # made last: others that are due with it come first
            self.create_timer(AGAIN, lambda: self.send("done", self._done), clock=steady)

    def _tell_done(self) -> None:
        """Report, unless a message was taken just now: more may wait, and unread ones would grow old."""
        if self._noted != self._taken:
            self._noted = self._taken
            return
        self._quiet.cancel()
        self._done = self.make.done(self.ns(self.now()), self.get_fully_qualified_name())
        self.send("done", self._done)

    def await_file(self, path: str) -> str:
        """Return the path of a pool file, once it is newer than the parameter `pool_since` requires.

        Raises:
            Ros2Error: It does not come.
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
        """Put in order what is not the middleware's; called once at the end, however it came."""


def matched_callbacks(matched: Callable[[Any], None]) -> Any:
    """Return event callbacks that report publishers of a subscription; None on Humble, which lacks them."""
    try:
        from rclpy.event_handler import SubscriptionEventCallbacks
    except ImportError:
        return None
    return SubscriptionEventCallbacks(matched=matched)


def _keep_clock(simulated: bool, parameters: Sequence[Any]) -> SetParametersResult:
    """Refuse another clock than that of the start, from which the node counts its seconds."""
    changed = any(p.name == "use_sim_time" and p.value != simulated for p in parameters)
    return SetParametersResult(
        successful=not changed,
        reason="its clock counts from the start of the node: start it again with this value"
        if changed
        else "",
    )


def _refused(error: Exception) -> int:
    """Say in one sentence what cannot be done."""
    print(f"finssim: {' '.join(str(error).split())}", file=sys.stderr)
    return REFUSED
