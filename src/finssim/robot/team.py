"""Exchange of estimates between vehicles, one per datagram, and the resulting tracks of the others.

A datagram contains the sender's name and estimate; an acoustic modem, a radio on a float or a computer beside the pool
transports it. Receivers know only what has arrived, with its age.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from finssim.control.guidance import Track
from finssim.robot.reading import Reading
from finssim.robot.runtime import Ticks

MAGIC = b"FST1"
LAYOUT = struct.Struct("<4s32s14d")
"""Magic, name in UTF-8 padded with zeros, age [s], position [m], quaternion xyzw, nu [m/s, rad/s]; then CRC-32."""
CHECK = struct.Struct("<I")
LONGEST_NAME = 32
"""Greatest length of a name in UTF-8 [bytes]."""
OLDEST = 60.0
"""Greatest age of a track when it is sent [s]."""
FARTHEST = 1.0e5
"""Greatest plausible position or velocity [m, m/s, rad/s]."""


def encode_track(name: str, track: Track, now: float) -> bytes:
    """Return the datagram of a track.

    Args:
        name: Name of the vehicle.
        track: Track with the time of its measurement.
        now: Sender's clock [s].

    Raises:
        ValueError: The name is empty or longer than `LONGEST_NAME` bytes.
    """
    whose = name.encode("utf-8")
    if not 0 < len(whose) <= LONGEST_NAME:
        raise ValueError(f"name '{name}' takes {len(whose)} bytes, expected 1 to {LONGEST_NAME}")
    age = 0.0 if math.isnan(track.time) else now - track.time
    numbers = [float(x) for row in (track.position, track.quaternion, track.nu) for x in row]
    body = LAYOUT.pack(MAGIC, whose, age, *numbers)
    return body + CHECK.pack(zlib.crc32(body))


def decode_track(data: bytes, now: float) -> tuple[str, Track] | None:
    """Return name and track of a received datagram; None if it is invalid or implausible.

    Args:
        data: The datagram.
        now: Receiver's clock [s], to which the track's time refers.
    """
    if len(data) != LAYOUT.size + CHECK.size or CHECK.unpack(data[LAYOUT.size :])[0] != zlib.crc32(
        data[: LAYOUT.size]
    ):
        return None
    magic, whose, age, *numbers = LAYOUT.unpack(data[: LAYOUT.size])
    values = np.array(numbers)
    quaternion = values[3:7]
    length = float(np.linalg.norm(quaternion))
    plausible = np.isfinite(values).all() and np.abs(values).max() <= FARTHEST and abs(length - 1.0) < 1e-3
    if magic != MAGIC or not plausible or not 0.0 <= age <= OLDEST:
        return None
    try:
        name = whose.rstrip(b"\0").decode("utf-8")
    except UnicodeDecodeError:
        return None
    return (
        (name, Track(values[:3], quaternion / length, values[7:], now - age))
        if name.isprintable() and name
        else None
    )


class Team:
    """Message exchange of one vehicle with its team.

    Attributes:
        name: Role of this vehicle in the task.
        tracks: Received tracks of the others, by name: the one with the newest measurement.
        refused: Number of invalid datagrams.
    """

    def __init__(self, name: str, others: tuple[str, ...], *, period: float = 0.1, turn: float = 0.0) -> None:
        """Set up the exchange.

        Args:
            name: Role of this vehicle in the task.
            others: Names to receive: the task's other vehicles, and other targets.
            period: Time between two messages of this vehicle [s].
            turn: Time of this vehicle's turn within the period [s].
        """
        self.name, self.tracks, self.refused = name, dict[str, Track](), 0
        self._others, self._period, self._turn = frozenset(others), period, turn
        self._ticks: Ticks | None = None

    def hear(self, now: float, datagrams: Sequence[bytes]) -> None:
        """Process received datagrams. `now` is the time [s]."""
        for data in datagrams:
            heard = decode_track(data, now)
            if heard is None or heard[0] not in self._others:
                self.refused += 1
                continue
            name, track = heard
            previous = self.tracks.get(name)
            if previous is None or track.time > previous.time:
                self.tracks[name] = track

    def known(self, reading: Reading) -> Reading:
        """Return the reading with the tracks of the others; not ready before all have been received.

        A message of any age remains valid, as in training: a vehicle that is lost stops alone.
        """
        missing = sorted(self._others - self.tracks.keys())
        reading = replace(reading, tracks=dict(self.tracks))
        if not missing or not reading.ready:
            return reading
        return replace(reading, ready=False, reason=f"nothing heard of {', '.join(missing)}")

    def datagrams_to_send(self, now: float, reading: Reading) -> list[bytes]:
        """Return the datagrams to send now: none outside this vehicle's turn, or while its position is unknown.

        `now` is the time [s].
        """
        if self._ticks is None:
            self._ticks = Ticks(now + self._turn)
        due, _ = self._ticks.due(now, self._period)
        if not due or not np.isfinite(reading.position).all() or not np.isfinite(reading.nu).all():
            return []
        track = Track(reading.position, reading.quaternion, reading.nu, reading.time)
        return [encode_track(self.name, track, now)]
