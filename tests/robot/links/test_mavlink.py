"""The link to an autopilot, against the emulated ArduSub in lock-step; `studies.faults` tests how runs end."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from finssim.control.guidance import Station
from finssim.core.rotations import quat_from_yaw, quat_to_euler
from finssim.pool import VirtualPool, draw_plant
from finssim.pool.drawn_plant import site_of
from finssim.robot.links.frames import LinkError
from finssim.robot.links.mavlink import MavlinkLink
from finssim.robot.links.transports import MavlinkAddress
from finssim.robot.lockstep import run_lockstep
from finssim.robot.messages import HEADING, VELOCITY, NavigationAid, Telemetry, ThrusterCommand
from finssim.robot.perception import Perception
from finssim.robot.pilots import make_pilot
from finssim.robot.runtime import Runtime
from finssim.robot.wiring import Wiring, connected
from finssim.vehicles import load_vehicle
from finssim.vehicles.defaults import vehicle_at, with_navigation

HEAVY = with_navigation(vehicle_at("tank", load_vehicle("bluerov2_heavy")))
SPEC = site_of("tank", draw_plant(HEAVY, 1, "realistic"))
START = (0.0, 0.0, -2.0)


def drive(
    seconds,
    *,
    arm=True,
    goal=(0.8, 0.3, -2.2),
    log=True,
    meanwhile=None,
    firmware=None,
    calibrate=False,
    yaw=0.0,
):
    """Run a PID in lock-step with the pool; return the runtime, the true motion, the link and the frames that it sent.

    Without `log` only the autopilot receives the Doppler log and has a position after 2 s. `meanwhile` is called
    with the pool and may return frames of another ground station; `firmware` changes the spec.
    """
    spec = SPEC.firmware.model_copy(update={"aiding_delay": 2.0, **(firmware or {})})
    spec = SPEC.model_copy(update={"firmware": spec})
    pool = VirtualPool(HEAVY, spec, firmware="ardusub", start=(START, quat_from_yaw(yaw)), seed=1)
    perception = Perception(HEAVY, None, mode="error-state", let_in=START[:2])
    runtime = Runtime(HEAVY, perception, make_pilot("pid", HEAVY), Station(goal, 0.4), arm=arm)
    link, sent, rows = MavlinkLink(HEAVY), [], []
    link.calibrate_depth = calibrate
    runtime.attach(link)

    def exchange(until, frames):
        sent.extend(frames)
        rows.append((pool.firmware.armed, float(np.abs(pool.plant.thrust).max())))
        others = meanwhile(pool) if meanwhile is not None else ()
        got = pool.exchange(until, [*frames, *(others or ())])
        return got if log else replace(got, frames=tuple(f for f in got.frames if f[1][:1] != b"{"))

    run_lockstep(runtime, SimpleNamespace(exchange=exchange), seconds)
    return runtime, pool, link, np.array(rows), sent


@pytest.mark.slow
def test_a_pid_swims_to_its_goal_by_axes_and_doppler_log():
    """The PID arms by MAVLink, steers by axes, locates itself by Doppler log, depth and compass, and disarms
    at the end."""
    runtime, pool, link, _, _ = drive(16.0)
    assert runtime.bridge.state == "disarmed" and not pool.firmware.armed
    assert [event.kind for event in runtime.counters.events].count("armed") == 1
    np.testing.assert_allclose(pool.plant.position, (0.8, 0.3, -2.2), atol=0.08)
    assert abs(float(quat_to_euler(pool.plant.quaternion.astype(float))[2]) - 0.4) < 0.05
    assert link.counts["velocity"] > 100 and link.counts["bad"] == 0


@pytest.mark.slow
def test_without_arm_nothing_arms_and_no_axis_is_sent():
    runtime, _, _, rows, sent = drive(8.0, arm=False)
    assert not rows.any()
    mav = mavlink.MAVLink(None)
    kinds = {message.get_type() for frame in sent for message in mav.parse_buffer(frame) or ()}
    assert "HEARTBEAT" in kinds and not kinds & {"MANUAL_CONTROL", "RC_CHANNELS_OVERRIDE"}
    assert runtime.reading.ready  # its position is known nevertheless


def test_an_older_firmware_is_steered_by_overrides_and_a_small_gain_too():
    """Thrusts do not depend on the message that carries the axes."""
    link = MavlinkLink(HEAVY)
    link._version, link._parameters = (4, 5), {"JS_GAIN_DEFAULT": 0.5, "JS_THR_GAIN": 1.0}
    other = MavlinkLink(HEAVY)
    other._version, other._parameters = (4, 1), {"JS_GAIN_DEFAULT": 0.5}
    speeds = np.array([0.3, -0.2, 0.25, 0.3, 0.2, 0.2, 0.25, 0.25])
    command = ThrusterCommand(True, tuple(speeds.tolist()))
    mav, kinds, pulses = mavlink.MAVLink(None), [], []
    for one in (link, other):
        (message,) = mav.parse_buffer(one._axes(0.0, command))
        kinds.append(message.get_type())
        pulses.append(np.array(one._sent[-1][1]))
    assert kinds == ["MANUAL_CONTROL", "RC_CHANNELS_OVERRIDE"]
    np.testing.assert_allclose(pulses[0], pulses[1], atol=1.0)


SURFACE = [
    *(
        mavlink.MAVLink_param_value_message(name, 101325.0, 9, 2, i)
        for i, name in enumerate((b"BARO1_GND_PRESS", b"BARO2_GND_PRESS"))
    ),
    mavlink.MAVLink_gps_global_origin_message(338103130, -1183938670, 0),
]
"""Messages that telemetry waits for: the barometers' pressure at the surface, and the origin."""


def test_axes_and_attitude_turn_from_its_frame_to_ours():
    """Nose up and right side down in the autopilot's axes give negative pitch and positive roll; specific
    force points up."""
    link = MavlinkLink(HEAVY)
    auto = mavlink.MAVLink(None, 1, 1)
    made = []
    for message in (
        *SURFACE,
        mavlink.MAVLink_raw_imu_message(0, 0, 0, -1000, 0, 0, 0, 0, 0, 0),
        mavlink.MAVLink_scaled_pressure2_message(10, 1013.25 + 98.2, 0, 0),
        mavlink.MAVLink_attitude_message(10, 0.1, 0.2, -0.3, 0.01, 0.02, 0.03),
    ):
        made += link.feed(1.0, bytes(message.pack(auto)))
    telemetry, heading = made
    assert isinstance(telemetry, Telemetry) and isinstance(heading, NavigationAid)
    np.testing.assert_allclose(quat_to_euler(np.array(telemetry.quaternion)), (0.1, -0.2, 0.3), atol=1e-6)
    np.testing.assert_allclose(telemetry.gyro, (0.01, -0.02, -0.03), atol=1e-6)
    np.testing.assert_allclose(telemetry.accel, (0.0, 0.0, 9.80665), atol=1e-6)
    assert telemetry.depth == pytest.approx(1.0, abs=1e-3)
    assert (
        heading.kind == HEADING and heading.values[0] == pytest.approx(0.3, abs=1e-6) and heading.age == 0.0
    )
    late = mavlink.MAVLink_attitude_message(510, 0.1, 0.2, -0.3, 0.01, 0.02, 0.03)
    assert link.feed(1.54, bytes(late.pack(auto)))[1].age == pytest.approx(0.04)


def test_a_specific_force_beyond_the_instruments_range_is_left_out():
    """The previous value remains in use."""
    link, auto = MavlinkLink(HEAVY), mavlink.MAVLink(None, 1, 1)
    for z in (-1000, -32021):
        link.feed(1.0, bytes(mavlink.MAVLink_raw_imu_message(0, 0, 0, z, 0, 0, 0, 0, 0, 0).pack(auto)))
    assert link._accel == pytest.approx((0.0, 0.0, 9.80665)) and link.counts["implausible"] == 1


@pytest.mark.parametrize("mounted", [False, True])
def test_its_own_velocity_counts_where_no_log_speaks(mounted):
    """0.4 m/s north with the nose north-east is forward and left; it counts only while the autopilot's filter is valid.

    A log 0.2 m ahead whose x axis points left would measure this velocity in its own axes, with that of the turn of
    0.5 rad/s to the right.
    """
    vehicle, v = HEAVY, 0.4 / math.sqrt(2)
    if mounted:
        place = {"position": [0.2, 0.0, 0.0], "orientation": quat_from_yaw(0.5 * math.pi).tolist()}
        vehicle = vehicle.replace({f"sensors.dvl.{name}": value for name, value in place.items()})
    link = MavlinkLink(vehicle)
    auto = mavlink.MAVLink(None, 1, 1)
    moving = mavlink.MAVLink_local_position_ned_message(10, 0, 0, 0, 0.4, 0.0, 0.0)
    turned = mavlink.MAVLink_attitude_message(10, 0.0, 0.0, math.pi / 4, 0, 0, 0.5)
    rest = (*SURFACE, mavlink.MAVLink_raw_imu_message(0, 0, 0, -1000, 0, 0, 0, 0, 0, 0),
            mavlink.MAVLink_scaled_pressure2_message(10, 1013.25, 0, 0), turned)  # fmt: skip
    for message in rest:
        link.feed(1.0, bytes(message.pack(auto)))
    assert link.feed(1.0, bytes(moving.pack(auto))) == []
    link.feed(1.0, bytes(mavlink.MAVLink_ekf_status_report_message(2, 0, 0, 0, 0, 0).pack(auto)))
    (aid,) = link.feed(1.1, bytes(moving.pack(auto)))
    assert aid.kind == VELOCITY
    np.testing.assert_allclose(aid.values, (v - 0.1, -v, 0.0) if mounted else (v, v, 0.0), atol=1e-6)


ORIGIN = bytes(
    mavlink.MAVLink_set_gps_global_origin_message(1, 338103130, -1183938670, 0).pack(
        mavlink.MAVLink(None, 254, 1)
    )
)
"""Origin sent by another ground station."""


def at(time, frame):
    """Return a `meanwhile` that sends a frame once, at a time of the pool [s]."""
    waiting = [frame]
    return lambda pool: [waiting.pop()] if waiting and pool.time >= time else []


def off(pool, goal):
    """Return the horizontal distance from a goal [m]."""
    return math.hypot(*(np.asarray(pool.plant.position[:2], float) - goal[:2]))


@pytest.mark.slow
def test_by_the_autopilots_own_position_alone():
    """Without a Doppler log of our own the error after 25 s is within 8 cm, without a pause or a rejected velocity.

    A vehicle that rolls upright in the first second passes too: its filter lags by more than a log's noise.
    """
    goal = (0.8, 0.3, -2.2)
    ready = {"aiding_delay": 0.0, "origin": (33.8, -118.4)}
    runtime, pool, link, _, _ = drive(25.0, log=False, firmware=ready)
    kinds = [event.kind for event in runtime.counters.events]
    assert kinds.count("armed") == 1 and "hold" not in kinds and "fault" not in kinds
    assert off(pool, goal) < 0.08 and link.counts["velocity"] == 0
    velocities = runtime.perception.health().counts["velocity"]
    assert velocities["accepted"] == sum(velocities.values()) > 250


@pytest.mark.slow
@pytest.mark.parametrize("lag", [0.0, 0.25])
def test_a_reset_of_the_autopilots_position_moves_nothing(lag):
    """The autopilot's filter jumps by 0.7 m at 10 s, with or without lag: the jump is noted and the station
    is kept."""

    def leap(pool):
        pool.faults.autopilot.position_lag = lag
        if 10.0 <= pool.time < 10.01:
            pool.firmware.leap(0.5, -0.5)
        return send(pool)

    send = at(0.5, ORIGIN)
    runtime, pool, link, _, _ = drive(19.0, log=False, meanwhile=leap)
    assert link.counts["position reset"] == 1 and runtime.bridge.state == "disarmed"
    assert off(pool, (0.8, 0.3)) < 0.1
    assert any("moved its position by 0.7" in event.text for event in runtime.counters.events)


@pytest.mark.slow
def test_an_origin_in_mid_run_turns_no_thrust():
    """The heading turns by 11.4 degrees over 20 s: thrust pauses at once and resumes in the frame of the
    start."""
    rows = []

    def watch(pool):
        rows.append((pool.time, float(np.abs(pool.plant.thrust).max())))
        return send(pool)

    send = at(10.0, ORIGIN)
    declination = {"declination": math.radians(11.4)}
    runtime, pool, link, _, _ = drive(44.0, goal=(1.0, 0.3, -2.2), meanwhile=watch, firmware=declination)
    rows = np.array(rows)
    assert rows[(rows[:, 0] > 11.0) & (rows[:, 0] < 28.0), 1].max() < 0.1
    kinds = [event.kind for event in runtime.counters.events]
    assert kinds.count("hold") == 1 and "fault" not in kinds and kinds.count("armed") == 2
    assert math.degrees(link._north - link._first_north) == pytest.approx(11.4, abs=2.5)
    # World x is the vehicle's heading at the start.
    assert off(pool, (1.0, 0.3)) < 0.14


@pytest.mark.slow
@pytest.mark.parametrize("origin", [False, True])
def test_goals_count_from_the_heading_of_the_start_without_an_origin(origin):
    """The vehicle points 60 degrees left of north: the goal is 0.8 m ahead, or 0.8 m north if there is an
    origin."""
    meanwhile = at(0.0, ORIGIN) if origin else None
    runtime, pool, _, _, _ = drive(16.0, goal=(0.8, 0.0, -2.2), meanwhile=meanwhile, yaw=math.radians(60.0))
    ahead = 0.0 if origin else math.radians(60.0)
    assert off(pool, (0.8 * math.cos(ahead), 0.8 * math.sin(ahead))) < 0.1
    turned = float(quat_to_euler(pool.plant.quaternion.astype(float))[2])
    assert turned == pytest.approx(ahead + 0.4, abs=0.05)
    told = [event.text for event in runtime.counters.events]
    assert any("world x is where the vehicle points now" in text for text in told) is not origin


def turned_by(link, seconds, rate, scale=1.0, north=0.0, begin=(1.0, 0.0)):
    """Feed a turning vehicle at 50 Hz; return time and heading at the end, and whether the link ever paused.

    `rate` is the vehicle's [rad/s], of which the gyroscope shows `scale`; `north` turns the autopilot's north [rad/s].
    """
    (now, yaw), auto, paused = begin, mavlink.MAVLink(None, 1, 1), False
    for _ in range(round(50 * seconds)):
        now, yaw = now + 0.02, yaw + 0.02 * (rate + north)
        shown = math.remainder(yaw, math.tau)
        for message in (
            mavlink.MAVLink_raw_imu_message(0, 0, 0, -1000, 0, 0, 0, 0, 0, 0),
            mavlink.MAVLink_scaled_pressure2_message(0, 1111.0, 0, 0),
            mavlink.MAVLink_attitude_message(round(1000 * now), 0.0, 0.0, shown, 0.0, 0.0, scale * rate),
        ):
            link.feed(now, bytes(message.pack(auto)))
        paused = paused or "turns its north" in link.pause(now)
    return (now, yaw), paused


def test_a_compass_that_is_read_late_does_not_turn_the_frame_of_the_start():
    """Without an origin world x is the vehicle's heading at the start, whatever the compass reads."""
    link, auto = MavlinkLink(HEAVY), mavlink.MAVLink(None, 1, 1)
    for message in SURFACE[:2]:
        link.feed(1.0, bytes(message.pack(auto)))
    (now, _), _ = turned_by(link, 1.0, 0.0)
    assert link._begun and any("no origin" in note for note in link.notes)
    turned_by(link, 1.0, 0.0, begin=(now, 1.2))
    assert float(quat_to_euler(link._q)[2]) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("scale", [0.96, 1.04])
def test_a_long_spin_with_an_inexact_gyroscope_is_no_turn_of_the_north(scale):
    """Ten turns at 73 deg/s, the recorded rate of a full stick, with an error of 4 % give 144 degrees. A later turn of
    north by 11.4 degrees in 20 s is detected, and its end too."""
    link, auto = MavlinkLink(HEAVY), mavlink.MAVLink(None, 1, 1)
    for message in SURFACE:
        link.feed(1.0, bytes(message.pack(auto)))
    rate = math.radians(73.2)
    state, paused = turned_by(link, 50.0, rate, scale)
    assert not paused
    for way in (-rate, rate):  # and back
        state, paused = turned_by(link, 8.0, way, scale, begin=state)
        assert not paused
    state, _ = turned_by(link, 12.0, 0.0, begin=state)
    state, paused = turned_by(link, 20.0, 0.0, north=math.radians(0.57), begin=state)
    assert paused
    state, _ = turned_by(link, 15.0, 0.0, begin=state)
    assert link.pause(state[0]) == ""


def test_a_goal_above_the_surface_by_the_pressure_is_refused_with_the_offset():
    """Calibrated at 5 kPa below the atmosphere, which is 0.51 m above the surface; a deeper goal, or a calibration
    during this run, is accepted."""
    link, auto = MavlinkLink(HEAVY), mavlink.MAVLink(None, 1, 1)
    for name in (b"BARO1_GND_PRESS", b"BARO2_GND_PRESS"):
        link.feed(1.0, bytes(mavlink.MAVLink_param_value_message(name, 96325.0, 9, 2, 0).pack(auto)))
    link.feed(1.0, bytes(mavlink.MAVLink_heartbeat_message(12, 3, 209, 19, 4, 3).pack(auto)))
    link._version, link._parameters["JS_GAIN_DEFAULT"] = (4, 5), 0.5
    assert any("0.5 m above the surface" in note for note in link.notes)
    link.highest = -0.3
    assert link.prepare(1.0) == (
        "a depth of 0.30 m is 0.21 m above the surface, since the autopilot counts depth from 0.5 m above the surface: "
        "bring the vehicle to the surface and give --calibrate-depth, or a goal below 0.51 m"
    )
    link.highest = -0.6
    assert link.prepare(1.0) == ""
    link.highest, link._calibrated = -0.3, "done"
    assert link.prepare(1.0) == ""


def test_a_quiet_instrument_has_not_frozen():
    """Whole milli-g may repeat for 2 s while attitude and rates change; attitude and rates that repeat are
    frozen."""
    runtime = Runtime(HEAVY, Perception(HEAVY, None), make_pilot("pid", HEAVY), Station(START, 0.0))
    link, auto = MavlinkLink(HEAVY), mavlink.MAVLink(None, 1, 1)
    runtime.attach(link)

    def play(begin, moving):
        for k in range(100):
            now = begin + 0.02 * k
            tilt = 1e-4 * k * moving
            for message in (
                mavlink.MAVLink_raw_imu_message(0, 0, 0, -1000, 0, 0, 0, 0, 0, 0),
                mavlink.MAVLink_scaled_pressure2_message(round(1000 * now), 1200.0 + 0.01 * k, 0, 0),
                mavlink.MAVLink_attitude_message(round(1000 * now), tilt, 0.0, 0.0, tilt, 0.0, 0.0),
            ):
                runtime.step(now, [(now, bytes(message.pack(auto)))])
        return runtime.bridge._watchdogs.fault_reason(now)

    assert "frozen" not in play(1.0, 1.0)
    assert "the quaternion and gyro has repeated" in play(3.0, 0.0)


def test_a_slow_simulation_is_named():
    """A simulation at half of real time is reported as such, and thrust waits."""
    link, auto = MavlinkLink(HEAVY), mavlink.MAVLink(None, 1, 1)
    for k in range(200):
        now = 0.04 * k
        for message in (
            mavlink.MAVLink_raw_imu_message(0, 0, 0, -1000, 0, 0, 0, 0, 0, 0),
            mavlink.MAVLink_scaled_pressure2_message(20 * k, 1200.0, 0, 0),
            mavlink.MAVLink_attitude_message(20 * k, 1e-5 * k, 0.0, 0.0, 0.0, 0.0, 0.0),
        ):
            link.feed(now, bytes(message.pack(auto)))
    assert link.clock_rate == pytest.approx(0.5, abs=0.02) and "0.50 times ours" in link.pause(now)


@pytest.mark.slow
def test_a_robot_that_starts_before_the_firmware_keeps_its_place():
    """The given start position still counts although the firmware is silent for the first 4 s."""
    begun = []

    def boot(pool):
        if not begun:
            begun.append(pool.firmware.reboot(2.5))
            pool.firmware._calibrate_at_start = False  # as if it had booted at the surface
        return send(pool)

    send = at(4.02, ORIGIN)
    runtime, pool, _, _, _ = drive(17.0, meanwhile=boot)
    assert runtime.counters.events and off(pool, (0.8, 0.3)) < 0.12


def test_telemetry_waits_for_the_pressure_at_the_surface():
    """Otherwise depth would step when it arrives; an autopilot that does not answer is waited for 3 s."""
    auto = mavlink.MAVLink(None, 1, 1)

    def depths(answered):
        link, found = MavlinkLink(HEAVY), []
        for k in range(200):
            now, sent = 0.02 * k, list(SURFACE) if answered and k == 50 else []
            sent += [
                mavlink.MAVLink_raw_imu_message(0, 0, 0, -1000, 0, 0, 0, 0, 0, 0),
                mavlink.MAVLink_scaled_pressure2_message(20 * k, 1111.45, 0, 0),
                mavlink.MAVLink_attitude_message(20 * k + 1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
            ]
            for message in sent:
                made = link.feed(now, bytes(message.pack(auto)))
                found += [(now, m.depth) for m in made if isinstance(m, Telemetry)]
        return np.array(found)

    assert depths(True)[0, 0] == pytest.approx(1.0, abs=0.03) and np.ptp(depths(True)[:, 1]) == 0.0
    assert depths(False)[0, 0] == pytest.approx(3.0, abs=0.05)


@pytest.mark.slow
def test_depth_is_calibrated_at_the_surface_before_arming():
    """After a restart at 2 m, depth counts from there and this is reported; once calibrated, the autopilot
    arms."""
    begun = []

    def boot(pool):
        if not begun:
            begun.append(pool.firmware.reboot(0.0))
        return ()

    runtime, pool, link, _, _ = drive(6.0, arm=False, meanwhile=boot)
    assert link.depth_offset == pytest.approx(2.0, abs=0.2)
    assert any("--calibrate-depth" in event.text for event in runtime.counters.events)
    runtime, pool, link, _, _ = drive(16.0, calibrate=True, goal=(0.0, 0.0, -0.3))
    assert pool.firmware.parameters["BARO2_GND_PRESS"] > 1.15e5 and link.depth_offset == pytest.approx(
        2.0, abs=0.2
    )
    kinds = [event.kind for event in runtime.counters.events]
    assert kinds.count("armed") == 1 and "fault" not in kinds
    assert pool.plant.position[2] == pytest.approx(-2.3, abs=0.15)  # 0.3 m below the depth of calibration


def test_only_an_autopilot_calibrates_its_depth():
    with (
        pytest.raises(LinkError, match="is for an autopilot"),
        connected(Wiring(robot="pool", calibrate_depth=True), HEAVY, None),
    ):
        pass


def test_a_heartbeat_from_before_its_disarming_arms_no_bridge():
    """After disarming and an immediate new request, an earlier heartbeat no longer counts as armed."""
    link, auto = MavlinkLink(HEAVY), mavlink.MAVLink(None, 1, 1)
    off = ThrusterCommand(False, (0.0,) * 8)
    armed = bytes(mavlink.MAVLink_heartbeat_message(12, 3, 209, 19, 4, 3).pack(auto))
    link._version, link._parameters = (4, 5), {"JS_GAIN_DEFAULT": 0.5}
    link.feed(10.0, armed)
    assert link.prepare(10.0) == ""
    link.encode(10.0, off, "armed")
    link.encode(10.1, off, "disarmed")
    link.feed(10.11, armed)  # in transit meanwhile
    assert "disarm" in link.prepare(10.12)
    link.feed(10.3, bytes(mavlink.MAVLink_heartbeat_message(12, 3, 81, 19, 3, 3).pack(auto)))
    assert link.prepare(10.7) == "waiting for it to arm"


def test_three_seconds_without_a_heartbeat_are_an_alarm():
    """With the last heartbeat at 10 s there is no alarm at 12.9 s, despite other messages, and an alarm at
    13.1 s."""
    link, auto = MavlinkLink(HEAVY), mavlink.MAVLink(None, 1, 1)
    link.feed(10.0, bytes(mavlink.MAVLink_heartbeat_message(12, 3, 209, 19, 4, 3).pack(auto)))
    link.feed(12.8, bytes(mavlink.MAVLink_attitude_message(10, 0, 0, 0, 0, 0, 0).pack(auto)))
    assert link.alarm(12.9) == ""
    assert link.alarm(13.1) == "no heartbeat from the autopilot for 3 s"


def test_signed_frames_pass_and_unsigned_ones_do_not():
    key = bytes(range(32))
    link, stranger = MavlinkLink(HEAVY, key=key), mavlink.MAVLink(None, 1, 1)
    beat = mavlink.MAVLink_heartbeat_message(12, 3, 81, 19, 3, 3)
    link.feed(1.0, bytes(beat.pack(stranger)))
    assert link.mode is None
    known = mavlink.MAVLink(None, 1, 1)
    known.signing.secret_key, known.signing.sign_outgoing = key, True
    link.feed(1.0, bytes(beat.pack(known)))
    assert link.mode == 19


@pytest.mark.parametrize(
    "address, parts",
    [
        ("mavlink", ("udpin", "127.0.0.1:14550", "127.0.0.1")),
        ("mavlink://udpin:0.0.0.0:14550?dvl=192.168.2.95", ("udpin", "0.0.0.0:14550", "192.168.2.95")),
        ("mavlink://tcp:127.0.0.1:5760", ("tcp", "127.0.0.1:5760", "")),
        ("mavlink://serial:/dev/ttyACM0,57600", ("serial", "/dev/ttyACM0,57600", "")),
    ],
)
def test_addresses(address, parts):
    found = MavlinkAddress.of(address)
    assert (found.kind, found.where, found.dvl) == parts


@pytest.mark.parametrize(
    "address", ["mavlink://", "mavlink://carrier:pigeon", "mavlink://udpin:", "mavlink://tcp:a:1?colour=red"]
)
def test_an_address_that_is_none_is_refused(address):
    if address == "mavlink://":
        assert MavlinkAddress.of(address).kind == "udpin"
        return
    with pytest.raises(LinkError, match="give mavlink://udpin"):
        MavlinkAddress.of(address)


def test_a_turned_imu_is_refused():
    with pytest.raises(LinkError, match="AHRS_ORIENTATION"):
        MavlinkLink(HEAVY.replace({"sensors.imu.orientation": [0.0, 0.0, 1.0, 0.0]}))


def test_it_waits_for_parameters_but_not_for_ever():
    """Three seconds after the first request to arm, by any clock, axes are sent as overrides."""
    link, auto = MavlinkLink(HEAVY), mavlink.MAVLink(None, 1, 1)
    beat = mavlink.MAVLink_heartbeat_message(12, 3, 81, 19, 3, 3)
    for now, waits in ((5000.0, True), (5002.5, True), (5003.5, False)):
        link.feed(now, bytes(beat.pack(auto)))
        assert ("version and parameters" in link.prepare(now)) == waits
