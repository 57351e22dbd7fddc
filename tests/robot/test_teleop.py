"""Hand inputs become a wrench: published gears, dead-man, button edges, lost devices; an operator with a
bridge."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from finssim.robot.bridge import Bridge, BridgeSettings
from finssim.robot.messages import Telemetry
from finssim.robot.teleop import ARMING, GEARS, LOST, Hands, Operator, shaped
from finssim.vehicles import load_vehicle

VEHICLE = load_vehicle("finsrov")
FULL = Hands(surge=1.0, sway=-1.0, heave=1.0, yaw=-1.0, dead_man=True)


class Shown:
    """A device with scripted inputs."""

    hands = Hands()

    def read(self, now):
        return self.hands


def looks(*shown):
    """Return the command after each poll at (time [s], hands)."""
    operator = Operator(Shown())
    commands = []
    for now, operator.device.hands in shown:
        commands.append(operator.look(now))
    return commands


def looked(*shown):
    """Return the last command after polling these 0.1 s apart, beginning with hands at rest."""
    return looks(*((0.1 * i, hands) for i, hands in enumerate((Hands(), *shown))))[-1]


@pytest.mark.parametrize(
    ("hands", "gear"),
    [
        (FULL, "cruise"),
        (replace(FULL, boost=True), "boost"),
        (replace(FULL, precision=True), "precision"),
        (replace(FULL, precision=True, boost=True), "precision"),
    ],
)
def test_full_deflection_gives_the_published_gear(hands, gear):
    """Cruise 6/4/5/0.8, precision 2/1.5/1.5/0.25, boost 10/7/8/1.2 N and N m; never a roll or pitch moment."""
    command = looked(hands)
    x, y, z, n = GEARS[gear]
    assert command.gear == gear
    assert command.wrench == pytest.approx([x, -y, z, 0.0, 0.0, -n])


def test_without_the_dead_man_there_is_no_thrust():
    assert not looked(replace(FULL, dead_man=False)).wrench.any()


def test_the_emergency_stop_leaves_no_thrust():
    command = looked(replace(FULL, stop=True))
    assert command.stop and not command.wrench.any()


def test_a_press_toggles_once_however_long_it_lasts():
    """Arm, acknowledge and mode are edges; the stop is not."""
    down = Hands(arm=True, acknowledge=True, mode=True)
    first, held = looked(down), looked(down, down)
    assert first.pressed == {"arm", "acknowledge", "mode"} and not held.pressed
    assert "arm" in looked(down, Hands(), down).pressed


def test_a_button_that_hangs_at_the_start_arms_nothing():
    commands = looks((0.0, Hands(arm=True)), (0.1, Hands(arm=True)))
    assert not any(command.pressed for command in commands)


def test_a_lost_device_gives_zeros_and_its_return_arms_nothing():
    _, driven, lost, back = looks(
        (0.0, Hands()), (0.1, FULL), (0.2, Hands(present=False)), (0.3, replace(FULL, arm=True))
    )
    assert driven.wrench.any() and lost.lost and not lost.wrench.any()
    assert not (back.lost or back.pressed or back.wrench.any())


def test_silence_counts_as_loss_after_half_a_second():
    """Until then the last inputs remain in force."""
    *_, silent, lost = looks((0.0, Hands()), (0.1, FULL), (0.5, None), (0.15 + LOST, None))
    assert silent.wrench.any() and lost.lost


@given(st.floats(-1.0, 1.0), st.floats(0.0, 0.5), st.floats(0.0, 1.0))
def test_the_answer_grows_with_the_deflection(deflection, dead_band, expo):
    """The response is odd, monotone, zero within the dead band and full at the end."""
    (answer, mirrored, more, full) = shaped(
        np.array([deflection, -deflection, min(deflection + 0.01, 1.0), 1.0]), dead_band, expo
    )
    assert answer == pytest.approx(-mirrored) and more >= answer - 1e-12 and full == pytest.approx(1.0)
    if abs(deflection) <= dead_band:
        assert answer == 0.0


def test_numbers_that_are_none_push_nothing():
    assert not shaped(np.array([math.nan, 0.0, 0.0, 0.0])).any()


class Drive:
    """An operator with a bridge that receives telemetry."""

    def __init__(self):
        self.device = Shown()
        self.operator = Operator(self.device)
        self.bridge = Bridge(VEHICLE, BridgeSettings.of(VEHICLE, need_reading=False))
        self.i = 0

    def turn(self, hands=None, turns=1):
        """Advance some turns of 20 ms and return the last frame."""
        for _ in range(turns):
            self.i += 1
            now = 0.02 * self.i
            noise = 1e-3 * math.sin(7.0 * self.i)
            self.bridge.telemetry(
                now,
                Telemetry(
                    self.i,
                    20 * self.i,
                    (0.0, 0.0, 0.0, 1.0),
                    (noise,) * 3,
                    (noise, 0.0, 9.81),
                    0.5,
                    1e5,
                    0,
                    None,
                ),
            )
            self.device.hands = hands or self.device.hands
            self.operator.turn(now, self.bridge)
            force = np.full(8, 0.5 * np.abs(self.operator.wrench()).max())
            self.bridge.command(now, force, "teleop")
            frame = self.bridge.tick(now)
        return frame


def test_a_drive_from_arming_to_the_emergency_stop():
    """A drive starts disarmed; only a press arms, the stop faults, and only after acknowledgement a press
    arms again."""
    drive = Drive()
    assert not drive.turn(FULL, 10).enable and drive.bridge.state == "disarmed"
    drive.turn(replace(FULL, arm=True))
    assert drive.bridge.state == "disarmed" and "release the sticks" in drive.operator.message
    drive.turn(Hands(), 2)
    drive.turn(Hands(arm=True))
    assert drive.bridge.state == "armed", drive.operator.message
    assert any(drive.turn(FULL, 20).normalised)
    stopped = drive.turn(replace(FULL, stop=True))
    assert drive.bridge.state == "fault" and not stopped.enable and not any(stopped.normalised)
    drive.turn(Hands())
    drive.turn(Hands(arm=True))
    assert drive.bridge.state == "fault" and "acknowledge the fault first" in drive.operator.message
    drive.turn(Hands())
    drive.turn(Hands(acknowledge=True))
    assert drive.bridge.state == "disarmed"
    drive.turn(Hands())
    drive.turn(Hands(arm=True))
    assert drive.bridge.state == "armed"
    drive.turn(Hands())
    drive.turn(Hands(arm=True))
    assert drive.bridge.state == "disarmed", "the second press disarms"


def test_the_mode_button_hands_over_once_a_press():
    swaps = []
    device = Shown()
    operator = Operator(device, swap=lambda: swaps.append(1))
    bridge = Bridge(VEHICLE)
    for i, hands in enumerate([Hands(), Hands(mode=True), Hands(mode=True), Hands()]):
        device.hands = hands
        operator.turn(0.1 * i, bridge)
    assert len(swaps) == 1


def test_an_unplugged_pad_disarms():
    drive = Drive()
    drive.turn(Hands(), 10)
    drive.turn(Hands(arm=True))
    assert drive.bridge.state == "armed"
    frame = drive.turn(Hands(present=False))
    assert drive.bridge.state == "disarmed" and not frame.enable and "lost" in drive.operator.message
    assert not drive.turn(replace(FULL, arm=True), 5).enable


class SlowAutopilot:
    """An autopilot that arms after several requests and never pauses or raises an alarm."""

    peer, watched = "autopilot", (("gyro",),)

    def __init__(self, asks):
        self.asks = asks

    def prepare(self, now):
        self.asks -= 1
        return "waiting for it to arm" if self.asks > 0 else ""

    def alarm(self, now):
        return ""

    def pause(self, now):
        return ""


@pytest.mark.parametrize(
    ("asks", "meanwhile", "state"),
    [
        (40, Hands(), "armed"),
        (round(1.1 * ARMING / 0.02), Hands(), "disarmed"),
        (40, FULL, "disarmed"),
        (40, Hands(stop=True), "fault"),
        (40, Hands(present=False), "disarmed"),
        (40, Hands(arm=True), "disarmed"),
    ],
    ids=["one press", "too slow", "sticks moved", "emergency stop", "device lost", "second press"],
)
def test_one_press_waits_for_an_autopilot_to_arm(asks, meanwhile, state):
    """The request is repeated until the autopilot is ready or time is up; any other input cancels the wait."""
    drive = Drive()
    drive.bridge.autopilot = SlowAutopilot(asks)
    drive.turn(Hands(), 2)
    drive.turn(Hands(arm=True))
    assert drive.bridge.state == "disarmed" and "waiting" in drive.operator.message
    drive.turn(Hands(), 10)
    drive.turn(meanwhile)
    drive.turn(Hands(), round(1.2 * ARMING / 0.02))
    assert drive.bridge.state == state, drive.operator.message
