"""The router between an autopilot and its ground stations, over real sockets on this machine."""

import json
import socket
import threading
import time
import urllib.request

import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from finssim.pool import VirtualPool, draw_plant
from finssim.pool.fleet import Fleet
from finssim.pool.real_time import SiteWires, serve_realtime
from finssim.pool.servers import GroundLinks, whole_frames
from finssim.robot.links.frames import LinkError
from finssim.robot.links.water_linked import DvlClient, decode_line
from finssim.vehicles import load_vehicle
from finssim.vehicles.defaults import with_navigation

FREE = ("127.0.0.1", 0)


@pytest.fixture
def links():
    links = GroundLinks(FREE, (), FREE, FREE)
    yield links
    links.close()


def beat(sequence=0):
    mav = mavlink.MAVLink(None, 255, 190)
    mav.seq = sequence
    return mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3).pack(mav)


def test_frames_are_cut_off_a_stream_as_they_complete():
    """Frames are found in any pieces, and after bytes that are not a frame."""
    stream, frames = bytearray(), []
    for byte in b"hello" + beat(1) + beat(2) + b"\x00" + beat(3):
        stream.append(byte)
        frames += whole_frames(stream)
    assert frames == [beat(1), beat(2), beat(3)] and not stream


def test_the_page_of_the_log_is_served_with_it_and_ends_with_it():
    with socket.socket() as free:
        free.bind(FREE)
        page = free.getsockname()
    links = GroundLinks(FREE, (), FREE, FREE, page)
    with urllib.request.urlopen("http://{}:{}/api/v1/about".format(*page), timeout=5.0) as answer:
        assert "DVL" in json.load(answer)["product_name"]
    links.close()
    with pytest.raises(OSError):
        socket.create_connection(page, timeout=1.0)


def test_stations_hear_the_vehicle_and_each_other(links):
    """Over TCP and UDP, a station does not receive its own frames; half a frame from one does not corrupt
    another's."""
    one, other = (socket.create_connection(links.tcp, timeout=5.0) for _ in range(2))
    caller = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    caller.settimeout(5.0)
    caller.sendto(beat(7)[:9], links.address)
    one.sendall(beat(1)[:10])
    other.sendall(beat(2))
    frames, end = [], time.monotonic() + 5.0
    while len(frames) < 1 and time.monotonic() < end:
        frames += links.receive()
    one.sendall(beat(1)[10:])
    while len(frames) < 2 and time.monotonic() < end:
        frames += links.receive()
    assert frames == [beat(2), beat(1)]
    links.send(b"\xfdvehicle")
    assert one.recv(100) == beat(2) + b"\xfdvehicle" and other.recv(100) == beat(1) + b"\xfdvehicle"
    assert [caller.recv(100) for _ in range(3)] == [beat(2), beat(1), b"\xfdvehicle"]
    one.close()
    links.receive()
    links.send(b"\xfdstill there")
    assert other.recv(100) == b"\xfdstill there"
    other.close()
    caller.close()


def test_a_station_is_sent_to_before_it_has_spoken_and_a_taken_port_is_refused():
    """The first is what a vehicle does with 14550; on refusal every opened socket is closed again."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station:
        station.bind(FREE)
        station.settimeout(5.0)
        links = GroundLinks(FREE, [station.getsockname()], FREE, FREE)
        links.send(beat())
        assert station.recv(100) == beat()
        with pytest.raises(LinkError, match="another port"):
            GroundLinks(FREE, (), FREE, links.dvl.address)
        links.close()


@pytest.mark.slow
def test_pymavlink_drives_it_in_real_time_and_its_log_reports(links):
    """Heartbeat, arming, an axis that moves the vehicle, lines of the Doppler log, and disarming, over real
    sockets."""
    heavy = with_navigation(load_vehicle("bluerov2_heavy"))
    world = VirtualPool(heavy, draw_plant(heavy, 1, "nominal"), firmware="ardusub")
    stop = threading.Event()
    site = threading.Thread(
        target=serve_realtime,
        args=(Fleet({"it": world}), SiteWires({"it": links})),
        kwargs={"until": stop.is_set, "duration": 60.0},
    )
    site.start()
    log = DvlClient(*links.dvl.address)
    station = mavutil.mavlink_connection(f"tcp:127.0.0.1:{links.tcp[1]}", source_system=255)
    try:
        assert station.wait_heartbeat(timeout=20.0).type == mavlink.MAV_TYPE_SUBMARINE
        station.mav.heartbeat_send(6, 8, 0, 0, 0, 3)
        log.receive()
        time.sleep(1.2)
        station.arducopter_arm()
        assert station.recv_match(type="COMMAND_ACK", blocking=True, timeout=5.0).result == 0
        start, lines = float(world.plant.position[0]), []
        for _ in range(20):
            station.mav.manual_control_send(1, 400, 0, 500, 0, 0)
            time.sleep(0.05)
            lines += log.receive()
        assert world.plant.position[0] - start > 0.03
        station.arducopter_disarm()
        end = time.monotonic() + 5.0
        while world.firmware.armed and time.monotonic() < end:
            time.sleep(0.02)
        assert not world.firmware.armed and any(decode_line(line) for line in lines)
    finally:
        stop.set()
        site.join()
        station.close()
        log.close()
