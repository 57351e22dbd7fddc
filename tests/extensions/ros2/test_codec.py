"""Wire bytes equal hand-written CDR; type hashes follow REP-2011."""

import hashlib
import json
import struct

import numpy as np
import pytest

from finssim.extensions.ros2 import MessageError, Ros2Error
from finssim.extensions.ros2.codec import INTERFACES, Definitions, codec_of

CODEC = codec_of("jazzy")


def message(name, **values):
    """Return a message of a type."""
    return CODEC.message(name)(**values)


def test_a_string_is_its_length_with_the_closing_zero_and_its_bytes():
    """std_msgs/String 'abc': header, 4, a b c NUL."""
    data = CODEC.serialize(message("std_msgs/msg/String", data="abc"))
    assert data == bytes.fromhex("000100000400000061626300")


def test_a_header_packs_its_time_before_its_frame():
    """std_msgs/Header: sec, nanosec, then the string; padded with zeros to four bytes."""
    stamp = message("builtin_interfaces/msg/Time", sec=1, nanosec=2)
    data = CODEC.serialize(message("std_msgs/msg/Header", stamp=stamp, frame_id="map1"))
    assert data == bytes.fromhex("000100000100000002000000050000006d61703100000000")


def test_doubles_are_aligned_to_eight_after_the_header():
    """Float64MultiArray: empty layout (sequence length, offset), length, gap, two doubles."""
    data = CODEC.serialize(message("std_msgs/msg/Float64MultiArray", data=[1.0, -2.0]))
    body = struct.pack("<III4x2d", 0, 0, 2, 1.0, -2.0)
    assert data == b"\x00\x01\x00\x00" + body


def test_a_thruster_command_in_bytes():
    """FinsSim's own message: header, source, names, a gap up to eight, forces."""
    made = message("finssim_msgs/msg/ThrusterCommand", source="pid", names=["a", "bc"], force=[1.5, -0.25])
    body = struct.pack("<iII", 0, 0, 1) + b"\0\0\0\0"  # stamp, frame_id "" and its padding
    body += struct.pack("<I", 4) + b"pid\0" + struct.pack("<I", 2)
    body += struct.pack("<I", 2) + b"a\0\0\0" + struct.pack("<I", 3) + b"bc\0\0"
    body += struct.pack("<I", 2)
    body += b"\0" * (-len(body) % 8) + struct.pack("<2d", 1.5, -0.25)
    assert CODEC.serialize(made) == b"\x00\x01\x00\x00" + body


def test_an_empty_message_carries_one_byte():
    """std_msgs/Empty: one zero, padded."""
    assert CODEC.serialize(message("std_msgs/msg/Empty")) == bytes.fromhex("0001000000000000")


def test_a_bool_and_an_octet_are_one_byte_each():
    """DiagnosticStatus begins with its level, an octet, then the aligned length of its name."""
    data = CODEC.serialize(message("diagnostic_msgs/msg/DiagnosticStatus", level=b"\x02"))
    assert data[4:12] == bytes.fromhex("0200000001000000")
    assert CODEC.serialize(message("std_msgs/msg/Bool", data=True))[4] == 1


@pytest.mark.slow
@pytest.mark.parametrize("distro", ["humble", "jazzy"])
def test_every_known_type_survives_its_own_bytes(distro):
    """A message with all defaults, of every type of a release, reads back equal."""
    codec = codec_of(distro)
    for name in codec.definitions.known():
        made = codec.message(name)()
        assert codec.deserialize(codec.serialize(made), name) == made, name


def test_values_survive_their_bytes():
    """Odometry with numbers in all fields survives."""
    made = message("nav_msgs/msg/Odometry", child_frame_id="base_link")
    made.pose.pose.position.z, made.twist.twist.angular.x = -0.7, 1e-9
    made.pose.covariance = np.arange(36.0)
    back = CODEC.deserialize(bytes(CODEC.serialize(made)), made.TYPE)
    assert back == made and back.pose.pose.orientation.w == 1.0
    back.pose.pose.position.z = 0.0
    assert back != made


def test_big_endian_bytes_are_read_too():
    """The header's second byte contains the byte order."""
    assert CODEC.deserialize(b"\x00\x00\x00\x00" + struct.pack(">d", 2.5), "std_msgs/msg/Float64").data == 2.5


@pytest.mark.parametrize("length", range(16))
def test_cut_bytes_are_refused_in_one_sentence(length):
    """A truncated message raises the codec's own error and no other."""
    data = bytes(CODEC.serialize(message("std_msgs/msg/Header", frame_id="odometry")))[:length]
    with pytest.raises(Ros2Error, match="std_msgs/msg/Header"):
        CODEC.deserialize(data, "std_msgs/msg/Header")


def test_quaternions_begin_as_no_rotation():
    """The default of w is 1 as in ROS 2."""
    assert message("geometry_msgs/msg/Pose").orientation.w == 1.0


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("height", 1.0),
        ("height", -1),
        ("height", 2**32),
        ("encoding", b"mono8"),
        ("is_bigendian", 256),
        ("data", np.zeros(4)),
        ("data", [300]),
        ("data", "text"),
        ("header", "map"),
    ],
)
def test_what_real_rclpy_refuses_is_refused_here(field, value):
    """A field accepts only its own type and raises an AssertionError otherwise, as on Humble."""
    image = message("sensor_msgs/msg/Image")
    with pytest.raises(AssertionError, match=field):
        setattr(image, field, value)


def test_a_float_field_refuses_an_integer():
    """Humble asserts the type, so code that runs here also runs there."""
    with pytest.raises(MessageError, match="write 1.0"):
        message("std_msgs/msg/Float64", data=1)


def test_unknown_fields_are_refused():
    """They are refused in the constructor and in assignments."""
    with pytest.raises(MessageError, match="no field 'w'"):
        message("geometry_msgs/msg/Point", w=1.0)
    with pytest.raises(AttributeError, match="no field 'w'"):
        message("geometry_msgs/msg/Point").w = 1.0


def test_fixed_arrays_keep_their_length():
    """An array of 36 covariances must have 36 values."""
    with pytest.raises(MessageError, match="expected 36 elements, found 35"):
        message("geometry_msgs/msg/PoseWithCovariance", covariance=[0.0] * 35)


def test_arrays_that_came_over_the_wire_are_writable():
    """As in rclpy, a node may correct a received message."""
    data = CODEC.serialize(message("geometry_msgs/msg/PoseWithCovariance"))
    back = CODEC.deserialize(bytearray(data), "geometry_msgs/msg/PoseWithCovariance")
    back.covariance[0] = 1.0
    assert back.covariance[0] == 1.0


def test_constants_belong_to_the_class():
    """Constants such as ThrusterState.FAULT are class attributes, and octets are bytes."""
    assert CODEC.message("finssim_msgs/msg/ThrusterState").FAULT == 3
    assert CODEC.message("diagnostic_msgs/msg/DiagnosticStatus").STALE == b"\x03"


def test_fields_are_spelled_as_ros_spells_them():
    """get_fields_and_field_types is that of a real Odometry, and of arrays."""
    assert CODEC.message("nav_msgs/msg/Odometry").get_fields_and_field_types() == {
        "header": "std_msgs/Header",
        "child_frame_id": "string",
        "pose": "geometry_msgs/PoseWithCovariance",
        "twist": "geometry_msgs/TwistWithCovariance",
    }
    spelled = CODEC.message("finssim_msgs/msg/EstimatorStatus").get_fields_and_field_types()
    assert spelled["position_std"] == "double[3]" and spelled["fixes_accepted"] == "uint32"


def test_defaults_in_a_definition_hold():
    """A `.msg` file may give the default of a field."""
    definitions = Definitions("jazzy")
    definitions.add_message("mine_msgs/msg/Gain", 'float64 gain 2.5 # why\nstring name "abc"\nint32 plain\n')
    assert definitions.defaults["mine_msgs/msg/Gain"] == {"gain": 2.5, "name": "abc"}


def test_another_definition_under_a_known_name_is_refused():
    """Two layouts under one name would corrupt messages."""
    with pytest.raises(Ros2Error, match="nav_msgs/msg/Odometry"):
        Definitions("jazzy").add_message("nav_msgs/msg/Odometry", "float64 x\n")


@pytest.mark.parametrize(("length", "distro"), [(24, "humble"), (16, "iron"), (16, "jazzy")])
def test_identifiers_in_the_node_list_have_the_length_of_the_release(length, distro):
    """Identifiers have 24 bytes up to Humble, and 16 since Iron."""
    assert len(codec_of(distro).message("rmw_dds_common/msg/Gid")().data) == length


# --- type hashes, computed a second time from the files alone ---------------------------------------------------------

TYPE_IDS = {
    **{
        n: i
        for i, n in enumerate("int8 uint8 int16 uint16 int32 uint32 int64 uint64 float32 float64".split(), 2)
    },
    "bool": 15,
    "string": 17,
}
STANDARD = {
    "builtin_interfaces/msg/Time": "int32 sec\nuint32 nanosec",
    "std_msgs/msg/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "std_msgs/msg/String": "string data",
    "geometry_msgs/msg/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
    "geometry_msgs/msg/Vector3": "float64 x\nfloat64 y\nfloat64 z",
}
OURS = {f"finssim_msgs/msg/{p.stem}": p.read_text() for p in INTERFACES.glob("finssim_msgs/msg/*.msg")}


def described(name):
    """Return REP-2011's description of one type from its text."""
    fields = []
    for line in {**STANDARD, **OURS}[name].splitlines():
        words = line.split("#")[0].split()
        if len(words) != 2 or "=" in words[1]:
            continue
        kind, field = words
        base, bracket, count = kind.partition("[")
        offset = 0 if not bracket else 144 if count == "]" else 48
        nested = "" if base in TYPE_IDS else "/msg/".join(base.split("/"))
        type_id = (TYPE_IDS[base] if not nested else 1) + offset
        capacity = int(count[:-1]) if offset == 48 else 0
        kinds = {"type_id": type_id, "capacity": capacity, "string_capacity": 0, "nested_type_name": nested}
        fields.append({"name": field, "type": kinds})
    return {"type_name": name, "fields": fields}


def referenced(name):
    """Return all types that a type references, directly or indirectly."""
    nested = {f["type"]["nested_type_name"] for f in described(name)["fields"]} - {""}
    return nested.union(*(referenced(n) for n in nested))


@pytest.mark.parametrize("name", [*STANDARD, *OURS])
def test_type_hashes_follow_the_rule(name):
    """RIHS01 is the SHA-256 of the canonical JSON of a type and of its referenced types, by name."""
    below = [described(n) for n in sorted(referenced(name))]
    text = json.dumps({"type_description": described(name), "referenced_type_descriptions": below})
    assert CODEC.type_hash(name) == f"RIHS01_{hashlib.sha256(text.encode()).hexdigest()}"


@pytest.mark.parametrize(
    ("name", "published"),
    [
        ("std_msgs/msg/String", "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"),
        # Hash for `char`, which rosidl treats as uint8: every participant of Iron and later announces it.
        (
            "rmw_dds_common/msg/ParticipantEntitiesInfo",
            "91a0593bacdcc50ea9bdcf849a938b128412cc1ea821245c663bcd26f83c295e",
        ),
    ],
)
def test_hashes_are_the_published_ones(name, published):
    assert codec_of("jazzy").type_hash(name) == f"RIHS01_{published}"
