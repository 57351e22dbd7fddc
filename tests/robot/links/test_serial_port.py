"""A serial line (a pseudo terminal) that is pulled, plugged, stuck or taken raises nothing and blocks
nothing."""

import os
import select

import pytest

from finssim.robot.links.frames import MCU, Decoder, LinkError, encode_command, encode_telemetry
from finssim.robot.links.transports import SerialTransport, open_transport
from robot.links import wire
from robot.links.test_frames import COMMAND, TELEMETRY

pytestmark = pytest.mark.skipif(os.name != "posix", reason="pseudo terminals are of POSIX")


class Line:
    """A serial device at a fixed name: a pseudo terminal whose other end belongs to the test."""

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

    def speed(self, transport):
        """Return the baud rate of the terminal."""
        import termios

        code = termios.tcgetattr(transport._port.fileno())[4]
        return {termios.B57600: 57600, termios.B115200: 115200}[code]

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


def test_a_frame_crosses_a_serial_line_in_pieces(line):
    """The decoder joins the pieces of the line; the command arrives as it was sent."""
    transport, decoder = open_transport(f"serial:{line.path}?baud=57600"), Decoder()
    assert transport.describe() == f"serial {line.path} at 57600 baud, connected"
    assert line.speed(transport) == 57600
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


@pytest.mark.parametrize("notice", ["receive", "send"])
def test_a_line_may_be_pulled_and_plugged_again(line, notice, caplog):
    """While unplugged, frames are counted and dropped; reconnection is tried after a second, not before."""
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


def test_a_stuck_line_holds_back_no_old_commands(line):
    """When the peer does not read, unsent commands are dropped: only the newest is sent later."""
    transport, sent = SerialTransport(line.path), 0
    while not transport.send_errors and sent < 1_000_000:
        transport.send(bytes(100))
        sent += 100
    assert transport.send_errors == 1
    assert transport.describe().endswith("connected")
    came = b""
    while select.select([line.master], [], [], 0.05)[0]:
        came += os.read(line.master, 65536)
    assert len(came) < sent / 2  # what the terminal itself had buffered
    transport.send(b"newest")
    assert os.read(line.master, 100) == b"newest"
    transport.close()


def test_a_device_belongs_to_one_program(line):
    """Opening it a second time is refused."""
    transport = SerialTransport(line.path)
    with pytest.raises(LinkError, match="cannot be opened"):
        SerialTransport(line.path)
    transport.close()
