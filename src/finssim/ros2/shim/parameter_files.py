"""ROS 2's parameter files: values by node name, with wildcards."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from finssim.ros2.errors import Ros2Error
from finssim.yaml_file import read_mapping

__all__ = ["Assignment", "overrides_for", "read_parameters"]

_KEY = "ros__parameters"


@dataclass(frozen=True)
class Assignment:
    """A value for a parameter of every node whose full name fits a pattern."""

    pattern: str
    """Full node name; `*` stands for one part of it, `**` for any number."""
    name: str
    """Dotted where the file nests it."""
    value: Any


def read_parameters(path: Path) -> list[Assignment]:
    """Assignments of a parameter file, in its order.

    Raises:
        Ros2Error: No such file, not YAML, or not laid out as a parameter file.
    """
    tree = read_mapping(path, Ros2Error, such_as=f"/**: {{{_KEY}: ...}}")
    return list(_nodes(path, "", tree))


def overrides_for(node: str, assignments: Sequence[Assignment]) -> dict[str, Any]:
    """Values for one node by its full name; of several for a parameter the last counts."""
    return {a.name: a.value for a in assignments if _pattern(a.pattern).fullmatch(node)}


def _nodes(path: Path, above: str, tree: Mapping[Any, Any]) -> Iterator[Assignment]:
    for key, below in tree.items():
        if not isinstance(below, Mapping):
            raise Ros2Error(f"{path}: {key}: expected '{_KEY}:' below a node's name, found {below!r}")
        if key == _KEY:
            yield from _values(path, above or "/**", "", below)
        else:
            yield from _nodes(path, f"{above}/{str(key).strip('/')}", below)


def _values(path: Path, pattern: str, prefix: str, tree: Mapping[Any, Any]) -> Iterator[Assignment]:
    for key, value in tree.items():
        if isinstance(value, Mapping):
            yield from _values(path, pattern, f"{prefix}{key}.", value)
        elif value is None:
            raise Ros2Error(f"{path}: {prefix}{key}: has no value: give one or leave the line out")
        else:
            yield Assignment(pattern, f"{prefix}{key}", value)


def _pattern(text: str) -> re.Pattern[str]:
    parts = {"**": ".*", "*": "[^/]*"}
    words = re.split(r"(/\*\*/|\*\*|\*)", text)
    return re.compile("".join("/(.*/)?" if w == "/**/" else parts.get(w, re.escape(w)) for w in words))
