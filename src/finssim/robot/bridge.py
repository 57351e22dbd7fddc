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

# Events of a bridge for its operator and its record, in order, a repeated one at most once a second.


KEPT = 1000
"""Greatest number of events that are kept until they are read."""
REPEAT = 1.0
"""Least time between two events of one kind and source [s]."""


class Event(NamedTuple):
    """Something that happened."""

    time: float
    """Robot's clock [s]."""
    kind: str
    """One or two words: state, fault, hold, command, telemetry, echo, clock, refused."""
    text: str
    """One sentence."""


class EventLog:
    """The newest events, and how many there were of each kind."""

    def __init__(self) -> None:
        self.events: deque[Event] = deque(maxlen=KEPT)
        self.counts: Counter[str] = Counter()
        self._last: dict[str, float] = {}

    def add(self, time: float, kind: str, text: str) -> None:
        """Notes an event, always.

        Args:
            time: Robot's clock [s].
            kind: One or two words.
            text: One sentence.
        """
        self.counts[kind] += 1
        self.events.append(Event(time, kind, text))

    def repeat(self, time: float, kind: str, text: str) -> None:
        """Counts an event that may come with every message, and notes it if none of its kind was noted just now.

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
        """All events since the last call, oldest first."""
        drained = list(self.events)
        self.events.clear()
        return drained


# The limits of a bridge: from the safety section of a vehicle file, or changed one by one.


Array = npt.NDArray[np.float64]

FULL_RANGE = 0.1
"""Time from full reverse to full forward where the vehicle file gives no slew limit of the thrust [s]."""


class BridgeError(ValueError):
    """A bridge was set up with limits it cannot keep: the message states which and what to give."""


@dataclass(frozen=True, kw_only=True)
class BridgeSettings:
    """Limits that stop the thrusters. Make them with `of`; `math.inf` switches a watchdog off."""

    slew: Array
    """Fastest change of each thrust, canonical order [N/s], (n,)."""
    command_timeout: float = 0.5
    """Longest silence of the commander [s]."""
    telemetry_timeout: float = 0.5
    """Longest silence of the motor controller [s]."""
    state_timeout: float = 0.5
    """Oldest reading to act on [s]."""
    frozen_limit: float = 0.3
    """Longest time that gyro or accelerometer may repeat its numbers to the last bit [s]."""
    max_tilt: float = math.inf
    """[rad]"""
    max_tilt_duration: float = 1.0
    """Longest time above `max_tilt` [s]."""
    workspace_lower: Array
    """Lower corner of the allowed box, world frame [m], (3,)."""
    workspace_upper: Array
    """Upper corner [m], (3,)."""
    workspace_margin: float = 0.1
    """Thrust may only push inwards this near to a face, on either side; further outside is a fault [m]."""
    hold_limit: float = 5.0
    """Longest hold before it becomes a fault, unless the operator asked for it [s]."""
    clock_step: float = 1.0
    """Longest step of the clock forward between two calls [s]."""
    reject_limit: float = 0.5
    """Longest time for which the motor controller may refuse every command, or receive none [s]."""
    need_reading: bool = True
    """True if the estimator must be ready; False lets an operator drive without localization."""
    vision_modes: tuple[str, ...] = ("fresh", "coast")
    """Modes of vision in which a reading may be acted on."""

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
        """Limits of a vehicle's `safety` section.

        Args:
            vehicle: Its `safety` section and the slew limits of its thrusters are read.
            changes: Fields by name that shall differ.

        Raises:
            BridgeError: A limit that cannot be kept, or no field of that name.
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
"""Fields that the safety section of a vehicle file gives under the same name."""
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
    """Fastest change of each thrust [N/s], (n,): the file's own where it limits thrust, else from range and time."""
    lower, upper = vehicle.force_limits
    stated = np.array([t.slew if t.domain == "force" else math.inf for t in vehicle.thrusters.values()])
    return np.where(np.isfinite(stated), stated, (upper - lower) / FULL_RANGE)


# Who commands a robot, and the newest command that was fit to be used.


EARLY = 0.1
"""Greatest lead of a stamp over the robot's clock [s]."""


class Commander:
    """Takes commands; what it refuses does not count as a sign of life."""

    def __init__(self, thrusters: int, timeout: float, others: int = 0) -> None:
        """
        Args:
            thrusters: Thrusts in a command, n.
            others: Values of other actuators that may follow them, m.
            timeout: Age at which a command, or a word from another source, no longer counts [s].
        """
        self._thrusters, self._others = thrusters, others
        self._timeout = timeout
        self.forget()

    def forget(self) -> None:
        """Reset to the state before the first command."""
        self.force: Array = np.zeros(self._thrusters)
        """Of the newest command, canonical order [N], (n,)."""
        self.setpoints: Array | None = None
        """Values of the other actuators in the newest command that has them [rad, m³ or m], (m,)."""
        self.received = -math.inf
        """When it came [s]."""
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
        """Everybody heard within the timeout. `now` is the time [s]."""
        return [name for name, time in self._heard.items() if now - time <= self._timeout]

    def accept(self, now: float, force: npt.ArrayLike, source: str, stamp: float | None) -> str:
        """Accept a command if it is fit to be used; otherwise return the reason and keep the one before.

        Args:
            now: When it came [s].
            force: Thrusts along the thrusters' axes, canonical order [N], (n,), or these and the values of the other
                actuators [rad, m³ or m], (n + m,).
            source: Who sent it.
            stamp: Time of what its sender knew, robot's clock [s]; None: it does not tell.
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
        """Return whether the newest command still counts and demands thrust."""
        return now - self.received <= self._timeout and bool(self.force.any())


# What watches the messages of a robot: each watchdog takes a message with its time and answers in one sentence.


TOLD, FOLLOWS = int(StatusFlag.DIAGNOSTICS), int(StatusFlag.DIRECT_THRUSTERS)
SENSED = ("quaternion", "gyro", "accel")
"""Sensors of telemetry whose repetition is noted."""
REORDERED = 1000
"""A datagram may be overtaken by this much of the controller's clock [ms]; further back is a restart."""


class TelemetryWatch:
    """Watch telemetry for silence, repetition and restarts; `timeout` is in [s]."""

    def __init__(self, outputs: int, timeout: float, others: int = 0) -> None:
        self._outputs, self._others = outputs, others
        self._timeout = timeout
        self.watched: tuple[tuple[str, ...], ...] = (("gyro",), ("accel",))
        """Groups of sensors: those of one that all repeat their numbers have frozen."""
        self.forget()

    def forget(self) -> None:
        """Reset to the state before the first message."""
        self.fresh_since = -math.inf
        self._last: Telemetry | None = None
        self._changed = dict.fromkeys(SENSED, math.inf)

    @property
    def values(self) -> tuple[float, ...]:
        """Return the values of the other actuators in the newest message [rad, m³ or m]; empty where it has none."""
        return () if self._last is None else self._last.actuators

    @property
    def lacks_actuators(self) -> bool:
        """Return whether the newest message lacks the vehicle's actuators besides thrusters."""
        return self._last is not None and len(self.values) < self._others

    def age(self, now: float) -> float:
        """Time since the last message that brought something new [s]; infinite before the first."""
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
        """Takes a well-formed message; a repeated or overtaken one refreshes nothing.

        `now` is the time [s].

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
        """Return the sensors that have repeated their exact numbers for longer than `limit` [s]; "" if none have."""
        for sensors in self.watched:
            changed = max(self._changed[sensor] for sensor in sensors)
            # Silence is another watchdog's: what counts is how long messages kept coming with the same numbers.
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
    """Duration for which a condition held at every check."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Reset to the state before the condition ever held."""
        self._since, self._until = math.inf, -math.inf

    def look(self, now: float, so: bool) -> None:
        """Note whether the condition holds now [s]."""
        if so:
            self._since, self._until = min(self._since, now), now
        else:
            self.forget()

    def longer(self, limit: float, now: float | None = None) -> bool:
        """Return whether it has held for longer than `limit` [s], until `now`, or until the last check if None."""
        return (self._until if now is None else now) - self._since > limit


class EchoWatch:
    """Echoes of commands by the motor controller."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Reset to the state before the first echo."""
        self._count: int | None = None
        self._mcu_ms = 0
        self.rejected = Lasting()
        """Whether commands are refused."""

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
        refused = armed and not echo.accepted
        self.rejected.look(now, refused)
        return "rejected" if refused else ""


class TiltWatch:
    """Duration of a vehicle's tilt beyond a limit."""

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
        self._tilted = Lasting()
        self.forget = self._tilted.forget

    def accept(self, now: float, quaternion: npt.ArrayLike) -> None:
        """Takes an attitude, given frame to world, xyzw, of any length, (4,)."""
        x, y, z, w = (float(part) for part in np.asarray(quaternion, float))
        a, b, c = self._level
        square = x * x + y * y + z * z + w * w
        up = 2.0 * (x * z - w * y) * a + 2.0 * (y * z + w * x) * b + (square - 2.0 * (x * x + y * y)) * c
        self._tilted.look(now, up < self._cosine * square)

    def over(self, now: float) -> bool:
        """Return whether it lasted too long. `now` is the time [s]."""
        return self._tilted.longer(self._duration, now)


class StateWatch:
    """State of the estimator, and whether it may be acted on."""

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
        """Reset to the state before the first reading."""
        self._oldest = -math.inf
        self._why = "no output of the estimator yet"
        self._pose: tuple[Array, Array] | None = None

    def accept(self, now: float, reading: Reading) -> None:
        """Takes a reading. `now` is the time [s]."""
        self._oldest = min(now, reading.time)
        self._why = self._unfit(reading)
        self._pose = None if self._why else (np.asarray(reading.position), np.asarray(reading.quaternion))

    def pose(self, now: float) -> tuple[Array, Array] | None:
        """World position [m], (3,), and quaternion, (4,), of the newest reading; None where it may not be acted on."""
        return None if self.missing(now) else self._pose

    def missing(self, now: float) -> str:
        """Return why there is no state to act on; "" if there is. `now` is the time [s]."""
        if self._why:
            return self._why
        return (
            f"the newest reading is older than {self._timeout:g} s"
            if now - self._oldest > self._timeout
            else ""
        )

    def _unfit(self, reading: Reading) -> str:
        """Return why a reading cannot be acted on; "" if it can."""
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


# The box a vehicle may move in: near a face thrust may only push inwards.


ROUNDING = 1e-3
"""Outward force that is left to the rounding of the allocation [N]."""


class Workspace:
    """A box in the world frame with a margin to both sides of each face."""

    def __init__(self, vehicle: Vehicle, lower: npt.ArrayLike, upper: npt.ArrayLike, margin: float) -> None:
        """
        Args:
            vehicle: Whose thrusters push.
            lower: Corner, world frame [m], (3,).
            upper: Opposite corner [m], (3,).
            margin: Half width of the band around each face in which thrust may only push inwards [m].
        """
        self.lower: Array = np.array(lower, float)
        self.upper: Array = np.array(upper, float)
        self.margin = margin
        self._inner = self.lower + margin, self.upper - margin
        self._outer = self.lower - margin, self.upper + margin
        self._allocator = Allocator.from_vehicle(vehicle)

    def left(self, position: Array) -> str:
        """Return the face that lies more than the margin behind the vehicle; "" while it is inside. World frame [m],
        (3,)."""
        for axis, name in enumerate("xyz"):
            if not self._outer[0][axis] <= position[axis] <= self._outer[1][axis]:
                box = f"{self.lower[axis]:g} to {self.upper[axis]:g}"
                return f"{name} is {position[axis]:.2f} m, outside {box} m by more than {self.margin:g} m"
        return ""

    def outward(self, position: Array) -> Array:
        """Return the direction out of the box on each axis where the vehicle is near a face, else 0: -1, 0 or 1, (3,).

        Args:
            position: World frame [m], (3,).

        Returns:
            The unit direction, (3,).
        """
        return (position > self._inner[1]).astype(float) - (position < self._inner[0])

    def inward_only(self, force: Array, position: Array, quaternion: Array) -> Array:
        """Thrusts without the part of their net force that pushes further out; the moment is kept.

        tau = B f,   the outward components of R tau_F are removed,   f = allocate(tau)

        Args:
            force: Canonical order, within the limits [N], (n,).
            position: World frame [m], (3,).
            quaternion: Body to world, xyzw, (4,).

        Returns:
            Thrusts [N], (n,); zeros where the thrusters cannot give the wrench without pushing out.
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


# All that watches a robot together: whether it is in danger, in want of something, or fit to be armed.


UP = (0.0, 0.0, 1.0)
BACK = 0.05
"""The clock may seem to go back by this much, where messages are handed over out of the order of their arrival [s]."""


class BridgeClock:
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
        """Note the time of a call, and return what is wrong with it; "" if nothing. `now` is the time [s]."""
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
        self.peer = "motor controller"
        """Who sends telemetry, in sentences."""
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
        """Note a well-formed message that came while `armed` or not; return "restarted" if the controller did.

        `now` is the time [s].
        """
        news = self.telemetry.accept(now, message)
        if news != "old":
            # Frames may be lost unseen; a firmware that sets no status bits does not report it.
            self.deaf.look(now, armed and bool(message.flags & TOLD) and not message.flags & FOLLOWS)
            self.tilts["telemetry"].accept(now, message.quaternion)
        return news if news == "restarted" else ""

    def take_reading(self, now: float, reading: Reading) -> None:
        """Takes a reading of the estimator. `now` is the time [s]."""
        self.state.accept(now, reading)
        pose = self.state.pose(now)
        if pose is None:
            self.tilts["estimator"].forget()
        else:
            self.tilts["estimator"].accept(now, pose[1])

    def danger(self, now: float) -> str:
        """Return what must stop the thrusters until an operator has acknowledged it; "" if nothing.

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

    def want(self, now: float, since: float) -> str:
        """Return what thrust waits for: the estimator, or a command, counted from `since` [s] at the earliest."""
        # The estimator first: without a state, a controller is silent for that very reason.
        reason = self._estimator(now)
        if reason:
            return reason
        late = now - max(self.commander.received, since) > self.settings.command_timeout
        return f"no command for {self.settings.command_timeout:g} s" if late else ""

    def unfit(self, now: float) -> str:
        """Return why arming is refused; "" if it is not. `now` is the time [s]."""
        reason = self.danger(now) or self._estimator(now)
        if reason:
            return reason
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


STATES = ("disarmed", "armed", "hold", "fault")
RUNNING = ("armed", "hold")
"""States in which the watchdogs bite."""


class MotorDevice(Protocol):
    """The device between a bridge and the motors, which may act independently (`robot.runtime.Link`)."""

    peer: str
    """Name of the device in messages."""
    watched: tuple[tuple[str, ...], ...]
    """Groups of its sensors; those of one that all repeat their numbers have frozen."""

    def prepare(self, now: float) -> str:
        """Prepare arming; called by `Bridge.arm` if nothing else prevents it. Return "" once commands count, else the
        reason."""

    def alarm(self, now: float) -> str:
        """Asked at every tick of an armed bridge: why the vehicle is no longer ours; "" while it is.

        `now` is the time [s].
        """

    def pause(self, now: float) -> str:
        """Return why no thrust may be given now, which passes; "" otherwise. `now` is the time [s]."""


class Bridge:
    """State machine of one vehicle. Every method takes the robot's clock `now` [s]; it reads no clock itself."""

    def __init__(self, vehicle: Vehicle, settings: BridgeSettings | None = None) -> None:
        self.vehicle = vehicle
        self.settings = settings or BridgeSettings.of(vehicle)
        self.motors = MotorMap.from_vehicle(vehicle)
        if len(self.settings.slew) != self.motors.thrusters:
            raise BridgeError(f"slew has {len(self.settings.slew)} rates, expected {self.motors.thrusters}")
        self._autopilot: MotorDevice | None = None
        self.getting_ready = False
        """Whether arming was last refused by nothing but an autopilot that has yet to get ready."""
        self.state = "disarmed"
        self.reason = ""
        """Why it is in hold or fault."""
        self.log = EventLog()
        self.force: Array = np.zeros(self.motors.thrusters)
        """Thrusts of the last tick after all limits, delivered on average, canonical order [N], (n,)."""
        others = list(vehicle.actuators.values())
        self.setpoints: Array = np.zeros(len(others))
        """Values that the last tick asked of the other actuators, within their travel [rad, m³ or m], (m,)."""
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
        """Has to be ready before the bridge arms, and may end it; None: there is none."""
        return self._autopilot

    @autopilot.setter
    def autopilot(self, autopilot: MotorDevice) -> None:
        self._autopilot, self._watchdogs.peer = autopilot, autopilot.peer
        self._watchdogs.telemetry.watched = autopilot.watched

    # -- what the operator says -------------------------------------------------------------------------------

    def arm(self, now: float, source: str) -> str:
        """Let commands through from now on. Returns "" or, in one sentence, why it is refused.

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
        """Thrusters off; a fault stays until it is acknowledged. `now` is the time [s]."""
        self._at(now)
        if self.state in RUNNING:
            self._enter("disarmed", "", "disarmed")

    def stop(self, now: float, reason: str) -> None:
        """Emergency stop, in every state. `now` is the time [s]."""
        self._at(now)
        self._fault(reason or "stopped")

    def acknowledge(self, now: float) -> None:
        """End a fault; the bridge is disarmed then. `now` is the time [s]."""
        self._at(now)
        if self.state == "fault":
            self._enter("disarmed", "", f"acknowledged: {self.reason}")

    def hold(self, now: float) -> None:
        """Pause an armed vehicle without thrust until `resume`, for as long as the operator likes.

        `now` is the time [s].
        """
        self._at(now)
        self._operator = self.state in RUNNING
        if self.state == "armed":
            self._hold("the operator holds")

    def resume(self, now: float) -> None:
        """End the operator's hold; thrust returns with the first command after it. `now` is the time [s]."""
        self._at(now)
        self._operator = False

    # -- what comes in ----------------------------------------------------------------------------------------

    def command(self, now: float, force: npt.ArrayLike, source: str, stamp: float | None = None) -> Array:
        """A command; one that is refused does not count as a sign of life.

        Args:
            now: When it came [s].
            force: Thrusts along the thrusters' axes, canonical order [N], (n,); these and the values of the other
                actuators [rad, m³ or m], (n + m,), which otherwise stay where they are.
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
        reason = self._commander.accept(now, force, source, stamp)
        if reason:
            self.log.repeat(now, "command refused", f"{source}: {reason}")
        return self._limited(now) if self.state == "armed" and not reason else unused

    def telemetry(self, now: float, telemetry: Telemetry) -> None:
        """A message from the motor controller. `now` is the time [s]."""
        if not self._at(now):
            return
        reason = self._watchdogs.telemetry.malformed(telemetry)
        if reason:
            self.log.repeat(now, "telemetry refused", reason)
        elif self._watchdogs.take_telemetry(now, telemetry, self.state == "armed"):
            self._alarm("restart", f"the {self._watchdogs.peer} restarted: its clock went back")

    def echo(self, now: float, echo: CommandEcho) -> None:
        """Note the motor controller's echo of a command. `now` is the time [s]."""
        if not self._at(now):
            return
        news = self._watchdogs.echo.accept(now, echo, self.state == "armed")
        if news == "restarted":
            self._alarm("restart", f"the {self._watchdogs.peer} restarted: its count of commands began again")
        elif news == "rejected":
            flags = f"flags {echo.reject_flags:#x}"
            self.log.repeat(now, "command rejected", f"the {self._watchdogs.peer} refused a command: {flags}")

    def reading(self, now: float, reading: Reading) -> None:
        """Note a reading of the estimator. `now` is the time [s]."""
        if self._at(now):
            self._watchdogs.take_reading(now, reading)

    # -- what goes out ----------------------------------------------------------------------------------------

    def tick(self, now: float) -> ThrusterCommand:
        """The frame to send now; call it at every turn of the loop, in every state. `now` is the time [s]."""
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
        """Return the source of the newest command."""
        return self._commander.source

    @property
    def requested(self) -> Array:
        """The newest command before all limits, canonical order [N], (n,)."""
        return self._commander.force

    def note(self, now: float, text: str) -> None:
        """Add a sentence of the device between us and the motors to the events. `now` is the time [s]."""
        self.log.repeat(now, "autopilot", text)

    def drain(self) -> list[Event]:
        """Events since the last call."""
        return self.log.drain()

    # -- inside -----------------------------------------------------------------------------------------------

    def _limited(self, now: float) -> Array:
        """The newest command within the limits of the thrusters and of the workspace [N], (n,)."""
        return self._watchdogs.limited(now, self.motors.limited(self._commander.force))

    def _refusal(self, now: float) -> str:
        """Return why arming is refused; "" if it is not."""
        if not self._at(now):
            return "the clock is not a number"
        if self.state == "fault":
            return f"acknowledge the fault first: {self.reason}"
        if self.state != "disarmed":
            return f"it is in state {self.state} already"
        return self._pause(now) or self._watchdogs.unfit(now)

    def _watch(self, now: float) -> None:
        """Let the watchdogs look: fault, hold, or on with it."""
        lost = self.autopilot.alarm(now) if self.autopilot is not None else ""
        danger = lost or self._watchdogs.danger(now)
        if danger:
            return self._fault(danger)
        pause = self._pause(now)
        want = "the operator holds" if self._operator else pause or self._watchdogs.want(now, self._armed_at)
        if want and self.state == "armed":
            self._hold(want)
        if self.state == "hold":
            self._wait(now, want, limited=not pause)

    def _pause(self, now: float) -> str:
        """Return what the device between us and the motors waits for; "" if nothing."""
        return self.autopilot.pause(now) if self.autopilot is not None else ""

    def _wait(self, now: float, want: str, *, limited: bool) -> None:
        """In hold: continue with the first command after the condition passed, or give up after the limit, if any."""
        if want:
            self.reason, self._passed_at = want, None
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

    def _fault(self, reason: str) -> None:
        """Stop; the first reason is kept until it is acknowledged."""
        if self.state == "fault":
            self.log.repeat(self._clock.now, "also", reason)
        else:
            self._enter("fault", reason, reason)

    def _enter(self, state: str, reason: str, text: str) -> None:
        """Changes state; no thrust is carried over."""
        self.state, self.reason, self._passed_at = state, reason, None
        self._operator = self._operator and state == "hold"
        self.force, self._memory = np.zeros_like(self.force), self.motors.reset()
        self.log.add(self._clock.now, state, text)
