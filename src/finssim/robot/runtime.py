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


# Statistics of a run: steps, late decisions, and the time from picture to command.


EARLY = 0.002
"""Greatest lead of a decision over its due time [s], so that a loop with jitter misses no turn."""
MISSES = 3.0
"""Age of a camera's last picture, in periods, above which it is too old, if that exceeds `state_timeout`."""
REMEMBERED = 20_000
"""Greatest number of stored latencies: half an hour at ten per second."""


class Ticks:
    """Schedule of a periodic task: on a fixed grid from its start, so that a late turn does not delay later ones."""

    def __init__(self, start: float = 0.0) -> None:
        """Set the first turn.

        Args:
            start: First turn [s].
        """
        self._next = start

    def due(self, now: float, period: float) -> tuple[bool, int]:
        """Return whether the task is due, and how many turns were missed completely since the last one.

        Args:
            now: [s]
            period: Current period [s].
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
    """Counts and timing of a run."""

    steps: int = 0
    telemetry: int = 0
    pictures: int = 0
    fixes: int = 0
    """Pictures that were used in the state."""
    decisions: int = 0
    missed: int = 0
    """Turns of the pilot without a decision because the loop was late."""
    overruns: int = 0
    """Steps that took longer than their period."""
    latencies: deque[float] = field(default_factory=lambda: deque(maxlen=REMEMBERED))
    """Times from the arrival of the newest picture in the state to the resulting command [s]."""
    events: deque[Any] = field(default_factory=lambda: deque(maxlen=200))
    """The latest events of the bridge."""
    onboard: Counter[str] = field(default_factory=Counter)
    """Readings of the vehicle's own cameras, sonars and altimeters, by name."""
    sight: deque[float] = field(default_factory=lambda: deque(maxlen=REMEMBERED))
    """Times from the exposure of the oldest picture that a decision uses to its command [s]."""
    inference: deque[float] = field(default_factory=lambda: deque(maxlen=REMEMBERED))
    """Durations of decisions, of a pilot that uses pictures [s]."""
    _newest: float = math.nan
    _pending: float = math.nan
    _exposed: float = math.nan

    def picture(self, arrival: float, used: bool) -> None:
        """Count a picture that arrived at a time [s]."""
        self.pictures += 1
        if used:
            self.fixes += 1
            self._newest = arrival

    def decided(self, exposed: float = math.nan, took: float = math.nan) -> None:
        """Note a decision on the current state.

        Args:
            exposed: Time of exposure of the oldest picture used [s]; NaN without pictures.
            took: Computation time [s].
        """
        self._pending, self._newest = self._newest, math.nan
        self._exposed = exposed
        if not math.isnan(exposed):
            self.inference.append(took)

    def sent(self, now: float) -> None:
        """Note the time at which the decision was sent [s]."""
        if not math.isnan(self._pending):
            self.latencies.append(now - self._pending)
            self._pending = math.nan
        if not math.isnan(self._exposed):
            self.sight.append(now - self._exposed)
            self._exposed = math.nan

    def summary(self) -> dict[str, Any]:
        """Return counts as plain data, with percentiles of the latency [s], None if there is none."""
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


# Received data: decoded, put on the robot's clock, and passed to perception, bridge and recorder.


USED = ("accepted", "initialized", "reacquired")


class Link(MotorDevice, Protocol):
    """Link to a motor controller or an autopilot; it encodes the bridge's commands and decodes received messages."""

    let_in: tuple[float, float] | None
    """Initial x, y of the vehicle, world frame [m]; None: not given."""
    calibrate_depth: bool
    """True if the device calibrates its barometer, at the surface, before it arms."""
    highest: float
    """Greatest z of the goal or trajectory, world frame [m], for a device that measures depth by itself."""
    notes: list[str]
    """Sentences for the user since they were last read."""

    def feed(self, now: float, data: bytes) -> list[Message]:
        """Return the messages completed by bytes that arrived at a time [s]; never raise an exception, for any
        bytes."""

    def encode(self, now: float, command: ThrusterCommand, state: str) -> list[bytes]:
        """Return the frames to send at a time [s] for the bridge's command and state."""


class Intake:
    """Input stage of one perception and one bridge. No received data raise an exception."""

    def __init__(
        self,
        perception: Perception,
        bridge: Bridge,
        counters: Counters,
        recorder: Recorder | None = None,
        link: Link | None = None,
    ) -> None:
        """Set up the input stage.

        Args:
            perception: Perception that processes sensor data.
            bridge: Bridge that monitors the messages.
            counters: Counters to update.
            recorder: Recorder of every message, if any.
            link: Link that decodes received bytes; that of the vehicle's motor controller if None.
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
        """Process received data.

        Args:
            now: Robot's clock [s].
            frames: Datagrams from the motor controller, each with its time of arrival [s].
            pictures: Pictures from the camera.
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
    """Perception, pilot and bridge of one vehicle. Clock and connections are outside: `step` receives time and data.

    No received data raise an exception: invalid data are counted. A pilot that fails stops the vehicle.
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
        """Assemble the robot.

        Args:
            vehicle: Vehicle.
            perception: Estimator of the state from pictures, telemetry and position fixes.
            pilot: Pilot that computes the thrusts.
            guide: Motion to follow; its time starts when the vehicle is armed.
            arm: Arm once, as soon as the state is ready. False: thrusters never turn.
            bridge: Bridge; the vehicle's default one if None.
            recorder: Recorder of everything, if any.
            team: Message exchange with other vehicles; None: there are none.
        """
        self.vehicle, self.pilot, self.guide = vehicle, pilot, guide
        self.perception = perception
        self.bridge = bridge or Bridge(vehicle)
        self.recorder, self.team = recorder, team
        self.team_datagrams: list[bytes] = []
        """Datagrams of the last step for the other vehicles."""
        self.counters = Counters()
        self.reading: Reading | None = None
        """Latest reading."""
        self.force = np.zeros(len(vehicle.thruster_names))
        """Last requested thrusts, as limited by the bridge [N], (n,)."""
        self.started = math.nan
        """Start of the guide's time [s]; NaN before."""
        self.refusal = ""
        """Reason why arming was last refused; empty if it was not."""
        self._arm, self._held_since = arm, math.inf
        self._ticks = Ticks()
        self.intake = Intake(self.perception, self.bridge, self.counters, recorder)
        self.attach(self.intake.link)

    def attach(self, link: Link) -> None:
        """Set the link to the device at the other end: the vehicle's motor controller by default."""
        self.link = self.intake.link = self.bridge.autopilot = link
        link.let_in = self.perception.let_in

    def step(
        self,
        now: float,
        frames: Sequence[tuple[float, bytes]],
        pictures: Sequence[Picture] = (),
        heard: Sequence[bytes] = (),
    ) -> list[bytes]:
        """Run one step of the loop.

        Args:
            now: Robot's clock [s].
            frames: Datagrams from the motor controller, each with its time of arrival [s].
            pictures: Pictures from the camera.
            heard: Datagrams from the other vehicles.

        Returns:
            Datagrams to send to the motor controller now; those for the other vehicles are in `team_datagrams`.
        """
        self.counters.steps += 1
        self.intake.take(now, frames, pictures)
        for note in self.link.notes:
            self.bridge.note(now, note)
        self.link.notes.clear()
        reading = self.perception.reading(now)
        if self.team is not None:
            self.team_datagrams = self.team.datagrams_to_send(now, reading)
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
        """Start the guide's time. `now` is the time [s]."""
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
            pilot: New pilot.
            guide: New motion to follow; its time starts when the vehicle is armed again.
            arm: Arm once, as soon as the state is ready.
            recorder: New recorder; nothing is recorded if None.
        """
        self.bridge.disarm(now)
        self._record_events()
        self.pilot, self.guide, self._arm = pilot, guide, arm
        self.started, self.refusal, self.force = math.nan, "", np.zeros_like(self.force)
        self.recorder = self.intake.recorder = recorder

    def stop(self, now: float, frames: int = 3) -> list[bytes]:
        """Disarm; return frames without thrust to send. `now` is the time [s]."""
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
        """Arm as soon as that is possible, once, and start the guide's time."""
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
        """Return which picture that the pilot needs is missing or too old; empty if none is."""
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
        """Return the time of exposure of a sensor's latest picture, robot's clock [s]."""
        return self.intake.pictures[name].time - self.vehicle.perception[name].latency

    def _decide(self, now: float, reading: Reading) -> None:
        """Let the pilot decide when it is due and has the state that it needs."""
        if math.isnan(self.started):
            return
        self._held_since = min(self._held_since, now) if self.bridge.state == "hold" else math.inf
        due, missed = self._ticks.due(now, self.pilot.period)
        self.counters.missed += missed
        if not due or self.bridge.state == "fault" or (self.pilot.needs_state and not reading.ready):
            return
        if now - self._held_since > FORGET_AFTER:
            self.pilot.reset()  # its integral would grow while the vehicle has no thrust
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
        """Return the pilot's thrusts, or one number per channel; if it fails, stop the vehicle and return None."""
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
