"""Physics for ArduSub's SITL: golden packets, lock-step rules, a stand-in as strict as SITL, and motion."""

import json
import math
import os
import select
import socket
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from finssim.cli import boundary
from finssim.cli.commands import app
from finssim.control.guidance import Station
from finssim.pool import ardusub
from finssim.pool.ardusub_sitl import (
    GRAVITY,
    Forwarder,
    Pulses,
    SitlServer,
    SitlWorld,
    decode_pulses,
    sitl_parameters,
    write_parameters,
)
from finssim.pool.plant_spec import Battery, PlantSpecError
from finssim.robot.links.frames import LinkError
from finssim.robot.links.transports import TcpServer
from finssim.robot.links.water_linked import DvlClient, DvlServer, decode_line
from finssim.sim import RectangularPool, Simulator, Water
from finssim.vehicles import load_vehicle

HEAVY = load_vehicle("bluerov2_heavy")
NEUTRAL = HEAVY.model_copy(
    update={"body": HEAVY.body.model_copy(update={"displaced_volume": HEAVY.body.mass / HEAVY.water.density})}
)
DEEP = Station((0.0, 0.0, -50.0), 0.0)
STILL = (1500,) * 16
PACKET = bytes.fromhex("1a48 9001 2a000000" + "dc05" * 15 + "6c07")
"""Magic 18458, 400 Hz, frame 42, fifteen channels at 1500 and the last at 1900, by hand."""


def mixed(**demands):
    """Return the pulses of ArduSub's VECTORED_6DOF mixer from its published table, all motors turning as
    wired."""
    table = {
        "roll": (0, 0, 0, 0, 1, -1, 1, -1),
        "pitch": (0, 0, 0, 0, -1, -1, 1, 1),
        "yaw": (1, -1, -1, 1, 0, 0, 0, 0),
        "throttle": (0, 0, 0, 0, -1, -1, -1, -1),
        "forward": (-1, -1, 1, 1, 0, 0, 0, 0),
        "lateral": (1, -1, 1, -1, 0, 0, 0, 0),
    }
    out = sum(demand * np.array(table[axis]) for axis, demand in demands.items())
    return (*(int(1500 + 400 * x) for x in out), *STILL[8:])


class StandIn:
    """SITL's side of the wire, as strict as the reference; `sitl_time` advances as SITL's clock would."""

    KEYS = (
        ("", "timestamp"), ("imu", "gyro"), ("imu", "accel_body"), ("", "position"), ("", "attitude"),
        ("", "quaternion"), ("", "velocity"), ("", "rng_1"), ("battery", "voltage"), ("battery", "current"),
    )  # fmt: skip
    """Section and name of each value that is read."""

    def __init__(self, address, rate=400, silence=1.0):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(0.1)
        self.address, self.rate, self.silence = address, rate, silence
        self.frame, self.sitl_time, self.timestamp = 0, 0.0, None
        self.buffer, self.sent, self.resets = b"", 0, 0

    def send(self, pulses):
        magic = {16: 18458, 32: 29569}[len(pulses)]
        packet = struct.pack(f"<HHI{len(pulses)}H", magic, self.rate, self.frame, *pulses)
        self.socket.sendto(packet, self.address)
        self.sent += 1

    def step(self, pulses=STILL):
        """Send one frame, poll every 100 ms, send again after a second of silence, and return the answer."""
        self.send(pulses)
        polls = 0
        while True:
            try:
                self.buffer += self.socket.recv(65536)
            except TimeoutError:
                polls += 1
                if polls >= 10 * self.silence:
                    self.send(pulses)
                    polls = 0
                continue
            found = self.parse()
            if found is not None:
                return self.advance(found)

    def parse(self):
        """Read only the text between the last two newlines; leave what follows the last one."""
        end = self.buffer.rfind(b"\n")
        begin = self.buffer.rfind(b"\n", 0, max(end, 0))
        if end < 0 or begin < 0:
            return None
        text, self.buffer = self.buffer[begin + 1 : end].decode("ascii"), self.buffer[end:]
        return {name: self.value(text, section, name) for section, name in self.KEYS if name in text}

    @staticmethod
    def value(text, section, name):
        """Find by plain search the section, the name after it, then a number or an array right after quote
        and colon."""
        at = text.index(section) + len(section)
        at = text.index(name, at) + len(name) + 2
        if text[at] != "[":
            assert text[at] in "-0123456789", f"{name}: {text[at : at + 8]!r} is read as 0"
            end = at
            while text[end] in "+-.e0123456789":
                end += 1
            return float(text[at:end])
        return [float(x) for x in text[at + 1 : text.index("]", at)].split(",")]

    def advance(self, found):
        dt = found["timestamp"] - (self.timestamp or 0.0)
        self.resets += dt < 0.0
        if 0.0 < dt < 0.1:
            self.sitl_time += dt
        self.timestamp = found["timestamp"]
        self.frame += 1
        return found


@pytest.fixture
def serving():
    """Function that starts a server in a thread until the test ends, and returns it."""
    running, threads = [True], []

    def start(world, **settings):
        server = SitlServer(world, ("127.0.0.1", 0), **settings)

        def loop():
            while running[0]:
                server.serve_once()
            server.close()

        threads.append(threading.Thread(target=loop))
        threads[-1].start()
        return server

    yield start
    running[0] = False
    for thread in threads:
        thread.join()


@pytest.fixture(scope="module")
def shared():
    """A neutral vehicle in open water that tests place as they need."""
    return SitlWorld(NEUTRAL, start=DEEP)


@pytest.fixture
def world(shared):
    shared.restart()
    return shared


def state_of(world):
    return json.loads(world.answer())


# The wire.


def test_the_golden_packets_of_both_sizes_are_read():
    """The packets are those of the reference, byte by byte."""
    assert decode_pulses(PACKET) == Pulses(400, 42, (*[1500] * 15, 1900))
    big = bytes.fromhex("8173 b004 00000100" + "4c04" * 32)
    assert decode_pulses(big) == Pulses(1200, 65536, (1100,) * 32)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "wrong magic"),
        (b"\x1a", "wrong magic"),
        (b"\x1b" + PACKET[1:], "wrong magic"),
        (PACKET[:-1], "wrong length"),
        (PACKET + b"\0", "wrong length"),
        (b"\x81\x73" + PACKET[2:], "wrong length"),
        (PACKET[:2] + b"\0\0" + PACKET[4:], "wrong rate"),
    ],
)
def test_other_packets_are_refused_with_a_word(data, reason):
    """The reason is returned and nothing is raised."""
    assert decode_pulses(data) == reason


def test_the_answer_of_a_vehicle_at_rest_is_this_line():
    """Every byte: newline, compact, the order of the names, specific force (0, 0, -9.80665), depth down,
    newline."""
    world = SitlWorld(
        NEUTRAL, pool=RectangularPool(length=10.0, width=6.0, depth=5.0), start=Station((1.0, 0.5, -2.0), 0.0)
    )
    assert world.answer() == (
        b'\n{"timestamp":0.0,"imu":{"gyro":[0.0,0.0,0.0],"accel_body":[0.0,0.0,-9.80665]},"position":[1.0,-0.5,2.0],'
        b'"attitude":[0.0,0.0,0.0],"quaternion":[1.0,0.0,0.0,0.0],"velocity":[0.0,0.0,0.0],'
        b'"battery":{"voltage":16.0,"current":0.6},"rng_1":3.0}\n'
    )


def test_the_strict_parser_reads_what_a_json_reader_reads(world):
    """This holds in every field, for a moving and turning vehicle."""
    for _ in range(50):
        world.step(mixed(forward=0.7, yaw=0.4, roll=0.5, throttle=-0.6), 100)
    line, client = world.answer(), StandIn(("127.0.0.1", 9))
    client.buffer = line
    found, state = client.parse(), json.loads(line)
    assert found.pop("voltage") == state["battery"]["voltage"]
    assert found.pop("current") == state["battery"]["current"] > 1.0
    assert found == {k: v for k, v in (state | state.pop("imu")).items() if k not in ("battery", "imu")}
    client.buffer = line[1:]
    assert client.parse() is None, "without the first newline nothing is read"
    client.socket.close()


# Lock-step.


def test_equal_counts_are_answered_without_stepping_lower_ones_start_again_gaps_go_on(world):
    """These are the rules of the reference; the first frame may have any count."""
    server = SitlServer(world, ("127.0.0.1", 0))
    full = mixed(throttle=-1.0)
    first = server.answer(Pulses(400, 7, full))
    assert server.answer(Pulses(400, 7, STILL)) == first and world.time == pytest.approx(1 / 400)
    server.answer(Pulses(400, 8, full))
    server.answer(Pulses(400, 11, full))
    assert world.time == pytest.approx(3 / 400)
    assert server.answer(Pulses(400, 0, full)) == first
    assert server.counts == {"frames": 4, "repeats": 1, "gaps": 1, "restarts": 1}
    server.answer(Pulses(400, 5, full))  # a process that starts skips counts, and loses no answer
    assert server.counts["gaps"] == 1
    server.close()


def test_a_restarted_world_repeats_itself(world):
    """The same pulses give the same bytes."""
    runs = []
    for _ in range(2):
        for _ in range(100):
            world.step(mixed(forward=0.5, yaw=0.3), 400)
        runs.append(world.answer())
        world.restart()
    assert runs[0] == runs[1]


@pytest.mark.slow
def test_sitl_goes_through_four_hundred_frames_in_a_second_of_its_clock(world, serving):
    """Each frame is answered once, SITL's clock and the world's agree, and its channels move the vehicle."""
    server = serving(world)
    client = StandIn(server.address)
    for _ in range(400):
        state = client.step(mixed(throttle=-1.0))
    assert client.sitl_time == pytest.approx(1.0, abs=1e-9) and client.resets == 0
    assert state["position"][2] > 50.3 and state["velocity"][2] > 0.5
    assert server.counts == {"frames": 400} and client.sent == 400
    client.socket.close()


def test_sitl_with_32_channels_is_answered(world, serving):
    """Channels beyond 16 drive nothing here."""
    client = StandIn(serving(world).address)
    assert client.step((1500,) * 32)["timestamp"] == pytest.approx(1 / 400)
    client.socket.close()


def test_packets_that_wait_get_one_answer(world):
    """SITL takes one answer per frame: a frame that was repeated while the server was slow is answered once."""
    server = SitlServer(world, ("127.0.0.1", 0))
    client = StandIn(server.address)
    for pulses in (STILL, STILL, mixed(throttle=-1.0)):
        client.send(pulses)
    time.sleep(0.02)
    server.serve_once()
    assert world.simulator.numpy("thrust")[0, 0, 4] > 0.0, "the newest one counts"
    assert client.socket.recv(65536).startswith(b'\n{"timestamp":0.0025')
    with pytest.raises(TimeoutError):
        client.socket.recv(65536)
    assert server.counts == {"frames": 1, "repeats": 2}
    client.socket.close()
    server.close()


def test_bad_packets_and_strangers_are_counted_and_not_answered(world):
    """After SITL has been silent for a while another peer may connect, as after its restart."""
    now = [0.0]
    server = SitlServer(world, ("127.0.0.1", 0), clock=lambda: now[0])
    client, other = StandIn(server.address), StandIn(server.address)
    client.send(STILL)
    time.sleep(0.02)
    server.serve_once()
    other.send(STILL)
    for data in (b"", b"hello", PACKET[:10], bytes(3000)):
        other.socket.sendto(data, server.address)
    time.sleep(0.02)
    server.serve_once()
    assert server.counts == {"frames": 1, "stranger": 1, "wrong magic": 3, "wrong length": 1}
    now[0] = 2.0
    other.send(STILL)
    time.sleep(0.02)
    server.serve_once()
    assert other.socket.recv(65536)
    for end in (client.socket, other.socket, server):
        end.close()


def test_a_taken_port_is_refused(world):
    """The refusal says what to do."""
    server = SitlServer(world, ("127.0.0.1", 0))
    with pytest.raises(LinkError, match="for SITL"):
        SitlServer(world, server.address)
    server.close()


# Motion.


def test_free_decay_is_the_simulators(world):
    """With the motors off the state equals that of a `Simulator` stepped directly, to the last bit."""
    other = Simulator(NEUTRAL, control_step=1 / 400, substeps=1, threads=1)
    for simulator in (world.simulator, other):
        simulator.place((0.0, 0.0, -50.0), (0.0, 0.1, 0.0, 0.995), (0.8, -0.3, 0.2, 0.3, -0.2, 0.5))
    for _ in range(200):
        world.step(STILL, 400)
        other.step()
    for name in ("position", "quaternion", "velocity"):
        np.testing.assert_array_equal(world.simulator.numpy(name), other.numpy(name))


def test_a_buoyant_vehicle_rises_at_its_terminal_speed():
    """d1 w + d2 w² equals its net buoyancy; up is negative down, and at constant speed the specific force is
    that of rest."""
    body = HEAVY.body.model_copy(update={"displaced_volume": 0.0142})
    world = SitlWorld(HEAVY.model_copy(update={"body": body}), start=DEEP)
    for _ in range(1000):
        world.step((0,) * 16, 100)
    net = 9.82 * (1000.0 * 0.0142 - 13.5)
    w = (-33.0 + math.sqrt(33.0**2 + 4.0 * 190.0 * net)) / (2.0 * 190.0)
    state = state_of(world)
    assert state["velocity"] == pytest.approx([0.0, 0.0, -w], abs=1e-4)
    assert state["imu"]["accel_body"] == pytest.approx([0.0, 0.0, -GRAVITY], abs=1e-3)


def test_forward_moves_it_along_its_heading():
    """Turned 30° to the left, which is -30° in NED, it moves north and west."""
    world = SitlWorld(NEUTRAL, start=Station((0.0, 0.0, -50.0), math.radians(30.0)))
    assert state_of(world)["attitude"][2] == pytest.approx(math.radians(-30.0), abs=1e-6)
    for _ in range(100):
        world.step(mixed(forward=0.4), 100)
    north, east, _ = state_of(world)["velocity"]
    assert math.degrees(math.atan2(east, north)) == pytest.approx(-30.0, abs=0.5)
    assert math.hypot(north, east) > 0.2


def test_a_quarter_turn_to_the_right_points_east(world):
    """Yaw demand is clockwise from above: gyro z and yaw grow; then forward moves it east."""
    while (yaw := state_of(world)["attitude"][2]) < math.pi / 2:
        assert yaw > -0.01 and world.time < 10.0
        world.step(mixed(yaw=0.3), 100)
    state = state_of(world)
    assert state["imu"]["gyro"][2] > 0.1
    half = 0.5 * state["attitude"][2]
    assert state["quaternion"] == pytest.approx([math.cos(half), 0.0, 0.0, math.sin(half)], abs=0.01)
    for _ in range(50):
        world.step(mixed(forward=0.5), 100)
    north, east, _ = state_of(world)["velocity"]
    assert east > 0.2 and abs(north) < east


@pytest.mark.parametrize(("axis", "index"), [("roll", 0), ("pitch", 1)])
def test_roll_and_pitch_turn_as_ardusub_means_them(world, axis, index):
    """Right side down and nose up are positive."""
    for _ in range(20):
        world.step(mixed(**{axis: 0.5}), 100)
    state = state_of(world)
    assert state["imu"]["gyro"][index] > 0.05 and state["attitude"][index] > 0.01


def test_velocity_is_the_integral_of_the_specific_force(world):
    """ArduPilot's navigation equation, v_dot = R f + g with its g, holds through a turning, pitching dive."""
    rate, v = 400, np.zeros(3)
    for _ in range(400):
        world.step(mixed(forward=0.6, throttle=-0.5, yaw=0.3, pitch=0.2), rate)
        state = state_of(world)
        w, x, y, z = state["quaternion"]
        R = np.array([
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ])  # fmt: skip
        v += (R @ state["imu"]["accel_body"] + [0.0, 0.0, GRAVITY]) / rate
    assert v == pytest.approx(state["velocity"], abs=0.02)
    assert np.linalg.norm(v) > 0.3


def test_pulses_make_the_published_thrusts_at_the_batterys_voltage():
    """1900 µs at 16 V gives the thrust of the T200's table; an empty battery gives less, and a loaded one
    sags."""
    stiff = SitlWorld(NEUTRAL, start=DEEP)
    weak = SitlWorld(NEUTRAL, start=DEEP, battery=Battery(full_voltage=13.0, resistance=0.02))
    pulses = (1900, 1100, 1500, 1520, 0, 1500, 1500, 1500)
    for world in (stiff, weak):
        for _ in range(50):
            world.step(pulses, 100)
    strong, faint = (w.simulator.numpy("thrust")[0, 0] for w in (stiff, weak))
    assert strong[:5] == pytest.approx([50.8, -39.0, 0.0, 0.0, 0.0], abs=0.6)
    assert 0.0 < faint[0] < 0.8 * strong[0]
    assert weak.voltage == pytest.approx(13.0 - 0.02 * weak.current) and weak.current > 3.0


def test_a_frame_rate_that_glides_keeps_time_and_motion(world):
    """SITL changes its rate by 1 Hz per frame; the motion equals that at a fixed rate."""
    elapsed = 0.0
    for rate in range(1200, 399, -1):
        world.step(mixed(forward=0.3), rate)
        elapsed += 1.0 / rate
    assert world.time == pytest.approx(elapsed)
    assert int(world.simulator.numpy("steps")[0]) == pytest.approx(400 * elapsed, abs=2)
    glided = state_of(world)
    world.restart()
    while world.time < elapsed:
        world.step(mixed(forward=0.3), 400)
    assert state_of(world)["velocity"] == pytest.approx(glided["velocity"], abs=0.005)


def test_current_carries_it_away():
    """A drifting vehicle reaches the water's velocity, in NED."""
    world = SitlWorld(NEUTRAL, start=DEEP, water=Water(current=(0.2, 0.1, 0.0), depth=60.0))
    for _ in range(600):
        world.step(STILL, 20)
    assert state_of(world)["velocity"] == pytest.approx([0.2, -0.1, 0.0], abs=0.02)


def test_the_doppler_log_beside_it_measures_the_same_world():
    """Velocities in the log's own axes, altitude, and its latency as age come at 8 Hz of the world's clock."""
    log = DvlServer(("127.0.0.1", 0))
    client = DvlClient(*log.address)
    pool, water = (
        RectangularPool(length=50.0, width=50.0, depth=5.0),
        Water(current=(0.2, 0.4, 0.0), depth=5.0),
    )
    world = SitlWorld(NEUTRAL, pool=pool, water=water, start=Station((0.0, 0.0, -3.5), 0.0), dvl=log)
    while not client.connected:
        client.receive()
    log.poll()
    for _ in range(200):
        world.step(mixed(throttle=0.2), 100)
    time.sleep(0.05)
    lines = client.receive()
    aids = [aid for line in lines if (aid := decode_line(line)) is not None]
    assert len(aids) == 16 and len(lines) - 16 == pytest.approx(10, abs=2)  # local positions at 5 Hz
    assert aids[-1].age == pytest.approx(0.06, abs=0.011)
    nu = world.simulator.numpy("velocity")[0, 0, :3]
    assert nu.min() > 0.1
    assert aids[-1].values == pytest.approx(nu.tolist(), abs=0.05)
    assert aids[-1].altitude == pytest.approx(5.0 + world.simulator.numpy("position")[0, 0, 2], abs=0.1)
    client.close()
    log.close()


class Autopilot:
    """ArduSub's end of a serial port over TCP; it accepts an origin once, and keeps what it receives."""

    def __init__(self):
        self.server, self.mav = TcpServer(("127.0.0.1", 0), bytearray), mavlink.MAVLink(None)
        self.out, self.deltas, self.origins, self.asked = mavlink.MAVLink(None, 1, 1), [], [], 0

    def restart(self):
        self.origins.clear()

    def poll(self):
        for client, _, data in self.server.receive():
            for message in self.mav.parse_buffer(data):
                self.asked += message.get_type() == "COMMAND_LONG"
                if message.get_type() == "VISION_POSITION_DELTA":
                    self.deltas.append(message)
                elif message.get_type() == "SET_GPS_GLOBAL_ORIGIN" and not self.origins:
                    self.origins.append((message.latitude, message.longitude))
                    report = mavlink.MAVLink_gps_global_origin_message(*self.origins[0], 0)
                    self.server.send(bytes(report.pack(self.out)), client)


def until(done, *turns):
    """Call the turns until done, for at most 20 s."""
    end = time.monotonic() + 20.0
    while not done() and time.monotonic() < end:
        for turn in turns:
            turn()
        time.sleep(0.002)
    assert done()


def test_ardusub_gets_its_origin_and_the_velocities_of_the_log():
    """One origin per start of SITL; displacement since the last report, forward-right-down, with confidence; none
    after a gap, and none faster than 20 Hz."""
    autopilot = Autopilot()
    forwarder = Forwarder(autopilot.server.address)
    until(lambda: forwarder.counts["origins"] == 1, forwarder.poll, autopilot.poll)
    assert autopilot.origins == [(338103130, -1183938670)] and autopilot.asked == 1
    for at in (1.0, 1.1, 1.13, 1.2, 3.0, 3.1):
        forwarder.velocity(at, np.array([0.5, -0.2, 0.1]), 0.1)
    until(lambda: len(autopilot.deltas) == 3, autopilot.poll)
    for message in autopilot.deltas:
        assert message.time_delta_usec == 100_000
        assert message.position_delta == pytest.approx([0.05, 0.02, -0.01], rel=1e-5)
        assert message.confidence == pytest.approx(75.0)
    assert [message.time_usec for message in autopilot.deltas] == [1_100_000, 1_200_000, 3_100_000]
    autopilot.restart()
    forwarder.restart()
    until(lambda: forwarder.counts["origins"] == 2, forwarder.poll, autopilot.poll)
    forwarder.close()
    autopilot.server.close()


def test_both_ends_may_start_again(shared):
    """After a silence SITL's new process counts from 0 from another port, and world and origin start again. A new
    physics process accepts the frame that SITL is sending: its time goes back once, which SITL calls a physics reset.
    """
    shared.restart()
    now, pulses = [0.0], mixed(throttle=-1.0)
    server = SitlServer(shared, ("127.0.0.1", 0), clock=lambda: now[0])
    restarted = []
    server.forwarder = SimpleNamespace(restart=lambda: restarted.append(1), poll=lambda: None)

    def frames(client, count):
        for _ in range(count):
            client.send(pulses)
            until(lambda: select.select([client.socket], [], [], 0.0)[0], server.serve_once)
            client.buffer += client.socket.recv(65536)
            client.advance(client.parse())
            now[0] += 1 / 400

    first = StandIn(server.address)
    frames(first, 40)
    assert first.sitl_time == pytest.approx(0.1) and first.frame == 40
    second = StandIn(server.address)  # after the reboot that VISO_TYPE needs
    now[0] += 4.0
    frames(second, 20)
    assert restarted == [1] and second.timestamp == pytest.approx(0.05) and second.resets == 0
    assert server.counts == {"frames": 60, "restarts": 1}
    address = server.address
    server.close()
    shared.restart()
    server = SitlServer(shared, address)
    frames(second, 20)
    assert second.resets == 1 and second.frame == 40 and second.timestamp == pytest.approx(0.05)
    assert server.counts == {"frames": 20}
    for end in (first.socket, second.socket, server):
        end.close()


@pytest.mark.slow
def test_a_session_by_the_commands_of_the_page(tmp_path, capsys):
    """A stand-in for ArduSub flies by its own position from the forwarded log; SIGTERM ends the physics with
    its summary, and the true motion scores the record."""
    with socket.socket() as one, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        one.bind(("127.0.0.1", 0))
        other.bind(("127.0.0.1", 0))
        tcp, udp = one.getsockname()[1], other.getsockname()[1]
    program = tmp_path / "ardusub"
    script = Path(__file__).parents[1] / "reference/ardusub_standin.py"
    program.write_text(f'#!/bin/sh\nexec {sys.executable} {script} {tcp} "$@"\n')
    program.chmod(0o755)
    slowly = os.environ | {"FINSSIM_CLOCK_RATE": "0.3"}
    finssim = [sys.executable, "-m", "finssim"]
    physics = [*finssim, *"ardusub-sitl --vehicle bluerov2_heavy --site tank --truth truth.mcap".split(),
               "--exec", "./ardusub", "--dvl", "127.0.0.1:0", "--bind", f"127.0.0.1:{udp}",
               "--mavlink", f"127.0.0.1:{tcp + 2}"]  # fmt: skip
    drive = [*finssim, "run", "--robot", f"mavlink://tcp:127.0.0.1:{tcp}", "--vehicle", "bluerov2_heavy",
             *"--site tank --pool-file none --let-in 0,0 --policy pid --goal 0.4,0,-0.6,0 --arm --duration 7".split(),
             "--record", "run.mcap"]  # fmt: skip
    process = subprocess.Popen(physics, cwd=tmp_path, env=slowly, stdout=subprocess.PIPE, text=True)
    try:
        run = subprocess.run(drive, cwd=tmp_path, env=slowly, capture_output=True, text=True, timeout=300.0)
        process.terminate()
        told, _ = process.communicate(timeout=60.0)
    finally:
        process.kill()
    assert run.returncode == 0, run.stderr
    assert process.returncode == 0 and "1 origins" in told and " velocities" in told
    score = f"evaluate {tmp_path}/run.mcap --task t1 --vehicle bluerov2_heavy --truth {tmp_path}/truth.mcap --json"
    assert boundary.run(app, score.split()) == 0
    (trial,) = json.loads(capsys.readouterr().out)["per_trial"]
    assert trial["localization"]["position_m"] < 0.15 and trial["fault"] in ("", "ended early")


@pytest.mark.slow
def test_the_command_serves_until_its_time_is_over(capsys, tmp_path, monkeypatch):
    """Its options reach the world, it prints how to start SITL, and it ends with a summary."""
    monkeypatch.chdir(tmp_path)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        address = free.getsockname()
    client, states = StandIn(address, silence=0.3), []
    thread = threading.Thread(target=lambda: states.extend(client.step() for _ in range(20)))
    thread.start()
    words = (
        "ardusub-sitl --site open-water --start 1,2,-3,90 --duration 0.05 --wave 0.5,20,90 --dvl 127.0.0.1:0"
    )
    assert boundary.run(app, [*words.split(), "--bind", f"127.0.0.1:{address[1]}"]) == 0
    thread.join(5.0)
    assert states[0]["position"] == pytest.approx([1.0, -2.0, 3.0], abs=0.01)
    assert states[0]["attitude"][2] == pytest.approx(-math.pi / 2, abs=0.01)
    north, east, _ = states[-1]["velocity"]
    assert east < -0.01 and abs(north) < 0.1 * abs(east), "carried by a wave that travels to the left, west"
    assert states[0]["rng_1"] == pytest.approx(17.0, abs=0.01)
    told = capsys.readouterr().out
    assert "20 frames" in told and f"--model JSON:127.0.0.1 --sim-port-out {address[1]}" in told
    assert "VISO_TYPE 1\n" in (tmp_path / "finssim.parm").read_text()
    client.socket.close()


@pytest.mark.parametrize(
    "version, there, missing",
    [
        ("4.1", ["SIM_GPS_DISABLE 1", "BARO_SPEC_GRAV 1.024"], ["ORIGIN_LAT", "SIM_GPS1_ENABLE"]),
        (
            "4.5",
            ["SIM_GPS_DISABLE 1", "GPS_TYPE 0"],
            ["SIM_GPS1_ENABLE", "VISO_TYPE", "ORIGIN_LAT"],
        ),
        ("4.6", ["SIM_GPS1_ENABLE 0", "GPS1_TYPE 0"], ["SIM_GPS_DISABLE", "SURFACE_MAX_THR"]),
        ("4.7", ["SIM_GPS1_ENABLE 0", "SURFACE_MAX_THR 1"], ["SIM_GPS_DISABLE"]),
    ],
)
def test_each_version_gets_its_parameters(version, there, missing, tmp_path):
    """The names for 4.5 are those of the recorded version; a file of another version is not replaced."""
    path = tmp_path / "a.parm"
    for _ in range(2):
        write_parameters(path, sitl_parameters(load_vehicle("bluerov2_heavy"), version, dvl=False))
    text = path.read_text()
    assert all(line + "\n" in text for line in there) and not any(name in text for name in missing)
    assert "FRAME_CONFIG 2\n" in text
    if version == "4.5":
        known = {line.split(",")[0] for line in ardusub.PARAMETERS.read_text().splitlines()}
        names = {line.split()[0] for line in text.splitlines()[1:]}
        assert names <= known
    path.write_text("FRAME_CONFIG 1\n")
    with pytest.raises(PlantSpecError, match="was not written by finssim"):
        write_parameters(path, {})


@pytest.mark.slow
def test_one_command_starts_and_ends_sitl(tmp_path, monkeypatch, capsys):
    """A program that logs its arguments replaces SITL; SIGTERM ends both with the summary."""
    program = tmp_path / "sitl"
    program.write_text('#!/bin/sh\necho "$@" > started\nexec sleep 60\n')
    program.chmod(0o755)
    command = [sys.executable, "-m", "finssim", "ardusub-sitl", "--bind", "127.0.0.1:0", "--exec", "./sitl"]
    process = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, text=True)
    try:
        end = time.monotonic() + 60.0
        while not (tmp_path / "started").exists() and time.monotonic() < end:
            time.sleep(0.05)
        process.terminate()
        told, _ = process.communicate(timeout=60.0)
    finally:
        process.kill()
    assert process.returncode == 0 and "ended after 0.0 s: SITL sent nothing" in told
    words = (tmp_path / "started").read_text()
    assert "--model JSON:127.0.0.1" in words and str(tmp_path / "finssim.parm") in words


def test_the_imu_has_the_files_noise_and_repeats_it(world):
    """At rest, rates scatter by the density times the root of the sample rate; a restart draws the same
    noise."""
    noisy = SitlWorld(NEUTRAL, start=Station((0.0, 0.0, -1.0), 0.0), noise=True, seed=3)
    noisy.step(STILL, 400)

    def rates():
        noisy.restart()
        return np.array([json.loads(noisy.answer())["imu"]["gyro"] for _ in range(400)])

    first = rates()
    expected = NEUTRAL.sensors.imu.gyro_noise_density * math.sqrt(400)
    assert first.std() == pytest.approx(expected, rel=0.1)
    np.testing.assert_array_equal(rates(), first)


@pytest.mark.parametrize(
    "words",
    [
        "--site moon",
        "--current 1,2",
        "--wave 1,nan,2",
        "--bind here",
        "--vehicle finsrov",
        "--start up",
        pytest.param("--exec ./nothing --bind 127.0.0.1:0", marks=pytest.mark.slow),
    ],
)
def test_the_command_refuses_what_cannot_be(words, capsys, tmp_path, monkeypatch):
    """Each invalid option is refused in one sentence."""
    monkeypatch.chdir(tmp_path)
    assert boundary.run(app, ["ardusub-sitl", *words.split()]) == 2
    assert "Traceback" not in capsys.readouterr().err
