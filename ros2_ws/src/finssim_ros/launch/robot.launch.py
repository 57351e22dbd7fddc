"""The robot's stack: ros2 launch finssim_ros robot.launch.py robot:=udp://192.168.0.2:58766 policy:=DIR

It starts disarmed: publish true on the topic arm, or press START on the gamepad (teleop:=true).
"""

from finssim_ros.launching import description

ARGUMENTS = {
    "robot": (
        "",
        "udp://HOST:PORT, serial:/dev/..., mavlink://..., or pool for the virtual pool on this machine",
    ),
    "policy": ("", "directory of an exported policy, pid or pid-paper"),
    "pool_file": ("", "calibrated pool and camera"),
    "record": ("", "MCAP file to record to"),
    "camera": ("true", "whether to start the camera"),
    "teleop": ("false", "whether to start gamepad or keyboard"),
}


def nodes(given):
    policy, located = given["policy"], {"pool_file": given["pool_file"]}
    graph = {
        "camera": located,
        "localizer": located,
        "state_estimation": {**located, "robot": given["robot"]},
        "controller": {"policy": policy},
        "hardware_bridge": {"robot": given["robot"]},
        "recorder": {"record": given["record"], **located},
        "teleop": {"other": policy if policy in ("", "pid", "pid-paper") else "policy"},
    }
    off = {name for name in ("camera", "teleop") if given[name].lower() not in ("true", "1")}
    return {name: parameters for name, parameters in graph.items() if name not in off}


def generate_launch_description():
    return description("robot", ARGUMENTS, nodes)
