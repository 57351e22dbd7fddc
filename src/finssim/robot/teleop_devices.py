"""What a person drives with: a terminal's keyboard, also over ssh, and a gamepad through pygame, without a window."""

from __future__ import annotations

import os
import select
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any, TextIO

from finssim.robot.teleop import Hands, TeleopError

__all__ = ["GAMEPAD_HELP", "KEYBOARD_HELP", "XBOX", "Gamepad", "Keyboard", "Keys", "Layout", "Pad"]


# A terminal's keyboard as teleoperation device, also over ssh; the terminal is put back as it was.


KEYBOARD_HELP = (
    "w s forward back | a d left right | r f up down | q e turn left, right | 1 2 3 precision, cruise, boost | "
    "space let go | enter arm, disarm | x emergency stop | k end a fault | m other pilot | Ctrl-C quit"
)

AXES = {
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
"""Key -> axis and deflection; the arrows drive and turn."""

KEY_BUTTONS = {"\r": "arm", "\n": "arm", "x": "stop", "k": "acknowledge", "m": "mode"}
GEAR_KEYS = {"1": "precision", "2": "cruise", "3": "boost"}


class Keys:
    """Which keys are held: a terminal tells presses and repeats, but no release.

    A key counts as held for `hold` seconds after its last press, which has to be longer than the keyboard waits before
    it repeats. That is the dead-man switch too: nobody at the keys, no thrust.
    """

    def __init__(self, hold: float = 0.6) -> None:
        """Args:
        hold: [s]
        """
        if not 0.0 < hold <= 2.0:
            raise TeleopError(f"hold is {hold:g} s, expected above 0 and at most 2 s")
        self.hold = hold
        self._pressed: dict[str, tuple[float, float]] = {}
        self._gear = "cruise"

    def press(self, now: float, key: str) -> None:
        """A key was pressed, or repeats; unknown keys do nothing."""
        key = key if key in AXES or len(key) > 1 else key.lower()
        if key in AXES:
            axis, deflection = AXES[key]
            self._pressed[axis] = (now, deflection)
        elif key in KEY_BUTTONS:
            self._pressed[KEY_BUTTONS[key]] = (now, 1.0)
        elif key in GEAR_KEYS:
            self._gear = GEAR_KEYS[key]
        elif key == " ":
            self._pressed.clear()

    def hands(self, now: float) -> Hands:
        """What is held now."""
        held = {name: value for name, (at, value) in self._pressed.items() if 0.0 <= now - at < self.hold}
        axes: dict[str, Any] = {name: held.get(name, 0.0) for name in ("surge", "sway", "heave", "yaw")}
        buttons: dict[str, Any] = {name: name in held for name in ("arm", "stop", "acknowledge", "mode")}
        return Hands(
            **axes,
            **buttons,
            dead_man=any(axes.values()),
            precision=self._gear == "precision",
            boost=self._gear == "boost",
        )


class Keyboard:
    """The terminal's keyboard.

    with Keyboard() as keyboard:
        hands = keyboard.read(now)
    """

    def __init__(self, stream: TextIO | None = None, hold: float = 0.6) -> None:
        """Args:
            stream: A terminal; standard input if None.
            hold: See `Keys` [s].

        Raises:
            TeleopError: Not a terminal.
        """
        self._stream = stream or sys.stdin
        if not self._stream.isatty():
            raise TeleopError(
                "the keyboard needs a terminal as standard input: run it in one, or use a gamepad"
            )
        self.keys = Keys(hold)
        self._descriptor = self._stream.fileno()
        self._before: list[Any] | None = None
        self._open = True

    def __enter__(self) -> Keyboard:
        import termios
        import tty

        self._before = termios.tcgetattr(self._descriptor)
        tty.setcbreak(self._descriptor)  # Ctrl-C still interrupts
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def pressed(self) -> list[str]:
        """Keys since the last call; never waits."""
        keys: list[str] = []
        while self._open and select.select([self._descriptor], [], [], 0.0)[0]:
            try:
                data = os.read(self._descriptor, 256)
            except OSError:
                data = b""
            self._open = bool(data)
            keys += _keys(data.decode("utf-8", errors="ignore"))
        return keys

    def read(self, now: float) -> Hands:
        """What is held now; never waits. A terminal that was closed is a device that is lost."""
        for key in self.pressed():
            self.keys.press(now, key)
        return self.keys.hands(now) if self._open else Hands(present=False)

    def close(self) -> None:
        """Put the terminal back as it was."""
        import termios

        if self._before is not None:
            try:
                termios.tcsetattr(self._descriptor, termios.TCSADRAIN, self._before)
            except termios.error:
                self._open = False  # the terminal is gone, and nothing is left to put back
            self._before = None


def _keys(text: str) -> list[str]:
    """Single keys, arrows as their sequence of three characters."""
    keys = []
    while text:
        length = 3 if text[:3] in AXES else 1
        keys.append(text[:length])
        text = text[length:]
    return keys


# A gamepad as teleoperation device, through pygame; no window is opened.


GAMEPAD_HELP = (
    "hold LB to drive | left stick surge, sway | right stick yaw | RT LT up, down | RB precision | X boost | "
    "START arm, disarm | B emergency stop | Y end a fault | SELECT other pilot | Ctrl-C quit"
)


@dataclass(frozen=True)
class Layout:
    """Numbers that the system gives to axes and buttons."""

    left_x: int
    left_y: int
    right_x: int
    left_trigger: int
    right_trigger: int
    dead_man: int
    precision: int
    boost: int
    arm: int
    stop: int
    acknowledge: int
    mode: int

    @property
    def axes(self) -> int:
        """How many axes a pad has to have."""
        return 1 + max(getattr(self, name) for name in STICKS)

    @property
    def buttons(self) -> int:
        """How many buttons a pad has to have."""
        return 1 + max(getattr(self, name) for name in BUTTONS)


STICKS = ("left_x", "left_y", "right_x", "left_trigger", "right_trigger")
BUTTONS = ("dead_man", "precision", "boost", "arm", "stop", "acknowledge", "mode")
"""Fields of a layout."""

XBOX = Layout(
    left_x=0,
    left_y=1,
    left_trigger=2,
    right_x=3,
    right_trigger=5,
    stop=1,
    boost=2,
    acknowledge=3,
    dead_man=4,
    precision=5,
    mode=6,
    arm=7,
)
"""Pads of the Xbox family under Linux."""


class Pad:
    """Axes and buttons of a pad as `Hands`."""

    def __init__(self, layout: Layout = XBOX) -> None:
        self.layout, self._moved = layout, set[int]()

    def hands(self, axes: Sequence[float], buttons: Sequence[Any]) -> Hands:
        """What the pad shows, as SDL has it: right and backwards are positive, a trigger goes from -1 to 1."""
        at = self.layout
        return Hands(
            surge=-axes[at.left_y],
            sway=-axes[at.left_x],
            heave=self._pulled(axes, at.right_trigger) - self._pulled(axes, at.left_trigger),
            yaw=-axes[at.right_x],
            **{name: bool(buttons[getattr(at, name)]) for name in BUTTONS},
        )

    def _pulled(self, axes: Sequence[float], axis: int) -> float:
        """How far a trigger is pulled, [0, 1]; 0, which is half way, is shown until it is moved for the first time."""
        if axes[axis] != 0.0:
            self._moved.add(axis)
        return (axes[axis] + 1.0) / 2.0 if axis in self._moved else 0.0


class Gamepad:
    """The first gamepad; one that is unplugged is lost, and found again when it comes back.

    with Gamepad() as pad:
        hands = pad.read()
    """

    def __init__(self, layout: Layout = XBOX) -> None:
        """Raises:
        TeleopError: No gamepad, or one with too few axes or buttons.
        ModuleNotFoundError: pygame is not installed.
        """
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
        os.environ.setdefault("SDL_JOYSTICK_ALLOW_BACKGROUND_EVENTS", "1")
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        import pygame

        self.layout = layout
        self._pygame = pygame
        pygame.display.init()
        pygame.joystick.init()
        self._pad: Any = None
        self._find()
        if self._pad is None:
            self.close()
            raise TeleopError("no gamepad is connected: plug one in, or use --device keyboard")
        if self._pad.get_numaxes() < layout.axes or self._pad.get_numbuttons() < layout.buttons:
            told = f"{self._pad.get_numaxes()} axes and {self._pad.get_numbuttons()} buttons"
            name = self._pad.get_name()
            self.close()
            raise TeleopError(
                f"gamepad {name} has {told}, expected {layout.axes} and {layout.buttons}: use one of the Xbox family"
            )

    def __enter__(self) -> Gamepad:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def read(self, now: float = 0.0) -> Hands:
        """What the pad shows; never waits."""
        for event in self._pygame.event.get():
            if event.type == self._pygame.JOYDEVICEREMOVED:
                self._pad = None
            elif event.type == self._pygame.JOYDEVICEADDED and self._pad is None:
                self._find()
        if self._pad is None:
            return Hands(present=False)
        try:
            return self._hands()
        except self._pygame.error:  # it went between two events
            self._pad = None
            return Hands(present=False)

    def close(self) -> None:
        """Let go of the pad."""
        self._pad = None
        self._pygame.joystick.quit()
        self._pygame.display.quit()

    def _find(self) -> None:
        if self._pygame.joystick.get_count():
            self._pad = self._pygame.joystick.Joystick(0)
            self._shown = Pad(self.layout)

    def _hands(self) -> Hands:
        axes = [float(self._pad.get_axis(i)) for i in range(self.layout.axes)]
        return self._shown.hands(axes, [self._pad.get_button(i) for i in range(self.layout.buttons)])
