"""The virtual pool: ros2 launch finssim_ros pool.launch.py severity:=realistic plant:=1"""

from finssim_ros.launching import description


def generate_launch_description():
    return description("pool")
