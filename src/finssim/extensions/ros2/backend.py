"""Selection of rclpy for a process: that of a sourced ROS 2 if it can be imported, otherwise FinsSim's own on DDS."""

from __future__ import annotations

import importlib
import importlib.abc
import importlib.machinery
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

from finssim.extensions.ros2 import Ros2Error
from finssim.extensions.ros2.codec import Codec, codec_of
from finssim.extensions.ros2.limits import PACKAGES, refuse

__all__ = ["activate", "install"]


@dataclass(frozen=True)
class Backend:
    """Modules behind `import rclpy`."""

    name: str
    """Name of the backend: "native" or "dds"."""
    description: str
    """Description in one line: kind, network settings, and the reason for the selection."""


_active: list[Backend] = []


def activate(interfaces: Sequence[Path] = (), *, announce: bool = True) -> Backend:
    """Make `import rclpy` and the message packages work; later calls return the result of the first.

    `PLATFORM_ROS` may be `native` or `dds`; by default the real rclpy is used if it can be imported. The
    environment variable FINSSIM_ROS_INTERFACES names more folders of interface packages, separated by colons.

    Args:
        interfaces: Additional folders of interface packages (`msg/*.msg`, `srv/*.srv`); a sourced ROS 2 uses
            its own.
        announce: True to print the selection to standard error.

    Raises:
        Ros2Error: The backend requested by `PLATFORM_ROS` is not available, or a network setting is malformed.
    """
    if not _active:
        requested = os.environ.get("PLATFORM_ROS", "")
        if requested not in ("", "native", "dds"):
            raise Ros2Error(f"PLATFORM_ROS is '{requested}': expected native or dds")
        missing = "PLATFORM_ROS=dds" if requested == "dds" else _why_not_native()
        if missing and requested == "native":
            raise Ros2Error(
                f"PLATFORM_ROS=native, but rclpy cannot be imported ({missing}): source a ROS 2 first"
            )
        _active.append(_shim(interfaces, missing) if missing else _native(requested))
        if announce:
            print(f"ROS 2: {_active[0].description}", file=sys.stderr, flush=True)
    return _active[0]


def _why_not_native() -> str:
    """Return the reason why the real rclpy cannot be used; empty if it can. It is imported, since partly
    sourced shells have a broken rclpy."""
    try:
        importlib.import_module("rclpy")
        importlib.import_module("rclpy.node")
    except ImportError as error:
        for name in [n for n in sys.modules if n.partition(".")[0] == "rclpy"]:
            del sys.modules[name]
        return str(error)
    return ""


def _native(requested: str) -> Backend:
    distro, middleware = (
        os.environ.get("ROS_DISTRO", "unknown"),
        os.environ.get("RMW_IMPLEMENTATION", "default"),
    )
    domain = os.environ.get("ROS_DOMAIN_ID", "0")
    reason = "PLATFORM_ROS=native" if requested else "it can be imported"
    return Backend("native", f"rclpy of {distro}, middleware {middleware}, domain {domain} ({reason})")


def _shim(interfaces: Sequence[Path], reason: str) -> Backend:
    try:
        importlib.import_module("finssim.extensions.ros2.shim")
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        raise Ros2Error(
            f"neither rclpy ({reason}) nor '{missing}' can be imported: source a ROS 2, or install finssim[ros2] "
            "on Python 3.10 or 3.11"
        ) from None
    from finssim.extensions.ros2.wire import wire_settings

    settings = wire_settings()
    named = [Path(p) for p in os.environ.get("FINSSIM_ROS_INTERFACES", "").split(os.pathsep) if p]
    install([*interfaces, *named])
    domain_text = f"domain {settings.domain}, {settings.interface}, as {settings.distro.name}"
    return Backend("dds", f"built-in rclpy over Cyclone DDS, {domain_text} ({reason})")


# Import hooks by which `import rclpy`, `import nav_msgs.msg` and `import std_srvs.srv` find the shim and
# message classes.

PARTS = {
    "context": ("context", "signals", "utilities"),
    "endpoint": (
        "callback_groups", "client", "event_handler", "publisher", "serialization", "service", "subscription", "task",
    ),
    "exceptions": ("exceptions",),
    "executors": ("executors", "timer"),
    "graph": ("topic_endpoint_info", "type_hash"),
    "logging": ("logging",),
    "node": ("node",),
    "parameter": ("parameter", "parameter_service"),
    "qos": ("qos",),
    "time": ("clock", "clock_type", "duration", "time"),
}  # fmt: skip
"""Module of the shim -> submodules of rclpy that it replaces."""
TF2 = (
    "buffer",
    "buffer_interface",
    "static_transform_broadcaster",
    "transform_broadcaster",
    "transform_listener",
)
"""Submodules of tf2_ros, all of which are one module of the shim."""


def install(interfaces: Sequence[Path] = ()) -> None:
    """Make rclpy and all message packages importable in this process.

    Args:
        interfaces: Additional folders of interface packages.

    Raises:
        Ros2Error: A folder contains no definitions, or a malformed one.
    """
    codec = codec_of()
    for folder in interfaces:
        codec.definitions.add_package(folder)
    shim = "finssim.extensions.ros2.shim"
    modules = {"rclpy": shim, "tf2_ros": f"{shim}.tf2", **{f"tf2_ros.{part}": f"{shim}.tf2" for part in TF2}}
    modules |= {f"rclpy.{part}": f"{shim}.{module}" for module, parts in PARTS.items() for part in parts}
    for name, source in modules.items():
        sys.modules[name] = module = importlib.import_module(source)
        module.__dict__.setdefault("__getattr__", partial(refuse, name))
        package, dot, part = name.partition(".")
        if dot:
            setattr(sys.modules[package], part, module)  # `import rclpy` gives rclpy.duration too
    sys.modules["tf2_ros"].__path__ = []
    sys.meta_path.insert(0, _Finder(codec))
    sys.meta_path.append(_Absent())


class _Finder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Finder of message packages, which also reports parts of rclpy that are not available."""

    def __init__(self, codec: Codec) -> None:
        self._codec, self._packages = codec, codec.packages()

    def find_spec(self, name: str, path: Any, target: Any = None) -> importlib.machinery.ModuleSpec | None:
        package, _, kind = name.partition(".")
        if package in ("rclpy", "tf2_ros"):
            raise ImportError(
                f"{name} needs a sourced ROS 2: FinsSim's built-in {package} has no {kind}", name=name
            )
        if package not in self._packages or kind not in ("", "msg", "srv"):
            return None
        if kind and not self._codec.names(package, kind):
            return None
        return importlib.machinery.ModuleSpec(name, self, is_package=not kind)

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> ModuleType:
        package, _, kind = spec.name.partition(".")
        return _Types(spec.name, self._codec, package, kind) if kind else ModuleType(spec.name)

    def exec_module(self, module: ModuleType) -> None:
        """Do nothing: classes are created at their first use."""


class _Absent(importlib.abc.MetaPathFinder):
    """Last finder, which reports alternatives to missing packages of ROS 2."""

    def find_spec(self, name: str, path: Any, target: Any = None) -> None:
        hint = PACKAGES.get(name.partition(".")[0])
        if hint is not None:
            raise ModuleNotFoundError(f"{name} needs a sourced ROS 2: {hint}", name=name)


class _Types(ModuleType):
    """Types of a package, each created at its first use."""

    def __init__(self, name: str, codec: Codec, package: str, kind: str) -> None:
        super().__init__(name, f"Types of {package}, from their definitions.")
        self.__dict__.update(_codec=codec, _package=package, _kind=kind, __all__=codec.names(package, kind))

    def __getattr__(self, name: str) -> Any:
        full = f"{self._package}/{self._kind}/{name}"
        if name.startswith("_") or name not in self.__all__:
            raise AttributeError(f"{self.__name__} has no type '{name}'")
        try:
            message_type = self._codec.service(full) if self._kind == "srv" else self._codec.message(full)
        except Ros2Error as error:
            raise AttributeError(str(error)) from None
        setattr(self, name, message_type)
        return message_type

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *self.__all__]
