"""Where pictures come from: over UDP, through shared memory, or nowhere."""

from __future__ import annotations

from typing import Protocol

from finssim.robot.link.layout import LinkError
from finssim.robot.link.transports import host_port
from finssim.robot.messages import Picture
from finssim.robot.picture_memory import SharedMemoryPictures
from finssim.robot.picture_udp import UdpPictures

__all__ = [
    "DEFAULT_CAMERA",
    "DEFAULT_PICTURES",
    "NoPictures",
    "PictureSource",
    "SharedMemoryPictures",
    "UdpPictures",
    "open_pictures",
]

DEFAULT_CAMERA = "127.0.0.1:58767"
"""Address of the virtual pool's camera."""
DEFAULT_PICTURES = "127.0.0.1:54322"
"""Address at which the robot takes its pictures."""


class PictureSource(Protocol):
    """The robot's end of the camera's wire. No call blocks, and none raises for what happens on the wire."""

    def receive(self, now: float) -> list[Picture]:
        """Pictures that came since the last call, oldest first, each with its time on the clock of `now` [s]."""

    def close(self) -> None:
        """Let go of the wire."""

    def describe(self) -> str:
        """The wire and how it fares, in a few words."""


class NoPictures:
    """No camera."""

    def receive(self, now: float) -> list[Picture]:
        """Nothing."""
        return []

    def close(self) -> None:
        """Nothing to let go of."""

    def describe(self) -> str:
        """That there is none."""
        return "no pictures"


def open_pictures(address: str, bind: str = DEFAULT_PICTURES) -> PictureSource:
    """The source that an address names.

    Args:
        address: "udp://HOST:PORT" of the camera's end, "shm:NAME" on this machine, or "none".
        bind: "ADDRESS:PORT" of this end, for UDP.

    Raises:
        LinkError: It names no source, or the source cannot be opened.
    """
    kind, _, rest = address.partition(":")
    if kind == "udp" and rest.startswith("//"):
        return UdpPictures(host_port(bind, "bind"), host_port(rest[2:], address))
    if kind == "shm" and rest:
        return SharedMemoryPictures(rest)
    if address == "none":
        return NoPictures()
    raise LinkError(f"unknown source of pictures {address!r}: give udp://HOST:PORT, shm:NAME or none")
