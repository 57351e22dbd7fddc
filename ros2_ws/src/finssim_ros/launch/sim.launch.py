"""A simulated vehicle with its controller: ros2 launch finssim_ros sim.launch.py vehicle:=bluerov2-heavy policy:=DIR"""

import os

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

ARGUMENTS = {
    "vehicle": ("finsrov", "vehicle of the catalogue, or its YAML file"),
    "namespace": ("finsrov", "what the vehicle's topics stand below"),
    "policy": ("pid", "directory of an exported policy, or pid"),
    "params_file": ("", "your own parameter file; the package's config/sim.yaml where empty"),
}


def generate_launch_description():
    default = os.path.join(get_package_share_directory("finssim_ros"), "config", "sim.yaml")
    arguments = {**ARGUMENTS, "params_file": (default, ARGUMENTS["params_file"][1])}
    vehicle = {"vehicle": LaunchConfiguration("vehicle")}
    parameters = [LaunchConfiguration("params_file"), vehicle]
    common = {"package": "finssim_ros", "namespace": LaunchConfiguration("namespace"), "output": "screen"}
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(n, default_value=d, description=text)
                for n, (d, text) in arguments.items()
            ),
            Node(executable="sim", parameters=parameters, **common),
            Node(
                executable="controller",
                parameters=[*parameters, {"policy": LaunchConfiguration("policy"), "use_sim_time": True}],
                **common,
            ),
        ]
    )
