"""Launch the robot's stack: ros2 launch finssim_ros robot.launch.py robot:=udp://192.168.0.2:58766 policy:=DIR

It starts disarmed: publish true on the topic arm, or press START on the gamepad (teleop:=joy).
"""

from finssim_ros.launching import description


def generate_launch_description():
    return description("robot")
