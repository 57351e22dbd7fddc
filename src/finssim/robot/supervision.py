"""All that watches a robot together: whether it is in danger, in want of something, or fit to be armed."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from finssim.geometry.rotations import quat_inverse_rotate
from finssim.robot.bridge_settings import BridgeSettings
from finssim.robot.commander import Commander
from finssim.robot.messages import Telemetry
from finssim.robot.robot import Reading
from finssim.robot.watchdogs import EchoWatch, FollowWatch, StateWatch, TelemetryWatch, TiltWatch
from finssim.robot.workspace import Workspace
from finssim.vehicles import Vehicle

__all__ = ["Clock", "Supervision"]

Array = npt.NDArray[np.float64]

UP = (0.0, 0.0, 1.0)
BACK = 0.05
"""The clock may seem to go back by this much, where messages are handed over out of the order of their arrival [s]."""


class Clock:
    """The time of the latest call, and whether time runs as it should."""

    def __init__(self, step: float) -> None:
        """
        Args:
            step: Longest step forward between two calls [s].
        """
        self.now = 0.0
        """The latest [s]."""
        self._step = step
        self._started = False

    def wrong(self, now: float) -> str:
        """Takes the time of a call; says what is wrong with it, "" if nothing."""
        if not math.isfinite(now):
            return "the clock is not a number"
        step = now - self.now if self._started else 0.0
        self._started = True
        if -BACK <= step <= self._step:
            self.now = now if step == 0.0 else max(now, self.now)
            return ""
        self.now = now
        return f"the clock jumped by {step:+.2f} s"


class Supervision:
    """The watchdogs of one vehicle and what they conclude. Every answer is one sentence, "" where all is well."""

    def __init__(self, vehicle: Vehicle, settings: BridgeSettings, outputs: int) -> None:
        self.settings = settings
        self.commander = Commander(len(vehicle.thrusters), settings.command_timeout)
        self.telemetry = TelemetryWatch(outputs, settings.telemetry_timeout)
        self.echo, self.follow = EchoWatch(), FollowWatch()
        self.state = StateWatch(settings.state_timeout, settings.vision_modes)
        imu = vehicle.sensors.imu
        level = UP if imu is None else quat_inverse_rotate(imu.orientation, UP)
        self.tilts = {
            "telemetry": TiltWatch(settings.max_tilt, settings.max_tilt_duration, level),
            "estimator": TiltWatch(settings.max_tilt, settings.max_tilt_duration),
        }
        self.workspace = Workspace(
            vehicle, settings.workspace_lower, settings.workspace_upper, settings.workspace_margin
        )

    def forget(self) -> None:
        """As before the first message."""
        for watch in (self.commander, self.telemetry, self.echo, self.follow, self.state):
            watch.forget()
        for tilt in self.tilts.values():
            tilt.forget()

    def take_telemetry(self, now: float, message: Telemetry, armed: bool) -> str:
        """Takes a well-formed message that came while `armed`, or not; "restarted" if the controller began anew."""
        news = self.telemetry.accept(now, message)
        if news != "old":
            self.follow.accept(now, message.flags, armed)
            self.tilts["telemetry"].accept(now, message.quaternion)
        return news if news == "restarted" else ""

    def take_reading(self, now: float, reading: Reading) -> None:
        """Takes a reading of the estimator."""
        self.state.accept(now, reading)
        pose = self.state.pose(now)
        if pose is None:
            self.tilts["estimator"].forget()
        else:
            self.tilts["estimator"].accept(now, pose[1])

    def danger(self, now: float) -> str:
        """What must stop the thrusters until somebody has looked."""
        limits = self.settings
        if self.telemetry.age(now) > limits.telemetry_timeout:
            return f"no fresh telemetry from the motor controller for {limits.telemetry_timeout:g} s"
        frozen = self.telemetry.frozen(now, limits.frozen_limit)
        if frozen:
            return f"telemetry is frozen: the {frozen} has repeated its numbers for {limits.frozen_limit:g} s"
        if self.echo.rejecting(limits.reject_limit):
            return f"the motor controller has refused every command for {limits.reject_limit:g} s"
        if self.follow.deaf(limits.reject_limit):
            return f"the motor controller has not followed any command for {limits.reject_limit:g} s"
        for source, tilt in self.tilts.items():
            if tilt.over(now):
                degrees = math.degrees(limits.max_tilt)
                return f"tilted beyond {degrees:.0f} degrees for {limits.max_tilt_duration:g} s, says the {source}"
        pose = self.state.pose(now)
        left = "" if pose is None else self.workspace.left(pose[0])
        return left and f"left the workspace: {left}"

    def want(self, now: float, since: float) -> str:
        """What thrust has to wait for: the estimator, or a command, counted from `since` [s] at the earliest."""
        # The estimator first: a controller that is not told where it is falls silent for that very reason.
        why = self._estimator(now)
        if why:
            return why
        late = now - max(self.commander.received, since) > self.settings.command_timeout
        return f"no command for {self.settings.command_timeout:g} s" if late else ""

    def unfit(self, now: float) -> str:
        """What stands against arming."""
        why = self.danger(now) or self._estimator(now)
        if why:
            return why
        rivals = self.commander.sources(now)
        if len(rivals) > 1:
            return f"two publishers command the thrusters: {' and '.join(rivals)}"
        if self.commander.asks(now):
            return "the command is not zero: release the sticks or stop the controller"
        return ""

    def limited(self, now: float, force: Array) -> Array:
        """Thrusts without what pushes out of the workspace, canonical order [N], (n,).

        Args:
            now: [s]
            force: Along the thrusters' axes, canonical order, within the limits [N], (n,).
        """
        pose = self.state.pose(now)
        return force if pose is None else self.workspace.inward_only(force, *pose)

    def _estimator(self, now: float) -> str:
        return self.state.missing(now) if self.settings.need_reading else ""
