"""Nodes need an rclpy; without a wheel of Cyclone and without a sourced ROS 2 their tests are skipped."""

import fcntl
import importlib.util
import tempfile
from pathlib import Path

import pytest

if importlib.util.find_spec("cyclonedds") is None:
    collect_ignore_glob = ["test_*.py"]


@pytest.fixture(scope="module")
def alone():
    """Lock for the only graph in real time: two at once would overload two cores."""
    with (Path(tempfile.gettempdir()) / "finssim-real-time-graph.lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
