"""Nodes need an rclpy; where Cyclone has no wheel, and no ROS 2 is sourced, there is none."""

import fcntl
import importlib.util
import tempfile
from pathlib import Path

import pytest

if importlib.util.find_spec("cyclonedds") is None:
    collect_ignore_glob = ["test_*.py"]


@pytest.fixture(scope="module")
def alone():
    """The only graph in real time: two at once are more than two cores can play."""
    with (Path(tempfile.gettempdir()) / "finssim-real-time-graph.lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
