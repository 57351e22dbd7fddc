"""What the launch files share: arguments that win over parameter files, but only where somebody gave them."""

import os

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

COMMON = {
    "vehicle": ("", "vehicle of the catalogue, or its YAML file; finsrov where neither this nor a file says"),
    "namespace": ("finsrov", "what the vehicle's topics stand below"),
    "frame_prefix": ("", "of the vehicle's own frames in /tf, such as robot_1/, where several share a graph"),
    "site": ("", "pool, tank or open-water"),
    "params_file": ("", "your own parameter file, in place of the package's"),
}

EVERYWHERE = ("vehicle", "frame_prefix", "site")
"""Parameters of every node."""


def description(graph, arguments, nodes):
    """A launch description.

    Args:
        graph: Name of the package's parameter file.
        arguments: Launch argument -> (default, meaning); an argument left empty leaves a parameter to the file.
        nodes: Function of the arguments' values that gives executable -> its parameters, all but `EVERYWHERE`.
    """
    declared = {**COMMON, **arguments}
    own = os.path.join(get_package_share_directory("finssim_ros"), "config", f"{graph}.yaml")

    def start(context):
        given = {name: context.launch_configurations[name] for name in declared}
        return [
            Node(
                package="finssim_ros",
                executable=executable,
                # With name and namespace launch_ros writes the parameters below the node's full name; without, below
                # /**, which loses against every node that a file names after a /** of its own.
                name=executable,
                namespace=given["namespace"],
                parameters=[
                    given["params_file"] or own,
                    *_given({**{name: given[name] for name in EVERYWHERE}, **parameters}),
                ],
                output="screen",
            )
            for executable, parameters in nodes(given).items()
        ]

    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(n, default_value=d, description=text)
                for n, (d, text) in declared.items()
            ),
            OpaqueFunction(function=start),
        ]
    )


def _given(parameters):
    """A dictionary of those that were given, if any; words stay words, whatever they look like."""
    given = {
        name: ParameterValue(value, value_type=str) if isinstance(value, str) else value
        for name, value in parameters.items()
        if value != ""
    }
    return [given] if given else []
