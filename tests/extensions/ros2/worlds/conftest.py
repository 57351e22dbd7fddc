"""Each test process uses its own ROS domain, over the loopback only."""

import importlib.util
import os

worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw") or 0)
os.environ["ROS_DOMAIN_ID"] = str(20 + 50 * (worker % 4) + os.getpid() % 40)
for variable in ("CYCLONEDDS_URI", "ROS_LOCALHOST_ONLY", "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_DISTRO"):
    os.environ.pop(variable, None)
os.environ["PLATFORM_ROS"] = "dds"

# Cyclone's wheels end at Python 3.11; elsewhere the wire is that of a sourced ROS 2.
if importlib.util.find_spec("cyclonedds") is None:
    collect_ignore_glob = ["test_*.py"]
