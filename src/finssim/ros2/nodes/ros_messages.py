"""The messages of a record as messages of rclpy: one description of what each field holds, for both."""

from __future__ import annotations

import array
import json
from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np
import numpy.typing as npt

from finssim.localization.pool import Pool
from finssim.robot.messages import Picture
from finssim.robot.pictures import jpeg
from finssim.robot.record_messages import MAP, Messages, floats
from finssim.vehicles import Vehicle

__all__ = ["OPTICAL", "RosMessages", "ros_type"]

OPTICAL = "camera_optical"
LENS_MODELS = {"plumb_bob": "plumb_bob", "rational": "rational_polynomial", "fisheye": "equidistant"}
"""Our name of a lens model -> that of ROS, with the same coefficients in the same order."""


def ros_type(name: str) -> Any:
    """The class of a type named as `nav_msgs/msg/Odometry`."""
    package, kind, short = name.split("/")
    return getattr(import_module(f"{package}.{kind}"), short)


class RosMessages(Messages):
    """As `robot.record_messages`, for publishers; and what a record does not hold."""

    def __init__(self, vehicle: Vehicle, prefix: str = "") -> None:
        super().__init__(vehicle, prefix)
        self._of = _Makers()

    def fix(self, stamp: int, position: Any, quaternion: Any, covariance: Any) -> Any:
        """Pose from one picture, map frame; covariance (6, 6)."""
        of = self._of
        pose = of["geometry_msgs/msg/PoseWithCovariance"](
            self.pose(position, quaternion), np.ascontiguousarray(covariance, np.float64).ravel()
        )
        return of["geometry_msgs/msg/PoseWithCovarianceStamped"](self.header(stamp, MAP), pose)

    def image(self, stamp: int, image: npt.NDArray[np.uint8]) -> Any:
        """A gray picture."""
        rows, columns = image.shape
        return self._of["sensor_msgs/msg/Image"](
            header=self.header(stamp, OPTICAL),
            height=rows,
            width=columns,
            encoding="mono8",
            is_bigendian=0,
            step=columns,
            data=image.ravel(),
        )

    def compressed(self, stamp: int, image: npt.NDArray[np.uint8]) -> Any | None:
        """The same as JPEG; None where it cannot be packed."""
        packed = jpeg(image)
        if packed is None:
            return None
        message = self.picture(stamp, packed)
        message.header.frame_id = OPTICAL
        return message

    def found_tags(self, stamp: int, picture: Picture, finder: str) -> Any:
        """Corners of tags as JSON: with the time of exposure [ns] and who found them."""
        values = json.loads(self.tags(picture).data)
        return self.words({"stamp_ns": stamp, "finder": finder, **values})

    def camera_info(self, stamp: int, pool: Pool) -> Any:
        """The camera's calibration."""
        lens = pool.camera.lens
        K = [lens.fx, 0.0, lens.cx, 0.0, lens.fy, lens.cy, 0.0, 0.0, 1.0]
        P = [*K[:3], 0.0, *K[3:6], 0.0, *K[6:], 0.0]
        return self._of["sensor_msgs/msg/CameraInfo"](
            header=self.header(stamp, OPTICAL),
            height=lens.height,
            width=lens.width,
            distortion_model=LENS_MODELS[lens.model],
            d=floats(lens.distortion or (0.0,) * 5),
            k=floats(K),
            r=np.eye(3).ravel(),
            p=floats(P),
        )

    def transforms(self, stamp: int, parts: Any) -> Any:
        """Frames in frames: parent, child, and position [m] with quaternion."""
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
        """A trajectory's poses, (n, 3) [m] and (n,) [rad], each stamped with its time, (n,) [ns]."""
        poses = [self.goal(int(t), p, float(yaw)) for t, p, yaw in zip(times, places, yaws, strict=True)]
        return self._of["nav_msgs/msg/Path"](self.header(stamp, MAP), poses)

    def clock(self, stamp: int) -> Any:
        """Simulated time."""
        return self._of["rosgraph_msgs/msg/Clock"](self.time(stamp))


class _Makers(dict[str, Callable[..., Any]]):
    """Type -> what makes a message of it, with fields by position or by name, and arrays as rclpy takes them."""

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
    """What makes a value into one that a field of real rclpy takes."""
    if kind in ("octet", "byte"):
        return lambda value: bytes([value]) if isinstance(value, int) else value
    if kind == "sequence<uint8>":
        return lambda value: array.array("B", np.ascontiguousarray(value, np.uint8).tobytes())
    if kind == "sequence<double>":
        return lambda value: array.array("d", np.asarray(value, np.float64).tobytes())
    return lambda value: value
