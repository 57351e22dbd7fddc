"""What differs on the wire between releases of ROS 2."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass

from finssim.ros2.errors import Ros2Error

__all__ = ["DISTROS", "Distro", "distro_of"]


@dataclass(frozen=True)
class Distro:
    """One release of ROS 2 as its peers see it."""

    name: str
    gid_length: int
    """Bytes of an endpoint's identifier in the node list: 24 up to Humble, 16 since Iron."""
    type_hashes: bool
    """Whether endpoints announce the hash of their type (since Iron)."""


DISTROS = {
    "humble": Distro("humble", 24, False),
    "iron": Distro("iron", 16, True),
    "jazzy": Distro("jazzy", 16, True),
    "kilted": Distro("kilted", 16, True),
}
"""Releases whose messages and wire are known."""


def distro_of(environ: Mapping[str, str] = os.environ) -> Distro:
    """The release to speak: that of `ROS_DISTRO`, Jazzy where it is not set.

    Raises:
        Ros2Error: A release that is not known.
    """
    name = environ.get("ROS_DISTRO") or "jazzy"
    if name not in DISTROS:
        raise Ros2Error(
            f"ROS_DISTRO is '{name}': set it to one of {', '.join(DISTROS)}, as the other nodes have it"
        )
    return DISTROS[name]
