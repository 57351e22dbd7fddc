"""Messages between nodes: table of topics, frames, services, and the rclpy profiles of their policies."""

from __future__ import annotations

from dataclasses import dataclass

from finssim.robot.record_messages import (
    COMMAND,
    LATCHED,
    OWN_TOPICS,
    QUALITIES,
    SENSOR,
    STREAM,
    TOPICS,
    Topic,
    depth_of,
    is_latched,
    is_reliable,
    own_topics,
)

__all__ = [
    "COMMAND",
    "FRAMES",
    "LATCHED",
    "OWN_TOPICS",
    "QUALITIES",
    "SENSOR",
    "SERVICES",
    "STREAM",
    "TOPICS",
    "ServiceName",
    "Topic",
    "own_topics",
    "quality_profile",
]


@dataclass(frozen=True)
class ServiceName:
    """A service. None is needed for safety, because services are available only over Cyclone DDS."""

    name: str
    type: str
    server: str
    meaning: str


FRAMES = {
    "map": "the pool: origin as the pool file has it, z up, z = 0 on the still water; positions jump with a fix",
    "odom": "begins as the map and is integrated from velocities: drifts, never jumps (REP-105)",
    "base_link": "the vehicle's body origin: x forward, y left, z up (REP-103)",
    "imu_link": "the inertial sensor as it is mounted; likewise pressure_link, each tag and each thruster",
    "dvl_link": "the Doppler log as it is mounted",
    "NAME_link": "a camera, sonar or altimeter of the vehicle's `perception`: x along its view, y left, z up",
    "NAME_optical": "the same camera's picture: z along the view, x right, y down (REP-103)",
    "NAME_acoustic": "the same sonar or Doppler log, as marine_acoustic_msgs has it: z along the view, x up, y right",
    "camera_link": "the overhead camera's body, x along the view",
    "camera_optical": "the overhead camera's picture: z along the view, x right, y down (REP-103)",
}
"""Coordinate frames; units are SI and radians throughout."""

SERVICES = {
    "reset": ServiceName("reset", "std_srvs/srv/Trigger", "sim", "put the vehicle back to its start"),
    "set_armed": ServiceName(
        "set_armed", "std_srvs/srv/SetBool", "hardware_bridge, sim", "the topic arm, with an answer"
    ),
}
"""Key -> service; each is an alternative to a topic."""


def quality_profile(quality: str) -> object:
    """Return the rclpy profile of a topic's policies; needs a rclpy (`finssim.extensions.ros2.backend.activate`)."""
    from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

    return QoSProfile(
        depth=depth_of(quality),
        reliability=ReliabilityPolicy.RELIABLE if is_reliable(quality) else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if is_latched(quality) else DurabilityPolicy.VOLATILE,
    )
