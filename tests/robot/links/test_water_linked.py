"""Water Linked DVL lines: the published example, FinsSim's axes, ages, hostile input, and both ends of the
connection."""

import json
import math
import random
import re
import socket
import time
import urllib.error
import urllib.request
from collections import Counter

import numpy as np
import pytest

from finssim.core.rotations import quat_from_yaw
from finssim.robot.links import water_linked
from finssim.robot.links.frames import LinkError
from finssim.robot.links.water_linked import (
    DeadReckoning,
    DvlClient,
    DvlServer,
    decode_line,
    encode_velocity,
    serve_about,
)
from finssim.robot.messages import VELOCITY

REPORT = {
    "time": 106.39, "vx": 0.5, "vy": 0.25, "vz": -0.125, "fom": 1.6e-4,
    "covariance": [[2.4e-8, 0.0, 0.0], [0.0, 1.5e-8, 0.0], [0.0, 0.0, 1.6e-9]], "altitude": 0.495,
    "transducers": [
        {"id": i, "velocity": 1e-4, "distance": 0.55, "rssi": -30.5, "nsd": -88.7, "beam_valid": True}
        for i in range(4)
    ],
    "velocity_valid": True, "tracking_mode": "bottom", "status": 0, "format": "json_v3.2", "type": "velocity",
    "time_of_validity": 1638191471563017, "time_of_transmission": 1638191471752336,
}  # fmt: skip
"""A report as in the protocol's documentation, with velocities large enough to check their signs."""


def line(**changes):
    return json.dumps(REPORT | changes, separators=(",", ":")).encode()


def test_the_published_report_becomes_a_velocity_in_our_axes_with_the_logs_own_age():
    """Right and down of the log are left and up of the vehicle, rotated; 189.319 ms passed from reflection to
    sending."""
    aid = decode_line(line())
    assert (aid.kind, aid.values) == (VELOCITY, (0.5, -0.25, 0.125))
    assert aid.age == pytest.approx(0.189319, abs=1e-9)
    assert (aid.altitude, aid.fom) == (0.495, 1.6e-4)


@pytest.mark.parametrize(
    ("version", "without"),
    [
        ("json_v1", ("type", "time_of_validity", "time_of_transmission", "covariance")),
        (None, ("type", "format", "time_of_validity", "time_of_transmission", "covariance")),
        ("json_v2", ("time_of_validity", "time_of_transmission", "covariance")),
    ],
)
def test_reports_of_old_firmware_are_velocities_without_an_age(version, without):
    """Before json_v3 reports have no times, in json_v1 no type; without bottom lock there is no velocity in
    any version."""
    old = {key: value for key, value in REPORT.items() if key not in without}
    old |= {} if version is None else {"format": version}
    counts = Counter()
    aid = decode_line(json.dumps(old).encode(), counts)
    assert (aid.values, aid.age, aid.fom) == ((0.5, -0.25, 0.125), 0.0, 1.6e-4)
    assert decode_line(json.dumps(old | {"velocity_valid": False}).encode(), counts) is None
    assert counts == {"velocity without times": 1, "no bottom lock": 1}


@pytest.mark.parametrize("missing", ["time_of_validity", "time_of_transmission"])
def test_a_report_of_new_firmware_needs_its_times(missing):
    counts = Counter()
    assert decode_line(json.dumps({k: v for k, v in REPORT.items() if k != missing}).encode(), counts) is None
    assert counts == {"implausible": 1}


@pytest.mark.parametrize(
    ("changes", "counted"),
    [
        ({"velocity_valid": False}, "no bottom lock"),
        ({"velocity_valid": 1}, "no bottom lock"),
        ({"vx": math.nan}, "implausible"),
        ({"vx": "0.5"}, "implausible"),
        ({"vx": True}, "implausible"),
        ({"vx": None}, "implausible"),
        ({"vz": -11.0}, "implausible"),
        ({"vz": 10**400}, "implausible"),
        ({"time_of_validity": 10**400, "time_of_transmission": 10**400}, "implausible"),
        ({"time_of_validity": 1638191471852336}, "implausible"),
        ({"time_of_validity": 1638191461852336}, "implausible"),
        ({"type": "velocity_water"}, "velocity_water"),
        ({"tracking_mode": "water"}, "velocity_water"),
        ({"type": "position_local"}, "position_local"),
        ({"type": "response"}, "response"),
        ({"type": ["velocity"]}, "not a report"),
    ],
)
def test_what_is_no_velocity_over_the_floor_is_counted(changes, counted):
    """Each such report is counted by its reason and yields no velocity."""
    counts = Counter()
    assert decode_line(line(**changes), counts) is None
    assert counts == {counted: 1}


@pytest.mark.parametrize("text", [b"", b"\xff", b"[1]", b"[" * 100_000, b"9" * 5000, line()[:-1], b"null"])
def test_what_is_no_json_object_is_counted(text):
    """Any bytes that are not a JSON object are counted."""
    counts = Counter()
    assert decode_line(text, counts) is None
    assert counts == {"not a report": 1}


def test_a_report_without_altitude_is_a_velocity():
    """Neither altitude nor figure of merit affects validity."""
    aid = decode_line(line(altitude=-1, fom=10**400))
    assert math.isnan(aid.altitude) and math.isnan(aid.fom)


def test_an_encoded_velocity_comes_back():
    """The report has the fields of the published one, in their order, and beam velocities that match the
    velocity."""
    data = encode_velocity([0.5, -0.25, 0.125], altitude=0.495, measured=1e9, sent=1e9 + 0.19, interval=0.1)
    report, aid = json.loads(data), decode_line(data)
    assert data.endswith(b"}\n") and data.count(b"\n") == 1
    assert list(report) == list(REPORT) and list(report["transducers"][0]) == list(REPORT["transducers"][0])
    assert (report["vx"], report["vy"], report["vz"]) == (0.5, 0.25, -0.125)
    assert isinstance(report["time_of_validity"], int)
    assert aid.values == (0.5, -0.25, 0.125)
    assert aid.age == pytest.approx(0.19, abs=1e-6)
    assert aid.altitude == 0.495
    # The mean of opposite beams is the component along z; the horizontal components of all beams add up to zero.
    beams = [beam["velocity"] for beam in report["transducers"]]
    assert np.mean(beams) == pytest.approx(-0.125 * math.cos(math.radians(22.5)))
    assert report["transducers"][0]["distance"] == pytest.approx(0.495 / math.cos(math.radians(22.5)))


def test_a_lost_bottom_is_sent_as_a_log_sends_it():
    """Without bottom lock: zeros, altitude and distances of -1, no valid beam."""
    report = json.loads(encode_velocity(None, measured=1.0, sent=1.2, interval=0.1))
    assert (report["vx"], report["altitude"], report["velocity_valid"]) == (0.0, -1.0, False)
    assert all(b["distance"] == -1.0 and b["beam_valid"] is False for b in report["transducers"])
    assert decode_line(json.dumps(report).encode()) is None


WORDS = (
    b"NaN",
    b"1e999",
    b"-Infinity",
    b"null",
    b"true",
    b'"',
    b"[",
    b"{}",
    b"9" * 400,
    b"-",
    b"\\u",
    b"\xff",
)


def mutated(source: random.Random, data: bytes) -> bytes:
    """Return data with one to three changes of a value or of some bytes."""
    for _ in range(source.randint(1, 3)):
        if source.random() < 0.7:
            values = [*re.finditer(rb'(?<=":)[^,\[\]{}]+', data)]
            if values:
                value = source.choice(values)
                number = str(source.choice((1e-9, 0.1, 3.0, 11.0, 1e20)) * source.choice((-1, 1))).encode()
                data = data[: value.start()] + source.choice((*WORDS, number, number)) + data[value.end() :]
            continue
        at, length = source.randrange(len(data) + 1), source.randint(1, 12)
        more = source.choice((source.randbytes(length), source.choice(WORDS), data[at : at + length]))
        data = data[:at] + more + data[at + source.choice((0, length, length, len(data))) :]
    return data


def fuzz(lines: int, seed: int = 0) -> Counter:
    """Count the outcomes of mutated lines; accepted values must be plausible."""
    source, counts = random.Random(seed), Counter()
    lost = encode_velocity(None, measured=1.0, sent=1.2, interval=0.1)
    whole = [
        line(),
        encode_velocity([1.0, 2.0, 3.0], altitude=2.0, measured=1.0, sent=1.2, interval=0.1),
        lost,
    ]
    for _ in range(lines):
        aid = decode_line(mutated(source, source.choice(whole)), counts)
        assert aid is None or (max(map(abs, aid.values)) <= 10.0 and 0.0 <= aid.age <= 5.0)
    assert counts.total() == lines
    return counts


def test_no_mutated_line_upsets_the_reader():
    """Three thousand lines per run; `python -m robot.links.test_water_linked` tries a hundred thousand."""
    assert fuzz(3000)["velocity"] > 100


@pytest.fixture
def server():
    server = DvlServer(("127.0.0.1", 0))
    yield server
    server.close()


def received(client, server, many=1, within=5.0):
    """Return the client's lines once this many have arrived, serving the server meanwhile."""
    found, end = [], time.monotonic() + within
    while len(found) < many and time.monotonic() < end:
        server.poll()
        found += client.receive()
        time.sleep(0.001)
    return found


def connected(server):
    client = DvlClient(*server.address)
    while not client.connected:
        client.receive()
        server.poll()
    return client


def test_reports_reach_several_clients_as_whole_lines(server):
    """Lines are whole however TCP splits them."""
    clients = [connected(server), connected(server)]
    server.poll()
    data = encode_velocity([0.1, 0.2, 0.3], altitude=1.0, measured=1.0, sent=1.2, interval=0.1)
    for _ in range(100):
        server.send(data)
    for client in clients:
        assert received(client, server, 100) == [data.strip()] * 100
        client.close()
        assert client.receive() == [] and "closed" in client.describe()


def asked(client, server, command, **parameters):
    """Return the response to a command."""
    request = {"command": command} | ({"parameters": parameters} if parameters else {})
    client.send(json.dumps(request).encode() + b"\n")
    (answer,) = received(client, server)
    return json.loads(answer)


def test_a_driver_configures_the_log(server):
    """Settings are applied all or none and read back; unknown commands and settings are refused by name."""
    client, counts = connected(server), Counter()
    assert asked(client, server, "set_config", speed_of_sound=1500, range_mode="=2")["success"] is True
    answer = asked(client, server, "get_config")
    assert decode_line(json.dumps(answer).encode(), counts) is None and counts == {"response": 1}
    assert (answer["result"]["speed_of_sound"], answer["result"]["range_mode"]) == (1500, "=2")
    for wrong in ({"speed_of_sound": 99}, {"dark_mode_enabled": 1}, {"range_mode": "far"}, {"gain": 1}):
        answer = asked(client, server, "set_config", acoustic_enabled=False, **wrong)
        assert answer["success"] is False and next(iter(wrong)) in answer["error_message"]
    assert server.settings["acoustic_enabled"] is True
    for command in ("reset_dead_reckoning", "calibrate_gyro", "trigger_ping"):
        answer = asked(client, server, command)
        assert answer["success"] is True and answer["response_to"] == command
    assert asked(client, server, "explode")["error_message"] == "unknown command"
    client.close()


def test_settings_change_what_is_measured(server):
    """The speed of sound scales velocities, the mounting offset rotates them, and without acoustics there are
    none."""
    client = connected(server)
    data = encode_velocity([0.5, 0.0, 0.0], altitude=2.0, measured=1.0, sent=1.1, interval=0.1)
    asked(client, server, "set_config", speed_of_sound=1475 * 1.02, mounting_rotation_offset=90)
    server.send(data)
    report = json.loads(received(client, server)[0])
    assert report["vy"] == pytest.approx(0.51) and report["vx"] == pytest.approx(0.0, abs=1e-12)
    assert report["altitude"] == pytest.approx(2.04)
    asked(client, server, "set_config", acoustic_enabled=False)
    server.send(data)
    assert received(client, server, within=0.1) == []
    client.close()


def test_dead_reckoning_counts_from_its_reset(server):
    """A quarter circle to the left at 5 reports a second; after a reset x is ahead and the heading 0."""
    client, reckoning, reports = connected(server), DeadReckoning(), []
    radius, speed = 2.0, 0.5
    for k in range(round(0.5 * math.pi * radius / speed * 10) + 1):
        turn = speed / radius * 0.1 * k
        reports += reckoning.take(0.1 * k, (speed, 0.0, 0.0), quat_from_yaw(turn), 1e9)
    last = json.loads(reports[-1])
    assert len(reports) == pytest.approx(len(range(0, 64, 2)), abs=1)
    assert (last["x"], last["y"]) == pytest.approx((radius, -radius), abs=0.1) and last[
        "yaw"
    ] == pytest.approx(-90, abs=4)
    assert last["type"] == "position_local" and last["status"] == 0
    server.send(reports[-1])
    received(client, server)
    asked(client, server, "reset_dead_reckoning")
    moved = last | {"x": last["x"] + 0.5, "y": last["y"] - 1.0}  # a metre ahead, half a metre to starboard
    server.send(json.dumps(moved).encode() + b"\n")
    report = json.loads(received(client, server)[0])
    assert (report["x"], report["y"]) == pytest.approx((1.0, 0.5), abs=0.1) and report[
        "yaw"
    ] == pytest.approx(0.0)
    client.close()


def test_beams_lie_where_the_log_has_them():
    """Beams 0 to 3 at 135, -135, -45 and 45 degrees from x towards y, 22.5 degrees from z."""
    report = json.loads(encode_velocity([1.0, 0.0, 0.0], altitude=1.0, measured=1.0, sent=1.0, interval=0.1))
    along = [beam["velocity"] for beam in report["transducers"]]
    tilt = math.sin(math.radians(22.5))
    assert along == pytest.approx([tilt * math.cos(math.radians(a)) for a in (135, -135, -45, 45)])


def test_blueos_finds_the_log_by_its_page():
    """The name contains DVL; other pages do not exist."""
    server = serve_about(("127.0.0.1", 0))
    try:
        address = "http://{}:{}".format(*server.server_address)
        with urllib.request.urlopen(f"{address}/api/v1/about", timeout=5.0) as answer:
            assert "DVL" in json.load(answer)["product_name"]
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(f"{address}/api/v1/outputs", timeout=5.0)
    finally:
        server.shutdown()
        server.server_close()


def test_a_lost_log_is_found_again_without_waiting():
    """The log is absent, appears, leaves and returns; no call takes as long as one turn of the robot's loop."""
    server = DvlServer(("127.0.0.1", 0))
    address, now = server.address, [0.0]
    server.close()
    client = DvlClient(*address, clock=lambda: now[0])
    assert client.receive() == [] and not client.connected
    client.send(b"{}\n")
    assert client.send_errors == 1
    for connections in (1, 2):
        server = DvlServer(address)
        for _ in range(1000):
            now[0] += 0.01
            server.poll()
            client.receive()
        assert client.connected and client.connections >= connections
        server.close()
        now[0] += 0.01
        client.receive()
        assert not client.connected
    client.close()


def test_a_silent_log_is_left(server):
    """A pulled cable does not close the connection, so five seconds without a byte do."""
    now = [0.0]
    client = DvlClient(*server.address, clock=lambda: now[0])
    for _ in range(100):
        client.receive()
    assert client.connected
    now[0] = 5.1
    client.receive()
    assert not client.connected
    client.close()


def test_a_line_without_end_is_dropped(server, monkeypatch):
    """The buffer stays small, and the next line is read."""
    monkeypatch.setattr(water_linked, "_LONGEST_LINE", 1000)
    client = connected(server)
    server.poll()
    for piece in (b"x" * 700, b"x" * 700, b"x\n", b'{"a":1}\n'):
        server.send(piece)
    assert received(client, server) == [b'{"a":1}']
    client.close()


def test_a_client_that_does_not_read_is_let_go(server):
    """A client that does not read is disconnected and delays no other client."""
    lazy = socket.create_connection(server.address)
    client = connected(server)
    server.poll()
    data = b"x" * 60_000 + b"\n"
    for _ in range(200):
        server.send(data)
        client.receive()
    assert len(server._server.clients) == 1
    lazy.close()
    client.close()


def test_a_port_that_is_taken_and_a_host_that_is_not_there_are_refused(server):
    """The refusals say what to do."""
    with pytest.raises(LinkError, match="give another port"):
        DvlServer(server.address)
    with pytest.raises(LinkError, match="no such host"):
        DvlClient("no-such-host.invalid")


if __name__ == "__main__":
    print(dict(fuzz(100_000)))
