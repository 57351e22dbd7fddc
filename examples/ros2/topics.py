# ruff: noqa: E402 - rclpy can be imported once a backend is active
"""List, echo and publish topics where the command `ros2` is not installed.

python examples/ros2/topics.py list
python examples/ros2/topics.py echo /bluerov2_heavy/odom
python examples/ros2/topics.py pub /bluerov2_heavy/goal geometry_msgs/msg/PoseStamped \
    "{header: {frame_id: map}, pose: {position: {x: 0.5, z: -0.6}}}"
"""

import sys
import time
from importlib import import_module

import yaml

from finssim.extensions.ros2 import activate

activate()

import rclpy
from rclpy.qos import qos_profile_sensor_data

DISCOVERY = 2.0
"""Time allowed for discovering the other nodes [s]."""


def type_of(name):
    """Return the class of a message, such as std_msgs/msg/Bool."""
    package, _, message = name.split("/")
    return getattr(import_module(f"{package}.msg"), message)


def fill(message, values):
    """Set fields of a message from nested mappings."""
    for field, value in values.items():
        if isinstance(value, dict):
            fill(getattr(message, field), value)
        else:
            setattr(message, field, type(getattr(message, field))(value))


def wait(node, seconds):
    """Spin a node for a while [s]."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        rclpy.spin_once(node, timeout_sec=0.1)


def main(command="list", topic="", kind="", values="{}"):
    rclpy.init()
    node = rclpy.create_node("topics")
    wait(node, DISCOVERY)
    known = dict(node.get_topic_names_and_types())
    if command == "list":
        for name, kinds in sorted(known.items()):
            print(name, *kinds)
    elif command == "echo" and topic in known:
        node.create_subscription(type_of(known[topic][0]), topic, print, qos_profile_sensor_data)
        rclpy.spin(node)
    elif command == "pub":
        message = type_of(kind)()
        fill(message, yaml.safe_load(values) or {})
        publisher = node.create_publisher(type(message), topic, 10)
        wait(node, DISCOVERY)
        publisher.publish(message)
        wait(node, 0.5)
    else:
        sys.exit(f"no topic {topic}: 'topics.py list' shows those of this domain")


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except KeyboardInterrupt:
        pass
