"""The wire between a robot and a virtual pool with a hand on it: what passes can be changed, and the truth is noted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from finssim.pool.virtual_pool import VirtualPool
from finssim.robot.link.decoder import MCU, Decoder
from finssim.robot.link.frames import encode_telemetry
from finssim.robot.messages import Delivery, Picture, Telemetry

__all__ = ["Course", "FaultyWire"]

Array = NDArray[np.float64]


class Course(NamedTuple):
    """What truly happened, by the pool's clock."""

    time: Array
    """[s], (k,)"""
    position: Array
    """Body origin, world frame [m], (k, 3)."""
    thrust: Array
    """Delivered, canonical order [N], (k, n)."""
    enabled: Array
    """Whether a frame that enables the motors left the robot at this time, (k,); NaN where nobody noted."""


class FaultyWire:
    """A world in lock-step whose time goes on by one period at each exchange, whatever the robot's clock says.

    Attributes:
        pool: Behind it.
        shift: By how much the robot's clock is ahead of the pool's [s]; a change is a jump of the robot's clock.
        change: Applied to each snapshot of the vehicle; None leaves the bytes alone.
        pictures: Applied to the pictures of an exchange; None leaves them alone.
    """

    def __init__(self, pool: VirtualPool, rate: float) -> None:
        """
        Args:
            pool: At time 0.
            rate: Exchanges a second [Hz].
        """
        self.pool = pool
        self.shift = 0.0
        self.change: Callable[[Telemetry], Telemetry] | None = None
        self.pictures: Callable[[Sequence[Picture]], Sequence[Picture]] | None = None
        self._rate, self._turns = rate, 0
        self._decoder, self._mcu = Decoder(outputs=pool.vehicle.mcu.outputs), Decoder(MCU)
        self._rows: list[tuple[float, Array, Array, bool]] = []

    def exchange(self, until: float, sent: Sequence[bytes]) -> Delivery:
        """Let the pool go on by one period; `until` is the robot's belief and does not count."""
        self._note(sent)
        self._turns += 1
        delivery = self.pool.exchange(self._turns / self._rate, sent)
        frames = delivery.frames
        if self.change is not None:
            frames = tuple((time, self._changed(data)) for time, data in frames)
        pictures = delivery.pictures if self.pictures is None else tuple(self.pictures(delivery.pictures))
        return Delivery(
            delivery.time + self.shift,
            tuple((time + self.shift, data) for time, data in frames),
            tuple(replace(picture, time=picture.time + self.shift) for picture in pictures),
        )

    def course(self) -> Course:
        """The truth at each exchange."""
        time, position, thrust, enabled = zip(*self._rows, strict=True)
        return Course(np.array(time), np.array(position), np.array(thrust), np.array(enabled, float))

    def _note(self, sent: Sequence[bytes]) -> None:
        plant = self.pool.plant
        drives = any(command.enable for data in sent for command in self._mcu.feed(data))
        self._rows.append((self.pool.time, plant.position.astype(float), plant.thrust.astype(float), drives))

    def _changed(self, data: bytes) -> bytes:
        """The frame with its snapshot changed; other frames, and those that no longer decode, as they are."""
        messages = self._decoder.feed(data)
        if self.change is None or len(messages) != 1 or not isinstance(messages[0], Telemetry):
            return data
        return encode_telemetry(self.change(messages[0]))
