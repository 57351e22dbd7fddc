"""Serialization of messages: little-endian CDR, as ROS 2 sends it, and the hash of a type's definition."""

from __future__ import annotations

import keyword
import math
import os
import re
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from finssim.extensions.ros2 import MessageError, Ros2Error


@dataclass(frozen=True)
class Distro:
    """Release of ROS 2 with the properties that its peers see."""

    name: str
    gid_length: int
    """Length of an endpoint's identifier in the node list [bytes]: 24 up to Humble, 16 since Iron."""
    type_hashes: bool
    """True if endpoints announce the hash of their type (since Iron)."""


DISTROS = {
    "humble": Distro("humble", 24, False),
    "iron": Distro("iron", 16, True),
    "jazzy": Distro("jazzy", 16, True),
    "kilted": Distro("kilted", 16, True),
}
"""Name -> release with known messages and protocol."""


def distro_of(environ: Mapping[str, str] = os.environ) -> Distro:
    """Return the release to use: that of `ROS_DISTRO`, Jazzy by default.

    Raises:
        Ros2Error: The release is not supported.
    """
    name = environ.get("ROS_DISTRO") or "jazzy"
    if name not in DISTROS:
        raise Ros2Error(
            f"ROS_DISTRO is '{name}': set it to one of {', '.join(DISTROS)}, as the other nodes have it"
        )
    return DISTROS[name]


# Message and service definitions: those of ROS 2, FinsSim's own, and those of folders named by the user.


INTERFACES = Path(__file__).parents[2] / "robot" / "interfaces"
"""Folder of FinsSim's interface packages, one folder each, with the layout of ROS 2."""

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
"""Services of every ROS 2 installation; rosbags provides only messages."""

NO_FIELDS = "uint8 structure_needs_at_least_one_member"  # as ROS 2 sends it for an empty message

_DEFAULT = re.compile(r"^(?P<type>[\w/<>=\[\]]+)\s+(?P<name>[a-z]\w*)\s+(?P<value>[^=\s].*)$")


class Definitions:
    """Field lists of all known types of one release.

    Attributes:
        store: Type store of rosbags, which contains fields and constants and creates the (de)serializers.
        defaults: Type -> field -> default value, if not zero.
        services: Names of services, such as `std_srvs/srv/Trigger`.
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
        """Add every `msg/*.msg` and `srv/*.srv` of a package, in any order of dependence.

        Raises:
            Ros2Error: The folder contains none, or one is malformed.
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
        """Add a type, with a name such as `finssim_msgs/msg/ThrusterCommand`, from the text of its `.msg` file.

        Raises:
            Ros2Error: The text is not a definition, or the name has a different one already.
        """
        fields = _without_char(_parsed(name, text))
        try:
            self.store.register({name: fields})
        except TypesysError as error:
            raise Ros2Error(f"{name}: {error}: rename yours") from None
        self.defaults.setdefault(name, _defaults(text))

    def add_service(self, name: str, text: str) -> None:
        """Add a service, with a name such as `std_srvs/srv/Trigger`, from the text of its `.srv` file.

        Raises:
            Ros2Error: The text is not a definition.
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
        """Return the names of all types, including the requests and responses of services."""
        return list(self.store.fielddefs)

    def fields(self, name: str) -> list[tuple[str, Any]]:
        """Return the names and descriptions of a type's fields, in the format of rosbags.

        Raises:
            Ros2Error: The type is unknown.
        """
        if name not in self.store.fielddefs:
            raise Ros2Error(
                f"no message type '{name}' is known: name the folder of its package in FINSSIM_ROS_INTERFACES"
            )
        fields = list(self.store.fielddefs[name][1])
        return fields or [(NO_FIELDS.split()[1], (Nodetype.BASE, ("uint8", 0)))]

    def constants(self, name: str) -> list[tuple[str, str, Any]]:
        """Return name, type and value of a type's constants."""
        return list(self.store.fielddefs[name][0])


def _parsed(name: str, text: str) -> Any:
    """Return the constants and fields of a `.msg` text; services are parsed as messages of another name."""
    package, kind, short = name.split("/")
    as_message = f"{package}/msg/{short}"
    try:
        return get_types_from_msg(text, as_message)[as_message]
    except TypesysError as error:
        raise Ros2Error(f"{package}/{kind}/{short}: not a message definition: {error}") from None


def _without_char(definition: Any) -> Any:
    """Return constants and fields with uint8 for char, as rosidl converts and hashes it; rosbags keeps char."""
    constants, fields = definition

    def plain(described: Any) -> Any:
        kind, detail = described
        if kind == Nodetype.BASE:
            return (kind, ("uint8", detail[1])) if detail[0] == "char" else described
        return described if kind == Nodetype.NAME else (kind, (plain(detail[0]), detail[1]))

    return constants, [(name, plain(described)) for name, described in fields]


def _defaults(text: str) -> dict[str, Any]:
    """Return the default values of fields in a `.msg` text."""
    lines = (_DEFAULT.match(re.sub(r"#.*", "", line).strip()) for line in text.splitlines())
    return {line["name"]: yaml.safe_load(line["value"]) for line in lines if line}


# Checks of field values: as strict as real rclpy on Humble, so that code that runs here also runs there.


INTEGERS = {
    **{f"int{b}": (-(2 ** (b - 1)), 2 ** (b - 1) - 1) for b in (8, 16, 32, 64)},
    **{f"uint{b}": (0, 2**b - 1) for b in (8, 16, 32, 64)},
}
DTYPES = {
    **{name: np.dtype(name) for name in INTEGERS},
    **dict.fromkeys(("byte", "octet"), np.dtype("uint8")),
    "float32": np.dtype("float32"),
    "float64": np.dtype("float64"),
    "bool": np.dtype("bool"),
}
"""Base types whose arrays are NumPy arrays -> dtype."""

FLOAT32_MAX = float(np.finfo(np.float32).max)
Check = Callable[[Any], Any]


class Numbers(np.ndarray[Any, Any]):
    """Sequence of numbers in a message: a NumPy array that behaves like rclpy's `array.array`.

    Its elements are Python numbers, and results of computations are ordinary NumPy arrays, which sequence
    fields refuse.
    """

    def __getitem__(self, index: Any) -> Any:
        part = super().__getitem__(index)
        return part.item() if isinstance(part, np.generic) else part

    def __iter__(self) -> Any:
        return iter(self.tolist())

    def __array_wrap__(self, array: Any, context: Any = None, return_scalar: bool = False) -> Any:
        return array[()] if return_scalar else np.asarray(array)


class Octet(bytes):
    """One byte: `bytes` in Python, as in rclpy, and a number for the serializer."""

    def __index__(self) -> int:
        return self[0]

    @classmethod
    def of(cls, number: int) -> Octet:
        """Return the octet with a number."""
        return cls((number,))


def check_of(described: Any, nested: Callable[[str], type]) -> Check:
    """Return the function that checks a value of a field and returns it in the message's format.

    Args:
        described: The field, in the format of rosbags.
        nested: Function that returns the class of a nested type.
    """
    kind, detail = described
    if kind == Nodetype.NAME:
        return _instance(nested(detail))
    if kind == Nodetype.BASE:
        return _base(*detail)
    (inner_kind, inner), count = detail
    fixed = kind == Nodetype.ARRAY
    if inner_kind == Nodetype.BASE and inner[0] in DTYPES:
        return _numbers(inner[0], count, fixed)
    return _objects(check_of((inner_kind, inner), nested), count, fixed)


def _instance(cls: type) -> Check:
    def check(value: Any) -> Any:
        if not isinstance(value, cls):
            raise MessageError(f"expected a {cls.__name__}, found {_shown(value)}")
        return value

    return check


def _base(base: str, bound: int) -> Check:
    if base in INTEGERS:
        return _integer(base)
    if base.startswith("float"):
        return _real(base)
    if base in ("byte", "octet"):
        return _octet
    expected = bool if base == "bool" else str

    def check(value: Any) -> Any:
        if not isinstance(value, expected) or (bound and len(value) > bound):
            limit = f" of at most {bound} characters" if bound else ""
            raise MessageError(f"expected a {expected.__name__}{limit}, found {_shown(value)}")
        return value

    return check


def _integer(base: str) -> Check:
    low, high = INTEGERS[base]

    def check(value: Any) -> Any:
        if not isinstance(value, int) or not low <= value <= high:
            raise MessageError(f"expected an int from {low} to {high}, found {_shown(value)}")
        return value

    return check


def _real(base: str) -> Check:
    limit = FLOAT32_MAX if base == "float32" else math.inf

    def check(value: Any) -> Any:
        if not isinstance(value, float):
            raise MessageError(f"expected a float, found {_shown(value)}: write 1.0 or float(...)")
        if abs(value) > limit and not math.isinf(value):
            raise MessageError(f"expected a number that fits {base}, found {value}")
        return value

    return check


def _octet(value: Any) -> Octet:
    if not isinstance(value, bytes) or len(value) != 1:
        raise MessageError(f"expected one byte such as b'\\x01', found {_shown(value)}")
    return Octet(value)


def _numbers(base: str, count: int, fixed: bool) -> Check:
    """Return the check of number arrays, which are stored as NumPy arrays; bytes and `array.array` are not copied.

    As in the messages of rosidl_generator_py on Humble, arrays of a fixed length accept NumPy arrays,
    sequences do not.
    """
    dtype, single = DTYPES[base], _integer("uint8") if base in ("byte", "octet") else _base(base, 0)

    def check(value: Any) -> Any:
        if isinstance(value, np.ndarray) and not fixed and not isinstance(value, Numbers):
            raise MessageError("expected a list, bytes or array.array, found a NumPy array: use .tolist()")
        if isinstance(value, (bytes, bytearray)) and base == "uint8":
            array = np.frombuffer(value, dtype)
        elif isinstance(value, (list, tuple)):
            array = np.array([single(v) for v in value], dtype)
        elif isinstance(value, np.ndarray) or hasattr(value, "typecode"):
            array = np.asarray(value)
        else:
            raise MessageError(f"expected a list or array of {dtype}, found {_shown(value)}")
        if array.dtype != dtype:
            raise MessageError(f"expected an array of {dtype}, found {array.dtype}: use .tolist()")
        if array.ndim != 1:
            raise MessageError(f"expected one axis, found {array.ndim}: use .ravel()")
        _check_count(len(array), count, fixed)
        return np.ascontiguousarray(array) if fixed else np.ascontiguousarray(array).view(Numbers)

    return check


def _objects(single: Check, count: int, fixed: bool) -> Check:
    def check(value: Any) -> list[Any]:
        if isinstance(value, (str, bytes)) or not isinstance(value, Sequence):
            raise MessageError(f"expected a list, found {_shown(value)}")
        _check_count(len(value), count, fixed)
        return [single(v) for v in value]

    return check


def _check_count(actual: int, count: int, fixed: bool) -> None:
    if (actual != count) if fixed else (count and actual > count):
        raise MessageError(f"expected {'' if fixed else 'at most '}{count} elements, found {actual}")


def _shown(value: Any) -> str:
    text = repr(value)
    return f"{text if len(text) <= 40 else text[:37] + '...'} ({type(value).__name__})"


def spelled(described: Any) -> str:
    """Return the field's type as spelled in ROS 2's `get_fields_and_field_types`."""
    kind, detail = described
    if kind == Nodetype.NAME:
        package, _, short = detail.split("/")
        return f"{package}/{short}"
    if kind == Nodetype.BASE:
        base, bound = detail
        spelling = {"bool": "boolean", "float32": "float", "float64": "double", "byte": "octet"}
        return f"string<{bound}>" if base == "string" and bound else spelling.get(base, base)
    inner, count = detail
    if kind == Nodetype.ARRAY:
        return f"{spelled(inner)}[{count}]"
    return f"sequence<{spelled(inner)}, {count}>" if count else f"sequence<{spelled(inner)}>"


# Python classes of messages that behave like those of real rclpy: defaults, checks on assignment, constants.


class Message:
    """Message with slots, keyword arguments, and a check of every assigned value."""

    __slots__ = ()
    TYPE: str
    """Type such as `nav_msgs/msg/Odometry`."""
    _checks: Mapping[str, Callable[[Any], Any]]
    _zeros: Mapping[str, Callable[[], Any]]
    _spelled: Mapping[str, str]

    def __init__(self, **values: Any) -> None:
        for name, zero in self._zeros.items():
            if name in values:
                setattr(self, name, values.pop(name))
            else:
                object.__setattr__(self, name, zero())
        if values:
            raise MessageError(f"{self.TYPE} has no field '{min(values)}'; it has {', '.join(self._zeros)}")

    def __setattr__(self, name: str, value: Any) -> None:
        if name not in self._checks:
            raise AttributeError(f"{self.TYPE} has no field '{name}'; it has {', '.join(self._zeros)}")
        try:
            value = self._checks[name](value)
        except MessageError as error:
            raise MessageError(f"{self.TYPE}: {name}: {error}") from None
        object.__setattr__(self, name, value)

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        return all(np.array_equal(getattr(self, n), getattr(other, n)) for n in self._zeros)

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        package, kind, short = self.TYPE.split("/")
        values = ", ".join(f"{n}={getattr(self, n)!r}" for n in self._zeros)
        return f"{package}.{kind}.{short}({values})"

    @classmethod
    def get_fields_and_field_types(cls) -> dict[str, str]:
        """Return field names and their types, spelled as in ROS 2."""
        return dict(cls._spelled)


def message_class(
    name: str, definitions: Definitions, nested: Callable[[str], type[Message]]
) -> tuple[type[Message], Callable[..., Message]]:
    """Return the class of a type, and a function that creates one from valid field values in order, for
    deserialization.

    Args:
        name: Name such as `nav_msgs/msg/Odometry`.
        definitions: Definitions that contain its fields.
        nested: Function that returns the class of a nested type.

    Raises:
        Ros2Error: The type is unknown.
    """
    described = {f"{n}_" if keyword.iskeyword(n) else n: d for n, d in definitions.fields(name)}
    defaults = definitions.defaults.get(name, {})
    body: dict[str, Any] = {
        "__slots__": tuple(described),
        "__module__": ".".join(name.split("/")[:2]),
        "TYPE": name,
        "_checks": {n: check_of(d, nested) for n, d in described.items()},
        "_zeros": {n: _zero(d, nested, defaults.get(n)) for n, d in described.items()},
        "_spelled": {n: spelled(d) for n, d in described.items()},
    }
    for constant, kind, value in definitions.constants(name):
        body[constant] = bytes([value]) if kind in ("byte", "octet") else value
    cls = type(Message)(name.rsplit("/", 1)[1], (Message,), body)
    return cls, _maker(cls, described)


def _maker(cls: type[Message], described: Mapping[str, Any]) -> Callable[..., Message]:
    """Return a function that creates a message from valid values: it sets the slots directly, several times faster."""
    names = list(described)
    lines = [f"def make({', '.join(f'v{i}' for i in range(len(names)))}):", "    m = new(cls)"]
    for i, (kind, detail) in enumerate(described.values()):
        expression = f"v{i}"
        if kind == Nodetype.BASE and detail[0] in ("byte", "octet"):
            expression = f"octet(v{i})"
        elif kind == Nodetype.SEQUENCE and detail[0][0] == Nodetype.BASE and detail[0][1][0] in DTYPES:
            expression = f"v{i}.view(numbers)"
        lines.append(f"    set{i}(m, {expression})")
    scope: dict[str, Any] = {f"set{i}": cls.__dict__[n].__set__ for i, n in enumerate(names)}
    scope |= {"new": object.__new__, "cls": cls, "octet": Octet.of, "numbers": Numbers}
    exec("\n".join([*lines, "    return m"]), scope)
    return scope["make"]  # type: ignore[no-any-return]


def _zero(described: Any, nested: Callable[[str], type[Message]], default: Any) -> Callable[[], Any]:
    """Return the function that creates a field's default: zero, empty, or as in its definition."""
    kind, detail = described
    if default is not None:
        check = check_of(described, nested)
        return lambda: check(default)
    if kind == Nodetype.NAME:
        cls = nested(detail)
        return lambda: cls()
    if kind == Nodetype.BASE:
        return _base_zero(detail[0])
    (inner_kind, inner), length = detail
    count = length if kind == Nodetype.ARRAY else 0
    if inner_kind == Nodetype.BASE and inner[0] in DTYPES:
        dtype = DTYPES[inner[0]]
        return lambda: np.zeros(count, dtype) if kind == Nodetype.ARRAY else np.zeros(0, dtype).view(Numbers)
    element = _zero((inner_kind, inner), nested, None)
    return lambda: [element() for _ in range(count)]


def _base_zero(base: str) -> Callable[[], Any]:
    """Return the function that creates the zero of a base type."""
    if base == "string":
        return str
    if base == "bool":
        return bool
    if base in ("byte", "octet"):
        return lambda: Octet(b"\0")
    return float if base.startswith("float") else int


# Serialization of messages: little-endian CDR, as ROS 2 sends it, and the hash of a type's definition.


HEADER = b"\x00\x01\x00\x00"
"""Encapsulation header: plain CDR, little endian."""


class ServiceType:
    """Service type as in rclpy: a request and a response class."""

    TYPE: str
    Request: type[Message]
    Response: type[Message]


class Codec:
    """Classes, serialization and hashes of all types of one release of ROS 2.

    Args:
        distro: Name of the release, such as "jazzy".
    """

    def __init__(self, distro: str) -> None:
        self.definitions = Definitions(distro)
        self._classes: dict[str, type[Message]] = {}
        self._services: dict[str, type[ServiceType]] = {}

    def message(self, name: str) -> type[Message]:
        """Return the class of a message, with a name such as `nav_msgs/msg/Odometry`.

        Raises:
            Ros2Error: The type is unknown.
        """
        if name not in self._classes:
            cls, make = message_class(name, self.definitions, self.message)
            self._classes[name] = cls
            store = self.definitions.store
            store.get_msgdef(name)
            store.cache[name] = replace(store.cache[name], cls=make)  # type: ignore[arg-type]
        return self._classes[name]

    def service(self, name: str) -> type[ServiceType]:
        """Return the class of a service, with a name such as `std_srvs/srv/Trigger`.

        Raises:
            Ros2Error: The service is unknown.
        """
        if name not in self.definitions.services:
            raise Ros2Error(
                f"no service type '{name}' is known: name the folder of its package in FINSSIM_ROS_INTERFACES"
            )
        if name not in self._services:
            halves = {h: self.message(f"{name}_{h}") for h in ("Request", "Response")}
            package, kind, short = name.split("/")
            body = {"TYPE": name, "__module__": f"{package}.{kind}", **halves}
            self._services[name] = type(short, (ServiceType,), body)
        return self._services[name]

    def names(self, package: str, kind: str) -> list[str]:
        """Return the short names of a package's types; `kind` is "msg" or "srv"."""
        available = self.definitions.services if kind == "srv" else self.definitions.known()
        return sorted(name.rsplit("/", 1)[1] for name in available if name.startswith(f"{package}/{kind}/"))

    def packages(self) -> set[str]:
        """Return the names of all packages with a type."""
        return {name.partition("/")[0] for name in self.definitions.known()}

    def serialize(self, message: Message) -> bytearray:
        """Return the bytes of a message: header, CDR, padding to a multiple of four.

        Raises:
            MessageError: A field was modified in place so that it no longer fits.
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
        """Return a message from its bytes; its arrays are writable and share the given buffer if that is writable.

        Extra bytes at the end are allowed: some writers pad.

        Raises:
            Ros2Error: The type is unknown, or the bytes are not one of its messages.
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
        """Return the hash that Iron and later announce with an endpoint, `RIHS01_` and 64 hexadecimal digits."""
        return self.definitions.store.hash_rihs01(name)

    def fields(self, name: str) -> list[tuple[str, Any]]:
        """Return the fields of a type, in the format of rosbags."""
        return self.definitions.fields(name)


def codec_of(distro: str | None = None) -> Codec:
    """Return the process's shared codec for a release; by default that of `ROS_DISTRO`."""
    return _codec(distro or distro_of().name)


@cache
def _codec(distro: str) -> Codec:
    return Codec(distro)
