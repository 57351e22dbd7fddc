"""Virtual pool node: vehicles and room with the interfaces of real ones, from which camera and hardware_bridge make
topics."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import rclpy

from finssim.core import realtime
from finssim.extensions.ros2.nodes.conversions import ros_type
from finssim.extensions.ros2.nodes.robot_node import RobotNode
from finssim.extensions.ros2.topics import TOPICS, quality_profile
from finssim.extensions.ros2.up import DVL_AFTER, STATIONS_AFTER
from finssim.extensions.ros2.worlds.clock import PacedClock
from finssim.pool.fleet import Fleet, Medium
from finssim.pool.real_time import PoolTiming
from finssim.pool.run import MCU_PORT, Ends, PoolFiles, SiteChoice
from finssim.pool.run import run as serve
from finssim.robot.links.transports import DEFAULT_BIND
from finssim.tasks.communication import Communication

__all__ = ["MessageTopics", "VirtualPoolNode"]


class MessageTopics:
    """Acoustic channel between the vehicles of a team: each receives what the others publish, delayed and
    with losses."""

    def __init__(self, node: RobotNode, fleet: Fleet, communication: Communication, seed: int) -> None:
        """
        Args:
            node: Node of the pool.
            fleet: Vehicles; their names are their namespaces.
            communication: Speed of sound, processing time and loss.
            seed: Seed of the losses.
        """
        place = lambda: {name: world.plant.position for name, world in fleet.worlds.items()}  # noqa: E731
        self._medium, self._now, self._node = Medium(place, communication, seed), 0.0, node
        kind, self._out = ros_type(TOPICS["sent"].type), {}
        quality: Any = quality_profile(TOPICS["sent"].quality)
        for name in fleet.worlds:
            self._out[name] = node.create_publisher(kind, TOPICS["received"].under(name), quality)
            take = lambda data, name=name: self._medium.send(self._now, name, bytes(data))  # noqa: E731
            node.create_subscription(kind, TOPICS["sent"].under(name), take, quality, raw=True)

    def poll(self, now: float) -> None:
        """Deliver what has arrived at a time [s]."""
        self._now = now
        for name, publisher in self._out.items():
            for data in self._medium.receive(now, name):
                publisher.publish(data)


class VirtualPoolNode(RobotNode):
    """Reads its parameters, then runs the pool until it is ended. Nothing of the truth is published."""

    def __init__(self) -> None:
        super().__init__("virtual_pool")
        self.sends("event", "diagnostics")
        site, world = self.get_parameter("site").value, self.parameter("world", "") or None
        water = self.parameter("water", "")
        self.choice = SiteChoice(
            vehicle=self.get_parameter("vehicle").value,
            plant=str(self.parameter("plant", "1")),
            severity=self.parameter("severity", "realistic"),
            firmware=self.parameter("firmware", "mcu"),
            site=None if world is not None and site == "open-water" else site,  # as deep as the world's water
            world=world,
            water=_path(water),
            start=self.parameter("start", "") or None,
            camera=self.parameter("camera", "pictures"),
            positioning=self.parameter("positioning", "none"),
            seed=self.parameter("seed", 1),
        )
        port = self.parameter("port", MCU_PORT)
        stations, log = (f"127.0.0.1:{port + after}" for after in (STATIONS_AFTER, DVL_AFTER))
        self._addresses = Ends(port=port, robot=self.parameter("bind", DEFAULT_BIND), tcp=stations, dvl=log)
        self._pool_file = _path(self.parameter("pool_file", ""))
        self._truth = _path(self.parameter("truth", ""))
        self.team = self.parameter("team", "") or None
        usual = Communication()
        self.communication = Communication(
            loss=self.parameter("message_loss", usual.loss),
            processing=self.parameter("message_delay", usual.processing),
        )
        factor, names = self.parameter("real_time_factor", 0.0), self.parameter("waits_for", "").split()
        self.clock: PacedClock | None = None
        if self.lockstep or factor > 0.0:
            self.base = 0
            self.clock = PacedClock(self, factor, names)
        self.event("start", f"plant {self.choice.plant}, {self.choice.severity}")

    def now(self) -> float:
        """Return the time of the pool, which is that of the topic /clock if it is published [s]."""
        return super().now() if self.clock is None else self.clock.time

    def spin(self) -> None:
        """Run the pool until SIGINT or SIGTERM."""
        files = PoolFiles(pool_file=self._pool_file, truth=self._truth)
        serve(self.choice, self._addresses, team=self.team, files=files, timing=_NodeTiming(self))


class _NodeTiming(PoolTiming):
    """Timing of the pool of a node: by /clock, or by real time, in which a team's messages are received."""

    def __init__(self, node: VirtualPoolNode) -> None:
        self._node, self._clock = node, node.clock
        self.paced = node.clock is not None

    def now(self) -> float:
        return super().now() if self._clock is None else self._clock.time

    def wait(self, duration: float, until: Callable[[], bool]) -> None:
        if self._clock is not None:
            self._clock.wait(until)
        elif self._node.team is None:
            super().wait(duration, until)
        else:
            end = time.monotonic() + duration / realtime.clock_rate()
            while (rest := end - time.monotonic()) > 0.0:
                rclpy.spin_once(self._node, timeout_sec=rest)

    def messages(self, fleet: Fleet) -> MessageTopics | None:
        node = self._node
        return MessageTopics(node, fleet, node.communication, node.choice.seed) if node.team else None


def _path(text: str) -> Path | None:
    return Path(text) if text else None
