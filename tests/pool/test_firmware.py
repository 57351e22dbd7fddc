"""The motor controller's firmware, tested through its input and output bytes."""

import numpy as np
import pytest

from finssim.pool import draw_plant
from finssim.pool.firmware import Firmware, FirmwareSample
from finssim.pool.plant import RPM
from finssim.robot.links.frames import (
    HOST,
    Decoder,
    RejectFlag,
    StatusFlag,
    command_count,
    crc16_modbus,
    encode_command,
    encode_debug_config,
)
from finssim.robot.messages import ThrusterCommand
from finssim.vehicles import load_vehicle

FINSROV = load_vehicle("finsrov")
SPEC = draw_plant(FINSROV, 1, "realistic")
REST = FirmwareSample((0.0, 0.0, 0.0), (0.0, 0.0, 9.81), 0.6, 107000.0)


def firmware(**clock):
    settings = {"crystal_ppm": 0.0, "clock_start": 0, **clock}
    return Firmware(FINSROV, SPEC.model_copy(update={"firmware": SPEC.firmware.model_copy(update=settings)}))


def frame(normalised, enable=True):
    return encode_command(ThrusterCommand(enable, tuple(normalised)))


def only(output, value):
    return [value if i == output else 0.0 for i in range(8)]


def telemetry(mcu, now, sample=REST):
    return mcu.telemetry(now, sample, np.zeros(8), np.zeros(8))


@pytest.mark.parametrize("name", FINSROV.thruster_names)
def test_outputs_and_signs_are_those_of_the_vehicle_file(name):
    """Half of full scale on a motor's output turns its thruster in the direction of its sign."""
    mcu, thruster = firmware(), FINSROV.thrusters[name]
    mcu.receive(0.0, frame(only(thruster.motor_index, 0.5)))
    expected = np.zeros(8)
    expected[FINSROV.thruster_names.index(name)] = thruster.motor_sign * 1500.0 * RPM
    np.testing.assert_allclose(mcu.target, expected, rtol=1e-6)


def test_targets_below_the_slowest_speed_are_standstill():
    """Half of the file's slowest speed gives zero; the slowest speed itself turns the motor."""
    mcu, thruster = firmware(), FINSROV.thrusters["H_RF"]
    slowest = thruster.dead_rpm_plus / 3000.0
    mcu.receive(0.0, frame(only(thruster.motor_index, 0.5 * slowest)))
    assert not mcu.target.any()
    mcu.receive(0.0, frame(only(thruster.motor_index, slowest)))
    assert mcu.target.any()


def test_motors_stop_half_a_second_after_the_last_command():
    """They do not stop earlier, and a new command starts them again."""
    mcu = firmware()
    mcu.receive(1.0, frame([0.5] * 8))
    mcu.watch(1.499)
    assert mcu.target.all()
    mcu.watch(1.501)
    assert not mcu.target.any()
    assert not telemetry(mcu, 1.51).flags & StatusFlag.DIRECT_THRUSTERS
    mcu.receive(2.0, frame([0.5] * 8))
    assert mcu.target.all()


def test_a_disabled_command_stops_the_motors():
    """This holds for any numbers in the command."""
    mcu = firmware()
    mcu.receive(0.0, frame([0.5] * 8))
    mcu.receive(0.1, frame([0.5] * 8, enable=False))
    assert not mcu.target.any()


def test_bad_frames_neither_move_nor_feed_the_watchdog():
    """A wrong CRC or a number beyond full scale changes nothing and does not restart the timeout."""
    mcu = firmware()
    mcu.receive(0.0, frame([0.5] * 8))
    good = frame([-0.5] * 8)
    mcu.receive(0.4, good[:-3] + bytes([good[-3] ^ 1]) + good[-2:])
    body = bytes([1]) + np.full(8, 1.5, dtype="<f4").tobytes()
    mcu.receive(0.4, b"\xaa" + body + crc16_modbus(body).to_bytes(2, "little") + b"\xbb")
    signs = [t.motor_sign for t in FINSROV.thrusters.values()]
    assert np.array_equal(np.sign(mcu.target), signs)
    mcu.watch(0.6)
    assert not mcu.target.any()


def test_a_command_may_come_in_pieces():
    """A command may be split, as over a serial line."""
    mcu, data = firmware(), frame([0.5] * 8)
    mcu.receive(0.0, data[:20])
    assert not mcu.target.any()
    mcu.receive(0.0, data[20:])
    assert mcu.target.all()


def test_echoes_come_on_request_one_in_so_many():
    """Mask bit 0 and a decimation of 3 give one echo per three commands, with the received and applied
    values."""
    mcu = firmware()
    assert mcu.receive(0.0, frame([0.5] * 8)) == []
    mcu.receive(0.0, encode_debug_config(1, 1, 3))
    replies = [mcu.receive(0.1 + 0.01 * i, frame([0.5] * 8)) for i in range(9)]
    assert [len(r) for r in replies] == [0, 0, 1] * 3
    echo = Decoder(HOST).feed(replies[2][0])[0]
    assert echo.accepted and echo.enabled and echo.reject_flags == 0 and echo.decimation == 3
    assert echo.command_count == 4 and echo.receive_ms == 120
    assert echo.command_crc == int.from_bytes(frame([0.5] * 8)[-3:-1], "little")
    np.testing.assert_allclose(echo.applied, echo.received, atol=1e-6)
    mcu.receive(0.3, encode_debug_config(2, 0, 1))
    assert mcu.receive(0.3, frame([0.5] * 8)) == []


def test_echoes_say_why_a_command_was_refused():
    """The reasons are: disabled, after a timeout, after a bad frame."""
    mcu = firmware()
    mcu.receive(0.0, encode_debug_config(1, 1, 1))

    def reject(now, data):
        return Decoder(HOST).feed(mcu.receive(now, data)[0])[0].reject_flags

    assert reject(0.0, frame([0.1] * 8, enable=False)) == RejectFlag.DISABLED
    mcu.watch(0.7)
    assert reject(0.8, frame([0.5] * 8)) == RejectFlag.TIMEOUT
    good = frame([0.5] * 8)
    assert reject(0.9, good[:-3] + b"\0\0" + good[-1:] + good) == RejectFlag.BAD_FRAME
    assert reject(1.0, good) == 0


def test_status_flags_tell_what_it_does():
    """The flags contain the count of commands, echo, drive and targets."""
    mcu = firmware()
    before = telemetry(mcu, 0.01).flags
    assert before & StatusFlag.DIAGNOSTICS and before & StatusFlag.RPM_CONTROL
    assert not before & (StatusFlag.COMMAND_RECEIVED | StatusFlag.TARGET_RPM | StatusFlag.ECHO_ON)
    mcu.receive(0.02, encode_debug_config(1, 1, 1))
    for _ in range(300):
        mcu.receive(0.02, frame([0.5] * 8))
    after = mcu.telemetry(0.03, REST, np.zeros(8), np.ones(8)).flags
    for bit in ("COMMAND_RECEIVED", "TARGET_RPM", "ECHO_ON", "DIRECT_THRUSTERS", "THROTTLE"):
        assert after & StatusFlag[bit]
    assert command_count(after) == 300 - 256


def test_its_clock_drifts_and_wraps():
    """100 ppm is 0.1 s in a thousand; 2³² ms wrap to 0."""
    assert firmware(crystal_ppm=100.0).clock(1000.0) == 1000100
    assert firmware(clock_start=2**32 - 500).clock(1.0) == 500


def test_a_reboot_is_silent_and_forgets_everything():
    """Motors stop at once; after 1.5 s without sending or receiving, clock, counters and sequence start
    again."""
    mcu = firmware(clock_start=100000)
    mcu.receive(0.0, frame([0.5] * 8))
    for i in range(5):
        telemetry(mcu, 0.01 * i)
    mcu.reboot(1.0)
    assert not mcu.target.any() and telemetry(mcu, 2.49) is None
    mcu.receive(2.0, frame([0.5] * 8))
    assert not mcu.target.any()
    first = telemetry(mcu, 2.51)
    assert first.sequence == 1 and first.mcu_ms in (9, 10) and command_count(first.flags) == 0


def test_telemetry_has_speeds_by_output_with_the_motors_signs():
    """Telemetry inverts the mapping of commands."""
    mcu = firmware()
    speed = np.arange(1.0, 9.0)
    rpm = mcu.telemetry(0.01, REST, speed, np.zeros(8)).motor_rpm
    for k, thruster in enumerate(FINSROV.thrusters.values()):
        assert rpm[thruster.motor_index] * RPM * thruster.motor_sign == pytest.approx(speed[k])
