"""Hardware bridge node: the one process that talks to motor controller or autopilot, with arming and every watchdog."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from finssim.robot.bridge import Bridge, BridgeSettings
from finssim.robot.link.transports import DEFAULT_BIND, open_transport
from finssim.robot.messages import CommandEcho, NavigationAid, Telemetry
from finssim.robot.perception import Unlocated
from finssim.robot.runtime import Counters, Intake
from finssim.robot.wiring import POOL_ADDRESS, link_of
from finssim.ros2.nodes.bridge_topics import BridgeTopics
from finssim.ros2.nodes.robot_node import RobotNode

__all__ = ["HardwareBridge"]

LAST_FRAMES = 3
"""Frames without thrust at the end."""
RPM = 2.0 * math.pi / 60.0


class HardwareBridge(RobotNode):
    """Frames to and from the motor controller; disarmed until the topic `arm` says true, whatever else comes."""

    def __init__(self) -> None:
        super().__init__("hardware_bridge")
        located, bind = self.parameter("need_reading", True), self.parameter("bind", DEFAULT_BIND)
        address = POOL_ADDRESS if self.robot == "pool" else self.robot
        self.transport, link = open_transport(address, bind), link_of(address, self.vehicle)
        self.bridge = Bridge(self.vehicle, BridgeSettings.of(self.vehicle, need_reading=located))
        self.bridge.autopilot = link
        self.counters, self.shafts = Counters(), np.zeros(0)
        self.intake = Intake(Unlocated(self.vehicle), self.bridge, self.counters, self, link)
        self.sends("imu", "pressure", "telemetry", "shafts", "echo", "positioning", "dvl", "compass")
        self.topics = BridgeTopics(self, self.bridge)
        self.create_timer(1.0 / self.parameter("rate", 60.0), self._turn)
        self.create_timer(1.0, self._tell)
        self.event("start", self.transport.describe())

    def telemetry(self, now: float, telemetry: Telemetry, time: float) -> None:
        """Publish a snapshot, as `robot.runtime.Intake` gives it to a recorder; stamps are of the measurement.

        Args:
            now: When it came [s].
            telemetry: The snapshot.
            time: When it was measured [s].
        """
        stamp, received = self.ns(time), self.ns(now)
        self.send("telemetry", self.make.telemetry(stamp, received, telemetry))
        if self.heard("imu"):
            self.send("imu", self.make.imu(stamp, telemetry))
        if self.heard("pressure"):
            self.send("pressure", self.make.pressure(stamp, telemetry))
        self.send("shafts", self._speeds(stamp, telemetry.motor_rpm))

    def echo(self, now: float, echo: CommandEcho) -> None:
        """Publish what the motor controller made of a command."""
        self.send("echo", self.make.echo(self.ns(now), echo))

    def aid(self, now: float, aid: NavigationAid) -> None:
        """Publish what a navigation instrument measured, stamped with its measurement."""
        made = self.make.aid(self.ns(now - aid.age), aid)
        if made is not None:
            self.send(*made)

    def _speeds(self, stamp: int, rpm: Sequence[float] | None) -> Any:
        message = None if rpm is None else self.make.shafts(stamp, rpm)
        if message is not None:
            self.shafts = np.asarray(message.velocity, float)
        return message

    def _turn(self) -> None:
        now = self.now()
        self.intake.take(now, [(now, data) for data in self.transport.receive()])
        command = self.bridge.tick(now)
        if self.now() - now < self.bridge.settings.command_timeout:  # else the process stood still meanwhile
            for data in self.intake.link.encode(now, command, self.bridge.state):
                self.transport.send(data)
        self.topics.tell(now, normalised=command.normalised, shaft_speed=self.shafts)

    def _tell(self) -> None:
        state = self.bridge.state
        counts = {"telemetry": self.counters.telemetry, "wire": self.transport.describe()}
        level = {"fault": "error", "hold": "warn"}.get(state, "ok")
        self.diagnose(level, state + (f": {self.bridge.reason}" if self.bridge.reason else ""), counts)

    def close(self) -> None:
        """Disarm, tell the motor controller so, and let go of the wire."""
        self.bridge.disarm(self.now())
        for _ in range(LAST_FRAMES):
            for data in self.intake.link.encode(self.now(), self.bridge.tick(self.now()), self.bridge.state):
                self.transport.send(data)
        self.transport.close()
