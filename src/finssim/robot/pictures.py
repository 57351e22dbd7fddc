"""Transport of pictures to the robot: encoding, UDP, and detection of tags in a thread."""

from __future__ import annotations

import logging
import math
import re
import struct
import threading
import zlib
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import numpy.typing as npt

from finssim.core import realtime
from finssim.core.budget import decoded_picture
from finssim.localization.detection.detector import RegionTracker, detector
from finssim.robot.links.frames import LinkError
from finssim.robot.links.transports import UdpTransport, host_port
from finssim.robot.messages import Picture, TagCorners
from finssim.vehicles import Vehicle
from finssim.vehicles.equipment import SENSOR_NAME

# Pictures of a record, as JPEG.


QUALITY = 90

Image = npt.NDArray[np.uint8]


def jpeg(image: Image) -> bytes | None:
    """Return a gray picture (h, w) or one in blue, green and red (h, w, 3) as JPEG; None if it is not such a
    picture."""
    import cv2

    if image.dtype != np.uint8 or image.ndim not in (2, 3) or not image.size:
        return None
    try:
        well, packed = cv2.imencode(".jpg", np.ascontiguousarray(image), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    except cv2.error:  # a size that the format does not support
        return None
    return packed.tobytes() if well else None


def picture_of(data: Image | bytes, *, colour: bool = False) -> Image | None:
    """Return the gray picture, (h, w), or in red, green and blue, (h, w, 3); None if the data are not a picture."""
    import cv2

    kind = cv2.IMREAD_COLOR if colour else cv2.IMREAD_GRAYSCALE
    image = decoded_picture(bytes(data), kind)
    return None if isinstance(image, str) else image[..., ::-1] if colour else image


def resized(image: Image | None, shape: Sequence[int]) -> Image:
    """Return a picture in another size, each pixel the mean of those that it covers; for a sonar the nearest range
    cells.

    Args:
        image: Picture in colour, gray, or a sonar's echoes by beam and range cell.
        shape: Rows, columns, and 3 for colour; for a sonar beams, range cells and 1.

    Raises:
        LinkError: There is no picture, or it is of another kind.
    """
    if image is not None and image.ndim == 2 and len(shape) == 3:
        cut = image[:, : shape[1], None]
        if cut.shape == tuple(shape):
            return cut
    if image is None or image.shape[2:] != tuple(shape[2:]):
        kind = "no picture" if image is None else f"a picture of shape {image.shape}"
        raise LinkError(f"{kind} came where one of shape {tuple(shape)} is seen: name a sensor of that kind")
    if image.shape == tuple(shape):
        return image
    import cv2

    return np.asarray(cv2.resize(image, (shape[1], shape[0]), interpolation=cv2.INTER_AREA), np.uint8)


# Encoding of a picture: a header, the sensor's name, the tags, and the image, raw or as JPEG.
#
# magic "FSPC", version u8, format u8, tags u16, time f64, late f64, sequence u32, rows u32, columns u32,
# length of the image u32; in version 2, for the vehicle's own sensors, its name in 32 bytes, padded with 0;
# per tag: id i32, corners 8 x f64; the image, or ranges as f32. All little endian.


_HEAD = struct.Struct("<4sBBHddIIII")
_TAG = struct.Struct("<i8d")
_NAME = struct.Struct("<32s")
_MAGIC, _VERSION, _NAMED = b"FSPC", 1, 2
NO_IMAGE, RAW, JPEG, COLOUR, COLOUR_JPEG, RANGES = range(6)
"""Formats: none, gray, red green blue with 3 bytes a pixel, or ranges in one row."""
MOST_TAGS = 256
LARGEST = 64 * 2**20
"""Greatest number of pixels of a picture."""


@dataclass(frozen=True)
class ReceivedPicture:
    """A picture and its sender's times."""

    picture: Picture
    """`time` is on the sender's clock."""
    late: float
    """Delay of its sending after `time` [s]: the rendering time beyond the camera's latency."""


def encode_picture(picture: Picture, *, late: float = 0.0, compress: bool = False) -> bytes:
    """Return a picture as bytes.

    Args:
        picture: Gray or in colour, tags alone, or ranges.
        late: Time of sending minus `picture.time` [s].
        compress: True for JPEG of quality 90, which shifts corners by 0.004 px and needs an eighth of the bytes.
    """
    image, (rows, columns), kind, data = picture.image, (0, 0), NO_IMAGE, b""
    if picture.ranges is not None:
        rows, columns, kind = 1, len(picture.ranges), RANGES
        data = np.asarray(picture.ranges, "<f4").tobytes()
    elif image is not None:
        (rows, columns), colour = image.shape[:2], image.ndim == 3
        packed = jpeg(image[..., ::-1] if colour else image) if compress else None
        kind = (COLOUR_JPEG if packed else COLOUR) if colour else (JPEG if packed else RAW)
        data = packed or np.ascontiguousarray(image).tobytes()
    counts = len(picture.tags), picture.time, late, picture.sequence % 2**32, rows, columns, len(data)
    head = _HEAD.pack(_MAGIC, _NAMED if picture.source else _VERSION, kind, *counts)
    name = _NAME.pack(picture.source.encode()) if picture.source else b""
    tags = [_TAG.pack(tag.tag_id, *np.ravel(tag.corners)) for tag in picture.tags]
    return b"".join([head, name, *tags, data])


def decode_picture(data: bytes) -> ReceivedPicture | None:
    """Return the picture; None if the bytes are invalid. Never raises an exception."""
    if len(data) < _HEAD.size:
        return None
    magic, version, kind, n, time, late, sequence, rows, columns, size = _HEAD.unpack_from(data)
    first = _HEAD.size + (_NAME.size if version == _NAMED else 0)
    start = first + n * _TAG.size
    if magic != _MAGIC or version not in (_VERSION, _NAMED) or n > MOST_TAGS or len(data) != start + size:
        return None
    if not (math.isfinite(time) and math.isfinite(late)) or rows * columns > LARGEST:
        return None
    source = data[_HEAD.size : first].rstrip(b"\0").decode(errors="replace")
    tags = _tags(data[first:start], n)
    image, ranges = _image(kind, data[start:], rows, columns), None
    if kind == RANGES and rows == 1 and len(data) == start + 4 * columns:
        ranges = np.frombuffer(data, "<f4", offset=start)
    named = re.fullmatch(SENSOR_NAME, source) is not None
    if (
        tags is None
        or (image is None and ranges is None) != (kind == NO_IMAGE)
        or named != (version == _NAMED)
    ):
        return None
    if ranges is not None and np.isnan(ranges).any():
        return None
    return ReceivedPicture(Picture(time, sequence, image, tags, source, ranges), late)


def _tags(data: bytes, n: int) -> tuple[TagCorners, ...] | None:
    tags = []
    for i in range(n):
        tag, *corners = _TAG.unpack_from(data, i * _TAG.size)
        if not all(map(math.isfinite, corners)):
            return None
        tags.append(TagCorners(tag, np.array(corners).reshape(4, 2)))
    return tuple(tags)


def _image(
    kind: int, data: bytes, rows: int, columns: int
) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]] | None:
    """Return the pixels; None if they do not match the header."""
    colour = kind in (COLOUR, COLOUR_JPEG)
    shape = (rows, columns, 3) if colour else (rows, columns)
    if kind in (RAW, COLOUR) and len(data) == math.prod(shape) > 0:
        return np.frombuffer(data, np.uint8).reshape(shape)
    if kind in (JPEG, COLOUR_JPEG) and data[:2] == b"\xff\xd8" and _announced(data) == (rows, columns):
        image = picture_of(data, colour=colour)
        return image if image is not None and image.shape == shape else None
    return None


def _announced(data: bytes) -> tuple[int, int] | None:
    """Return rows and columns in a JPEG's own header, so that no decompression bomb is decoded."""
    at = 2
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker, size = data[at + 1], int.from_bytes(data[at + 2 : at + 4], "big")
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            return int.from_bytes(data[at + 5 : at + 7], "big"), int.from_bytes(data[at + 7 : at + 9], "big")
        at += 2 + max(size, 2)
    return None


# Messages longer than a datagram: split into numbered fragments, and reassembled with bounded memory.
#
# magic "FSPF", message u32, index u16, count u16, CRC-32 of the complete message u32; then a piece of it.
# All little endian; every piece but the last has the same length.


_FRAGMENT_HEAD = struct.Struct("<4sIHHI")
_FRAGMENT_MAGIC = b"FSPF"
LONGEST_FRAGMENT = 60_000
"""Bytes of the message in a datagram, within the limit of the loopback interface; 1400 are below the MTU of other
networks."""
MOST_FRAGMENTS = 4096
UNFINISHED = 4
"""Greatest number of incomplete messages; older ones are dropped."""
MOST_BYTES = 32 * 2**20
"""Greatest size of all incomplete messages together."""


def fragments(data: bytes, number: int, size: int = LONGEST_FRAGMENT) -> list[bytes]:
    """Return the datagrams of a message.

    Args:
        data: The message.
        number: Number of the message, different from the next one's.
        size: Bytes of the message in each datagram.
    """
    pieces = [data[i : i + size] for i in range(0, len(data), size)] or [b""]
    crc = zlib.crc32(data)
    return [
        _FRAGMENT_HEAD.pack(_FRAGMENT_MAGIC, number % 2**32, i, len(pieces), crc) + piece
        for i, piece in enumerate(pieces)
    ]


class Assembler:
    """Assembler of complete messages from fragments in any order, with repetitions and losses. Never raises an
    exception."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        """Numbers of messages: whole, unknown (not a fragment), incomplete (dropped), corrupt (CRC)."""
        self._parts: OrderedDict[tuple[int, int, int], dict[int, bytes]] = OrderedDict()
        self._held = 0
        self._done: OrderedDict[tuple[int, int, int], None] = OrderedDict()

    def add(self, datagram: bytes) -> bytes | None:
        """Return the message that this fragment completes, or None."""
        if len(datagram) < _FRAGMENT_HEAD.size:
            self.counts["unknown"] += 1
            return None
        magic, number, index, count, crc = _FRAGMENT_HEAD.unpack_from(datagram)
        if magic != _FRAGMENT_MAGIC or not index < count <= MOST_FRAGMENTS:
            self.counts["unknown"] += 1
            return None
        key = (number, count, crc)
        if key in self._done:
            return None
        parts = self._parts.setdefault(key, {})
        if index not in parts:
            parts[index] = datagram[_FRAGMENT_HEAD.size :]
            self._held += len(parts[index])
        if len(parts) < count:
            self._give_up()
            return None
        del self._parts[key]
        self._held -= sum(map(len, parts.values()))
        return self._whole(key, b"".join(parts[i] for i in range(count)))

    def _whole(self, key: tuple[int, int, int], data: bytes) -> bytes | None:
        if zlib.crc32(data) != key[2]:
            self.counts["corrupt"] += 1
            return None
        self.counts["whole"] += 1
        self._done[key] = None
        if len(self._done) > UNFINISHED:
            self._done.popitem(last=False)
        return data

    def _give_up(self) -> None:
        while len(self._parts) > UNFINISHED or self._held > MOST_BYTES:
            _, parts = self._parts.popitem(last=False)
            self._held -= sum(map(len, parts.values()))
            self.counts["incomplete"] += 1


# Pictures over UDP from one peer only, received by a separate thread so that they do not wait for the control loop.


_WAITING = 16
"""Greatest number of waiting pictures and readings; the oldest is dropped."""
_BUFFER = 4 * 2**20
"""Requested size of the system's receive buffer [bytes]."""
_LATEST = 10.0
"""Greatest delay of a picture [s]."""


class UdpPictures:
    """Receiver of pictures from one address; datagrams of others are refused, counted and logged once.

    A picture's time is that of its reception minus the sending delay that the sender reports.
    """

    def __init__(self, bind: tuple[str, int], peer: tuple[str, int], *, polled: bool = False) -> None:
        """Start receiving.

        Args:
            bind: Local address and port; port 0 selects a free one (see `address`).
            peer: Address and port of the camera.
            polled: True to read the socket only in `receive`, whose time is then that of reception, on any clock.

        Raises:
            LinkError: An address cannot be resolved or bound.
        """
        self.not_understood = 0
        self.assembler = Assembler()
        self._waiting: deque[tuple[float, Picture]] = deque(maxlen=_WAITING)
        self._wire = UdpTransport(bind, peer, longest=65536, buffer=_BUFFER)
        self.address, self.peer, self.refused = self._wire.address, self._wire.peer, self._wire.refused
        self._open = True
        self._thread = None if polled else threading.Thread(target=self._listen, name="pictures", daemon=True)
        if self._thread is not None:
            self._thread.start()

    def receive(self, now: float) -> list[Picture]:
        """Return the pictures since the last call, oldest first, with times on the clock of `now` [s]."""
        received, later = [], 0.0 if self._thread is None else realtime.now() - now
        for data in self._wire.receive() if self._thread is None else ():
            self._add(now, data)
        while self._waiting:
            came, picture = self._waiting.popleft()
            received.append(replace(picture, time=came - later))
        return received

    def close(self) -> None:
        """Close the socket."""
        self._open = False
        if self._thread is not None:
            self._thread.join(timeout=2.0)
        self._wire.close()

    def describe(self) -> str:
        """Return both addresses and the errors so far."""
        counts = self.assembler.counts
        bad = counts["incomplete"] + counts["corrupt"] + counts["unknown"] + self.not_understood
        text = f"{self._wire.describe()}, {counts['whole']} pictures"
        return text + (f", {bad} incomplete or corrupt" if bad else "")

    def _listen(self) -> None:
        while self._open:
            for data in self._wire.receive(wait=0.2):
                self._add(realtime.now(), data)

    def _add(self, came: float, data: bytes) -> None:
        complete = self.assembler.add(data)
        if complete is not None:
            self._take(came, complete)

    def _take(self, came: float, data: bytes) -> None:
        posted = decode_picture(data)
        if posted is None or not 0.0 <= posted.late < _LATEST:
            self.not_understood += 1
            return
        self._waiting.append((came - posted.late, posted.picture))


# Sources of pictures: UDP, or none.


DEFAULT_CAMERA = "127.0.0.1:58767"
"""Address of the virtual pool's camera."""
DEFAULT_PICTURES = "127.0.0.1:54322"
"""Address at which the robot receives its pictures."""


class PictureSource(Protocol):
    """The robot's end of the camera link. No call blocks, and no event on the link raises an exception."""

    def receive(self, now: float) -> list[Picture]:
        """Return the pictures since the last call, oldest first, each with its time on the clock of `now` [s]."""

    def close(self) -> None:
        """Close the link."""

    def describe(self) -> str:
        """Return the address and the state of the link, in a few words."""


class NoPictures:
    """No camera."""

    def receive(self, now: float) -> list[Picture]:
        """Return no pictures. `now` is the time [s]."""
        return []

    def close(self) -> None:
        """Do nothing."""

    def describe(self) -> str:
        """Return the description that there is none."""
        return "no pictures"


def open_pictures(address: str, bind: str = DEFAULT_PICTURES, *, polled: bool = False) -> PictureSource:
    """Return the source of pictures at an address.

    Args:
        address: "udp://HOST:PORT" of the camera, or "none".
        bind: Local "ADDRESS:PORT", for UDP.
        polled: See `UdpPictures`.

    Raises:
        LinkError: The address is invalid, or the source cannot be opened.
    """
    kind, _, rest = address.partition(":")
    if kind == "udp" and rest.startswith("//"):
        return UdpPictures(host_port(bind, "bind"), host_port(rest[2:], address), polled=polled)
    if address == "none":
        return NoPictures()
    raise LinkError(f"unknown source of pictures {address!r}: give udp://HOST:PORT or none")


# A picture source that detects tags in a separate thread, so that the control loop never waits for a detector.


_TAGS_LOG = logging.getLogger(__name__)
POLL = 0.002
"""Time between two checks for a new picture [s]."""
WAITING = 16
"""Greatest number of pictures and readings that wait for the loop."""


class TagFinder:
    """Source of pictures with their detected tags; the image is removed from a picture without tags.

    Readings of the vehicle's own sensors are passed on unchanged.
    """

    def __init__(
        self,
        source: PictureSource,
        vehicle: Vehicle,
        *,
        size: tuple[int, int],
        clock: Callable[[], float] = realtime.now,
    ) -> None:
        """Start the detection.

        Args:
            source: Source of pictures, owned by the finder from now on.
            vehicle: Vehicle with the tags to detect.
            size: Rows and columns of the camera's pictures; others are passed on unchanged, to be refused.
            clock: The robot's clock [s].
        """
        assert vehicle.tags is not None
        self._source, self._size, self._clock = source, size, clock
        self._tracker = RegionTracker(detector(vehicle.tags.family), set(vehicle.tags.mounts))
        self._found: deque[Picture] = deque(maxlen=WAITING)
        self._over = threading.Event()
        self.problem = ""
        """First error of the detector; the picture is passed on as one without tags."""
        self.skipped = 0
        """Number of pictures that were skipped because newer ones had arrived."""
        self._thread = threading.Thread(target=self._look, name="tag finder", daemon=True)
        self._thread.start()

    def receive(self, now: float) -> list[Picture]:
        """Return the pictures processed since the last call."""
        pictures = []
        while self._found:
            pictures.append(self._found.popleft())
        return pictures

    def describe(self) -> str:
        """Return the description of the source and of the detection, in a few words."""
        problem = f", {self.problem}" if self.problem else ""
        return f"{self._source.describe()}, {self.skipped} skipped{problem}"

    def close(self) -> None:
        """Stop the detection and close the source."""
        self._over.set()
        self._thread.join()
        self._source.close()

    def _look(self) -> None:
        while not self._over.wait(POLL):
            arrived = self._source.receive(self._clock())
            self._found.extend(picture for picture in arrived if picture.source)
            pictures = [picture for picture in arrived if not picture.source]
            if pictures:
                self.skipped += len(pictures) - 1
                self._found.append(self._with_tags(pictures[-1]))

    def _with_tags(self, picture: Picture) -> Picture:
        image = picture.image
        if image is None or picture.tags or image.shape != self._size or image.dtype != np.uint8:
            return picture
        try:
            detections = self._tracker.detect(image, picture.time)
        except Exception as error:  # any error: the next picture may be valid
            if not self.problem:
                self.problem = f"tags cannot be sought: {type(error).__name__}: {error}"
                _TAGS_LOG.warning(self.problem)
            return replace(picture, image=None)
        tags = tuple(TagCorners(d.tag, d.corners) for d in detections)
        return replace(picture, tags=tags, image=image if tags else None)
