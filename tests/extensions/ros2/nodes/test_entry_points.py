# ruff: noqa: E402 - rclpy can be imported once a backend is active
"""Functions that `ros2 run finssim_ros NODE` calls: the arguments of the command line reach the node."""

import os
import runpy
import subprocess
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from finssim.extensions.ros2.backend import activate

activate(announce=False)

import rclpy

from finssim.extensions.ros2.nodes.robot_node import RobotNode
from finssim.extensions.ros2.up import NODES, run_node
from finssim.extensions.ros2.worlds.virtual_pool import VirtualPoolNode

PACKAGE = Path(__file__).resolve().parents[4] / "ros2_ws" / "src" / "finssim_ros"


@pytest.fixture
def entry(monkeypatch):
    """Function that calls an installed function with a command line, in this process, and returns its result."""
    import setuptools

    told = {}
    monkeypatch.setattr(setuptools, "setup", told.update)
    monkeypatch.chdir(PACKAGE)
    runpy.run_path("setup.py")
    monkeypatch.syspath_prepend(str(PACKAGE))
    for name in ("finssim_ros", "finssim_ros.run"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    scripts = dict(line.split(" = ") for line in told["entry_points"]["console_scripts"])
    assert set(scripts) == set(NODES)
    monkeypatch.setattr(RobotNode, "urgent", False)
    monkeypatch.setattr("finssim.extensions.ros2.nodes.robot_node.LISTENING", 0.0)
    monkeypatch.setattr(RobotNode, "listening", 0.0)

    def call(node, *words):
        monkeypatch.setattr(sys, "argv", [f"/somewhere/lib/finssim_ros/{node}", *words])
        return EntryPoint(node, scripts[node], "console_scripts").load()()

    return call


@pytest.fixture
def lived(monkeypatch):
    """Nodes that would have started to run: they end at once instead."""
    seen = []
    for kind in (RobotNode, VirtualPoolNode):
        monkeypatch.setattr(kind, "spin", lambda self: seen.append(self))
    return seen


@pytest.mark.parametrize("node", NODES)
def test_every_installed_node_takes_its_ros_arguments(entry, lived, capsys, node):
    """A vehicle that does not exist is refused by name; without the argument the node would run an ordinary
    one."""
    assert entry(node, "--ros-args", "-p", "vehicle:=nosuch") == 2 and not lived
    assert "'nosuch'" in capsys.readouterr().err


def test_names_parameters_and_files_reach_an_installed_node(entry, lived, tmp_path):
    """`ros2 launch` passes on a node name, a namespace, use_sim_time and a parameter file."""
    file = tmp_path / "own.yaml"
    file.write_text("/**:\n  ros__parameters: {vehicle: bluerov2_heavy, policy: pid-paper}\n")
    words = f"-r __node:=pilot -r __ns:=/deep/blue -p use_sim_time:=true --params-file {file}"
    assert entry("controller", "--ros-args", *words.split()) == 0
    (node,) = lived
    assert node.get_fully_qualified_name() == "/deep/blue/pilot"
    assert node.filed.name.startswith("bluerov2") and node.get_parameter("use_sim_time").value
    assert node.modes.switch.mode == "pid-paper"


@pytest.mark.parametrize(
    ("node", "setting"), [("recorder", "pool_file:=gone.yaml"), ("localizer", "pool_file:=gone.yaml")]
)
def test_an_installed_node_refuses_a_missing_file_in_a_sentence(entry, lived, capsys, node, setting):
    """The message is not a traceback."""
    words = ("--ros-args", "-p", setting, "-p", "record:=x.mcap")
    assert entry(node, *words) == 2 and not lived
    assert "gone.yaml" in capsys.readouterr().err and not Path("x.mcap").exists()


def test_a_recorder_without_a_pool_records(entry, lived, tmp_path):
    """With pool_file:=none the recorder runs and copies no pool file."""
    record = tmp_path / "x.mcap"
    assert entry("recorder", "--ros-args", "-p", "pool_file:=none", "-p", f"record:={record}") == 0
    assert lived and record.exists()


def test_a_localizer_without_a_pool_is_refused(entry, lived, capsys):
    """The message states what to do."""
    assert entry("localizer", "--ros-args", "-p", "pool_file:=none") == 2 and not lived
    assert "start none where no camera looks" in capsys.readouterr().err


def test_an_older_workspace_that_gives_no_arguments_keeps_those_of_the_process(monkeypatch, lived, capsys):
    """Functions of an older workspace call `run_node` with the name only."""
    monkeypatch.setattr(RobotNode, "listening", 0.0)
    monkeypatch.setattr(RobotNode, "urgent", False)
    monkeypatch.setattr(sys, "argv", ["sim", "--ros-args", "-p", "vehicle:=nosuch"])
    assert run_node("sim") == 2 and not lived


def test_a_node_whose_context_is_shut_down_during_a_call_ends_in_order(monkeypatch, capsys):
    """Real rclpy shuts down at SIGTERM during any call; an error of the node itself keeps its traceback."""
    monkeypatch.setattr(RobotNode, "urgent", False)
    monkeypatch.setattr("finssim.extensions.ros2.nodes.robot_node.LISTENING", 0.0)
    monkeypatch.setattr(RobotNode, "listening", 0.0)
    monkeypatch.setattr(sys, "argv", ["node"])
    closed = []

    class Left(RobotNode):
        def __init__(self, leave):
            super().__init__("left")
            self.sends("event", "diagnostics")
            self.create_timer(0.01, lambda: (leave(), self.event("late", "words"), 1 / 0))

        def close(self):
            closed.append(self)

    class Leaves(Left):
        def __init__(self):
            super().__init__(rclpy.shutdown)

    class Fails(Left):
        def __init__(self):
            super().__init__(lambda: None)

    assert Leaves.run() == 0 and len(closed) == 1
    with pytest.raises(ZeroDivisionError):
        Fails.run()
    assert len(closed) == 2


@pytest.mark.slow
def test_the_script_that_colcon_installs_exits_with_the_status(tmp_path):
    """The script text of setuptools is run as a process."""
    script = tmp_path / "sim"
    script.write_text("import sys\nfrom finssim_ros.run import sim\nsys.exit(sim())\n")
    environ = {**os.environ, "PYTHONPATH": os.pathsep.join([str(PACKAGE), *sys.path])}
    words = [sys.executable, str(script), "--ros-args", "-p", "vehicle:=nosuch"]
    done = subprocess.run(words, env=environ, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2 and "'nosuch'" in done.stderr and "Traceback" not in done.stderr


def teardown_module():
    """Leave the wire."""
    rclpy.try_shutdown()
