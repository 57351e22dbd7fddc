"""Names of nodes, topics and services: what is allowed, and which full name a short one stands for."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from finssim.ros2.shim.exceptions import (
    InvalidNamespaceException,
    InvalidNodeNameException,
    InvalidTopicNameException,
)

__all__ = ["Remap", "check_node", "expanded", "full_node_name", "remapped"]

_TOKEN = r"[A-Za-z_][A-Za-z0-9_]*"
_TOPIC = re.compile(rf"^(~|(~/|/)?{_TOKEN}(/{_TOKEN})*)$")


@dataclass(frozen=True)
class Remap:
    """One rule `[node:]source:=target` of the command line."""

    node: str
    """Name of the node it is for; empty for all."""
    source: str
    target: str


def check_node(name: str, namespace: str) -> str:
    """Check a node's names; returns the namespace with its leading slash.

    Raises:
        InvalidNodeNameException: Not a name.
        InvalidNamespaceException: Not a namespace.
    """
    if not re.fullmatch(_TOKEN, name):
        raise InvalidNodeNameException(
            f"node name '{name}': use letters, digits and underscores, no digit first"
        )
    full = "/" + namespace.strip("/")
    if full != "/" and not re.fullmatch(rf"(/{_TOKEN})+", full):
        raise InvalidNamespaceException(
            f"namespace '{namespace}': use names of letters, digits and _ between slashes"
        )
    return full


def full_node_name(name: str, namespace: str) -> str:
    """Namespace and name as one."""
    return f"{namespace.rstrip('/')}/{name}"


def expanded(topic: str, name: str, namespace: str) -> str:
    """The full name of a topic or service, from the name a node uses: absolute, relative or private with `~`.

    Raises:
        InvalidTopicNameException: Not a name.
    """
    if not _TOPIC.match(topic) or "__" in topic:
        raise InvalidTopicNameException(
            f"topic or service name '{topic}': use names of letters, digits and single _"
        )
    if topic.startswith("/"):
        return topic
    if topic.startswith("~"):
        return full_node_name(name, namespace) + topic[1:]
    return f"{namespace.rstrip('/')}/{topic}"


def remapped(topic: str, name: str, namespace: str, rules: Sequence[Remap]) -> str:
    """The full name after the first rule that holds for it.

    Raises:
        InvalidTopicNameException: Not a name.
    """
    full = expanded(topic, name, namespace)
    for rule in rules:
        special = rule.source.startswith("__")
        if not special and rule.node in ("", name) and expanded(rule.source, name, namespace) == full:
            return expanded(rule.target, name, namespace)
    return full
