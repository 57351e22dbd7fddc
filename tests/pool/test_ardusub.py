"""The emulated autopilot against pymavlink, in lock-step: what it answers, how it steers, when it stops."""

import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from finssim.core.rotations import quat_from_euler, quat_to_euler
from finssim.pool import VirtualPool, draw_plant
from finssim.pool.ardusub import ALT_HOLD, MANUAL, STABILIZE, SURFACE
from finssim.pool.firmware import AttitudeFilter
from finssim.robot.links.water_linked import decode_line
from finssim.vehicles import load_vehicle
from finssim.vehicles.defaults import with_navigation

HEAVY = with_navigation(load_vehicle("bluerov2_heavy"))
SPEC = draw_plant(HEAVY, 1, "nominal")
DEEP = SPEC.model_copy(update={"basin": SPEC.basin.model_copy(update={"depth": 5.0})})
ACCEPTED, DENIED, UNSUPPORTED, FAILED = 0, 2, 3, 4
ARM, MODE, INTERVAL, REQUEST, REBOOT = 400, 176, 511, 512, 246
NEUTRAL = (0, 0, 500, 0)


class Ground:
    """A ground station in lock-step with a pool, that beats and may steer."""

    def __init__(
        self, *, system=255, start=(0.0, 0.0, -2.0), yaw=0.0, attitude=None, vehicle=HEAVY, spec=DEEP
    ):
        q = quat_from_euler(*(attitude or (0.0, 0.0, yaw)))
        self.pool = VirtualPool(vehicle, spec, firmware="ardusub", start=(start, q))
        self.mav = mavlink.MAVLink(None, system, 190)
        self.mav.robust_parsing = True
        self.beats, self.axes, self.buttons, self.tilt = True, None, 0, (0, 0)
        self.channels, self.lines, self.last = None, [], {}
        self.sent = 0.0

    @property
    def firmware(self):
        return self.pool.firmware

    def pack(self, message):
        data = message.pack(self.mav)
        self.mav.seq = (self.mav.seq + 1) % 256
        return data

    def run(self, duration, *messages):
        """Messages that came meanwhile; the given ones go out first."""
        out, queue, end = [], [self.pack(m) for m in messages], self.pool.time + duration
        while self.pool.time < end - 1e-9:
            if self.beats and self.pool.time >= self.sent:
                self.sent += 1.0
                queue.append(self.pack(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3)))
            if self.axes is not None:
                x, y, z, r = self.axes
                s, t = self.tilt
                queue.append(
                    self.pack(mavlink.MAVLink_manual_control_message(1, x, y, z, r, self.buttons, s=s, t=t))
                )
            if self.channels is not None:
                six = [self.channels.get(i, 65535) for i in range(1, 9)]
                queue.append(self.pack(mavlink.MAVLink_rc_channels_override_message(1, 1, *six)))
            for _, frame in self.pool.exchange(self.pool.time + 0.05, queue).frames:
                if frame[:1] == b"{":
                    self.lines.append(frame)
                else:
                    out += self.mav.parse_buffer(frame) or ()
            queue = []
        self.last = {m.get_type(): m for m in out}
        return out

    def command(self, number, *values, wait=0.15):
        """Result of a command."""
        values = [*values, *[0.0] * (7 - len(values))]
        out = self.run(wait, mavlink.MAVLink_command_long_message(1, 1, number, 0, *values))
        (ack,) = [m for m in out if m.get_type() == "COMMAND_ACK"]
        assert ack.command == number and ack.target_system == self.mav.srcSystem
        return ack.result

    def texts(self, out):
        return [m.text for m in out if m.get_type() == "STATUSTEXT"]

    def set(self, **values):
        """Store parameters; their values as answered."""
        out = []
        for name, value in values.items():
            out += self.run(0.1, mavlink.MAVLink_param_set_message(1, 1, name.encode(), value, 9))
        return {m.param_id: m.param_value for m in out if m.get_type() == "PARAM_VALUE"}

    def armed(self, mode=MANUAL, gain=1.0):
        """Itself, armed and ready to be steered."""
        self.set(JS_GAIN_DEFAULT=gain, SURFACE_MAX_THR=1.0)
        self.pool.reboot()
        self.axes = NEUTRAL
        self.run(3.0)
        assert self.command(MODE, 1, mode) == ACCEPTED
        assert self.command(ARM, 1) == ACCEPTED and self.firmware.armed
        return self


@pytest.fixture
def ground():
    return Ground()


def test_it_beats_once_a_second_and_is_silent_otherwise(ground):
    """Type submarine, ArduPilot, MANUAL, disarmed; nothing else until it is asked."""
    out = ground.run(5.0)
    beats = [m for m in out if m.get_type() == "HEARTBEAT"]
    assert len(beats) == 5 and {m.get_type() for m in out} == {"HEARTBEAT", "STATUSTEXT"}
    beat = beats[-1]
    assert (beat.type, beat.autopilot, beat.base_mode, beat.custom_mode) == (12, 3, 81, MANUAL)
    assert beat.get_srcSystem() == 1 and beat.get_srcComponent() == 1
    assert any("ArduSub V4.5" in text for text in ground.texts(out))


def test_all_parameters_come_on_request_and_a_set_one_is_answered(ground):
    """Each index once, float by value with its own type; whole ones are rounded and limited, unknown ones ignored."""
    out = ground.run(2.0, mavlink.MAVLink_param_request_list_message(1, 1))
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


def test_every_command_has_an_answer(ground):
    """Accepted, failed or unsupported, and never silence; another system's commands have none."""
    ground.run(2.0)
    assert ground.command(31000) == UNSUPPORTED
    assert ground.command(MODE, 1, 16) == ground.command(MODE, 1, 4) == FAILED
    assert ground.command(MODE, 0, 19) == DENIED
    assert ground.command(209, 0, 0, 50, 0, 0, 2) == FAILED  # motor test
    assert ground.command(183, 1, 1600) == FAILED
    assert ground.command(REQUEST, 148) == ACCEPTED
    version = ground.last["AUTOPILOT_VERSION"]
    assert version.flight_sw_version >> 16 == 0x0405 and version.capabilities & 32 == 0
    assert ground.command(REQUEST, 31) == ACCEPTED and "ATTITUDE_QUATERNION" in ground.last
    assert ground.command(REQUEST, 9999) == ground.command(INTERVAL, 9999, 1e5) == FAILED
    out = ground.run(0.2, mavlink.MAVLink_command_long_message(7, 1, ARM, 0, 1, 0, 0, 0, 0, 0, 0))
    assert not [m for m in out if m.get_type() == "COMMAND_ACK"] and not ground.firmware.armed
    out = ground.run(0.2, mavlink.MAVLink_command_int_message(1, 1, 0, ARM, 0, 0, 1, 0, 0, 0, 0, 0, 0))
    assert [m.result for m in out if m.get_type() == "COMMAND_ACK"] == [ACCEPTED] and ground.firmware.armed


def test_streams_and_intervals(ground):
    """A group by REQUEST_DATA_STREAM, one message by SET_MESSAGE_INTERVAL, -1 ends it, 0 goes back to SR0."""
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


def test_missions_are_empty_and_clocks_answer(ground):
    """What a ground station asks on connecting."""
    out = []
    for kind in (0, 1, 2):
        out += ground.run(0.1, mavlink.MAVLink_mission_request_list_message(1, 1, kind))
    counts = [m for m in out if m.get_type() == "MISSION_COUNT"]
    assert [(m.count, m.mission_type) for m in counts] == [(0, 0), (0, 1), (0, 2)]
    ground.run(
        0.2,
        mavlink.MAVLink_mission_clear_all_message(1, 1, 0),
        mavlink.MAVLink_timesync_message(0, 77),
        mavlink.MAVLink_ping_message(5, 6, 0, 0),
        mavlink.MAVLink_file_transfer_protocol_message(0, 1, 1, [5, 0, 7, 4, *[0] * 247]),
    )
    assert ground.last["MISSION_ACK"].type == 0
    assert ground.last["FILE_TRANSFER_PROTOCOL"].payload[:6] == [6, 0, 7, 129, 1, 4]
    answer = ground.last["TIMESYNC"]
    assert answer.ts1 == 77 and 1e-9 * answer.tc1 == pytest.approx(ground.pool.time, abs=0.2)
    assert (ground.last["PING"].seq, ground.last["PING"].target_system) == (6, 255)


def test_arming_is_checked_and_may_be_forced(ground):
    """Refused while the gyroscope settles, without a button that disarms, and on a low battery, with the reason."""
    assert ground.command(ARM, 1) == FAILED and not ground.firmware.armed
    ground.run(1.5)
    assert ground.command(ARM, 1) == ACCEPTED and ground.firmware.armed
    out = ground.run(1.0)
    assert [m.base_mode for m in out if m.get_type() == "HEARTBEAT"] == [209]
    assert ground.command(ARM, 0) == ACCEPTED and not ground.firmware.armed
    ground.set(BTN4_FUNCTION=0)
    out = ground.run(0.2, mavlink.MAVLink_command_long_message(1, 1, ARM, 0, 1, 0, 0, 0, 0, 0, 0))
    assert ground.last["COMMAND_ACK"].result == FAILED and ground.texts(out) == [
        "Arm: Disarm button not assigned"
    ]
    assert ground.command(ARM, 1, 21196) == ACCEPTED and ground.command(ARM, 0) == ACCEPTED
    ground.set(BTN4_FUNCTION=4)
    ground.pool.faults.battery_voltage = 11.0
    ground.run(0.1)
    assert ground.command(ARM, 1) == FAILED


AXES = {"surge": (0, 1), "sway": (1, -1), "yaw": (5, -1), "heave": (2, 1)}
"""Axis of MANUAL_CONTROL -> index of our body velocity and its sign for a positive stick."""


@pytest.mark.parametrize("way", [1, -1])
@pytest.mark.parametrize("axis", AXES)
def test_each_axis_moves_the_vehicle_its_way(axis, way):
    """Ahead, right, clockwise, up; nothing else moves as fast. With STABILIZE against the horizontals' pitch moment."""
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
    """A BlueROV2 without compass and log: frame 1, no pitch, the mixer's limits; MOT_n_DIRECTION turns a motor."""
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
    """s lifts the nose, t rolls to the right, as raw microseconds without the gain."""
    ground = Ground().armed(gain=0.25)
    ground.tilt = tilt
    ground.run(0.3)
    roll, pitch, _ = (float(a) for a in quat_to_euler(ground.pool.plant.quaternion.astype(float)))
    turn = {"roll": roll, "pitch": -pitch}[name]
    assert turn > 0.05
    expected = [1500] * 4 + ([1350, 1350, 1650, 1650] if name == "pitch" else [1650, 1350, 1650, 1350])
    assert ground.firmware.pulses.tolist() == expected


def test_the_gain_scales_sticks_and_buttons_change_it(ground):
    """Half output for full stick by default; button 11 raises it by a quarter of the range, and says so."""
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
    """Another one may command, but its sticks do nothing."""
    ground = Ground(system=200)
    ground.axes, ground.channels = (1000, 0, 500, 0), {5: 1900}
    ground.run(1.5)
    assert ground.command(ARM, 1) == ACCEPTED
    ground.run(0.5)
    assert not ground.firmware.target.any()


def test_without_a_pilot_it_disarms_after_three_seconds():
    """FS_PILOT_INPUT 2: disarmed at once, and a heartbeat that says critical; the pilot's heartbeats do not save it."""
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


def test_without_the_ground_stations_heartbeat_it_disarms_after_five_seconds():
    """Once one was heard; sticks count as heartbeats, so they are silent too, and the pilot's failsafe is off."""
    ground = Ground().armed()
    ground.set(FS_PILOT_INPUT=0)
    ground.axes = None
    ground.pool.faults.no_ground_heartbeat = True
    ground.run(4.8)
    assert ground.firmware.armed
    assert any("heartbeat lost" in text for text in ground.texts(ground.run(0.5)))
    assert not ground.firmware.armed


def test_a_low_battery_disarms_after_its_timer():
    """BATT_LOW_TIMER 10 s below BATT_LOW_VOLT."""
    ground = Ground().armed()
    ground.pool.faults.battery_voltage = 11.0
    ground.run(9.8)
    assert ground.firmware.armed
    assert any("Battery 1 is low" in text for text in ground.texts(ground.run(0.5)))
    assert not ground.firmware.armed


def test_a_leak_is_reported_and_with_two_it_surfaces():
    """FS_LEAK_ENABLE 1 warns and drives on, 2 goes up."""
    ground = Ground().armed()
    ground.pool.faults.leak = True
    assert ground.texts(ground.run(0.5)) == ["Leak Detected"] and ground.firmware.mode == MANUAL
    ground.pool.faults.leak = False
    ground.set(FS_LEAK_ENABLE=2)
    ground.pool.faults.leak = True
    ground.run(3.0)
    assert ground.firmware.mode == SURFACE and ground.pool.plant.position[2] > -1.9


def test_stabilize_rights_it_and_holds_its_heading():
    """From 25 degrees of roll and 15 of pitch, level to 4 degrees in 3 s, and the heading to 3."""
    ground = Ground(attitude=(0.45, 0.25, 1.0)).armed(STABILIZE)
    ground.run(3.0)
    roll, pitch, yaw = (float(a) for a in quat_to_euler(ground.pool.plant.quaternion.astype(float)))
    held = -ground.firmware._held_yaw
    assert max(abs(roll), abs(pitch)) < math.radians(4.0) and abs(yaw - held) < math.radians(3.0)


def test_depth_hold_holds_its_depth_and_climbs_by_the_stick():
    """Within 5 cm over 10 s against 1 N of weight; up and down by the stick; held again where it is let go."""
    ground = Ground().armed(ALT_HOLD, gain=0.5)
    ground.run(2.0)
    z = float(ground.pool.plant.position[2])
    ground.run(8.0)
    assert abs(ground.pool.plant.position[2] - z) < 0.05
    ground.axes = (0, 0, 750, 0)
    ground.run(1.0)
    assert ground.pool.plant.nu[2] > 0.2
    ground.axes = NEUTRAL
    ground.run(3.0)
    assert abs(ground.pool.plant.nu[2]) < 0.03 and ground.pool.plant.position[2] > z + 0.1


def test_near_the_surface_depth_hold_has_little_upward_throttle():
    """SURFACE_MAX_THR 0.1 at 10 cm, 0.5 about half a metre below that, as reported."""
    ground = Ground(start=(0.0, 0.0, -0.55)).armed(ALT_HOLD)
    ground.set(SURFACE_MAX_THR=0.1)
    ground.axes = (0, 0, 1000, 0)
    ground.run(0.1)
    up = (1500.0 - ground.firmware.pulses[4:].mean()) / 400.0
    depth = -float(ground.pool.plant.position[2])
    assert up == pytest.approx(0.1 + 0.9 * (depth - 0.1), abs=0.08)


def test_telemetry_is_the_truth_in_north_east_down():
    """Attitude, heading, depth, pressure, accelerations and battery, of a vehicle that stands tilted."""
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
    """Dead-reckoned north, east, down to 5 % of the way; without an origin, and without the log, there is none."""
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
    ground.pool.faults.dvl_silent = True
    ground.run(0.2)
    ground.lines.clear()
    ground.run(1.0)
    assert not ground.lines


def test_a_fault_of_depth_or_heartbeat_is_that_alone():
    """The gauge stands while the rest moves; the vehicle's heartbeat goes missing and its telemetry does not."""
    ground = Ground().armed(ALT_HOLD)
    ground.run(0.5, mavlink.MAVLink_request_data_stream_message(1, 1, 0, 10, 1))
    ground.pool.faults.freeze_depth = True
    ground.pool.faults.no_heartbeat = True
    ground.axes = (0, 0, 700, 0)
    out = ground.run(2.0)
    pressures = {m.press_abs for m in out if m.get_type() == "SCALED_PRESSURE2"}
    assert len(pressures) <= 2 and len({m.yaw for m in out if m.get_type() == "ATTITUDE"}) > 10
    assert not [m for m in out if m.get_type() == "HEARTBEAT"]
    ground.pool.faults.nan_field = "quaternion"
    ground.run(0.3)
    assert math.isnan(ground.last["ATTITUDE"].roll)


def test_a_reboot_is_silent_and_keeps_nothing_but_parameters(ground):
    """By command when disarmed only; motors off, clock from 0, MANUAL, gain read again."""
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
    """SETUP_SIGNING stores the key; unsigned arming is not heard, signed is; what it sends verifies."""
    key = list(range(1, 33))
    ground.run(1.5, mavlink.MAVLink_setup_signing_message(1, 1, key, 10**6))
    out = ground.run(0.3, mavlink.MAVLink_command_long_message(1, 1, ARM, 0, 1, 0, 0, 0, 0, 0, 0))
    assert not [m for m in out if m.get_type() == "COMMAND_ACK"] and not ground.firmware.armed
    signing = ground.mav.signing
    signing.secret_key, signing.sign_outgoing, signing.timestamp = bytes(key), True, 10**9
    assert ground.command(ARM, 1) == ACCEPTED and ground.firmware.armed
    assert ground.last["COMMAND_ACK"].get_signed()


def test_a_compass_turns_the_filter_and_nothing_else():
    """`turn` by all of the difference gives the heading; tilt stays."""
    filter = AttitudeFilter(0.5, 0.01, 9.81)
    filter.update((0.0, 0.0, 0.0), (1.0, 2.0, 9.0), 0.01)
    before = [float(a) for a in quat_to_euler(np.array(filter.quaternion))]
    filter.turn(2.0, 1.0)
    after = [float(a) for a in quat_to_euler(np.array(filter.quaternion))]
    np.testing.assert_allclose(after, [before[0], before[1], 2.0], atol=1e-9)


def test_equal_seeds_send_equal_bytes():
    """Nothing of the computer's clock is in them."""

    def sent():
        ground = Ground()
        ground.pool.exchange(1.0, [ground.pack(mavlink.MAVLink_request_data_stream_message(1, 1, 0, 10, 1))])
        return ground.pool.exchange(3.0).frames

    frames = sent()
    assert len(frames) > 200 and frames == sent()
