"""Command lines, parameter files and names are read as in ROS 2."""

import math
import re

import pytest

from finssim.extensions.ros2.shim.arguments import (
    Remap,
    expanded,
    overrides_for,
    parse_arguments,
    parsed_value,
    read_parameters,
    remapped,
)
from finssim.extensions.ros2.shim.exceptions import InvalidTopicNameException, RosArgumentsError

FILE = """
/**:
  ros__parameters: {gain: 1.0, limits: {low: -1.5, high: 2}}
/rov/controller:
  ros__parameters: {gain: 3.0}
rov:
  camera:
    ros__parameters: {rate: 30}
/*/localizer:
  ros__parameters: {words: [a, b]}
"""


@pytest.fixture
def parameters(tmp_path):
    """Assignments of the parameter file above."""
    return read(tmp_path, FILE)


def read(tmp_path, *texts):
    """Return the parameters of files with these texts, one after the other."""
    overrides = {}
    for i, text in enumerate(texts):
        (tmp_path / f"{i}.yaml").write_text(text)
        read_parameters(tmp_path / f"{i}.yaml", overrides)
    return overrides


@pytest.mark.parametrize(
    ("node", "values"),
    [
        ("/rov/controller", {"gain": 3.0, "limits.low": -1.5, "limits.high": 2}),
        ("/rov/camera", {"gain": 1.0, "limits.low": -1.5, "limits.high": 2, "rate": 30}),
        ("/rov/localizer", {"gain": 1.0, "limits.low": -1.5, "limits.high": 2, "words": ["a", "b"]}),
        ("/a/b/localizer", {"gain": 1.0, "limits.low": -1.5, "limits.high": 2}),
        ("/controller", {"gain": 1.0, "limits.low": -1.5, "limits.high": 2}),
    ],
)
def test_files_reach_the_nodes_they_name(parameters, node, values):
    """** matches any number of names, * one; a later match wins, and nested names are dotted."""
    assert overrides_for(node, parameters) == values


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("gain: 1.0", "gain: expected 'ros__parameters:'"),
        ("ros__parameters: {gain: 1.0}", "is below '', expected the name of a node"),
        ("/a b: {ros__parameters: {gain: 1.0}}", "is below '/a b'"),
        ("/**: {ros__parameters: {gain: }}", "gain: has no value"),
        ("/**: {ros__parameters: {gains: [1, 2.0]}}", "all of one type"),
        ("/**: {ros__parameters: {gains: [[1], [2]]}}", "plain values only"),
        ("/**: {ros__parameters: [1]}", "expected parameters and values"),
        ("/a: &x {ros__parameters: {gain: 1.0}}\n/b: *x", "no aliases"),
        ("/**: {ros__parameters: {", "while parsing"),
        (f"/**: {{ros__parameters: {'[' * 3000}", "line 1: nested more than 100 deep"),
    ],
)
def test_files_that_rcl_refuses_are_refused(tmp_path, text, words):
    """The error is one sentence with the file's name, and a RuntimeError like rclpy's."""
    with pytest.raises(RosArgumentsError, match=re.escape(words)) as refused:
        read(tmp_path, text)
    assert "0.yaml" in str(refused.value) and isinstance(refused.value, RuntimeError)


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(RosArgumentsError, match="No such file"):
        read_parameters(tmp_path / "none.yaml", {})


WILD, NAMED = "/**: {ros__parameters: {policy: a}}\n", "/**/controller: {ros__parameters: {policy: b}}\n"


@pytest.mark.parametrize(
    ("texts", "value"),
    [
        ((WILD + NAMED,), "b"),
        ((NAMED + WILD,), "a"),
        ((NAMED, WILD), "a"),
        ((WILD + NAMED, WILD.replace("policy: a", "policy: c")), "b"),
        ((WILD + NAMED, "/x/controller: {ros__parameters: {policy: d}}\n"), "d"),
        (("/x/controller: {ros__parameters: {policy: d}}\n", WILD), "a"),
    ],
)
def test_a_pattern_keeps_the_rank_of_its_first_mention(tmp_path, texts, value):
    """rcl merges files in this order, so a launch argument below /** lost against the package's own file."""
    assert overrides_for("/x/controller", read(tmp_path, *texts)) == {"policy": value}


def test_a_command_line_is_split_into_ros_and_the_rest():
    """All arguments between --ros-args and -- belong to ROS."""
    line = "prog --mine --ros-args -r a:=b -p n:gain:=2 --log-level debug -- --more".split()
    found = parse_arguments(line)
    assert found.rest == ["prog", "--mine", "--more"]
    assert found.remaps == [Remap("", "a", "b")]
    assert overrides_for("/n", found.parameters) == {"gain": 2}
    assert not overrides_for("/x/n", found.parameters), "a node without namespace, as in rcl"


@pytest.mark.parametrize(
    ("values", "taken"),
    [
        ("1.0 2.0", 2.0),
        ("1 2.0", 1),
        ("1.0 2", 2),
        ("a 1.0 b", 1.0),
        ("[a] [1,2]", [1, 2]),
        ("[1] 2.0", 2.0),
        ("1 []", 1),
    ],
)
def test_of_values_of_several_types_one_type_counts(values, taken):
    """rcl keeps one of each type, and rclpy takes bool before integer, float, word and lists."""
    line = [word for value in values.split() for word in ("-p", f"a:={value}")]
    assert overrides_for("/n", parse_arguments(["--ros-args", *line]).parameters) == {"a": taken}


@pytest.mark.parametrize(
    "line",
    [
        "-p gain",
        "-p gain:=",
        "-p gain:={a: 1}",
        "--nonsense 1",
        "-r",
        "-r __ns:=rov",
        "-r __node:=/rov",
        "--log-level x",
        "--log-level :=debug",
        "--params-file /nowhere.yaml",
    ],
)
def test_malformed_arguments_are_refused(line):
    """They are not ignored."""
    with pytest.raises(RosArgumentsError):
        parse_arguments(["--ros-args", *line.split(maxsplit=1)])


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1", 1),
        ("+7", 7),
        ("0x1F", 31),
        ("010", 8),
        ("08", 8.0),
        ("1_000", "1_000"),
        ("12:30", "12:30"),
        ("2026-11-23", "2026-11-23"),
        ("9223372036854775808", 9223372036854775808.0),
        ("1.0", 1.0),
        ("1e3", 1000.0),
        ("-.5", -0.5),
        ("inf", math.inf),
        ("-.inf", -math.inf),
        ("true", True),
        ("y", True),
        ("off", False),
        ("abc", "abc"),
        ("null", "null"),
        ("~", "~"),
        ("'1'", "1"),
        ("!!str 1", "1"),
        ("[1.0, 2.0]", [1.0, 2.0]),
        ("[a, b]", ["a", "b"]),
        ("[]", None),
    ],
)
def test_values_have_the_type_they_look_like(text, value):
    """Values are typed like those of rcl's get_value, which follows neither YAML 1.1 nor 1.2."""
    assert parsed_value(text) == value and type(parsed_value(text)) is type(value)


@pytest.mark.parametrize(
    ("short", "full"),
    [("odom", "/ns/odom"), ("/odom", "/odom"), ("~/odom", "/ns/me/odom"), ("a/b", "/ns/a/b")],
)
def test_short_names_stand_for_full_ones(short, full):
    """Names are relative, absolute or private."""
    assert expanded(short, "me", "/ns") == full


@pytest.mark.parametrize("bad", ["", "1a", "a b", "/a/", "a//b", "a__b", "{node}"])
def test_names_that_ros_refuses_are_refused(bad):
    """The refusal comes before the name reaches the wire."""
    with pytest.raises(InvalidTopicNameException):
        expanded(bad, "me", "/")


def test_the_first_fitting_rule_renames():
    """Rules are compared by full names, and may apply to one node only."""
    rules = [Remap("other", "odom", "/x"), Remap("", "odom", "/y"), Remap("", "/ns/odom", "/z")]
    assert remapped("odom", "me", "/ns", rules) == "/y"
    assert remapped("/ns/odom", "other", "/ns", rules) == "/x"
    assert remapped("imu", "me", "/ns", rules) == "/ns/imu"
