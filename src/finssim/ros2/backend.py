"""Which rclpy a process uses: that of a sourced ROS 2 if it can be imported, our shim on the same wire if not."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from finssim.ros2.errors import Ros2Error

__all__ = ["Backend", "activate"]


@dataclass(frozen=True)
class Backend:
    """What `import rclpy` gives."""

    name: str
    """"native" or "dds"."""
    description: str
    """One line: which, where it talks, and why it was chosen."""


_active: list[Backend] = []


def activate(interfaces: Sequence[Path] = (), *, announce: bool = True) -> Backend:
    """Make `import rclpy` and the message packages work; later calls give the first one's answer.

    `PLATFORM_ROS` may be `native` or `dds`; without it the real rclpy is used wherever it can be imported. The
    environment's FINSSIM_ROS_INTERFACES names more folders of interface packages, apart by colons.

    Args:
        interfaces: Folders of interface packages (`msg/*.msg`, `srv/*.srv`) besides ours; a sourced ROS 2 has its own.
        announce: Whether to print the choice to standard error.

    Raises:
        Ros2Error: `PLATFORM_ROS` asks for what is not there, or a setting of the wire is malformed.
    """
    if not _active:
        asked = os.environ.get("PLATFORM_ROS", "")
        if asked not in ("", "native", "dds"):
            raise Ros2Error(f"PLATFORM_ROS is '{asked}': expected native or dds")
        missing = "PLATFORM_ROS=dds" if asked == "dds" else _why_not_native()
        if missing and asked == "native":
            raise Ros2Error(
                f"PLATFORM_ROS=native, but rclpy cannot be imported ({missing}): source a ROS 2 first"
            )
        _active.append(_shim(interfaces, missing) if missing else _native(asked))
        if announce:
            print(f"ROS 2: {_active[0].description}", file=sys.stderr, flush=True)
    return _active[0]


def _why_not_native() -> str:
    """Why the real rclpy cannot be used; empty if it can. Found by importing: half-sourced shells have it broken."""
    try:
        importlib.import_module("rclpy")
        importlib.import_module("rclpy.node")
    except ImportError as error:
        for name in [n for n in sys.modules if n.partition(".")[0] == "rclpy"]:
            del sys.modules[name]
        return str(error)
    return ""


def _native(asked: str) -> Backend:
    distro, middleware = (
        os.environ.get("ROS_DISTRO", "unknown"),
        os.environ.get("RMW_IMPLEMENTATION", "default"),
    )
    domain = os.environ.get("ROS_DOMAIN_ID", "0")
    reason = "PLATFORM_ROS=native" if asked else "it can be imported"
    return Backend("native", f"rclpy of {distro}, middleware {middleware}, domain {domain} ({reason})")


def _shim(interfaces: Sequence[Path], reason: str) -> Backend:
    try:
        importlib.import_module("finssim.ros2.shim")
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        raise Ros2Error(
            f"neither rclpy ({reason}) nor '{missing}' can be imported: source a ROS 2, or install finssim[ros2] "
            "on Python 3.10 or 3.11"
        ) from None
    from finssim.ros2.finder import install
    from finssim.ros2.wire.settings import wire_settings

    settings = wire_settings()
    named = [Path(p) for p in os.environ.get("FINSSIM_ROS_INTERFACES", "").split(os.pathsep) if p]
    install([*interfaces, *named])
    where = f"domain {settings.domain}, {settings.interface}, as {settings.distro.name}"
    return Backend("dds", f"built-in rclpy over Cyclone DDS, {where} ({reason})")
