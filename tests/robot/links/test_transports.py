"""UDP with a single peer, memory and null transports, and their addresses; none raises or blocks."""

import logging
import select
import socket

import pytest

from finssim.robot.links.frames import LinkError, encode_command, encode_telemetry
from finssim.robot.links.transports import UdpTransport, memory_pair, open_transport
from robot.links.test_frames import COMMAND, TELEMETRY

LOCAL = "127.0.0.1"


def plain_socket():
    end = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    end.bind((LOCAL, 0))
    return end


@pytest.fixture
def ends():
    """A transport, and a plain socket as its peer."""
    peer = plain_socket()
    transport = UdpTransport((LOCAL, 0), peer.getsockname())
    yield transport, peer
    transport.close()
    peer.close()


def received(transport):
    """Return what arrives within a second; datagrams on loopback are almost, but not quite, immediate."""
    select.select([transport._socket], [], [], 1.0)
    return transport.receive()


def test_datagrams_go_to_the_peer_and_come_from_it(ends):
    """One command goes out and two frames of telemetry come in, oldest first; then nothing, without waiting."""
    transport, peer = ends
    transport.send(encode_command(COMMAND))
    assert peer.recv(2048) == encode_command(COMMAND)
    peer.sendto(b"first", transport.address)
    peer.sendto(b"second", transport.address)
    assert received(transport) == [b"first", b"second"]
    assert transport.receive() == []


def test_a_stranger_is_refused_counted_and_named_once(ends, caplog):
    """Another port of the same address is also a stranger; datagrams of the peer in between are received."""
    transport, peer = ends
    with plain_socket() as stranger, caplog.at_level(logging.WARNING, "finssim.robot.links"):
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
    """Strangers beyond 64 are counted together and named in one line."""
    transport, _ = ends
    for _ in range(80):
        with plain_socket() as stranger:
            stranger.sendto(b"me", transport.address)
    received(transport)
    assert len(transport.refused) == 65
    assert sum(transport.refused.values()) == 80
    assert len(caplog.messages) == 65


def test_a_flood_does_not_hold_the_loop_up(ends):
    """One call reads at most 1024 datagrams."""
    transport, peer = ends
    transport._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
    for _ in range(1100):
        peer.sendto(b"x", transport.address)
    assert len(received(transport)) <= 1024


def test_a_datagram_that_is_too_long_is_cut_and_then_no_frame(ends):
    """At most 2048 bytes of a datagram are read."""
    transport, peer = ends
    peer.sendto(bytes(5000), transport.address)
    (data,) = received(transport)
    assert len(data) == 2048


def test_sending_to_nobody_raises_nothing(ends):
    """When the peer disappears and returns on the same port, frames reach it again."""
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
    """A datagram too large for UDP and a closed end are counted and reported once."""
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
    """A vehicle elsewhere needs a given local address; loopback would never reach it."""
    _, peer = ends
    transport = open_transport(f"udp://localhost:{peer.getsockname()[1]}", bind=f"{LOCAL}:0")
    assert transport.address[0] == LOCAL
    assert transport.peer == peer.getsockname()
    transport.close()
    with pytest.raises(LinkError, match=r"192\.0\.2\.1:58766 is on another machine .* bind the address"):
        open_transport("udp://192.0.2.1:58766")


def test_a_second_robot_on_the_same_port_is_refused(ends):
    """Two programs cannot both listen to one vehicle on one address."""
    transport, peer = ends
    with pytest.raises(LinkError, match="cannot bind 127.0.0.1:.*end the program that has it"):
        UdpTransport(transport.address, peer.getsockname())


@pytest.mark.parametrize(
    ("address", "said"),
    [
        (
            "tcp://127.0.0.1:1",
            "unknown wire 'tcp://127.0.0.1:1': give udp://HOST:PORT, serial:DEVICE or mavlink://KIND:WHERE",
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
    """The sentence says which addresses are valid."""
    with pytest.raises(LinkError) as refused:
        open_transport(address, bind=f"{LOCAL}:0")
    assert said in str(refused.value)


def test_what_goes_in_at_one_end_of_memory_comes_out_at_the_other():
    """Messages pass both ways, in order and once; a closed end neither accepts nor delivers, a full one drops
    the oldest."""
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
