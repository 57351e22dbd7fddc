"""Keys of a terminal count as held briefly after each press, are read without waiting, and leave the terminal
restored."""

import io
import os
import pty
import sys
import termios

import pytest

from finssim.robot.teleop import Keyboard, Keys, TeleopError

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="terminals of Unix")


@pytest.fixture
def terminal():
    """The keyboard's and the terminal's end of a pseudo terminal."""
    ours, theirs = pty.openpty()
    with os.fdopen(theirs, "r", closefd=True) as stream:
        yield ours, stream
    try:
        os.close(ours)
    except OSError:
        pass


def test_a_key_counts_as_held_for_a_moment():
    """The short hold acts as a dead-man switch: no key presses, no thrust."""
    keys = Keys(hold=0.6)
    keys.press(1.0, "w")
    keys.press(1.1, "q")
    both, late, gone = keys.hands(1.2), keys.hands(1.65), keys.hands(1.75)
    assert (both.surge, both.yaw, both.dead_man) == (1.0, 1.0, True)
    assert (late.surge, late.yaw, late.dead_man) == (0.0, 1.0, True)
    assert (gone.yaw, gone.dead_man) == (0.0, False)


@pytest.mark.parametrize(
    ("key", "axis", "value"),
    [
        ("w", "surge", 1), ("s", "surge", -1), ("a", "sway", 1), ("d", "sway", -1), ("r", "heave", 1),
        ("f", "heave", -1), ("q", "yaw", 1), ("e", "yaw", -1), ("W", "surge", 1), ("\x1b[C", "yaw", -1),
    ],
)  # fmt: skip
def test_keys_push_along_body_axes(key, axis, value):
    """Forward, left, up and turning left are positive."""
    keys = Keys()
    keys.press(0.0, key)
    assert getattr(keys.hands(0.1), axis) == value


def test_the_opposite_key_takes_over_and_space_lets_go():
    keys = Keys()
    keys.press(0.0, "w")
    keys.press(0.1, "s")
    assert keys.hands(0.1).surge == -1.0
    keys.press(0.2, " ")
    assert keys.hands(0.2).surge == 0.0 and not keys.hands(0.2).dead_man


def test_gears_stay_and_buttons_do_not():
    keys = Keys()
    for key in ("1", "\r", "x", "k", "m", "?"):
        keys.press(0.0, key)
    hands = keys.hands(0.1)
    assert hands.precision and hands.arm and hands.stop and hands.acknowledge and hands.mode
    later = keys.hands(5.0)
    assert later.precision and not (later.arm or later.stop)
    keys.press(6.0, "3")
    assert keys.hands(6.0).boost and not keys.hands(6.0).precision


def test_a_held_enter_is_one_press():
    """Enter repeats thirty times a second, but the vehicle is armed once."""
    keys = Keys()
    shown = []
    for i in range(30):
        keys.press(1.0 + i / 30.0, "\r")
        shown.append(keys.hands(1.0 + i / 30.0).arm)
    assert all(shown)


def test_the_terminal_is_read_without_waiting_and_put_back(terminal):
    """Line buffering and echo are off while reading and restored afterwards."""
    ours, stream = terminal
    before = termios.tcgetattr(stream.fileno())
    with Keyboard(stream) as keyboard:
        assert termios.tcgetattr(stream.fileno())[3] & (termios.ICANON | termios.ECHO) == 0
        assert termios.tcgetattr(stream.fileno())[3] & termios.ISIG, "Ctrl-C must interrupt"
        assert not keyboard.read(0.0).dead_man
        os.write(ours, b"w\x1b[D1")
        hands = keyboard.read(0.1)
        assert (hands.surge, hands.yaw, hands.precision) == (1.0, 1.0, True)
    assert termios.tcgetattr(stream.fileno()) == before


def test_the_terminal_is_put_back_after_an_error(terminal):
    _, stream = terminal
    before = termios.tcgetattr(stream.fileno())
    with pytest.raises(RuntimeError), Keyboard(stream):
        raise RuntimeError
    assert termios.tcgetattr(stream.fileno()) == before


def test_a_closed_terminal_is_a_lost_device(terminal):
    """A closed terminal, as when the ssh connection breaks, counts as a lost device."""
    ours, stream = terminal
    with Keyboard(stream) as keyboard:
        os.write(ours, b"w")
        assert keyboard.read(0.0).present
        os.close(ours)
        assert not keyboard.read(0.1).present


def test_what_is_no_terminal_is_refused():
    with pytest.raises(TeleopError, match="needs a terminal"):
        Keyboard(io.StringIO())
    with pytest.raises(TeleopError, match="hold is 0 s"):
        Keys(0.0)
