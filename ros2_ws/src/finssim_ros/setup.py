"""Installation of the nodes and launch files for `ros2 run finssim_ros` and `ros2 launch finssim_ros`."""

from glob import glob

from setuptools import setup

NODES = [
    "camera",
    "controller",
    "hardware_bridge",
    "localizer",
    "recorder",
    "sim",
    "state_estimation",
    "teleop",
    "virtual_pool",
]

setup(
    name="finssim_ros",
    version="0.1.0",
    packages=["finssim_ros"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/finssim_ros"]),
        ("share/finssim_ros", ["package.xml"]),
        ("share/finssim_ros/launch", glob("launch/*.launch.py")),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    entry_points={"console_scripts": [f"{node} = finssim_ros.run:{node}" for node in NODES]},
)
