"""Bags of ROS 1 and ROS 2 from plain values; fields that a message does not name are zero or empty."""

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

T0 = 1_760_000_000


def xyz(*values):
    """Return the fields of a vector or point."""
    return dict(zip("xyz", values, strict=True))


def empty(node, of):
    """Return zero of a plain type, or an array of zeros."""
    if node == Nodetype.BASE:
        return {"string": "", "bool": False}.get(of[0], 0.0 if "float" in of[0] else 0)
    (inner, name), count = of
    plain = inner == Nodetype.BASE and name[0] != "string"
    return np.zeros(count, "uint8" if name[0] in ("octet", "byte") else name[0]) if plain else []


class Bag:
    """Messages of one bag, in ROS 1 or ROS 2."""

    def __init__(self, kind=2, types=None):
        self.kind, self.queue = kind, []
        self.types = get_typestore(Stores.ROS2_HUMBLE if kind == 2 else Stores.ROS1_NOETIC)
        for name, text in (types or {}).items():
            self.types.register(get_types_from_msg(text, name))

    def message(self, name, values):
        """Return a message of a type from mappings of its fields."""
        fields = {}
        for field, (node, of) in self.types.fielddefs[name][1]:
            value = values.get(field)
            if node == Nodetype.NAME:
                value = self.message(of, value or {})
            fields[field] = empty(node, of) if value is None else value
        return self.types.types[name](**fields)

    def header(self, t, frame="base_link"):
        whole = int(T0 + t)
        return {"stamp": {"sec": whole, "nanosec": round((T0 + t - whole) * 1e9)}, "frame_id": frame}

    def add(self, topic, kind, make, rate=10.0, delay=0.003, seconds=10.0):
        """Add messages of `make(i, t)` at a rate; those with a header are stamped."""
        name = kind.replace("/", "/msg/", 1)
        for i in range(round(seconds * rate)):
            t = i / rate
            message = self.message(name, {"header": self.header(t)} | make(i, t))
            self.queue.append((round((T0 + t + delay) * 1e9), topic, name, message))
        return self

    def write(self, path, broken=(), storage=StoragePlugin.MCAP, mode=None, version=9):
        """Write the bag, compressed if a mode is given; the messages of `broken` topics are cut."""
        if self.kind == 2:
            writer = Writer(path, version=version, storage_plugin=storage)
            if mode is not None:
                writer.set_compression(mode, CompressionFormat.ZSTD)
        else:
            path = path.with_suffix(".bag")
            writer = Writer1(path)
        pack = self.types.serialize_cdr if self.kind == 2 else self.types.serialize_ros1
        with writer:
            names = {topic: name for _, topic, name, _ in self.queue}
            known = {t: writer.add_connection(t, name, typestore=self.types) for t, name in names.items()}
            for ns, topic, name, message in sorted(self.queue, key=lambda item: item[0]):
                raw = pack(message, name)
                writer.write(known[topic], ns, raw[:10] if topic in broken else raw)
        return path
