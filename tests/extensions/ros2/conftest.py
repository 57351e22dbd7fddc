"""Each test process uses its own ROS domain, over the loopback only."""

import importlib.util
import os

worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw") or 0)
os.environ["ROS_DOMAIN_ID"] = str(10 + 50 * (worker % 4) + os.getpid() % 50)
for variable in ("CYCLONEDDS_URI", "ROS_LOCALHOST_ONLY", "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_DISTRO"):
    os.environ.pop(variable, None)
os.environ["PLATFORM_ROS"] = "dds"

WIRE = (
    "as_strict_as_rclpy",
    "graph_queries",
    "shim",
    "tf2",
    "topics",
    "two_processes",
    "wire_settings",
    "wire_types",
)
"""Tests that need the wire."""

# Cyclone has no wheels beyond Python 3.11; elsewhere the tests use a sourced ROS 2.
if importlib.util.find_spec("cyclonedds") is None:
    collect_ignore = [f"test_{name}.py" for name in WIRE]
