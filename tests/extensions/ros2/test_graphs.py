"""Nodes of each graph and their parameters agree with the page."""

import importlib.util
import re
from pathlib import Path

import pytest
import yaml

from finssim.control import ControlError
from finssim.extensions.ros2 import Ros2Error
from finssim.extensions.ros2.up import (
    COMMON_PARAMETERS,
    GRAPHS,
    NODE_PARAMETERS,
    NODES,
    Options,
    VehicleNames,
    plan_of,
    topics_of,
)
from finssim.robot.goals import GoalError

PAGE = (Path(__file__).resolve().parents[3] / "docs" / "reference" / "ros2_nodes.md").read_text()
FILE = Path("/somewhere/pool.yaml")


def source(node):
    """Return the source of a node's module."""
    return Path(importlib.util.find_spec(NODES[node].partition(":")[0]).origin).read_text()


@pytest.mark.parametrize("node", NODES)
def test_each_node_is_a_class_and_stands_on_the_page(node):
    """The page lists every parameter that the node declares."""
    assert f"\nclass {NODES[node].partition(':')[2]}(RobotNode):" in source(node)
    (row,) = re.findall(rf"^\| {node} \| .*$", PAGE, flags=re.MULTILINE)
    declared = set(re.findall(r'self\.parameter\("(\w+)"', source(node)))
    assert declared == set(re.findall(r"`(\w+)`", row.rsplit(" | ", 1)[1])), row


def test_graphs_are_made_of_nodes():
    """The pool's graph is the robot's with a virtual pool."""
    assert {node for nodes in GRAPHS.values() for node in nodes} <= set(NODES)
    assert GRAPHS["pool"] == ("virtual_pool", *GRAPHS["robot"])


AUTOPILOT = {"firmware": "ardusub", "vehicle": "bluerov2_heavy", "port": 6000}


def told(graph, tmp_path, **choices):
    """Return the parameters of the nodes' file: node -> parameters; ** for parameters that all share."""
    plan = plan_of(graph, Options.of(choices), FILE)
    plan.write(tmp_path / "p.yaml")
    tree = yaml.safe_load((tmp_path / "p.yaml").read_text())
    found = {key.rsplit("/", 1)[-1]: value["ros__parameters"] for key, value in tree.items()}
    robots = [found[node] for node in found if node not in ("sim", "virtual_pool")]
    alike = set.intersection(*(set(parameters) for parameters in robots))
    return {"**": {name: robots[0][name] for name in alike & set(COMMON_PARAMETERS.split())}, **found}


@pytest.mark.parametrize(
    ("graph", "choices", "node", "parameters"),
    [
        ("sim", {}, "**", {"vehicle": "finsrov", "use_sim_time": True}),
        ("sim", {"start": "0,0,-1,0"}, "sim", {"start": "0,0,-1,0", "seed": 1}),
        ("sim", {"hydrodynamics": "mesh", "seed": 4}, "sim", {"hydrodynamics": "mesh", "seed": 4}),
        ("sim", {"policy": "pid-paper"}, "controller", {"policy": "pid-paper"}),
        ("sim", {"goal": "0,0,-0.5,0"}, "controller", {"goal": "0,0,-0.5,0"}),
        ("sim", {"trajectory": "helix", "task": "t2"}, "controller", {"trajectory": "helix", "task": "t2"}),
        ("pool", {}, "virtual_pool", {"plant": "1", "severity": "realistic", "camera": "pictures"}),
        ("pool", {"severity": "hard", "camera": "corners"}, "virtual_pool", {"severity": "hard"}),
        ("pool", {"plant": "7", "truth": Path("t.fst")}, "virtual_pool", {"plant": "7", "truth": "t.fst"}),
        ("pool", {"port": 6000}, "**", {"robot": "udp://127.0.0.1:6000"}),
        ("pool", {"port": 6000}, "camera", {"pictures": "udp://127.0.0.1:6001", "pool_file": str(FILE)}),
        ("pool", {"bind": "127.0.0.1:7000"}, "camera", {"pictures_bind": "127.0.0.1:7001"}),
        ("pool", {"bind": "127.0.0.1:7000"}, "virtual_pool", {"bind": "127.0.0.1:7000"}),
        ("pool", {"teleop": "joy"}, "hardware_bridge", {"need_reading": False}),
        ("pool", {"teleop": "joy"}, "teleop", {"device": "joy", "other": "pid"}),
        ("pool", {"record": Path("r.mcap")}, "recorder", {"record": "r.mcap", "pool_file": str(FILE)}),
        (
            "robot",
            {"robot": "serial:/dev/x", "pool_file": FILE},
            "**",
            {"robot": "serial:/dev/x"},
        ),
        ("robot", {"site": "open-water"}, "state_estimation", {"pool_file": "none"}),
        ("robot", {"site": "open-water"}, "**", {"vehicle": "finsrov", "site": "open-water"}),
        ("pool", {"let_in": "1,-2"}, "state_estimation", {"let_in": "1,-2", "mode": "error-state"}),
        ("pool", {"site": "tank"}, "virtual_pool", {"camera": "corners"}),
        ("pool", {"namespace": "robot_1"}, "**", {"frame_prefix": "robot_1/"}),
        ("pool", {"site": "open-water", "positioning": "usbl"}, "virtual_pool", {"camera": "none"}),
        ("pool", AUTOPILOT, "virtual_pool", {"firmware": "ardusub", "camera": "none", "port": 6000}),
        ("pool", AUTOPILOT, "**", {"robot": "mavlink://udpout:127.0.0.1:6000?dvl=127.0.0.1:6002"}),
        ("robot", {"robot": "serial:/dev/x", "pool_file": FILE}, "camera", {"pictures": "none"}),
        ("robot", {"pictures": "udp://a:1", "pool_file": FILE}, "camera", {"pictures": "udp://a:1"}),
    ],
)
def test_choices_reach_their_node(tmp_path, graph, choices, node, parameters):
    """Each option becomes a parameter of the node that uses it."""
    found = told(graph, tmp_path, **choices)
    assert parameters.items() <= found[node].items()


def test_extra_nodes_are_started_where_asked_for():
    """Extra nodes are the recorder and teleoperation."""

    def nodes(graph, **choices):
        return tuple(one.node for one in plan_of(graph, Options.of(choices), FILE).nodes)

    assert nodes("sim") == GRAPHS["sim"]
    assert nodes("robot", site="open-water") == ("hardware_bridge", "state_estimation", "controller")
    assert nodes("sim", record=Path("r.mcap"), teleop="joy") == (*GRAPHS["sim"], "recorder", "teleop")


def test_each_vehicle_of_a_team_has_its_own_names_ports_and_share():
    """Vehicles share one world; namespaces, frames, tag ids, ports ten apart, goals and records are per
    vehicle."""
    goals = "0,0,-1,0; 2,0,-1,0; 4,0,-1,0"
    choices = {"team": "finsrov,finsrov,lauv", "site": "open-water", "goal": goals, "record": Path("r")}
    plan = plan_of("pool", Options.of({**choices, "lockstep": True}), FILE)
    assert plan.namespaces == ("robot_1", "robot_2", "robot_3")
    found = {one.full_name: one.parameters for one in plan.nodes}
    assert [name for name in found if "virtual_pool" in name] == ["/team/virtual_pool"]
    assert found["/team/virtual_pool"]["team"] == "finsrov,finsrov,lauv"
    waited = found["/team/virtual_pool"]["waits_for"].split()
    assert set(waited) == found.keys() - {"/team/virtual_pool"} and len(waited) == 12
    third = {node: found[f"/robot_3/{node}"] for node in ("hardware_bridge", "controller", "recorder")}
    wire = {"bind": "127.0.0.1:54341", "robot": "udp://127.0.0.1:58786"}
    assert {**wire, "number": 2, "frame_prefix": "robot_3/"}.items() <= third["hardware_bridge"].items()
    assert {"goal": "4,0,-1,0", "vehicle": "lauv"}.items() <= third["controller"].items()
    assert third["recorder"]["record"] == str(Path("r/robot_3.mcap"))


@pytest.mark.parametrize("graph", GRAPHS)
def test_time_of_a_graph_is_that_of_its_world(graph):
    """In lock-step and with a factor, all nodes but the world use /clock; otherwise only those of a simulator
    do."""

    def lives(**choices):
        file = {} if graph != "robot" else {"pool_file": FILE}
        nodes = plan_of(graph, Options.of({**file, **choices}), FILE).nodes
        return {
            bool(one.parameters.get("use_sim_time"))
            for one in nodes
            if one.node not in ("sim", "virtual_pool")
        }

    assert lives() == {graph == "sim"}
    assert lives(lockstep=True) == lives(real_time_factor=0.5) == {True}


def test_every_option_of_a_node_is_a_parameter_of_it():
    """The parameter is declared by the option's name in the node's source or in that of every node."""
    for node, names in NODE_PARAMETERS.items():
        assert not [name for name in names.split() if f'self.parameter("{name}"' not in source(node)]
    common = Path(importlib.util.find_spec("finssim.extensions.ros2.nodes.robot_node").origin).read_text()
    names = set(COMMON_PARAMETERS.split()) - {"use_sim_time", "frame_prefix"}
    assert not [name for name in names if f'self.parameter("{name}"' not in common]


@pytest.mark.parametrize(
    ("graph", "choices", "error", "words"),
    [
        ("pond", {}, Ros2Error, "unknown graph 'pond'; available: sim, robot, pool"),
        ("robot", {}, Ros2Error, "give --pool-file"),
        ("pool", {"bind": "here"}, Ros2Error, "ADDRESS:PORT"),
        ("robot", {"site": "open-water", "let_in": "here"}, GoalError, "two numbers x,y"),
        ("sim", {"goal": "9,9,-9,0"}, GoalError, "outside the workspace"),
        ("sim", {"goal": "0,0,-0.5,0", "trajectory": "helix"}, GoalError, "both are given"),
        ("sim", {"plant": "3"}, Ros2Error, "--plant has no effect in the graph sim"),
        ("robot", {"pool_file": FILE, "positioning": "usbl"}, Ros2Error, "--positioning has no effect"),
        ("pool", {"message_loss": 0.5}, Ros2Error, "for the messages of a team: give --team"),
        ("pool", {"team": "lauv,lauv", "vehicle": "lauv"}, Ros2Error, "leave --vehicle out"),
        ("robot", {"robot": "serial:/dev/x", "pool_file": FILE, "lockstep": True}, Ros2Error, "real time"),
        (
            "pool",
            {"real_time_factor": 0.0},
            Ros2Error,
            "--real-time-factor 0: expected more than 0, or --lockstep",
        ),
        ("sim", {"team": "finsrov,finsrov"}, Ros2Error, "--team is for the graph pool"),
        ("sim", {"firmware": "ardusub"}, Ros2Error, "--firmware has no effect in the graph sim"),
        ("pool", {"firmware": "ardusub"}, ControlError, "autopilot"),
        ("pool", {**AUTOPILOT, "camera": "corners"}, Ros2Error, "--firmware ardusub has no camera"),
        (
            "pool",
            {"team": "finsrov,finsrov", "goal": "0,0,-1,0"},
            Ros2Error,
            "expected 2 separated by semicolons",
        ),
    ],
)
def test_what_cannot_be_started_is_refused_in_a_sentence(graph, choices, error, words):
    """The refusal comes before any process starts."""
    with pytest.raises(error, match=re.escape(words)):
        plan_of(graph, Options.of(choices), FILE)


def test_topics_are_those_of_the_nodes():
    """Full names are listed; a simulator has no camera."""
    names = {
        name for name, _ in topics_of(plan_of("sim", Options(names=VehicleNames(namespace="rov")), None))
    }
    assert {"/rov/odom", "/clock", "/rov/arm", "/rov/thruster_cmd"} <= names
    assert "/rov/camera/image" not in names and "/rov/telemetry" not in names


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["node", "kamera"], "unknown node 'kamera'; available: camera, controller"),
        (["up", "pond"], "unknown graph 'pond'"),
        (["up", "robot"], "give --pool-file"),
        (["up", "sim", "--vehicle", "finrov"], "did you mean 'finsrov'"),
        (["up", "sim", "--goal", "here"], "expected four numbers"),
    ],
)
def test_the_command_refuses_in_a_sentence(capsys, words, sentence):
    """The status is 2, and nothing is started."""
    from finssim.cli import boundary
    from finssim.cli.commands import app

    assert boundary.run(app, ["ros2", *words]) == 2
    assert sentence in capsys.readouterr().err
