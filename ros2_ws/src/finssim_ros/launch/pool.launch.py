"""The virtual pool: ros2 launch finssim_ros pool.launch.py severity:=realistic plant:=1"""

import os

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

ARGUMENTS = {
    "vehicle": ("finsrov", "vehicle of the catalogue, or its YAML file"),
    "namespace": ("finsrov", "what the vehicle's topics stand below"),
    "severity": ("realistic", "nominal, realistic or hard"),
    "plant": ("1", "seed or file of the plant"),
    "pool_file": ("pool.yaml", "file to write its calibrated pool and camera to, for the robot"),
    "params_file": ("", "your own parameter file; the package's config/pool.yaml where empty"),
}

WORDS = ("vehicle", "severity", "plant", "pool_file")


def generate_launch_description():
    default = os.path.join(get_package_share_directory("finssim_ros"), "config", "pool.yaml")
    arguments = {**ARGUMENTS, "params_file": (default, ARGUMENTS["params_file"][1])}
    words = {n: ParameterValue(LaunchConfiguration(n), value_type=str) for n in WORDS}
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(n, default_value=d, description=text)
                for n, (d, text) in arguments.items()
            ),
            Node(
                package="finssim_ros",
                executable="virtual_pool",
                namespace=LaunchConfiguration("namespace"),
                parameters=[LaunchConfiguration("params_file"), words],
                output="screen",
            ),
        ]
    )
