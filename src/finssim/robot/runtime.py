"""The robot's software, one step at a time: inputs, state, decision, outputs."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt

from finssim.control.guidance import Guide
from finssim.robot.bridge import Bridge, MotorDevice
from finssim.robot.goals import highest
from finssim.robot.links.clock import ClockMap
from finssim.robot.links.frames import McuLink, Message
from finssim.robot.messages import CommandEcho, NavigationAid, Picture, Telemetry, ThrusterCommand
from finssim.robot.perception import Perception
from finssim.robot.pilots import Pilot
from finssim.robot.reading import Reading
from finssim.vehicles import Vehicle

if TYPE_CHECKING:
    from finssim.robot.recorder import Recorder
    from finssim.robot.team import Team

__all__ = ["Counters", "Intake", "Link", "Runtime", "Ticks"]


# What a run counts: steps, decisions that came late, and the time from camera to command.


EARLY = 0.002
"""A decision may come this much before its time [s], so that a loop that jitters misses no turn."""
MISSES = 3.0
"""Periods of a camera after which its last picture is too old to act on, if they are longer than `state_timeout`."""
REMEMBERED = 20_000
"""Latencies that are kept: half an hour at ten a second."""


class Ticks:
    """When a periodic thing is due: on the grid of its start, never later because an earlier turn was late."""

    def __init__(self, start: float = 0.0) -> None:
        """
        Args:
            start: First turn [s].
        """
        self._next = start

    def due(self, now: float, period: float) -> tuple[bool, int]:
        """Return whether it is time, and how many turns were missed altogether since the last one.

        Args:
            now: [s]
            period: From now on [s].
        """
        early = min(EARLY, 0.1 * period)
        if self._next - now > 2.0 * period:  # the clock was set back, or the period has become shorter
            self._next = now
        late = now + early - self._next
        if late < 0.0:
            return False, 0
        missed = math.floor(late / period)
        self._next += (missed + 1) * period
        return True, missed


@dataclass
class Counters:
    """Totals of a run."""

    steps: int = 0
    telemetry: int = 0
    pictures: int = 0
    fixes: int = 0
    """Pictures that became part of the state."""
    decisions: int = 0
    missed: int = 0
    """Turns of the pilot that passed without a decision because the loop was late."""
    overruns: int = 0
    """Steps that took longer than their period."""
    latencies: deque[float] = field(default_factory=lambda: deque(maxlen=REMEMBERED))
    """Time from the arrival of the newest picture in the state to the command that is decided on it [s]."""
    events: deque[Any] = field(default_factory=lambda: deque(maxlen=200))
    """The latest events of the bridge."""
    onboard: Counter[str] = field(default_factory=Counter)
    """Readings of the vehicle's own cameras, sonars and altimeters, by name."""
    sight: deque[float] = field(default_factory=lambda: deque(maxlen=REMEMBERED))
    """Time from the exposure of the oldest picture that a decision uses to its command [s]."""
    inference: deque[float] = field(default_factory=lambda: deque(maxlen=REMEMBERED))
    """Duration of decisions, of a pilot that uses pictures [s]."""
    _newest: float = math.nan
    _pending: float = math.nan
    _exposed: float = math.nan

    def picture(self, arrival: float, used: bool) -> None:
        """A picture came [s]."""
        self.pictures += 1
        if used:
            self.fixes += 1
            self._newest = arrival

    def decided(self, exposed: float = math.nan, took: float = math.nan) -> None:
        """Note a decision on the current state.

        Args:
            exposed: When the oldest picture that it is made on was taken [s]; NaN without pictures.
            took: What it took [s].
        """
        self._pending, self._newest = self._newest, math.nan
        self._exposed = exposed
        if not math.isnan(exposed):
            self.inference.append(took)

    def sent(self, now: float) -> None:
        """Note that the decision was sent [s]."""
        if not math.isnan(self._pending):
            self.latencies.append(now - self._pending)
            self._pending = math.nan
        if not math.isnan(self._exposed):
            self.sight.append(now - self._exposed)
            self._exposed = math.nan

    def summary(self) -> dict[str, Any]:
        """Totals as plain data; percentiles of the latency [s], None where there was none."""
        names = ("steps", "telemetry", "pictures", "fixes", "decisions", "missed", "overruns")
        totals = {name: getattr(self, name) for name in names} | {"latency_s": _percentiles(self.latencies)}
        if self.onboard:
            totals["onboard"] = dict(self.onboard)
        if self.sight:
            totals["exposure_to_command_s"] = _percentiles(self.sight)
            totals["inference_s"] = _percentiles(self.inference)
        return totals


def _percentiles(times: deque[float]) -> dict[str, float | None]:
    values = np.array(times)
    return {f"p{p}": float(np.percentile(values, p)) if values.size else None for p in (50, 95, 99)}


# Everything that arrives: decoded, put on the robot's clock, and given to perception, bridge and record.


USED = ("accepted", "initialized", "reacquired")


class Link(MotorDevice, Protocol):
    """Conversion of the bridge's commands for the other end of the wire: a motor controller or an autopilot."""

    let_in: tuple[float, float] | None
    """x, y of where the vehicle begins, world frame [m]; None: not given."""
    calibrate_depth: bool
    """True if the device calibrates its barometer, at the surface, before it arms."""
    highest: float
    """Greatest z of the goal or trajectory, world frame [m], for a device that measures depth by itself."""
    notes: list[str]
    """Sentences for the user since they were last taken."""

    def feed(self, now: float, data: bytes) -> list[Message]:
        """Messages that bytes complete, which came at a time [s]; never raises, whatever they are."""

    def encode(self, now: float, command: ThrusterCommand, state: str) -> list[bytes]:
        """Frames to send at a time [s] for the bridge's command and state."""


class Intake:
    """Feeds one perception and one bridge. Nothing that arrives can raise."""

    def __init__(
        self,
        perception: Perception,
        bridge: Bridge,
        counters: Counters,
        recorder: Recorder | None = None,
        link: Link | None = None,
    ) -> None:
        """
        Args:
            perception: Learns what the sensors say.
            bridge: Watches whether they still speak.
            counters: Counts it.
            recorder: Takes it down.
            link: Reads what comes; the vehicle's motor controller if None.
        """
        vehicle = perception.vehicle
        self.link: Link = link or McuLink(vehicle.mcu.outputs, len(vehicle.actuators))
        self.clock = ClockMap()
        self.pictures: dict[str, Picture] = {}
        """The latest reading of each of the vehicle's own cameras, sonars and altimeters, by name."""
        self._perception, self._bridge = perception, bridge
        self._counters, self.recorder = counters, recorder

    def take(
        self, now: float, frames: Sequence[tuple[float, bytes]], pictures: Sequence[Picture] = ()
    ) -> None:
        """Take in what has come.

        Args:
            now: Robot's clock [s].
            frames: Datagrams from the motor controller, each with its time of arrival [s].
            pictures: From the camera.
        """
        for arrival, data in frames:
            for message in self.link.feed(arrival, data):
                if isinstance(message, Telemetry):
                    self._telemetry(arrival, message)
                elif isinstance(message, CommandEcho):
                    self._echo(arrival, message)
                elif isinstance(message, NavigationAid):
                    self._aid(arrival, message)
        for picture in pictures:
            if not picture.source:
                verdict = self._perception.picture(now, picture)
                self._counters.picture(picture.time, verdict in USED)
            elif picture.source in self._perception.vehicle.perception:
                self.pictures[picture.source] = picture
                self._counters.onboard[picture.source] += 1
            if self.recorder is not None:
                self.recorder.picture(now, picture)

    def _telemetry(self, arrival: float, telemetry: Telemetry) -> None:
        time = self.clock.stamp(telemetry.mcu_ms, arrival)
        self._counters.telemetry += 1
        self._perception.telemetry(arrival, telemetry, time)
        self._bridge.telemetry(arrival, telemetry)
        if self.recorder is not None:
            self.recorder.telemetry(arrival, telemetry, time)

    def _aid(self, arrival: float, aid: NavigationAid) -> None:
        self._perception.aid(arrival, aid)
        if self.recorder is not None:
            self.recorder.aid(arrival, aid)

    def _echo(self, arrival: float, echo: CommandEcho) -> None:
        self._bridge.echo(arrival, echo)
        if self.recorder is not None:
            self.recorder.echo(arrival, echo)


Array = npt.NDArray[np.float64]


FORGET_AFTER = 1.0
"""Time in hold after which a pilot restarts from its first decision [s]."""


class Runtime:
    """Perception, pilot and bridge of one vehicle. Knows no clock and no wire: `step` is given both.

    Nothing that arrives can raise: bad data is counted. A pilot that fails stops the vehicle.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        perception: Perception,
        pilot: Pilot,
        guide: Guide,
        *,
        arm: bool = False,
        bridge: Bridge | None = None,
        recorder: Recorder | None = None,
        team: Team | None = None,
    ) -> None:
        """
        Args:
            vehicle: As its file has it.
            perception: Estimates the state, of pictures, telemetry and position fixes.
            pilot: Who steers.
            guide: Where to; its time starts when the vehicle is armed.
            arm: Arm once, as soon as the state is ready. False: thrusters never turn.
            bridge: Otherwise than by default.
            recorder: Takes down everything.
            team: Hears of others and tells them of this vehicle; None: it is alone.
        """
        self.vehicle, self.pilot, self.guide = vehicle, pilot, guide
        self.perception = perception
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
        self._arm, self._held_since = arm, math.inf
        self._ticks = Ticks()
        self.intake = Intake(self.perception, self.bridge, self.counters, recorder)
        self.attach(self.intake.link)

    def attach(self, link: Link) -> None:
        """Set the link to the other end of the wire: the vehicle's motor controller by default."""
        self.link = self.intake.link = self.bridge.autopilot = link
        link.let_in = self.perception.let_in

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
        for note in self.link.notes:
            self.bridge.note(now, note)
        self.link.notes.clear()
        reading = self.perception.reading(now)
        if self.team is not None:
            self.told = self.team.tell(now, reading)
            self.team.hear(now, heard)
            reading = self.team.known(reading)
        if self.intake.pictures:
            reading = replace(reading, pictures=dict(self.intake.pictures))
        if reading.ready and (reason := self._unseen(now)):
            reading = replace(reading, ready=False, reason=reason)
        self.reading = reading
        self.bridge.reading(now, reading)
        self._begin(now, reading)
        self._decide(now, reading)
        command = self.bridge.tick(now)
        self._record(now, reading, command)
        return self.link.encode(now, command, self.bridge.state)

    def sent(self, now: float) -> None:
        """Note when the datagrams of the last step were sent [s], for the latency of a decision."""
        self.counters.sent(now)

    def start(self, now: float) -> None:
        """Let the guide's time begin. `now` is the time [s]."""
        self.started = now
        self._ticks = Ticks(now)
        self.pilot.reset()
        if self.recorder is not None:
            self.recorder.event(now, "trial_start", self.guide.name)

    def hand_over(
        self, now: float, pilot: Pilot, guide: Guide, *, arm: bool, recorder: Recorder | None = None
    ) -> None:
        """Disarm, and restart with another pilot and guide, once arming is possible again.

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
        """Disarm; returns frames without thrust to send. `now` is the time [s]."""
        self._arm = False
        self.bridge.disarm(now)
        last = [self.link.encode(now, self.bridge.tick(now), self.bridge.state) for _ in range(frames)]
        self._record_events()
        return [frame for frames_of_tick in last for frame in frames_of_tick]

    @property
    def t(self) -> float:
        """Time of the latest reading since the guide's start [s]; NaN before it."""
        return math.nan if self.reading is None else self.reading.time - self.started

    def _begin(self, now: float, reading: Reading) -> None:
        """Arm as soon as that is possible, once, and let the guide's time begin."""
        if not math.isnan(self.started) or (self.pilot.needs_state and not reading.ready):
            return
        if self._arm:
            self.link.highest = highest(self.guide) if self.pilot.needs_state else -math.inf
            self.refusal = self.bridge.arm(now, self.pilot.name)
            if self.refusal:
                return
            self._arm = False
        self.start(now)

    def _unseen(self, now: float) -> str:
        """Return the picture that the pilot needs and the robot lacks, or only has too old; empty for none."""
        for name in getattr(self.pilot, "pictures", ()):
            if name not in self.intake.pictures:
                return f"no picture of {name} yet"
            age = now - self._exposed(name)
            if age > max(self.vehicle.safety.state_timeout, MISSES / self.vehicle.perception[name].rate) + (
                self.vehicle.perception[name].latency
            ):
                return f"the last picture of {name} is {age:.1f} s old"
        return ""

    def _exposed(self, name: str) -> float:
        """When the latest picture of a sensor was taken, robot's clock [s]."""
        return self.intake.pictures[name].time - self.vehicle.perception[name].latency

    def _decide(self, now: float, reading: Reading) -> None:
        """Ask the pilot when it is its turn and it knows enough."""
        if math.isnan(self.started):
            return
        self._held_since = min(self._held_since, now) if self.bridge.state == "hold" else math.inf
        due, missed = self._ticks.due(now, self.pilot.period)
        self.counters.missed += missed
        if not due or self.bridge.state == "fault" or (self.pilot.needs_state and not reading.ready):
            return
        if now - self._held_since > FORGET_AFTER:
            self.pilot.reset()  # its integral would grow against a vehicle that has no thrust
        force = self._asked(now, reading)
        if force is None:
            return
        self.counters.decisions += 1
        exposures = [self._exposed(name) for name in getattr(self.pilot, "pictures", ())]
        self.counters.decided(min(exposures, default=math.nan), getattr(self.pilot, "took", math.nan))
        self.force = self.bridge.command(now, force, self.pilot.name, stamp=reading.time)
        if self.recorder is not None:
            goal = self.guide.at(now - self.started)
            self.recorder.goal(now, goal.position, float(goal.yaw))
            thrust = force[: self.force.size]
            self.recorder.command(now, force, self.pilot.name, self.vehicle.control_matrix @ thrust)
            self.recorder.policy(
                now, self.pilot.name, period=self.pilot.period, missed=self.counters.missed, force=thrust,
                observation=getattr(self.pilot, "observation", ()), action=getattr(self.pilot, "action", ()),
                vehicle_sha256=self.vehicle.sha256,
            )  # fmt: skip

    def _asked(self, now: float, reading: Reading) -> Array | None:
        """Return the pilot's thrusts, or one number per channel; None, and the vehicle stopped, if it fails."""
        try:
            force = np.asarray(self.pilot.act(reading, self.guide, now - self.started), float)
        except (
            Exception
        ) as error:  # whatever a pilot does wrong, the thrusters must stop and the loop continue
            self.bridge.stop(now, f"pilot {self.pilot.name} failed: {' '.join(str(error).split())[:200]}")
            return None
        channels = (len(self.vehicle.channel_names),)
        if force.shape not in (self.force.shape, channels) or not np.isfinite(force).all():
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
                now, bridge.state, reason=bridge.reason, source=bridge.source, requested=bridge.requested,
                force=bridge.force, normalised=command.normalised,
            )  # fmt: skip
        self._record_events()

    def _record_events(self) -> None:
        for event in self.bridge.drain():
            self.counters.events.append(event)
            if self.recorder is not None:
                self.recorder.event(event.time, event.kind, event.text)
