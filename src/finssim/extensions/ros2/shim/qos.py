"""`rclpy.qos`: quality of service as ROS 2 names it."""

from __future__ import annotations

from enum import Enum, IntEnum
from typing import Any

from finssim.extensions.ros2.shim.time import Duration
from finssim.extensions.ros2.wire import Quality


class HistoryPolicy(IntEnum):
    """Policy of the number of stored samples."""

    SYSTEM_DEFAULT = 0
    KEEP_LAST = 1
    KEEP_ALL = 2


class ReliabilityPolicy(IntEnum):
    """Policy of resending lost samples."""

    SYSTEM_DEFAULT = 0
    RELIABLE = 1
    BEST_EFFORT = 2


class DurabilityPolicy(IntEnum):
    """Policy of earlier samples for late readers."""

    SYSTEM_DEFAULT = 0
    TRANSIENT_LOCAL = 1
    VOLATILE = 2


class LivelinessPolicy(IntEnum):
    """Policy of liveliness; only automatic is supported."""

    SYSTEM_DEFAULT = 0
    AUTOMATIC = 1


QoSHistoryPolicy, QoSReliabilityPolicy = HistoryPolicy, ReliabilityPolicy
QoSDurabilityPolicy, QoSLivelinessPolicy = DurabilityPolicy, LivelinessPolicy


class InvalidQoSProfileException(Exception):
    """Profile without a depth."""


POLICIES = {
    "history": HistoryPolicy.KEEP_LAST,
    "depth": 10,
    "reliability": ReliabilityPolicy.RELIABLE,
    "durability": DurabilityPolicy.VOLATILE,
    "lifespan": Duration(),
    "deadline": Duration(),
    "liveliness": LivelinessPolicy.SYSTEM_DEFAULT,
}
"""Policy -> default (rmw_qos_profile_default), which also determines its type."""


class QoSProfile:
    """Policies of an endpoint; arguments, defaults and refusals as in rclpy."""

    history: HistoryPolicy
    depth: int
    reliability: ReliabilityPolicy
    durability: DurabilityPolicy
    lifespan: Duration
    deadline: Duration
    liveliness: LivelinessPolicy

    def __init__(self, **policies: Any) -> None:
        unknown = set(policies) - set(POLICIES)
        assert not unknown, f"QoSProfile: '{min(unknown)}' is no policy, or needs a sourced ROS 2: omit it"
        if (
            "depth" not in policies
            and policies.get("history", HistoryPolicy.KEEP_LAST) == HistoryPolicy.KEEP_LAST
        ):
            raise InvalidQoSProfileException("QoSProfile: give the number of samples kept, such as depth=10")
        for name, value in (POLICIES | policies).items():
            setattr(self, name, value)

    def __setattr__(self, name: str, value: Any) -> None:
        kind = type(POLICIES[name])
        fits = isinstance(value, int) if issubclass(kind, int) else isinstance(value, kind)
        assert fits, f"QoSProfile: {name} is {value!r}, expected a {kind.__name__}"
        object.__setattr__(self, name, kind(value) if issubclass(kind, IntEnum) else value)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, QoSProfile) and vars(self) == vars(other)

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        return f"QoSProfile({', '.join(f'{k}={v!r}' for k, v in vars(self).items())})"


def quality_of(profile: QoSProfile | int) -> Quality:
    """Return the network policies of a profile or a depth.

    Raises:
        TypeError: The argument is neither a profile nor a depth.
        ValueError: The depth is negative.
    """
    if isinstance(profile, int):
        if profile < 0:
            raise ValueError(f"a depth of {profile}: expected zero or more")
        profile = QoSProfile(depth=profile)
    if not isinstance(profile, QoSProfile):
        raise TypeError(f"{profile!r}: expected a QoSProfile or a depth")
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
    """Named profiles."""

    SYSTEM_DEFAULT = qos_profile_system_default
    SENSOR_DATA = qos_profile_sensor_data
    SERVICES_DEFAULT = qos_profile_services_default
    PARAMETERS = qos_profile_parameters
    PARAMETER_EVENTS = qos_profile_parameter_events
