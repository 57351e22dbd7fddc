"""Controller node: computes thrusts by PID, policy or an operator's wrench, while the bridge reports that it
is armed."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from finssim.agents.controllers import CONTROLLERS, COSTLY
from finssim.control import ControlError
from finssim.control.guidance import Guide, Measured, Station
from finssim.control.policy import NETWORK_FILE
from finssim.control.trajectories import check_speed, through_points
from finssim.core.rotations import quat_yaw
from finssim.extensions.ros2.nodes.conversions import own_reading, station_of_pose, trajectory_of, wrench_of
from finssim.extensions.ros2.nodes.remote import RemoteBridge, RemoteState
from finssim.extensions.ros2.nodes.robot_node import RobotNode
from finssim.robot.goals import GoalError, check_reachable, guide_of
from finssim.robot.messages import Picture
from finssim.robot.pilots import AgentPilot, ModeSwitch, WrenchPilot, make_pilot
from finssim.robot.reading import Reading
from finssim.robot.runtime import Runtime

Array = npt.NDArray[np.float64]

STALE = 0.5
"""Age from which a wrench is ignored [s]."""


class Modes:
    """Control modes: PIDs by name, `policy` if a directory is given, and `teleop` by the topic `wrench_cmd`."""

    def __init__(self, node: RobotNode, policy: str, task: str) -> None:
        """
        Args:
            node: Node that receives wrenches.
            policy: Initial mode: name of a PID, or directory of a policy.
            task: Task for which the policy must have been trained; empty: its own.

        Raises:
            PolicyError: The policy does not fit the vehicle.
            ControlError: The controller does not fit the vehicle.
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
        """Switch the mode; return whether it changed, which it does not for an unknown mode."""
        if mode == self.switch.mode:
            return False
        try:
            self.switch.select(mode)
        except ControlError as error:
            self._node.event("refused", str(error))
            return False
        self._node.event("mode", mode)
        return True

    def policy_info(self, stamp: int, runtime: Runtime) -> Any:
        """Return the PolicyInfo of the latest decision."""
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
    """Pilot with a measurement of the duration of its latest decision."""

    def __init__(self, pilot: Any) -> None:
        self._pilot = pilot
        self.took = math.nan
        """Duration of the latest decision [s]."""

    def __getattr__(self, name: str) -> Any:
        return getattr(self._pilot, name)

    def act(self, reading: Measured, guide: Guide, t: float) -> Array:
        """Return the requested thrusts in canonical order [N], (n,)."""
        start = time.perf_counter()
        force: Array = self._pilot.act(reading, guide, t)
        self.took = time.perf_counter() - start
        return force


# Node and its callbacks.


STATE_TIMEOUT = 0.5
"""Greatest age of a usable reading, unless the vehicle file specifies one [s]."""
PATH_POINTS = 200
MOST_PICTURES = 16
"""Greatest number of queued pictures while the bridge is not armed; the oldest is dropped."""


class ControllerNode(RobotNode):
    """Node that is silent until the bridge is armed; then a trajectory starts, or without a goal the vehicle
    holds its pose."""

    def __init__(self) -> None:
        super().__init__("controller")
        self.sends("command", "path", "policy", "event", "diagnostics")
        self.sends(*["setpoints"] * bool(self.vehicle.actuators))
        safety = self.vehicle.safety
        policy, task = self.parameter("policy", "pid"), self.parameter("task", "")
        self.modes = Modes(self, policy, task)
        self.bridge = RemoteBridge(self, lambda: f"{self.get_name()}/{self.modes.switch.mode}")
        self.state = RemoteState(self, safety.state_timeout if safety else STATE_TIMEOUT)
        nowhere = Station((0.0, 0.0, 0.0), 0.0)
        self.runtime = Runtime(self.vehicle, self.state, self.modes.switch, nowhere, bridge=self.bridge)
        self.guide: Guide | None = None
        self.armed = False
        # Import and compute everything for the first path now: once armed, the loop must not wait for it.
        check_speed(through_points("", [(0.0, 0.0, 0.0, 0.0), (1e3, 0.0, 0.0, 0.0)]), self.vehicle)
        goal, trajectory = self.parameter("goal", ""), self.parameter("trajectory", "")
        if goal or trajectory:
            self._follow(guide_of(goal or None, trajectory or None))
        self.hears("goal", lambda message: self._take(station_of_pose(message)))
        self.hears("follow", lambda message: self._take(trajectory_of(message)))
        self.hears("trajectory", self._on_trajectory)
        self.hears("mode", self._on_mode)
        self._seen: list[Picture] = []
        for name, shape in self.modes.switch.pictures.items():
            kind = "range" if not shape else "sonar" if shape[-1] == 1 else "image"
            self.hears(f"{name}/{kind}", partial(self._on_own, name))
        self.create_timer(1.0 / self.parameter("rate", 60.0), self._turn)
        self.create_timer(1.0, self._publish_diagnostics)

    def _turn(self) -> None:
        if self.bridge.silent:  # not the same as disarmed: a trajectory continues with the next message
            return
        now, armed = self.now(), self.bridge.state in ("armed", "hold")
        begins, self.armed = armed and not self.armed, armed
        if begins:
            self.runtime.started = math.nan
        if not armed:
            return
        if math.isnan(self.runtime.started):
            self.runtime.guide = self.guide or _here(self.state.reading(now))
        before, began = self.runtime.counters.decisions, self.runtime.started
        pictures, self._seen = self._seen, []
        self.runtime.step(now, (), pictures)
        if self.runtime.started != began and not math.isnan(self.runtime.started):
            self._show(self.runtime.guide, self.runtime.started)
        if self.runtime.counters.decisions > before:
            self.send("policy", self.modes.policy_info(self.ns(now), self.runtime))

    def _on_own(self, name: str, message: Any) -> None:
        """Queue a reading of an onboard sensor for a policy with perception; invalid ones are ignored."""
        reading = own_reading(message)
        if reading is not None:
            late = self.vehicle.perception[name].latency
            time = self.seconds(message.header.stamp) + late
            self._seen.append(replace(reading, time=time, source=name))
            del self._seen[:-MOST_PICTURES]

    def _follow(self, guide: Guide) -> None:
        """Follow a guide from now on, if the vehicle can reach it.

        Raises:
            GoalError: The vehicle cannot reach it.
        """
        check_reachable(guide, self.vehicle)
        self.guide = self.runtime.guide = guide
        now = self.now()
        if not math.isnan(self.runtime.started):
            self.runtime.start(now)
        self._show(guide, now)
        self.event("goal", guide.name)

    def _show(self, guide: Guide, began: float) -> None:
        """Publish the path with its times, for a start at a given time [s]."""
        end = guide.duration if math.isfinite(guide.duration) else 0.0
        times = np.linspace(0.0, end, PATH_POINTS if end else 1)
        way, stamps = guide.at(times), [self.ns(began + float(t)) for t in times]
        self.send("path", self.make.path(self.ns(self.now()), stamps, way.position, way.yaw))

    def _take(self, guide: Guide | str) -> None:
        """Follow the guide of a message, or report why it is not possible."""
        if isinstance(guide, str):
            self.event("refused", guide)
        else:
            self._try(lambda: guide)

    def _on_trajectory(self, message: Any) -> None:
        self._try(lambda: guide_of(None, str(message.data)))

    def _on_mode(self, message: Any) -> None:
        if self.modes.select(str(message.data)):
            self.runtime.started = math.nan  # the new pilot restarts

    def _try(self, make: Any) -> None:
        try:
            self._follow(make())
        except (GoalError, ControlError, OSError) as error:
            self.event("refused", " ".join(str(error).split()))

    def _publish_diagnostics(self) -> None:
        counters = self.runtime.counters
        values = {"mode": self.modes.switch.mode, "decisions": counters.decisions, "missed": counters.missed}
        self.diagnose("control", "ok", self.bridge.state, values)


def _here(reading: Reading) -> Guide:
    """Return a guide that holds the position and heading of a reading."""
    x, y, z = (float(v) for v in reading.position)
    return Station((x, y, z), float(quat_yaw(reading.quaternion)), "here")
