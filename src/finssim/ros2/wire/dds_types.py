"""DDS types of ROS messages: they carry the type's name and let Cyclone check the bounds of what comes in."""

from __future__ import annotations

from typing import Any

from cyclonedds.idl import make_idl_struct
from cyclonedds.idl import types as idl

from finssim.ros2.codec import Codec
from finssim.ros2.definitions import Nodetype

__all__ = ["DdsTypes", "dds_type_name", "ros_type_name"]

PRIMITIVES: dict[str, Any] = {
    **{
        f"{sign}int{bits}": getattr(idl, f"{sign}int{bits}") for sign in ("", "u") for bits in (8, 16, 32, 64)
    },
    **dict.fromkeys(("byte", "octet"), idl.uint8),
    "float32": idl.float32,
    "float64": idl.float64,
    "bool": bool,
    "string": str,
}


def dds_type_name(name: str) -> str:
    """`nav_msgs/msg/Odometry` as DDS has it: `nav_msgs::msg::dds_::Odometry_`."""
    package, kind, short = name.split("/")
    return f"{package}::{kind}::dds_::{short}_"


def ros_type_name(name: str) -> str:
    """The reverse of `dds_type_name`; a name of another form is left as it is."""
    parts = name.split("::")
    if len(parts) != 4 or parts[2] != "dds_":
        return name
    return f"{parts[0]}/{parts[1]}/{parts[3].removesuffix('_')}"


class DdsTypes:
    """Cyclone's types of a codec's messages, made when first asked for."""

    def __init__(self, codec: Codec) -> None:
        self._codec = codec
        self._made: dict[tuple[str, bool], Any] = {}

    def type_of(self, name: str, *, service: bool = False) -> Any:
        """The type of a message; that of a service's half begins with the client's number and the request's."""
        if (name, service) not in self._made:
            fields = {"header_client_": idl.uint64, "header_sequence_": idl.int64} if service else {}
            fields |= {f"{n}_": self._field(*described) for n, described in self._codec.fields(name)}
            self._made[name, service] = make_idl_struct(
                name.replace("/", "_"), dds_type_name(name), fields, dataclassify=False
            )
        return self._made[name, service]

    def _field(self, kind: Any, what: Any) -> Any:
        if kind == Nodetype.NAME:
            return self.type_of(what)
        if kind == Nodetype.BASE:
            base, bound = what
            return idl.bounded_str[bound] if base == "string" and bound else PRIMITIVES[base]
        inner, count = what
        if kind == Nodetype.ARRAY:
            return idl.array[self._field(*inner), count]
        return idl.sequence[self._field(*inner), count] if count else idl.sequence[self._field(*inner)]
