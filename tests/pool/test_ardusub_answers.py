"""The emulated autopilot answers as ArduSub 4.5.0 did: every row of the recording in tests/data/ardusub_4_5_0.

The inputs are sent again and the numbers compared. Rows without a counterpart are in `LEFT`, each with its reason; a
test fails if a row is neither compared nor there.
"""

import csv
import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from finssim.core.rotations import quat_to_euler
from finssim.pool import ardusub, draw_plant
from finssim.pool.ardusub import ALT_HOLD, MANUAL, STABILIZE
from reference.ground_station import ARM, HEAVY, INTERVAL, MODE, NEUTRAL, REQUEST, Ground

DATA = Path(__file__).parents[1] / "data" / "ardusub_4_5_0" / "answers.json"
RECORDED = json.loads(DATA.read_text())
SECOND = RECORDED["second_recording"]

LEFT = {
    "pilot_silence": "FS_PILOT_INPUT is compiled out of SITL; the emulator has it, as a vehicle does",
    "gcs_failsafe": "recorded again, with the times, in second_recording",
    "after_fs": "recorded again in second_recording",
    "arm_no_disarm_button": "the vehicle was armed still; recorded again in second_recording",
    "armforce_no_disarm_button": "recorded again in second_recording",
    "arm_lowvolt": "recorded again in second_recording",
    "batt_low_volt": "a parameter, compared with all others",
    "reboot": "the vehicle was armed still; recorded again in second_recording",
}
"""Rows of the recording that are not compared, and why."""
LEFT_STREAMS = {"SIMSTATE": "of the simulator, not of the autopilot"}
LEFT_VERSION = {
    "cap": "not emulated, so not claimed: missions, file transfer, targets, termination, calibration, fence, rally",
    "fcv": "names this emulator",
}
SET_FOR_THE_VEHICLE = {
    "BARO1_GND_PRESS", "BARO2_GND_PRESS", "BARO_SPEC_GRAV", "VISO_TYPE", "EK3_SRC1_POSXY", "EK3_SRC1_VELXY",
}  # fmt: skip
"""Parameters that differ for a BlueROV2 Heavy with a Doppler log."""


def severities(out):
    """Severities of the texts among messages, in their order."""
    return [m.severity for m in out if m.get_type() == "STATUSTEXT"]


def recorded(texts):
    return [text["severity"] for text in texts]


def ready(**kwargs):
    """Return a ground station that steers, on a vehicle whose gyroscope has settled."""
    ground = Ground(**kwargs)
    ground.axes = NEUTRAL
    ground.run(1.5)
    return ground


def channels(ground):
    """Return inputs and pulses of channels 1 to 8."""
    return [list(ground.firmware._inputs[:8]), [int(pulse) for pulse in ground.firmware.pulses]]


@pytest.fixture
def ground():
    return ready()


@pytest.fixture(scope="module")
def armed():
    ground = ready()
    assert ground.command(ARM, 1) == 0
    ground.run(1.0)
    return ground


def test_every_row_is_compared_or_left_with_a_reason():
    """The keys of the recording are the words in quotation marks in this file."""
    text = Path(__file__).read_text()
    for row in (*RECORDED, *SECOND):
        assert f'"{row}"' in text, row
    assert not set(LEFT) - set(RECORDED)


def test_streams_nobody_asked_for(ground):
    """Each message comes at its rate, to 5 %: ArduSub's scheduler gives 2.08 Hz for 2."""
    rates = Counter(m.get_type() for m in ground.run(24.0))
    asked = {name: rate for name, rate in RECORDED["default_streams_hz"].items() if name not in LEFT_STREAMS}
    asked.pop("TIMESYNC")  # one every 12 s
    for name, rate in asked.items():
        assert rates[name] / 24.0 == pytest.approx(rate, rel=0.05), name
    assert set(rates) - {"STATUSTEXT", "TIMESYNC"} == set(asked)


def test_heartbeat_version_and_number_of_parameters(ground):
    out = ground.run(2.0)
    beat = [m for m in out if m.get_type() == "HEARTBEAT"][-1]
    fields = [
        beat.type,
        beat.autopilot,
        beat.base_mode,
        beat.custom_mode,
        beat.system_status,
        beat.mavlink_version,
    ]
    assert fields == RECORDED["heartbeat"]
    assert ground.command(REQUEST, 148) == 0
    answer, version = ground.last["AUTOPILOT_VERSION"], RECORDED["autopilot_version"]
    assert hex(answer.flight_sw_version) == version["sw"] and not set(LEFT_VERSION) - set(version)
    got = answer.middleware_sw_version, answer.os_sw_version, answer.board_version, answer.uid
    assert list(got) == [version[name] for name in ("mw", "os", "board", "uid")]
    assert [answer.vendor_id, answer.product_id] == [version["vendor"], version["product"]]
    ground.run(4.0, mavlink.MAVLink_param_request_list_message(1, 1))
    # The recorded list has one parameter more than the recorded count: one appeared meanwhile.
    assert (
        ground.last["PARAM_VALUE"].param_count - 1 == RECORDED["param_count"][0] == RECORDED["param_count"][1]
    )


def test_parameters_have_the_recorded_values_and_types():
    """Values equal the file's in single precision, except those that describe the vehicle; RC3_TRIM is 1100."""
    ground, sent = Ground(), {}
    out = ground.run(5.0, mavlink.MAVLink_param_request_list_message(1, 1))
    sent |= {m.param_id: (m.param_value, m.param_type) for m in out if m.get_type() == "PARAM_VALUE"}
    with ardusub.PARAMETERS.open(newline="") as file:
        rows = {r["name"]: (np.float32(r["value"]), int(r["mavlink_type"])) for r in csv.DictReader(file)}
    different = {name for name in rows if sent[name] != rows[name]}
    assert different == SET_FOR_THE_VEHICLE and {name: sent[name][1] for name in rows} == {
        n: r[1] for n, r in rows.items()
    }
    assert sent["RC3_TRIM"][0] == 1100 and sent["PILOT_SPEED_UP"][0] == 100 and sent["ARMING_CHECK"][0] == 448
    assert sent["BATT_LOW_VOLT"][0] == RECORDED["batt_low_volt"]


def test_storing_parameters(ground):
    """Stick gains beyond their range are stored, integers truncated, and unknown parameters get no answer."""
    assert ground.set(JS_GAIN_DEFAULT=2.0) == {"JS_GAIN_DEFAULT": RECORDED["pset_gain_2"]}
    assert ground.set(THR_DZ=99.6) == {"THR_DZ": RECORDED["pset_thr_dz_frac"]}
    assert RECORDED["param_set_unknown"] is None and ground.set(NO_SUCH=1.0) == {}
    out = ground.run(0.3, mavlink.MAVLink_param_request_read_message(1, 1, b"NO_SUCH", -1))
    assert RECORDED["param_read_unknown"] is None and not [m for m in out if m.get_type() == "PARAM_VALUE"]


def test_arming_and_disarming(ground):
    """Arming is accepted without an origin, with two warnings, and repeatedly; throttle in VFR_HUD is 50 and
    0."""
    out = ground.run(0.3, mavlink.MAVLink_command_long_message(1, 1, ARM, 0, 1, 0, 0, 0, 0, 0, 0))
    assert [m.result for m in out if m.get_type() == "COMMAND_ACK"] == RECORDED["arm_noorigin"]
    was_armed, texts = RECORDED["arm_noorigin_state"]
    assert ground.firmware.armed == was_armed and severities(out) == recorded(texts)
    out = ground.run(1.2)
    beat = [m for m in out if m.get_type() == "HEARTBEAT"][-1]
    assert [beat.base_mode, beat.custom_mode, beat.system_status] == RECORDED["heartbeat_armed"]
    assert ground.last["VFR_HUD"].throttle == RECORDED["vfr_thr_armed_neutral"]
    assert ground.command(ARM, 1) == RECORDED["arm_again"]
    out = ground.run(0.3, mavlink.MAVLink_command_long_message(1, 1, ARM, 0, 0, 0, 0, 0, 0, 0, 0))
    assert ground.last["COMMAND_ACK"].result == RECORDED["disarm"]
    assert severities(out) == recorded(RECORDED["disarm_texts"])
    assert ground.command(ARM, 0) == RECORDED["disarm_again"]
    ground.run(0.3)
    assert ground.last["VFR_HUD"].throttle == RECORDED["vfr_thr_disarmed"]


def test_modes(ground):
    """For each mode in turn, disarmed: result, mode afterwards, severities."""
    for mode, (result, after, texts) in RECORDED["modes_disarmed"].items():
        out = ground.run(
            0.15, mavlink.MAVLink_command_long_message(1, 1, MODE, 0, 1, int(mode), 0, 0, 0, 0, 0)
        )
        acks = [m.result for m in out if m.get_type() == "COMMAND_ACK"]
        if int(mode) == 0:
            acks, out = [ground.command(MODE, 1, 0)], []
        assert (acks, ground.firmware.mode, severities(out)) == ([result], after, recorded(texts)), mode
    ((_, command, result),), mode = RECORDED["set_mode_msg"]
    out = ground.run(0.2, mavlink.MAVLink_set_mode_message(1, 1, 0))
    assert [(m.command, m.result) for m in out if m.get_type() == "COMMAND_ACK"] == [(command, result)]
    assert ground.firmware.mode == mode
    assert ground.command(MODE, 0, 19) == RECORDED["do_set_mode_nocustomflag"]


def axes(name):
    """Return axes x, y, z, r, s, t of a name of `inputs`."""
    mixed = {
        "neutral": (0, 0, 500, 0, 0, 0), "mix1": (1000, 1000, 500, 1000, 0, 0), "mix2": (300, -200, 700, 150, 120, -90),
        "mix3": (0, 0, 1000, 0, 400, 400), "x32767": (32767,) * 6, "xm1000": (-1000, 0, 500, 0, 0, 0),
        "zneg": (0, 0, -1000, 0, 0, 0),
    }  # fmt: skip
    if name in mixed:
        return mixed[name]
    values = {"x": 0, "y": 0, "z": 500, "r": 0, "s": 0, "t": 0} | {name[0]: int(name[1:])}
    return tuple(values.values())


@pytest.mark.parametrize("name", RECORDED["inputs"])
def test_inputs_and_outputs_to_the_microsecond(armed, name):
    """MANUAL_CONTROL at a gain of 0.5 gives the recorded RC channels and servo outputs 1 to 8."""
    x, y, z, r, s, t = axes(name)
    armed.axes, armed.tilt = (x, y, z, r), (s, t)
    armed.run(0.2)
    got = channels(armed)
    armed.axes, armed.tilt = NEUTRAL, (0, 0)
    armed.run(0.1)
    assert got == RECORDED["inputs"][name]


def test_strangers_and_other_targets_do_not_steer(armed):
    """MANUAL_CONTROL of system 254, for target 2 and for target 0 has no effect."""
    armed.axes = None
    for row, system, target in (("other_sysid", 254, 1), ("wrong_target", 255, 2), ("target0", 255, 0)):
        other = mavlink.MAVLink(None, system, 190)
        message = mavlink.MAVLink_manual_control_message(target, 1000, 0, 500, 0, 0).pack(other)
        armed.pool.exchange(armed.pool.time + 0.1, [message])
        armed.run(0.05)
        assert channels(armed)[1] == RECORDED[row], row
    armed.axes = NEUTRAL
    armed.run(0.2)


@pytest.mark.parametrize(
    "row, values",
    [
        ("override_1700", {5: 1700}),
        ("override_2100_900", {5: 2100, 6: 900}),
        ("override_release", {5: 0, 6: 0}),
    ],
)
def test_overrides(armed, row, values):
    armed.axes, armed.channels = None, values
    armed.run(0.2)
    got = channels(armed)
    armed.axes, armed.channels = NEUTRAL, None
    armed.run(0.2)
    assert got == RECORDED[row]


def test_buttons(ground):
    """Each is held for 0.4 s, armed: function, kinds of texts, mode, armed. A mode is refused in each
    message."""
    ground.command(ARM, 1)
    for button, (function, texts, mode, stays) in RECORDED["buttons"].items():
        assert ground.firmware.parameters[f"BTN{button}_FUNCTION"] == function
        if not ground.firmware.armed:
            assert ground.command(ARM, 1) == 0
        ground.command(MODE, 1, MANUAL)
        ground.run(0.2)
        ground.buttons = 1 << int(button)
        out = ground.run(0.4)
        ground.buttons = 0
        got = set(severities(out)), ground.firmware.mode, ground.firmware.armed
        assert got == (set(recorded(texts)), mode, stays), button
        assert len(severities(out)) == len(texts) or len(texts) > 1, button
        ground.run(0.2)


COMMANDS = {
    "unknown_31999": (31999,), "nav_takeoff": (22,), "nav_land": (21,), "loiter_unlim": (17,), "rtl": (20,),
    "motor_test_disarmed": (209, 0, 1, 1600, 1, 0, 2), "set_servo_1": (183, 1, 1600), "set_servo_9": (183, 9, 1600),
    "set_relay": (181, 0, 1), "preflight_cal_baro": (241, 0, 0, 1), "preflight_cal_gyro": (241, 1),
    "cal_accel_simple": (241, 0, 0, 0, 0, 4), "req_caps": (520, 1), "req_proto": (519, 1),
    "get_msg_interval": (510, 30),
    "set_interval_bad_id": (INTERVAL, 9999, 1e5), "set_interval_fast": (INTERVAL, 30, 1000),
    "set_interval_off": (INTERVAL, 30, -1), "set_interval_default": (INTERVAL, 30, 0), "req_msg_bad": (REQUEST, 9999),
    "req_msg_attq": (REQUEST, 31), "req_msg_home": (REQUEST, 242), "get_home": (410,), "arm_param_2": (ARM, 2),
    "do_reposition": (192,), "set_home_current": (179, 1), "fence_enable": (207, 1), "mission_start": (300,),
    "flight_term_0": (185, 0), "change_speed": (178, 0, 1), "cond_yaw": (115, 90), "storage_format": (526, 1),
    "run_prearm": (401,), "set_ekf_source": (42007, 1), "available_modes": (REQUEST, 435),
}  # fmt: skip
"""Rows of `commands` and the messages sent for them."""


def send(ground, number, *values, wait=2.5):
    """Return the result of a command, None without an answer, and the severities of the texts."""
    values = [*values, *[0.0] * (7 - len(values))]
    out = ground.run(wait, mavlink.MAVLink_command_long_message(1, 1, number, 0, *values))
    acks = [m.result for m in out if m.get_type() == "COMMAND_ACK"]
    return [acks[0] if acks else None, severities(out)]


def test_commands(ground):
    """Acknowledgement and severities match; the gyroscope's calibration answers after its 3 s."""
    assert set(COMMANDS) == set(RECORDED["commands"])
    for row, sent in COMMANDS.items():
        answer = send(ground, *sent, wait=2.5 if row == "preflight_cal_gyro" else 0.2)
        result, texts = RECORDED["commands"][row]
        assert answer == [result, recorded(texts)], row
        if result is None:
            out = ground.run(1.0)
            assert [(m.command, m.result) for m in out if m.get_type() == "COMMAND_ACK"] == [(241, 0)]


def test_commands_while_armed(ground):
    """A motor test runs, ground pressure and reboot are postponed; the end of the test disarms."""
    ground.command(ARM, 1)
    ground.run(0.6)
    sent = {
        "motor_test_armed": (209, 0, 1, 1500, 1, 0, 2),
        "baro_armed": (241, 0, 0, 1),
        "reboot_armed": (246, 1),
    }
    for row, values in sent.items():
        result, texts, pulses = RECORDED["commands_armed"][row]
        assert [*send(ground, *values, wait=0.1), channels(ground)[1]] == [result, recorded(texts), pulses], (
            row
        )
    ground.run(1.0)
    was_armed, _, pulses = RECORDED["commands_armed"]["after"]
    assert [ground.firmware.armed, channels(ground)[1]] == [was_armed, pulses]
    assert SECOND["reboot_armed"] == [4, []]


def test_missions_clocks_and_pings(ground):
    for kind, (count, mission) in RECORDED["mission_count"].items():
        ground.run(0.1, mavlink.MAVLink_mission_request_list_message(1, 1, int(kind)))
        answer = ground.last["MISSION_COUNT"]
        assert [answer.count, answer.mission_type] == [count, mission]
    out = ground.run(
        0.2,
        mavlink.MAVLink_mission_clear_all_message(1, 1, 0),
        mavlink.MAVLink_timesync_message(0, 77),
        mavlink.MAVLink_ping_message(5, 6, 0, 0),
    )
    assert ground.last["MISSION_ACK"].type == RECORDED["mission_clear"]
    kinds = {m.get_type() for m in out}
    assert ("TIMESYNC" in kinds, "PING" in kinds) == (RECORDED["timesync"], RECORDED["ping"])


def test_a_motor_test_drives_single_outputs_and_cools_down(ground):
    """Servo 1 by a pulse, then servo 3 by a percentage, each repeated; then it disarms and allows no test for
    10 s."""
    result, first, then, both, after, texts = SECOND["motor_test"]
    ground.command(ARM, 1)
    ground.run(0.6)
    for values, wanted in (((0, 1, 1600), (result, first)), ((2, 0, 75), (then, both))):
        for _ in range(5):
            answer = send(ground, 209, *values, 1, 0, 2, wait=0.4)
        assert (answer[0], channels(ground)[1]) == wanted
    out = ground.run(1.0)
    assert ground.firmware.armed == after and severities(out) == recorded(texts)
    ground.command(ARM, 1)
    result, texts = SECOND["motor_test_again"]
    assert send(ground, 209, 0, 1, 1600, 1, 0, 2, wait=0.2) == [result, recorded(texts)]


def test_the_ground_station_falls_silent(ground):
    """An armed vehicle disarms after 2.5 s with a critical heartbeat, a disarmed one warns; sticks and
    overrides count too."""
    ground.command(ARM, 1)
    ground.run(1.0)
    for row in ("manual_control_is_heartbeat", "override_is_heartbeat"):
        ground.beats = False
        ground.axes, ground.channels = (NEUTRAL, None) if row.startswith("manual") else (None, {5: 1500})
        ground.run(4.0)
        assert ground.firmware.armed == SECOND[row][0]
    ground.beats, ground.axes, ground.channels = True, NEUTRAL, None
    ground.run(1.0)
    ground.set(FS_PILOT_INPUT=0)
    ground.beats, ground.axes = False, None
    out, waited = [], 0.0
    while ground.firmware.armed and waited < 10.0:
        out += ground.run(0.1)
        waited += 0.1
    seconds, texts, status = SECOND["gcs_failsafe"]
    assert waited == pytest.approx(seconds, abs=0.7)  # heartbeats are 1 s apart
    assert set(recorded(texts)) <= set(severities(out)) <= {*recorded(texts), 4}
    beat = [m for m in ground.run(1.5) if m.get_type() == "HEARTBEAT"][-1]
    assert beat.system_status == status
    ground.beats, ground.axes = True, NEUTRAL
    ground.run(2.0)
    assert ground.last["HEARTBEAT"].system_status == SECOND["after"][0]


def test_the_ground_station_of_a_disarmed_vehicle_is_missed_with_a_word(ground):
    ground.set(FS_PILOT_INPUT=0)
    ground.beats, ground.axes = False, None
    out = ground.run(4.0)
    status, texts = SECOND["gcs_lost_disarmed"]
    assert severities(out) == recorded(texts) and ground.last["HEARTBEAT"].system_status == status


def test_what_refuses_to_arm(ground):
    """Arming is refused, forced or not, if no button disarms, and at a low voltage."""
    ground.set(BTN4_FUNCTION=0)
    for row, values in (("arm_no_button", (ARM, 1)), ("force_no_button", (ARM, 1, 21196))):
        result, now_armed, texts = SECOND[row]
        assert send(ground, *values, wait=0.2) == [result, recorded(texts)]
        assert ground.firmware.armed == now_armed
    ground.set(BTN4_FUNCTION=4, BATT_ARM_VOLT=20.0)
    result, now_armed, texts = SECOND["arm_lowvolt"]
    assert send(ground, ARM, 1, wait=0.2) == [result, recorded(texts)] and ground.firmware.armed == now_armed


def test_a_leak_is_a_word_and_no_more(armed):
    """The armed vehicle stays active and in its mode; later, disarmed, it is in standby."""
    armed.pool.faults.autopilot.leak = True
    out = armed.run(1.2)
    armed.pool.faults.autopilot.leak = False
    beat = [m for m in out if m.get_type() == "HEARTBEAT"][-1]
    still, status, mode, texts = SECOND["leak"]
    assert [armed.firmware.armed, beat.system_status, beat.custom_mode] == [still, status, mode]
    assert severities(out) == recorded(texts)
    armed.command(ARM, 0)
    armed.run(1.2)
    assert armed.last["HEARTBEAT"].system_status == SECOND["leak_later"]
    armed.command(ARM, 1)
    armed.run(1.0)


def test_a_reboot_takes_its_time_and_is_confirmed(ground):
    """It is accepted when disarmed. SITL took 25 s to return, the emulated autopilot its plant's reboot time."""
    assert send(ground, 246, 1, wait=0.05)[0] == SECOND["reboot"][0]


RECORDED_HEAVY = HEAVY.replace({"body.displaced_volume": 0.0134})
"""Vehicle of the recording, which sank by 1 N; the catalogue's has since been trimmed to float."""
RECORDED_SPEC = draw_plant(RECORDED_HEAVY, 1, "nominal")
RECORDED_SPEC = RECORDED_SPEC.model_copy(
    update={"basin": RECORDED_SPEC.basin.model_copy(update={"depth": 12.0})}
)


def at_once(name):
    """Return a deep pool with the vehicle of the recording."""
    ground = ready(spec=RECORDED_SPEC, start=(0.0, 0.0, -5.0), vehicle=RECORDED_HEAVY)
    assert ground.command(MODE, 1, name) == 0 and ground.command(ARM, 1) == 0
    ground.run(1.0)
    return ground


def state(ground):
    """Return roll, pitch, yaw [deg] and body rates [deg/s] in the autopilot's axes."""
    plant = ground.pool.plant
    roll, pitch, yaw = (float(a) for a in quat_to_euler(plant.quaternion.astype(float)))
    rates = plant.nu[3:] * (1.0, -1.0, -1.0)
    return np.degrees([roll, -pitch, -yaw, *rates])


@pytest.mark.parametrize("name", SECOND["stabilize"])
def test_stabilize_leans_and_turns_as_recorded(name):
    """After 4.5 s lean agrees to 10 % (the other axis to 2 degrees), the rate of turn to 10 % (or 1 degree a
    second)."""
    ground = at_once(STABILIZE)
    x, y, z, r, s, t = axes(name)
    ground.axes, ground.tilt = (x, y, z, r), (s, t)
    ground.run(4.5)
    roll, pitch, _, _, _, turn = state(ground)
    wanted = SECOND["stabilize"][name]
    assert roll == pytest.approx(wanted[0], rel=0.1, abs=2.0)
    assert pitch == pytest.approx(wanted[1], rel=0.1, abs=2.0)
    assert turn == pytest.approx(wanted[5], rel=0.1, abs=1.0)


@pytest.mark.parametrize("name", SECOND["althold_climb"])
def test_depth_hold_climbs_as_recorded(name):
    """Climb rate agrees to 10 % (or 1 cm/s), throttle to 3 %, pulses to 25 µs."""
    ground = at_once(ALT_HOLD)
    x, y, z, r, _, _ = axes(name)
    ground.axes = (x, y, z, r)
    ground.run(4.0, mavlink.MAVLink_request_data_stream_message(1, 1, 0, 10, 1))
    climbs = []
    for _ in range(10):
        ground.run(0.1)
        climbs.append(float(ground.pool.plant.nu[2]))
    climb, throttle, pulses = SECOND["althold_climb"][name]
    assert np.mean(climbs) == pytest.approx(climb, rel=0.1, abs=0.01)
    assert ground.last["VFR_HUD"].throttle == pytest.approx(throttle, abs=3)
    np.testing.assert_allclose(ground.firmware.pulses[4:], pulses, atol=25)


def test_the_vertical_axis_alone_is_ramped_after_arming(ground):
    """Servo 5 at full throttle agrees to 15 µs from 0.08 to 0.56 s after arming; the others act at once."""
    ground.set(JS_GAIN_DEFAULT=1.0)
    ground.pool.reboot()
    ground.run(3.0)
    ground.axes = (1000, 0, 1000, 0)
    ground.run(0.3)
    ground.run(0.05, mavlink.MAVLink_command_long_message(1, 1, ARM, 0, 1, 0, 0, 0, 0, 0, 0))
    start, got = ground.firmware._armed_at, []
    assert ground.firmware.pulses[2] == 1900
    for after in (0.08, 0.2, 0.32, 0.44, 0.56):
        ground.pool.exchange(
            start + after, [ground.pack(mavlink.MAVLink_manual_control_message(1, 1000, 0, 1000, 0, 0))]
        )
        got.append(float(ground.firmware.pulses[4]))
    np.testing.assert_allclose(got, (1430, 1334, 1238, 1142, 1100), atol=15)
