"""Nodes need an rclpy; where Cyclone has no wheel, and no ROS 2 is sourced, there is none."""

import importlib.util

if importlib.util.find_spec("cyclonedds") is None:
    collect_ignore_glob = ["test_*.py"]
