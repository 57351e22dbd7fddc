"""Between a controller and the motors: arming, watchdogs, limits. Nothing but an explicit `arm` starts a thruster.

    disarmed --arm--> armed <--condition passed, fresh command-- hold
        ^               |  `------transient condition------------^ |
        |          serious condition, `stop`               lasts too long
        |               v                                          v
        `--acknowledge-- fault <-----------------------------------'

Only `armed` sends enabled frames; hold, fault and disarmed send zeros with the motors disabled at every tick.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from finssim.control.motor_map import MotorMap
from finssim.robot.bridge_settings import BridgeError, BridgeSettings
from finssim.robot.events import Event, EventLog
from finssim.robot.messages import CommandEcho, Telemetry, ThrusterCommand
from finssim.robot.robot import Reading
from finssim.robot.supervision import Clock, Supervision
from finssim.vehicles import Vehicle

__all__ = ["STATES", "Bridge"]

Array = npt.NDArray[np.float64]

STATES = ("disarmed", "armed", "hold", "fault")
RUNNING = ("armed", "hold")
"""States in which the watchdogs bite."""


class Bridge:
    """State machine of one vehicle. Every method takes the robot's clock `now` [s]; it reads no clock itself."""

    def __init__(self, vehicle: Vehicle, settings: BridgeSettings | None = None) -> None:
        self.vehicle = vehicle
        self.settings = settings or BridgeSettings.of(vehicle)
        self.motors = MotorMap.from_vehicle(vehicle)
        if len(self.settings.slew) != self.motors.thrusters:
            raise BridgeError(f"slew has {len(self.settings.slew)} rates, expected {self.motors.thrusters}")
        self.state = "disarmed"
        self.reason = ""
        """Why it is in hold or fault."""
        self.log = EventLog()
        self.force: Array = np.zeros(self.motors.thrusters)
        """Thrusts of the last tick after all limits, delivered on average, canonical order [N], (n,)."""
        self._watchdogs = Supervision(vehicle, self.settings, self.motors.outputs)
        self._commander = self._watchdogs.commander
        self._clock = Clock(self.settings.clock_step)
        self._off = ThrusterCommand(False, (0.0,) * self.motors.outputs)
        self._memory = self.motors.reset()
        self._ticked: float | None = None
        self._armed_at = self._held_at = math.nan
        self._passed_at: float | None = None
        self._operator = False

    # -- what the operator says -------------------------------------------------------------------------------

    def arm(self, now: float, source: str) -> str:
        """Let commands through from now on. Returns "" or, in one sentence, why it is refused."""
        why = self._refusal(now)
        if why:
            self.log.repeat(self._clock.now, "refused", f"{source} may not arm: {why}")
            return why
        self._commander.forget()
        self._watchdogs.echo.forget()
        self._watchdogs.follow.forget()
        self._armed_at = self._clock.now
        self._enter("armed", "", f"armed by {source}")
        return ""

    def disarm(self, now: float) -> None:
        """Thrusters off; a fault stays until it is acknowledged."""
        self._at(now)
        if self.state in RUNNING:
            self._enter("disarmed", "", "disarmed")

    def stop(self, now: float, why: str) -> None:
        """Emergency stop, in every state."""
        self._at(now)
        self._fault(why or "stopped")

    def acknowledge(self, now: float) -> None:
        """End a fault; the bridge is disarmed then."""
        self._at(now)
        if self.state == "fault":
            self._enter("disarmed", "", f"acknowledged: {self.reason}")

    def hold(self, now: float) -> None:
        """Pause an armed vehicle without thrust until `resume`, for as long as the operator likes."""
        self._at(now)
        self._operator = self.state in RUNNING
        if self.state == "armed":
            self._hold("the operator holds")

    def resume(self, now: float) -> None:
        """End the operator's hold; thrust returns with the first command after it."""
        self._at(now)
        self._operator = False

    # -- what comes in ----------------------------------------------------------------------------------------

    def command(self, now: float, force: npt.ArrayLike, source: str, stamp: float | None = None) -> Array:
        """A command; one that is refused does not count as a sign of life.

        Args:
            now: When it came [s].
            force: Thrusts along the thrusters' axes, canonical order [N], (n,).
            source: Who sent it; two at a time are a fault.
            stamp: Time of what its sender knew, robot's clock [s].

        Returns:
            The thrusts within their limits and the workspace's [N], (n,); zeros where they will not be used.
        """
        unused = np.zeros_like(self.force)
        if not self._at(now):
            return unused
        rival = self._commander.rival(now, source)
        if rival and self.state in RUNNING:
            self._fault(f"two publishers command the thrusters: {rival} and {source}")
        why = self._commander.accept(now, force, source, stamp)
        if why:
            self.log.repeat(now, "command refused", f"{source}: {why}")
        return self._limited(now) if self.state == "armed" and not why else unused

    def telemetry(self, now: float, telemetry: Telemetry) -> None:
        """A message from the motor controller."""
        if not self._at(now):
            return
        why = self._watchdogs.telemetry.malformed(telemetry)
        if why:
            self.log.repeat(now, "telemetry refused", why)
        elif self._watchdogs.take_telemetry(now, telemetry, self.state == "armed"):
            self._alarm("restart", "the motor controller restarted: its clock went back")

    def echo(self, now: float, echo: CommandEcho) -> None:
        """What the motor controller made of a command."""
        if not self._at(now):
            return
        news = self._watchdogs.echo.accept(now, echo, self.state == "armed")
        if news == "restarted":
            self._alarm("restart", "the motor controller restarted: its count of commands began again")
        elif news == "rejected":
            flags = f"flags {echo.reject_flags:#x}"
            self.log.repeat(now, "command rejected", f"the motor controller refused a command: {flags}")

    def reading(self, now: float, reading: Reading) -> None:
        """What the estimator knows."""
        if self._at(now):
            self._watchdogs.take_reading(now, reading)

    # -- what goes out ----------------------------------------------------------------------------------------

    def tick(self, now: float) -> ThrusterCommand:
        """The frame to send now; call it at every turn of the loop, in every state."""
        dt = self._period(now)
        if self.state in RUNNING:
            self._watch(self._clock.now)
        if self.state != "armed":
            return self._off
        step = self.settings.slew * dt
        change = np.minimum(np.maximum(self._limited(now) - self.force, -step), step)
        told, self.force, self._memory = self.motors.normalised(self.force + change, self._memory, dt)
        return ThrusterCommand(True, tuple(told.tolist()))

    @property
    def source(self) -> str:
        """Who sent the newest command."""
        return self._commander.source

    @property
    def requested(self) -> Array:
        """The newest command before all limits, canonical order [N], (n,)."""
        return self._commander.force

    @property
    def events(self) -> list[Event]:
        """Events that nobody has drained yet."""
        return list(self.log.events)

    def drain(self) -> list[Event]:
        """Events since the last call."""
        return self.log.drain()

    # -- inside -----------------------------------------------------------------------------------------------

    def _limited(self, now: float) -> Array:
        """The newest command within the limits of the thrusters and of the workspace [N], (n,)."""
        return self._watchdogs.limited(now, self.motors.limited(self._commander.force))

    def _refusal(self, now: float) -> str:
        """Why arming is refused; "" if nothing stands against it."""
        if not self._at(now):
            return "the clock is not a number"
        if self.state == "fault":
            return f"acknowledge the fault first: {self.reason}"
        return (
            self._watchdogs.unfit(now) if self.state == "disarmed" else f"it is in state {self.state} already"
        )

    def _watch(self, now: float) -> None:
        """Let the watchdogs look: fault, hold, or on with it."""
        danger = self._watchdogs.danger(now)
        if danger:
            return self._fault(danger)
        want = "the operator holds" if self._operator else self._watchdogs.want(now, self._armed_at)
        if want and self.state == "armed":
            self._hold(want)
        if self.state == "hold":
            self._wait(now, want)

    def _wait(self, now: float, want: str) -> None:
        """In hold: go on with the first command after the condition passed, or give up after the limit."""
        if want:
            self.reason, self._passed_at = want, None
        elif self._passed_at is None:
            self._passed_at = now
        elif self._commander.received > self._passed_at:
            return self._enter("armed", "", f"resumed after: {self.reason}")
        if self._operator:
            self._held_at = now
        elif now - self._held_at > self.settings.hold_limit:
            self._fault(f"held longer than {self.settings.hold_limit:g} s: {self.reason}")

    def _hold(self, why: str) -> None:
        self._held_at = self._clock.now
        self._enter("hold", why, why)

    def _period(self, now: float) -> float:
        """Time since the last tick [s], 0 at the first."""
        if not self._at(now):
            return 0.0
        before, self._ticked = self._ticked, self._clock.now
        step = 0.0 if before is None else max(self._ticked - before, 0.0)
        if step > self.settings.clock_step:
            self._alarm("clock", f"the loop stood still for {step:.1f} s")
        return step

    def _at(self, now: float) -> bool:
        """Watches the clock; False where `now` is no time at all."""
        wrong = self._clock.wrong(now)
        if wrong and math.isfinite(now):
            # Nothing that was heard before a jump has an age any more.
            self._watchdogs.forget()
            self._ticked = None
        if wrong:
            self._alarm("clock", wrong)
        return math.isfinite(now)

    def _alarm(self, kind: str, text: str) -> None:
        """A fault where thrusters could turn, otherwise only an event."""
        if self.state in RUNNING:
            self._fault(text)
        else:
            self.log.repeat(self._clock.now, kind, text)

    def _fault(self, why: str) -> None:
        """Stop; the first reason stands until it is acknowledged."""
        if self.state == "fault":
            self.log.repeat(self._clock.now, "also", why)
        else:
            self._enter("fault", why, why)

    def _enter(self, state: str, reason: str, text: str) -> None:
        """Changes state; no thrust is carried over."""
        self.state, self.reason, self._passed_at = state, reason, None
        self._operator = self._operator and state == "hold"
        self.force, self._memory = np.zeros_like(self.force), self.motors.reset()
        self.log.add(self._clock.now, state, text)
