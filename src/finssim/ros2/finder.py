"""Lets `import rclpy`, `import nav_msgs.msg` and `import std_srvs.srv` find the shim and the codec's classes."""

from __future__ import annotations

import importlib
import importlib.abc
import importlib.machinery
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from finssim.ros2.codec import Codec, codec_of
from finssim.ros2.errors import Ros2Error

__all__ = ["install"]

PARTS = (
    "callback_groups",
    "client",
    "clock",
    "clock_type",
    "context",
    "duration",
    "event_handler",
    "exceptions",
    "executors",
    "logging",
    "node",
    "parameter",
    "parameter_service",
    "publisher",
    "qos",
    "serialization",
    "service",
    "subscription",
    "task",
    "time",
    "timer",
    "utilities",
)
"""Submodules of rclpy that the shim has."""


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
    shim = "finssim.ros2.shim"
    sys.modules["rclpy"] = importlib.import_module(shim)
    for part in PARTS:
        sys.modules[f"rclpy.{part}"] = importlib.import_module(f"{shim}.{part}")
    sys.meta_path.insert(0, _Finder(codec))


class _Finder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Finds message packages, and says of rclpy's other parts what they need."""

    def __init__(self, codec: Codec) -> None:
        self._codec, self._packages = codec, codec.packages()

    def find_spec(self, name: str, path: Any, target: Any = None) -> importlib.machinery.ModuleSpec | None:
        package, _, kind = name.partition(".")
        if package == "rclpy":
            raise ImportError(
                f"{name} needs a sourced ROS 2: FinsSim's built-in rclpy has no {kind}", name=name
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
            made = self._codec.service(full) if self._kind == "srv" else self._codec.message(full)
        except Ros2Error as error:
            raise AttributeError(str(error)) from None
        setattr(self, name, made)
        return made

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *self.__all__]
