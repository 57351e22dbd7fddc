"""The bridge between a controller and the motors: arming, watchdogs, limits. Only an explicit `arm` starts a thruster.

    disarmed --arm--> armed <--condition passed, fresh command-- hold
        ^               |  `------transient condition------------^ |
        |          serious condition, `stop`               lasts too long
        |               v                                          v
        `--acknowledge-- fault <-----------------------------------'

Only `armed` sends enabled frames; hold, fault and disarmed send zeros with the motors disabled at every tick.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from finssim.control.allocation import Allocator
from finssim.control.motor_map import MotorMap
from finssim.core.rotations import quat_inverse_rotate, quat_to_matrix
from finssim.robot.links.frames import StatusFlag
from finssim.robot.messages import CommandEcho, Telemetry, ThrusterCommand
from finssim.robot.reading import Reading
from finssim.vehicles import Vehicle

# Events of a bridge for its operator and its record, in order; repeated ones are noted at most once a second.


KEPT = 1000
"""Greatest number of events that are stored until they are read."""
REPEAT = 1.0
"""Least time between two events of one kind and source [s]."""


class Event(NamedTuple):
    """An event of the bridge."""

    time: float
    """Robot's clock [s]."""
    kind: str
    """One or two words: state, fault, hold, command, telemetry, echo, clock, refused."""
    text: str
    """One sentence."""


class EventLog:
    """The newest events, and their number by kind."""

    def __init__(self) -> None:
        self.events: deque[Event] = deque(maxlen=KEPT)
        self.counts: Counter[str] = Counter()
        self._last: dict[str, float] = {}

    def add(self, time: float, kind: str, text: str) -> None:
        """Add an event unconditionally.

        Args:
            time: Robot's clock [s].
            kind: One or two words.
            text: One sentence.
        """
        self.counts[kind] += 1
        self.events.append(Event(time, kind, text))

    def repeat(self, time: float, kind: str, text: str) -> None:
        """Count an event that may recur with every message, and add it unless one of its kind was added recently.

        Args:
            time: Robot's clock [s].
            kind: One or two words.
            text: One sentence.
        """
        last = self._last.get(kind)
        if last is not None and 0.0 <= time - last < REPEAT:
            self.counts[kind] += 1
            return
        self._last[kind] = time
        self.add(time, kind, text)

    def drain(self) -> list[Event]:
        """Return all events since the last call, oldest first."""
        drained = list(self.events)
        self.events.clear()
        return drained


# Limits of a bridge: from the safety section of a vehicle file, with individual changes.


Array = npt.NDArray[np.float64]

FULL_RANGE = 0.1
"""Time from full reverse to full forward if the vehicle file gives no slew limit of the thrust [s]."""


class BridgeError(ValueError):
    """The limits of a bridge are invalid; the message states which and what to give."""


@dataclass(frozen=True, kw_only=True)
class BridgeSettings:
    """Limits that stop the thrusters. Create them with `of`; `math.inf` disables a watchdog."""

    slew: Array
    """Fastest change of each thrust, canonical order [N/s], (n,)."""
    command_timeout: float = 0.5
    """Longest silence of the commander [s]."""
    telemetry_timeout: float = 0.5
    """Longest silence of the motor controller [s]."""
    state_timeout: float = 0.5
    """Greatest age of a reading that may be used [s]."""
    frozen_limit: float = 0.3
    """Longest time for which gyroscope or accelerometer may repeat exactly the same numbers [s]."""
    max_tilt: float = math.inf
    """Greatest tilt [rad]."""
    max_tilt_duration: float = 1.0
    """Longest time above `max_tilt` [s]."""
    workspace_lower: Array
    """Lower corner of the workspace, world frame [m], (3,)."""
    workspace_upper: Array
    """Upper corner of the workspace [m], (3,)."""
    workspace_margin: float = 0.1
    """Distance from a face, on either side, within which thrust may only push inwards; further outside is a fault
    [m]."""
    hold_limit: float = 5.0
    """Longest hold before it becomes a fault, except for a hold by the operator [s]."""
    clock_step: float = 1.0
    """Longest forward step of the clock between two calls [s]."""
    reject_limit: float = 0.5
    """Longest time for which the motor controller may refuse or miss every command [s]."""
    need_reading: bool = True
    """True if the estimator must be ready; False allows driving without localization."""
    vision_modes: tuple[str, ...] = ("fresh", "coast")
    """States of vision in which a reading may be used."""

    def __post_init__(self) -> None:
        for name in DURATIONS:
            if not getattr(self, name) > 0.0:
                raise BridgeError(f"{name} is {getattr(self, name)}, expected a number above 0")
        if not self.workspace_margin >= 0.0:
            raise BridgeError(f"workspace_margin is {self.workspace_margin}, expected 0 m or more")
        if np.shape(self.workspace_lower) != (3,) or np.shape(self.workspace_upper) != (3,):
            raise BridgeError("workspace_lower and workspace_upper must be points of three numbers [m]")
        if not np.less(self.workspace_lower, self.workspace_upper).all():
            raise BridgeError("workspace_lower must be below workspace_upper on every axis")
        if np.ndim(self.slew) != 1 or not np.greater(self.slew, 0.0).all():
            raise BridgeError("slew must be one rate above 0 N/s per thruster")

    @classmethod
    def of(cls, vehicle: Vehicle, **changes: Any) -> BridgeSettings:
        """Return the limits of a vehicle's `safety` section.

        Args:
            vehicle: Vehicle with the `safety` section and the slew limits of its thrusters.
            changes: Changed fields by name.

        Raises:
            BridgeError: A limit is invalid, or there is no field with that name.
        """
        names = {field.name for field in fields(cls)}
        if not changes.keys() <= names:
            unknown = sorted(changes.keys() - names)
            raise BridgeError(
                f"no bridge setting {', '.join(unknown)}; available: {', '.join(sorted(names))}"
            )
        limits: dict[str, Any] = {"slew": _slew(vehicle)}
        limits.update({name: getattr(vehicle.safety, name) for name in FROM_FILE})
        return replace(cls(**limits), **changes) if changes else cls(**limits)


FROM_FILE = (
    "command_timeout",
    "telemetry_timeout",
    "state_timeout",
    "max_tilt",
    "max_tilt_duration",
    "workspace_lower",
    "workspace_upper",
)
"""Fields with the same name in the safety section of a vehicle file."""
DURATIONS = (
    "command_timeout",
    "telemetry_timeout",
    "state_timeout",
    "frozen_limit",
    "max_tilt",
    "hold_limit",
    "clock_step",
    "reject_limit",
)


def _slew(vehicle: Vehicle) -> Array:
    """Return the slew limit of each thrust [N/s], (n,): the file's own if it limits thrust, otherwise range over
    time."""
    lower, upper = vehicle.force_limits
    stated = np.array([t.slew if t.domain == "force" else math.inf for t in vehicle.thrusters.values()])
    return np.where(np.isfinite(stated), stated, (upper - lower) / FULL_RANGE)


# Sources of commands, and the newest accepted command.


EARLY = 0.1
"""Greatest lead of a stamp over the robot's clock [s]."""


class Commander:
    """Receiver of commands; a refused command does not reset the command timeout."""

    def __init__(self, thrusters: int, timeout: float, others: int = 0) -> None:
        """Start without a command.

        Args:
            thrusters: Number of thrusts in a command, n.
            others: Number of values of other actuators that may follow them, m.
            timeout: Age at which a command, or a message of another source, expires [s].
        """
        self._thrusters, self._others = thrusters, others
        self._timeout = timeout
        self.forget()

    def forget(self) -> None:
        """Reset to the state before the first command."""
        self.force: Array = np.zeros(self._thrusters)
        """Thrusts of the newest command, canonical order [N], (n,)."""
        self.setpoints: Array | None = None
        """Values of the other actuators in the newest command that has them [rad, m³ or m], (m,)."""
        self.received = -math.inf
        """Arrival of the newest command [s]."""
        self.source = ""
        self._stamp = -math.inf
        self._heard: dict[str, float] = {}

    def rival(self, now: float, source: str) -> str:
        """Return another source that sent a command within the timeout; "" if there is none.

        `now` is the time [s].
        """
        self._heard[source] = now
        self._heard = {name: time for name, time in self._heard.items() if now - time <= self._timeout}
        return next((name for name in self._heard if name != source), "")

    def sources(self, now: float) -> list[str]:
        """Return all sources of commands within the timeout. `now` is the time [s]."""
        return [name for name, time in self._heard.items() if now - time <= self._timeout]

    def accept(self, now: float, force: npt.ArrayLike, source: str, stamp: float | None) -> str:
        """Accept a valid command; otherwise return the reason and keep the previous command.

        Args:
            now: Arrival of the command [s].
            force: Thrusts along the thrusters' axes, canonical order [N], (n,), or these and the values of the other
                actuators [rad, m³ or m], (n + m,).
            source: Sender of the command.
            stamp: Time of the state on which the command is based, robot's clock [s]; None if unknown.
        """
        try:
            requested = np.array(force, float)
        except (TypeError, ValueError):
            return "command is no list of numbers"
        n, m = self._thrusters, self._others
        if requested.shape not in ((n,), (n + m,)):
            channels = f", or {n + m} numbers with the other actuators" if m else ""
            return f"command has shape {requested.shape}, expected {n} thrusts{channels}"
        if not np.isfinite(requested).all():
            return "command is not finite"
        if stamp is not None:
            if not -EARLY <= now - stamp <= self._timeout:
                return f"command is stamped {stamp:.3f} s, received at {now:.3f} s"
            if source == self.source and stamp < self._stamp:
                return "command is older than the one before"
        self.force, self.source, self.received = requested[:n], source, now
        if m and requested.size > n:
            self.setpoints = requested[n:]
        self._stamp = -math.inf if stamp is None else stamp
        return ""

    def asks(self, now: float) -> bool:
        """Return whether the newest command has not expired and demands thrust. `now` is the time [s]."""
        return now - self.received <= self._timeout and bool(self.force.any())


# Watchdogs of a robot's messages: each one receives a message with its time and answers in one sentence.


TOLD, FOLLOWS = int(StatusFlag.DIAGNOSTICS), int(StatusFlag.DIRECT_THRUSTERS)
SENSED = ("quaternion", "gyro", "accel")
"""Sensors of telemetry whose repetition is monitored."""
REORDERED = 1000
"""Greatest backward step of the controller's clock of an overtaken datagram [ms]; a larger one is a restart."""


class TelemetryWatch:
    """Watchdog of telemetry: silence, repetition and restarts; `timeout` is in [s]."""

    def __init__(self, outputs: int, timeout: float, others: int = 0) -> None:
        self._outputs, self._others = outputs, others
        self._timeout = timeout
        self.watched: tuple[tuple[str, ...], ...] = (("gyro",), ("accel",))
        """Groups of sensors: a group is frozen if all of its sensors repeat their numbers."""
        self.forget()

    def forget(self) -> None:
        """Reset to the state before the first message."""
        self.fresh_since = -math.inf
        self._last: Telemetry | None = None
        self._changed = dict.fromkeys(SENSED, math.inf)

    @property
    def values(self) -> tuple[float, ...]:
        """Values of the other actuators in the newest message [rad, m³ or m]; empty if it has none."""
        return () if self._last is None else self._last.actuators

    @property
    def lacks_actuators(self) -> bool:
        """Return whether the newest message lacks the vehicle's actuators besides thrusters."""
        return self._last is not None and len(self.values) < self._others

    def age(self, now: float) -> float:
        """Return the time since the last message with new data [s]; infinite before the first."""
        return now - self.fresh_since

    def malformed(self, message: Telemetry) -> str:
        """Return why a message cannot be used; "" if it can."""
        numbers = (*message.quaternion, *message.gyro, *message.accel, message.depth, message.pressure)
        if not all(map(math.isfinite, (*numbers, *(message.motor_rpm or ()), *message.actuators))):
            return "a number in the telemetry is not finite"
        if not 0.9 < math.hypot(*message.quaternion) < 1.1:
            return "the attitude in the telemetry is not a unit quaternion"
        if message.motor_rpm is not None and len(message.motor_rpm) != self._outputs:
            return f"the telemetry has {len(message.motor_rpm)} motor speeds, expected {self._outputs}"
        return ""

    def accept(self, now: float, message: Telemetry) -> str:
        """Accept a well-formed message; a repeated or overtaken one does not count as new data.

        `now` is the time [s].

        Returns:
            "restarted" if the controller's clock went back, "old" if the message has no new data, "" otherwise.
        """
        last = self._last
        if last is not None and (message.sequence, message.mcu_ms) == (last.sequence, last.mcu_ms):
            return "old"
        # After a silence the old numbers do not constrain the new ones.
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
        """Return the sensors that have repeated their exact numbers for longer than `limit` [s]; "" if none have."""
        for sensors in self.watched:
            changed = max(self._changed[sensor] for sensor in sensors)
            # Silence has another watchdog: only the time counts for which messages arrived with the same numbers.
            if min(now, self.fresh_since) - changed > limit:
                return " and ".join(sensors)
        return ""

    def _take(self, now: float, message: Telemetry, last: Telemetry | None) -> None:
        self.fresh_since = now
        self._last = message
        for sensor in self._changed:
            if last is None or getattr(message, sensor) != getattr(last, sensor):
                self._changed[sensor] = now


class Lasting:
    """Duration for which a condition was true at every check."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Reset to the state before the condition was ever true."""
        self._since, self._until = math.inf, -math.inf

    def look(self, now: float, so: bool) -> None:
        """Note whether the condition is true now [s]."""
        if so:
            self._since, self._until = min(self._since, now), now
        else:
            self.forget()

    def longer(self, limit: float, now: float | None = None) -> bool:
        """Return whether it was true for longer than `limit` [s], until `now`, or until the last check if None."""
        return (self._until if now is None else now) - self._since > limit


class EchoWatch:
    """Watchdog of the motor controller's command echoes."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Reset to the state before the first echo."""
        self._count: int | None = None
        self._mcu_ms = 0
        self.rejected = Lasting()
        """Duration for which commands are refused."""

    def accept(self, now: float, echo: CommandEcho, armed: bool) -> str:
        """Accept an echo; return "restarted" if its count of commands restarted, "rejected" if it refused one,
        otherwise ""."""
        elapsed = _signed(echo.mcu_ms - self._mcu_ms, 32)
        restarted = False
        if self._count is not None:
            if -REORDERED <= elapsed < 0:
                return ""  # overtaken by a newer one
            restarted = elapsed < 0 or _signed(echo.command_count - self._count, 32) < 0
        self._count, self._mcu_ms = echo.command_count, echo.mcu_ms
        if restarted:
            return "restarted"
        refused = armed and not echo.accepted
        self.rejected.look(now, refused)
        return "rejected" if refused else ""


class TiltWatch:
    """Duration of a vehicle's tilt beyond a limit."""

    def __init__(self, limit: float, duration: float, level: npt.ArrayLike = (0.0, 0.0, 1.0)) -> None:
        """Start without an attitude.

        Args:
            limit: Greatest tilt [rad].
            duration: Longest time beyond it [s].
            level: The body's z axis in the frame of the given attitudes, (3,).
        """
        self._cosine = math.cos(min(limit, math.pi)) if math.isfinite(limit) else -math.inf
        self._duration = duration
        self._level = tuple(float(part) for part in np.asarray(level, float))
        self._tilted = Lasting()
        self.forget = self._tilted.forget

    def accept(self, now: float, quaternion: npt.ArrayLike) -> None:
        """Accept an attitude, frame to world, xyzw, of any length, (4,)."""
        x, y, z, w = (float(part) for part in np.asarray(quaternion, float))
        a, b, c = self._level
        square = x * x + y * y + z * z + w * w
        up = 2.0 * (x * z - w * y) * a + 2.0 * (y * z + w * x) * b + (square - 2.0 * (x * x + y * y)) * c
        self._tilted.look(now, up < self._cosine * square)

    def over(self, now: float) -> bool:
        """Return whether the tilt has lasted too long. `now` is the time [s]."""
        return self._tilted.longer(self._duration, now)


class StateWatch:
    """Watchdog of the estimator's state."""

    def __init__(self, timeout: float, modes: tuple[str, ...]) -> None:
        """Start without a reading.

        Args:
            timeout: Greatest age of a reading that may be used [s].
            modes: States of vision in which a reading may be used.
        """
        self._timeout = timeout
        self._modes = modes
        self.forget()

    def forget(self) -> None:
        """Reset to the state before the first reading."""
        self._oldest = -math.inf
        self._why = "no output of the estimator yet"
        self._pose: tuple[Array, Array] | None = None

    def accept(self, now: float, reading: Reading) -> None:
        """Accept a reading. `now` is the time [s]."""
        self._oldest = min(now, reading.time)
        self._why = self._unfit(reading)
        self._pose = None if self._why else (np.asarray(reading.position), np.asarray(reading.quaternion))

    def pose(self, now: float) -> tuple[Array, Array] | None:
        """Return world position [m], (3,), and quaternion, (4,), of the newest reading; None if it may not be used."""
        return None if self.missing(now) else self._pose

    def missing(self, now: float) -> str:
        """Return why there is no usable state; "" if there is one. `now` is the time [s]."""
        if self._why:
            return self._why
        return (
            f"the newest reading is older than {self._timeout:g} s"
            if now - self._oldest > self._timeout
            else ""
        )

    def _unfit(self, reading: Reading) -> str:
        """Return why a reading cannot be used; "" if it can."""
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
    """Return the difference of two counters modulo 2^bits, as the nearest signed number."""
    half = 1 << (bits - 1)
    return (difference + half) % (1 << bits) - half


# The workspace of a vehicle: near a face thrust may only push inwards.


ROUNDING = 1e-3
"""Outward force that is tolerated as rounding of the allocation [N]."""


class Workspace:
    """A box in the world frame with a margin on both sides of each face."""

    def __init__(self, vehicle: Vehicle, lower: npt.ArrayLike, upper: npt.ArrayLike, margin: float) -> None:
        """Set up the box.

        Args:
            vehicle: Vehicle with the thrusters.
            lower: Lower corner, world frame [m], (3,).
            upper: Upper corner [m], (3,).
            margin: Half width of the band around each face in which thrust may only push inwards [m].
        """
        self.lower: Array = np.array(lower, float)
        self.upper: Array = np.array(upper, float)
        self.margin = margin
        self._inner = self.lower + margin, self.upper - margin
        self._outer = self.lower - margin, self.upper + margin
        self._allocator = Allocator.from_vehicle(vehicle)

    def left(self, position: Array) -> str:
        """Return the face that the vehicle has crossed by more than the margin; "" while it is inside. World frame
        [m], (3,)."""
        for axis, name in enumerate("xyz"):
            if not self._outer[0][axis] <= position[axis] <= self._outer[1][axis]:
                box = f"{self.lower[axis]:g} to {self.upper[axis]:g}"
                return f"{name} is {position[axis]:.2f} m, outside {box} m by more than {self.margin:g} m"
        return ""

    def outward(self, position: Array) -> Array:
        """Return the outward direction on each axis near whose face the vehicle is, otherwise 0: -1, 0 or 1, (3,).

        Args:
            position: World frame [m], (3,).

        Returns:
            The unit direction, (3,).
        """
        return (position > self._inner[1]).astype(float) - (position < self._inner[0])

    def inward_only(self, force: Array, position: Array, quaternion: Array) -> Array:
        """Return the thrusts without the outward components of their net force; the moment is preserved.

        tau = B f,   the outward components of R tau_F are removed,   f = allocate(tau)

        Args:
            force: Canonical order, within the limits [N], (n,).
            position: World frame [m], (3,).
            quaternion: Body to world, xyzw, (4,).

        Returns:
            Thrusts [N], (n,); zeros if the thrusters cannot produce the wrench without an outward force.
        """
        outward = self.outward(position)
        if not outward.any():
            return force
        R = quat_to_matrix(quaternion)
        tau = self._allocator.achieved(force)
        push = R @ tau[:3]
        out = push * outward > ROUNDING
        if not out.any():
            return force
        push[out] = 0.0
        allocated = self._allocator.allocate(np.concatenate([R.T @ push, tau[3:]]))
        still = (R @ self._allocator.achieved(allocated)[:3]) * outward
        return allocated if bool((still <= ROUNDING).all()) else np.zeros_like(force)


# All watchdogs of a robot together: serious conditions, transient conditions, and readiness for arming.


UP = (0.0, 0.0, 1.0)
BACK = 0.05
"""Apparent backward step of the clock that is tolerated, for messages processed out of order of arrival [s]."""


class BridgeClock:
    """The time of the latest call, with a check of its steps."""

    def __init__(self, step: float) -> None:
        """Start without a time.

        Args:
            step: Longest forward step between two calls [s].
        """
        self.now = 0.0
        """Time of the latest call [s]."""
        self._step = step
        self._started = False

    def wrong(self, now: float) -> str:
        """Store the time of a call, and return the problem with it; "" if there is none. `now` is the time [s]."""
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
    """The watchdogs of one vehicle and their conclusions. Every answer is one sentence, or "" if there is no
    problem."""

    def __init__(self, vehicle: Vehicle, settings: BridgeSettings, outputs: int) -> None:
        self.settings = settings
        self.peer = "motor controller"
        """Name of the sender of telemetry in messages."""
        self._others = tuple(vehicle.actuators)
        m = len(self._others)
        self.commander = Commander(len(vehicle.thrusters), settings.command_timeout, m)
        self.telemetry = TelemetryWatch(outputs, settings.telemetry_timeout, m)
        self.echo, self.deaf = EchoWatch(), Lasting()
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
        """Reset to the state before the first message."""
        for watch in (self.commander, self.telemetry, self.echo, self.deaf, self.state):
            watch.forget()
        for tilt in self.tilts.values():
            tilt.forget()

    def take_telemetry(self, now: float, message: Telemetry, armed: bool) -> str:
        """Process a well-formed message, received while `armed` or not; return "restarted" if the controller restarted.

        `now` is the time [s].
        """
        news = self.telemetry.accept(now, message)
        if news != "old":
            # Frames may be lost undetected; a firmware that sets no status bits does not report it.
            self.deaf.look(now, armed and bool(message.flags & TOLD) and not message.flags & FOLLOWS)
            self.tilts["telemetry"].accept(now, message.quaternion)
        return news if news == "restarted" else ""

    def take_reading(self, now: float, reading: Reading) -> None:
        """Accept a reading of the estimator. `now` is the time [s]."""
        self.state.accept(now, reading)
        pose = self.state.pose(now)
        if pose is None:
            self.tilts["estimator"].forget()
        else:
            self.tilts["estimator"].accept(now, pose[1])

    def fault_reason(self, now: float) -> str:
        """Return the condition that must stop the thrusters until an operator acknowledges it; "" if there is none.

        `now` is the time [s].
        """
        limits = self.settings
        if self.telemetry.age(now) > limits.telemetry_timeout:
            return f"no fresh telemetry from the {self.peer} for {limits.telemetry_timeout:g} s"
        if self.telemetry.lacks_actuators:
            return (
                f"the {self.peer} uses version 1 of the protocol, which has thrusters alone: "
                f"{', '.join(self._others)} need a firmware with version 2"
            )
        frozen = self.telemetry.frozen(now, limits.frozen_limit)
        if frozen:
            return f"telemetry is frozen: the {frozen} has repeated its numbers for {limits.frozen_limit:g} s"
        if self.echo.rejected.longer(limits.reject_limit):
            return f"the {self.peer} has refused every command for {limits.reject_limit:g} s"
        if self.deaf.longer(limits.reject_limit):
            return f"the {self.peer} has not followed any command for {limits.reject_limit:g} s"
        for source, tilt in self.tilts.items():
            if tilt.over(now):
                degrees = math.degrees(limits.max_tilt)
                return f"tilted beyond {degrees:.0f} degrees for {limits.max_tilt_duration:g} s, says the {source}"
        pose = self.state.pose(now)
        side = "" if pose is None else self.workspace.left(pose[0])
        return side and f"left the workspace: {side}"

    def hold_reason(self, now: float, since: float) -> str:
        """Return the transient condition that prevents thrust: no state, or no command, counted from `since` [s] on."""
        # The estimator first: without a state, a controller sends no commands.
        reason = self._estimator(now)
        if reason:
            return reason
        late = now - max(self.commander.received, since) > self.settings.command_timeout
        return f"no command for {self.settings.command_timeout:g} s" if late else ""

    def arming_refusal(self, now: float) -> str:
        """Return why arming is refused; "" if it is not. `now` is the time [s]."""
        reason = self.fault_reason(now) or self._estimator(now)
        if reason:
            return reason
        rivals = self.commander.sources(now)
        if len(rivals) > 1:
            return f"two publishers command the thrusters: {' and '.join(rivals)}"
        if self.commander.asks(now):
            return "the command is not zero: release the sticks or stop the controller"
        return ""

    def limited(self, now: float, force: Array) -> Array:
        """Return the thrusts without what pushes out of the workspace, canonical order [N], (n,).

        Args:
            now: [s]
            force: Along the thrusters' axes, canonical order, within the limits [N], (n,).
        """
        pose = self.state.pose(now)
        return force if pose is None else self.workspace.inward_only(force, *pose)

    def _estimator(self, now: float) -> str:
        return self.state.missing(now) if self.settings.need_reading else ""


STATES = ("disarmed", "armed", "hold", "fault")
RUNNING = ("armed", "hold")
"""States in which the watchdogs are active."""


class MotorDevice(Protocol):
    """The device between a bridge and the motors, which may act independently (`robot.runtime.Link`)."""

    peer: str
    """Name of the device in messages."""
    watched: tuple[tuple[str, ...], ...]
    """Groups of its sensors; a group is frozen if all of its sensors repeat their numbers."""

    def prepare(self, now: float) -> str:
        """Prepare arming; `Bridge.arm` calls it if nothing else prevents arming. `now` is the time [s].

        Returns:
            "" once commands are accepted, otherwise the reason.
        """

    def alarm(self, now: float) -> str:
        """Return why the vehicle is no longer under our control; "" while it is. Called at every tick of an armed
        bridge.

        `now` is the time [s].
        """

    def pause(self, now: float) -> str:
        """Return why thrust is temporarily not possible; "" otherwise. `now` is the time [s]."""


class Bridge:
    """State machine of one vehicle. Every method has the robot's clock `now` [s] as an argument; it reads no clock
    itself."""

    def __init__(self, vehicle: Vehicle, settings: BridgeSettings | None = None) -> None:
        self.vehicle = vehicle
        self.settings = settings or BridgeSettings.of(vehicle)
        self.motors = MotorMap.from_vehicle(vehicle)
        if len(self.settings.slew) != self.motors.thrusters:
            raise BridgeError(f"slew has {len(self.settings.slew)} rates, expected {self.motors.thrusters}")
        self._autopilot: MotorDevice | None = None
        self.getting_ready = False
        """True if arming was last refused only because an autopilot is not ready yet."""
        self.state = "disarmed"
        self.reason = ""
        """Reason of a hold or fault."""
        self.log = EventLog()
        self.force: Array = np.zeros(self.motors.thrusters)
        """Thrusts of the last tick after all limits, delivered on average, canonical order [N], (n,)."""
        others = list(vehicle.actuators.values())
        self.setpoints: Array = np.zeros(len(others))
        """Commanded values of the other actuators in the last tick, within their travel [rad, m³ or m], (m,)."""
        self._rest = np.array([math.nan if a.off is None else a.off for a in others])
        self._travel = np.array([a.minimum for a in others]), np.array([a.maximum for a in others])
        self._watchdogs = Supervision(vehicle, self.settings, self.motors.outputs)
        self._commander = self._watchdogs.commander
        self._clock = BridgeClock(self.settings.clock_step)
        self._memory = self.motors.reset()
        self._ticked: float | None = None
        self._armed_at = self._held_at = math.nan
        self._passed_at: float | None = None
        self._operator = False

    @property
    def autopilot(self) -> MotorDevice | None:
        """Device that must be ready before the bridge arms, and that may end arming; None: there is none."""
        return self._autopilot

    @autopilot.setter
    def autopilot(self, autopilot: MotorDevice) -> None:
        self._autopilot, self._watchdogs.peer = autopilot, autopilot.peer
        self._watchdogs.telemetry.watched = autopilot.watched

    # -- operator commands ----------------------------------------------------------------------------------------

    def arm(self, now: float, source: str) -> str:
        """Start to pass commands on. Return "", or in one sentence why arming is refused.

        `now` is the time [s].
        """
        refusal = self._refusal(now)
        reason = refusal or (self.autopilot.prepare(now) if self.autopilot is not None else "")
        self.getting_ready = bool(reason) and not refusal
        if reason:
            self.log.repeat(self._clock.now, "refused", f"{source} may not arm: {reason}")
            return reason
        self._commander.forget()
        self._watchdogs.echo.forget()
        self._watchdogs.deaf.forget()
        self._armed_at = self._clock.now
        self._enter("armed", "", f"armed by {source}")
        return ""

    def disarm(self, now: float) -> None:
        """Switch the thrusters off; a fault remains until it is acknowledged. `now` is the time [s]."""
        self._at(now)
        if self.state in RUNNING:
            self._enter("disarmed", "", "disarmed")

    def stop(self, now: float, reason: str) -> None:
        """Make an emergency stop, in any state. `now` is the time [s]."""
        self._at(now)
        self._fault(reason or "stopped")

    def acknowledge(self, now: float) -> None:
        """End a fault; the bridge is then disarmed. `now` is the time [s]."""
        self._at(now)
        if self.state == "fault":
            self._enter("disarmed", "", f"acknowledged: {self.reason}")

    def hold(self, now: float) -> None:
        """Pause an armed vehicle without thrust until `resume`, without a time limit.

        `now` is the time [s].
        """
        self._at(now)
        self._operator = self.state in RUNNING
        if self.state == "armed":
            self._hold("the operator holds")

    def resume(self, now: float) -> None:
        """End the operator's hold; thrust resumes with the next command. `now` is the time [s]."""
        self._at(now)
        self._operator = False

    # -- inputs -----------------------------------------------------------------------------------------------------

    def command(self, now: float, force: npt.ArrayLike, source: str, stamp: float | None = None) -> Array:
        """Process a command; a refused command does not reset the command timeout.

        Args:
            now: Arrival of the command [s].
            force: Thrusts along the thrusters' axes, canonical order [N], (n,); or these and the values of the other
                actuators [rad, m³ or m], (n + m,), which are otherwise unchanged.
            source: Sender of the command; two senders at a time are a fault.
            stamp: Time of the state on which the command is based, robot's clock [s].

        Returns:
            The thrusts within their limits and those of the workspace [N], (n,); zeros if they are not used.
        """
        unused = np.zeros_like(self.force)
        if not self._at(now):
            return unused
        rival = self._commander.rival(now, source)
        if rival and self.state in RUNNING:
            self._fault(f"two publishers command the thrusters: {rival} and {source}")
        reason = self._commander.accept(now, force, source, stamp)
        if reason:
            self.log.repeat(now, "command refused", f"{source}: {reason}")
        return self._limited(now) if self.state == "armed" and not reason else unused

    def telemetry(self, now: float, telemetry: Telemetry) -> None:
        """Process a message from the motor controller. `now` is the time [s]."""
        if not self._at(now):
            return
        reason = self._watchdogs.telemetry.malformed(telemetry)
        if reason:
            self.log.repeat(now, "telemetry refused", reason)
        elif self._watchdogs.take_telemetry(now, telemetry, self.state == "armed"):
            self._alarm("restart", f"the {self._watchdogs.peer} restarted: its clock went back")

    def echo(self, now: float, echo: CommandEcho) -> None:
        """Process the motor controller's echo of a command. `now` is the time [s]."""
        if not self._at(now):
            return
        news = self._watchdogs.echo.accept(now, echo, self.state == "armed")
        if news == "restarted":
            self._alarm("restart", f"the {self._watchdogs.peer} restarted: its count of commands began again")
        elif news == "rejected":
            flags = f"flags {echo.reject_flags:#x}"
            self.log.repeat(now, "command rejected", f"the {self._watchdogs.peer} refused a command: {flags}")

    def reading(self, now: float, reading: Reading) -> None:
        """Process a reading of the estimator. `now` is the time [s]."""
        if self._at(now):
            self._watchdogs.take_reading(now, reading)

    # -- outputs ----------------------------------------------------------------------------------------------------

    def tick(self, now: float) -> ThrusterCommand:
        """Return the frame to send now; call it in every step of the loop, in every state. `now` is the time [s]."""
        dt = self._period(now)
        if self.state in RUNNING:
            self._watch(self._clock.now)
        if self.state != "armed":
            reported = self._watchdogs.telemetry.values or self.setpoints
            self.setpoints = np.where(np.isnan(self._rest), reported, self._rest)
            return ThrusterCommand(False, (0.0,) * self.motors.outputs, tuple(self.setpoints.tolist()))
        step = self.settings.slew * dt
        change = np.minimum(np.maximum(self._limited(now) - self.force, -step), step)
        normalised, self.force, self._memory = self.motors.normalised(self.force + change, self._memory, dt)
        if self._commander.setpoints is not None:
            self.setpoints = np.clip(self._commander.setpoints, *self._travel)
        return ThrusterCommand(True, tuple(normalised.tolist()), tuple(self.setpoints.tolist()))

    @property
    def source(self) -> str:
        """Source of the newest command."""
        return self._commander.source

    @property
    def requested(self) -> Array:
        """Thrusts of the newest command before all limits, canonical order [N], (n,)."""
        return self._commander.force

    def note(self, now: float, text: str) -> None:
        """Add a sentence of the device between the bridge and the motors to the events. `now` is the time [s]."""
        self.log.repeat(now, "autopilot", text)

    def drain(self) -> list[Event]:
        """Return the events since the last call."""
        return self.log.drain()

    # -- internal ---------------------------------------------------------------------------------------------------

    def _limited(self, now: float) -> Array:
        """Return the newest command within the limits of the thrusters and of the workspace [N], (n,)."""
        return self._watchdogs.limited(now, self.motors.limited(self._commander.force))

    def _refusal(self, now: float) -> str:
        """Return why arming is refused; "" if it is not."""
        if not self._at(now):
            return "the clock is not a number"
        if self.state == "fault":
            return f"acknowledge the fault first: {self.reason}"
        if self.state != "disarmed":
            return f"it is in state {self.state} already"
        return self._pause(now) or self._watchdogs.arming_refusal(now)

    def _watch(self, now: float) -> None:
        """Evaluate the watchdogs, and enter fault or hold, or continue."""
        lost = self.autopilot.alarm(now) if self.autopilot is not None else ""
        fault_reason = lost or self._watchdogs.fault_reason(now)
        if fault_reason:
            return self._fault(fault_reason)
        pause = self._pause(now)
        hold_reason = (
            "the operator holds"
            if self._operator
            else pause or self._watchdogs.hold_reason(now, self._armed_at)
        )
        if hold_reason and self.state == "armed":
            self._hold(hold_reason)
        if self.state == "hold":
            self._wait(now, hold_reason, limited=not pause)

    def _pause(self, now: float) -> str:
        """Return the condition for which the device between bridge and motors waits; "" if none."""
        return self.autopilot.pause(now) if self.autopilot is not None else ""

    def _wait(self, now: float, hold_reason: str, *, limited: bool) -> None:
        """Process a hold: continue with the first command after the condition passed, or fault after the limit, if
        any."""
        if hold_reason:
            self.reason, self._passed_at = hold_reason, None
        elif self._passed_at is None:
            self._passed_at = now
        elif self._commander.received > self._passed_at:
            return self._enter("armed", "", f"resumed after: {self.reason}")
        if self._operator or not limited:
            self._held_at = now
        elif now - self._held_at > self.settings.hold_limit:
            self._fault(f"held longer than {self.settings.hold_limit:g} s: {self.reason}")

    def _hold(self, reason: str) -> None:
        self._held_at = self._clock.now
        self._enter("hold", reason, reason)

    def _period(self, now: float) -> float:
        """Return the time since the last tick [s], 0 at the first."""
        if not self._at(now):
            return 0.0
        before, self._ticked = self._ticked, self._clock.now
        step = 0.0 if before is None else max(self._ticked - before, 0.0)
        if step > self.settings.clock_step:
            self._alarm("clock", f"the loop stood still for {step:.1f} s")
        return step

    def _at(self, now: float) -> bool:
        """Check the clock; return False if `now` is not a number."""
        wrong = self._clock.wrong(now)
        if wrong and math.isfinite(now):
            # Messages from before a jump no longer have a known age.
            self._watchdogs.forget()
            self._ticked = None
        if wrong:
            self._alarm("clock", wrong)
        return math.isfinite(now)

    def _alarm(self, kind: str, text: str) -> None:
        """Enter a fault if thrusters could turn, otherwise only add an event."""
        if self.state in RUNNING:
            self._fault(text)
        else:
            self.log.repeat(self._clock.now, kind, text)

    def _fault(self, reason: str) -> None:
        """Enter the fault state; the first reason is kept until it is acknowledged."""
        if self.state == "fault":
            self.log.repeat(self._clock.now, "also", reason)
        else:
            self._enter("fault", reason, reason)

    def _enter(self, state: str, reason: str, text: str) -> None:
        """Change the state; thrust is reset to zero."""
        self.state, self.reason, self._passed_at = state, reason, None
        self._operator = self._operator and state == "hold"
        self.force, self._memory = np.zeros_like(self.force), self.motors.reset()
        self.log.add(self._clock.now, state, text)
