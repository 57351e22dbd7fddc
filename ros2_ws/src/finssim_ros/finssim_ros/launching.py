"""Launch files from the options of `finssim ros2 up`; arguments win over parameter files, but only where given."""

import os
import re
from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from finssim.cli.command_line import read
from finssim.extensions.ros2.up import launch_arguments, launched

OLDER = {"camera": {"true": "", "false": "none"}, "teleop": {"true": "joy", "false": ""}}
"""Words of earlier launch files, and what they are now."""
FILE = "params_file"


def description(graph):
    """Return the launch description of a graph; an argument left empty leaves a parameter to the file."""
    options = list(read("finssim.extensions.ros2.up:Options").all_options())
    meanings = {option.name: f"{option.metavar or 'NUMBER'}: {option.help}" for option in options}
    declared = {name: meanings[name] for name in launch_arguments(graph)}
    declared[FILE] = "FILE: Your own parameter file, in place of the package's."
    own = os.path.join(get_package_share_directory("finssim_ros"), "config", f"{graph}.yaml")

    def start(context):
        words = {name: context.launch_configurations[name] for name in declared}
        words = {name: OLDER.get(name, {}).get(word.lower(), word) for name, word in words.items()}
        file = words.pop(FILE) or own
        namespace, nodes = launched(graph, {name: word for name, word in words.items() if word})
        if graph != "pool" and re.search(r"^[^#]*\brecord:", Path(file).read_text(), re.MULTILINE):
            nodes.setdefault("recorder", {})
        return [
            Node(
                package="finssim_ros",
                executable=node,
                # With name and namespace launch_ros writes the parameters below the node's full name; without, below
                # /**, which loses against every node that a file names after a /** of its own.
                name=node,
                namespace=namespace,
                parameters=[file, *([_words(parameters)] if parameters else [])],
                output="screen",
            )
            for node, parameters in nodes.items()
        ]

    arguments = [DeclareLaunchArgument(n, default_value="", description=d) for n, d in declared.items()]
    return LaunchDescription([*arguments, OpaqueFunction(function=start)])


def _words(parameters):
    """Return parameters whose words stay words, whatever they look like."""
    return {
        name: ParameterValue(value, value_type=str) if isinstance(value, str) else value
        for name, value in parameters.items()
    }
