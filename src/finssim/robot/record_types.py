"""Topics of a record, and the ROS 2 types of their messages: definitions, constructors and CDR through rosbags."""

from __future__ import annotations

from functools import cache
from importlib import resources
from typing import Any, NamedTuple

__all__ = ["METADATA", "TOPICS", "RecordError", "Topic", "definition", "types"]


class RecordError(ValueError):
    """A record cannot be read, or not played as asked."""


METADATA = "finssim"
"""Name of the metadata record that says what the record is of."""


class Topic(NamedTuple):
    """What a record keeps under one name."""

    name: str
    """After the vehicle's name; a leading slash stands for itself."""
    kind: str
    """Type of its messages."""


TOPICS = {
    "imu": Topic("imu", "sensor_msgs/msg/Imu"),
    "pressure": Topic("pressure", "sensor_msgs/msg/FluidPressure"),
    "telemetry": Topic("telemetry", "finssim_msgs/msg/HardwareTelemetry"),
    "shafts": Topic("joint_states", "sensor_msgs/msg/JointState"),
    "odometry": Topic("odom", "nav_msgs/msg/Odometry"),
    "estimator": Topic("estimator_status", "finssim_msgs/msg/EstimatorStatus"),
    "goal": Topic("goal", "geometry_msgs/msg/PoseStamped"),
    "wrench": Topic("wrench_cmd", "geometry_msgs/msg/WrenchStamped"),
    "command": Topic("thruster_cmd", "finssim_msgs/msg/ThrusterCommand"),
    "thrusters": Topic("thruster_state", "finssim_msgs/msg/ThrusterState"),
    "echo": Topic("command_echo", "finssim_msgs/msg/CommandEcho"),
    "policy": Topic("policy_info", "finssim_msgs/msg/PolicyInfo"),
    "picture": Topic("camera/image/compressed", "sensor_msgs/msg/CompressedImage"),
    "tags": Topic("camera/tags", "std_msgs/msg/String"),
    "event": Topic("events", "std_msgs/msg/String"),
    "diagnostics": Topic("diagnostics", "diagnostic_msgs/msg/DiagnosticArray"),
    "transform": Topic("/tf", "tf2_msgs/msg/TFMessage"),
}
"""Everything a record may hold."""


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
