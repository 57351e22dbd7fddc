"""Command lines, parameter files and names are read as ROS 2 reads them."""

import pytest

from finssim.ros2.errors import Ros2Error
from finssim.ros2.shim.arguments import parse_arguments, parsed_value
from finssim.ros2.shim.exceptions import InvalidTopicNameException
from finssim.ros2.shim.names import Remap, expanded, remapped
from finssim.ros2.shim.parameter_files import overrides_for, read_parameters

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
    """Assignments of the file above."""
    path = tmp_path / "p.yaml"
    path.write_text(FILE)
    return read_parameters(path)


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
    """** is any number of names, * one, a later match wins, nested names are dotted."""
    assert overrides_for(node, parameters) == values


def test_a_file_without_values_says_where(tmp_path):
    """Not laid out as a parameter file."""
    path = tmp_path / "p.yaml"
    path.write_text("gain: 1.0\n")
    with pytest.raises(Ros2Error, match="ros__parameters"):
        read_parameters(path)


def test_a_command_line_is_split_into_ros_and_the_rest():
    """Everything between --ros-args and -- is for ROS."""
    line = "prog --mine --ros-args -r a:=b -p n:gain:=2 --log-level debug -- --more".split()
    found = parse_arguments(line)
    assert found.rest == ["prog", "--mine", "--more"]
    assert found.remaps == [Remap("", "a", "b")]
    assert overrides_for("/x/n", found.parameters) == {"gain": 2} and not overrides_for(
        "/x/m", found.parameters
    )


@pytest.mark.parametrize(
    "line", ["--ros-args -p gain", "--ros-args --nonsense 1", "--ros-args -r", "--ros-args --log-level x"]
)
def test_malformed_arguments_are_refused(line):
    """Instead of being left out."""
    with pytest.raises(Ros2Error):
        parse_arguments(line.split())


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1", 1),
        ("1.0", 1.0),
        ("1e-3", 1e-3),
        ("true", True),
        ("abc", "abc"),
        ("'1'", "1"),
        ("[1.0, 2.0]", [1.0, 2.0]),
    ],
)
def test_values_have_the_type_they_look_like(text, value):
    """As rcl reads them."""
    assert parsed_value(text) == value and type(parsed_value(text)) is type(value)


@pytest.mark.parametrize(
    ("short", "full"),
    [("odom", "/ns/odom"), ("/odom", "/odom"), ("~/odom", "/ns/me/odom"), ("a/b", "/ns/a/b")],
)
def test_short_names_stand_for_full_ones(short, full):
    """Relative, absolute and private."""
    assert expanded(short, "me", "/ns") == full


@pytest.mark.parametrize("bad", ["", "1a", "a b", "/a/", "a//b", "a__b", "{node}"])
def test_names_that_ros_refuses_are_refused(bad):
    """Before they reach the wire."""
    with pytest.raises(InvalidTopicNameException):
        expanded(bad, "me", "/")


def test_the_first_fitting_rule_renames():
    """Rules are compared by full names, and may be for one node alone."""
    rules = [Remap("other", "odom", "/x"), Remap("", "odom", "/y"), Remap("", "/ns/odom", "/z")]
    assert remapped("odom", "me", "/ns", rules) == "/y"
    assert remapped("/ns/odom", "other", "/ns", rules) == "/x"
    assert remapped("imu", "me", "/ns", rules) == "/ns/imu"
