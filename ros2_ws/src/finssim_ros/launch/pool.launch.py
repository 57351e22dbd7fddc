"""The virtual pool: ros2 launch finssim_ros pool.launch.py severity:=realistic plant:=1"""

from finssim_ros.launching import description

ARGUMENTS = {
    "severity": ("", "nominal, realistic or hard"),
    "plant": ("", "seed or file of the plant"),
    "pool_file": ("pool.yaml", "file to write its calibrated pool and camera to, for the robot"),
}


def generate_launch_description():
    return description(
        "pool", ARGUMENTS, lambda given: {"virtual_pool": {name: given[name] for name in ARGUMENTS}}
    )
