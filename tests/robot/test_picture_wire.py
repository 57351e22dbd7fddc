"""Pictures reach the robot whole or not at all, from one peer only, and either side may die."""

import socket
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from finssim.pool.pictures import UdpSender
from finssim.robot.links.frames import LinkError
from finssim.robot.messages import Picture, TagCorners
from finssim.robot.pictures import (
    MOST_BYTES,
    Assembler,
    NoPictures,
    UdpPictures,
    _announced,
    decode_picture,
    encode_picture,
    fragments,
    open_pictures,
    resized,
)

RANDOM = np.random.default_rng(0)
NOISE = RANDOM.integers(0, 256, (48, 64)).astype(np.uint8)
SMOOTH = np.tile(np.arange(0, 256, 2, dtype=np.uint8), (72, 1))
TAGS = (
    TagCorners(15, RANDOM.normal(300.0, 100.0, (4, 2))),
    TagCorners(16, RANDOM.normal(500.0, 50.0, (4, 2))),
)


def until(receive, count=1, patience=10.0):
    """Return what was received once it contains this many pictures."""
    found, end = [], time.monotonic() + patience
    while len(found) < count and time.monotonic() < end:
        found += receive(time.monotonic())
        time.sleep(0.002)
    return found


def udp_pair(**options):
    """Return a camera's and a robot's end on loopback."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        camera = free.getsockname()
    robot = UdpPictures(("127.0.0.1", 0), camera)
    return UdpSender(camera, robot.address, **options), robot


def test_a_picture_comes_back_from_its_bytes():
    """Image and tags are bit-identical, and the lateness is the one that the sender reported."""
    posted = decode_picture(encode_picture(Picture(3.25, 7, NOISE, TAGS), late=0.5))
    assert (posted.picture.time, posted.picture.sequence, posted.late) == (3.25, 7, 0.5)
    assert np.array_equal(posted.picture.image, NOISE)
    for a, b in zip(posted.picture.tags, TAGS, strict=True):
        assert a.tag_id == b.tag_id and np.array_equal(a.corners, b.corners)


COLOURS = RANDOM.integers(0, 256, (9, 16, 3)).astype(np.uint8)


@pytest.mark.parametrize(
    "reading",
    [
        Picture(1.5, 3, COLOURS, source="front_camera"),
        Picture(1.5, 3, NOISE, source="sonar"),
        Picture(1.5, 3, source="altimeter", ranges=np.array([1.25, np.inf], np.float32)),
    ],
    ids=lambda reading: reading.source,
)
def test_readings_of_own_sensors_cross_udp_as_they_are(reading):
    """Small pictures are not compressed, so a policy receives exactly the same numbers as in training."""
    sender, robot = udp_pair()
    sender.send(reading, reading.time)
    (there,) = until(robot.receive)
    sender.close(), robot.close()
    assert (there.source, there.sequence) == (reading.source, 3)
    for a, b in ((there.image, reading.image), (there.ranges, reading.ranges)):
        assert (a is None) == (b is None) and (a is None or np.array_equal(a, b))


def test_a_large_picture_in_colour_is_compressed():
    """JPEG preserves colour: within 12 levels for a smooth picture."""
    image = np.zeros((40, 64, 3), np.uint8)
    image[..., 0], image[..., 2] = 200, np.arange(64)
    packed = encode_picture(Picture(0.0, 0, image, source="front_camera"), compress=True)
    there = decode_picture(packed).picture.image
    assert len(packed) < image.nbytes / 2 and np.abs(there.astype(int) - image).max() <= 12


def test_a_reading_needs_a_name_and_ranges_numbers():
    """A reading with an invalid sensor name or with NaN is not sent."""
    for spoilt in (
        Picture(0.0, 0, COLOURS, source="Front camera"),
        Picture(0.0, 0, source="altimeter", ranges=np.array([np.nan], np.float32)),
    ):
        assert decode_picture(encode_picture(spoilt)) is None


def test_pictures_are_resized_by_area():
    """Each resized pixel is the mean of the pixels that it covers; another kind is refused."""
    image = np.zeros((4, 8, 3), np.uint8)
    image[::2] = 100
    np.testing.assert_array_equal(resized(image, (2, 4, 3)), np.full((2, 4, 3), 50, np.uint8))
    assert resized(image, (4, 8, 3)) is image
    with pytest.raises(LinkError, match="no picture came"):
        resized(None, (2, 4, 3))
    with pytest.raises(LinkError, match="a picture of shape \\(4, 8, 3\\) came"):
        resized(image, (2, 4))


def test_a_sonars_picture_is_cut_to_the_range_that_is_seen():
    """The nearest range cells of every beam are kept unchanged; a different number of beams or too few cells
    is refused."""
    echoes = np.arange(6 * 10, dtype=np.uint8).reshape(6, 10)
    np.testing.assert_array_equal(resized(echoes, (6, 4, 1))[..., 0], echoes[:, :4])
    for shape in ((3, 4, 1), (6, 11, 1), (6, 10, 3)):
        with pytest.raises(LinkError, match="a picture of shape \\(6, 10\\) came"):
            resized(echoes, shape)


def test_compression_takes_fewer_bytes_and_keeps_gray_to_a_few_levels():
    """JPEG of a smooth picture takes less than half the bytes and stays within 4 levels."""
    raw, packed = (encode_picture(Picture(0.0, 0, SMOOTH), compress=c) for c in (False, True))
    assert len(packed) < len(raw) / 2
    there = decode_picture(packed).picture.image.astype(int)
    assert np.abs(there - SMOOTH).max() <= 4


@given(data=st.binary(max_size=300))
@settings(max_examples=300, deadline=None)
def test_bytes_at_random_are_no_picture(data):
    """Neither codec nor assembler raises on random bytes or makes a picture of them."""
    assert decode_picture(data) is None
    assert decode_picture(b"FSPC\x01\x02" + data) is None
    assert Assembler().add(data) is None or data[:4] == b"FSPF"


@given(
    place=st.integers(0, 10_000), value=st.integers(0, 255), cut=st.integers(0, 10_000), packed=st.booleans()
)
@settings(max_examples=300, deadline=None)
def test_a_spoilt_picture_raises_nothing(place, value, cut, packed):
    """With any byte changed or any length cut, the result is a picture with finite numbers or none."""
    data = bytearray(encode_picture(Picture(1.0, 1, SMOOTH, TAGS), compress=packed))
    data[place % len(data)] = value
    for spoilt in (bytes(data), bytes(data[: cut % len(data)])):
        posted = decode_picture(spoilt)
        assert posted is None or np.isfinite([posted.picture.time, posted.late]).all()
        assert posted is None or all(np.isfinite(tag.corners).all() for tag in posted.picture.tags)


def test_fragments_find_together_in_any_order_and_not_without_each_other():
    """Shuffled and duplicated fragments give the message once; a missing or corrupted fragment drops it."""
    data = bytes(RANDOM.integers(0, 256, 10_000, dtype=np.uint8))
    pieces = fragments(data, 5, 1400)
    assert len(pieces) == 8
    order = RANDOM.permutation(16) % 8
    assembler = Assembler()
    assert [whole for i in order if (whole := assembler.add(pieces[i])) is not None] == [data]
    assembler = Assembler()
    assert not any(assembler.add(piece) for piece in pieces[1:])
    assembler = Assembler()
    spoilt = pieces[3][:-1] + bytes([pieces[3][-1] ^ 1])
    assert not any(assembler.add(piece) for piece in [*pieces[:3], spoilt, *pieces[4:]])
    assert assembler.counts["corrupt"] == 1


def test_unfinished_messages_take_bounded_memory():
    """Only a few of a hundred unfinished messages are kept."""
    assembler, piece = Assembler(), bytes(50_000)
    for number in range(100):
        for datagram in fragments(piece * 30 + bytes([number]), number, 50_000)[:-1]:
            assembler.add(datagram)
    held = sum(len(p) for parts in assembler._parts.values() for p in parts.values())
    assert held <= min(MOST_BYTES, 4 * 30 * 50_000) and assembler.counts["incomplete"] == 96


@pytest.mark.parametrize("fragment", [1400, 60_000])
def test_pictures_cross_udp(fragment):
    """Image, tags and sequence arrive; the time is the time of reception minus the lateness."""
    camera, robot = udp_pair(fragment=fragment)
    try:
        before = time.monotonic()
        camera.send(Picture(before - 0.3, 4, SMOOTH, TAGS), before)
        (picture,) = until(robot.receive)
        assert picture.sequence == 4 and picture.image.shape == SMOOTH.shape and len(picture.tags) == 2
        assert before - 0.3 <= picture.time <= time.monotonic() - 0.3
    finally:
        camera.close()
        robot.close()


def test_tags_alone_fit_one_datagram():
    """Without an image a picture is a few hundred bytes."""
    assert len(fragments(encode_picture(Picture(0.0, 0, tags=TAGS)), 0, 1400)) == 1


def test_others_are_refused_and_named_once(caplog):
    """A picture from an unknown sender is rejected whatever it contains, and the log names the sender once."""
    camera, robot = udp_pair()
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            stranger.bind(("127.0.0.1", 0))
            for i in range(3):
                stranger.sendto(fragments(encode_picture(Picture(0.0, i, SMOOTH)), i)[0], robot.address)
            address = stranger.getsockname()
        camera.send(Picture(time.monotonic(), 9, SMOOTH), time.monotonic())
        assert [p.sequence for p in until(robot.receive)] == [9]
        assert robot.refused == {address: 3}
        assert sum("refused" in r.message for r in caplog.records) == 1
    finally:
        camera.close()
        robot.close()


def test_a_source_is_opened_by_its_address():
    """Each address opens its source; any other is refused in one sentence."""
    assert isinstance(open_pictures("none"), NoPictures) and open_pictures("none").receive(0.0) == []
    source = open_pictures("udp://127.0.0.1:58767", "127.0.0.1:0")
    assert isinstance(source, UdpPictures) and source.peer == ("127.0.0.1", 58767)
    source.close()
    for address in ("tcp://1.2.3.4:5", "shm:pool", "udp://127.0.0.1", "", "udp://localhost:99999"):
        with pytest.raises(LinkError, match=r"."):
            open_pictures(address, "127.0.0.1:0")


@pytest.mark.parametrize("marker", [0xC4, 0xC8, 0xCC, 0xE0])
def test_a_segment_before_the_frame_header_does_not_hide_the_size(marker):
    """Segments such as Huffman tables or extensions before the frame header are not mistaken for it."""
    data = bytearray(encode_picture(Picture(1.0, 0, SMOOTH), compress=True))
    start = data.index(b"\xff\xd8\xff")
    dqt = data.index(b"\xff\xdb", start)
    assert _announced(bytes(data[start:])) == SMOOTH.shape
    segment = bytes([0xFF, marker, 0, 12]) + bytes(range(10))
    assert _announced(bytes(data[start:dqt]) + segment + bytes(data[dqt:])) == SMOOTH.shape
    assert _announced(b"\xff\xd8" + segment) is None
