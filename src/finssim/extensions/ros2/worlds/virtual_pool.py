"""Virtual pool node: vehicle and room on the wires of real ones, of which camera and hardware_bridge make topics."""

from __future__ import annotations

from pathlib import Path

from finssim.extensions.ros2.nodes.robot_node import RobotNode
from finssim.pool.run import MCU_PORT
from finssim.pool.run import run as serve
from finssim.robot.links.transports import DEFAULT_BIND

__all__ = ["VirtualPoolNode"]


class VirtualPoolNode(RobotNode):
    """Reads its parameters and then is the pool until it is ended; nothing of the truth is published."""

    def __init__(self) -> None:
        super().__init__("virtual_pool")
        self.sends("event", "diagnostics")
        self.plan = {
            "plant": str(self.parameter("plant", "1")),
            "severity": self.parameter("severity", "realistic"),
            "camera": self.parameter("camera", "pictures"),
            "port": self.parameter("port", MCU_PORT),
            "robot": self.parameter("bind", DEFAULT_BIND),
            "pool_file": _path(self.parameter("pool_file", "")),
            "truth": _path(self.parameter("truth", "")),
            "start": self.parameter("start", "") or None,
            "positioning": self.parameter("positioning", "none"),
            "seed": self.parameter("seed", 1),
            "world": self.parameter("world", "") or None,
        }
        self._vehicle_name = self.get_parameter("vehicle").value
        self._site = self.get_parameter("site").value
        self.event("start", f"plant {self.plan['plant']}, {self.plan['severity']}")

    def spin(self) -> None:
        """Be the pool until SIGINT or SIGTERM."""
        world_is_site = self.plan["world"] is not None and self._site == "open-water"  # as deep as the world
        options = {"bind": "127.0.0.1", "site": None if world_is_site else self._site, **self.plan}
        serve(vehicle=self._vehicle_name, **options)


def _path(text: str) -> Path | None:
    return Path(text) if text else None
