"""What stands after `--ros-args` on a command line: remapping, parameters, log levels."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from finssim.ros2.shim.exceptions import RosArgumentsError
from finssim.ros2.shim.logging import LoggingSeverity
from finssim.ros2.shim.names import TOKEN, Remap
from finssim.ros2.shim.parameter_files import Overrides, override, parsed_value, read_parameters

__all__ = ["RosArguments", "parse_arguments"]

_SWITCHES = {
    f"--{way}-{what}-logs" for way in ("enable", "disable") for what in ("rosout", "stdout", "external-lib")
}
_TARGETS = {"__node": TOKEN, "__name": TOKEN, "__ns": rf"/|(/{TOKEN})+"}
"""What a node's name or namespace may be replaced with."""


@dataclass
class RosArguments:
    """Arguments in the order given."""

    remaps: list[Remap] = field(default_factory=list)
    parameters: Overrides = field(default_factory=dict)
    levels: list[tuple[str, LoggingSeverity]] = field(default_factory=list)
    enclave: str = "/"
    rest: list[str] = field(default_factory=list)
    """What is not for ROS."""


def parse_arguments(arguments: Sequence[str]) -> RosArguments:
    """Read a command line.

    Raises:
        RosArgumentsError: An argument for ROS that is malformed or not known.
    """
    found, words, ros = RosArguments(), list(arguments), False
    while words:
        word = words.pop(0)
        if word == "--ros-args":
            ros = True
        elif not ros:
            found.rest.append(word)
        elif word == "--":
            ros = False
        elif word not in _SWITCHES:
            if not words:
                raise RosArgumentsError(f"--ros-args: {word} stands at the end: give its value after it")
            _take(found, word, words.pop(0))
    return found


def _take(found: RosArguments, flag: str, value: str) -> None:
    """Add one flag with its value."""
    if flag in ("-r", "--remap"):
        source, target = _pair(flag, value)
        node, _, source = source.rpartition(":")
        if not re.fullmatch(_TARGETS.get(source, ".+"), target):
            raise RosArgumentsError(
                f"--ros-args {flag} {value}: '{target}' is no name, or a namespace without its slash"
            )
        found.remaps.append(Remap(node, source, target))
    elif flag in ("-p", "--param"):
        name, text = _pair(flag, value)
        node, _, name = name.rpartition(":")
        try:
            override(found.parameters, node or "/**", name, parsed_value(text))
        except ValueError as error:
            raise RosArgumentsError(f"--ros-args {flag} {value}: {error}") from None
    elif flag == "--params-file":
        read_parameters(Path(value), found.parameters)
    elif flag == "--log-level":
        logger, mark, level = value.rpartition(":=")
        if level.upper() not in LoggingSeverity.__members__ or (mark and not logger):
            raise RosArgumentsError(
                f"--log-level {value}: expected [LOGGER:=] and debug, info, warn, error or fatal"
            )
        found.levels.append((logger, LoggingSeverity[level.upper()]))
    elif flag in ("-e", "--enclave"):
        found.enclave = value
    elif flag not in ("--log-config-file", "--log-file-name"):
        raise RosArgumentsError(
            f"--ros-args: unknown argument '{flag}': known are -r, -p, --params-file, --log-level and -e"
        )


def _pair(flag: str, value: str) -> tuple[str, str]:
    left, mark, right = value.partition(":=")
    if not (left and mark and right):
        raise RosArgumentsError(f"--ros-args {flag} {value}: expected NAME:=VALUE")
    return left, right
