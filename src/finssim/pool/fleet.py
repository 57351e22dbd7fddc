"""Several vehicles in one water: a plant and a motor controller each, and one camera that sees the tags of all."""

from __future__ import annotations

import heapq
import random
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from itertools import count

import numpy as np
from numpy.typing import NDArray

from finssim.pool.virtual_pool import VirtualPool
from finssim.robot.messages import Picture
from finssim.robot.runtime import Runtime
from finssim.tasks.communication import Communication

__all__ = ["Fleet", "Medium", "one_picture"]


# Messages between vehicles on their way through the water: late by the way, and sometimes lost, as in training.


Array = NDArray[np.float64]


class Medium:
    """Carries a datagram to all others; which are lost follows from the seed and the order of sending."""

    def __init__(
        self,
        positions: Callable[[], Mapping[str, Array]],
        communication: Communication | None = None,
        seed: int = 0,
    ) -> None:
        """
        Args:
            positions: Where everybody is, by name, world frame [m], (3,).
            communication: Speed of sound, processing time and loss; None: everything arrives at once.
            seed: Of what is lost.
        """
        self._positions, self._communication = positions, communication
        self._random = random.Random(f"medium {seed}")
        self._order = count()
        self._under_way: dict[str, list[tuple[float, int, bytes]]] = {name: [] for name in positions()}

    def send(self, now: float, sender: str, datagram: bytes, *, lossless: bool = False) -> None:
        """Put a datagram into the water at a time [s]; one that is `lossless` is on a cable."""
        places, c = self._positions(), self._communication
        for name, under_way in self._under_way.items():
            if name == sender:
                continue
            arrival = now
            if c is not None and not lossless:
                if self._random.random() < c.loss:
                    continue
                way = float(np.linalg.norm(places[name] - places[sender]))
                arrival += way / c.speed_of_sound + c.processing
            heapq.heappush(under_way, (arrival, next(self._order), datagram))

    def receive(self, now: float, name: str) -> list[bytes]:
        """Return what has reached a receiver by a time [s], in the order of arrival."""
        under_way, out = self._under_way[name], []
        while under_way and under_way[0][0] <= now + 1e-9:
            out.append(heapq.heappop(under_way)[2])
        return out


class Fleet:
    """Vehicles and objects in the water, by name.

    Attributes:
        worlds: Plants and motor controllers.
        medium: What carries messages between the vehicles; None: nothing does.
        runtimes: Software of the vehicles that the site itself steers.
    """

    def __init__(self, worlds: Mapping[str, VirtualPool], medium: Medium | None = None) -> None:
        """Make a fleet of vehicles at the same time."""
        self.worlds, self.medium = dict(worlds), medium
        self.runtimes: dict[str, Runtime] = {}

    @property
    def over(self) -> bool:
        """Return whether the task is over; the vehicles continue to swim."""
        return False

    def turn(self, now: float, due: bool) -> None:
        """Look at what is true; nothing but a task does.

        Args:
            now: Site's clock [s].
            due: Whether the software of vehicles has just taken a step.
        """

    def close(self) -> None:
        """Finish the truth files."""
        for world in self.worlds.values():
            world.close()


def one_picture(pictures: Iterable[Picture]) -> list[Picture]:
    """Corners of each vehicle, of the same exposures, as the one camera has them: a picture with all tags."""
    by_exposure: dict[tuple[str, int], Picture] = {}
    for picture in pictures:
        key = picture.source, picture.sequence
        before = by_exposure.get(key)
        by_exposure[key] = picture if before is None else replace(before, tags=before.tags + picture.tags)
    return [by_exposure[key] for key in sorted(by_exposure)]
