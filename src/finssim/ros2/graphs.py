"""Which nodes make up a robot, its virtual pool or a simulated vehicle, and with which parameters."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import yaml

from finssim.ros2.errors import Ros2Error
from finssim.ros2.topics import TOPICS, Topic

__all__ = ["GRAPHS", "MCU_PORT", "NODES", "Plan", "run_node", "topics_of"]

NODES = {
    "camera": "finssim.ros2.nodes.camera:Camera",
    "controller": "finssim.ros2.nodes.controller:Controller",
    "hardware_bridge": "finssim.ros2.nodes.hardware_bridge:HardwareBridge",
    "localizer": "finssim.ros2.nodes.localizer:Localizer",
    "recorder": "finssim.ros2.nodes.recorder:RecorderNode",
    "sim": "finssim.ros2_worlds.sim:Sim",
    "state_estimation": "finssim.ros2.nodes.state_estimation:StateEstimation",
    "teleop": "finssim.ros2.nodes.teleop:Teleop",
    "virtual_pool": "finssim.ros2_worlds.virtual_pool:VirtualPoolNode",
}
"""Node -> module and class."""

ROBOT = ("hardware_bridge", "camera", "localizer", "state_estimation", "controller")

GRAPHS = {"sim": ("sim", "controller"), "robot": ROBOT, "pool": ("virtual_pool", *ROBOT)}
"""Graph -> nodes, in the order of their start; they end in the reverse order, the bridge after who commands it."""

MCU_PORT = 58766
"""Of a virtual pool's motor controller, if not told otherwise; pictures leave from the next port."""


@dataclass
class Plan:
    """A graph before it lives."""

    graph: str
    vehicle: str
    namespace: str
    parameters: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Node, or `/**` for all -> parameters."""
    extra: tuple[str, ...] = ()
    """Nodes besides those of the graph: recorder, teleop."""
    blind: bool = False
    """Whether no camera looks, so that nothing is localized by it."""
    sees: bool = False
    """Whether pictures of the vehicle's own sensors come all the same."""

    def __post_init__(self) -> None:
        if self.graph not in GRAPHS:
            raise Ros2Error(f"unknown graph '{self.graph}'; available: {', '.join(GRAPHS)}")
        everywhere: dict[str, Any] = {"vehicle": self.vehicle}
        if self.graph == "sim":
            everywhere["use_sim_time"] = True
            self.set("sim", use_sim_time=False)
        self.parameters["/**"] = {**everywhere, **self.parameters.get("/**", {})}

    @property
    def nodes(self) -> tuple[str, ...]:
        """In the order of their start."""
        left_out = (("localizer",) if self.sees else ("camera", "localizer")) if self.blind else ()
        return (*(name for name in GRAPHS[self.graph] if name not in left_out), *self.extra)

    def set(self, node: str, **values: Any) -> None:
        """Give parameters; None leaves a node's own default."""
        known = {name: value for name, value in values.items() if value is not None}
        self.parameters.setdefault(node, {}).update(known)

    def write(self, path: Path) -> None:
        """The parameters as a ROS 2 parameter file."""
        tree = {
            key if key == "/**" else f"/{self.namespace}/{key}": {"ros__parameters": values}
            for key, values in self.parameters.items()
            if values
        }
        path.write_text(yaml.dump(tree, Dumper=_Quoting, sort_keys=False), encoding="utf-8")


def run_node(name: str, *words: str) -> int:
    """Run one node in this process, until Ctrl-C; its parameters come after --ros-args, or from a file there.

    Example: finssim ros2 node state_estimation

    Args:
        name (NAME): camera, controller, hardware_bridge, localizer, recorder, sim, state_estimation, teleop or
            virtual_pool; after it --ros-args as for any ROS 2 node.
        words: What follows it on the command line.

    Returns:
        The exit status.

    Raises:
        Ros2Error: There is no such node.
    """
    from finssim.quiet import start_warp

    sys.argv = [name, *words]
    if name not in NODES:
        raise Ros2Error(f"unknown node '{name}'; available: {', '.join(NODES)}")
    start_warp()
    module, _, node = NODES[name].partition(":")
    return int(getattr(import_module(module), node).run())


class _Quoting(yaml.SafeDumper):
    """Puts words into quotes: rcl would read `1e3`, `inf` and `y` as numbers and true where YAML reads words."""


_Quoting.add_representer(
    str, lambda dumper, word: dumper.represent_scalar("tag:yaml.org,2002:str", word, style='"')
)


def topics_of(plan: Plan) -> list[tuple[str, Topic]]:
    """Full names of what a graph's nodes publish, and of what they take from people."""
    senders = {*plan.nodes, "you", "every node"}
    return [
        (topic.under(plan.namespace), topic)
        for topic in TOPICS.values()
        if senders & {word.strip() for word in topic.sender.split(",")}
    ]
