"""FinsSim's message files are valid in ROS 2, and the workspace builds from identical files."""

import ast
import contextlib
import importlib
import inspect
import re
import runpy
import subprocess
import sys
import types
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
import yaml

from finssim.extensions.ros2 import Ros2Error
from finssim.extensions.ros2.backend import activate
from finssim.extensions.ros2.codec import INTERFACES
from finssim.extensions.ros2.shim.arguments import overrides_for, parse_arguments
from finssim.extensions.ros2.topics import OWN_TOPICS, SERVICES, TOPICS
from finssim.extensions.ros2.up import NODES as GRAPH_NODES
from finssim.extensions.ros2.up import Options, each_option, plan_of
from finssim.extensions.ros2.up import launched as graph_launched
from finssim.robot.wiring import POOL_ADDRESS
from finssim.vehicles.loader import catalogue

MESSAGES = sorted(INTERFACES.glob("finssim_msgs/msg/*.msg"))
"""FinsSim's messages; those of sonars are marine_msgs', which a ROS 2 installation provides itself."""
WORKSPACE = Path(__file__).resolve().parents[3] / "ros2_ws" / "src"
NODES = WORKSPACE / "finssim_ros"


def names(path):
    """Return name and text of each message file in a folder."""
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
    """`char` hashes differently between implementations, and every published message has a time."""
    lines = [line.split("#")[0].split() for line in path.read_text().splitlines()]
    fields = [words for words in lines if len(words) == 2 and "=" not in words[1]]
    assert fields[0] == ["std_msgs/Header", "header"]
    assert not any(kind.startswith("char") for kind, _ in fields)


def has_rosidl():
    """Return whether the system's Python has ROS 2's own parser."""
    try:
        probe = subprocess.run(["/usr/bin/python3", "-c", "import rosidl_adapter.msg"], capture_output=True)
    except OSError:
        return False
    return probe.returncode == 0


@pytest.mark.slow
@pytest.mark.skipif(not has_rosidl(), reason="needs apt-get install python3-rosidl python3-lark python3-empy")
def test_the_official_parser_takes_every_message(tmp_path):
    """rosidl_adapter converts each message into IDL."""
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
    """colcon uses the name in package.xml."""
    root = ElementTree.parse(WORKSPACE / package / "package.xml").getroot()
    assert root.findtext("name") == package and root.get("format") == "3"
    build = root.findtext("export/build_type")
    assert build == ("ament_cmake" if package == "finssim_msgs" else "ament_python")


def test_messages_depend_on_every_package_they_use():
    """A package left out of package.xml builds only by chance."""
    root = ElementTree.parse(WORKSPACE / "finssim_msgs/package.xml").getroot()
    used = {
        w.split("/")[0] for p in MESSAGES for w in p.read_text().split() if w.count("/") == 1 and "_" in w
    }
    assert {e.text for e in root.findall("depend")} == {
        u for u in used if u.endswith(("_msgs", "_interfaces"))
    }


def test_nodes_depend_on_every_package_whose_types_they_use():
    """These are topics, services and imports of nodes, launch files and examples; nothing else but the
    environment."""
    root = ElementTree.parse(NODES / "package.xml").getroot()
    own = [topic for topics in OWN_TOPICS.values() for topic in topics.values()]
    used = {kind.type.split("/")[0] for kind in (*TOPICS.values(), *SERVICES.values(), *own)}
    ours = (INTERFACES.parents[1] / "extensions" / "ros2").glob("[nw]o*/*.py")
    for file in (*ours, *NODES.rglob("*/*.py"), *(WORKSPACE.parents[1] / "examples" / "ros2").glob("*.py")):
        for node in ast.walk(ast.parse(file.read_text())):
            named = (
                [n.name for n in node.names]
                if isinstance(node, ast.Import)
                else [getattr(node, "module", "")]
            )
            used |= {name.partition(".")[0] for name in named if name}
    used -= {*sys.stdlib_module_names, "finssim", "finssim_ros"}
    keys = {{"numpy": "python3-numpy", "yaml": "python3-yaml"}.get(name, name) for name in used}
    assert keys | {"python3-venv"} == {e.text for e in root.findall("exec_depend")}


@pytest.mark.parametrize("path", sorted(NODES.rglob("*.py")), ids=lambda path: path.name)
def test_python_of_the_workspace_compiles_on_humble(path):
    """Python 3.10 reads every file."""
    ast.parse(path.read_text(), feature_version=(3, 10))


def entry_points():
    """Return the names that setup.py installs."""
    tree = ast.parse((NODES / "setup.py").read_text())
    nodes = next(n for n in tree.body if isinstance(n, ast.Assign) and n.targets[0].id == "NODES")
    return {element.value for element in nodes.value.elts}


@pytest.fixture
def launched(monkeypatch, tmp_path):
    """Function that runs a launch file with arguments and returns executable -> command line, as launch_ros makes it.

    launch and launch_ros are not on PyPI. Their replacement here treats names and parameters like
    launch_ros/actions/node.py: a dictionary becomes a file, below the node's full name if name and namespace are given.
    """

    names = []

    def node(**told):
        names.append(f"/{told['namespace']}/{told['name']}")
        named = {"name", "namespace"} <= told.keys()
        full = f"/{told['namespace'].strip('/')}/{told['name']}" if named else "/**"
        line = ["--ros-args", "-r", f"__node:={told['name']}", "-r", f"__ns:=/{told['namespace'].strip('/')}"]
        for i, given in enumerate(told["parameters"]):
            if isinstance(given, dict):
                path = tmp_path / f"{told['executable']}{i}.yaml"
                path.write_text(yaml.dump({full: {"ros__parameters": given}}))
                given = str(path)
            line += ["--params-file", given]
        return told["executable"], line

    parts = {
        "launch": {"LaunchDescription": list},
        "launch.actions": {
            "DeclareLaunchArgument": lambda name, default_value, description: (name, default_value),
            "OpaqueFunction": lambda function: function,
        },
        "launch_ros": {},
        "launch_ros.actions": {"Node": node},
        "launch_ros.parameter_descriptions": {"ParameterValue": lambda value, value_type: value_type(value)},
    }
    for name, contents in parts.items():
        module = types.ModuleType(name)
        module.__dict__.update(contents)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.syspath_prepend(str(NODES))
    for name in ("finssim_ros", "finssim_ros.launching"):
        monkeypatch.delitem(sys.modules, name, raising=False)

    def start(graph, **given):
        *declared, function = runpy.run_path(str(NODES / f"launch/{graph}.launch.py"))[
            "generate_launch_description"
        ]()
        values = dict(declared)
        assert set(given) <= set(values), f"{graph}.launch.py does not declare {set(given) - set(values)}"
        return dict(function(types.SimpleNamespace(launch_configurations={**values, **given})))

    start.named = names

    return start


def parameters_of(lines, node, namespace="finsrov"):
    """Return the parameters that a node reads from its command line."""
    return overrides_for(f"/{namespace}/{node}", parse_arguments(lines[node]).parameters)


@pytest.mark.parametrize(
    ("graph", "given", "node", "parameters"),
    [
        ("robot", {"robot": "udp://1.2.3.4:5"}, "hardware_bridge", {"robot": "udp://1.2.3.4:5"}),
        ("robot", {"record": "a.mcap"}, "recorder", {"record": "a.mcap"}),
        ("robot", {"policy": "pid-paper"}, "controller", {"policy": "pid-paper"}),
        ("robot", {"policy": "runs/hold", "teleop": "joy"}, "teleop", {"other": "policy", "device": "joy"}),
        ("robot", {"teleop": "gamepad"}, "hardware_bridge", {"need_reading": False}),
        ("robot", {"bind": "10.0.0.1:6000"}, "hardware_bridge", {"bind": "10.0.0.1:6000"}),
        ("robot", {"bind": "10.0.0.1:6000"}, "camera", {"pictures_bind": "10.0.0.1:6001"}),
        ("robot", {"robot": "udp://a:1", "pictures": "udp://b:2"}, "camera", {"pictures": "udp://b:2"}),
        ("robot", {"let_in": "1,2"}, "state_estimation", {"let_in": "1,2", "mode": "error-state"}),
        ("robot", {"goal": "0,0,-0.5,0"}, "controller", {"goal": "0,0,-0.5,0"}),
        ("robot", {"namespace": "robot_1"}, "camera", {"frame_prefix": "robot_1/"}),
        ("robot", {"namespace": "robot_1", "frame_prefix": "a/"}, "camera", {"frame_prefix": "a/"}),
        ("pool", {"positioning": "usbl", "site": "open-water"}, "virtual_pool", {"positioning": "usbl"}),
        ("pool", {"port": "6000", "seed": "4"}, "virtual_pool", {"port": 6000, "seed": 4}),
        ("pool", {"lockstep": "true"}, "virtual_pool", {"lockstep": True, "real_time_factor": 0.0}),
        ("pool", {"lockstep": "True"}, "controller", {"lockstep": True, "use_sim_time": True}),
        ("sim", {"real_time_factor": "0.5"}, "sim", {"real_time_factor": 0.5}),
        ("sim", {"start": "0,0,-1,0"}, "sim", {"start": "0,0,-1,0"}),
        ("robot", {"pool_file": "1.yaml"}, "localizer", {"pool_file": "1.yaml"}),
        ("robot", {"vehicle": "warpauv"}, "camera", {"vehicle": "warpauv"}),
        ("sim", {"policy": "pid-paper"}, "controller", {"policy": "pid-paper", "use_sim_time": True}),
        ("sim", {"vehicle": "bluerov2_heavy"}, "sim", {"vehicle": "bluerov2_heavy"}),
        ("pool", {"plant": "7"}, "virtual_pool", {"plant": "7"}),
    ],
)
def test_launch_arguments_win_over_parameter_files(launched, tmp_path, graph, given, node, parameters):
    """Files that begin with /** lose against launch arguments, and win over their defaults."""
    file = tmp_path / "own.yaml"
    file.write_text("/**:\n  ros__parameters: {policy: a, robot: b, goal: c, port: 1, seed: 9, rate: 30.0}\n")
    given = {**given, "params_file": str(file)}
    namespace = given.get("namespace") or given.get("vehicle", "finsrov")
    found = parameters_of(launched(graph, **given), node, namespace)
    assert {**parameters, "rate": 30.0}.items() <= found.items()


def defaults_of(node):
    """Return parameter -> default of a node, as declared in its source and in that of every node."""
    module = importlib.import_module(GRAPH_NODES[node].partition(":")[0])
    found = {}
    for part in (importlib.import_module("finssim.extensions.ros2.nodes.robot_node"), module):
        for call in ast.walk(ast.parse(inspect.getsource(part))):
            if (
                isinstance(call, ast.Call)
                and ast.unparse(call.func) == "self.parameter"
                and len(call.args) == 2
            ):
                name, default = call.args
                with contextlib.suppress(NameError):  # a default that depends on the vehicle
                    found[ast.literal_eval(name)] = eval(ast.unparse(default), vars(part))
    return found


EQUAL = [
    ("sim", {}),
    ("sim", {"vehicle": "bluerov2_heavy", "policy": "pid-paper", "goal": "0.5,0,-0.7,45", "seed": "3"}),
    ("sim", {"namespace": "robot_1", "hydrodynamics": "mesh", "record": "a.mcap", "teleop": "joy"}),
    ("robot", {"site": "open-water", "pool_file": "none", "camera": "none", "record": "x.mcap"}),
    ("robot", {"pool_file": "none", "robot": "udp://192.168.0.2:58766", "bind": "192.168.0.10:54321"}),
    ("robot", {"pool_file": "/a/pool.yaml", "robot": "serial:/dev/x", "pictures": "udp://b:2"}),
    ("robot", {"site": "open-water", "let_in": "1,-2", "trajectory": "helix", "teleop": "gamepad"}),
    (
        "pool",
        {"pool_file": "/a/pool.yaml", "lockstep": "true", "record": "x.mcap", "real_time_factor": "2.0"},
    ),
    ("sim", {"lockstep": "true"}),
    ("pool", {"pool_file": "/a/pool.yaml"}),
    ("pool", {"pool_file": "/a/pool.yaml", "site": "tank", "plant": "7", "severity": "hard", "port": "6000"}),
    ("pool", {"site": "open-water", "positioning": "usbl", "world": "dock", "start": "0,1,-3,0"}),
]


@pytest.mark.parametrize(("graph", "given"), EQUAL)
def test_launch_files_start_what_up_starts(launched, graph, given):
    """The namespace, the nodes and each parameter are the same."""
    pytest.importorskip("cyclonedds")
    activate(announce=False)
    convert = {"seed": int, "port": int, "real_time_factor": float, "record": Path, "lockstep": bool}
    typed = {name: convert.get(name, str)(text) for name, text in given.items()}
    plan = plan_of(graph, Options.of(typed), given.get("pool_file", "pool.yaml"))
    lines = launched(graph, **given)
    assert launched.named == [one.full_name for one in plan.nodes]
    for one in plan.nodes:
        wanted = {**defaults_of(one.node), **one.parameters}
        found = {**defaults_of(one.node), **parameters_of(lines, one.node, one.namespace)}
        for values in (wanted, found):
            values["robot"] = POOL_ADDRESS if values["robot"] == "pool" else values["robot"]
            values.pop("pool_since")
        assert found == wanted, one.node


def test_one_launch_file_starts_a_team(launched):
    """It starts one world, and the nodes of each vehicle in its namespace."""
    plan = graph_launched(
        "pool",
        {"team": "finsrov,finsrov,finsrov", "site": "open-water", "message_loss": "0.2", "record": "runs"},
    )
    bridges = [one.parameters for one in plan.nodes if one.node == "hardware_bridge"]
    assert [p.get("bind") for p in bridges] == [None, "127.0.0.1:54331", "127.0.0.1:54341"]
    assert [p.get("robot") for p in bridges] == [None, "udp://127.0.0.1:58776", "udp://127.0.0.1:58786"]
    launched("pool", team="finsrov,finsrov,finsrov", site="open-water", message_loss="0.2", record="runs")
    robot = ("hardware_bridge", "state_estimation", "controller", "recorder")
    wanted = {f"/robot_{i}/{node}" for i in (1, 2, 3) for node in robot}
    assert set(launched.named) == wanted | {"/team/virtual_pool"}


def test_every_launch_file_takes_the_options_of_up(launched):
    """Exceptions are arming, which needs a message, and the duration."""
    for graph in ("sim", "robot", "pool"):
        *declared, _ = runpy.run_path(str(NODES / f"launch/{graph}.launch.py"))[
            "generate_launch_description"
        ]()
        options = {option.name for _, option in each_option()} - {"arm", "duration"}
        assert {name for name, _ in declared} == options | {"params_file"}


def test_a_number_that_is_none_is_refused(launched):
    """The refusal comes at launch, before any process starts."""
    for given, sentence in (
        ({"seed": "x"}, "seed:=x: expected an integer"),
        ({"lockstep": "1"}, "lockstep:=1: expected true or false"),
    ):
        with pytest.raises(Ros2Error, match=sentence):
            launched("sim", **given)


def test_a_recorder_is_started_where_a_parameter_file_names_its_file(launched, tmp_path):
    """Launch files have always done so; without such a parameter only record:= starts one."""
    path = tmp_path / "own.yaml"
    path.write_text("/**/recorder:\n  ros__parameters: {record: a.mcap}\n")
    lines = launched("robot", params_file=str(path))
    assert parameters_of(lines, "recorder") == {"record": "a.mcap"}
    assert "recorder" not in launched("robot")


def test_a_parameter_file_of_ones_own_keeps_what_launch_does_not_say(launched, tmp_path):
    """Defaults of a launch file do not override it."""
    path = tmp_path / "own.yaml"
    path.write_text("/**:\n  ros__parameters: {vehicle: lauv, policy: runs/a, rate: 30.0}\n")
    lines = launched("robot", params_file=str(path), namespace="deep/blue")
    assert parameters_of(lines, "controller", "deep/blue") == {
        "vehicle": "lauv",
        "policy": "runs/a",
        "rate": 30.0,
        "frame_prefix": "deep/blue/",
    }
    lines = launched("robot", params_file=str(path), policy="pid")
    assert parameters_of(lines, "controller")["policy"] == "pid"


def test_launch_files_start_what_is_installed(launched):
    """Every executable has an entry point, and every node is an executable."""
    started = [set(launched(graph)) for graph in ("sim", "pool", "robot")] + [
        set(launched("robot", teleop="joy", record="a.mcap"))
    ]
    assert set(launched("robot", camera="none")) == {"hardware_bridge", "state_estimation", "controller"}
    assert set().union(*started) == entry_points() == set(GRAPH_NODES)
    run = runpy.run_path(str(NODES / "finssim_ros/run.py"))
    with pytest.raises(AttributeError, match="available: camera"):
        run["__getattr__"]("kamera")


def test_vehicles_that_pages_and_launch_files_name_exist():
    """Vehicles after `vehicle:=` and `--vehicle` exist."""
    pages = WORKSPACE.parents[1] / "docs"
    files = [*NODES.rglob("*.py"), pages / "ros2.md", pages / "reference" / "ros2_installation.md"]
    named = {m for file in files for m in re.findall(r"(?:vehicle:=|--vehicle )([\w-]+)", file.read_text())}
    assert {"finsrov", "bluerov2_heavy"} <= named <= set(catalogue())
