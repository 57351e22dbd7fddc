"""Virtual pool node: vehicle and room on the wires of real ones, of which camera and hardware_bridge make topics."""

from __future__ import annotations

from pathlib import Path

from finssim.extensions.ros2.nodes.robot_node import RobotNode
from finssim.pool.run import MCU_PORT, Ends, SiteChoice
from finssim.pool.run import run as serve
from finssim.robot.links.transports import DEFAULT_BIND

__all__ = ["VirtualPoolNode"]


class VirtualPoolNode(RobotNode):
    """Reads its parameters and then is the pool until it is ended; nothing of the truth is published."""

    def __init__(self) -> None:
        super().__init__("virtual_pool")
        self.sends("event", "diagnostics")
        site, world = self.get_parameter("site").value, self.parameter("world", "") or None
        self.choice = SiteChoice(
            vehicle=self.get_parameter("vehicle").value,
            plant=str(self.parameter("plant", "1")),
            severity=self.parameter("severity", "realistic"),
            site=None if world is not None and site == "open-water" else site,  # as deep as the world
            world=world,
            start=self.parameter("start", "") or None,
            camera=self.parameter("camera", "pictures"),
            positioning=self.parameter("positioning", "none"),
            seed=self.parameter("seed", 1),
        )
        self._ends = Ends(port=self.parameter("port", MCU_PORT), robot=self.parameter("bind", DEFAULT_BIND))
        self._pool_file = _path(self.parameter("pool_file", ""))
        self._truth = _path(self.parameter("truth", ""))
        self.event("start", f"plant {self.choice.plant}, {self.choice.severity}")

    def spin(self) -> None:
        """Be the pool until SIGINT or SIGTERM."""
        serve(self.choice, self._ends, pool_file=self._pool_file, truth=self._truth)


def _path(text: str) -> Path | None:
    return Path(text) if text else None
