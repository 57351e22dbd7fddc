"""Several vehicles at one site: a plant and a motor controller each, and one camera that sees the tags of all."""

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


# Transmission of messages between vehicles through the water: delayed by distance, and sometimes lost, as in training.


Array = NDArray[np.float64]


class Medium:
    """Medium that carries a datagram to all other vehicles; losses follow from the seed and the order of sending."""

    def __init__(
        self,
        positions: Callable[[], Mapping[str, Array]],
        communication: Communication | None = None,
        seed: int = 0,
    ) -> None:
        """
        Args:
            positions: Function that returns the positions of all vehicles, by name, world frame [m], (3,).
            communication: Speed of sound, processing time and loss; None delivers everything immediately.
            seed: Seed of the losses.
        """
        self._positions, self._communication = positions, communication
        self._random = random.Random(f"medium {seed}")
        self._order = count()
        self._under_way: dict[str, list[tuple[float, int, bytes]]] = {name: [] for name in positions()}

    def send(self, now: float, sender: str, datagram: bytes, *, lossless: bool = False) -> None:
        """Send a datagram at a time [s]; if `lossless`, it travels on a cable, without delay or loss."""
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
        """Return the datagrams that have reached a receiver by a time [s], in the order of arrival."""
        under_way, out = self._under_way[name], []
        while under_way and under_way[0][0] <= now + 1e-9:
            out.append(heapq.heappop(under_way)[2])
        return out


class Fleet:
    """Vehicles and objects in the water, by name.

    Attributes:
        worlds: Plants and motor controllers.
        medium: Medium for messages between the vehicles; None means no messages.
        runtimes: Software of the vehicles that the site itself controls.
    """

    def __init__(self, worlds: Mapping[str, VirtualPool], medium: Medium | None = None) -> None:
        """Create a fleet of vehicles with a common time."""
        self.worlds, self.medium = dict(worlds), medium
        self.runtimes: dict[str, Runtime] = {}

    @property
    def over(self) -> bool:
        """Return whether the task is over; the vehicles continue."""
        return False

    def evaluate(self, now: float, due: bool) -> None:
        """Evaluate the true state; only a task site does this.

        Args:
            now: Site's clock [s].
            due: Whether the software of the vehicles has just run a step.
        """

    def close(self) -> None:
        """Finish the truth files."""
        for world in self.worlds.values():
            world.close()


def one_picture(pictures: Iterable[Picture]) -> list[Picture]:
    """Return pictures with the tags of all vehicles, from the pictures of each vehicle with equal exposures."""
    by_exposure: dict[tuple[str, int], Picture] = {}
    for picture in pictures:
        key = picture.source, picture.sequence
        before = by_exposure.get(key)
        by_exposure[key] = picture if before is None else replace(before, tags=before.tags + picture.tags)
    return [by_exposure[key] for key in sorted(by_exposure)]
