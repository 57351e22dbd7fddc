"""Messages to bytes and back: little-endian CDR as ROS 2 sends it, and the hash that names a type's layout."""

from __future__ import annotations

import struct
from dataclasses import replace
from functools import cache
from typing import Any

from rosbags.serde import SerdeError

from finssim.ros2.definitions import Definitions
from finssim.ros2.distro import distro_of
from finssim.ros2.errors import MessageError, Ros2Error
from finssim.ros2.message_class import Message, message_class

__all__ = ["HEADER", "Codec", "Message", "Service", "codec_of"]

HEADER = b"\x00\x01\x00\x00"
"""Encapsulation: plain CDR, little endian."""


class Service:
    """A service type, as rclpy has it: two messages under one name."""

    TYPE: str
    Request: type[Message]
    Response: type[Message]


class Codec:
    """Classes, bytes and hashes of all types of one release of ROS 2.

    Args:
        distro: Name of the release, e.g. "jazzy".
    """

    def __init__(self, distro: str) -> None:
        self.definitions = Definitions(distro)
        self._classes: dict[str, type[Message]] = {}
        self._services: dict[str, type[Service]] = {}

    def message(self, name: str) -> type[Message]:
        """Class of a message, named as `nav_msgs/msg/Odometry`.

        Raises:
            Ros2Error: Unknown type.
        """
        if name not in self._classes:
            cls, make = message_class(name, self.definitions, self.message)
            self._classes[name] = cls
            store = self.definitions.store
            store.get_msgdef(name)
            store.cache[name] = replace(store.cache[name], cls=make)  # type: ignore[arg-type]
        return self._classes[name]

    def service(self, name: str) -> type[Service]:
        """Class of a service, named as `std_srvs/srv/Trigger`.

        Raises:
            Ros2Error: Unknown service.
        """
        if name not in self.definitions.services:
            raise Ros2Error(
                f"no service type '{name}' is known: name the folder of its package in FINSSIM_ROS_INTERFACES"
            )
        if name not in self._services:
            halves = {h: self.message(f"{name}_{h}") for h in ("Request", "Response")}
            package, kind, short = name.split("/")
            body = {"TYPE": name, "__module__": f"{package}.{kind}", **halves}
            self._services[name] = type(short, (Service,), body)
        return self._services[name]

    def names(self, package: str, kind: str) -> list[str]:
        """Short names of a package's types; `kind` is "msg" or "srv"."""
        found = self.definitions.services if kind == "srv" else self.definitions.known()
        return sorted(name.rsplit("/", 1)[1] for name in found if name.startswith(f"{package}/{kind}/"))

    def packages(self) -> set[str]:
        """Names of all packages with a type."""
        return {name.partition("/")[0] for name in self.definitions.known()}

    def serialize(self, message: Message) -> bytearray:
        """Bytes of a message: header, CDR, zeros up to a multiple of four.

        Raises:
            MessageError: A field was changed in place into something that does not fit.
        """
        definition = self.definitions.store.cache[message.TYPE]
        try:
            size = definition.getsize_cdr(0, message, self.definitions.store)
            buffer = bytearray(4 + size + -size % 4)
            buffer[:4] = HEADER
            definition.serialize_cdr_le(memoryview(buffer)[4:], 0, message, self.definitions.store)
        except (AttributeError, TypeError, ValueError, AssertionError, struct.error, SerdeError) as error:
            raise MessageError(
                f"{message.TYPE}: cannot be sent: {error}: give each field its own type"
            ) from None
        return buffer

    def deserialize(self, data: bytes | bytearray | memoryview, name: str) -> Message:
        """A message from its bytes; its arrays are writable and share the given buffer if that is writable.

        Bytes left over at the end are allowed: some writers pad.

        Raises:
            Ros2Error: Unknown type, or bytes that are none of its messages.
        """
        self.message(name)
        definition = self.definitions.store.cache[name]
        raw = memoryview(data)
        if len(raw) < 4 or raw[0] != 0 or raw[1] > 1:
            raise Ros2Error(f"{name}: {len(raw)} bytes without a CDR header: the sender must use plain CDR")
        decode: Any = definition.deserialize_cdr_le if raw[1] else definition.deserialize_cdr_be
        try:
            message, _ = decode(raw[4:], 0, definition.cls, self.definitions.store)
        except (struct.error, ValueError, IndexError, SerdeError) as error:
            raise Ros2Error(f"{name}: malformed message of {len(raw)} bytes: {error}") from None
        return message  # type: ignore[no-any-return]

    def type_hash(self, name: str) -> str:
        """The hash that Iron and later announce with an endpoint, `RIHS01_` and 64 hexadecimal digits."""
        return self.definitions.store.hash_rihs01(name)

    def fields(self, name: str) -> list[tuple[str, Any]]:
        """Fields of a type, as rosbags has them."""
        return self.definitions.fields(name)


def codec_of(distro: str | None = None) -> Codec:
    """The process's one codec for a release; that of `ROS_DISTRO` where none is named."""
    return _codec(distro or distro_of().name)


@cache
def _codec(distro: str) -> Codec:
    return Codec(distro)
