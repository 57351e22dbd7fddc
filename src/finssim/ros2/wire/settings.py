"""Where the wire goes: domain and network interface, from the environment that ROS 2 itself reads."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass

from finssim.ros2.distro import Distro, distro_of
from finssim.ros2.errors import Ros2Error

__all__ = ["LOOPBACK", "WireSettings", "wire_settings"]

MAX_DOMAIN = 232
"""A higher domain has no room for its UDP ports (7400 + 250 d + 2·index)."""

LOOPBACK = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='lo'/></Interfaces>"
    "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
    "<MaxAutoParticipantIndex>60</MaxAutoParticipantIndex><Peers><Peer address='127.0.0.1'/></Peers></Discovery>"
    "</Domain></CycloneDDS>"
)
"""Cyclone's configuration for this machine alone: the loopback interface has no multicast, so peers are asked."""

LOOPBACK_WORDS = "sends on the loopback alone, listens on every address"
"""Cyclone binds what it receives on to all addresses, whatever interface it is given."""


@dataclass(frozen=True)
class WireSettings:
    """How a participant joins."""

    domain: int
    """ROS domain, 0 to 232."""
    xml: str | None
    """Configuration of Cyclone; None where the environment's own or Cyclone's default rules."""
    interface: str
    """The same in words, for the line at the start."""
    distro: Distro


def wire_settings(environ: Mapping[str, str] = os.environ, domain: int | None = None) -> WireSettings:
    """Settings as the environment has them: this machine only, unless it says otherwise.

    `CYCLONEDDS_URI` wins over everything. Without it, the network is used only when `ROS_LOCALHOST_ONLY=0`, or
    `ROS_AUTOMATIC_DISCOVERY_RANGE` is SUBNET or SYSTEM_DEFAULT.

    Args:
        environ: The environment.
        domain: Domain to use instead of `ROS_DOMAIN_ID` (0 where that is not set either).

    Raises:
        Ros2Error: A variable holds what it cannot.
    """
    number = _domain(environ.get("ROS_DOMAIN_ID") or "0") if domain is None else _domain(str(domain))
    if environ.get("CYCLONEDDS_URI"):
        return WireSettings(number, None, "as CYCLONEDDS_URI says", distro_of(environ))
    if _network_wanted(environ):
        return WireSettings(
            number, None, "the network interface that Cyclone DDS chooses", distro_of(environ)
        )
    return WireSettings(number, LOOPBACK, LOOPBACK_WORDS, distro_of(environ))


def _domain(text: str) -> int:
    if not (text.isdecimal() and int(text) <= MAX_DOMAIN):
        raise Ros2Error(
            f"ROS domain '{text}': expected a whole number from 0 to {MAX_DOMAIN} in ROS_DOMAIN_ID"
        )
    return int(text)


def _network_wanted(environ: Mapping[str, str]) -> bool:
    reach = environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper()
    if reach not in ("", "SUBNET", "LOCALHOST", "SYSTEM_DEFAULT"):
        raise Ros2Error(
            f"ROS_AUTOMATIC_DISCOVERY_RANGE is '{reach}': expected LOCALHOST, SUBNET or SYSTEM_DEFAULT"
        )
    local = environ.get("ROS_LOCALHOST_ONLY", "")
    if local not in ("", "0", "1"):
        raise Ros2Error(f"ROS_LOCALHOST_ONLY is '{local}': expected 0 or 1")
    return local == "0" if local else reach in ("SUBNET", "SYSTEM_DEFAULT")
