"""Wires: UDP with one peer, a serial line that is pulled and plugged, memory, nobody; none raises or waits."""

import logging
import os
import select
import socket
import sys

import pytest

from finssim.robot.link.decoder import MCU, Decoder
from finssim.robot.link.frames import encode_command, encode_telemetry
from finssim.robot.link.layout import LinkError
from finssim.robot.link.serial_port import SerialTransport
from finssim.robot.link.transports import DryRun, memory_pair, open_transport
from finssim.robot.link.udp import UdpTransport
from robot.link import wire
from robot.link.test_frames import COMMAND, TELEMETRY

POSIX = pytest.mark.skipif(sys.platform == "win32", reason="pseudo terminals are of POSIX")
LOCAL = "127.0.0.1"


def plain_socket():
    end = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    end.bind((LOCAL, 0))
    return end


@pytest.fixture
def ends():
    """A transport, and a plain socket that is its peer."""
    peer = plain_socket()
    transport = UdpTransport((LOCAL, 0), peer.getsockname())
    yield transport, peer
    transport.close()
    peer.close()


def received(transport):
    """What comes within a second; datagrams on loopback are there at once, but only almost."""
    select.select([transport._socket], [], [], 1.0)
    return transport.receive()


def test_datagrams_go_to_the_peer_and_come_from_it(ends):
    """A command out, two frames of telemetry in, oldest first; then nothing, without waiting."""
    transport, peer = ends
    transport.send(encode_command(COMMAND))
    assert peer.recv(2048) == encode_command(COMMAND)
    peer.sendto(b"first", transport.address)
    peer.sendto(b"second", transport.address)
    assert received(transport) == [b"first", b"second"]
    assert transport.receive() == []


def test_a_stranger_is_refused_counted_and_named_once(ends, caplog):
    """Another port of the same address is a stranger too; what the peer sends among it gets through."""
    transport, peer = ends
    with plain_socket() as stranger, caplog.at_level(logging.WARNING, "finssim.robot.link"):
        for _ in range(3):
            stranger.sendto(encode_telemetry(TELEMETRY), transport.address)
        peer.sendto(b"true", transport.address)
        assert received(transport) == [b"true"]
        assert transport.refused == {stranger.getsockname(): 3}
        (said,) = caplog.messages
        name = "{}:{}".format(*stranger.getsockname())
        assert said.startswith(f"refused a datagram from {name}: this end listens to ")
    assert "3 datagrams of others refused" in transport.describe()


def test_a_crowd_of_strangers_fills_neither_memory_nor_log(ends, caplog):
    """Beyond 64 of them, the rest are counted together and named in one line."""
    transport, _ = ends
    for _ in range(80):
        with plain_socket() as stranger:
            stranger.sendto(b"me", transport.address)
    received(transport)
    assert len(transport.refused) == 65
    assert sum(transport.refused.values()) == 80
    assert len(caplog.messages) == 65


def test_a_flood_does_not_hold_the_loop_up(ends):
    """One call looks at 1024 datagrams at most."""
    transport, peer = ends
    transport._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
    for _ in range(1100):
        peer.sendto(b"x", transport.address)
    assert len(received(transport)) <= 1024


def test_a_datagram_that_is_too_long_is_cut_and_then_no_frame(ends):
    """2048 bytes of it are taken."""
    transport, peer = ends
    peer.sendto(bytes(5000), transport.address)
    (data,) = received(transport)
    assert len(data) == 2048


def test_sending_to_nobody_raises_nothing(ends):
    """The peer has gone, and comes back at the same port: frames reach it again."""
    transport, peer = ends
    address = peer.getsockname()
    peer.close()
    for _ in range(5):
        transport.send(b"anyone?")
        assert transport.receive() == []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as again:
        again.bind(address)
        transport.send(b"here")
        assert again.recv(100) == b"here"


def test_what_cannot_leave_is_counted_and_said_once(ends, caplog):
    """A datagram that UDP has no room for, and a closed end."""
    transport, _ = ends
    transport.send(bytes(70_000))
    transport.send(bytes(70_000))
    assert transport.send_errors == 2
    assert len(caplog.messages) == 1
    transport.close()
    transport.send(b"late")
    assert transport.receive() == []
    assert transport.send_errors == 3
    assert "3 frames could not leave" in transport.describe()


def test_it_is_bound_to_this_machine_unless_told_otherwise(ends):
    """A vehicle elsewhere needs an address that is given; loopback would never reach it."""
    _, peer = ends
    transport = open_transport(f"udp://localhost:{peer.getsockname()[1]}", bind=f"{LOCAL}:0")
    assert transport.address[0] == LOCAL
    assert transport.peer == peer.getsockname()
    transport.close()
    with pytest.raises(LinkError, match=r"192\.0\.2\.1:58766 is on another machine .* bind the address"):
        open_transport("udp://192.0.2.1:58766")


def test_a_second_robot_on_the_same_port_is_refused(ends):
    """Two programs cannot both listen to one vehicle at one address."""
    transport, peer = ends
    with pytest.raises(LinkError, match="cannot bind 127.0.0.1:.*end the program that has it"):
        UdpTransport(transport.address, peer.getsockname())


@pytest.mark.parametrize(
    ("address", "said"),
    [
        (
            "tcp://127.0.0.1:1",
            "unknown wire 'tcp://127.0.0.1:1': give udp://HOST:PORT, serial:DEVICE or dry-run",
        ),
        ("udp://127.0.0.1", "no HOST:PORT"),
        ("udp://127.0.0.1:70000", "no HOST:PORT"),
        ("udp://127.0.0.1:0", "not one address and port"),
        ("udp://0.0.0.0:58766", "not one address and port"),
        ("serial:", "unknown wire"),
        ("serial:/dev/none?baud=fast", "baud is 'fast'"),
        ("serial:/dev/none", "serial:/dev/none: cannot be opened at 115200 baud"),
    ],
)
def test_an_address_that_is_no_wire_is_refused(address, said):
    """With a sentence that says what to give."""
    with pytest.raises(LinkError) as refused:
        open_transport(address, bind=f"{LOCAL}:0")
    assert said in str(refused.value)


class Line:
    """A serial device at a fixed name: a pseudo terminal whose other end the test holds."""

    def __init__(self, path):
        self.path, self.master = str(path), None

    def plug(self):
        import tty

        self.master, other = os.openpty()
        tty.setraw(other)
        os.symlink(os.ttyname(other), self.path)
        os.close(other)

    def unplug(self):
        os.unlink(self.path)
        os.close(self.master)
        self.master = None

    def write(self, data, transport):
        """Write, and wait until the device has something to read."""
        os.write(self.master, data)
        select.select([transport._port.fileno()], [], [], 1.0)


@pytest.fixture
def line(tmp_path):
    found = Line(tmp_path / "ttyVehicle")
    found.plug()
    yield found
    if found.master is not None:
        found.unplug()


@POSIX
def test_a_frame_crosses_a_serial_line_in_pieces(line):
    """The decoder puts together what the line takes apart; the command arrives as it was sent."""
    transport, decoder = open_transport(f"serial:{line.path}?baud=57600"), Decoder()
    assert transport.describe() == f"serial {line.path} at 57600 baud, connected"
    frame, found = encode_telemetry(TELEMETRY), []
    for piece in (frame[:30], frame[30:31], frame[31:]):
        line.write(piece, transport)
        found += [message for data in transport.receive() for message in decoder.feed(data)]
    assert found == [wire.frame_at(frame, 0, "host")[1]]
    assert transport.receive() == []
    transport.send(encode_command(COMMAND))
    assert Decoder(MCU).feed(os.read(line.master, 100)) == [COMMAND]
    transport.close()
    transport.send(b"late")
    assert transport.receive() == []
    assert transport.describe().endswith("closed")


@POSIX
@pytest.mark.parametrize("notice", ["receive", "send"])
def test_a_line_may_be_pulled_and_plugged_again(line, notice, caplog):
    """Without it frames are counted and dropped; it is tried again a second later, not before."""
    now = 100.0
    transport = SerialTransport(line.path, clock=lambda: now)
    line.unplug()
    assert transport.receive() == [] if notice == "receive" else transport.send(b"lost") is None
    assert transport.describe().endswith("not connected")
    errors = transport.send_errors
    transport.send(b"lost")
    assert transport.send_errors == errors + 1
    now = 101.5
    assert transport.receive() == []
    line.plug()
    now = 102.0
    assert transport.receive() == []
    assert transport.describe().endswith("not connected")
    now = 102.5
    transport.send(b"back")
    assert os.read(line.master, 10) == b"back"
    line.write(b"telemetry", transport)
    assert transport.receive() == [b"telemetry"]
    assert transport.reconnects == 1
    assert [m.split(": ")[1].split(" (")[0] for m in caplog.messages] == ["lost", "is back"]
    transport.close()


@POSIX
def test_a_stuck_line_holds_back_no_old_commands(line):
    """Nobody reads: what has not left by then is dropped, so the past does not come out later and the newest does."""
    transport, sent = SerialTransport(line.path), 0
    while not transport.send_errors and sent < 1_000_000:
        transport.send(bytes(100))
        sent += 100
    assert transport.send_errors == 1
    assert transport.describe().endswith("connected")
    came = b""
    while select.select([line.master], [], [], 0.05)[0]:
        came += os.read(line.master, 65536)
    assert len(came) < sent / 2  # what the terminal itself had taken in
    transport.send(b"newest")
    assert os.read(line.master, 100) == b"newest"
    transport.close()


@POSIX
def test_a_device_belongs_to_one_program(line):
    """A second opening of it is refused."""
    transport = SerialTransport(line.path)
    with pytest.raises(LinkError, match="cannot be opened"):
        SerialTransport(line.path)
    transport.close()


def test_what_goes_in_at_one_end_of_memory_comes_out_at_the_other():
    """Both ways, in order, once; a closed end takes and gives nothing, and a full one loses the oldest."""
    robot, vehicle = memory_pair()
    robot.send(b"a")
    robot.send(b"b")
    vehicle.send(b"c")
    assert (vehicle.receive(), robot.receive(), vehicle.receive()) == ([b"a", b"b"], [b"c"], [])
    for i in range(5000):
        robot.send(b"%d" % i)
    waiting = vehicle.receive()
    assert (len(waiting), waiting[-1]) == (4096, b"4999")
    robot.close()
    robot.send(b"late")
    vehicle.send(b"late")
    assert (vehicle.receive(), robot.receive()) == ([], [])


def test_a_dry_run_sends_to_nobody():
    """It takes frames and counts them."""
    wire_to_nobody = open_transport("dry-run")
    assert isinstance(wire_to_nobody, DryRun)
    wire_to_nobody.send(b"a")
    wire_to_nobody.send(b"b")
    assert (wire_to_nobody.sent, wire_to_nobody.last, wire_to_nobody.receive()) == (2, b"b", [])
