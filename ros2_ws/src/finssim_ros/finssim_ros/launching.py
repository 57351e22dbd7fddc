"""Launch descriptions from the graphs that `finssim ros2 up` uses; given arguments override parameter files."""

import re
from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from finssim.cli.command_line import read
from finssim.extensions.ros2.up import launch_arguments, launched

FILE = "params_file"


def description(graph):
    """Return the launch description of a graph; an empty argument leaves its parameter to the file and the
    nodes' defaults."""
    options = {option.name: option for option in read("finssim.extensions.ros2.up:Options").all_options()}
    declared = {
        name: f"{options[name].metavar or options[name].kind.__name__}: {options[name].help}"
        for name in launch_arguments()
    }
    declared[FILE] = "FILE: Parameter file of all nodes."

    def start(context):
        words = {name: context.launch_configurations[name] for name in declared}
        file = words.pop(FILE)
        if file and (
            named := re.search(r"^[^#\n]*\brecord: *([^\s,}]+)", Path(file).read_text(), re.MULTILINE)
        ):
            words["record"] = words["record"] or named[1].strip("\"'")
        plan = launched(graph, {name: word for name, word in words.items() if word})
        return [
            Node(
                package="finssim_ros",
                executable=one.node,
                # With name and namespace, launch_ros writes the parameters below the node's full name; without, below
                # /**, which a later entry for the node in a parameter file overrides if the file has its own /** first.
                name=one.node,
                namespace=one.namespace,
                parameters=[*([file] if file else []), *([_words(one.parameters)] if one.parameters else [])],
                output="screen",
            )
            for one in plan.nodes
        ]

    arguments = [DeclareLaunchArgument(n, default_value="", description=d) for n, d in declared.items()]
    return LaunchDescription([*arguments, OpaqueFunction(function=start)])


def _words(parameters):
    """Return parameters whose strings stay strings, whatever they look like."""
    return {
        name: ParameterValue(value, value_type=str) if isinstance(value, str) else value
        for name, value in parameters.items()
    }
