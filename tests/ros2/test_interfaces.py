"""Our message files are legal ROS 2, and the workspace builds from the very same ones."""

import ast
import subprocess
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
import yaml

from finssim.ros2.definitions import INTERFACES

MESSAGES = sorted(INTERFACES.glob("*/msg/*.msg"))
WORKSPACE = Path(__file__).resolve().parents[2] / "ros2_ws" / "src"
NODES = WORKSPACE / "finssim_ros"


def names(path):
    """Name and text of each message file in a folder."""
    return {file.name: file.read_text() for file in path.glob("*.msg")}


def test_the_workspace_holds_the_same_messages():
    """A changed message must be changed in both places: colcon and the wheel must agree on every byte."""
    assert names(WORKSPACE / "finssim_msgs/msg") == names(INTERFACES / "finssim_msgs/msg")


def test_cmake_builds_every_message():
    """A message left out of CMakeLists.txt would be missing in a real ROS 2."""
    text = (WORKSPACE / "finssim_msgs/CMakeLists.txt").read_text()
    assert {f"msg/{path.name}" for path in MESSAGES} == {
        w.strip('"') for w in text.split() if w.startswith('"msg/')
    }


@pytest.mark.parametrize("path", MESSAGES, ids=lambda path: path.stem)
def test_messages_begin_with_a_header_and_hold_no_char(path):
    """`char` hashes differently between implementations, and everything we send has a time."""
    lines = [line.split("#")[0].split() for line in path.read_text().splitlines()]
    fields = [words for words in lines if len(words) == 2 and "=" not in words[1]]
    assert fields[0] == ["std_msgs/Header", "header"]
    assert not any(kind.startswith("char") for kind, _ in fields)


def has_rosidl():
    """Whether the system's Python has ROS 2's own parser."""
    try:
        probe = subprocess.run(["/usr/bin/python3", "-c", "import rosidl_adapter.msg"], capture_output=True)
    except OSError:
        return False
    return probe.returncode == 0


@pytest.mark.slow
@pytest.mark.skipif(not has_rosidl(), reason="needs apt-get install python3-rosidl python3-lark python3-empy")
def test_the_official_parser_takes_every_message(tmp_path):
    """rosidl_adapter turns each into IDL."""
    script = (
        "import sys, pathlib; from rosidl_adapter.msg import convert_msg_to_idl\n"
        "root, out = map(pathlib.Path, sys.argv[1:])\n"
        "for f in sorted(root.glob('msg/*.msg')): convert_msg_to_idl(root, root.name, f.relative_to(root), out)"
    )
    command = ["/usr/bin/python3", "-c", script, str(INTERFACES / "finssim_msgs"), str(tmp_path)]
    subprocess.run(command, check=True, capture_output=True)
    assert {p.stem for p in tmp_path.glob("*.idl")} == {p.stem for p in MESSAGES}


@pytest.mark.parametrize("package", ["finssim_msgs", "finssim_ros"])
def test_packages_are_named_as_their_folders(package):
    """colcon goes by package.xml."""
    root = ElementTree.parse(WORKSPACE / package / "package.xml").getroot()
    assert root.findtext("name") == package and root.get("format") == "3"
    build = root.findtext("export/build_type")
    assert build == ("ament_cmake" if package == "finssim_msgs" else "ament_python")


def test_messages_depend_on_every_package_they_use():
    """A package left out of package.xml builds only by luck."""
    root = ElementTree.parse(WORKSPACE / "finssim_msgs/package.xml").getroot()
    used = {
        w.split("/")[0] for p in MESSAGES for w in p.read_text().split() if w.count("/") == 1 and "_" in w
    }
    assert {e.text for e in root.findall("depend")} == {
        u for u in used if u.endswith(("_msgs", "_interfaces"))
    }


@pytest.mark.parametrize("path", sorted(NODES.rglob("*.py")), ids=lambda path: path.name)
def test_python_of_the_workspace_compiles_on_humble(path):
    """Python 3.10 reads every file."""
    ast.parse(path.read_text(), feature_version=(3, 10))


def started_by(launch):
    """Executables that a launch file names."""
    tree = ast.parse(launch.read_text())
    words = {k.value.value for k in ast.walk(tree) if isinstance(k, ast.keyword) and k.arg == "executable"
             and isinstance(k.value, ast.Constant)}  # fmt: skip
    calls = [c for c in ast.walk(tree) if isinstance(c, ast.Call) and getattr(c.func, "id", "") == "node"]
    return words | {c.args[0].value for c in calls}


def entry_points():
    """Names that setup.py installs and functions that they call."""
    tree = ast.parse((NODES / "setup.py").read_text())
    nodes = next(n for n in tree.body if isinstance(n, ast.Assign) and n.targets[0].id == "NODES")
    return {element.value for element in nodes.value.elts}


def test_launch_files_start_what_is_installed():
    """Every executable of every launch file has an entry point and a function."""
    launches = sorted(NODES.glob("launch/*.launch.py"))
    assert [p.name for p in launches] == ["pool.launch.py", "robot.launch.py", "sim.launch.py"]
    functions = {f.name for f in ast.parse((NODES / "finssim_ros/run.py").read_text()).body
                 if isinstance(f, ast.FunctionDef)}  # fmt: skip
    assert set().union(*(started_by(p) for p in launches)) | functions - {"_run"} == entry_points()


@pytest.mark.parametrize("name", ["sim", "pool", "robot"])
def test_parameter_files_are_read_as_ros_reads_them(name):
    """Each is a parameter file, and its values reach nodes in any namespace."""
    from finssim.ros2.shim.parameter_files import overrides_for, read_parameters

    path = NODES / "config" / f"{name}.yaml"
    assert all("ros__parameters" in below for below in yaml.safe_load(path.read_text()).values())
    node = {"sim": "sim", "pool": "virtual_pool", "robot": "controller"}[name]
    assert overrides_for(f"/finsrov/{node}", read_parameters(path))["vehicle"] == "finsrov"
