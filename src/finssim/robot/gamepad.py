"""A gamepad as teleoperation device, through pygame; no window is opened."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

from finssim.robot.teleop import Hands, TeleopError

__all__ = ["HELP", "XBOX", "Gamepad", "Layout"]

HELP = (
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
        return 1 + max(self.left_x, self.left_y, self.right_x, self.left_trigger, self.right_trigger)

    @property
    def buttons(self) -> int:
        """How many buttons a pad has to have."""
        return 1 + max(
            self.dead_man, self.precision, self.boost, self.arm, self.stop, self.acknowledge, self.mode
        )


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
        self._moved: set[int] = set()
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
            self._moved.clear()

    def _hands(self) -> Hands:
        pad, at = self._pad, self.layout

        def held(button: int) -> bool:
            return bool(pad.get_button(button))

        return Hands(
            surge=-pad.get_axis(at.left_y),
            sway=-pad.get_axis(at.left_x),
            heave=self._trigger(at.right_trigger) - self._trigger(at.left_trigger),
            yaw=-pad.get_axis(at.right_x),
            dead_man=held(at.dead_man),
            precision=held(at.precision),
            boost=held(at.boost),
            arm=held(at.arm),
            stop=held(at.stop),
            acknowledge=held(at.acknowledge),
            mode=held(at.mode),
        )

    def _trigger(self, axis: int) -> float:
        """How far a trigger is pulled, [0, 1]; SDL shows 0, which is half way, until it is moved for the first time."""
        value = float(self._pad.get_axis(axis))
        if value != 0.0:
            self._moved.add(axis)
        return (value + 1.0) / 2.0 if axis in self._moved else 0.0
