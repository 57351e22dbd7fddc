"""Names, types, frames and policies of all that FinsSim says of a robot: one table, for topics, records and page."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["QUALITIES", "TOPICS", "Topic", "offered_qos"]

STREAM, COMMAND, LATCHED, SENSOR = "stream", "command", "latched", "sensor"

QUALITIES = {
    STREAM: "reliable, volatile, depth 10",
    COMMAND: "reliable, volatile, depth 1",
    LATCHED: "reliable, transient local, depth 1",
    SENSOR: "best effort, volatile, depth 5",
}
"""The policies in use. A best-effort publisher gives nothing to a reliable subscription; every other pair fits."""


INFINITE = (9223372036, 854775807)
"""RMW_DURATION_INFINITE [s, ns]."""


def is_reliable(quality: str) -> bool:
    """Whether lost messages are sent again."""
    return quality != SENSOR


def is_latched(quality: str) -> bool:
    """Whether who comes late gets the last message."""
    return quality == LATCHED


def depth_of(quality: str) -> int:
    """Messages kept."""
    return {STREAM: 10, SENSOR: 5}.get(quality, 1)


def offered_qos(quality: str) -> str:
    """What rosbag2 keeps of a topic's policies: a list of profiles in YAML, as numbers, which every release reads.

    Its names for policies came with Jazzy, whose reader tries numbers first; Humble's knows nothing else.
    """
    forever = f"{{sec: {INFINITE[0]}, nsec: {INFINITE[1]}}}"
    policies = {
        "history": 1,
        "depth": depth_of(quality),
        "reliability": 1 if is_reliable(quality) else 2,
        "durability": 1 if is_latched(quality) else 2,
        "deadline": forever,
        "lifespan": forever,
        "liveliness": 1,
        "liveliness_lease_duration": forever,
        "avoid_ros_namespace_conventions": "false",
    }
    return "- " + "\n  ".join(f"{name}: {value}" for name, value in policies.items())


@dataclass(frozen=True)
class Topic:
    """One topic."""

    name: str
    """Below the vehicle's namespace, unless it begins with a slash."""
    type: str
    """As `nav_msgs/msg/Odometry`."""
    quality: str
    """One of `QUALITIES`."""
    frame: str
    """`frame_id` of its header; empty where it has none."""
    sender: str
    """Nodes that publish it."""
    meaning: str

    def under(self, vehicle: str) -> str:
        """Full name for a vehicle."""
        return self.name if self.name.startswith("/") else f"/{vehicle}/{self.name}"


TOPICS = {
    "imu": Topic(
        "imu",
        "sensor_msgs/msg/Imu",
        SENSOR,
        "base_link",
        "hardware_bridge, sim",
        "inertial sample, body axes",
    ),
    "pressure": Topic(
        "pressure",
        "sensor_msgs/msg/FluidPressure",
        SENSOR,
        "base_link",
        "hardware_bridge, sim",
        "absolute pressure [Pa]",
    ),
    "telemetry": Topic(
        "telemetry",
        "finssim_msgs/msg/HardwareTelemetry",
        STREAM,
        "imu_link",
        "hardware_bridge",
        "snapshot of the motor controller, as it came",
    ),
    "shafts": Topic(
        "joint_states",
        "sensor_msgs/msg/JointState",
        STREAM,
        "base_link",
        "hardware_bridge",
        "shafts' speeds",
    ),
    "odometry": Topic(
        "odom",
        "nav_msgs/msg/Odometry",
        STREAM,
        "map",
        "state_estimation, sim",
        "state: pose in map, twist in base_link (`child_frame_id`)",
    ),
    "estimator": Topic(
        "estimator_status",
        "finssim_msgs/msg/EstimatorStatus",
        STREAM,
        "map",
        "state_estimation, sim",
        "whether the state may be acted on, and why not",
    ),
    "fix": Topic(
        "vision/pose",
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        STREAM,
        "map",
        "localizer",
        "pose from one picture, through the refracting water",
    ),
    "positioning": Topic(
        "positioning/pose",
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        SENSOR,
        "map",
        "hardware_bridge",
        "fix of motion capture (x, y, yaw) or acoustic positioning (x, y, z), by wire; what is not measured has 1e6",
    ),
    "dvl": Topic(
        "dvl/twist",
        "geometry_msgs/msg/TwistWithCovarianceStamped",
        SENSOR,
        "dvl_link",
        "hardware_bridge",
        "velocity over the floor by the Doppler log, its axes",
    ),
    "compass": Topic(
        "compass/imu",
        "sensor_msgs/msg/Imu",
        SENSOR,
        "base_link",
        "hardware_bridge",
        "heading in the map as an orientation; it has no rates and no specific force",
    ),
    "goal": Topic("goal", "geometry_msgs/msg/PoseStamped", COMMAND, "map", "you", "pose to hold"),
    "path": Topic(
        "path",
        "nav_msgs/msg/Path",
        LATCHED,
        "map",
        "controller",
        "trajectory that is followed, each pose stamped with its time",
    ),
    "follow": Topic(
        "follow_path",
        "nav_msgs/msg/Path",
        COMMAND,
        "map",
        "you",
        "trajectory to follow from now on: a level pose at each time, counted from the first one's",
    ),
    "trajectory": Topic(
        "trajectory",
        "std_msgs/msg/String",
        COMMAND,
        "",
        "you",
        "name or file of a trajectory to follow from now on",
    ),
    "mode": Topic(
        "mode",
        "std_msgs/msg/String",
        COMMAND,
        "",
        "teleop, you",
        "controller to use: pid, pid-paper, policy or teleop",
    ),
    "wrench": Topic(
        "wrench_cmd",
        "geometry_msgs/msg/WrenchStamped",
        COMMAND,
        "base_link",
        "teleop, you",
        "wrench asked for [N, N m]",
    ),
    "command": Topic(
        "thruster_cmd",
        "finssim_msgs/msg/ThrusterCommand",
        COMMAND,
        "base_link",
        "controller",
        "thrust asked of each thruster [N]; forgotten when stale",
    ),
    "thrusters": Topic(
        "thruster_state",
        "finssim_msgs/msg/ThrusterState",
        STREAM,
        "base_link",
        "hardware_bridge, sim",
        "armed or not and why, thrusts as limited and as measured",
    ),
    "echo": Topic(
        "command_echo",
        "finssim_msgs/msg/CommandEcho",
        STREAM,
        "base_link",
        "hardware_bridge",
        "what the motor controller made of a command",
    ),
    "policy": Topic(
        "policy_info",
        "finssim_msgs/msg/PolicyInfo",
        STREAM,
        "base_link",
        "controller",
        "one decision, in and out",
    ),
    "arm": Topic(
        "arm", "std_msgs/msg/Bool", COMMAND, "", "teleop, you", "true arms, false disarms; nothing else arms"
    ),
    "stop": Topic(
        "stop",
        "std_msgs/msg/Empty",
        COMMAND,
        "",
        "controller, teleop, you",
        "zero thrust until acknowledged",
    ),
    "acknowledge": Topic(
        "acknowledge", "std_msgs/msg/Empty", COMMAND, "", "teleop, you", "ends a fault; leaves it disarmed"
    ),
    "image": Topic(
        "camera/image", "sensor_msgs/msg/Image", SENSOR, "camera_optical", "camera", "picture, mono8"
    ),
    "picture": Topic(
        "camera/image/compressed",
        "sensor_msgs/msg/CompressedImage",
        SENSOR,
        "camera_optical",
        "camera",
        "the same as JPEG",
    ),
    "camera_info": Topic(
        "camera/camera_info",
        "sensor_msgs/msg/CameraInfo",
        LATCHED,
        "camera_optical",
        "camera",
        "its calibration",
    ),
    "tags": Topic(
        "camera/tags", "std_msgs/msg/String", STREAM, "", "camera, localizer", "tags found in a picture, JSON"
    ),
    "event": Topic("events", "std_msgs/msg/String", STREAM, "", "every node", "what happened, JSON"),
    "diagnostics": Topic(
        "diagnostics", "diagnostic_msgs/msg/DiagnosticArray", STREAM, "", "every node", "health of each part"
    ),
    "transform": Topic(
        "/tf",
        "tf2_msgs/msg/TFMessage",
        STREAM,
        "map",
        "state_estimation, sim",
        "map to odom, odom to base_link",
    ),
    "fixed_transform": Topic(
        "/tf_static",
        "tf2_msgs/msg/TFMessage",
        LATCHED,
        "base_link",
        "state_estimation, sim",
        "base_link to all that is mounted on it, map to camera_link, camera_link to camera_optical",
    ),
    "robot": Topic(
        "robot_description",
        "std_msgs/msg/String",
        LATCHED,
        "",
        "state_estimation, sim",
        "URDF of the vehicle file",
    ),
    "clock": Topic("/clock", "rosgraph_msgs/msg/Clock", SENSOR, "", "sim", "simulated time"),
}
"""Key -> topic."""
