"""`finssim teleop`: manual driving, with the same bridge and the same record as a controller.

Inputs of a gamepad or a keyboard become a wrench by gears, a dead band and a dead-man switch; buttons arm, disarm and
stop the vehicle, or hand over to a controller.
"""

from __future__ import annotations

import math
import os
import select
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Annotated, Any, Literal, NamedTuple, Protocol, TextIO

import numpy as np
import numpy.typing as npt

from finssim.control.guidance import Guide, Station
from finssim.localization.overhead_camera import Pool, load_pool
from finssim.robot.bridge import Bridge, BridgeSettings
from finssim.robot.goals import check_reachable, station_of
from finssim.robot.perception import Perception, Unlocated
from finssim.robot.pilots import HelmPilot, ModeSwitch, Pilot, WrenchPilot, make_pilot
from finssim.robot.recorder import Recorder, recording
from finssim.robot.runtime import Runtime
from finssim.robot.wiring import RobotDriver, Wiring, connected
from finssim.vehicles import Vehicle, load_vehicle

Array = npt.NDArray[np.float64]

Gear = Literal["precision", "cruise", "boost"]

GEARS: dict[Gear, tuple[float, float, float, float]] = {
    "precision": (2.0, 1.5, 1.5, 0.25),
    "cruise": (6.0, 4.0, 5.0, 0.8),
    "boost": (10.0, 7.0, 8.0, 1.2),
}
"""Wrench at full deflection of surge, sway, heave [N] and yaw [N m], as published."""
DEAD_BAND = 0.1
"""Deflection below which there is no output; larger ones are measured from it."""
EXPO = 0.3
"""Weight of the cubic term of the response: small deflections become finer, the full one is unchanged."""
LOST = 0.5
"""Time without input after which the device counts as lost [s]."""
ARMING = 5.0
"""Time for which a press of the arm button waits for an autopilot to become ready [s]."""


class TeleopError(ValueError):
    """A device for teleoperation is missing, or cannot be used."""


@dataclass(frozen=True)
class Hands:
    """State of an input device at one time. Axes are in [-1, 1]: forward, left, up, turn left."""

    surge: float = 0.0
    sway: float = 0.0
    heave: float = 0.0
    yaw: float = 0.0
    dead_man: bool = False
    """True if the dead-man switch is held; otherwise there is no thrust."""
    precision: bool = False
    boost: bool = False
    arm: bool = False
    """True if the button that arms and disarms is pressed."""
    stop: bool = False
    """True if the emergency stop is pressed."""
    acknowledge: bool = False
    """True if the button that ends a fault is pressed."""
    mode: bool = False
    """True if the button that hands over to the other pilot is pressed."""
    present: bool = True
    """True if the device is connected."""

    @property
    def gear(self) -> Gear:
        """Selected gear; precision, the more careful one, takes precedence over boost."""
        return "precision" if self.precision else "boost" if self.boost else "cruise"

    @property
    def wrench(self) -> Array:
        """Commanded wrench, body frame [N, N m], (6,); zero without the dead-man switch, and with the emergency
        stop."""
        if not self.dead_man or self.stop:
            return np.zeros(6)
        x, y, z, n = shaped(np.array([self.surge, self.sway, self.heave, self.yaw])) * GEARS[self.gear]
        return np.array([x, y, z, 0.0, 0.0, n])


def shaped(deflection: Array, dead_band: float = DEAD_BAND, expo: float = EXPO) -> Array:
    """Return the response to deflections: e d³ + (1 - e) d with d from the dead band, within [-1, 1]; NaN counts as
    0."""
    x = np.clip(np.nan_to_num(deflection, nan=0.0), -1.0, 1.0)
    beyond = np.maximum(np.abs(x) - dead_band, 0.0) / (1.0 - dead_band)
    return np.asarray(np.sign(x) * (expo * beyond**3 + (1.0 - expo) * beyond), float)


@dataclass(frozen=True)
class TeleopCommand:
    """Current command of the operator."""

    wrench: Array = field(default_factory=lambda: np.zeros(6))
    """Wrench, body frame [N, N m], (6,)."""
    gear: Gear = "cruise"
    stop: bool = False
    pressed: frozenset[str] = frozenset()
    """Buttons that were just pressed, of arm, acknowledge and mode: once for each press."""
    lost: bool = False
    """True if the device is lost: disarm."""


class Device(Protocol):
    """A gamepad, a keyboard, or a replacement for one."""

    def read(self, now: float) -> Hands | None:
        """Return its state now [s]; None without news since the last call. Never waits."""


class Operator:
    """An operator of a running robot: reads a device in each step of the loop and executes its commands.

    A vehicle is armed only by a press of the arm button; an autopilot that is not ready yet is waited for up to
    `ARMING` seconds, or until the next press. A lost device, a released dead-man switch and the emergency stop each
    mean no thrust; a lost device disarms, and its return arms nothing: the first reading after the start or after a
    loss only determines which buttons are pressed.
    """

    def __init__(self, device: Device, swap: Callable[[], None] | None = None) -> None:
        """Set the device.

        Args:
            device: The operator's input device.
            swap: Function that switches between operator and controller; None: there is no controller.
        """
        self.device, self._swap = device, swap
        self.command = TeleopCommand()
        """Latest command."""
        self.message = ""
        """Message to the operator: why arming was refused, or what is wrong."""
        self._before: Hands | None = None
        self._heard = self._arming = -math.inf
        """Time of the device's last input, and end of the wait for an autopilot [s]."""

    def wrench(self) -> Array:
        """Return the requested wrench, body frame [N, N m], (6,); for `pilots.WrenchPilot`."""
        return self.command.wrench

    def deflection(self) -> Array:
        """Return surge, sway, heave and yaw as fractions of the highest gear [-], (4,); for `pilots.HelmPilot`."""
        return np.asarray(self.command.wrench[[0, 1, 2, 5]] / GEARS["boost"])

    def look(self, now: float) -> TeleopCommand:
        """Return the operator's command at a time [s]."""
        hands, before = self.device.read(now), self._before
        if hands is not None and hands.present:
            self._heard = now
        if (hands is not None and not hands.present) or now - self._heard > LOST:
            self._before = None
            return TeleopCommand(lost=True)
        self._before = hands = hands or before or Hands()
        if before is None:
            return TeleopCommand(gear=hands.gear, stop=hands.stop)
        edges = (b for b in ("arm", "acknowledge", "mode") if getattr(hands, b) and not getattr(before, b))
        return TeleopCommand(hands.wrench, hands.gear, hands.stop, frozenset(edges))

    def turn(self, now: float, bridge: Bridge) -> None:
        """Read the device at a time [s], and arm, disarm or stop accordingly."""
        self.command = command = self.look(now)
        armed = bridge.state in ("armed", "hold")
        waiting, self._arming = now < self._arming, self._arming if not command.stop else -math.inf
        if command.lost:
            self._arming = -math.inf
            if armed:
                bridge.disarm(now)
                self.message = "the device is lost: disarmed"
            return
        if command.stop:
            if bridge.state != "fault":
                bridge.stop(now, "emergency stop by the operator")
            return
        if "acknowledge" in command.pressed and bridge.state == "fault":
            bridge.acknowledge(now)
            self.message = ""
        if "arm" in command.pressed and (armed or waiting):
            bridge.disarm(now)
            self.message, self._arming = "", -math.inf
        elif waiting or "arm" in command.pressed:
            self.message = bridge.arm(now, "operator")
            if not bridge.getting_ready:
                self._arming = -math.inf
            elif not waiting:
                self._arming = now + ARMING
        if "mode" in command.pressed and self._swap is not None:
            self._swap()


# A terminal's keyboard, also over ssh; the terminal's settings are restored.


KEYBOARD_HELP = (
    "w s forward back | a d left right | r f up down | q e turn left, right | 1 2 3 precision, cruise, boost | "
    "space let go | enter arm, disarm | x emergency stop | k end a fault | m other pilot | Ctrl-C quit"
)
KEY_AXES = {
    "w": ("surge", 1.0),
    "s": ("surge", -1.0),
    "a": ("sway", 1.0),
    "d": ("sway", -1.0),
    "r": ("heave", 1.0),
    "f": ("heave", -1.0),
    "q": ("yaw", 1.0),
    "e": ("yaw", -1.0),
    "\x1b[A": ("surge", 1.0),
    "\x1b[B": ("surge", -1.0),
    "\x1b[D": ("yaw", 1.0),
    "\x1b[C": ("yaw", -1.0),
}
"""Key -> axis and deflection; the arrow keys drive and turn."""
KEY_BUTTONS = {"\r": "arm", "\n": "arm", "x": "stop", "k": "acknowledge", "m": "mode"}
GEAR_KEYS = {"1": "precision", "2": "cruise", "3": "boost"}


class Keys:
    """Keys that are held: a terminal reports presses and repeats, but no release.

    A key counts as held for `hold` seconds after its last press, which must be longer than the keyboard's repeat delay.
    This is also the dead-man switch: without pressed keys there is no thrust.
    """

    def __init__(self, hold: float = 0.6) -> None:
        """
        Args:
            hold: Time for which a key counts as held after its last press [s].
        """
        if not 0.0 < hold <= 2.0:
            raise TeleopError(f"hold is {hold:g} s, expected above 0 and at most 2 s")
        self.hold = hold
        self._pressed: dict[str, tuple[float, float]] = {}
        self._gear = "cruise"

    def press(self, now: float, key: str) -> None:
        """Note that a key was pressed, or repeats; unknown keys have no effect. `now` is the time [s]."""
        key = key if len(key) > 1 else key.lower()
        if key in KEY_AXES:
            axis, deflection = KEY_AXES[key]
            self._pressed[axis] = (now, deflection)
        elif key in KEY_BUTTONS:
            self._pressed[KEY_BUTTONS[key]] = (now, 1.0)
        elif key in GEAR_KEYS:
            self._gear = GEAR_KEYS[key]
        elif key == " ":
            self._pressed.clear()

    def hands(self, now: float) -> Hands:
        """Return the state of the held keys. `now` is the time [s]."""
        held = {name: value for name, (at, value) in self._pressed.items() if 0.0 <= now - at < self.hold}
        axes: dict[str, Any] = {name: held.get(name, 0.0) for name in ("surge", "sway", "heave", "yaw")}
        buttons: dict[str, Any] = {name: name in held for name in KEY_BUTTONS.values()}
        gear: dict[str, Any] = {name: self._gear == name for name in ("precision", "boost")}
        return Hands(**axes, **buttons, **gear, dead_man=any(axes.values()))


class Keyboard:
    """The terminal's keyboard.

    with Keyboard() as keyboard:
        hands = keyboard.read(now)
    """

    def __init__(self, stream: TextIO | None = None, hold: float = 0.6) -> None:
        """
        Args:
            stream: A terminal; standard input if None.
            hold: See `Keys` [s].

        Raises:
            TeleopError: Not a terminal.
        """
        stream = stream or sys.stdin
        if not stream.isatty():
            raise TeleopError(
                "the keyboard needs a terminal as standard input: run it in one, or use a gamepad"
            )
        self.keys = Keys(hold)
        self._descriptor = stream.fileno()
        self._before: list[Any] = []
        self._open = True

    def __enter__(self) -> Keyboard:
        try:
            import termios
            import tty
        except ImportError:
            _windows_keyboard()  # nothing to set up: its console reports keys as they are pressed
            return self
        self._before = termios.tcgetattr(self._descriptor)
        tty.setcbreak(self._descriptor)  # Ctrl-C still interrupts
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not self._before:
            return
        import termios

        try:
            termios.tcsetattr(self._descriptor, termios.TCSADRAIN, self._before)
        except termios.error:
            self._open = False  # the terminal is gone, so there is nothing to restore

    def pressed(self) -> list[str]:
        """Return the keys since the last call, arrows as their sequence of three characters; never waits."""
        if not self._before:
            return _windows_keys(_windows_keyboard())
        keys: list[str] = []
        while self._open and select.select([self._descriptor], [], [], 0.0)[0]:
            try:
                data = os.read(self._descriptor, 256)
            except OSError:
                data = b""
            self._open = bool(data)
            text = data.decode("utf-8", errors="ignore")
            while text:
                length = 3 if text[:3] in KEY_AXES else 1
                keys.append(text[:length])
                text = text[length:]
        return keys

    def read(self, now: float) -> Hands:
        """Return the state of the held keys; never waits. A terminal that was closed is a lost device.

        `now` is the time [s].
        """
        for key in self.pressed():
            self.keys.press(now, key)
        return self.keys.hands(now) if self._open else Hands(present=False)


WINDOWS_ARROWS = {"H": "\x1b[A", "P": "\x1b[B", "M": "\x1b[C", "K": "\x1b[D"}
"""Second character of an arrow key in Windows' console -> its sequence in a terminal."""


def _windows_keyboard() -> Any:
    """Return Windows' console module.

    Raises:
        TeleopError: This system has neither that nor termios.
    """
    try:
        import msvcrt
    except ImportError:
        raise TeleopError(
            "this Python reads no keyboard (it has neither termios nor msvcrt): use a gamepad"
        ) from None
    return msvcrt


def _windows_keys(console: Any) -> list[str]:
    """Return the keys pressed since the last call; the console marks a special key by a prefix."""
    keys = []
    while console.kbhit():
        key = console.getwch()
        if key == "\x03":
            raise KeyboardInterrupt
        keys.append(WINDOWS_ARROWS.get(console.getwch(), "") if key in "\x00\xe0" else key)
    return keys


# A gamepad through pygame; no window is opened.


GAMEPAD_HELP = (
    "hold LB to drive | left stick surge, sway | right stick yaw | RT LT up, down | RB precision | X boost | "
    "START arm, disarm | B emergency stop | Y end a fault | SELECT other pilot | Ctrl-C quit"
)
STICKS = {"left_x": 0, "left_y": 1, "left_trigger": 2, "right_x": 3, "right_trigger": 5}
"""Axes of pads of the Xbox family, numbered as in Linux."""
BUTTONS = {"stop": 1, "boost": 2, "acknowledge": 3, "dead_man": 4, "precision": 5, "mode": 6, "arm": 7}
"""Buttons of pads of the Xbox family."""
AXIS_COUNT, BUTTON_COUNT = 1 + max(STICKS.values()), 1 + max(BUTTONS.values())
"""Least numbers of axes and buttons of a pad."""


class Pad:
    """Axes and buttons of a pad as `Hands`."""

    def __init__(self) -> None:
        self._moved = set[int]()

    def hands(self, axes: Sequence[float], buttons: Sequence[Any]) -> Hands:
        """Return the pad's state, with SDL's signs: right and backwards are positive, a trigger goes from -1 to 1.

        Axes are in [-1, 1].
        """
        return Hands(
            surge=-axes[STICKS["left_y"]],
            sway=-axes[STICKS["left_x"]],
            heave=self._pulled(axes, STICKS["right_trigger"]) - self._pulled(axes, STICKS["left_trigger"]),
            yaw=-axes[STICKS["right_x"]],
            **{name: bool(buttons[number]) for name, number in BUTTONS.items()},
        )

    def _pulled(self, axes: Sequence[float], axis: int) -> float:
        """Return how far a trigger is pulled, [0, 1]; until its first motion it reports 0, half way, which is
        ignored."""
        if axes[axis] != 0.0:
            self._moved.add(axis)
        return (axes[axis] + 1.0) / 2.0 if axis in self._moved else 0.0


class Gamepad:
    """The first gamepad; one that is unplugged is lost, and found again when it is reconnected.

    with Gamepad() as pad:
        hands = pad.read()
    """

    def __init__(self) -> None:
        """
        Raises:
            TeleopError: No gamepad, or one with too few axes or buttons.
            ModuleNotFoundError: pygame is not installed.
        """
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
        os.environ.setdefault("SDL_JOYSTICK_ALLOW_BACKGROUND_EVENTS", "1")
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        import pygame

        self._pygame, self._device, self._pad = pygame, None, Pad()
        pygame.display.init()
        pygame.joystick.init()
        self._find()
        problem = "no gamepad is connected: plug one in, or use --device keyboard"
        if self._device is not None:
            axes, buttons = self._device.get_numaxes(), self._device.get_numbuttons()
            if axes >= AXIS_COUNT and buttons >= BUTTON_COUNT:
                return
            problem = (
                f"gamepad {self._device.get_name()} has {axes} axes and {buttons} buttons, expected {AXIS_COUNT} and "
                f"{BUTTON_COUNT}: use one of the Xbox family"
            )
        self.__exit__()
        raise TeleopError(problem)

    def __enter__(self) -> Gamepad:
        return self

    def __exit__(self, *error: object) -> None:
        self._device = None
        self._pygame.joystick.quit()
        self._pygame.display.quit()

    def read(self, now: float = 0.0) -> Hands:
        """Return the state of the pad; never waits. `now` is the time [s]."""
        for event in self._pygame.event.get():
            if event.type == self._pygame.JOYDEVICEREMOVED:
                self._device = None
            elif event.type == self._pygame.JOYDEVICEADDED and self._device is None:
                self._find()
        if self._device is None:
            return Hands(present=False)
        try:
            axes = [float(self._device.get_axis(i)) for i in range(AXIS_COUNT)]
            return self._pad.hands(axes, [self._device.get_button(i) for i in range(BUTTON_COUNT)])
        except self._pygame.error:  # it was disconnected between two events
            self._device = None
            return Hands(present=False)

    def _find(self) -> None:
        if self._pygame.joystick.get_count():
            self._device, self._pad = self._pygame.joystick.Joystick(0), Pad()


# Manual driving.


SHOWN_EVERY = 0.2
"""Time between two updates of the status line on the terminal [s]."""


@dataclass(frozen=True, kw_only=True)
class DriveSettings:
    """Settings of manual driving."""

    action: str | None = None
    """(MODE) Commands of the sticks or keys: wrench6, a wrench of the thrusters; for a vehicle with fins also surfaces,
    propellers and each fin by its effect on yaw and pitch, or course_pitch, speed, course and pitch by the autopilot,
    while the state is known. If not given: surfaces for a vehicle with fins, otherwise wrench6."""
    rate: Annotated[float, (20.0, 200.0)] = 60.0
    """Rate of the loop [Hz]."""
    duration: Annotated[float | None, (0.0, None)] = None
    """Duration [s]; until Ctrl-C if not given."""


class Handover(NamedTuple):
    """Controller to which the mode button hands over."""

    pilot: Pilot
    guide: Guide
    """Guide of the controller."""


def drive(
    vehicle: Vehicle,
    device: Device,
    connection: RobotDriver,
    *,
    settings: DriveSettings = DriveSettings(),
    pool: Pool | None = None,
    recorder: Recorder | None = None,
    handover: Handover | None = None,
    show: Callable[[Runtime, Operator], None] = lambda runtime, operator: None,
) -> Runtime:
    """Drive until the time is over or Ctrl-C; the vehicle starts disarmed, and ends with frames without thrust.

    Args:
        vehicle: Vehicle.
        device: The operator's input device.
        connection: Driver that runs the robot's software on its connections.
        settings: Action mode of the operator, rate of the loop and duration.
        pool: Camera, water and frames; None: the vehicle is driven, and armed, without localization.
        recorder: Recorder of everything, if any.
        handover: Controller to which the mode button hands over; None: there is none.
        show: Called in every step.
    """

    def swap() -> None:
        if handover is not None:
            switch.select("other" if switch.mode == "person" else "person")

    operator = Operator(device, swap=swap)
    action = settings.action or ("surfaces" if vehicle.actuators else "wrench6")
    rate, duration = settings.rate, math.inf if settings.duration is None else settings.duration
    person: Pilot
    if action == "wrench6":
        person = WrenchPilot(operator.wrench, vehicle, period=1.0 / rate)
    else:
        person = HelmPilot(operator.deflection, vehicle, action, period=1.0 / rate)
    switch = ModeSwitch({"person": person, **({} if handover is None else {"other": handover.pilot})})
    runtime = Runtime(
        vehicle,
        Unlocated(vehicle) if pool is None and not person.needs_state else Perception(vehicle, pool),
        switch,
        Station((0.0, 0.0, 0.0), 0.0) if handover is None else handover.guide,
        bridge=Bridge(vehicle, BridgeSettings.of(vehicle, need_reading=False)),
        recorder=recorder,
    )

    def turn(running: Runtime) -> None:
        if running.reading is not None:
            before = switch.mode
            operator.turn(running.reading.time, running.bridge)
            if recorder is not None and switch.mode != before:
                recorder.event(running.reading.time, "mode", switch.mode)
        show(running, operator)

    connection(runtime, rate=rate, duration=duration, show=turn, until=lambda running: False)
    return runtime


@dataclass(frozen=True, kw_only=True)
class DriveWiring:
    """Connection of the driven vehicle, and its overhead camera."""

    robot: str = "pool"
    """(WIRE) Link to the motor controller: udp://HOST:PORT, serial:DEVICE, or pool (the virtual
    pool on this machine); or to an autopilot: mavlink or mavlink://KIND:ADDRESS, as in finssim run."""
    bind: str = "127.0.0.1:54321"
    """(ADDRESS:PORT) Local address and port, for UDP."""
    pool_file: Path | None = None
    """(FILE) Pool file: camera, water plane and frames (.yaml); without it the position is unknown."""
    pictures: str | None = None
    """(ADDRESS) Overhead camera: udp://HOST:PORT or none; the virtual pool's with --robot pool,
    otherwise none, if not given. Needs --pool-file."""

    def pool(self) -> Pool | None:
        """Return the pool of the file; None without one.

        Raises:
            LocalizationError: The file is invalid.
            TeleopError: Pictures are requested without it.
        """
        if self.pool_file is not None:
            return load_pool(self.pool_file)
        if self.pictures is not None:
            raise TeleopError("--pictures needs the camera's pose: give --pool-file, too")
        return None


def run(
    *,
    vehicle: str = "finsrov",
    device: str = "gamepad",
    wiring: Annotated[DriveWiring, "options"] = DriveWiring(),
    policy: str | None = None,
    goal: str | None = None,
    record: Path | None = None,
    key_hold: float = 0.6,
    settings: Annotated[DriveSettings, "options"] = DriveSettings(),
) -> None:
    """Drive by hand. Starts disarmed; START or enter arms; thrust needs LB or a key held.

    Example: finssim teleop --device keyboard --robot pool --record drive.mcap

    Args:
        vehicle (NAME|FILE): Vehicle in the catalogue, or path of a vehicle file.
        device (NAME): Input device: gamepad or keyboard.
        wiring: Connection of the vehicle and its camera.
        policy (DIR|pid): Controller to which SELECT or m hands over: pid, or a policy's directory. Needs
            --pool-file and --goal.
        goal (X,Y,Z,YAW): Goal of the policy, x,y,z,yaw [m, deg].
        record (FILE): Record of the run to write (.mcap).
        key_hold (S): Time for which a key counts as held after its last press [s].
        settings: What the person commands, the rate of the loop and its duration.

    Raises:
        TeleopError, ControlError, LinkError, VehicleError, LocalizationError, PolicyError, OutputError: What cannot be
            used.
    """
    body, pool = load_vehicle(vehicle), wiring.pool()
    handover = _handover(policy, goal, body, pool)
    with ExitStack() as stack:
        if device == "keyboard":
            hands, keys = stack.enter_context(Keyboard(hold=key_hold)), KEYBOARD_HELP
        elif device == "gamepad":
            hands, keys = stack.enter_context(Gamepad()), GAMEPAD_HELP
        else:
            raise TeleopError(f"unknown device '{device}': expected gamepad or keyboard")
        wires = Wiring(robot=wiring.robot, bind=wiring.bind, pictures=wiring.pictures)
        connection = stack.enter_context(connected(wires, body, pool))
        meta = {"command": "finssim teleop", "robot": wiring.robot}
        recorder = stack.enter_context(recording(record, body, meta, pool_file=wiring.pool_file))
        print(keys, file=sys.stderr)
        drive(
            body, hands, connection, settings=settings, pool=pool, recorder=recorder, handover=handover,
            show=_status_line(),
        )  # fmt: skip
        print(file=sys.stderr)


def _handover(policy: str | None, goal: str | None, vehicle: Vehicle, pool: Pool | None) -> Handover | None:
    """Return the controller to which the operator hands over, with its guide; None without one."""
    if policy is None:
        if goal is not None:
            raise TeleopError("--goal is where a controller steers to: give --policy, too, or omit it")
        return None
    if pool is None or goal is None:
        raise TeleopError(
            "a controller to hand over to needs a state and a goal: give --pool-file and --goal"
        )
    station = station_of(goal)
    check_reachable(station, vehicle)
    return Handover(make_pilot(policy, vehicle), station)


def _status_line() -> Callable[[Runtime, Operator], None]:
    """Return a function that updates one line on the terminal: state, gear, wrench, and messages."""
    newest = -math.inf

    def show(runtime: Runtime, operator: Operator) -> None:
        nonlocal newest
        now = runtime.reading.time if runtime.reading is not None else -math.inf
        if now - newest < SHOWN_EVERY:
            return
        newest = now
        x, y, z, _, _, n = operator.command.wrench
        problem = runtime.recorder.problem if runtime.recorder is not None else ""
        message = problem or runtime.bridge.reason or operator.message
        line = f"{runtime.bridge.state:8} {operator.command.gear:9} surge {x:5.1f} sway {y:5.1f} heave {z:5.1f} N "
        print(f"\r{line}yaw {n:5.2f} N m  {message}\x1b[K", end="", file=sys.stderr, flush=True)

    return show
