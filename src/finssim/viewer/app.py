"""The view's page and its loop."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import redirect_stdout
from io import StringIO

import viser

from finssim.viewer.frame import Source
from finssim.viewer.panel import Panel
from finssim.viewer.playback import Playback
from finssim.viewer.scene import Scene

__all__ = ["View"]

RATE = 20.0
"""Frames a second [Hz]."""
PLOT_PERIOD = 0.5
"""Between drawings of the plots [s]."""


class View:
    """A page that shows a source. `run` is its loop; `turn` one pass of it."""

    def __init__(
        self,
        source: Source,
        *,
        bind: str = "127.0.0.1",
        port: int = 8080,
        speed: float = 1.0,
        playing: bool = True,
    ) -> None:
        """Serve the page.

        Args:
            source: What is shown; it belongs to the view from now on.
            bind: Address to serve at; this machine alone by default.
            port: To serve at, or the next one that is free.
            speed: Times as fast as real.
            playing: Whether it runs from the start.
        """
        self.source, self.playback = source, Playback(source.duration, speed=speed, playing=playing)
        with redirect_stdout(StringIO()):  # viser greets and says goodbye even where it is told not to
            self.server = viser.ViserServer(host=bind, port=port, label="FinsSim", verbose=False)
        self.scene = Scene(self.server, source.stage)
        self.panel = Panel(self.server, source.stage, self.playback)
        self._drawn, self._plotted, self._since_plot = math.nan, math.nan, math.inf
        host = "localhost" if bind in ("0.0.0.0", "::") else bind
        self.url = f"http://{host}:{self.server.get_port()}"
        """Of the page."""

    def turn(self, elapsed: float) -> None:
        """Let so much real time go by [s], and draw what that changes."""
        self.panel.read()
        now = self.playback.advance(elapsed)
        self._since_plot += elapsed
        if now != self._drawn:
            frame = self.source.frame(now)
            with self.server.atomic():
                self.scene.draw(frame)
                self.panel.show(frame)
            self._drawn = now
        if now != self._plotted and self._since_plot >= PLOT_PERIOD:
            self.panel.plot(self.source.curves(), now)
            self._plotted, self._since_plot = now, 0.0

    def run(self, until: Callable[[], bool], *, clock: Callable[[], float] = time.monotonic) -> None:
        """Show the source until told to stop."""
        before = clock()
        while not until():
            now = clock()
            self.turn(now - before)
            before = now
            time.sleep(max(0.0, 1.0 / RATE - (clock() - now)))

    def close(self) -> None:
        """Take the page down."""
        with redirect_stdout(StringIO()):
            self.server.stop()
        self.source.close()
