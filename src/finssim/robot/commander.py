"""Who commands a robot, and the newest command that was fit to be used."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

__all__ = ["Commander"]

Array = npt.NDArray[np.float64]

EARLY = 0.1
"""How far a stamp may lie ahead of the robot's clock [s]."""


class Commander:
    """Takes thrust commands; what it refuses does not count as a sign of life."""

    def __init__(self, thrusters: int, timeout: float) -> None:
        """
        Args:
            thrusters: Numbers in a command, n.
            timeout: Age at which a command, or a word from another source, no longer counts [s].
        """
        self._thrusters = thrusters
        self._timeout = timeout
        self.forget()

    def forget(self) -> None:
        """As before the first command."""
        self.force: Array = np.zeros(self._thrusters)
        """Of the newest command, canonical order [N], (n,)."""
        self.received = -math.inf
        """When it came [s]."""
        self.source = ""
        self._stamp = -math.inf
        self._heard: dict[str, float] = {}

    def rival(self, now: float, source: str) -> str:
        """Another source that was heard, whatever it said, within the timeout; "" if there is none."""
        self._heard[source] = now
        self._heard = {name: time for name, time in self._heard.items() if now - time <= self._timeout}
        return next((name for name in self._heard if name != source), "")

    def sources(self, now: float) -> list[str]:
        """Everybody heard within the timeout."""
        return [name for name, time in self._heard.items() if now - time <= self._timeout]

    def accept(self, now: float, force: npt.ArrayLike, source: str, stamp: float | None) -> str:
        """Takes a command if it is fit to be used; otherwise says why not and keeps the one before.

        Args:
            now: When it came [s].
            force: Thrusts along the thrusters' axes, canonical order [N], (n,).
            source: Who sent it.
            stamp: Time of what its sender knew, robot's clock [s]; None: it does not tell.
        """
        try:
            wanted = np.array(force, float)
        except (TypeError, ValueError):
            return "command is no list of numbers"
        if wanted.shape != (self._thrusters,):
            return f"command has shape {wanted.shape}, expected {self._thrusters} thrusts"
        if not np.isfinite(wanted).all():
            return "command is not finite"
        if stamp is not None:
            if not -EARLY <= now - stamp <= self._timeout:
                return f"command is stamped {stamp:.3f} s, received at {now:.3f} s"
            if source == self.source and stamp < self._stamp:
                return "command is older than the one before"
        self.force, self.source, self.received = wanted, source, now
        self._stamp = -math.inf if stamp is None else stamp
        return ""

    def asks(self, now: float) -> bool:
        """Whether the newest command still counts and asks for thrust."""
        return now - self.received <= self._timeout and bool(self.force.any())
