"""`rclpy.qos`: quality of service as ROS 2 names it."""

from __future__ import annotations

from enum import Enum, IntEnum
from typing import Any

from finssim.ros2.errors import Ros2Error
from finssim.ros2.shim.duration import Duration
from finssim.ros2.wire.quality import Quality

__all__ = [
    "DurabilityPolicy",
    "HistoryPolicy",
    "LivelinessPolicy",
    "QoSDurabilityPolicy",
    "QoSHistoryPolicy",
    "QoSLivelinessPolicy",
    "QoSPresetProfiles",
    "QoSProfile",
    "QoSReliabilityPolicy",
    "ReliabilityPolicy",
    "qos_profile_parameter_events",
    "qos_profile_parameters",
    "qos_profile_sensor_data",
    "qos_profile_services_default",
    "qos_profile_system_default",
]


class HistoryPolicy(IntEnum):
    """Which samples are kept."""

    SYSTEM_DEFAULT = 0
    KEEP_LAST = 1
    KEEP_ALL = 2


class ReliabilityPolicy(IntEnum):
    """Whether lost samples are sent again."""

    SYSTEM_DEFAULT = 0
    RELIABLE = 1
    BEST_EFFORT = 2


class DurabilityPolicy(IntEnum):
    """Whether a reader that comes late gets earlier samples."""

    SYSTEM_DEFAULT = 0
    TRANSIENT_LOCAL = 1
    VOLATILE = 2


class LivelinessPolicy(IntEnum):
    """Who says that a writer is alive; only the automatic one."""

    SYSTEM_DEFAULT = 0
    AUTOMATIC = 1


QoSHistoryPolicy, QoSReliabilityPolicy = HistoryPolicy, ReliabilityPolicy
QoSDurabilityPolicy, QoSLivelinessPolicy = DurabilityPolicy, LivelinessPolicy


class QoSProfile:
    """Policies of an endpoint; arguments and defaults as in rclpy."""

    def __init__(self, **policies: Any) -> None:
        if "depth" not in policies and "history" not in policies:
            raise Ros2Error("QoSProfile: give the number of samples kept as depth=10, or a history")
        self.depth: int = policies.pop("depth", 0)
        self.history = HistoryPolicy(policies.pop("history", HistoryPolicy.KEEP_LAST))
        self.reliability = ReliabilityPolicy(policies.pop("reliability", ReliabilityPolicy.RELIABLE))
        self.durability = DurabilityPolicy(policies.pop("durability", DurabilityPolicy.VOLATILE))
        self.liveliness = LivelinessPolicy(policies.pop("liveliness", LivelinessPolicy.SYSTEM_DEFAULT))
        self.deadline: Duration = policies.pop("deadline", Duration())
        self.lifespan: Duration = policies.pop("lifespan", Duration())
        if policies:
            raise Ros2Error(f"QoSProfile: '{min(policies)}' needs a sourced ROS 2: leave it out")
        if self.history == HistoryPolicy.KEEP_LAST and self.depth < 1:
            raise Ros2Error(f"QoSProfile: depth is {self.depth}, expected at least 1 with KEEP_LAST")

    def __eq__(self, other: object) -> bool:
        return isinstance(other, QoSProfile) and vars(self) == vars(other)

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        return f"QoSProfile({', '.join(f'{k}={v!r}' for k, v in vars(self).items())})"


def quality_of(profile: QoSProfile | int) -> Quality:
    """A profile, or a depth alone, as the wire has it."""
    if isinstance(profile, int):
        profile = QoSProfile(depth=profile)
    return Quality(
        depth=0 if profile.history == HistoryPolicy.KEEP_ALL else profile.depth or 1,
        reliable=profile.reliability != ReliabilityPolicy.BEST_EFFORT,
        transient_local=profile.durability == DurabilityPolicy.TRANSIENT_LOCAL,
        deadline=profile.deadline.nanoseconds / 1e9,
        lifespan=profile.lifespan.nanoseconds / 1e9,
    )


qos_profile_sensor_data = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
qos_profile_system_default = QoSProfile(depth=10)
qos_profile_services_default = QoSProfile(depth=10)
qos_profile_parameters = QoSProfile(depth=1000)
qos_profile_parameter_events = QoSProfile(depth=1000)


class QoSPresetProfiles(Enum):
    """The named profiles."""

    SYSTEM_DEFAULT = qos_profile_system_default
    SENSOR_DATA = qos_profile_sensor_data
    SERVICES_DEFAULT = qos_profile_services_default
    PARAMETERS = qos_profile_parameters
