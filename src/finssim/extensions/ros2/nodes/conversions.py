"""Conversions of ROS 2 messages to the robot's own values. Malformed messages give a sentence or None, not an
exception."""

from __future__ import annotations

import array
import json
import math
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any

import numpy as np
import numpy.typing as npt

from finssim.control import ControlError
from finssim.control.guidance import Station
from finssim.control.trajectories import Trajectory, through_points
from finssim.core.rotations import quat_yaw
from finssim.robot.messages import (
    HEADING,
    POSE,
    POSITION,
    VELOCITY,
    NavigationAid,
    Picture,
    TagCorners,
    Telemetry,
)
from finssim.robot.pictures import jpeg, picture_of
from finssim.robot.reading import Reading
from finssim.robot.record_messages import FIRST_TIME, LAST_TIME, MAP, UNKNOWN, Messages
from finssim.vehicles import Vehicle

Array = npt.NDArray[np.float64]

LEVEL = math.radians(20.0)
"""Limit of a goal's roll and pitch [rad]: vehicles here hold level poses."""
GRAY = {"rgb8": (0.299, 0.587, 0.114), "bgr8": (0.114, 0.587, 0.299)}
"""Weights of the channels in brightness (ITU-R BT.601)."""
MOST_TAGS = 1000
MOST_POSES = 10_000


def nanoseconds(stamp: Any) -> int:
    """Return a stamp [ns]."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def xyz(v: Any) -> tuple[float, float, float]:
    """Return the numbers of a vector or point, in its unit."""
    return float(v.x), float(v.y), float(v.z)


def xyzw(q: Any) -> tuple[float, float, float, float]:
    """Return the components of a quaternion."""
    return float(q.x), float(q.y), float(q.z), float(q.w)


def telemetry_of(message: Any) -> Telemetry:
    """Return the snapshot of a HardwareTelemetry message; NaN values are passed on, as on the wire."""
    rpm = tuple(float(v) for v in message.motor_rpm)
    return Telemetry(
        sequence=int(message.sequence),
        mcu_ms=int(message.mcu_ms),
        quaternion=xyzw(message.orientation),
        gyro=xyz(message.angular_velocity),
        accel=xyz(message.linear_acceleration),
        depth=float(message.depth),
        pressure=float(message.pressure),
        flags=int(message.status_flags),
        motor_rpm=rpm or None,
    )


def aid_of(key: str, message: Any, age: float, frame: str) -> NavigationAid | str:
    """Return the reading of a navigation instrument, or the reason why it cannot be used; NaN values are passed on.

    Args:
        key: Key of its topic: positioning, dvl or compass.
        message: Received message.
        age: Time since its stamp [s].
        frame: Required frame.
    """
    if message.header.frame_id not in ("", frame):
        return "of another frame"
    if key == "dvl":
        std = math.sqrt(max(0.0, message.twist.covariance[0]))
        return NavigationAid(0, VELOCITY, age, xyz(message.twist.twist.linear), (std, 0.0))
    if key == "compass":
        heading = float(quat_yaw(np.array(xyzw(message.orientation))))
        return NavigationAid(0, HEADING, age, (heading, 0.0, 0.0), (0.0, 0.0))
    pose, covariance = message.pose.pose, np.array(message.pose.covariance, float)
    std, turn = math.sqrt(max(covariance[0], 0.0)), math.sqrt(max(covariance[35], 0.0))
    x, y, z = xyz(pose.position)
    if not covariance[35] < UNKNOWN:
        return NavigationAid(0, POSITION, age, (x, y, z), (std, 0.0))
    return NavigationAid(0, POSE, age, (x, y, float(quat_yaw(np.array(xyzw(pose.orientation))))), (std, turn))


def force_of(message: Any, names: Sequence[str]) -> Array | str:
    """Return the thrusts of a ThrusterCommand in canonical order [N], or the reason why it cannot be used."""
    return _in_order(message.names, message.force, names, "thruster", "thrust")


def setpoints_of(message: Any, names: Sequence[str]) -> Array | str:
    """Return the positions of a JointState in the order of the names [rad, m³ or m], or the reason why it
    cannot be used."""
    return _in_order(message.name, message.position, names, "actuator", "position")


def _in_order(
    named: Sequence[str], values: Sequence[float], names: Sequence[str], kind: str, word: str
) -> Array | str:
    if sorted(named) != sorted(names):
        return f"it names the {kind}s {', '.join(named) or 'none'}, expected {', '.join(names)}, each once"
    if len(values) != len(named):
        return f"it has {len(values)} {word}s for {len(named)} {kind}s"
    by_name = dict(zip(named, map(float, values), strict=True))
    ordered = np.array([by_name[name] for name in names])
    return ordered if np.isfinite(ordered).all() else f"it holds a {word} that is not finite"


def wrench_of(message: Any, frame: str = "base_link") -> Array | None:
    """Return the wrench of a WrenchStamped, body frame [N, N m], (6,); None if it is in another frame or not
    finite."""
    tau = np.array([*xyz(message.wrench.force), *xyz(message.wrench.torque)])
    fits = message.header.frame_id in ("", frame)
    return tau if fits and np.isfinite(tau).all() else None


def station_of_pose(message: Any) -> Station | str:
    """Return the station of a PoseStamped, or the reason for refusing it."""
    frame = message.header.frame_id
    if frame not in ("", "map"):
        return f"a goal in frame '{frame}', expected map"
    position, q = np.array(xyz(message.pose.position)), np.array(xyzw(message.pose.orientation))
    if not (np.isfinite(position).all() and np.isfinite(q).all()):
        return "a goal that is not finite"
    length = float(np.linalg.norm(q))
    if not 0.9 < length < 1.1:
        return "a goal whose orientation is no unit quaternion"
    x, y, _, _ = q / length
    # Tilt of the z axis: its cosine is 1 - 2 (x² + y²), for any yaw.
    if 1.0 - 2.0 * (x * x + y * y) < math.cos(LEVEL):
        return "a goal that is not level: give a turn about z alone"
    return Station((float(position[0]), float(position[1]), float(position[2])), float(quat_yaw(q / length)))


def trajectory_of(message: Any) -> Trajectory | str:
    """Return the trajectory through the poses of a Path at their times, or the reason for refusing it."""
    if len(message.poses) > MOST_POSES:
        return f"a path of {len(message.poses)} poses, expected at most {MOST_POSES}"
    rows = []
    for i, pose in enumerate(message.poses):
        station = station_of_pose(pose)
        if isinstance(station, str):
            return f"a path with pose {i + 1}: {station}"
        seconds = 1e-9 * (nanoseconds(pose.header.stamp) - nanoseconds(message.poses[0].header.stamp))
        rows.append((seconds, *station.position, station.yaw))
    if message.header.frame_id not in ("", "map"):
        return f"a path in frame '{message.header.frame_id}', expected map"
    try:
        return through_points("path", rows)
    except ControlError as error:
        return f"a path whose {error}"


def reading_of(status: Any, odometry: Any | None, time: float) -> Reading:
    """Return the reading of an EstimatorStatus and the Odometry of the same stamp.

    Args:
        status: EstimatorStatus.
        odometry: Odometry; None: position and velocity are NaN.
        time: Time of its stamp, robot's clock [s].
    """
    std = np.array([*status.position_std, *status.velocity_std, status.yaw_std], float)
    if odometry is None:
        position, q, nu = np.full(3, math.nan), np.array([0.0, 0.0, 0.0, 1.0]), np.full(6, math.nan)
    else:
        pose, twist = odometry.pose.pose, odometry.twist.twist
        position, q = np.array(xyz(pose.position)), np.array(xyzw(pose.orientation))
        nu = np.array([*xyz(twist.linear), *xyz(twist.angular)])
    valid = bool(
        np.isfinite(position).all() and np.isfinite(nu).all() and abs(np.linalg.norm(q) - 1.0) < 0.01
    )
    reason = str(status.reason) or ("" if valid else "no odometry")
    return Reading(time, position, q, nu, bool(status.ready) and valid, str(status.mode), reason, std)


def image_of(message: Any, *, colour: bool = False) -> npt.NDArray[np.uint8] | None:
    """Return the picture of an Image with encoding mono8, rgb8 or bgr8; None if it is invalid.

    Args:
        message: Received message.
        colour: True to keep colour, red green blue, (rows, columns, 3); else the result is gray, (rows, columns).
    """
    channels = {"mono8": 1, "8UC1": 1, "rgb8": 3, "bgr8": 3}.get(message.encoding, 0)
    rows, columns, step = int(message.height), int(message.width), int(message.step)
    data = np.frombuffer(memoryview(message.data), np.uint8)
    if not channels or rows * columns == 0 or step < channels * columns or len(data) != rows * step:
        return None
    pixels = data.reshape(rows, step)[:, : channels * columns]
    if channels == 1:
        return np.ascontiguousarray(pixels)
    pixels = pixels.reshape(rows, columns, 3)
    if colour:
        return np.ascontiguousarray(pixels if message.encoding == "rgb8" else pixels[..., ::-1])
    weights = np.array(GRAY[message.encoding])
    return np.round(pixels @ weights).astype(np.uint8)


def own_reading(message: Any) -> Picture | None:
    """Return the reading of an Image, a ProjectedSonarImage or a Range, without its time; None if it is invalid."""
    if hasattr(message, "beam_directions"):
        beams, echoes = message.image.beam_count, np.frombuffer(memoryview(message.image.data), np.uint8)
        if message.image.dtype != 0 or beams == 0 or len(echoes) == 0 or len(echoes) % beams:
            return None
        return Picture(0.0, 0, np.ascontiguousarray(echoes.reshape(-1, beams).T))
    if hasattr(message, "max_range"):
        distance = np.array([message.range], np.float32)
        return None if np.isnan(distance[0]) else Picture(0.0, 0, ranges=distance)
    image = image_of(message, colour=True)
    return None if image is None else Picture(0.0, 0, image)


def compressed_of(message: Any) -> npt.NDArray[np.uint8] | None:
    """Return the gray picture of a CompressedImage; None if it is invalid."""
    return picture_of(np.frombuffer(memoryview(message.data), np.uint8))


def tags_of(message: Any) -> tuple[int, str, Picture] | None:
    """Return time of exposure [ns], finder and tags of a String with JSON; None if it is malformed."""
    try:
        decoded = json.loads(message.data)
        tags = tuple(_tag(tag) for tag in decoded["tags"][:MOST_TAGS])
        stamp, sequence, finder = int(decoded["stamp_ns"]), int(decoded["sequence"]), str(decoded["finder"])
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError):
        return None
    if not FIRST_TIME <= stamp <= LAST_TIME:  # JSON integers may have any size
        return None
    return stamp, finder, Picture(0.0, sequence, None, tags)


def _tag(values: Any) -> TagCorners:
    corners = np.array(values["corners"], float)
    if corners.shape != (4, 2) or not np.isfinite(corners).all():
        raise ValueError("no corners")
    return TagCorners(int(values["id"]), corners)


# Messages of a record as rclpy messages: both use one description of the fields.


OPTICAL = "camera_optical"


def ros_type(name: str) -> Any:
    """Return the class of a type with a name such as `nav_msgs/msg/Odometry`."""
    package, kind, short = name.split("/")
    return getattr(import_module(f"{package}.{kind}"), short)


class RosMessages(Messages):
    """Messages of `robot.record_messages`, for publishers, and further ones that a record does not contain."""

    def __init__(self, vehicle: Vehicle, prefix: str = "") -> None:
        super().__init__(vehicle, prefix)
        self._of = _Makers()

    def fix(self, stamp: int, position: Any, quaternion: Any, covariance: Any) -> Any:
        """Return the pose from one picture, map frame; covariance (6, 6)."""
        of = self._of
        pose = of["geometry_msgs/msg/PoseWithCovariance"](
            self.pose(position, quaternion), np.ascontiguousarray(covariance, np.float64).ravel()
        )
        return of["geometry_msgs/msg/PoseWithCovarianceStamped"](self.header(stamp, MAP), pose)

    def compressed(self, stamp: int, image: npt.NDArray[np.uint8]) -> Any | None:
        """Return a picture as JPEG; None if it cannot be encoded."""
        return self.picture(stamp, jpeg(image), OPTICAL)

    def found_tags(self, stamp: int, picture: Picture, finder: str) -> Any:
        """Return the corners of tags as JSON, with the time of exposure [ns] and the name of the detecting node."""
        values = json.loads(self.tags(picture).data)
        return self.words({"stamp_ns": stamp, "finder": finder, **values})

    def transforms(self, stamp: int, parts: Any) -> Any:
        """Return transforms from (parent, child, (position [m], quaternion))."""
        of = self._of
        return of["tf2_msgs/msg/TFMessage"](
            [
                of["geometry_msgs/msg/TransformStamped"](
                    self.header(stamp, parent),
                    self.frame(child),
                    of["geometry_msgs/msg/Transform"](self.vector(p), self.quaternion(q)),
                )
                for parent, child, (p, q) in parts
            ]
        )

    def path(self, stamp: int, times: Any, places: Any, yaws: Any) -> Any:
        """Return a trajectory's poses, (n, 3) [m] and (n,) [rad], each stamped with its time, (n,) [ns]."""
        poses = [self.goal(int(t), p, float(yaw)) for t, p, yaw in zip(times, places, yaws, strict=True)]
        return self._of["nav_msgs/msg/Path"](self.header(stamp, MAP), poses)

    def clock(self, stamp: int) -> Any:
        """Return the simulated time."""
        return self._of["rosgraph_msgs/msg/Clock"](self.time(stamp))

    def done(self, stamp: int, name: str) -> Any:
        """Return a node's report in lock-step, with its full name."""
        return self._of["std_msgs/msg/Header"](self.time(stamp), name)

    def team_message(self, stamp: int, sender: str, data: bytes) -> Any:
        """Return the message of a vehicle to the others of its team."""
        header = self._of["std_msgs/msg/Header"](self.time(stamp), "")
        return self._of["finssim_msgs/msg/TeamMessage"](header, sender, np.frombuffer(data, np.uint8))


class _Makers(dict[str, Callable[..., Any]]):
    """Type -> function that creates a message from fields by position or name, with arrays in the form that
    rclpy accepts."""

    def __missing__(self, name: str) -> Callable[..., Any]:
        cls = ros_type(name)
        fields = cls.get_fields_and_field_types()
        names = tuple(fields)
        convert = {n: _converter(kind) for n, kind in fields.items()}

        def make(*values: Any, **named: Any) -> Any:
            named |= zip(names, values, strict=False)
            return cls(**{n: convert[n](v) for n, v in named.items()})

        self[name] = make
        return make


def _converter(kind: str) -> Callable[[Any], Any]:
    """Return the function that converts a value for a field of the real rclpy."""
    if kind in ("octet", "byte"):
        return lambda value: bytes([value]) if isinstance(value, int) else value
    if kind == "sequence<uint8>":
        return lambda value: array.array("B", np.ascontiguousarray(value, np.uint8).tobytes())
    if kind in ("sequence<double>", "sequence<float>"):
        code = kind[9]
        return lambda value: array.array(code, np.asarray(value, code).tobytes())
    return lambda value: value
