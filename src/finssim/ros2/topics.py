"""Names, types, frames and policies of everything FinsSim's nodes say to each other: one table, for code and page."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["FRAMES", "SERVICES", "TOPICS", "ServiceName", "Topic", "quality_profile"]

STREAM, COMMAND, LATCHED, SENSOR = "stream", "command", "latched", "sensor"

QUALITIES = {
    STREAM: "reliable, volatile, depth 10",
    COMMAND: "reliable, volatile, depth 1",
    LATCHED: "reliable, transient local, depth 1",
    SENSOR: "best effort, volatile, depth 5",
}
"""The policies in use. A best-effort publisher gives nothing to a reliable subscription; every other pair fits."""


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


@dataclass(frozen=True)
class ServiceName:
    """One service. None is needed for safety: services reach Cyclone DDS only."""

    name: str
    type: str
    server: str
    meaning: str


FRAMES = {
    "map": "the pool: origin as the pool file has it, z up, z = 0 on the still water (REP-105 map and odom in one)",
    "odom": "equal to map: fixes are absolute, so nothing drifts",
    "base_link": "the vehicle's body origin: x forward, y left, z up (REP-103)",
    "imu_link": "the inertial sensor as it is mounted",
    "camera_link": "the overhead camera's body, x along the view",
    "camera_optical": "the overhead camera's picture: z along the view, x right, y down (REP-103)",
}
"""Coordinate frames; units are SI and radians throughout."""

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
    "goal": Topic("goal", "geometry_msgs/msg/PoseStamped", LATCHED, "map", "you", "pose to hold"),
    "path": Topic("path", "nav_msgs/msg/Path", LATCHED, "map", "controller", "trajectory that is followed"),
    "trajectory": Topic(
        "trajectory",
        "std_msgs/msg/String",
        LATCHED,
        "",
        "you",
        "name or file of a trajectory to follow from now on",
    ),
    "mode": Topic(
        "mode",
        "std_msgs/msg/String",
        LATCHED,
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
        "/tf", "tf2_msgs/msg/TFMessage", STREAM, "map", "state_estimation, sim", "map to base_link"
    ),
    "fixed_transform": Topic(
        "/tf_static",
        "tf2_msgs/msg/TFMessage",
        LATCHED,
        "base_link",
        "state_estimation, sim",
        "base_link to imu_link, map to odom, map to camera_optical",
    ),
    "clock": Topic("/clock", "rosgraph_msgs/msg/Clock", SENSOR, "", "sim", "simulated time"),
}
"""Key -> topic."""

SERVICES = {
    "reset": ServiceName("reset", "std_srvs/srv/Trigger", "sim", "put the vehicle back to its start"),
    "set_armed": ServiceName(
        "set_armed", "std_srvs/srv/SetBool", "hardware_bridge, sim", "the topic arm, with an answer"
    ),
}
"""Key -> service, for convenience beside the topics."""


def quality_profile(quality: str) -> object:
    """The rclpy profile of a topic's policies; needs a rclpy (`finssim.ros2.backend.activate`)."""
    from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

    return QoSProfile(
        depth={STREAM: 10, SENSOR: 5}.get(quality, 1),
        reliability=ReliabilityPolicy.BEST_EFFORT if quality == SENSOR else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if quality == LATCHED else DurabilityPolicy.VOLATILE,
    )
