"""The ROS 2 types of a record's messages: definitions, constructors and CDR through rosbags."""

from __future__ import annotations

from functools import cache
from importlib import resources
from typing import Any

__all__ = ["METADATA", "RecordError", "definition", "types"]


class RecordError(ValueError):
    """A record cannot be read, or not played as asked."""


METADATA = "finssim"
"""Name of the metadata record that says what the record is of."""


@cache
def types() -> Any:
    """A rosbags type store of ROS 2 Humble's messages and ours."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    folder = resources.files("finssim") / "ros2" / "interfaces" / "finssim_msgs" / "msg"
    for file in sorted(folder.iterdir(), key=lambda file: file.name):
        name = f"finssim_msgs/msg/{file.name.removesuffix('.msg')}"
        store.register(get_types_from_msg(file.read_text(encoding="utf-8"), name))
    return store


def definition(kind: str) -> str:
    """Text of a type and of all that it uses."""
    text, _ = types().generate_msgdef(kind, ros_version=2)
    return str(text)
