"""The link to an autopilot, against the emulated ArduSub in lock-step: it steers, and it lets go when it has to."""

import math
import re

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from finssim.control.guidance import Station
from finssim.geometry.rotations import quat_to_euler
from finssim.pool import VirtualPool, draw_plant
from finssim.pool.draw_plant import site_of
from finssim.robot.link.frames import LinkError
from finssim.robot.link.mavlink import MavlinkLink
from finssim.robot.link.transports import MavlinkAddress
from finssim.robot.lockstep import run_lockstep
from finssim.robot.messages import HEADING, VELOCITY, Delivery, NavigationAid, Telemetry, ThrusterCommand
from finssim.robot.perception import Perception
from finssim.robot.pilots import make_pilot
from finssim.robot.runtime import Runtime
from finssim.vehicles import load_vehicle
from finssim.vehicles.defaults import vehicle_at, with_navigation

HEAVY = with_navigation(vehicle_at("tank", load_vehicle("bluerov2_heavy")))
SPEC = site_of("tank", draw_plant(HEAVY, 1, "realistic"))
START = (0.0, 0.0, -2.0)
STOPPED = 0.5
"""Within which thrust has to be gone [s]."""


class Somebody:
    """Another ground station on the same wire, and what it does when."""

    def __init__(self, system=255):
        self.mav = mavlink.MAVLink(None, system, 190)
        self.deeds = []

    def does(self, start, message, every=0.04, until=math.inf):
        self.deeds.append([start, message, every, until])
        return self

    def turn(self, now):
        out = []
        for deed in self.deeds:
            start, message, every, until = deed
            if now >= start and now <= until:
                deed[0] = now + every
                out.append(bytes(message.pack(self.mav)))
                self.mav.seq = (self.mav.seq + 1) % 256
        return out


class World:
    """A pool with somebody else in it; keeps what truly happened."""

    def __init__(self, faults=(), somebody=None, **options):
        self.pool = VirtualPool(
            HEAVY, SPEC, firmware="ardusub", start=(START, (0, 0, 0, 1)), seed=1, **options
        )
        self.faults, self.somebody, self.rows, self.sent = list(faults), somebody, [], []

    def exchange(self, until, sent):
        for at, what in self.faults:
            if self.pool.time < at <= until:
                what(self.pool)
        more = self.somebody.turn(self.pool.time) if self.somebody else []
        self.sent += [(self.pool.time, frame) for frame in sent]
        delivery = self.pool.exchange(until, [*sent, *more])
        thrust = float(np.abs(self.pool.plant.thrust).max())
        self.rows.append(
            (self.pool.time, thrust, self.pool.firmware.armed, *self.pool.plant.position.tolist())
        )
        return Delivery(delivery.time, delivery.frames, delivery.pictures)

    def thrust_after(self, when):
        return max(row[1] for row in self.rows if row[0] >= when)

    def axes_sent_after(self, when):
        mav = mavlink.MAVLink(None)
        kinds = [m.get_type() for at, frame in self.sent if at >= when for m in mav.parse_buffer(frame) or ()]
        return sum(kind in ("MANUAL_CONTROL", "RC_CHANNELS_OVERRIDE") for kind in kinds)


def setting(name, value):
    return lambda pool: setattr(pool.faults, name, value)


def drive(seconds, *, arm=True, goal=(0.8, 0.3, -2.2), vehicle=HEAVY, key=b"", **world):
    world = World(**world)
    perception = Perception(vehicle, None, mode="error-state", let_in=START[:2])
    runtime = Runtime(
        vehicle, None, make_pilot("pid", vehicle), Station(goal, 0.4), arm=arm, perception=perception
    )
    link = MavlinkLink(vehicle, key=key)
    runtime.attach(link)
    faulted = []

    def show(runtime):
        if runtime.bridge.state == "fault" and not faulted:
            faulted.append(world.pool.time)

    run_lockstep(runtime, world, seconds, show=show)
    return runtime, world, link, faulted[0] if faulted else math.nan


@pytest.mark.slow
def test_a_pid_swims_to_its_goal_by_axes_and_doppler_log():
    """Armed by MAVLink, steered by axes, located by Doppler log, depth and compass; disarmed at the end."""
    runtime, world, link, _ = drive(20.0)
    assert runtime.bridge.state == "disarmed" and not world.pool.firmware.armed
    assert [event.kind for event in runtime.counters.events].count("armed") == 1
    np.testing.assert_allclose(world.rows[-1][3:], (0.8, 0.3, -2.2), atol=0.08)
    assert abs(float(quat_to_euler(world.pool.plant.quaternion.astype(float))[2]) - 0.4) < 0.05
    assert link.counts["velocity"] > 100 and link.counts["bad"] == 0


@pytest.mark.slow
def test_without_arm_nothing_arms_and_no_axis_is_sent():
    runtime, world, _, _ = drive(8.0, arm=False)
    assert not any(row[2] for row in world.rows) and world.thrust_after(0.0) == 0.0
    assert world.axes_sent_after(0.0) == 0
    assert runtime.reading.ready  # it knows where it is all the same


@pytest.mark.slow
def test_a_joystick_wins_at_once():
    """Somebody's stick under the same station's number: our axes end within half a second, theirs go on."""
    stick = mavlink.MAVLink_manual_control_message(1, 0, 0, 500, 400, 0)
    runtime, world, _, fault = drive(12.0, somebody=Somebody().does(6.0, stick))
    assert "somebody else steers" in runtime.bridge.reason and 6.0 < fault < 6.0 + STOPPED
    assert world.axes_sent_after(fault + 0.05) == 0
    assert world.pool.firmware.armed and world.thrust_after(11.0) > 1.0  # the stick still has it


@pytest.mark.slow
def test_a_mode_changed_from_outside_ends_it():
    mode = mavlink.MAVLink_command_long_message(1, 1, 176, 0, 1, 2, 0, 0, 0, 0, 0)
    runtime, world, _, fault = drive(10.0, somebody=Somebody().does(6.0, mode, until=6.05))
    assert "mode to ALT_HOLD" in runtime.bridge.reason and fault < 6.0 + STOPPED
    assert world.axes_sent_after(fault + 0.05) == 0
    armed = [row[0] for row in world.rows if row[2]]
    assert 8.0 < armed[-1] < 9.5  # nobody gives it a pilot's input any more: its own failsafe, 3 s later


@pytest.mark.slow
def test_disarmed_from_outside_it_stays_so():
    disarm = mavlink.MAVLink_command_long_message(1, 1, 400, 0, 0, 0, 0, 0, 0, 0, 0)
    runtime, world, _, _ = drive(10.0, somebody=Somebody().does(6.0, disarm, until=6.05))
    assert "was disarmed" in runtime.bridge.reason
    assert world.thrust_after(6.0 + STOPPED) == 0.0 and not any(row[2] for row in world.rows if row[0] > 6.5)


@pytest.mark.slow
def test_a_ground_station_that_only_looks_disturbs_nothing():
    beat = mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3)
    runtime, world, _, fault = drive(10.0, somebody=Somebody(254).does(0.0, beat, every=1.0))
    assert math.isnan(fault) and runtime.counters.decisions > 100


@pytest.mark.slow
def test_rates_that_another_station_lowers_are_asked_for_again():
    """Attitude at 2 Hz for everybody, as a ground station might want it: within 3 s there are 50 a second again."""
    slow = mavlink.MAVLink_command_long_message(1, 1, 511, 0, 30, 5e5, 0, 0, 0, 0, 0)
    runtime, world, link, fault = drive(4.0, arm=False, somebody=Somebody().does(2.0, slow, until=2.01))
    assert link.counts["ATTITUDE"] < 200
    before = link.counts["ATTITUDE"]
    runtime.attach(link)
    run_lockstep(runtime, world, 6.0, start=world.pool.time)
    assert link.counts["ATTITUDE"] - before > 150


@pytest.mark.slow
@pytest.mark.parametrize(
    "fault, sentence, limit",
    [
        (setting("no_heartbeat", True), "no heartbeat from the autopilot", 3.5 + STOPPED),
        (setting("drop", 1.0), "no fresh telemetry", 0.5 + STOPPED),
        (setting("leak", True), "failsafe|disarmed", 2.5),
        (setting("battery_voltage", 9.0), "failsafe|disarmed", 12.0),
        (setting("freeze_depth", True), "held longer than|no depth", 9.0),
        (setting("dvl_silent", True), "held longer than", 9.0),
        (lambda pool: pool.reboot(), "restarted|no fresh telemetry", 0.5 + STOPPED),
    ],
    ids=["heartbeat", "silence", "leak", "battery", "frozen depth", "no log", "reboot"],
)
def test_each_fault_ends_as_the_page_says(fault, sentence, limit):
    """The bridge stops for the reason named, no later than its limit, and thrust is gone with it."""
    runtime, world, _, stopped = drive(8.0 + limit, faults=[(6.0, fault)])
    assert re.search(sentence, runtime.bridge.reason), runtime.bridge.reason
    assert 6.0 < stopped < 6.0 + limit
    silent = "no fresh telemetry" in runtime.bridge.reason and world.pool.faults.drop == 1.0
    assert world.thrust_after(stopped + STOPPED) == 0.0
    assert not world.pool.firmware.armed or silent


@pytest.mark.slow
def test_frames_that_are_lost_and_spoiled_now_and_then_do_no_harm():
    def spoil(pool):
        pool.faults.drop, pool.faults.corrupt, pool.faults.drop_commands = 0.1, 0.1, 0.1

    runtime, world, link, fault = drive(20.0, faults=[(4.0, spoil)])
    assert math.isnan(fault) and link.counts["bad"] > 10
    np.testing.assert_allclose(world.rows[-1][3:], (0.8, 0.3, -2.2), atol=0.12)


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


def test_spoiled_frames_raise_nothing_and_arm_nothing():
    """A sample; benchmarks/fuzz_mavlink.py makes the million."""
    random, link = np.random.default_rng(0), MavlinkLink(HEAVY)
    auto = mavlink.MAVLink(None, 1, 1)
    whole = [
        bytes(m.pack(auto))
        for m in (
            mavlink.MAVLink_heartbeat_message(12, 3, 81, 19, 3, 3),
            mavlink.MAVLink_attitude_message(10, 0.1, 0.2, -0.3, 0.01, 0.02, 0.03),
            mavlink.MAVLink_statustext_message(4, b"words"),
            mavlink.MAVLink_param_value_message(b"JS_GAIN_DEFAULT", 0.5, 9, 3, 1),
        )
    ] + [b'{"type":"velocity","vx":1}\n']
    for k in range(3000):
        frame = bytearray(whole[k % len(whole)])
        for _ in range(random.integers(1, 6)):
            frame[random.integers(len(frame))] = random.integers(256)
        link.feed(0.01 * k, bytes(frame[: random.integers(1, len(frame) + 1)]))
        sent = link.encode(0.01 * k, ThrusterCommand(False, (0.0,) * 8), "disarmed")
        kinds = [m for data in sent for m in mavlink.MAVLink(None).parse_buffer(data) or ()]
        assert not any(m.get_type() == "COMMAND_LONG" and m.command == 400 for m in kinds)


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
