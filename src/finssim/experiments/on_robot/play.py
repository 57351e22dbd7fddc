"""One trial of a robot: waited for, brought to its start, played and recorded; a virtual pool begins at the start."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from finssim.control.guidance import Guide, Station
from finssim.geometry.rotations import quat_yaw, wrap_angle
from finssim.localization.pool import Pool
from finssim.robot.perception import Perception
from finssim.robot.pilots import Pilot, WrenchPilot, make_pilot
from finssim.robot.recorder import Recorder
from finssim.robot.robot import Reading
from finssim.robot.runtime import Runtime
from finssim.robot.wiring import Drive
from finssim.vehicles import Vehicle

__all__ = ["Attendant", "Ended", "Outcome", "Placing", "RobotTrial", "play"]

GETTING_READY = 10.0
"""Longest time until the estimator knows where the vehicle is, and it is armed [s]."""
NEAR, TURNED = 0.10, math.radians(10.0)
"""A vehicle is at its start within this of it [m, rad] ..."""
SLOW, TURNING = 0.05, math.radians(5.0)
"""... and no faster than this [m/s, rad/s] ..."""
SETTLED = 2.0
"""... for so long [s]."""
ROUGHLY, ROUGHLY_TURNED, ROUGHLY_SLOW = 0.15, math.radians(20.0), 0.1
"""The same where the start need not be exact [m, rad, m/s] ..."""
PATIENCE = 10.0
"""... after so long [s]: a PID tuned from guesses may circle its goal for ever."""
APPROACH = 60.0
"""Longest way to a start [s]."""

Ended = Literal["over", "fault", "skipped", "interrupted", "not there"]
"""How a trial ended: by itself, by the bridge, at the operator's wish, by Ctrl-C, or the start was never reached."""


class Attendant(Protocol):
    """The person beside the water."""

    def keys(self) -> Sequence[str]:
        """Pressed since the last call: enter goes on, x or space stops the thrusters, s skips, q ends; never waits."""

    def line(self, text: str) -> None:
        """How it stands now; called at every step."""


@dataclass(frozen=True, kw_only=True)
class RobotTrial:
    """What is played. A new one for every attempt, since pilots remember."""

    name: str
    pilot: Pilot
    guide: Guide
    duration: float
    """Longest, from arming [s]."""
    over: Callable[[Runtime], bool]
    """Whether it has come to its end."""
    watch: Callable[[Runtime], None] = lambda runtime: None
    """Looks on after every step of the trial itself."""


@dataclass(frozen=True, kw_only=True)
class Placing:
    """How a vehicle gets to where a trial begins."""

    start: Station
    by_hand: bool = False
    """Somebody carries it there, and presses enter. False: the tuned PID steers it there."""
    exact: bool = True
    """Whether the trial is worth nothing from elsewhere; an excitation is."""
    attendant: Attendant | None = None
    """Nobody is asked if None: the way to the start begins as soon as the state is known."""


@dataclass(frozen=True)
class Outcome:
    """How a trial went."""

    runtime: Runtime
    ended: Ended
    fault: str
    """Why it ended before its time, or never began; empty if it did neither."""
    begun: bool
    """Whether the trial itself was begun, not only the way to its start."""


def play(
    trial: RobotTrial,
    drive: Drive,
    vehicle: Vehicle,
    site: Pool,
    *,
    perception: Perception | None = None,
    recorder: Recorder | None = None,
    placing: Placing | None = None,
) -> Outcome:
    """Play a trial.

    Args:
        trial: What to do.
        drive: Runs the robot's software on its wires, or in lock-step with a world.
        vehicle: As the robot knows it.
        site: Camera, water and frames, as calibrated.
        perception: Otherwise than by default.
        recorder: Takes down the trial itself, not the way to its start.
        placing: How the vehicle gets to the start; None: it is there already, at rest, as in a pool that begins.
    """
    stages = _Stages(trial, vehicle, recorder, placing)
    if placing is None:
        runtime = Runtime(
            vehicle, site, trial.pilot, trial.guide, arm=True, perception=perception, recorder=recorder
        )
        longest = GETTING_READY + trial.duration
    else:
        idle = WrenchPilot(lambda: np.zeros(6), vehicle, name="idle")
        runtime = Runtime(vehicle, site, idle, placing.start, arm=False, perception=perception)
        longest = math.inf
    drive(runtime, duration=longest, show=stages.look, until=stages.over)
    ended: Ended = stages.ended or ("interrupted" if math.isinf(longest) else "over")
    return Outcome(runtime, ended, stages.fault(runtime), stages.begun)


class _Stages:
    """Waits for the vehicle and its attendant, sees it to the start, hands over to the trial, and ends it."""

    def __init__(
        self, trial: RobotTrial, vehicle: Vehicle, recorder: Recorder | None, placing: Placing | None
    ) -> None:
        self._trial, self._vehicle, self._recorder, self._placing = trial, vehicle, recorder, placing
        self._stage: Callable[[Runtime, float], bool] = self._play if placing is None else self._wait
        self._since = math.nan
        """When the stage began [s]."""
        self._there_since = math.nan
        self.ended: Ended | None = None
        self.begun = placing is None
        self._reason = ""

    def look(self, runtime: Runtime) -> None:
        """After every step."""
        if self.begun:
            self._trial.watch(runtime)

    def over(self, runtime: Runtime) -> bool:
        """Whether to end; goes from stage to stage."""
        assert runtime.reading is not None  # a step has been made
        now = runtime.reading.time
        self._since = now if math.isnan(self._since) else self._since
        if runtime.bridge.state == "fault":
            return self._end("fault")
        return self._stage(runtime, now)

    def fault(self, runtime: Runtime) -> str:
        """Why the trial ended before its time, or never began; empty if it did neither."""
        if runtime.bridge.state == "fault":
            return runtime.bridge.reason
        if self._reason:
            return self._reason
        if self.begun and math.isnan(runtime.started):
            return f"never armed: {runtime.refusal or 'no state'}"
        return "" if self.ended == "over" else "not finished"

    def _end(self, how: Ended, reason: str = "") -> bool:
        self.ended, self._reason = how, reason
        return True

    def _keys(self) -> Sequence[str]:
        attendant = self._placing and self._placing.attendant
        return attendant.keys() if attendant else ()

    def _line(self, text: str) -> None:
        if self._placing is not None and self._placing.attendant is not None:
            self._placing.attendant.line(text)

    def _wait(self, runtime: Runtime, now: float) -> bool:
        """Thrusters cannot turn: until the state is known and the attendant says go."""
        assert self._placing is not None and runtime.reading is not None
        keys, reading = self._keys(), runtime.reading
        if now == self._since:
            return False  # what was pressed before anybody was asked means nothing
        if "s" in keys:
            return self._end("skipped", "skipped by the operator")
        if "q" in keys:
            return self._end("interrupted")
        if not reading.ready:
            self._line(f"waiting for the vehicle: {reading.reason}")
            return False
        there = self._there(reading, now)
        if self._placing.by_hand and not there:
            self._line(f"bring it to its start: {self._way(reading)}")
            return False
        if self._placing.attendant is not None and not {"\r", "\n"} & set(keys):
            word = "play" if self._placing.by_hand else "let it go to its start and play"
            self._line(f"enter: {word}; s: skip; q: end; {self._way(reading)}")
            return False
        if self._placing.by_hand:
            self._begin(runtime, now)
        else:
            pilot = make_pilot("pid", self._vehicle)
            runtime.hand_over(now, pilot, self._placing.start, arm=True)
            self._stage, self._since, self._there_since = self._approach, now, math.nan
        return False

    def _approach(self, runtime: Runtime, now: float) -> bool:
        """The PID steers to the start."""
        assert runtime.reading is not None
        if {"x", " "} & set(self._keys()):
            runtime.bridge.stop(now, "stopped by the operator")
            return self._end("fault")
        reading = runtime.reading
        self._line(f"on the way to its start: {self._way(reading)}; x: stop")
        if self._there(reading, now):
            self._begin(runtime, now)
        elif now - self._since > APPROACH:
            why = runtime.refusal or self._way(reading)
            return self._end("not there", f"not at its start after {APPROACH:g} s: {why}")
        return False

    def _begin(self, runtime: Runtime, now: float) -> None:
        """Hand over to the trial: disarmed, and armed again for its pilot."""
        runtime.hand_over(now, self._trial.pilot, self._trial.guide, arm=True, recorder=self._recorder)
        self._stage, self._since, self.begun = self._play, now, True

    def _play(self, runtime: Runtime, now: float) -> bool:
        if {"x", " "} & set(self._keys()):
            runtime.bridge.stop(now, "stopped by the operator")
            return self._end("fault")
        if self._trial.over(runtime):
            return self._end("over")
        if self._placing is None:
            return False  # the drive ends it
        t = 0.0 if math.isnan(runtime.t) else runtime.t
        self._line(f"{t:.0f} s of {self._trial.duration:.0f} s; x: stop")
        late = math.isnan(runtime.started) and now - self._since > GETTING_READY
        return (late or t > self._trial.duration + GETTING_READY) and self._end("not there")

    def _there(self, reading: Reading, now: float) -> bool:
        """Whether the vehicle has been at its start, at rest, for long enough."""
        assert self._placing is not None
        start = self._placing.start
        off = np.abs(reading.position - start.position).max(), abs(self._turn(reading))
        fast = np.linalg.norm(reading.nu[:3]), np.linalg.norm(reading.nu[3:])
        near = (
            reading.ready and off[0] <= NEAR and off[1] <= TURNED and fast[0] <= SLOW and fast[1] <= TURNING
        )
        if not near:
            self._there_since = math.nan
        elif math.isnan(self._there_since):
            self._there_since = now
        return bool(now - self._there_since >= SETTLED)

    def _turn(self, reading: Reading) -> float:
        assert self._placing is not None
        return float(wrap_angle(self._placing.start.yaw - quat_yaw(reading.quaternion)))

    def _way(self, reading: Reading) -> str:
        """What is left of the way."""
        assert self._placing is not None
        x, y, z = self._placing.start.position - reading.position
        return f"({x:+.2f}, {y:+.2f}, {z:+.2f}) m and {math.degrees(self._turn(reading)):+.0f}° to go"
