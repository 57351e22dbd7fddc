"""The link to an autopilot, against the emulated ArduSub in lock-step; `studies.faults` tests how it ends."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from finssim.control.guidance import Station
from finssim.core.rotations import quat_to_euler
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
from finssim.vehicles import load_vehicle
from finssim.vehicles.defaults import vehicle_at, with_navigation

HEAVY = with_navigation(vehicle_at("tank", load_vehicle("bluerov2_heavy")))
SPEC = site_of("tank", draw_plant(HEAVY, 1, "realistic"))
START = (0.0, 0.0, -2.0)


def drive(seconds, *, arm=True, goal=(0.8, 0.3, -2.2)):
    """A PID in lock-step with the pool; the runtime, what truly happened, the link and what it sent."""
    pool = VirtualPool(HEAVY, SPEC, firmware="ardusub", start=(START, (0, 0, 0, 1)), seed=1)
    perception = Perception(HEAVY, None, mode="error-state", let_in=START[:2])
    runtime = Runtime(
        HEAVY, None, make_pilot("pid", HEAVY), Station(goal, 0.4), arm=arm, perception=perception
    )
    link, sent, rows = MavlinkLink(HEAVY), [], []
    runtime.attach(link)

    def exchange(until, frames):
        sent.extend(frames)
        rows.append((pool.firmware.armed, float(np.abs(pool.plant.thrust).max())))
        return pool.exchange(until, frames)

    run_lockstep(runtime, SimpleNamespace(exchange=exchange), seconds)
    return runtime, pool, link, np.array(rows), sent


@pytest.mark.slow
def test_a_pid_swims_to_its_goal_by_axes_and_doppler_log():
    """Armed by MAVLink, steered by axes, located by Doppler log, depth and compass; disarmed at the end."""
    runtime, pool, link, _, _ = drive(20.0)
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
    assert runtime.reading.ready  # it knows where it is all the same


def test_an_older_firmware_is_steered_by_overrides_and_a_small_gain_too():
    """The same thrusts, whatever carries the axes."""
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


def test_axes_and_attitude_turn_from_its_frame_to_ours():
    """Nose up and right side down in the autopilot's axes: pitch below zero, roll above; specific force points up."""
    link = MavlinkLink(HEAVY)
    auto = mavlink.MAVLink(None, 1, 1)
    made = []
    for message in (
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
    assert heading.kind == HEADING and heading.values[0] == pytest.approx(0.3, abs=1e-6)


def test_a_specific_force_beyond_the_instruments_range_is_left_out():
    """The one before it is used on."""
    link, auto = MavlinkLink(HEAVY), mavlink.MAVLink(None, 1, 1)
    for z in (-1000, -32021):
        link.feed(1.0, bytes(mavlink.MAVLink_raw_imu_message(0, 0, 0, z, 0, 0, 0, 0, 0, 0).pack(auto)))
    assert link._accel == pytest.approx((0.0, 0.0, 9.80665)) and link.counts["implausible"] == 1


def test_its_own_velocity_counts_where_no_log_speaks():
    """North 0.4 m/s with the nose north-east is forward and left; only while its filter says that it knows."""
    link = MavlinkLink(HEAVY)
    auto = mavlink.MAVLink(None, 1, 1)
    moving = mavlink.MAVLink_local_position_ned_message(10, 0, 0, 0, 0.4, 0.0, 0.0)
    turned = mavlink.MAVLink_attitude_message(10, 0.0, 0.0, math.pi / 4, 0, 0, 0)
    rest = (mavlink.MAVLink_raw_imu_message(0, 0, 0, -1000, 0, 0, 0, 0, 0, 0),
            mavlink.MAVLink_scaled_pressure2_message(10, 1013.25, 0, 0), turned)  # fmt: skip
    for message in rest:
        link.feed(1.0, bytes(message.pack(auto)))
    assert link.feed(1.0, bytes(moving.pack(auto))) == []
    link.feed(1.0, bytes(mavlink.MAVLink_ekf_status_report_message(2, 0, 0, 0, 0, 0).pack(auto)))
    (aid,) = link.feed(1.1, bytes(moving.pack(auto)))
    assert aid.kind == VELOCITY
    np.testing.assert_allclose(aid.values, (0.4 / math.sqrt(2), 0.4 / math.sqrt(2), 0.0), atol=1e-6)


def test_a_heartbeat_from_before_its_disarming_arms_no_bridge():
    """Disarmed and asked for again at once: what it said a moment ago no longer holds."""
    link, auto = MavlinkLink(HEAVY), mavlink.MAVLink(None, 1, 1)
    off = ThrusterCommand(False, (0.0,) * 8)
    armed = bytes(mavlink.MAVLink_heartbeat_message(12, 3, 209, 19, 4, 3).pack(auto))
    link._version, link._parameters = (4, 5), {"JS_GAIN_DEFAULT": 0.5}
    link.feed(10.0, armed)
    assert link.prepare(10.0) == ""
    link.encode(10.0, off, "armed")
    link.encode(10.1, off, "disarmed")
    link.feed(10.11, armed)  # on its way meanwhile
    assert "disarm" in link.prepare(10.12)
    link.feed(10.3, bytes(mavlink.MAVLink_heartbeat_message(12, 3, 81, 19, 3, 3).pack(auto)))
    assert link.prepare(10.7) == "waiting for it to arm"


def test_three_seconds_without_a_heartbeat_are_an_alarm():
    """Armed and heard at 10 s: nothing at 12.9 s, whatever else arrives meanwhile, and an alarm at 13.1 s."""
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
    """Whatever the clock says: three seconds from the first wish to arm; then axes go out as overrides."""
    link, auto = MavlinkLink(HEAVY), mavlink.MAVLink(None, 1, 1)
    beat = mavlink.MAVLink_heartbeat_message(12, 3, 81, 19, 3, 3)
    for now, waits in ((5000.0, True), (5002.5, True), (5003.5, False)):
        link.feed(now, bytes(beat.pack(auto)))
        assert ("version and parameters" in link.prepare(now)) == waits
