"""The robot's software, one step at a time: what has come in, what is known of it, what is decided, what goes out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from finssim.control.guidance import Guide
from finssim.localization.pool import Pool
from finssim.robot.bridge import Bridge
from finssim.robot.counters import Counters, Ticks
from finssim.robot.intake import Intake
from finssim.robot.link.frames import encode_command
from finssim.robot.messages import Picture, ThrusterCommand
from finssim.robot.perception import Perception
from finssim.robot.pilots import Pilot
from finssim.robot.robot import Reading
from finssim.robot.team import Team
from finssim.vehicles import Vehicle

if TYPE_CHECKING:
    from finssim.robot.recorder import Recorder

__all__ = ["Runtime"]

Array = npt.NDArray[np.float64]


class Runtime:
    """Perception, pilot and bridge of one vehicle. Knows no clock and no wire: `step` is given both.

    Nothing that arrives can raise: bad data is counted. A pilot that fails stops the vehicle.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        pool: Pool | None,
        pilot: Pilot,
        guide: Guide,
        *,
        arm: bool = False,
        perception: Perception | None = None,
        bridge: Bridge | None = None,
        recorder: Recorder | None = None,
        team: Team | None = None,
    ) -> None:
        """
        Args:
            vehicle: As its file has it.
            pool: Camera, water and frames; None: no camera looks.
            pilot: Who steers.
            guide: Where to; its time starts when the vehicle is armed.
            arm: Arm once, as soon as the state is ready. False: thrusters never turn.
            perception: Otherwise than by default.
            bridge: Otherwise than by default.
            recorder: Takes down everything.
            team: Hears of others and tells them of this vehicle; None: it is alone.
        """
        self.vehicle, self.pilot, self.guide = vehicle, pilot, guide
        self.perception = perception or Perception(vehicle, pool)
        self.bridge = bridge or Bridge(vehicle)
        self.recorder, self.team = recorder, team
        self.told: list[bytes] = []
        """Datagrams for the others of the last step."""
        self.counters = Counters()
        self.reading: Reading | None = None
        """The latest."""
        self.force = np.zeros(len(vehicle.thruster_names))
        """Thrusts that were asked for last, as the bridge limited them [N], (n,)."""
        self.started = math.nan
        """When the guide's time began [s]; NaN before."""
        self.refusal = ""
        """Why arming was refused last; empty where it was not."""
        self._arm = arm
        self._ticks = Ticks()
        self.intake = Intake(self.perception, self.bridge, self.counters, recorder)

    def step(
        self,
        now: float,
        frames: Sequence[tuple[float, bytes]],
        pictures: Sequence[Picture] = (),
        heard: Sequence[bytes] = (),
    ) -> list[bytes]:
        """One turn of the loop.

        Args:
            now: Robot's clock [s].
            frames: Datagrams from the motor controller, each with its time of arrival [s].
            pictures: From the camera.
            heard: Datagrams from the others.

        Returns:
            Datagrams to send to the motor controller now; those for the others are `told`.
        """
        self.counters.steps += 1
        self.intake.take(now, frames, pictures)
        reading = self.perception.reading(now)
        if self.team is not None:
            self.told = self.team.tell(now, reading)
            self.team.hear(now, heard)
            reading = self.team.known(reading)
        self.reading = reading
        self.bridge.reading(now, reading)
        self._begin(now, reading)
        self._decide(now, reading)
        command = self.bridge.tick(now)
        self._record(now, reading, command)
        return [encode_command(command)]

    def sent(self, now: float) -> None:
        """Tell when the datagrams of the last step went out [s], for the latency of a decision."""
        self.counters.sent(now)

    def start(self, now: float) -> None:
        """Let the guide's time begin."""
        self.started = now
        self._ticks = Ticks(now)
        self.pilot.reset()
        if self.recorder is not None:
            self.recorder.event(now, "trial_start", self.guide.name)

    def hand_over(
        self, now: float, pilot: Pilot, guide: Guide, *, arm: bool, recorder: Recorder | None = None
    ) -> None:
        """Disarm, and begin anew with another pilot and guide, once all stands for arming again.

        Args:
            now: Robot's clock [s].
            pilot: Who steers from then on.
            guide: Where to; its time starts when the vehicle is armed again.
            arm: Arm once, as soon as the state is ready.
            recorder: Takes down everything from now on; nobody does if None.
        """
        self.bridge.disarm(now)
        self._record_events()
        self.pilot, self.guide, self._arm = pilot, guide, arm
        self.started, self.refusal, self.force = math.nan, "", np.zeros_like(self.force)
        self.recorder = self.intake.recorder = recorder

    def stop(self, now: float, frames: int = 3) -> list[bytes]:
        """Disarm; returns frames without thrust to send."""
        self._arm = False
        self.bridge.disarm(now)
        last = [encode_command(self.bridge.tick(now)) for _ in range(frames)]
        self._record_events()
        return last

    @property
    def t(self) -> float:
        """Time of the latest reading since the guide's start [s]; NaN before it."""
        return math.nan if self.reading is None else self.reading.time - self.started

    def _begin(self, now: float, reading: Reading) -> None:
        """Arm as soon as that is possible, once, and let the guide's time begin."""
        if not math.isnan(self.started) or (self.pilot.needs_state and not reading.ready):
            return
        if self._arm:
            self.refusal = self.bridge.arm(now, self.pilot.name)
            if self.refusal:
                return
            self._arm = False
        self.start(now)

    def _decide(self, now: float, reading: Reading) -> None:
        """Ask the pilot when it is its turn and it knows enough."""
        if math.isnan(self.started):
            return
        due, missed = self._ticks.due(now, self.pilot.period)
        self.counters.missed += missed
        if not due or self.bridge.state == "fault" or (self.pilot.needs_state and not reading.ready):
            return
        force = self._asked(now, reading)
        if force is None:
            return
        self.counters.decisions += 1
        self.counters.decided()
        self.force = self.bridge.command(now, force, self.pilot.name, stamp=reading.time)
        if self.recorder is not None:
            goal = self.guide.at(now - self.started)
            self.recorder.goal(now, goal.position, float(goal.yaw))
            self.recorder.command(now, force, self.pilot.name, self.vehicle.control_matrix @ force)
            self.recorder.policy(
                now,
                self.pilot.name,
                period=self.pilot.period,
                missed=self.counters.missed,
                force=force,
                observation=getattr(self.pilot, "observation", ()),
                action=getattr(self.pilot, "action", ()),
                vehicle_sha256=self.vehicle.sha256,
            )

    def _asked(self, now: float, reading: Reading) -> Array | None:
        """What the pilot wants; None, and the vehicle stopped, where it fails."""
        try:
            force = np.asarray(self.pilot.act(reading, self.guide, now - self.started), float)
        except Exception as error:  # whatever a pilot does wrong, the thrusters must stop and the loop go on
            self.bridge.stop(now, f"pilot {self.pilot.name} failed: {' '.join(str(error).split())[:200]}")
            return None
        if force.shape != self.force.shape or not np.isfinite(force).all():
            self.bridge.stop(
                now, f"pilot {self.pilot.name} asks for {force.tolist()}, expected finite thrusts"
            )
            return None
        return force

    def _record(self, now: float, reading: Reading, command: ThrusterCommand) -> None:
        bridge = self.bridge
        if self.recorder is not None:
            self.recorder.reading(now, reading)
            self.recorder.thrusters(
                now,
                bridge.state,
                reason=bridge.reason,
                source=bridge.source,
                requested=bridge.requested,
                force=bridge.force,
                normalised=command.normalised,
            )
        self._record_events()

    def _record_events(self) -> None:
        for event in self.bridge.drain():
            self.counters.events.append(event)
            if self.recorder is not None:
                self.recorder.event(event.time, event.kind, event.text)
