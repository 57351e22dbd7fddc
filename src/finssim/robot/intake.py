"""Everything that arrives: decoded, put on the robot's clock, and given to perception, bridge and record."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from finssim.robot.bridge import Bridge
from finssim.robot.counters import Counters
from finssim.robot.link.clock import ClockMap
from finssim.robot.link.decoder import Decoder
from finssim.robot.messages import CommandEcho, NavigationAid, Picture, Telemetry
from finssim.robot.perception import Perception

if TYPE_CHECKING:
    from finssim.robot.recorder import Recorder

__all__ = ["Intake"]

USED = ("accepted", "initialized", "reacquired")


class Intake:
    """Feeds one perception and one bridge. Nothing that arrives can raise."""

    def __init__(
        self, perception: Perception, bridge: Bridge, counters: Counters, recorder: Recorder | None = None
    ) -> None:
        """
        Args:
            perception: Learns what the sensors say.
            bridge: Watches whether they still speak.
            counters: Counts it.
            recorder: Takes it down.
        """
        self.decoder = Decoder(outputs=perception.vehicle.mcu.outputs)
        self.clock = ClockMap()
        self._perception, self._bridge = perception, bridge
        self._counters, self.recorder = counters, recorder

    def take(
        self, now: float, frames: Sequence[tuple[float, bytes]], pictures: Sequence[Picture] = ()
    ) -> None:
        """Take in what has come.

        Args:
            now: Robot's clock [s].
            frames: Datagrams from the motor controller, each with its time of arrival [s].
            pictures: From the camera.
        """
        for arrival, data in frames:
            for message in self.decoder.feed(data):
                if isinstance(message, Telemetry):
                    self._telemetry(arrival, message)
                elif isinstance(message, CommandEcho):
                    self._echo(arrival, message)
                elif isinstance(message, NavigationAid):
                    self._aid(arrival, message)
        for picture in pictures:
            verdict = self._perception.picture(now, picture)
            self._counters.picture(picture.time, verdict in USED)
            if self.recorder is not None:
                self.recorder.picture(now, picture)

    def _telemetry(self, arrival: float, telemetry: Telemetry) -> None:
        time = self.clock.stamp(telemetry.mcu_ms, arrival)
        self._counters.telemetry += 1
        self._perception.telemetry(arrival, telemetry, time)
        self._bridge.telemetry(arrival, telemetry)
        if self.recorder is not None:
            self.recorder.telemetry(arrival, telemetry, time)

    def _aid(self, arrival: float, aid: NavigationAid) -> None:
        self._perception.aid(arrival, aid)
        if self.recorder is not None:
            self.recorder.aid(arrival, aid)

    def _echo(self, arrival: float, echo: CommandEcho) -> None:
        self._bridge.echo(arrival, echo)
        if self.recorder is not None:
            self.recorder.echo(arrival, echo)
