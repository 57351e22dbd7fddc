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

__all__ = ["TOKEN", "Remap", "check_node", "expanded", "full_node_name", "remapped"]

TOKEN = r"[A-Za-z_][A-Za-z0-9_]*"
_TOPIC = re.compile(rf"^(~|(~/|/)?{TOKEN}(/{TOKEN})*)$")
LONGEST_NODE, LONGEST_NAMESPACE, LONGEST_TOPIC = 255, 245, 247
"""As rmw counts them: RMW_NODE_NAME_MAX_NAME_LENGTH, RMW_NAMESPACE_MAX_LENGTH, RMW_TOPIC_MAX_NAME_LENGTH."""


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
    if not re.fullmatch(TOKEN, name) or len(name) > LONGEST_NODE:
        raise InvalidNodeNameException(
            f"node name '{name}': use at most {LONGEST_NODE} letters, digits and underscores, no digit first"
        )
    full = namespace if namespace.startswith("/") else f"/{namespace}"
    if full != "/" and not re.fullmatch(rf"(/{TOKEN})+", full) or len(full) > LONGEST_NAMESPACE:
        raise InvalidNamespaceException(
            f"namespace '{namespace}': use names of letters, digits and _ between slashes, none at the end"
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
        full = topic
    elif topic.startswith("~"):
        full = full_node_name(name, namespace) + topic[1:]
    else:
        full = full_node_name(topic, namespace)
    if len(full) > LONGEST_TOPIC:
        raise InvalidTopicNameException(
            f"topic or service name '{full}': longer than {LONGEST_TOPIC} characters"
        )
    return full


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
