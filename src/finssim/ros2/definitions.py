"""Message and service definitions: those of ROS 2 itself, our own, and those of folders the user names."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from finssim.ros2.errors import Ros2Error

__all__ = ["INTERFACES", "STANDARD_SERVICES", "Definitions", "Nodetype"]

INTERFACES = Path(__file__).parent / "interfaces"
"""Folder of our own interface packages, one folder each, as ROS 2 lays them out."""

STANDARD_SERVICES = {
    "rcl_interfaces/srv/DescribeParameters": "string[] names\n---\nrcl_interfaces/ParameterDescriptor[] descriptors\n",
    "rcl_interfaces/srv/GetParameters": "string[] names\n---\nrcl_interfaces/ParameterValue[] values\n",
    "rcl_interfaces/srv/GetParameterTypes": "string[] names\n---\nuint8[] types\n",
    "rcl_interfaces/srv/ListParameters": (
        "uint64 DEPTH_RECURSIVE=0\nstring[] prefixes\nuint64 depth\n---\nrcl_interfaces/ListParametersResult result\n"
    ),
    "rcl_interfaces/srv/SetParameters": (
        "rcl_interfaces/Parameter[] parameters\n---\nrcl_interfaces/SetParametersResult[] results\n"
    ),
    "rcl_interfaces/srv/SetParametersAtomically": (
        "rcl_interfaces/Parameter[] parameters\n---\nrcl_interfaces/SetParametersResult result\n"
    ),
    "std_srvs/srv/Empty": "---\n",
    "std_srvs/srv/SetBool": "bool data\n---\nbool success\nstring message\n",
    "std_srvs/srv/Trigger": "---\nbool success\nstring message\n",
}
"""Services that every ROS 2 has; rosbags knows messages only."""

NO_FIELDS = "uint8 structure_needs_at_least_one_member"  # what ROS 2 itself sends for an empty message

_DEFAULT = re.compile(r"^(?P<type>[\w/<>=\[\]]+)\s+(?P<name>[a-z]\w*)\s+(?P<value>[^=\s].*)$")


class Definitions:
    """Field lists of all known types of one release.

    Attributes:
        store: rosbags' store, which holds fields and constants and makes the (de)serialisers.
        defaults: Type -> field -> default value, where it is not zero.
        services: Names of services, as `std_srvs/srv/Trigger`.
    """

    def __init__(self, distro: str) -> None:
        self.store: Typestore = get_typestore(getattr(Stores, f"ROS2_{distro.upper()}"))
        self.store.fielddefs.update({n: _without_char(d) for n, d in self.store.fielddefs.items()})
        self.defaults: dict[str, dict[str, Any]] = {"geometry_msgs/msg/Quaternion": {"w": 1.0}}
        self.services: set[str] = set()
        for name, text in STANDARD_SERVICES.items():
            self.add_service(name, text)
        for package in sorted(INTERFACES.iterdir()):
            self.add_package(package)

    def add_package(self, folder: Path) -> None:
        """Add every `msg/*.msg` and `srv/*.srv` of a package, in whatever order they need each other.

        Raises:
            Ros2Error: The folder holds none, or one is malformed.
        """
        messages, services = sorted(folder.glob("msg/*.msg")), sorted(folder.glob("srv/*.srv"))
        if not messages and not services:
            raise Ros2Error(
                f"{folder}: holds neither msg/*.msg nor srv/*.srv: name the folder of an interface package"
            )
        for path in messages:
            self.add_message(f"{folder.name}/msg/{path.stem}", path.read_text(encoding="utf-8"))
        for path in services:
            self.add_service(f"{folder.name}/srv/{path.stem}", path.read_text(encoding="utf-8"))

    def add_message(self, name: str, text: str) -> None:
        """Add a type, named as `finssim_msgs/msg/ThrusterCommand`, from the text of its `.msg` file.

        Raises:
            Ros2Error: The text is no definition, or another one of that name is known.
        """
        fields = _without_char(_parsed(name, text))
        try:
            self.store.register({name: fields})
        except TypesysError as error:
            raise Ros2Error(f"{name}: {error}: rename yours") from None
        self.defaults.setdefault(name, _defaults(text))

    def add_service(self, name: str, text: str) -> None:
        """Add a service, named as `std_srvs/srv/Trigger`, from the text of its `.srv` file.

        Raises:
            Ros2Error: The text is no definition.
        """
        halves = re.split(r"^---[ \t]*$", text, flags=re.MULTILINE)
        if len(halves) != 2:
            raise Ros2Error(
                f"{name}: expected one line '---' between request and response, found {len(halves) - 1}"
            )
        for suffix, half in zip(("_Request", "_Response"), halves, strict=True):
            empty = not re.sub(r"#.*", "", half).strip()
            self.add_message(name + suffix, NO_FIELDS if empty else half)
        self.services.add(name)

    def known(self) -> list[str]:
        """Names of all types, the halves of services among them."""
        return list(self.store.fielddefs)

    def fields(self, name: str) -> list[tuple[str, Any]]:
        """Names and descriptions of a type's fields, as rosbags has them.

        Raises:
            Ros2Error: Unknown type.
        """
        if name not in self.store.fielddefs:
            raise Ros2Error(
                f"no message type '{name}' is known: name the folder of its package in FINSSIM_ROS_INTERFACES"
            )
        fields = list(self.store.fielddefs[name][1])
        return fields or [(NO_FIELDS.split()[1], (Nodetype.BASE, ("uint8", 0)))]

    def constants(self, name: str) -> list[tuple[str, str, Any]]:
        """Name, type and value of a type's constants."""
        return list(self.store.fielddefs[name][0])


def _parsed(name: str, text: str) -> Any:
    """Constants and fields of a `.msg` text; rosbags reads services as messages under another name."""
    package, kind, short = name.split("/")
    as_message = f"{package}/msg/{short}"
    try:
        return get_types_from_msg(text, as_message)[as_message]
    except TypesysError as error:
        raise Ros2Error(f"{package}/{kind}/{short}: not a message definition: {error}") from None


def _without_char(definition: Any) -> Any:
    """Constants and fields with uint8 for char: what rosidl makes of it, and hashes, where rosbags keeps the word."""
    constants, fields = definition

    def plain(described: Any) -> Any:
        kind, what = described
        if kind == Nodetype.BASE:
            return (kind, ("uint8", what[1])) if what[0] == "char" else described
        return described if kind == Nodetype.NAME else (kind, (plain(what[0]), what[1]))

    return constants, [(name, plain(described)) for name, described in fields]


def _defaults(text: str) -> dict[str, Any]:
    """Default values that a `.msg` text gives to fields."""
    lines = (_DEFAULT.match(re.sub(r"#.*", "", line).strip()) for line in text.splitlines())
    return {line["name"]: yaml.safe_load(line["value"]) for line in lines if line}
