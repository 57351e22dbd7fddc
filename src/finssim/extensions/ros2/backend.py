"""Choice of rclpy for a process: that of a sourced ROS 2 if it can be imported, otherwise our shim on the same wire."""

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
    """Modules that `import rclpy` gives."""

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
    """Return why the real rclpy cannot be used; empty if it can. Found by importing: half-sourced shells have it
    broken."""
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


# What lets `import rclpy`, `import nav_msgs.msg` and `import std_srvs.srv` find the shim and the codec's classes.

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
"""Modules of the shim, and the submodules of rclpy that each is."""
TF2 = (
    "buffer",
    "buffer_interface",
    "static_transform_broadcaster",
    "transform_broadcaster",
    "transform_listener",
)
"""Submodules of tf2_ros, which are all one module of the shim."""


def install(interfaces: Sequence[Path] = ()) -> None:
    """Give this process the names of rclpy and of all message packages.

    Args:
        interfaces: Folders of interface packages besides ours.

    Raises:
        Ros2Error: A folder without definitions, or a malformed one.
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
    """Finds message packages, and reports what rclpy's other parts need."""

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
        """Nothing to run: classes are made when first asked for."""


class _Absent(importlib.abc.MetaPathFinder):
    """Finder that is asked last: it reports what to do without missing packages of ROS 2."""

    def find_spec(self, name: str, path: Any, target: Any = None) -> None:
        hint = PACKAGES.get(name.partition(".")[0])
        if hint is not None:
            raise ModuleNotFoundError(f"{name} needs a sourced ROS 2: {hint}", name=name)


class _Types(ModuleType):
    """The types of a package, each made when it is first asked for."""

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
