"""Fields of ROS messages by dotted path, and the columns that messages of usual types hold."""

from __future__ import annotations

import math
import re
from typing import Any

from finssim.calibration.errors import CalibrationError
from finssim.vehicles.part import did_you_mean

__all__ = ["USUAL", "number_at", "stamp_of", "word_at"]


def _pose(at: str) -> dict[str, str]:
    return {c: f"{at}.position.{c}" for c in "xyz"} | {f"q{c}": f"{at}.orientation.{c}" for c in "xyzw"}


def _twist(at: str) -> dict[str, str]:
    linear = {name: f"{at}.linear.{c}" for name, c in zip("uvw", "xyz", strict=True)}
    return linear | {name: f"{at}.angular.{c}" for name, c in zip("pqr", "xyz", strict=True)}


def _wrench(at: str) -> dict[str, str]:
    force = {f"tau_{c}": f"{at}.force.{c}" for c in "xyz"}
    return force | {
        name: f"{at}.torque.{c}" for name, c in zip(("tau_k", "tau_m", "tau_n"), "xyz", strict=True)
    }


USUAL: dict[str, dict[str, str]] = {
    "sensor_msgs/msg/Imu": {
        **{name: f"angular_velocity.{c}" for name, c in zip("pqr", "xyz", strict=True)},
        **{f"a{c}": f"linear_acceleration.{c}" for c in "xyz"},
    },
    "nav_msgs/msg/Odometry": _pose("pose.pose") | _twist("twist.twist"),
    "geometry_msgs/msg/WrenchStamped": _wrench("wrench"),
    "geometry_msgs/msg/Wrench": _wrench(""),
    "geometry_msgs/msg/PoseStamped": _pose("pose"),
    "geometry_msgs/msg/PoseWithCovarianceStamped": _pose("pose.pose"),
    "geometry_msgs/msg/TwistStamped": _twist("twist"),
    "geometry_msgs/msg/TwistWithCovarianceStamped": _twist("twist.twist"),
    "sensor_msgs/msg/FluidPressure": {"pressure": "fluid_pressure"},
    "sensor_msgs/msg/BatteryState": {"voltage": "voltage"},
    "finssim_msgs/msg/HardwareTelemetry": {"depth": "depth"},
}
"""Type -> canonical column -> field. An Imu's attitude is taken only where a map says so, for many leave it unset.
Where two of them hold one column and no map says which, the type that stands first here is believed."""

_PART = re.compile(r"([^.\[\]]+)|\[([^\]]*)\]")


def number_at(message: Any, path: str, topic: str) -> float:
    """The number at a dotted path: `twist.twist.linear.x`, `data[3]`, `velocity[T1]` (by the list `name` or `names`).

    Raises:
        CalibrationError: No such field, or no number there.
    """
    value = _value_at(message, path, topic)
    if isinstance(value, (bool, int, float)) or (hasattr(value, "item") and getattr(value, "ndim", 1) == 0):
        return float(value)
    if hasattr(value, "nanosec"):
        return float(value.sec) + 1e-9 * float(value.nanosec)
    raise CalibrationError(
        f"{topic}: field '{path}' is a {type(value).__name__}, expected a number{_inside(value)}"
    )


def word_at(message: Any, path: str, topic: str) -> str:
    """The text at a dotted path; numbers become text."""
    value = _value_at(message, path, topic)
    return value if isinstance(value, str) else f"{number_at(message, path, topic):g}"


def stamp_of(message: Any) -> int | None:
    """The header's stamp [ns], or None where there is none or it was left at zero."""
    header = getattr(message, "header", None)
    stamp = getattr(header, "stamp", None)
    if stamp is None:
        return None
    nanoseconds = int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
    return nanoseconds or None


def _value_at(message: Any, path: str, topic: str) -> Any:
    value: Any = message
    for name, index in _PART.findall(path):
        owner = value
        if name and not name.isdigit():
            value = getattr(value, name, None)
            if value is None:
                fields = _fields(owner)
                raise CalibrationError(
                    f"{topic}: no field '{name}' of '{path}'{did_you_mean(name, fields)} fields are {', '.join(fields)}"
                )
            continue
        key = index or name
        names = [str(x) for x in getattr(message, "names", getattr(message, "name", ()))]
        place = int(key) if key.lstrip("-").isdigit() else names.index(key) if key in names else None
        if place is None:
            raise CalibrationError(
                f"{topic}: '{path}' asks for '{key}', and the message names {', '.join(names) or 'none'}"
            )
        try:
            value = value[place]
        except (IndexError, TypeError):
            if hasattr(value, "__len__") and len(value) == 0:
                return math.nan  # an array left empty holds no sample
            raise CalibrationError(f"{topic}: '{path}' has no element {key}") from None
    return value


def _fields(value: Any) -> list[str]:
    return [name for name in getattr(value, "__dataclass_fields__", {}) if not name.startswith("_")]


def _inside(value: Any) -> str:
    inside = _fields(value)
    return f": it holds {', '.join(inside)}" if inside else ""
