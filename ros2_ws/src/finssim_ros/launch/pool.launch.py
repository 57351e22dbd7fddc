"""Launch the virtual pool and a robot: ros2 launch finssim_ros pool.launch.py severity:=realistic
goal:=0.4,0,-0.5,0

Several vehicles: team:=finsrov,finsrov,finsrov site:=open-water positioning:=motion-capture
"""

from finssim_ros.launching import description


def generate_launch_description():
    return description("pool")
