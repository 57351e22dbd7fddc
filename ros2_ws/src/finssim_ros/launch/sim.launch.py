"""A simulated vehicle with its controller: ros2 launch finssim_ros sim.launch.py vehicle:=bluerov2_heavy policy:=DIR"""

from finssim_ros.launching import description

ARGUMENTS = {"policy": ("", "directory of an exported policy, pid or pid-paper")}


def generate_launch_description():
    return description(
        "sim",
        ARGUMENTS,
        lambda given: {"sim": {}, "controller": {"policy": given["policy"], "use_sim_time": True}},
    )
