"""Launch a simulated vehicle and its controller: ros2 launch finssim_ros sim.launch.py
vehicle:=bluerov2_heavy policy:=DIR"""

from finssim_ros.launching import description


def generate_launch_description():
    return description("sim")
