"""The robot's stack: ros2 launch finssim_ros robot.launch.py robot:=udp://192.168.0.2:58766 policy:=DIR

It starts disarmed: publish true on the topic arm, or press START on the gamepad (teleop:=true).
"""

import os

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

ARGUMENTS = {
    "vehicle": ("finsrov", "vehicle of the catalogue, or its YAML file"),
    "namespace": ("finsrov", "what the vehicle's topics stand below"),
    "robot": (
        "pool",
        "udp://HOST:PORT, serial:/dev/..., dry-run, or pool for the virtual pool on this machine",
    ),
    "policy": ("pid", "directory of an exported policy, or pid"),
    "pool_file": ("", "calibrated pool and camera"),
    "record": ("", "MCAP file to record to; no record where empty"),
    "camera": ("true", "whether to start the camera"),
    "teleop": ("false", "whether to start gamepad or keyboard"),
    "params_file": ("", "your own parameter file; the package's config/robot.yaml where empty"),
}


def word(name):
    """A launch argument as text, whatever it looks like."""
    return ParameterValue(LaunchConfiguration(name), value_type=str)


def generate_launch_description():
    default = os.path.join(get_package_share_directory("finssim_ros"), "config", "robot.yaml")
    arguments = {**ARGUMENTS, "params_file": (default, ARGUMENTS["params_file"][1])}

    def node(executable, condition=None, **own):
        parameters = [LaunchConfiguration("params_file"), {"vehicle": word("vehicle"), **own}]
        return Node(
            package="finssim_ros",
            executable=executable,
            namespace=LaunchConfiguration("namespace"),
            parameters=parameters,
            condition=condition,
            output="screen",
        )

    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(n, default_value=d, description=text)
                for n, (d, text) in arguments.items()
            ),
            node("camera", IfCondition(LaunchConfiguration("camera")), pool_file=word("pool_file")),
            node("localizer", pool_file=word("pool_file")),
            node("state_estimation", pool_file=word("pool_file")),
            node("controller", policy=word("policy")),
            node("hardware_bridge", robot=word("robot")),
            node("recorder", record=word("record")),
            node("teleop", IfCondition(LaunchConfiguration("teleop"))),
        ]
    )
