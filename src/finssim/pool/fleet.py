"""Several vehicles in one water: a plant and a motor controller each, and one camera that sees the tags of all."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

from finssim.pool.medium import Medium
from finssim.pool.virtual_pool import VirtualPool
from finssim.robot.messages import Picture
from finssim.robot.runtime import Runtime

__all__ = ["Fleet", "one_picture"]


class Fleet:
    """What is in the water, by name.

    Attributes:
        worlds: Plants and motor controllers.
        medium: What carries messages between the vehicles; None: nothing does.
        runtimes: Software of the vehicles that the site itself steers.
    """

    def __init__(self, worlds: Mapping[str, VirtualPool], medium: Medium | None = None) -> None:
        """Of vehicles at the same time."""
        self.worlds, self.medium = dict(worlds), medium
        self.runtimes: dict[str, Runtime] = {}

    @property
    def over(self) -> bool:
        """Whether all that was to be done is done; the vehicles swim on."""
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
    found: dict[int, Picture] = {}
    for picture in pictures:
        before = found.get(picture.sequence)
        found[picture.sequence] = (
            picture if before is None else replace(before, tags=before.tags + picture.tags)
        )
    return [found[sequence] for sequence in sorted(found)]
