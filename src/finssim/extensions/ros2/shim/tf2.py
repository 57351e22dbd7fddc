"""`tf2_ros`: poses of frames over time from /tf and /tf_static, and both broadcasters; names and errors as in
tf2_ros."""

from __future__ import annotations

import bisect
import math
import time as system_time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from finssim.core.rotations import (
    quat_conjugate,
    quat_from_rotvec,
    quat_multiply,
    quat_rotate,
    quat_to_rotvec,
)
from finssim.extensions.ros2.codec import codec_of
from finssim.extensions.ros2.limits import Limited
from finssim.extensions.ros2.shim.qos import DurabilityPolicy, QoSProfile
from finssim.extensions.ros2.shim.time import Duration, Time

Array = npt.NDArray[np.float64]
Pose = tuple[Array, Array]
"""Position [m] (3,) and orientation xyzw (4,) of a frame in another."""

NONE, CACHE = Duration(), Duration(seconds=10.0)
UNIT = 0.01
"""Largest deviation of a quaternion's squared length from 1 [-]."""
POLL = 0.02
"""Polling interval while a lookup waits [s]."""
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class TransformException(Exception):
    """Base of the exceptions about transforms."""


class LookupException(TransformException):
    """Unknown frame."""


class ConnectivityException(TransformException):
    """Two frames in different trees."""


class ExtrapolationException(TransformException):
    """Time outside the known range."""


class InvalidArgumentException(TransformException):
    """Malformed frame name or transform."""


class TimeoutException(TransformException):
    """Exception that is defined only for code that catches it."""


def _times(first: Pose, second: Pose) -> Pose:
    """Return the pose of the second pose's frame in the parent of the first."""
    position = first[0] + np.asarray(quat_rotate(first[1], second[0]))
    return position, np.asarray(quat_multiply(first[1], second[1]))


def _inverse(pose: Pose) -> Pose:
    q = np.asarray(quat_conjugate(pose[1]))
    return -np.asarray(quat_rotate(q, pose[0])), q


IDENTITY: Pose = (np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))


@dataclass
class _Link:
    """Parent of a frame and its pose there, over time; a static one is valid at any time."""

    static: bool
    stamps: list[int] = field(default_factory=list)
    """Stamps [ns], increasing; a single meaningless one if static."""
    samples: list[tuple[str, Pose]] = field(default_factory=list)

    def add(self, stamp: int, parent: str, pose: Pose, cache: int) -> bool:
        """Insert a sample; return whether it is recent enough."""
        if self.static:
            self.stamps, self.samples = [0], [(parent, pose)]
            return True
        if self.stamps and stamp < self.stamps[-1] - cache:
            return False
        i = bisect.bisect_left(self.stamps, stamp)
        replaced = i + (i < len(self.stamps) and self.stamps[i] == stamp)
        self.stamps[i:replaced], self.samples[i:replaced] = [stamp], [(parent, pose)]
        old = bisect.bisect_left(self.stamps, self.stamps[-1] - cache)
        del self.stamps[:old], self.samples[:old]
        return True

    def at(self, stamp: int) -> tuple[str, Pose]:
        """Return parent and pose at a time [ns], interpolated linearly and spherically.

        Raises:
            ExtrapolationException: The time is before the first or after the last sample.
        """
        if self.static:
            return self.samples[0]
        i = bisect.bisect_left(self.stamps, stamp)
        if i < len(self.stamps) and self.stamps[i] == stamp:
            return self.samples[i]
        if i in (0, len(self.stamps)):
            way, end, word = ("past", 0, "earliest") if i == 0 else ("future", -1, "latest")
            raise ExtrapolationException(
                f"Lookup would require extrapolation into the {way}.  Requested time {1e-9 * stamp:.6f} but the {word} "
                f"data is at time {1e-9 * self.stamps[end]:.6f}"
            )
        (parent, first), (later_parent, second) = self.samples[i - 1], self.samples[i]
        if parent != later_parent:
            return parent, first
        part = (stamp - self.stamps[i - 1]) / (self.stamps[i] - self.stamps[i - 1])
        turn = np.asarray(quat_to_rotvec(quat_multiply(quat_conjugate(first[1]), second[1])))
        q = np.asarray(quat_multiply(first[1], quat_from_rotvec(part * turn)))
        return parent, (first[0] + part * (second[0] - first[0]), q)


class Buffer(Limited):
    """Frames and their poses over the last seconds.

    Args:
        cache_time: Time for which poses are stored; default 10 s.
        node: Accepted as in tf2_ros; the service `tf2_frames` is not offered.
    """

    def __init__(self, cache_time: Duration | None = None, node: Any = None) -> None:
        self._cache = (cache_time or CACHE).nanoseconds
        self._links: dict[str, _Link] = {}

    def set_transform(self, transform: Any, authority: str) -> None:
        """Add a TransformStamped.

        Raises:
            InvalidArgumentException: A frame has no name or is its own parent, a number is not finite, or the
                rotation is invalid.
        """
        self._set(transform, static=False)

    def set_transform_static(self, transform: Any, authority: str) -> None:
        """Add a TransformStamped that is valid at any time; raises as `set_transform`."""
        self._set(transform, static=True)

    def clear(self) -> None:
        """Remove all transforms."""
        self._links.clear()

    def lookup_transform(
        self, target_frame: str, source_frame: str, time: Any, timeout: Duration = NONE
    ) -> Any:
        """Return the pose of the source frame in the target frame, as TransformStamped.

        Args:
            target_frame: Frame of the resulting coordinates.
            source_frame: Frame of the given coordinates.
            time: Time; `Time()` is the latest time at which the complete chain is known.
            timeout: Longest wait; only another thread can receive transforms meanwhile.

        Raises:
            LookupException: A frame is unknown.
            ConnectivityException: The frames are not connected.
            ExtrapolationException: The time is outside the known range.
            InvalidArgumentException: A name is malformed.
        """
        return self.lookup_transform_full(target_frame, time, source_frame, time, target_frame, timeout)

    def lookup_transform_full(
        self,
        target_frame: str,
        target_time: Any,
        source_frame: str,
        source_time: Any,
        fixed_frame: str,
        timeout: Duration = NONE,
    ) -> Any:
        """Return the source frame at one time in the target frame at another, through a fixed frame.

        Arguments and errors are as in `lookup_transform`.
        """
        later, earlier = _nanoseconds(target_time), _nanoseconds(source_time)
        parts = ((fixed_frame, source_frame, earlier), (target_frame, fixed_frame, later))
        self._wait(lambda: all(self._try(*part)[1] == "" for part in parts), timeout)
        (stamp, pose), (late, last) = (self._look(*part) for part in parts)
        stamp = late if target_frame != fixed_frame else stamp
        position, q = _times(last, pose)
        of = codec_of().message
        header = of("std_msgs/msg/Header")(stamp=Time(nanoseconds=stamp).to_msg(), frame_id=target_frame)
        x, y, z = (float(v) for v in position)
        qx, qy, qz, qw = (float(v) for v in q)
        transform = of("geometry_msgs/msg/Transform")(
            translation=of("geometry_msgs/msg/Vector3")(x=x, y=y, z=z),
            rotation=of("geometry_msgs/msg/Quaternion")(x=qx, y=qy, z=qz, w=qw),
        )
        return of("geometry_msgs/msg/TransformStamped")(
            header=header, child_frame_id=source_frame, transform=transform
        )

    def can_transform(
        self,
        target_frame: str,
        source_frame: str,
        time: Any,
        timeout: Duration = NONE,
        return_debug_tuple: bool = False,
    ) -> Any:
        """Return whether `lookup_transform` has a result; with `return_debug_tuple` also the reason if not."""
        stamp = _nanoseconds(time)
        self._wait(lambda: self._try(target_frame, source_frame, stamp)[1] == "", timeout)
        _, reason = self._try(target_frame, source_frame, stamp)
        return (not reason, reason) if return_debug_tuple else not reason

    def get_latest_common_time(self, target_frame: str, source_frame: str) -> Time:
        """Return the latest time at which the chain between two frames is known."""
        return Time(nanoseconds=self._look(target_frame, source_frame, 0)[0])

    def _set(self, transform: Any, *, static: bool) -> None:
        child, parent = (name.lstrip("/") for name in (transform.child_frame_id, transform.header.frame_id))
        t, r = transform.transform.translation, transform.transform.rotation
        position, q = np.array([t.x, t.y, t.z]), np.array([r.x, r.y, r.z, r.w])
        if not child or not parent or child == parent:
            raise InvalidArgumentException(
                f"a transform from '{parent}' to '{child}': give two different frames"
            )
        if not np.isfinite([*position, *q]).all() or not math.isclose(q @ q, 1.0, abs_tol=UNIT):
            raise InvalidArgumentException(
                f"transform from '{parent}' to '{child}': expected finite numbers and a quaternion of length 1"
            )
        link = self._links.get(child)
        if link is None or link.static != static:
            link = self._links[child] = _Link(static)
        stamp = _nanoseconds(transform.header.stamp)
        link.add(stamp, parent, (position, q / np.linalg.norm(q)), self._cache)

    def _try(self, target: str, source: str, stamp: int) -> tuple[Any, str]:
        try:
            return self._look(target, source, stamp), ""
        except TransformException as error:
            return None, str(error)

    def _look(self, target: str, source: str, stamp: int) -> tuple[int, Pose]:
        """Return the time (the latest common one for 0) and the pose of the source in the target."""
        known = self._links.keys() | {parent for link in self._links.values() for parent, _ in link.samples}
        for argument, frame in (("target_frame", target), ("source_frame", source)):
            if not frame or frame.startswith("/"):
                raise InvalidArgumentException(
                    f"{argument} is '{frame}': give a name without a leading slash"
                )
            if frame not in known:
                raise LookupException(
                    f'"{frame}" passed to lookupTransform argument {argument} does not exist. '
                )
        if target == source:
            return stamp, IDENTITY
        if not stamp:
            newest = lambda link: link.stamps[-1]  # noqa: E731
            ends = [self._way(frame, newest) for frame in (target, source)]
            used = [link for way, other in (ends, ends[::-1]) for link in _until_common(way, other)]
            stamp = min((link.stamps[-1] for link in used if not link.static), default=0)
        return stamp, self._join(target, source, stamp)

    def _join(self, target: str, source: str, stamp: int) -> Pose:
        up, why = zip(*(self._chain(frame, stamp) for frame in (target, source)), strict=True)
        for frame, pose in up[1].items():
            if frame in up[0]:
                return _times(_inverse(up[0][frame]), pose)
        looking = f", when looking up transform from frame [{source}] to frame [{target}]"
        for reason in why:
            if reason is not None:
                raise ExtrapolationException(f"{reason}{looking}")
        raise ConnectivityException(
            f"Could not find a connection between '{target}' and '{source}' because they are not part of the same "
            "tree. Tf has two or more unconnected trees."
        )

    def _chain(self, frame: str, stamp: int) -> tuple[dict[str, Pose], ExtrapolationException | None]:
        """Return a frame's pose in each frame above it at a time, itself first, and the exception that ends
        the chain."""
        start, pose, poses = frame, IDENTITY, {frame: IDENTITY}
        while frame in self._links:
            try:
                frame, step = self._links[frame].at(stamp)
            except ExtrapolationException as error:
                return poses, error
            if frame in poses:
                raise ConnectivityException(f"the frames above '{start}' form a loop at '{frame}'")
            pose = _times(step, pose)
            poses[frame] = pose
        return poses, None

    def _way(self, frame: str, newest: Callable[[_Link], int]) -> list[tuple[str, _Link | None]]:
        """Return the frames from one up to its root by their newest parents, each with the link above it."""
        way: list[tuple[str, _Link | None]] = []
        while (link := self._links.get(frame)) is not None and frame not in (seen for seen, _ in way):
            way.append((frame, link))
            frame = link.samples[-1][0]
        return [*way, (frame, None)]

    def _wait(self, there: Callable[[], bool], timeout: Duration) -> None:
        end = system_time.monotonic() + 1e-9 * timeout.nanoseconds
        while not there() and system_time.monotonic() < end:
            system_time.sleep(POLL)


def _until_common(
    way: list[tuple[str, _Link | None]], other: list[tuple[str, _Link | None]]
) -> Iterable[_Link]:
    """Return the links of a chain below the first frame that is also in the other one."""
    shared = {frame for frame, _ in other}
    for frame, link in way:
        if frame in shared or link is None:
            return
        yield link


def _nanoseconds(time: Any) -> int:
    """Return a `Time` or its message in [ns]."""
    if isinstance(time, Time):
        return time.nanoseconds
    if isinstance(time, codec_of().message("builtin_interfaces/msg/Time")):
        return int(time.sec) * 10**9 + int(time.nanosec)
    raise TypeError(f"a time of {time!r}: expected a rclpy.time.Time or builtin_interfaces.msg.Time")


class TransformListener:
    """Listener that fills a buffer from /tf and /tf_static while its node is spun.

    Args:
        buffer: Buffer to fill.
        node: Node that subscribes.
        spin_thread: Only False is supported: spin the node yourself.
        qos: Policies for /tf.
        static_qos: Policies for /tf_static.
    """

    def __init__(
        self, buffer: Buffer, node: Any, *, spin_thread: bool = False, qos: Any = None, static_qos: Any = None
    ) -> None:
        if spin_thread:
            raise TypeError(
                "spin_thread=True needs a sourced ROS 2: spin the node, and look up in its callbacks"
            )
        kind = codec_of().message("tf2_msgs/msg/TFMessage")
        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.buffer, self.node = buffer, node
        self.tf_sub = node.create_subscription(kind, "/tf", self._taker(buffer.set_transform), qos or 100)
        self.tf_static_sub = node.create_subscription(
            kind, "/tf_static", self._taker(buffer.set_transform_static), static_qos or latched
        )

    def unregister(self) -> None:
        """Destroy the subscriptions."""
        self.node.destroy_subscription(self.tf_sub)
        self.node.destroy_subscription(self.tf_static_sub)

    def _taker(self, put: Callable[[Any, str], None]) -> Callable[[Any], None]:
        def take(message: Any) -> None:
            for transform in message.transforms:
                try:
                    put(transform, "default_authority")
                except InvalidArgumentException as error:
                    self.node.get_logger().warning(f"left out: {error}", throttle_duration_sec=1.0)

        return take


class TransformBroadcaster:
    """Publisher of poses of frames on /tf.

    Args:
        node: Node that publishes.
        qos: Policies of the publisher.
    """

    topic, policies = "/tf", QoSProfile(depth=100)

    def __init__(self, node: Any, qos: Any = None) -> None:
        kind = codec_of().message("tf2_msgs/msg/TFMessage")
        self.pub_tf = node.create_publisher(kind, self.topic, qos or self.policies)

    def sendTransform(self, transform: Any) -> None:
        """Publish a TransformStamped, or several."""
        several = list(transform) if isinstance(transform, (list, tuple)) else [transform]
        self.pub_tf.publish(self.pub_tf.msg_type(transforms=self._all(several)))

    def _all(self, several: list[Any]) -> list[Any]:
        return several


class StaticTransformBroadcaster(TransformBroadcaster):
    """Publisher of static poses on /tf_static, which sends all poses given so far each time."""

    topic, policies = "/tf_static", LATCHED

    def __init__(self, node: Any, qos: Any = None) -> None:
        super().__init__(node, qos)
        self._sent: dict[str, Any] = {}

    def _all(self, several: list[Any]) -> list[Any]:
        self._sent |= {transform.child_frame_id: transform for transform in several}
        return list(self._sent.values())
