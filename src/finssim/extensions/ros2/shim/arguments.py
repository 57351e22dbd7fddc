"""Names of nodes and topics, and arguments after `--ros-args`: remapping, parameters, parameter files, log levels."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from finssim.core.yaml_file import DEEPEST
from finssim.extensions.ros2.shim.exceptions import (
    InvalidNamespaceException,
    InvalidNodeNameException,
    InvalidTopicNameException,
    RosArgumentsError,
)
from finssim.extensions.ros2.shim.logging import LoggingSeverity

TOKEN = r"[A-Za-z_][A-Za-z0-9_]*"
_TOPIC = re.compile(rf"^(~|(~/|/)?{TOKEN}(/{TOKEN})*)$")
LONGEST_NODE, LONGEST_NAMESPACE, LONGEST_TOPIC = 255, 245, 247
"""Greatest lengths of names in rmw: RMW_NODE_NAME_MAX_NAME_LENGTH, RMW_NAMESPACE_MAX_LENGTH,
RMW_TOPIC_MAX_NAME_LENGTH."""


@dataclass(frozen=True)
class Remap:
    """Remapping rule `[node:]source:=target` of the command line."""

    node: str
    """Name of the node to which it applies; empty for all."""
    source: str
    target: str


def check_node(name: str, namespace: str) -> str:
    """Check a node's names; return the namespace with its leading slash.

    Raises:
        InvalidNodeNameException: The name is invalid.
        InvalidNamespaceException: The namespace is invalid.
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
    """Return namespace and name as one."""
    return f"{namespace.rstrip('/')}/{name}"


def expanded(topic: str, name: str, namespace: str) -> str:
    """Return the full name of a topic or service, from an absolute, a relative or, with `~`, a private name.

    Raises:
        InvalidTopicNameException: The name is invalid.
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
    """Return the full name after the first remapping rule that matches.

    Raises:
        InvalidTopicNameException: The name is invalid.
    """
    full = expanded(topic, name, namespace)
    for rule in rules:
        special = rule.source.startswith("__")
        if not special and rule.node in ("", name) and expanded(rule.source, name, namespace) == full:
            return expanded(rule.target, name, namespace)
    return full


# Parameters from files and `-p`, parsed like rcl does (rcl_yaml_param_parser/src/parse.c).


Overrides = dict[str, dict[str, Any]]
"""Node name or pattern -> parameter -> value, in the order in which the patterns were first mentioned.

That order is their precedence: of several matching patterns the last one wins, and a pattern that is
mentioned again keeps the rank of its first mention. Thus `/**` of a later file is overridden by
`/**/controller` of an earlier one that began with `/**`.
"""

KEY = "ros__parameters"
STRING = "tag:yaml.org,2002:str"
TYPES = (bool, int, float, str)
TRUE = {"Y", "y", "yes", "Yes", "YES", "true", "True", "TRUE", "on", "On", "ON"}
FALSE = {"N", "n", "no", "No", "NO", "false", "False", "FALSE", "off", "Off", "OFF"}

_INTEGER = re.compile(r"[-+]?(0[xX][0-9a-fA-F]+|0[0-7]*|[1-9][0-9]*)")
_FLOAT = re.compile(
    r"(?P<number>[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?)|[-+]?\.?(inf|Inf|INF)|[-+]?(infinity|nan|NaN|NAN)|\.(nan|NaN|NAN)"
)
_NAME = re.compile(r"/?(\*\*?|[A-Za-z_]\w*)(/(\*\*?|[A-Za-z_]\w*))*")

Tree = Any
"""Scalar event, list of trees, or tuple of (key, tree)."""


def read_parameters(path: Path, overrides: Overrides) -> None:
    """Add the values of a parameter file.

    Raises:
        RosArgumentsError: The file does not exist, or rcl would refuse it.
    """
    try:
        tree = _document(path.read_text(encoding="utf-8"))
        if tree is not None:
            _add_nodes("", tree, overrides)
    except OSError as error:
        raise RosArgumentsError(f"--params-file {path}: {error.strerror}") from None
    except (yaml.YAMLError, ValueError) as error:
        raise RosArgumentsError(f"--params-file {path}: {' '.join(str(error).split())}") from None


def parsed_value(text: str) -> Any:
    """Return a parameter's value after `-p name:=`; None for an empty list, whose type is unknown.

    Raises:
        ValueError: The text is empty, not YAML, a mapping, or a list of different types.
    """
    try:
        tree = _document(text)
    except yaml.YAMLError:
        raise ValueError(f"'{text}' is not valid YAML: quote it") from None
    if tree is None or isinstance(tree, tuple):
        raise ValueError(f"'{text}' is no value: give a number, a word or a list")
    return _value(tree)


def override(overrides: Overrides, pattern: str, name: str, value: Any) -> None:
    """Set a value: the last one wins, but among values of several types the one whose type is first in `TYPES`.

    rcl stores a value of each type, and rclpy uses the first one (node.cpp, `_parameter_from_rcl_variant`).
    """
    values = overrides.setdefault(pattern, {})
    if name not in values or _rank(value) <= _rank(values[name]):
        values[name] = value


def overrides_for(node: str, overrides: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the values for one node by its full name, such as `/finsrov/controller`."""
    values: dict[str, Any] = {}
    for pattern, pattern_values in overrides.items():
        pattern = pattern if pattern.startswith("/") else f"/{pattern}"
        # As in rclpy: "/*" matches one name, and "/**", which becomes that with a star, any number.
        if re.fullmatch(pattern.replace("/*", r"(/\w+)"), node):
            values.update(pattern_values)
    return values


def _rank(value: Any) -> int:
    """Return the rank of a value's type; lists come after single values, and an empty list, which is no
    value, last."""
    if value is None:
        return 2 * len(TYPES)
    many = isinstance(value, list)
    return TYPES.index(type(value[0] if many else value)) + many * len(TYPES)


def _document(text: str) -> Tree:
    """Return the first document's tree; None if it is empty."""
    events = yaml.parse(text, Loader=yaml.SafeLoader)
    for event in events:
        if isinstance(event, (yaml.StreamEndEvent, yaml.DocumentEndEvent)):
            break
        if not isinstance(event, (yaml.StreamStartEvent, yaml.DocumentStartEvent)):
            return _tree(event, events)
    return None


def _tree(event: Any, events: Iterator[Any], depth: int = 0) -> Tree:
    if depth > DEEPEST:
        raise ValueError(f"line {event.start_mark.line + 1}: nested more than {DEEPEST} deep")
    if isinstance(event, yaml.AliasEvent):
        raise ValueError(f"line {event.start_mark.line + 1}: rcl takes no aliases: write the value out")
    if isinstance(event, yaml.SequenceStartEvent):
        parts = []
        while not isinstance(part := next(events), yaml.SequenceEndEvent):
            parts.append(_tree(part, events, depth + 1))
        return parts
    if isinstance(event, yaml.MappingStartEvent):
        pairs = []
        while not isinstance(key := next(events), yaml.MappingEndEvent):
            if not isinstance(key, yaml.ScalarEvent) or not key.value:
                raise ValueError(f"line {key.start_mark.line + 1}: expected a name before the colon")
            pairs.append((key.value, _tree(next(events), events, depth + 1)))
        return tuple(pairs)
    return event


def _add_nodes(above: str, tree: Tree, overrides: Overrides) -> None:
    """Descend to `ros__parameters`; the keys above it form a node's name."""
    if not isinstance(tree, tuple):
        raise ValueError(f"{above or 'its top'}: expected '{KEY}:' below a node's name")
    for key, below in tree:
        if key != KEY:
            _add_nodes(f"{above}/{key.lstrip('/')}" if above else key, below, overrides)
        elif not _NAME.fullmatch(above):
            raise ValueError(f"{KEY} is below '{above}', expected the name of a node such as /**/controller")
        elif not isinstance(below, tuple):
            raise ValueError(f"{above}: expected parameters and values below {KEY}")
        else:
            for name, value in _values("", below):
                override(overrides, above, name, value)


def _values(prefix: str, tree: Tree) -> Iterator[tuple[str, Any]]:
    for key, below in tree:
        if isinstance(below, tuple):
            yield from _values(f"{prefix}{key}.", below)
            continue
        try:
            yield f"{prefix}{key}", _value(below)
        except ValueError as error:
            raise ValueError(f"{prefix}{key}: {error}") from None


def _value(tree: Tree) -> Any:
    if not isinstance(tree, list):
        return _scalar(tree)
    if any(isinstance(part, (list, tuple)) for part in tree):
        raise ValueError("a list holds plain values only")
    values = [_scalar(part) for part in tree]
    if len({type(value) for value in values}) > 1:
        raise ValueError(
            f"{values}: the values of a list are all of one type: write 1.0 beside 2.0, and quote words"
        )
    return values or None


def _scalar(event: Any) -> bool | int | float | str:
    """Return the result of rcl's `get_value`, which is neither YAML 1.1 nor 1.2."""
    text: str = event.value
    if event.style in ("'", '"') or event.tag == STRING:
        return text
    if not text:
        raise ValueError("has no value: give one or leave the line out")
    if text in TRUE or text in FALSE:
        return text in TRUE
    if _INTEGER.fullmatch(text):
        digits = text.lstrip("+-")
        base = 16 if digits[1:2] in ("x", "X") else 8 if digits[0] == "0" else 10
        number = int(text, base)
        if -(2**63) <= number < 2**63:
            return number
        return float(number)
    match = _FLOAT.fullmatch(text)
    return float(match["number"] or re.sub(r"\.", "", text)) if match else text


# Arguments after `--ros-args` on a command line: remapping, parameters, log levels.


_SWITCHES = {
    f"--{way}-{what}-logs" for way in ("enable", "disable") for what in ("rosout", "stdout", "external-lib")
}
_TARGETS = {"__node": TOKEN, "__name": TOKEN, "__ns": rf"/|(/{TOKEN})+"}
"""Remapping source of a node's name or namespace -> pattern of its targets."""


@dataclass
class RosArguments:
    """Parsed arguments, in the given order."""

    remaps: list[Remap] = field(default_factory=list)
    parameters: Overrides = field(default_factory=dict)
    levels: list[tuple[str, LoggingSeverity]] = field(default_factory=list)
    enclave: str = "/"
    rest: list[str] = field(default_factory=list)
    """Arguments that are not for ROS."""


def parse_arguments(arguments: Sequence[str]) -> RosArguments:
    """Parse a command line.

    Raises:
        RosArgumentsError: An argument for ROS is malformed or unknown.
    """
    parsed, tokens, ros = RosArguments(), list(arguments), False
    while tokens:
        word = tokens.pop(0)
        if word == "--ros-args":
            ros = True
        elif not ros:
            parsed.rest.append(word)
        elif word == "--":
            ros = False
        elif word not in _SWITCHES:
            if not tokens:
                raise RosArgumentsError(f"--ros-args: {word} is at the end: give its value after it")
            _take(parsed, word, tokens.pop(0))
    return parsed


def _take(parsed: RosArguments, flag: str, value: str) -> None:
    """Add one flag with its value."""
    if flag in ("-r", "--remap"):
        source, target = _pair(flag, value)
        node, _, source = source.rpartition(":")
        if not re.fullmatch(_TARGETS.get(source, ".+"), target):
            raise RosArgumentsError(
                f"--ros-args {flag} {value}: '{target}' is no name, or a namespace without its slash"
            )
        parsed.remaps.append(Remap(node, source, target))
    elif flag in ("-p", "--param"):
        name, text = _pair(flag, value)
        node, _, name = name.rpartition(":")
        try:
            override(parsed.parameters, node or "/**", name, parsed_value(text))
        except ValueError as error:
            raise RosArgumentsError(f"--ros-args {flag} {value}: {error}") from None
    elif flag == "--params-file":
        read_parameters(Path(value), parsed.parameters)
    elif flag == "--log-level":
        logger, mark, level = value.rpartition(":=")
        if level.upper() not in LoggingSeverity.__members__ or (mark and not logger):
            raise RosArgumentsError(
                f"--log-level {value}: expected [LOGGER:=] and debug, info, warn, error or fatal"
            )
        parsed.levels.append((logger, LoggingSeverity[level.upper()]))
    elif flag in ("-e", "--enclave"):
        parsed.enclave = value
    elif flag not in ("--log-config-file", "--log-file-name"):
        raise RosArgumentsError(
            f"--ros-args: unknown argument '{flag}': known are -r, -p, --params-file, --log-level and -e"
        )


def _pair(flag: str, value: str) -> tuple[str, str]:
    name, mark, right = value.partition(":=")
    if not (name and mark and right):
        raise RosArgumentsError(f"--ros-args {flag} {value}: expected NAME:=VALUE")
    return name, right
