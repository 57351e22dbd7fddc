"""What stands after `--ros-args` on a command line: remapping, parameters, log levels."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from finssim.ros2.errors import Ros2Error
from finssim.ros2.shim.logging import LoggingSeverity
from finssim.ros2.shim.names import Remap
from finssim.ros2.shim.parameter_files import Assignment, read_parameters

__all__ = ["RosArguments", "parse_arguments"]

_SWITCHES = {
    f"--{way}-{what}-logs" for way in ("enable", "disable") for what in ("rosout", "stdout", "external-lib")
}
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+")


@dataclass
class RosArguments:
    """Arguments in the order given."""

    remaps: list[Remap] = field(default_factory=list)
    parameters: list[Assignment] = field(default_factory=list)
    levels: list[tuple[str, LoggingSeverity]] = field(default_factory=list)
    enclave: str = "/"
    rest: list[str] = field(default_factory=list)
    """What is not for ROS."""


def parse_arguments(arguments: Sequence[str]) -> RosArguments:
    """Read a command line.

    Raises:
        Ros2Error: An argument for ROS that is malformed or not known.
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
                raise Ros2Error(f"--ros-args: {word} stands at the end: give its value after it")
            _take(found, word, words.pop(0))
    return found


def _take(found: RosArguments, flag: str, value: str) -> None:
    """Add one flag with its value."""
    if flag in ("-r", "--remap"):
        source, target = _pair(flag, value)
        node, _, source = source.rpartition(":")
        found.remaps.append(Remap(node, source, target))
    elif flag in ("-p", "--param"):
        name, text = _pair(flag, value)
        node, _, name = name.rpartition(":")
        found.parameters.append(Assignment(f"/**/{node}" if node else "/**", name, parsed_value(text)))
    elif flag == "--params-file":
        found.parameters += read_parameters(Path(value))
    elif flag == "--log-level":
        logger, _, level = value.rpartition(":=")
        found.levels.append((logger, _severity(level)))
    elif flag in ("-e", "--enclave"):
        found.enclave = value
    elif flag != "--log-config-file":
        raise Ros2Error(
            f"--ros-args: unknown argument '{flag}': known are -r, -p, --params-file, --log-level and -e"
        )


def _pair(flag: str, value: str) -> tuple[str, str]:
    left, mark, right = value.partition(":=")
    if not (left and mark and right):
        raise Ros2Error(f"--ros-args {flag} {value}: expected NAME:=VALUE")
    return left, right


def _severity(word: str) -> LoggingSeverity:
    if word.upper() not in LoggingSeverity.__members__:
        raise Ros2Error(f"--log-level {word}: expected debug, info, warn, error or fatal")
    return LoggingSeverity[word.upper()]


def parsed_value(text: str) -> Any:
    """A parameter's value as YAML has it; `1e-3` is a number, as in ROS."""
    if _NUMBER.fullmatch(text):
        return float(text)
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError:
        raise Ros2Error(f"parameter value '{text}' is not valid YAML: quote it") from None
