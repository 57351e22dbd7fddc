"""What watches the messages of a robot: each watchdog takes a message with its time and answers in one sentence."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from finssim.robot.link.frames import StatusFlag
from finssim.robot.messages import CommandEcho, Telemetry
from finssim.robot.robot import Reading

__all__ = ["EchoWatch", "FollowWatch", "StateWatch", "TelemetryWatch", "TiltWatch"]

Array = npt.NDArray[np.float64]

TOLD, FOLLOWS = int(StatusFlag.DIAGNOSTICS), int(StatusFlag.DIRECT_THRUSTERS)
REORDERED = 1000
"""A datagram may be overtaken by this much of the controller's clock [ms]; further back is a restart."""


class TelemetryWatch:
    """Silence, repetition and restarts of the motor controller."""

    def __init__(self, outputs: int, timeout: float) -> None:
        self._outputs = outputs
        self._timeout = timeout
        self.forget()

    def forget(self) -> None:
        """As before the first message."""
        self.fresh_since = -math.inf
        self._last: Telemetry | None = None
        self._changed = {"gyro": math.inf, "accel": math.inf}

    def age(self, now: float) -> float:
        """Time since the last message that brought something new [s]; infinite before the first."""
        return now - self.fresh_since

    def malformed(self, message: Telemetry) -> str:
        """Why a message cannot be used; "" if it can."""
        numbers = (*message.quaternion, *message.gyro, *message.accel, message.depth, message.pressure)
        if not all(map(math.isfinite, (*numbers, *(message.motor_rpm or ())))):
            return "a number in the telemetry is not finite"
        if not 0.9 < math.hypot(*message.quaternion) < 1.1:
            return "the attitude in the telemetry is not a unit quaternion"
        if message.motor_rpm is not None and len(message.motor_rpm) != self._outputs:
            return f"the telemetry has {len(message.motor_rpm)} motor speeds, expected {self._outputs}"
        return ""

    def accept(self, now: float, message: Telemetry) -> str:
        """Takes a well-formed message; a repeated or overtaken one refreshes nothing.

        Returns:
            "restarted" if the controller's clock went back, "old" if the message brings nothing new, "" otherwise.
        """
        last = self._last
        if last is not None and (message.sequence, message.mcu_ms) == (last.sequence, last.mcu_ms):
            return "old"
        # After a silence the old numbers say nothing about the new ones.
        if last is None or self.age(now) > self._timeout:
            restarted = last is not None and _signed(message.mcu_ms - last.mcu_ms, 32) < -REORDERED
            self._take(now, message, None)
            return "restarted" if restarted else ""
        elapsed = _signed(message.mcu_ms - last.mcu_ms, 32)
        if elapsed < -REORDERED:
            self._take(now, message, None)
            return "restarted"
        if elapsed < 0 or _signed(message.sequence - last.sequence, 16) <= 0:
            return "old"
        self._take(now, message, last)
        return ""

    def frozen(self, now: float, limit: float) -> str:
        """Which sensor has repeated its numbers to the last bit for longer than `limit` [s]; "" if none has."""
        for sensor, changed in self._changed.items():
            # Silence is another watchdog's: what counts is how long messages kept coming with the same numbers.
            if min(now, self.fresh_since) - changed > limit:
                return sensor
        return ""

    def _take(self, now: float, message: Telemetry, last: Telemetry | None) -> None:
        self.fresh_since = now
        self._last = message
        for sensor in self._changed:
            if last is None or getattr(message, sensor) != getattr(last, sensor):
                self._changed[sensor] = now


class EchoWatch:
    """What the motor controller made of the commands."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """As before the first echo."""
        self._count: int | None = None
        self._mcu_ms = 0
        self.rejected_since = math.inf
        self.rejected_until = -math.inf

    def accept(self, now: float, echo: CommandEcho, armed: bool) -> str:
        """Takes an echo; "restarted" if its count of commands began again, "rejected" if it refused one, else ""."""
        elapsed = _signed(echo.mcu_ms - self._mcu_ms, 32)
        restarted = False
        if self._count is not None:
            if -REORDERED <= elapsed < 0:
                return ""  # overtaken by a newer one
            restarted = elapsed < 0 or _signed(echo.command_count - self._count, 32) < 0
        self._count, self._mcu_ms = echo.command_count, echo.mcu_ms
        if restarted:
            return "restarted"
        if not armed or echo.accepted:
            self.rejected_since = math.inf
            return ""
        self.rejected_since = min(self.rejected_since, now)
        self.rejected_until = now
        return "rejected"

    def rejecting(self, limit: float) -> bool:
        """Whether every command was refused for longer than `limit` [s]."""
        return self.rejected_until - self.rejected_since > limit


class FollowWatch:
    """Whether the motors follow the commands, as the status bits of the telemetry tell: frames may be lost unseen."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """As if they did."""
        self._since, self._until = math.inf, -math.inf

    def accept(self, now: float, flags: int, armed: bool) -> None:
        """Takes status bits, and whether commands were enabled; those of a firmware that sets none say nothing."""
        if not armed or flags & FOLLOWS or not flags & TOLD:
            return self.forget()
        self._since, self._until = min(self._since, now), now

    def deaf(self, limit: float) -> bool:
        """Whether they have not followed for longer than `limit` [s]."""
        return self._until - self._since > limit


class TiltWatch:
    """How long a vehicle has been tilted beyond a limit."""

    def __init__(self, limit: float, duration: float, level: npt.ArrayLike = (0.0, 0.0, 1.0)) -> None:
        """
        Args:
            limit: [rad]
            duration: Longest time beyond it [s].
            level: The body's z axis in the frame whose attitude is given, (3,).
        """
        self._cosine = math.cos(min(limit, math.pi)) if math.isfinite(limit) else -math.inf
        self._duration = duration
        self._level = tuple(float(part) for part in np.asarray(level, float))
        self._since = math.inf

    def forget(self) -> None:
        """As if the vehicle had been level."""
        self._since = math.inf

    def accept(self, now: float, quaternion: npt.ArrayLike) -> None:
        """Takes an attitude, given frame to world, xyzw, of any length, (4,)."""
        x, y, z, w = (float(part) for part in np.asarray(quaternion, float))
        a, b, c = self._level
        square = x * x + y * y + z * z + w * w
        up = 2.0 * (x * z - w * y) * a + 2.0 * (y * z + w * x) * b + (square - 2.0 * (x * x + y * y)) * c
        self._since = min(self._since, now) if up < self._cosine * square else math.inf

    def over(self, now: float) -> bool:
        """Whether it lasted too long."""
        return now - self._since > self._duration


class StateWatch:
    """Whether what the estimator says may be acted on."""

    def __init__(self, timeout: float, modes: tuple[str, ...]) -> None:
        """
        Args:
            timeout: Oldest reading to act on [s].
            modes: Modes of vision in which one may be acted on.
        """
        self._timeout = timeout
        self._modes = modes
        self.forget()

    def forget(self) -> None:
        """As before the first reading."""
        self._oldest = -math.inf
        self._why = "the estimator has said nothing yet"
        self._pose: tuple[Array, Array] | None = None

    def accept(self, now: float, reading: Reading) -> None:
        """Takes a reading."""
        self._oldest = min(now, reading.time)
        self._why = self._unfit(reading)
        self._pose = None if self._why else (np.asarray(reading.position), np.asarray(reading.quaternion))

    def pose(self, now: float) -> tuple[Array, Array] | None:
        """World position [m], (3,), and quaternion, (4,), of the newest reading; None where it may not be acted on."""
        return None if self.missing(now) else self._pose

    def missing(self, now: float) -> str:
        """Why there is none to act on; "" if there is."""
        if self._why:
            return self._why
        return (
            f"the newest reading is older than {self._timeout:g} s"
            if now - self._oldest > self._timeout
            else ""
        )

    def _unfit(self, reading: Reading) -> str:
        """Why a reading cannot be acted on; "" if it can."""
        if not reading.ready:
            return f"the estimator is not ready: {reading.reason or 'no reason given'}"
        if reading.mode not in self._modes:
            return f"vision is {reading.mode}"
        shapes = np.shape(reading.position), np.shape(reading.quaternion), np.shape(reading.nu)
        if shapes != ((3,), (4,), (6,)):
            return f"the reading has shapes {shapes}, expected position (3,), quaternion (4,) and nu (6,)"
        numbers = (reading.time, *reading.position, *reading.quaternion, *reading.nu)
        if not all(map(math.isfinite, numbers)):
            return "a number in the reading is not finite"
        return "" if 0.9 < math.hypot(*reading.quaternion) < 1.1 else "its attitude is not a unit quaternion"


def _signed(difference: int, bits: int) -> int:
    """A difference of two counters modulo 2^bits, as the nearest signed number."""
    half = 1 << (bits - 1)
    return (difference + half) % (1 << bits) - half
