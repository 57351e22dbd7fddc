"""A gamepad through pygame; SDL's virtual joystick replaces the hardware."""

import ctypes
import os
from pathlib import Path

import pytest

pytest.importorskip("pygame")
import pygame

from finssim.robot.teleop import BUTTONS, STICKS, Gamepad, TeleopError

GAME_CONTROLLER = 1
"""SDL_JOYSTICK_TYPE_GAMECONTROLLER"""


def sdl():
    """The SDL library that pygame has loaded."""
    folder = Path(pygame.__file__).resolve().parents[1] / "pygame.libs"
    found = sorted(folder.glob("libSDL2-2*"))
    if not found:
        pytest.skip("pygame's own SDL is not there")
    library = ctypes.CDLL(str(found[0]))
    library.SDL_JoystickOpen.restype = ctypes.c_void_p
    library.SDL_JoystickSetVirtualAxis.argtypes = [ctypes.c_void_p, ctypes.c_int, ctypes.c_int16]
    library.SDL_JoystickSetVirtualButton.argtypes = [ctypes.c_void_p, ctypes.c_int, ctypes.c_uint8]
    return library


class Plastic:
    """A virtual gamepad that a test operates."""

    def __init__(self, axes=6, buttons=11):
        os.environ["SDL_VIDEODRIVER"] = "dummy"
        pygame.display.init()
        pygame.joystick.init()
        self.sdl = sdl()
        self.index = self.sdl.SDL_JoystickAttachVirtual(GAME_CONTROLLER, axes, buttons, 0)
        if self.index < 0:
            pytest.skip("this SDL has no virtual joysticks")
        self.joystick = self.sdl.SDL_JoystickOpen(self.index)

    def axis(self, number, value):
        self.sdl.SDL_JoystickSetVirtualAxis(self.joystick, number, round(32767 * value))

    def button(self, number, down=True):
        self.sdl.SDL_JoystickSetVirtualButton(self.joystick, number, int(down))

    def unplug(self):
        self.sdl.SDL_JoystickDetachVirtual(self.index)


@pytest.fixture
def plastic():
    pad = Plastic()
    yield pad
    pygame.joystick.quit()
    pygame.display.quit()


def test_sticks_and_triggers_push_along_body_axes(plastic):
    """Stick forward is surge, stick left is sway and yaw to the left, the right trigger is up."""
    with Gamepad() as pad:
        pad.read()
        for axis, value in (
            (STICKS["left_y"], -1.0),
            (STICKS["left_x"], -0.5),
            (STICKS["right_x"], 1.0),
            (STICKS["right_trigger"], 1.0),
        ):
            plastic.axis(axis, value)
        plastic.axis(STICKS["left_trigger"], -1.0)
        plastic.button(BUTTONS["dead_man"])
        hands = pad.read()
    assert hands.surge == pytest.approx(1.0, abs=1e-3) and hands.sway == pytest.approx(0.5, abs=1e-3)
    assert hands.yaw == pytest.approx(-1.0, abs=1e-3) and hands.heave == pytest.approx(1.0, abs=1e-3)
    assert hands.dead_man and not (hands.arm or hands.stop)


@pytest.mark.parametrize("name", ["dead_man", "precision", "boost", "arm", "stop", "acknowledge", "mode"])
def test_each_button_does_one_thing(plastic, name):
    with Gamepad() as pad:
        plastic.button(BUTTONS[name])
        hands = pad.read()
    shown = {
        n: getattr(hands, n) for n in ("dead_man", "precision", "boost", "arm", "stop", "acknowledge", "mode")
    }
    assert [n for n, down in shown.items() if down] == [name]


def test_a_trigger_that_nobody_touched_pushes_nothing(plastic):
    """SDL reports 0 for a trigger until it moves, which would be half a pull."""
    with Gamepad() as pad:
        assert pad.read().heave == 0.0


def test_a_pulled_plug_is_a_lost_device(plastic):
    with Gamepad() as pad:
        assert pad.read().present
        plastic.unplug()
        assert not pad.read().present


def test_pads_with_too_few_buttons_and_none_at_all_are_refused():
    os.environ["SDL_VIDEODRIVER"] = "dummy"
    with pytest.raises(TeleopError, match="no gamepad is connected: plug one in, or use --device keyboard"):
        Gamepad()
    Plastic(axes=2, buttons=2)
    with pytest.raises(TeleopError, match="has 2 axes and 2 buttons, expected 6 and 8"):
        Gamepad()
