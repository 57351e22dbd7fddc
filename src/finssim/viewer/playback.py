"""The clock of a view: it runs, stands, runs faster, and is set."""

from __future__ import annotations

import math

__all__ = ["LONGEST_TURN", "SPEEDS", "Playback"]

SPEEDS = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
"""Times as fast as real."""
LONGEST_TURN = 0.1
"""What one turn of the loop may advance at single speed [s]: a world that is slower than real time slows the clock."""

NEARLY = 0.05
"""So near to its end a recording is over [s]: a slider need not reach it to the last digit."""


class Playback:
    """Where in a source's time the view is."""

    def __init__(self, duration: float, *, speed: float = 1.0, playing: bool = True) -> None:
        """
        Args:
            duration: Of the source [s]; infinite for a live one.
            speed: Times as fast as real.
            playing: Whether it runs from the start.
        """
        self.duration, self.speed, self.playing = duration, speed, playing
        self.time = 0.0
        """[s]"""

    @property
    def live(self) -> bool:
        """Whether there is no end, and no way back."""
        return math.isinf(self.duration)

    def advance(self, elapsed: float) -> float:
        """Let so much real time go by [s]; returns the new time [s]. A recording stops at its end."""
        if self.playing:
            self.time += min(elapsed, LONGEST_TURN) * self.speed
            if self.time >= self.duration:
                self.time, self.playing = self.duration, False
        return self.time

    def play(self, playing: bool) -> None:
        """Run or stand; from the end, run from the beginning."""
        if playing and self.time >= self.duration - NEARLY:
            self.time = 0.0
        self.playing = playing

    def seek(self, time: float) -> None:
        """Go to a time [s], within the source's; a live source has no other than its own."""
        if not self.live:
            self.time = min(max(time, 0.0), self.duration)
