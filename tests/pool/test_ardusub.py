"""Answers, steering and failsafes of the emulated autopilot, tested with pymavlink in lock-step."""

import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from finssim.core.rotations import quat_to_euler
from finssim.pool import draw_plant
from finssim.pool.ardusub import ACRO, ALT_HOLD, MANUAL, MOTOR_DETECT, STABILIZE, SURFACE, SURFTRAK
from finssim.pool.firmware import AttitudeFilter
from finssim.pool.plant_spec import PlantSpecError
from finssim.pool.run import SiteChoice
from finssim.robot.links.water_linked import decode_line
from finssim.vehicles import load_vehicle
from reference.ground_station import (
    ACCEPTED,
    ARM,
    DEEP,
    HEAVY,
    INTERVAL,
    MODE,
    NEUTRAL,
    REBOOT,
    REQUEST,
    Ground,
)

DENIED, UNSUPPORTED, FAILED = 2, 3, 4


@pytest.fixture
def ground():
    return Ground()


def test_all_parameters_come_on_request_and_a_set_one_is_answered(ground):
    """Each index comes once, with value and type; integers are rounded and limited, unknown parameters
    ignored."""
    out = ground.run(5.0, mavlink.MAVLink_param_request_list_message(1, 1))
    values = [m for m in out if m.get_type() == "PARAM_VALUE"]
    assert sorted(m.param_index for m in values) == list(range(values[0].param_count))
    table = {m.param_id: m for m in values}
    assert table["FRAME_CONFIG"].param_value == 2.0 and table["FRAME_CONFIG"].param_type == 2
    assert table["JS_GAIN_DEFAULT"].param_value == 0.5 and table["JS_GAIN_DEFAULT"].param_type == 9
    assert all(len(name) <= 16 for name in table)
    assert ground.set(JS_GAIN_DEFAULT=0.75, JS_GAIN_STEPS=1e9, NO_SUCH=1.0, THR_DZ=math.nan) == {
        "JS_GAIN_DEFAULT": 0.75,
        "JS_GAIN_STEPS": 127.0,
    }
    for index, name in ((-1, b"JS_GAIN_DEFAULT"), (table["JS_GAIN_DEFAULT"].param_index, b"")):
        out = ground.run(0.1, mavlink.MAVLink_param_request_read_message(1, 1, name, index))
        assert [m.param_value for m in out if m.get_type() == "PARAM_VALUE"] == [0.75]


def test_commands_as_whole_numbers_and_for_others(ground):
    """COMMAND_INT is performed; a command for another system gets no answer."""
    ground.run(2.0)
    out = ground.run(0.2, mavlink.MAVLink_command_long_message(7, 1, ARM, 0, 1, 0, 0, 0, 0, 0, 0))
    assert not [m for m in out if m.get_type() == "COMMAND_ACK"] and not ground.firmware.armed
    out = ground.run(0.2, mavlink.MAVLink_command_int_message(1, 1, 0, ARM, 0, 0, 1, 0, 0, 0, 0, 0, 0))
    assert [m.result for m in out if m.get_type() == "COMMAND_ACK"] == [ACCEPTED] and ground.firmware.armed


def test_streams_and_intervals(ground):
    """REQUEST_DATA_STREAM sets a group, SET_MESSAGE_INTERVAL one message; -1 stops it, 0 returns to SR0."""
    ground.run(1.0, mavlink.MAVLink_request_data_stream_message(1, 1, 10, 20, 1))
    count = lambda name, out: sum(m.get_type() == name for m in out)  # noqa: E731
    assert count("ATTITUDE", ground.run(2.0)) == pytest.approx(40, abs=1)
    assert ground.command(INTERVAL, 30, 1e5) == ground.command(INTERVAL, 31, 2e4) == ACCEPTED
    out = ground.run(2.0)
    assert count("ATTITUDE", out) == pytest.approx(20, abs=1)
    assert count("ATTITUDE_QUATERNION", out) == pytest.approx(100, abs=2)
    assert ground.command(INTERVAL, 30, -1) == ACCEPTED and count("ATTITUDE", ground.run(1.0)) == 0
    ground.set(SR0_EXTRA1=4)
    assert count("ATTITUDE", ground.run(2.0)) == pytest.approx(8, abs=1)


def test_clocks_answer_and_file_transfer_is_refused(ground):
    """The refusal keeps a ground station from waiting."""
    ground.run(
        0.2,
        mavlink.MAVLink_timesync_message(0, 77),
        mavlink.MAVLink_file_transfer_protocol_message(0, 1, 1, [5, 0, 7, 4, *[0] * 247]),
    )
    assert ground.last["FILE_TRANSFER_PROTOCOL"].payload[:6] == [6, 0, 7, 129, 1, 4]
    answer = ground.last["TIMESYNC"]
    assert answer.ts1 == 77 and 1e-9 * answer.tc1 == pytest.approx(ground.pool.time, abs=0.2)


def test_arming_waits_for_the_gyroscope(ground):
    assert ground.command(ARM, 1) == FAILED and not ground.firmware.armed
    ground.run(1.5)
    assert ground.command(ARM, 1) == ACCEPTED and ground.firmware.armed


def test_with_every_check_an_origin_is_missed_after_arming(ground):
    """With ARMING_CHECK 1 the answer is failure, but the motors are armed nevertheless."""
    ground.run(1.5)
    ground.set(ARMING_CHECK=1, BATT_ARM_VOLT=0)
    assert ground.command(ARM, 1) == FAILED and ground.firmware.armed


AXES = {"surge": (0, 1), "sway": (1, -1), "yaw": (5, -1), "heave": (2, 1)}
"""Axis of MANUAL_CONTROL -> index of the body velocity and its sign for a positive stick."""


@pytest.mark.parametrize("way", [1, -1])
@pytest.mark.parametrize("axis", AXES)
def test_each_axis_moves_the_vehicle_its_way(axis, way):
    """Ahead, right, clockwise or up; no other velocity is as large. STABILIZE counters the horizontals' pitch
    moment."""
    ground = Ground().armed(STABILIZE)
    stick = {"surge": (500 * way, 0, 500, 0), "sway": (0, 500 * way, 500, 0)}
    stick |= {"heave": (0, 0, 500 + 250 * way, 0), "yaw": (0, 0, 500, 600 * way)}
    ground.axes = stick[axis]
    ground.run(1.0)
    index, sign = AXES[axis]
    nu = ground.pool.plant.nu
    assert nu[index] * sign * way > 0.2
    others = np.delete(nu[:3], index) if index < 3 else nu[:3]
    assert np.abs(others).max() < 0.3 * abs(nu[index])


def test_six_thrusters_have_their_own_frame_and_directions():
    """A BlueROV2 without compass and log: frame 1, no pitch, the mixer's limits; MOT_n_DIRECTION reverses a
    motor."""
    rov = load_vehicle("bluerov2")
    ground = Ground(vehicle=rov, spec=draw_plant(rov, 1, "nominal"), start=(0.0, 0.0, -0.5)).armed()
    assert ground.firmware.parameters["FRAME_CONFIG"] == 1.0 and not ground.lines
    ground.axes, ground.tilt = (500, 0, 1000, 0), (200, 0)
    ground.run(0.2)
    assert ground.firmware.pulses.tolist() == [1300, 1300, 1500, 1500, 1100, 1100]
    ground.set(MOT_5_DIRECTION=-1)
    assert ground.firmware.pulses.tolist() == [1300, 1300, 1500, 1500, 1900, 1100]


@pytest.mark.parametrize("name, tilt", [("pitch", (150, 0)), ("roll", (0, 150))])
def test_the_extension_axes_turn_it_about_the_other_two(name, tilt):
    """s lifts the nose and t rolls to the right, as raw microseconds without the gain."""
    ground = Ground().armed(gain=0.25)
    ground.tilt = tilt
    ground.run(0.3)
    roll, pitch, _ = (float(a) for a in quat_to_euler(ground.pool.plant.quaternion.astype(float)))
    turn = {"roll": roll, "pitch": -pitch}[name]
    assert turn > 0.05
    expected = [1500] * 4 + ([1350, 1350, 1650, 1650] if name == "pitch" else [1650, 1350, 1650, 1350])
    assert ground.firmware.pulses.tolist() == expected


def test_the_gain_scales_sticks_and_buttons_change_it(ground):
    """A full stick gives half output by default; button 11 raises the gain by a quarter of the range and
    reports it."""
    ground.axes = NEUTRAL
    ground.run(2.0, mavlink.MAVLink_request_data_stream_message(1, 1, 2, 5, 1))
    assert ground.command(ARM, 1) == ACCEPTED
    ground.axes = (1000, 0, 500, 0)
    out = ground.run(0.5)
    assert ground.firmware.pulses.tolist() == [1300, 1300, 1700, 1700, 1500, 1500, 1500, 1500]
    gains = [m.value for m in out if m.get_type() == "NAMED_VALUE_FLOAT" and m.name == "PilotGain"]
    assert gains and set(gains) == {0.5}
    ground.buttons = 1 << 11
    assert ground.texts(ground.run(0.2)) == ["#Gain is at 75%"]
    assert ground.firmware.pulses[0] == 1200
    ground.buttons = 1 << 4
    ground.run(0.1)
    assert not ground.firmware.armed and not ground.firmware.target.any()
    ground.buttons = 1 << 6
    ground.run(0.1)
    assert ground.firmware.armed


def test_overrides_steer_without_gain_and_lapse_after_three_seconds(ground):
    """Pitch is channel 1 and roll 2; RC_CHANNELS shows the inputs; 0 releases one."""
    ground.set(FS_PILOT_INPUT=0)
    ground.run(1.5, mavlink.MAVLink_request_data_stream_message(1, 1, 3, 10, 1))
    ground.command(ARM, 1)
    ground.channels = {1: 1600, 5: 1700}
    ground.run(0.3)
    inputs = ground.last["RC_CHANNELS"]
    assert (inputs.chan1_raw, inputs.chan2_raw, inputs.chan5_raw, inputs.chan9_raw) == (
        1600,
        1500,
        1700,
        1100,
    )
    assert ground.last["SERVO_OUTPUT_RAW"].servo3_raw == 1700
    assert ground.firmware.pulses.tolist() == [1300, 1300, 1700, 1700, 1400, 1400, 1600, 1600]
    ground.channels = {1: 0, 5: 1700}
    ground.run(0.1)
    assert ground.firmware.pulses[4:].tolist() == [1500] * 4
    ground.channels = None
    ground.run(2.7)
    assert ground.firmware.pulses[2] == 1700
    ground.run(0.4)
    assert ground.firmware.pulses.tolist() == [1500] * 8 and ground.firmware.armed


def test_only_the_ground_station_of_its_id_steers():
    """Another station may send commands, but its sticks have no effect."""
    ground = Ground(system=200)
    ground.axes, ground.channels = (1000, 0, 500, 0), {5: 1900}
    ground.run(1.5)
    assert ground.command(ARM, 1) == ACCEPTED
    ground.run(0.5)
    assert not ground.firmware.target.any()


def test_without_a_pilot_it_disarms_after_three_seconds():
    """FS_PILOT_INPUT 2 disarms, with a critical heartbeat, even if the pilot's heartbeats continue."""
    ground = Ground().armed()
    ground.axes = (1000, 0, 500, 0)
    ground.run(0.5)
    ground.axes = None
    ground.run(2.9)
    assert ground.firmware.armed and ground.firmware.pulses[2] == 1900
    out = ground.run(0.2)
    assert not ground.firmware.armed and not ground.firmware.target.any()
    assert "Lost manual control" in ground.texts(out)
    assert ground.run(1.0) and ground.last["HEARTBEAT"].system_status == 5


def test_a_low_battery_disarms_after_its_timer():
    """BATT_LOW_TIMER is 10 s below BATT_LOW_VOLT; both are off by default."""
    ground = Ground().armed()
    ground.set(BATT_LOW_VOLT=12.8, BATT_FS_LOW_ACT=2)
    ground.pool.faults.autopilot.battery_voltage = 11.0
    ground.run(9.8)
    assert ground.firmware.armed
    assert any("Battery 1 is low" in text for text in ground.texts(ground.run(0.5)))
    assert not ground.firmware.armed


def test_a_leak_is_reported_and_with_two_it_surfaces():
    """FS_LEAK_ENABLE 1 only warns; 2 rises to SURFACE_DEPTH, if there is a position, and holds there."""
    ground = Ground().armed()
    ground.run(0.5, mavlink.MAVLink_set_gps_global_origin_message(1, 338103130, -1183938670, 0))
    ground.pool.faults.autopilot.leak = True
    assert ground.texts(ground.run(0.5)) == ["Leak Detected"] and ground.firmware.mode == MANUAL
    ground.pool.faults.autopilot.leak = False
    ground.set(FS_LEAK_ENABLE=2)
    ground.pool.faults.autopilot.leak = True
    ground.run(1.5)
    assert ground.firmware.mode == SURFACE and ground.pool.plant.position[2] > -1.9
    ground.run(8.0)
    assert ground.firmware.mode == ALT_HOLD and -0.4 < ground.pool.plant.position[2] < -0.05


def test_stabilize_rights_it_and_holds_its_heading():
    """From 25 degrees of roll and 15 of pitch, it is level to 4 degrees within 3 s, and its heading to 3
    degrees."""
    ground = Ground(attitude=(0.45, 0.25, 1.0)).armed(STABILIZE)
    ground.run(3.0)
    roll, pitch, yaw = (float(a) for a in quat_to_euler(ground.pool.plant.quaternion.astype(float)))
    held = -ground.firmware._attitude_loop.heading
    assert max(abs(roll), abs(pitch)) < math.radians(4.0) and abs(yaw - held) < math.radians(3.0)


def test_depth_hold_holds_its_depth_and_climbs_by_the_stick():
    """Depth stays within 5 cm over 10 s against 1 N of weight; the stick moves it, and depth is held from its
    release."""
    ground = Ground().armed(ALT_HOLD, gain=0.5)
    ground.run(2.0)
    z = float(ground.pool.plant.position[2])
    ground.run(8.0)
    assert abs(ground.pool.plant.position[2] - z) < 0.05
    ground.axes = (0, 0, 750, 0)
    ground.run(1.0)
    assert ground.pool.plant.nu[2] > 0.1
    ground.axes = NEUTRAL
    ground.run(3.0)
    assert abs(ground.pool.plant.nu[2]) < 0.03 and ground.pool.plant.position[2] > z + 0.1


def versioned(version):
    """Return the deep pool with another version of the autopilot."""
    firmware = DEEP.firmware.model_copy(update={"version": version})
    return Ground(spec=DEEP.model_copy(update={"firmware": firmware}), start=(0.0, 0.0, -0.55))


def test_version_4_7_has_other_names_and_little_throttle_near_the_surface():
    """SURFACE_MAX_THR is 0.1 at 10 cm and 1 a metre below that; the system id has its new name."""
    ground = versioned("4.7").armed(ALT_HOLD)
    assert (
        "SYSID_THISMAV" not in ground.firmware.parameters and ground.firmware.parameters["MAV_SYSID"] == 1.0
    )
    ground.set(SURFACE_MAX_THR=0.1)
    ground.axes = (0, 0, 1000, 0)
    ground.run(0.4)
    up = (1500.0 - ground.firmware.pulses[4:].mean()) / 400.0
    depth = -float(ground.pool.plant.position[2])
    assert 0.0 < up <= 0.1 + 0.9 * (depth - 0.1) + 0.02
    assert ground.command(REQUEST, 148) == ACCEPTED
    assert ground.last["AUTOPILOT_VERSION"].flight_sw_version >> 16 == 0x0407


def test_version_4_1_knows_no_axes_of_pitch_and_roll():
    ground = versioned("4.1").armed()
    ground.tilt = (400, 400)
    ground.run(0.3)
    assert ground.firmware.pulses.tolist() == [1500.0] * 8 and ground.command(MODE, 1, 21) == FAILED


def test_the_version_is_an_option_of_the_pool():
    """The option applies to ArduSub alone: with the motor controller another version is refused."""
    plan, _ = SiteChoice(vehicle="bluerov2_heavy", firmware="ardusub", version="4.1").plan()
    assert plan.spec.firmware.version == "4.1"
    with pytest.raises(PlantSpecError, match="--firmware ardusub"):
        SiteChoice(version="4.7", camera="none").plan()


def test_acro_turns_by_the_stick_and_rights_itself():
    """The stick sets yaw rate, and roll while it is held; without it the vehicle levels; throttle is the
    pilot's."""
    ground = Ground().armed(ACRO, gain=0.5)
    ground.axes, ground.tilt = (0, 0, 500, 500), (0, 200)
    ground.run(2.0)
    roll, _, _ = (float(a) for a in quat_to_euler(ground.pool.plant.quaternion.astype(float)))
    # A quarter of the range: 3.375 · 45° times the part beyond the dead zone.
    turn = -math.degrees(ground.pool.plant.nu[5])
    assert turn == pytest.approx(3.375 * 45.0 * (100 - 20) / (400 - 20), rel=0.2) and roll > math.radians(
        20.0
    )
    ground.axes, ground.tilt = NEUTRAL, (0, 0)
    ground.run(4.0)
    roll, _, _ = (float(a) for a in quat_to_euler(ground.pool.plant.quaternion.astype(float)))
    assert abs(roll) < math.radians(6.0)


def test_motor_detection_is_accepted_and_turns_nothing():
    ground = Ground().armed(MOTOR_DETECT)
    ground.axes = (1000, 0, 1000, 0)
    ground.run(0.5)
    assert ground.firmware.mode == MOTOR_DETECT and not ground.firmware.target.any()


def test_surface_tracking_holds_the_depth_without_a_rangefinder():
    ground = Ground().armed(SURFTRAK, gain=0.5)
    ground.run(2.0)
    z = float(ground.pool.plant.position[2])
    ground.run(4.0)
    assert ground.firmware.mode == SURFTRAK and abs(ground.pool.plant.position[2] - z) < 0.05


def test_after_a_reboot_under_water_depth_counts_from_there():
    """This lasts until a command calibrates depth at the surface."""
    ground = Ground(start=(0.0, 0.0, -2.0))
    ground.pool.reboot()
    ground.run(4.0, mavlink.MAVLink_request_data_stream_message(1, 1, 0, 10, 1))
    assert ground.last["VFR_HUD"].alt == pytest.approx(0.0, abs=0.15)
    assert ground.firmware.parameters["BARO2_GND_PRESS"] > 1.15e5


def test_the_heading_is_magnetic_until_there_is_an_origin():
    """Once there is an origin, the heading turns by the declination in 20 s, as recorded."""
    firmware = DEEP.firmware.model_copy(update={"declination": math.radians(11.4)})
    ground = Ground(spec=DEEP.model_copy(update={"firmware": firmware}), yaw=0.0)
    ground.run(3.0)

    def heading():
        """Return the autopilot's heading minus the true one, clockwise [deg]."""
        true = -float(quat_to_euler(ground.pool.plant.quaternion.astype(float))[2])
        return math.degrees(ground.firmware._attitude[2] - true)

    assert heading() == pytest.approx(-11.4, abs=2.5)
    ground.run(10.0, mavlink.MAVLink_set_gps_global_origin_message(1, 338103130, -1183938670, 0))
    assert -9.0 < heading() < -3.0
    ground.run(13.0)
    assert heading() == pytest.approx(0.0, abs=2.5)


def test_telemetry_is_the_truth_in_north_east_down():
    """Attitude, heading, depth, pressure, accelerations and battery match the truth for a tilted vehicle at
    rest."""
    level = HEAVY.model_copy(
        update={"body": HEAVY.body.model_copy(update={"center_of_buoyancy": np.zeros(3)})}
    )
    spec = draw_plant(level, 1, "nominal")
    spec = spec.model_copy(update={"basin": spec.basin.model_copy(update={"depth": 5.0})})
    ground = Ground(attitude=(0.2, 0.1, 0.7), spec=spec)
    ground.run(2.0, mavlink.MAVLink_request_data_stream_message(1, 1, 0, 10, 1))
    truth = [float(a) for a in quat_to_euler(ground.pool.plant.quaternion.astype(float))]
    a, last = ground.last["ATTITUDE"], ground.last
    np.testing.assert_allclose([a.roll, -a.pitch, -a.yaw], truth, atol=0.03)
    depth = -float(ground.pool.plant.position[2])
    assert last["SCALED_PRESSURE2"].press_abs == pytest.approx(1013.25 + 98.2 * depth, abs=5.0)
    assert last["VFR_HUD"].alt == pytest.approx(-depth, abs=0.06)
    assert last["GLOBAL_POSITION_INT"].relative_alt == pytest.approx(-1000.0 * depth, abs=60.0)
    heading = math.degrees(-truth[2]) % 360.0
    assert last["VFR_HUD"].heading == pytest.approx(heading, abs=2.0)
    imu = last["RAW_IMU"]
    assert imu.zacc == pytest.approx(-1000.0 * math.cos(truth[0]) * math.cos(truth[1]), abs=30)
    assert imu.yacc == pytest.approx(-1000.0 * math.sin(truth[0]) * math.cos(truth[1]), abs=30)
    assert last["BATTERY_STATUS"].voltages[0] == pytest.approx(16400, abs=300)
    assert last["SYS_STATUS"].onboard_control_sensors_health & mavlink.MAV_SYS_STATUS_PREARM_CHECK
    assert "LOCAL_POSITION_NED" not in last


def test_its_own_position_comes_with_the_doppler_log_and_an_origin():
    """Dead-reckoned north, east, down is right to 5 % of the distance; without an origin or a log there is no
    position."""
    ground = Ground(yaw=0.5).armed(STABILIZE)
    ground.run(0.1, mavlink.MAVLink_set_gps_global_origin_message(1, 338103130, -1183938670, 0))
    p0, n0 = ground.pool.plant.position.copy(), ground.firmware._position.copy()
    ground.axes = (400, 0, 500, 0)
    ground.run(4.0, mavlink.MAVLink_request_data_stream_message(1, 1, 6, 10, 1))
    np.testing.assert_allclose(decode_line(ground.lines[-1]).values, ground.pool.plant.nu[:3], atol=0.08)
    ground.axes = NEUTRAL
    ground.run(3.0)
    x, y, _ = (ground.pool.plant.position - p0).tolist()
    local = ground.last["LOCAL_POSITION_NED"]
    way = math.hypot(x, y)
    assert math.hypot(local.x - n0[0] - x, local.y - n0[1] + y) < 0.05 * way and way > 1.0
    assert ground.last["GLOBAL_POSITION_INT"].lat > 338103130
    assert decode_line(ground.lines[-1]).altitude == pytest.approx(
        5.0 + ground.pool.plant.position[2], rel=0.05
    )
    ground.pool.faults.autopilot.dvl_silent = True
    ground.run(0.2)
    ground.lines.clear()
    ground.run(1.0)
    assert not ground.lines


def test_late_instruments_count_by_the_attitude_of_then():
    """The vehicle goes ahead while spinning; the log, 0.2 m ahead, is 60 ms late, the compass 20 ms. The autopilot's
    position follows the truth, and its heading lags by less than a degree."""
    ground = Ground(vehicle=HEAVY.replace({"sensors.dvl.position": [0.2, 0.0, 0.0]})).armed(STABILIZE)
    ground.run(12.0, mavlink.MAVLink_set_gps_global_origin_message(1, 338103130, -1183938670, 0))
    p0, n0 = ground.pool.plant.position.copy(), ground.firmware._position.copy()
    ground.axes, off = (1000, 0, 500, 1000), []
    for _ in range(60):
        ground.run(0.1)
        true = float(quat_to_euler(ground.pool.plant.quaternion.astype(float))[2])
        off.append(math.degrees(math.remainder(float(ground.firmware._attitude[2]) + true, math.tau)))
    assert abs(float(ground.pool.plant.nu[5])) > math.radians(50.0)
    assert abs(np.mean(off[20:])) < 1.0
    ground.axes = NEUTRAL
    ground.run(2.0)
    x, y, _ = (ground.pool.plant.position - p0).tolist()
    north, east = ground.firmware._position - n0
    assert math.hypot(north - x, east + y) < 0.05


def test_a_fault_of_depth_or_heartbeat_is_that_alone():
    """A frozen gauge leaves the other sensors moving; a missing heartbeat leaves telemetry running."""
    ground = Ground().armed(ALT_HOLD)
    ground.run(0.5, mavlink.MAVLink_request_data_stream_message(1, 1, 0, 10, 1))
    ground.pool.faults.freeze_depth = True
    ground.pool.faults.autopilot.no_heartbeat = True
    ground.axes = (0, 0, 700, 0)
    out = ground.run(2.0)
    pressures = {m.press_abs for m in out if m.get_type() == "SCALED_PRESSURE2"}
    assert len(pressures) <= 2 and len({m.yaw for m in out if m.get_type() == "ATTITUDE"}) > 10
    assert not [m for m in out if m.get_type() == "HEARTBEAT"]
    ground.pool.faults.nan_field = "quaternion"
    ground.run(0.3)
    assert math.isnan(ground.last["ATTITUDE"].roll)


def test_a_reboot_is_silent_and_keeps_nothing_but_parameters(ground):
    """A reboot by command needs a disarmed vehicle; then motors off, clock from 0, MANUAL, and the gain is
    read again."""
    ground = ground.armed(STABILIZE, gain=1.0)
    assert ground.command(REBOOT, 1) == FAILED
    ground.command(ARM, 0)
    ground.set(JS_GAIN_DEFAULT=0.25)
    assert ground.command(REBOOT, 1) == ACCEPTED
    assert not ground.run(1.2)
    out = ground.run(1.0)
    assert (
        any("ArduSub" in text for text in ground.texts(out))
        and ground.last["HEARTBEAT"].custom_mode == MANUAL
    )
    assert ground.command(REQUEST, 2) == ACCEPTED and ground.last["SYSTEM_TIME"].time_boot_ms < 3000
    assert ground.firmware._gain == 0.25


def test_signed_traffic_alone_counts_once_it_has_a_key(ground):
    """SETUP_SIGNING stores the key; unsigned arming is ignored, signed arming accepted; its own messages
    verify."""
    key = list(range(1, 33))
    ground.run(1.5, mavlink.MAVLink_setup_signing_message(1, 1, key, 10**6))
    out = ground.run(0.3, mavlink.MAVLink_command_long_message(1, 1, ARM, 0, 1, 0, 0, 0, 0, 0, 0))
    assert not [m for m in out if m.get_type() == "COMMAND_ACK"] and not ground.firmware.armed
    signing = ground.mav.signing
    signing.secret_key, signing.sign_outgoing, signing.timestamp = bytes(key), True, 10**9
    assert ground.command(ARM, 1) == ACCEPTED and ground.firmware.armed
    assert ground.last["COMMAND_ACK"].get_signed()


def test_a_compass_turns_the_filter_and_nothing_else():
    """`turn` by the whole difference gives the heading; tilt does not change."""
    filter = AttitudeFilter(0.5, 0.01, 9.81)
    filter.update((0.0, 0.0, 0.0), (1.0, 2.0, 9.0), 0.01)
    before = [float(a) for a in quat_to_euler(np.array(filter.quaternion))]
    filter.turn(2.0, 1.0)
    after = [float(a) for a in quat_to_euler(np.array(filter.quaternion))]
    np.testing.assert_allclose(after, [before[0], before[1], 2.0], atol=1e-9)


def test_equal_seeds_send_equal_bytes():
    """The bytes do not depend on the computer's clock."""

    def sent():
        ground = Ground()
        ground.pool.exchange(1.0, [ground.pack(mavlink.MAVLink_request_data_stream_message(1, 1, 0, 10, 1))])
        return ground.pool.exchange(3.0).frames

    frames = sent()
    assert len(frames) > 200 and frames == sent()
