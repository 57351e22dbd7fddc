"""Robot and world take turns over TCP: nothing is lost in transit, and an absent world is reported."""

import socket
import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from finssim.robot.lockstep import (
    LockstepClient,
    LockstepError,
    decode_delivery,
    decode_request,
    encode_delivery,
    encode_refusal,
    encode_request,
    receive,
)
from finssim.robot.messages import Delivery, Picture, TagCorners

finite = st.floats(allow_nan=False)
images = st.none() | st.tuples(st.integers(1, 9), st.integers(1, 9)).flatmap(lambda s: arrays(np.uint8, s))
corners = arrays(np.float64, (4, 2), elements=st.floats(allow_nan=False, allow_infinity=False))
tags = st.builds(TagCorners, st.integers(0, 500), corners)
pictures = st.builds(
    Picture,
    st.floats(allow_nan=False, allow_infinity=False),
    st.integers(0, 2**32 - 1),
    images,
    st.lists(tags, max_size=2).map(tuple),
)
deliveries = st.builds(
    Delivery,
    finite,
    st.lists(st.tuples(finite, st.binary(max_size=99)), max_size=4).map(tuple),
    st.lists(pictures, max_size=3).map(tuple),
)


def through_a_socket(*messages):
    """Return a connection that receives these messages."""
    near, far = socket.socketpair()
    with near, far:
        near.sendall(b"".join(messages))
        near.shutdown(socket.SHUT_WR)
        return [receive(far) for _ in range(len(messages) + 1)]


@given(until=finite, sent=st.lists(st.binary(max_size=99), max_size=4))
def test_a_request_comes_back_as_it_was(until, sent):
    """A request's time and frames survive the round trip."""
    message, end = through_a_socket(encode_request(until, sent))
    assert decode_request(*message) == (until, tuple(sent)) and end is None


@given(delivery=deliveries)
def test_a_delivery_comes_back_as_it_was(delivery):
    """Frames with their arrival times and pictures with grey values and tags survive the round trip."""
    message, _ = through_a_socket(encode_delivery(delivery))
    back = decode_delivery(*message)
    assert (back.time, back.frames) == (delivery.time, delivery.frames)
    for a, b in zip(delivery.pictures, back.pictures, strict=True):
        assert (a.time, a.sequence, [t.tag_id for t in a.tags]) == (
            b.time,
            b.sequence,
            [t.tag_id for t in b.tags],
        )
        assert (b.image is None) if a.image is None else np.array_equal(a.image, b.image)
        assert all(np.array_equal(s.corners, t.corners) for s, t in zip(a.tags, b.tags, strict=True))


def test_a_message_that_is_cut_or_no_message_is_refused():
    """Messages cut within a frame or body, and streams of another kind, are refused."""
    whole = encode_request(1.0, [b"abc"])
    with pytest.raises(LockstepError, match="closed within a message"):
        through_a_socket(whole[:-1])
    with pytest.raises(LockstepError, match="no lock-step message"):
        through_a_socket(b"GET / HTTP/1.1\r\n\r\n")
    kind, body = through_a_socket(whole)[0]
    with pytest.raises(LockstepError, match="ends before"):
        decode_request(kind, body[:-1])
    with pytest.raises(LockstepError, match="expected a request"):
        decode_request(2, body)
    with pytest.raises(LockstepError, match="expected a delivery"):
        decode_delivery(kind, body)


def served(answer):
    """Return the address of a world that gives this answer to one request, or closes the connection if it is
    None."""
    server = socket.create_server(("127.0.0.1", 0))

    def serve():
        connection, _ = server.accept()
        with server, connection:
            message = receive(connection)
            if message is not None and answer is not None:
                connection.sendall(answer(*decode_request(*message)))

    threading.Thread(target=serve, daemon=True).start()
    return f"127.0.0.1:{server.getsockname()[1]}"


def test_a_client_exchanges_with_a_world():
    """The client sends the time and its frames, and receives what the world delivers."""
    address = served(lambda until, sent: encode_delivery(Delivery(until, tuple((until, f) for f in sent))))
    with LockstepClient(address) as world:
        assert world.exchange(0.5, [b"x", b"yz"]) == Delivery(0.5, ((0.5, b"x"), (0.5, b"yz")))


def test_a_world_that_is_not_there_gone_or_refuses_is_one_sentence():
    """Each message names the address or gives the world's own reason."""
    with socket.create_server(("127.0.0.1", 0)) as closed:
        nobody = f"127.0.0.1:{closed.getsockname()[1]}"
    with pytest.raises(LockstepError, match="no world in lock-step at .* start one with"):
        LockstepClient(nobody)
    with pytest.raises(LockstepError, match="no world in lock-step at nonsense"):
        LockstepClient("nonsense")
    with (
        LockstepClient(served(None)) as world,
        pytest.raises(LockstepError, match="is gone|does not answer"),
    ):
        world.exchange(1.0, ())
    with LockstepClient(served(lambda *_: encode_refusal("the walls fell in"))) as world:
        with pytest.raises(LockstepError, match="the walls fell in"):
            world.exchange(1.0, ())


def test_a_silent_world_is_given_up():
    """A silent world is given up after the timeout, in one sentence."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"127.0.0.1:{server.getsockname()[1]}"
        with (
            LockstepClient(address, timeout=0.2) as world,
            pytest.raises(LockstepError, match="silent for too long"),
        ):
            world.exchange(1.0, ())
