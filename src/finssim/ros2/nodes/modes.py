"""The controllers that a controller node can switch between, and what is told of each decision."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np
import numpy.typing as npt

from finssim.control import ControlError
from finssim.control.controllers import CONTROLLERS, COSTLY
from finssim.control.guidance import Guide, Measured
from finssim.control.policy import NETWORK_FILE
from finssim.robot.pilots import AgentPilot, ModeSwitch, WrenchPilot, make_pilot
from finssim.robot.runtime import Runtime
from finssim.ros2.nodes.conversions import wrench_of
from finssim.ros2.nodes.robot_node import RobotNode

__all__ = ["Modes"]

Array = npt.NDArray[np.float64]

STALE = 0.5
"""A wrench older than this is none [s]."""


class Modes:
    """PIDs by name, `policy` where a directory was given, and `teleop`: the topic `wrench_cmd`."""

    def __init__(self, node: RobotNode, policy: str, task: str) -> None:
        """
        Args:
            node: That hears wrenches.
            policy: A PID's name or a policy's directory, to begin with.
            task: That the policy must have been trained for; empty: its own.

        Raises:
            PolicyError, ControlError: It does not fit the vehicle.
        """
        self._node = node
        self._wrench, self._wrench_at = np.zeros(6), -math.inf
        pilots: dict[str, Any] = {
            name: make_pilot(name, node.filed) for name in CONTROLLERS if name == policy or name not in COSTLY
        }
        self._policy: AgentPilot | None = None
        if policy not in pilots:
            pilots["policy"] = self._policy = make_pilot(policy, node.filed, task=task or None)
        pilots["teleop"] = WrenchPilot(self._newest, node.vehicle)
        self._pilots = {name: _Timed(pilot) for name, pilot in pilots.items()}
        self.switch = ModeSwitch(self._pilots, policy if policy in pilots else "policy")
        node.hears("wrench", self._on_wrench)

    def select(self, mode: str) -> bool:
        """Hand over; whether that changed anything: an unknown mode does not."""
        if mode == self.switch.mode:
            return False
        try:
            self.switch.select(mode)
        except ControlError as error:
            self._node.event("refused", str(error))
            return False
        self._node.event("mode", mode)
        return True

    def told(self, stamp: int, runtime: Runtime) -> Any:
        """PolicyInfo of the decision just made."""
        pilot = self._pilots[self.switch.mode]
        values: dict[str, Any] = {
            "period": pilot.period,
            "compute_time": pilot.took,
            "missed": runtime.counters.missed,
            "force": runtime.force,
            "vehicle_sha256": self._node.vehicle.sha256,
            "task": pilot.describe().get("task", ""),
            "observation": getattr(pilot, "observation", ()),
            "action": getattr(pilot, "action", ()),
        }
        if self.switch.mode == "policy" and self._policy is not None:
            values["policy_sha256"] = self._policy.describe().get("files", {}).get(NETWORK_FILE, "")
        return self._node.make.policy(stamp, self.switch.mode, values)

    def _newest(self) -> Array:
        fresh = self._node.now() - self._wrench_at <= STALE
        return self._wrench if fresh else np.zeros(6)

    def _on_wrench(self, message: Any) -> None:
        tau = wrench_of(message, self._node.make.frame("base_link"))
        if tau is not None:
            self._wrench, self._wrench_at = tau, self._node.now()


class _Timed:
    """A pilot, and how long its latest decision took."""

    def __init__(self, pilot: Any) -> None:
        self._pilot = pilot
        self.took = math.nan
        """[s]"""

    def __getattr__(self, name: str) -> Any:
        return getattr(self._pilot, name)

    def act(self, reading: Measured, guide: Guide, t: float) -> Array:
        """Wanted thrusts in canonical order [N], (n,)."""
        start = time.perf_counter()
        force: Array = self._pilot.act(reading, guide, t)
        self.took = time.perf_counter() - start
        return force
