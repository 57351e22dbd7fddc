"""A terminal's keyboard as teleoperation device, also over ssh; the terminal is put back as it was."""

from __future__ import annotations

import os
import select
import sys
from types import TracebackType
from typing import Any, TextIO

from finssim.robot.teleop import Hands, TeleopError

__all__ = ["HELP", "Keyboard", "Keys"]

HELP = (
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

BUTTONS = {"\r": "arm", "\n": "arm", "x": "stop", "k": "acknowledge", "m": "mode"}
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
        elif key in BUTTONS:
            self._pressed[BUTTONS[key]] = (now, 1.0)
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
