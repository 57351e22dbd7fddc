"""The side of a view: clock, health, the camera's picture, events and plots."""

from __future__ import annotations

import math
from typing import Any

import viser

from finssim.viewer.frame import Frame, Picture, Stage
from finssim.viewer.picture_panel import blank, draw_picture
from finssim.viewer.playback import SPEEDS, Playback
from finssim.viewer.plots import legend_of, plots_of
from finssim.viewer.scene import COLOURS

__all__ = ["Panel"]

SLIDER_STEP = 0.02
"""Of the time slider [s]."""


class Panel:
    """Controls and figures of one stage."""

    def __init__(self, server: viser.ViserServer, stage: Stage, playback: Playback) -> None:
        """
        Args:
            server: Of the page.
            stage: What is looked at.
            playback: The clock that the controls set.
        """
        self._server, self._gui, self._playback = server, server.gui, playback
        self._gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        self._gui.set_panel_label("FinsSim")
        self._gui.main_panel.dock_right()
        self._gui.add_markdown(f"**{stage.title}**  \n{_legend()}")
        self._slider: Any = None
        self._button: Any = None
        self._speed: Any = None
        self._shown = 0.0
        self._controls(playback)
        self._status = self._gui.add_markdown("")
        self._image: Any = None
        if stage.site is not None:
            with self._gui.add_folder("camera"):
                self._image = self._gui.add_image(blank(), jpeg_quality=70)
        self._seen: Picture | None = None
        with self._gui.add_folder("errors") as self._figures:
            self._named = self._gui.add_markdown("")
        self._plots: dict[tuple[str, ...], Any] = {}
        with self._gui.add_folder("events"):
            self._events = self._gui.add_markdown("none yet")
        self._last_events: tuple[str, ...] = ()

    def read(self) -> None:
        """Do what the person at the controls wants."""
        playback = self._playback
        playback.speed = float(self._speed.value.removesuffix("x"))
        label = "pause" if playback.playing else "play"
        if self._button.label != label:
            self._button.label = label
        if self._slider is not None and abs(self._slider.value - self._shown) > 0.5 * SLIDER_STEP:
            playback.seek(float(self._slider.value))
            self._shown = float(self._slider.value)

    def show(self, frame: Frame) -> None:
        """Put a frame's figures on the panel."""
        playback = self._playback
        if self._slider is None:
            self._clock.content = f"{frame.time:.1f} s"
        elif self._shown != playback.time:
            self._slider.value = self._shown = min(round(playback.time, 2), self._slider.max)
        rows = "".join(f"| {name} | {text} |\n" for name, text in frame.status.items())
        content = f"| | |\n|---|---|\n{rows}" if rows else ""
        if content != self._status.content:
            self._status.content = content
        if self._image is not None and frame.picture is not self._seen:
            self._seen = frame.picture
            self._image.image = blank() if frame.picture is None else draw_picture(frame.picture)
        events = tuple(frame.events)
        if events != self._last_events:
            self._last_events = events
            self._events.content = "  \n".join(_plain(line) for line in reversed(events)) or "none yet"

    def plot(self, curves: Any, now: float) -> None:
        """Draw curves, up to a time in full [s]."""
        plots = plots_of(curves)
        named = legend_of(plots)
        if named != self._named.content:
            self._named.content = named
        for plot in plots:
            key = (plot.title, *(curve.label for curve in plot.curves))
            if key not in self._plots:
                for old in [k for k in self._plots if k[0] == plot.title]:
                    self._plots.pop(old).remove()
                with self._figures:
                    self._plots[key] = self._gui.add_uplot(
                        plot.data(now),
                        plot.series(),
                        title=plot.title,
                        scales={"x": {"time": False}},
                        legend={"show": False},
                        aspect=2.0,
                    )
            else:
                self._plots[key].data = plot.data(now)

    def _controls(self, playback: Playback) -> None:
        gui = self._gui
        if playback.live:
            self._clock = gui.add_markdown("0.0 s")
        else:
            steps = max(1, math.floor(playback.duration / SLIDER_STEP))
            self._slider = gui.add_slider("time [s]", 0.0, round(steps * SLIDER_STEP, 2), SLIDER_STEP, 0.0)
        self._button = gui.add_button("pause" if playback.playing else "play")
        speeds = tuple(f"{speed:g}x" for speed in SPEEDS)
        first = f"{playback.speed:g}x"
        options = speeds if first in speeds else (first, *speeds)
        self._speed = gui.add_dropdown("speed", options, initial_value=first)
        self._button.on_click(lambda _: playback.play(not playback.playing))


def _legend() -> str:
    names = ("truth", "estimate", "goal", "force")
    return " · ".join(
        f'<span style="color:rgb{COLOURS[name]}">■</span> {name}'.replace(", ", ",") for name in names
    )


def _plain(text: str) -> str:
    """A line in which nothing is markup."""
    return "".join(f"\\{c}" if c in "\\`*_{}[]<>#|" else c for c in text)
